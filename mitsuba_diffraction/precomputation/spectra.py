"""Computing and loading spectra, of scalar and of rigorous theory."""

from __future__ import annotations

import inspect
import os
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ..errors import RequestError
from ..files.writing import cache_folder
from ..progress import Progress, silent
from ..rigorous import build_table as rigorous
from ..rigorous.rigorous_spectrum import RIGOROUS_FORMAT as RIGOROUS_FORMAT
from ..rigorous.rigorous_spectrum import RigorousSpectrum
from ..rigorous.solver import one_thread
from ..scalar_theory.validity import scalar_waves
from ..settings import SERIES, SPECTRUM_PARAMETERS, RigorousSettings, ScalarSettings, Settings
from ..spectrum import build as scalar
from ..surface.heightfield import HeightField
from .grating_spectrum import GratingSpectrum

Spectrum = GratingSpectrum | RigorousSpectrum

_MAX_HEADER_BYTES = 2**16  # which contain the name of the format


def precompute(
    height_field: HeightField | Sequence[HeightField], *, progress: Progress = silent, **settings: Any
) -> Spectrum:
    """Compute the spectrum of the phase e^{iκh}, or the table of rigorous efficiencies, its error at most `tolerance`.

    Args:
        height_field: the surface; or several periodic patches (extent "tile") of one size, random samples of an
            irregular surface. The spectra of patches are averaged.
        progress: called with (steps done, steps in all). An interrupted build of rigorous theory resumes from
            intermediate results in the cache folder.
        settings: `theory`, "scalar" by default or "rigorous", and the parameters of `ScalarSettings` or of
            `RigorousSettings`.

    Returns:
        The spectrum; its `error` is measured at values of κ that were not used to build it.

    Raises:
        ValueError: if an argument is out of range, the surface is deeper than `largest_height_range`, or the tolerance
            cannot be kept in float32 or within a table of 4 GB.

    Warns:
        UserWarning: if the pixels are too coarse to resolve all frequencies that the shortest wavelength reaches, a
            sample is too small for the coherence length, or `terms` are too few for the tolerance.
    """
    for name in settings.keys() - SPECTRUM_PARAMETERS.keys():
        raise TypeError(f"precompute() got an unexpected keyword argument {name!r}")
    request = Settings.of(**settings)
    patches = (height_field,) if isinstance(height_field, HeightField) else tuple(height_field)
    if not all(isinstance(patch, HeightField) for patch in patches):
        raise RequestError(f"height_field: got {type(height_field).__name__}, wanted a HeightField or several")
    check_index_range(request)
    spectrum = build_spectrum(patches, request, progress)
    for concern in spectrum.concerns:
        warnings.warn(concern, stacklevel=2)
    return spectrum


def _with_settings(function: Callable[..., Spectrum]) -> inspect.Signature:
    """Return the signature of a function whose last parameter stands for the settings by name."""
    own = list(inspect.signature(function).parameters.values())[:-1]
    return inspect.Signature([*own, *SPECTRUM_PARAMETERS.values()], return_annotation="Spectrum")


precompute.__dict__["__signature__"] = _with_settings(precompute)


def build_spectrum(
    patches: Sequence[HeightField], settings: Settings, progress: Progress = silent, *, keep_waves: bool = False
) -> Spectrum:
    """Compute the spectrum as `precompute`, from patches and settings; `keep_waves`: with `GratingSpectrum.waves`."""
    if not patches:
        raise RequestError("patches: got none, wanted at least one")
    if len(patches) > 1 and settings.extent != "tile":
        raise RequestError(f"patches: got {len(patches)} with extent {settings.extent!r}, wanted 1, or extent 'tile'")
    first = patches[0]
    for patch in patches[1:]:
        if patch.shape != first.shape or not np.allclose(patch.tile_size, first.tile_size, rtol=1e-9):
            raise RequestError(f"patches: got {patch!r} beside {first!r}, wanted patches of one size")
    for patch in patches:
        check_height_range(patch, settings)
    if isinstance(settings, ScalarSettings):
        if len(patches) > 1 and settings.representation in SERIES:
            raise RequestError(
                f"representation: got {settings.representation!r} with {len(patches)} patches, wanted 'slices', or "
                "patches = 1: an average has no amplitude"
            )
        with one_thread():
            found = GratingSpectrum(**vars(scalar.build_power_spectrum(patches, settings, progress)))
        if not keep_waves:
            return found
        return replace(found, waves=scalar_waves(first, found.extent, found.wavelengths))
    assert isinstance(settings, RigorousSettings)
    if len(patches) > 1:
        raise RequestError(
            f"theory: got rigorous and {len(patches)} patches ({first.source}, …), wanted one, of one row"
        )
    return rigorous.build_rigorous(first, settings, progress, cache_folder())


def check_height_range(height_field: HeightField, settings: Settings) -> None:
    """Check that heights are not deeper than the `largest_height_range`, as heights in nm are.

    Raises:
        RequestError: if they are.
    """
    if (height_range := height_field.height_range) > settings.largest_height_range:
        raise RequestError(
            f"heights: got a range of {height_range:.4g} µm, wanted at most {settings.largest_height_range:g}: are "
            "these nanometres? If the surface is so deep, raise largest_height_range"
        )


def check_index_range(settings: Settings) -> None:
    """Check that the index of a rigorous table is known at all its wavelengths, which a scene does not ask again.

    Raises:
        RequestError: if it is not.
    """
    if not isinstance(settings, RigorousSettings):
        return
    below = rigorous.medium_below(settings)
    shortest, longest = (wavelength * settings.ext_ior for wavelength in settings.wavelengths)
    try:
        for known in below.known_ranges:
            known.check((shortest, longest))
    except RequestError as error:
        if settings.ext_ior == 1:
            raise
        (low, high), n = settings.wavelengths, settings.ext_ior
        raise RequestError(
            f"{error}; wavelengths are those inside ext_ior={n:g}: light of {low:g} to {high:g} nm in air has "
            f"{low / n:.0f} to {high / n:.0f}"
        ) from None


def build_versions(settings: Settings) -> list[int]:
    """Return the versions of the code that builds a spectrum of this theory alone."""
    return [rigorous.BUILD_VERSION] if isinstance(settings, RigorousSettings) else []


def load_spectrum(path: str | os.PathLike[str], recipe: str | None = None) -> Spectrum:
    """Read a spectrum of either theory; arguments and errors of `GratingSpectrum.load`."""
    return (RigorousSpectrum if is_rigorous(path) else GratingSpectrum).load(path, recipe)


def is_rigorous(path: str | os.PathLike[str]) -> bool:
    """Return whether a file exists and has the header of a rigorous spectrum."""
    if not os.path.isfile(path):
        return False
    with open(path, "rb") as stream:
        return RIGOROUS_FORMAT.encode() in stream.read(_MAX_HEADER_BYTES)
