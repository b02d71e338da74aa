"""The powers of all nodes as a function of κ: a short sum Σ_n g_n(κ) B_n, or a polynomial on each of equal intervals.

S holds κ only in e^{iκu}, u = h(x) − h(x′) the differences in height, |u| ≤ R. With κ = κ_c (1 + t), κ_c = κ_max/2 and
−1 ≤ t ≤ 1, every expansion of e^{iκ_c t u} in t is one of S, with real terms; it holds for the average ⟨·⟩ over places
as well, which an expansion of the amplitude does not. The g_n are polynomials in t. x = κ_c R = κ_max H determines how
many are needed.

`taylor`, `chebyshev` and `svd` return all the functions that J Chebyshev nodes κ_j allow, and a projection, (N, J):
B_n(q) = Σ_j projection_nj S(q; κ_j). A shorter sum takes the first of both.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import RequestError


@dataclass(frozen=True, eq=False)
class Series:
    """The functions g_n(κ) = Σ_k modes_nk T_k(t), n < N, of a representation; modes (N, K), κ_max in rad/µm."""

    name: str
    max_kappa: float
    modes: NDArray[np.float64] = field(repr=False)

    def __post_init__(self) -> None:
        if self.modes.ndim != 2 or 0 in self.modes.shape or not np.isfinite(self.modes).all():
            raise RequestError(f"modes: got {self.modes.shape}, wanted finite numbers, (terms, degrees)")
        self.modes.setflags(write=False)

    @property
    def terms(self) -> int:
        """N."""
        return len(self.modes)

    def weights(self, kappa: ArrayLike) -> NDArray[np.float64]:
        """Evaluate g_n(κ) for κ (...) in rad/µm: (..., N)."""
        return chebyshev_polynomials(position(kappa, self.max_kappa), self.modes.shape[1]) @ self.modes.T

    def first(self, terms: int) -> Series:
        """Return the first functions only, without the degrees that none of them contains."""
        modes = self.modes[:terms]
        degrees = 1 + max(np.flatnonzero(modes.any(axis=0)), default=0)
        return replace(self, modes=modes[:, :degrees].copy())


def taylor(max_kappa: float, nodes: int) -> tuple[Series, NDArray[np.float64]]:
    """Return g_n = tⁿ and B_n = F{(iκ_c u)ⁿ/n! · e^{iκ_c u}}, the series of e^{iκ_c t u} about the middle of all κ.

    This is the expansion of Stam's diffraction shaders (Stam 1999) and their successors. The derivatives of e^{ix} have
    modulus one, so that the remainder after N terms is of the order of x^N/N! with x = κ_c R (Lagrange). The terms grow
    to about e^x before they shrink, and so do their rounding errors: in float32 the series fails for surfaces deeper
    than about half a micrometre. The polynomial through S at the `nodes`, J, must resolve it.
    """
    monomials = _triangle(np.polynomial.chebyshev.poly2cheb, nodes)
    coefficients = _triangle(np.polynomial.chebyshev.cheb2poly, nodes).T
    return Series("taylor", max_kappa, monomials), coefficients @ chebyshev_transform(nodes)


def chebyshev(max_kappa: float, nodes: int) -> tuple[Series, NDArray[np.float64]]:
    """Return g_n = T_n(t) and B_n = F{ε_n iⁿ J_n(κ_c u) e^{iκ_c u}}, by e^{iκ_c u t} = Σ_n ε_n iⁿ J_n(κ_c u) T_n(t).

    This is the Jacobi–Anger expansion (Dhillon and Ghosh 2016 used it in the height); ε_0 = 1, else 2. Everything is
    bounded by two, so nothing cancels; the terms fall off faster than any power once n > x = κ_c R. The B_n are the
    coefficients of the polynomial through S at the `nodes`, J, which must resolve it.
    """
    return Series("chebyshev", max_kappa, np.eye(nodes)), chebyshev_transform(nodes)


def svd(max_kappa: float, values: NDArray[np.float64]) -> tuple[Series, NDArray[np.float64]]:
    """Return the singular value decomposition of S at J Chebyshev nodes and n frequencies, the strongest modes first.

    The g_n are orthonormal over the Chebyshev nodes, so that B_n = Σ_j g_n(κ_j) S(q; κ_j). For the values given, no
    separable sum of as many terms is nearer. An error counts by its modulus, ∫|ΔS| dq. By Cauchy–Schwarz
    (Σ|ΔS|)² ≤ Σ S̄ · Σ ΔS²/S̄, so frequencies are weighted by 1/√S̄, S̄ the mean of |S| over κ.
    """
    mean = np.abs(values).mean(axis=0)
    weight = np.where(mean > 0, 1 / np.sqrt(np.where(mean > 0, mean, 1)), 0)
    at_nodes = np.linalg.svd(values * weight, full_matrices=False)[0].T
    return Series("svd", max_kappa, at_nodes @ chebyshev_transform(len(values)).T), at_nodes


def _triangle(convert: Callable[[NDArray[np.float64]], NDArray[np.float64]], count: int) -> NDArray[np.float64]:
    """Return the coefficients in one basis of the polynomials of the other, one in each row: (count, count)."""
    rows = np.zeros((count, count))
    for n in range(count):
        rows[n, : n + 1] = convert(np.eye(n + 1)[n])
    return rows


def position(kappa: ArrayLike, max_kappa: float) -> NDArray[np.float64]:
    """Return t = 2κ/κ_max − 1."""
    return 2 * np.asarray(kappa, np.float64) / max_kappa - 1


def chebyshev_nodes(count: int) -> NDArray[np.float64]:
    """Return the zeros of T_J in t, ascending: (J,)."""
    return -np.cos(np.pi * (np.arange(count) + 0.5) / count)


def chebyshev_polynomials(t: ArrayLike, count: int) -> NDArray[np.float64]:
    """Evaluate T_n(t), n < `count`, for t (...): (..., count)."""
    t = np.asarray(t, np.float64)
    return np.polynomial.chebyshev.chebvander(t, count - 1).reshape(*t.shape, count)


def chebyshev_transform(count: int) -> NDArray[np.float64]:
    """Return the matrix, (J, J), from values at `chebyshev_nodes` to Chebyshev coefficients of their interpolant."""
    values = chebyshev_polynomials(chebyshev_nodes(count), count)
    norm = np.full(count, 2.0)
    norm[0] = 1.0
    return norm[:, None] * values.T / count


def nodes_for(x: float, tolerance: float) -> int:
    """Return how many Chebyshev nodes resolve e^{ixt} on −1 ≤ t ≤ 1 to `tolerance`.

    Jacobi–Anger: the coefficient of T_n is 2 iⁿ J_n(x), and |J_n(x)| ≤ (x/2)ⁿ/n!.
    """
    if x == 0:
        return 1
    # In logarithms: the bound itself grows to e^{x/2} before it falls, which no float holds beyond x = 1400.
    count, bound = 1, np.log(4 / tolerance)
    while bound > 0 or count < x / 2:
        bound += np.log(x) - np.log(2 * count)
        count += 1
    return count


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
        """Accumulate B_n = Σ_j projection_nj S(κ_j), one κ after the other, to hold little more than the result.

        `projection` is (N, J) for J Chebyshev nodes, powers(κ) gives S on the grid, κ in rad/µm.
        """
        nodes = projection.shape[1]
        # Taylor's terms come out of sums that cancel; those of the others are as large as what is summed.
        dtype = np.float64 if np.abs(projection).sum(axis=1).max() > 100 else np.float32
        terms = None
        for j, t in enumerate(chebyshev_nodes(nodes)):
            power = powers((1 + t) / 2 * series.max_kappa).astype(dtype)
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
    def first_interval(self) -> float:
        """The length of the interval from κ = 0 in which c_m/κ² of m ≠ 0 is nearly a line, rad/µm."""
        return self.max_kappa / 16

    @property
    def max_kappa(self) -> float:
        """κ_max in rad/µm."""
        return self.series.max_kappa

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns) of the grid."""
        return self.terms.shape[1:]

    def content(self) -> list[NDArray]:
        """Return all that distinguishes the table, as C-contiguous arrays."""
        weights = self.series.weights(np.linspace(0, self.max_kappa, 2 * self.series.terms + 2))
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
        """Evaluate c_m(κ) of all nodes, (rows, columns), in float32 as a renderer computes them; κ in rad/µm."""
        # The last bits of BLAS depend on the number of cores.
        return np.einsum("n,nyx->yx", self.series.weights(kappa).astype(np.float32), self.terms)

    def powers_at(
        self, row: NDArray[np.int64], column: NDArray[np.int64], kappa: NDArray[np.float64]
    ) -> NDArray[np.float32]:
        """Evaluate c_m(κ) at one node and one κ each; all arguments and the result of one shape (...)."""
        weights = self.series.weights(kappa).astype(np.float32)
        return np.einsum("...n,n...->...", weights, self.terms[:, row, column])


