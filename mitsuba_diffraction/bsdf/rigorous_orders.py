"""Rigorous orders at run time: the table of efficiencies, and an order drawn by its efficiency."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..rigorous.efficiencies import MIRRORED, REVERSED
from ..rigorous.spectrum import RigorousSpectrum
from .geometry import Geometry, Incidence
from .inversion import search, truncated_gaussian
from .orders import WHOLE
from .tables import PacketTable, larger, limited, opaque, smaller
from .transmission import Crossing, CrossingIncidence

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
    """A pair of directions in the coordinates of `Axes`, and where the table of its way stands.

    Attributes:
        q_x, q_y: cycles/µm.
        k_y: as of `Axes`, in units of 2π/T.
        c: as of `Axes`, of the reversed light where `upwards`.
        g: as of `Axes`.
        z: Z / (K − 1).
        reflects: whether light leaves on its own side; None without transmission.
        upwards: whether it crosses from below.
        squares: of an interface, the square of g on the side where the table's light comes from and where it leaves.
        shift: D.
        longest: the side of order 0.
        steps: by how much that of the next order is less.
        max_order: M.
        before: where order 0 starts.
    """

    q_x: mi.Float
    q_y: mi.Float
    k_y: mi.Float
    c: mi.Float
    g: mi.Float
    z: mi.Float
    reflects: mi.Bool | None
    upwards: mi.Bool | None
    squares: tuple[mi.Float, mi.Float] | None
    shift: mi.Float | int
    longest: mi.Int32 | int
    steps: mi.Int32 | int
    max_order: mi.Int32 | int
    before: mi.Int32 | int


class RigorousOrders:
    """Σ_m η_m N(q − m/T; σ_q² I), and the density Σ_m P_m N(q − m/T; σ_q² I) from which q is drawn.

    η_m is that of the pair (ω_i, ω_o), in the coordinates of `Axes`: symmetric under exchange. N is cut off at `reach`
    standard deviations along each axis and scaled up. P_m follows η_m of light from ω_i, averaged over cells of

        p = g + α = P + max(m, 0),    r = g − α = R − min(m, 0),    α = −ω_i,x ν,    g = ν √(1 − ω_i,y²),

    and of the wavelength: in p and r the orders of one direction share one cell. Where light passes, α and g are those
    of the medium of ω_i, and each side has cells for reflected and for transmitted light.
    """

    resolved = True

    def __init__(self, spectrum: RigorousSpectrum) -> None:
        axes = spectrum.axes
        self.axes = axes
        self.count = int(2 * spectrum.cutoff_sigmas * spectrum.lobe_width * axes.period) + 1  # lobes that overlap
        self.table = PacketTable(_packets(spectrum))
        if mi.is_polarized:
            self.matrices = PacketTable(np.concatenate([np.moveaxis(t.mueller, 0, 1) for t in spectrum.tables]))
        self.transmits = len(spectrum.tables) > 1
        self.interface = spectrum.transmission == "interface"
        all_axes = [table.axes for table in spectrum.tables]
        starts = itertools.accumulate((a.nodes for a in all_axes), initial=0)
        # Of each table what `_Pair` has of it.
        self.layouts = [
            (a.shift, a.side(0), a.side(0) - a.side(1), a.max_order, start + a.offset(0))
            for a, start in zip(all_axes, starts, strict=False)
        ]
        self.max_order = max(a.max_order for a in all_axes)
        if self.transmits:
            self.max_decay, self.excess = opaque(axes.max_decay * (1 - 1e-6)), opaque(axes.index**2 - 1)
            self.cells = math.gcd(CELLS_BOTH, axes.steps)
            units = _units(*_shares_of_sides(spectrum, self.cells))
        else:
            self.cells = math.gcd(CELLS, axes.steps)
            units = _units(_shares(spectrum, self.cells))
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

    def meets(self, q_x: mi.Float, q_y: mi.Float) -> mi.Bool:
        """Whether q lies in the lobe of an order; q in cycles/µm."""
        return (mi.Float(self._first(q_x)) * self.pitch - q_x <= self.half_width) & (dr.abs(q_y) <= self.half_width)

    def _first(self, q_x: mi.Float) -> mi.Int32:
        """The first order whose lobe may hold q_x."""
        return mi.Int32(dr.ceil((q_x - self.half_width) * self.period))

    def evaluate(
        self, geometry: Geometry | Crossing, incidence: Incidence | CrossingIncidence, active: mi.Bool
    ) -> tuple[mi.Float, mi.Float]:
        """Return n_o² cos θ_o Σ_m η_m N and the density of q, both in µm², for one wavelength.

        The lobe of each order keeps its power at the horizon (`Geometry.of_order`).

        Args:
            geometry: of the pair of directions, along the pattern's axes.
            incidence: the wavelength and where it comes from.
            active: mask; q lies in the lobe of an order (`meets`).
        """
        frequency = incidence.frequency
        if self.transmits:
            i, o = geometry.i, geometry.o
            pair = self._pair(i.tangent, o.tangent, frequency, (i.sign > 0, o.sign > 0))
        else:
            # Its tables are those inside of a coat.
            pair = self._pair(*geometry.inside(), geometry.index * frequency, None)
        q_x, q_y = pair.q_x, pair.q_y
        cell = self._cell(incidence)
        first = self._first(q_x)
        power, density = mi.Float(0.0), mi.Float(0.0)
        for step in range(self.count):
            m = first + step
            offset = dr.fma(-self.pitch, mi.Float(m), q_x)
            there = active & (dr.abs(offset) <= self.half_width) & (dr.abs(m) <= pair.max_order)
            square = dr.square(offset) + dr.square(q_y)
            lobe = dr.select(there, self.peak * dr.exp(self.falloff * square), 0)
            tangent = mi.Vector2f(mi.Float(m) * self.pitch * incidence.wavelength, 0)
            *_, gain = geometry.of_order(tangent, frequency * self.per_width)
            power += lobe * gain * self._efficiency(m, pair, there)
            # An order that does not propagate is not drawn.
            there &= incidence.propagates(tangent)
            density += dr.select(there, lobe, 0) * self.orders(mi.UInt32(dr.select(there, cell + m, 0)), there).y
        return power * (geometry.outgoing if self.transmits else geometry.cos_o), density / WHOLE

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
        reflects = upwards = squares = None
        layout = self.layouts[0]
        if self.interface:
            g = dr.sqrt(larger(dr.abs(square), 1e-12))
            g = dr.select(square < 0, -g, g)
        else:
            g = dr.sqrt(larger(square, 0))
        if self.transmits:
            reflects = above[0] == above[1]
            layout = [
                one if one == two == three else dr.select(reflects, dr.select(above[0], one, two), three)
                for one, two, three in zip(*self.layouts, strict=True)
            ]
            upwards = dr.select(reflects, mi.Bool(False), above[1])
            c = dr.select(upwards, -c, c)
        if self.interface:
            inside = dr.fma(self.excess, dr.square(nu), square)
            own = dr.select(above[0], square, inside)
            squares = dr.select(reflects, own, square), dr.select(reflects, own, inside)
        q_x, q_y = -(k_i.x + k_o.x) * frequency, -(k_i.y + k_o.y) * frequency
        return _Pair(q_x, q_y, k_y, c, g, self._z(g, frequency), reflects, upwards, squares, *layout)

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
        q_x, q_y = pair.q_x, pair.q_y
        first = self._first(q_x)
        rows = [mi.Vector4f(0.0) for _ in range(4)]
        for step in range(self.count):
            m = first + step
            offset = dr.fma(-self.pitch, mi.Float(m), q_x)
            there = active & (dr.abs(offset) <= self.half_width) & (dr.abs(q_y) <= self.half_width)
            there &= dr.abs(m) <= pair.max_order
            lobe = dr.select(there, dr.exp(self.falloff * (dr.square(offset) + dr.square(q_y))), 0)
            for row, found in enumerate(self._matrix(m, pair, there)):
                rows[row] += lobe * found
        bright = rows[0].x > 0
        if self.transmits:
            back = [mi.Vector4f(*(float(REVERSED[i] * REVERSED[j]) * rows[j][i] for j in range(4))) for i in range(4)]
            rows = [dr.select(pair.upwards, other, row) for row, other in zip(rows, back, strict=True)]
        mirrored, changed = dr.select(pair.k_y < 0, mi.Float(-1), mi.Float(1)), np.not_equal.outer(MIRRORED, MIRRORED)
        scale = dr.rcp(dr.select(bright, rows[0].x, mi.Float(1)))
        return [
            [
                dr.select(bright, rows[i][j] * scale * (mirrored if changed[i, j] else 1), mi.Float(i == j))
                for j in range(4)
            ]
            for i in range(4)
        ]

    def _matrix(self, m: mi.Int32, pair: _Pair, active: mi.Bool) -> list[mi.Vector4f]:
        """The rows of M of order m, linear between the nodes."""
        active, start, side, places = self._place(m, pair, active)
        places = [*places, _split(pair.z * (self.axes.planes - 1), mi.UInt32(self.axes.planes))]
        rows = [mi.Vector4f(0.0) for _ in range(4)]
        for i, j, k in np.ndindex(2, 2, 2):
            node = start + (places[0][0] + i) * side + places[1][0] + j
            weight = mi.Float(1)
            for (_, share), up in zip(places, (i, j, k), strict=True):
                weight *= share if up else 1 - share
            for row in range(4):
                packet = self.matrices(((node * self.axes.planes) + places[2][0] + k) * 4 + row, active)
                rows[row] += weight * packet
        return rows

    def sample(
        self, incidence: Incidence | CrossingIncidence, u: mi.Float, v: mi.Point2f, active: mi.Bool
    ) -> tuple[mi.Point2f, mi.Bool]:
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
        """Z / (K − 1), from 0 to 1."""
        most = self.period / larger(g, 1e-6)
        if self.interface:
            most = dr.select(g < 0, self.period * self.max_decay / larger(-g, 1e-6), most)
        first, last = smaller(self.shortest, most), smaller(self.longest, most)
        return limited((dr.rcp(frequency) - first) / larger(last - first, 1e-6), 0, 1)

    def _position(self, p: mi.Float) -> mi.Float:
        """X / s of P ≥ 0."""
        whole = dr.floor(p)
        part = p - whole
        near = smaller(part, 1 - part)
        # Above zero, where the root has a derivative.
        root = dr.sqrt(larger(near, 1e-12))
        value = mi.Float(_ARC_SINE[-1])
        for coefficient in _ARC_SINE[-2::-1]:
            value = dr.fma(value, near, coefficient)
        value *= root
        return whole + dr.select(part < 0.5, value, 1 - value)

    def _efficiency(self, m: mi.Int32, pair: _Pair, active: mi.Bool) -> mi.Float:
        """η_m(P, R, Z), linear between the nodes; 0 for an order that does not propagate."""
        active, start, side, ((i, f), (j, h)) = self._place(m, pair, active)
        k, w = _split(pair.z * (self.axes.planes - 1), mi.UInt32(self.axes.planes))
        packet = self.table((start + i * side + j) * (self.axes.planes - 1) + k, active)
        # Along Z the lower and the upper half of each word; then along R, then along P.
        along_z = [dr.lerp(mi.Float(word & 0xFFFF), mi.Float(word >> 16), w) for word in packet]
        found = dr.lerp(dr.lerp(along_z[0], along_z[1], h), dr.lerp(along_z[2], along_z[3], h), f)
        return dr.select(active, found * (1 / STEPS), 0)

    def _place(
        self, m: mi.Int32, pair: _Pair, active: mi.Bool
    ) -> tuple[mi.Bool, mi.UInt32, mi.UInt32, list[tuple[mi.UInt32, mi.Float]]]:
        """Whether order m propagates, where its nodes start, their side, the nodes along P and R and the rest."""
        half = 0.5 * mi.Float(dr.abs(m))
        c, g = pair.c, pair.g
        if self.interface:
            k_x, (come, leave) = c + 0.5 * mi.Float(m), pair.squares
            active = active & (dr.square(k_x) < come) & (dr.square(k_x - mi.Float(m)) < leave)
            g, c, half = g + pair.shift, dr.select(pair.reflects, c, k_x), dr.select(pair.reflects, half, 0)
        p, r = g + c - half, g - c - half
        active = active & (p > 0) & (r > 0)
        start, side = self._layout(dr.select(active, m, 0), pair)
        places = [_split(self._position(dr.select(active, x, 0)) * self.axes.steps, side) for x in (p, r)]
        return active, start, side, places

    def _layout(self, m: mi.Int32, pair: _Pair) -> tuple[mi.UInt32, mi.UInt32]:
        """Where order m starts in a plane, and its side, as `Axes.offset` and `Axes.side` have them.

        The side of order k is A − s |k|; of the orders 1 … n the squares add up to n A² − A s n (n + 1)
        + s² n (n + 1)(2n + 1)/6.
        """
        steps, longest, n = pair.steps, pair.longest, dr.abs(m)
        whole = longest * longest
        before = n * whole - longest * steps * n * (n + 1) + steps * steps * (n * (n + 1) * (2 * n + 1) // 6)
        side = longest - steps * n
        start = dr.select(m > 0, pair.before + whole + before - side * side, pair.before - before)
        return mi.UInt32(start), mi.UInt32(side)

    def _cell(self, incidence: Incidence | CrossingIncidence) -> mi.Int32:
        """Where order 0 of the sampler's cell stands in its table."""
        # Tangential components are the same inside of a coat.
        along, across = (self.period * incidence.frequency * s for s in (incidence.wi.x, incidence.wi.y))
        frequency = incidence.index * incidence.frequency
        g = dr.safe_sqrt(dr.square(self.period * frequency) - dr.square(across))
        p, r = (
            dr.clip(mi.Int32(self.cells * self._position(larger(x, 0))), 0, self.cells_across - 1)
            for x in (g - along, g + along)
        )
        if self.transmits:
            # In the medium of ω_i.
            g, frequency = g / incidence.index, incidence.frequency
        z = dr.clip(mi.Int32(self._z(g, frequency) * self.sampler_planes), 0, self.sampler_planes - 1)
        if self.transmits:
            side = dr.select(incidence.above, 0, 2 * self.sampler_planes)
            z += side + dr.select(incidence.reflects, 0, self.sampler_planes)
        width = 2 * self.max_order + 2
        return ((z * self.cells_across + p) * self.cells_across + r) * width + self.max_order


