"""How commands take a scan or a recipe: the options that a scan needs, and the recipe that they amount to."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ..coherence import SUN_COHERENCE_LENGTH
from ..errors import RequestError
from ..recipe import Recipe
from ..surface.prepare import STEP_NAMES, step_of

PixelSize = Annotated[float | None, typer.Option(help="of a scan, µm")]
HeightRange = Annotated[float | None, typer.Option(help="of a scan, black to white, µm")]
FillMissing = Annotated[
    bool, typer.Option("--fill-missing", help="of a scan, fill pixels without a height from their surroundings")
]
Channel = Annotated[str | None, typer.Option(help="of a scan with several, a name or a number")]
Unit = Annotated[
    list[str] | None,
    typer.Option(help="of a scan whose file names none; given twice: along the surface, and of the heights"),
]
Prepare = Annotated[
    list[str] | None,
    typer.Option(help=f"of a scan, a step, done in the order given: {', '.join(STEP_NAMES)}; NAME=ARGUMENT"),
]
Extent = Annotated[
    str | None,
    typer.Option(
        help="tile (the patch repeats) or sample (a piece of an irregular surface); a recipe's own by default"
    ),
]
CoherenceLength = Annotated[
    float | None, typer.Option(help=f"µm; a recipe's own by default, else that of sunlight, {SUN_COHERENCE_LENGTH:g}")
]


def options_of_scan(
    pixel_size: float | None,
    height_range: float | None,
    fill_missing: bool,
    channel: str | None,
    unit: list[str] | None,
    prepare: list[str] | None,
) -> dict[str, object]:
    """What was given, under the names that recipes have for it."""
    given = {
        "pixel_size": pixel_size,
        "height_range": height_range,
        "fill_missing": fill_missing or None,
        "channel": channel,
        "unit": unit[0] if unit and len(unit) == 1 else unit or None,
        "prepare": [step_of(text) for text in prepare] if prepare else None,
    }
    return {name: value for name, value in given.items() if value is not None}


def recipe_of(source: Path, of_scan: dict[str, object], settings: dict[str, object]) -> Recipe:
    """The recipe that a file is, or that a scan and its options make; `settings` of the spectrum go before its own.

    Raises:
        ValueError: if options of a scan are given for a recipe, or something in either is wrong.
    """
    if source.suffix.lower() != ".toml":
        return Recipe({"scan": source.name, **of_scan}, settings, source.parent)
    if of_scan:
        names = ", ".join(f"--{name.replace('_', '-')}" for name in of_scan)
        raise RequestError(f"{names} go with a scan; the recipe {source} has its own")
    recipe = Recipe.load(source)
    return Recipe(recipe.surface, {**recipe.spectrum, **settings}, recipe.folder)
