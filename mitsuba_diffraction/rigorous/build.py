"""From a height field to the table of its rigorous efficiencies, with a measured error."""

from __future__ import annotations

import hashlib
import os
import warnings
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from ..errors import RequestError
from ..files import whole_file
from ..progress import Progress, silent
from ..settings import SUN_COHERENCE_LENGTH, Settings
from ..surface.heightfield import HeightField
from .axes import LARGEST_PERIOD, STORED, Axes
from .coordinate_transformation import Grating, light_from, scatter
from .curve import Curve, curve_of
from .efficiencies import REVERSED, converge, mueller, one_thread, solve, wave_numbers
from .materials import refractive_index
from .spectrum import RigorousSpectrum

Real = NDArray[np.float64]

# Steps to a unit that are solved, one after the other until the error is kept.
_SOLVED = (8, 16, 32)
PLANES = 17
# Wavelengths that are solved, by the least g λ / T (the cosine of the cone angle) of these: metals in light along the
# grooves show narrow lines that move with the wavelength.
_CONES = ((0.45, 17), (0.7, 9), (1.0, 5))
# An order at exactly grazing exit has no Rayleigh wave.
_OFF = 1e-8
_NEAR = 0.02
_CHECKS = 200
# Light at which the harmonics are chosen: near the normal, and oblique from both sides.
_HARD = ((0.1, 0, 1), (0.8, 0.3, 0.5), (-0.8, 0.3, 0.5))
BUILD_VERSION = 3  # raised when tables of equal requests change
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
    wavelengths = settings.wavelengths
    int_ior, material, ext_ior, polarised = settings.int_ior, settings.material, settings.ext_ior, settings.polarised
    period, longest = height_field.tile_size[0], LARGEST_PERIOD * wavelengths[0] * 1e-3
    if period > longest:
        raise RequestError(
            f"period: got {period:.4g} µm, wanted at most {longest:.4g} µm with theory=rigorous, "
            f"{LARGEST_PERIOD:g} times the shortest wavelength; use theory=scalar"
        )
    with one_thread():
        surface = _Surface(
            height_field,
            (wavelengths[0] * 1e-3, wavelengths[1] * 1e-3),
            lambda wavelength: refractive_index(wavelength * ext_ior, int_ior=int_ior, material=material) / ext_ior,
            tolerance,
            repr((int_ior, material, ext_ior, polarised)),
        )
        checks = surface.checks()
        error, done = np.inf, 0
        for solved in _SOLVED:
            # Twice the steps cost four times as much and leave an eighth of the error: which table will be the last?
            begin, done = done, 95 if error <= 8 * tolerance or solved == _SOLVED[-1] else done + 20
            axes = Axes(surface.period, surface.wavelengths, STORED * solved, PLANES)
            table = _Table(surface, axes, solved, polarised)
            values, matrices = table.values(
                lambda row, rows, a=begin, b=done: progress(a + (b - a) * row // rows, 100), checkpoints
            )
            spectrum = RigorousSpectrum(
                axes=axes,
                values=values,
                material=material or "",
                int_ior=complex(int_ior or 0),
                ext_ior=float(ext_ior),
                mueller=matrices,
                coherence_length=float(settings.coherence_length),
                tolerance=float(tolerance),
                harmonics=surface.harmonics,
                source=height_field.source,
                source_digest=height_field.digest,
                **_errors(axes, values, matrices, checks),
            )
            # NaN: there are no matrices.
            if spectrum.error <= tolerance and not spectrum.polarisation_error > MATRICES * tolerance:
                progress(100, 100)
                return spectrum
            error = spectrum.error
    progress(100, 100)
    got, wanted = f"{spectrum.error:.2g}", f"{tolerance:.2g}"
    if polarised:
        got += f" and {spectrum.polarisation_error:.2g} of the Mueller matrices"
        wanted += f" and {MATRICES * tolerance:.2g}"
    warnings.warn(
        f"rigorous table: got a mean error of {got} with {_SOLVED[-1]} steps to a unit, wanted at most {wanted}",
        stacklevel=4,
    )
    return spectrum


class _Surface:
    """A surface and its material, ready to be solved.

    Attributes:
        harmonics: N, enough for a tenth of the tolerance at the shortest wavelength.
    """

    def __init__(
        self,
        height_field: HeightField,
        wavelengths: tuple[float, float],
        index: Callable[[float], complex],
        tolerance: float,
        named: str,
    ) -> None:
        self.period = height_field.tile_size[0]
        self.wavelengths = wavelengths
        self.index = index
        self.tolerance = tolerance
        curve = curve_of(height_field)
        self.harmonics = max(self._harmonics(curve, np.array(d) / np.linalg.norm(d)) for d in _HARD)
        # The table takes the first; the others are for light that needs more, and for what it is compared with.
        self.gratings = [Grating(curve, int(1.4**k * self.harmonics)) for k in range(5)]
        self.digest = hashlib.sha256(
            repr((height_field.digest, wavelengths, named, self.harmonics, BUILD_VERSION)).encode()
        ).hexdigest()

    def _harmonics(self, curve: Curve, omega: Real) -> int:
        """The fewest harmonics that are right to a tenth of the tolerance, at the shortest wavelength."""
        index, k_0 = self.index(self.wavelengths[0]), self.period / self.wavelengths[0]
        exact = converge(curve, omega, k_0, index, self.tolerance / 20)
        if exact.error > self.tolerance:
            raise RequestError(
                f"height field: got an error of {exact.error:.2g} with {exact.harmonics} harmonics at a wavelength of "
                f"{1e3 * self.wavelengths[0]:.4g} nm, wanted at most {self.tolerance:.2g}; it is too deep for its "
                "period with theory=rigorous"
            )
        # At grazing incidence there are orders up to 2 T/λ.
        count, _ = wave_numbers(curve, k_0, index, 1.0)
        while count < exact.harmonics:
            found = solve(curve, omega, k_0, index, count)
            difference = np.abs(found.unpolarised - exact.unpolarised).sum()
            if max(difference / exact.unpolarised.sum(), found.imbalance) <= self.tolerance / 10:
                break
            count = int(np.ceil(1.1 * count))
        return count

    def solve(
        self, alpha: float, g: float, wavelengths: Iterable[float], finer: int = 0
    ) -> tuple[NDArray[np.int64], Real]:
        """m of the orders, and M_ij, (wavelengths, orders, 4, 4), for k_x = α and g (times period/2π).

        M_00 is η of unpolarised light. The harmonics, those of `gratings[finer]`, are raised where R + T is not one
        within the tolerance, or where R is above one if the material absorbs.

        Raises:
            ValueError: if the largest number of harmonics does not conserve energy either.
        """
        wavelengths = list(wavelengths)
        for grating in self.gratings[finer:]:
            light, found, excess = light_from(grating, alpha, g**2), [], 0.0
            for wavelength in wavelengths:
                k_y, index = np.sqrt(max((self.period / wavelength) ** 2 - g**2, 0)), self.index(wavelength)
                solved = scatter(grating, light, k_y, index)
                total = [(np.abs(a) ** 2).sum(axis=(0, 1)) for a in (solved.reflected, solved.transmitted)]
                beyond = sum(total) - 1
                excess = max(excess, np.max(np.abs(beyond) if index.imag == 0 else beyond))
                found.append(mueller(solved.reflected))
            if excess <= self.tolerance:
                return -solved.orders, np.array(found)
        raise RequestError(
            f"height field: got an excess of {excess:.2g} of the incident light with {grating.harmonics} harmonics at "
            f"{1e3 * wavelengths[0]:.4g} to {1e3 * wavelengths[-1]:.4g} nm, wanted at most {self.tolerance:.2g}; "
            "it is too deep for its period with theory=rigorous"
        )

    def checks(self) -> list[tuple[float, float, float, NDArray[np.int64], Real]]:
        """α, g, λ, m and M_ij at random places, directions uniform over the hemisphere, wavelengths over the range."""
        rng = np.random.default_rng(0)
        checks = []
        for cosine, turn, share in rng.random((_CHECKS, 3)):
            wavelength = self.wavelengths[0] + share * (self.wavelengths[1] - self.wavelengths[0])
            k = np.sqrt(1 - cosine**2) * self.period / wavelength
            alpha, k_y = k * np.cos(2 * np.pi * turn), k * np.sin(2 * np.pi * turn)
            g = np.sqrt((self.period / wavelength) ** 2 - k_y**2)
            m, matrices = self.solve(alpha, g, [wavelength], finer=1)
            checks.append((alpha, g, wavelength, m, matrices[0]))
        return checks


def _errors(
    axes: Axes, values: NDArray[np.float32], mueller: NDArray[np.float32] | None, checks: list
) -> dict[str, float]:
    """`error`, `worst`, `worst_near` and `polarisation_error` of a table."""
    table = RigorousSpectrum(axes, values, "", 1, SUN_COHERENCE_LENGTH, 0.1, 0, 0, 0, 0, "", "", mueller=mueller)
    error, near, split = [], [], []
    for alpha, g, wavelength, m, matrices in checks:
        eta = matrices[:, 0, 0]
        found = table.evaluate(m, alpha - m / 2, g, wavelength)
        if mueller is not None:
            ours = table.evaluate_mueller(m, alpha - m / 2, g, wavelength)
            split.append(np.abs(ours - matrices).max(axis=(1, 2)).sum() / eta.sum())
        error.append(np.abs(found - eta).sum() / eta.sum())
        near.append(min(abs(x - round(x)) for x in (g + alpha, g - alpha)) < _NEAR)
    error, near = np.array(error), np.array(near)
    return {
        "error": float(error.mean()),
        "worst": float(error[~near].max(initial=0)),
        "worst_near": float(error[near].max(initial=0)),
        "polarisation_error": float(np.mean(split)) if split else float("nan"),
    }


class _Table:
    """A lattice of light to be solved, and the way from there to the nodes of `Axes`.

    Light from (p, r) = (g + α, g − α) has order m at P = p − max(m, 0), R = r + min(m, 0): whole units away, so that
    one lattice serves all orders.
    """

    def __init__(self, surface: _Surface, axes: Axes, steps: int, polarised: bool) -> None:
        self.surface, self.axes, self.steps = surface, axes, steps
        self.entries = 4 if polarised else 1  # rows and columns of the matrices that are kept
        self.lattice = axes.solved
        count = self.lattice.side(0)
        nodes = self.lattice.nodes_at(count)
        self.p = np.where(np.arange(count) % steps, nodes, nodes + _OFF)

    def values(
        self, progress: Progress, checkpoints: Path | None
    ) -> tuple[NDArray[np.float32], NDArray[np.float32] | None]:
        """`values` and `mueller` of `RigorousSpectrum`."""
        rows = _Checkpoint(checkpoints, f"{self.surface.digest}-{self.steps}")
        left = [row for row in range(1, len(self.p)) if row not in rows.done]
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            try:
                for row, solved in zip(left, pool.map(self._row, left), strict=True):
                    rows.add(row, solved)
                    progress(len(rows.done), len(self.p) - 1)
            except BaseException:
                pool.shutdown(cancel_futures=True)
                rows.write()
                raise
        values = self._stored(rows.done)
        rows.remove()
        return values

    def _row(self, row: int) -> NDArray[np.float32]:
        """M of all light with this p: (r, orders −M … M, K, i, j); NaN where an order does not propagate."""
        largest, planes, entries = self.axes.largest, self.axes.planes, self.entries
        found = np.full((len(self.p), 2 * largest + 1, planes, entries, entries), np.nan, np.float32)
        # The units that the table reaches, whole, for polynomials across them.
        unit = (row - 1) // self.steps
        reached = range(1, min(len(self.p), (self.lattice.units(0) - unit) * self.steps + 1))
        for column in reached:
            p, r = self.p[row], self.p[column]
            g = (p + r) / 2
            first, last = self.axes.range(g)
            count = 1
            if last > first:
                cone = g * self.axes.wavelengths[0] / self.axes.period
                count = next((count for limit, count in _CONES if cone < limit), _CONES[-1][1])
            at, weights = _chebyshev(count, planes)
            m, solved = self.surface.solve((p - r) / 2, g, first + at * (last - first))
            kept = np.abs(m) <= largest
            matrices = solved[:, kept, :entries, :entries]
            found[column, m[kept] + largest] = np.einsum("kw,wm...->mk...", weights, matrices)
        return found

    def _stored(self, rows: dict[int, NDArray[np.float32]]) -> tuple[NDArray[np.float32], NDArray[np.float32] | None]:
        """What was solved, the mean of light and reversed light, at the nodes that are stored."""
        axes, steps, largest, entries = self.axes, self.steps, self.axes.largest, self.entries
        matrices = np.zeros((axes.planes, axes.nodes, entries, entries), np.float32)
        signs = np.outer(REVERSED, REVERSED)[:entries, :entries]
        for m in axes.orders:
            side, solved = axes.side(m), self.lattice.side(m)
            found = np.full((solved, solved, axes.planes, entries, entries), np.nan)
            for row, of_row in rows.items():
                p = row - max(m, 0) * steps
                # A node at the end of two units was solved just inside the one where the order travels.
                if 0 < p < solved:
                    part = of_row[-min(m, 0) * steps :, m + largest][:solved]
                    found[p, 1 : len(part)] = part[1:]
            # At grazing exit or incidence all is mirrored.
            found[0], found[:, 0] = (float(m == 0) * np.eye(entries),) * 2
            reversed_ = signs * found.transpose(1, 0, 2, 4, 3)
            both = np.where(np.isnan(found), reversed_, np.where(np.isnan(reversed_), found, (found + reversed_) / 2))
            both = np.nan_to_num(both)  # units that light does not reach
            refine = _cubic(axes.units(m), steps, axes.steps)
            block = np.einsum("ai,bj,ijkxy->kabxy", refine, refine, both, optimize=True)
            start = axes.offset(m)
            matrices[:, start : start + side**2] = block.reshape(axes.planes, -1, entries, entries)
        # Beside a kink the polynomials overshoot.
        eta = matrices[..., :1, :1]
        matrices *= np.divide(np.clip(eta, 0, 1), eta, out=np.zeros_like(eta), where=eta != 0)
        return np.ascontiguousarray(matrices[..., 0, 0]), matrices if entries == 4 else None


def _chebyshev(count: int, planes: int) -> tuple[Real, Real]:
    """Chebyshev–Lobatto points in 0 … 1, (count,), and the weights (planes, count) of their values at equal steps."""
    if count == 1:
        return np.zeros(1), np.ones((planes, 1))
    at = (1 - np.cos(np.pi * np.arange(count) / (count - 1))) / 2
    return at, _lagrange(np.linspace(0, 1, planes), at)


def _lagrange(x: Real, nodes: Real) -> Real:
    """(x, nodes): weights of values at the nodes in the polynomial through them."""
    ratio = np.ones((len(x), len(nodes)))
    for j, node in enumerate(nodes):
        others = np.delete(nodes, j)
        ratio[:, j] = np.prod((x[:, None] - others) / (node - others), axis=1)
    return ratio


def _cubic(units: int, steps: int, finer: int) -> Real:
    """(finer nodes, nodes): cubic interpolation between nodes, of each unit by its own."""
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
        self._unwritten = 0
        if self.path and self.path.is_file():
            try:
                with open(self.path, "rb") as stream, np.load(stream) as file:
                    self.done = {int(row): file[row] for row in file.files}
            except (OSError, ValueError, EOFError, KeyError, BadZipFile):
                self.path.unlink(missing_ok=True)

    def add(self, row: int, values: NDArray[np.float32]) -> None:
        self.done[row] = values
        self._unwritten += 1
        if self._unwritten >= 8:
            self.write()

    def write(self) -> None:
        # A checkpoint only saves time: a folder that cannot be written to is no reason to stop.
        with suppress(OSError):
            if self.path:
                self.path.parent.mkdir(parents=True, exist_ok=True)
                with whole_file(self.path) as temporary, open(temporary, "wb") as file:
                    np.savez(file, **{str(row): values for row, values in self.done.items()})
        self._unwritten = 0

    def remove(self) -> None:
        with suppress(OSError):
            if self.path:
                self.path.unlink(missing_ok=True)
