"""`mitsuba-diffraction precompute`: a spectrum file from a recipe or a scan."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ..errors import RequestError
from ..grating_spectrum import GratingSpectrum
from ..outputs import check_outputs
from ..precomputation import Spectrum
from ..progress import durations, progress_bar, stage, tell
from ..recipe import Recipe
from ..rigorous.rigorous_spectrum import RigorousSpectrum
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
    sources: Annotated[list[Path], typer.Argument(metavar="RECIPE|SCAN...", help="recipes (.toml), or scans")],
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
    overwrite: Overwrite = False,
) -> None:
    """Compute the power spectrum of the phase from recipes or scans."""
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
            _precompute(source, recipe, target, seam)


def _precompute(source: Path, recipe: Recipe, target: Path, seam: str) -> None:
    """Compute, save and report one spectrum."""
    with progress_bar(f"spectrum of {source.name}", "%") as progress:
        spectrum = recipe.build(progress)
        with stage("writing"):
            spectrum.save(target)
    tell(
        f"{target}: {spectrum.source}; {spectrum.extent}, {spectrum.grid}; coherence length "
        f"{spectrum.coherence_length:.4g} µm; {_table_summary(spectrum)}{seam}"
    )
    for text in (spectrum.excess, spectrum.warning) if isinstance(spectrum, GratingSpectrum) else ():
        if text:
            tell(f"! {text}")


def _table_summary(spectrum: Spectrum) -> str:
    size, tolerance = f"{spectrum.megabytes:.3g} MB", f"(tolerance {spectrum.tolerance:.3g})"
    if isinstance(spectrum, RigorousSpectrum):
        return (
            f"rigorous, {spectrum.material_name}, {size}, mean error {spectrum.error:.1e} {tolerance}\n"
            f"maximum error {spectrum.max_error:.1e} of the reflected light, {spectrum.max_error_near:.1e} near a "
            "Rayleigh anomaly"
            + ("" if spectrum.mueller is None else f"; Mueller matrices, mean {spectrum.polarisation_error:.1e}")
        )
    scatter = f", standard error of one scan {spectrum.standard_error:.2g}" if spectrum.extent == "sample" else ""
    return (
        f"{spectrum.representation}, {size}, error {spectrum.error:.1e} {tolerance}{scatter}\n"
        f"truncated, at most: {spectrum.truncated_power:.1e} of the power at weak frequencies; "
        f"{spectrum.unresolved_power:.1e} at frequencies that no direction reaches or no pixel resolves"
    )


def _seam(source: Path, recipe: Recipe) -> str:
    """Return a line on the seam of a scan that is repeated as a tile; "" for a recipe.

    Raises:
        ValueError: if the seam would be visible.
    """
    if source.suffix.lower() == ".toml":
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