def _split(x: mi.Float, count: mi.UInt32) -> tuple[mi.UInt32, mi.Float]:
    """The node below x, at most the last but one, and how far x is beyond it."""
    low = dr.minimum(mi.UInt32(x), count - 2)
    return low, x - mi.Float(low)


def _packets(spectrum: RigorousSpectrum) -> NDArray[np.uint32]:
    """η_m at the eight nodes about each cell, in steps of 1/65535: (nodes of all tables, K − 1, 4).

    Node (i, j, k) has the words of (i, j), (i, j + 1), (i + 1, j), (i + 1, j + 1), each with k in its lower half and
    k + 1 in its upper one: a single read of 16 bytes for an efficiency. Between the nodes that were solved the table
    may dip below zero, or exceed one, by its error.
    """
    nodes, first = sum(table.axes.nodes for table in spectrum.tables), 0
    packets = np.empty((nodes, spectrum.axes.planes - 1, 4), np.uint32)
    for table in spectrum.tables:
        axes = table.axes
        for m in axes.orders:
            square = np.moveaxis(axes.square(table.values, m), 0, -1)
            side, start = square.shape[0], first + axes.offset(m)
            steps = np.rint(np.clip(square, 0, 1).astype(np.float64) * STEPS).astype(np.uint32)
            words = np.pad(steps[..., :-1] | steps[..., 1:] << 16, [(0, 1), (0, 1), (0, 0)], mode="edge")
            corners = [words[i : side + i, j : side + j] for i, j in np.ndindex(2, 2)]
            packets[start : start + side**2] = np.stack(corners, axis=-1).reshape(side**2, -1, 4)
        first += axes.nodes
    return packets


