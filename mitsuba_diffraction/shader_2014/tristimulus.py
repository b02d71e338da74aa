"""Colour in the shader: the contribution of each wavelength to XYZ, conversion to RGB, and spectra of RGB colours."""

from __future__ import annotations

from functools import lru_cache

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import lsq_linear

from ..bsdf.device_tables import PacketTable
from ..optics.color import SRGB_TO_XYZ, XYZ_TO_SRGB, daylight, matching_functions
from ..settings import VISIBLE
from .quirks import Quirks

FIRST_WAVELENGTH, LAST_WAVELENGTH, WAVELENGTH_STEP = 380.0, 780.0, 5.0  # nm
WAVELENGTH_COUNT = 81  # from the shortest to the longest, in such steps
PUBLISHED_R0 = 0.04  # an index of 1.5, close to that of snake skin

CIE_RGB = (
    np.array([[0.41847, -0.15866, -0.082835], [-0.091169, 0.25243, 0.015708], [0.00092090, -0.0025498, 0.17860]])
    / 0.17697
)
"""XYZ → CIE RGB of 1931 (Smith and Guild 1931), eq. 4.9 of the thesis, as in its code: rows sum to one."""

FLAT = 106.857
"""∫ȳ dλ in nm: a constant spectrum of one has Y = 1, as in `color`."""


def wavelengths() -> NDArray[np.float64]:
    """Return the nodes of the tables below, 1 nm apart: (401,), nm."""
    return np.arange(FIRST_WAVELENGTH, LAST_WAVELENGTH + 0.5)


@lru_cache(maxsize=1)
def d65_weights() -> NDArray[np.float64]:
    """Return S(λ) (x̄, ȳ, z̄) of the illuminant D65 (CIE 15:2018), (401, 3) per nm.

    Normalised to Y = 1 for the integral of the shader, the trapezoidal rule at 5 nm.
    """
    weights = daylight(wavelengths())[:, None] * matching_functions(wavelengths())
    return weights / np.trapezoid(weights[:: int(WAVELENGTH_STEP), 1], dx=WAVELENGTH_STEP)


def light_weights(irradiance: ArrayLike) -> NDArray[np.float64]:
    """Return S(λ) (x̄, ȳ, z̄)/∫ȳ dλ, (401, 3) per nm, for the irradiance S of a light at `wavelengths`, (401,) per nm."""
    return np.asarray(irradiance, np.float64)[:, None] * matching_functions(wavelengths()) / FLAT


def rgb_matrix(*, cie_rgb_matrix: bool) -> NDArray[np.float64]:
    """Return the matrix XYZ → linear RGB, of CIE RGB or sRGB (IEC 61966-2-1)."""
    return CIE_RGB if cie_rgb_matrix else XYZ_TO_SRGB


class SpectralWeights:
    """Table of (X, Y, Z, R₀) with one entry per nm, read with linear interpolation (algorithm 4.3, line 5)."""

    def __init__(self, quirks: Quirks, peak: float, r_0: ArrayLike, light: ArrayLike | None) -> None:
        """Build the table.

        For the irradiance E(λ) per nm and the relative radiance ρ(λ), the colour is ∫ ρ E (x̄, ȳ, z̄) dλ / ∫ȳ dλ.
        Absolute radiance has the additional factor R₀ S(0)/λ², where S(0) is the density of a flat surface at q = 0.

        Args:
            quirks: `fixed_index`, `d65_light` and `relative` apply.
            peak: S(0) of a flat surface, µm².
            r_0: power reflectance at normal incidence, one number or (401,) at `tristimulus.wavelengths`.
            light: its irradiance, (401,); None for D65 with Y = 1.
        """
        weights = d65_weights() if light is None else light_weights(light)
        self.luminance = 1.0 if light is None else float(np.trapezoid(weights[:, 1]))
        if quirks.d65_light:
            weights = d65_weights() * self.luminance
        r_0 = PUBLISHED_R0 if quirks.fixed_index else r_0
        r_0 = np.broadcast_to(np.asarray(r_0, np.float64), wavelengths().shape)
        if not quirks.relative:
            weights = weights * (r_0 * peak / (wavelengths() * 1e-3) ** 2)[:, None]
        self.table = PacketTable(np.concatenate([weights, r_0[:, None]], axis=1))

    def __call__(self, wavelength: mi.Float, active: mi.Bool) -> tuple[mi.Color3f, mi.Float]:
        """Return (X, Y, Z) per nm, and R₀, at a wavelength in nm; zero outside 380 to 780 nm."""
        active = active & (wavelength >= FIRST_WAVELENGTH - 1e-3) & (wavelength <= LAST_WAVELENGTH + 1e-3)
        value = interpolated(self.table, wavelength - FIRST_WAVELENGTH, int(LAST_WAVELENGTH - FIRST_WAVELENGTH), active)
        return mi.Color3f(value.x, value.y, value.z), value.w


