"""`mitsuba-diffraction precompute`: a spectrum file from a recipe, a profile or a scan."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ..errors import RequestError, is_number
from ..files.outputs import check_outputs
from ..precomputation.recipe import Recipe
from ..precomputation.requested_surface import RequestedSurface
from ..precomputation.spectra import check_index_range
from ..precomputation.surface_text import converted
from ..progress import bytes_text, durations, progress_bar, stage, tell
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
    representation: Annotated[
        str | None, typer.Option(help="slices, or a series of the amplitude: taylor, chebyshev")
    ] = None,
    terms: Annotated[str | None, typer.Option(help="of a series: a number, or auto, as the tolerance requires")] = None,
    heights_from: Annotated[str | None, typer.Option(help="level of h = 0 in a series: mean, lowest")] = None,
    tolerance: Annotated[float | None, typer.Option(help="bound of the error, a fraction of the light")] = None,
    coherence_length: Annotated[float | None, typer.Option(help="µm")] = None,
    overwrite: Overwrite = False,
) -> None:
    """Compute the power spectrum of the phase from recipes, profiles or scans."""
    options = {
        "representation": representation,
        "terms": None if terms is None else converted(terms),
        "heights_from": heights_from,
        "tolerance": tolerance,
        "coherence_length": coherence_length,
    }
    requests = [RequestedSurface.of(text, options=options) for text in surfaces]
    if output is not None and len(requests) > 1:
        raise RequestError(f"-o: got {len(requests)} sources, wanted one (without -o each is named after its source)")
    targets = [output or Path(request.path.name or "spectrum").with_suffix(".exr") for request in requests]
    for target in targets:
        check_suffix("-o", target, ".exr")
    for request in requests:
        _check_pixel_size(request.stated)
    reads = [file for request in requests for file in request.files]
    writes = [("-o" if output else f"spectrum of {r.path}", t) for r, t in zip(requests, targets, strict=True)]
    check_outputs(reads, writes, overwrite=overwrite)
    with durations():
        for request, target in zip(requests, targets, strict=True):
            request.say_extent()
            _precompute(request, target, verbose)


def _check_pixel_size(recipe: Recipe) -> None:
    """Refuse pixels of a scan within which no diffraction occurs."""
    pixel_size, length = recipe.surface.get("pixel_size", 0), recipe.settings.coherence_length
    if is_number(pixel_size) and pixel_size > length:
        raise RequestError(
            f"pixel_size: got {pixel_size:g} µm, wanted at most the coherence length, {length:g} µm: with larger "
            "pixels there is a single height within the coherence length, and no diffraction"
        )


def _precompute(request: RequestedSurface, target: Path, verbose: bool) -> None:
    """Compute, save and report one spectrum."""
    recipe = request.recipe
    check_index_range(recipe.settings)
    with progress_bar(f"spectrum of {request.path.name}", "%") as progress:
        spectrum = recipe.build(progress)
        with stage("writing"):
            spectrum.save(target)
    tell(f"{target}: {recipe.summary()}; {spectrum.summary}; {bytes_text(1e6 * spectrum.megabytes)}")
    if verbose:
        coherence_length = f"coherence length {spectrum.coherence_length:.4g} µm"
        tell(f"{spectrum.source}\n{spectrum.extent}, {spectrum.grid}; {coherence_length}\n{spectrum.details}")
    for concern in spectrum.concerns:
        tell(f"! {concern}")
