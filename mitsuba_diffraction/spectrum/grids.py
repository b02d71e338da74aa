"""The nodes of a spectrum: the diffraction orders of a tile, or a lattice of B-splines for a smooth spectrum."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.special
from numpy.typing import NDArray

from ..errors import RequestError

MAX_TILE = 1e6  # µm; of a larger tile, light reaches millions of orders


class _Rectangle:
    """The nodes m = (m_x, m_y), |m_x| ≤ M_x, |m_y| ≤ M_y."""

    max_order: tuple[int, int]

    def __post_init__(self) -> None:
        if not all(m >= 0 for m in self.max_order):
            raise RequestError(f"max_order: got {self.max_order}, wanted two integers ≥ 0")

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns) = (2 M_y + 1, 2 M_x + 1); row ↔ m_y, column ↔ m_x, both from −M."""
        return 2 * self.max_order[1] + 1, 2 * self.max_order[0] + 1

    def axes(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return m_x of the columns and m_y of the rows."""
        m_x, m_y = self.max_order
        return np.arange(-m_x, m_x + 1), np.arange(-m_y, m_y + 1)


@dataclass(frozen=True)
class LobeAxis:
    """Truncation of an order's lobe along one axis.

    Attributes:
        count: number of lobes that contribute at one q.
        half_width: |q − m/T| up to which the order m contributes, cycles/µm; infinite if all contribute everywhere.
        inside: the fraction of the Gaussian within `half_width`, by which the lobe is divided.
    """

    count: int
    half_width: float
    inside: float


@dataclass(frozen=True)
class OrderGrid(_Rectangle):
    """The orders m = (m_x, m_y) of a tile that are kept: a rectangle about m = 0. The order m lies at q = m/T.

    Attributes:
        tile_size: (T_x, T_y) in µm.
        max_order: (M_x, M_y), |m_x| ≤ M_x, |m_y| ≤ M_y.
    """

    tile_size: tuple[float, float]
    max_order: tuple[int, int]

    def __post_init__(self) -> None:
        if not all(0 < t <= MAX_TILE for t in self.tile_size):
            raise RequestError(f"tile_size: got {self.tile_size}, wanted two positive lengths up to {MAX_TILE:g} µm")
        super().__post_init__()

    @classmethod
    def reachable(cls, tile_size: tuple[float, float], pixels: tuple[int, int], max_frequency: float) -> OrderGrid:
        """Return the orders up to `max_frequency`, the largest |q| that a pair of directions reaches, in cycles/µm.

        No orders exceed the Nyquist order N/2 of the `pixels`, (N_x, N_y).
        """
        x, y = (min(int(np.floor(t * max_frequency)), n // 2) for t, n in zip(tile_size, pixels, strict=True))
        return cls(tile_size, (x, y))

    def __str__(self) -> str:
        x, y = self.tile_size
        return f"{x:.4g} × {y:.4g} µm, {self.shape[1]} × {self.shape[0]} orders"

    def frequencies(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return q_x of the columns and q_y of the rows, cycles/µm."""
        x, y = (m / size for m, size in zip(self.axes(), self.tile_size, strict=True))
        return x, y

    def take(self, powers: NDArray, half: float = 0.5, along: tuple[int, ...] = (0, 1)) -> NDArray:
        """Select the kept orders, in the order of `axes`, from the powers of all, (N_y, N_x), as in `scipy.fft.fft2`.

        The Nyquist order of an even N has no sign: both signs get the factor `half`, for amplitudes √½. With one axis
        in `along`, the orders along that axis are selected.
        """
        for axis in along:
            m, count = self.axes()[1 - axis], powers.shape[axis]
            powers = powers.take(m % count, axis)
            powers.swapaxes(0, axis)[2 * np.abs(m) == count] *= half
        return powers

    def around(
        self, q: NDArray[np.float64], lobe_width: float, cutoff_sigmas: float
    ) -> Iterator[tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]]:
        """Yield the orders whose lobes contain q (..., 2): row, column and N(q − m/T; σ_q² I), one neighbour at a time.

        The lobe is truncated by `lobes` and scaled to the integral one; it is 0 outside, and outside the grid.
        """
        tile, max_order = np.array(self.tile_size), np.array(self.max_order)
        lobes = self.lobes(lobe_width, cutoff_sigmas)
        count = np.array([lobe.count for lobe in lobes])
        half_width = np.array([lobe.half_width for lobe in lobes])
        start = np.where(np.isinf(half_width), -max_order, q * tile - count / 2)
        first = np.ceil(np.clip(start, -max_order - count, max_order + 1)).astype(np.int64)
        peak = 1 / (2 * np.pi * lobe_width**2 * lobes[0].inside * lobes[1].inside)
        for step in np.ndindex(*count):
            m = first + step
            offset = q - m / tile
            kept = ((np.abs(m) <= max_order) & (np.abs(offset) <= half_width)).all(axis=-1)
            column, row = np.moveaxis(np.where(kept[..., None], m + max_order, 0), -1, 0)
            yield row, column, np.where(kept, peak * np.exp(-(offset**2).sum(axis=-1) / (2 * lobe_width**2)), 0)

    def lobes(self, lobe_width: float, cutoff_sigmas: float) -> tuple[LobeAxis, LobeAxis]:
        """Return the truncation of lobes of width σ_q (cycles/µm) along x and y: at `cutoff_sigmas`·σ_q or further.

        Separate lobes are truncated there. Where lobes overlap, the same number of them, the nearest, contributes at
        every q: each is truncated at that many half spacings. If more overlap than there are orders, none is truncated.
        """
        result = []
        for size, max_order in zip(self.tile_size, self.max_order, strict=True):
            # Rounding in the width must not add an order.
            count = max(1, int(np.ceil(2 * cutoff_sigmas * lobe_width * size * (1 - 1e-9))))
            half_width = count / (2 * size) if count > 1 else cutoff_sigmas * lobe_width
            if count > 2 * max_order + 1:
                count, half_width = 2 * max_order + 1, np.inf
            inside = float(scipy.special.erf(half_width / (np.sqrt(2) * lobe_width)))
            result.append(LobeAxis(count, half_width, inside))
        x, y = result
        return x, y


