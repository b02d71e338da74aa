"""The factor e(ω, λ) that bounds the albedo by one, as a table.

With R = 1 the BSDF without E has an albedo a(ω_i, λ) (`furnace.py`) that exceeds one for some directions. It multiplies
by

    E = min(e(ω_i, λ), e(ω_o, λ)),    e = 1/max(1, a)

which is reciprocal, and one where neither direction reflects more than it receives. The table has e at nodes, and e is
linear between them: E is a safeguard of the model, which bounds the albedo of a perfect mirror to about a per cent.

Of a grating with the period T, c = √(1 − ω_y²) and

    u = (c − ω_x) T/λ,    v = (c + ω_x) T/λ

the order m > 0 propagates if m < u, and m < 0 if −m < v: e jumps where u or v is a whole number, and is continuous
between. So each unit square of (u, v) is divided into cells by itself, finest near its lower edges, where an order has
just emerged; at u = 0 and v = 0 ω itself is at the horizon. With f the fraction of u, nodes are equidistant in √f, as
cos θ_o of that order is. a depends on u and v alone, but for lobes that reach the horizon: seen in units of c, they are
1/c as wide. The table has one slice.

Of surfaces with orders in two dimensions, of samples and of interfaces the hemisphere is a square, its middle the
normal and its edge the horizon,

    (ω_x − ω_y, ω_x + ω_y) (1 − t)/(|ω_x| + |ω_y|),    cos θ = 1 − (1 − t²)²

with nodes that are equidistant along its sides and, the slices, in 1/λ. An interface has tables for the light of each
side. That of e = 1 is not among the kinks: the tables hold 1/a also where it is a little more than one.

Scaling lengths by s and heights by h is equivalent to scaling heights by r = h/s at the wavelength λ/s: where scales
vary, there are nodes of r.
"""

from __future__ import annotations

import base64
import binascii
import dataclasses
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter

from ..errors import RequestError
from ..spectrum.grids import OrderGrid
from ..spectrum.power_spectrum import PowerSpectrum
from .furnace import Furnace, Real

MAX_E = 1.05
"""Of what is stored: e is one where that is more, so that it has its kink where a = 1 within a cell."""
LINE_NODES = 1.2e5  # of the table of a line grating, about
MAX_NODES = 100000  # of another table
PAIRS = 3e7  # of a node and a component, of a table with one ratio
MIN_SLICES, MAX_SLICES = 8, 16  # nodes of 1/λ
SLICE_PHASE = 4  # radians of the phase of the deepest point, for each further slice
MIN_FRACTION, MIN_T = 1e-7, 0.01  # of u and v at nodes, and of t


