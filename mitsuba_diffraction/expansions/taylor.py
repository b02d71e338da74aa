"""The Taylor series of the phase, as in Stam's diffraction shaders (Stam 1999) and the real-time shader after them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import gammaln


@dataclass(frozen=True)
class TaylorSeries:
    """e^{iκh} = Σ_{n<N} c_n(κ) φ_n(h) + remainder, with c_n = (iκH)ⁿ/n! and φ_n = (h/H)ⁿ.

    h is centred, |h| ≤ H. Every derivative of e^{ix} has modulus one, so Lagrange's remainder is at most x^N/N! with
    x = κH. The terms grow to about e^x before they shrink, and so do their rounding errors: in float32 the series is
    lost for surfaces deeper than about half a micrometre.

    Attributes:
        half_range: H in µm.
        terms: N.
    """

    half_range: float
    terms: int

    NAME: ClassVar[str] = "taylor"

    def __post_init__(self) -> None:
        if not (np.isfinite(self.half_range) and self.half_range >= 0):
            raise ValueError(f"half_range: got {self.half_range}, wanted a length ≥ 0 in µm")
        if self.terms < 1:
            raise ValueError(f"terms: got {self.terms}, wanted at least 1")

    @classmethod
    def for_tolerance(cls, half_range: float, largest_kappa: float, tolerance: float) -> TaylorSeries:
        """The fewest terms for which the order powers keep the L1 error `tolerance` up to κ = `largest_kappa` (rad/µm).

        An error of modulus δ or less in e^{iκh} changes the powers by Σ_m ||F_m|² − |F'_m|²| ≤ 2δ + δ²
        (Cauchy–Schwarz, with ‖F‖ = 1 by Parseval).
        """
        series = cls(half_range, 1)
        while 2 * (delta := series.remainder(largest_kappa)) + delta**2 > tolerance:
            series = cls(half_range, series.terms + 1)
        return series

    def remainder(self, kappa: float) -> float:
        """Lagrange's bound (κH)^N/N! of the modulus of what N terms leave out."""
        x = kappa * self.half_range
        if x == 0:
            return 0.0
        return float(np.exp(min(self.terms * np.log(x) - gammaln(self.terms + 1), 300.0)))

    def weights(self, kappa: ArrayLike) -> NDArray[np.complex128]:
        """c_n(κ) for κ (...) in rad/µm: (..., N)."""
        x = np.asarray(kappa, np.float64)[..., None] * self.half_range
        n = np.arange(1, self.terms)
        return np.cumprod(np.concatenate([np.ones_like(x, np.complex128), 1j * x / n], axis=-1), axis=-1)

    def basis(self, heights: NDArray[np.float64]) -> Iterator[NDArray[np.float64]]:
        """φ_n of the centred `heights` (µm), n = 0 … N−1, one array of their shape at a time."""
        scaled = heights / self.half_range if self.half_range > 0 else np.zeros_like(heights)
        power = np.ones_like(scaled)
        for _ in range(self.terms):
            yield power
            power = power * scaled
