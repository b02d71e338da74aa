"""E(ω_i, ω_o, λ), the factor that bounds the albedo by about one.

With R = 1 the BSDF without E has an albedo a(ω_i, λ) (`furnace.py`) that exceeds one for some directions. The BSDF is
multiplied by

    E = min(e(ω_i, λ), e(ω_o, λ)),    e = 1/max(1, a)

which is reciprocal, and one where a ≤ 1 for both directions. e is computed at nodes (`nodes.py`) when a surface is
loaded, and is linear between them. An interface has four e: for light from above and from below, each for reflected
and for transmitted light. E is a safeguard of the model; docs/plugin.md has measured albedos.

Scaling lengths by s and heights by h is equivalent to scaling heights by r = h/s at the wavelength λ/s: where scales
vary, the table has nodes in r.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..spectrum.grids import OrderGrid
from ..spectrum.power_spectrum import PowerSpectrum
from .furnace import MAX_E, SAMPLES, Furnace, Real, bounds_of
from .geometry import cell_of, on_square
from .nodes import Nodes, frequencies_of
from .scattering import Scattering
from .tables import NumberTable, integer_part, larger, limited, opaque, smaller

MAX_LINE_NODES = 1.2e5  # of a line grating, about
MAX_SIDE = 64  # nodes along a side of the square of directions
SLICES, CONTINUUM_SLICES = 16, 8  # nodes of 1/λ: if orders are resolved, and else
MAX_EVALUATIONS = 1e7  # of orders or of samples, for the nodes of a table with one ratio


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

    def __init__(self, nodes: Nodes, values: NDArray[np.floating], ratios: Sequence[float] = (1.0,)) -> None:
        """Pack a table.

        Args:
            nodes: those of directions and wavelengths.
            values: 1/a or e, (ratios, channels, *nodes.shape). There is one channel; or for an interface four: light
                from above, reflected and transmitted, and light from below, likewise.
            ratios: the nodes of h/s, equidistant.
        """
        self.nodes, self.ratios = nodes, ratios
        self.two_sided = values.shape[1] > 1
        numbers = np.rint(np.clip(values, 0, MAX_E) * (255 / MAX_E)).astype(np.uint32)
        # With the four corners of a grid cell; those of the last slice of 1/λ, too.
        of_slice = [corner[2:] for corner in nodes.corners()[:4]]
        self.table = NumberTable(sum(numbers[(..., *at)] << (8 * k) for k, at in enumerate(of_slice)))
        # Opaque, as the numbers of cells depend on the surface.
        self.last_slice, self.side = opaque(nodes.slices - 1), opaque(nodes.side)
        self.first_frequency, span = opaque(nodes.frequencies[0]), nodes.frequencies[1] - nodes.frequencies[0]
        self.slices_per_frequency = opaque((nodes.slices - 1) / span)
        self.period, self.last_square = opaque(nodes.period), opaque(nodes.squares - 1)
        self.cells, self.first_cells = opaque(nodes.cells), opaque(nodes.first)
        if len(ratios) > 1:
            first, *_, last = ratios
            self.last_ratio, self.first_ratio = opaque(len(ratios) - 1), opaque(first)
            self.per_ratio = opaque((len(ratios) - 1) / (last - first))

    @classmethod
    def of(
        cls,
        scattering: Scattering,
        spectrum: PowerSpectrum,
        eta: float | None = None,
        ratios: Sequence[float] = (1.0,),
        min_lateral_scale: float = 1.0,
    ) -> Energy | None:
        """Compute the table of a spectrum; None if e is one for all directions and wavelengths.

        Args:
            scattering: the tables of `spectrum`.
            spectrum: S(q; κ); for an interface, of wavelengths in the denser medium.
            eta: n below relative to n above, if light is transmitted.
            ratios: the nodes of h/s, equidistant.
            min_lateral_scale: the minimum of s.
        """
        first, last = frequencies_of(spectrum, eta)
        nodes = _nodes(spectrum, eta, scattering.resolved, (first * min(min_lateral_scale, 1), last))
        furnace = Furnace.of(scattering, spectrum, eta)
        furnaces = [dataclasses.replace(furnace, height_scale=ratio) for ratio in ratios]
        e = _bounds(nodes, furnaces, eta, nodes.points()).reshape(len(ratios), -1, *nodes.shape)
        if scattering.resolved or 1 in spectrum.grid.shape:
            # e varies fast where an order is just above the horizon, and in deep reliefs: where it is less at the
            # centre of a grid cell than between the corners, they are lowered by the difference.
            corners = nodes.corners()
            of_centres = _bounds(nodes, furnaces, eta, nodes.points(0.5)).reshape(e[corners[0]].shape)
            excess = np.where(of_centres < 1, np.mean([e[corner] for corner in corners], axis=0) - of_centres, 0)
            lowered = e.copy()
            for corner in corners:
                lowered[corner] = np.minimum(lowered[corner], e[corner] - np.maximum(excess, 0))
            e = lowered
        return cls(nodes, e, ratios) if e.min() < 1 else None

    def __str__(self) -> str:
        return "bounds the albedo by about one"

    def coordinates(self, omega: mi.Vector3f) -> Coordinates:
        """Return the coordinates of ω, a unit vector along the pattern's axes next to the relief, z < 0 below."""
        z = dr.abs(omega.z) if self.two_sided else larger(omega.z, 0)
        if self.nodes.lines:
            x = omega.y if self.nodes.turned else omega.x
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
        """Return e of one direction, for transmitted or reflected light; other arguments as of `factor`."""
        side, slices, weights = integer_part(self.side), integer_part(self.last_slice) + 1, []
        index, tables = mi.UInt32(0), 4 if self.two_sided else 1
        if self.two_sided:
            index += dr.select(at.below, mi.UInt32(2), 0) + dr.select(transmitted, mi.UInt32(1), 0)
        if len(self.ratios) > 1:
            cell, weight = cell_of((ratio - self.first_ratio) * self.per_ratio, self.last_ratio)
            index += tables * cell
            weights.append((weight, tables * slices * side * side))
        index *= slices
        if self.nodes.lines:
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


