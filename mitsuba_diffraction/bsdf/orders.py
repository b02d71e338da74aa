"""S(q; κ) of a tile at run time: the few orders near q, their powers and lobes, and how an order is drawn.

P_m = Σ_j w_j A_jm / Σ_j w_j M_j is a mixture over κ (`KappaCells`), restricted to the rectangle of orders around those
that propagate: light on other orders goes nowhere, and at grazing incidence most of the mixture would lie there. M_j is
the sum of A_jm over the rectangle. A one-row grating has the exact interval: with s the direction of incidence,

    |m_x/T_x + s_x/λ| ≤ √(1/λ² − s_y²/λ²)
"""

from __future__ import annotations

import functools
from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..grating_spectrum import GratingSpectrum
from ..spectrum.orders import LobeAxis
from ..spectrum.tables import HALF_SCALE, SeriesTable, SliceTable, shared_exponents
from .cell_sampler import LOBE, CellAxis, CellSampler
from .geometry import Geometry, Incidence, cos_square, k_g
from .inversion import CELLS, KappaCells, averages, choose, search, sums_before, truncated_gaussian
from .tables import HalfTable, PacketTable, SharedExponentTable, ShareTable, larger, limited, opaque

# Linear interpolation of g_n(κ) errs by less than this share of its largest value.
_WEIGHT_ERROR = 1e-5


# Nodes lie in squares of 4 × 4, so that those of a window lie in few lines of the cache: one word each, in one to four.
_SQUARE = 4


def order_power(
    table: SeriesTable | SliceTable, rim: tuple[int, int] = (0, 0), windows: bool = True
) -> SeriesPower | SlicePower:
    """The evaluation that fits the table.

    Args:
        table: of a spectrum.
        rim: nodes of zero that are put on each side, (x, y).
        windows: whether several nodes are read at a time.
    """
    return (SlicePower if isinstance(table, SliceTable) else SeriesPower)(table, rim, _SQUARE if windows else 1)


