"""S(q; κ) of a tile at run time: the few orders near q, each with the Gaussian lobe of the coherence length."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import scipy.ndimage
import scipy.special

from ..spectrum import GratingSpectrum
from .cell_sampler import CellSampler
from .incidence import Incidence
from .kappa_cells import averages
from .order_power import order_power
from .order_sampler import OrderSampler
from .tables import opaque

OVERLAP = 4  # from so many neighbours along x and along y the lobes are drawn as cells


class LineSpectrum:
    """S(q; κ) = Σ_m η_m(κ) N(q − m/T; σ_q² I), and the density from which q is drawn.

    N is cut off at `reach` standard deviations. Orders that stand far apart need one of them, so that one evaluation
    reads `order_power` once; a tile as large as the coherence length needs 5 × 5. The density is Σ_m P_m N(q − m/T)
    with the P_m of `OrderSampler`, or, where many orders overlap, that of `CellSampler`, which reads one packet only.
    """

    def __init__(self, spectrum: GratingSpectrum) -> None:
        self.power = order_power(spectrum.table)
        self.count_x, self.count_y = spectrum.neighbours
        overlap = min(self.count_x, self.count_y) >= OVERLAP
        self.cells = _cells(spectrum) if overlap else None
        self.orders = None if overlap else OrderSampler(spectrum)
        self.largest_x, self.largest_y = spectrum.grid.largest
        self.columns = spectrum.grid.shape[1]
        sigma, reach = spectrum.lobe_width, spectrum.reach
        inside = -np.expm1(-(reach**2) / 2)  # the share of the Gaussian within its reach
        self.lobe_width, self.inside = opaque(sigma), opaque(inside)
        self.peak = opaque(1 / (2 * np.pi * sigma**2 * inside))
        self.falloff = opaque(-0.5 / sigma**2)
        self.radius, self.farthest = opaque(reach * sigma), opaque((reach * sigma) ** 2)
        self.tile_x, self.tile_y = (opaque(t) for t in spectrum.grid.tile_size)
        self.pitch_x, self.pitch_y = (opaque(1 / t) for t in spectrum.grid.tile_size)

    def evaluate(
        self,
        q_x: mi.Float,
        q_y: mi.Float,
        kappa: mi.Float,
        incidence: Incidence,
        active: mi.Bool,
    ) -> tuple[mi.Float, mi.Float]:
        """S(q; κ) and the density of q, both in µm², for one wavelength.

        Args:
            q_x: cycles/µm.
            q_y: cycles/µm.
            kappa: rad/µm.
            incidence: the wavelength and where it comes from.
            active: mask.
        """
        first_x = dr.maximum(mi.Int32(dr.ceil((q_x - self.radius) * self.tile_x)), -self.largest_x)
        first_y = dr.maximum(mi.Int32(dr.ceil((q_y - self.radius) * self.tile_y)), -self.largest_y)
        near = active & (first_x <= self.largest_x) & (self._square_x(first_x, q_x) <= self.farthest)
        near &= (first_y <= self.largest_y) & (self._square_y(first_y, q_y) <= self.farthest)
        power, density = self._where_near(first_x, first_y, q_x, q_y, kappa, incidence, near)
        if self.cells is not None:
            weights = self.cells.weights(incidence)
            density = self.cells.density(q_x, q_y, weights, active)
        # Interpolation may dip below zero by its error.
        return dr.maximum(power, 0), density

    def _square_x(self, m_x: mi.Int32, q_x: mi.Float) -> mi.Float:
        """(q_x − m_x/T_x)²."""
        return dr.square(dr.fma(-self.pitch_x, mi.Float(m_x), q_x))

    def _square_y(self, m_y: mi.Int32, q_y: mi.Float) -> mi.Float:
        """(q_y − m_y/T_y)²."""
        return dr.square(dr.fma(-self.pitch_y, mi.Float(m_y), q_y))

    @dr.syntax
    def _where_near(
        self,
        first_x: mi.Int32,
        first_y: mi.Int32,
        q_x: mi.Float,
        q_y: mi.Float,
        kappa: mi.Float,
        incidence: Incidence,
        active: mi.Bool,
    ) -> tuple[mi.Float, mi.Float]:
        """Σ_m η_m(κ) N(q − m/T; σ_q² I) over the neighbours, and the same with P_m.

        Most directions lie between the orders of a grating: they jump over all that reads tables.
        """
        power, density = mi.Float(0.0), mi.Float(0.0)
        if active:
            power, density = self._sum(first_x, first_y, q_x, q_y, kappa, incidence, active)
        return power, density

    @dr.syntax
    def _sum(
        self,
        first_x: mi.Int32,
        first_y: mi.Int32,
        q_x: mi.Float,
        q_y: mi.Float,
        kappa: mi.Float,
        incidence: Incidence,
        active: mi.Bool,
    ) -> tuple[mi.Float, mi.Float]:
        """The sums, row by row."""
        at = self.power.at(kappa, active)
        weights = mi.Vector4f(0.0) if self.orders is None else self.orders.weights(incidence, active)
        columns = [first_x + step for step in range(self.count_x)]
        squares = [self._square_x(m_x, q_x) for m_x in columns]
        # exp(−|q − m/T|²/2σ_q²) is a product: one factor for each column, one for each row.
        lobes = [dr.exp(self.falloff * square) for square in squares]
        if dr.hint(self.count_y == 1, mode="scalar"):
            power, density = self._row(first_y, columns, squares, lobes, q_y, at, weights, active)
        else:
            power, density = mi.Float(0.0), mi.Float(0.0)
            step = mi.Int32(0)
            # −1: the loop only adds up, so that gradients need nothing of its steps.
            while dr.hint(step < self.count_y, max_iterations=-1):
                more = self._row(first_y + step, columns, squares, lobes, q_y, at, weights, active)
                power += more[0]
                density += more[1]
                step += 1
        return power, density

    def _row(
        self,
        m_y: mi.Int32,
        columns: list[mi.Int32],
        squares: list[mi.Float],
        lobes: list[mi.Float],
        q_y: mi.Float,
        at: list[tuple[mi.UInt32, mi.Vector4f]],
        weights: mi.Vector4f,
        active: mi.Bool,
    ) -> tuple[mi.Float, mi.Float]:
        """The part of one row of orders.

        Args:
            m_y: the row.
            columns: m_x.
            squares: (q_x − m_x/T_x)² of the columns.
            lobes: exp(−(q_x − m_x/T_x)²/2σ_q²) of the columns.
            q_y: cycles/µm.
            at: of the method `at` of the powers.
            weights: of `OrderSampler.weights`.
            active: mask.
        """
        square_y = self._square_y(m_y, q_y)
        active = active & (dr.abs(m_y) <= self.largest_y)
        middle = (m_y + self.largest_y) * self.columns + self.largest_x
        power, density = mi.Float(0.0), mi.Float(0.0)
        for m_x, square, lobe in zip(columns, squares, lobes, strict=True):
            near = active & (dr.abs(m_x) <= self.largest_x) & (square + square_y <= self.farthest)
            order = mi.UInt32(dr.select(near, middle + m_x, 0))
            power += dr.select(near, lobe * self.power.of(order, at, near), 0)
            if self.orders is not None:
                density += dr.select(near, lobe * self.orders.share(order, weights, near), 0)
        factor = self.peak * dr.exp(self.falloff * square_y)
        return factor * power, factor * density

    def sample(
        self,
        incidence: Incidence,
        u: mi.Float,
        v: mi.Point2f,
        active: mi.Bool,
    ) -> tuple[mi.Float, mi.Float]:
        """Draw q in cycles/µm, for one wavelength; `incidence` as in `evaluate`."""
        if self.cells is not None:
            return self.cells.sample(self.cells.weights(incidence), u, v, active)
        row, column, v = self.orders.sample(incidence, u, v, active)
        radius = self.lobe_width * dr.sqrt(-2 * dr.log(1 - v.x * self.inside))
        sin, cos = dr.sincos(dr.two_pi * v.y)
        m_x, m_y = mi.Float(column) - self.largest_x, mi.Float(row) - self.largest_y
        return m_x / self.tile_x + radius * cos, m_y / self.tile_y + radius * sin


def _cells(spectrum: GratingSpectrum) -> CellSampler:
    """The sampler for orders that overlap: cells no wider than σ_q, a whole number of them from order to order."""
    shares, spacing = averages(spectrum), []
    for axis, tile in ((2, spectrum.grid.tile_size[0]), (1, spectrum.grid.tile_size[1])):
        per_order = int(np.ceil(1 / (tile * spectrum.lobe_width)))
        spacing.append(1 / (tile * per_order))
        shares = _lobes(shares, axis, per_order, spacing[-1] / spectrum.lobe_width, spectrum.reach)
    largest = (shares.shape[2] - 1) // 2, (shares.shape[1] - 1) // 2
    return CellSampler(shares, tuple(spacing), largest, spectrum.largest_kappa)


def _lobes(shares: np.ndarray, axis: int, per_order: int, width: float, reach: float) -> np.ndarray:
    """Spread the orders over cells along one axis: each cell gets the integral of the Gaussian lobes over it.

    Args:
        shares: (κ cells, rows, columns).
        axis: of `shares`.
        per_order: cells from one order to the next.
        width: of a cell, in standard deviations.
        reach: how far a lobe is followed, in standard deviations.
    """
    shares = np.moveaxis(shares, axis, -1)
    side = int(np.ceil(reach / width + 0.5))  # the cells on each side of an order that its lobe meets
    spread = np.zeros((*shares.shape[:-1], (shares.shape[-1] - 1) * per_order + 1 + 2 * side))
    spread[..., side : spread.shape[-1] - side : per_order] = shares
    ends = (np.arange(-side, side + 2) - 0.5) * width
    lobe = np.diff(scipy.special.ndtr(ends))
    return np.moveaxis(scipy.ndimage.convolve1d(spread, lobe, mode="constant"), -1, axis)
