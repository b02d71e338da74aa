"""E(ω_i, ω_o, λ) at run time: what keeps the grating from reflecting more light than it receives.

E = min(e(ω_i, λ), e(ω_o, λ)), e as in `spectrum/energy_table.py`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..spectrum.energy_table import HORIZON, EnergyTable
from .arithmetic import larger, limited, smaller
from .tables import NumberTable, PacketTable, opaque


@dataclass
class Place:
    """Where a direction lies in the table: cells and the place in them, 0 to 1, c and cos θ."""

    column: mi.UInt32
    x: mi.Float
    row: mi.UInt32
    y: mi.Float
    c: mi.Float
    z: mi.Float


class Energy:
    """e(ω, λ) from a table, linear in y, ν and s.

    The four corners of a cell in (ν, x) are packed as bytes into one number, so that a direction and a wavelength cost
    one read of four bytes, or two where the table has more than one row: reads cost more than the arithmetic. Bytes
    are rounded down, which leaves e a lower bound.
    """

    def __init__(self, table: EnergyTable, slope: np.ndarray | None = None, change: mi.Float | None = None) -> None:
        """`slope` times `change`, which is zero but for its gradient, is added to the table."""
        self.measured = table.excess, *table.loss
        self.rows, slices, columns = table.values.shape
        self.slices, self.columns = slices - 1, columns - 1
        self.conical, self.shadowing = table.conical, table.shadowing
        steps, least, step = table.packed()
        self.table = NumberTable(_corners(steps) @ (np.uint32(1) << np.arange(0, 32, 8, dtype=np.uint32)))
        self.least, self.step = opaque(least), opaque(step)
        self.slope = None if slope is None else PacketTable(_corners(slope))
        self.change = change
        first, last = table.frequencies
        self.first = opaque(first)
        self.per_frequency = opaque(self.slices / (last - first))

    def __str__(self) -> str:
        text = "albedo at most 1 + {:.2g}; where a ≤ 1, 1 − e is {:.2g} in the mean, {:.2g} at most"
        return text.format(*self.measured)

    def factor(self, wi: mi.Vector3f, wo: mi.Vector3f, wavelengths: mi.UnpolarizedSpectrum) -> mi.UnpolarizedSpectrum:
        """E of each wavelength."""
        there, back = self.place(wi), self.place(wo)
        result = mi.UnpolarizedSpectrum(1.0)
        for channel in range(len(result)):
            frequency = self.per_frequency / wavelengths[channel]
            result[channel] = smaller(self.bound(there, frequency), self.bound(back, frequency))
        return result

    def place(self, omega: mi.Vector3f) -> Place:
        """The place of ω, along the pattern's axes."""
        z = larger(omega.z, 0)
        c = dr.sqrt(dr.square(omega.x) + dr.square(z))
        tangent = omega.x / larger(c + z, 1e-7)
        rest = larger(1 - dr.abs(tangent), 0)
        s = dr.copysign(1 - 0.5 * (dr.sqrt(rest) + rest), tangent)
        column, x = _cell(0.5 * (s + 1) * self.columns, self.columns)
        row, y = mi.UInt32(0), mi.Float(0)
        if self.rows > 1:
            row, y = _cell(0.5 * (omega.y / (1 + c) + 1) * (self.rows - 1), self.rows - 1)
        return Place(column, x, row, y, c, z)

    def bound(self, place: Place, frequency: mi.Float) -> mi.Float:
        """e of the direction at `place`; `frequency` is 1/λ in cells of the table."""
        nu = place.c * frequency if self.conical else frequency - self.first * self.per_frequency
        cell, t = _cell(nu, self.slices)
        index = (place.row * self.slices + cell) * self.columns + place.column
        steps = self._between(lambda i: _bytes(self.table(i)), index, place, t)
        e = dr.fma(steps, self.step, self.least)
        if self.slope is not None:
            e += self._between(lambda i: self.slope(i, True), index, place, t) * self.change
        if self.shadowing == "none":
            e *= dr.square(smaller(place.z / HORIZON, 1))
        return e

    def _between(
        self, corners: Callable[[mi.UInt32], mi.Vector4f], index: mi.UInt32, place: Place, t: mi.Float
    ) -> mi.Float:
        """Linear between the corners of the cell at `index`."""
        values = corners(index)
        if self.rows > 1:
            values = dr.lerp(values, corners(index + self.slices * self.columns), place.y)
        return dr.lerp(dr.lerp(values[0], values[1], place.x), dr.lerp(values[2], values[3], place.x), t)


def _bytes(number: mi.UInt32) -> mi.Vector4f:
    return mi.Vector4f(*(mi.Float(mi.Int32((number >> shift) & 255)) for shift in range(0, 32, 8)))


def _corners(values: np.ndarray) -> np.ndarray:
    """(rows, slices, columns) → (rows, slices − 1, columns − 1, 4): two neighbours in x, and the same at the next ν."""
    below, above = values[:, :-1], values[:, 1:]
    return np.stack([below[..., :-1], below[..., 1:], above[..., :-1], above[..., 1:]], -1)


def _cell(x: mi.Float, count: int) -> tuple[mi.UInt32, mi.Float]:
    """The cell of x, 0 ≤ x ≤ count, and the place in it; outside, the nearest."""
    x = limited(x, 0, count)
    cell = dr.minimum(mi.UInt32(x), count - 1)
    return cell, x - mi.Float(cell)
