"""`mitsuba-diffraction precompute`: a spectrum file from a recipe, a profile or a scan."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ..errors import RequestError
from ..files.outputs import check_outputs
from ..precomputation.recipe import Recipe, source_named
from ..precomputation.spectra import check_material
from ..progress import bytes_text, durations, progress_bar, stage, tell
from ..settings import ORIGINS, REPRESENTATIONS, SUN_COHERENCE_LENGTH, THEORIES
from ..surface.prepare import is_seam_visible, seam_steps
from .arguments import (
    Overwrite,
    check_suffix,
    options_of_scan,
    recipe_of,
    settings_of,
    takes_scan,
)


@takes_scan
def precompute(
    context: typer.Context,
    sources: Annotated[list[Path], typer.Argument(metavar="SURFACE...", help="recipes (.toml), profiles, or scans")],
    output: Annotated[Path | None, typer.Option("-o", "--output", help="spectrum file; default: ./NAME.exr")] = None,
    representation: Annotated[str | None, typer.Option(help=f"{', '.join(REPRESENTATIONS)}; default: auto")] = None,
    tolerance: Annotated[
        float | None,
        typer.Option(
            help="maximum error, a fraction of the power; default: 0.01, and 0.001 for a tile of separate orders"
        ),
    ] = None,
    terms: Annotated[int | None, typer.Option(help="terms of taylor or chebyshev; default: as many as needed")] = None,
    heights_from: Annotated[
        str | None, typer.Option(help=f"level of h = 0 in taylor or chebyshev: {', '.join(ORIGINS)}; default: mean")
    ] = None,
    theory: Annotated[
        str | None,
        typer.Option(help=f"{', '.join(THEORIES)} (for line gratings); default: scalar"),
    ] = None,
    material: Annotated[str | None, typer.Option(help="for rigorous theory: a conductor, as Mitsuba names it")] = None,
    int_ior: Annotated[
        str | None, typer.Option(help="for rigorous theory: the index of a dielectric, a name such as BK7, or a file")
    ] = None,
    ext_ior: Annotated[float | None, typer.Option(help="for rigorous theory: the index of a coat; default: 1")] = None,
    polarised: Annotated[bool, typer.Option("--polarised", help="for rigorous theory: with Mueller matrices")] = False,
    largest_angle: Annotated[
        float | None, typer.Option(help="maximum angle of incidence or exit in the scene, degrees; default: 90")
    ] = None,
    largest_height_range: Annotated[float | None, typer.Option(help="refuse deeper surfaces, µm; default: 20")] = None,
    verbose: Annotated[
        bool, typer.Option("--verbose", help="print the steps of preparation, the grid, and what is truncated, too")
    ] = False,
    overwrite: Overwrite = False,
) -> None:
    """Compute the power spectrum of the phase from recipes, profiles or scans."""
    sources = [Path(source_named(str(source))) for source in sources]
    if output is not None and len(sources) > 1:
        raise RequestError(f"-o: got {len(sources)} sources, wanted one (without -o each is named after its source)")
    targets = [output or Path(source.name or "spectrum").with_suffix(".exr") for source in sources]
    for target in targets:
        check_suffix("-o", target, ".exr")
    pixel_size, settings = context.params["pixel_size"], settings_of(context)
    max_pixel_size = settings.get("coherence_length", SUN_COHERENCE_LENGTH)
    if pixel_size is not None and pixel_size > max_pixel_size:
        raise RequestError(
            f"--pixel-size: got {pixel_size:g} µm, wanted at most the coherence length, {max_pixel_size:g} µm: with "
            "larger pixels there is a single height within the coherence length, and no diffraction"
        )
    recipes = [recipe_of(source, options_of_scan(context), settings, "tile") for source in sources]
    reads = [*sources, *(file for recipe in recipes for file in recipe.files)]
    writes = [("-o" if output else f"spectrum of {s}", t) for s, t in zip(sources, targets, strict=True)]
    check_outputs(reads, writes, overwrite=overwrite)
    is_sure = "extent" in settings
    with durations():
        seams = ["" if is_sure else _seam(source, recipe) for source, recipe in zip(sources, recipes, strict=True)]
        for source, recipe, target, seam in zip(sources, recipes, targets, seams, strict=True):
            _precompute(source, recipe, target, seam, verbose)


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
        raise RequestError(
            f"--extent: got none, and {source} does not tile without a seam: r.m.s. steps of {seam}; wanted "
            "--extent sample (a sample of an irregular surface), --extent tile (periodic, in spite of the seam), or "
            "--prepare crop_periods (a grating, cropped to whole periods)"
        )
    return f"\nrepeated as a tile; r.m.s. steps at the seam {seam}" if seam else ""
