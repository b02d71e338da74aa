"""`mitsuba-diffraction validate`: the BSDF against closed forms and rigorous results, a scene against Mitsuba."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from ...cli.arguments import KEYS_OF_RECIPES, SURFACE, Define, Overwrite, Variant, scene_parameters
from ...errors import RequestError
from ...files import outputs
from ...precomputation.recipe import Recipe
from ...precomputation.requested_surface import RequestedSurface
from ...progress import progress_bar, show, tell
from ..record import Record


def validate(
    surface: Annotated[
        str | None,
        typer.Argument(
            metavar=f"[{SURFACE} | SCENE]",
            help=f"check only this recipe (.toml), profile, scan or scene (.xml); {KEYS_OF_RECIPES}",
        ),
    ] = None,
    define: Define = None,
    variant: Variant = None,
    json: Annotated[Path | None, typer.Option(help="save the results (.json)")] = None,
    markdown: Annotated[Path | None, typer.Option(help="save a table with notes and sources (.md)")] = None,
    overwrite: Overwrite = False,
) -> None:
    """Check the BSDF, a surface, or the picture of a scene against Mitsuba's own; fail if a bound is exceeded."""
    import mitsuba as mi

    from ...render.scene_file import SceneFile
    from ...variants import choose_variant
    from .. import report
    from ..validation.scene_pictures import compare_scene

    chosen = choose_variant(variant)
    scene = SceneFile(surface, scene_parameters(define)) if surface and surface.lower().endswith(".xml") else None
    if define and scene is None:
        raise RequestError(f"-D: got {surface or 'no scene'}, wanted a scene (.xml), which has parameters")
    requested = None if surface is None or scene is not None else RequestedSurface.of(surface)
    recipe = None if requested is None else _recipe(requested)
    reads = scene.files() if scene is not None else [] if requested is None else requested.files
    writes = [(option, path) for option, path in (("--json", json), ("--markdown", markdown)) if path is not None]
    outputs.check_outputs(reads, writes, overwrite=overwrite)
    mi.set_variant(chosen)
    if requested is not None:
        requested.say_extent()
    if scene is not None:
        with progress_bar("pictures") as progress:
            comparison = compare_scene(scene, progress)
        results = comparison.records
    else:
        results = _results(recipe)
    show(report.record_table(results), width=120)
    if scene is not None:
        tell(str(comparison))
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


def _results(recipe: Recipe | None) -> list[Record]:
    """Return the results of the checks of a surface, or, without one, of all others."""
    from ...precomputation.grating_spectrum import GratingSpectrum
    from ..validation.checks import checks, surface_checks

    if recipe is None:
        these = checks()
    else:
        spectrum = recipe.cached(progress_bar)
        assert isinstance(spectrum, GratingSpectrum)  # `_recipe` refuses rigorous theory
        these = surface_checks(recipe.height_field(), spectrum)
    results: list[Record] = []
    with progress_bar("validation") as progress:
        for check in these:
            results.append(check.run())
            progress(len(results), len(these))
    return results


def _recipe(requested: RequestedSurface) -> Recipe:
    recipe = requested.recipe
    if recipe.patches > 1:
        recipe = replace(recipe, surface={**recipe.surface, "patches": 1})
    if recipe.settings.theory == "rigorous":
        got = f"{requested.title}: got theory = 'rigorous'"
        raise RequestError(f"{got}, wanted scalar; precompute prints the measured errors")
    return recipe