@dataclass(frozen=True, eq=False)
class SliceTable:
    """c_m as a polynomial on each of K equal intervals of 0 ≤ κ ≤ κ_max, through its values at Chebyshev points.

    c_m(κ) = Σ_jl F*… e^{iκ(h_j − h_l)} is band-limited: its fastest oscillation in κ has the angular frequency R, the
    height range. A cubic through Chebyshev points of an interval Δκ errs by at most (RΔκ)⁴/3072 of its amplitude, a
    parabola by (RΔκ)³/192, so about 1.3 and 0.6 rad per interval keep 1e-3; deep surfaces need more intervals but lose
    no digits.

    Attributes:
        max_kappa: κ_max in rad/µm.
        values: a_p of c_m = Σ_p a_p t^p, −1 ≤ t ≤ 1 on each interval; float32 (K, 3 or 4, rows, columns), on the grid.
    """

    max_kappa: float
    values: NDArray[np.float32] = field(repr=False)

    representation: ClassVar[str] = "slices"

    def __post_init__(self) -> None:
        got = self.values
        if got.ndim != 4 or got.shape[1] not in (3, 4) or got.dtype != np.float32 or not np.isfinite(got).all():
            raise RequestError(f"values: got {got.dtype} {got.shape}, wanted finite float32 (K, 3 or 4, rows, columns)")
        got.setflags(write=False)

    @property
    def first_interval(self) -> float:
        """Δκ in rad/µm."""
        return self.max_kappa / len(self.values)

    @classmethod
    def build(
        cls,
        intervals: int,
        terms: int,
        max_kappa: float,
        powers: Callable[[float], NDArray[np.float64]],
        rounded: Callable[[NDArray[np.float32]], NDArray[np.float32]],
        progress: Callable[[int, int], None],
    ) -> SliceTable:
        """Build from c_m = powers(κ) at one κ after the other, to hold little more than the result in memory.

        `rounded` gives the values (K, terms, ...) as they are read, `packed` or `halved`; an interval with values too
        large for it stays as it is.
        """
        values, nodes, polynomial = None, chebyshev_nodes(terms), to_polynomial(terms)
        for interval, node in np.ndindex(intervals, terms):
            power = powers((interval + (1 + nodes[node]) / 2) / intervals * max_kappa)
            if values is None:
                values = np.zeros((intervals, terms, *power.shape), np.float32)
            for coefficient, factor in zip(values[interval], polynomial[:, node], strict=True):
                coefficient += factor * power
            if node == terms - 1 and np.isfinite(stored := rounded(values[interval, None])).all():
                values[interval] = stored[0]
            progress(interval * terms + node + 1, intervals * terms)
        return cls(max_kappa, values)

    @property
    def intervals(self) -> int:
        """K."""
        return len(self.values)

    @property
    def terms(self) -> int:
        """The number of coefficients a_p."""
        return self.values.shape[1]

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns) of the grid."""
        return self.values.shape[2:]

    def content(self) -> list[NDArray]:
        """Return all that distinguishes the table, as C-contiguous arrays."""
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
        """Evaluate c_m(κ) of all nodes, (rows, columns), in float32 as a renderer computes them; κ in rad/µm."""
        interval, t = place(kappa, self.max_kappa, self.intervals)
        # The last bits of BLAS depend on the number of cores.
        return np.einsum("n,nyx->yx", t ** np.arange(self.terms, dtype=np.float32), self.values[interval])

    def powers_at(
        self, row: NDArray[np.int64], column: NDArray[np.int64], kappa: NDArray[np.float64]
    ) -> NDArray[np.float32]:
        """Evaluate c_m(κ) at one node and one κ each; all arguments and the result of one shape (...)."""
        interval, t = place(kappa, self.max_kappa, self.intervals)
        result = np.float32(0)
        for power in reversed(range(self.terms)):
            result = result * t + self.values[interval, power, row, column]
        return result


HALF_SCALE = 2.0**14  # of numbers in half precision: the largest are just under 4, the least 4e-9


def halved(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Round `values` to half precision after scaling.

    Those too small for its full precision become zero, those too large infinite.
    """
    with np.errstate(over="ignore"):
        half = (values * np.float32(HALF_SCALE)).astype(np.float16)
    half[np.abs(half) < np.finfo(np.float16).smallest_normal] = 0
    return half.astype(np.float32) / np.float32(HALF_SCALE)


