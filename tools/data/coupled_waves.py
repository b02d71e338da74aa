"""Rigorous efficiencies of the reflected orders of a grating by coupled-wave analysis with `meent` (NumPy).

meent solves Maxwell's equations layer by layer (Moharam et al. 1995, with Li's factorisation for TM). This file
adds exact Fourier coefficients of each layer and the stopping criterion: harmonics and layers are increased until the
orders no longer change.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import toeplitz

Array = NDArray[np.float64]

# Without loss, rounding determines the sign of the root of an eigenvalue, and waves may be confused with their
# reflections: with many layers several per cent of the energy are lost. This index of absorption changes the
# efficiencies by 1e-7.
_LOSS = 1e-8
# A metal is a slab that lets 1e-9 through: of meent's substrates only those without loss conserve energy in TM.
_SLAB = 10.0  # −ln of the amplitude


@dataclass(frozen=True)
class Profile:
    """A profile that every level cuts in one piece.

    Attributes:
        above: level t in (0, 1) of the depth → (left end, width) of what is higher, in periods. (n,) → two of (n,).
    """

    above: Callable[[Array], tuple[Array, Array]]


PROFILES = {
    # h = (1 + sin 2πx) / 2
    "sinusoidal": Profile(lambda t: (0.25 - np.arccos(2 * t - 1) / (2 * np.pi), np.arccos(2 * t - 1) / np.pi)),
    # h = x
    "blazed": Profile(lambda t: (t, 1 - t)),
    # h = 1 − |2x − 1|
    "triangular": Profile(lambda t: (t / 2, 1 - t)),
}
"""Of unit depth and period, as in `gratings`; the triangular one rises in the first half of its period."""


@dataclass(frozen=True)
class Efficiencies:
    """Efficiencies of one grating at one wavelength and angle.

    Attributes:
        orders: m, those that propagate; q = m / period as everywhere in this package.
        te, tm: fraction of the incident power in each order; TE: the electric field is along the grooves (s).
        harmonics: M; the fields are sums of 2M + 1 waves.
        layers: number of layers of the profile.
        change: Σ|Δη|/Σ η at the last increase of the harmonics, or by extrapolation in the layers; the larger.
        lost: |1 − R − T|, R + T being the reflected and transmitted power; the larger of TE and TM; NaN for a metal.
    """

    orders: NDArray[np.int64]
    te: Array
    tm: Array
    harmonics: int
    layers: int
    change: float
    lost: float


def solve(
    profile: str,
    period: float,
    depth: float,
    wavelength: float,
    angle: float,
    index: complex,
    harmonics: int,
    layers: int,
) -> tuple[NDArray[np.int64], Array, Array]:
    """Solve with given numbers of harmonics and layers.

    Args:
        profile: a name of `PROFILES`.
        period, depth, wavelength: µm.
        angle: of incidence, degrees; the light is incident from −x, in the plane across the grooves.
        index: n + ik of the medium below, k ≥ 0; air is above.
        harmonics: M.
        layers: of equal thickness.

    Returns:
        The orders that propagate (n,); their efficiencies (2, n), TE and TM; the reflected and transmitted power (2,).
    """
    from meent.on_numpy.emsolver.rcwa import RCWANumpy

    left, width = PROFILES[profile].above((np.arange(layers)[::-1] + 0.5) / layers)
    thickness = np.full(layers, depth / layers)
    below = complex(index)
    if index.imag:
        left, width = np.append(left, 0), np.append(width, 1)
        thickness = np.append(thickness, _SLAB * wavelength / (2 * np.pi * index.imag))
        below = 1.0
    inside, outside = (index - 1j * _LOSS * (not index.imag)).real - 1j * (index.imag + _LOSS), 1 - 1j * _LOSS
    along = _convolution(left, width, inside**2, outside**2, harmonics)
    across = _convolution(left, width, inside**-2, outside**-2, harmonics)
    layers_of = np.linalg.inv(across), along, np.linalg.inv(along)
    efficiencies, total = [], []
    for polarisation in (0.0, 1.0):
        solver = RCWANumpy(
            n_top=1.0,
            n_bot=np.real(below),
            theta=np.deg2rad(angle),
            pol=polarisation,
            period=(period, period),
            wavelength=wavelength,
            thickness=thickness,
            fto=(harmonics, 0),
        )
        found = solver.solve_1d(wavelength, *layers_of)["res"]
        efficiencies.append(found["de_ri"].ravel())
        total.append(found["de_ri"].sum() + found["de_ti"].sum())
    m = np.arange(-harmonics, harmonics + 1)
    propagates = np.abs(np.sin(np.deg2rad(angle)) + m * wavelength / period) < 1
    # meent's order m has the outgoing k_x = sin θ + mλ/period; here it is −mλ/period − ω_i,x.
    return -m[propagates][::-1], np.array(efficiencies)[:, propagates][:, ::-1], np.array(total)


def _convolution(
    left: Array, width: Array, inside: complex, outside: complex, harmonics: int
) -> NDArray[np.complex128]:
    """Return Toeplitz matrices (layers, 2M + 1, 2M + 1) of ∫ f(x) e^{2πinx} dx of two-valued functions f."""
    n = np.arange(-2 * harmonics, 2 * harmonics + 1)
    left, width = left[:, None], width[:, None]
    box = width * np.sinc(n * width) * np.exp(2j * np.pi * n * (left + width / 2))
    coefficients = (inside - outside) * box + outside * (n == 0)
    middle = 2 * harmonics
    return np.array([toeplitz(c[middle:], c[middle::-1]) for c in coefficients])


def converged(
    profile: str,
    period: float,
    depth: float,
    wavelength: float,
    angle: float,
    index: complex,
    *,
    tolerance: float,
    max_harmonics: int = 70,
    max_layers: int = 256,
) -> Efficiencies:
    """Return efficiencies whose last change is below `tolerance`, or those at the maximum harmonics and layers.

    The harmonics are increased by two fifths at a time, with few layers; then the layers are doubled. The error is
    proportional to the square of their thickness, so that after the last doubling it is a third of the change, which is
    subtracted (Richardson's extrapolation).

    Args:
        profile, period, depth, wavelength, angle, index: as in `solve`.
        tolerance: of Σ_m |Δη_m| / Σ_m η_m, the larger of TE and TM.
        max_harmonics, max_layers: upper bounds.
    """

    def change(old: Array, new: Array) -> float:
        return float((np.abs(new - old).sum(axis=1) / new.sum(axis=1)).max())

    arguments = profile, period, depth, wavelength, angle, index
    layers = 8
    harmonics = int(np.ceil(max(index.real, 1) * period / wavelength)) + 10
    _, old, _ = solve(*arguments, harmonics, layers)
    while True:
        harmonics = int(np.ceil(1.4 * harmonics))
        _, new, _ = solve(*arguments, harmonics, layers)
        change_of_harmonics, old = change(old, new), new
        if change_of_harmonics < tolerance or harmonics * 1.4 > max_harmonics:
            break
    while True:
        layers *= 2
        orders, new, total = solve(*arguments, harmonics, layers)
        correction = (new - old) / 3
        old, change_of_layers = new, change(new, new + correction)
        if change_of_layers < tolerance or layers * 2 > max_layers:
            break
    found = np.maximum(new + correction, 0)
    lost = float("nan") if index.imag else float(np.abs(1 - total).max())
    return Efficiencies(orders, *found, harmonics, layers, max(change_of_harmonics, change_of_layers), lost)
