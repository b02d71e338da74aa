"""`mitsuba-diffraction validate`: the BSDF against closed forms and rigorous results."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer

from ...cli.arguments import KEYS_OF_RECIPES, SURFACE, Overwrite, Variant
from ...errors import RequestError
from ...files import outputs
from ...precomputation.recipe import Recipe
from ...precomputation.surface_text import parsed
from ...progress import progress_bar, show, tell


def validate(
    surface: Annotated[
        str | None,
        typer.Argument(
            metavar=f"[{SURFACE}]", help=f"check only this recipe (.toml), profile or scan; {KEYS_OF_RECIPES}"
        ),
    ] = None,
    variant: Variant = None,
    json: Annotated[Path | None, typer.Option(help="save the results (.json)")] = None,
    markdown: Annotated[Path | None, typer.Option(help="save a table with notes and sources (.md)")] = None,
    overwrite: Overwrite = False,
) -> None:
    """Check the BSDF against closed forms and rigorous results, or check one surface; fail if a bound is exceeded."""
    import mitsuba as mi

    from ...precomputation.grating_spectrum import GratingSpectrum
    from ...variants import choose_variant
    from .. import report
    from ..validation.checks import checks, surface_checks

    chosen = choose_variant(variant)
    source, values = ("", {}) if surface is None else parsed(surface)
    recipe = _recipe(source, values) if source else None
    reads = [] if recipe is None else [Path(source), *recipe.files]
    writes = [(option, path) for option, path in (("--json", json), ("--markdown", markdown)) if path is not None]
    outputs.check_outputs(reads, writes, overwrite=overwrite)
    mi.set_variant(chosen)
    if recipe is None:
        these = checks()
    else:
        spectrum = recipe.cached(progress_bar)
        assert isinstance(spectrum, GratingSpectrum)  # `_recipe` refuses rigorous theory
        these = surface_checks(recipe.height_field(), spectrum)
    results = []
    with progress_bar("validation") as progress:
        for check in these:
            results.append(check.run())
            progress(len(results), len(these))
    show(report.record_table(results), width=120)
    missed = [result.name for result in results if not result.ok]
    promised = sum(result.bound is not None for result in results)
    tell(
        f"{promised - len(missed)} of {promised} within their bounds; {len(results) - promised} reported without one. "
        "Differences are absolute, |found − expected|, unless stated otherwise"
    )
    if json is not None:
        outputs.save_json({"checks": report.record_dicts(results)}, json)
    if markdown is not None:
        report.save_markdown(report.record_markdown(results), markdown)
    if missed:
        raise RuntimeError(f"{len(missed)} of {promised} checks missed: {'; '.join(missed)}")


def _recipe(source: str, values: dict[str, Any]) -> Recipe:
    recipe = Recipe.of_source(source, values)
    if recipe.patches > 1:
        recipe = replace(recipe, surface={**recipe.surface, "patches": 1})
    if recipe.settings.theory == "rigorous":
        raise RequestError(f"{source}: got theory = 'rigorous', wanted scalar; precompute prints the measured errors")
    return recipe
