"""Computing and loading spectra, of scalar and of rigorous theory."""

from __future__ import annotations

import os
import warnings
from collections.abc import Sequence

import numpy as np

from .errors import RequestError
from .files import cache_folder
from .grating_spectrum import GratingSpectrum
from .progress import Progress, silent
from .rigorous import build_table as rigorous
from .rigorous.rigorous_spectrum import RIGOROUS_FORMAT as RIGOROUS_FORMAT
from .rigorous.rigorous_spectrum import RigorousSpectrum
from .rigorous.solver import one_thread
from .settings import SERIES, SUN_COHERENCE_LENGTH, VISIBLE, Settings
from .spectrum import build as scalar
from .surface.heightfield import HeightField

Spectrum = GratingSpectrum | RigorousSpectrum

_MAX_HEADER_BYTES = 2**16  # which contain the name of the format


def precompute(
    height_field: HeightField | Sequence[HeightField],
    *,
    extent: str = "tile",
    coherence_length: float = SUN_COHERENCE_LENGTH,
    wavelengths: tuple[float, float] = VISIBLE,
    largest_angle: float = 90.0,
    representation: str = "auto",
    tolerance: float | None = None,
    largest_height_range: float = 20.0,
    terms: int | None = None,
    heights_from: str = "mean",
    progress: Progress = silent,
    theory: str = "scalar",
    int_ior: complex | str | None = None,
    material: str | None = None,
    ext_ior: float = 1.0,
    polarised: bool = False,
    transmission: str = "none",
) -> Spectrum:
    """Compute the spectrum of the phase e^{iκh}, or the table of rigorous efficiencies, its error at most `tolerance`.

    Args:
        height_field: the surface; or several periodic patches (extent "tile") of one size, random samples of an
            irregular surface. The spectra of patches are averaged.
        progress: called with (steps done, steps in all). An interrupted build of rigorous theory resumes from
            intermediate results in the cache folder.

    For all other arguments see `Settings`.

    Returns:
        The spectrum; its `error` is measured at values of κ that were not used to build it.

    Raises:
        ValueError: if an argument is out of range, the surface is deeper than `largest_height_range`, or the tolerance
            cannot be kept in float32 or within a table of 4 GB.

    Warns:
        UserWarning: if the pixels are too coarse to resolve all frequencies that the shortest wavelength reaches, a
            sample is too small for the coherence length, or `terms` are too few for the tolerance.
    """
    settings = Settings(
        extent=extent,
        coherence_length=coherence_length,
        wavelengths=wavelengths,
        largest_angle=largest_angle,
        representation=representation,
        tolerance=tolerance,
        largest_height_range=largest_height_range,
        terms=terms,
        heights_from=heights_from,
        theory=theory,
        int_ior=int_ior,
        material=material,
        ext_ior=ext_ior,
        polarised=polarised,
        transmission=transmission,
    )
    patches = (height_field,) if isinstance(height_field, HeightField) else tuple(height_field)
    if not all(isinstance(patch, HeightField) for patch in patches):
        raise RequestError(f"height_field: got {type(height_field).__name__}, wanted a HeightField or several")
    spectrum = build_spectrum(patches, settings, progress)
    if isinstance(spectrum, GratingSpectrum) and spectrum.excess:
        warnings.warn(spectrum.excess, stacklevel=2)
    return spectrum


def build_spectrum(patches: Sequence[HeightField], settings: Settings, progress: Progress = silent) -> Spectrum:
    """Compute the spectrum as `precompute`, from patches and settings."""
    if not patches:
        raise RequestError("patches: got none, wanted at least one")
    if len(patches) > 1 and settings.extent != "tile":
        raise RequestError(f"patches: got {len(patches)} with extent {settings.extent!r}, wanted 1, or extent 'tile'")
    if len(patches) > 1 and settings.representation in SERIES:
        raise RequestError(
            f"representation: got {settings.representation!r} with {len(patches)} patches, wanted 'slices', or "
            "patches = 1: an average has no amplitude"
        )
    first = patches[0]
    for patch in patches[1:]:
        if patch.shape != first.shape or not np.allclose(patch.tile_size, first.tile_size, rtol=1e-9):
            raise RequestError(f"patches: got {patch!r} beside {first!r}, wanted patches of one size")
    height_range = max(patch.height_range for patch in patches)
    if height_range > settings.largest_height_range:
        raise RequestError(
            f"heights: got a range of {height_range:.4g} µm, wanted at most {settings.largest_height_range:g}: are "
            "these nanometres? If the surface is so deep, raise largest_height_range of `precompute`"
        )
    if settings.theory == "scalar":
        with one_thread():
            return GratingSpectrum(**vars(scalar.build_power_spectrum(patches, settings, progress)))
    if len(patches) > 1:
        raise RequestError(
            f"theory: got rigorous and {len(patches)} patches ({first.source}, …), wanted one, of one row"
        )
    return rigorous.build_rigorous(first, settings, progress, cache_folder())


def load_spectrum(path: str | os.PathLike[str], recipe: str | None = None) -> Spectrum:
    """Read a spectrum of either theory; arguments and errors of `GratingSpectrum.load`."""
    return (RigorousSpectrum if is_rigorous(path) else GratingSpectrum).load(path, recipe)


def is_rigorous(path: str | os.PathLike[str]) -> bool:
    """Return whether a file exists and has the header of a rigorous spectrum."""
    if not os.path.isfile(path):
        return False
    with open(path, "rb") as stream:
        return RIGOROUS_FORMAT.encode() in stream.read(_MAX_HEADER_BYTES)
