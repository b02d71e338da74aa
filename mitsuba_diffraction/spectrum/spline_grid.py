"""A lattice of quadratic B-splines, for a spectrum without sharp lines."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import scipy.ndimage
from numpy.typing import NDArray

from ..errors import RequestError
from .orders import OrderGrid


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
        """Return q_x of the columns and q_y of the rows, cycles/µm."""
        return tuple(np.arange(-m, m + 1) * d for m, d in zip(self.largest, self.spacing, strict=True))

    def around(
        self, q: NDArray[np.float64]
    ) -> Iterator[tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]]:
        """Yield the nodes about q (..., 2): row, column and weight, one of nine at a time; weight 0 beyond the grid."""
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

    def within(self, coefficients: NDArray[np.float64], reached: tuple[float, float]) -> float:
        """Compute ∫ Σ c B B/(Δ_x Δ_y) over |q_x| and |q_y| up to `reached` (cycles/µm)."""
        inside = []
        for largest, spacing, end in zip(self.largest, self.spacing, reached, strict=True):
            m = np.arange(-largest, largest + 1)
            inside.append(spline_integral(end / spacing - m) - spline_integral(-end / spacing - m))
        return float(inside[1] @ coefficients @ inside[0])

    def error(
        self,
        kept: OrderGrid | SplineGrid,
        coefficients: NDArray[np.float32],
        exact: NDArray[np.float64],
        shift: NDArray[np.float64],
        reached: tuple[float, float],
    ) -> float:
        """Compute ∫|S_approx − S_exact| dq up to `reached`, by the rectangle rule on the lattice shifted by `shift` Δ.

        Args:
            kept: the smaller grid of the approximation.
            coefficients: c_m on it; zero outside.
            exact: S Δ_x Δ_y on the shifted lattice, of the shape of this grid.
            shift: (x, y), each within ±½.
            reached: (x, y) in cycles/µm.
        """
        weights_x, weights_y = (np.array(spline_weights(s)) for s in shift)
        approximate = np.zeros(self.shape)
        approximate[inner(self, kept)] = coefficients
        approximate = scipy.ndimage.correlate1d(approximate, weights_x, axis=1, mode="constant")
        approximate = scipy.ndimage.correlate1d(approximate, weights_y, axis=0, mode="constant")
        inside_x, inside_y = (
            np.abs(np.arange(-largest, largest + 1) + s) * spacing <= end
            for largest, spacing, s, end in zip(self.largest, self.spacing, shift, reached, strict=True)
        )
        return float(inside_y @ np.abs(np.maximum(approximate, 0) - exact) @ inside_x)


def spline(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Evaluate B(x)."""
    x = np.abs(x)
    return np.where(x <= 0.5, 0.75 - x**2, 0.5 * np.maximum(1.5 - x, 0) ** 2)


def spline_weights(t: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return B(t + 1), B(t), B(t − 1) for |t| ≤ ½: the weights of the nodes before, at and after the nearest."""
    return 0.5 * (0.5 - t) ** 2, 0.75 - t**2, 0.5 * (0.5 + t) ** 2


def spline_integral(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return ∫B from −∞ to x."""
    x = np.clip(x, -1.5, 1.5)
    return sum(c * np.maximum(x + 1.5 - k, 0) ** 3 for k, c in enumerate((1, -3, 3, -1))) / 6


def inner(grid: OrderGrid | SplineGrid, kept: OrderGrid | SplineGrid) -> tuple[slice, slice]:
    """Return slices of the nodes of `kept` among those of the larger `grid`."""
    return tuple(slice(m - n, m + n + 1) for m, n in zip(grid.largest[::-1], kept.largest[::-1], strict=True))
