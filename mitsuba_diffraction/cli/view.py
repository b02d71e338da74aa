"""`mitsuba-diffraction view`: a page in which a surface is shaded live in the browser."""

from __future__ import annotations

import functools
import webbrowser
from pathlib import Path
from typing import Annotated, Any

import typer

from ..errors import shell_command
from ..files.outputs import check_outputs
from ..files.writing import whole_file
from ..precomputation.recipe import Recipe
from ..progress import NAME, bytes_text, progress_bar, say, tell
from ..viewer.page import page, reference_picture
from ..viewer.viewed_surface import Surface
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
    sources: Annotated[
        list[str],
        typer.Argument(
            metavar="SURFACE[,name=value…]…",
            help="a recipe (.toml), a saved spectrum (.exr), a profile, or a scan; name=value: material, int_ior, "
            "coat_ior, orientation, height_scale, and the parameters of a profile; several are a list in one page",
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
    requests = [surface_of(source) for source in sources]
    stem = Path(requests[0][0]).stem or "view"
    target = output or Path(stem if len(requests) == 1 else "surfaces").with_suffix(".html")
    check_suffix("-o", target, ".html")
    of_scan, settings = options_of_scan(context), settings_of(context)
    # The options of a scan do not apply to the other surfaces.
    has_scan = any(is_scan(name) for name, _ in requests)
    recipes = [
        recipe_of(Path(name), of_scan, settings) if is_scan(name) or ((of_scan or settings) and not has_scan) else None
        for name, _ in requests
    ]
    reads = [file for file in (*(Path(name) for name, _ in requests), reference) if file is not None and file.exists()]
    files = [file for recipe in recipes if recipe is not None for file in recipe.files]
    check_outputs([*reads, *files], [("-o", target)], overwrite=overwrite)
    picture = None if reference is None else reference_picture(reference)
    surfaces = [
        _surface(context, name, parameters, recipe)
        for (name, parameters), recipe in zip(requests, recipes, strict=True)
    ]
    text = page(*surfaces, picture=picture)
    with whole_file(target) as temporary:
        temporary.write_text(text, encoding="utf-8")
    shown = surfaces[0].spectrum.source if len(surfaces) == 1 else f"{len(surfaces)} surfaces"
    tell(f"{target}: {shown}, {bytes_text(len(text.encode()))}")
    address = target.resolve().as_uri()
    tell(f"open {address} in a browser")
    if open_page:
        webbrowser.open(address)


def _surface(context: typer.Context, name: str, parameters: dict[str, Any], recipe: Recipe | None) -> Surface:
    """Return the surface of one argument; a recipe is given for a scan, or for other settings."""
    path, progress = Path(name), functools.partial(progress_bar, unit="%")
    if is_film(name):
        say(
            "note", f"{name}: the page shows the light that it reflects; `render` shows the light that a film transmits"
        )
    if recipe is None:
        return Surface.named(name, parameters, progress)
    spectrum = f"{path.stem}.exr"
    extent = {"extent": recipe.settings.extent} if is_scan(name) else {}
    options = _words(given_of(context, SCAN_OPTIONS) | extent)
    command = shell_command(NAME, "precompute", path.name, *options, "-o", spectrum)
    return Surface.of_recipe(recipe, path.stem, {"filename": spectrum}, parameters, progress, command)


def _words(options: dict[str, Any]) -> list[str]:
    """Return options of the command line as words."""
    words = []
    for name, value in options.items():
        option = f"--{name.replace('_', '-')}"
        for item in value if isinstance(value, list | tuple) else [value]:
            words += [option] if item is True else [option, str(item)]
    return words
