"""From a height field to the table of its rigorous efficiencies, with a measured error."""

from __future__ import annotations

import dataclasses
import hashlib
import itertools
import os
import time
import warnings
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from ..errors import RequestError
from ..files import whole_file
from ..progress import Progress, silent
from ..settings import Settings
from ..surface.heightfield import HeightField
from .coordinate_transformation import ABOVE, BELOW, Curve, Grating, Scattered, curve_of, half_space, scatter
from .efficiencies import REVERSED, converge, matrices_of, one_thread, solve, through_sheet, wave_numbers
from .materials import refractive_index
from .spectrum import LARGEST_PERIOD, STORED, Axes, RigorousSpectrum, Table, axes_of

Real = NDArray[np.float64]
# The part of a unit and the units of p + r → M of that light, as `_Build._job` has it.
_Lattice = dict[tuple[int, int], NDArray[np.float32]]
# n of the orders in and out, and their matrices, (orders out, orders in, 4, 4).
_Orders = tuple[NDArray[np.int64], NDArray[np.int64], Real]
# α, g, λ, whether an order is near its Rayleigh anomaly, and (from, to) → m and M_ij of the orders, (n, 4, 4).
_Checked = tuple[float, float, float, bool, dict[tuple[int, int], tuple[NDArray[np.int64], Real]]]

