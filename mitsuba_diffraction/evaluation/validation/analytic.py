"""Gratings for which scalar theory has a closed form, evaluated through the BSDF.

Directions of the orders (the grating equation), their powers, and energy conservation.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.special import jv

from ...array_types import Real
from ...bsdf.testing import direction, towards
from ...settings import lobe_width
from ...surface import gratings
from ...surface.heightfield import HeightField
from ..record import Check, Record
from .conservation import parseval
from .lobes import brdf, density, grating, k_g_between, order_powers_of_bsdf, orders_above, spectrum_of

MAX_ERROR = 1e-4
_WAVELENGTHS = (0.42, 0.55, 0.68)  # µm
_ANGLES = (0.0, 20.0, 50.0)  # degrees
_PERIOD = 2.5  # µm
NARROW_LOBES = {"coherence_length": 200.0}  # µm: η_m(κ), K and G change little over a lobe


# ---------------------------------------------------------------- directions of the orders


def compare_directions(height_field: HeightField, theta: float, phi: float) -> Record:
    """Compare peaks of the BSDF over the hemisphere with u = −ω_i,x − mλ/period, v = −ω_i,y; the period is 2.5 µm."""
    spectrum = spectrum_of(height_field, **NARROW_LOBES)
    bsdf = grating(spectrum, conserve=False)
    wi = direction(theta, phi)
    expected, found = [], []
    for wavelength in _WAVELENGTHS:
        for peak in _peaks(bsdf, wi, wavelength, spectrum.lobe_width * wavelength):
            m = np.rint((-peak[0] - wi[0]) * _PERIOD / wavelength)
            expected.append([-wi[0] - m * wavelength / _PERIOD, -wi[1]])
            found.append(peak)
    return Record.at_max_error(expected, found, MAX_ERROR, f"{len(found)} orders, direction cosines")


def _peaks(bsdf: object, wi: Real, wavelength: float, width: float) -> list[Real]:
    """Return centres (u, v) of all lobes, two lobe widths apart, at up to 70 degrees, by an exhaustive search.

    A centre is the mean of (u, v) weighted by f/(K G), which removes the variation of K G over a lobe.
    """

    def brdf_at(u: Real, v: Real) -> Real:
        return density(bsdf, wi, np.stack([u, v, np.sqrt(1 - u**2 - v**2)], axis=-1), wavelength)

    axis = np.arange(-1, 1, 2 * width)
    u, v = (grid.ravel() for grid in np.meshgrid(axis, axis))
    inside = np.hypot(u, v) < np.sin(np.deg2rad(70))
    u, v = u[inside], v[inside]
    values = brdf_at(u, v)
    candidates = np.flatnonzero(values > 0.02 * values.max())
    peaks = []
    offset = np.linspace(-8, 8, 81) * width
    while len(candidates):
        strongest = candidates[np.argmax(values[candidates])]
        near = np.hypot(u[candidates] - u[strongest], v[candidates] - v[strongest]) < 12 * width
        candidates = candidates[~near]
        x, y = (axis.ravel() for axis in np.meshgrid(u[strongest] + offset, v[strongest] + offset))
        weights = brdf_at(x, y)
        peaks.append(np.array([x @ weights, y @ weights]) / weights.sum())
    return peaks


# ---------------------------------------------------------------- powers of the orders


def compare_orders(
    height_field: HeightField, closed_form: Callable[[Real, Real], Real], azimuth: float = 0.0
) -> Record:
    """Compare η_m of the orders at up to 80° with `closed_form`, which takes m (n, 2) and κ (n,)."""
    spectrum = spectrum_of(height_field, **NARROW_LOBES)
    bsdf = grating(spectrum, conserve=False)
    expected, found = [], []
    for angle in _ANGLES:
        wi = direction(angle, azimuth)
        for wavelength in _WAVELENGTHS:
            m = orders_above(spectrum, wi, wavelength)
            powers, kappa = order_powers_of_bsdf(bsdf, spectrum, wi, m, wavelength)
            expected.append(closed_form(m, kappa))
            found.append(powers)
    wanted, powers = np.concatenate(expected), np.concatenate(found)
    return Record.at_max_error(wanted, powers, MAX_ERROR, f"{len(powers)} orders, 0 to 50°, 420 to 680 nm")


def _binary(m: Real, kappa: Real, depth: float) -> Real:
    """Return cos²(κd/2) for the specular order, (2/πm)² sin²(κd/2) for odd orders, zero for even ones; half duty."""
    odd = m[:, 0] % 2 == 1
    with np.errstate(divide="ignore"):
        odd_power = np.where(odd, (2 / (np.pi * m[:, 0])) ** 2, 0) * np.sin(kappa * depth / 2) ** 2
    return np.where(m[:, 0] == 0, np.cos(kappa * depth / 2) ** 2, odd_power)


def _literature() -> Record:
    """Compare orders of a binary grating of phase π, transmitted into n = 1.5, with published FDTD results."""
    # Transmitted light is delayed by (n − 1) · 0.5 µm = λ/2; in reflection a depth of λ/4 has the same effect.
    transmitted = 1 - 0.04
    published = np.array([0.3891, 0.0429, 0.0152, 0.0076]) / transmitted
    spectrum = spectrum_of(gratings.lamellar(10.0, 0.125), **NARROW_LOBES)
    bsdf = grating(spectrum, conserve=False)
    m = np.stack([[1, 3, 5, 7], [0, 0, 0, 0]], axis=-1)
    found, _ = order_powers_of_bsdf(bsdf, spectrum, direction(0), m, 0.5)
    return Record.at_max_error(published, found, 1e-3, "orders 1, 3, 5, 7, fractions of transmitted light (n = 1.5)")


# ---------------------------------------------------------------- mirror, energy, reciprocity


def _flat() -> Record:
    """Compare a flat mirror with K N(q; σ_q²)/λ² as a fraction of its peak, up to 3 σ_q."""
    spectrum = spectrum_of(HeightField(np.zeros((1, 4)), 0.05, "flat mirror"))
    bsdf = grating(spectrum)
    sigma = lobe_width(spectrum.coherence_length)
    offset = np.linspace(0, 3, 13)[:, None] * sigma * np.array([0.6, 0.8])
    expected, found = [], []
    for angle in _ANGLES:
        wi = direction(angle, 30.0)
        for wavelength in _WAVELENGTHS:
            wo = towards(wi, offset, 1e3 * wavelength)
            peak = 1 / (wavelength**2 * 2 * np.pi * sigma**2)
            found.append(brdf(bsdf, wi, wo, wavelength) / peak)
            expected.append(k_g_between(wi, wo) * np.exp(-((offset / sigma) ** 2).sum(-1) / 2))
    return Record.at_max_error(expected, found, MAX_ERROR, "fraction of the peak")


SINUSOID, BLAZE = gratings.sinusoidal(_PERIOD, 0.3), gratings.blazed(_PERIOD, 0.25, samples=2048)


def sinusoid_orders(m: Real, kappa: Real) -> Real:
    """Return J_m²(κ depth/2) (Jacobi–Anger)."""
    return jv(m[:, 0], kappa * 0.15) ** 2


def blaze_orders(m: Real, kappa: Real) -> Real:
    """Return sinc²(m − κ depth/2π)."""
    return np.sinc(m[:, 0] - kappa * 0.25 / (2 * np.pi)) ** 2


def _crossed() -> Record:
    def closed_form(m: Real, kappa: Real) -> Real:
        return (jv(m, kappa[:, None] * 0.075) ** 2).prod(axis=1)

    return compare_orders(gratings.crossed(2.0, 0.15, samples=64), closed_form)


def _check(name: str, measure: Callable[[], Record], source: str) -> Check:
    return Check("analytic", name, measure, source)


CHECKS = (
    _check(
        "grating equation, planar incidence",
        lambda: compare_directions(SINUSOID, 25, 0),
        "sin θ_o = sin θ_i + mλ/period",
    ),
    _check(
        "grating equation, conical incidence", lambda: compare_directions(SINUSOID, 40, 65), "conical form, v constant"
    ),
    _check("sinusoid: orders J_m²(κ depth/2)", lambda: compare_orders(SINUSOID, sinusoid_orders), "Jacobi–Anger"),
    _check(
        "binary: orders (2/πm)² sin²(κ depth/2)",
        lambda: compare_orders(gratings.lamellar(_PERIOD, 0.2), lambda m, kappa: _binary(m, kappa, 0.2)),
        "Fourier series of a square wave",
    ),
    _check(
        "blaze: orders sinc²(m − κ depth/2π)",
        lambda: compare_orders(BLAZE, blaze_orders),
        "Fourier transform of a ramp",
    ),
    _check("flat mirror: Gaussian lobe of the coherence length", _flat, "K N(q; σ_q²)/λ²"),
    _check("two crossed sinusoids: product of their orders", _crossed, "J²(κ d/2) J²(κ d/2)"),
    _check("Parseval, sinusoid", lambda: parseval(spectrum_of(SINUSOID)), "Σ_m η_m = 1"),
    _check("Parseval, crossed", lambda: parseval(spectrum_of(gratings.crossed(2.0, 0.15, samples=64))), "Σ_m η_m = 1"),
    Check(
        "literature", "binary grating, period 20 λ, FDTD", _literature, "transmission by FDTD, model.md; orders alike"
    ),
)
