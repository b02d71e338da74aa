"""The order powers themselves at nodes in κ, interpolated by a cubic on each interval."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from ..heightfield import HeightField
from ..reference import order_powers
from .orders import OrderGrid

# Chebyshev points of the first kind on [0, 1]: no cubic through four samples is nearer to a smooth function.
NODES = 0.5 - 0.5 * np.cos(np.pi * (np.arange(4) + 0.5) / 4)
# Row p: the coefficient of t^p as a combination of the values at NODES.
_TO_POLYNOMIAL = np.linalg.inv(np.vander(NODES, increasing=True))


@dataclass(frozen=True, eq=False)
class SliceTable:
    """η_m at four Chebyshev points of each of K equal intervals of 0 ≤ κ ≤ κ_max.

    η_m(κ) = Σ_jl F*… e^{iκ(h_j − h_l)} is band-limited: its fastest oscillation in κ has the angular frequency R, the
    height range. A cubic through Chebyshev points of an interval Δκ errs by at most (RΔκ)⁴/3072 of its amplitude, so
    about 1.3 rad per interval keep 1e-3, and deep surfaces need more intervals but lose no digits.

    Attributes:
        largest_kappa: κ_max in rad/µm.
        values: η_m, float32 (K, 4, rows, columns), on an order grid.
    """

    largest_kappa: float
    values: NDArray[np.float32] = field(repr=False)

    representation: ClassVar[str] = "slices"
    floats_per_order: ClassVar[int] = 4

    def __post_init__(self) -> None:
        got = self.values
        if got.ndim != 4 or got.shape[1] != 4 or got.dtype != np.float32 or not np.isfinite(got).all():
            raise ValueError(f"values: got {got.dtype} {got.shape}, wanted finite float32 (K, 4, rows, columns)")
        got.setflags(write=False)

    @classmethod
    def build(
        cls,
        intervals: int,
        largest_kappa: float,
        height_field: HeightField,
        orders: OrderGrid,
        progress: Callable[[int, int], None],
    ) -> SliceTable:
        """Transform e^{iκh} at one node after the other, so that little more than the result is held in memory."""
        powers = np.empty((intervals, 4, *orders.shape), np.float32)
        for interval in range(intervals):
            for node in range(4):
                kappa = (interval + NODES[node]) / intervals * largest_kappa
                powers[interval, node] = orders.take(order_powers(height_field, kappa))
            progress(interval + 1, intervals)
        return cls(largest_kappa, powers)

    @property
    def intervals(self) -> int:
        """K."""
        return len(self.values)

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns) of the order grid."""
        return self.values.shape[2:]

    @property
    def nbytes(self) -> int:
        """Size in memory."""
        return self.values.nbytes

    def polynomials(self) -> NDArray[np.float32]:
        """The cubics a₀ + a₁t + a₂t² + a₃t³, 0 ≤ t ≤ 1 on each interval: (rows, columns, K, 4)."""
        return np.einsum("pn,knyx->yxkp", _TO_POLYNOMIAL, self.values, optimize=True).astype(np.float32)

    def powers(self, kappa: float) -> NDArray[np.float32]:
        """η_m(κ) of all orders, (rows, columns); κ in rad/µm."""
        interval, t = self._place(np.float64(kappa))
        weights = (t ** np.arange(4) @ _TO_POLYNOMIAL).astype(np.float32)
        return np.maximum(np.tensordot(weights, self.values[interval], 1), 0)

    def powers_at(
        self, row: NDArray[np.int64], column: NDArray[np.int64], kappa: NDArray[np.float64]
    ) -> NDArray[np.float32]:
        """η_m(κ) at one order and one κ each; all arguments and the result of one shape (...)."""
        interval, t = self._place(kappa)
        weights = (t[..., None] ** np.arange(4) @ _TO_POLYNOMIAL).astype(np.float32)
        nodes = np.stack([self.values[interval, node, row, column] for node in range(4)], axis=-1)
        return np.maximum((weights * nodes).sum(axis=-1), 0)

    def _place(self, kappa: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """The interval of κ and the place in it, 0 ≤ t ≤ 1."""
        x = kappa / self.largest_kappa * self.intervals
        interval = np.clip(np.floor(x), 0, self.intervals - 1).astype(np.int64)
        return interval, x - interval
