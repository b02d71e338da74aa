"""`mitsuba-diffraction precompute`: a spectrum file from a recipe, a profile or a scan."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ..errors import RequestError, is_number
from ..files.outputs import check_outputs
from ..precomputation.recipe import Recipe
from ..precomputation.spectra import check_material
from ..precomputation.surface_text import parsed
from ..progress import bytes_text, durations, progress_bar, stage, tell
from ..surface.prepare import is_seam_visible, seam_steps
from .arguments import KEYS_OF_RECIPES, SURFACE, Overwrite, check_suffix


def precompute(
    surfaces: Annotated[
        list[str],
        typer.Argument(
            metavar=SURFACE,
            help=f"recipes (.toml), profiles, or scans; {KEYS_OF_RECIPES}, or theory, material and int_ior",
        ),
    ],
    output: Annotated[Path | None, typer.Option("-o", "--output", help="spectrum file; default: ./NAME.exr")] = None,
    verbose: Annotated[
        bool, typer.Option("--verbose", help="print the steps of preparation, the grid, and what is truncated, too")
    ] = False,
    overwrite: Overwrite = False,
) -> None:
    """Compute the power spectrum of the phase from recipes, profiles or scans."""
    requests = [parsed(text) for text in surfaces]
    sources = [Path(source) for source, _ in requests]
    if output is not None and len(sources) > 1:
        raise RequestError(f"-o: got {len(sources)} sources, wanted one (without -o each is named after its source)")
    targets = [output or Path(source.name or "spectrum").with_suffix(".exr") for source in sources]
    for target in targets:
        check_suffix("-o", target, ".exr")
    recipes = [Recipe.of_source(source, values, "tile") for source, values in requests]
    for recipe in recipes:
        _check_pixel_size(recipe)
    reads = [*sources, *(file for recipe in recipes for file in recipe.files)]
    writes = [("-o" if output else f"spectrum of {s}", t) for s, t in zip(sources, targets, strict=True)]
    check_outputs(reads, writes, overwrite=overwrite)
    with durations():
        seams = [
            "" if "extent" in values else _seam(source, recipe)
            for source, (_, values), recipe in zip(sources, requests, recipes, strict=True)
        ]
        for source, recipe, target, seam in zip(sources, recipes, targets, seams, strict=True):
            _precompute(source, recipe, target, seam, verbose)


def _check_pixel_size(recipe: Recipe) -> None:
    """Refuse pixels of a scan within which no diffraction occurs."""
    pixel_size, length = recipe.surface.get("pixel_size", 0), recipe.settings.coherence_length
    if is_number(pixel_size) and pixel_size > length:
        raise RequestError(
            f"pixel_size: got {pixel_size:g} µm, wanted at most the coherence length, {length:g} µm: with larger "
            "pixels there is a single height within the coherence length, and no diffraction"
        )


def _precompute(source: Path, recipe: Recipe, target: Path, seam: str, verbose: bool) -> None:
    """Compute, save and report one spectrum."""
    check_material(recipe.settings)
    with progress_bar(f"spectrum of {source.name}", "%") as progress:
        spectrum = recipe.build(progress)
        with stage("writing"):
            spectrum.save(target)
    tell(f"{target}: {recipe.summary()}; {spectrum.summary}; {bytes_text(1e6 * spectrum.megabytes)}{seam}")
    if verbose:
        coherence_length = f"coherence length {spectrum.coherence_length:.4g} µm"
        tell(f"{spectrum.source}\n{spectrum.extent}, {spectrum.grid}; {coherence_length}\n{spectrum.details}")
    for concern in spectrum.concerns:
        tell(f"! {concern}")


def _seam(source: Path, recipe: Recipe) -> str:
    """Return a line on the seam of a scan that is repeated as a tile; "" for another surface.

    Raises:
        ValueError: if the seam would be visible.
    """
    if "scan" not in recipe.surface or source.suffix.lower() == ".toml":
        return ""
    steps = seam_steps(recipe.height_field())
    seam = " and ".join(
        f"{across * 1e3:.3g} nm along {axis} ({inside * 1e3:.3g} inside)" for axis, (across, inside) in steps.items()
    )
    if is_seam_visible(steps):
        ways = [
            "extent=sample (a sample of an irregular surface)",
            "extent=tile (periodic, in spite of the seam)",
            "prepare=crop_periods (a grating, cropped to whole periods)",
        ]
        if any("crop_periods" in step for step in recipe.surface.get("prepare", ())):
            ways.pop()
        raise RequestError(
            f"extent: got none, and {source} does not tile without a seam: r.m.s. steps of {seam}; wanted "
            f"{', '.join(ways[:-1])} or {ways[-1]}"
        )
    return f"\nrepeated as a tile; r.m.s. steps at the seam {seam}" if seam else ""
