"""An order drawn from a table over ω_i and 1/λ, where orders do not overlap.

In each bin the probability P_m follows the powers of the orders that `energy/furnace.py` finds at points of the bin,

    P_m ∝ √⟨η_m²⟩

the density for which the variance of a sample is least. Directions have the square of `energy/table.py`.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from ..energy.furnace import Furnace
from ..energy.table import Layout, bounds_of, frequencies_of
from ..geometry import fresnel
from ..grating_spectrum import GratingSpectrum
from .geometry import Incidence, cell_of, on_square
from .inversion import search
from .tables import NumberTable, PacketTable, larger, opaque

WHOLE = 2**24  # a float32 holds whole numbers up to here
UNIFORM_FRACTION = 0.05  # of the probability in a bin, that all its orders have alike
# Numbers of a table, about, times √ranges of heights and for each way of light: more would only fill the cache; of an
# interface more, since from inside, where waves are shorter, orders change faster with direction.
ENTRIES, ENTRIES_OF_INTERFACE = 1e5, 2.5e5
# Radians by which the phase of the deepest point may change within a bin, by reflection from above: of line gratings,
# which have few orders, and of others; and between the points of a bin.
MAX_PHASE_OF_LINES, MAX_PHASE, MAX_PHASE_OF_POINTS = 2.0, 4.0, 2.5
SLICES = 4, 10  # bins of 1/λ: minimum and maximum
SIDES = 4, 96  # bins along the square of directions, likewise
FRACTION_BINS = 64  # of the transmitted fraction, along the square
CHANGE = 0.01  # of η, relative to η − 1, for which a table serves


class OrderSampler:
    """P_m of light from either side to either side, in bins: (scale of heights, from, to, 1/λ, row, column of ω_i).

    Attributes:
        before: Σ P of the orders before each of the rectangle that propagates in a bin, in units of 2⁻²⁴.
        bins: of each the start in `before`, first column and row among all orders, and columns + 2¹⁶ rows.
        counts: bins along the slices and along the square, as arrays: tables of other heights have others.
        fractions: T e_T/(R e_R + T e_T) in finer bins of directions, from above and from below.
    """

    def __init__(
        self,
        spectrum: GratingSpectrum,
        eta: float | None = None,
        is_sheet: bool = False,
        coat_index: float = 1.0,
        height_scales: Sequence[float] = (1.0,),
        min_lateral_scale: float = 1.0,
    ) -> None:
        """Make the table.

        Args:
            spectrum: its wavelengths are those in the densest medium next to the relief.
            eta: index below relative to that above; None if nothing is transmitted.
            is_sheet: there is a flat face below, with the upper medium below it.
            coat_index: of a layer over the relief, relative to the outside.
            height_scales: times the heights, ascending; there are bins between one and the next.
            min_lateral_scale: times the lengths along the surface, of which heights are in units.
        """
        grid = spectrum.grid
        self.transmits, self.is_sheet = eta is not None, is_sheet
        self.eta, self.coat_index = eta or 1.0, coat_index
        self.tile, self.max_order = np.array(grid.tile_size), np.array(grid.max_order)
        first, last = (frequency / coat_index for frequency in frequencies_of(spectrum, eta))
        first *= min(min_lateral_scale, 1)
        sides = (True, False) if self.transmits else (True,)
        turn = 4 * np.pi * spectrum.height_range * float(np.mean(height_scales)) * (last - first)
        max_phase = MAX_PHASE_OF_LINES if 0 in grid.max_order else MAX_PHASE
        self.slices = int(np.clip(turn * coat_index / max_phase, *SLICES))
        orders = np.minimum((1 + self.eta) * self.tile * (first + last) / 2, 2 * self.max_order) + 1
        ranges = list(itertools.pairwise(height_scales)) or [tuple(height_scales)]
        entries = ENTRIES_OF_INTERFACE if self.transmits and not is_sheet else ENTRIES
        self.side = int(np.clip(np.sqrt(entries / (np.sqrt(len(ranges)) * self.slices * orders.prod())), *SIDES))
        self.layout = Layout(0.0, 1, self.side, 1, self.slices + 1, (first, last))
        sums, bins, fractions, start = [], [], [], 0
        for scales, above in itertools.product(ranges, sides):
            furnaces = [Furnace.of(spectrum, scale, eta, 1 if above else -1) for scale in scales]
            sent = []
            for reflects in sides:
                index = self._indices(above)[0] if reflects else abs(self.eta - 1)
                steps = 1 + int(turn * index / (self.slices * MAX_PHASE_OF_POINTS))
                points = [k / steps for k in range(self.slices * steps + 1)]
                squares = [self._squares(furnaces, above, reflects, point) for point in points]
                sent.append(np.sqrt(np.mean(squares, axis=0)).sum((-1, -2)).ravel())
                for slice_ in range(self.slices):
                    within = sum(squares[slice_ * steps : (slice_ + 1) * steps + 1])
                    corner, size = self._rectangles(above, reflects, slice_)
                    of_bins, starts = _packed(_of_corners(within), corner, size)
                    sums.append(of_bins)
                    bins.append(np.stack([start + starts, *corner.T, size[:, 0] + (size[:, 1] << 16)], -1))
                    start += len(of_bins)
            if not self.transmits:
                continue
            # E of a wavelength in the middle.
            omega, wavelengths = self._nodes(self.slices / 2)
            albedo = furnaces[0].albedo(self._inside(omega, above), wavelengths / self._indices(above)[0])
            reflected, transmitted = np.array(sent) * bounds_of(albedo, furnaces[0].index)
            fraction = (transmitted / np.maximum(reflected + transmitted, 1e-30)).reshape(self.side + 1, -1)
            middles = (np.indices((FRACTION_BINS, FRACTION_BINS)) + 0.5) * (self.side / FRACTION_BINS)
            fractions.append(map_coordinates(fraction, middles, order=1))
        self.before = NumberTable(np.concatenate(sums))
        self.bins = PacketTable(np.concatenate(bins).astype(np.uint32))
        if self.transmits:
            self.fractions = NumberTable(np.reshape(fractions, (len(ranges), 2, *middles.shape[1:])).mean(axis=0))
        self.counts = opaque(self.slices), opaque(self.side)
        self.edges = [opaque(scale) for scale in height_scales[1:-1]]
        self.first, self.per_slice = opaque(first), opaque(self.slices / (last - first))

    def _indices(self, above: bool) -> tuple[float, float]:
        """Return n next to the relief and outside, on one side of it."""
        return (self.coat_index, 1.0) if above else (self.eta, 1.0 if self.is_sheet else self.eta)

    def _nodes(self, slice_: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the directions at the nodes of the square, outside, and λ above in µm, at a coordinate of slices."""
        nodes = np.indices((1, self.side + 1, self.side + 1)).reshape(3, -1).T.astype(np.float64)
        nodes[:, 0] = slice_
        return self.layout.directions(nodes)

    def _inside(self, omega: NDArray[np.float64], above: bool) -> NDArray[np.float64]:
        """Return next to the relief the directions outside of it."""
        inside, outside = self._indices(above)
        tangent = omega[:, :2] * (outside / inside)
        return np.column_stack([tangent, np.sqrt(np.maximum(1 - (tangent**2).sum(-1), 1e-12))])

    def _squares(self, furnaces: Sequence[Furnace], above: bool, reflects: bool, slice_: float) -> NDArray[np.floating]:
        """Compute η_m² at the nodes of directions, the mean over scales of heights: (rows, columns, orders, orders)."""
        (inside, outside), goes_below = self._indices(above), above != reflects
        omega, wavelengths = self._nodes(slice_)
        result = np.zeros((len(omega), *(2 * self.max_order[::-1] + 1)), np.float32)
        for furnace in furnaces:
            powers = np.zeros_like(result)
            for way in furnace.ways[:1] if reflects else furnace.ways[1:]:
                node, component, power = furnace.sent(self._inside(omega, above), wavelengths / inside, way)
                m = np.rint((way or 1) * furnace.q[component] * self.tile).astype(np.int64)
                if self.is_sheet:
                    tangent = outside * omega[node, :2] + wavelengths[node, None] * m / self.tile
                    square = 1 - (tangent**2).sum(-1)
                    power = power * (square > 0)
                    if goes_below:
                        power *= 1 - fresnel(np.sqrt(np.maximum(square, 0)), self.eta)
                column, row = (m + self.max_order).T
                powers[node, row, column] += power
            result += powers**2 / len(furnaces)
        return result.reshape(self.side + 1, self.side + 1, *result.shape[1:])

    def _rectangles(self, above: bool, reflects: bool, slice_: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return first column and row of the orders that propagate in each cell of a slice, and how many: (cells, 2).

        From the borders of the cells: |m/T + k_i,∥/λ| ≤ n_o/λ.
        """
        along = np.linspace(0, 1, 5)
        border = np.stack(np.meshgrid([0, 1], along, along, indexing="ij"), -1).reshape(-1, 3)
        corner = np.indices((1, self.side, self.side)).reshape(3, -1).T
        corner[:, 0] = slice_
        omega, wavelengths = self.layout.directions(
            np.repeat(corner, len(border), 0) + np.tile(border, (len(corner), 1))
        )
        per_wavelength = self.tile / wavelengths[:, None]
        middle = -self._indices(above)[1] * omega[:, :2] * per_wavelength
        # More, as borders are curved and the index may change by `CHANGE`.
        half = self._indices(above == reflects)[1] * per_wavelength + 1e-3
        half += (1e-3 + 2 * CHANGE * max(self.eta, 1)) * per_wavelength.max()
        first, last = (x.reshape(len(corner), -1, 2) for x in (middle - half, middle + half))
        first = np.clip(np.ceil(first.min(1)), -self.max_order, self.max_order).astype(np.int64)
        last = np.clip(np.floor(last.max(1)), -self.max_order, self.max_order).astype(np.int64)
        return first + self.max_order, last - first + 1

    def _bin(self, incidence: Incidence, active: mi.Bool) -> tuple[mi.UInt32, mi.Int32, mi.Int32, mi.Int32, mi.Int32]:
        """Return where the sums of a bin begin, its first order along x and y, and its columns and rows."""
        max_x, max_y = map(int, self.max_order)
        slices, side = self.counts
        tangent = incidence.tangent / incidence.index
        column, row = _direction(mi.Vector3f(*tangent, dr.safe_sqrt(1 - dr.squared_norm(tangent))), side)
        slice_, _ = cell_of((incidence.frequency - self.first) * self.per_slice, slices)
        way, ways = mi.UInt32(0), 4 if self.transmits else 1
        if self.transmits:
            way = dr.select(incidence.above, mi.UInt32(0), 2) + dr.select(incidence.reflects, mi.UInt32(0), 1)
        if self.edges:
            way += sum(dr.select(incidence.height_scale > edge, mi.UInt32(ways), 0) for edge in self.edges)
        index = ((way * mi.UInt32(slices) + slice_) * mi.UInt32(side) + row) * mi.UInt32(side) + column
        start, x, y, size = self.bins(index, active)
        return start, mi.Int32(x) - max_x, mi.Int32(y) - max_y, mi.Int32(size & 0xFFFF), mi.Int32(size >> 16)

    def probability(self, m_x: mi.Int32, m_y: mi.Int32, incidence: Incidence, active: mi.Bool) -> mi.Float:
        """Return P_m for one wavelength."""
        start, first_x, first_y, columns, rows = self._bin(incidence, active)
        column, row = m_x - first_x, m_y - first_y
        active = active & (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
        order = start + mi.UInt32(row * columns + column)
        return (self.before(order + 1, active) - self.before(order, active)) * (1 / WHOLE)

    def sample(
        self, incidence: Incidence, u: mi.Float, v: mi.Point2f, active: mi.Bool
    ) -> tuple[mi.Int32, mi.Int32, mi.Point2f]:
        """Draw an order for one wavelength from `u`; return it and `v`."""
        start, first_x, first_y, columns, rows = self._bin(incidence, active)

        def before(place: mi.Int32) -> mi.Float:
            return self.before(start + mi.UInt32(place), active)

        place, _ = search(before, mi.Int32(0), columns * rows, int(np.prod(2 * self.max_order + 1)), u)
        # In masked lanes there are no columns.
        row = mi.Int32((mi.Float(place) + 0.5) / larger(mi.Float(columns), 1))
        return first_x + place - row * columns, first_y + row, v

    def transmitted(self, omega: mi.Vector3f) -> mi.Float:
        """Return the fraction of light that is transmitted, ω along the pattern's axes."""
        column, row = _direction(omega, FRACTION_BINS)
        return self.fractions((dr.select(omega.z > 0, mi.UInt32(0), FRACTION_BINS) + row) * FRACTION_BINS + column)


def _direction(omega: mi.Vector3f, side: mi.Float | int) -> list[mi.UInt32]:
    """Return column and row of ω among the bins of the square."""
    return [cell_of(side * place, side)[0] for place in on_square(omega)]


def _of_corners(at_nodes: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return the root of the sum of the four corners of each cell, (rows + 1, columns + 1, …) → (cells, …)."""
    rows, columns = (n - 1 for n in at_nodes.shape[:2])
    total = sum(at_nodes[j : j + rows, i : i + columns] for j, i in np.ndindex(2, 2))
    return np.sqrt(total.reshape(rows * columns, *at_nodes.shape[2:]))


def _packed(
    p: NDArray[np.floating], first: NDArray[np.int64], size: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return the sums before the orders of all rectangles, one after the other, and where each begins.

    Args:
        p: in proportion to P_m, (cells, orders, orders); zero outside of the rectangles.
        first: column and row where a rectangle begins, (cells, 2).
        size: its columns and rows, (cells, 2).
    """
    of_x, of_y = (
        (np.arange(n) >= begin[:, None]) & (np.arange(n) < (begin + count)[:, None])
        for n, begin, count in zip(p.shape[:0:-1], first.T, size.T, strict=True)
    )
    inside = (of_y[:, :, None] & of_x[:, None]).reshape(len(p), -1)
    p = p.reshape(len(p), -1).astype(np.float64)
    p = (1 - UNIFORM_FRACTION) * p / np.maximum(
        p.sum(1, keepdims=True), 1e-30
    ) + UNIFORM_FRACTION * inside / inside.sum(1, keepdims=True)
    sums = np.rint(WHOLE * p.cumsum(1) / p.sum(1, keepdims=True))
    count = size.prod(1) + 1
    return np.insert(sums, 0, 0, 1)[np.insert(inside, 0, True, 1)], count.cumsum() - count
