"""The singular value decomposition of S(q; κ) over κ and q: for what occurs, no separable sum is shorter."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...errors import RequestError
from . import chebyshev_nodes, chebyshev_polynomials, chebyshev_transform, position


@dataclass(frozen=True, eq=False)
class SvdSeries:
    """g_n(κ) = Σ_k modes_nk T_k(t), orthonormal over the Chebyshev nodes; B_n = Σ_j g_n(κ_j) S(q; κ_j).

    Attributes:
        largest_kappa: κ_max in rad/µm.
        modes: (N, J) Chebyshev coefficients of the g_n.
    """

    largest_kappa: float
    modes: NDArray[np.float64] = field(repr=False)

    name: ClassVar[str] = "svd"

    def __post_init__(self) -> None:
        if self.modes.ndim != 2 or 0 in self.modes.shape or not np.isfinite(self.modes).all():
            raise RequestError(f"modes: got {self.modes.shape}, wanted finite numbers, (terms, degrees)")
        self.modes.setflags(write=False)

    @classmethod
    def fit(cls, largest_kappa: float, values: NDArray[np.float64]) -> SvdSeries:
        """All the modes of S, the strongest first.

        An error counts by its modulus, ∫|ΔS| dq. By Cauchy–Schwarz (Σ|ΔS|)² ≤ Σ S̄ · Σ ΔS²/S̄, so frequencies are
        weighted by 1/√S̄, S̄ the mean of |S| over κ.

        Args:
            largest_kappa: κ_max in rad/µm.
            values: (J, n) S at J Chebyshev nodes and n frequencies.
        """
        mean = np.abs(values).mean(axis=0)
        weight = np.where(mean > 0, 1 / np.sqrt(np.where(mean > 0, mean, 1)), 0)
        modes = np.linalg.svd(values * weight, full_matrices=False)[0].T
        return cls(largest_kappa, modes @ chebyshev_transform(len(values)).T)

    def first(self, terms: int) -> SvdSeries:
        """The strongest modes only."""
        return SvdSeries(self.largest_kappa, self.modes[:terms].copy())

    @property
    def terms(self) -> int:
        """N."""
        return len(self.modes)

    def weights(self, kappa: ArrayLike) -> NDArray[np.float64]:
        """g_n(κ) for κ (...) in rad/µm: (..., N)."""
        return chebyshev_polynomials(position(kappa, self.largest_kappa), self.modes.shape[1]) @ self.modes.T

    def projection(self, nodes: int) -> NDArray[np.float64]:
        """(N, J): g_n at the nodes, as they are orthonormal there.

        Raises:
            ValueError: if the nodes are not those of the fit.
        """
        if nodes != self.modes.shape[1]:
            raise RequestError(f"nodes: got {nodes}, wanted the {self.modes.shape[1]} of the fit")
        return self.modes @ chebyshev_polynomials(chebyshev_nodes(nodes), nodes).T
