"""Nodes of directions and wavelengths, of the tables of E and of the sampler of orders.

For a line grating of period T, with c = √(1 − ω_y²) and

    u = (c − ω_x) T/λ,    v = (c + ω_x) T/λ

the order m > 0 propagates if m < u, and the order m < 0 if −m < v. The albedo jumps where u or v is a whole number, and
is continuous between. Each unit square of (u, v) is therefore divided into grid cells separately. They are finest near
its lower edges, where an order is just above the horizon; at u = 0 and v = 0, ω itself is at the horizon. With f the
fractional part of u, nodes are equidistant in √f, which is proportional to cos θ_o of that order. The albedo depends on
u and v alone, except where lobes meet the horizon: in units of c, their width is proportional to 1/c. The table has one
slice.

For all other surfaces the hemisphere is mapped to a square, with the normal at its centre and the horizon at its edge,

    (ω_x − ω_y, ω_x + ω_y) (1 − t)/(|ω_x| + |ω_y|),    cos θ = 1 − (1 − t²)²

Nodes are equidistant along the sides, and slices are equidistant in 1/λ.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..spectrum.power_spectrum import PowerSpectrum

Real = NDArray[np.float64]

MIN_FRACTION = 1e-7  # distance of nodes from whole u and v
MIN_T = 0.01  # t of nodes at the horizon


@dataclass(frozen=True)
class Nodes:
    """The nodes of a table.

    Attributes:
        first: number of grid cells along a side of the square; or from u or v = 0 to 1, where ω is near the horizon.
        slices: number of nodes in 1/λ.
        frequencies: (minimum, maximum) of 1/λ in 1/µm.
        period: T in µm of a line grating; 0 for any other surface.
        squares: number of unit squares of (u, v) along u and along v; 1 for the square of all directions.
        cells: number of grid cells along a side of each other unit square.
        turned: whether the grating is periodic along y, so that x and y are exchanged.
    """

    first: int
    slices: int
    frequencies: tuple[float, float]
    period: float = 0.0
    squares: int = 1
    cells: int = 1
    turned: bool = False

    @classmethod
    def of_lines(cls, period: float, frequencies: tuple[float, float], count: float, turned: bool) -> Nodes:
        """Return about `count` nodes of a line grating."""
        # In about half of the unit squares 1/λ is in range.
        side = np.sqrt(2 * count)
        first = int(np.clip(side / 8, 4, 24))
        rest = (side - 2 * first - 1) / 3
        period /= max(np.ceil(2 * period * frequencies[1] / max(rest, 2)), 1)
        squares = int(np.ceil(2 * period * frequencies[1]))
        cells = int(np.clip((3 * rest / max(squares - 1, 1) - 1) / 2, 1, 48))
        return cls(first, 1, frequencies, float(period), squares, cells, turned)

    @property
    def lines(self) -> bool:
        """Whether the nodes are those of a line grating."""
        return self.period > 0

    @property
    def side(self) -> int:
        """Number of grid cells along u or v, or along a side of the square."""
        return self.first + (self.squares - 1) * self.cells

    @property
    def shape(self) -> tuple[int, int, int]:
        """(slices, nodes along v, nodes along u); unit squares share no nodes."""
        return self.slices, self.side + self.squares, self.side + self.squares

    def corners(self) -> list[tuple[Any, ...]]:
        """Return the indices of the corners of all grid cells in an array (..., *shape), from slices to columns."""
        # The unit square of each grid cell, as its nodes are k + s_k and k + s_k + 1.
        squares = np.repeat(np.arange(self.squares), [self.first] + [self.cells] * (self.squares - 1))
        start, count = np.arange(self.side) + squares, max(self.slices - 1, 1)
        return [
            (..., slice(k, k + count), start[:, None] + j, start + i)
            for k, j, i in np.ndindex(min(self.slices, 2), 2, 2)
        ]

    def points(self, offset: float = 0.0) -> Real:
        """Return the coordinates of all nodes, (n, 3), in the order of `shape`; of centres of grid cells for 0.5."""
        last = 1 if offset == 0 else 0
        slices = np.arange(self.slices + last - 1) + offset if self.slices > 1 else np.zeros(1)
        axis = np.arange(self.first + last) + offset
        if self.lines:
            counts = [self.first] + [self.cells] * (self.squares - 1)
            fractions = [((np.arange(count + last) + offset) / count) ** 2 for count in counts]
            axis = np.concatenate([j + f.clip(MIN_FRACTION, 1 - MIN_FRACTION) for j, f in enumerate(fractions)])
        return np.stack(np.meshgrid(slices, axis, axis, indexing="ij"), -1).reshape(-1, 3)

    def directions(self, coordinates: Real) -> tuple[Real, Real]:
        """Return ω (n, 3) and λ in µm (n,) at coordinates (n, 3): slice, row and column in grid cells; or 0, v and u.

        Many directions of a line grating have the same u and v. Of those whose 1/λ is in range, the one with 1/λ
        closest to the middle is returned.
        """
        first, last = self.frequencies
        nu, row, column = coordinates.T
        if self.lines:
            nu = (row + column) / (2 * self.period)
            c = np.minimum(nu / ((first + last) / 2), 1)
            x = (row - column) / (row + column)
            x, y, z = c * x, np.sqrt(1 - c**2), c * np.sqrt(1 - x**2)
            return np.stack([y, x, z] if self.turned else [x, y, z], -1), c / nu
        row, column = (2 * x / self.first - 1 for x in (row, column))
        x, y = (column + row) / 2, (column - row) / 2
        t = np.maximum(1 - np.abs(x) - np.abs(y), MIN_T)
        z = 1 - (1 - t**2) ** 2
        along = np.sqrt(1 - z**2) / np.maximum(np.hypot(x, y), 1e-12)
        return np.stack([along * x, along * y, z], -1), 1 / (first + nu / (self.slices - 1) * (last - first))


def frequencies_of(spectrum: PowerSpectrum, eta: float | None) -> tuple[float, float]:
    """Return (minimum, maximum) of 1/λ above in 1/µm; `eta` is n below relative to n above, if light is transmitted."""
    # The wavelengths of the spectrum are in the denser medium.
    shortest, longest = (w * 1e-3 * max(eta or 1, 1) for w in spectrum.wavelengths)
    return 1 / longest, 1 / shortest
