"""The range of scalar theory: its efficiencies in closed form, and their deviation from rigorous ones.

Scalar theory treats each facet of the surface as a plane mirror (tangent-plane approximation), which holds if the
surface varies slowly on the scale of a wavelength. Stored results of rigorous coupled-wave analysis, made by
`precompute/rigorous_reference.py`, quantify the error as a function of period/λ and depth/λ.
"""

from __future__ import annotations

import functools
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import RegularGridInterpolator
from scipy.special import jv

from .errors import RequestError
from .geometry import k_g
from .surface.heightfield import HeightField

Array = NDArray[np.float64]
OrderPowers = Callable[[NDArray[np.int64], Array], Array]
"""(m, κ), broadcast against each other → η_m(κ)."""

STORED = Path(__file__).parent / "data" / "rigorous.json"

TRUSTED = 0.1
"""Expected error above which a surface is considered outside the range of scalar theory."""


def fresnel(cosine: ArrayLike, index: complex) -> tuple[Array, Array]:
    """Power reflectances (R_s, R_p) of a plane of index n + ik in air, for the cosine of the angle of incidence."""
    cosine = np.asarray(cosine, np.float64)
    root = np.sqrt(complex(index) ** 2 - (1 - cosine**2))
    s = (cosine - root) / (cosine + root)
    p = (index**2 * cosine - root) / (index**2 * cosine + root)
    return np.abs(s) ** 2, np.abs(p) ** 2


def geometry(cos_i: ArrayLike, cos_o: ArrayLike, cos_between: ArrayLike) -> Array:
    """K G from cos θ_i, cos θ_o and ω_i·ω_o; see `geometry.k_g`."""
    return k_g(cos_i, cos_o, np.add(1, cos_between))


def equivalent_depth(rms_height: float) -> float:
    """Peak-to-valley depth of the sinusoid of equal roughness: 2√2 times the r.m.s. height (any unit)."""
    return 2 * np.sqrt(2) * rms_height


def sinusoid_powers(depth: float) -> OrderPowers:
    """η_m = J_m(κ · depth / 2)² of a sinusoid; peak-to-valley depth in µm."""
    return lambda m, kappa: jv(m, kappa * depth / 2) ** 2


def profile_powers(height_field: HeightField) -> OrderPowers:
    """η_m of a profile of one row, by direct summation for each pair (m, κ)."""
    if height_field.shape[0] != 1:
        raise RequestError(f"height_field: got {height_field.shape[0]} rows, wanted a profile of one")
    heights, count = height_field.centred[0], height_field.shape[1]

    def powers(m: NDArray[np.int64], kappa: Array) -> Array:
        m, kappa = np.broadcast_arrays(m, kappa)
        waves = np.exp(1j * (kappa[..., None] * heights - 2 * np.pi * m[..., None] * np.arange(count) / count))
        return np.where(2 * np.abs(m) < count, np.abs(waves.mean(axis=-1)) ** 2, 0.0)

    return powers


@dataclass(frozen=True)
class Orders:
    """Efficiencies of the propagating orders of a grating.

    Attributes:
        m: the orders, (n,).
        s, p: fraction of the incident power in each, polarised perpendicular and parallel to the plane of incidence,
            (n,).
    """

    m: NDArray[np.int64]
    s: Array
    p: Array

    @property
    def unpolarised(self) -> Array:
        """The mean of s and p."""
        return (self.s + self.p) / 2


def scalar_orders(powers: OrderPowers, period: float, wavelength: float, angle: float, index: complex) -> Orders:
    """R K G E η_m(κ_m), the efficiencies of the BSDF in float64 in the limit of narrow lobes.

    Light is incident from −x in the plane perpendicular to the grooves. Integrating the BRDF R K G S(q; κ)/λ² E
    (`bsdf/`) times cos θ_o over the lobe of an order, with du dv = λ² dq, gives these factors at the direction of the
    order.

    Args:
        powers: of the profile.
        period: µm.
        wavelength: µm.
        angle: of incidence, degrees.
        index: n + ik of the material.
    """
    pitch = wavelength / period
    sine = -np.sin(np.deg2rad(angle))
    m, sines, factor, cos_half = _mirror_orders(powers, pitch, wavelength, np.array([sine]))
    kept = factor[0] > -1
    m, sines, factor, cos_half = m[kept], sines[0, kept], factor[0, kept], cos_half[0, kept]
    albedo = np.maximum(factor.sum(), _albedo(powers, pitch, wavelength, sines))
    reflected = factor / np.maximum(1, albedo)
    s, p = fresnel(cos_half, index)
    return Orders(m, s * reflected, p * reflected)


