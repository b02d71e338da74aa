"""The Taylor series in the height, the way of Stam's diffraction shaders (Stam 1999) and of the shader after them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...errors import RequestError
from . import chebyshev_transform, position


@dataclass(frozen=True)
class TaylorSeries:
    """g_n = tⁿ and B_n = F{(iκ_c u)ⁿ/n! · e^{iκ_c u}}, the series of e^{iκ_c t u} about the middle of the range of κ.

    The derivatives of e^{ix} have modulus one, so what N terms leave out is of the order of x^N/N! with x = κ_c R
    (Lagrange). The terms grow to about e^x before they shrink, and so do their rounding errors: in float32 the series
    is lost for surfaces deeper than about half a micrometre.

    Attributes:
        largest_kappa: κ_max in rad/µm.
        terms: N.
    """

    largest_kappa: float
    terms: int

    name: ClassVar[str] = "taylor"

    def __post_init__(self) -> None:
        if self.terms < 1:
            raise RequestError(f"terms: got {self.terms}, wanted at least 1")

    def weights(self, kappa: ArrayLike) -> NDArray[np.float64]:
        """tⁿ for κ (...) in rad/µm: (..., N)."""
        return position(kappa, self.largest_kappa)[..., None] ** np.arange(self.terms)

    def projection(self, nodes: int) -> NDArray[np.float64]:
        """(N, J): the coefficients of tⁿ in the polynomial through S at J Chebyshev nodes, which must resolve it."""
        monomials = np.zeros((nodes, nodes))
        for n in range(nodes):
            monomials[: n + 1, n] = np.polynomial.chebyshev.cheb2poly(np.eye(n + 1)[n])
        return (monomials @ chebyshev_transform(nodes))[: self.terms]
