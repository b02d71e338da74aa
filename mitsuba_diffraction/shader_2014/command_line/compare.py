"""`mitsuba-diffraction compare`: the path tracer against the real-time shader."""

from __future__ import annotations

import time
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated

import typer

from ...cli.arguments import Define, Overwrite, Variant, check_suffix, scene_parameters
from ...errors import RequestError
from ...files.outputs import check_outputs, free_name, save_json
from ...files.writing import examples_folder, whole_file
from ...precomputation.recipe import Recipe
from ...progress import progress_bar, say, show, tell

_PICTURES = {"-path.exr": "path_traced", "-published.exr": "published", "-corrected.exr": "corrected"}
"""Suffix → picture."""


def compare(
    scene: Annotated[
        Path, typer.Argument(metavar="SCENE.xml|RECIPE.toml", help="a scene, or a recipe on the objects of scan.xml")
    ],
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="prefix of the output files, or their folder")
    ] = None,
    shader: Annotated[
        list[str] | None,
        typer.Option(help="flss (default), nmm, pq, nmm_pq or gem; may be repeated; quirks are those of the first"),
    ] = None,
    terms: Annotated[int | None, typer.Option(min=1, help="number of Taylor terms of the shader")] = None,
    window: Annotated[str | None, typer.Option(help="texel or 4sigma; of flss and nmm")] = None,
    interpolation: Annotated[str | None, typer.Option(help="sinc or linear; of pq and nmm_pq")] = None,
    brightness: Annotated[
        str, typer.Option(help="of the shader's diffraction: a number, 1000 in the published program; auto fits it")
    ] = "auto",
    pigment: Annotated[bool, typer.Option("--pigment", help="add what lies below gratings to all pictures")] = False,
    spp: Annotated[int, typer.Option(min=1, help="samples per pixel of the path tracer")] = 64,
    shading_points: Annotated[int, typer.Option(min=1, help="shading points per pixel of the shader")] = 4,
    width: Annotated[int | None, typer.Option(min=1, help="pixels; default: that of the scene")] = None,
    height: Annotated[int | None, typer.Option(min=1, help="pixels; default: that of the scene")] = None,
    shares: Annotated[bool, typer.Option(help="measure the cost of each quirk of the shader")] = True,
    variant: Variant = None,
    seed: Annotated[int, typer.Option(min=0, help="seed of the random numbers")] = 0,
    json: Annotated[Path | None, typer.Option(help="save the numbers (.json)")] = None,
    define: Define = None,
    overwrite: Overwrite = False,
) -> None:
    """Compare renderings of a scene by the path tracer and the real-time shader."""
    check_suffix("SCENE", scene, ".xml", ".toml")
    if scene.suffix.lower() == ".toml":
        Recipe.load(scene)  # reports what is wrong with it, before Mitsuba starts

    import mitsuba as mi

    from ...render.scene_file import SceneFile
    from ...variants import choose_variant
    from ..comparison import ComparisonRequest, figure, summary
    from ..comparison import compare as run
    from ..comparison.pictures import supported_lights
    from ..diffraction_shader import checked_brightness

    number = None if brightness == "auto" else checked_brightness(_number(brightness))
    parameters, name = scene_parameters(define), scene.stem
    first, *others = shader or ["flss"]
    if scene.suffix.lower() == ".toml":
        parameters = {"spectrum": str(scene.resolve()), **parameters}
        scene = examples_folder() / "scenes" / "scan.xml"
    if "light" not in parameters and (lights := supported_lights(SceneFile(scene, parameters))):
        light = parameters["light"] = "parallel" if "parallel" in lights else lights[-1]
        say("note", f"the shader does not know the lights of {scene.name}: light={light}, of {', '.join(lights)}")
    reads = SceneFile(scene, parameters).files()
    prefix = output
    if output is None or output.is_dir():
        folder = output or Path()
        prefix = folder / free_name(
            f"{name}-{first}",
            lambda stem: [folder / f"{stem}{end}" for end in (*_PICTURES, ".png", "-others.png")],
            reads,
        )
    images = {f"{prefix}{end}": picture for end, picture in _PICTURES.items()}
    figures = {f"{prefix}.png": False} | ({f"{prefix}-others.png": True} if others else {})
    written = [("-o", Path(target)) for target in (*images, *figures)]
    written += [("--json", json)] if json is not None else []
    check_outputs(reads, written, overwrite=overwrite)
    mi.set_variant(choose_variant(variant))
    request = ComparisonRequest(
        scene,
        first,
        others,
        terms=terms,
        window=window,
        interpolation=interpolation,
        brightness=number,
        pigment=pigment,
        width=width,
        height=height,
        spp=spp,
        shading_points=shading_points,
        seed=seed,
        parameters=parameters,
        shares=shares,
    )
    start = time.perf_counter()
    found = run(request, progress_bar)
    with ExitStack() as files:  # all of them or none
        for target, picture in images.items():
            found.pictures[picture].image.save(files.enter_context(whole_file(target)))
        for target, is_others in figures.items():
            figure.save_figure(found, files.enter_context(whole_file(target)), others=is_others)
        if json is not None:
            save_json(summary.as_dict(found), files.enter_context(whole_file(json)))
    of_quirks = () if found.shares is None else (summary.quirk_table(found.shares),)
    show(summary.picture_table(found), *of_quirks, width=120)
    tell("\n" + "\n".join(summary.notes(found)))
    tell(f"{', '.join(str(target) for _, target in written)}: {found.variant}, {time.perf_counter() - start:.1f} s")


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise RequestError(f"--brightness: got {text!r}, wanted auto or a number") from None
