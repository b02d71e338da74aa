"""The diffraction orders of a tile: where they lie, and which of them a scene can reach."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class OrderGrid:
    """The orders m = (m_x, m_y) of a tile that are kept: a rectangle about m = 0. The order m lies at q = m/T.

    Attributes:
        tile_size: (T_x, T_y) in µm.
        largest: (M_x, M_y), |m_x| ≤ M_x, |m_y| ≤ M_y.
    """

    tile_size: tuple[float, float]
    largest: tuple[int, int]

    def __post_init__(self) -> None:
        if not all(np.isfinite(t) and t > 0 for t in self.tile_size):
            raise ValueError(f"tile_size: got {self.tile_size}, wanted two positive lengths in µm")
        if not all(m >= 0 for m in self.largest):
            raise ValueError(f"largest order: got {self.largest}, wanted two integers ≥ 0")

    @classmethod
    def reachable(
        cls, tile_size: tuple[float, float], pixels: tuple[int, int], shortest_wavelength: float
    ) -> OrderGrid:
        """The orders that some pair of directions reaches: |q| ≤ 2/λ, as far as the pixels resolve them.

        Args:
            tile_size: (T_x, T_y) in µm.
            pixels: (N_x, N_y); there is nothing at or beyond the Nyquist order N/2.
            shortest_wavelength: λ_min in µm.
        """
        largest = tuple(
            min(int(np.floor(2 * t / shortest_wavelength)), (n - 1) // 2)
            for t, n in zip(tile_size, pixels, strict=True)
        )
        return cls(tile_size, largest)

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns) = (2 M_y + 1, 2 M_x + 1); row ↔ m_y, column ↔ m_x, both from −M."""
        return 2 * self.largest[1] + 1, 2 * self.largest[0] + 1

    def axes(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """m_x of the columns and m_y of the rows."""
        m_x, m_y = self.largest
        return np.arange(-m_x, m_x + 1), np.arange(-m_y, m_y + 1)

    def frequencies(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """q_x of the columns and q_y of the rows, cycles/µm."""
        return tuple(m / size for m, size in zip(self.axes(), self.tile_size, strict=True))

    def take(self, transform: NDArray) -> NDArray:
        """The kept orders out of a discrete Fourier transform of the tile.

        Args:
            transform: (N_y, N_x), in the order of `scipy.fft.fft2`.

        Returns:
            (2 M_y + 1, 2 M_x + 1), in the order of `axes`.
        """
        m_x, m_y = self.axes()
        return transform[np.ix_(m_y % transform.shape[0], m_x % transform.shape[1])]

    def neighbours(self, lobe_width: float, reach: float) -> tuple[int, int]:
        """How many orders can lie within ±`reach`·σ_q of one q, along x and y (σ_q in cycles/µm)."""
        return tuple(
            int(min(np.floor(2 * reach * lobe_width * t) + 1, 2 * m + 1))
            for t, m in zip(self.tile_size, self.largest, strict=True)
        )
