"""Colour in the shader: spectral weights for XYZ, conversion to RGB, and spectra of RGB colours."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import lsq_linear

from ...color import daylight, matching_functions
from ...settings import VISIBLE

MIN_WAVELENGTH, MAX_WAVELENGTH, WAVELENGTH_STEP = 380.0, 780.0, 5.0  # nm
WAVELENGTH_COUNT = 81  # from the shortest to the longest, in such steps

CIE_RGB = np.array([[0.41847, -0.15866, -0.082835], [-0.091169, 0.25243, 0.015708], [0.00092090, -0.0025498, 0.17860]])
"""XYZ → CIE RGB of 1931 (Smith and Guild 1931), eq. 4.9 of the thesis. Rows sum to 0.177."""

FLAT = 106.857
"""∫ȳ dλ in nm: a constant spectrum of one has Y = 1, as in `color`."""


def wavelengths() -> NDArray[np.float64]:
    """Return the nodes of the tables below, 1 nm apart: (401,), nm."""
    return np.arange(MIN_WAVELENGTH, MAX_WAVELENGTH + 0.5)


@lru_cache(maxsize=1)
def d65_weights() -> NDArray[np.float64]:
    """Return S(λ) (x̄, ȳ, z̄) of the illuminant D65 (CIE 15:2018), (401, 3) per nm.

    Normalised to Y = 1 for the integral of the shader, the trapezoidal rule at 5 nm.
    """
    weights = daylight(wavelengths())[:, None] * matching_functions(wavelengths())
    return weights / np.trapezoid(weights[:: int(WAVELENGTH_STEP), 1], dx=WAVELENGTH_STEP)


def light_weights(spectrum: ArrayLike) -> NDArray[np.float64]:
    """Return S(λ) (x̄, ȳ, z̄)/∫ȳ dλ, (401, 3) per nm, for the spectrum S of a light at `wavelengths`, (401,) per nm."""
    return np.asarray(spectrum, np.float64)[:, None] * matching_functions(wavelengths()) / FLAT


def d65_white() -> NDArray[np.float64]:
    """Return XYZ of D65 by the integral of the shader, Y = 1: (3,)."""
    return np.trapezoid(d65_weights()[:: int(WAVELENGTH_STEP)], dx=WAVELENGTH_STEP, axis=0)


def rgb_matrix(*, cie_rgb_matrix: bool, d65_twice: bool) -> NDArray[np.float64]:
    """Return the matrix XYZ → linear RGB: M or, eq. 4.10, M diag(D65), where M is CIE RGB or sRGB (IEC 61966-2-1)."""
    import colour

    matrix = CIE_RGB if cie_rgb_matrix else colour.RGB_COLOURSPACES["sRGB"].matrix_XYZ_to_RGB
    return matrix * d65_white() if d65_twice else np.array(matrix)


EMISSION = np.arange(VISIBLE[0], VISIBLE[1] + 0.5, 5.0)
"""The nodes of `primary_spectra`, nm."""


@lru_cache(maxsize=1)
def primary_spectra() -> NDArray[np.float64]:
    """Return spectra b_c(λ) of the sRGB primaries at `EMISSION`, piecewise linear: (95, 3).

    The spectrum Σ_c RGB_c b_c(λ) has the colour RGB. b_c is the non-negative spectrum of least power, whose smoothness
    keeps the noise of wavelength sampling low.
    """
    import colour

    fine = np.arange(EMISSION[0], EMISSION[-1] + 0.5)
    hats = np.maximum(0.0, 1 - np.abs(fine[:, None] - EMISSION) / (EMISSION[1] - EMISSION[0]))
    to_xyz = matching_functions(fine).T @ hats / FLAT
    primaries = colour.RGB_COLOURSPACES["sRGB"].matrix_RGB_to_XYZ
    system = np.concatenate([1e4 * to_xyz, 1e-2 * np.eye(EMISSION.size)])
    rest = np.zeros(EMISSION.size)
    spectra = [lsq_linear(system, np.concatenate([1e4 * target, rest]), bounds=(0, np.inf)).x for target in primaries.T]
    result = np.stack(spectra, axis=1)
    # Removes the small colour error due to the least-power term.
    result = result @ np.linalg.solve(to_xyz @ result, primaries)
    result.setflags(write=False)
    return result
