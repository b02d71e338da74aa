"""`mitsuba-diffraction view`: a page in which a surface is shaded live in the browser."""

from __future__ import annotations

import functools
import shlex
import webbrowser
from pathlib import Path
from typing import Annotated, Any

import typer

from ..files import whole_file
from ..outputs import check_outputs
from ..progress import NAME, progress_bar, say, tell
from ..viewer.page import page, reference_picture
from ..viewer.surface import Surface
from .arguments import (
    SCAN_OPTIONS,
    Overwrite,
    check_suffix,
    given_of,
    is_film,
    is_scan,
    options_of_scan,
    recipe_of,
    settings_of,
    surface_of,
    takes_scan,
)


@takes_scan
def view(
    context: typer.Context,
    source: Annotated[
        str,
        typer.Argument(
            metavar="SURFACE[,name=value…]",
            help="a recipe (.toml), a saved spectrum (.exr), a profile, or a scan; name=value: material, int_ior, "
            "orientation, height_scale, and the parameters of a profile",
        ),
    ],
    output: Annotated[Path | None, typer.Option("-o", "--output", help="the page; default: ./NAME.html")] = None,
    reference: Annotated[
        Path | None, typer.Option(help="a spectral picture (.exr) of `render`, for comparison in the page")
    ] = None,
    open_page: Annotated[bool, typer.Option("--open/--no-open", help="open the page in the browser")] = True,
    overwrite: Overwrite = False,
) -> None:
    """Write a page that shades a surface live in the browser (WebGL2), without network."""
    name, parameters = surface_of(source)
    path, progress = Path(name), functools.partial(progress_bar, unit="%")
    target = output or Path(path.stem or "view").with_suffix(".html")
    check_suffix("-o", target, ".html")
    of_scan, settings = options_of_scan(context), settings_of(context)
    recipe, of_a_scan = None, is_scan(name)
    if of_a_scan or of_scan or settings:
        recipe = recipe_of(path, of_scan, settings)
    reads = [file for file in (path, reference) if file is not None and file.exists()]
    check_outputs([*reads, *(recipe.files if recipe else [])], [("-o", target)], overwrite=overwrite)
    picture = None if reference is None else reference_picture(reference)
    if recipe is None:
        surface = Surface.named(name, parameters, progress)
    else:
        spectrum = f"{path.stem}.exr"
        options = _words(given_of(context, SCAN_OPTIONS) | ({"extent": recipe.settings.extent} if of_a_scan else {}))
        command = shlex.join([NAME, "precompute", path.name, *options, "-o", spectrum])
        surface = Surface.of_recipe(recipe, path.stem, {"filename": spectrum}, parameters, progress, command)
    if is_film(name):
        say(
            "note", f"{name}: the page shows the light that it reflects; `render` shows the light that a film transmits"
        )
    text = page(surface, picture)
    with whole_file(target) as temporary:
        temporary.write_text(text, encoding="utf-8")
    tell(f"{target}: {surface.spectrum.source}, {len(text.encode()) / 1e6:.2g} MB")
    if open_page:
        webbrowser.open(target.resolve().as_uri())


def _words(options: dict[str, Any]) -> list[str]:
    """Return options of the command line as words."""
    words = []
    for name, value in options.items():
        option = f"--{name.replace('_', '-')}"
        for item in value if isinstance(value, list | tuple) else [value]:
            words += [option] if item is True else [option, str(item)]
    return words
