"""The powers themselves at nodes in κ, interpolated by a cubic on each interval."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import RequestError
from .expansions import chebyshev_nodes

# Chebyshev points of the first kind on [0, 1]: no cubic through four samples is nearer to a smooth function.
NODES = (1 + chebyshev_nodes(4)) / 2
# Row p: the coefficient of t^p as a combination of the values at NODES.
_TO_POLYNOMIAL = np.linalg.inv(np.vander(NODES, increasing=True))


@dataclass(frozen=True, eq=False)
class SliceTable:
    """c_m at four Chebyshev points of each of K equal intervals of 0 ≤ κ ≤ κ_max.

    c_m(κ) = Σ_jl F*… e^{iκ(h_j − h_l)} is band-limited: its fastest oscillation in κ has the angular frequency R, the
    height range. A cubic through Chebyshev points of an interval Δκ errs by at most (RΔκ)⁴/3072 of its amplitude, so
    about 1.3 rad per interval keep 1e-3, and deep surfaces need more intervals but lose no digits.

    Attributes:
        largest_kappa: κ_max in rad/µm.
        values: c_m, float32 (K, 4, rows, columns), on the grid.
    """

    largest_kappa: float
    values: NDArray[np.float32] = field(repr=False)

    representation: ClassVar[str] = "slices"
    floats_per_node: ClassVar[int] = 4

    def __post_init__(self) -> None:
        got = self.values
        if got.ndim != 4 or got.shape[1] != 4 or got.dtype != np.float32 or not np.isfinite(got).all():
            raise RequestError(f"values: got {got.dtype} {got.shape}, wanted finite float32 (K, 4, rows, columns)")
        got.setflags(write=False)

    @classmethod
    def build(
        cls,
        intervals: int,
        largest_kappa: float,
        powers: Callable[[float], NDArray[np.float64]],
        progress: Callable[[int, int], None],
    ) -> SliceTable:
        """Takes the powers at one κ after the other, so that little more than the result is held in memory."""
        values = None
        for interval, node in np.ndindex(intervals, len(NODES)):
            power = powers((interval + NODES[node]) / intervals * largest_kappa)
            if values is None:
                values = np.empty((intervals, len(NODES), *power.shape), np.float32)
            values[interval, node] = power
            progress(interval * len(NODES) + node + 1, intervals * len(NODES))
        return cls(largest_kappa, values)

    @property
    def intervals(self) -> int:
        """K."""
        return len(self.values)

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns) of the grid."""
        return self.values.shape[2:]

    def content(self) -> list[NDArray]:
        """All that tells it from others, C-contiguous."""
        return [np.ascontiguousarray(self.values)]

    @property
    def nbytes(self) -> int:
        """Size in memory."""
        return self.values.nbytes

    def polynomials(self) -> NDArray[np.float32]:
        """The cubics a₀ + a₁t + a₂t² + a₃t³, 0 ≤ t ≤ 1 on each interval: (K, rows, columns, 4)."""
        result = np.empty((self.intervals, *self.shape, 4), np.float32)
        for interval, values in enumerate(self.values):
            np.einsum("pn,nyx->yxp", _TO_POLYNOMIAL.astype(np.float32), values, out=result[interval])
        return result

    def powers(self, kappa: float) -> NDArray[np.float32]:
        """c_m(κ) of all nodes, (rows, columns), in float32 as a renderer computes them; κ in rad/µm."""
        interval, weights = interpolation(kappa, self.largest_kappa, self.intervals)
        # The last bits of BLAS depend on the number of cores.
        return np.einsum("n,nyx->yx", weights.astype(np.float32), self.values[interval])

    def powers_at(
        self, row: NDArray[np.int64], column: NDArray[np.int64], kappa: NDArray[np.float64]
    ) -> NDArray[np.float32]:
        """c_m(κ) at one node and one κ each; all arguments and the result of one shape (...)."""
        interval, weights = interpolation(kappa, self.largest_kappa, self.intervals)
        values = np.stack([self.values[interval, node, row, column] for node in range(len(NODES))], axis=-1)
        return (weights.astype(np.float32) * values).sum(axis=-1)


def interpolation(
    kappa: ArrayLike, largest_kappa: float, intervals: int
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """The interval of κ (...), and the weights (..., 4) of the values at its four points."""
    x = np.asarray(kappa, np.float64) / largest_kappa * intervals
    interval = np.clip(np.floor(x), 0, intervals - 1).astype(np.int64)
    return interval, (x - interval)[..., None] ** np.arange(4) @ _TO_POLYNOMIAL
