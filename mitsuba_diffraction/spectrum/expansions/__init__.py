"""S(q; κ) as a short sum Σ_n g_n(κ) B_n(q): the ways to separate the frequency from the wavelength.

S holds κ only in e^{iκu}, u = h(x) − h(x′) the differences in height, |u| ≤ R. With κ = κ_c (1 + t), κ_c = κ_max/2 and
−1 ≤ t ≤ 1, every expansion of e^{iκ_c t u} in t is one of S, with real terms; it holds for the average ⟨·⟩ over places
as well, which an expansion of the amplitude does not. The g_n are polynomials in t. x = κ_c R = κ_max H decides how
many are needed.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray


class Series(Protocol):
    """A set of functions g_n(κ), n < N.

    Attributes:
        name: of the representation.
        largest_kappa: κ_max in rad/µm.
        terms: N.
    """

    @property
    def name(self) -> str: ...

    @property
    def largest_kappa(self) -> float: ...

    @property
    def terms(self) -> int: ...

    def weights(self, kappa: ArrayLike) -> NDArray[np.float64]:
        """g_n(κ) for κ (...) in rad/µm: (..., N)."""
        ...

    def projection(self, nodes: int) -> NDArray[np.float64]:
        """(N, J): B_n = Σ_j projection_nj S(κ_j) from the values of S at J `chebyshev_nodes`."""
        ...


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
