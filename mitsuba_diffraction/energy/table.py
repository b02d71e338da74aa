"""The factor e(ω, λ) that bounds the albedo by one, as a table.

With R = 1 the BSDF without E has an albedo a(ω_i, λ) (`furnace.py`) that exceeds one for some directions. The BSDF is
multiplied by

    E = min(e(ω_i, λ), e(ω_o, λ)),    e = 1/max(1, a)

which is reciprocal, and one where a ≤ 1 for both directions. The table holds e at nodes and is linear between them.
Where e is smaller at the centre of a grid cell than the mean of its corners, the corners are lowered by the difference.
This is needed because a varies fast where an order is just above the horizon, and in deep reliefs, where they are
lowered by more near the horizon. E is a safeguard of the model; docs/materials.md has measured albedos.

For a line grating of period T, with c = √(1 − ω_y²) and

    u = (c − ω_x) T/λ,    v = (c + ω_x) T/λ

the order m > 0 propagates if m < u, and the order m < 0 if −m < v. e jumps where u or v is a whole number, and is
continuous between. Each unit square of (u, v) is therefore divided into grid cells separately. They are finest near its
lower edges, where an order is just above the horizon; at u = 0 and v = 0, ω itself is at the horizon. With f the
fractional part of u, nodes are equidistant in √f, which is proportional to cos θ_o of that order. Where no lobe meets
the horizon, a depends on u and v alone; where one does, its width in units of c is proportional to 1/c. The table has
one slice, of a mean c; of reliefs deeper than the shortest wavelength, it holds the minimum of e at the maximum and at
the minimum of c.

For surfaces with orders in two dimensions, for samples and for interfaces the hemisphere is mapped to a square, with
the normal at its centre and the horizon at its edge,

    (ω_x − ω_y, ω_x + ω_y) (1 − t)/(|ω_x| + |ω_y|),    cos θ = 1 − (1 − t²)²

Its nodes are equidistant along the sides, and its slices are equidistant in 1/λ. An interface has tables for light from
above and from below. The tables of reflected light hold 1/a up to `MAX_E`, so that interpolation does not smooth the
kink of e at a = 1.

Scaling lengths by s and heights by h is equivalent to scaling heights by r = h/s at the wavelength λ/s: where scales
vary, the table has nodes in r.
"""

from __future__ import annotations

import base64
import binascii
import dataclasses
import threading
import zlib
from collections.abc import Hashable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import RequestError
from ..machine import usable_cores
from ..optics.film_stack import MAX_PHASE_STEP, Stack
from ..spectrum.grids import OrderGrid
from ..spectrum.power_spectrum import PowerSpectrum
from .furnace import MAX_E, MAX_GRAZING, Furnace, Real

MAX_LINE_NODES = 1.2e5  # nodes of the table of a line grating, about
MAX_NODES = 100000  # nodes of any other table
MAX_NODE_COMPONENT_PAIRS = 3e7  # evaluations for a table with one ratio
SLICES, MAX_SLICES = 16, 96  # nodes of 1/λ; more than the minimum where fringes of films are narrow
MIN_FRACTION = 1e-7  # distance of nodes from whole u and v
MIN_T = 0.01  # t of nodes at the horizon
MAX_GRAZING_COS = 0.2  # cos θ of ω, below which grid cells do not resolve the orders that return to ω
MAX_KEPT = 16  # tables of this process that are kept; at most 6.4 MB each, mostly 0.4 MB


