"""Scans and recipes on the command line: the options of a scan, and the recipe equivalent to them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import fields
from pathlib import Path
from typing import Annotated, Any

import typer

from ..errors import RequestError
from ..recipe import Recipe
from ..settings import SUN_COHERENCE_LENGTH, Settings
from ..surface.prepare import STEP_NAMES, step_of

PixelSize = Annotated[float | None, typer.Option(help="pixel size of the scan, µm")]
HeightRange = Annotated[float | None, typer.Option(help="heights from black to white, µm")]
FillMissing = Annotated[bool, typer.Option("--fill-missing", help="interpolate missing pixels of the scan")]
Channel = Annotated[str | None, typer.Option(help="channel of the scan, by name or number")]
Unit = Annotated[
    list[str] | None,
    typer.Option(help="unit of a scan without one; given twice: lateral, then of the heights"),
]
Prepare = Annotated[
    list[str] | None,
    typer.Option(help=f"apply a step to the scan, in the order given: {', '.join(STEP_NAMES)}; NAME=ARGUMENT"),
]
Extent = Annotated[
    str | None,
    typer.Option(help="tile (periodic) or sample (of an irregular surface); default: that of the recipe"),
]
CoherenceLength = Annotated[
    float | None, typer.Option(help=f"µm; default: that of the recipe, or of sunlight, {SUN_COHERENCE_LENGTH:g}")
]


def options_of_scan(context: typer.Context) -> dict[str, object]:
    """Return the options of a scan that the command was given, under their names in recipes."""
    given = _given(context, ("pixel_size", "height_range", "fill_missing", "channel", "unit", "prepare"))
    if len(unit := given.get("unit", ())) == 1:
        given["unit"] = unit[0]
    steps = [*["level_plane"] * context.params.get("plane", False), *given.get("prepare", [])]
    return {**given, "prepare": [step_of(text) for text in steps]} if steps else given


def settings_of(context: typer.Context) -> dict[str, object]:
    """Return the options of the spectrum that the command was given, under their names in `Settings`."""
    return _given(context, [field.name for field in fields(Settings)])


def _given(context: typer.Context, names: Iterable[str]) -> dict[str, Any]:
    # A number may be zero, which is refused elsewhere.
    return {n: value for n in names if (value := context.params.get(n)) not in (None, ()) and value is not False}


def recipe_of(source: Path, of_scan: dict[str, object], settings: dict[str, object]) -> Recipe:
    """Return the recipe in a file, or the one equivalent to a scan; `settings` take the place of those of a file."""
    if source.suffix.lower() != ".toml":
        return Recipe({"scan": source.name, **of_scan}, settings, source.parent)
    if of_scan:
        names = ", ".join(f"--{name.replace('_', '-')}" for name in of_scan)
        raise RequestError(f"{names} go with a scan; the recipe {source} has its own")
    return Recipe.load(source, **settings)
