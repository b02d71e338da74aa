"""E(ω_i, ω_o, λ) at run time: what keeps the grating from sending out more light than it receives.

E = min(e(ω_i, λ), e(ω_o, λ)), e as in `energy/table.py`; of an interface, e of each side and of
reflected or transmitted light.

With lengths along the surface times s and heights times h, a relief is at λ what it is with heights times r = h/s at
λ/s: where scales vary there are tables over r, read at λ/s.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..energy.table import LARGEST, EnergyTable
from .geometry import cell_of, on_square
from .tables import NumberTable, PacketTable, larger, limited, opaque, smaller


@dataclass
class Place:
    """Where a direction lies in a table.

    Attributes:
        u, v: c − ω_x and c + ω_x, of a line grating; else columns and rows in cells.
        under: under the surface.
        lateral: s.
        ratio: where the ratio of scales lies among those of tables.
    """

    u: mi.Float
    v: mi.Float
    under: mi.Bool
    lateral: mi.Float | float = 1.0
    ratio: mi.UInt32 | None = None


class Energy:
    """e(ω, λ) from a table, linear between the corners of a cell.

    The four corners of a cell are packed as bytes into one number, so that a direction and a wavelength cost one read
    of four bytes, or two where e is linear between wavelengths: reads cost more than the arithmetic.
    """

    def __init__(
        self,
        tables: Sequence[EnergyTable],
        slopes: np.ndarray | None = None,
        change: mi.Float | None = None,
        edges: Sequence[float] | None = None,
    ) -> None:
        """Pack the tables.

        Args:
            tables: of reflected light; or, of an interface, of reflected and of transmitted light from above, and the
                same from below.
            slopes: times `change`, are added to the tables; those of one after the other.
            change: zero but for its gradient.
            edges: where scales vary, the ratios between that of one and that of the next; tables of one ratio follow
                those of the one before.
        """
        first, layout = tables[0], tables[0].layout
        self.loss = np.max([table.loss for table in tables], axis=0)
        # Arrays, as tables of other heights have other numbers of cells.
        slices, side, _, corners = first.steps.shape
        self.layout, self.last_slice, self.side = layout, opaque(slices - 1), opaque(side)
        self.cells_of_table = opaque(first.steps.size // corners)
        self.two_sided = len(tables) > 1 + len(edges or ())
        steps = np.concatenate([of.steps for of in tables])
        self.table = NumberTable(steps @ (np.uint32(1) << np.arange(0, 32, 8, dtype=np.uint32)))
        heights = [(LARGEST - of.least) / 255 for of in tables]
        self.steps = [opaque(height) for height in heights] if edges is None else NumberTable(np.array(heights))
        self.edges = None if edges is None else [opaque(edge) for edge in edges]
        self.slope = None if slopes is None else PacketTable(slopes)
        self.change = change
        # Of an interface wavelengths below have the same place among the slices of their table as those above.
        self.frequencies = [opaque(nu) for nu in layout.frequencies]
        if edges is not None:
            of_ratio = tables[:: len(tables) // (1 + len(edges))]
            self.frequencies = [NumberTable(np.array([of.layout.frequencies[k] for of in of_ratio])) for k in (0, 1)]
        self.period, self.squares = opaque(layout.period), opaque(layout.squares - 1)
        self.cells, self.first_cells = opaque(layout.cells), opaque(layout.first)

    def __str__(self) -> str:
        return "bounds the albedo by one, and loses {:.2g} in the mean, {:.2g} at most".format(*self.loss)

    def factor(self, places: tuple[Place, Place], frequency: mi.Float, ratio: mi.Float) -> mi.Float:
        """Return E of one wavelength; `frequency` is 1/λ in 1/µm, λ in the medium above."""
        there, back = places
        if self.edges is not None:
            number = sum((dr.select(dr.detach(ratio) > e, mi.UInt32(1), 0) for e in self.edges), mi.UInt32(0))
            there, back = (dataclasses.replace(place, ratio=number) for place in places)
        passes = there.under != back.under
        return smaller(self.bound(there, frequency, passes), self.bound(back, frequency, passes))

    def coordinates(self, omega: mi.Vector3f) -> Place:
        """Return the place of ω, along the pattern's axes."""
        z = dr.abs(omega.z) if self.two_sided else larger(omega.z, 0)
        if self.layout.lines:
            x = omega.y if self.layout.turned else omega.x
            longer = dr.sqrt(dr.square(x) + dr.square(z)) + dr.abs(x)
            # c − |x| without cancellation.
            shorter = dr.square(z) / larger(longer, 1e-12)
            u, v = dr.select(x > 0, shorter, longer), dr.select(x > 0, longer, shorter)
        else:
            u, v = (self.first_cells * place for place in on_square(mi.Vector3f(omega.x, omega.y, z)))
        return Place(u, v, omega.z < 0)

    def bound(self, place: Place, frequency: mi.Float, passes: mi.Bool | None = None) -> mi.Float:
        """Return e of reflected light, or of light that passes, of the direction at `place`.

        `frequency` is 1/λ in 1/µm, λ in the medium above.
        """
        frequency, number, side = frequency * place.lateral, place.ratio, mi.UInt32(self.side)
        if self.two_sided:
            number = dr.select(place.under, mi.UInt32(2), 0) + dr.select(passes, mi.UInt32(1), 0)
            number = number if place.ratio is None else 4 * place.ratio + number
        if place.ratio is not None:
            step = self.steps(number)
        elif self.two_sided:
            above, below = (dr.select(passes, self.steps[k + 1], self.steps[k]) for k in (0, 2))
            step = dr.select(place.under, below, above)
        else:
            step = self.steps[0]
        if self.layout.lines:
            (column, x), (row, y) = (self._column(u * (self.period * frequency)) for u in (place.u, place.v))
            index = row * side + column
        else:
            (column, x), (row, y) = (cell_of(u, self.first_cells) for u in (place.u, place.v))
            first, last = self.frequencies if place.ratio is None else [nu(place.ratio) for nu in self.frequencies]
            below, beyond = cell_of((frequency - first) / (last - first) * self.last_slice, self.last_slice)
            index = (below * side + row) * side + column
        if number is not None:
            index += number * mi.UInt32(self.cells_of_table)

        def between(corners: Callable[[mi.UInt32], mi.Vector4f]) -> mi.Float:
            values = corners(index)
            if not self.layout.lines:
                values = dr.lerp(values, corners(index + side * side), beyond)
            return dr.lerp(dr.lerp(values[0], values[1], x), dr.lerp(values[2], values[3], x), y)

        e = LARGEST - (255 - between(lambda i: _bytes(self.table(i)))) * step
        if self.slope is not None:
            e += between(lambda i: self.slope(i, True)) * self.change
        return smaller(e, 1)

    def _column(self, u: mi.Float) -> tuple[mi.UInt32, mi.Float]:
        """Return the cell of u along one axis, and the place in it."""
        square = smaller(dr.floor(u), self.squares)
        inner = square > 0
        cells = dr.select(inner, self.cells, self.first_cells)
        cell, x = cell_of(dr.sqrt(limited(u - square, 0, 1)) * cells, cells)
        start = dr.select(inner, dr.fma(square - 1, self.cells, self.first_cells), 0)
        return cell + mi.UInt32(start), x


def _bytes(number: mi.UInt32) -> mi.Vector4f:
    return mi.Vector4f(*(mi.Float(mi.Int32((number >> shift) & 255)) for shift in range(0, 32, 8)))
