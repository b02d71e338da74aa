"""The powers of all nodes as a function of κ: polynomials on equal intervals, and their rounding; amplitude series."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import ClassVar

import numpy as np
import scipy.special
from numpy.typing import ArrayLike, NDArray

from ..errors import RequestError


def chebyshev_nodes(count: int) -> NDArray[np.float64]:
    """Return the zeros of T_J in t, ascending: (J,)."""
    return -np.cos(np.pi * (np.arange(count) + 0.5) / count)


def derivative_bound(heights: NDArray[np.float64], weights: ArrayLike, n: int) -> float:
    """Return an upper bound of ∫|∂ⁿS/∂κⁿ| dq, µmⁿ, of S = |F{a e^{iκh}}|²; `weights` a² of sum one, heights in µm.

    The mean height h̄ is a phase without effect. ∂ⁿS = Σ_k (n over k) F{(ih)^k u} F*{(ih)^{n−k} u}, u = a e^{iκ(h−h̄)};
    by Cauchy–Schwarz and Parseval the integral is at most

        Σ_k (n over k) √(M_2k M_2n−2k),     M_j = Σ a² (h − h̄)^j.
    """
    weights = np.asarray(weights)
    square = (heights - np.sum(weights * heights)) ** 2
    moments = [float(np.sum(weights * square**k)) for k in range(n + 1)]
    return sum(math.comb(n, k) * math.sqrt(moments[k] * moments[n - k]) for k in range(n + 1))


@dataclass(frozen=True, eq=False)
class SliceTable:
    """c_m as a polynomial on each of K equal intervals of 0 ≤ κ ≤ κ_max, through its values at Chebyshev points.

    The error ∫|ΔS| dq of interpolation through Chebyshev points of an interval Δκ has an upper bound. Cubic: Δκ⁴/3072 ·
    max ∫|∂⁴S/∂κ⁴| dq. Parabola: Δκ³/192 · max ∫|∂³S/∂κ³| dq. `derivative_bound` bounds these integrals by the moments
    of the heights, so that the number of intervals that a tolerance needs is known beforehand (`intervals_for`). Deep
    surfaces need more intervals but lose no digits.

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
        progress: Callable[[int, int], None],
        rounded: Callable[[NDArray[np.float32]], NDArray[np.float32]] | None = None,
        kept: Callable[[], tuple[slice, slice]] = lambda: (slice(None), slice(None)),
    ) -> SliceTable:
        """Build from c_m = powers(κ), one κ after the other, so that memory holds little more than the result.

        Args:
            intervals: K.
            terms: the number of coefficients a_p.
            max_kappa: κ_max in rad/µm.
            powers: returns c_m, (rows, columns), for κ in rad/µm.
            progress: called with the number of κ done, and of all.
            rounded: rounds values (K, terms, ...) to a number format (`packed`, `halved`); an interval with values too
                large for the format is not rounded.
            kept: returns, when all powers are known, the nodes that are kept.
        """
        values = np.empty((), np.float32)  # until the shape is known
        nodes, polynomial = chebyshev_nodes(terms), to_polynomial(terms)
        for interval, node in np.ndindex(intervals, terms):
            power = powers((interval + (1 + nodes[node]) / 2) / intervals * max_kappa)
            if not values.ndim:
                values = np.zeros((intervals, terms, *power.shape), np.float32)
            for coefficient, factor in zip(values[interval], polynomial[:, node], strict=True):
                coefficient += factor * power
            progress(interval * terms + node + 1, intervals * terms)
        values = np.ascontiguousarray(values[(slice(None), slice(None), *kept())])
        for one in values[:, None]:
            if rounded is not None and np.isfinite(stored := rounded(one)).all():
                one[:] = stored
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

    def extrema(self) -> NDArray[np.float64]:
        """Return the κ in rad/µm at which the error of interpolation is largest, (K `terms` + 1,), ascending.

        These are the ends of the intervals and, between them, the extrema of the Chebyshev polynomial T_`terms`.
        """
        inside = (1 - np.cos(np.pi * np.arange(self.terms) / self.terms)) / 2
        kappas = (np.arange(self.intervals)[:, None] + inside).ravel() / self.intervals
        return self.max_kappa * np.append(kappas, 1.0)

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
        interval, t = locate(kappa, self.max_kappa, self.intervals)
        # The last bits of BLAS depend on the number of cores.
        return np.einsum("n,nyx->yx", t ** np.arange(self.terms, dtype=np.float32), self.values[interval])

    def powers_at(
        self, row: NDArray[np.int64], column: NDArray[np.int64], kappa: NDArray[np.float64]
    ) -> NDArray[np.float32]:
        """Evaluate c_m(κ) at one node and one κ each; all arguments and the result of one shape (...)."""
        interval, t = locate(kappa, self.max_kappa, self.intervals)
        result = np.zeros((), np.float32)
        for power in reversed(range(self.terms)):
            result = result * t + self.values[interval, power, row, column]
        return result


