"""`mitsuba-diffraction compare`: the path tracer against the real-time shader."""

from __future__ import annotations

import time
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from ..files import refuse_unwritable, whole_file
from .arguments import scene_parameters
from .console import out, progress_bar, tell


def compare(
    scene: Annotated[Path, typer.Argument(metavar="SCENE.xml")],
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="what the names of the files begin with, or a folder")
    ] = None,
    shader: Annotated[str, typer.Option(help="flss, nmm, pq or gem")] = "flss",
    spp: Annotated[int, typer.Option(min=1, help="samples per pixel of the path tracer")] = 64,
    shading_points: Annotated[int, typer.Option(min=1, help="per pixel of the shader, each with its spectrum")] = 4,
    width: Annotated[int | None, typer.Option(min=1, help="pixels; the scene's own by default")] = None,
    height: Annotated[int | None, typer.Option(min=1, help="pixels; the scene's own by default")] = None,
    shares: Annotated[bool, typer.Option(help="measure what each quirk of the shader makes")] = True,
    variant: Annotated[str | None, typer.Option(help="of Mitsuba; the fastest spectral one by default")] = None,
    seed: Annotated[int, typer.Option(min=0)] = 0,
    json: Annotated[Path | None, typer.Option(help="write the numbers here, too")] = None,
    define: Annotated[
        list[str] | None, typer.Option("-D", metavar="NAME=VALUE", help="a parameter of the scene")
    ] = None,
) -> None:
    """Render a scene with the path tracer and with the real-time shader, and show and measure the difference."""
    import mitsuba as mi

    from ..studies.shader_comparison import compare as run
    from ..studies.shader_comparison import summary
    from ..variants import choose_variant

    name = f"{scene.stem}-{shader}"
    prefix = Path(name) if output is None else output / name if output.is_dir() else output
    if not prefix.parent.is_dir():
        raise ValueError(f"-o: got {prefix}, but the folder {prefix.parent} is not there")
    if json is not None and not json.parent.is_dir():
        raise ValueError(f"--json: got {json}, but the folder {json.parent} is not there")
    images = {
        f"{prefix}-path.exr": "path_traced",
        f"{prefix}-published.exr": "published",
        f"{prefix}-corrected.exr": "corrected",
    }
    written = [*images, f"{prefix}.png", *([str(json)] if json is not None else [])]
    for target in written:
        refuse_unwritable(target)
    parameters = scene_parameters(define)
    mi.set_variant(choose_variant(variant))
    start = time.perf_counter()
    found = run(
        scene,
        shader,
        width=width,
        height=height,
        spp=spp,
        shading_points=shading_points,
        seed=seed,
        parameters=parameters,
        shares=shares,
        progress=progress_bar,
    )
    with ExitStack() as files:  # all of them or none
        for target, picture in images.items():
            found.pictures[picture].image.save(files.enter_context(whole_file(target)))
        summary.save_figure(found, files.enter_context(whole_file(f"{prefix}.png")))
        if json is not None:
            summary.save_json(found, files.enter_context(whole_file(json)))
    # Wide enough wherever it goes, a file too.
    wide = Console(highlight=False, width=max(out.width, 120))
    wide.print(summary.picture_table(found))
    if found.shares is not None:
        wide.print("", summary.quirk_table(found), sep="\n")
    tell("\n" + "\n".join(summary.notes(found)))
    tell(f"{', '.join(written)}: {found.variant}, {time.perf_counter() - start:.1f} s")
