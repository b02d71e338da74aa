"""`mitsuba-diffraction validate`: the BSDF against closed forms and rigorous results."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ...cli.arguments import (
    Overwrite,
    Variant,
    options_of_scan,
    recipe_of,
    settings_of,
    takes_scan,
)
from ...errors import RequestError
from ...files import outputs
from ...precomputation.recipe import source_named
from ...progress import progress_bar, show, tell

if TYPE_CHECKING:
    from ...precomputation.recipe import Recipe


@takes_scan
def validate(
    context: typer.Context,
    surface: Annotated[
        Path | None, typer.Argument(metavar="[SURFACE]", help="check only this recipe (.toml), profile or scan")
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

    of_scan, settings = options_of_scan(context), settings_of(context)
    if surface is None and (of_scan or settings):
        names = ", ".join(f"--{name.replace('_', '-')}" for name in {**of_scan, **settings})
        raise RequestError(
            f"{names}: got no surface; they go with a scan, --extent and --coherence-length with a recipe, too"
        )
    chosen = choose_variant(variant)
    recipe = None if surface is None else _recipe(surface, of_scan, settings)
    reads = [] if surface is None or recipe is None else [surface, *recipe.files]
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


def _recipe(path: Path, of_scan: dict[str, object], settings: dict[str, object]) -> Recipe:
    recipe = recipe_of(Path(source_named(str(path))), of_scan, settings)
    if recipe.patches > 1:
        recipe = replace(recipe, surface={**recipe.surface, "patches": 1})
    if recipe.settings.theory == "rigorous":
        raise RequestError(f"{path}: got theory = 'rigorous', wanted scalar; precompute prints the measured errors")
    return recipe