@dataclass(frozen=True, eq=False)
class AmplitudeTable:
    """η_m(κ) = |Σ_{n<N} c_n(κL) F_nm|², a series of the amplitude e^{iκh} of one tile; F_n = F{p_n(h/L)}, |h| ≤ L.

    - taylor: p_n(u) = uⁿ, c_n(x) = (ix)ⁿ/n!. As the derivatives of e^{ix} have modulus one, the remainder is at most
      x^N/N! (Lagrange). The terms grow to about e^x before they shrink, and rounding errors grow with them.
    - chebyshev: p_n = T_n, c_n(x) = ε_n iⁿ J_n(x) (Jacobi–Anger; ε_0 = 1, else 2). Terms are at most two and decrease
      faster than any power for n > x.

    Attributes:
        representation: "taylor" or "chebyshev".
        max_kappa: κ_max in rad/µm.
        height: L in µm.
        terms: F_nm, complex64 (N, rows, columns), on the grid.
    """

    representation: str
    max_kappa: float
    height: float
    terms: NDArray[np.complex64] = field(repr=False)

    def __post_init__(self) -> None:
        got = self.terms
        if got.ndim != 3 or 0 in got.shape or got.dtype != np.complex64 or not np.isfinite(got).all():
            raise RequestError(f"terms: got {got.dtype} {got.shape}, wanted finite complex64 (N, rows, columns)")
        if not (np.isfinite(self.height) and self.height >= 0):
            raise RequestError(f"height: got {self.height}, wanted a length ≥ 0 in µm")
        got.setflags(write=False)

    @property
    def first_interval(self) -> float:
        """The length of the interval from κ = 0 in which η_m/κ² of m ≠ 0 is nearly linear, rad/µm."""
        return min(self.max_kappa / 16, 0.5 / max(self.height, 1e-30))

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns) of the grid."""
        return self.terms.shape[1:]

    def content(self) -> list[NDArray]:
        """Return all that distinguishes the table, as C-contiguous arrays."""
        return [np.array([self.height]), np.ascontiguousarray(self.terms)]

    @property
    def nbytes(self) -> int:
        """Size in memory."""
        return self.terms.nbytes

    @property
    def words_per_node(self) -> int:
        """Words of 32 bits that a renderer reads of a node at one κ: packets of two terms."""
        return 4 * -(-len(self.terms) // 2)

    def weights(self, kappa: ArrayLike) -> NDArray[np.complex64]:
        """Return c_n of κ (...) in rad/µm, (..., N)."""
        x = np.asarray(kappa, np.float64) * self.height
        return series_weights(self.representation, len(self.terms), x).astype(np.complex64)

    def powers(self, kappa: float) -> NDArray[np.float32]:
        """Evaluate η_m(κ) of all orders, (rows, columns), in float32 as a renderer computes them; κ in rad/µm."""
        return _square(np.einsum("n,nyx->yx", self.weights(kappa), self.terms))

    def powers_at(
        self, row: NDArray[np.int64], column: NDArray[np.int64], kappa: NDArray[np.float64]
    ) -> NDArray[np.float32]:
        """Evaluate η_m(κ) of one order and one κ each; all arguments and the result of one shape (...)."""
        return _square(np.einsum("...n,n...->...", self.weights(kappa), self.terms[:, row, column]))


def _square(amplitude: NDArray[np.complex64]) -> NDArray[np.float32]:
    return amplitude.real**2 + amplitude.imag**2


def series_function(representation: str, n: int, u: NDArray[np.float64]) -> NDArray[np.float64]:
    """Evaluate p_n(u), |u| ≤ 1: uⁿ or T_n."""
    return u**n if representation == "taylor" else np.cos(n * np.arccos(np.clip(u, -1, 1)))


def series_weights(representation: str, terms: int, x: ArrayLike) -> NDArray[np.complex128]:
    """Evaluate c_n(x), (..., N), for x (...) ≥ 0."""
    n = np.arange(terms)
    x = np.asarray(x, np.float64)[..., None]
    if representation == "taylor":
        size = np.cumprod(np.where(n == 0, 1.0, x / np.maximum(n, 1)), axis=-1)
    else:
        size = np.where(n == 0, 1, 2) * scipy.special.jv(n, x)
    return size * np.array([1, 1j, -1, -1j])[n % 4]


HALF_SCALE = 2.0**14  # factor of numbers in half precision, which then are multiples of 4e-12 up to just under 4


def halved(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Round `values` to half precision after scaling; too large ones become infinite."""
    with np.errstate(over="ignore"):
        half = (values * np.float32(HALF_SCALE)).astype(np.float16)
    return half.astype(np.float32) / np.float32(HALF_SCALE)