# Steps to a unit that are solved, one after the other until the error is kept; each twice those before, which it holds.
_SOLVED = (8, 16, 32)
# Of an interface, whose light from below is less smooth. 600 lines/mm in glass have a mean error of 0.0106 with eight.
_SOLVED_BOTH = (10, 20, 40)
PLANES = 17
# Wavelengths that are solved, by the least g λ / T (the cosine of the cone angle) of these: metals in light along the
# grooves show narrow lines that move with the wavelength.
_CONES = ((0.45, 17), (0.7, 9), (1.0, 5))
# η is stored in steps of this: files are half as large.
_ROUNDED = 2.0**-16
# An order at exactly grazing exit has no Rayleigh wave.
_OFF = 1e-8
_NEAR = 0.02
_CHECKS = 200
_SECONDS = 20.0  # between checkpoints, each of which is written whole
# Light at which the harmonics are chosen: near the normal, and oblique from both sides.
_HARD = ((0.1, 0, 1), (0.8, 0.3, 0.5), (-0.8, 0.3, 0.5))
BUILD_VERSION = 5  # raised when tables of equal requests change
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
        error, done, lattice = np.inf, 0, {}
        steps = _SOLVED_BOTH if settings.transmission == "interface" else _SOLVED
        for solved in steps:
            # Twice the steps cost four times as much and leave an eighth of the error: which table will be the last?
            begin, done = done, 95 if error <= 8 * tolerance or solved == steps[-1] else done + 20
            axes = Axes(surface.period, surface.wavelengths, STORED * solved, PLANES)
            build = _Build(surface, axes, solved, settings.polarised, lattice)
            tables, lattice = build.tables(
                lambda row, rows, a=begin, b=done: progress(a + (b - a) * row // rows, 100), checkpoints
            )
            spectrum = RigorousSpectrum(
                tables=tables,
                transmission=settings.transmission,
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
        f"rigorous table: got a mean error of {got} with {steps[-1]} steps to a unit, wanted at most {wanted}",
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

    def solve(self, alpha: float, g: float, wavelengths: Iterable[float], finer: int = 0) -> list[Scattered]:
        """Solve for light of all orders from either side, at each wavelength; α of order 0 and g times period/2π.

        The harmonics, those of `gratings[finer]`, are raised where R + T is not one within the tolerance, or where R is
        above one if the material absorbs. g is that above, signed as in `Axes`.
        """
        wavelengths, square = list(wavelengths), g * abs(g)
        for grating in self.gratings[finer:]:
            alphas, found, excess = alpha + grating.n, [], 0.0
            above = half_space(grating, alphas, square, True)
            for wavelength in wavelengths:
                k_0, index = self.period / wavelength, self.index(wavelength)
                k_y = np.sqrt(max(k_0**2 - square, 0))
                gamma2 = square + k_0**2 * ((index.real**2 if index.imag == 0 else index**2) - 1)
                solved = scatter(alphas, above, half_space(grating, alphas, gamma2, False), k_y, index)
                for of_light in solved.amplitudes:
                    beyond = np.asarray(sum((np.abs(a) ** 2).sum(axis=(0, 1)) for a in of_light)) - 1
                    excess = max(excess, np.max(np.abs(beyond) if index.imag == 0 else beyond, initial=0))
                found.append(solved)
            if excess <= self.tolerance:
                return found
        raise RequestError(
            f"height field: got an excess of {excess:.2g} of the incident light with {grating.harmonics} harmonics at "
            f"{1e3 * wavelengths[0]:.4g} to {1e3 * wavelengths[-1]:.4g} nm, wanted at most {self.tolerance:.2g}; "
            "it is too deep for its period with theory=rigorous"
        )

    def matrices(self, solved: Scattered) -> dict[tuple[int, int], _Orders]:
        """Return (from, to) → n of the orders in and of those out, and M_ij, (orders out, orders in, 4, 4)."""
        if self.transmission == "sheet":
            of_air = solved.orders[ABOVE], solved.orders[ABOVE]
            found = through_sheet(solved, self.index(self.wavelengths[0]).real)
            return {way: (*of_air, matrices) for way, matrices in found.items()}
        sides = (ABOVE,) if self.transmission == "none" else (ABOVE, BELOW)
        ways = itertools.product(sides, sides)
        return {(i, o): (solved.orders[i], solved.orders[o], matrices_of(solved, i, o)) for i, o in ways}

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
            (solved,) = self.solve(alpha, g, [wavelength], finer=1)
            orders = {
                way: (-of_out, matrices[:, of_in == 0][:, 0])
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
    """A lattice of light to be solved, and the way from there to the nodes of `Axes`.

    Light from (p, r) = (g + α, g − α) has order m at P = p − max(m, 0), R = r + min(m, 0): whole units away, so that
    one lattice serves all orders. And lights whose p and r differ by whole units, p + r being equal, are orders of each
    other: they are solved together, from both sides. Reversed light has p and r exchanged, so that half of the lattice
    is solved: r less its units at most p less its units.
    """

    def __init__(self, surface: _Surface, axes: Axes, steps: int, polarised: bool, coarser: _Lattice) -> None:
        self.surface, self.steps, self.coarser = surface, steps, coarser
        self.entries = 4 if polarised else 1  # rows and columns of the matrices that are kept
        self.axes = axes_of(axes, surface.transmission, surface.index(surface.wavelengths[0]).real)
        self.local = surface.transmission == "interface"
        self.parts = np.sin(np.pi / 2 * np.arange(steps) / steps) ** 2
        self.parts[0] = _OFF
        # Of light that crosses, also what is solved from below, as reversed light.
        self.solved = [(axes, axes.way) for axes in self.axes] + [(axes, (BELOW, ABOVE)) for axes in self.axes[2:]]
        # Where the orders of each begin among all of a job.
        self.first = np.cumsum([0, *(len(axes.orders) for axes, _ in self.solved)])
        self.signs = np.outer(REVERSED, REVERSED)[: self.entries, : self.entries]
        # p less its whole units, and the units of p + r; below zero no light travels above.
        below = int(np.ceil(2 * self.axes[0].max_decay * axes.period / axes.wavelengths[0])) + 1 if self.local else 0
        self.shift = max(axes.shift for axes in self.axes)
        units = range(-below, axes.units(0) + 2)
        self.jobs = [(part, unit) for part in reversed(range(steps)) for unit in units]  # the longest first

    def tables(self, progress: Progress, checkpoints: Path | None) -> tuple[tuple[Table, ...], _Lattice]:
        """Return those of `RigorousSpectrum`, and the lattice, a quarter of that of twice the steps."""
        done = _Checkpoint(checkpoints, f"{self.surface.digest}-{self.steps}")
        left = [job for job in range(len(self.jobs)) if job not in done.done]
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            try:
                for job, solved in zip(left, pool.map(self._job, left), strict=True):
                    done.add(job, solved)
                    progress(len(done.done), len(self.jobs))
            except BaseException:
                pool.shutdown(cancel_futures=True)
                done.write()
                raise
        tables = [self._stored(table, done.done) for table in range(len(self.axes))]
        done.remove()
        return tuple(tables), {self.jobs[job]: solved for job, solved in done.done.items()}

    def _job(self, job: int) -> NDArray[np.float32]:
        """Return M: (r less its units, orders of all tables, units of p + D, K, i, j); NaN where there is no light.

        Of reversed light: (p less its units, …).
        """
        part, units = self.jobs[job]
        axes, entries, shift = self.axes[0], self.entries, self.shift
        nu = axes.period / axes.wavelengths[0]
        shape = self.first[-1], max(units + 2 * shift + 1, 0)
        found = np.full((part + 1, *shape, axes.planes, entries, entries), np.nan, np.float32)
        middle = (units + 1) // 2
        known = self.coarser.get((part // 2, units)) if part % 2 == 0 else None
        for other in range(part + 1):
            if known is not None and other % 2 == 0:
                found[other] = known[other // 2]
                continue
            # A node at the end of a unit belongs to that unit. The units that the table reaches are solved whole, for
            # polynomials across them.
            if not units - (part == 0) - (other == 0) < axes.units(0):
                continue
            p, r = self.parts[part] + middle, self.parts[other] + units - middle
            g = (p + r) / 2
            if g < 1e-4:
                if not self.local or g < -axes.max_decay * nu - 1:
                    continue
                g = min(g, -1e-4)  # fields that neither travel nor decay have no admittance
            shortest, longest = axes.range(g)
            count = 1
            if longest > shortest:
                count = next((count for limit, count in _CONES if abs(g) < limit * nu), _CONES[-1][1])
            at, weights = _nodes(count, axes.planes, self.local)
            wavelengths = shortest + at * (longest - shortest)
            nodes = np.full((count, *shape, entries, entries), np.nan)
            if self.local:
                nodes[:] = 0
                nodes[:, self.first[0] + self.axes[0].max_order] = nodes[:, self.first[1] + self.axes[1].max_order] = (
                    np.eye(entries)
                )
            for node, solved in enumerate(self.surface.solve((p - r) / 2, g, wavelengths)):
                ways = self.surface.matrices(solved)
                for (table, way), start in zip(self.solved, self.first[:-1], strict=True):
                    of_in, of_out, matrices = ways[way]
                    m, matrices = of_in - of_out[:, None], matrices[..., :entries, :entries]
                    unit = np.broadcast_to(of_in + middle + shift, m.shape)
                    if way != table.way:
                        unit = np.broadcast_to(units - middle - of_out[:, None] + shift, m.shape)
                        matrices = self.signs * matrices.swapaxes(-1, -2)
                    kept = (np.abs(m) <= table.max_order) & (unit >= 0) & (unit < shape[1])
                    nodes[node, start + table.max_order + m[kept], unit[kept]] = matrices[kept]
            found[other] = np.einsum("kw,wmu...->muk...", weights, nodes)
        return found

    def _stored(self, table: int, done: dict[int, NDArray[np.float32]]) -> Table:
        """Return what was solved at the nodes that are stored; the other half of the lattice is reversed light."""
        axes, lattice, steps, entries = self.axes[table], self.axes[table].solved, self.steps, self.entries
        matrices = np.zeros((axes.planes, axes.nodes, entries, entries), np.float32)
        count, reflected = lattice.side(0), axes.way[0] == axes.way[1]
        for m in axes.orders:
            side, start = lattice.side(m), axes.offset(m)
            of_light = np.full((count + steps, count + steps, axes.planes, entries, entries), np.nan, np.float32)
            for job, solved in done.items():
                part, units = self.jobs[job]
                for unit in range(units + 2 * axes.shift + 1):
                    p, r = unit * steps, (units + 2 * axes.shift - unit) * steps
                    if p < count and r < count:
                        of_unit = solved[:, :, unit + self.shift - axes.shift]
                        if not reflected:
                            of_light[p : p + part + 1, r + part] = of_unit[:, self.first[3] + m + axes.max_order]
                        of_light[p + part, r : r + part + 1] = of_unit[:, self.first[table] + m + axes.max_order]
            p, r = (less * steps for less in axes.least(m))
            found = of_light[p : p + side, r : r + side].astype(float)
            if not axes.shift:
                # At grazing exit or incidence all is mirrored.
                found[0], found[:, 0] = (float(m == 0 and reflected) * np.eye(entries),) * 2
            if reflected:
                # Where p and r have the same fraction, both were solved.
                back = self.signs * found.transpose(1, 0, 2, 4, 3)
                found = np.where(np.isnan(found), back, np.where(np.isnan(back), found, (found + back) / 2))
            found = np.nan_to_num(found)  # units that light does not reach
            refine = _cubic(axes.units(m), steps, axes.steps)
            block = np.einsum("ai,bj,ijkxy->kabxy", refine, refine, found, optimize=True)
            matrices[:, start : start + axes.side(m) ** 2] = block.reshape(axes.planes, -1, entries, entries)
        # Beside a kink the polynomials overshoot.
        eta = matrices[..., :1, :1]
        matrices *= np.divide(np.clip(eta, 0, 1), eta, out=np.zeros_like(eta), where=eta != 0)
        matrices = np.round(matrices / _ROUNDED) * np.float32(_ROUNDED)
        values = np.ascontiguousarray(matrices[..., 0, 0])
        return Table(axes, values, matrices if entries == 4 else None)


def _nodes(count: int, planes: int, local: bool) -> tuple[Real, Real]:
    """Return points in 0 … 1, (count,), and the weights (planes, count) of their values at equal steps.

    Chebyshev–Lobatto points; or, if local, points at equal steps and cubic polynomials of four neighbours: kinks stay
    where they are.
    """
    if count == 1:
        return np.zeros(1), np.ones((planes, 1))
    if local:
        return np.linspace(0, 1, count), _cubic(1, count - 1, planes - 1)
    at = (1 - np.cos(np.pi * np.arange(count) / (count - 1))) / 2
    return at, _lagrange(np.linspace(0, 1, planes), at)


def _lagrange(x: Real, nodes: Real) -> Real:
    """Return (x, nodes): weights of values at the nodes in the polynomial through them."""
    ratio = np.ones((len(x), len(nodes)))
    for j, node in enumerate(nodes):
        others = np.delete(nodes, j)
        ratio[:, j] = np.prod((x[:, None] - others) / (node - others), axis=1)
    return ratio


def _cubic(units: int, steps: int, finer: int) -> Real:
    """Return (finer nodes, nodes): cubic interpolation between nodes, of each unit by its own."""
    matrix = np.zeros((units * finer + 1, units * steps + 1))
    for unit in range(units):
        for fine in range(finer + 1):
            x = fine * steps / finer
            low = int(np.clip(np.floor(x) - 1, 0, steps - 3))
            row = matrix[unit * finer + fine]
            row[:] = 0
            row[unit * steps + low : unit * steps + low + 4] = _lagrange(np.array([x]), np.arange(low, low + 4.0))[0]
    return matrix


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