@dataclass(frozen=True)
class Layout:
    """The nodes of a table.

    Attributes:
        period: T in µm of a line grating; 0 for any other surface.
        squares: number of unit squares of (u, v) along u and along v; 1 for the square of all directions.
        first: number of grid cells from u or v = 0 to 1, where ω is near the horizon; else along a side of the square.
        cells: number of grid cells along a side of each other unit square.
        slices: 1, or the number of nodes in 1/λ.
        frequencies: (minimum, maximum) of 1/λ in 1/µm.
        turned: whether the grating is periodic along y, so that x and y are exchanged.
    """

    period: float
    squares: int
    first: int
    cells: int
    slices: int
    frequencies: tuple[float, float]
    turned: bool = False

    def __post_init__(self) -> None:
        if not (0 <= self.period < np.inf and 0 < self.frequencies[0] < self.frequencies[1] < np.inf):
            raise RequestError(f"energy table: got period {self.period}, frequencies {self.frequencies}")
        if min(self.squares, self.first, self.cells, self.slices - (not self.lines)) < 1:
            raise RequestError(
                f"energy table: got {self.squares}, {self.first}, {self.cells}, {self.slices}, wanted at least one each"
            )

    @property
    def lines(self) -> bool:
        """Whether the table belongs to a line grating."""
        return self.period > 0

    @property
    def side(self) -> int:
        """Number of grid cells along u or v, or along a side of the square."""
        return self.first + (self.squares - 1) * self.cells

    @property
    def shape(self) -> tuple[int, int, int]:
        """(slices, nodes along v, nodes along u); unit squares share no nodes."""
        return self.slices, self.side + self.squares, self.side + self.squares

    @classmethod
    def of(cls, furnace: Furnace, laterals: tuple[float, float] = (1.0, 1.0)) -> Layout:
        """Choose the layout: as fine as `MAX_NODES` and `MAX_NODE_COMPONENT_PAIRS` allow."""
        spectrum, grid = furnace.spectrum, furnace.spectrum.grid
        frequencies = frequencies_of(spectrum, furnace.index, laterals)
        if furnace.index is not None or not (isinstance(grid, OrderGrid) and 1 in grid.shape):
            nodes = min(MAX_NODE_COMPONENT_PAIRS / (len(furnace.q) * (1 if furnace.index is None else 6)), MAX_NODES)
            phase = 0.0 if furnace.stack is None else furnace.stack.phase(frequencies)
            slices = int(np.clip(phase / MAX_PHASE_STEP, SLICES, MAX_SLICES))
            return cls(0.0, 1, max(int(np.sqrt(nodes / slices)) - 1, 8), 1, slices, frequencies)
        turned = grid.shape[1] == 1 and grid.shape[0] > 1
        # In about half of the unit squares 1/λ is in range.
        side = np.sqrt(2 * min(MAX_LINE_NODES, MAX_NODE_COMPONENT_PAIRS / max(len(furnace.q) / 2, 1)))
        first = int(np.clip(side / 8, 4, 24))
        period, rest = grid.tile_size[int(turned)], (side - 2 * first - 1) / 3
        period /= max(np.ceil(2 * period * frequencies[1] / max(rest, 2)), 1)
        squares = int(np.ceil(2 * period * frequencies[1]))
        cells = int(np.clip((3 * rest / max(squares - 1, 1) - 1) / 2, 1, 48))
        return cls(float(period), squares, first, cells, 1, frequencies, turned)

    @property
    def squares_of_cells(self) -> NDArray[np.int64]:
        """The index s_k of the unit square of each grid cell k along u or v; its nodes are k + s_k and k + s_k + 1."""
        return np.repeat(np.arange(self.squares), [self.first] + [self.cells] * (self.squares - 1))

    def corners(self) -> list[tuple[Any, ...]]:
        """Return the indices of the corners of all grid cells in an array (..., *shape), from slices to columns."""
        start = np.arange(self.side) + self.squares_of_cells
        count = max(self.slices - 1, 1)
        return [
            (..., slice(k, k + count), start[:, None] + j, start + i)
            for k, j, i in np.ndindex(min(self.slices, 2), 2, 2)
        ]

    def points(self, offset: float) -> Real:
        """Return the coordinates of all nodes (`offset` 0) or of the centres of all grid cells (0.5), (n, 3).

        They are in the order of `shape`, for `directions`.
        """
        last = 1 if offset == 0 else 0
        slices = np.arange(self.slices + last - 1) + offset if self.slices > 1 else np.zeros(1)
        axis = np.arange(self.first + last) + offset
        if self.lines:
            counts = [self.first] + [self.cells] * (self.squares - 1)
            fractions = [((np.arange(count + last) + offset) / count) ** 2 for count in counts]
            axis = np.concatenate([j + f.clip(MIN_FRACTION, 1 - MIN_FRACTION) for j, f in enumerate(fractions)])
        return np.stack(np.meshgrid(slices, axis, axis, indexing="ij"), -1).reshape(-1, 3)

    def directions(self, coordinates: Real, frequency: float = np.inf) -> tuple[Real, Real]:
        """Return ω (n, 3) and λ in µm (n,) at coordinates (n, 3): slice, row and column in grid cells; or 0, v and u.

        Many directions of a line grating have the same u and v. Among these the direction with 1/λ in the range of the
        table, and closest to `frequency`, is returned.
        """
        first, last = self.frequencies
        nu, row, column = coordinates.T
        if self.lines:
            nu = (row + column) / (2 * self.period)
            c = np.minimum(nu / np.clip(frequency, first, last), 1)
            x = (row - column) / (row + column)
            x, y, z = c * x, np.sqrt(1 - c**2), c * np.sqrt(1 - x**2)
            return np.stack([y, x, z] if self.turned else [x, y, z], -1), c / nu
        row, column = (2 * x / self.first - 1 for x in (row, column))
        x, y = (column + row) / 2, (column - row) / 2
        t = np.maximum(1 - np.abs(x) - np.abs(y), MIN_T)
        z = 1 - (1 - t**2) ** 2
        along = np.sqrt(1 - z**2) / np.maximum(np.hypot(x, y), 1e-12)
        return np.stack([along * x, along * y, z], -1), 1 / (first + nu / (self.slices - 1) * (last - first))