class _Power:
    """What both have in common.

    Attributes:
        table: packets of numbers, square after square of nodes.
        rows: of nodes, with the rim.
        columns: of nodes, with the rim.
        square: nodes along the side of a square.
        nodes: those of all squares.
    """

    def __init__(self, rows: int, columns: int, square: int) -> None:
        self.rows, self.columns, self.square = rows, columns, square
        self.row = -(-columns // square) * square**2  # nodes of a row of squares
        self.nodes = -(-rows // square) * self.row

    def _arranged(self, packets: np.ndarray) -> np.ndarray:
        """(..., rows, columns) → (..., nodes)."""
        square, (rows, columns) = self.square, packets.shape[-2:]
        pad = [(0, 0)] * (packets.ndim - 2) + [(0, -rows % square), (0, -columns % square)]
        padded = np.pad(packets, pad)
        rows, columns = (n // square for n in padded.shape[-2:])
        squares = padded.reshape(*packets.shape[:-2], rows, square, columns, square)
        return squares.swapaxes(-2, -3).reshape(*packets.shape[:-2], -1)

    def _places(self, first: mi.Int32, count: int, before: int, beside: int) -> list[mi.UInt32]:
        """What each of `count` rows or columns adds to the index: `before` for a square, `beside` for a node in it."""
        places = [mi.UInt32(first + step) for step in range(count)]
        if self.square == 1:
            return [place * before for place in places]
        return [place // self.square * before + place % self.square * beside for place in places]

    def window(
        self,
        row: mi.Int32,
        column: mi.Int32,
        weights_x: Sequence[mi.Float],
        weights_y: Sequence[mi.Float],
        at: list[tuple[mi.UInt32, mi.Vector4f]],
        active: mi.Bool,
    ) -> mi.Float:
        """Σ_ij w_x,i w_y,j c of the nodes from (row, column) on.

        Args:
            row: of the first node, the rim included; beyond the table, where a window holds zeros only, the nearest.
            column: likewise.
            weights_x: w_x,i.
            weights_y: w_y,j.
            at: what the method `at` gave for κ.
            active: mask.
        """
        row = dr.clip(row, 0, self.rows - len(weights_y))
        column = dr.clip(column, 0, self.columns - len(weights_x))
        rows = self._places(row, len(weights_y), self.row, self.square)
        columns = self._places(column, len(weights_x), self.square**2, 1)
        weights_x = [weight * self.unit for weight in weights_x]
        total = mi.Float(0.0)
        for offset, factors in at:
            packet = type(factors)(0.0)
            for weight, r in zip(weights_y, rows, strict=True):
                line = type(factors)(0.0)
                for w, c in zip(weights_x, columns, strict=True):
                    line = self.table.add(line, w, offset + r + c, active)
                packet = dr.fma(weight, line, packet)
            total += dr.dot(packet, factors)
        return total


class SlicePower(_Power):
    """c_m(κ) = Σ_p a_p t^p, −1 ≤ t ≤ 1 on the interval of κ. A node is one packet of one, two or four words."""

    def __init__(self, table: SliceTable, rim: tuple[int, int], square: int) -> None:
        values = _rimmed(table.values, rim)
        super().__init__(*values.shape[2:], square)
        values = self._arranged(values)
        words = table.words_per_node if dr.is_jit_v(mi.Float) else 4
        scale = 1.0
        if words == 1:
            mantissas, exponents = shared_exponents(values)
            packets = SharedExponentTable(np.moveaxis(mantissas, 1, -1), exponents)
        elif words == 2:
            scale = HALF_SCALE
            packets = HalfTable(np.moveaxis(values, 1, -1) * np.float32(scale))
        else:
            padded = np.pad(values, ((0, 0), (0, 4 - table.terms), (0, 0)))
            packets = PacketTable(np.moveaxis(padded, 1, -1))
        self.table, self.unit = packets, packets.unit / scale
        self.packet = mi.Vector3f if words == 1 else mi.Vector4f
        self.intervals = table.intervals
        self.per_kappa = opaque(table.intervals / table.largest_kappa)

    def at(self, kappa: mi.Float, active: mi.Bool) -> list[tuple[mi.UInt32, mi.Vector3f | mi.Vector4f]]:
        """Where the packets of node 0 lie at κ (rad/µm), and the factors of their numbers."""
        x = kappa * self.per_kappa
        interval = dr.minimum(mi.UInt32(x), self.intervals - 1)
        t = 2 * (x - mi.Float(interval)) - 1
        factors = [1, t, dr.square(t), dr.square(t) * t]
        return [(interval * self.nodes, self.packet(factors[: len(self.packet(0))]))]


class SeriesPower(_Power):
    """c_m(κ) = Σ_n g_n(κ) B_nm. A node is ⌈N/4⌉ packets of four floats; the g_n come from a small table over κ."""

    unit = 1.0

    def __init__(self, table: SeriesTable, rim: tuple[int, int], square: int) -> None:
        terms, rows, columns = table.terms.shape
        self.packets = (terms + 3) // 4
        packets = np.zeros((self.packets, 4, rows, columns), np.float32)
        packets.reshape(-1, rows, columns)[:terms] = table.terms
        packets = _rimmed(packets, rim)
        super().__init__(*packets.shape[2:], square)
        self.table = PacketTable(np.moveaxis(self._arranged(packets), 1, -1))
        weights = _weights(table)
        self.steps = len(weights) - 1
        padded = np.zeros((len(weights), self.packets * 4), np.float32)
        padded[:, :terms] = weights
        self.weights = PacketTable(padded.reshape(-1, self.packets, 4))
        self.per_kappa = opaque(self.steps / table.largest_kappa)

    def at(self, kappa: mi.Float, active: mi.Bool) -> list[tuple[mi.UInt32, mi.Vector4f]]:
        """Where the packets of node 0 lie at κ (rad/µm), and the factors of their four floats."""
        x = kappa * self.per_kappa
        step = dr.minimum(mi.UInt32(x), self.steps - 1)
        t = x - mi.Float(step)
        result = []
        for packet in range(self.packets):
            low = self.weights(step * self.packets + packet, active)
            high = self.weights((step + 1) * self.packets + packet, active)
            result.append((mi.UInt32(packet * self.nodes), dr.fma(t, high - low, low)))
        return result


def _rimmed(values: np.ndarray, rim: tuple[int, int]) -> np.ndarray:
    """(..., rows, columns) with nodes of zero around them."""
    return np.pad(values, ((0, 0), (0, 0), (rim[1], rim[1]), (rim[0], rim[0])))


def _weights(table: SeriesTable) -> np.ndarray:
    """g_n at steps in κ so small that straight lines between them serve: (steps + 1, N)."""
    steps = 64
    while True:
        kappas = np.linspace(0, table.largest_kappa, 2 * steps + 1)
        weights = table.series.weights(kappas)
        error = np.abs(weights[1::2] - (weights[:-1:2] + weights[2::2]) / 2).max(axis=0)
        if (error <= _WEIGHT_ERROR * np.abs(weights).max(axis=0)).all() or steps >= 1 << 14:
            return weights[::2]
        steps *= 2


FLOOR = 0.05  # the share of each κ cell that all orders have alike
WHOLE = 2**24  # a float32 holds whole numbers up to here
LARGEST_TABLE = 2**19  # packets (8 MB); where the sums over rectangles take more, all orders can be drawn


class OrderSampler:
    """Draws orders by two binary searches; P_m of a given order reads one packet of four floats.

    The A_jm are whole numbers of units 2⁻²⁴, so that sums over rectangles are exact: the probability of what is drawn
    is the probability that is reported.
    """

    def __init__(self, spectrum: GratingSpectrum) -> None:
        self.cells = KappaCells(spectrum.largest_kappa)
        self.rows, self.columns = spectrum.grid.shape
        self.largest_x, self.largest_y = spectrum.grid.largest
        self.tile_x, self.tile_y = (opaque(t) for t in spectrum.grid.tile_size)
        self.restricted = (self.largest_x + 1) ** 2 * (self.rows + 1) <= LARGEST_TABLE
        units = np.stack([_units(average) for average in averages(spectrum, FLOOR)], axis=-1)
        self.shares = PacketTable(units)
        # The sums of A_j over the columns before x, for each row.
        before_x = np.zeros((self.rows, self.columns + 1, CELLS), np.int64)
        before_x[:, 1:] = units.cumsum(axis=1)
        self.before_x = PacketTable(before_x)
        # The sums of A_j over the rows before y, for each first column and each end of the columns.
        first, end = np.arange(self.largest_x + 1), np.arange(self.largest_x + 1, self.columns + 1)
        if not self.restricted:
            first, end = first[:1], end[-1:]
        before_y = np.zeros((len(first), len(end), self.rows + 1, CELLS), np.int64)
        for index, column in enumerate(first):
            before_y[index, :, 1:] = np.moveaxis((before_x[:, end] - before_x[:, [column]]).cumsum(axis=0), 1, 0)
        self.before_y = PacketTable(before_y)

    def rectangle(self, incidence: Incidence) -> tuple[mi.Int32, mi.Int32, mi.Int32, mi.Int32]:
        """The first row, the end of the rows, the first column, the end of the columns."""
        if not self.restricted:
            return mi.Int32(0), mi.Int32(self.rows), mi.Int32(0), mi.Int32(self.columns)
        frequency = incidence.frequency
        s_x, s_y = incidence.wi.x * frequency, incidence.wi.y * frequency
        rows = self._interval(s_y, s_x, self.columns, frequency, self.tile_y, self.largest_y)
        columns = self._interval(s_x, s_y, self.rows, frequency, self.tile_x, self.largest_x)
        return *rows, *columns

    def _interval(
        self, along: mi.Float, across: mi.Float, lines: int, frequency: mi.Float, tile: mi.Float, largest: int
    ) -> tuple[mi.Int32, mi.Int32]:
        """The orders |m/T + s/λ| ≤ ρ along one axis, of which there are `lines` side by side: first and end."""
        if largest == 0:
            return mi.Int32(0), mi.Int32(1)
        half = frequency
        if lines == 1:
            half = dr.safe_sqrt(dr.square(frequency) - dr.square(across))
        first = mi.Int32(dr.ceil((-along - half) * tile))
        last = mi.Int32(dr.floor((half - along) * tile))
        # The mirror order m = 0 is always among them.
        return dr.clip(first, -largest, 0) + largest, dr.clip(last, 0, largest) + (largest + 1)

    def weights(self, incidence: Incidence, active: mi.Bool) -> mi.Vector4f:
        """w_j / Σ_j w_j M_j for one wavelength.

        Args:
            incidence: the wavelength and where it comes from.
            active: mask.
        """
        weights = self.cells.weights(incidence)
        bottom, top, left, right = self.rectangle(incidence)
        total = dr.dot(weights, self._masses(bottom, top, self._start(left, right), active))
        return weights * dr.rcp(larger(total, 1))

    def _start(self, left: mi.Int32, right: mi.Int32) -> mi.Int32:
        """Where the sums over the rows begin in their table."""
        if not self.restricted:
            return mi.Int32(0)
        return (left * (self.largest_x + 1) + right - (self.largest_x + 1)) * (self.rows + 1)

    def _masses(self, bottom: mi.Int32, top: mi.Int32, start: mi.Int32, active: mi.Bool) -> mi.Vector4f:
        """M_j in units."""
        masses = self.before_y(mi.UInt32(start + top), active)
        return masses - self.before_y(mi.UInt32(start + bottom), active) if self.rows > 1 else masses

    def share(self, order: mi.UInt32, weights: mi.Vector4f, active: mi.Bool) -> mi.Float:
        """P_m of the order with flat index `order`, which is among those of the rectangle."""
        return dr.dot(self.shares(order, active), weights)

    def sample(
        self,
        incidence: Incidence,
        u: mi.Float,
        v: mi.Point2f,
        active: mi.Bool,
    ) -> tuple[mi.Int32, mi.Int32, mi.Point2f]:
        """Draw an order for one wavelength; the arguments are those of `weights`.

        κ cell and row come from `u`, the column from `v` where there are several rows.

        Returns:
            Its row and column, and what is left of `v`: two numbers uniform in [0, 1).
        """
        bottom, top, left, right = self.rectangle(incidence)
        start = self._start(left, right)
        masses = self._masses(bottom, top, start, active)
        cell, u = choose(self.cells.weights(incidence) * masses, u)

        def before_y(y: mi.Int32) -> mi.Float:
            return self.before_y.entry(mi.UInt32(start + y), cell, active)

        def before_x(x: mi.Int32) -> mi.Float:
            return self.before_x.entry(mi.UInt32(row * (self.columns + 1) + x), cell, active)

        if self.rows == 1:
            row = mi.Int32(0)
            column, _ = search(before_x, left, right, self.columns, u)
            return row, column, v
        row, _ = search(before_y, bottom, top, self.rows, u)
        column, rest = search(before_x, left, right, self.columns, v.x)
        return row, column, mi.Point2f(rest, v.y)


def _units(average: NDArray[np.float64]) -> NDArray[np.int64]:
    """A_jm of one κ cell in units of 2⁻²⁴: at least one, no more than 2²⁴ together."""
    return 1 + np.floor(average * (WHOLE - average.size)).astype(np.int64)


WIDEST = 0.5  # σ_q: cells are no wider
SCALE = 1.7  # τ in σ_q: ∫ N²/F′ dq is least, 1.04


class LineSampler:
    """The density of a q that propagates, here for orders along x:

        p(q) = P_m/Δ · F′(q_y)/(F(b) − F(a)),    |q_x − mΔ| ≤ Δ/2

    P_m = Σ_j w_j A_jm / Σ_j w_j M_j is a mixture over κ (`KappaCells`), restricted to the cells in which something
    propagates, over which M_j is the sum of A_jm. Across the orders, Student's distribution with four degrees of
    freedom stands for the Gaussian, which takes longer to restrict to what propagates at q_x, a ≤ q_y ≤ b:

        F(y) = t − t³/3,    t = y/√(τ² + y²),    t = 2 sin(arcsin(3F/2)/3)

    With s the direction of incidence, the limits are

        |q_x + s_x/λ| ≤ √(1/λ² − s_⊥²),             s_⊥ = max(|s_y/λ| − 4σ_q, 0)
        |q_y + s_y/λ| ≤ √(1/λ² − (q_x + s_x/λ)²),   |q_y| ≤ 4σ_q
    """

    def __init__(self, spectrum: GratingSpectrum) -> None:
        self.along_x = spectrum.grid.shape[0] == 1
        axis = CellAxis.of(spectrum, 0 if self.along_x else 1, WIDEST)
        self.cells, self.largest, self.count = KappaCells(spectrum.largest_kappa), axis.largest, len(axis.shares)
        shares = axis.shares @ averages(spectrum, FLOOR).reshape(CELLS, -1).T
        self.shares = ShareTable(np.maximum(shares, 0))
        # The sums of A_j over the cells before each.
        self.before = PacketTable(sums_before(np.float64(self.shares.values)))
        self.spacing, self.per_q = opaque(axis.spacing), opaque(1 / axis.spacing)
        self.reach, self.limit = opaque(LOBE * spectrum.lobe_width), _cumulative(LOBE / SCALE)
        per_scale = 1 / (SCALE * spectrum.lobe_width)
        self.per_scale, self.per_area = opaque(per_scale), opaque(per_scale / axis.spacing)

    def density(self, q_x: mi.Float, q_y: mi.Float, incidence: Incidence, active: mi.Bool) -> mi.Float:
        """p(q) in µm², q in cycles/µm, for one wavelength; of a q that propagates."""
        along, across = self._axes(q_x, q_y)
        m = mi.Int32(dr.round(along * self.per_q))
        active = active & (dr.abs(m) <= self.largest) & (dr.abs(across) <= self.reach)
        cell = mi.UInt32(m + self.largest)
        weights = self.cells.weights(incidence)
        first, end = self._interval(incidence)
        total = dr.dot(weights, self._masses(first, end, active))
        low, high = self._across(along, incidence)
        # F′ = τ⁴/(τ² + y²)^(5/2)
        root = dr.rsqrt(1 + dr.square(across * self.per_scale))
        lobe = self.per_area * root * dr.square(dr.square(root))
        total = larger(total, 1e-20) * larger(high - low, 1e-6)
        return dr.dot(weights, self.shares(cell, active)) * lobe * dr.rcp(total)

    def sample(self, incidence: Incidence, u: mi.Float, v: mi.Point2f, active: mi.Bool) -> mi.Point2f:
        """Draw q in cycles/µm, for one wavelength.

        The κ cell comes from `u`, the place along the orders from `v.x` and that across from `v.y`.
        """
        first, end = self._interval(incidence)
        kappa_cell, _ = choose(self.cells.weights(incidence) * self._masses(first, end, active), u)

        def before(cell: mi.Int32) -> mi.Float:
            return self.before.entry(mi.UInt32(cell), kappa_cell, active)

        cell, place = search(before, first, end, self.count, v.x)
        along = (mi.Float(cell - self.largest) + place - 0.5) * self.spacing
        low, high = self._across(along, incidence)
        t = 2 * dr.sin(dr.asin(1.5 * dr.fma(v.y, high - low, low)) / 3)
        return mi.Point2f(*self._axes(along, t * dr.rsqrt(1 - dr.square(t)) / self.per_scale))

    def _axes(self, x: mi.Float, y: mi.Float) -> tuple[mi.Float, mi.Float]:
        """Along the orders and across from x and y, and the reverse."""
        return (x, y) if self.along_x else (y, x)

    def _interval(self, incidence: Incidence) -> tuple[mi.Int32, mi.Int32]:
        """The first cell in which something propagates, and the end of them."""
        frequency = incidence.frequency
        along, across = (s * frequency for s in self._axes(incidence.wi.x, incidence.wi.y))
        half = dr.safe_sqrt(dr.square(frequency) - dr.square(larger(dr.abs(across) - self.reach, 0)))
        first = mi.Int32(dr.floor(dr.fma(-along - half, self.per_q, 0.5)))
        end = mi.Int32(dr.ceil(dr.fma(half - along, self.per_q, 0.5)))
        # The mirror direction m = 0 is always among them.
        return dr.clip(first, -self.largest, 0) + self.largest, dr.clip(end, 1, self.largest + 1) + self.largest

    def _masses(self, first: mi.Int32, end: mi.Int32, active: mi.Bool) -> mi.Vector4f:
        """M_j."""
        return self.before(mi.UInt32(end), active) - self.before(mi.UInt32(first), active)

    def _across(self, along: mi.Float, incidence: Incidence) -> tuple[mi.Float, mi.Float]:
        """F(a) and F(b)."""
        frequency = incidence.frequency
        s_along, s_across = (s * frequency for s in self._axes(incidence.wi.x, incidence.wi.y))
        half = dr.safe_sqrt(dr.square(frequency) - dr.square(along + s_along))
        low, high = (_cumulative((end - s_across) * self.per_scale) for end in (-half, half))
        return limited(low, -self.limit, self.limit), limited(high, -self.limit, self.limit)


def _cumulative(x: mi.Float) -> mi.Float:
    """F(τx)."""
    t = x * dr.rsqrt(1 + dr.square(x))
    return t - dr.square(t) * t / 3


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

        K and G are those of each order, and its lobe keeps its power at the horizon (`Geometry.of_order`).

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
