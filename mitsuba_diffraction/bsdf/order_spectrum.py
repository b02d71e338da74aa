"""S(q; κ) of a tile at run time: the few orders near q, each with the Gaussian lobe of the coherence length."""

from __future__ import annotations

import functools

import drjit as dr
import mitsuba as mi
import numpy as np

from ..spectrum import GratingSpectrum
from ..spectrum.orders import LobeAxis
from .arithmetic import larger
from .cell_sampler import CellSampler
from .incidence import Incidence
from .inversion import truncated_gaussian
from .line_sampler import LineSampler
from .order_power import order_power
from .order_sampler import OrderSampler
from .tables import opaque

# cycles/µm: of a line grating with wider lobes, which the horizon cuts through, q is drawn instead of an order.
NARROW = 0.03


class OrderSpectrum:
    """S(q; κ) = Σ_m η_m(κ) N(q − m/T; σ_q² I), and the density from which q is drawn.

    N ends as `OrderGrid.lobes` says. Orders that stand apart need one of them, so that one evaluation reads
    `order_power` once; a tile as large as the coherence length needs 4 × 4. The density is Σ_m P_m N(q − m/T) with the
    P_m of `OrderSampler`; where orders overlap, that of `CellSampler`. For a line grating whose orders overlap or are
    wide, it is that of `LineSampler`.
    """

    def __init__(self, spectrum: GratingSpectrum) -> None:
        grid, sigma = spectrum.grid, spectrum.lobe_width
        self.axes = tuple(
            _Axis(lobe, size, largest, sigma)
            for lobe, size, largest in zip(spectrum.lobes, grid.tile_size, grid.largest, strict=True)
        )
        line = 1 in grid.shape
        self.apart = all(axis.count == 1 for axis in self.axes) and not (line and sigma > NARROW)
        self.power = order_power(spectrum.table, tuple(axis.rim for axis in self.axes), windows=not self.apart)
        self.cells = None
        if not self.apart:
            self.cells = LineSampler(spectrum) if line else CellSampler(spectrum)
        self.orders = OrderSampler(spectrum) if self.apart else None
        self.columns = grid.shape[1]

    def meets(self, q_x: mi.Float, q_y: mi.Float) -> mi.Bool:
        """Whether q lies in the lobe of an order, where they stand apart; q in cycles/µm."""
        along_x, along_y = self.axes
        return along_x.holds(along_x.first(q_x), q_x) & along_y.holds(along_y.first(q_y), q_y)

    def evaluate(
        self,
        q_x: mi.Float,
        q_y: mi.Float,
        kappa: mi.Float,
        incidence: Incidence,
        active: mi.Bool,
        drawn: bool,
    ) -> tuple[mi.Float, mi.Float]:
        """S(q; κ) and the density of q, both in µm², for one wavelength.

        Args:
            q_x: cycles/µm.
            q_y: cycles/µm.
            kappa: rad/µm.
            incidence: the wavelength and where it comes from.
            active: mask.
            drawn: whether the direction is a sample, so that an order meets it.
        """
        along_x, along_y = self.axes
        m_x, m_y = along_x.first(q_x), along_y.first(q_y)
        if self.apart:
            power, density = self._apart(m_x, m_y, q_x, q_y, kappa, incidence, active, drawn)
        else:
            power = self._power(m_x, m_y, along_x.lobes(m_x, q_x), along_y.lobes(m_y, q_y), kappa, active)
            density = self.cells.density(q_x, q_y, incidence, active)
        # Interpolation may dip below zero by its error.
        return dr.select(active, larger(power, 0), 0), density

    def _power(
        self,
        m_x: mi.Int32,
        m_y: mi.Int32,
        lobes_x: list[mi.Float],
        lobes_y: list[mi.Float],
        kappa: mi.Float,
        active: mi.Bool,
    ) -> mi.Float:
        """Σ_m η_m(κ) N(q − m/T; σ_q² I) over the orders from (m_x, m_y) on."""
        at = self.power.at(kappa, active)
        row, column = (m + (axis.largest + axis.rim) for m, axis in zip((m_y, m_x), self.axes[::-1], strict=True))
        return self.power.window(row, column, lobes_x, lobes_y, at, active)

    @dr.syntax
    def _apart(
        self,
        m_x: mi.Int32,
        m_y: mi.Int32,
        q_x: mi.Float,
        q_y: mi.Float,
        kappa: mi.Float,
        incidence: Incidence,
        active: mi.Bool,
        drawn: bool,
    ) -> tuple[mi.Float, mi.Float]:
        """`_power` of the one order that may hold at q, and the density.

        Most directions lie between the orders of a grating: unless drawn, they jump over all that reads tables.
        """
        near = active & self.meets(q_x, q_y)
        power, density, needed = mi.Float(0.0), mi.Float(0.0), drawn or near
        # What has no derivative is bound here: Dr.Jit carries all other state through the branch.
        read = functools.partial(self._read, m_x, m_y, incidence, near)
        if needed:
            power, density = read(q_x, q_y, kappa)
        return power, density

    def _read(
        self,
        m_x: mi.Int32,
        m_y: mi.Int32,
        incidence: Incidence,
        near: mi.Bool,
        q_x: mi.Float,
        q_y: mi.Float,
        kappa: mi.Float,
    ) -> tuple[mi.Float, mi.Float]:
        """As `_apart`, where `near`; else zero."""
        lobes_x, lobes_y = self.axes[0].lobes(m_x, q_x), self.axes[1].lobes(m_y, q_y)
        power = self._power(m_x, m_y, lobes_x, lobes_y, kappa, near)
        order = mi.UInt32((m_y + self.axes[1].largest) * self.columns + m_x + self.axes[0].largest)
        share = self.orders.share(order, self.orders.weights(incidence, near), near)
        return power, share * lobes_x[0] * lobes_y[0]

    def sample(
        self,
        incidence: Incidence,
        u: mi.Float,
        v: mi.Point2f,
        active: mi.Bool,
    ) -> tuple[mi.Float, mi.Float]:
        """Draw q in cycles/µm, for one wavelength; `incidence` as in `evaluate`."""
        if self.cells is not None:
            return self.cells.sample(incidence, u, v, active)
        row, column, v = self.orders.sample(incidence, u, v, active)
        return self.axes[0].place(column, v.x), self.axes[1].place(row, v.y)


