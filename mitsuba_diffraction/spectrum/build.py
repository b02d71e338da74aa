"""From a height field to its power spectrum, within a tolerance."""

from __future__ import annotations

import dataclasses
import hashlib
import warnings
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, cast

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from ..errors import RequestError
from ..progress import Progress, part, stage
from ..settings import CONTINUUM_TOLERANCE, ORDERS_TOLERANCE, SERIES, ScalarSettings, lobe_width
from ..surface.heightfield import HeightField
from .grids import LobeAxis, OrderGrid, inner
from .power_spectrum import PowerSpectrum
from .sample import SamplePowers, effective_coherence_length, standard_error
from .tables import (
    AmplitudeTable,
    SliceTable,
    halved,
    intervals_for,
    packed,
    series_function,
    series_weights,
    to_polynomial,
)
from .tile import TilePowers, TileSplines

# Fractions of the tolerance; the bounds of interpolation are not reached, so that together they may exceed one.
_TRUNCATION_FRACTION = 0.1  # for weak frequencies that are left out
_SPLINE_FRACTION = 0.4  # for interpolation between the nodes in q
_INTERPOLATION_FRACTION = 0.9  # for interpolation in κ
# ∫|ΔS| dq of quadratic splines is this times the third power of their spacing in σ_q, for a Gaussian lobe.
_SPLINE_ERROR, _MAX_SPACING = 0.017, 0.74
_SERIES_FRACTION = 0.7  # by which a series of the amplitude is truncated
# The error is measured at as many κ as this number of Fourier transforms allows, but at least at `_MIN_MEASURED`.
_MAX_TRANSFORMS, _MIN_MEASURED = 400, 8
_MEASURED_FRACTION = 0.95  # of the maximum error over κ: that of those measured, but see `_TableBuilder._measured`
_MAX_UNPACKED_NODES = 2_000  # up to which the nodes of one κ fit unpacked into the first-level cache
MAX_TABLE_BYTES = 4e9

Splines = SamplePowers | TileSplines


def build_power_spectrum(patches: Sequence[HeightField], settings: ScalarSettings, progress: Progress) -> PowerSpectrum:
    """Compute the mean power spectrum of the phase e^{iκh} of patches of one size; raises and warns as `precompute`."""
    height_field = patches[0]
    height_range = max(patch.height_range for patch in patches)
    coherence_length, tolerance = settings.coherence_length, settings.tolerance
    shortest = settings.wavelengths[0] * 1e-3
    max_kappa = 4 * np.pi / shortest
    max_frequency = 2 * np.sin(np.deg2rad(settings.largest_angle)) / shortest
    _check_resolution(height_field, max_frequency)
    effective, found_error, tail = float(coherence_length), None, 0.0
    powers: TilePowers | Splines | None
    series = settings.representation in SERIES
    if settings.extent == "tile":
        sigma = lobe_width(effective)
        if tolerance is None:
            tolerance = _default_tolerance(height_field, len(patches), sigma)
        rho = dataclasses.replace(settings, tolerance=tolerance).lobe_cutoff
        orders = TilePowers(patches, max_frequency, rho * sigma, not series and tolerance >= CONTINUUM_TOLERANCE)
        lobes = orders.grid.lobes(sigma, rho)
        powers = None if series else _tile_splines(orders, lobes, sigma, max_frequency, tolerance)
        if powers is None:
            powers, tail = orders, 2 * (1 - lobes[0].inside * lobes[1].inside)
    else:
        tolerance = CONTINUUM_TOLERANCE if tolerance is None else tolerance
        effective = effective_coherence_length(height_field, coherence_length)
        with stage("standard error"):
            progress(1, 100)
            found_error = standard_error(
                height_field, coherence_length=effective, max_kappa=max_kappa, max_frequency=max_frequency
            )
        progress = part(progress, 0.1, 1)
        if effective < coherence_length * (1 - 1e-9):
            x, y = height_field.tile_size
            warnings.warn(
                f"coherence_length: a scan of {x:.4g} × {y:.4g} µm supports {effective:.4g} µm of the requested "
                f"{coherence_length:.4g} µm; the lobes are as wide as the scan allows",
                stacklevel=4,
            )
        powers = SamplePowers(height_field, effective, _spline_spacing(tolerance, lobe_width(effective)), max_frequency)
    build = _TableBuilder(powers, height_range, max_kappa, tolerance - tail, progress)
    table: SliceTable | AmplitudeTable
    table, error = build.series(height_field.heights, settings) if series else build()
    source, source_digest = height_field.source, height_field.digest
    if len(patches) > 1:
        source = f"mean of {len(patches)} patches: {source}, …"
        source_digest = hashlib.sha256("".join(patch.digest for patch in patches).encode()).hexdigest()
    return PowerSpectrum(
        table=table,
        grid=build.kept,
        # Settings that do not affect the table are left at their defaults, as in files.
        settings=ScalarSettings(
            extent=settings.extent,
            coherence_length=effective,
            wavelengths=settings.wavelengths,
            largest_angle=float(settings.largest_angle),
            representation=table.representation,
            tolerance=float(tolerance),
            terms=len(table.terms) if isinstance(table, AmplitudeTable) else None,
            heights_from=settings.heights_from,
        ),
        pixel_size=height_field.pixel_size,
        height_range=height_range,
        error=error + tail,
        source=source,
        source_digest=source_digest,
        patches=len(patches),
        truncated_power=build.truncated_power,
        unresolved_power=build.unresolved_power,
        standard_error=found_error,
    )