# Format of numbers with a common exponent: whole numbers up to 255 times 2⁻³⁶ to 2⁻⁶.
MAX_MANTISSA, MIN_EXPONENT, EXPONENT_COUNT = 255, -36, 31


def packed(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Round `values` (K, 3, ...) to three whole numbers and one common exponent for each node and interval."""
    mantissas, exponents = shared_exponents(values)
    return np.ldexp(mantissas, exponents[:, None]).astype(np.float32)


def shared_exponents(values: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Return whole numbers m (K, 3, ...) and exponents e (K, ...), `values` ≈ m 2^e; infinite m for those too large."""
    peak = np.abs(values).max(axis=1)
    exponents = np.frexp(peak / np.float32(MAX_MANTISSA + 0.5))[1]
    exponents = np.where(peak > 0, np.maximum(exponents, MIN_EXPONENT), MIN_EXPONENT)
    mantissas = np.rint(np.ldexp(values, -exponents[:, None]))
    too_large = exponents >= MIN_EXPONENT + EXPONENT_COUNT
    mantissas[np.broadcast_to(too_large[:, None], mantissas.shape)] = np.inf
    return mantissas, exponents


def intervals_for(derivative: float, terms: int, max_kappa: float, allowed: float) -> int:
    """Return the number of intervals that bounds ∫|ΔS| dq by `allowed`; `derivative` bounds ∫|∂ⁿS/∂κⁿ| dq, n `terms`.

    A polynomial through n Chebyshev points errs by at most max|f⁽ⁿ⁾| Δκⁿ/(2²ⁿ⁻¹ n!).
    """
    error = derivative * max_kappa**terms / (2 ** (2 * terms - 1) * math.factorial(terms))
    return max(1, math.ceil((error / allowed) ** (1 / terms)))


def to_polynomial(terms: int) -> NDArray[np.float64]:
    """Return the matrix whose row p gives the coefficient of t^p from the values at as many Chebyshev points."""
    return np.linalg.inv(np.vander(chebyshev_nodes(terms), increasing=True)).astype(np.float64)


def locate(kappa: ArrayLike, max_kappa: float, intervals: int) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Return the index of the interval of κ (...) and the coordinate t in it, −1 to 1."""
    x = np.asarray(kappa, np.float64) / max_kappa * intervals
    interval = np.clip(np.floor(x), 0, intervals - 1).astype(np.int64)
    return interval, (2 * (x - interval) - 1).astype(np.float32)
