"""Predicted colours: against the viewing angle, and the share and the colour of single orders.

All in the plane of incidence that holds the wave vector of the main period, for a surface that reflects all wavelengths
alike (R = 1), under daylight (D65), without the energy factor E:

    L(λ) ∝ D65(λ) K G S(q e; κ)/λ² · cos θ_i,    q = (sin θ_i − sin θ_o)/λ,    κ = 2π (cos θ_i + cos θ_o)/λ

Angles are positive on the side opposite to the light: the specular direction is θ_o = θ_i.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..color import daylight, spectrum_to_XYZ
from ..geometry import k_g
from ..grating_spectrum import GratingSpectrum
from ..settings import VISIBLE

Array = NDArray[np.float64]

WAVELENGTHS = np.arange(VISIBLE[0], VISIBLE[1] + 1, 2.0)
"""nm; fine enough for the lobes of `LONGEST_COHERENCE`."""

LONGEST_COHERENCE = 20.0
"""µm. At 65 µm the orders of one wavelength are narrower than a pixel of the picture."""


def illumination() -> Array:
    """Return D65 at `WAVELENGTHS`, of luminance Y = 1."""
    values = daylight(WAVELENGTHS)
    return values / spectrum_to_XYZ(values, WAVELENGTHS)[1]


def radiance(
    spectrum: GratingSpectrum,
    direction: float,
    theta_i: ArrayLike,
    theta_o: ArrayLike,
    *,
    height_scale: float = 1.0,
    lateral_scale: float = 1.0,
) -> Array:
    """Compute L(λ), which the docstring of this module defines.

    Heights scaled by s have the spectrum S(q; s κ). A surface stretched by s has s² S(s q; κ), where the coherence
    length is scaled as well.

    Args:
        spectrum: of the surface.
        direction: of the wave vector e, degrees from +x.
        theta_i, theta_o: (...), degrees, broadcast against each other.
        height_scale, lateral_scale: of the heights, and of the lengths in the surface.

    Returns:
        (..., n) for the n `WAVELENGTHS`.
    """
    theta_i, theta_o = np.broadcast_arrays(np.deg2rad(theta_i), np.deg2rad(theta_o))
    cos_i, cos_o = np.cos(theta_i)[..., None], np.cos(theta_o)[..., None]
    wavelengths = WAVELENGTHS * 1e-3
    q = (np.sin(theta_i) - np.sin(theta_o))[..., None] / wavelengths
    kappa = 2 * np.pi * (cos_i + cos_o) / wavelengths
    along = np.deg2rad(direction)
    vector = lateral_scale * q[..., None] * np.array([np.cos(along), np.sin(along)])
    density = lateral_scale**2 * spectrum.evaluate(vector, height_scale * kappa)
    # The light comes from −θ_i.
    factor = k_g(cos_i, cos_o, 1 + np.cos(theta_i + theta_o)[..., None])
    return illumination() * factor * density / wavelengths**2 * cos_i


def order_angle(order: int, period: float, wavelength: float) -> float | None:
    """Return θ_o in degrees of an order at normal incidence, sin θ_o = m λ/period (µm); None if evanescent."""
    sine = order * wavelength / period
    return float(np.degrees(np.arcsin(sine))) if abs(sine) < 1 else None


def order_share(
    spectrum: GratingSpectrum,
    direction: float,
    period: float,
    order: int,
    wavelength: float,
    *,
    height_scale: float = 1.0,
    lateral_scale: float = 1.0,
) -> float:
    """Return the share of the reflected power about one order and its opposite, at normal incidence (R = 1, K G = 1).

    S is integrated over the cells of the lattice of orders, squares of side 1/period about q = ±m e/period, at the κ of
    the order. An irregular surface spreads its orders over these cells; a grating has them in the middle.

    Args:
        period: of the surface, µm, as it is after scaling.
        wavelength: µm.
    """
    angle = order_angle(order, period, wavelength)
    if angle is None:
        return 0.0
    kappa = 2 * np.pi * (1 + np.cos(np.deg2rad(angle))) / wavelength
    # S is a sum of lobes of width σ_q: a sum over points σ_q apart is their integral.
    count = int(np.clip(np.ceil(1 / (period * spectrum.lobe_width)), 8, 400))
    offset = ((np.arange(count) + 0.5) / count - 0.5) / period
    along = np.deg2rad(direction)
    e, across = np.array([np.cos(along), np.sin(along)]), np.array([-np.sin(along), np.cos(along)])
    total = 0.0
    for sign in (1, -1):
        q = (sign * order / period + offset)[:, None, None] * e + offset[None, :, None] * across
        total += spectrum.evaluate(lateral_scale * q, np.float64(height_scale * kappa)).mean()
    return float(total * lateral_scale**2 / period**2)