@dataclass(frozen=True, eq=False)
class EnergyTable:
    """The factor e at nodes, linear between them.

    Attributes:
        layout: the nodes of directions and wavelengths.
        ratios: the nodes of h/s, equidistant.
        values: uint8 (ratios, channels, *layout.shape): e = min(1, `MAX_E`/255 · value). There is one channel; or for
            an interface four: light from above, reflected and transmitted, and light from below, likewise.
    """

    layout: Layout
    values: NDArray[np.uint8] = field(repr=False)
    ratios: tuple[float, ...] = (1.0,)

    def __post_init__(self) -> None:
        got, wanted = self.values, (len(self.ratios), self.values.shape[1], *self.layout.shape)
        if got.shape != wanted or got.dtype != np.uint8:
            raise RequestError(f"energy table: got {got.dtype} {got.shape}, wanted uint8 {wanted}")
        got.setflags(write=False)

    @classmethod
    def of(
        cls,
        spectrum: PowerSpectrum,
        ratios: Sequence[float] = (1.0,),
        stack: Stack | None = None,
        laterals: tuple[float, float] = (1.0, 1.0),
    ) -> EnergyTable:
        """Return the table of `spectrum`: one of the last `MAX_KEPT`, or computed.

        A scene that is loaded again, or a parameter that returns to a value, takes the table that it had.

        Args:
            spectrum: S(q; κ); for an interface, of wavelengths in the denser medium.
            ratios: the nodes of h/s, equidistant.
            stack: the dielectric with its films, if light is transmitted.
            laterals: bounds of s.
        """
        key = spectrum.digest, tuple(ratios), stack, laterals
        with _keeping:
            kept = _kept.pop(key, None)
        table = kept or cls._computed(spectrum, ratios, stack, laterals)
        with _keeping:
            _kept[key] = table
            while len(_kept) > MAX_KEPT:
                _kept.pop(next(iter(_kept)))  # least recently used
        return table

    @classmethod
    def _computed(
        cls, spectrum: PowerSpectrum, ratios: Sequence[float], stack: Stack | None, laterals: tuple[float, float]
    ) -> EnergyTable:
        above = Furnace.of(spectrum, max(ratios), stack, laterals[0])
        sides = [above] if stack is None else [above, above.from_below()]
        layout = Layout.of(sides[0], laterals)
        of_nodes = _bounds(layout, sides, ratios, layout.points(0.0), laterals)
        of_centres = _bounds(layout, sides, ratios, layout.points(0.5), laterals)
        # e varies fast where an order is just above the horizon, and in deep reliefs. Where it is less at the centre of
        # a grid cell than between the corners, the corners are lowered by the difference. Reliefs deeper than all
        # wavelengths retroreflect light at grazing incidence, where K G is large and grid cells do not resolve lobes:
        # corners of these cells are lowered by twice the difference, of either sign.
        omega, _ = layout.directions(layout.points(0.5), layout.frequencies[0])
        unresolved_cells = (omega[:, 2] < MAX_GRAZING_COS) & _is_deeper(above, layout.frequencies[0])
        corners = layout.corners()
        values = np.empty((*of_nodes.shape[:2], *layout.shape), np.uint8)
        for channel in np.ndindex(of_nodes.shape[:2]):
            e = of_nodes[channel].reshape(layout.shape)
            of_corners = np.array([e[corner] for corner in corners])
            centre = of_centres[channel].reshape(of_corners.shape[1:])
            excess, lowest = of_corners.mean(axis=0) - centre, np.minimum(of_corners.min(axis=0), centre)
            unresolved = unresolved_cells.reshape(centre.shape) & (lowest < 1)
            excess = np.where(unresolved, 2 * np.abs(excess), np.where(centre < 1, np.maximum(excess, 0), 0))
            lowered = e.copy()
            for corner in corners:
                lowered[corner] = np.minimum(lowered[corner], np.maximum(e[corner] - excess, lowest / 2))
            values[channel] = np.rint(np.clip(lowered, 0, MAX_E) * (255 / MAX_E))
        return cls(layout, values, tuple(ratios))

    @property
    def needed(self) -> bool:
        """Whether the albedo exceeds one for any direction."""
        return bool(self.values.min() * (MAX_E / 255) < 1)

    def corners(self) -> NDArray[np.uint8]:
        """Return the values at the corners (u, v), (u⁺, v), (u, v⁺), (u⁺, v⁺) of grid cells.

        Returns:
            (ratios, channels, slices, side, side, 4).
        """
        start = np.arange(self.layout.side) + self.layout.squares_of_cells
        return np.stack([self.values[..., start[:, None] + j, start + i] for j, i in np.ndindex(2, 2)], -1)

    def as_plain(self) -> dict[str, Any]:
        """Return a table of one channel and one ratio as numbers and strings, for JSON."""
        packed = base64.b64encode(zlib.compress(self.values.tobytes(), 9)).decode("ascii")
        return {"layout": dataclasses.asdict(self.layout), "values": packed}

    @classmethod
    def from_plain(cls, plain: Mapping[str, Any]) -> EnergyTable:
        """Return the table that `as_plain` describes.

        Raises:
            ValueError, TypeError or KeyError: if it is not a table.
        """
        if plain.keys() != {"layout", "values"}:
            raise RequestError(f"energy table: got {', '.join(plain)}, wanted layout, values")
        layout = Layout(**{**plain["layout"], "frequencies": tuple(plain["layout"]["frequencies"])})
        size = int(np.prod(layout.shape, dtype=np.int64))
        try:
            # A limit, as a damaged file may expand without end.
            content = zlib.decompressobj().decompress(base64.b64decode(plain["values"]), size + 1)
        except (zlib.error, binascii.Error) as error:
            raise RequestError(f"energy table: {error}") from None
        if not 0 < size < 1 << 26 or len(content) != size:
            raise RequestError(f"energy table: got {len(content)} bytes, wanted {size}")
        return cls(layout, np.frombuffer(content, np.uint8).reshape(1, 1, *layout.shape))


