"""Rigorous orders at run time: the table of efficiencies, and an order drawn by its efficiency."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..rigorous.efficiencies import ODD, REVERSED
from ..rigorous.spectrum import RigorousSpectrum
from .geometry import Geometry, Incidence, cell_of
from .inversion import search, truncated_gaussian
from .order_sampler import WHOLE
from .tables import NumberTable, PacketTable, larger, limited, opaque, smaller

CELLS = 8  # of the sampler to each unit of P and R
CELLS_BOTH = 4  # where light passes, too
PLANES = 4  # of its cells over the wavelengths
# 2/π asin √x = √x Σ_n a_n xⁿ for x ≤ 1/2, to 4e-7 (least squares at Chebyshev points).
_ARC_SINE = (0.63661934, 0.10616330, 0.04642647, 0.03876191, -0.01541680, 0.06134137)
_POINTS = tuple(itertools.product((0.1, 0.9), repeat=3))  # of each of these, along Z, p and r, where η is taken
STEPS = 2**16 - 1  # of η in the table
FLOOR = 0.05  # the share that all orders of a cell have alike, for those that vary within it


@dataclass(eq=False)
class _Pair:
    """A pair of directions in the coordinates of `Axes`.

    Attributes:
        q_x, q_y: cycles/µm.
        k_y: as of `Axes`, in units of 2π/T.
        c: as of `Axes`.
        square: γ².
        inside: γ'²; zero if Z is the wavelength.
        z: Z, if it is the wavelength.
        above: whether light comes from above and whether it leaves there; None without transmission.
    """

    q_x: mi.Float
    q_y: mi.Float
    k_y: mi.Float
    c: mi.Float
    square: mi.Float
    inside: mi.Float
    z: mi.Float
    above: tuple[mi.Bool, mi.Bool] | None


@dataclass(eq=False)
class _Place:
    """Where an order of a pair stands in the table.

    Attributes:
        active: whether it propagates.
        back: whether the light of the table is reversed.
        row: of the table.
        nodes: of F, X and Z: the node before, and how far the order is beyond it.
    """

    active: mi.Bool
    back: mi.Bool
    row: mi.UInt32
    nodes: list[tuple[mi.UInt32, mi.Float]]


class RigorousOrders:
    """Σ_m η_m N(q − m/T; σ_q² I), and the density Σ_m P_m N(q − m/T; σ_q² I) from which q is drawn.

    η_m is that of the pair (ω_i, ω_o), in the coordinates of `Axes`: symmetric under exchange. N is cut off at `reach`
    standard deviations along each axis and scaled up. P_m follows η_m of light from ω_i, averaged over cells of

        p = g + α,    r = g − α,    α = −ω_i,x ν,    g = ν √(1 − ω_i,y²),

    and of the wavelength: in p and r the orders of one direction share one cell. Where light passes, α and g are those
    of the medium of ω_i, and each side has cells for reflected and for transmitted light.
    """

    resolved = True

    def __init__(self, spectrum: RigorousSpectrum) -> None:
        axes = spectrum.axes
        self.axes = axes
        self.count = int(2 * spectrum.cutoff_sigmas * spectrum.lobe_width * axes.period) + 1  # lobes that overlap
        self.table = PacketTable(_packets(spectrum.values))
        if mi.is_polarized:
            self.matrices = PacketTable(spectrum.mueller)
        self.transmits = spectrum.transmission != "none"
        self.interface = spectrum.transmission == "interface"
        self.max_order = axes.max_order
        self.starts = NumberTable(axes.starts.astype(np.uint32))
        self.excess, self.top = opaque(axes.excess), opaque(axes.top)
        self.cells = CELLS_BOTH if self.transmits else CELLS
        units = _units(*_shares(spectrum, self.cells))
        self.sampler_planes, self.cells_across = units.shape[-4], units.shape[-2]
        before = np.zeros((*units.shape[:-1], units.shape[-1] + 1))
        before[..., 1:] = units.cumsum(axis=-1)
        self.orders = PacketTable(np.stack([before, np.append(units, 0 * units[..., :1], axis=-1)], axis=-1), width=2)
        sigma, reach = spectrum.lobe_width, spectrum.cutoff_sigmas
        inside = math.erf(reach / math.sqrt(2))  # the share of the Gaussian within its reach, along one axis
        self.spread, self.inside = opaque(np.sqrt(2) * sigma), opaque(inside)
        self.peak, self.falloff = opaque(1 / (2 * np.pi * (sigma * inside) ** 2)), opaque(-0.5 / sigma**2)
        self.half_width, self.per_width = opaque(reach * sigma), opaque(1 / sigma)
        self.period, self.pitch = opaque(axes.period), opaque(1 / axes.period)
        self.shortest, self.longest = (opaque(w) for w in axes.wavelengths)

    def meets(self, q_x: mi.Float, q_y: mi.Float, scale: float = 1.0) -> mi.Bool:
        """Whether q lies in the lobe of an order; q in cycles/µm, the lateral scale is one."""
        return (mi.Float(self._first(q_x)) * self.pitch - q_x <= self.half_width) & (dr.abs(q_y) <= self.half_width)

    def _first(self, q_x: mi.Float) -> mi.Int32:
        """The first order whose lobe may hold q_x."""
        return mi.Int32(dr.ceil((q_x - self.half_width) * self.period))

    def _near(self, pair: _Pair, active: mi.Bool) -> Iterator[tuple[mi.Int32, mi.Float, mi.Bool]]:
        """The orders whose lobes may hold q: m, |q − m/T|², and where they do along x."""
        first = self._first(pair.q_x)
        for step in range(self.count):
            m = first + step
            offset = dr.fma(-self.pitch, mi.Float(m), pair.q_x)
            there = active & (dr.abs(offset) <= self.half_width) & (dr.abs(m) <= self.max_order)
            yield m, dr.square(offset) + dr.square(pair.q_y), there

    def evaluate(self, geometry: Geometry, incidence: Incidence, active: mi.Bool) -> tuple[mi.Float, mi.Float]:
        """Return n_o² cos θ_o Σ_m η_m N and the density of q, both in µm², for one wavelength.

        The lobe of each order keeps its power at the horizon (`Geometry.of_order`).

        Args:
            geometry: of the pair of directions, along the pattern's axes.
            incidence: the wavelength and where it comes from.
            active: mask; q lies in the lobe of an order (`meets`).
        """
        frequency = incidence.frequency
        # Under a coat tables are those inside of it.
        k_i, k_o, index = geometry.incident, geometry.outgoing, geometry.coat_index
        above = (k_i.sign > 0, k_o.sign > 0) if self.transmits else None
        pair = self._pair(k_i.tangent / index, k_o.tangent / index, index * frequency, above)
        cell = self._cell(incidence)
        power, density = mi.Float(0.0), mi.Float(0.0)
        for m, square, there in self._near(pair, active):
            lobe = dr.select(there, self.peak * dr.exp(self.falloff * square), 0)
            tangent = mi.Vector2f(mi.Float(m) * self.pitch * incidence.wavelength, 0)
            *_, gain = geometry.of_order(tangent, frequency * self.per_width)
            power += lobe * gain * self._efficiency(m, pair, there)
            # An order that does not propagate is not drawn.
            there &= incidence.propagates(tangent)
            density += dr.select(there, lobe, 0) * self.orders(mi.UInt32(dr.select(there, cell + m, 0)), there).y
        return power * geometry.factor, density / WHOLE

    def _pair(
        self,
        k_i: mi.Vector2f | mi.Vector3f,
        k_o: mi.Vector2f | mi.Vector3f,
        frequency: mi.Float,
        above: tuple[mi.Bool, mi.Bool] | None,
    ) -> _Pair:
        """Return the coordinates of a pair of directions.

        Args:
            k_i, k_o: n ω of both, or their parts along the surface.
            frequency: 1/λ above.
            above: whether each is above; None without transmission.
        """
        nu = self.period * frequency
        k_y, c = 0.5 * nu * (k_o.y - k_i.y), 0.5 * nu * (k_o.x - k_i.x)
        square = dr.square(nu) - dr.square(k_y)
        inside, z = mi.Float(0.0), mi.Float(0.0)
        if self.transmits:
            inside = larger(dr.fma(self.excess, dr.square(nu), square), 0)
        else:
            z = self._z(dr.sqrt(larger(square, 0)), frequency)
        if not self.interface:
            square = larger(square, 0)
        q_x, q_y = -(k_i.x + k_o.x) * frequency, -(k_i.y + k_o.y) * frequency
        return _Pair(q_x, q_y, k_y, c, square, inside, z, above)

    def mueller(
        self,
        source: mi.Vector2f | mi.Vector3f,
        exit_: mi.Vector2f | mi.Vector3f,
        frequency: mi.Float,
        active: mi.Bool,
        above: tuple[mi.Bool, mi.Bool] | None,
    ) -> list[list[mi.Float]]:
        """M_ij / M_00 of light from `source`, from all orders whose lobes reach the pair; the identity where none does.

        Args:
            source, exit_: along the pattern's axes, times n where light passes.
            frequency: 1/λ in cycles/µm, above.
            active: mask.
            above: whether each is above; None without transmission.
        """
        pair = self._pair(source, exit_, frequency, above)
        rows = [mi.Vector4f(0.0) for _ in range(4)]
        for m, square, there in self._near(pair, active & (dr.abs(pair.q_y) <= self.half_width)):
            lobe = dr.select(there, dr.exp(self.falloff * square), 0)
            for row, found in enumerate(self._matrix(m, pair, there)):
                rows[row] += lobe * found
        bright = rows[0].x > 0
        across = pair.k_y / (self.period * frequency)
        scale = dr.rcp(dr.select(bright, rows[0].x, mi.Float(1)))
        return [
            [dr.select(bright, rows[i][j] * scale * (across if ODD[i, j] else 1), mi.Float(i == j)) for j in range(4)]
            for i in range(4)
        ]

    def _matrix(self, m: mi.Int32, pair: _Pair, active: mi.Bool) -> list[mi.Vector4f]:
        """The rows of M of order m, linear between the nodes."""
        place = self._place(m, pair, active)
        rows = [mi.Vector4f(0.0) for _ in range(4)]
        for corner in np.ndindex(2, 2, 2):
            node, weight = place.row, mi.Float(1)
            for (low, share), up, steps in zip(place.nodes, corner, self.axes.steps, strict=True):
                node = node * (steps + 1) + low + up
                weight *= share if up else 1 - share
            for row in range(4):
                rows[row] += weight * self.matrices(node * 4 + row, place.active)
        back = [mi.Vector4f(*(float(REVERSED[i] * REVERSED[j]) * rows[j][i] for j in range(4))) for i in range(4)]
        return [dr.select(place.back, other, row) for row, other in zip(rows, back, strict=True)]

    def sample(self, incidence: Incidence, u: mi.Float, v: mi.Point2f, active: mi.Bool) -> tuple[mi.Point2f, mi.Bool]:
        """Draw q in cycles/µm, for one wavelength, and tell whether the order of q propagates.

        The order comes from `u`, its place in the lobe from `v`.
        """
        middle = self._cell(incidence)
        max_order = self.max_order

        def before(m: mi.Int32) -> mi.Float:
            return self.orders(mi.UInt32(middle + m), active).x

        m, _ = search(before, mi.Int32(-max_order), mi.Int32(max_order + 1), 2 * max_order + 1, u)
        x, y = (truncated_gaussian(number, self.inside, self.spread) for number in v)
        tangent = mi.Vector2f(mi.Float(m) * self.pitch * incidence.wavelength, 0)
        return mi.Point2f(dr.fma(self.pitch, mi.Float(m), x), y), incidence.propagates(tangent)

    def _z(self, g: mi.Float, frequency: mi.Float) -> mi.Float:
        """Z of the wavelength, from 0 to 1."""
        most = self.period / larger(g, 1e-6)
        first, last = smaller(self.shortest, most), smaller(self.longest, most)
        return limited((dr.rcp(frequency) - first) / larger(last - first, 1e-6), 0, 1)

    def _efficiency(self, m: mi.Int32, pair: _Pair, active: mi.Bool) -> mi.Float:
        """η_m, linear between the nodes; 0 for an order that does not propagate."""
        place = self._place(m, pair, active)
        (i, f), (j, h), (k, w) = place.nodes
        _, x_steps, z_steps = self.axes.steps
        packet = self.table(((place.row * self.axes.steps[0] + i) * x_steps + j) * z_steps + k, place.active)
        # Along Z the lower and the upper half of each word; then along X, then along F.
        along_z = [dr.lerp(mi.Float(word & 0xFFFF), mi.Float(word >> 16), w) for word in packet]
        found = dr.lerp(dr.lerp(along_z[0], along_z[1], h), dr.lerp(along_z[2], along_z[3], h), f)
        return dr.select(place.active, found * (1 / STEPS), 0)

    def _place(self, m: mi.Int32, pair: _Pair, active: mi.Bool) -> _Place:
        """The place of order m."""
        k_x = pair.c + 0.5 * mi.Float(m)
        whole = dr.round(k_x)
        n, a = mi.Int32(whole), dr.abs(k_x - whole)
        back = k_x < whole
        # Light that comes and that leaves.
        orders = dr.select(back, m - n, n), dr.select(back, -n, n - m)
        cell, low, high = _cell_of(pair.square, a)
        inner, inside = mi.UInt32(0), pair.z
        if self.transmits:
            inner, low_inside, high_inside = _cell_of(pair.inside, a)
            if self.interface:
                low, low_inside = (
                    dr.select(cell == 0, low_inside - self.top, low),
                    dr.select(inner == 0, low + self.top, low_inside),
                )
            inside = _arc(limited((pair.inside - low_inside) / larger(high_inside - low_inside, 1e-7), 0, 1))
        near, far = dr.sqrt(larger(pair.square - low, 1e-12)), dr.sqrt(larger(high - pair.square, 1e-12))
        places = _arc(2 * a), near / (near + far), inside
        nodes = [cell_of(x * steps, steps) for x, steps in zip(places, self.axes.steps, strict=True)]
        cells, inner_cells = self.axes.starts.shape
        start = self.starts(dr.minimum(cell, cells - 1) * inner_cells + dr.minimum(inner, inner_cells - 1))
        active = active & (start < 0x80000000) & (cell < cells) & (inner < inner_cells)
        count, channels = cell, []
        if self.transmits:
            count_below = inner if self.interface else cell
            count = cell + count_below
        for number, order in enumerate(orders):
            place, most, before = mi.UInt32(dr.select(order >= 0, 2 * order, -2 * order - 1)), cell, 0
            if self.transmits:
                above = dr.select(back, pair.above[1 - number], pair.above[number])
                most, before = dr.select(above, cell, count_below), dr.select(above, 0, cell)
            active &= place < most
            channels.append(place + before)
        row = dr.select(active, start + channels[0] * count + channels[1], 0)
        return _Place(active, back, row, nodes)

    def _cell(self, incidence: Incidence) -> mi.Int32:
        """Where order 0 of the sampler's cell stands in its table."""
        # Tangential components are the same inside of a coat.
        along, across = self.period * incidence.frequency * incidence.tangent
        frequency = incidence.coat_index * incidence.frequency
        g = dr.safe_sqrt(dr.square(self.period * incidence.index * frequency) - dr.square(across))
        p, r = (
            dr.clip(mi.Int32(self.cells * _position(larger(x, 0))), 0, self.cells_across - 1)
            for x in (g - along, g + along)
        )
        # λ is that above, g that of the medium of ω_i.
        z = dr.clip(mi.Int32(self._z(g / incidence.index, frequency) * self.sampler_planes), 0, self.sampler_planes - 1)
        if self.transmits:
            side = dr.select(incidence.above, 0, 2 * self.sampler_planes)
            z += side + dr.select(incidence.reflects, 0, self.sampler_planes)
        width = 2 * self.max_order + 2
        return ((z * self.cells_across + p) * self.cells_across + r) * width + self.max_order


