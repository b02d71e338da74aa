"""The factor e(ω, λ) that bounds the albedo by one, as a table.

With R = 1 the BSDF without E has an albedo a(ω_i, λ) (`furnace.py`) that exceeds one for some directions. It multiplies
by

    E = min(e(ω_i, λ), e(ω_o, λ)),    e ≤ min(1, 1/a)

which is reciprocal, bounds the albedo by one, and is one where neither direction reflects more than it receives.

Of a grating with the period T, c = √(1 − ω_y²) and

    u = (c − ω_x) T/λ,    v = (c + ω_x) T/λ

the order m > 0 propagates if m < u, and m < 0 if −m < v: e jumps where u or v is a whole number, and is continuous
between. So each unit square of (u, v) is divided into cells by itself, finest near its lower edges, where an order has
just emerged; at u = 0 and v = 0 ω itself is at the horizon. With f the fraction of u, nodes are equidistant in √f, as
cos θ_o of that order is. a depends on u and v alone, but for lobes that reach the horizon: seen in units of c, they are
1/c as wide, and e is the smaller of those at both ends of the range of c = (u + v) λ/2T. The table has one slice.

Of surfaces with orders in two dimensions, of samples and of interfaces the hemisphere is a square, its middle the
normal and its edge the horizon,

    (ω_x − ω_y, ω_x + ω_y) (1 − t)/(|ω_x| + |ω_y|),    cos θ = 1 − (1 − t²)²

with nodes that are equidistant along its sides and, the slices, in 1/λ: there e is smooth but for its kinks. An
interface has tables for the light of each side. That of e = 1 is not among the kinks: the tables hold 1/a also where it
is a little more than one.
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
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import minimum_filter

from ..errors import RequestError
from ..spectrum.grids import OrderGrid
from ..spectrum.power_spectrum import PowerSpectrum
from .furnace import BLUR, PHASE, Furnace, Indices, Real

SLACK = 1e-3
"""What an albedo may exceed one by."""
LARGEST = 1.05
"""Of what is stored: e is one where that is more, so that it has its kink where a = 1 within a cell."""
CHECKED, CHECKS = 150, 3  # random places at which a table is held against the spectrum itself, and how often
CANDIDATES, TIGHT = 15, 0.9  # so many places, at most, for one that is checked: there the furnace finds this albedo
ABOUT = 3, 5, 5  # slices, rows and columns that are lowered about such a place
NODES, FINEST = 3500, 12  # nodes of other tables; times this, at most
PLACES = 1.2e5  # cells of the table of a line grating, about; a quarter if lobes are wide, which takes longer
ROUNDS, PAIRS = 32, 5e6  # places in a cell, at most; about so many pairs with components
STEEP = 0.98  # e is lowered so far inside of a cell or its neighbours, where more places are tried
STRIDE = np.array([0.8191725, 0.6710436, 0.5497005])  # of places in a cell, so that few rounds cover it (Roberts 2018)
NEAR = 3  # of an order emerging at u = m within u − m < 3σ_q T/c a lobe reaches the horizon
LEAST, HORIZON = 1e-7, 0.01  # the least fraction of u and v, and the least t


@dataclass(frozen=True)
class Layout:
    """Where the cells of a table lie.

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
    def shape(self) -> tuple[int, int, int, int]:
        """Slices, cells along v and u, and the four corners of each."""
        side = self.first + (self.squares - 1) * self.cells
        return self.slices, side, side, 4

    @classmethod
    def of(cls, furnace: Furnace) -> Layout:
        """Choose the layout: as fine as the work allows."""
        spectrum, grid = furnace.spectrum, furnace.spectrum.grid
        frequencies = frequencies_of(spectrum, furnace.index)
        if furnace.index is not None or not (isinstance(grid, OrderGrid) and 1 in grid.shape):
            # As fine as the work allows, which is about the same for all.
            nodes = NODES * float(np.clip(PAIRS / 2 / (furnace.work * NODES), 1, 1 if furnace.index else FINEST))
            # In the denser medium, as both sides have equally many slices.
            turn = 4e3 * np.pi * furnace.depth * (1 / spectrum.wavelengths[0] - 1 / spectrum.wavelengths[1])
            slices = int(np.clip(4 + turn / PHASE, 4, 16) * np.cbrt(nodes / NODES))
            # Of deep surfaces more: but orders that are evaluated by themselves need the time for places within cells.
            per_slice = nodes / (slices if furnace.by_order else min(slices, 8))
            return cls(0.0, 1, int(np.sqrt(per_slice)), 1, slices, frequencies)
        turned = grid.shape[1] == 1 and grid.shape[0] > 1
        # So many places that the work is about the same for all gratings; where no phase turns within lobes, two thirds
        # lose as little.
        nodes = PLACES / (4 if furnace.wide else 1 if furnace.turning else 1.5)
        side = np.sqrt(2 * min(nodes, PAIRS / max(len(furnace.q) / 2, 1)))
        first = int(np.clip(side / 8, 4, 24))
        period, rest = grid.tile_size[int(turned)], (side - 2 * first - 1) / 3
        period /= max(np.ceil(2 * period * frequencies[1] / max(rest, 2)), 1)
        squares = int(np.ceil(2 * period * frequencies[1]))
        cells = int(np.clip((3 * rest / max(squares - 1, 1) - 1) / 2, 1, 48))
        return cls(float(period), squares, first, cells, 1, frequencies, turned)

    def places(self, directions: Real, wavelengths: ArrayLike) -> tuple[Real, Real, Real]:
        """Return slice, row and column of ω (n, 3) and λ (µm), in cells: each (n,)."""
        x, y, z = directions.T
        if not self.lines:
            t = np.sqrt(1 - np.sqrt(np.maximum(1 - z, 0)))
            along = (1 - t) / np.maximum(np.abs(x) + np.abs(y), 1e-12)
            first, last = self.frequencies
            place = np.clip((1 / np.broadcast_to(wavelengths, x.shape) - first) / (last - first), 0, 1)
            return place * (self.slices - 1), *(self.first / 2 * (1 + along * of) for of in (x - y, x + y))
        if self.turned:
            x, y = y, x
        longer = np.sqrt(x**2 + z**2) + np.abs(x)
        shorter = z**2 / np.maximum(longer, 1e-12)
        per_length = self.period / np.asarray(wavelengths)
        u, v = (self._place(np.where(x * sign > 0, shorter, longer) * per_length) for sign in (1, -1))
        return np.zeros(len(x)), v, u

    def directions(self, cells: Indices, inside: Real, frequency: float = np.inf) -> tuple[Real, Real]:
        """Return the inverse of `places`, ω (n, 3) and λ (n,), of places `inside` cells, both (n, 3).

        Many directions of a line grating have the same u and v: of those in the range of the spectrum the one is
        returned whose 1/λ is the closest to `frequency`; with zero, that with c = 1 in any case.
        """
        first, last = self.frequencies
        if self.lines:
            v, u = (square + fraction for square, fraction in self.fractions(cells, inside))
            nu = (u + v) / (2 * self.period)
            c = np.minimum(nu / np.clip(frequency, first, last), 1) if frequency else np.ones_like(nu)
            x = (v - u) / (u + v)
            x, y, z = c * x, np.sqrt(1 - c**2), c * np.sqrt(1 - x**2)
            return np.stack([y, x, z] if self.turned else [x, y, z], -1), c / nu
        nu, row, column = (cells + inside).T
        row, column = (2 * x / self.first - 1 for x in (row, column))
        x, y = (column + row) / 2, (column - row) / 2
        t = np.maximum(1 - np.abs(x) - np.abs(y), HORIZON)
        z = 1 - (1 - t**2) ** 2
        along = np.sqrt(1 - z**2) / np.maximum(np.hypot(x, y), 1e-12)
        return np.stack([along * x, along * y, z], -1), 1 / (first + nu / (self.slices - 1) * (last - first))

    def fractions(self, cells: Indices, inside: Real) -> list[tuple[Indices, Real]]:
        """Return the whole number below v and that below u, (n,), each with what remains, of a line grating."""
        result = []
        for cell, x in zip(cells.T[1:], inside.T[1:], strict=True):
            square = self.squares_of_cells[cell]
            start, count = self._span(square)
            result.append((square, np.clip(((cell - start + x) / count) ** 2, LEAST, 1 - LEAST)))
        return result

    @property
    def squares_of_cells(self) -> Indices:
        """The unit square of each cell along u or v."""
        return np.repeat(np.arange(self.squares), [self.first] + [self.cells] * (self.squares - 1))

    @property
    def cell_counts(self) -> tuple[int, int, int]:
        """Cells along slices, v and u."""
        return max(self.slices - 1, 1), *self.shape[1:3]

    def cells_of(self, *places: Real) -> tuple[Indices, ...]:
        """Return the cells of places (slice, row, column), as an index of the first three axes of `shape`."""
        return tuple(np.clip(x.astype(np.int64), 0, n - 1) for x, n in zip(places, self.cell_counts, strict=True))

    def lowered(self, e: Real, share: Real) -> Real:
        """Return e at corners (..., *shape) times a share of each cell, (..., slices − 1 or 1, rows, columns)."""
        if not self.lines:
            # Two cells share a slice.
            n = self.slices - 1
            share = np.minimum(share[..., np.r_[0, :n], :, :], share[..., np.r_[:n, n - 1], :, :])
        return e * share[..., None]

    def random_places(self, count: int, seed: int) -> tuple[Real, Real]:
        """Return `count` directions (n, 3), two thirds of them beyond 60°, one beyond 85°, and λ in µm, (n,)."""
        rng = np.random.default_rng(seed)
        theta = np.deg2rad(rng.uniform(rng.choice([0, 60, 85], count), 89.9))
        phi = rng.uniform(0, 2 * np.pi, count)
        x, y = np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi)
        omega = np.stack([y, x, np.cos(theta)] if self.turned else [x, y, np.cos(theta)], -1)
        return omega, rng.uniform(1 / self.frequencies[1], 1 / self.frequencies[0], count)

    def _place(self, u: Real) -> Real:
        square = np.minimum(np.floor(u), self.squares - 1)
        start, count = self._span(square)
        return start + np.sqrt(np.clip(u - square, 0, 1)) * count

    def _span(self, square: NDArray) -> tuple[NDArray, NDArray]:
        """Return the first cell of a unit square, and how many it has."""
        inner = square > 0
        return np.where(inner, self.first + (square - 1) * self.cells, 0), np.where(inner, self.cells, self.first)


