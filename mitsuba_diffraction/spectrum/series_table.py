"""The powers from a series: c_m(κ) = Σ_n g_n(κ) B_nm."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ..errors import RequestError
from .expansions import Series, chebyshev_nodes


@dataclass(frozen=True, eq=False)
class SeriesTable:
    """The terms of a series at every node of a grid.

    Attributes:
        series: the g_n(κ).
        terms: B_nm, float32 (N, rows, columns), on the grid.
    """

    series: Series
    terms: NDArray[np.float32] = field(repr=False)

    def __post_init__(self) -> None:
        got = self.terms
        if got.ndim != 3 or len(got) != self.series.terms or got.dtype != np.float32 or not np.isfinite(got).all():
            raise RequestError(
                f"terms: got {got.dtype} {got.shape}, wanted finite float32 ({self.series.terms}, rows, columns)"
            )
        got.setflags(write=False)

    @classmethod
    def build(
        cls,
        series: Series,
        projection: NDArray[np.float64],
        powers: Callable[[float], NDArray[np.float64]],
        progress: Callable[[int, int], None],
    ) -> SeriesTable:
        """Accumulates the terms node by node; little more than the result is held in memory.

        Args:
            series: the g_n(κ).
            projection: (N, J), B_n = Σ_j projection_nj S(κ_j) over J Chebyshev nodes.
            powers: S(κ) on the grid, κ in rad/µm.
            progress: called with (nodes done, J).
        """
        nodes = projection.shape[1]
        # Taylor's terms come out of sums that cancel; those of the others are as large as what is summed.
        dtype = np.float64 if np.abs(projection).sum(axis=1).max() > 100 else np.float32
        terms = None
        for j, t in enumerate(chebyshev_nodes(nodes)):
            power = powers((1 + t) / 2 * series.largest_kappa).astype(dtype)
            if terms is None:
                terms = np.zeros((series.terms, *power.shape), dtype)
            for term, factor in zip(terms, projection[:, j].astype(dtype), strict=True):
                term += factor * power
            progress(j + 1, nodes)
        return cls(series, terms.astype(np.float32, copy=False))

    @property
    def representation(self) -> str:
        """The name of the series."""
        return self.series.name

    @property
    def largest_kappa(self) -> float:
        """κ_max in rad/µm."""
        return self.series.largest_kappa

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns) of the grid."""
        return self.terms.shape[1:]

    def content(self) -> list[NDArray]:
        """All that tells it from others, C-contiguous."""
        weights = self.series.weights(np.linspace(0, self.largest_kappa, 2 * self.series.terms + 2))
        return [
            np.frombuffer(self.representation.encode(), np.uint8),
            np.ascontiguousarray(weights),
            np.ascontiguousarray(self.terms),
        ]

    @property
    def nbytes(self) -> int:
        """Size in memory."""
        return self.terms.nbytes

    @property
    def words_per_node(self) -> int:
        """Words of 32 bits that a renderer reads of a node at one κ: packets of four."""
        return 4 * -(-len(self.terms) // 4)

    def powers(self, kappa: float) -> NDArray[np.float32]:
        """c_m(κ) of all nodes, (rows, columns), in float32 as a renderer computes them; κ in rad/µm."""
        # The last bits of BLAS depend on the number of cores.
        return np.einsum("n,nyx->yx", self.series.weights(kappa).astype(np.float32), self.terms)

    def powers_at(
        self, row: NDArray[np.int64], column: NDArray[np.int64], kappa: NDArray[np.float64]
    ) -> NDArray[np.float32]:
        """c_m(κ) at one node and one κ each; all arguments and the result of one shape (...)."""
        weights = self.series.weights(kappa).astype(np.float32)
        return np.einsum("...n,n...->...", weights, self.terms[:, row, column])
