"""The powers of a periodic tile: of each order, their mean over several tiles, and B-spline coefficients."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np
import scipy.fft
import scipy.linalg
from numpy.typing import NDArray

from ..progress import Progress
from ..surface.heightfield import HeightField
from .grids import OrderGrid, SplineGrid, inner, spline
from .tables import chebyshev_nodes, chebyshev_polynomials, chebyshev_transform, nodes_for, position

# Fractions of the largest κ at which the interpolation in κ is compared with direct sums.
_CHECKED_FRACTIONS = (0.137, 0.618, 0.983)


class TilePowers:
    """η_m(κ) on an order grid, from one transform of the tile.

    Attributes:
        grid: the orders whose lobes overlap the frequencies that light reaches.
        own_error: an upper bound of Σ_m |Δη_m| of these powers.
    """

    own_error: float = 0.0

    def __init__(self, height_field: HeightField, max_frequency: float, lobe_radius: float) -> None:
        """Take the tile, the largest |q| that light reaches and the radius of a lobe, both in cycles/µm."""
        self._height_field = height_field
        pixels = height_field.shape[::-1]
        self.grid = OrderGrid.reachable(height_field.tile_size, pixels, max_frequency + lobe_radius)
        self._reachable = OrderGrid.reachable(height_field.tile_size, pixels, max_frequency)

    def __call__(self, kappa: float) -> NDArray[np.float64]:
        """Compute η_m(κ), (rows, columns); κ in rad/µm."""
        transform = scipy.fft.fft2(np.exp(1j * kappa * self._height_field.centred), norm="forward", overwrite_x=True)
        return self.grid.take(transform.real**2 + transform.imag**2)

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
        return float(exact.sum() - inside.sum() + np.abs(np.maximum(powers, 0) - inside).sum()) + self.own_error


class MeanPowers(TilePowers):
    """The mean of η_m(κ) over P periodic patches, which estimates that over the many patches that a pixel covers.

    Powers are band-limited in κ by the height range, so that their values at Chebyshev nodes determine them everywhere
    (Jacobi–Anger); transforming every patch for every κ would take ten times as long. The transforms at the nodes are
    in single precision. The error of that and of the interpolation is measured against direct sums in double precision
    and added to the error of a table.
    """

    def __init__(
        self,
        height_fields: Sequence[HeightField],
        max_frequency: float,
        lobe_radius: float,
        max_kappa: float,
        tolerance: float,
        progress: Progress,
    ) -> None:
        """Take patches of one size, frequency and radius as in `TilePowers`, the largest κ in rad/µm and the tolerance.

        `progress` is called with the number of finished patches and the total.
        """
        super().__init__(height_fields[0], max_frequency, lobe_radius)
        self._max_kappa = max_kappa
        height_range = max(field.height_range for field in height_fields)
        self._nodes = nodes_for(max_kappa * height_range / 2, 0.01 * tolerance)
        total = np.zeros((self._nodes, *self.grid.shape))
        direct = np.zeros((len(_CHECKED_FRACTIONS), *self.grid.shape))
        for number, field in enumerate(height_fields, 1):
            heights = field.centred.astype(np.float32)
            for j, kappa in enumerate((1 + chebyshev_nodes(self._nodes)) / 2 * max_kappa):
                total[j] += self.grid.take(_powers_float32(heights, kappa))
            one = TilePowers(field, max_frequency, lobe_radius)
            for j, fraction in enumerate(_CHECKED_FRACTIONS):
                direct[j] += one(fraction * max_kappa)
            progress(number, len(height_fields))
        flat = total.reshape(self._nodes, -1) / len(height_fields)
        self._coefficients = chebyshev_transform(self._nodes) @ flat
        self.own_error = max(
            float(np.abs(self(fraction * max_kappa) - powers / len(height_fields)).sum())
            for fraction, powers in zip(_CHECKED_FRACTIONS, direct, strict=True)
        )

    def __call__(self, kappa: float) -> NDArray[np.float64]:
        """Compute the mean of η_m(κ), (rows, columns); κ in rad/µm."""
        values = chebyshev_polynomials(position(np.array([kappa]), self._max_kappa), self._nodes)
        return (values @ self._coefficients).reshape(self.grid.shape)


def _powers_float32(heights: NDArray[np.float32], kappa: float) -> NDArray[np.float32]:
    """Compute η_m(κ) of all orders in single precision, (N_y, N_x), as in `scipy.fft.fftfreq`."""
    phase = np.float32(kappa) * heights
    wave = np.empty(heights.shape, np.complex64)
    wave.real, wave.imag = np.cos(phase), np.sin(phase)
    transform = scipy.fft.fft2(wave, norm="forward", overwrite_x=True)
    return transform.real**2 + transform.imag**2


class TileSplines:
    """The B-spline coefficients c_m(κ) of S(q; κ) of a tile whose overlapping lobes make S smooth.

    S is separable in each order, and so is its least-squares projection on the splines: c = A_y η A_xᵀ, where a column
    of A projects the lobe of one order.

    Attributes:
        grid: all nodes whose splines overlap the frequencies that light reaches.
    """

    # Additional nodes outside the grid, so that power outside is not projected on its outermost nodes.
    _MARGIN = 12

    def __init__(self, powers: TilePowers, lobe_width: float, spacing: float, max_frequency: float) -> None:
        """Take η_m(κ), σ_q, and the largest spacing and frequency of the nodes, all in cycles/µm."""
        self._powers, self._sigma, self._spacing = powers, lobe_width, spacing
        self._orders = powers.grid.frequencies()
        # S is negligible further than six σ_q from the last order.
        self._max_q = tuple(min(max_frequency, q[-1] + 6 * lobe_width) for q in self._orders)
        max_order = tuple(int(np.rint(end / spacing)) + 1 for end in self._max_q)
        self.grid = SplineGrid((spacing, spacing), max_order, (np.inf, np.inf))
        self._random = np.random.default_rng(0)

    @cached_property
    def _projection(self) -> list[NDArray[np.float64]]:
        """A_x and A_y, computed when coefficients are first requested."""
        return [self._projected(m, q) for m, q in zip(self.grid.max_order, self._orders, strict=True)]

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

    def _lobes(self, positions: NDArray[np.float64], orders: NDArray[np.float64]) -> NDArray[np.float64]:
        """Compute Δ N(q − m/T; σ_q²) at q = Δ · `positions`, (positions, orders)."""
        offset = (positions[:, None] * self._spacing - orders) / self._sigma
        return self._spacing / (np.sqrt(2 * np.pi) * self._sigma) * np.exp(-(offset**2) / 2)

    def __call__(self, kappa: float) -> NDArray[np.float64]:
        """Compute c_m(κ), (rows, columns), with Σ c = 1 over all frequencies; κ in rad/µm."""
        along_x, along_y = self._projection
        return along_y @ self._powers(kappa) @ along_x.T

    def reached(self, powers: NDArray[np.float64]) -> float:
        """Return the fraction of the power at frequencies that light reaches, from c_m of the grid."""
        return self.grid.within(powers, self._max_q)

    def error(self, kept: OrderGrid | SplineGrid, powers: NDArray[np.float32], kappa: float) -> float:
        """Return ∫|S_approx − S_exact| dq over the frequencies that light reaches; arguments of `TilePowers.error`."""
        shift = self._random.uniform(-0.5, 0.5, 2)
        along_x, along_y = (
            self._lobes(np.arange(-max_order, max_order + 1) + s, orders)
            for max_order, s, orders in zip(self.grid.max_order, shift, self._orders, strict=True)
        )
        exact = along_y @ self._powers(kappa) @ along_x.T
        return self.grid.error(kept, powers, exact, shift, self._max_q) + self._powers.own_error