@dataclass(frozen=True, eq=False)
class EnergyTable:
    """e at the corners of cells, linear between them.

    Attributes:
        layout: where the cells lie.
        steps: uint8 (slices, rows, columns, 4): e = min(1, `least` + (`LARGEST` − `least`)/255 · step), with the step
            linear between (u, v), (u⁺, v), (u, v⁺) and (u⁺, v⁺).
        least: the smallest e.
        loss: (mean, largest) share of e that is less than the furnace allows, at random places, most of them slanted.
    """

    layout: Layout
    steps: NDArray[np.uint8] = field(repr=False)
    least: float
    loss: tuple[float, float]

    def __post_init__(self) -> None:
        got = self.steps
        if got.shape != self.layout.shape or got.dtype != np.uint8:
            raise RequestError(f"energy table: got {got.dtype} {got.shape}, wanted uint8 {self.layout.shape}")
        if not 0 <= self.least <= 1:
            raise RequestError(f"energy table: got {self.least} as its smallest value, wanted 0 to 1")
        got.setflags(write=False)

    @classmethod
    def of(
        cls, spectrum: PowerSpectrum, height_scale: float = 1.0, layouts: Sequence[Layout] | None = None
    ) -> EnergyTable:
        """Make the table of `spectrum`, with its heights scaled by `height_scale`; it has the first of `layouts`."""
        furnace = Furnace.of(spectrum, height_scale)
        return cls._of_side(furnace, layouts[0] if layouts else Layout.of(furnace))[0]

    @classmethod
    def of_interface(
        cls,
        spectrum: PowerSpectrum,
        index: float,
        height_scale: float = 1.0,
        layouts: Sequence[Layout] | None = None,
    ) -> list[EnergyTable]:
        """Make the tables of an interface: reflected and transmitted light from above, and the same from below.

        Args:
            spectrum: it holds wavelengths in the denser medium.
            index: of the medium below relative to that above.
            height_scale: times the heights.
            layouts: of both sides; those of `Layout.of` if there are none.
        """
        furnaces = [Furnace.of(spectrum, height_scale, index, side) for side in (1, -1)]
        layouts = layouts or [Layout.of(furnace) for furnace in furnaces]
        pairs = zip(furnaces, layouts, strict=True)
        return [table for furnace, layout in pairs for table in cls._of_side(furnace, layout)]

    @classmethod
    def _of_side(cls, furnace: Furnace, layout: Layout) -> list[EnergyTable]:
        """Make the tables of one side: e at the corners of cells, lowered where an albedo at random places exceeds one.

        Where the furnace is not exact, the albedo of the spectrum itself counts, too: first cells about such places are
        lowered, at last all.
        """
        e = corners(furnace, layout)
        losses = [(0.0, 0.0)] * len(e)
        exact = furnace.by_order and not (furnace.wide or furnace.turning)
        count = CHECKED // len(furnace.ways)
        for check in range(CHECKS if e.min() < 1 else 0):
            bounds = [cls.packed(layout, of).at for of in e]
            # Where phases turn within lobes, albedos change the most within a cell.
            most = (8 if furnace.turning else 1) * CANDIDATES
            candidates = int(np.clip(most * PAIRS / (240 * furnace.work), count, most * count))
            omega, lengths = layout.random_places(candidates, check)
            cells, a = layout.cells_of(*layout.places(omega, lengths)), furnace.albedo(omega, lengths)
            got, share = np.stack([at(omega, lengths) for at in bounds]), np.ones(layout.cell_counts)
            highest = (got * a).sum(0)
            lower = 1 / np.maximum(highest, 1)
            if not exact:
                tried = np.flatnonzero(highest > TIGHT)[:count]
                albedo = furnace.albedo_of_nodes(omega[tried], lengths[tried], bounds, pairs=False)
                tried = tried[albedo > 1]
                # Of two estimates the smaller: what both exceed by more than `SLACK` is no noise.
                both = [furnace.albedo_of_nodes(omega[tried], lengths[tried], bounds, k) for k in (0, 1)]
                # Beyond what the furnace finds, unless phases turn: by that the cell itself is lowered.
                albedo = np.minimum(*both) / (1 + SLACK) * (1.0 if furnace.turning else lower[tried])
                np.minimum.at(share, tuple(of[tried] for of in cells), 1 / np.maximum(albedo, 1))
            # Places that were not tried may exceed by as much again.
            everywhere = share.min() ** 2 if check == CHECKS - 1 else 1.0
            if layout.lines and not exact:
                np.minimum.at(share, cells, lower)
            share = np.minimum(minimum_filter(share, ABOUT), everywhere)
            np.minimum.at(share, cells, lower)
            # What is beyond one is no part of e where it is lowered.
            e = np.where(layout.lowered(np.ones_like(e), share) < 1, layout.lowered(np.minimum(e, 1), share), e)
            lost = 1 - np.minimum(got * share[cells] / np.minimum(bounds_of(a, furnace.index), 1), 1)
            losses = [(float(of.mean()), float(of.max())) for of in lost]
        return [cls.packed(layout, *of) for of in zip(e, losses, strict=True)]

    @classmethod
    def packed(cls, layout: Layout, e: Real, loss: tuple[float, float] = (0.0, 0.0)) -> EnergyTable:
        """Round e at the corners of cells to bytes, so that it exceeds the numbers by no more than `SLACK`."""
        least = min(float(e.min()), 1.0)
        steps = np.floor(np.minimum((e * (1 + SLACK) - least) / (LARGEST - least), 1) * 255)
        return cls(layout, np.maximum(steps, 0).astype(np.uint8), least, loss)

    @property
    def needed(self) -> bool:
        """Return whether some direction would reflect more than it receives."""
        return self.least < 1

    def at(self, directions: Real, wavelengths: ArrayLike) -> Real:
        """Return e(ω, λ) as the renderer has it, (n,), for ω (n, 3) along the pattern's axes and λ in µm."""
        slices, rows, columns = places = self.layout.places(directions, wavelengths)
        below, row, column = self.layout.cells_of(*places)
        weights = _bilinear(columns - column, rows - row)
        steps = (self.steps[below, row, column] * weights).sum(-1)
        if not self.layout.lines:
            above = (self.steps[below + 1, row, column] * weights).sum(-1)
            steps += (slices - below) * (above - steps)
        return np.minimum(self.least + (LARGEST - self.least) / 255 * steps, 1)

    def as_plain(self) -> dict[str, Any]:
        """Return the table as numbers and texts, for JSON."""
        packed = base64.b64encode(zlib.compress(self.steps.tobytes(), 9)).decode("ascii")
        return {"layout": dataclasses.asdict(self.layout), "least": self.least, "loss": self.loss, "steps": packed}

    @classmethod
    def from_plain(cls, plain: Mapping[str, Any]) -> EnergyTable:
        """Return the table that `as_plain` describes.

        Raises:
            ValueError, TypeError or KeyError: if it is not a table.
        """
        if plain.keys() != {"layout", "least", "loss", "steps"}:
            raise RequestError(f"energy table: got {', '.join(plain)}, wanted layout, least, loss, steps")
        layout = Layout(**{**plain["layout"], "frequencies": tuple(plain["layout"]["frequencies"])})
        size = int(np.prod(layout.shape, dtype=np.int64))
        try:
            # No more than there should be: a damaged file may hold a long row of zeros.
            content = zlib.decompressobj().decompress(base64.b64decode(plain["steps"]), size + 1)
        except (zlib.error, binascii.Error) as error:
            raise RequestError(f"energy table: {error}") from None
        if not 0 < size < 1 << 26 or len(content) != size:
            raise RequestError(f"energy table: got {len(content)} bytes, wanted {size}")
        steps = np.frombuffer(content, np.uint8).reshape(layout.shape)
        mean, largest = plain["loss"]
        return cls(layout, steps, float(plain["least"]), (float(mean), float(largest)))


