"""From a height field to the table of its rigorous efficiencies, with a measured error."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import itertools
import os
import time
import warnings
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from ..errors import RequestError
from ..files import whole_file
from ..progress import Progress, silent
from ..settings import Settings
from ..surface.heightfield import HeightField
from .coordinate_transformation import ABOVE, BELOW, Curve, Grating, HalfSpace, Scattered, curve_of, half_space, scatter
from .efficiencies import (
    ODD,
    REVERSED,
    converge,
    matrices_of,
    one_thread,
    solve,
    through_sheet,
    unpolarised,
    wave_numbers,
)
from .materials import refractive_index
from .spectrum import LARGEST_PERIOD, Axes, RigorousSpectrum, edges_of, rank, shares_at

Real = NDArray[np.float64]
# n of the orders in and out, and their matrices, (orders out, orders in, 4, 4).
_Orders = tuple[NDArray[np.int64], NDArray[np.int64], Real]
# α, g, λ, whether an order is near its Rayleigh anomaly, and (from, to) → m and M_ij of the orders, (n, 4, 4).
_Checked = tuple[float, float, float, bool, dict[tuple[int, int], tuple[NDArray[np.int64], Real]]]

# Steps of F, X and (with transmission) Z that are solved, one after the other until the error is kept. Most along X, on
# which depends by how much light that grazes the surface enters it; along F, plasmons of metals are narrow.
_SOLVED = ((12, 15, 12), (18, 24, 18))
# Where light passes a third more steps are stored, and at least these, by cubic polynomials, as most of the time goes
# into solutions; of large periods the first of them are enough.
_SOLVED_BOTH = ((4, 6, 4), (6, 9, 6), (9, 15, 9), (12, 18, 12))
_LEAST_STORED = 8, 12, 8
PLANES = 17
_PLACES = 20  # to each step that is stored, where a table is fitted to its polynomials
# Wavelengths that are solved, by the least g λ / T (the cosine of the cone angle) of these: metals in light along the
# grooves show narrow lines that move with the wavelength.
_CONES = ((0.45, 17), (0.7, 9), (1.0, 5))
# η is stored in steps of this: files are half as large.
_ROUNDED = 2.0**-16
# An order at exactly grazing exit has no Rayleigh wave. sin² at the first and the last node.
_OFF = 1e-12
_STILL = 1e-8  # γ²
_LEAST_K_Y = 1e-4  # matrices are divided by k_y
_NEAR = 0.02
_CHECKS = 200
_SECONDS = 20.0  # between checkpoints, each of which is written whole
# Light at which the harmonics are chosen: near the normal, and oblique from both sides.
_HARD = ((0.1, 0, 1), (0.8, 0.3, 0.5), (-0.8, 0.3, 0.5))
BUILD_VERSION = 7  # raised when tables of equal requests change
MATRICES = 3.0
"""Bound of `polarisation_error`, in tolerances: matrices vary faster than η."""


def build_spectrum(
    height_field: HeightField,
    settings: Settings,
    progress: Progress = silent,
    checkpoints: Path | None = None,
) -> RigorousSpectrum:
    """Compute the table of a surface of one row.

    Args:
        height_field: the surface; rows that differ are refused.
        settings: of rigorous theory. The tolerance bounds `RigorousSpectrum.error`, the mean of Σ|Δη_m| / Σ η_m over
            directions and wavelengths, and a third of `polarisation_error`.
        progress: called with (per cent done, 100); it never counts back.
        checkpoints: a folder for what is done so far; an interrupted build goes on from there.

    Raises:
        ValueError: if the material is unknown, the period is above ten of the shortest wavelength, or the profile is
            too deep for efficiencies that converge and conserve energy within the tolerance.

    Warns:
        UserWarning: if the finest table errs by more than the tolerance, or its Mueller matrices by more than three
            times that; `error` and `polarisation_error` say by how much.
    """
    tolerance = 1e-2 if settings.tolerance is None else settings.tolerance
    period, longest = height_field.tile_size[0], LARGEST_PERIOD * settings.wavelengths[0] * 1e-3
    if period > longest:
        raise RequestError(
            f"period: got {period:.4g} µm, wanted at most {longest:.4g} µm with theory=rigorous, "
            f"{LARGEST_PERIOD:g} times the shortest wavelength; use theory=scalar"
        )
    with one_thread():
        surface = _Surface(height_field, settings, tolerance)
        checks = surface.checks()
        error, done = np.inf, 0
        steps = _SOLVED if settings.transmission == "none" else _SOLVED_BOTH
        for solved in steps:
            # Half as many steps again leave less than half of the error: which table will be the last?
            begin, done = done, 95 if error <= 2 * tolerance or solved == steps[-1] else done + 20
            build = _Build(surface, solved, settings.polarised)
            values, mueller = build.table(
                lambda row, rows, a=begin, b=done: progress(a + (b - a) * row // rows, 100), checkpoints
            )
            spectrum = RigorousSpectrum(
                axes=build.axes,
                values=values,
                mueller=mueller,
                material=settings.material or "",
                int_ior=complex(settings.int_ior or 0),
                ext_ior=float(settings.ext_ior),
                coherence_length=float(settings.coherence_length),
                tolerance=float(tolerance),
                harmonics=surface.harmonics,
                source=height_field.source,
                source_digest=height_field.digest,
                **dict.fromkeys(("error", "max_error", "max_error_near"), np.nan),
            )
            spectrum = dataclasses.replace(spectrum, **_errors(spectrum, checks))
            # NaN: there are no matrices.
            if spectrum.error <= tolerance and not spectrum.polarisation_error > MATRICES * tolerance:
                progress(100, 100)
                return spectrum
            error = spectrum.error
    progress(100, 100)
    got, wanted = f"{spectrum.error:.2g}", f"{tolerance:.2g}"
    if settings.polarised:
        got += f" and {spectrum.polarisation_error:.2g} of the Mueller matrices"
        wanted += f" and {MATRICES * tolerance:.2g}"
    warnings.warn(
        f"rigorous table: got a mean error of {got} with {max(steps[-1])} steps to a cell, wanted at most {wanted}",
        stacklevel=4,
    )
    return spectrum


class _Surface:
    """A surface and its material, ready to be solved.

    Attributes:
        harmonics: N, enough for a tenth of the tolerance at the shortest wavelength.
    """

    def __init__(self, height_field: HeightField, settings: Settings, tolerance: float) -> None:
        self.period = height_field.tile_size[0]
        self.wavelengths = settings.wavelengths[0] * 1e-3, settings.wavelengths[1] * 1e-3
        self.material = settings.int_ior, settings.material, settings.ext_ior
        self.tolerance = tolerance
        self.transmission = settings.transmission
        curve = curve_of(height_field)
        self.harmonics = max(self._harmonics(curve, np.array(d) / np.linalg.norm(d)) for d in _HARD)
        # The table takes the first; the others are for light that needs more, and for what it is compared with.
        self.gratings = [Grating(curve, int(1.4**k * self.harmonics)) for k in range(5)]
        request = height_field.digest, self.wavelengths, self.material, settings.polarised, self.transmission
        self.digest = hashlib.sha256(repr((request, self.harmonics, BUILD_VERSION)).encode()).hexdigest()

    def index(self, wavelength: float) -> complex:
        """Return n + ik below, relative to the medium above, where the wavelength is in µm."""
        int_ior, material, ext_ior = self.material
        return refractive_index(wavelength * ext_ior, int_ior=int_ior, material=material) / ext_ior

    def _harmonics(self, curve: Curve, omega: Real) -> int:
        """Return the fewest harmonics that are right to a tenth of the tolerance, at the shortest wavelength."""
        index, k_0 = self.index(self.wavelengths[0]), self.period / self.wavelengths[0]
        exact = converge(curve, omega, k_0, index, self.tolerance / 20)
        if exact.error > self.tolerance:
            raise RequestError(
                f"height field: got an error of {exact.error:.2g} with {exact.harmonics} harmonics at a wavelength of "
                f"{1e3 * self.wavelengths[0]:.4g} nm, wanted at most {self.tolerance:.2g}; it is too deep for its "
                "period with theory=rigorous"
            )
        # At grazing incidence there are orders up to 2 T/λ.
        count, _ = wave_numbers(curve, k_0, index, np.array([1.0, 0.0, 0.0]))
        while count < exact.harmonics:
            found = solve(curve, omega, k_0, index, count)
            difference = np.abs(found.unpolarised - exact.unpolarised).sum()
            if max(difference / exact.unpolarised.sum(), found.imbalance) <= self.tolerance / 10:
                break
            count = int(np.ceil(1.1 * count))
        return count

    def light(self, square: float, wavelength: float) -> tuple[float, complex]:
        """Return ν² and γ'² of light of γ²."""
        nu2, index = (self.period / wavelength) ** 2, self.index(wavelength)
        return nu2, square + nu2 * ((index.real**2 if index.imag == 0 else index**2) - 1)

    def solve(
        self,
        alpha: float,
        square: float,
        lights: Iterable[tuple[float, complex]],
        finer: int = 0,
        fields: Callable[[Grating, float, complex, bool], HalfSpace] = half_space,
    ) -> list[Scattered]:
        """Solve for light of all orders from either side, for each (ν², γ'²); α of order 0 and γ² in (2π/T)².

        The harmonics, those of `gratings[finer]`, are raised where R + T is not one within the tolerance, or where R is
        above one if the material absorbs. `fields` may remember results of `half_space`.
        """
        lights = list(lights)
        for grating in self.gratings[finer:]:
            found, excess = [], 0.0
            above = fields(grating, alpha, square, True)
            for nu2, inside in lights:
                index = self.index(self.period / np.sqrt(nu2))
                k_y = np.emath.sqrt(nu2 - square)
                k_y = k_y if abs(k_y) > _LEAST_K_Y else _LEAST_K_Y
                solved = scatter(alpha + grating.n, above, fields(grating, alpha, inside, False), k_y, index)
                for of_light in solved.amplitudes:
                    beyond = np.asarray(sum(solved.powers(a).sum(axis=(0, 1)) for a in of_light)) - 1
                    excess = max(excess, np.max(np.abs(beyond) if index.imag == 0 else beyond, initial=0))
                found.append(solved)
            if excess <= self.tolerance:
                return found
        shortest, longest = (1e3 * self.period / np.sqrt(end(nu2 for nu2, _ in lights)) for end in (max, min))
        raise RequestError(
            f"height field: got an excess of {excess:.2g} of the incident light with {grating.harmonics} harmonics at "
            f"{shortest:.4g} to {longest:.4g} nm, wanted at most {self.tolerance:.2g}; it is too deep for its period "
            "with theory=rigorous"
        )

    def matrices(self, solved: Scattered, entries: int = 4) -> dict[tuple[int, int], _Orders]:
        """Return (from, to) → n of the orders in and of those out, and M_ij, (orders out, orders in, entries, entries).

        With one entry it is η. Where k_y is imaginary, elements that are odd in k_y are so, too.
        """
        orders = solved.orders
        if self.transmission == "sheet":
            orders = orders[ABOVE], orders[ABOVE]
            found = through_sheet(solved, self.index(self.wavelengths[0]).real)
        else:
            sides = (ABOVE,) if self.transmission == "none" else (ABOVE, BELOW)
            of_way = unpolarised if entries == 1 else matrices_of
            found = {(i, o): of_way(solved, i, o) for i, o in itertools.product(sides, sides)}
        return {(i, o): (orders[i], orders[o], m[..., :entries, :entries]) for (i, o), m in found.items()}

    def checks(self) -> list[_Checked]:
        """Return light at random places, directions uniform over the hemispheres, wavelengths over the range."""
        rng = np.random.default_rng(0)
        checks = []
        for number, (cosine, turn, share) in enumerate(rng.random((_CHECKS, 3))):
            wavelength = self.wavelengths[0] + share * (self.wavelengths[1] - self.wavelengths[0])
            side = BELOW if self.transmission != "none" and number % 2 else ABOVE
            inside = side == BELOW and self.transmission == "interface"
            nu, n = self.period / wavelength, self.index(wavelength).real if inside else 1.0
            k = np.sqrt(1 - cosine**2) * n * nu
            alpha, k_y = k * np.cos(2 * np.pi * turn), k * np.sin(2 * np.pi * turn)
            g = np.sign(nu - abs(k_y)) * np.sqrt(abs(nu**2 - k_y**2))
            square = g * abs(g)
            (solved,) = self.solve(alpha, square, [self.light(square, wavelength)], finer=1)
            orders = {
                way: (-of_out, matrices[:, of_in == 0][:, 0].real)
                for way, (of_in, of_out, matrices) in self.matrices(solved).items()
                if way[0] == side
            }
            near = g > 0 and min(abs(x - round(x)) for x in (g + alpha, g - alpha)) < _NEAR
            checks.append((alpha, g, wavelength, bool(near), orders))
        return checks


