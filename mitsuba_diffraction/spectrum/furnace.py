"""The albedo in a white furnace, from the stored spectrum itself, and an energy table that holds in it.

With R = 1 the BSDF reflects

    A(ω_i, λ) = ∫ K G S(q; κ) min(e(ω_i, λ), e(ω_o, λ)) dq

`albedo.py` makes the table from a gathered spectrum, at as many places as a table has cells. Here A is integrated at
fewer places, but from the powers of the spectrum, by quasi-Monte Carlo with importance sampling: nodes by their power
about κ and K G, then a q in the lobe. Where A exceeds one the nodes of the table are lowered, until a set of places
shows none.
"""

from __future__ import annotations

import dataclasses
import itertools
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.special import ndtri
from scipy.stats import qmc

from ..geometry import k_g
from .albedo import DEEP, SLACK
from .energy_table import EnergyTable
from .orders import LobeAxis, OrderGrid
from .spline_grid import SplineGrid, spline, spline_integral

if TYPE_CHECKING:
    from .grating_spectrum import GratingSpectrum

BLOCKS = 20  # blocks of nodes along one axis, at most
BINS = 12  # of κ, for which the power of each block is kept
FLOOR = 0.25  # the share of the power over all κ in the density: powers oscillate within a bin
NEAR = 3  # cos θ_o in cos θ_i below which K G changes faster than a lobe
CHUNK = 1 << 15  # points that are computed at once, so that they stay in the cache

# One set of places: how many, of shallow surfaces and of deep ones, and the points by which A is estimated; then the
# same where it is largest.
PLACES, PLACES_DEEP = 1024, 4096
SCREENED = ((PLACES_DEEP, 64), (256, 256))
# Then places about the largest, normally distributed by so many radians, as peaks are narrow.
CLIMBERS, CHILDREN, CLIMBED = 48, 6, (0.03, 0.01)
# The largest again, as long as a bound is too wide to decide, unless there are more such places: then it costs less to
# lower the whole table a little.
BOUNDED = ((48, 512), (48, 2048), (12, 8192))
REPETITIONS = 4
CONFIDENCE = 2.353 / REPETITIONS**0.5  # one-sided 95 %: Student's t with REPETITIONS − 1 degrees of freedom
ALLOWED = 1e-3  # what an upper confidence bound of A may exceed one by
LITTLE = 0.02  # the excess of A above which the nodes around the cell are lowered, too
MANY, MUCH = 12, 0.1  # with more such places, or a larger excess, the whole table is lowered
WIDEST = 2  # cells about a place
ROUNDS = 16
PASSED_DEEP = 3  # sets of places one after the other that find nothing in a deep surface: one might by luck
STEEPEST = 89.9  # degrees
GRAZING = 3e-3  # the least cos θ_o of places where an order emerges


