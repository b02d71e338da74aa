"""Rigorous orders at run time: the table of efficiencies, and an order drawn by its efficiency."""

from __future__ import annotations

import functools
import math

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..rigorous.efficiencies import MIRRORED
from ..rigorous.spectrum import RigorousSpectrum
from .geometry import Geometry, Incidence, cos_square
from .inversion import search, truncated_gaussian
from .orders import WHOLE
from .tables import PacketTable, larger, limited, opaque, smaller

CELLS = 8  # of the sampler to each unit of P and R
PLANES = 4  # of its cells over the wavelengths
# 2/π asin √x = √x Σ_n a_n xⁿ for x ≤ 1/2, to 4e-7 (least squares at Chebyshev points).
_ARC_SINE = (0.63661934, 0.10616330, 0.04642647, 0.03876191, -0.01541680, 0.06134137)
STEPS = 2**16 - 1  # of η in the table
FLOOR = 0.05  # the share that all orders of a cell have alike, for those that vary within it


class RigorousOrders:
    """Σ_m η_m N(q − m/T; σ_q² I), and the density Σ_m P_m N(q − m/T; σ_q² I) from which q is drawn.

    η_m is that of the pair (ω_i, ω_o), in the coordinates of `Axes`: symmetric under exchange. N is cut off at `reach`
    standard deviations along each axis and scaled up. P_m follows η_m of light from ω_i, averaged over cells of

        p = g + α = P + max(m, 0),    r = g − α = R − min(m, 0),    α = −ω_i,x ν,    g = ν √(1 − ω_i,y²),

    and of the wavelength: in p and r the orders of one direction share one cell.
    """

    resolved = True

    def __init__(self, spectrum: RigorousSpectrum) -> None:
        axes = spectrum.axes
        self.axes = axes
        self.count = int(2 * spectrum.reach * spectrum.lobe_width * axes.period) + 1  # lobes that overlap
        self.table = PacketTable(_packets(spectrum))
        if mi.is_polarized:
            self.matrices = PacketTable(np.moveaxis(spectrum.mueller, 0, 1))
        self.cells = math.gcd(CELLS, axes.steps)
        units = _units(_shares(spectrum, self.cells))
        self.sampler_planes = units.shape[0]
        self.cells_across = units.shape[1]
        before = np.zeros((*units.shape[:3], units.shape[3] + 1))
        before[..., 1:] = units.cumsum(axis=-1)
        self.orders = PacketTable(np.stack([before, np.append(units, 0 * units[..., :1], axis=-1)], axis=-1), width=2)
        sigma, reach = spectrum.lobe_width, spectrum.reach
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

    @dr.syntax
    def evaluate(
        self, geometry: Geometry, incidence: Incidence, active: mi.Bool, wo_is_sample: bool
    ) -> tuple[mi.Float, mi.Float]:
        """cos θ_o Σ_m η_m N and the density of q, both in µm², for one wavelength.

        The lobe of each order keeps its power at the horizon (`Geometry.of_order`).

        Args:
            geometry: of the pair of directions, along the pattern's axes.
            incidence: the wavelength and where it comes from.
            active: mask.
            wo_is_sample: whether ω_o was drawn, so that nearly always it lies in the lobe of an order.
        """
        q = geometry.tangent * incidence.frequency
        near = active & self.meets(q.x, q.y)
        power, density, needed = mi.Float(0.0), mi.Float(0.0), wo_is_sample or near
        # Most directions lie between the orders: unless ω_o is a sample, they skip all that reads tables.
        # What has no derivative is bound here: Dr.Jit carries all other state through the branch.
        read = functools.partial(self._read, incidence, near)
        if needed:
            power, density = read(geometry)
        return power, density

    def _coordinates(self, wi: mi.Vector3f, wo: mi.Vector3f, frequency: mi.Float) -> tuple[mi.Float, ...]:
        """q_x, q_y in cycles/µm, and k_y, c, g and the third coordinate of `Axes`."""
        nu = self.period * frequency
        k_y, c = 0.5 * nu * (wo.y - wi.y), 0.5 * nu * (wo.x - wi.x)
        g = dr.sqrt(larger(dr.square(nu) - dr.square(k_y), 0))
        return -(wi.x + wo.x) * frequency, -(wi.y + wo.y) * frequency, k_y, c, g, self._z(g, frequency)

    def _read(self, incidence: Incidence, near: mi.Bool, geometry: Geometry) -> tuple[mi.Float, mi.Float]:
        """As `evaluate`, where `near`; else zero."""
        # Its tables are those inside of a coat.
        frequency = incidence.frequency
        q_x, q_y, _, c, g, z = self._coordinates(*geometry.inside(), geometry.index * frequency)
        cell = self._cell(incidence)
        first = self._first(q_x)
        power, density = mi.Float(0.0), mi.Float(0.0)
        for step in range(self.count):
            m = first + step
            offset = dr.fma(-self.pitch, mi.Float(m), q_x)
            there = near & (dr.abs(offset) <= self.half_width) & (dr.abs(m) <= self.axes.largest)
            square = dr.square(offset) + dr.square(q_y)
            lobe = dr.select(there, self.peak * dr.exp(self.falloff * square), 0)
            tangent = mi.Vector2f(mi.Float(m) * self.pitch / frequency, 0)
            *_, gain = geometry.of_order(tangent, frequency * self.per_width)
            power += lobe * gain * self._efficiency(m, c, g, z, there)
            # An order that does not propagate is not drawn.
            there &= cos_square(geometry.wi, tangent) > 0
            density += dr.select(there, lobe, 0) * self.orders(mi.UInt32(dr.select(there, cell + m, 0)), there).y
        return power * geometry.cos_o, density / WHOLE

    def mueller(
        self, source: mi.Vector3f, exit_: mi.Vector3f, frequency: mi.Float, active: mi.Bool
    ) -> list[list[mi.Float]]:
        """M_ij / M_00 of light from `source`, from all orders whose lobes reach the pair; the identity where none does.

        Args:
            source, exit_: along the pattern's axes.
            frequency: 1/λ in cycles/µm.
            active: mask.
        """
        q_x, q_y, k_y, c, g, z = self._coordinates(source, exit_, frequency)
        first = self._first(q_x)
        rows = [mi.Vector4f(0.0) for _ in range(4)]
        for step in range(self.count):
            m = first + step
            offset = dr.fma(-self.pitch, mi.Float(m), q_x)
            there = active & (dr.abs(offset) <= self.half_width) & (dr.abs(q_y) <= self.half_width)
            there &= dr.abs(m) <= self.axes.largest
            lobe = dr.select(there, dr.exp(self.falloff * (dr.square(offset) + dr.square(q_y))), 0)
            for row, found in enumerate(self._matrix(m, c, g, z, there)):
                rows[row] += lobe * found
        bright = rows[0].x > 0
        mirrored, changed = dr.select(k_y < 0, mi.Float(-1), mi.Float(1)), np.not_equal.outer(MIRRORED, MIRRORED)
        scale = dr.rcp(dr.select(bright, rows[0].x, mi.Float(1)))
        return [
            [
                dr.select(bright, rows[i][j] * scale * (mirrored if changed[i, j] else 1), mi.Float(i == j))
                for j in range(4)
            ]
            for i in range(4)
        ]

    def _matrix(self, m: mi.Int32, c: mi.Float, g: mi.Float, z: mi.Float, active: mi.Bool) -> list[mi.Vector4f]:
        """The rows of M of order m, linear between the nodes."""
        active, start, side, places = self._place(m, c, g, active)
        places = [*places, _split(z * (self.axes.planes - 1), mi.UInt32(self.axes.planes))]
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

    def sample(self, incidence: Incidence, u: mi.Float, v: mi.Point2f, active: mi.Bool) -> tuple[mi.Point2f, mi.Bool]:
        """Draw q in cycles/µm, for one wavelength, and tell whether the order of q propagates.

        The order comes from `u`, its place in the lobe from `v`.
        """
        middle = self._cell(incidence)
        largest = self.axes.largest

        def before(m: mi.Int32) -> mi.Float:
            return self.orders(mi.UInt32(middle + m), active).x

        m, _ = search(before, mi.Int32(-largest), mi.Int32(largest + 1), 2 * largest + 1, u)
        x, y = (truncated_gaussian(number, self.inside, self.spread) for number in v)
        tangent = mi.Vector2f(mi.Float(m) * self.pitch / incidence.frequency, 0)
        return mi.Point2f(dr.fma(self.pitch, mi.Float(m), x), y), cos_square(incidence.wi, tangent) > 0

    def _z(self, g: mi.Float, frequency: mi.Float) -> mi.Float:
        """Z / (K − 1), from 0 to 1."""
        most = self.period / larger(g, 1e-6)
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

    def _efficiency(self, m: mi.Int32, c: mi.Float, g: mi.Float, z: mi.Float, active: mi.Bool) -> mi.Float:
        """η_m(P, R, Z), linear between the nodes; 0 for an order that does not propagate."""
        active, start, side, ((i, f), (j, h)) = self._place(m, c, g, active)
        k, w = _split(z * (self.axes.planes - 1), mi.UInt32(self.axes.planes))
        packet = self.table((start + i * side + j) * (self.axes.planes - 1) + k, active)
        # Along Z the lower and the upper half of each word; then along R, then along P.
        along_z = [dr.lerp(mi.Float(word & 0xFFFF), mi.Float(word >> 16), w) for word in packet]
        found = dr.lerp(dr.lerp(along_z[0], along_z[1], h), dr.lerp(along_z[2], along_z[3], h), f)
        return dr.select(active, found * (1 / STEPS), 0)

    def _place(
        self, m: mi.Int32, c: mi.Float, g: mi.Float, active: mi.Bool
    ) -> tuple[mi.Bool, mi.UInt32, mi.UInt32, list[tuple[mi.UInt32, mi.Float]]]:
        """Whether order m propagates, where its nodes start, their side, the nodes along P and R and the rest."""
        half = 0.5 * mi.Float(dr.abs(m))
        p, r = g + c - half, g - c - half
        active = active & (p > 0) & (r > 0)
        start, side = self._layout(dr.select(active, m, 0))
        places = [_split(self._position(dr.select(active, x, 0)) * self.axes.steps, side) for x in (p, r)]
        return active, start, side, places

    def _layout(self, m: mi.Int32) -> tuple[mi.UInt32, mi.UInt32]:
        """Where order m starts in a plane, and its side, as `Axes.offset` and `Axes.side` have them.

        The side of order k is A − s |k|; of the orders 1 … n the squares add up to n A² − A s n (n + 1)
        + s² n (n + 1)(2n + 1)/6.
        """
        steps, longest, most = self.axes.steps, self.axes.side(0), self.axes.largest

        def squares(n: mi.Int32 | int) -> mi.Int32 | int:
            return n * longest**2 - longest * steps * n * (n + 1) + steps**2 * (n * (n + 1) * (2 * n + 1) // 6)

        n = dr.abs(m)
        side, below = longest - steps * n, squares(most)
        start = dr.select(m > 0, below + longest**2 + squares(n) - side * side, below - squares(n))
        return mi.UInt32(start), mi.UInt32(side)

    def _cell(self, incidence: Incidence) -> mi.Int32:
        """Where order 0 of the sampler's cell stands in its table."""
        # Tangential components are the same inside of a coat.
        along, across = (self.period * incidence.frequency * s for s in (incidence.wi.x, incidence.wi.y))
        frequency = incidence.index * incidence.frequency
        g = dr.safe_sqrt(dr.square(self.period * frequency) - dr.square(across))
        p, r = (
            dr.clip(mi.Int32(self.cells * self._position(larger(x, 0))), 0, self.cells_across - 1)
            for x in (g - along, g + along)
        )
        z = dr.clip(mi.Int32(self._z(g, frequency) * self.sampler_planes), 0, self.sampler_planes - 1)
        width = 2 * self.axes.largest + 2
        return ((z * self.cells_across + p) * self.cells_across + r) * width + self.axes.largest


def _split(x: mi.Float, count: mi.UInt32) -> tuple[mi.UInt32, mi.Float]:
    """The node below x, at most the last but one, and how far x is beyond it."""
    low = dr.minimum(mi.UInt32(x), count - 2)
    return low, x - mi.Float(low)


def _packets(spectrum: RigorousSpectrum) -> NDArray[np.uint32]:
    """η_m at the eight nodes about each cell, in steps of 1/65535: (nodes, K − 1, 4).

    Node (i, j, k) has the words of (i, j), (i, j + 1), (i + 1, j), (i + 1, j + 1), each with k in its lower half and
    k + 1 in its upper one: a single read of 16 bytes for an efficiency. Between the nodes that were solved the table
    may dip below zero, or exceed one, by its error.
    """
    packets = np.empty((spectrum.axes.nodes, spectrum.axes.planes - 1, 4), np.uint32)
    for m in spectrum.axes.orders:
        square = np.moveaxis(spectrum.axes.square(spectrum.values, m), 0, -1)
        side, start = square.shape[0], spectrum.axes.offset(m)
        steps = np.rint(np.clip(square, 0, 1).astype(np.float64) * STEPS).astype(np.uint32)
        words = np.pad(steps[..., :-1] | steps[..., 1:] << 16, [(0, 1), (0, 1), (0, 0)], mode="edge")
        corners = [words[i : side + i, j : side + j] for i, j in np.ndindex(2, 2)]
        packets[start : start + side**2] = np.stack(corners, axis=-1).reshape(side**2, -1, 4)
    return packets


def _shares(spectrum: RigorousSpectrum, cells: int) -> NDArray[np.float64]:
    """η_m averaged over the sampler's cells, (Z, p, r, orders); `cells` of them to each unit.

    An order that is evanescent by less than the reach of its lobe has half of what it has where it begins to propagate.
    """
    axes = spectrum.axes
    planes = math.gcd(PLANES, axes.planes - 1)
    margin = spectrum.reach * spectrum.lobe_width * axes.period
    whole = axes.units(0) * cells
    ends = -np.arange(whole)  # of the cells below P = 0
    ends = ends // cells + np.sin(np.pi / 2 * (ends % cells) / cells) ** 2
    beyond = int((ends > -margin).sum())
    shares = np.zeros((planes, whole, whole, 2 * axes.largest + 1))
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


def _averaged(values: NDArray, axis: int, cells: int) -> NDArray[np.float64]:
    """The mean over each of so many cells along one axis, of what is linear between the nodes."""
    values = np.moveaxis(np.asarray(values, np.float64), axis, 0)
    middle = (values[1:] + values[:-1]) / 2
    return np.moveaxis(middle.reshape(cells, -1, *middle.shape[1:]).mean(axis=1), 0, axis)


def _units(shares: NDArray[np.float64]) -> NDArray[np.int64]:
    """P_m of every cell in units of 2⁻²⁴, 2²⁴ together, so that sums in float32 are exact."""
    mirror = shares.shape[-1] // 2
    shares = np.maximum(shares, 0)  # interpolation may dip below
    possible = shares > 0
    possible[..., mirror] = True  # order 0 propagates always
    shares = shares / np.maximum(shares.sum(axis=-1, keepdims=True), 1e-30)
    shares = (1 - FLOOR) * shares + FLOOR * possible / possible.sum(axis=-1, keepdims=True)
    units = np.floor(shares * WHOLE).astype(np.int64)
    units[..., mirror] += WHOLE - units.sum(axis=-1)
    return units