def _nodes(spectrum: PowerSpectrum, eta: float | None, resolved: bool, frequencies: tuple[float, float]) -> Nodes:
    """Choose the nodes, as many as `MAX_EVALUATIONS` allow."""
    grid, evaluations = spectrum.grid, float(SAMPLES)
    if resolved and isinstance(grid, OrderGrid):
        # The number of orders that propagate, nearly.
        size = 2 * np.array(grid.tile_size) * max(eta or 1, 1) * np.mean(frequencies)
        evaluations = float(np.prod(np.minimum(size, 2 * np.array(grid.max_order)) + 1))
        if eta is None and 1 in grid.shape:
            turned = grid.shape[1] == 1 and grid.shape[0] > 1
            count = min(MAX_LINE_NODES, MAX_EVALUATIONS / evaluations)
            return Nodes.of_lines(grid.tile_size[int(turned)], frequencies, count, turned)
    slices = SLICES if resolved else CONTINUUM_SLICES
    count = MAX_EVALUATIONS / (evaluations * slices * (1 if eta is None else 4))
    return Nodes(int(np.clip(np.sqrt(count), 9, MAX_SIDE)) - 1, slices, frequencies)


def _bounds(nodes: Nodes, furnaces: Sequence[Furnace], eta: float | None, points: Real) -> Real:
    """Return e at coordinates of nodes or of centres of grid cells, (ratios, channels, n)."""
    used = np.ones(len(points), bool)
    if nodes.lines:
        # u + v = 2cT/λ
        used = np.floor(points[:, 1:]).sum(-1) < 2 * nodes.period * nodes.frequencies[1]
    omega, wavelengths = nodes.directions(points[used])
    e = np.ones((len(furnaces), 1 if eta is None else 4, len(points)))
    for k, furnace in enumerate(furnaces):
        of_sides = [bounds_of(furnace.albedo(omega, wavelengths), eta)]
        if eta is not None:
            of_sides.append(bounds_of(furnace.albedo(omega * [1, 1, -1], wavelengths), eta))
        e[k, :, used] = np.concatenate(of_sides).T
    return e
