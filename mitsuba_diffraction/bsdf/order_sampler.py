"""A sampler of orders that do not overlap, from tables over ω_i and 1/λ.

In each bin the probability of an order,

    P_m ∝ √⟨p_m²⟩,

minimises the variance of a sample. p_m is the power of the order in `energy/furnace.py`, and ⟨·⟩ the mean over points
of the bin. Directions are mapped to the square of `energy/table.py`.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace
from typing import cast

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from ..energy.furnace import Furnace
from ..energy.table import Layout, frequencies_of
from ..optics.film_stack import Stack
from ..optics.geometry import fresnel
from ..precomputation.grating_spectrum import GratingSpectrum
from ..spectrum.grids import OrderGrid
from .device_tables import NumberTable, PacketTable, integer_part, larger, opaque
from .directions import Incidence, cell_of
from .inversion import direction_bin, direction_borders, search

PROBABILITY_UNITS = 2**24  # to the probability one; float32 represents integers exactly up to it
UNIFORM_FRACTION = 0.05  # of the probability in a bin, divided equally among its orders
# Approximate numbers of entries of a table; larger ones do not fit into the cache. There is a table for each pair of
# incident and outgoing medium, and for each range of height scales; with several ranges, the number is divided by the
# root of theirs. Interfaces have more entries, since orders vary faster with the direction in the denser medium.
MAX_ENTRIES, MAX_INTERFACE_ENTRIES = 1e5, 2.5e5
# Radians, by which the phase of the deepest point in normal reflection from above may change within a bin (of line
# gratings, which have few orders; of other gratings), and between the points of a bin at which powers are evaluated.
MAX_LINE_PHASE, MAX_PHASE, MAX_POINT_PHASE = 2.0, 4.0, 2.5
MIN_WAVELENGTH_BINS, MAX_WAVELENGTH_BINS = 4, 10  # bins of 1/λ
MIN_SIDE_BINS, MAX_SIDE_BINS = 4, 96  # along a side of the square of directions
FRACTION_SIDE_BINS = 64  # likewise, of the transmitted fraction
MAX_INDEX_CHANGE = 0.01  # of η, relative to η − 1, up to which a table is reused


class OrderSampler:
    """P_m in bins of (scale of heights, medium of ω_i, medium of ω_o, 1/λ, row and column of ω_i).

    Attributes:
        cumulative: cumulative sums of P_m over the rectangle of orders that propagate in a bin, in units of 2⁻²⁴.
        bins: for each bin the start in `cumulative`, the first column and row of its rectangle among all orders, and
            the number of columns + 2¹⁶ times the number of rows.
        counts: numbers of bins of 1/λ and along a side of the square; opaque, as they depend on the surface.
        fractions: T e_T/(R e_R + T e_T) in finer bins of directions, from above and from below.
    """

    def __init__(
        self,
        spectrum: GratingSpectrum,
        stack: Stack | None = None,
        is_sheet: bool = False,
        coat_index: float = 1.0,
        height_scales: Sequence[float] = (1.0,),
        laterals: tuple[float, float] = (1.0, 1.0),
    ) -> None:
        """Make the table.

        Args:
            spectrum: with the wavelengths in the densest medium next to the relief.
            stack: the media with the films; None without transmission.
            is_sheet: whether there is a flat lower face, with the upper medium below it.
            coat_index: of a layer over the relief, relative to the outside.
            height_scales: factors of the heights, ascending; each interval between two of them has its own bins.
            laterals: bounds of the factor of lengths along the surface, by which heights are divided.
        """
        grid = cast(OrderGrid, spectrum.grid)
        self.transmits, self.is_sheet, self.stack = stack is not None, is_sheet, stack
        self.eta, self.coat_index = 1.0 if stack is None else stack.nominal, coat_index
        self.tile, self.max_order, self.laterals = np.array(grid.tile_size), np.array(grid.max_order), laterals
        first, last = (frequency / coat_index for frequency in frequencies_of(spectrum, self.eta, laterals))
        sides = (True, False) if self.transmits else (True,)
        phase = 4 * np.pi * spectrum.height_range * float(np.mean(height_scales)) * (last - first)
        max_phase = MAX_LINE_PHASE if 0 in grid.max_order else MAX_PHASE
        self.slices = int(np.clip(phase * coat_index / max_phase, MIN_WAVELENGTH_BINS, MAX_WAVELENGTH_BINS))
        orders = np.minimum((1 + self.eta) * self.tile * (first + last) / 2, 2 * self.max_order) + 1
        ranges: list[tuple[float, ...]] = [*itertools.pairwise(height_scales)] or [tuple(height_scales)]
        entries = MAX_INTERFACE_ENTRIES if self.transmits and not is_sheet else MAX_ENTRIES
        side_bins = np.sqrt(entries / (np.sqrt(len(ranges)) * self.slices * orders.prod()))
        self.side_bins = int(np.clip(side_bins, MIN_SIDE_BINS, MAX_SIDE_BINS))
        self.layout = Layout(0.0, 1, self.side_bins, 1, self.slices + 1, (first, last))
        borders = direction_borders(self.side_bins, 4)
        low, high = borders.min(1), borders.max(1)
        sums, bins, fractions, start = [], [], [], 0
        furnace = Furnace.of(spectrum, 1.0, stack, laterals[0])
        of_sides = {True: furnace, False: furnace.from_below()}
        for scales, above in itertools.product(ranges, sides):
            furnaces = [replace(of_sides[above], height_scale=scale) for scale in scales]
            powers_of_sides = []
            for reflects in sides:
                index = self._indices(above)[0] if reflects else abs(self.eta - 1)
                steps = 1 + int(phase * index / (self.slices * MAX_POINT_PHASE))
                points = [k / steps for k in range(self.slices * steps + 1)]
                squares = [self._squared_powers(furnaces, above, reflects, point) for point in points]
                powers_of_sides.append(np.sqrt(np.mean(squares, axis=0)).sum((-1, -2)).ravel())
                for slice_ in range(self.slices):
                    within = np.sum(squares[slice_ * steps : (slice_ + 1) * steps + 1], axis=0)
                    corner, size = self._order_ranges(above, reflects, slice_, low, high)
                    of_bins, starts = _packed_cumulative(_root_corner_sum(within), corner, size)
                    sums.append(of_bins)
                    bins.append(np.stack([start + starts, *corner.T, size[:, 0] + (size[:, 1] << 16)], -1))
                    start += len(of_bins)
            if not self.transmits:
                continue
            # With E at the central wavelength.
            omega, wavelengths = self._nodes(self.slices / 2)
            furnace, inside = self._at(furnaces[0], above, wavelengths)
            (bounds,) = furnace.bounds(self._inside(omega, above, inside), wavelengths / inside, [scales[0]])
            reflected, transmitted = np.array(powers_of_sides) * bounds
            fraction = (transmitted / np.maximum(reflected + transmitted, 1e-30)).reshape(self.side_bins + 1, -1)
            middles = (np.indices((FRACTION_SIDE_BINS, FRACTION_SIDE_BINS)) + 0.5) * (
                self.side_bins / FRACTION_SIDE_BINS
            )
            fractions.append(map_coordinates(fraction, middles, order=1))
        self.cumulative = NumberTable(np.concatenate(sums))
        self.bins = PacketTable(np.concatenate(bins).astype(np.uint32))
        if self.transmits:
            self.fractions = NumberTable(np.reshape(fractions, (len(ranges), 2, *middles.shape[1:])).mean(axis=0))
        self.counts = opaque(self.slices), opaque(self.side_bins)
        self.edges = [opaque(scale) for scale in height_scales[1:-1]]
        self.first, self.per_slice = opaque(first), opaque(self.slices / (last - first))

    def _indices(self, above: bool, eta: float | None = None) -> tuple[float, float]:
        """Return n next to the relief and outside, above or below; `eta` is the index at a wavelength."""
        eta = eta or self.eta
        return (self.coat_index, 1.0) if above else (eta, 1.0 if self.is_sheet else eta)

    def _at(self, furnace: Furnace, above: bool, wavelengths: NDArray[np.float64]) -> tuple[Furnace, float]:
        """Return the furnace at the wavelength of `wavelengths`, which are equal, and n of the medium of ω_i."""
        at = furnace.at_wavelength(float(wavelengths[0]), self.laterals)
        return at, self.coat_index if above else 1 / (at.index or 1.0)

    def _nodes(self, slice_: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return outside directions at the nodes of the square, and λ above in µm, at a coordinate along 1/λ."""
        nodes = np.indices((1, self.side_bins + 1, self.side_bins + 1)).reshape(3, -1).T.astype(np.float64)
        nodes[:, 0] = slice_
        return self.layout.directions(nodes)

    def _inside(self, omega: NDArray[np.float64], above: bool, inside: float) -> NDArray[np.float64]:
        """Return the directions next to the relief, in the index `inside`, from the directions outside.

        Of light that a sheet reflects totally none enters; it gets the direction at the horizon.
        """
        tangent = omega[:, :2] * (self._indices(above, inside)[1] / inside)
        tangent /= np.maximum(np.sqrt((tangent**2).sum(-1, keepdims=True) / (1 - 1e-12)), 1)
        return np.column_stack([tangent, np.sqrt(1 - (tangent**2).sum(-1))])

    def _squared_powers(
        self, furnaces: Sequence[Furnace], above: bool, reflects: bool, slice_: float
    ) -> NDArray[np.floating]:
        """Return p_m² at the nodes of directions, averaged over scales of heights: (rows, columns, orders, orders)."""
        omega, wavelengths = self._nodes(slice_)
        result = np.zeros((len(omega), *(2 * self.max_order[::-1] + 1)), np.float32)
        for furnace in furnaces:
            powers = np.zeros_like(result)
            furnace, inside = self._at(furnace, above, wavelengths)
            eta = (furnace.index or 1.0) ** (1 if above else -1)
            outside, (relief, outgoing) = self._indices(above, eta)[1], self._indices(above == reflects, eta)
            for way in furnace.branches[:1] if reflects else furnace.branches[1:]:
                node, component, power = furnace.terms(self._inside(omega, above, inside), wavelengths / inside, way)
                m = np.rint((way or 1) * furnace.q[component] * self.tile).astype(np.int64)
                tangent = outside * omega[node, :2] + wavelengths[node, None] * m / self.tile
                square = outgoing**2 - (tangent**2).sum(-1)
                power = power * (square > 0)
                if relief != outgoing:
                    power *= 1 - np.mean(fresnel(np.sqrt(np.maximum(square, 0)) / outgoing, relief / outgoing), axis=0)
                column, row = (m + self.max_order).T
                powers[node, row, column] += power
            result += powers**2 / len(furnaces)
        return result.reshape(self.side_bins + 1, self.side_bins + 1, *result.shape[1:])

    def _order_ranges(
        self, above: bool, reflects: bool, slice_: int, low: NDArray[np.float64], high: NDArray[np.float64]
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return first column and row of the propagating orders of each bin of a slice, and their numbers: (bins, 2).

        They follow from the minima and maxima of ω_∥ outside in the bins, (bins, 2), by |m/T + k_i,∥/λ| ≤ n_o/λ.
        """
        _, wavelengths = self.layout.directions(np.array([[slice_, 0, 0], [slice_ + 1, 0, 0]], np.float64))
        per_wavelength = self.tile / wavelengths[:, None]
        # With a margin for curved borders, dispersion, and an index that changes by `MAX_INDEX_CHANGE`.
        half = self._indices(above == reflects)[1] * per_wavelength + 1e-3
        half += (1e-3 + 2 * MAX_INDEX_CHANGE * max(self.eta, 1)) * per_wavelength.max()
        first, last = (
            -self._indices(above)[1] * omega[:, None] * per_wavelength + sign * half
            for omega, sign in ((high, -1), (low, 1))
        )
        first = np.clip(np.ceil(first.min(1)), -self.max_order, self.max_order).astype(np.int64)
        last = np.clip(np.floor(last.max(1)), -self.max_order, self.max_order).astype(np.int64)
        # From inside of a medium there are no orders beyond the critical angle of all of them.
        return first + self.max_order, np.maximum(last - first + 1, 0)

    def _bin(self, incidence: Incidence, active: mi.Bool) -> tuple[mi.UInt32, mi.Int32, mi.Int32, mi.Int32, mi.Int32]:
        """Return the start of a bin in the table, its first order along x and y, its numbers of columns and rows."""
        max_x, max_y = map(int, self.max_order)
        slices, side_bins = self.counts
        tangent = incidence.tangent / incidence.index
        column, row = direction_bin(mi.Vector3f(*tangent, dr.safe_sqrt(1 - dr.squared_norm(tangent))), side_bins)
        slice_, _ = cell_of((incidence.frequency - self.first) * self.per_slice, slices)
        table, tables = mi.UInt32(0), 4 if self.transmits else 1
        if self.transmits:
            table = dr.select(incidence.above, mi.UInt32(0), 2) + dr.select(incidence.reflects, mi.UInt32(0), 1)
        if self.edges:
            table += sum(dr.select(incidence.height_scale > edge, mi.UInt32(tables), 0) for edge in self.edges)
        side = integer_part(side_bins)
        index = ((table * integer_part(slices) + slice_) * side + row) * side + column
        start, x, y, size = self.bins(index, active)
        return start, mi.Int32(x) - max_x, mi.Int32(y) - max_y, mi.Int32(size & 0xFFFF), mi.Int32(size >> 16)

    def probability(self, m_x: mi.Int32, m_y: mi.Int32, incidence: Incidence, active: mi.Bool) -> mi.Float:
        """Return P_m for one wavelength."""
        start, first_x, first_y, columns, rows = self._bin(incidence, active)
        column, row = m_x - first_x, m_y - first_y
        active = active & (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
        order = start + mi.UInt32(row * columns + column)
        return (self.cumulative(order + 1, active) - self.cumulative(order, active)) * (1 / PROBABILITY_UNITS)

    def sample(self, incidence: Incidence, u: mi.Float, active: mi.Bool) -> tuple[mi.Int32, mi.Int32]:
        """Draw an order for one wavelength."""
        start, first_x, first_y, columns, rows = self._bin(incidence, active)

        def cumulative(index: mi.Int32) -> mi.Float:
            return self.cumulative(start + mi.UInt32(index), active)

        index, _ = search(cumulative, mi.Int32(0), columns * rows, int(np.prod(2 * self.max_order + 1)), u)
        # In masked lanes the number of columns is zero.
        row = mi.Int32((mi.Float(index) + 0.5) / larger(mi.Float(columns), 1))
        return first_x + index - row * columns, first_y + row

    def transmitted_fraction(self, omega: mi.Vector3f) -> mi.Float:
        """Return the transmitted fraction of power, ω along the pattern's axes."""
        column, row = direction_bin(omega, FRACTION_SIDE_BINS)
        return self.fractions(
            (dr.select(omega.z > 0, mi.UInt32(0), FRACTION_SIDE_BINS) + row) * FRACTION_SIDE_BINS + column
        )


def _root_corner_sum(at_nodes: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return the root of the sum over the four corners of each bin, (rows + 1, columns + 1, …) → (bins, …)."""
    rows, columns = (n - 1 for n in at_nodes.shape[:2])
    total = np.sum([at_nodes[j : j + rows, i : i + columns] for j, i in np.ndindex(2, 2)], axis=0)
    return np.sqrt(total.reshape(rows * columns, *at_nodes.shape[2:]))


def _packed_cumulative(
    p: NDArray[np.floating], first: NDArray[np.int64], size: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return the cumulative sums of P over the rectangles of all bins, concatenated, and the start of each.

    Args:
        p: proportional to P_m in the rectangles, (bins, orders, orders).
        first: first column and row of the rectangles, (bins, 2).
        size: their numbers of columns and rows, (bins, 2).
    """
    of_x, of_y = (
        (np.arange(n) >= begin[:, None]) & (np.arange(n) < (begin + count)[:, None])
        for n, begin, count in zip(p.shape[:0:-1], first.T, size.T, strict=True)
    )
    inside = (of_y[:, :, None] & of_x[:, None]).reshape(len(p), -1)
    sums = cumulative_units(p.reshape(len(p), -1).astype(np.float64), inside)
    count = size.prod(1) + 1
    return sums[np.insert(inside, 0, True, 1)], count.cumsum() - count


def cumulative_units(p: NDArray[np.float64], possible: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return cumulative sums of P_m, beginning with zero, in units of 2⁻²⁴: float32 then has exact differences.

    P_m is proportional to `p` among the `possible` orders, but for `UNIFORM_FRACTION`, which is divided equally among
    them, and zero elsewhere: (..., orders) → (..., orders + 1). Where no order is possible, all sums are zero.
    """
    p = p * possible
    p = (1 - UNIFORM_FRACTION) * p / np.maximum(p.sum(axis=-1, keepdims=True), 1e-30)
    p += UNIFORM_FRACTION * possible / np.maximum(possible.sum(axis=-1, keepdims=True), 1)
    sums = np.rint(PROBABILITY_UNITS * p.cumsum(axis=-1) / np.maximum(p.sum(axis=-1, keepdims=True), 1e-30))
    return np.insert(sums, 0, 0, axis=-1)
