"""S(q; κ) as a short sum Σ_n g_n(κ) B_n(q): the ways to separate the frequency from the wavelength.

S holds κ only in e^{iκu}, u = h(x) − h(x′) the differences in height, |u| ≤ R. With κ = κ_c (1 + t), κ_c = κ_max/2 and
−1 ≤ t ≤ 1, every expansion of e^{iκ_c t u} in t is one of S, with real terms; it holds for the average ⟨·⟩ over places
as well, which an expansion of the amplitude does not. The g_n are polynomials in t. x = κ_c R = κ_max H decides how
many are needed.

`taylor`, `chebyshev` and `svd` return all the functions that J Chebyshev nodes κ_j allow, and a projection, (N, J):
B_n(q) = Σ_j projection_nj S(q; κ_j). A shorter sum takes the first of both.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import RequestError


@dataclasses.dataclass(frozen=True, eq=False)
class Series:
    """The functions g_n(κ) = Σ_k modes_nk T_k(t), n < N.

    Attributes:
        name: of the representation.
        largest_kappa: κ_max in rad/µm.
        modes: (N, K) Chebyshev coefficients of the g_n.
    """

    name: str
    largest_kappa: float
    modes: NDArray[np.float64] = dataclasses.field(repr=False)

    def __post_init__(self) -> None:
        if self.modes.ndim != 2 or 0 in self.modes.shape or not np.isfinite(self.modes).all():
            raise RequestError(f"modes: got {self.modes.shape}, wanted finite numbers, (terms, degrees)")
        self.modes.setflags(write=False)

    @property
    def terms(self) -> int:
        """N."""
        return len(self.modes)

    def weights(self, kappa: ArrayLike) -> NDArray[np.float64]:
        """g_n(κ) for κ (...) in rad/µm: (..., N)."""
        return chebyshev_polynomials(position(kappa, self.largest_kappa), self.modes.shape[1]) @ self.modes.T

    def first(self, terms: int) -> Series:
        """The first functions only, without the degrees that none of them contains."""
        modes = self.modes[:terms]
        degrees = 1 + max(np.flatnonzero(modes.any(axis=0)), default=0)
        return dataclasses.replace(self, modes=modes[:, :degrees].copy())


def taylor(largest_kappa: float, nodes: int) -> tuple[Series, NDArray[np.float64]]:
    """g_n = tⁿ and B_n = F{(iκ_c u)ⁿ/n! · e^{iκ_c u}}, the series of e^{iκ_c t u} about the middle of the range of κ.

    It is the way of Stam's diffraction shaders (Stam 1999) and of the shader after them. The derivatives of e^{ix} have
    modulus one, so what N terms leave out is of the order of x^N/N! with x = κ_c R (Lagrange). The terms grow to about
    e^x before they shrink, and so do their rounding errors: in float32 the series is lost for surfaces deeper than
    about half a micrometre.

    Args:
        largest_kappa: κ_max in rad/µm.
        nodes: J, enough for the polynomial through S at the nodes to resolve it; its coefficients are the B_n.
    """
    monomials = _triangle(np.polynomial.chebyshev.poly2cheb, nodes)
    coefficients = _triangle(np.polynomial.chebyshev.cheb2poly, nodes).T
    return Series("taylor", largest_kappa, monomials), coefficients @ chebyshev_transform(nodes)


def chebyshev(largest_kappa: float, nodes: int) -> tuple[Series, NDArray[np.float64]]:
    """g_n = T_n(t) and B_n = F{ε_n iⁿ J_n(κ_c u) e^{iκ_c u}}, by e^{iκ_c u t} = Σ_n ε_n iⁿ J_n(κ_c u) T_n(t).

    This is the Jacobi–Anger expansion (Dhillon and Ghosh 2016 used it in the height); ε_0 = 1, else 2. Everything is
    bounded by two, so nothing cancels; the terms fall off faster than any power once n > x = κ_c R.

    Args:
        largest_kappa: κ_max in rad/µm.
        nodes: J, enough for the polynomial through S at the nodes to resolve it; the B_n are its coefficients.
    """
    return Series("chebyshev", largest_kappa, np.eye(nodes)), chebyshev_transform(nodes)


def svd(largest_kappa: float, values: NDArray[np.float64]) -> tuple[Series, NDArray[np.float64]]:
    """The singular value decomposition of S(q; κ) over κ and q, the strongest modes first.

    The g_n are orthonormal over the Chebyshev nodes, so that B_n = Σ_j g_n(κ_j) S(q; κ_j). For the values given, no
    separable sum of as many terms is nearer. An error counts by its modulus, ∫|ΔS| dq. By Cauchy–Schwarz
    (Σ|ΔS|)² ≤ Σ S̄ · Σ ΔS²/S̄, so frequencies are weighted by 1/√S̄, S̄ the mean of |S| over κ.

    Args:
        largest_kappa: κ_max in rad/µm.
        values: (J, n) S at J Chebyshev nodes and n frequencies.
    """
    mean = np.abs(values).mean(axis=0)
    weight = np.where(mean > 0, 1 / np.sqrt(np.where(mean > 0, mean, 1)), 0)
    at_nodes = np.linalg.svd(values * weight, full_matrices=False)[0].T
    return Series("svd", largest_kappa, at_nodes @ chebyshev_transform(len(values)).T), at_nodes


def _triangle(convert: Callable[[NDArray[np.float64]], NDArray[np.float64]], count: int) -> NDArray[np.float64]:
    """The coefficients in one basis of the polynomials of the other, one in each row: (count, count)."""
    rows = np.zeros((count, count))
    for n in range(count):
        rows[n, : n + 1] = convert(np.eye(n + 1)[n])
    return rows


def position(kappa: ArrayLike, largest_kappa: float) -> NDArray[np.float64]:
    """t = 2κ/κ_max − 1."""
    return 2 * np.asarray(kappa, np.float64) / largest_kappa - 1


def chebyshev_nodes(count: int) -> NDArray[np.float64]:
    """The zeros of T_J in t, ascending: (J,)."""
    return -np.cos(np.pi * (np.arange(count) + 0.5) / count)


def chebyshev_polynomials(t: ArrayLike, count: int) -> NDArray[np.float64]:
    """T_n(t), n < `count`, for t (...): (..., count)."""
    t = np.asarray(t, np.float64)
    return np.polynomial.chebyshev.chebvander(t, count - 1).reshape(*t.shape, count)


def chebyshev_transform(count: int) -> NDArray[np.float64]:
    """(J, J): from values at `chebyshev_nodes` to the Chebyshev coefficients of the polynomial through them."""
    values = chebyshev_polynomials(chebyshev_nodes(count), count)
    norm = np.full(count, 2.0)
    norm[0] = 1.0
    return norm[:, None] * values.T / count


def nodes_for(x: float, tolerance: float) -> int:
    """How many Chebyshev nodes resolve e^{ixt} on −1 ≤ t ≤ 1 to `tolerance`.

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
