"""The power of each order of a tile that repeats for ever."""

from __future__ import annotations

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from ..surface.heightfield import HeightField
from .orders import OrderGrid


class TilePowers:
    """η_m(κ) on an order grid, from one transform of the tile.

    Attributes:
        grid: the orders of which a lobe, or a part of it, lies where light reaches.
    """

    def __init__(self, height_field: HeightField, reach: float, lobe_radius: float) -> None:
        """Takes the tile, the largest |q| that light reaches and the radius of a lobe, both in cycles/µm."""
        self._height_field = height_field
        pixels = height_field.shape[::-1]
        self.grid = OrderGrid.reachable(height_field.tile_size, pixels, reach + lobe_radius)
        self._reached = OrderGrid.reachable(height_field.tile_size, pixels, reach)

    def __call__(self, kappa: float) -> NDArray[np.float64]:
        """η_m(κ), (rows, columns); κ in rad/µm."""
        return self.grid.take(_powers(self._height_field, kappa))

    def reached(self, powers: NDArray[np.float64]) -> float:
        """The share of the power in orders that lie where light reaches; takes η_m of the grid."""
        return float(powers[inner(self.grid, self._reached)].sum())

    def error(self, kept: OrderGrid, powers: NDArray[np.float32], kappa: float) -> float:
        """∫|S_approx − S_exact| dq over the frequencies of this grid: of lobes that stand apart; of others, a bound.

        Args:
            kept: the smaller grid of the approximation.
            powers: η_m on it; zero outside.
            kappa: κ in rad/µm.
        """
        exact = self(kappa)
        inside = exact[inner(self.grid, kept)]
        return float(exact.sum() - inside.sum() + np.abs(np.maximum(powers, 0) - inside).sum())


def _powers(height_field: HeightField, kappa: float) -> NDArray[np.float64]:
    """η_m(κ) = |F_m|² of all orders, (N_y, N_x), as in `scipy.fft.fftfreq`."""
    transform = scipy.fft.fft2(np.exp(1j * kappa * height_field.centred), norm="forward", overwrite_x=True)
    return transform.real**2 + transform.imag**2


def inner(grid: OrderGrid, kept: OrderGrid) -> tuple[slice, slice]:
    """Where the nodes of `kept` lie among those of the larger `grid`."""
    return tuple(slice(m - n, m + n + 1) for m, n in zip(grid.largest[::-1], kept.largest[::-1], strict=True))
