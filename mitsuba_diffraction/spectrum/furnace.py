"""The albedo in a white furnace, from the stored spectrum itself, and an energy table that holds in it.

With R = 1 the BSDF reflects

    A(ω_i, λ) = ∫ K G S(q; κ) min(e(ω_i, λ), e(ω_o, λ)) dq

`albedo.py` makes the table from a gathered spectrum, at as many places as a table has cells. Here A is integrated at
fewer places, but from the powers of the spectrum, by quasi-Monte Carlo with importance sampling: nodes by their power
about κ and K G, then a q in the lobe. Where A exceeds one the nodes of the table are lowered, until a set of places
that lowered nothing shows none; it is what `EnergyTable.excess` reports.
"""

from __future__ import annotations

import dataclasses
import itertools
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri
from scipy.stats import qmc

from ..geometry import k_g
from .albedo import SLACK
from .energy_table import EnergyTable
from .orders import OrderGrid
from .spline_grid import spline_integral

if TYPE_CHECKING:
    from .grating_spectrum import GratingSpectrum

BLOCKS = 48  # blocks of nodes along one axis, at most
BINS = 12  # of κ, for which the power of each block is kept
FLOOR = 0.25  # the share of the power over all κ in the density: powers oscillate within a bin
CHUNK = 1 << 16  # points that are computed at once, so that they stay in the cache

PLACES = 1024  # directions and wavelengths of one round
POINTS = 256  # by which A is estimated at each
CANDIDATES, REPETITIONS, MORE_POINTS = 32, 4, 512  # the largest are computed again, less twice their noise
ROUNDS = 10
LITTLE = 0.02  # what an albedo may exceed one by without more than the nodes about it being lowered anew
STEEPEST = 89.9  # degrees


class Furnace:
    """A(ω, λ) of a spectrum, by importance sampling."""

    def __init__(self, spectrum: GratingSpectrum) -> None:
        self._spectrum = spectrum
        grid = spectrum.grid
        self._lines = isinstance(grid, OrderGrid)
        if self._lines:
            self._inside = [lobe.inside for lobe in spectrum.lobes]
            # Beyond six σ_q there is nothing.
            self._lobe = float(np.hypot(*(min(lobe.half_width, 6 * spectrum.lobe_width) for lobe in spectrum.lobes)))
        else:
            self._limit = np.array(grid.limit)
            offsets = np.linspace(-1.5, 1.5, 1025)
            self._spline = spline_integral(offsets), offsets
            self._lobe = 1.5 * float(np.hypot(*grid.spacing))

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
        self._radius = np.hypot(*np.meshgrid(np.ptp(x, axis=1) / 2, np.ptp(y, axis=1) / 2)).ravel() + self._lobe

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

        row, column = self._row[node], self._column[node]
        q_x, q_y = self._q_x[column], self._q_y[row]
        if self._lines:
            q_x, q_y = (
                q + spectrum.lobe_width * ndtri(0.5 + inside * (np.clip(x[..., i], 1e-9, 1 - 1e-9) - 0.5))
                for i, (q, inside) in enumerate(zip((q_x, q_y), self._inside, strict=True), start=1)
            )
        else:
            q_x = q_x + np.interp(x[..., 1], *self._spline) * spectrum.grid.spacing[0]
            q_y = q_y + np.interp(x[..., 2], *self._spline) * spectrum.grid.spacing[1]
        u, v = wavelengths[:, None] * q_x, wavelengths[:, None] * q_y
        o_x, o_y = u + directions[:, :1], v + directions[:, 1:2]
        square = 1 - o_x**2 - o_y**2
        above = square > 0
        if not self._lines:
            above &= (np.abs(q_x) <= self._limit[0]) & (np.abs(q_y) <= self._limit[1])
        i, j = np.nonzero(above)
        cos_i, cos_o = cos_i[i], np.sqrt(square[i, j])
        w = cos_i + cos_o
        d = (u[i, j] ** 2 + v[i, j] ** 2 + w**2) / 2
        kappa = np.minimum(per_cosine[i] * w, spectrum.largest_kappa)
        value = weight[i, j] / points * k_g(cos_i, cos_o, d, shadowing)
        value *= spectrum.table.powers_at(row[i, j], column[i, j], kappa)
        raw = np.bincount(i, value, count)
        if not table.needed:
            return np.stack([raw, raw, raw])
        out = np.stack([-o_x[i, j], -o_y[i, j], cos_o], -1)
        there, back = table.at(directions, wavelengths)[i], table.at(out, wavelengths[i])
        return np.stack(
            [
                np.bincount(i, value * np.minimum(there, back), count),
                np.bincount(i, np.where(there < back, value * there, 0), count),
                raw,
            ]
        )


