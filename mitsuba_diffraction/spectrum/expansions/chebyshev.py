"""The Jacobi–Anger expansion (Dhillon and Ghosh 2016 used it in the height)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...errors import RequestError
from . import chebyshev_polynomials, chebyshev_transform, position


@dataclass(frozen=True)
class ChebyshevSeries:
    """g_n = T_n(t) and B_n = F{ε_n iⁿ J_n(κ_c u) e^{iκ_c u}}, by e^{iκ_c u t} = Σ_n ε_n iⁿ J_n(κ_c u) T_n(t).

    ε_0 = 1, else 2. Everything is bounded by two, so nothing cancels; the terms fall off faster than any power once
    n > x = κ_c R.

    Attributes:
        largest_kappa: κ_max in rad/µm.
        terms: N.
    """

    largest_kappa: float
    terms: int

    name: ClassVar[str] = "chebyshev"

    def __post_init__(self) -> None:
        if self.terms < 1:
            raise RequestError(f"terms: got {self.terms}, wanted at least 1")

    def weights(self, kappa: ArrayLike) -> NDArray[np.float64]:
        """T_n(t) for κ (...) in rad/µm: (..., N)."""
        return chebyshev_polynomials(position(kappa, self.largest_kappa), self.terms)

    def projection(self, nodes: int) -> NDArray[np.float64]:
        """(N, J): the first N Chebyshev coefficients of the polynomial through S at J Chebyshev nodes."""
        return chebyshev_transform(nodes)[: self.terms]