def _errors(spectrum: RigorousSpectrum, checks: list[_Checked]) -> dict[str, float]:
    """Return `error`, `max_error`, `max_error_near` and `polarisation_error` of a table."""
    error, split = [], []
    for alpha, g, wavelength, _, orders in checks:
        total, difference, matrices_differ = 0.0, 0.0, 0.0
        for sides, (m, matrices) in orders.items():
            place = m, alpha - m / 2, g, wavelength, sides
            eta = matrices[:, 0, 0]
            total += eta.sum()
            difference += np.abs(spectrum.evaluate(*place) - eta).sum()
            if spectrum.mueller is not None:
                matrices_differ += np.abs(spectrum.evaluate(*place, mueller=True) - matrices).max(axis=(1, 2)).sum()
        error.append(difference / total)
        split.append(matrices_differ / total)
    error, near = np.array(error), np.array([check[3] for check in checks])
    return {
        "error": float(error.mean()),
        "max_error": float(error[~near].max(initial=0)),
        "max_error_near": float(error[near].max(initial=0)),
        "polarisation_error": float("nan") if spectrum.mueller is None else float(np.mean(split)),
    }


class _Build:
    """The nodes of `Axes`, of which every so many are solved, all orders of light from both sides together.

    Fields above depend on a and γ alone, those below on a and γ': each is the solution of one eigenproblem, and most of
    the time goes there. With transmission a lattice of γ and one of γ' serve all of their pairs.
    """

    def __init__(self, surface: _Surface, steps: tuple[int, int, int], polarised: bool) -> None:
        self.surface, self.steps = surface, steps
        self.entries = 4 if polarised else 1  # rows and columns of the matrices that are kept
        self.passes = surface.transmission != "none"
        f, x, z = steps
        if self.passes:
            f, x, z = (max(4 * count // 3, least) for count, least in zip(steps, _LEAST_STORED, strict=True))
        index = surface.index(surface.wavelengths[0]).real if self.passes else 0.0
        self.axes = Axes(
            surface.period, surface.wavelengths, (f, x, z if self.passes else PLANES - 1), index, surface.transmission
        )
        self.shares = [np.clip(shares, _OFF, 1 - _OFF) for shares in shares_at(steps)]
        self.jobs = [(share, cells) for share in self.shares[0] / 2 for cells in self.axes.blocks]
        # Those of two a: one thread may be ahead.
        self.fields = functools.lru_cache(maxsize=2 * int(np.dot(self.axes.starts.shape, steps[1:])))(half_space)

    def table(self, progress: Progress, checkpoints: Path | None) -> tuple[NDArray[np.float32], Any]:
        """Return `values` and `mueller` of `RigorousSpectrum`."""
        done = _Checkpoint(checkpoints, f"{self.surface.digest}-{max(self.steps)}")
        left = [job for job in range(len(self.jobs)) if job not in done.done]
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            try:
                for job, solved in zip(left, pool.map(self._job if self.passes else self._planes, left), strict=True):
                    done.add(job, solved)
                    progress(len(done.done), len(self.jobs))
            except BaseException:
                pool.shutdown(cancel_futures=True)
                done.write()
                raise
        stored = self._stored(done.done)
        done.remove()
        return stored

    def _job(self, job: int) -> NDArray[np.float32]:
        """Return M at one a in one block: (orders in, orders out, X, Z, i, j); 0 where there is no light."""
        a, (cell, inside) = self.jobs[job]
        axes, surface = self.axes, self.surface
        counts = axes.counts(cell, inside)
        low, low_inside = (float(edges_of(j, a, 0.0)[0]) for j in (cell, inside))
        nodes = [len(shares) for shares in self.shares[1:]]
        found = np.zeros((sum(counts), sum(counts), *nodes, self.entries, self.entries))
        # Where a cell is but a point its nodes are one.
        known: dict[tuple[float, float], NDArray] = {}
        for (x, of_x), (z, of_z) in itertools.product(*(enumerate(shares) for shares in self.shares[1:])):
            square, below = _inside(cell, a, of_x, low_inside - axes.top), _inside(inside, a, of_z, low + axes.top)
            nu2 = (below - square) / axes.excess
            # Beyond the light that there is, too: where nodes are left out, polynomials of their neighbours err.
            if nu2 < max((axes.period / axes.wavelengths[1]) ** 2, square) / 64:
                continue
            key = square, below
            if key not in known:
                (solved,) = surface.solve(a, square, [(nu2, below)], fields=self.fields)
                known[key] = self._matrices(solved, counts)
            found[:, :, x, z] = known[key]
        return found.astype(np.float32)

    def _planes(self, job: int) -> NDArray[np.float32]:
        """Return what `_job` does, Z being the wavelength."""
        a, (cell, _) = self.jobs[job]
        axes, surface, planes = self.axes, self.surface, []
        squares = [_inside(cell, a, of_x, 0.0) for of_x in self.shares[1]]
        for square, before in zip(squares, [None, *squares], strict=False):
            if square == before:
                planes.append(planes[-1])
                continue
            g = np.sqrt(square)
            shortest, longest = axes.range(g)
            count = 1
            if longest > shortest:
                count = next((count for limit, count in _CONES if g < limit * axes.largest), _CONES[-1][1])
            at, weights = _nodes(count)
            lights = [surface.light(square, wavelength) for wavelength in shortest + at * (longest - shortest)]
            solved = [self._matrices(light, axes.counts(cell, 0)) for light in surface.solve(a, square, lights)]
            planes.append(np.einsum("kw,wnm...->nmk...", weights, solved))
        return np.stack(planes, axis=2).astype(np.float32)

    def _matrices(self, solved: Scattered, counts: tuple[int, int]) -> Real:
        """Return M, odd elements per k_y/ν, (orders in, orders out, i, j), in the order of the rows of `Axes`."""
        found = np.zeros((sum(counts),) * 2 + (self.entries,) * 2)
        for (from_, to), (of_in, of_out, matrices) in self.surface.matrices(solved, self.entries).items():
            if self.entries > 1:
                matrices = matrices / np.where(ODD, solved.k_y / solved.k_0, 1)
            of_in, of_out = rank(of_in), rank(of_out)
            came, left = of_in < counts[from_], of_out < counts[to]
            rows, columns = of_in[came] + from_ * counts[0], of_out[left] + to * counts[0]
            found[np.ix_(rows, columns)] = matrices[np.ix_(left, came)].swapaxes(0, 1).real
        return found

    def _stored(self, done: dict[int, NDArray[np.float32]]) -> tuple[NDArray[np.float32], Any]:
        """Return what was solved at the nodes that are stored."""
        axes, entries, blocks = self.axes, self.entries, len(self.axes.blocks)
        matrices = np.empty((*axes.shape, entries, entries), np.float32)
        # The wavelength, where it is an axis, is done.
        steps = list(zip(self.steps, axes.steps, strict=True))[: 3 if self.passes else 2]
        refine = [_fitted(functools.partial(_cubic, solved), stored) for solved, stored in steps]
        refine += [] if self.passes else [np.eye(PLANES)]
        signs = np.outer(REVERSED, REVERSED)[:entries, :entries]
        for block, (cells, row) in enumerate(axes.blocks.items()):
            solved = np.stack([done[job] for job in range(block, len(self.jobs), blocks)])
            for of_a, shift in ((0, 1), (-1, 0)):
                # At a = 0 and 1/2 light and reversed light are both of the table, orders n and −n, or −n − 1.
                orders, before = [], 0
                for count in axes.counts(*cells):
                    mirrored = np.maximum(((np.arange(count) + shift) ^ 1) - shift, 0)
                    orders.append(np.where(mirrored < count, mirrored + before, -1))
                    before += count
                order = np.concatenate(orders)
                back = signs * solved[of_a][np.ix_(order, order)].transpose(1, 0, 2, 3, 5, 4)
                both = np.logical_and.outer(order >= 0, order >= 0)[..., None, None, None, None]
                solved[of_a] = np.where(both, (solved[of_a] + back) / 2, solved[of_a])
            found = np.einsum("ax,by,cz,xnmyz...->nmabc...", *refine, solved, optimize=True)
            # Beside a kink the polynomials overshoot.
            eta = found[..., :1, :1]
            found *= np.divide(np.clip(eta, 0, 1), eta, out=np.zeros_like(eta), where=eta != 0)
            count = found.shape[0] ** 2
            matrices[row : row + count] = (np.round(found / _ROUNDED) * _ROUNDED).reshape(count, *matrices.shape[1:])
        return np.ascontiguousarray(matrices[..., 0, 0]), matrices if entries == 4 else None


def _inside(cell: int, a: float, share: float, least: float) -> float:
    """Return γ² in a cell; the same for all shares if it is but a point."""
    low, high = (float(x) for x in edges_of(cell, a, least))
    square = low + (high - low) * (share if high - low > 1e-6 else 0.5)
    # Fields that neither travel nor decay have no admittance.
    return square if abs(square) > _STILL else _STILL if cell else -_STILL


@functools.cache
def _nodes(count: int) -> tuple[Real, Real]:
    """Return Chebyshev–Lobatto points in 0 … 1, (count,), and the weights (planes, count) of values at equal steps."""
    at = (1 - np.cos(np.pi * np.arange(count) / max(count - 1, 1))) / 2
    return at, _fitted(lambda x: _lagrange(x, at), PLANES - 1)


def _lagrange(x: Real, nodes: Real) -> Real:
    """Return (x, nodes): weights of values at the nodes in the polynomial through them."""
    others = [np.delete(nodes, j) for j in range(len(nodes))]
    factors = [(x[:, None] - other) / (node - other) for node, other in zip(nodes, others, strict=True)]
    return np.stack([factor.prod(axis=1) for factor in factors], axis=1)


def _cubic(steps: int, x: Real) -> Real:
    """Return (x, nodes solved): weights in cubic interpolation between four neighbours, x from 0 to 1."""
    low = np.clip((x * steps).astype(int) - 1, 0, steps - 3)
    matrix = np.zeros((len(x), steps + 1))
    matrix[np.arange(len(x))[:, None], low[:, None] + np.arange(4)] = _lagrange(x * steps - low, np.arange(4.0))
    return matrix


def _fitted(polynomials: Callable[[Real], Real], steps: int) -> Real:
    """Return (steps + 1, nodes solved): weights of values at equal steps between which linear look-ups fit polynomials.

    Of the rms error of values on a polynomial, h² |f''| / √120 with steps h, least squares leave 1/√6. Values at the
    ends are on it: tables of neighbouring cells meet there.
    """
    x = (np.arange(_PLACES * steps) + 0.5) / (_PLACES * steps)
    hats = np.maximum(1 - np.abs(steps * x[:, None] - np.arange(steps + 1)), 0)
    ends = polynomials(np.array([0.0, 1.0]))
    rest = polynomials(x) - hats[:, [0, -1]] @ ends
    return np.vstack([ends[:1], np.linalg.lstsq(hats[:, 1:-1], rest, rcond=None)[0], ends[1:]])


class _Checkpoint:
    """Rows that are done, in memory and, now and then, in a file of that name."""

    def __init__(self, folder: Path | None, name: str) -> None:
        self.path = folder / f"rigorous-{name}.npz" if folder else None
        self.done: dict[int, NDArray[np.float32]] = {}
        self._written = time.monotonic()
        if self.path and self.path.is_file():
            try:
                with open(self.path, "rb") as stream, np.load(stream) as file:
                    self.done = {int(row): file[row] for row in file.files}
            except (OSError, ValueError, EOFError, KeyError, BadZipFile):
                self.path.unlink(missing_ok=True)

    def add(self, row: int, values: NDArray[np.float32]) -> None:
        self.done[row] = values
        if time.monotonic() > self._written + _SECONDS:
            self.write()

    def write(self) -> None:
        # A checkpoint only saves time: a folder that cannot be written to is no reason to stop.
        with suppress(OSError):
            if self.path:
                self.path.parent.mkdir(parents=True, exist_ok=True)
                with whole_file(self.path) as temporary, open(temporary, "wb") as file:
                    np.savez(file, **{str(row): values for row, values in self.done.items()})
        self._written = time.monotonic()

    def remove(self) -> None:
        with suppress(OSError):
            if self.path:
                self.path.unlink(missing_ok=True)