def random_places(
    rng: np.random.Generator, count: int, wavelengths: tuple[float, float]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Directions (n, 3), half of them uniform in the polar angle and half beyond 70°, and λ in µm (n,)."""
    least = np.where(rng.random(count) < 0.5, 0, 70)
    theta = np.deg2rad(rng.uniform(least, STEEPEST))
    phi = rng.uniform(0, 2 * np.pi, count)
    directions = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1)
    return directions, rng.uniform(*wavelengths, count) * 1e-3


def conserving(spectrum: GratingSpectrum, table: EnergyTable, height_scale: float = 1.0) -> EnergyTable:
    """The table, lowered where the albedo exceeds one, with the excess and the loss that were measured.

    Args:
        spectrum: what the table was made for.
        table: e.
        height_scale: times the heights.
    """
    furnace, rng = Furnace(spectrum), np.random.default_rng(1)
    shape = np.array(table.values.shape)
    for attempt in range(ROUNDS):
        directions, wavelengths = random_places(rng, PLACES, spectrum.wavelengths)
        total, _, raw = furnace.albedo(directions, wavelengths, table, POINTS, rng, height_scale)
        lost = (1 - table.at(directions, wavelengths))[raw <= 1]
        first = np.argsort(-total, kind="stable")[:CANDIDATES]
        directions, wavelengths = directions[first], wavelengths[first]
        repeated = np.array(
            [furnace.albedo(directions, wavelengths, table, MORE_POINTS, rng, height_scale) for _ in range(REPETITIONS)]
        )
        total, local, raw = repeated.mean(0)
        total = total - 2 * repeated[:, 0].std(0) / np.sqrt(REPETITIONS - 1)
        excess, over = float(total.max() - 1), total > 1 + SLACK
        if not over.any() or attempt == ROUNDS - 1:
            break
        total, local, raw = total[over], local[over], raw[over]
        e = table.at(directions[over], wavelengths[over])
        # A is concave in e(ω_i) and so below its tangent; and e = 1/a always suffices.
        factor = np.maximum(1 - (total - 1) / np.maximum(local, 1e-9), 1 / np.maximum(raw * e, 1e-9))
        factor = np.minimum(factor, 1).astype(np.float32)
        values = table.values.copy()
        cell = np.floor(table.places(directions[over], wavelengths[over])).astype(np.int64)
        # The corners of the cell. Where more is wrong than a few cells: all that is below one, by a little, and where
        # that is too little, the same bound for a neighbourhood that widens.
        corners = np.ones_like(values)
        if attempt:
            corners[values < 1 - SLACK] = max(1 / total.max(), 1 - LITTLE)
        for step in itertools.product(range(-attempt, 2 + attempt), repeat=3):
            node = tuple(np.clip(cell + step, 0, shape - 1).T)
            if min(step) >= 0 and max(step) <= 1:
                np.minimum.at(corners, node, factor)
            elif attempt:
                np.minimum.at(values, node, np.where(total > 1 + LITTLE, factor * e, 1).astype(np.float32))
        table = dataclasses.replace(table, values=values * corners)
    loss = (float(lost.mean()), float(lost.max())) if len(lost) else (0.0, 0.0)
    return dataclasses.replace(table, excess=excess, loss=loss)
