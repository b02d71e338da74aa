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
cos θ_o of that order is. a depends on u and v alone: the table has one slice.

Of surfaces with orders in two dimensions, and of samples, T is so short that one square holds all directions, and
slices are equidistant in the same function of the fraction 1 − |y|, y = ω_y/(1 + c). So it is of an interface, where
transmitted orders emerge elsewhere; it has one table for the light of each side.
"""

from __future__ import annotations

import base64
import binascii
import dataclasses
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import minimum_filter

from ..errors import RequestError
from ..spectrum.grids import OrderGrid
from .furnace import Furnace, PowerSpectrum

SLACK = 1e-3
"""What an albedo may exceed one by."""
CHECKED, CHECKS = 150, 3  # random places at which a table is held against the spectrum itself, and how often
CANDIDATES, TIGHT = 15, 0.9  # so many places for one that is checked: there the furnace finds at least this albedo
ABOUT = 3, 5, 5  # slices, rows and columns that are lowered about such a place
GENERAL, FINEST = (17, 22), 3  # slices, and cells along u and v, of other tables; finer by this, at most
PLACES = 1.5e5  # nodes of the table of a line grating, at most; a quarter if lobes are wide, which takes longer
ROUNDS, PAIRS = (1, 32), 5e6  # random places in each cell, at least and at most; about so many pairs with components
STEEP = 0.98  # e is lowered so far inside of a cell or its neighbours, where more places are tried
STRIDE = np.array([0.8191725, 0.6710436, 0.5497005])  # of places in a cell, so that few rounds cover it (Roberts 2018)
TURNED = 1.0, 0.5  # c for which a is computed, where it matters
LEAST, HORIZON = 1e-7, 1e-4  # the least fraction of u and v, and of y


@dataclass(frozen=True)
class Layout:
    """Where the cells of a table lie.

    Attributes:
        period: T in µm.
        squares: unit squares of (u, v) along each.
        first: cells along u or v from 0 to 1, where ω is near the horizon.
        cells: along the side of the other unit squares.
        slices: one, or nodes of y.
        frequencies: (smallest, largest) 1/λ in 1/µm.
        lines: of a line grating.
        turned: the grating is periodic along y: x and y change places.
    """

    period: float
    squares: int
    first: int
    cells: int
    slices: int
    frequencies: tuple[float, float]
    lines: bool
    turned: bool = False

    def __post_init__(self) -> None:
        if not (0 < self.period < np.inf and 0 < self.frequencies[0] < self.frequencies[1] < np.inf):
            raise RequestError(f"energy table: got period {self.period}, frequencies {self.frequencies}, wanted > 0")
        if min(self.squares, self.first, self.cells, self.slices - (not self.lines)) < 1:
            raise RequestError(
                f"energy table: got {self.squares}, {self.first}, {self.cells}, {self.slices}, wanted at least one"
            )

    @property
    def shape(self) -> tuple[int, int, int, int]:
        """Slices, cells along v and u, and the four corners of each."""
        side = self.first + (self.squares - 1) * self.cells
        return self.slices, side, side, 4

    @classmethod
    def of(cls, spectrum: PowerSpectrum, furnace: Furnace) -> Layout:
        """Choose the layout for `spectrum`: as fine as the work allows."""
        # Those of the spectrum are in the denser medium.
        shortest, longest = (w * 1e-3 * max(furnace.index or 1, 1) for w in spectrum.wavelengths)
        frequencies = 1 / longest, 1 / shortest
        grid = spectrum.grid
        if furnace.index is not None or not (isinstance(grid, OrderGrid) and 1 in grid.shape):
            # As fine as the work allows, which is about the same for all.
            places = GENERAL[0] * GENERAL[1] ** 2
            finest = 1 if furnace.index is None else FINEST
            finer = np.clip(np.cbrt(PAIRS / (furnace.work * places)), 1, finest)
            slices, side = 1 + 2 * int(GENERAL[0] * finer / 2), int(GENERAL[1] * finer)
            return cls(shortest / 2, 1, side, 1, slices, frequencies, False)
        turned = grid.shape[1] == 1 and grid.shape[0] > 1
        # So many places that the work is about the same for all gratings; where no phase turns within lobes, two thirds
        # lose as little.
        nodes = PLACES / (4 if furnace.wide else 1 if furnace.turning else 1.5)
        side = np.sqrt(2 * min(nodes, PAIRS / max(len(furnace.q) / 2, 1)))
        first = int(np.clip(side / 8, 4, 24))
        period, rest = grid.tile_size[int(turned)], (side - 2 * first - 1) / 3
        period /= max(np.ceil(2 * period / shortest / max(rest, 2)), 1)
        squares = int(np.ceil(2 * period / shortest))
        cells = int(np.clip((3 * rest / max(squares - 1, 1) - 1) / 2, 1, 24))
        return cls(float(period), squares, first, cells, 1, frequencies, True, turned)

    def places(
        self, directions: NDArray[np.float64], wavelengths: ArrayLike
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Return slice, row and column of ω (n, 3) and λ (µm), in cells: each (n,)."""
        x, y, z = directions.T
        if self.turned:
            x, y = y, x
        c = np.sqrt(x**2 + z**2)
        longer = c + np.abs(x)
        shorter = z**2 / np.maximum(longer, 1e-12)
        per_length = self.period / np.asarray(wavelengths)
        u, v = (self._place(np.where(x * sign > 0, shorter, longer) * per_length) for sign in (1, -1))
        if self.lines:
            row = np.zeros(len(x))
        else:
            y = y / (1 + c)
            row = (1 - np.copysign(1 - _equidistant(1 - np.abs(y)), -y)) / 2 * (self.slices - 1)
        return row, v, u

    def cells_of(self, *places: NDArray[np.float64]) -> tuple[NDArray[np.int64], ...]:
        """Return the cells of places (slice, row, column), as an index of the first three axes of `shape`."""
        return tuple(np.clip(x.astype(np.int64), 0, n - 1) for x, n in zip(places, self.shape[:3], strict=True))

    def random_places(self, count: int, seed: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return `count` directions (n, 3), two thirds of them beyond 60°, one beyond 85°, and λ in µm, (n,)."""
        rng = np.random.default_rng(seed)
        theta = np.deg2rad(rng.uniform(rng.choice([0, 60, 85], count), 89.9))
        phi = rng.uniform(0, 2 * np.pi, count)
        x, y = np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi)
        omega = np.stack([y, x, np.cos(theta)] if self.turned else [x, y, np.cos(theta)], -1)
        return omega, rng.uniform(1 / self.frequencies[1], 1 / self.frequencies[0], count)

    def _place(self, u: NDArray[np.float64]) -> NDArray[np.float64]:
        square = np.minimum(np.floor(u), self.squares - 1)
        start = np.where(square > 0, self.first + (square - 1) * self.cells, 0)
        return start + _equidistant(u - square) * np.where(square > 0, self.cells, self.first)

    def nodes(self, square: int) -> NDArray[np.float64]:
        """Return u at the nodes of a unit square and in the middle between them."""
        count = 2 * (self.first if square == 0 else self.cells)
        return square + np.clip(_fraction(np.arange(count + 1) / count), LEAST, 1 - LEAST)


def _equidistant(f: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return √f; below 0 and above 1, of the nearest."""
    return np.sqrt(np.clip(f, 0, 1))


def _fraction(h: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the inverse of `_equidistant`."""
    return h**2


@dataclass(frozen=True, eq=False)
class EnergyTable:
    """e at the corners of cells, linear between them.

    Attributes:
        layout: where the cells lie.
        steps: uint8 (slices, rows, columns, 4): e = `least` + (1 − `least`)/255 · step at (u, v), (u⁺, v), (u, v⁺) and
            (u⁺, v⁺).
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
    def of(cls, spectrum: PowerSpectrum, height_scale: float = 1.0) -> EnergyTable:
        """Make the table of `spectrum`, with its heights scaled by `height_scale`."""
        return cls._of_side(spectrum, Furnace.of(spectrum, height_scale))[0]

    @classmethod
    def of_interface(cls, spectrum: PowerSpectrum, index: float, height_scale: float = 1.0) -> list[EnergyTable]:
        """Make the tables of an interface: reflected and transmitted light from above, and the same from below.

        Args:
            spectrum: it holds wavelengths in the denser medium.
            index: of the medium below relative to that above.
            height_scale: times the heights.
        """
        furnaces = [Furnace.of(spectrum, height_scale, index, side) for side in (1, -1)]
        return [table for furnace in furnaces for table in cls._of_side(spectrum, furnace)]

    @classmethod
    def _of_side(cls, spectrum: PowerSpectrum, furnace: Furnace) -> list[EnergyTable]:
        """Make the tables of one side: e at the corners of cells, lowered where an albedo at random places exceeds one.

        Where the furnace is not exact, the albedo of the spectrum itself counts, too: first cells about such places are
        lowered, at last all.
        """
        layout = Layout.of(spectrum, furnace)
        e = corners(furnace, layout)
        losses = [(0.0, 0.0)] * len(e)
        exact = furnace.by_order and not (furnace.wide or furnace.turning)
        count = CHECKED // len(furnace.ways)
        for check in range(CHECKS if e.min() < 1 else 0):
            bounds = [cls.packed(layout, of).at for of in e]
            omega, lengths = layout.random_places(CANDIDATES * count, check)
            cells, a = layout.cells_of(*layout.places(omega, lengths)), furnace.albedo(omega, lengths)
            got, share = np.stack([at(omega, lengths) for at in bounds]), np.ones(layout.shape[:3])
            highest = (got * a).sum(0)
            lower = 1 / np.maximum(highest, 1)
            if not exact:
                tried = np.flatnonzero(highest > TIGHT)[:count]
                albedo = furnace.albedo_of_nodes(spectrum, omega[tried], lengths[tried], bounds, pairs=False)
                tried = tried[albedo > 1]
                # Of two estimates the smaller: what both exceed is no noise.
                both = [furnace.albedo_of_nodes(spectrum, omega[tried], lengths[tried], bounds, k) for k in (0, 1)]
                # Beyond what the furnace finds, unless phases turn: by that the cell itself is lowered.
                albedo = np.minimum(*both) * (1.0 if furnace.turning else lower[tried])
                np.minimum.at(share, tuple(of[tried] for of in cells), 1 / np.maximum(albedo, 1))
            # Places that were not tried may exceed by as much again.
            everywhere = share.min() ** 2 if check == CHECKS - 1 else 1.0
            if layout.lines:
                np.minimum.at(share, cells, lower)
            share = np.minimum(minimum_filter(share, ABOUT), everywhere)
            np.minimum.at(share, cells, lower)
            e = e * share[..., None]
            lost = 1 - np.minimum(got * share[cells] / bounds_of(a, furnace.index), 1)
            losses = [(float(of.mean()), float(of.max())) for of in lost]
        return [cls.packed(layout, *of) for of in zip(e, losses, strict=True)]

    @classmethod
    def packed(cls, layout: Layout, e: NDArray[np.float64], loss: tuple[float, float] = (0.0, 0.0)) -> EnergyTable:
        """Round e at the corners of cells to bytes, so that it exceeds the numbers by no more than `SLACK`."""
        least = float(e.min())
        steps = np.floor(np.minimum((e * (1 + SLACK) - least) / max(1 - least, 1e-9), 1) * 255)
        return cls(layout, np.maximum(steps, 0).astype(np.uint8), least, loss)

    @property
    def needed(self) -> bool:
        """Return whether some direction would reflect more than it receives."""
        return self.least < 1

    def at(self, directions: NDArray[np.float64], wavelengths: ArrayLike) -> NDArray[np.float64]:
        """Return e(ω, λ) as the renderer has it, (n,), for ω (n, 3) along the pattern's axes and λ in µm."""
        slices, rows, columns = places = self.layout.places(directions, wavelengths)
        below, row, column = self.layout.cells_of(*places)
        weights = _bilinear(columns - column, rows - row)
        steps = (self.steps[below, row, column] * weights).sum(-1)
        if not self.layout.lines:
            above = (self.steps[np.minimum(below + 1, self.steps.shape[0] - 1), row, column] * weights).sum(-1)
            steps += (slices - below) * (above - steps)
        return self.least + (1 - self.least) / 255 * steps

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


def between(below: EnergyTable, middle: EnergyTable, above: EnergyTable) -> EnergyTable:
    """Return a lower bound of e between two tables from these and the one in the middle.

    A parabola through three equidistant values exceeds them by no more than an eighth of its second difference.
    """
    first, second, third = (t.least + (1 - t.least) / 255 * t.steps.astype(np.float64) for t in (below, middle, above))
    lowest = np.minimum(np.minimum(first, second), third)
    e = np.maximum(lowest - np.abs(first - 2 * second + third) / 8, 0)
    lost = e / np.maximum(second, 1e-9)
    loss = below.loss[0] + float(1 - lost.mean()), below.loss[1] + float(1 - lost.min())
    return EnergyTable.packed(middle.layout, e / (1 + SLACK), loss)


def bounds_of(albedo: NDArray[np.float64], index: float | None) -> NDArray[np.float64]:
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
        return 1 / np.maximum(albedo, 1)
    r, t = albedo
    e_t = np.minimum(1, (1 - np.minimum(r, ((index - 1) / (index + 1)) ** 2)) / np.maximum(t, 1e-9))
    return np.stack([np.minimum(1, (1 - e_t * t) / np.maximum(r, 1e-9)), e_t])


def corners(furnace: Furnace, layout: Layout) -> NDArray[np.float64]:
    """Compute e at the corners of all cells, a lower bound of `bounds_of` between them.

    Returns:
        e of reflected, and of an interface of transmitted light, (1 or 2, *layout.shape).
    """
    return (_line_corners if layout.lines else _general_corners)(furnace, layout)


def _line_corners(furnace: Furnace, layout: Layout) -> NDArray[np.float64]:
    """Compute `corners` of a line grating."""
    last = layout.frequencies[1]
    nodes = [layout.nodes(square) for square in range(layout.squares)]
    lattice = np.concatenate(nodes)
    square = np.repeat(np.arange(layout.squares), [len(n) for n in nodes])
    v, u = np.meshgrid(lattice, lattice, indexing="ij")
    nu = (u + v) / (2 * layout.period)
    reached = np.add.outer(square, square) < 2 * layout.period * last
    e = np.ones((1, *nu.shape))
    if layout.turned:
        furnace = dataclasses.replace(furnace, q=furnace.q[:, ::-1])
    x = ((v - u) / (u + v))[reached]
    omega = np.stack([x, np.zeros(len(x)), np.sqrt(1 - x**2)], -1)
    # Where phases turn within lobes a depends on c, too: seen in the scale of c, lobes are 1/c as wide.
    scales = TURNED if furnace.turning else (1.0,)
    a = [dataclasses.replace(furnace, widths=furnace.widths / c).albedo(omega, 1 / nu[reached])[0] for c in scales]
    e[0, reached] = 1 / np.maximum(np.max(a, axis=0), 1)
    inside = reached & (nu <= last)
    # The cells: each second node but the last of a unit square.
    start = np.concatenate([np.arange(0, len(n) - 1, 2) + np.flatnonzero(square == k)[0] for k, n in enumerate(nodes)])

    def at(values: NDArray, j: int, i: int) -> NDArray:
        return values[..., start[:, None] + j, start + i]

    result = np.stack([at(e, j, i) for j in (0, 2) for i in (0, 2)], -1)
    # In the middle of the cells and of their edges.
    share = np.ones(result.shape[:-1])
    for j, i in ((1, 1), (0, 1), (1, 0), (2, 1), (1, 2)):
        got = result @ _bilinear(np.float64(i / 2), np.float64(j / 2))
        share = np.minimum(share, np.where(at(inside, j, i), at(e, j, i) / np.maximum(got, 1e-30), 1))
    return (result * share[..., None])[None]


def _general_corners(furnace: Furnace, layout: Layout) -> NDArray[np.float64]:
    """Compute `corners` of orders in two dimensions and of samples: lowered at random places in the cells."""
    side, (first, last) = layout.first, layout.frequencies
    cells = np.indices((layout.slices - 1, side, side)).reshape(3, -1).T

    def latitude(slices: NDArray[np.float64]) -> NDArray[np.float64]:
        place = 2 * slices / (layout.slices - 1) - 1
        return np.copysign(1 - np.maximum(_fraction(1 - np.abs(place)), HORIZON), place)

    def bound(places: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Return `bounds_of` at places (slice, row, column), (n, 3), and whether there is light there."""
        y = latitude(places[:, 0])
        u, v = (np.maximum(_fraction(p / side), LEAST) for p in (places[:, 2], places[:, 1]))
        c, nu = (1 - y**2) / (1 + y**2), (u + v) / (2 * layout.period)
        lengths = c / nu
        there = (lengths >= 1 / last) & (lengths <= 1 / first)
        directions = np.stack([c * (v - u) / (u + v), 2 * y / (1 + y**2), c * 2 * np.sqrt(u * v) / (u + v)], -1)
        a = furnace.albedo(directions, np.clip(lengths, 1 / last, 1 / first))
        return bounds_of(a, furnace.index), there

    # Cells that light reaches at some wavelength.
    y = latitude(cells[:, :1] + [0, 0.5, 1])
    c = (1 - y**2) / (1 + y**2)
    low, high = (_fraction((cells[:, 1] + k) / side) + _fraction((cells[:, 2] + k) / side) for k in (0, 1))
    per = 2 * layout.period
    cells = cells[(low <= per * last * c.max(-1)) & (high >= per * first * c.min(-1))]
    # Nodes, each of them once.
    eight = np.array(list(np.ndindex(2, 2, 2)))
    nodes, corner = np.unique((cells[:, None] + eight).reshape(-1, 3), axis=0, return_inverse=True)
    e = bound(nodes.astype(np.float64))[0][:, corner.reshape(-1, 8)]
    start, lowered = np.random.default_rng(0).random((len(cells), 3)), np.ones((len(e), len(cells)))

    def of_neighbours() -> NDArray[np.float64]:
        near = np.ones((len(e), *np.add(layout.shape[:3], (-1, 0, 0))))
        near[(slice(None), *cells.T)] = lowered
        return minimum_filter(near, (1, 3, 3, 3))[(slice(None), *cells.T)]

    some, done = np.arange(len(cells)), 0
    # All cells, and again those that are steep.
    jumps = furnace.by_order and furnace.index is not None
    for steep in (False, True)[: 1 + jumps]:
        if steep:
            some = np.flatnonzero(of_neighbours().min(0) < STEEP)
        rounds = int(np.clip(PAIRS / max(len(some) * furnace.work, 1), *ROUNDS)) if len(some) else 0
        for index in range(done, done + rounds):
            inside = (start[some] + index * STRIDE) % 1
            wanted, there = bound(cells[some] + inside)
            weights = np.prod(np.where(eight, inside[:, None], 1 - inside[:, None]), -1)
            got = (weights * e[:, some]).sum(-1)
            share = np.where(there, np.minimum(wanted / np.maximum(got, 1e-30), 1), 1)
            e[:, some] *= share[..., None]
            lowered[:, some] *= share
        done += rounds
    if jumps:
        # What few places show in one cell may lie between those in its neighbours.
        e *= (of_neighbours() / np.maximum(lowered, 1e-30))[..., None]
        e[e < 1] *= 1 - 2 * SLACK
    # Two cells share a corner (slice, row, column, corner).
    full = np.ones((len(e), *layout.shape))
    for of, to in zip(e, full, strict=True):
        for k, (above, j, i) in enumerate(eight):
            np.minimum.at(to, (cells[:, 0] + above, cells[:, 1], cells[:, 2], 2 * j + i), np.maximum(of[:, k], 0))
    return full


def _bilinear(x: NDArray[np.float64] | np.float64, y: NDArray[np.float64] | np.float64) -> NDArray[np.float64]:
    return np.stack([(1 - x) * (1 - y), x * (1 - y), (1 - x) * y, x * y], -1)