class _Gaussian:
    """The lobe of an order, truncated along each axis."""

    def __init__(self, sigma: float, lobes: tuple[LobeAxis, LobeAxis]) -> None:
        self._sigma, self._lobes = sigma, lobes
        # Beyond six σ_q there is nothing.
        self.radius = float(np.hypot(*(min(lobe.half_width, 6 * sigma) for lobe in lobes)))

    def drawn(self, x: NDArray[np.float64], y: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Points of the lobe, in cycles/µm, for numbers from 0 to 1."""
        return tuple(
            self._sigma * ndtri(0.5 + lobe.inside * (np.clip(t, 1e-9, 1 - 1e-9) - 0.5))
            for t, lobe in zip((x, y), self._lobes, strict=True)
        )

    def density(self, q_x: NDArray[np.float64], q_y: NDArray[np.float64]) -> NDArray[np.float64]:
        """µm², of integral one."""
        product = np.exp(-(q_x**2 + q_y**2) / (2 * self._sigma**2)) / (2 * np.pi * self._sigma**2)
        for q, lobe in zip((q_x, q_y), self._lobes, strict=True):
            product = product * np.where(np.abs(q) < lobe.half_width, 1 / lobe.inside, 0)
        return product


class _Spline:
    """The B-spline of a node."""

    def __init__(self, spacing: tuple[float, float]) -> None:
        self._spacing = spacing
        self._offsets = np.linspace(-1.5, 1.5, 1025)
        self._integral = spline_integral(self._offsets)
        self.radius = 1.5 * float(np.hypot(*spacing))

    def drawn(self, x: NDArray[np.float64], y: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """As of `_Gaussian`."""
        return tuple(
            np.interp(t, self._integral, self._offsets) * d for t, d in zip((x, y), self._spacing, strict=True)
        )

    def density(self, q_x: NDArray[np.float64], q_y: NDArray[np.float64]) -> NDArray[np.float64]:
        """As of `_Gaussian`."""
        product = 1 / (self._spacing[0] * self._spacing[1])
        for q, spacing in zip((q_x, q_y), self._spacing, strict=True):
            product = product * spline(q / spacing)
        return product


class Furnace:
    """A(ω, λ) of a spectrum, by importance sampling."""

    def __init__(self, spectrum: GratingSpectrum) -> None:
        self._spectrum = spectrum
        grid = spectrum.grid
        of_splines = isinstance(grid, SplineGrid)
        self._lobe = _Spline(grid.spacing) if of_splines else _Gaussian(spectrum.lobe_width, spectrum.lobes)
        self._limit = grid.limit if of_splines else (np.inf, np.inf)

        # Nodes, block after block.
        blocks, frequencies = [], grid.frequencies()
        for q in frequencies:
            count = min(BLOCKS, len(q))
            blocks.append(np.arange(len(q)) * count // len(q))
        columns = blocks[0].max() + 1
        block = (blocks[1][:, None] * columns + blocks[0]).ravel()
        order = np.argsort(block, kind="stable")
        self._row, self._column = np.divmod(order, grid.shape[1])
        count = columns * (blocks[1].max() + 1)
        self._first = np.searchsorted(block[order], np.arange(count + 1))
        bins = np.empty((BINS, count))
        total = np.zeros(block.size)
        for i in range(BINS):
            powers = sum(
                np.abs(spectrum.powers((i + x) / BINS * spectrum.largest_kappa)).astype(np.float64).ravel()
                for x in (1 / 6, 1 / 2, 5 / 6)
            )
            bins[i] = np.bincount(block, powers, count)
            total += powers
        total += 0.02 * total.mean()
        mass = total[order]
        self._cumulative = np.concatenate([[0], np.cumsum(mass)])
        self._mass = mass
        self._block_mass = np.diff(self._cumulative[self._first])
        share = self._block_mass / self._block_mass.sum()
        self._density = bins / np.maximum(bins.sum(-1, keepdims=True), 1e-30) + FLOOR * share
        self._q_x, self._q_y = frequencies
        # The middle of each block, and its radius.
        edges = [
            [(q[b == i].min(), q[b == i].max()) for i in range(b.max() + 1)]
            for q, b in zip(frequencies, blocks, strict=True)
        ]
        x, y = (np.array(e) for e in edges)
        self._centre = np.stack(np.meshgrid(x.mean(-1), y.mean(-1)), -1).reshape(-1, 2)
        self._radius = np.hypot(*np.meshgrid(np.ptp(x, axis=1) / 2, np.ptp(y, axis=1) / 2)).ravel() + self._lobe.radius

    def drawn_nodes(self, rng: np.random.Generator, count: int) -> NDArray[np.float64]:
        """The frequencies (n, 2) of nodes drawn by their power over all κ, cycles/µm."""
        node = np.searchsorted(self._cumulative, rng.random(count) * self._cumulative[-1], side="right") - 1
        node = np.minimum(node, len(self._row) - 1)
        return np.stack([self._q_x[self._column[node]], self._q_y[self._row[node]]], -1)

    def albedo(
        self,
        directions: NDArray[np.float64],
        wavelengths: NDArray[np.float64],
        table: EnergyTable,
        points: int,
        rng: np.random.Generator,
        height_scale: float = 1.0,
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Albedos at places (ω, λ).

        Args:
            directions: ω_i, (n, 3) unit vectors above the surface, along the pattern's axes.
            wavelengths: λ in µm, (n,).
            table: e, and the kind of shadowing.
            points: of the quadrature, for each place; a power of two.
            rng: shifts the points of each place.
            height_scale: times the heights.

        Returns:
            A; the part of it where e(ω_i) < e(ω_o); and the albedo without e: each (n,).
        """
        sequence = qmc.Sobol(3, scramble=False).random(points)
        shifts = rng.random((len(directions), 3))
        parts = np.array_split(np.arange(len(directions)), 1 + len(directions) * points // CHUNK)

        def compute(part: NDArray[np.int64]) -> NDArray[np.float64]:
            x = (sequence + shifts[part, None]) % 1
            return self._albedo(directions[part], wavelengths[part], table, x, height_scale)

        with ThreadPoolExecutor() as threads:
            return tuple(np.concatenate(list(threads.map(compute, parts)), axis=1))

    def bounded(
        self,
        directions: NDArray[np.float64],
        wavelengths: NDArray[np.float64],
        table: EnergyTable,
        rng: np.random.Generator,
        height_scale: float = 1.0,
    ) -> NDArray[np.float64]:
        """As `albedo`, (3, n), but of A an upper 95 % confidence bound, tight enough to decide whether A is allowed."""
        result, unsure = np.empty((3, len(directions))), np.arange(len(directions))
        for most, points in BOUNDED:
            if len(unsure) > most:
                break
            places = directions[unsure], wavelengths[unsure]
            found = np.array([self.albedo(*places, table, points, rng, height_scale) for _ in range(REPETITIONS)])
            mean, deviation = found.mean(0), CONFIDENCE * found[:, 0].std(0, ddof=1)
            result[:, unsure] = mean
            result[0, unsure] += deviation
            if (mean[0] - deviation > 1 + ALLOWED).any():
                break
            unsure = unsure[mean[0] + deviation > 1 + ALLOWED]
            if not len(unsure):
                break
        return result

    def _albedo(
        self,
        directions: NDArray[np.float64],
        wavelengths: NDArray[np.float64],
        table: EnergyTable,
        x: NDArray[np.float64],
        height_scale: float,
    ) -> NDArray[np.float64]:
        count, points = x.shape[:2]
        spectrum, shadowing = self._spectrum, table.shadowing == "v_cavity"
        cos_i = directions[:, 2]
        per_cosine = 2 * np.pi * height_scale / wavelengths

        # The blocks: by their power at κ, times K G cos θ_o at their middle.
        out = wavelengths[:, None, None] * self._centre + directions[:, None, :2]
        square = (out**2).sum(-1)
        radius = wavelengths[:, None] * self._radius
        cos_o = np.sqrt(np.maximum(1 - square, 0.25 * np.minimum(radius, 1)))
        d = (((out - directions[:, None, :2]) ** 2).sum(-1) + (cos_i[:, None] + cos_o) ** 2) / 2
        bins = per_cosine[:, None] * (cos_i[:, None] + cos_o) / spectrum.largest_kappa * BINS
        density = self._density[np.minimum(bins.astype(np.int64), BINS - 1), np.arange(len(self._first) - 1)]
        density *= np.where(square < (1 + radius) ** 2, k_g(cos_i[:, None], cos_o, d, shadowing), 0)
        cumulative = np.cumsum(density, axis=-1)
        density /= cumulative[:, -1:]
        cumulative /= cumulative[:, -1:]
        place = np.arange(count)[:, None]
        index = np.searchsorted((cumulative + place).ravel(), (x[..., 0] + place).ravel(), side="right")
        block = np.minimum(index.reshape(count, points) - place * density.shape[1], density.shape[1] - 1)
        chosen = density[place, block]
        rest = np.clip((x[..., 0] - cumulative[place, block]) / np.maximum(chosen, 1e-30) + 1, 0, 1 - 1e-9)
        # A node of the block, by its power.
        target = self._cumulative[self._first[block]] + rest * self._block_mass[block]
        node = np.searchsorted(self._cumulative, target.ravel(), side="right").reshape(target.shape) - 1
        node = np.clip(node, self._first[block], self._first[block + 1] - 1)
        weight = self._block_mass[block] / np.maximum(chosen * self._mass[node], 1e-300)

        i, node, weight = np.repeat(np.arange(count), points), node.ravel(), weight.ravel() / points
        first, second = x[..., 1].ravel(), x[..., 2].ravel()
        row, column = self._row[node], self._column[node]
        middle = np.stack([self._q_x[column], self._q_y[row]])
        q = middle + self._lobe.drawn(first, second)
        # Where light grazes, K G changes faster than a lobe: of the lobes there a second point, drawn by cos θ_o.
        near, horizon = _Horizon.of(directions[i], wavelengths[i], middle, self._lobe)
        more = horizon.drawn(first[near], second[near])
        shares = horizon.share(q[:, near]), horizon.share(more)
        more_weight = weight[near] * shares[1]
        weight[near] *= shares[0]
        q, weight = np.concatenate([q, more], 1), np.concatenate([weight, more_weight])
        i, row, column = (np.concatenate([a, a[near]]) for a in (i, row, column))

        u, v = wavelengths[i] * q
        square = 1 - (u + directions[i, 0]) ** 2 - (v + directions[i, 1]) ** 2
        lit = (square > 0) & (weight > 0) & (np.abs(q[0]) <= self._limit[0]) & (np.abs(q[1]) <= self._limit[1])
        i, row, column, weight, u, v = (a[lit] for a in (i, row, column, weight, u, v))
        cos_i, cos_o = cos_i[i], np.sqrt(square[lit])
        w = cos_i + cos_o
        d = (u**2 + v**2 + w**2) / 2
        kappa = np.minimum(per_cosine[i] * w, spectrum.largest_kappa)
        value = weight * k_g(cos_i, cos_o, d, shadowing) * spectrum.table.powers_at(row, column, kappa)
        raw = np.bincount(i, value, count)
        if not table.needed:
            return np.stack([raw, raw, raw])
        out = np.stack([-directions[i, 0] - u, -directions[i, 1] - v, cos_o], -1)
        there, back = table.at(directions, wavelengths)[i], table.at(out, wavelengths[i])
        return np.stack(
            [
                np.bincount(i, value * np.minimum(there, back), count),
                np.bincount(i, np.where(there < back, value * there, 0), count),
                raw,
            ]
        )


@dataclass(frozen=True)
class _Horizon:
    """Points q of lobes that reach near the horizon, even in the azimuth of ω_o and in log(cos θ_i + cos θ_o).

    −ω_o,t = ω_i,t + λq has the azimuth φ, and du dv = cos θ_o dcos θ_o dφ. With N the density of a lobe and h that of
    these points, points of either have the share N/(N + h), the balance heuristic (Veach and Guibas 1995).
    """

    wavelengths: NDArray[np.float64]
    tangent: NDArray[np.float64]  # of ω_i, (2, n)
    cos_i: NDArray[np.float64]
    middle: NDArray[np.float64]  # q of the node, (2, n)
    azimuth: NDArray[np.float64]
    opening: NDArray[np.float64]  # |φ − azimuth| at most
    lowest: NDArray[np.float64]  # cos θ_o
    highest: NDArray[np.float64]
    lobe: _Gaussian | _Spline

    @classmethod
    def of(
        cls,
        directions: NDArray[np.float64],
        wavelengths: NDArray[np.float64],
        middle: NDArray[np.float64],
        lobe: _Gaussian | _Spline,
    ) -> tuple[NDArray[np.int64], _Horizon]:
        """Which lobes these are, and their points."""
        x, y = directions[:, :2].T + wavelengths * middle
        distance, radius = np.hypot(x, y), wavelengths * lobe.radius
        near = np.flatnonzero(
            (distance + radius > np.sqrt(1 - np.minimum(NEAR * directions[:, 2], 0.5) ** 2)) & (distance - radius < 1)
        )
        distance, radius = distance[near], radius[near]
        inner, outer = np.maximum(distance - radius, 0), np.minimum(distance + radius, 1)
        return near, cls(
            wavelengths=wavelengths[near],
            tangent=directions[near, :2].T,
            cos_i=directions[near, 2],
            middle=middle[:, near],
            azimuth=np.arctan2(y, x)[near],
            opening=np.where(distance > radius, np.arcsin(np.minimum(radius / np.maximum(distance, 1e-9), 1)), np.pi),
            lowest=np.sqrt(1 - outer**2),
            highest=np.sqrt(1 - inner**2),
            lobe=lobe,
        )

    def drawn(self, x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
        """q, (2, n), for numbers from 0 to 1."""
        low = self.lowest + self.cos_i
        cos_o = low * ((self.highest + self.cos_i) / low) ** x - self.cos_i
        sine, phi = np.sqrt(np.maximum(1 - cos_o**2, 0)), self.azimuth + self.opening * (2 * y - 1)
        return (sine * np.array([np.cos(phi), np.sin(phi)]) - self.tangent) / self.wavelengths

    def share(self, q: NDArray[np.float64]) -> NDArray[np.float64]:
        """N/(N + h) at q, (2, n)."""
        x, y = self.tangent + self.wavelengths * q
        cos_o = np.sqrt(np.maximum(1 - x**2 - y**2, 1e-14))
        c, s = np.cos(self.azimuth), np.sin(self.azimuth)
        inside = np.abs(np.arctan2(c * y - s * x, c * x + s * y)) <= self.opening
        inside &= (cos_o >= self.lowest) & (cos_o <= self.highest)
        n = self.lobe.density(*(q - self.middle)) / self.wavelengths**2
        logarithm = np.log((self.highest + self.cos_i) / (self.lowest + self.cos_i))
        h = 1 / (2 * self.opening * logarithm * (cos_o + self.cos_i) * cos_o)
        return n / np.maximum(n + np.where(inside, h, 0), 1e-300)


def random_places(
    rng: np.random.Generator, count: int, wavelengths: tuple[float, float]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Directions (n, 3), half of them uniform in the polar angle, a quarter beyond 70° and beyond 85°; λ in µm (n,)."""
    least = np.choose(rng.integers(4, size=count), (0, 0, 70, 85))
    theta = np.deg2rad(rng.uniform(least, STEEPEST))
    phi = rng.uniform(0, 2 * np.pi, count)
    directions = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1)
    return directions, rng.uniform(*wavelengths, count) * 1e-3


def _emerging(
    furnace: Furnace, rng: np.random.Generator, directions: NDArray[np.float64], wavelengths: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Directions for which an order leaves near the horizon (a Rayleigh line), where an albedo peaks within a degree.

    An order drawn by its power leaves at an azimuth and a log(cos θ_o) that are evenly distributed. Where no direction
    sends it there, the given ones stay: (n, 3).
    """
    q = furnace.drawn_nodes(rng, len(directions))
    cosine, phi = np.exp(rng.uniform(np.log(GRAZING), np.log(0.5), len(q))), rng.uniform(0, 2 * np.pi, len(q))
    out = np.sqrt(1 - cosine**2)[:, None] * np.stack([np.cos(phi), np.sin(phi)], -1)
    tangential = -wavelengths[:, None] * q - out
    square = (tangential**2).sum(-1)
    there = square < np.sin(np.deg2rad(STEEPEST)) ** 2
    found = directions.copy()
    found[there] = np.concatenate([tangential[there], np.sqrt(1 - square[there])[:, None]], -1)
    return found


def conserving(spectrum: GratingSpectrum, table: EnergyTable, height_scale: float = 1.0) -> EnergyTable:
    """The table, lowered where the albedo exceeds one, with the excess and the loss that were measured.

    Each set of places lowers the table, or measures the excess and the loss; the last sets lower nothing.

    Args:
        spectrum: what the table was made for.
        table: e.
        height_scale: times the heights.
    """
    furnace, rng = Furnace(spectrum), np.random.default_rng(1)
    deep = spectrum.largest_kappa * spectrum.height_range > DEEP
    places, enough = (PLACES_DEEP, PASSED_DEEP) if deep else (PLACES, 1)
    passed, excess = 0, 0.0
    for attempt in range(ROUNDS):
        directions, wavelengths = random_places(rng, places, spectrum.wavelengths)
        anywhere = np.ones(places, bool)
        if isinstance(spectrum.grid, OrderGrid):
            anywhere[places // 2 :] = False
            directions[~anywhere] = _emerging(furnace, rng, directions[~anywhere], wavelengths[~anywhere])
        total, lost = np.zeros(len(directions)), None
        for count, points in SCREENED:
            first = _largest(total, count)
            directions, wavelengths = directions[first], wavelengths[first]
            total, _, raw = furnace.albedo(directions, wavelengths, table, points, rng, height_scale)
            if lost is None:
                lost = (1 - table.at(directions, wavelengths))[(raw <= 1) & anywhere[first]]
        for spread in CLIMBED:
            first = _largest(total, CLIMBERS)
            directions, wavelengths, total = directions[first], wavelengths[first], total[first]
            near = _about(rng, directions, wavelengths, spectrum.wavelengths, spread)
            risen = furnace.albedo(*near, table, SCREENED[-1][1], rng, height_scale)[0]
            directions, wavelengths = np.concatenate([directions, near[0]]), np.concatenate([wavelengths, near[1]])
            total = np.concatenate([total, risen])
        first = _largest(total, BOUNDED[0][0])
        directions, wavelengths = directions[first], wavelengths[first]
        albedo, local, raw = furnace.bounded(directions, wavelengths, table, rng, height_scale)
        over = albedo > 1 + ALLOWED
        excess = albedo.max() - 1 if over.any() or not passed else max(excess, albedo.max() - 1)
        passed = 0 if over.any() else passed + 1
        if passed == enough or attempt == ROUNDS - 1:
            break
        if passed:
            continue
        table = _lowered(
            table, directions[over], wavelengths[over], albedo[over], local[over], raw[over], min(attempt + 1, WIDEST)
        )
    loss = (float(lost.mean()), float(lost.max())) if len(lost) else (0.0, 0.0)
    return dataclasses.replace(table, excess=float(excess), loss=loss)


def _about(
    rng: np.random.Generator,
    directions: NDArray[np.float64],
    wavelengths: NDArray[np.float64],
    limits: tuple[float, float],
    spread: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Places about others, CHILDREN of each: ω (n, 3) and λ (n,), normally distributed by `spread` radians and λ."""
    directions, wavelengths = (np.repeat(x, CHILDREN, axis=0) for x in (directions, wavelengths))
    near = directions + spread * rng.standard_normal(directions.shape)
    near[:, 2] = np.maximum(near[:, 2], np.cos(np.deg2rad(STEEPEST)))
    near /= np.linalg.norm(near, axis=-1, keepdims=True)
    wavelengths = wavelengths * (1 + spread * rng.standard_normal(len(wavelengths)))
    return near, np.clip(wavelengths, limits[0] * 1e-3, limits[1] * 1e-3)


def _largest(values: NDArray[np.float64], count: int) -> NDArray[np.int64]:
    return np.argsort(-values, kind="stable")[:count]


def _lowered(
    table: EnergyTable,
    directions: NDArray[np.float64],
    wavelengths: NDArray[np.float64],
    albedo: NDArray[np.float64],
    local: NDArray[np.float64],
    raw: NDArray[np.float64],
    width: int,
) -> EnergyTable:
    """The table, lower at places where the albedo exceeds one.

    Args:
        table: e.
        directions: of the places, (n, 3).
        wavelengths: λ in µm, (n,).
        albedo: A, (n,).
        local: the part of it where e(ω_i) < e(ω_o).
        raw: the albedo without e.
        width: the cells about those of the places that are lowered, too.
    """
    e, shape = table.at(directions, wavelengths), np.array(table.values.shape)
    # A is concave in e(ω_i) and so below its tangent; and e = 1/a always suffices.
    factor = np.maximum(1 - (albedo - 1) / np.maximum(local, 1e-9), 1 / np.maximum(raw * e, 1e-9))
    factor = np.minimum(factor, 1).astype(np.float32)
    about = np.where(albedo > 1 + LITTLE, factor * e / table.horizon(directions[:, 2]), 1).astype(np.float32)
    values = table.values.copy()
    if (albedo > 1 + LITTLE).sum() > MANY or albedo.max() > 1 + MUCH:
        # The albedo changes within a cell: each node halfway to the least about it.
        values = (values + ndimage.minimum_filter(values, 3, mode="nearest")) / 2
    cell = np.floor(table.places(directions, wavelengths)).astype(np.int64)
    # All that is below one, by a little; the corners of the cell, by the factor; the nodes about, to the same bound.
    corners = np.ones_like(values)
    corners[values < 1 - SLACK] = max(1 / albedo.max(), 1 - LITTLE)
    for step in itertools.product(range(-width, 2 + width), repeat=3):
        node = tuple(np.clip(cell + step, 0, shape - 1).T)
        if min(step) >= 0 and max(step) <= 1:
            np.minimum.at(corners, node, factor)
        else:
            np.minimum.at(values, node, about)
    return dataclasses.replace(table, values=values * corners)
