"""`mitsuba-diffraction validate`: what is known, against what is computed."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from ..precompute import precompute
from ..readers import read_height_field
from ..recipe import Recipe
from .console import out, progress_bar, tell

if TYPE_CHECKING:
    from ..validation import Check


def validate(
    surface: Annotated[
        Path | None, typer.Argument(metavar="[SURFACE]", help="a recipe (.toml) or a scan: check this surface instead")
    ] = None,
    pixel_size: Annotated[float | None, typer.Option(help="of a scan, µm")] = None,
    height_range: Annotated[float | None, typer.Option(help="of a scan, black to white, µm")] = None,
    extent: Annotated[str, typer.Option(help="of a scan: sample or tile")] = "sample",
    variant: Annotated[str | None, typer.Option(help="of Mitsuba; the fastest spectral one by default")] = None,
    json: Annotated[Path | None, typer.Option(help="write the results here, too")] = None,
    markdown: Annotated[Path | None, typer.Option(help="write a table with notes and sources here (.md)")] = None,
    figures: Annotated[Path | None, typer.Option(metavar="DIR", help="draw the evaluation's figures here")] = None,
) -> None:
    """Check against closed forms and rigorous results, or check one surface; fails if a bound is missed."""
    import mitsuba as mi

    from ..validation import checks, report
    from ..variants import choose_variant

    if surface is None and (pixel_size is not None or height_range is not None):
        raise ValueError("--pixel-size and --height-range go with a scan")
    chosen = choose_variant(variant)
    if chosen.startswith("scalar"):
        raise ValueError(f"--variant: got {chosen}, wanted llvm_… or cuda_…: the checks take millions of directions")
    mi.set_variant(chosen)
    these = checks() if surface is None else _of_surface(surface, pixel_size, height_range, extent)
    results = []
    with progress_bar("validation") as progress:
        for check in these:
            results.append(check.result())
            progress(len(results), len(these))
    Console(highlight=False, width=max(out.width, 120)).print(report.table(results))
    missed = [result["name"] for result in results if not result["ok"]]
    promised = sum(result["bound"] is not None for result in results)
    tell(f"{promised - len(missed)} of {promised} within their bounds; {len(results) - promised} only shown")
    if json is not None:
        report.save_json(results, json)
    if markdown is not None:
        report.save_markdown(results, markdown)
    if figures is not None:
        from ..evaluation import save_figures

        with progress_bar("figures") as progress:
            save_figures(figures, progress=progress)
    if missed:
        raise RuntimeError(f"{len(missed)} of {promised} checks missed: {'; '.join(missed)}")


def _of_surface(path: Path, pixel_size: float | None, height_range: float | None, extent: str) -> tuple[Check, ...]:
    from ..validation.surface import surface_checks

    if path.suffix.lower() == ".toml":
        if pixel_size is not None or height_range is not None:
            raise ValueError(f"--pixel-size and --height-range go with a scan; the recipe {path} has its own")
        recipe = Recipe.load(path)
        return surface_checks(recipe.height_field(), recipe.cached())
    height_field = read_height_field(path, pixel_size=pixel_size, height_range=height_range)
    with progress_bar(f"spectrum of {path.name}") as progress:
        return surface_checks(height_field, precompute(height_field, extent=extent, progress=progress))
