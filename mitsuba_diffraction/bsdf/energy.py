"""E(ω_i, ω_o, λ) at run time: what keeps the grating from reflecting more light than it receives.

E = min(e(ω_i, λ), e(ω_o, λ)), e as in `energy/table.py`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..energy.table import EnergyTable
from .tables import NumberTable, PacketTable, larger, limited, opaque, smaller


@dataclass
class Place:
    """c − ω_x and c + ω_x of a direction, where it lies among the slices (the one below, and how far from it), and
    whether it is under the surface."""

    u: mi.Float
    v: mi.Float
    below: mi.UInt32
    beyond: mi.Float
    under: mi.Bool


class Energy:
    """e(ω, λ) from a table, linear between the corners of a cell.

    The four corners of a cell are packed as bytes into one number, so that a direction and a wavelength cost one read
    of four bytes, or two where e is linear between slices: reads cost more than the arithmetic.
    """

    def __init__(
        self,
        table: EnergyTable,
        slope: np.ndarray | None = None,
        change: mi.Float | None = None,
        under: EnergyTable | None = None,
        index: float = 1.0,
    ) -> None:
        """Pack the table, or those of both sides of an interface.

        Args:
            table: of directions above the surface.
            slope: times `change`, is added to the table; with `under`, the slopes of both, one after the other.
            change: zero but for its gradient.
            under: of directions below the surface, where light is transmitted.
            index: n below relative to n above.
        """
        tables = [table] if under is None else [table, under]
        self.loss, layout = table.loss, table.layout
        self.slices, self.side = table.steps.shape[:2]
        self.layout, self.two_sided, self.cells_of_side = layout, under is not None, table.steps.size // 4
        steps = np.concatenate([of.steps for of in tables])
        self.table = NumberTable(steps @ (np.uint32(1) << np.arange(0, 32, 8, dtype=np.uint32)))
        self.steps = [opaque((1 - of.least) / 255) for of in tables]
        self.slope = None if slope is None else PacketTable(slope)
        self.change = change
        # Wavelengths are those above.
        self.periods = [opaque(of.layout.period * n) for of, n in zip(tables, (1, index), strict=False)]
        self.squares = opaque(layout.squares - 1)
        self.cells, self.first_cells = opaque(layout.cells), opaque(layout.first)

    def __str__(self) -> str:
        return "bounds the albedo by one, and loses {:.2g} in the mean, {:.2g} at most".format(*self.loss)

    def factor(self, wi: mi.Vector3f, wo: mi.Vector3f, wavelengths: mi.UnpolarizedSpectrum) -> mi.UnpolarizedSpectrum:
        """Return E of each wavelength.

        Args:
            wi, wo: along the pattern's axes, each inside the medium that it is in, z < 0 below.
            wavelengths: µm, in the medium above.
        """
        there, back = self.place(wi), self.place(wo)
        result = mi.UnpolarizedSpectrum(1.0)
        for channel in range(len(result)):
            frequency = dr.rcp(wavelengths[channel])
            result[channel] = smaller(self.bound(there, frequency), self.bound(back, frequency))
        return result

    def place(self, omega: mi.Vector3f) -> Place:
        """Return the place of ω, along the pattern's axes."""
        x, y = (omega.y, omega.x) if self.layout.turned else (omega.x, omega.y)
        square = dr.square(omega.z if self.two_sided else larger(omega.z, 0))
        c = dr.sqrt(dr.square(x) + square)
        longer = c + dr.abs(x)
        # c − |x| without cancellation.
        shorter = square / larger(longer, 1e-12)
        u, v = dr.select(x > 0, shorter, longer), dr.select(x > 0, longer, shorter)
        place = Place(u, v, mi.UInt32(0), mi.Float(0), omega.z < 0)
        if not self.layout.lines:
            y = y / (1 + c)
            row = 0.5 * (self.slices - 1) * (1 + dr.copysign(1 - _equidistant(1 - dr.abs(y)), y))
            place.below, place.beyond = _cell(row, self.slices - 1)
        return place

    def bound(self, place: Place, frequency: mi.Float) -> mi.Float:
        """Return e of the direction at `place`; `frequency` is 1/λ in 1/µm, λ in the medium above."""
        per_length = self._of_side(self.periods, place) * frequency
        (column, x), (row, y) = (self._column(u * per_length) for u in (place.u, place.v))
        index = (place.below * self.side + row) * self.side + column
        if self.two_sided:
            index += dr.select(place.under, mi.UInt32(self.cells_of_side), 0)

        def between(corners: Callable[[mi.UInt32], mi.Vector4f]) -> mi.Float:
            values = corners(index)
            if not self.layout.lines:
                values = dr.lerp(values, corners(index + self.side * self.side), place.beyond)
            return dr.lerp(dr.lerp(values[0], values[1], x), dr.lerp(values[2], values[3], x), y)

        # From above, so that one stays one.
        e = 1 - (255 - between(lambda i: _bytes(self.table(i)))) * self._of_side(self.steps, place)
        if self.slope is not None:
            e += between(lambda i: self.slope(i, True)) * self.change
        return e

    def _of_side(self, numbers: list[mi.Float], place: Place) -> mi.Float:
        return dr.select(place.under, numbers[1], numbers[0]) if self.two_sided else numbers[0]

    def _column(self, u: mi.Float) -> tuple[mi.UInt32, mi.Float]:
        """Return the cell of u along one axis, and the place in it."""
        square = smaller(dr.floor(u), self.squares)
        inner = square > 0
        cells = dr.select(inner, self.cells, self.first_cells)
        cell, x = _cell(_equidistant(u - square) * cells, cells)
        start = dr.select(inner, dr.fma(square - 1, self.cells, self.first_cells), 0)
        return cell + mi.UInt32(start), x


def _equidistant(f: mi.Float) -> mi.Float:
    """Return √f, from 0 to 1."""
    return dr.sqrt(limited(f, 0, 1))


def _bytes(number: mi.UInt32) -> mi.Vector4f:
    return mi.Vector4f(*(mi.Float(mi.Int32((number >> shift) & 255)) for shift in range(0, 32, 8)))


def _cell(x: mi.Float, count: mi.Float | int) -> tuple[mi.UInt32, mi.Float]:
    """Return the cell of x, 0 ≤ x ≤ count, and the place in it; outside, the nearest."""
    x = limited(x, 0, count)
    cell = dr.minimum(mi.UInt32(x), mi.UInt32(count) - 1)
    return cell, x - mi.Float(cell)