def _default_tolerance(height_field: HeightField, patches: int, sigma: float) -> float:
    """Return the default tolerance of a tile, from whether its orders, of width σ_q, overlap."""
    half_width = ScalarSettings(tolerance=CONTINUUM_TOLERANCE).lobe_cutoff * sigma
    overlap = any(
        count > 1 and 1 / size < 2 * half_width
        for size, count in zip(height_field.tile_size, height_field.shape[::-1], strict=True)
    )
    return CONTINUUM_TOLERANCE if overlap or patches > 1 else ORDERS_TOLERANCE


def _spline_spacing(tolerance: float, sigma: float) -> float:
    """Return the spacing of the nodes of splines in cycles/µm, for lobes of width σ_q."""
    return min(_MAX_SPACING, (_SPLINE_FRACTION * tolerance / _SPLINE_ERROR) ** (1 / 3)) * sigma


def _tile_splines(
    orders: TilePowers, lobes: tuple[LobeAxis, LobeAxis], sigma: float, max_frequency: float, tolerance: float
) -> TileSplines | None:
    """Return the lattice of splines of a tile, or None if reading it is no faster than reading the orders."""
    splines = TileSplines(orders, sigma, _spline_spacing(tolerance, sigma), max_frequency)
    faster = _cost(9, splines.grid.shape) < _cost(lobes[0].count * lobes[1].count, orders.grid.shape)
    return splines if faster else None


def _cost(packets: int, shape: tuple[int, int]) -> float:
    """Return the cost of an evaluation that reads `packets` nodes of (rows, columns), in reads of a small table.

    On a CPU reads take the same time while the nodes of one κ, at 8 bytes, fill less than 1 MB. For larger tables the
    time grows with the square root of the size.
    """
    return packets * max(1.0, shape[0] * shape[1] * 8e-6) ** 0.5


class _Storage(NamedTuple):
    """Number format of slices."""

    terms: int  # of the polynomial in κ
    rounded: Callable[[NDArray[np.float32]], NDArray[np.float32]] | None  # rounds values to the format
    min_allowed: float  # smallest allowed error for which the format is tried


# From the fastest to the most accurate.
_STORAGES = (
    _Storage(3, packed, 2.0**-8),
    _Storage(4, halved, 2.0**-11),
    _Storage(4, None, 0.0),
)


