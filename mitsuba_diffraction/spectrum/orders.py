"""The diffraction orders of a tile: where they lie, and which of them a scene can reach."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import scipy.special
from numpy.typing import NDArray

from ..errors import RequestError


@dataclass(frozen=True)
class LobeAxis:
    """Truncation of an order's lobe along one axis.

    Attributes:
        count: number of lobes that contribute at one q.
        half_width: |q − m/T| up to which the order m contributes, cycles/µm; infinite if all contribute everywhere.
        inside: the share of the Gaussian within `half_width`, by which it is divided.
    """

    count: int
    half_width: float
    inside: float


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
            raise RequestError(f"tile_size: got {self.tile_size}, wanted two positive lengths in µm")
        if not all(m >= 0 for m in self.largest):
            raise RequestError(f"largest order: got {self.largest}, wanted two integers ≥ 0")

    @classmethod
    def reachable(cls, tile_size: tuple[float, float], pixels: tuple[int, int], largest_frequency: float) -> OrderGrid:
        """Return the orders up to `largest_frequency` (cycles/µm), as far as the pixels resolve them.

        Args:
            tile_size: (T_x, T_y) in µm.
            pixels: (N_x, N_y); there is nothing beyond the Nyquist order N/2.
            largest_frequency: the largest |q| that a pair of directions reaches, cycles/µm.
        """
        largest = tuple(
            min(int(np.floor(t * largest_frequency)), n // 2) for t, n in zip(tile_size, pixels, strict=True)
        )
        return cls(tile_size, largest)

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns) = (2 M_y + 1, 2 M_x + 1); row ↔ m_y, column ↔ m_x, both from −M."""
        return 2 * self.largest[1] + 1, 2 * self.largest[0] + 1

    def __str__(self) -> str:
        x, y = self.tile_size
        return f"{x:.4g} × {y:.4g} µm, {self.shape[1]} × {self.shape[0]} orders"

    def axes(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return m_x of the columns and m_y of the rows."""
        m_x, m_y = self.largest
        return np.arange(-m_x, m_x + 1), np.arange(-m_y, m_y + 1)

    def frequencies(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return q_x of the columns and q_y of the rows, cycles/µm."""
        return tuple(m / size for m, size in zip(self.axes(), self.tile_size, strict=True))

    def take(self, powers: NDArray[np.float64]) -> NDArray[np.float64]:
        """Select the kept orders from the powers of all.

        Args:
            powers: (N_y, N_x), in the order of `scipy.fft.fft2`.

        Returns:
            (2 M_y + 1, 2 M_x + 1), in the order of `axes`. The Nyquist order of an even N has no sign: half of its
            power goes to each.
        """
        m_x, m_y = self.axes()
        taken = powers[np.ix_(m_y % powers.shape[0], m_x % powers.shape[1])]
        for lines, m, count in ((taken, m_y, powers.shape[0]), (taken.T, m_x, powers.shape[1])):
            lines[2 * np.abs(m) == count] *= 0.5
        return taken

    def around(
        self, q: NDArray[np.float64], lobe_width: float, reach: float
    ) -> Iterator[tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]]:
        """Yield the orders whose lobes hold q (..., 2): row, column and N(q − m/T; σ_q² I), one neighbour at a time.

        The lobe is cut off as `lobes` says and scaled to the integral one; it is 0 beyond, and beyond the grid.
        """
        tile, largest, lobes = np.array(self.tile_size), np.array(self.largest), self.lobes(lobe_width, reach)
        count = np.array([lobe.count for lobe in lobes])
        half_width = np.array([lobe.half_width for lobe in lobes])
        start = np.where(np.isinf(half_width), -largest, q * tile - count / 2)
        first = np.ceil(np.clip(start, -largest - count, largest + 1)).astype(np.int64)
        peak = 1 / (2 * np.pi * lobe_width**2 * lobes[0].inside * lobes[1].inside)
        for step in np.ndindex(*count):
            m = first + step
            offset = q - m / tile
            kept = ((np.abs(m) <= largest) & (np.abs(offset) <= half_width)).all(axis=-1)
            column, row = np.moveaxis(np.where(kept[..., None], m + largest, 0), -1, 0)
            yield row, column, np.where(kept, peak * np.exp(-(offset**2).sum(axis=-1) / (2 * lobe_width**2)), 0)

    def lobes(self, lobe_width: float, reach: float) -> tuple[LobeAxis, LobeAxis]:
        """Return the truncation of lobes of width σ_q (cycles/µm) along x and y: at `reach`·σ_q or further.

        Separate lobes are truncated there. Where lobes overlap, the same number of them, the nearest, contributes at
        every q: each is truncated at that many half spacings. If more overlap than there are orders, none is truncated.
        """
        result = []
        for size, largest in zip(self.tile_size, self.largest, strict=True):
            # Rounding in the width must not add an order.
            count = max(1, int(np.ceil(2 * reach * lobe_width * size * (1 - 1e-9))))
            half_width = count / (2 * size) if count > 1 else reach * lobe_width
            if count > 2 * largest + 1:
                count, half_width = 2 * largest + 1, np.inf
            inside = float(scipy.special.erf(half_width / (np.sqrt(2) * lobe_width)))
            result.append(LobeAxis(count, half_width, inside))
        return tuple(result)
