"""Rigorous orders at run time: the table of efficiencies, and the sampler of orders."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..rigorous.rigorous_spectrum import RigorousSpectrum
from ..rigorous.solver import ODD, REVERSED
from .device_tables import NumberTable, PacketTable, integer_part, larger, limited, opaque, smaller
from .directions import Geometry, Incidence, WaveVector, cell_of
from .inversion import search, truncated_gaussian
from .order_sampler import PROBABILITY_UNITS, cumulative_units

BINS_PER_UNIT = 8  # of the sampler, along p and r
TRANSMISSION_BINS_PER_UNIT = 4  # likewise, where light is transmitted
WAVELENGTH_BINS = 4  # of the sampler
# 2/π asin √x = √x Σ_n a_n xⁿ for x ≤ 1/2, to 4e-7 (least squares at Chebyshev points).
_ARC_SINE = (0.63661934, 0.10616330, 0.04642647, 0.03876191, -0.01541680, 0.06134137)
_BIN_POINTS = tuple(itertools.product((0.1, 0.9), repeat=3))  # of the mean of η over a bin, along Z, p and r
MAX_STORED = 2**16 - 1  # the integer that represents η = 1 in the table


@dataclass(eq=False)
class _Pair:
    """A pair of directions in the coordinates of `Axes`.

    Attributes:
        q: cycles/µm.
        half: (c, k_y) of `Axes`, half of the difference of k_∥ in units of 2π/T.
        square: γ².
        inside: γ'²; zero if Z is the wavelength.
        z: Z, if it is the wavelength.
        above: whether the incident and the outgoing direction are above; None without transmission.
    """

    q: mi.Vector2f
    half: mi.Vector2f
    square: mi.Float
    inside: mi.Float
    z: mi.Float
    above: tuple[mi.Bool, mi.Bool] | None


class _Position(NamedTuple):
    """The coordinates of an order of a pair in the table.

    Attributes:
        row: of the table.
        nodes: of F, X and Z: the grid cell, and the coordinate in it.
        is_reversed: whether the table holds the reverse of the pair.
        active: whether the order propagates.
    """

    row: mi.UInt32
    nodes: list[tuple[mi.UInt32, mi.Float]]
    is_reversed: mi.Bool
    active: mi.Bool


class RigorousOrders:
    """Σ_m η_m Γ N(q − m/T; σ_q² I), and the density Σ_m P_m N(q − m/T; σ_q² I) from which q is drawn.

    η_m of the pair (ω_i, ω_o), in the coordinates of `Axes`, is symmetric under exchange. Γ is the gain of the lobe of
    each order. N is truncated along each axis at `cutoff_sigmas` standard deviations and normalised. P_m is
    proportional to η_m of light from ω_i, averaged over bins of

        p = g + α,    r = g − α,    α = −ω_i,x ν,    g = ν √(1 − ω_i,y²),

    and of the wavelength; all orders of one incident direction are in the same bin. With transmission, α and g are
    computed in the medium of ω_i. Reflected and transmitted light from above and from below have separate bins.
    """

    resolved = True

    def __init__(self, spectrum: RigorousSpectrum) -> None:
        axes = spectrum.axes
        self.axes = axes
        self.count = int(2 * spectrum.cutoff_sigmas * spectrum.lobe_width * axes.period) + 1  # lobes that overlap
        self.table = PacketTable(_packets(spectrum.values))
        if mi.is_polarized:
            self.matrices = PacketTable(np.asarray(spectrum.mueller))
        self.transmits = spectrum.transmission != "none"
        self.interface = spectrum.transmission == "interface"
        self.max_order = axes.max_order
        self.starts = NumberTable(axes.starts.astype(np.uint32))
        self.excess, self.top = opaque(axes.excess), opaque(axes.excess_limit)
        self.bins_per_unit = TRANSMISSION_BINS_PER_UNIT if self.transmits else BINS_PER_UNIT
        sums = cumulative_units(*_bin_efficiencies(spectrum, self.bins_per_unit))
        self.wavelength_bins, self.bins_across = sums.shape[-4], sums.shape[-2]
        self.orders = PacketTable(np.stack([sums, np.diff(sums, append=sums[..., -1:])], axis=-1), width=2)
        sigma, cutoff = spectrum.lobe_width, spectrum.cutoff_sigmas
        inside = math.erf(cutoff / math.sqrt(2))  # the fraction of the Gaussian inside of the cutoff, along one axis
        self.spread, self.inside = opaque(np.sqrt(2) * sigma), opaque(inside)
        self.peak, self.falloff = opaque(1 / (2 * np.pi * (sigma * inside) ** 2)), opaque(-0.5 / sigma**2)
        self.half_width, self.per_width = opaque(cutoff * sigma), opaque(1 / sigma)
        self.period, self.pitch = opaque(axes.period), opaque(1 / axes.period)
        self.shortest, self.longest = (opaque(w) for w in axes.wavelengths)

    def meets(self, q_x: mi.Float, q_y: mi.Float, scale: float = 1.0) -> mi.Bool:
        """As `Scattering.meets`; the lateral scale is one."""
        return (mi.Float(self._first(q_x)) * self.pitch - q_x <= self.half_width) & (dr.abs(q_y) <= self.half_width)

    def _first(self, q_x: mi.Float) -> mi.Int32:
        """Return the first order whose lobe may contain q_x."""
        return mi.Int32(dr.ceil((q_x - self.half_width) * self.period))

    def _near(self, pair: _Pair, active: mi.Bool) -> Iterator[tuple[mi.Int32, mi.Float, mi.Bool]]:
        """Yield m, |q − m/T|², and whether the lobe contains q_x, of the orders whose lobes may contain q."""
        first = self._first(pair.q.x)
        for step in range(self.count):
            m = first + step
            offset = dr.fma(-self.pitch, mi.Float(m), pair.q.x)
            in_lobe = active & (dr.abs(offset) <= self.half_width) & (dr.abs(m) <= self.max_order)
            yield m, dr.square(offset) + dr.square(pair.q.y), in_lobe

    def power_and_density(self, geometry: Geometry, incidence: Incidence, active: mi.Bool) -> tuple[mi.Float, mi.Float]:
        """As `Scattering.power_and_density`, with the gain Γ of `Geometry.order_squares_and_gain`."""
        frequency = incidence.frequency
        # Under a coat, the table is for wavelengths inside of it.
        pair = self._pair(geometry.incident, geometry.outgoing, frequency, incidence.coat_index * frequency)
        order_0 = self._bin(incidence)
        power, density = mi.Float(0.0), mi.Float(0.0)
        for m, square, in_lobe in self._near(pair, active):
            lobe = dr.select(in_lobe, self.peak * dr.exp(self.falloff * square), 0)
            tangent = mi.Vector2f(mi.Float(m) * self.pitch * incidence.wavelength, 0)
            *_, gain = geometry.order_squares_and_gain(tangent, frequency * self.per_width)
            power += lobe * gain * self._efficiency(m, pair, in_lobe)
            # Evanescent orders are not drawn.
            in_lobe &= incidence.propagates(tangent)
            entry = self.orders(mi.UInt32(dr.select(in_lobe, order_0 + m, 0)), in_lobe)
            density += dr.select(in_lobe, lobe, 0) * entry.y
        return power * geometry.factor, density / PROBABILITY_UNITS

    def _pair(self, k_i: WaveVector, k_o: WaveVector, outside: mi.Float, frequency: mi.Float) -> _Pair:
        """Return the coordinates of a pair of directions, from 1/λ outside and next to the relief above."""
        nu, half = self.period * frequency, 0.5 * self.period * outside * (k_o.tangent - k_i.tangent)
        square = dr.square(nu) - dr.square(half.y)
        inside, z, above = mi.Float(0.0), mi.Float(0.0), None
        if self.transmits:
            inside = larger(dr.fma(self.excess, dr.square(nu), square), 0)
            above = k_i.sign > 0, k_o.sign > 0
        else:
            z = self._z(dr.sqrt(larger(square, 0)), frequency)
        if not self.interface:
            square = larger(square, 0)
        return _Pair(-(k_i.tangent + k_o.tangent) * outside, half, square, inside, z, above)

    def mueller(self, k_i: WaveVector, k_o: WaveVector, frequency: mi.Float, active: mi.Bool) -> list[list[mi.Float]]:
        """Return M_ij / M_00 over all orders whose lobes contain a pair of directions; else the identity.

        Args:
            k_i, k_o: of source and exit, along the pattern's axes; under a coat, of the directions inside.
            frequency: 1/λ in cycles/µm, next to the relief above.
            active: mask.
        """
        pair = self._pair(k_i, k_o, frequency, frequency)
        rows = [mi.Vector4f(0.0) for _ in range(4)]
        for m, square, in_lobe in self._near(pair, active & (dr.abs(pair.q.y) <= self.half_width)):
            lobe = dr.select(in_lobe, dr.exp(self.falloff * square), 0)
            for row, found in enumerate(self._matrix(m, pair, in_lobe)):
                rows[row] += lobe * found
        bright = rows[0].x > 0
        across = pair.half.y / (self.period * frequency)
        scale = dr.rcp(dr.select(bright, rows[0].x, mi.Float(1)))
        matrix = [[rows[i][j] * scale * (across if ODD[i, j] else 1) for j in range(4)] for i in range(4)]
        # Interpolated matrices may have a degree of polarisation above one: then all elements but M_00 are reduced.
        polarised = [sum(dr.square(m) for m in line[1:]) for line in (matrix[0], [row[0] for row in matrix])]
        limit = dr.rsqrt(larger(larger(*polarised), 1))
        return [
            [dr.select(bright, matrix[i][j] * (limit if i or j else 1), mi.Float(i == j)) for j in range(4)]
            for i in range(4)
        ]

    def _matrix(self, m: mi.Int32, pair: _Pair, active: mi.Bool) -> list[mi.Vector4f]:
        """Return the rows of M of order m, linear between the nodes."""
        table_row, nodes, is_reversed, active = self._position(m, pair, active)
        rows = [mi.Vector4f(0.0) for _ in range(4)]
        for corner in np.ndindex(2, 2, 2):
            node, weight = table_row, mi.Float(1)
            for (low, fraction), up, steps in zip(nodes, corner, self.axes.steps, strict=True):
                node = node * (steps + 1) + low + up
                weight *= fraction if up else 1 - fraction
            for row in range(4):
                rows[row] += weight * self.matrices(node * 4 + row, active)
        reversed_rows = [
            mi.Vector4f(*(float(REVERSED[i] * REVERSED[j]) * rows[j][i] for j in range(4))) for i in range(4)
        ]
        return [dr.select(is_reversed, other, row) for row, other in zip(rows, reversed_rows, strict=True)]

    def sample(self, incidence: Incidence, u: mi.Float, v: mi.Point2f, active: mi.Bool) -> tuple[mi.Point2f, mi.Bool]:
        """As `Scattering.sample`."""
        order_0, max_order = self._bin(incidence), self.max_order

        def cumulative(m: mi.Int32) -> mi.Float:
            return self.orders(mi.UInt32(order_0 + m), active).x

        m, _ = search(cumulative, mi.Int32(-max_order), mi.Int32(max_order + 1), 2 * max_order + 1, u)
        x, y = (truncated_gaussian(number, self.inside, self.spread) for number in v)
        tangent = mi.Vector2f(mi.Float(m) * self.pitch * incidence.wavelength, 0)
        return mi.Point2f(dr.fma(self.pitch, mi.Float(m), x), y), incidence.propagates(tangent)

    def _z(self, g: mi.Float, frequency: mi.Float) -> mi.Float:
        """Return Z of the wavelength, from 0 to 1."""
        cutoff = self.period / larger(g, 1e-6)
        first, last = smaller(self.shortest, cutoff), smaller(self.longest, cutoff)
        return limited((dr.rcp(frequency) - first) / larger(last - first, 1e-6), 0, 1)

    def _efficiency(self, m: mi.Int32, pair: _Pair, active: mi.Bool) -> mi.Float:
        """Return η_m, linear between the nodes; 0 for an evanescent order."""
        at = self._position(m, pair, active)
        row, active, ((i, f), (j, h), (k, w)) = at.row, at.active, at.nodes
        f_steps, x_steps, z_steps = self.axes.steps
        packet = self.table(((row * f_steps + i) * x_steps + j) * z_steps + k, active)
        # Along Z between the lower and the upper half of each word, then along X and F.
        along_z = [dr.lerp(mi.Float(mi.Int32(word & 0xFFFF)), mi.Float(mi.Int32(word >> 16)), w) for word in packet]
        found = dr.lerp(dr.lerp(along_z[0], along_z[1], h), dr.lerp(along_z[2], along_z[3], h), f)
        return dr.select(active, found * (1 / MAX_STORED), 0)

    def _position(self, m: mi.Int32, pair: _Pair, active: mi.Bool) -> _Position:
        """Return the coordinates of order m of a pair in the table."""
        k_x = pair.half.x + 0.5 * mi.Float(m)
        whole = dr.round(k_x)
        n, a = mi.Int32(whole), dr.abs(k_x - whole)
        is_reversed = k_x < whole
        # The orders of the incident and of the outgoing direction.
        orders = dr.select(is_reversed, m - n, n), dr.select(is_reversed, -n, n - m)
        cell, low, high = _grid_cell(pair.square, a)
        inner, inside = mi.UInt32(0), pair.z
        if self.transmits:
            inner, low_inside, high_inside = _grid_cell(pair.inside, a)
            if self.interface:
                low, low_inside = (
                    dr.select(cell == 0, low_inside - self.top, low),
                    dr.select(inner == 0, low + self.top, low_inside),
                )
            inside = _arc(limited((pair.inside - low_inside) / larger(high_inside - low_inside, 1e-7), 0, 1))
        near, far = dr.sqrt(larger(pair.square - low, 1e-12)), dr.sqrt(larger(high - pair.square, 1e-12))
        coordinates = _arc(2 * a), near / (near + far), inside
        nodes = [cell_of(x * steps, steps) for x, steps in zip(coordinates, self.axes.steps, strict=True)]
        cells, inner_cells = self.axes.starts.shape
        start = self.starts(dr.minimum(cell, cells - 1) * inner_cells + dr.minimum(inner, inner_cells - 1))
        active = active & (start < 0x80000000) & (cell < cells) & (inner < inner_cells)
        count, channels = cell, []
        if self.transmits:
            count_below = inner if self.interface else cell
            count = cell + count_below
        for number, order in enumerate(orders):
            channel, channels_of_side, first = mi.UInt32(dr.select(order >= 0, 2 * order, -2 * order - 1)), cell, 0
            if pair.above is not None:
                above = dr.select(is_reversed, pair.above[1 - number], pair.above[number])
                channels_of_side, first = dr.select(above, cell, count_below), dr.select(above, 0, cell)
            active &= channel < channels_of_side
            channels.append(channel + first)
        row = dr.select(active, start + channels[0] * count + channels[1], 0)
        return _Position(row, nodes, is_reversed, active)

    def _bin(self, incidence: Incidence) -> mi.Int32:
        """Return the index of order 0 in the bin of the sampler."""
        # Tangential components are the same inside of a coat.
        along, across = self.period * incidence.frequency * incidence.tangent
        frequency = incidence.coat_index * incidence.frequency
        g = dr.safe_sqrt(dr.square(self.period * incidence.index * frequency) - dr.square(across))
        p, r = (
            dr.clip(mi.Int32(self.bins_per_unit * _arc_coordinate(larger(x, 0))), 0, self.bins_across - 1)
            for x in (g - along, g + along)
        )
        # λ is measured above, g in the medium of ω_i.
        z = dr.clip(
            mi.Int32(self._z(g / incidence.index, frequency) * self.wavelength_bins), 0, self.wavelength_bins - 1
        )
        if self.transmits:
            first = dr.select(incidence.above, 0, 2 * self.wavelength_bins)
            z += first + dr.select(incidence.reflects, 0, self.wavelength_bins)
        width = 2 * self.max_order + 2
        return ((z * self.bins_across + p) * self.bins_across + r) * width + self.max_order


def _arc(t: mi.Float) -> mi.Float:
    """Return 2/π asin √t, 0 ≤ t ≤ 1."""
    near = smaller(t, 1 - t)
    # Positive, as the root has no derivative at zero.
    root = dr.sqrt(larger(near, 1e-12))
    value = mi.Float(_ARC_SINE[-1])
    for coefficient in _ARC_SINE[-2::-1]:
        value = dr.fma(value, near, coefficient)
    value *= root
    return dr.select(t < 0.5, value, 1 - value)


def _arc_coordinate(p: mi.Float) -> mi.Float:
    """Return the coordinate of p ≥ 0 that is an arc sine within each unit."""
    whole = dr.floor(p)
    return whole + _arc(p - whole)


def _grid_cell(square: mi.Float, a: mi.Float) -> tuple[mi.UInt32, mi.Float, mi.Float]:
    """Return the grid cell of γ², and h² at its beginning (undefined for cell 0) and end."""
    root = dr.sqrt(larger(square, 0))
    whole = dr.floor(root)
    part = root - whole
    far = part >= 1 - a
    within = (part >= a) & (part < 1 - a)
    middle = whole + dr.select(far, mi.Float(1), dr.select(within, mi.Float(0.5), mi.Float(0)))
    half = dr.select(within, 0.5 - a, a)
    return integer_part(2 * middle), dr.square(middle - half), dr.square(middle + half)


def _packets(values: NDArray[np.float32]) -> NDArray[np.uint32]:
    """Return η at the eight corners of each grid cell in units of 1/65535, (rows, cells of F, of X, of Z, 4).

    Cell (i, j, k) has the words of (i, j), (i, j + 1), (i + 1, j), (i + 1, j + 1), each with k in its lower half and
    k + 1 in its upper one, so that an efficiency is a single read of 16 bytes.
    """
    rows, f, x, z = values.shape
    packets = np.empty((rows, f - 1, x - 1, z - 1, 4), np.uint32)
    for row in range(rows):
        steps = np.rint(values[row].astype(np.float64) * MAX_STORED).astype(np.uint32)
        words = steps[..., :-1] | steps[..., 1:] << 16
        for corner, (i, j) in enumerate(np.ndindex(2, 2)):
            packets[row, ..., corner] = words[i : f - 1 + i, j : x - 1 + j]
    return packets


def _bin_efficiencies(spectrum: RigorousSpectrum, bins_per_unit: int) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return η_m in the bins of the sampler, and whether m may propagate, both (ways, Z, p, r, orders).

    The ways are above → above and, with transmission, above → below, below → below, below → above.
    """
    axes = spectrum.axes
    nu, max_order = axes.max_nu, axes.max_order
    ways = [(0, 0)] if spectrum.transmission == "none" else [(0, 0), (0, 1), (1, 1), (1, 0)]
    m = np.arange(-max_order, max_order + 1)
    across = int(np.ceil(2 * max(spectrum.indices) * nu)) * bins_per_unit
    efficiencies = np.zeros((len(ways), WAVELENGTH_BINS, across, across, len(m)))
    possible = np.zeros(efficiencies.shape, bool)
    ends = np.arange(across + 1)
    ends = ends // bins_per_unit + np.sin(np.pi / 2 * (ends % bins_per_unit) / bins_per_unit) ** 2

    def inside_bins(fraction: float) -> NDArray[np.float64]:
        return ends[:-1] + fraction * np.diff(ends)

    def wavelengths(g: NDArray[np.float64], n: float, fraction: NDArray[np.float64]) -> NDArray[np.float64]:
        first, last = (np.minimum(w, n * axes.period / np.maximum(g, 1e-9)) for w in axes.wavelengths)
        return first + fraction * (last - first)

    for way, (incident, outgoing) in enumerate(ways):
        n_i, n_o = (spectrum.indices[side] for side in (incident, outgoing))
        # The bins that contain propagating light.
        p, r = np.nonzero(np.add.outer(ends[:-1], ends[:-1]) < 2 * n_i * nu)
        z = np.repeat(np.arange(WAVELENGTH_BINS), len(p))
        p, r = np.tile(p, WAVELENGTH_BINS), np.tile(r, WAVELENGTH_BINS)
        max_g = np.minimum((ends[p + 1] + ends[r + 1]) / 2, n_i * nu)
        shortest = wavelengths(max_g, n_i, z / WAVELENGTH_BINS)
        longest = wavelengths((ends[p] + ends[r]) / 2, n_i, (z + 1) / WAVELENGTH_BINS)
        change = (n_o**2 - n_i**2) * (axes.period / (shortest if n_o > n_i else longest)) ** 2
        g_out = np.sqrt(np.maximum(max_g**2 + change, 0))
        low, high = (ends[p] - ends[r + 1]) / 2, (ends[p + 1] - ends[r]) / 2
        may = np.maximum(low[:, None] - m, m - high[:, None]) < g_out[:, None]
        possible[way, z, p, r] = may
        index, order = np.nonzero(may)
        found, of_order = np.zeros((2, len(index))), m[order]
        for t, u, v in _BIN_POINTS:
            x, y = inside_bins(u)[p], inside_bins(v)[r]
            g, alpha = (x + y) / 2, (x - y) / 2
            wavelength = wavelengths(g, n_i, (z + t) / WAVELENGTH_BINS)
            square = g**2 - (n_i**2 - 1) * (axes.period / wavelength) ** 2
            g = np.sign(square) * np.sqrt(np.abs(square))
            eta = spectrum.evaluate(
                of_order, alpha[index] - of_order / 2, g[index], wavelength[index], (incident, outgoing)
            )
            found += eta, eta > 0
        # The mean over the points at which the order propagates, as the horizon may cross a bin.
        efficiencies[way, z[index], p[index], r[index], order] = found[0] / np.maximum(found[1], 1)
    possible[..., max_order] = True  # order 0 always propagates
    return efficiencies, possible
