"""The sum of the passes, and how sure it is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..color import spectrum_to_XYZ


@dataclass(eq=False)
class Accumulation:
    """Sums over passes p = 1 … P, of n_p samples per pixel each.

    y_p is a pixel's luminance Y in the pass p alone. Floating-point sums depend on their order: passes must come in
    the order of their number.

    Attributes:
        wavelengths: (n,) float64, nm.
        sums: (height, width, n + 1) float64, Σ_p of what `trace_pass` gives.
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
        """No pass yet."""
        return cls(
            wavelengths,
            np.zeros((rows, columns, wavelengths.size + 1)),
            np.zeros((rows, columns)),
            np.zeros((rows, columns)),
        )

    def add(self, traced: NDArray[np.float32], samples: int) -> None:
        """Adds what `trace_pass` gave for that many samples per pixel."""
        # einsum adds in one order; a matrix product may share the work among threads.
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
        # Row by row: the sums of a large picture are not doubled in memory.
        return np.stack([ratio(row[:, :-1], row[:, -1:]).astype(np.float32) for row in self.sums])

    def error(self) -> float:
        """The relative error that nine in ten lit pixels do not exceed.

        A sample's luminance has the variance σ², and y_p has σ²/n_p. An unbiased estimate of σ² from passes is

            s² = (Σ_p n_p y_p² − (Σ_p n_p y_p)²/N) / (P − 1),

        a pixel's relative error is its standard error over its luminance, (s/√N) / (Σ_p n_p y_p/N), and the picture's
        is the 90th percentile over the pixels that are not black. The mean square over all pixels would be no measure
        where a lamp is seen by way of two gratings: a few very bright samples then make all of it, and it does not fall
        for hours. With few passes the percentile is rather too large, as s² scatters.

        Returns:
            The error; not a number before two passes, or for a black picture.
        """
        lit = self.luminance > 0
        if self.passes < 2 or not lit.any():
            return float("nan")
        luminance, squares = self.luminance[lit], self.squares[lit]
        variance = np.maximum(squares - luminance**2 / self.samples, 0) / (self.passes - 1)
        return float(np.percentile(np.sqrt(variance * self.samples) / luminance, 90))


def ratio(sums: NDArray, weights: NDArray) -> NDArray:
    """sums/weights, zero where no sample lies under the filter."""
    return np.divide(sums, weights, out=np.zeros_like(sums), where=weights != 0)