@dataclass(frozen=True)
class Layout:
    """The nodes of a table.

    Attributes:
        period: T in µm of a line grating; 0, of another surface.
        squares: unit squares of (u, v) along each; or the one of all directions.
        first: cells along u or v from 0 to 1, where ω is near the horizon; or along the sides of the one square.
        cells: along the side of the other unit squares.
        slices: one, or nodes of 1/λ.
        frequencies: (smallest, largest) 1/λ in 1/µm.
        turned: the grating is periodic along y: x and y change places.
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
                f"energy table: got {self.squares}, {self.first}, {self.cells}, {self.slices}, wanted at least one"
            )

    @property
    def lines(self) -> bool:
        """Whether it is of a line grating."""
        return self.period > 0

    @property
    def side(self) -> int:
        """Cells along u or v, or along a side of the square."""
        return self.first + (self.squares - 1) * self.cells

    @property
    def shape(self) -> tuple[int, int, int]:
        """Slices, nodes along v and u: a unit square has its own."""
        return self.slices, self.side + self.squares, self.side + self.squares

    @classmethod
    def of(cls, furnace: Furnace, min_lateral_scale: float = 1.0) -> Layout:
        """Choose the layout: as fine as the work allows."""
        spectrum, grid = furnace.spectrum, furnace.spectrum.grid
        lowest, highest = frequencies_of(spectrum, furnace.index)
        frequencies = lowest * min(min_lateral_scale, 1), highest
        if furnace.index is not None or not (isinstance(grid, OrderGrid) and 1 in grid.shape):
            nodes = min(PAIRS / (len(furnace.q) * (1 if furnace.index is None else 6)), MAX_NODES)
            slices = int(min(MIN_SLICES + _phase(furnace, frequencies) / SLICE_PHASE, MAX_SLICES))
            return cls(0.0, 1, max(int(np.sqrt(nodes / slices)) - 1, 8), 1, slices, frequencies)
        turned = grid.shape[1] == 1 and grid.shape[0] > 1
        # About half of the squares have light.
        side = np.sqrt(2 * min(LINE_NODES, PAIRS / max(len(furnace.q) / 2, 1)))
        first = int(np.clip(side / 8, 4, 24))
        period, rest = grid.tile_size[int(turned)], (side - 2 * first - 1) / 3
        period /= max(np.ceil(2 * period * highest / max(rest, 2)), 1)
        squares = int(np.ceil(2 * period * highest))
        cells = int(np.clip((3 * rest / max(squares - 1, 1) - 1) / 2, 1, 48))
        return cls(float(period), squares, first, cells, 1, frequencies, turned)

    @property
    def squares_of_cells(self) -> NDArray[np.int64]:
        """The unit square of each cell along u or v: the cell k has the nodes k + this number and the next."""
        return np.repeat(np.arange(self.squares), [self.first] + [self.cells] * (self.squares - 1))

    def nodes(self) -> Real:
        """Return the coordinates of all nodes, (n, 3), in the order of `shape`, as `directions` takes them."""
        axis: Real = np.arange(self.shape[1], dtype=np.float64)
        if self.lines:
            counts = [self.first] + [self.cells] * (self.squares - 1)
            fractions = [np.linspace(0, 1, count + 1, dtype=np.float64) ** 2 for count in counts]
            axis = np.concatenate([j + f.clip(MIN_FRACTION, 1 - MIN_FRACTION) for j, f in enumerate(fractions)])
        axes = np.arange(self.slices, dtype=np.float64), axis, axis
        return np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)

    def directions(self, coordinates: Real, frequency: float = np.inf) -> tuple[Real, Real]:
        """Return ω (n, 3) and λ in µm (n,) of coordinates (n, 3): slice, row and column in cells; or 0, v and u.

        Many directions of a line grating have the same u and v: of those in the range of the table the one is returned
        whose 1/λ is the closest to `frequency`.
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
    """e at nodes, linear between them.

    Attributes:
        layout: the nodes of directions and wavelengths.
        ratios: the nodes of h/s, equidistant.
        values: uint8 (ratios, ways, *layout.shape): e = min(1, `MAX_E`/255 · value). The ways are one, or, of an
            interface, reflected and transmitted light from above, and the same from below.
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
        index: float | None = None,
        min_lateral_scale: float = 1.0,
    ) -> EnergyTable:
        """Make the table of `spectrum`.

        Args:
            spectrum: S(q; κ); of an interface for wavelengths in the denser medium.
            ratios: the nodes of h/s, equidistant.
            index: of the medium below relative to that above, if light is transmitted.
            min_lateral_scale: the smallest s.
        """
        sides = [Furnace.of(spectrum, max(ratios), index, side) for side in ((1,) if index is None else (1, -1))]
        layout = Layout.of(sides[0], min_lateral_scale)
        nodes = layout.nodes()
        if layout.lines:
            # u + v = 2cT/λ
            lit = np.floor(nodes[:, 1:]).sum(-1) < 2 * layout.period * layout.frequencies[1]
        else:
            lit = np.ones(len(nodes), bool)
        omega, wavelengths = layout.directions(nodes[lit], float(np.mean(layout.frequencies)))
        e = np.ones((len(ratios), 1 if index is None else 4, len(nodes)))
        for k, ratio in enumerate(ratios):
            found = [
                bounds_of(dataclasses.replace(side, height_scale=ratio).albedo(omega, wavelengths / n), side.index)
                for side, n in zip(sides, (1.0, index or 1.0), strict=False)
            ]
            e[k, :, lit] = np.concatenate(found).T
        e = e.reshape(*e.shape[:2], *layout.shape)
        if _phase(sides[0], layout.frequencies) > (MAX_SLICES - MIN_SLICES) * SLICE_PHASE:
            # Of a relief so deep e has no smooth course from node to node: each gets the smallest of its neighbours,
            # rounded down.
            e = minimum_filter(e, (1, 1, 3, 3, 3)) - 0.5 * MAX_E / 255
        values = np.rint(np.clip(e, 0, MAX_E) * (255 / MAX_E)).astype(np.uint8)
        return cls(layout, values, tuple(ratios))

    @property
    def needed(self) -> bool:
        """Whether some direction would reflect more than it receives."""
        return bool(self.values.min() * (MAX_E / 255) < 1)

    def corners(self) -> NDArray[np.uint8]:
        """Return the values at (u, v), (u⁺, v), (u, v⁺), (u⁺, v⁺) of cells, (ratios, ways, slices, side, side, 4)."""
        start = np.arange(self.layout.side) + self.layout.squares_of_cells
        return np.stack([self.values[..., start[:, None] + j, start + i] for j, i in np.ndindex(2, 2)], -1)

    def as_plain(self) -> dict[str, Any]:
        """Return the table, of reflected light and one ratio, as numbers and texts, for JSON."""
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
            # No more than there should be: a damaged file may hold a long row of zeros.
            content = zlib.decompressobj().decompress(base64.b64decode(plain["values"]), size + 1)
        except (zlib.error, binascii.Error) as error:
            raise RequestError(f"energy table: {error}") from None
        if not 0 < size < 1 << 26 or len(content) != size:
            raise RequestError(f"energy table: got {len(content)} bytes, wanted {size}")
        return cls(layout, np.frombuffer(content, np.uint8).reshape(1, 1, *layout.shape))


def _phase(furnace: Furnace, frequencies: tuple[float, float]) -> float:
    """Return by how much the phase of the deepest point differs between two 1/λ, in the denser medium, in radians."""
    height = furnace.spectrum.height_range * furnace.height_scale * max(furnace.index or 1, 1)
    return 4 * np.pi * height * (frequencies[1] - frequencies[0])


def frequencies_of(spectrum: PowerSpectrum, index: float | None) -> tuple[float, float]:
    """Return (smallest, largest) 1/λ in 1/µm of a table; `index` is η as of `Furnace`."""
    # Those of the spectrum are in the denser medium.
    shortest, longest = (w * 1e-3 * max(index or 1, 1) for w in spectrum.wavelengths)
    return 1 / longest, 1 / shortest


def bounds_of(albedo: Real, index: float | None) -> Real:
    """Return e from what the furnace finds.

    Reflected light alone has e = 1/max(1, a). Of an interface transmitted light comes first, as scalar theory sends all
    of it on where steep facets reflect it totally, but for what a plane reflects at normal incidence, F₀:

        e_T = min(1, (1 − min(R, F₀))/T),    e_R = min(1, (1 − e_T T)/R),    e_R R + e_T T = min(1, R + T)

    Args:
        albedo: (1, n), or R and T (2, n).
        index: η; None of reflected light alone.

    Returns:
        As `albedo`; of reflected light alone up to `MAX_E`.
    """
    if index is None:
        return np.minimum(1 / np.maximum(albedo, 1e-9), MAX_E)
    r, t = albedo
    # No more than one: e_R is so steep there that what lies between nodes would lower them by more.
    e_t = np.minimum(1, (1 - np.minimum(r, ((index - 1) / (index + 1)) ** 2)) / np.maximum(t, 1e-9))
    return np.stack([np.minimum(1, (1 - e_t * t) / np.maximum(r, 1e-9)), e_t])