@dataclass(frozen=True)
class Stretched:
    """A spectrum seen with lengths along the surface times a lateral scale s as the unit of length.

    Wavelengths are shorter by s, and lobes wider; orders stay where they are.

    Attributes:
        spectrum: S(q; κ).
        least: s; of several the least.
    """

    spectrum: PowerSpectrum
    least: float

    def __getattr__(self, name: str) -> Any:
        return getattr(self.spectrum, name)

    @property
    def lobe_width(self) -> float:
        """s σ_q in cycles/µm; of several s, of the least, with which λσ_q is right at the longest wavelength."""
        return self.spectrum.lobe_width * self.least

    @property
    def wavelengths(self) -> tuple[float, float]:
        """λ/s in nm, from the shortest that the spectrum covers."""
        shortest, longest = self.spectrum.wavelengths
        return shortest, longest / self.least


def frequencies_of(spectrum: PowerSpectrum, index: float | None) -> tuple[float, float]:
    """Return (smallest, largest) 1/λ in 1/µm of a table; `index` is η as of `Furnace`."""
    # Those of the spectrum are in the denser medium.
    shortest, longest = (w * 1e-3 * max(index or 1, 1) for w in spectrum.wavelengths)
    return 1 / longest, 1 / shortest


def between(below: EnergyTable, middle: EnergyTable, above: EnergyTable) -> EnergyTable:
    """Return a lower bound of e between two tables from these and the one in the middle.

    A parabola through three equidistant values exceeds them by no more than an eighth of its second difference.
    """
    first, second, third = (
        t.least + (LARGEST - t.least) / 255 * t.steps.astype(np.float64) for t in (below, middle, above)
    )
    lowest = np.minimum(np.minimum(first, second), third)
    e = np.maximum(lowest - np.abs(first - 2 * second + third) / 8, 0)
    lost = np.minimum(e, 1) / np.clip(second, 1e-9, 1)
    loss = below.loss[0] + float(1 - lost.mean()), below.loss[1] + float(1 - lost.min())
    return EnergyTable.packed(middle.layout, e / (1 + SLACK), loss)