def _arc(share: mi.Float) -> mi.Float:
    """2/π asin √t, t from 0 to 1."""
    near = smaller(share, 1 - share)
    # Above zero, where the root has a derivative.
    root = dr.sqrt(larger(near, 1e-12))
    value = mi.Float(_ARC_SINE[-1])
    for coefficient in _ARC_SINE[-2::-1]:
        value = dr.fma(value, near, coefficient)
    value *= root
    return dr.select(share < 0.5, value, 1 - value)


def _position(p: mi.Float) -> mi.Float:
    """p ≥ 0 in units that are steps of arcs."""
    whole = dr.floor(p)
    return whole + _arc(p - whole)


def _cell_of(square: mi.Float, a: mi.Float) -> tuple[mi.UInt32, mi.Float, mi.Float]:
    """The cell of γ², and h² where it begins (but of cell 0) and ends."""
    root = dr.sqrt(larger(square, 0))
    whole = dr.floor(root)
    part = root - whole
    far = part >= 1 - a
    within = (part >= a) & (part < 1 - a)
    middle = whole + dr.select(far, mi.Float(1), dr.select(within, mi.Float(0.5), mi.Float(0)))
    half = dr.select(within, 0.5 - a, a)
    return mi.UInt32(2 * middle), dr.square(middle - half), dr.square(middle + half)


