"""The order powers from a series: η_m(κ) = |Σ_n c_n(κ) F{φ_n}_m|²."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from ..expansions.taylor import TaylorSeries
from ..heightfield import HeightField
from .orders import OrderGrid


@dataclass(frozen=True, eq=False)
class SeriesTable:
    """The Fourier coefficients of the terms of a series.

    Attributes:
        series: e^{iκh} = Σ_n c_n(κ) φ_n(h).
        coefficients: F{φ_n}_m, complex64 (N, rows, columns), on an order grid.
    """

    series: TaylorSeries
    coefficients: NDArray[np.complex64] = field(repr=False)

    def __post_init__(self) -> None:
        got = self.coefficients
        if got.ndim != 3 or len(got) != self.series.terms or got.dtype != np.complex64 or not np.isfinite(got).all():
            raise ValueError(
                f"coefficients: got {got.dtype} {got.shape}, wanted finite complex64 (terms, rows, columns)"
            )
        got.setflags(write=False)

    @classmethod
    def build(
        cls, series: TaylorSeries, height_field: HeightField, orders: OrderGrid, progress: Callable[[int, int], None]
    ) -> SeriesTable:
        """Transform the terms one after the other, so that little more than the result is held in memory."""
        coefficients = np.empty((series.terms, *orders.shape), np.complex64)
        for n, term in enumerate(series.basis(height_field.centred)):
            coefficients[n] = orders.take(scipy.fft.fft2(term, norm="forward"))
            progress(n + 1, series.terms)
        return cls(series, coefficients)

    @property
    def representation(self) -> str:
        """The name of the series."""
        return self.series.NAME

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns) of the order grid."""
        return self.coefficients.shape[1:]

    @property
    def floats_per_order(self) -> int:
        """How many floats the power of one order at one κ reads."""
        return 2 * self.series.terms

    @property
    def nbytes(self) -> int:
        """Size in memory."""
        return self.coefficients.nbytes

    def powers(self, kappa: float) -> NDArray[np.float32]:
        """η_m(κ) of all orders, (rows, columns), in float32 as a renderer computes them; κ in rad/µm."""
        amplitude = np.zeros(self.shape, np.complex64)
        for weight, term in zip(self.series.weights(kappa).astype(np.complex64), self.coefficients, strict=True):
            amplitude += weight * term
        return amplitude.real**2 + amplitude.imag**2

    def powers_at(
        self, row: NDArray[np.int64], column: NDArray[np.int64], kappa: NDArray[np.float64]
    ) -> NDArray[np.float32]:
        """η_m(κ) at one order and one κ each; all arguments and the result of one shape (...)."""
        weights = self.series.weights(kappa).astype(np.complex64)
        amplitude = np.einsum("...n,n...->...", weights, self.coefficients[:, row, column])
        return amplitude.real**2 + amplitude.imag**2