def _shares(spectrum: RigorousSpectrum, cells: int) -> NDArray[np.float64]:
    """η_m averaged over the sampler's cells, (Z, p, r, orders); `cells` of them to each unit.

    An order that is evanescent by less than the reach of its lobe has half of what it has where it begins to propagate.
    """
    axes = spectrum.axes
    planes = math.gcd(PLANES, axes.planes - 1)
    margin = spectrum.cutoff_sigmas * spectrum.lobe_width * axes.period
    whole = axes.units(0) * cells
    ends = -np.arange(whole)  # of the cells below P = 0
    ends = ends // cells + np.sin(np.pi / 2 * (ends % cells) / cells) ** 2
    beyond = int((ends > -margin).sum())
    shares = np.zeros((planes, whole, whole, 2 * axes.max_order + 1))
    for column, m in enumerate(axes.orders):
        units = axes.units(m) * cells
        average = _averaged(_averaged(_averaged(axes.square(spectrum.values, m), 0, planes), 1, units), 2, units)
        padded = np.pad(average, [(0, 0), (beyond, 0), (beyond, 0)], mode="edge")
        padded[:, :beyond] *= 0.5
        padded[:, :, :beyond] *= 0.5
        start = [max(m, 0) * cells - beyond, max(-m, 0) * cells - beyond]
        from_ = [max(s, 0) for s in start]
        to = [s + beyond + units for s in start]
        shares[:, from_[0] : to[0], from_[1] : to[1], column] = padded[:, from_[0] - start[0] :, from_[1] - start[1] :]
    return shares