def _packets(values: NDArray[np.float32]) -> NDArray[np.uint32]:
    """η at the eight nodes about each cell, in steps of 1/65535: (rows, F, X, Z, 4), one less than nodes of each.

    Cell (i, j, k) has the words of (i, j), (i, j + 1), (i + 1, j), (i + 1, j + 1), each with k in its lower half and
    k + 1 in its upper one: a single read of 16 bytes for an efficiency.
    """
    rows, f, x, z = values.shape
    packets = np.empty((rows, f - 1, x - 1, z - 1, 4), np.uint32)
    for row in range(rows):
        steps = np.rint(values[row].astype(np.float64) * STEPS).astype(np.uint32)
        words = steps[..., :-1] | steps[..., 1:] << 16
        for corner, (i, j) in enumerate(np.ndindex(2, 2)):
            packets[row, ..., corner] = words[i : f - 1 + i, j : x - 1 + j]
    return packets


def _shares(spectrum: RigorousSpectrum, cells: int) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return η_m in the sampler's cells, and whether m may propagate, (ways, Z, p, r, orders); `cells` to each unit.

    The ways are above → above and, where light passes, above → below, below → below, below → above.
    """
    axes = spectrum.axes
    nu, max_order = axes.largest, axes.max_order
    ways = [(0, 0)] if spectrum.transmission == "none" else [(0, 0), (0, 1), (1, 1), (1, 0)]
    m = np.arange(-max_order, max_order + 1)
    across = int(np.ceil(2 * max(spectrum.indices) * nu)) * cells
    shares = np.zeros((len(ways), PLANES, across, across, len(m)))
    possible = np.zeros(shares.shape, bool)
    ends = np.arange(across + 1)
    ends = ends // cells + np.sin(np.pi / 2 * (ends % cells) / cells) ** 2

    def placed(share: float) -> NDArray[np.float64]:
        return ends[:-1] + share * np.diff(ends)

    def wavelengths(g: NDArray[np.float64], n: float, share: NDArray[np.float64]) -> NDArray[np.float64]:
        first, last = (np.minimum(w, n * axes.period / np.maximum(g, 1e-9)) for w in axes.wavelengths)
        return first + share * (last - first)

    for way, (side, to) in enumerate(ways):
        n_i, n_o = (spectrum.indices[s] for s in (side, to))
        # The cells that some light has.
        p, r = np.nonzero(np.add.outer(ends[:-1], ends[:-1]) < 2 * n_i * nu)
        z, p, r = np.repeat(np.arange(PLANES), len(p)), np.tile(p, PLANES), np.tile(r, PLANES)
        g_most = np.minimum((ends[p + 1] + ends[r + 1]) / 2, n_i * nu)
        shortest = wavelengths(g_most, n_i, z / PLANES)
        longest = wavelengths((ends[p] + ends[r]) / 2, n_i, (z + 1) / PLANES)
        change = (n_o**2 - n_i**2) * (axes.period / (shortest if n_o > n_i else longest)) ** 2
        g_out = np.sqrt(np.maximum(g_most**2 + change, 0))
        low, high = (ends[p] - ends[r + 1]) / 2, (ends[p + 1] - ends[r]) / 2
        may = np.maximum(low[:, None] - m, m - high[:, None]) < g_out[:, None]
        possible[way, z, p, r] = may
        cell, order = np.nonzero(may)
        found, of_order = np.zeros((2, len(cell))), m[order]
        for t, u, v in _POINTS:
            x, y = placed(u)[p], placed(v)[r]
            g, alpha = (x + y) / 2, (x - y) / 2
            wavelength = wavelengths(g, n_i, (z + t) / PLANES)
            square = g**2 - (n_i**2 - 1) * (axes.period / wavelength) ** 2
            g = np.sign(square) * np.sqrt(np.abs(square))
            eta = spectrum.evaluate(of_order, alpha[cell] - of_order / 2, g[cell], wavelength[cell], (side, to))
            found += eta, eta > 0
        # The mean of where the order propagates: the horizon may cross a cell anywhere.
        shares[way, z[cell], p[cell], r[cell], order] = found[0] / np.maximum(found[1], 1)
    return shares, possible


def _units(shares: NDArray[np.float64], possible: NDArray[np.bool_]) -> NDArray[np.int64]:
    """P_m of every cell in units of 2⁻²⁴, 2²⁴ together, so that sums in float32 are exact.

    Orders have a floor where they are `possible`.
    """
    mirror = shares.shape[-1] // 2
    possible[..., mirror] = True  # order 0 propagates always
    shares = shares / np.maximum(shares.sum(axis=-1, keepdims=True), 1e-30)
    shares = (1 - FLOOR) * shares + FLOOR * possible / possible.sum(axis=-1, keepdims=True)
    units = np.floor(shares * WHOLE).astype(np.int64)
    units[..., mirror] += WHOLE - units.sum(axis=-1)
    return units
