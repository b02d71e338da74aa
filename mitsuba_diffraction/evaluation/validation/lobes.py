"""Lobes of a BSDF: the power that a grating reflects into each order, by quadrature over the plugin.

Wavelengths are in µm here, as in the closed forms.
"""

from __future__ import annotations

import functools
from typing import Any, cast

import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike

from ...array_types import Real
from ...bsdf import testing
from ...optics.geometry import k_g
from ...precomputation.grating_spectrum import GratingSpectrum
from ...precomputation.spectra import precompute
from ...spectrum.grids import OrderGrid
from ...surface.heightfield import HeightField

_TOLERANCE = 1e-5
"""Of the spectra, so that an analytic check to 1e-4 measures the model, not its tables."""
_QUADRATURE_POINTS = 16


def grating(spectrum: GratingSpectrum, conserve: bool = True, **parameters: Any) -> mi.BSDF:
    """Load the plugin; a perfect mirror unless an index or a material is given.

    `conserve=False` omits E, which closed forms do not include: only R K G S/λ² remains.
    """
    if not {"int_ior", "material"} & set(parameters):
        parameters["material"] = "none"
    return mi.load_dict(
        {"type": "diffraction_grating", "spectrum": spectrum, "conserve_energy": conserve, **parameters}
    )


@functools.lru_cache(maxsize=32)
def _built(height_field: HeightField, settings: tuple[tuple[str, Any], ...]) -> GratingSpectrum:
    return cast(GratingSpectrum, precompute(height_field, **dict(settings)))


def spectrum_of(height_field: HeightField, **settings: Any) -> GratingSpectrum:
    """Precompute a spectrum, to 1e-5 by default; cached for the next check of the same surface."""
    return _built(height_field, tuple(sorted({"tolerance": _TOLERANCE, **settings}.items())))


def k_g_between(wi: ArrayLike, wo: ArrayLike, shadowing: bool = True) -> Real:
    """Compute K G of unit vectors (..., 3) in the upper hemisphere; shapes broadcast."""
    wi, wo = np.asarray(wi, np.float64), np.asarray(wo, np.float64)
    return k_g(wi[..., 2], wo[..., 2], ((wi + wo)[..., :2] ** 2).sum(axis=-1), shadowing=shadowing)


def brdf(bsdf: mi.BSDF, wi: ArrayLike, wo: ArrayLike, wavelength: float) -> Real:
    """Evaluate f [1/sr] at directions (..., 3); zero where ω_o is not above the surface."""
    value = testing.evaluate(bsdf, wi, wo, [1e3 * wavelength])[..., 0]
    cosine = np.broadcast_to(np.asarray(wo)[..., 2], value.shape)
    return np.divide(value, cosine, out=np.zeros_like(value), where=cosine > 0)


def density(bsdf: mi.BSDF, wi: Real, wo: Real, wavelength: float) -> Real:
    """Evaluate S [µm²] by a perfect mirror without E: f λ²/(K G)."""
    return brdf(bsdf, wi, wo, wavelength) * wavelength**2 / k_g_between(wi, wo)


def lobe_powers(bsdf: mi.BSDF, spectrum: GratingSpectrum, wi: Real, q: ArrayLike, wavelength: float) -> Real:
    """Integrate the fraction of the incident power reflected into the lobes about q: ∫ f cos θ_o dω_o = λ² ∫ f dq.

    By Gauss–Legendre quadrature over the square to which a lobe is truncated.

    Args:
        bsdf: of the spectrum.
        spectrum: of a tile whose lobes do not overlap.
        wi: (3,).
        q: (n, 2) cycles/µm; the part of a lobe below the horizon does not count.
        wavelength: µm.

    Returns:
        (n,).
    """
    x, weights = np.polynomial.legendre.leggauss(_QUADRATURE_POINTS)
    cutoff = spectrum.cutoff_sigmas * spectrum.lobe_width
    offset = cutoff * np.stack(np.meshgrid(x, x), axis=-1).reshape(-1, 2)
    points = np.asarray(q, np.float64)[:, None, :] + offset
    area = cutoff**2 * np.outer(weights, weights).ravel()
    return brdf(bsdf, wi, testing.towards(wi, points, 1e3 * wavelength), wavelength) @ area * wavelength**2


def orders_above(spectrum: GratingSpectrum, wi: Real, wavelength: float) -> Real:
    """Return the orders m (n, 2) of a tile at up to 80° from the normal."""
    m_x, m_y = np.meshgrid(*spectrum.grid.axes())
    m = np.stack([m_x.ravel(), m_y.ravel()], axis=-1)
    cosines = -wavelength * m / np.asarray(cast(OrderGrid, spectrum.grid).tile_size) - wi[:2]
    return m[np.hypot(*cosines.T) < np.sin(np.deg2rad(80))]


def order_powers_of_bsdf(
    bsdf: mi.BSDF, spectrum: GratingSpectrum, wi: Real, m: Real, wavelength: float
) -> tuple[Real, Real]:
    """Return η_m (n,) of the orders m (n, 2) by the BSDF (the power of their lobes without K and G), and their κ."""
    q = m / np.asarray(cast(OrderGrid, spectrum.grid).tile_size)
    wo = testing.towards(wi, q, 1e3 * wavelength)
    kappa = 2 * np.pi * (wi[2] + wo[:, 2]) / wavelength
    return lobe_powers(bsdf, spectrum, wi, q, wavelength) / k_g_between(wi, wo), kappa
