"""The frequencies of an irregular surface: a lattice of quadratic B-splines, for a spectrum without sharp lines."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..errors import RequestError


@dataclass(frozen=True)
class SplineGrid:
    """S(q; κ) = Σ_m c_m(κ) B(q_x/Δ_x − m_x) B(q_y/Δ_y − m_y)/(Δ_x Δ_y), B the centred quadratic B-spline, ∫B = 1.

    B(x) = ¾ − x² for |x| ≤ ½, ½(3/2 − |x|)² for ½ ≤ |x| ≤ 3/2, else 0. Three by three nodes hold at any q. Beyond the
    Nyquist limit S is zero; the nodes there serve the splines that reach back inside.

    Attributes:
        spacing: (Δ_x, Δ_y) in cycles/µm.
        largest: (M_x, M_y), |m_x| ≤ M_x, |m_y| ≤ M_y.
        limit: |q_x| and |q_y| at which the spectrum ends, cycles/µm: the Nyquist limit, infinite on a uniform axis.
    """

    spacing: tuple[float, float]
    largest: tuple[int, int]
    limit: tuple[float, float]

    def __post_init__(self) -> None:
        if not all(np.isfinite(d) and d > 0 for d in self.spacing):
            raise RequestError(f"spacing: got {self.spacing}, wanted two positive numbers in cycles/µm")
        if not all(m >= 0 for m in self.largest):
            raise RequestError(f"largest node: got {self.largest}, wanted two integers ≥ 0")
        if not all(limit > 0 for limit in self.limit):
            raise RequestError(f"limit: got {self.limit}, wanted two positive numbers in cycles/µm")

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns) = (2 M_y + 1, 2 M_x + 1); row ↔ m_y, column ↔ m_x, both from −M."""
        return 2 * self.largest[1] + 1, 2 * self.largest[0] + 1

    def __str__(self) -> str:
        x, y = self.spacing
        return f"{self.shape[1]} × {self.shape[0]} frequencies, {x:.3g} × {y:.3g} cycles/µm apart"

    def frequencies(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """q_x of the columns and q_y of the rows, cycles/µm."""
        return tuple(np.arange(-m, m + 1) * d for m, d in zip(self.largest, self.spacing, strict=True))

    def around(
        self, q: NDArray[np.float64]
    ) -> Iterator[tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]]:
        """The nodes about q (..., 2): row, column and weight, one of nine at a time; weight 0 beyond grid or limit."""
        place = q / np.array(self.spacing)
        nearest = np.rint(place).astype(np.int64)
        weights = spline_weights(place - nearest)
        area = self.spacing[0] * self.spacing[1]
        # Rounding in the q of the caller must not cut off the limit itself.
        inside = (np.abs(q) <= np.array(self.limit) * (1 + 1e-12)).all(axis=-1)
        for i, j in np.ndindex(3, 3):
            m = nearest + (np.array([i, j]) - 1)
            kept = inside & (np.abs(m) <= self.largest).all(axis=-1)
            column, row = np.moveaxis(np.where(kept[..., None], m + self.largest, 0), -1, 0)
            yield row, column, np.where(kept, weights[i][..., 0] * weights[j][..., 1] / area, 0)


def spline_weights(t: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """B(t + 1), B(t), B(t − 1) for |t| ≤ ½: the weights of the nodes before, at and after the nearest."""
    return 0.5 * (0.5 - t) ** 2, 0.75 - t**2, 0.5 * (0.5 + t) ** 2


def spline_integral(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """∫B from −∞ to x."""
    x = np.clip(x, -1.5, 1.5)
    return sum(c * np.maximum(x + 1.5 - k, 0) ** 3 for k, c in enumerate((1, -3, 3, -1))) / 6
