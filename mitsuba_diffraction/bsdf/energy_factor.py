"""E(ω_i, ω_o, λ) at run time, the factor that bounds the albedo by about one.

E = min(e(ω_i, λ), e(ω_o, λ)), e as in `energy/table.py`. An interface has four e: for light from above and from below,
each for reflected and for transmitted light.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..energy.table import MAX_E, EnergyTable
from .device_tables import NumberTable, integer_part, larger, limited, opaque, smaller
from .directions import cell_of, on_square


@dataclass
class Coordinates:
    """The coordinates of a direction in the table.

    Attributes:
        u, v: c − ω_x and c + ω_x for a line grating; else column and row in grid cells.
        below: whether the direction is below the surface.
    """

    u: mi.Float
    v: mi.Float
    below: mi.Bool


class Energy:
    """e(ω, λ) from a table, linear between the corners of a grid cell.

    The four corners of a grid cell are packed as bytes into one word, as reads cost more than arithmetic. A direction
    and a wavelength need one read; interpolation between wavelengths and between ratios of scales each double that.
    """

    def __init__(self, table: EnergyTable) -> None:
        """Pack a table."""
        self.layout = layout = table.layout
        self.two_sided, self.ratios = table.values.shape[1] > 1, table.ratios
        self.table = NumberTable(table.corners() @ (np.uint32(1) << np.arange(0, 32, 8, dtype=np.uint32)))
        # Opaque, as the numbers of cells depend on the surface.
        self.last_slice, self.side = opaque(layout.slices - 1), opaque(layout.side)
        self.first_frequency, span = opaque(layout.frequencies[0]), layout.frequencies[1] - layout.frequencies[0]
        self.slices_per_frequency = opaque((layout.slices - 1) / span)
        self.period, self.last_square = opaque(layout.period), opaque(layout.squares - 1)
        self.cells, self.first_cells = opaque(layout.cells), opaque(layout.first)
        if len(self.ratios) > 1:
            first, *_, last = self.ratios
            self.last_ratio, self.first_ratio = opaque(len(self.ratios) - 1), opaque(first)
            self.per_ratio = opaque((len(self.ratios) - 1) / (last - first))

    def coordinates(self, omega: mi.Vector3f) -> Coordinates:
        """Return the coordinates of ω, a unit vector along the pattern's axes next to the relief, z < 0 below."""
        z = dr.abs(omega.z) if self.two_sided else larger(omega.z, 0)
        if self.layout.lines:
            x = omega.y if self.layout.turned else omega.x
            longer = dr.sqrt(dr.square(x) + dr.square(z)) + dr.abs(x)
            # c − |x| without cancellation.
            shorter = dr.square(z) / larger(longer, 1e-12)
            u, v = dr.select(x > 0, shorter, longer), dr.select(x > 0, longer, shorter)
        else:
            u, v = (self.first_cells * x for x in on_square(mi.Vector3f(omega.x, omega.y, z)))
        return Coordinates(u, v, omega.z < 0)

    def factor(
        self, pair: tuple[Coordinates, Coordinates], frequency: mi.Float, ratio: mi.Float | float = 1.0
    ) -> mi.Float:
        """Return E of a pair of directions.

        Args:
            pair: the coordinates of both directions.
            frequency: s/λ in 1/µm, λ in the upper medium next to the relief and s the scale of lengths.
            ratio: h/s, h the scale of heights; ignored if the table has a single one.
        """
        i, o = pair
        transmitted = i.below != o.below
        return smaller(self.bound(i, frequency, transmitted, ratio), self.bound(o, frequency, transmitted, ratio))

    def bound(
        self, at: Coordinates, frequency: mi.Float, transmitted: mi.Bool | bool = False, ratio: mi.Float | float = 1.0
    ) -> mi.Float:
        """Return e of one direction, for transmitted or reflected light; for other arguments see `factor`."""
        side, slices, weights = integer_part(self.side), integer_part(self.last_slice) + 1, []
        index, tables = mi.UInt32(0), 4 if self.two_sided else 1
        if self.two_sided:
            index += dr.select(at.below, mi.UInt32(2), 0) + dr.select(transmitted, mi.UInt32(1), 0)
        if len(self.ratios) > 1:
            cell, weight = cell_of((ratio - self.first_ratio) * self.per_ratio, self.last_ratio)
            index += tables * cell
            weights.append((weight, tables * slices * side * side))
        index *= slices
        if self.layout.lines:
            (column, x), (row, y) = (self._column(u * (self.period * frequency)) for u in (at.u, at.v))
        else:
            (column, x), (row, y) = (cell_of(u, self.first_cells) for u in (at.u, at.v))
            slice_, weight = cell_of((frequency - self.first_frequency) * self.slices_per_frequency, self.last_slice)
            index += slice_
            weights.append((weight, side * side))
        index = (index * side + row) * side + column

        def interpolate(index: mi.UInt32, weights: list[tuple[mi.Float, mi.UInt32]]) -> mi.Vector4f:
            if not weights:
                number = self.table(index)
                return mi.Vector4f(*(mi.Float(mi.Int32((number >> shift) & 255)) for shift in range(0, 32, 8)))
            (weight, step), *remaining = weights
            return dr.lerp(interpolate(index, remaining), interpolate(index + step, remaining), weight)

        values = interpolate(index, weights)
        value = dr.lerp(dr.lerp(values[0], values[1], x), dr.lerp(values[2], values[3], x), y)
        return smaller(value * (MAX_E / 255), 1)

    def _column(self, u: mi.Float) -> tuple[mi.UInt32, mi.Float]:
        """Return the grid cell of u along one axis, and the coordinate in it."""
        square = smaller(dr.floor(u), self.last_square)
        inner = square > 0
        cells = dr.select(inner, self.cells, self.first_cells)
        cell, x = cell_of(dr.sqrt(limited(u - square, 0, 1)) * cells, cells)
        start = dr.select(inner, dr.fma(square - 1, self.cells, self.first_cells), 0)
        return cell + integer_part(start), x
