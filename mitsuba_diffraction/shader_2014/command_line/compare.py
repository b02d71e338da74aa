"""`mitsuba-diffraction compare`: the path tracer against the real-time shader."""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ...cli.arguments import Define, Overwrite, Variant, as_command, check_suffix, scene_parameters
from ...errors import RequestError
from ...files.outputs import check_outputs, free_name, save_json
from ...files.writing import examples_folder, whole_file
from ...precomputation.recipe import Recipe
from ...progress import progress_bar, say, show, tell

if TYPE_CHECKING:
    from ...render.scene_file import SceneFile
    from ..comparison import ComparisonRequest

_PICTURES = {"-path.exr": "path_traced", "-published.exr": "published", "-corrected.exr": "corrected"}
"""Suffix → picture."""


@dataclass(frozen=True)
class CompareRequest:
    """What `compare` was asked for: its arguments and options."""

    scene: Annotated[
        Path, typer.Argument(metavar="SCENE.xml|RECIPE.toml", help="a scene, or a recipe on the objects of scan.xml")
    ]
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="prefix of the output files, or their folder")
    ] = None
    shader: Annotated[
        list[str] | None,
        typer.Option(help="flss (default), nmm, pq, nmm_pq or gem; may be repeated; quirks are those of the first"),
    ] = None
    terms: Annotated[int | None, typer.Option(min=1, help="number of Taylor terms of the shader")] = None
    window: Annotated[str | None, typer.Option(help="texel or 4sigma; of flss and nmm")] = None
    interpolation: Annotated[str | None, typer.Option(help="sinc or linear; of pq and nmm_pq")] = None
    brightness: Annotated[
        str, typer.Option(help="of the shader's diffraction: a number, 1000 in the published program; auto fits it")
    ] = "auto"
    pigment: Annotated[bool, typer.Option("--pigment", help="add what lies below gratings to all pictures")] = False
    spp: Annotated[int, typer.Option(min=1, help="samples per pixel of the path tracer")] = 64
    shading_points: Annotated[int, typer.Option(min=1, help="shading points per pixel of the shader")] = 4
    width: Annotated[int | None, typer.Option(min=1, help="pixels; default: that of the scene")] = None
    height: Annotated[int | None, typer.Option(min=1, help="pixels; default: that of the scene")] = None
    costs: Annotated[bool, typer.Option(help="measure the cost of each quirk of the shader")] = True
    variant: Variant = None
    seed: Annotated[int, typer.Option(min=0, help="seed of the random numbers")] = 0
    json: Annotated[Path | None, typer.Option(help="save the numbers (.json)")] = None
    define: Define = None
    overwrite: Overwrite = False

    def scene_file(self) -> SceneFile:
        """Return the scene, or that on whose objects a recipe is, with lights that the shader knows."""
        from ...render.scene_file import SceneFile
        from ..comparison.pictures import supported_lights

        scene, parameters = self.scene, scene_parameters(self.define)
        if scene.suffix.lower() == ".toml":
            parameters = {"spectrum": str(scene.resolve()), **parameters}
            scene = examples_folder() / "scenes" / "scan.xml"
        if "light" not in parameters and (lights := supported_lights(SceneFile(scene, parameters))):
            light = parameters["light"] = "parallel" if "parallel" in lights else lights[-1]
            say("note", f"the shader does not know the lights of {scene.name}: light={light}, of {', '.join(lights)}")
        return SceneFile(scene, parameters)

    def outputs(self, reads: Sequence[Path]) -> tuple[dict[str, str], dict[str, bool]]:
        """Return the pictures by the paths of their files, and whether a figure is of the other shaders.

        Raises:
            RequestError: if a file may not be written, beside those that the scene reads.
        """
        first, *others = self.shader or ["flss"]
        prefix = self.output
        if prefix is None or prefix.is_dir():
            folder, ends = prefix or Path(), (*_PICTURES, ".png", "-others.png")
            name = f"{self.scene.stem}-{first}"
            prefix = folder / free_name(name, lambda stem: [folder / f"{stem}{end}" for end in ends], reads)
        images = {f"{prefix}{end}": picture for end, picture in _PICTURES.items()}
        figures = {f"{prefix}.png": False} | ({f"{prefix}-others.png": True} if others else {})
        written = [("-o", Path(target)) for target in (*images, *figures)]
        written += [("--json", self.json)] if self.json is not None else []
        check_outputs(reads, written, overwrite=self.overwrite)
        return images, figures

    def comparison(self, scene_file: SceneFile, brightness: float | None) -> ComparisonRequest:
        """Return what is compared."""
        from ..comparison import ComparisonRequest

        first, *others = self.shader or ["flss"]
        return ComparisonRequest(
            scene_file.path,
            first,
            others,
            terms=self.terms,
            window=self.window,
            interpolation=self.interpolation,
            brightness=brightness,
            pigment=self.pigment,
            width=self.width,
            height=self.height,
            spp=self.spp,
            shading_points=self.shading_points,
            seed=self.seed,
            parameters=scene_file.parameters,
            costs=self.costs,
        )


@as_command(CompareRequest)
def compare(request: CompareRequest) -> None:
    """Compare renderings of a scene by the path tracer and the real-time shader."""
    check_suffix("SCENE", request.scene, ".xml", ".toml")
    if request.scene.suffix.lower() == ".toml":
        Recipe.load(request.scene)  # reports what is wrong with it, before Mitsuba starts

    import mitsuba as mi

    from ...variants import choose_variant
    from ..comparison import compare as run
    from ..comparison import figure, summary
    from ..diffraction_shader import checked_brightness

    brightness = None if request.brightness == "auto" else checked_brightness(_number(request.brightness))
    scene_file = request.scene_file()
    images, figures = request.outputs(scene_file.files())
    mi.set_variant(choose_variant(request.variant))
    start = time.perf_counter()
    found = run(request.comparison(scene_file, brightness), progress_bar)
    with ExitStack() as files:  # all of them or none
        for target, picture in images.items():
            found.pictures[picture].image.save(files.enter_context(whole_file(target)))
        for target, is_others in figures.items():
            figure.save_figure(found, files.enter_context(whole_file(target)), others=is_others)
        if request.json is not None:
            save_json(summary.as_dict(found), files.enter_context(whole_file(request.json)))
    of_quirks = () if found.costs is None else (summary.quirk_table(found.costs),)
    show(summary.picture_table(found), *of_quirks, width=120)
    tell("\n" + "\n".join(summary.notes(found)))
    written = [*images, *figures, *([] if request.json is None else [str(request.json)])]
    tell(f"{', '.join(written)}: {found.variant}, {time.perf_counter() - start:.1f} s")


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise RequestError(f"--brightness: got {text!r}, wanted auto or a number") from None
