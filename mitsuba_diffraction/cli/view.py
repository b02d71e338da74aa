"""`mitsuba-diffraction view`: a page in which a surface is shaded live in the browser."""

from __future__ import annotations

import functools
import webbrowser
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from ..files.outputs import check_outputs
from ..files.writing import whole_file
from ..precomputation.in_scene import OF_SCENE
from ..precomputation.requested_surface import RequestedSurface
from ..precomputation.surface_text import written
from ..progress import bytes_text, progress_bar, say, tell
from ..viewer.page import page, reference_picture
from ..viewer.viewed_surface import ViewedSurface
from .arguments import KEYS_OF_RECIPES, SURFACE, Overwrite, check_suffix


def view(
    sources: Annotated[
        list[str],
        typer.Argument(
            metavar=SURFACE,
            help=f"a recipe (.toml), a saved spectrum (.exr), a profile, or a scan; {KEYS_OF_RECIPES}, material, "
            "int_ior, coat_ior, orientation, height_scale; several are a list in one page",
        ),
    ],
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="the page; default: ./NAME.html, of several ./surfaces.html")
    ] = None,
    reference: Annotated[
        Path | None, typer.Option(help="a spectral picture (.exr) of `render`, for comparison in the page")
    ] = None,
    open_page: Annotated[bool, typer.Option("--open/--no-open", help="open the page in the browser")] = True,
    overwrite: Overwrite = False,
) -> None:
    """Write a page that shades surfaces live in the browser (WebGL2), without network."""
    requests = [RequestedSurface.of(source, aside=OF_SCENE) for source in sources]
    stem = requests[0].path.stem or "view"
    target = output or Path(stem if len(requests) == 1 else "surfaces").with_suffix(".html")
    check_suffix("-o", target, ".html")
    reads = [*(file for request in requests for file in request.files), *([] if reference is None else [reference])]
    check_outputs(reads, [("-o", target)], overwrite=overwrite)
    picture = None if reference is None else reference_picture(reference)
    for request in requests:
        if request.is_film:
            shown = "the page shows the light that it reflects; `render` shows the light that a film transmits"
            say("note", f"{request.title}: {shown}")
    progress = functools.partial(progress_bar, unit="%")
    surfaces = [ViewedSurface.requested(request, progress) for request in requests]
    for request in requests:
        request.say_extent()
    stems = [one.name for one in surfaces]
    for index, request in enumerate(requests):
        values = {**request.values, **request.aside}
        if values and stems.count(stems[index]) > 1:  # as of two periods, or materials, of one profile
            surfaces[index] = replace(surfaces[index], name=written(stems[index], values))
    text = page(*surfaces, picture=picture)
    with whole_file(target) as temporary:
        temporary.write_text(text, encoding="utf-8")
    shown = surfaces[0].spectrum.source if len(surfaces) == 1 else f"{len(surfaces)} surfaces"
    tell(f"{target}: {shown}, {bytes_text(len(text.encode()))}")
    address = target.resolve().as_uri()
    tell(f"open {address} in a browser")
    if open_page:
        webbrowser.open(address)