# Of numbers that share an exponent: whole numbers up to 255 times 2⁻³⁶ to 2⁻⁶.
MANTISSA, LEAST_EXPONENT, EXPONENTS = 255, -36, 31


def packed(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Round `values` (K, 3, ...) to three whole numbers and one exponent for each node and interval."""
    mantissas, exponents = shared_exponents(values)
    return np.ldexp(mantissas, exponents[:, None]).astype(np.float32)


def shared_exponents(values: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Return whole numbers m (K, 3, ...) and exponents e (K, ...), `values` ≈ m 2^e; infinite m for those too large."""
    peak = np.abs(values).max(axis=1)
    exponents = np.frexp(peak / np.float32(MANTISSA + 0.5))[1]
    exponents = np.where(peak > 0, np.maximum(exponents, LEAST_EXPONENT), LEAST_EXPONENT)
    mantissas = np.rint(np.ldexp(values, -exponents[:, None]))
    mantissas[np.broadcast_to((exponents >= LEAST_EXPONENT + EXPONENTS)[:, None], mantissas.shape)] = np.inf
    return mantissas, exponents


def to_polynomial(terms: int) -> NDArray[np.float64]:
    """Return the matrix whose row p gives the coefficient of t^p from the values at as many Chebyshev points."""
    return np.linalg.inv(np.vander(chebyshev_nodes(terms), increasing=True))


def place(kappa: ArrayLike, max_kappa: float, intervals: int) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Return the interval of κ (...), and the place t in it, −1 to 1."""
    x = np.asarray(kappa, np.float64) / max_kappa * intervals
    interval = np.clip(np.floor(x), 0, intervals - 1).astype(np.int64)
    return interval, (2 * (x - interval) - 1).astype(np.float32)