class _TableBuilder:
    """Builder of a table that keeps the tolerance, from exact powers.

    Attributes:
        kept: the grid without the weak frequencies at its edges.
        truncated_power: an upper bound, over κ, of the fraction of the power outside `kept`.
        unresolved_power: the largest fraction of the power, over κ, that is outside the whole grid.
    """

    def __init__(
        self,
        powers: TilePowers | Splines,
        height_range: float,
        max_kappa: float,
        allowed: float,
        progress: Progress,
    ) -> None:
        self._exact = powers
        self._range = height_range
        self._max_kappa = max_kappa
        self._allowed = allowed
        self._progress, self._done = progress, 0
        self.kept = powers.grid
        self.truncated_power = self.unresolved_power = 0.0

    def _phase(self, begin: float, end: float) -> Progress:
        """Return a function that reports progress of a part of the whole, in per cent, which never decreases."""

        def forward(done: int, total: int) -> None:
            self._done = max(self._done, done)
            self._progress(self._done, total)

        return part(forward, begin, end)

    def __call__(self) -> tuple[SliceTable, float]:
        """Return the cheapest table and its measured error.

        The bound of interpolation gives the number of intervals. If the measured error (interpolation + splines +
        rounding) still exceeds the tolerance, one interval is added; if that is not enough, the next, more precise
        format is tried.
        """
        error, refusal = np.inf, None
        for storage in _STORAGES if np.prod(self._exact.grid.shape) > _MAX_UNPACKED_NODES else _STORAGES[-1:]:
            if self._allowed < storage.min_allowed:
                continue
            derivative = self._exact.derivative_bound(storage.terms)
            first = intervals_for(derivative, storage.terms, self._max_kappa, _INTERPOLATION_FRACTION * self._allowed)
            for intervals in (first, first + 1 + first // 8):
                try:
                    table = self._build(storage, intervals)
                except _TooLargeError as too_large:
                    # Another format may need fewer intervals.
                    refusal = too_large
                    break
                error = self._measured(table, table.extrema()) / _MEASURED_FRACTION
                if error <= self._allowed:
                    return table, error
        raise refusal or RequestError(
            f"tolerance: got {self._allowed:.2g} with a surface of height range {self._range:.3g} µm, wanted one that "
            f"float32 keeps up to κ = {self._max_kappa:.1f} rad/µm (measured error {error:.2g})"
        )

    def _build(self, storage: _Storage, intervals: int) -> SliceTable:
        """Build a table, and find the weak frequencies at the edges of the grid, which it leaves out."""
        grid, missing = self._exact.grid, []
        outer: tuple[list[NDArray[np.float64]], list[NDArray[np.float64]]] = ([], [])
        _check_size(grid.shape, intervals * storage.terms)

        def powers(kappa: float) -> NDArray[np.float64]:
            power = self._exact(kappa)
            missing.append(1 - self._exact.reached(power))
            for axis in (0, 1):
                outer[axis].append(_outer_sums(np.abs(power).sum(axis=axis)))
            return power

        def kept() -> tuple[slice, slice]:
            powers(self._max_kappa)
            # Between the nodes in κ, and above the last, the fractions may be larger.
            between = np.vander(np.linspace(-1, 1, 9), storage.terms, increasing=True) @ to_polynomial(storage.terms)

            def largest(values: list[Any]) -> NDArray[np.float64]:
                interpolated = between @ np.reshape(values[:-1], (intervals, storage.terms, -1))
                return np.maximum(interpolated.max(axis=(0, 1)), values[-1])

            self.unresolved_power = float(np.clip(largest(missing)[0], 0, 1))
            max_order, self.truncated_power = [], 0.0
            for whole, sums in zip(grid.max_order, outer, strict=True):
                outside = largest(sums)
                max_order.append(int(np.argmax(outside <= _TRUNCATION_FRACTION / 2 * self._allowed)) if whole else 0)
                self.truncated_power += float(np.clip(outside[max_order[-1]], 0, 1))
            self.kept = dataclasses.replace(grid, max_order=(max_order[0], max_order[1]))
            return inner(grid, self.kept)

        with stage("powers"):
            # Values are rounded as stored, so that the measured error includes rounding.
            return SliceTable.build(
                intervals, storage.terms, self._max_kappa, powers, self._phase(0.0, 0.7), storage.rounded, kept
            )

    def series(self, heights: NDArray[np.float64], settings: ScalarSettings) -> tuple[AmplitudeTable, float]:
        """Return the amplitude series of a tile, with the requested or required number of terms, and its error."""
        kind, origin = settings.representation, settings.heights_from
        heights = heights - (heights.min() if origin == "lowest" else heights.mean())
        height = float(np.abs(heights).max())
        x, u = self._max_kappa * height, heights / (height or 1.0)
        count = settings.terms or _terms_needed(kind, u, x, self._allowed)
        grid = cast(OrderGrid, self.kept)
        _check_size(grid.shape, 2 * count)
        kappas = np.linspace(0, self._max_kappa, 12 + int(2 * x))
        # Each term, and each κ of the unresolved power and of the error, takes about one transform.
        step = 1 / (count + 2 * len(kappas))
        terms, report = [], self._phase(0.0, count * step)
        with stage("powers"):
            for n in range(count):
                transform = scipy.fft.fft2(series_function(kind, n, u), norm="forward")
                terms.append(grid.take(transform, 0.5**0.5).astype(np.complex64))
                report(n + 1, count)
            report = self._phase(count * step, 1 - len(kappas) * step)
            for number, kappa in enumerate(kappas, 1):
                self.unresolved_power = max(self.unresolved_power, 1 - self._exact.reached(self._exact(kappa)))
                report(number, len(kappas))
        table = AmplitudeTable(kind, self._max_kappa, height, np.stack(terms))
        with np.errstate(over="ignore", invalid="ignore"):
            error = self._measured(table, kappas, 1 - len(kappas) * step)
        if not np.isfinite(error) or (error > self._allowed and settings.terms is None):
            raise RequestError(
                f"{kind}: {count} terms of heights from the {origin}, of a range of {self._range:.3g} µm, err by "
                f"{error:.2g} of the power, more than the tolerance {self._allowed:.2g}: in float32 they grow to "
                f"e^{x:.1f} and cancel; wanted 'chebyshev', or 'slices'"
            )
        return table, error

    def _measured(self, table: SliceTable | AmplitudeTable, kappas: NDArray[np.float64], begin: float = 0.7) -> float:
        """Return the largest error of S over some of `kappas`, at least `_MIN_MEASURED`, as many as time allows.

        On scans of 6, 20 and 65 µm, to 1e-2 and 1e-3, the maximum over up to 60 other κ was at most 1.01 times that
        over the eight. Rounding to 8 bits makes the error of a mean of patches vary more with κ: up to 1.1 times that
        over the eight with 16 or 48 patches, and up to 1.7 times with two, which have few strong orders.
        """
        count = max(_MIN_MEASURED, _MAX_TRANSFORMS // self._exact.transforms)
        chosen = np.unique(np.rint(np.linspace(0, len(kappas) - 1, count)).astype(int))
        max_error, report = 0.0, self._phase(begin, 1.0)
        with stage("measuring the error"):
            for number, kappa in enumerate(kappas[chosen], 1):
                # np.maximum keeps NaN.
                max_error = float(np.maximum(max_error, self._exact.error(self.kept, table.powers(kappa), kappa)))
                report(number, len(chosen))
        return max_error


def _terms_needed(kind: str, u: NDArray[np.float64], x: float, allowed: float) -> int:
    """Return the number of terms that keeps Σ|Δη_m| of e^{ixu}, |u| ≤ 1, within the allowed error.

    With ΔF the amplitudes of the remainder, Σ|Δη| ≤ 2‖ΔF‖ + ‖ΔF‖², and ‖ΔF‖² is its mean square over the tile.
    """
    limit = 40 + int(3 * x)
    weights, remainder = series_weights(kind, limit, x), np.exp(1j * x * u)
    for n in range(limit):
        size = np.sqrt(np.mean(np.abs(remainder) ** 2))
        if n and size * (2 + size) <= _SERIES_FRACTION * allowed:
            return n
        remainder -= weights[n] * series_function(kind, n, u)
    # Rounding errors of double precision exceed the allowed error.
    return limit


def _outer_sums(profile: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the sums of a profile over −M…M outside each |m|: (M + 1,)."""
    half = len(profile) // 2
    folded = profile[half:] + profile[half::-1]
    folded[0] /= 2
    return np.concatenate([np.cumsum(folded[::-1])[::-1][1:], [0.0]])


class _TooLargeError(RequestError):
    """A table that would need too much memory, or a lattice that would take longer to read than the orders."""


def _check_size(shape: tuple[int, int], floats: int) -> None:
    """Refuse a table of `floats` numbers per node before its memory is allocated."""
    if 4.0 * np.prod(shape, dtype=float) * floats > MAX_TABLE_BYTES:
        raise _TooLargeError(
            f"tolerance: needs {' × '.join(map(str, shape))} frequencies of {floats} numbers, more than a table of "
            "4 GB; take a larger tolerance, a smaller patch or, of a sample, a shorter coherence length"
        )


def _check_resolution(height_field: HeightField, max_frequency: float) -> None:
    for axis, size, count in zip("xy", height_field.pixel_size, height_field.shape[::-1], strict=True):
        if count > 1 and 1 / (2 * size) < max_frequency * (1 - 1e-9):
            warnings.warn(
                f"pixels of {size * 1e3:.4g} nm along {axis} resolve frequencies up to {1 / (2 * size):.3g} cycles/µm, "
                f"but light reaches {max_frequency:.3g}: those between are missing",
                stacklevel=5,
            )
