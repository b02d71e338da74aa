"""Efficiencies of scalar theory in closed form: the limit of narrow lobes, in float64, which validates the BSDF.

Scalar theory treats each facet of the surface as a plane mirror (tangent-plane approximation), which holds if the
surface varies slowly on the scale of a wavelength (`validity.py`).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import ArrayLike, NDArray
from scipy.special import jv

from ..array_types import Real
from ..errors import RequestError
from ..optics.geometry import Diffracted, Orders, diffracted, fresnel
from ..spectrum.grids import OrderGrid
from ..surface.heightfield import HeightField
from .reference import amplitudes

OrderPowers = Callable[[NDArray[np.int64], Real], Real]
"""(m, κ), broadcast against each other → η_m(κ)."""


def incident_direction(angle: float, azimuth: float) -> Real:
    """Return ω_i, (3,), from the angle of incidence and the azimuth of its plane in degrees."""
    theta, phi = np.deg2rad((angle, azimuth))
    return np.array([-np.sin(theta) * np.cos(phi), -np.sin(theta) * np.sin(phi), np.cos(theta)])


def sinusoid_powers(depth: float) -> OrderPowers:
    """Return η_m = J_m(κ · depth / 2)² of a sinusoid; peak-to-valley depth in µm."""
    return lambda m, kappa: jv(m, kappa * depth / 2) ** 2


def profile_powers(height_field: HeightField) -> OrderPowers:
    """Compute η_m of a profile of one row, by direct summation for each pair (m, κ)."""
    if height_field.shape[0] != 1:
        raise RequestError(f"height_field: got {height_field.shape[0]} rows, wanted a profile of one")
    heights, count = height_field.centred[0], height_field.shape[1]

    def powers(m: NDArray[np.int64], kappa: Real) -> Real:
        m, kappa = np.broadcast_arrays(m, kappa)
        waves = np.exp(1j * (kappa[..., None] * heights - 2 * np.pi * m[..., None] * np.arange(count) / count))
        return np.where(2 * np.abs(m) < count, np.abs(waves.mean(axis=-1)) ** 2, 0.0)

    return powers


def tile_powers(height_field: HeightField, shortest: float) -> OrderPowers:
    """Compute η_m of a tile, for pairs of m = (m_x, m_y), (…, 2), and κ up to 4π/`shortest`, a wavelength in µm.

    F_m(κ) is interpolated by Chebyshev polynomials in κ, exactly in float64: e^{iκh} oscillates no faster than e^{iκH},
    so that coefficients of orders above κH/2 decrease faster than exponentially.
    """
    max_kappa = 4 * np.pi / shortest
    degree = int(np.ceil(max_kappa * height_field.half_range / 2)) + 25
    grid = OrderGrid.reachable(height_field.tile_size, height_field.shape[::-1], 2 / shortest)
    m_x, m_y = (axis.ravel() for axis in np.meshgrid(*grid.axes()))

    def of_nodes(x: Real) -> Any:
        return np.stack([amplitudes(height_field, kappa)[m_y, m_x] for kappa in max_kappa / 2 * (x + 1)])

    coefficients: Any = chebyshev.chebinterpolate(of_nodes, degree)

    def powers(m: NDArray[np.int64], kappa: Real) -> Real:
        inside = np.asarray((np.abs(m) <= grid.max_order).all(axis=-1))
        columns, rows = np.moveaxis(np.where(inside[..., None], m + grid.max_order, 0), -1, 0)
        waves = chebyshev.chebvander(2 * kappa / max_kappa - 1, degree)
        amplitude = (waves * np.moveaxis(coefficients[:, rows * grid.shape[1] + columns], 0, -1)).sum(axis=-1)
        # Orders at the Nyquist frequency have no sign.
        inside &= (2 * np.abs(m) < height_field.shape[::-1]).all(axis=-1)
        return np.where(inside, np.abs(amplitude) ** 2, 0.0)

    return powers


def scalar_orders(
    powers: OrderPowers,
    period: float | tuple[float, float],
    wavelength: float,
    angle: float,
    index: complex,
    azimuth: float = 0.0,
) -> Orders:
    """Compute R K G E η_m(κ_m), the efficiencies of the BSDF in float64 in the limit of narrow lobes.

    Integrating the BRDF R K G S(q; κ)/λ² E (`bsdf/`) times cos θ_o over the lobe of an order, with du dv = λ² dq, gives
    these factors at the direction of the order.

    Args:
        powers: of the profile or tile.
        period: µm; for a tile, along x and y.
        wavelength: µm.
        angle: of incidence, degrees, from −x.
        index: n + ik of the material; ∞ of a perfect mirror.
        azimuth: of the plane of incidence, degrees; 0: perpendicular to the grooves, 90: parallel (conical).
    """
    m, steps = _lattice(wavelength / np.atleast_1d(period), 2.0)

    def of_orders(kept: NDArray[np.bool_], kappa: Real) -> Real:
        return powers(m[kept], kappa)

    found, power = mirrored(of_orders, incident_direction(angle, azimuth)[:2], steps, wavelength)
    albedo = [mirrored(of_orders, tangent, steps, wavelength)[1].sum() for tangent in found.tangent]
    power = power / np.maximum(1, np.maximum(power.sum(), albedo))
    s, p = fresnel(found.cos_half, index)
    return Orders(m[found.kept], s * power, p * power)


def mirrored(
    powers: Callable[[NDArray[np.bool_], Real], NDArray[np.floating]], tangent: Real, steps: Real, wavelength: float
) -> tuple[Diffracted, Real]:
    """Return the directions of diffracted light, (n,), and K G S there, which a perfect mirror reflects without E.

    Args:
        powers: (mask of the frequencies that propagate, their κ) → S, or η_m.
        tangent: the tangential part of ω_i, (2,); nothing is reflected if it is evanescent.
        steps: λq, (..., 2).
        wavelength: λ, µm.
    """
    found = diffracted(tangent, steps)
    return found, found.k_g * powers(found.kept, 2 * np.pi * found.v_z / wavelength)


def transmitted_orders(
    powers: OrderPowers,
    period: float | tuple[float, float],
    wavelength: float,
    angle: float,
    index: float,
    azimuth: float = 0.0,
    from_below: bool = False,
    sheet: bool = False,
) -> Orders:
    """Compute K_t G_t (1 − F) η_m(κ_m), the transmitted orders of the BSDF in the limit of narrow lobes.

    For arguments see `scalar_orders`; the medium is a dielectric. The angle is measured in air. For light from below it
    is the angle of the direction into which a plane would refract the light. The efficiencies sum to at most one. For a
    sheet, with light from above, they include the transmittance 1 − F of the flat face.
    """
    tangent = incident_direction(angle, azimuth)[:2]
    return transmitted_at(powers, period, wavelength, tangent, index, from_below, sheet)


def transmitted_at(
    powers: OrderPowers,
    period: float | tuple[float, float],
    wavelength: float,
    tangent: Real,
    index: float,
    from_below: bool = False,
    sheet: bool = False,
) -> Orders:
    """Compute `transmitted_orders` of light of any tangential wave vector n_i ω_i,∥, (2,); below, up to the index."""
    n_i, n_o, side = (index, 1.0, -1) if from_below else (1.0, index, 1)
    m, steps = _lattice(wavelength / np.atleast_1d(period), n_i + n_o)
    found = diffracted(tangent, steps, n_i, n_o)
    # S(q; −κ) = S(−q; κ)
    kappa, sign = 2 * np.pi * np.abs(found.v_z) / wavelength, np.where(side * found.v_z < 0, -1, 1)
    m = m[found.kept]
    power = found.k_g * powers((m.T * sign).T, kappa)
    s, p = (power * (1 - reflected) for reflected in fresnel(found.cos_half, n_o / n_i))
    s, p = (polarised / max(1.0, (s + p).sum() / 2) for polarised in (s, p))
    if sheet:
        cos_out = np.sqrt(np.maximum(1 - n_o**2 + found.k_oz**2, 0))
        through = 1 - np.mean(fresnel(cos_out, index), axis=0)
        m, s, p = ((values.T * factor).T[cos_out > 0] for values, factor in ((m, 1), (s, through), (p, through)))
    return Orders(m, s, p)


def _lattice(pitch: Real, cutoff: float) -> tuple[NDArray[np.int64], Real]:
    """Return m up to |m| λ/T = `cutoff`, (n,) of a profile or (n, 2), and m λ/T along x and y, (n, 2)."""
    axes = [np.arange(-int(cutoff / p) - 1, int(cutoff / p) + 2) for p in pitch]
    m = np.stack(np.meshgrid(*axes, indexing="ij"), -1)
    m = m.reshape(-1, len(pitch))
    steps = np.zeros((len(m), 2))
    steps[:, : len(pitch)] = m * pitch
    return m if len(pitch) == 2 else m[:, 0], steps


def efficiency_difference(scalar: ArrayLike, rigorous: ArrayLike) -> float:
    """Return the L1 difference of efficiencies relative to the rigorously reflected power: Σ|Δη_m| / Σ η_m."""
    scalar, rigorous = np.asarray(scalar), np.asarray(rigorous)
    return float(np.abs(scalar - rigorous).sum() / rigorous.sum())
