"""From a height field to the table of its rigorous efficiencies, with a measured error."""

from __future__ import annotations

import functools
import hashlib
import itertools
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from ..array_types import Real
from ..errors import RequestError
from ..files.writing import whole_file
from ..machine import usable_cores
from ..optics.media import MediumBelow
from ..progress import Progress, silent, stage
from ..settings import RigorousSettings
from ..surface.heightfield import HeightField
from .coordinate_transformation import (
    ABOVE,
    BELOW,
    Curve,
    CurveMatrices,
    HalfSpace,
    Scattered,
    curve_of,
    half_space,
    scatter,
)
from .rigorous_spectrum import (
    MAX_PERIOD_IN_WAVELENGTHS,
    Axes,
    RigorousSpectrum,
    fractions_at_nodes,
    interval_bounds,
    rank,
)
from .solver import (
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

# n of the incident and of the outgoing orders, and their matrices, (outgoing orders, incident orders, 4, 4).
_Orders = tuple[NDArray[np.int64], NDArray[np.int64], NDArray[Any]]
# α, g, λ, whether an order is near its Rayleigh anomaly, and (side of incidence, side of exit) → m and M_ij, (n, 4, 4).
_Check = tuple[float, float, float, bool, dict[tuple[int, int], tuple[NDArray[np.int64], Real]]]

# Steps of F, X and (with transmission) Z at which Maxwell's equations are solved; the first that keeps the tolerance is
# taken. X needs most, as it resolves transmission at grazing incidence; F resolves the narrow plasmons of metals.
SOLVED_STEPS = ((12, 15, 12), (18, 24, 18))
# With transmission, solutions take most of the time: the table stores a third more steps, and at least these, of cubic
# polynomials. For large periods the first entry is enough.
SOLVED_STEPS_TRANSMISSION = ((4, 6, 4), (6, 9, 6), (9, 15, 9), (12, 18, 12))
_MIN_STORED_STEPS = 8, 12, 8
WAVELENGTH_NODES = 17
_FIT_POINTS = 20  # per stored step, of the least-squares fit of a table to its polynomials
# (largest g λ / T, number of solved wavelengths). g λ / T is the cosine of the cone angle: with incidence along the
# grooves, metals show narrow lines that move with the wavelength.
_SOLVED_WAVELENGTHS = ((0.45, 17), (0.7, 9), (1.0, 5))
# η is stored as multiples of this, which halves the size of files.
_ETA_STEP = 2.0**-16
# Distance of the first and the last node from 0 and 1, in sin²: an order at exactly grazing exit has no Rayleigh wave.
_MIN_FRACTION = 1e-12
_MIN_SQUARE = 1e-8  # |γ²|
_MIN_K_Y = 1e-4  # matrices are divided by k_y
_MAX_ANOMALY_DISTANCE = 0.02  # of P or R from an integer, near a Rayleigh anomaly
CHECK_COUNT = 200
_PAIR_WORK = 0.2  # of matching a field above and one below, in units of the eigenproblem of one field; measured
_CHECKPOINT_SECONDS = 20.0  # between checkpoints, each of which is written as a whole
# Directions for which the harmonics are chosen: near the normal, and oblique from both sides.
_HARMONICS_DIRECTIONS = ((0.1, 0, 1), (0.8, 0.3, 0.5), (-0.8, 0.3, 0.5))
BUILD_VERSION = 9  # raised when tables of equal requests change
MAX_POLARISATION_ERROR = 3.0
"""Bound of `polarisation_error`, in tolerances: matrices vary faster than η."""


def build_rigorous(
    height_field: HeightField,
    settings: RigorousSettings,
    progress: Progress = silent,
    checkpoints: Path | None = None,
) -> RigorousSpectrum:
    """Compute the table of a surface of one row.

    Args:
        height_field: the surface; rows that differ are refused.
        settings: of rigorous theory. The tolerance bounds `RigorousSpectrum.error` and a third of `polarisation_error`.
        progress: called with (per cent done, 100) of the work of one table. It starts again if a finer table is needed,
            which is known only after the error of the first table.
        checkpoints: a folder for intermediate results, from which an interrupted build resumes.

    Raises:
        ValueError: if the material is unknown, the period exceeds ten times the shortest wavelength, or the profile is
            too deep for efficiencies that converge and conserve energy within the tolerance.

    Warns:
        UserWarning: if `error` of the finest table exceeds the tolerance, or `polarisation_error` three times that.
    """
    tolerance = 1e-2 if settings.tolerance is None else settings.tolerance
    name = settings.material or (settings.int_ior if isinstance(settings.int_ior, str) else None)
    stored = replace(settings, tolerance=float(tolerance))
    if name:
        stored = replace(stored, material=Path(name).name, int_ior=None)
    period = height_field.tile_size[0]
    max_period = MAX_PERIOD_IN_WAVELENGTHS * settings.wavelengths[0] * 1e-3
    if period > max_period:
        raise RequestError(
            f"period: got {period:.4g} µm, wanted at most {max_period:.4g} µm with theory=rigorous, "
            f"{MAX_PERIOD_IN_WAVELENGTHS:g} times the shortest wavelength; use theory=scalar"
        )
    with one_thread():
        with stage("reference solutions"):
            relief = _SolvedRelief(height_field, settings, tolerance)
            checks = relief.checks()
        steps = SOLVED_STEPS if settings.transmission == "none" else SOLVED_STEPS_TRANSMISSION
        for number, solved in enumerate(steps, 1):
            with stage(f"table {number} of at most {len(steps)}"):
                build = _CoarseSolver(relief, solved, settings.polarised)
                values, mueller = build.table(progress, checkpoints)
            spectrum = RigorousSpectrum(
                axes=build.axes,
                values=values,
                mueller=mueller,
                settings=stored,
                index_digest=relief.below.digest if name else "",
                harmonics=relief.harmonics,
                source=height_field.source,
                source_digest=height_field.digest,
                **dict.fromkeys(("error", "max_error", "max_error_near"), np.nan),
            )
            spectrum = replace(spectrum, **_errors(spectrum, checks))
            # `polarisation_error` is NaN without matrices.
            if spectrum.error <= tolerance and not spectrum.polarisation_error > MAX_POLARISATION_ERROR * tolerance:
                return spectrum
    got, wanted = f"{spectrum.error:.2g}", f"{tolerance:.2g}"
    if settings.polarised:
        got += f" and {spectrum.polarisation_error:.2g} of the Mueller matrices"
        wanted += f" and {MAX_POLARISATION_ERROR * tolerance:.2g}"
    warnings.warn(
        f"rigorous table: got a mean error of {got} with {max(steps[-1])} steps per interval, wanted at most {wanted}",
        stacklevel=4,
    )
    return spectrum


def medium_below(settings: RigorousSettings) -> MediumBelow:
    """Return the medium below the surface of a table, which a scene does not know: there is no default.

    Raises:
        RequestError: as `MediumBelow.of`, or if there is none, or it is the perfect mirror.
    """
    if settings.material is None and settings.int_ior is None:
        raise RequestError("int_ior, material: got neither with theory=rigorous, wanted one of the two")
    below = MediumBelow.of(settings.material, settings.int_ior)
    below.check_theory(settings.theory)
    return below


class _SolvedRelief:
    """A relief, the medium below it and the solver for them.

    Attributes:
        below: n + ik below.
        harmonics: N, which keeps a tenth of the tolerance at the shortest wavelength.
    """

    def __init__(self, height_field: HeightField, settings: RigorousSettings, tolerance: float) -> None:
        self.period = height_field.tile_size[0]
        self.wavelengths = settings.wavelengths[0] * 1e-3, settings.wavelengths[1] * 1e-3
        index = medium_below(settings).index
        assert index is not None
        self.below, self.ext_ior = index, settings.ext_ior
        self.tolerance = tolerance
        self.transmission = settings.transmission
        curve = curve_of(height_field)
        self.harmonics = max(self._harmonics(curve, np.array(d) / np.linalg.norm(d)) for d in _HARMONICS_DIRECTIONS)
        # The table uses the first. The others serve light that needs more harmonics, and the checks.
        self.gratings = [CurveMatrices(curve, int(1.4**k * self.harmonics)) for k in range(5)]
        media = self.below.digest, settings.ext_ior, self.transmission
        request = height_field.digest, self.wavelengths, media, settings.polarised, self.harmonics, BUILD_VERSION
        self.digest = hashlib.sha256(repr(request).encode()).hexdigest()

    def index(self, wavelength: float) -> complex:
        """Return n + ik below, relative to the medium above, for a wavelength in µm in the medium above."""
        return complex(self.below(wavelength * self.ext_ior)) / self.ext_ior

    def _harmonics(self, curve: Curve, omega: Real) -> int:
        """Return the smallest N that keeps a tenth of the tolerance at the shortest wavelength."""
        index, k_0 = self.index(self.wavelengths[0]), self.period / self.wavelengths[0]
        exact = converge(curve, omega, k_0, index, self.tolerance / 20)
        if exact.error > self.tolerance:
            raise RequestError(
                f"height field: got an error of {exact.error:.2g} with {exact.harmonics} harmonics at a wavelength of "
                f"{1e3 * self.wavelengths[0]:.4g} nm, wanted at most {self.tolerance:.2g}; it is too deep for its "
                "period with theory=rigorous"
            )
        # At grazing incidence orders propagate up to 2 T/λ.
        count, _ = wave_numbers(curve, k_0, index, np.array([1.0, 0.0, 0.0]))
        while count < exact.harmonics:
            found = solve(curve, omega, k_0, index, count)
            difference = np.abs(found.unpolarised - exact.unpolarised).sum()
            if max(difference / exact.unpolarised.sum(), found.imbalance) <= self.tolerance / 10:
                break
            count = int(np.ceil(1.1 * count))
        return count

    def light(self, square: float, wavelength: float) -> tuple[float, complex]:
        """Return ν² and γ'² for γ² = `square`."""
        nu2, index = (self.period / wavelength) ** 2, self.index(wavelength)
        return nu2, square + nu2 * ((index.real**2 if index.imag == 0 else index**2) - 1)

    def solve(
        self,
        alpha: float,
        square: float,
        lights: Iterable[tuple[float, complex]],
        finer: int = 0,
        fields: Callable[[CurveMatrices, float, complex, bool], HalfSpace] = half_space,
    ) -> list[Scattered]:
        """Solve for light of all orders from above and below, for each (ν², γ'²).

        The number of harmonics begins at its value for `gratings[finer]`. It is raised while R + T differs from one by
        more than the tolerance; if the material absorbs, while R exceeds one.

        Args:
            alpha: α of order 0, in units of 2π/T.
            square: γ², in units of (2π/T)².
            lights: pairs of ν² and γ'².
            finer: index of the first of `gratings` to try.
            fields: `half_space`, or a cached form of it.
        """
        lights = list(lights)
        for grating in self.gratings[finer:]:
            found, excess = [], 0.0
            above = fields(grating, alpha, square, True)
            for nu2, square_below in lights:
                index = self.index(self.period / np.sqrt(nu2))
                k_y = np.emath.sqrt(nu2 - square)
                k_y = k_y if abs(k_y) > _MIN_K_Y else _MIN_K_Y
                solved = scatter(alpha + grating.n, above, fields(grating, alpha, square_below, False), k_y, index)
                for of_side in solved.amplitudes:
                    imbalance = np.asarray(sum(solved.powers(a).sum(axis=(0, 1)) for a in of_side)) - 1
                    excess = max(excess, np.max(np.abs(imbalance) if index.imag == 0 else imbalance, initial=0))
                found.append(solved)
            if excess <= self.tolerance:
                return found
        shortest, longest = (1e3 * self.period / np.sqrt(limit(nu2 for nu2, _ in lights)) for limit in (max, min))
        raise RequestError(
            f"height field: got an excess of {excess:.2g} of the incident light with {grating.harmonics} harmonics at "
            f"{shortest:.4g} to {longest:.4g} nm, wanted at most {self.tolerance:.2g}; it is too deep for its period "
            "with theory=rigorous"
        )

    def matrices(self, solved: Scattered, entries: int = 4) -> dict[tuple[int, int], _Orders]:
        """Return the orders and their matrices by (side of incidence, side of exit).

        Returns:
            n of the incident orders, n of the outgoing ones, and M_ij, (outgoing, incident, entries, entries); with one
            entry η. Where k_y is imaginary, the elements that are odd in k_y are imaginary, too.
        """
        orders = solved.orders
        found: Mapping[tuple[int, int], NDArray[Any]]
        if self.transmission == "sheet":
            orders = orders[ABOVE], orders[ABOVE]
            found = through_sheet(solved, self.index(self.wavelengths[0]).real)
        else:
            sides = (ABOVE,) if self.transmission == "none" else (ABOVE, BELOW)
            compute = unpolarised if entries == 1 else matrices_of
            found = {(i, o): compute(solved, i, o) for i, o in itertools.product(sides, sides)}
        return {(i, o): (orders[i], orders[o], m[..., :entries, :entries]) for (i, o), m in found.items()}

    def checks(self) -> list[_Check]:
        """Solve at random directions, uniform over the hemispheres, and wavelengths, uniform over the range."""
        rng = np.random.default_rng(0)
        checks = []
        for number, (cosine, turn, fraction) in enumerate(rng.random((CHECK_COUNT, 3))):
            wavelength = self.wavelengths[0] + fraction * (self.wavelengths[1] - self.wavelengths[0])
            side = BELOW if self.transmission != "none" and number % 2 else ABOVE
            in_medium = side == BELOW and self.transmission == "interface"
            nu, n = self.period / wavelength, self.index(wavelength).real if in_medium else 1.0
            k = np.sqrt(1 - cosine**2) * n * nu
            alpha, k_y = k * np.cos(2 * np.pi * turn), k * np.sin(2 * np.pi * turn)
            g = np.sign(nu - abs(k_y)) * np.sqrt(abs(nu**2 - k_y**2))
            square = g * abs(g)
            (solved,) = self.solve(alpha, square, [self.light(square, wavelength)], finer=1)
            orders = {
                sides: (-outgoing, matrices[:, incident == 0][:, 0].real)
                for sides, (incident, outgoing, matrices) in self.matrices(solved).items()
                if sides[0] == side
            }
            near = g > 0 and min(abs(x - round(x)) for x in (g + alpha, g - alpha)) < _MAX_ANOMALY_DISTANCE
            checks.append((alpha, g, wavelength, bool(near), orders))
        return checks


def _errors(spectrum: RigorousSpectrum, checks: list[_Check]) -> dict[str, Any]:
    """Return `error`, `max_error`, `max_error_near` and `polarisation_error` of a table."""
    errors, polarisation_error = [], []
    for alpha, g, wavelength, _, orders in checks:
        total, difference, matrix_difference = 0.0, 0.0, 0.0
        for sides, (m, matrices) in orders.items():
            arguments = m, alpha - m / 2, g, wavelength, sides
            eta = matrices[:, 0, 0]
            total += eta.sum()
            difference += np.abs(spectrum.evaluate(*arguments) - eta).sum()
            if spectrum.mueller is not None:
                difference_ij = spectrum.evaluate(*arguments, mueller=True) - matrices
                matrix_difference += np.abs(difference_ij).max(axis=(1, 2)).sum()
        errors.append(difference / total)
        polarisation_error.append(matrix_difference / total)
    error, near = np.array(errors), np.array([check[3] for check in checks])
    return {
        "error": float(error.mean()),
        "max_error": float(error[~near].max(initial=0)),
        "max_error_near": float(error[near].max(initial=0)),
        "polarisation_error": float("nan") if spectrum.mueller is None else float(np.mean(polarisation_error)),
    }


class _CoarseSolver:
    """Solver on a coarser grid than `Axes`, for all orders of light from above and below together.

    The fields above depend on a and γ alone, the fields below on a and γ'. Each is the solution of one eigenproblem,
    which takes most of the time. With transmission a lattice of γ and one of γ' serve all of their pairs.
    """

    def __init__(self, relief: _SolvedRelief, steps: tuple[int, int, int], polarised: bool) -> None:
        self.relief, self.steps = relief, steps
        self.entries = 4 if polarised else 1  # rows and columns of the matrices that are kept
        self.transmits = relief.transmission != "none"
        f, x, z = steps
        if self.transmits:
            f, x, z = (max(4 * n // 3, min_steps) for n, min_steps in zip(steps, _MIN_STORED_STEPS, strict=True))
        index = relief.index(relief.wavelengths[0]).real if self.transmits else 0.0
        stored_steps = f, x, z if self.transmits else WAVELENGTH_NODES - 1
        self.axes = Axes(relief.period, relief.wavelengths, stored_steps, index, relief.transmission)
        self.fractions = [np.clip(t, _MIN_FRACTION, 1 - _MIN_FRACTION) for t in fractions_at_nodes(steps)]
        self.jobs = [(a, intervals) for a in self.fractions[0] / 2 for intervals in self.axes.blocks]
        # Holds the fields of two values of a, as one thread may be ahead of the others.
        self.fields = functools.lru_cache(maxsize=2 * int(np.dot(self.axes.starts.shape, steps[1:])))(half_space)

    def table(self, progress: Progress, checkpoints: Path | None) -> tuple[NDArray[np.float32], Any]:
        """Return `values` and `mueller` of `RigorousSpectrum`."""
        done = _Checkpoint(checkpoints, f"{self.relief.digest}-{max(self.steps)}")
        remaining = [job for job in range(len(self.jobs)) if job not in done.done]
        solve = self._job if self.transmits else self._planes
        work = self.work()
        total = sum(work)
        finished = sum(work[job] for job in done.done)
        with ThreadPoolExecutor(usable_cores()) as pool:
            try:
                for job, solved in zip(remaining, pool.map(solve, remaining), strict=True):
                    done.add(job, solved)
                    finished += work[job]
                    progress(int(100 * finished / total + 1e-6), 100)
            except BaseException:
                pool.shutdown(cancel_futures=True)
                done.write()
                raise
        stored = self._stored(done.done)
        done.remove()
        return stored

    def work(self) -> list[float]:
        """Return about the work of each job, in eigenproblems, to foretell the time that is left.

        A field that several jobs share counts in the first of them.
        """
        works, known = [], set[tuple[float, float, bool]]()
        for job, (a, _) in enumerate(self.jobs):
            if self.transmits:
                pairs = {squares for *_, squares in self._pairs(job)}
                fields = {
                    (a, square, above) for pair in pairs for square, above in zip(pair, (True, False), strict=True)
                }
                works.append(len(fields - known) + _PAIR_WORK * len(pairs))
                known |= fields
            else:
                counts = [len(self._wavelengths(square)[0]) for square in set(self._squares(job))]
                works.append(len(counts) + (1 + _PAIR_WORK) * sum(counts))
        return works

    def _pairs(self, job: int) -> Iterator[tuple[int, int, tuple[float, float]]]:
        """Return the indices along X and Z and (γ², γ'²) of each node of a job that is solved."""
        a, (above, below) = self.jobs[job]
        axes = self.axes
        low, low_below = (float(interval_bounds(j, a, 0.0)[0]) for j in (above, below))
        for (x, t_x), (z, t_z) in itertools.product(*(enumerate(fractions) for fractions in self.fractions[1:])):
            square = _square_in(above, a, t_x, low_below - axes.excess_limit)
            square_below = _square_in(below, a, t_z, low + axes.excess_limit)
            nu2 = (square_below - square) / axes.excess
            # Nodes outside the range of light are solved, too: without them the polynomials of their neighbours err.
            if nu2 >= max((axes.period / axes.wavelengths[1]) ** 2, square) / 64:
                yield x, z, (square, square_below)

    def _job(self, job: int) -> NDArray[np.float32]:
        """Return M at one a in one block, (incident, outgoing, X, Z, i, j); 0 at nodes that are not solved."""
        a, intervals = self.jobs[job]
        counts = self.axes.counts(*intervals)
        nodes = [len(fractions) for fractions in self.fractions[1:]]
        found = np.zeros((sum(counts), sum(counts), *nodes, self.entries, self.entries))
        # All nodes of an interval that shrinks to a point coincide.
        known: dict[tuple[float, float], NDArray] = {}
        for x, z, squares in self._pairs(job):
            if squares not in known:
                square, square_below = squares
                nu2 = (square_below - square) / self.axes.excess
                (solved,) = self.relief.solve(a, square, [(nu2, square_below)], fields=self.fields)
                known[squares] = self._matrices(solved, counts)
            found[:, :, x, z] = known[squares]
        return found.astype(np.float32)

    def _squares(self, job: int) -> list[float]:
        """Return γ² at the nodes along X of a job where Z is the wavelength."""
        a, (above, _) = self.jobs[job]
        return [_square_in(above, a, t_x, 0.0) for t_x in self.fractions[1]]

    def _wavelengths(self, square: float) -> tuple[Real, Real]:
        """Return the wavelengths that are solved for γ² = `square`, and the weights from these to the nodes."""
        g = np.sqrt(square)
        shortest, longest = self.axes.range(g)
        count = 1
        if longest > shortest:
            counts = (count for limit, count in _SOLVED_WAVELENGTHS if g < limit * self.axes.max_nu)
            count = next(counts, _SOLVED_WAVELENGTHS[-1][1])
        at, weights = _nodes(count)
        return shortest + at * (longest - shortest), weights

    def _planes(self, job: int) -> NDArray[np.float32]:
        """Return the result of `_job` where Z is the wavelength."""
        a, (above, _) = self.jobs[job]
        relief, planes, squares = self.relief, list[Any](), self._squares(job)
        for square, previous in zip(squares, [None, *squares], strict=False):
            if square == previous:
                planes.append(planes[-1])
                continue
            wavelengths, weights = self._wavelengths(square)
            lights = [relief.light(square, wavelength) for wavelength in wavelengths]
            solved = [self._matrices(found, self.axes.counts(above, 0)) for found in relief.solve(a, square, lights)]
            planes.append(np.einsum("kw,wnm...->nmk...", weights, solved))
        return np.stack(planes, axis=2).astype(np.float32)

    def _matrices(self, solved: Scattered, counts: tuple[int, int]) -> Real:
        """Return M, odd elements divided by k_y/ν, (incident, outgoing, i, j), in the order of the rows of `Axes`."""
        found = np.zeros((sum(counts),) * 2 + (self.entries,) * 2)
        for (side_i, side_o), (incident, outgoing, matrices) in self.relief.matrices(solved, self.entries).items():
            if self.entries > 1:
                matrices = matrices / np.where(ODD, solved.k_y / solved.k_0, 1)
            incident, outgoing = rank(incident), rank(outgoing)
            kept_i, kept_o = incident < counts[side_i], outgoing < counts[side_o]
            rows, columns = incident[kept_i] + side_i * counts[0], outgoing[kept_o] + side_o * counts[0]
            found[np.ix_(rows, columns)] = matrices[np.ix_(kept_o, kept_i)].swapaxes(0, 1).real
        return found

    def _stored(self, done: dict[int, NDArray[np.float32]]) -> tuple[NDArray[np.float32], Any]:
        """Return the solutions interpolated to the nodes of the table."""
        axes, entries, blocks = self.axes, self.entries, len(self.axes.blocks)
        matrices = np.empty((*axes.shape, entries, entries), np.float32)
        # A wavelength axis already has its final nodes.
        steps = list(zip(self.steps, axes.steps, strict=True))[: 3 if self.transmits else 2]
        refine = [_fitted(functools.partial(_cubic, solved), stored) for solved, stored in steps]
        refine += [] if self.transmits else [np.eye(WAVELENGTH_NODES)]
        signs = np.outer(REVERSED, REVERSED)[:entries, :entries]
        for block, (intervals, row) in enumerate(axes.blocks.items()):
            solved = np.stack([done[job] for job in range(block, len(self.jobs), blocks)])
            for index_a, shift in ((0, 1), (-1, 0)):
                # At a = 0 and a = 1/2 the table holds light and reversed light: orders n and −n, or n and −n − 1.
                orders, offset = [], 0
                for count in axes.counts(*intervals):
                    mirrored = np.maximum(((np.arange(count) + shift) ^ 1) - shift, 0)
                    orders.append(np.where(mirrored < count, mirrored + offset, -1))
                    offset += count
                order = np.concatenate(orders)
                reverse = signs * solved[index_a][np.ix_(order, order)].transpose(1, 0, 2, 3, 5, 4)
                both = np.logical_and.outer(order >= 0, order >= 0)[..., None, None, None, None]
                solved[index_a] = np.where(both, (solved[index_a] + reverse) / 2, solved[index_a])
            found = np.einsum("ax,by,cz,xnmyz...->nmabc...", *refine, solved, optimize=True)
            # Polynomials overshoot beside a kink.
            eta = found[..., :1, :1]
            found *= np.divide(np.clip(eta, 0, 1), eta, out=np.zeros_like(eta), where=eta != 0)
            count = found.shape[0] ** 2
            matrices[row : row + count] = (np.round(found / _ETA_STEP) * _ETA_STEP).reshape(count, *matrices.shape[1:])
        return np.ascontiguousarray(matrices[..., 0, 0]), matrices if entries == 4 else None


def _square_in(interval: int, a: float, t: float, min_square: float) -> float:
    """Return γ² at the fraction t of an interval; the same for all t if the interval is a point."""
    low, high = (float(x) for x in interval_bounds(interval, np.asarray(a), min_square))
    square = low + (high - low) * (t if high - low > 1e-6 else 0.5)
    # A field that neither propagates nor decays has no admittance.
    return square if abs(square) > _MIN_SQUARE else _MIN_SQUARE if interval else -_MIN_SQUARE


@functools.cache
def _nodes(count: int) -> tuple[Real, Real]:
    """Return Chebyshev–Lobatto points in [0, 1], (count,), and weights from these to equal steps, (nodes, count)."""
    at = (1 - np.cos(np.pi * np.arange(count) / max(count - 1, 1))) / 2
    return at, _fitted(lambda x: _lagrange(x, at), WAVELENGTH_NODES - 1)


def _lagrange(x: Real, nodes: Real) -> Real:
    """Return the weights, (x, nodes), of values at the nodes in the polynomial through them."""
    others = [np.delete(nodes, j) for j in range(len(nodes))]
    factors = [(x[:, None] - other) / (node - other) for node, other in zip(nodes, others, strict=True)]
    return np.stack([factor.prod(axis=1) for factor in factors], axis=1)


def _cubic(steps: int, x: Real) -> Real:
    """Return the weights, (x, steps + 1), of cubic interpolation between four neighbours, x from 0 to 1."""
    low = np.clip((x * steps).astype(int) - 1, 0, steps - 3)
    matrix = np.zeros((len(x), steps + 1))
    matrix[np.arange(len(x))[:, None], low[:, None] + np.arange(4)] = _lagrange(x * steps - low, np.arange(4.0))
    return matrix


def _fitted(polynomials: Callable[[Real], Real], steps: int) -> Real:
    """Return the weights, (steps + 1, solved nodes), of the least-squares fit of a linear table to polynomials.

    Linear interpolation between values of a polynomial has the r.m.s. error h² |f''| / √120 with steps h; the fit has
    1/√6 of that. It is exact at the ends, where tables of adjacent intervals meet.
    """
    x = (np.arange(_FIT_POINTS * steps) + 0.5) / (_FIT_POINTS * steps)
    hats = np.maximum(1 - np.abs(steps * x[:, None] - np.arange(steps + 1)), 0)
    ends = polynomials(np.array([0.0, 1.0]))
    rest = polynomials(x) - hats[:, [0, -1]] @ ends
    return np.vstack([ends[:1], np.linalg.lstsq(hats[:, 1:-1], rest, rcond=None)[0], ends[1:]])


class _Checkpoint:
    """Finished jobs, in memory and, at intervals, in a file."""

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
        if time.monotonic() > self._written + _CHECKPOINT_SECONDS:
            self.write()

    def write(self) -> None:
        # A checkpoint only saves time: failure to write it does not stop the build.
        with suppress(OSError):
            if self.path:
                self.path.parent.mkdir(parents=True, exist_ok=True)
                with whole_file(self.path) as temporary, open(temporary, "wb") as file:
                    arrays: dict[str, Any] = {str(row): values for row, values in self.done.items()}
                    np.savez(file, **arrays)
        self._written = time.monotonic()

    def remove(self) -> None:
        with suppress(OSError):
            if self.path:
                self.path.unlink(missing_ok=True)