class _Axis:
    """The orders along one axis, and the lobe's factor there."""

    def __init__(self, lobe: LobeAxis, size: float, largest: int, sigma: float) -> None:
        self.count, self.largest = lobe.count, largest
        self.all = np.isinf(lobe.half_width)
        # A window that lies beyond the grid reads zeros only.
        self.rim = 0 if self.all else self.count
        self.size, self.pitch = opaque(size), opaque(1 / size)
        self.half_width = opaque(min(lobe.half_width, 1e30))
        self.falloff = opaque(-0.5 / sigma**2)
        self.inside, self.spread = opaque(lobe.inside), opaque(np.sqrt(2) * sigma)
        self.peak = opaque(1 / (np.sqrt(2 * np.pi) * sigma * lobe.inside))
        self.slope = opaque(1 / (size * sigma**2))
        self.steps = [opaque(np.exp(-0.5 * (k / (size * sigma)) ** 2)) for k in range(1, 0 if self.all else self.count)]

    def first(self, q: mi.Float) -> mi.Int32:
        """The first of the `count` orders that contribute at q (cycles/µm)."""
        return mi.Int32(-self.largest) if self.all else mi.Int32(dr.ceil(q * self.size - 0.5 * self.count))

    def holds(self, m: mi.Int32, q: mi.Float) -> mi.Bool:
        """Whether there is an order m, and q lies in its lobe."""
        offset = dr.fma(-self.pitch, mi.Float(m), q)
        return (dr.abs(m) <= self.largest) & (dr.abs(offset) <= self.half_width)

    def lobes(self, first: mi.Int32, q: mi.Float) -> list[mi.Float]:
        """N(q − m/T; σ_q²) of each of these orders, µm; zero beyond the half width."""
        offset = dr.fma(-self.pitch, mi.Float(first), q)
        if self.all:
            offsets = [dr.fma(-self.pitch, step, offset) for step in range(self.count)]
            return [self.peak * dr.exp(self.falloff * dr.square(offset)) for offset in offsets]
        lobe = self.peak * dr.exp(self.falloff * dr.square(offset))
        if self.count == 1:
            return [dr.select(dr.abs(offset) <= self.half_width, lobe, 0)]
        # exp(−(x − k/T)²/2σ²) = exp(−x²/2σ²) exp(x/Tσ²)^k exp(−k²/2T²σ²): an exponential for all together.
        ratio, lobes = dr.exp(self.slope * offset), [lobe]
        for step in self.steps:
            lobe = lobe * ratio
            lobes.append(lobe * step)
        return lobes

    def place(self, node: mi.Int32, u: mi.Float) -> mi.Float:
        """The q in the lobe of the order at a row or column with the share `u` of it below, cycles/µm."""
        return dr.fma(self.pitch, mi.Float(node) - self.largest, truncated_gaussian(u, self.inside, self.spread))
