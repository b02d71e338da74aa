"""S(q; κ) of a tile at run time: the few orders near q, each with the Gaussian lobe of the coherence length."""

from __future__ import annotations

import functools

import drjit as dr
import mitsuba as mi
import numpy as np

from ..spectrum import GratingSpectrum
from ..spectrum.orders import LobeAxis
from .arithmetic import larger, limited
from .cell_sampler import CellSampler
from .geometry import Geometry, cos_square, k_g
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
        self.columns, self.line = grid.shape[1], line
        self.per_width = opaque(1 / sigma)

    def meets(self, q_x: mi.Float, q_y: mi.Float) -> mi.Bool:
        """Whether q lies in the lobe of an order, where they stand apart; q in cycles/µm."""
        along_x, along_y = self.axes
        return along_x.holds(along_x.first(q_x), q_x) & along_y.holds(along_y.first(q_y), q_y)

    def evaluate(
        self,
        geometry: Geometry,
        height_scale: mi.Float,
        shadowing: bool,
        incidence: Incidence,
        active: mi.Bool,
        drawn: bool,
    ) -> tuple[mi.Float, mi.Float]:
        """K G S(q; κ) cos θ_o and the density of q, both in µm², for one wavelength.

        K and G are those of each order, and its lobe keeps its power at the horizon (`Geometry.gain`).

        Args:
            geometry: of the pair of directions.
            height_scale: times the heights.
            shadowing: whether G is a factor.
            incidence: the wavelength and where it comes from.
            active: mask.
            drawn: whether the direction is a sample, so that an order meets it.
        """
        if self.apart:
            power, density = self._apart(geometry, height_scale, shadowing, incidence, active, drawn)
        else:
            q, kappa = geometry.tangent * incidence.frequency, geometry.kappa(incidence.frequency, height_scale)
            m_x, m_y = (axis.first(q) for axis, q in zip(self.axes, q, strict=True))
            lobes_x, lobes_y = self.axes[0].lobes(m_x, q.x), self.axes[1].lobes(m_y, q.y)
            factor = 1
            if self.line:
                lobes_x, lobes_y = self._weighted(m_x, m_y, lobes_x, lobes_y, geometry, shadowing, incidence)
            else:
                factor = of_continuum(geometry, shadowing, incidence, self.per_width)
            power = factor * self._power(m_x, m_y, lobes_x, lobes_y, kappa, active)
            density = self.cells.density(q.x, q.y, incidence, active)
        # Interpolation may dip below zero by its error.
        return dr.select(active, larger(power, 0), 0), density

    def _weighted(
        self,
        m_x: mi.Int32,
        m_y: mi.Int32,
        lobes_x: list[mi.Float],
        lobes_y: list[mi.Float],
        geometry: Geometry,
        shadowing: bool,
        incidence: Incidence,
    ) -> tuple[list[mi.Float], list[mi.Float]]:
        """The lobes of the orders of a line grating from (m_x, m_y) on, times K G cos θ_o and gain of each order."""

        def factor(x: int, y: int) -> mi.Float:
            return self._factor(m_x + x, m_y + y, geometry, shadowing, incidence)

        if len(lobes_x) > 1:
            return [lobe * factor(step, 0) for step, lobe in enumerate(lobes_x)], lobes_y
        return lobes_x, [lobe * factor(0, step) for step, lobe in enumerate(lobes_y)]

    def _factor(
        self, m_x: mi.Int32, m_y: mi.Int32, geometry: Geometry, shadowing: bool, incidence: Incidence
    ) -> mi.Float:
        """K G cos θ_o of an order, times the gain of its lobe."""
        tangent = self._tangent(m_x, m_y, incidence)
        cos_i, cos_o, gain = geometry.of_order(tangent, incidence.frequency * self.per_width)
        square = dr.squared_norm(tangent) / dr.square(geometry.index)
        return k_g(cos_i, cos_o, square, shadowing) * gain * geometry.cos_o

    def _tangent(self, m_x: mi.Int32, m_y: mi.Int32, incidence: Incidence) -> mi.Vector2f:
        """λq of an order."""
        pitches = (axis.pitch for axis in self.axes)
        return mi.Vector2f(*(mi.Float(m) * p for m, p in zip((m_x, m_y), pitches, strict=True))) / incidence.frequency

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
        geometry: Geometry,
        height_scale: mi.Float,
        shadowing: bool,
        incidence: Incidence,
        active: mi.Bool,
        drawn: bool,
    ) -> tuple[mi.Float, mi.Float]:
        """`evaluate` of the one order that may hold at q.

        Most directions lie between the orders of a grating: unless drawn, they jump over all that reads tables.
        """
        q = geometry.tangent * incidence.frequency
        near = active & self.meets(q.x, q.y)
        power, density, needed = mi.Float(0.0), mi.Float(0.0), drawn or near
        # What has no derivative is bound here: Dr.Jit carries all other state through the branch.
        read = functools.partial(self._read, shadowing, incidence, near)
        if needed:
            power, density = read(geometry, height_scale)
        return power, density

    def _read(
        self, shadowing: bool, incidence: Incidence, near: mi.Bool, geometry: Geometry, height_scale: mi.Float
    ) -> tuple[mi.Float, mi.Float]:
        """As `_apart`, where `near`; else zero."""
        q = geometry.tangent * incidence.frequency
        m_x, m_y = (axis.first(q) for axis, q in zip(self.axes, q, strict=True))
        lobes_x, lobes_y = self.axes[0].lobes(m_x, q.x), self.axes[1].lobes(m_y, q.y)
        power = self._power(m_x, m_y, lobes_x, lobes_y, geometry.kappa(incidence.frequency, height_scale), near)
        power *= self._factor(m_x, m_y, geometry, shadowing, incidence)
        order = mi.UInt32((m_y + self.axes[1].largest) * self.columns + m_x + self.axes[0].largest)
        share = self.orders.share(order, self.orders.weights(incidence, near), near)
        # An order that does not propagate is not drawn.
        there = cos_square(geometry.wi, self._tangent(m_x, m_y, incidence)) > 0
        return power, dr.select(there, share * lobes_x[0] * lobes_y[0], 0)

    def sample(
        self,
        incidence: Incidence,
        u: mi.Float,
        v: mi.Point2f,
        active: mi.Bool,
    ) -> tuple[mi.Point2f, mi.Bool]:
        """Draw q in cycles/µm, for one wavelength, and tell whether the order of q propagates."""
        if self.cells is not None:
            return self.cells.sample(incidence, u, v, active), active
        row, column, v = self.orders.sample(incidence, u, v, active)
        tangent = self._tangent(column - self.axes[0].largest, row - self.axes[1].largest, incidence)
        q = mi.Point2f(self.axes[0].place(column, v.x), self.axes[1].place(row, v.y))
        return q, cos_square(incidence.wi, tangent) > 0


def of_continuum(geometry: Geometry, shadowing: bool, incidence: Incidence, per_width: mi.Float) -> mi.Float:
    """K G cos θ_o and gain where orders overlap, so that no single one is known.

    At grazing incidence the mirror order has nearly all of the power, and K grows without bound within its lobe. From
    cos θ = 0.2 down, and up to 4 σ_q from q = 0, S is taken for that of the mirror order, K G for one; from cos θ = 0.4
    up, and from 5 σ_q on, K and G are those at q, and what lobes lose below the horizon they get from those beyond.
    """
    per_width = incidence.frequency * per_width
    mirror = limited((25 - dr.squared_norm(geometry.tangent) * dr.square(per_width)) / 9, 0, 1)
    mirror *= limited(2 - 5 * larger(geometry.wi.z, geometry.wo.z), 0, 1)
    *_, gain = geometry.of_order(mi.Vector2f(0), per_width)
    return dr.lerp(geometry.k_g(shadowing), gain, mirror) * geometry.cos_o


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