def _mirror_orders(
    powers: OrderPowers, pitch: float, wavelength: float, sines: Array
) -> tuple[NDArray[np.int64], Array, Array, Array]:
    """For ω_i,x (d,): m (n,), and (d, n) each ω_o,x, K G η_m for R = 1 (−1 where evanescent), and ω_i·h."""
    m = np.arange(-int(2 / pitch) - 1, int(2 / pitch) + 2)
    sine_i = sines[:, None]
    sine_o = -m * pitch - sine_i
    there = np.abs(sine_o) < 1
    cos_i = np.sqrt(1 - sine_i**2)
    cos_o = np.sqrt(np.where(there, 1 - sine_o**2, 1))
    cos_between = sine_i * np.where(there, sine_o, 0) + cos_i * cos_o
    kappa = 2 * np.pi * (cos_i + cos_o) / wavelength
    factor = np.where(there, geometry(cos_i, cos_o, cos_between) * powers(m, kappa), -1)
    return m, sine_o, factor, np.sqrt((1 + cos_between) / 2)


def _albedo(powers: OrderPowers, pitch: float, wavelength: float, sines: Array) -> Array:
    """a(ω) of a perfect mirror for light from ω_x, (d,)."""
    factor = _mirror_orders(powers, pitch, wavelength, sines)[2]
    return np.maximum(factor, 0).sum(axis=1)


@functools.cache
def stored() -> dict[str, Any]:
    """The stored rigorous results, as `precompute/rigorous_reference.py` wrote them."""
    return json.loads(STORED.read_text(encoding="utf-8"))


def difference(scalar: ArrayLike, rigorous: ArrayLike) -> float:
    """L1 difference of efficiencies relative to the rigorously reflected power: Σ|Δη_m| / Σ η_m."""
    scalar, rigorous = np.asarray(scalar), np.asarray(rigorous)
    return float(np.abs(scalar - rigorous).sum() / rigorous.sum())


@functools.cache
def error_map() -> tuple[Array, Array, Array, Array]:
    """Error of scalar theory for sinusoids of n = 1.5 in unpolarised light.

    Returns:
        period/λ (n,), depth/λ (k,), angles of incidence in degrees (a,), and the error, (n, k, a).
    """
    found: dict[tuple[float, float, float], float] = {}
    index = complex(stored()["map index"])
    for point in stored()["map"]:
        period, depth, angle = point["period"], point["depth"], point["angle"]
        orders = scalar_orders(sinusoid_powers(depth), period, 1.0, angle, index)
        if [int(orders.m[0]), int(orders.m[-1])] != point["orders"]:
            raise RequestError(f"{STORED.name}: orders {point['orders']} at {period} λ, wanted {orders.m[[0, -1]]}")
        found[period, depth, angle] = difference(orders.unpolarised, point["unpolarised"])
    periods, depths, angles = (np.array(sorted(set(values))) for values in zip(*found, strict=True))
    errors = np.array([[[found[p, d, a] for a in angles] for d in depths] for p in periods])
    return periods, depths, angles, errors


@functools.cache
def _interpolated() -> RegularGridInterpolator:
    periods, depths, _, errors = error_map()
    return RegularGridInterpolator((np.log(periods), np.log(depths)), np.log(errors.max(axis=2)))


def expected_error(period: float, depth: float, wavelength: float) -> float:
    """Expected error of scalar theory for a surface at incidence up to 20°.

    The larger of the stored errors at 0° and 20°, interpolated linearly in the logarithms. They are for sinusoids of
    n = 1.5. Other surfaces are represented by their main period and their `equivalent_depth`; edges increase the error.

    Args:
        period: µm.
        depth: peak to valley, µm.
        wavelength: µm.

    Returns:
        Σ|Δη_m| relative to the reflected power. Above the largest stored period (20 λ) and below the smallest depth
        (λ/20), the value at the boundary, an upper bound. NaN for periods below λ or depths above 2 λ, which are not
        stored and beyond scalar theory.

    Raises:
        ValueError: unless period and wavelength are positive and the depth is not negative.
    """
    for name, value in (("period", period), ("wavelength", wavelength)):
        if not (np.isfinite(value) and value > 0):
            raise RequestError(f"{name}: got {value!r}, wanted a positive number in µm")
    if not (np.isfinite(depth) and depth >= 0):
        raise RequestError(f"depth: got {depth!r}, wanted a number in µm, zero or more")
    periods, depths, _, _ = error_map()
    if period < periods[0] * wavelength or depth > depths[-1] * wavelength:
        return float("nan")
    place = np.minimum(period / wavelength, periods[-1]), np.maximum(depth / wavelength, depths[0])
    return float(np.exp(_interpolated()(np.log(place))).item())
