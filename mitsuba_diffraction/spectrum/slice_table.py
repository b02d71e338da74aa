"""The powers themselves, a polynomial in κ on each of equal intervals."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import RequestError
from .expansions import chebyshev_nodes


@dataclass(frozen=True, eq=False)
class SliceTable:
    """c_m as a polynomial on each of K equal intervals of 0 ≤ κ ≤ κ_max, through its values at Chebyshev points.

    c_m(κ) = Σ_jl F*… e^{iκ(h_j − h_l)} is band-limited: its fastest oscillation in κ has the angular frequency R, the
    height range. A cubic through Chebyshev points of an interval Δκ errs by at most (RΔκ)⁴/3072 of its amplitude, a
    parabola by (RΔκ)³/192, so about 1.3 and 0.6 rad per interval keep 1e-3; deep surfaces need more intervals but lose
    no digits.

    Attributes:
        largest_kappa: κ_max in rad/µm.
        values: a_p of c_m = Σ_p a_p t^p, −1 ≤ t ≤ 1 on each interval; float32 (K, 3 or 4, rows, columns), on the grid.
    """

    largest_kappa: float
    values: NDArray[np.float32] = field(repr=False)

    representation: ClassVar[str] = "slices"

    def __post_init__(self) -> None:
        got = self.values
        if got.ndim != 4 or got.shape[1] not in (3, 4) or got.dtype != np.float32 or not np.isfinite(got).all():
            raise RequestError(f"values: got {got.dtype} {got.shape}, wanted finite float32 (K, 3 or 4, rows, columns)")
        got.setflags(write=False)

    @classmethod
    def build(
        cls,
        intervals: int,
        terms: int,
        largest_kappa: float,
        powers: Callable[[float], NDArray[np.float64]],
        rounded: Callable[[NDArray[np.float32]], NDArray[np.float32]],
        progress: Callable[[int, int], None],
    ) -> SliceTable:
        """Takes the powers at one κ after the other, so that little more than the result is held in memory.

        Args:
            intervals: K.
            terms: how many a_p.
            largest_kappa: κ_max in rad/µm.
            powers: c_m at one κ.
            rounded: values (K, terms, ...) as they are read, `packed` or `halved`; an interval stays as it is where
                they are too large for it.
            progress: called with what is done and what there is to do.
        """
        values, nodes, polynomial = None, chebyshev_nodes(terms), to_polynomial(terms)
        for interval, node in np.ndindex(intervals, terms):
            power = powers((interval + (1 + nodes[node]) / 2) / intervals * largest_kappa)
            if values is None:
                values = np.zeros((intervals, terms, *power.shape), np.float32)
            for coefficient, factor in zip(values[interval], polynomial[:, node], strict=True):
                coefficient += factor * power
            if node == terms - 1 and np.isfinite(stored := rounded(values[interval, None])).all():
                values[interval] = stored[0]
            progress(interval * terms + node + 1, intervals * terms)
        return cls(largest_kappa, values)

    @property
    def intervals(self) -> int:
        """K."""
        return len(self.values)

    @property
    def terms(self) -> int:
        """How many a_p."""
        return self.values.shape[1]

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns) of the grid."""
        return self.values.shape[2:]

    def content(self) -> list[NDArray]:
        """All that tells it from others, C-contiguous."""
        return [np.ascontiguousarray(self.values)]

    @cached_property
    def words_per_node(self) -> int:
        """Words of 32 bits that a renderer reads of a node at one κ: 1 if `packed`, 2 if `halved`, else 4."""
        for terms, words, rounded in ((3, 1, packed), (4, 2, halved)):
            # One interval after the other: all at once would take several times the memory of the table.
            if self.terms == terms and all(np.array_equal(rounded(v), v) for v in self.values[:, None]):
                return words
        return 4

    @property
    def nbytes(self) -> int:
        """Size in the memory of a renderer."""
        return 4 * self.words_per_node * self.intervals * self.shape[0] * self.shape[1]

    def powers(self, kappa: float) -> NDArray[np.float32]:
        """c_m(κ) of all nodes, (rows, columns), in float32 as a renderer computes them; κ in rad/µm."""
        interval, t = place(kappa, self.largest_kappa, self.intervals)
        # The last bits of BLAS depend on the number of cores.
        return np.einsum("n,nyx->yx", t ** np.arange(self.terms, dtype=np.float32), self.values[interval])

    def powers_at(
        self, row: NDArray[np.int64], column: NDArray[np.int64], kappa: NDArray[np.float64]
    ) -> NDArray[np.float32]:
        """c_m(κ) at one node and one κ each; all arguments and the result of one shape (...)."""
        interval, t = place(kappa, self.largest_kappa, self.intervals)
        result = np.float32(0)
        for power in reversed(range(self.terms)):
            result = result * t + self.values[interval, power, row, column]
        return result


HALF_SCALE = 2.0**14
"""Of numbers in half precision: the largest are just under 4, the least 4e-9."""


def halved(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """`values` rounded to half precision after scaling.

    Those too small for its full precision become zero, those too large infinite.
    """
    with np.errstate(over="ignore"):
        half = (values * np.float32(HALF_SCALE)).astype(np.float16)
    half[np.abs(half) < np.finfo(np.float16).smallest_normal] = 0
    return half.astype(np.float32) / np.float32(HALF_SCALE)


MANTISSA, LEAST_EXPONENT, EXPONENTS = 255, -36, 31
"""Of numbers that share an exponent: whole numbers up to 255 times 2⁻³⁶ to 2⁻⁶."""


def packed(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """`values` (K, 3, ...) as three whole numbers and one exponent for each node and interval can represent them."""
    mantissas, exponents = shared_exponents(values)
    return np.ldexp(mantissas, exponents[:, None]).astype(np.float32)


def shared_exponents(values: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Whole numbers m (K, 3, ...) and exponents e (K, ...), `values` ≈ m 2^e; infinite m for those too large."""
    largest = np.abs(values).max(axis=1)
    exponents = np.frexp(largest / np.float32(MANTISSA + 0.5))[1]
    exponents = np.where(largest > 0, np.maximum(exponents, LEAST_EXPONENT), LEAST_EXPONENT)
    mantissas = np.rint(np.ldexp(values, -exponents[:, None]))
    mantissas[np.broadcast_to((exponents >= LEAST_EXPONENT + EXPONENTS)[:, None], mantissas.shape)] = np.inf
    return mantissas, exponents


def to_polynomial(terms: int) -> NDArray[np.float64]:
    """Row p: the coefficient of t^p as a combination of the values at as many Chebyshev points."""
    return np.linalg.inv(np.vander(chebyshev_nodes(terms), increasing=True))


def place(kappa: ArrayLike, largest_kappa: float, intervals: int) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """The interval of κ (...), and the place t in it, −1 to 1."""
    x = np.asarray(kappa, np.float64) / largest_kappa * intervals
    interval = np.clip(np.floor(x), 0, intervals - 1).astype(np.int64)
    return interval, (2 * (x - interval) - 1).astype(np.float32)
