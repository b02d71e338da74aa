"""The efficiencies of the orders that a grating reflects, by Maxwell's equations, and how far they have converged."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import RequestError
from ..surface.heightfield import HeightField
from .blas import one_thread
from .coordinate_transformation import Grating, light_from, scatter
from .curve import curve_of
from .materials import refractive_index

Real = NDArray[np.float64]
Complex = NDArray[np.complex128]

MOST_HARMONICS = 80


@dataclass(frozen=True, eq=False)
class Efficiencies:
    """What a grating reflects of light from one direction.

    The polarisation of a wave that travels along k̂ is given in the basis ŝ = ẑ × k̂ / |ẑ × k̂| (ŷ along the
    normal) and p̂ = k̂ × ŝ; k̂ = −ω_i of the incident light, and k̂ = ω_o of an order.

    Attributes:
        orders: m of the orders that propagate, ascending, (n,); q_x = m / period, ω_o,x = −λ m / period − ω_i,x.
        amplitudes: (n, 2, 2), [order, polarisation of the order, of the incident light], s before p; |·|² is a share of
            the incident power.
        transmitted: the share of the incident power that is transmitted, (2,), of s and p light; NaN if the material
            absorbs.
        harmonics: N; fields are sums of 2N + 1 waves.
        error: by how much the efficiencies changed at the last raise of N: Σ|Δη_m| / Σ η_m, of s or p, the larger. NaN
            if N was given.
    """

    orders: NDArray[np.int64]
    amplitudes: Complex
    transmitted: Real
    harmonics: int
    error: float

    @property
    def s(self) -> Real:
        """η_m of s-polarised incident light, (n,)."""
        return (np.abs(self.amplitudes[:, :, 0]) ** 2).sum(axis=1)

    @property
    def p(self) -> Real:
        """η_m of p-polarised incident light, (n,)."""
        return (np.abs(self.amplitudes[:, :, 1]) ** 2).sum(axis=1)

    @property
    def unpolarised(self) -> Real:
        """η_m of unpolarised light, the mean of both, (n,)."""
        return (self.s + self.p) / 2


def efficiencies(
    height_field: HeightField,
    direction: ArrayLike,
    wavelength: float,
    *,
    int_ior: complex | None = None,
    material: str | None = None,
    tolerance: float = 1e-3,
    harmonics: int | None = None,
) -> Efficiencies:
    """Rigorous efficiencies of a surface of one row, h(x), in air; conical incidence included.

    Args:
        height_field: one period (rows that differ are refused); straight lines join the pixels (`curve_of`).
        direction: ω_i, (3,), to the light, in the local frame; it is normalised. ω_i,z > 0.
        wavelength: µm, in vacuum.
        int_ior: index of refraction of a dielectric, or n + ik.
        material: or a conductor by Mitsuba's name, "Al".
        tolerance: harmonics are raised until the efficiencies change by less than this share of the reflected light (of
            s and of p light), or their number reaches the larger of 80 and twice the largest order;
            `Efficiencies.error` says what was reached.
        harmonics: N, to take this number as it is; at least the largest |m| that propagates.

    Raises:
        ValueError: if an argument is out of range.
    """
    if not (np.isfinite(wavelength) and 0.01 <= wavelength <= 100):
        raise RequestError(f"wavelength: got {wavelength!r}, wanted µm, from 0.01 to 100")
    index = refractive_index(wavelength, int_ior=int_ior, material=material)
    omega = np.asarray(direction, np.float64)
    length = np.linalg.norm(omega)
    if omega.shape != (3,) or not (np.isfinite(length) and length > 0 and omega[2] > 0):
        raise RequestError(f"direction: got {direction!r}, wanted three numbers, to the light, the third positive")
    omega = omega / length
    # Every order that propagates is among the harmonics.
    fewest = int(np.ceil(height_field.tile_size[0] / wavelength * (1 + abs(omega[0]))))
    if harmonics is not None:
        if not fewest <= harmonics <= 500:
            raise RequestError(f"harmonics: got {harmonics!r}, wanted a number from {fewest} to 500")
        return _solve(height_field, omega, wavelength, index, harmonics)
    if not 0 < tolerance < 1:
        raise RequestError(f"tolerance: got {tolerance!r}, wanted a share of the reflected light between 0 and 1")
    count = fewest + 6
    most = max(MOST_HARMONICS, 2 * fewest)
    found = _solve(height_field, omega, wavelength, index, count)
    while True:
        count = min(int(np.ceil(1.25 * count)) + 1, most)
        before, found = found, _solve(height_field, omega, wavelength, index, count)
        error = max(np.abs(a - b).sum() / b.sum() for a, b in ((before.s, found.s), (before.p, found.p)))
        if error <= tolerance or count == most:
            return Efficiencies(found.orders, found.amplitudes, found.transmitted, count, float(error))


def _solve(height_field: HeightField, omega: Real, wavelength: float, index: complex, harmonics: int) -> Efficiencies:
    k_0 = height_field.tile_size[0] / wavelength
    alpha, k_y = -omega[:2] * k_0
    with one_thread():
        grating = Grating(curve_of(height_field), harmonics)
        solved = scatter(grating, light_from(grating, alpha, k_0**2 - k_y**2), k_y, index)
    light = _frames(np.array([[alpha, k_y, -k_0 * omega[2]]]) / k_0)
    alphas = alpha + solved.orders
    heights = np.sqrt(k_0**2 - k_y**2 - alphas**2)
    orders = _frames(np.stack([alphas, np.full_like(alphas, k_y), heights], axis=1) / k_0)
    amplitudes = orders.transpose(0, 2, 1) @ solved.reflected @ light
    transmitted = np.full(2, np.nan)
    if index.imag == 0:
        transmitted = (np.abs(solved.transmitted @ light) ** 2).sum(axis=(0, 1))
    # Orders count along the change of k_x there, and along q = −(ω_i + ω_o)/λ here.
    return Efficiencies(-solved.orders[::-1], amplitudes[::-1], transmitted, harmonics, float("nan"))


def _frames(k: Real) -> Real:
    """(n, 2, 2): ŝ and p̂ (columns) of waves along k (n, 3) in terms of ê and k̂ × ê (rows), as in `Scattered`."""
    across = np.hypot(k[:, 0], k[:, 1])
    s = np.stack([-k[:, 1], k[:, 0], np.zeros(len(k))], axis=1)
    s = np.where(across[:, None] < 1e-12, [0.0, 1.0, 0.0], s / np.maximum(across, 1e-12)[:, None])
    # ê·ŝ = s_y/√(1 − k_y²), and (k̂ × ê)·ŝ = −ê·(k̂ × ŝ) = −ê·p̂.
    scale = np.sqrt(np.maximum(1 - k[:, 1] ** 2, 1e-30))
    cos, sin = s[:, 1] / scale, np.cross(k, s)[:, 1] / scale
    return np.array([[cos, sin], [-sin, cos]]).transpose(2, 0, 1)