def _shares_of_sides(spectrum: RigorousSpectrum, cells: int) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return η_m in the cells of light that passes, and whether m may propagate, (4 ways, Z, p, r, orders).

    The ways are above → above, above → below, below → below, below → above.
    """
    axes = spectrum.axes
    planes = math.gcd(PLANES, axes.planes - 1)
    nu = axes.period / axes.wavelengths[0]
    max_order = max(table.axes.max_order for table in spectrum.tables)
    m = np.arange(-max_order, max_order + 1)
    across = int(np.ceil(2 * max(spectrum.indices) * nu)) * cells
    shares = np.zeros((4, planes, across, across, len(m)))
    possible = np.zeros(shares.shape, bool)
    ends = np.arange(across + 1)
    ends = ends // cells + np.sin(np.pi / 2 * (ends % cells) / cells) ** 2

    def placed(share: float) -> NDArray[np.float64]:
        return ends[:-1] + share * np.diff(ends)

    def wavelengths(g: NDArray[np.float64], n: float, share: NDArray[np.float64]) -> NDArray[np.float64]:
        first, last = (np.minimum(w, n * axes.period / np.maximum(g, 1e-9)) for w in axes.wavelengths)
        return first + share * (last - first)

    for way, (side, to) in enumerate(((0, 0), (0, 1), (1, 1), (1, 0))):
        n_i, n_o = (spectrum.indices[s] for s in (side, to))
        # The cells that some light has.
        p, r = np.nonzero(np.add.outer(ends[:-1], ends[:-1]) < 2 * n_i * nu)
        z, p, r = np.repeat(np.arange(planes), len(p)), np.tile(p, planes), np.tile(r, planes)
        g_most = np.minimum((ends[p + 1] + ends[r + 1]) / 2, n_i * nu)
        shortest = wavelengths(g_most, n_i, z / planes)
        longest = wavelengths((ends[p] + ends[r]) / 2, n_i, (z + 1) / planes)
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
            wavelength = wavelengths(g, n_i, (z + t) / planes)
            square = g**2 - (n_i**2 - 1) * (axes.period / wavelength) ** 2
            g = np.sign(square) * np.sqrt(np.abs(square))
            eta = spectrum.evaluate(of_order, alpha[cell] - of_order / 2, g[cell], wavelength[cell], (side, to))
            found += eta, eta > 0
        # The mean of where the order propagates: the horizon may cross a cell anywhere.
        shares[way, z[cell], p[cell], r[cell], order] = found[0] / np.maximum(found[1], 1)
    return shares, possible


def _averaged(values: NDArray, axis: int, cells: int) -> NDArray[np.float64]:
    """The mean over each of so many cells along one axis, of what is linear between the nodes."""
    values = np.moveaxis(np.asarray(values, np.float64), axis, 0)
    middle = (values[1:] + values[:-1]) / 2
    return np.moveaxis(middle.reshape(cells, -1, *middle.shape[1:]).mean(axis=1), 0, axis)


def _units(shares: NDArray[np.float64], possible: NDArray[np.bool_] | None = None) -> NDArray[np.int64]:
    """P_m of every cell in units of 2⁻²⁴, 2²⁴ together, so that sums in float32 are exact.

    Orders have a floor where they are `possible`: where their share is not zero, unless it is given.
    """
    mirror = shares.shape[-1] // 2
    shares = np.maximum(shares, 0)  # interpolation may dip below
    possible = shares > 0 if possible is None else possible
    possible[..., mirror] = True  # order 0 propagates always
    shares = shares / np.maximum(shares.sum(axis=-1, keepdims=True), 1e-30)
    shares = (1 - FLOOR) * shares + FLOOR * possible / possible.sum(axis=-1, keepdims=True)
    units = np.floor(shares * WHOLE).astype(np.int64)
    units[..., mirror] += WHOLE - units.sum(axis=-1)
    return units