def bounds_of(albedo: Real, index: float | None) -> Real:
    """Return e from what the furnace finds.

    Reflected light alone has e = 1/max(1, a). Of an interface transmitted light comes first, as scalar theory sends all
    of it on where steep facets reflect it totally, but for what a plane reflects at normal incidence, F₀:

        e_T = min(1, (1 − min(R, F₀))/T),    e_R = min(1, (1 − e_T T)/R),    e_R R + e_T T = min(1, R + T)

    Args:
        albedo: (1, n), or R and T (2, n).
        index: η; None of reflected light alone.

    Returns:
        As `albedo`.
    """
    if index is None:
        return np.minimum(1 / np.maximum(albedo, 1e-9), LARGEST)
    r, t = albedo
    # No more than one: e_R is so steep there that what lies between corners would lower them by more.
    e_t = np.minimum(1, (1 - np.minimum(r, ((index - 1) / (index + 1)) ** 2)) / np.maximum(t, 1e-9))
    return np.stack([np.minimum(1, (1 - e_t * t) / np.maximum(r, 1e-9)), e_t])


def corners(furnace: Furnace, layout: Layout) -> Real:
    """Compute e at the corners of all cells, a lower bound of `bounds_of` between them.

    Returns:
        e of reflected, and of an interface of transmitted light, (1 or 2, *layout.shape).
    """
    slices, side = layout.shape[:2]

    def bound(cells: Indices, inside: Real) -> Real:
        omega, lengths = layout.directions(cells, inside)
        a = furnace.albedo(omega, lengths)
        if layout.lines:
            # Lobes are 1/c as wide, which matters where one reaches the horizon or phases turn within it.
            c = np.sqrt(1 - omega[:, 0 if layout.turned else 1] ** 2)
            least = np.min([f for _, f in layout.fractions(cells, inside)], axis=0)
            near = (c < 1) & (furnace.turning | (c * least < NEAR * furnace.spectrum.lobe_width * layout.period))
            # Phases turn least within the narrowest lobes.
            for frequency in (layout.frequencies[0], 0.0)[: 1 + furnace.turning if near.any() else 0]:
                omega, lengths = layout.directions(cells[near], inside[near], frequency)
                a[:, near] = np.maximum(a[:, near], furnace.albedo(omega, lengths))
        return bounds_of(a, furnace.index)

    # Unit squares have nodes of their own: cells begin at `start`.
    squares = layout.squares_of_cells
    start = np.arange(side) + squares
    of_node = np.repeat(np.arange(side), 1 + np.diff(squares, append=layout.squares))
    at_end = np.diff(of_node, prepend=-1) == 0
    if layout.lines:
        reached = np.add.outer(squares, squares)[None] < 2 * layout.period * layout.frequencies[1]
    else:
        reached = np.ones(layout.cell_counts, bool)
    nodes = np.indices((slices, len(of_node), len(of_node))).reshape(3, -1)
    cells, inside = (np.stack([nodes[0] * k, of[nodes[1]], of[nodes[2]]], -1) for k, of in ((1, of_node), (0, at_end)))
    some = reached[0][cells[:, 1], cells[:, 2]]
    of_nodes = np.ones((len(furnace.ways[:2]), len(some)))
    of_nodes[:, some] = bound(cells[some], inside[some])
    at = of_nodes.reshape(-1, slices, len(of_node), len(of_node))
    e = np.stack([at[..., start[:, None] + j, start + i] for j, i in np.ndindex(2, 2)], -1)
    lowered = np.ones((len(e), *layout.cell_counts))
    # The middle of all cells, and more places in those that are steep.
    deep, emerging = furnace.spectrum.max_kappa * furnace.depth * BLUR > 1, furnace.by_order and not layout.lines
    least = 3 if layout.lines else 8 if emerging and deep and furnace.index is None else 1
    some, rounds, index = reached, 1, 0
    while index < rounds:
        inside = (0.5 + index * STRIDE) % 1
        got = e @ _bilinear(inside[2], inside[1])
        if not layout.lines:
            got = (1 - inside[0]) * got[:, :-1] + inside[0] * got[:, 1:]
        share, cells = np.ones_like(lowered), np.argwhere(some)
        wanted, found = bound(cells, np.broadcast_to(inside, cells.shape)), np.maximum(got[:, some], 1e-30)
        share[:, some] = np.where(wanted < np.minimum(found, 1), wanted / found, 1)
        if index == rounds - 1 > 0:
            # Other places may exceed as much as the last ones of a cell and its neighbours; where strong orders emerge
            # within cells, transmitted ones or those of deep surfaces, as any of these.
            so_far = lowered if emerging and (deep or furnace.index is not None) else 1.0
            share = minimum_filter(so_far * share, (1, 3, 3, 3)) / np.maximum(so_far, 1e-30)
        e, lowered, index = layout.lowered(e, share), lowered * share, index + 1
        if index == 1:
            some = reached & (minimum_filter(lowered, (1, 3, 3, 3)).min(0) < STEEP)
            rounds = int(np.clip(PAIRS / (max(some.sum(), 1) * furnace.work), least, ROUNDS)) if some.any() else 1
    if not layout.lines:
        # For what lies between the places that were tried.
        e[(e < 1).any(-1)] *= 1 - 2 * SLACK
    return np.maximum(e, 0)


def _bilinear(x: Real | np.float64, y: Real | np.float64) -> Real:
    return np.stack([(1 - x) * (1 - y), x * (1 - y), (1 - x) * y, x * y], -1)
