"""The sum of the passes and its standard error."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..color import spectrum_to_XYZ


@dataclass(eq=False)
class Accumulation:
    """Sums over passes p = 1 … P of n_p samples per pixel each.

    y_p is the luminance Y of a pixel in pass p alone. Floating-point sums depend on their order: passes must be added
    in the order of their indices.

    Attributes:
        wavelengths: (n,) float64, nm.
        sums: (height, width, n + 1) float64, Σ_p of the results of `trace_pass`.
        luminance: (height, width) float64, Σ_p n_p y_p.
        squares: (height, width) float64, Σ_p n_p y_p².
        passes: P.
        samples: N = Σ_p n_p.
    """

    wavelengths: NDArray[np.float64]
    sums: NDArray[np.float64]
    luminance: NDArray[np.float64]
    squares: NDArray[np.float64]
    passes: int = 0
    samples: int = 0

    @classmethod
    def empty(cls, rows: int, columns: int, wavelengths: NDArray[np.float64]) -> Accumulation:
        """Zero passes."""
        return cls(
            wavelengths,
            np.zeros((rows, columns, wavelengths.size + 1)),
            np.zeros((rows, columns)),
            np.zeros((rows, columns)),
        )

    def add(self, traced: NDArray[np.float32], samples: int) -> None:
        """Adds the result of `trace_pass` with that many samples per pixel."""
        # einsum adds in a fixed order; a matrix product may be multithreaded.
        weights = spectrum_to_XYZ(np.eye(self.wavelengths.size), self.wavelengths)[:, 1].astype(np.float32)
        luminance = np.einsum("yxi,i->yx", traced[..., :-1], weights).astype(np.float64)
        luminance = ratio(luminance, traced[..., -1])
        self.sums += traced
        self.luminance += samples * luminance
        self.squares += samples * luminance**2
        self.passes += 1
        self.samples += samples

    def radiance(self) -> NDArray[np.float32]:
        """(height, width, n) float32, W m⁻² sr⁻¹ nm⁻¹."""
        # Row by row, to avoid a second copy of the sums of a large picture.
        return np.stack([ratio(row[:, :-1], row[:, -1:]).astype(np.float32) for row in self.sums])

    def error(self) -> float:
        """The 90th percentile of the relative standard error of luminance over all non-black pixels.

        With σ² the variance of the luminance of a sample, y_p has the variance σ²/n_p. An unbiased estimate of σ² is

            s² = (Σ_p n_p y_p² − (Σ_p n_p y_p)²/N) / (P − 1),

        and the relative error of a pixel is (s/√N) / (Σ_p n_p y_p/N). The mean square over all pixels is not useful
        where a lamp is seen by way of two gratings: it is dominated by fireflies and does not fall for hours. With few
        passes the percentile is biased upwards by the variance of s².

        Returns:
            The error; NaN before two passes, or for a black picture.
        """
        lit = self.luminance > 0
        if self.passes < 2 or not lit.any():
            return float("nan")
        luminance, squares = self.luminance[lit], self.squares[lit]
        variance = np.maximum(squares - luminance**2 / self.samples, 0) / (self.passes - 1)
        return float(np.percentile(np.sqrt(variance * self.samples) / luminance, 90))


def ratio(sums: NDArray, weights: NDArray) -> NDArray:
    """sums/weights, zero where the filter covers no sample."""
    return np.divide(sums, weights, out=np.zeros_like(sums), where=weights != 0)
