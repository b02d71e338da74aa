"""`mitsuba-diffraction render`: from a scene to a spectral picture."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

import typer

from .console import progress_bar, tell


def render(
    scene: Annotated[Path, typer.Argument(metavar="SCENE.xml")],
    output: Annotated[Path | None, typer.Option("-o", "--output", help="the spectral picture (.exr)")] = None,
    spp: Annotated[int, typer.Option(min=1, help="samples per pixel")] = 64,
    width: Annotated[int | None, typer.Option(min=1, help="pixels; the scene's own by default")] = None,
    height: Annotated[int | None, typer.Option(min=1, help="pixels; the scene's own by default")] = None,
    variant: Annotated[str | None, typer.Option(help="of Mitsuba; the fastest spectral one by default")] = None,
    seed: Annotated[int, typer.Option(min=0)] = 0,
    define: Annotated[
        list[str] | None, typer.Option("-D", metavar="NAME=VALUE", help="a parameter of the scene")
    ] = None,
) -> None:
    """Path-trace a scene into a spectral picture (.exr) and a preview (.png) beside it."""
    import mitsuba as mi

    from ..color import save_preview
    from ..render import render as trace
    from ..variants import choose_variant

    target = output or Path(scene.with_suffix(".exr").name)
    if target.suffix.lower() != ".exr":
        raise ValueError(f"-o: got {target}, wanted a file name that ends in .exr")
    if not target.parent.is_dir():
        raise ValueError(f"-o: got {target}, but the folder {target.parent} is not there")
    parameters = {}
    for item in define or []:
        name, equals, value = item.partition("=")
        if not (name and equals):
            raise ValueError(f"-D: got {item!r}, wanted NAME=VALUE")
        # A file named on the command line is relative to where the command is given.
        parameters[name] = str(Path(value).resolve()) if Path(value).is_file() else value
    mi.set_variant(choose_variant(variant))
    start = time.perf_counter()
    with progress_bar(scene.name) as progress:
        image = trace(scene, spp=spp, width=width, height=height, seed=seed, parameters=parameters, progress=progress)
    image.save(target)
    preview = target.with_suffix(".png")
    exposure = save_preview(image, preview)
    rows, columns, bins = image.radiance.shape
    tell(
        f"{target}: {columns} × {rows} pixels, {bins} wavelengths, {spp} samples per pixel, {mi.variant()}, "
        f"{time.perf_counter() - start:.1f} s\n{preview}: preview, exposure {exposure:.4g}"
    )
