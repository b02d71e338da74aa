"""The powers of a periodic tile: of each order, their mean over several tiles, and B-spline coefficients."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property, partial
from typing import Any

import numpy as np
import scipy.fft
import scipy.linalg
from numpy.typing import NDArray

from ..machine import usable_cores
from ..surface.heightfield import HeightField
from .grids import SHIFTS, OrderGrid, SplineGrid, inner, spline
from .tables import derivative_bound

_BLOCK_SIZE = 1 << 14  # pixels that are evaluated at once; larger temporary arrays would be new pages of memory


def phase_wave(heights: NDArray[np.float64], kappa: float) -> NDArray[np.complex64]:
    """Compute e^{iκh} in single precision, of the shape of the heights (µm); κ in rad/µm."""
    wave = np.empty(heights.shape, np.complex64)
    rows = max(1, _BLOCK_SIZE // heights.shape[1])
    for first in range(0, len(heights), rows):
        block = slice(first, first + rows)
        turns = heights[block] * (kappa / (2 * np.pi))
        turns -= np.rint(turns)  # in double precision
        phase = turns.astype(np.float32)
        phase *= np.float32(2 * np.pi)
        np.cos(phase, out=wave[block].real)
        np.sin(phase, out=wave[block].imag)
    return wave


class TilePowers:
    """η_m(κ) on an order grid, from the transform of a tile, or its mean over several, as a pixel covers many.

    Attributes:
        grid: the orders whose lobes overlap the frequencies that light reaches.
        transforms: the number of Fourier transforms for one κ.
    """

    def __init__(
        self, height_fields: Sequence[HeightField], max_frequency: float, lobe_radius: float, single: bool = False
    ) -> None:
        """Take the tiles, and what their orders are needed for.

        Args:
            height_fields: of one size.
            max_frequency: the largest |q| that light reaches, cycles/µm.
            lobe_radius: the radius of a lobe, cycles/µm.
            single: whether to transform in single precision, whose error is below 1e-6 of the power.
        """
        self._heights, self.single = [field.centred for field in height_fields], single
        self.transforms = len(height_fields)
        tile_size, pixels = height_fields[0].tile_size, height_fields[0].shape[::-1]
        self.grid = OrderGrid.reachable(tile_size, pixels, max_frequency + lobe_radius)
        self._reachable = OrderGrid.reachable(tile_size, pixels, max_frequency)

    def __call__(self, kappa: float) -> NDArray[np.float64]:
        """Compute η_m(κ), (rows, columns); κ in rad/µm."""
        total = np.zeros(self.grid.shape)
        with ThreadPoolExecutor(usable_cores()) as pool:
            for power in pool.map(partial(self._power, kappa), self._heights):
                total += power
        return total / self.transforms

    def _power(self, kappa: float, heights: NDArray[np.float64]) -> NDArray[np.floating]:
        """Compute |F{e^{iκh}}|² of one tile at the orders of the grid."""
        amplitude = phase_wave(heights, kappa) if self.single else np.exp(1j * kappa * heights)
        for axis in (1, 0):
            # Only columns that are kept are transformed along y.
            amplitude = scipy.fft.fft(amplitude, axis=axis, norm="forward", overwrite_x=True)
            amplitude = self.grid.take(amplitude, 0.5**0.5, (axis,))
        return amplitude.real**2 + amplitude.imag**2

    def derivative_bound(self, n: int) -> float:
        """Return an upper bound of Σ_m |∂ⁿη_m/∂κⁿ|, µmⁿ."""
        return float(np.mean([derivative_bound(heights, 1 / heights.size, n) for heights in self._heights]))

    def reached(self, powers: NDArray[np.float64]) -> float:
        """Return the fraction of the power in orders that light reaches, from η_m of the grid."""
        return float(powers[inner(self.grid, self._reachable)].sum())

    def error(self, kept: OrderGrid | SplineGrid, powers: NDArray[np.float32], kappa: float) -> float:
        """Return ∫|S_approx − S_exact| dq over the frequencies of this grid; an upper bound if lobes overlap.

        Args:
            kept: the smaller grid of the approximation.
            powers: η_m on it; zero outside.
            kappa: κ in rad/µm.
        """
        exact = self(kappa)
        inside = exact[inner(self.grid, kept)]
        return float(exact.sum() - inside.sum() + np.abs(np.maximum(powers, 0) - inside).sum())


class TileSplines:
    """The B-spline coefficients c_m(κ) of S(q; κ) of a tile whose overlapping lobes make S smooth.

    S is separable in each order, and so is its least-squares projection on the splines: c = A_y η A_xᵀ, where a column
    of A projects the lobe of one order.

    Attributes:
        grid: all nodes whose splines overlap the frequencies that light reaches.
        transforms: the number of Fourier transforms for one κ.
    """

    # Additional nodes outside the grid, so that power outside is not projected on its outermost nodes.
    _MARGIN = 12

    def __init__(self, powers: TilePowers, lobe_width: float, spacing: float, max_frequency: float) -> None:
        """Take η_m(κ), σ_q, and the largest spacing and frequency of the nodes, all in cycles/µm."""
        self._powers, self._sigma, self._spacing = powers, lobe_width, spacing
        self._type = np.float32 if powers.single else np.float64
        self.transforms = powers.transforms
        self._orders = powers.grid.frequencies()
        # S is negligible further than six σ_q from the last order.
        self._max_q = tuple(min(max_frequency, q[-1] + 6 * lobe_width) for q in self._orders)
        x, y = (int(np.rint(end / spacing)) + 1 for end in self._max_q)
        self.grid = SplineGrid((spacing, spacing), (x, y), (np.inf, np.inf))

    @cached_property
    def _projection(self) -> list[NDArray[Any]]:
        """A_x and A_y, computed when coefficients are first requested."""
        return [
            self._projected(m, q).astype(self._type) for m, q in zip(self.grid.max_order, self._orders, strict=True)
        ]

    @cached_property
    def _lobes_between(self) -> list[list[NDArray[Any]]]:
        """Along x and y: `_lobes` at the nodes shifted by each of `SHIFTS`, computed when the error is first needed."""
        return [
            [self._lobes(m + shift, orders).astype(self._type) for shift in SHIFTS]
            for m, orders in zip(self.grid.axes(), self._orders, strict=True)
        ]

    def _projected(self, max_order: int, orders: NDArray[np.float64]) -> NDArray[np.float64]:
        """Compute A, (nodes, orders), along one axis."""
        nodes = np.arange(-max_order - self._MARGIN, max_order + self._MARGIN + 1)
        x, weights = np.polynomial.legendre.leggauss(8)
        # B is a parabola on each of three pieces.
        x = np.concatenate([piece + x / 2 for piece in (-1, 0, 1)])
        weights = np.tile(weights / 2, 3) * spline(x)
        moments = sum(w * self._lobes(nodes + t, orders) for t, w in zip(x, weights, strict=True))
        # ∫B(x)B(x − k), k = 2, 1, 0.
        gram = np.repeat(np.array([[1], [26], [66]]) / 120, len(nodes), axis=1)
        return scipy.linalg.solveh_banded(gram, moments)[self._MARGIN : -self._MARGIN]

    def _lobes(self, positions: NDArray[np.floating], orders: NDArray[np.float64]) -> NDArray[np.float64]:
        """Compute Δ N(q − m/T; σ_q²) at q = Δ · `positions`, (positions, orders)."""
        offset = (positions[:, None] * self._spacing - orders) / self._sigma
        return self._spacing / (np.sqrt(2 * np.pi) * self._sigma) * np.exp(-(offset**2) / 2)

    def __call__(self, kappa: float) -> NDArray[np.float64]:
        """Compute c_m(κ), (rows, columns), with Σ c = 1 over all frequencies; κ in rad/µm."""
        along_x, along_y = self._projection
        return (along_y @ self._powers(kappa).astype(self._type) @ along_x.T).astype(np.float64)

    def derivative_bound(self, n: int) -> float:
        """Return an upper bound of ∫|∂ⁿS/∂κⁿ| dq, µmⁿ: lobes have the same bound as their orders."""
        return self._powers.derivative_bound(n)

    def reached(self, powers: NDArray[np.float64]) -> float:
        """Return the fraction of the power at frequencies that light reaches, from c_m of the grid."""
        return self.grid.within(powers, self._max_q)

    def error(self, kept: OrderGrid | SplineGrid, powers: NDArray[np.float32], kappa: float) -> float:
        """Return ∫|S_approx − S_exact| dq over the frequencies that light reaches; arguments of `TilePowers.error`."""
        lobes_x, lobes_y = self._lobes_between
        of_orders = self._powers(kappa).astype(self._type)
        along_y = [lobes @ of_orders for lobes in lobes_y]

        def exact(x: int, y: int) -> NDArray[np.floating]:
            return along_y[y] @ lobes_x[x].T

        return self.grid.error(kept, powers, exact, self._max_q)
