"""S(q; κ) of a tile at run time: the orders near q, their powers and lobes, and samples of q."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import cast

import drjit as dr
import mitsuba as mi
import numpy as np
import scipy.special

from ..energy.furnace import small_kappa
from ..precomputation.grating_spectrum import GratingSpectrum
from ..spectrum.grids import LobeAxis, OrderGrid
from ..spectrum.tables import HALF_SCALE, AmplitudeTable, SliceTable, shared_exponents
from .continuum_sampler import BinSampler
from .device_tables import PacketTable, SharedExponentTable, integer_part, larger, opaque
from .directions import Geometry, Incidence
from .inversion import truncated_gaussian
from .order_sampler import OrderSampler

# Nodes are stored in squares of 4 × 4, so that a window of nodes of one word lies in one to four cache lines.
_SQUARE_SIDE = 4

# Of x, between nodes of the Bessel functions of a series; cubics interpolate these with an error up to step⁴/384.
_MAX_BESSEL_STEP = 0.1


class _NodeTable:
    """Base class of table look-ups.

    Attributes:
        rows, columns: numbers of nodes, including the rim.
        square: number of nodes along the side of a square.
        nodes: number of nodes of all squares.
    """

    def __init__(self, shape: tuple[int, int], rim: tuple[int, int], windows: bool) -> None:
        """Compute the layout.

        Args:
            shape: rows and columns of the table.
            rim: number of nodes of zero on each side, (x, y).
            windows: whether several nodes are read at once.
        """
        self.rim, self.square = rim, _SQUARE_SIDE if windows else 1
        self.rows, self.columns = shape[0] + 2 * rim[1], shape[1] + 2 * rim[0]
        self.row = -(-self.columns // self.square) * self.square**2  # nodes of a row of squares
        self.nodes = -(-self.rows // self.square) * self.row

    def _arranged(self, packets: np.ndarray) -> np.ndarray:
        """Add the rim and arrange the nodes in squares: (..., rows, columns) → (..., nodes)."""
        square, (x, y) = self.square, self.rim
        pad = [(0, 0)] * (packets.ndim - 2) + [(y, y + -self.rows % square), (x, x + -self.columns % square)]
        padded = np.pad(packets, pad)
        rows, columns = (n // square for n in padded.shape[-2:])
        squares = padded.reshape(*packets.shape[:-2], rows, square, columns, square)
        return squares.swapaxes(-2, -3).reshape(*packets.shape[:-2], -1)

    def _offsets(self, first: mi.Int32, count: int, square_stride: int, node_stride: int) -> list[mi.UInt32]:
        """Return the index offsets of `count` rows or columns, from the strides of squares and of the nodes in one."""
        positions = [mi.UInt32(first + step) for step in range(count)]
        if self.square == 1:
            return [position * square_stride for position in positions]
        return [
            position // self.square * square_stride + position % self.square * node_stride for position in positions
        ]

    def _window(
        self, row: mi.Int32, column: mi.Int32, height: int, width: int
    ) -> tuple[list[mi.UInt32], list[mi.UInt32]]:
        """Return the index offsets of the rows and columns of a window that begins at (row, column)."""
        row = dr.clip(row, 0, self.rows - height)
        column = dr.clip(column, 0, self.columns - width)
        return self._offsets(row, height, self.row, self.square), self._offsets(column, width, self.square**2, 1)


class SlicePower(_NodeTable):
    """c_m(κ) = Σ_p a_p t^p, −1 ≤ t ≤ 1 on an interval of κ, from packets of one, two or four words."""

    def __init__(self, table: SliceTable, rim: tuple[int, int] = (0, 0), windows: bool = True) -> None:
        """Arrange a table; for `rim` and `windows` see `_NodeTable`."""
        super().__init__(table.shape, rim, windows)
        values = self._arranged(table.values)
        words = table.words_per_node
        scale = 1.0
        packets: SharedExponentTable | PacketTable
        if words == 1:
            mantissas, exponents = shared_exponents(values)
            packets = SharedExponentTable(np.moveaxis(mantissas, 1, -1), exponents)
        elif words == 2:
            scale = HALF_SCALE
            packets = PacketTable((np.moveaxis(values, 1, -1) * np.float32(scale)).astype(np.float16))
        else:
            padded = np.pad(values, ((0, 0), (0, 4 - table.terms), (0, 0)))
            packets = PacketTable(np.moveaxis(padded, 1, -1))
        self.table, self.unit = packets, packets.unit / scale
        self.packet = mi.Vector3f if words == 1 else mi.Vector4f
        self.intervals = table.intervals
        self.per_kappa = opaque(table.intervals / table.max_kappa)

    def window(
        self,
        row: mi.Int32,
        column: mi.Int32,
        weights_x: Sequence[mi.Float],
        weights_y: Sequence[mi.Float],
        at: tuple[mi.UInt32, mi.Vector3f | mi.Vector4f],
        active: mi.Bool,
    ) -> mi.Float:
        """Return Σ_ij w_x,i w_y,j c_ij over a window of nodes.

        Args:
            row, column: of the first node, including the rim; clipped to the table, whose rim is zero.
            weights_x, weights_y: w_x,i and w_y,j.
            at: returned by the method `at_kappa`.
            active: mask.
        """
        rows, columns = self._window(row, column, len(weights_y), len(weights_x))
        weights_x = [weight * self.unit for weight in weights_x]
        offset, factors = at
        packet = type(factors)(0.0)
        for weight, r in zip(weights_y, rows, strict=True):
            row_sum = type(factors)(0.0)
            for w, c in zip(weights_x, columns, strict=True):
                row_sum = self.table.add(row_sum, w, offset + r + c, active)
            packet = dr.fma(weight, row_sum, packet)
        return dr.dot(packet, factors)

    def at_kappa(self, kappa: mi.Float, small: tuple[mi.Float, mi.Bool]) -> tuple[mi.UInt32, mi.Vector3f | mi.Vector4f]:
        """Return the index of node 0 at κ (rad/µm), and the factors of the components of a packet.

        `small` is from `Geometry.small`; κ₁ is at most half of the first interval.
        """
        x = kappa * self.per_kappa
        interval = dr.minimum(integer_part(x), self.intervals - 1)
        factors = self._factors(2 * (x - mi.Float(mi.Int32(interval))) - 1)
        kappa_1, where = small
        first, second = (self._factors(2 * n * kappa_1 * self.per_kappa - 1) for n in (1, 2))
        return interval * self.nodes, small_kappa(kappa, kappa_1, factors, first, second, where, dr.select)

    def _factors(self, t: mi.Float) -> mi.Vector3f | mi.Vector4f:
        """Return the powers of t."""
        return self.packet([1, t, dr.square(t), dr.square(t) * t][: len(self.packet(0))])


class AmplitudePower(_NodeTable):
    """η_m(κ) = |Σ_n c_n(κL) F_nm|² of `AmplitudeTable`, by a loop over n with two terms in a packet.

    Apart from their phases iⁿ, the c_n follow from a recurrence (taylor) or from cubics in κL (chebyshev).
    """

    def __init__(self, table: AmplitudeTable, rim: tuple[int, int] = (0, 0), windows: bool = True) -> None:
        """Arrange a table; for `rim` and `windows` see `_NodeTable`."""
        super().__init__(table.shape, rim, windows)
        count = len(table.terms)
        pairs = -(-count // 2)
        # Series of all lengths have the same kernel.
        self.pairs = dr.opaque(mi.UInt32, pairs)
        terms = np.zeros((2 * pairs, 2, *table.shape), np.float32)
        terms[:count, 0], terms[:count, 1] = table.terms.real, table.terms.imag
        packets = self._arranged(terms.reshape(pairs, 4, *table.shape))
        self.table = PacketTable(np.moveaxis(packets, 1, -1))
        self.height, self.factors = opaque(table.height), None
        if table.representation == "chebyshev":
            max_x, n = table.max_kappa * table.height, np.arange(2 * pairs)
            self.steps = 1 + int(max_x / _MAX_BESSEL_STEP)
            x = np.linspace(0, max_x, self.steps + 1)[:, None]
            self.per_x = opaque(self.steps / max(max_x, 1e-30))
            values = [function(n, x).reshape(-1, pairs, 2) for function in (scipy.special.jv, scipy.special.jvp)]
            packets = np.concatenate([values[0], values[1] * max_x / self.steps], axis=-1)
            packets[:, 1:] *= 2
            packets[:, 0, 1::2] *= 2
            self.factors = PacketTable(packets)

    def at_kappa(self, kappa: mi.Float, small: tuple[mi.Float, mi.Bool]) -> tuple[mi.Float, mi.Float]:
        """Return κ, and the factor of the power: κ₁²/κ² where `small` applies and κ < κ₁; a series is exact there."""
        kappa_1, where = small
        where = where & (kappa < kappa_1)
        # Below κ₁/100 the ratio of the power to κ² is constant.
        kappa = dr.select(where, larger(kappa, 0.01 * kappa_1), kappa)
        return kappa, dr.select(where, dr.square(kappa_1 / larger(kappa, 1e-30)), 1)

    def window(
        self,
        row: mi.Int32,
        column: mi.Int32,
        weights_x: Sequence[mi.Float],
        weights_y: Sequence[mi.Float],
        at: tuple[mi.Float, mi.Float],
        active: mi.Bool,
    ) -> mi.Float:
        """Return Σ_ij w_x,i w_y,j η_ij over a window of orders; for arguments see `SlicePower.window`."""
        rows, columns = self._window(row, column, len(weights_y), len(weights_x))
        kappa, factor = at
        weights = [y * x for y in weights_y for x in weights_x]
        amplitudes = self._amplitudes([r + c for r in rows for c in columns], kappa * self.height, active)
        powers = [re * re + im * im for re, im in amplitudes]
        return factor * sum(weight * power for weight, power in zip(weights, powers, strict=True))

    def _amplitudes(self, nodes: list[mi.UInt32], x: mi.Float, active: mi.Bool) -> list[tuple[mi.Float, mi.Float]]:
        """Return real and imaginary parts of F_m; the same loop sums their derivatives by x if needed."""
        differentiate = dr.grad_enabled(x)
        at = dr.detach(x)
        if self.factors is not None:
            coordinate = at * self.per_x
            step = dr.minimum(integer_part(coordinate), self.steps - 1)
            coordinate -= mi.Float(mi.Int32(step))

        def body(
            pair: mi.UInt32, sign: mi.Float, term: mi.Float, before: mi.Float, *sums: mi.Float
        ) -> tuple[mi.UInt32 | mi.Float, ...]:
            if self.factors is None:
                # The derivative of xⁿ/n! is the previous term.
                n = mi.Float(2 * pair)
                odd = term * at / (n + 1)
                factors = [(term, odd), (before, term)]
                term, before = odd * at / (n + 2), odd
            else:
                low, high = (self.factors((step + k) * self.pairs + pair, active) for k in (0, 1))
                both = [_hermite(low[k], high[k], low[k + 2], high[k + 2], coordinate) for k in (0, 1)]
                (even, even_slope), (odd, odd_slope) = both
                factors = [(even, odd), (even_slope * self.per_x, odd_slope * self.per_x)]
            parts: list[mi.Float] = []
            for node in nodes:
                f = sign * self.table(pair * self.nodes + node, active)
                for even, odd in factors[: 1 + differentiate]:
                    # Odd terms have the additional phase i.
                    parts.append(dr.fma(even, f[0], dr.fma(-odd, f[3], sums[len(parts)])))
                    parts.append(dr.fma(even, f[1], dr.fma(odd, f[2], sums[len(parts)])))
            return pair + 1, -sign, term, before, *parts

        count = len(nodes) * (4 if differentiate else 2)
        start = mi.UInt32(0), mi.Float(1), mi.Float(1), mi.Float(0), *(mi.Float(0) for _ in range(count))
        sums = dr.while_loop(start, lambda pair, *_: pair < self.pairs, body)[4:]
        if not differentiate:
            return list(zip(sums[::2], sums[1::2], strict=True))
        parts = zip(sums[::4], sums[1::4], sums[2::4], sums[3::4], strict=True)
        return [(dr.replace_grad(re, by_re * x), dr.replace_grad(im, by_im * x)) for re, im, by_re, by_im in parts]


def _hermite(
    low: mi.Float, high: mi.Float, low_slope: mi.Float, high_slope: mi.Float, t: mi.Float
) -> tuple[mi.Float, mi.Float]:
    """Return the cubic through values and slopes at 0 and 1, and its derivative, at t."""
    rise = high - low
    square, cube = 3 * rise - 2 * low_slope - high_slope, low_slope + high_slope - 2 * rise
    return low + t * (low_slope + t * (square + t * cube)), low_slope + t * (2 * square + t * 3 * cube)


# cycles/µm: for line gratings with wider lobes, which the horizon truncates, q is drawn instead of an order.
MAX_DRAWN_LOBE_WIDTH = 0.03


class ScalarOrders:
    """S(q; κ) = Σ_m η_m(κ) N(q − m/T; σ_q² I), and the density from which q is drawn.

    N is truncated as in `OrderGrid.lobes`. If orders are resolved, at most one of them contributes at q, and lobes may
    be scaled; for a tile as large as the coherence length, 4 × 4 orders contribute.

    For resolved orders the density is Σ_m P_m N(q − m/T), with P_m of an `OrderSampler`, which depends on the media and
    scales of a scene. For overlapping orders, and for line gratings with wide lobes, it is the density of `BinSampler`.

    Attributes:
        axes: the orders along x and y.
        is_line: whether there is one order along x or y.
        resolved: whether at most one order contributes at q, and an order is drawn instead of q.
        power: η_m(κ).
        per_width: 1/σ_q.
        sampler: of overlapping orders; resolved ones have it from `drawn_by`.
    """

    sampler: OrderSampler | BinSampler

    def __init__(self, spectrum: GratingSpectrum, typical_max_kappa: float | None) -> None:
        """Arrange the tables; for `typical_max_kappa` see `KappaBins`."""
        grid, sigma = cast(OrderGrid, spectrum.grid), spectrum.lobe_width
        self.axes = tuple(
            _Axis(lobe, size, max_order, sigma)
            for lobe, size, max_order in zip(spectrum.lobes, grid.tile_size, grid.max_order, strict=True)
        )
        self.is_line = 1 in grid.shape
        is_wide = self.is_line and sigma > MAX_DRAWN_LOBE_WIDTH
        self.resolved = all(axis.count == 1 for axis in self.axes) and not is_wide
        if not self.resolved:
            self.sampler = BinSampler(spectrum, typical_max_kappa)
        self.power: AmplitudePower | SlicePower
        rim, windows = (self.axes[0].rim, self.axes[1].rim), not self.resolved
        if isinstance(spectrum.table, AmplitudeTable):
            self.power = AmplitudePower(spectrum.table, rim, windows=windows)
        else:
            self.power = SlicePower(spectrum.table, rim, windows=windows)
        self.per_width = opaque(1 / sigma)

    @property
    def max_scale(self) -> float:
        """The maximum lateral scale for which resolved orders stay so."""
        return min((axis.max_scale for axis in self.axes if axis.max_order), default=np.inf)

    def drawn_by(self, sampler: OrderSampler) -> ScalarOrders:
        """Return resolved orders with the sampler of a scene, which share the tables."""
        result = copy.copy(self)
        result.sampler = sampler
        return result

    def meets(self, q_x: mi.Float, q_y: mi.Float, scale: mi.Float | float) -> mi.Bool:
        """As `Scattering.meets`."""
        if not self.resolved:
            return mi.Bool(True)
        along_x, along_y = self.axes
        return along_x.contains(along_x.first(q_x), q_x, scale) & along_y.contains(along_y.first(q_y), q_y, scale)

    def power_and_density(self, geometry: Geometry, incidence: Incidence, active: mi.Bool) -> tuple[mi.Float, mi.Float]:
        """As `Scattering.power_and_density`.

        For resolved orders, and for all orders of line gratings, K and G are computed per order, with the gain of its
        lobe (`Geometry.order_factor`). For other tiles they are computed once, from the two directions
        (`Geometry.continuum_factor`).
        """
        scale = incidence.lobe_scale
        q = geometry.tangent * incidence.frequency
        per_width = incidence.frequency / scale * self.per_width
        m_x, m_y = (axis.first(q) for axis, q in zip(self.axes, q, strict=True))
        lobes_x, lobes_y = self.axes[0].lobes(m_x, q.x, scale), self.axes[1].lobes(m_y, q.y, scale)
        q_sign, factor = incidence.q_sign, 1
        # Each window of orders is read at one κ: offsets of its column and row, lobes along x and y, κ, and whether
        # it is read at −m.
        if isinstance(self.sampler, OrderSampler):
            tangent = self._tangent(m_x, m_y, incidence.wavelength)
            factor = geometry.order_factor(tangent, incidence, per_width)
            windows = [(0, 0, lobes_x, lobes_y, *geometry.order_kappa(tangent, incidence))]
            sign = mi.Int32(q_sign)
            probability = self.sampler.probability(sign * m_x, sign * m_y, incidence, active)
            # Evanescent orders are not drawn.
            propagates = incidence.propagates(q_sign * tangent)
            density = dr.select(propagates, probability * lobes_x[0] * lobes_y[0], 0)
        else:
            density = self.sampler.density(q_sign * q, incidence, active)
            if self.is_line:
                windows = []
                for x, y in np.ndindex(len(lobes_x), len(lobes_y)):
                    tangent = self._tangent(m_x + x, m_y + y, incidence.wavelength)
                    lobe = geometry.order_factor(tangent, incidence, per_width) * lobes_x[x]
                    windows.append((x, y, [lobe], [lobes_y[y]], *geometry.order_kappa(tangent, incidence)))
            else:
                factor = geometry.continuum_factor(incidence, per_width)
                windows = [(0, 0, lobes_x, lobes_y, geometry.kappa(incidence.frequency), mi.Bool(False))]
        power = 0
        for x, y, of_x, of_y, kappa, negated in windows:
            at = self.power.at_kappa(kappa, geometry.small())
            column, row = (
                axis.max_order + axis.rim + dr.select(negated, -m, m)
                for axis, m in zip(self.axes, (m_x + x, m_y + y), strict=True)
            )
            power += factor * self.power.window(row, column, of_x, of_y, at, active)
        # Interpolated powers may be slightly negative.
        return dr.select(active, larger(power, 0), 0), density

    def _tangent(self, m_x: mi.Int32, m_y: mi.Int32, wavelength: mi.Float) -> mi.Vector2f:
        """Return λq of an order."""
        along_x, along_y = self.axes
        return mi.Vector2f(mi.Float(m_x) * along_x.pitch, mi.Float(m_y) * along_y.pitch) * wavelength

    def sample(self, incidence: Incidence, u: mi.Float, v: mi.Point2f, active: mi.Bool) -> tuple[mi.Point2f, mi.Bool]:
        """As `Scattering.sample`."""
        if isinstance(self.sampler, BinSampler):
            return self.sampler.sample(incidence, u, v, active)
        m_x, m_y = self.sampler.sample(incidence, u, active)
        tangent = self._tangent(m_x, m_y, incidence.wavelength)
        scale = incidence.lobe_scale
        q = mi.Point2f(self.axes[0].quantile(m_x, v.x, scale), self.axes[1].quantile(m_y, v.y, scale))
        return q, incidence.propagates(tangent)


class _Axis:
    """The orders along one axis, and the factor of their lobes."""

    def __init__(self, lobe: LobeAxis, size: float, max_order: int, sigma: float) -> None:
        self.count, self.max_order = lobe.count, max_order
        self.reads_all = np.isinf(lobe.half_width)
        # A window outside of the grid reads zeros only.
        self.rim = 0 if self.reads_all else self.count
        self.size, self.pitch = opaque(size), opaque(1 / size)
        self.half_width = opaque(min(lobe.half_width, 1e30))
        self.max_scale = (1 + 1e-6) / (2 * lobe.half_width * size)
        self.falloff = opaque(-0.5 / sigma**2)
        self.inside, self.spread = opaque(lobe.inside), opaque(np.sqrt(2) * sigma)
        self.peak = opaque(1 / (np.sqrt(2 * np.pi) * sigma * lobe.inside))
        self.slope = opaque(1 / (size * sigma**2))
        self.steps = [
            opaque(np.exp(-0.5 * (k / (size * sigma)) ** 2)) for k in range(1, 0 if self.reads_all else self.count)
        ]

    def first(self, q: mi.Float) -> mi.Int32:
        """Return the first of the `count` orders that contribute at q (cycles/µm)."""
        return mi.Int32(-self.max_order) if self.reads_all else mi.Int32(dr.ceil(q * self.size - 0.5 * self.count))

    def contains(self, m: mi.Int32, q: mi.Float, scale: mi.Float | float) -> mi.Bool:
        """Return whether the order m exists and q lies in its lobe, scaled by `scale`."""
        offset = dr.fma(-self.pitch, mi.Float(m), q)
        return (dr.abs(m) <= self.max_order) & (dr.abs(offset) <= self.half_width * scale)

    def lobes(self, first: mi.Int32, q: mi.Float, scale: mi.Float | float = 1.0) -> list[mi.Float]:
        """Return N(q − m/T; s² σ_q²) of the `count` orders from `first` on, µm; zero outside of the half width.

        s is the scale of lobes; it is one where several orders contribute.
        """
        offset = dr.fma(-self.pitch, mi.Float(first), q) / scale
        if self.reads_all:
            offsets = [dr.fma(-self.pitch, step, offset) for step in range(self.count)]
            return [self.peak * dr.exp(self.falloff * dr.square(offset)) for offset in offsets]
        lobe = self.peak / scale * dr.exp(self.falloff * dr.square(offset))
        if self.count == 1:
            return [dr.select(dr.abs(offset) <= self.half_width, lobe, 0)]
        # exp(−(x − k/T)²/2σ²) = exp(−x²/2σ²) exp(x/Tσ²)^k exp(−k²/2T²σ²): one exponential for all orders.
        ratio, lobes = dr.exp(self.slope * offset), [lobe]
        for step in self.steps:
            lobe = lobe * ratio
            lobes.append(lobe * step)
        return lobes

    def quantile(self, m: mi.Int32, u: mi.Float, scale: mi.Float | float) -> mi.Float:
        """Return the quantile `u` of the lobe of order m, scaled by `scale`: q in cycles/µm."""
        return dr.fma(self.pitch, mi.Float(m), scale * truncated_gaussian(u, self.inside, self.spread))