def interpolated(table: PacketTable, position: mi.Float, last: int, active: mi.Bool) -> mi.Vector4f:
    """Return a table's packets 0 … `last`, interpolated linearly at `position` (clamped), and zero if not `active`."""
    position = dr.clip(position, 0, last)
    index = mi.UInt32(dr.minimum(position, last - 1))
    below, above = table(index, active), table(index + 1, active)
    return below + (position - mi.Float(index)) * (above - below)


EMISSION = np.arange(VISIBLE[0], VISIBLE[1] + 0.5, 5.0)
"""The nodes of `emission_of_primaries`, nm."""


@lru_cache(maxsize=1)
def emission_of_primaries() -> NDArray[np.float64]:
    """Return spectra b_c(λ) of the sRGB primaries at `EMISSION`, piecewise linear: (95, 3).

    The spectrum Σ_c RGB_c b_c(λ) has the colour RGB. b_c is the non-negative spectrum of least power, whose smoothness
    keeps the noise of wavelength sampling low.
    """
    fine = np.arange(EMISSION[0], EMISSION[-1] + 0.5)
    hats = np.maximum(0.0, 1 - np.abs(fine[:, None] - EMISSION) / (EMISSION[1] - EMISSION[0]))
    to_xyz = matching_functions(fine).T @ hats / FLAT
    system = np.concatenate([1e4 * to_xyz, 1e-2 * np.eye(EMISSION.size)])
    rest = np.zeros(EMISSION.size)
    columns = [
        lsq_linear(system, np.concatenate([1e4 * target, rest]), bounds=(0, np.inf)).x for target in SRGB_TO_XYZ.T
    ]
    result = np.stack(columns, axis=1)
    # Removes the small colour error due to the least-power term.
    result = result @ np.linalg.solve(to_xyz @ result, SRGB_TO_XYZ)
    result.setflags(write=False)
    return result


class Emission:
    """A spectrum of given linear sRGB: Σ_c RGB_c b_c(λ), with b_c from `tristimulus.emission_of_primaries`."""

    def __init__(self) -> None:
        columns = emission_of_primaries()
        self.table = PacketTable(np.concatenate([columns, np.zeros((len(columns), 1))], axis=1))

    def __call__(self, rgb: mi.Color3f, wavelengths: mi.UnpolarizedSpectrum, active: mi.Bool) -> mi.UnpolarizedSpectrum:
        """Evaluate the spectrum, per nm, at the wavelengths of a ray, in nm."""
        result = mi.UnpolarizedSpectrum(0)
        first, spacing = float(EMISSION[0]), float(EMISSION[1] - EMISSION[0])
        for channel in range(len(result)):
            b = interpolated(self.table, (wavelengths[channel] - first) / spacing, EMISSION.size - 1, active)
            result[channel] = rgb.x * b.x + rgb.y * b.y + rgb.z * b.z
        return result