SHIFTS = (-0.25, 0.25)
"""Of the nodes, in spacings, along each axis: lattices on which the error of splines is measured."""


@dataclass(frozen=True)
class SplineGrid(_Rectangle):
    """S(q; κ) = Σ_m c_m(κ) B(q_x/Δ_x − m_x) B(q_y/Δ_y − m_y)/(Δ_x Δ_y), B the centred quadratic B-spline, ∫B = 1.

    B(x) = ¾ − x² for |x| ≤ ½, ½(3/2 − |x|)² for ½ ≤ |x| ≤ 3/2, else 0. Three by three nodes contribute at any q. S is
    zero outside the Nyquist limit; the nodes there belong to splines that overlap the inside.

    Attributes:
        spacing: (Δ_x, Δ_y) in cycles/µm.
        max_order: (M_x, M_y), |m_x| ≤ M_x, |m_y| ≤ M_y.
        limit: |q_x| and |q_y| at which the spectrum ends, cycles/µm: the Nyquist limit, infinite on a uniform axis.
    """

    spacing: tuple[float, float]
    max_order: tuple[int, int]
    limit: tuple[float, float]

    def __post_init__(self) -> None:
        if not all(np.isfinite(d) and d > 0 for d in self.spacing):
            raise RequestError(f"spacing: got {self.spacing}, wanted two positive numbers in cycles/µm")
        super().__post_init__()
        if not all(limit > 0 for limit in self.limit):
            raise RequestError(f"limit: got {self.limit}, wanted two positive numbers in cycles/µm")

    def __str__(self) -> str:
        x, y = self.spacing
        return f"{self.shape[1]} × {self.shape[0]} frequencies, {x:.3g} × {y:.3g} cycles/µm apart"

    def frequencies(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return q_x of the columns and q_y of the rows, cycles/µm."""
        x, y = (np.float64(d) * m for m, d in zip(self.axes(), self.spacing, strict=True))
        return x, y

    def around(
        self, q: NDArray[np.float64]
    ) -> Iterator[tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]]:
        """Yield the nodes about q (..., 2): row, column and weight, one of nine at a time; 0 outside the grid."""
        position = q / np.array(self.spacing)
        nearest = np.rint(position).astype(np.int64)
        weights = spline_weights(position - nearest)
        area = self.spacing[0] * self.spacing[1]
        # Rounding of the caller's q must not exclude the limit itself.
        inside = (np.abs(q) <= np.array(self.limit) * (1 + 1e-12)).all(axis=-1)
        for i, j in np.ndindex(3, 3):
            m = nearest + (np.array([i, j]) - 1)
            kept = inside & (np.abs(m) <= self.max_order).all(axis=-1)
            column, row = np.moveaxis(np.where(kept[..., None], m + self.max_order, 0), -1, 0)
            yield row, column, np.where(kept, weights[i][..., 0] * weights[j][..., 1] / area, 0)

    def within(self, coefficients: NDArray[np.float64], max_q: tuple[float, float]) -> float:
        """Compute ∫ Σ c B B/(Δ_x Δ_y) over |q_x| and |q_y| up to `max_q` (cycles/µm)."""
        inside: list[NDArray[np.float64]] = []
        for m, spacing, end in zip(self.axes(), self.spacing, max_q, strict=True):
            inside.append(spline_integral(end / spacing - m) - spline_integral(-end / spacing - m))
        return float(inside[1] @ coefficients @ inside[0])

    def error(
        self,
        kept: OrderGrid | SplineGrid,
        coefficients: NDArray[np.float32],
        exact: Callable[[int, int], NDArray[np.floating]],
        max_q: tuple[float, float],
    ) -> float:
        """Compute ∫|S_approx − S_exact| dq up to `max_q`, by the rectangle rule on a lattice of half the spacing.

        Args:
            kept: the smaller grid of the approximation.
            coefficients: c_m on it; zero outside.
            exact: returns S Δ_x Δ_y, of the shape of this grid, at the nodes shifted by `SHIFTS[x]` and `SHIFTS[y]`.
            max_q: (x, y) in cycles/µm.
        """
        padded, errors = np.zeros((self.shape[0] + 2, self.shape[1] + 2), np.float32), []
        padded[1:-1, 1:-1][inner(self, kept)] = coefficients
        axes = list(zip(self.axes(), self.spacing, max_q, strict=True))
        for x, y in np.ndindex(2, 2):
            approximate = padded
            for axis, index in ((1, x), (0, y)):
                nodes = np.lib.stride_tricks.sliding_window_view(approximate, 3, axis)
                approximate = nodes @ np.array(spline_weights(SHIFTS[index]), np.float32)
            inside_x, inside_y = (
                np.abs(m + SHIFTS[index]) * spacing <= end
                for index, (m, spacing, end) in zip((x, y), axes, strict=True)
            )
            difference = np.abs(np.maximum(approximate, 0) - exact(x, y))
            errors.append(inside_y @ difference.astype(np.float64) @ inside_x)
        return float(np.mean(errors))


def spline(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Evaluate B(x)."""
    x = np.abs(x)
    return np.where(x <= 0.5, 0.75 - x**2, 0.5 * np.maximum(1.5 - x, 0) ** 2)


def spline_weights(t: Any) -> tuple[Any, Any, Any]:
    """Return B(t + 1), B(t), B(t − 1) for |t| ≤ ½: the weights of the nodes before, at and after the nearest."""
    return 0.5 * (0.5 - t) ** 2, 0.75 - t**2, 0.5 * (0.5 + t) ** 2


def spline_integral(x: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return ∫B from −∞ to x."""
    x = np.clip(x, -1.5, 1.5)
    return np.sum([c * np.maximum(x + 1.5 - k, 0) ** 3 for k, c in enumerate((1, -3, 3, -1))], axis=0) / 6


def inner(grid: OrderGrid | SplineGrid, kept: OrderGrid | SplineGrid) -> tuple[slice, slice]:
    """Return slices of the larger `grid` that select the nodes of `kept`."""
    rows, columns = (slice(m - n, m + n + 1) for m, n in zip(grid.max_order[::-1], kept.max_order[::-1], strict=True))
    return rows, columns