_keeping = threading.Lock()
_kept: dict[Hashable, EnergyTable] = {}


def _is_deeper(furnace: Furnace, frequency: float) -> bool:
    """Return whether the relief is deeper than the wavelength 1/`frequency`."""
    return furnace.spectrum.height_range * furnace.height_scale * frequency > 1


def _bounds(
    layout: Layout, sides: Sequence[Furnace], ratios: Sequence[float], points: Real, laterals: tuple[float, float]
) -> Real:
    """Return e at coordinates of nodes or centres of a layout, (ratios, channels, n)."""
    used, mirror, grid = np.ones(len(points), bool), 0, sides[0].spectrum.grid
    if layout.lines:
        # u + v = 2cT/λ
        used = np.floor(points[:, 1:]).sum(-1) < 2 * layout.period * layout.frequencies[1]
    elif isinstance(grid, OrderGrid) and 1 in grid.shape:
        # Symmetric along the grooves, as rows and columns are exchanged, in reverse where the grooves are along x.
        _, row, column = points.T
        mirror = 1 if grid.shape[0] == 1 else -1
        used = row <= column if mirror == 1 else row + column <= layout.side
    # Of deep lines, first of the directions with the same u and v that in the plane.
    of_both = layout.lines and _is_deeper(sides[0], layout.frequencies[1])
    frequency = layout.frequencies[0] if of_both else float(np.mean(layout.frequencies))
    omega, wavelengths = layout.directions(points[used], frequency)
    node = np.flatnonzero(used)
    if of_both:
        # Also the one farthest from the plane, where lobes meet the horizon.
        grazing = omega[:, 2] ** 2 < 2 * MAX_GRAZING * sides[0].lobe_scale * sides[0].spectrum.lobe_width * wavelengths
        conical = layout.directions(points[node[grazing]], layout.frequencies[1])
        omega, wavelengths = (np.concatenate(x) for x in zip((omega, wavelengths), conical, strict=True))
        node = np.concatenate([node, node[grazing]])
    e = np.full((len(ratios), sum(len(side.branches[:2]) for side in sides), len(points)), MAX_E)
    found = np.empty((*e.shape[:2], len(node)))
    if layout.lines:
        slices = np.array_split(np.arange(len(omega)), SLICES)
    else:
        # R and T of films, and the index, depend on the wavelength; there are few wavelengths.
        slices = [np.flatnonzero(wavelengths == wavelength) for wavelength in np.unique(wavelengths)]
    step = (layout.frequencies[1] - layout.frequencies[0]) / (2 * max(layout.slices - 1, 1))

    def of_slice(slice_: NDArray[np.int64]) -> Real:
        bounds = []
        for side in sides:
            furnace = side.at_wavelength(wavelengths[slice_[0]], laterals, step)
            length = wavelengths[slice_] * (1.0 if side.side > 0 else furnace.index or 1.0)
            bounds.append(furnace.bounds(omega[slice_], length, ratios))
        return np.concatenate(bounds, axis=1)

    with ThreadPoolExecutor(usable_cores()) as pool:
        for slice_, bounds in zip(slices, pool.map(of_slice, slices), strict=True):
            found[..., slice_] = bounds
    for of_node, of_direction in zip(e.reshape(-1, len(points)), found.reshape(-1, len(node)), strict=True):
        np.minimum.at(of_node, node, of_direction)
    if mirror:
        count = len(np.unique(points[:, 1]))
        mirrored = e.reshape(*e.shape[:2], -1, count, count)[..., ::mirror, ::mirror].swapaxes(-1, -2)
        e = np.where(used, e, mirrored.reshape(e.shape))
    return e


def frequencies_of(
    spectrum: PowerSpectrum, index: float | None, laterals: tuple[float, float] = (1.0, 1.0)
) -> tuple[float, float]:
    """Return (minimum, maximum) of s/λ in 1/µm for a table; `index` is η of `Furnace`, `laterals` are bounds of s."""
    # The wavelengths of the spectrum are in the denser medium, and are shorter for s > 1.
    shortest, longest = (w * 1e-3 * max(index or 1, 1) for w in spectrum.wavelengths)
    return min(laterals[0], 1) / longest, min(laterals[1], 1) / shortest
