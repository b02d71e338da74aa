"""From a height field to its power spectrum, within a tolerance."""

from __future__ import annotations

import dataclasses
import hashlib
import warnings
from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from ..errors import RequestError
from ..progress import Progress, part
from ..settings import SERIES, Settings, lobe_cutoff, lobe_width
from ..surface.heightfield import HeightField
from .grids import LobeAxis, OrderGrid, inner
from .power_spectrum import TAIL_FRACTION, PowerSpectrum
from .sample import SamplePowers, effective_coherence_length, standard_error
from .tables import (
    AmplitudeTable,
    SliceTable,
    chebyshev_nodes,
    chebyshev_polynomials,
    chebyshev_transform,
    halved,
    locate,
    nodes_for,
    packed,
    position,
    series_function,
    series_weights,
    to_polynomial,
)
from .tile import MeanPowers, TilePowers, TileSplines

# Fractions of the tolerance.
_TRUNCATION_FRACTION = 0.1  # for weak frequencies that are left out
_SPLINE_FRACTION = 0.4  # for interpolation between the nodes in q
# Intervals are chosen by the strongest frequencies, and errors are measured at a few κ: both keep this fraction of the
# allowed error.
_SAFETY_FRACTION = 0.7
_MAX_SPACING = 0.74  # of the lattice of splines, in σ_q
_MAX_PILOT = 8_000  # strongest frequencies by which intervals are chosen
_MAX_UNPACKED_NODES = 2_000  # up to which the nodes of one κ fit unpacked into the first-level cache
_MAX_TABLE_BYTES = 4e9
# Default tolerances: of a tile the smaller; of a sample a fraction of its standard error between the two, as the table
# need not be exact to 1e-3 where the spectrum is known to 25 %.
_MIN_DEFAULT_TOLERANCE, _MAX_DEFAULT_TOLERANCE = 1e-3, 1e-2
_STANDARD_ERROR_FRACTION = 0.1

_MEAN_TIME_FRACTION = 0.7  # of the build, spent on the mean of several patches, roughly

Splines = SamplePowers | TileSplines
Lattice = TypeVar("Lattice", SamplePowers, TileSplines)


def build_spectrum(patches: Sequence[HeightField], settings: Settings, progress: Progress) -> PowerSpectrum:
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
        allowed = tolerance = _MIN_DEFAULT_TOLERANCE if tolerance is None else tolerance
        sigma, rho = lobe_width(effective), lobe_cutoff(TAIL_FRACTION * tolerance)
        orders = TilePowers(height_field, max_frequency, rho * sigma)
        if len(patches) > 1:
            mean_tolerance = (1 - TAIL_FRACTION) * tolerance
            mean_progress, progress = part(progress, 0, _MEAN_TIME_FRACTION), part(progress, _MEAN_TIME_FRACTION, 1)
            orders = MeanPowers(patches, max_frequency, rho * sigma, max_kappa, mean_tolerance, mean_progress)
        lobes = orders.grid.lobes(sigma, rho)
        powers = None if series else _tile_splines(orders, lobes, sigma, max_frequency, max_kappa, tolerance)
        if powers is None:
            powers, tail = orders, 2 * (1 - lobes[0].inside * lobes[1].inside)
            allowed -= tail
    else:
        effective = effective_coherence_length(height_field, coherence_length)
        found_error = standard_error(
            height_field, coherence_length=effective, max_kappa=max_kappa, max_frequency=max_frequency
        )
        if tolerance is None:
            wanted = _STANDARD_ERROR_FRACTION * found_error
            tolerance = float(np.clip(wanted, _MIN_DEFAULT_TOLERANCE, _MAX_DEFAULT_TOLERANCE))
        allowed = tolerance
        if effective < coherence_length * (1 - 1e-9):
            x, y = height_field.tile_size
            warnings.warn(
                f"coherence_length: a scan of {x:.4g} × {y:.4g} µm supports {effective:.4g} µm of the requested "
                f"{coherence_length:.4g} µm; the lobes are as wide as the scan allows",
                stacklevel=4,
            )
        powers = _refined(
            lambda spacing: SamplePowers(height_field, effective, spacing, max_frequency),
            lobe_width(effective),
            max_kappa,
            tolerance,
        )
    build = _Build(powers, height_range, max_kappa, allowed, progress)
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
        settings=Settings(
            settings.extent,
            effective,
            settings.wavelengths,
            float(settings.largest_angle),
            table.representation,
            float(tolerance),
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


def _tile_splines(
    orders: TilePowers,
    lobes: tuple[LobeAxis, LobeAxis],
    sigma: float,
    max_frequency: float,
    max_kappa: float,
    tolerance: float,
) -> TileSplines | None:
    """Return the lattice of splines of a tile, or None if reading it is no faster than reading the orders."""
    cost = _cost(lobes[0].count * lobes[1].count, orders.grid.shape)

    def lattice(spacing: float) -> TileSplines:
        splines = TileSplines(orders, sigma, spacing, max_frequency)
        # A finer lattice would be slower still.
        if _cost(9, splines.grid.shape) >= cost:
            raise _TooLargeError(f"{splines.grid}: read no faster than the orders")
        return splines

    try:
        return _refined(lattice, sigma, max_kappa, tolerance)
    except _TooLargeError:
        return None


def _cost(packets: int, shape: tuple[int, int]) -> float:
    """Return the cost of an evaluation that reads `packets` nodes of (rows, columns), in reads of a small table.

    On a CPU reads take the same time while the nodes of one κ, at 8 bytes, fill less than 1 MB; beyond, the time grows
    with the square root of the size.
    """
    return packets * max(1.0, shape[0] * shape[1] * 8e-6) ** 0.5


def _refined(lattice: Callable[[float], Lattice], sigma: float, max_kappa: float, tolerance: float) -> Lattice:
    """Return the coarsest lattice, made by `lattice` for a spacing, that keeps `_SPLINE_FRACTION` of the tolerance."""
    allowed, spacing = _SPLINE_FRACTION * tolerance, _MAX_SPACING * sigma
    while True:
        powers = lattice(spacing)
        _check_size(powers.grid.shape, 4)
        error = max(
            powers.error(powers.grid, powers(kappa).astype(np.float32), kappa)
            for kappa in (0.0, 0.35 * max_kappa, max_kappa)
        )
        if error <= allowed:
            return powers
        # The error of quadratic splines falls with the third power of the spacing.
        spacing *= float(min(0.95, 0.95 * (allowed / error) ** (1 / 3)))


class _Storage(NamedTuple):
    """Number format of slices."""

    terms: int  # of the polynomial in κ
    rounded: Callable[[NDArray[np.float32]], NDArray[np.float32]]  # rounds values to the format
    min_allowed: float  # smallest allowed error for which the format is tried
    interpolation: float  # fraction of the allowed error that interpolation takes in the first attempt
    min_interpolation: float  # fraction below which the format is abandoned


# From the fastest to the most accurate.
_STORAGES = (
    _Storage(3, packed, 2.0**-9, 0.7, 0.3),
    _Storage(4, halved, 2.0**-11, 0.8, 0.3),
    _Storage(4, lambda values: values, 0.0, 1.0, 0.01),
)


class _Build:
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
        self._x = max_kappa * height_range / 2
        self._nodes = nodes_for(self._x, 0.01 * allowed)
        self._survey()

    def _powers(self, kappa: float) -> NDArray[np.float64]:
        return self._exact(kappa)[inner(self._exact.grid, self.kept)]

    def _survey(self) -> None:
        """Find the extent of the power and the strongest frequencies (the pilot), over the Chebyshev nodes in κ."""
        kappas = (1 + chebyshev_nodes(self._nodes)) / 2 * self._max_kappa
        grid, report = self._exact.grid, self._phase(0.0, 0.3)
        outer: tuple[list[NDArray[np.float64]], list[NDArray[np.float64]]] = ([], [])
        missing, total, strongest = [], 0.0, None
        pilot = np.empty((self._nodes, min(_MAX_PILOT, int(np.prod(grid.shape)))))
        for j, kappa in enumerate(kappas):
            power = self._exact(kappa)
            missing.append(1 - self._exact.reached(power))
            size = np.abs(power)
            total += size.sum()
            for axis in (0, 1):
                outer[axis].append(_outer_sums(size.sum(axis=axis)))
            if strongest is None:
                strongest = np.sort(np.argpartition(-size, pilot.shape[1] - 1, axis=None)[: pilot.shape[1]])
            pilot[j] = power.ravel()[strongest]
            report(j + 1, self._nodes)
        # Between the nodes the fractions may be larger: interpolate in κ.
        between = self._between()[1]
        self.unresolved_power = float(np.clip((between @ missing).max(), 0, 1))
        max_order, self.truncated_power = [], 0.0
        for whole, sums in zip(grid.max_order, outer, strict=True):
            outside = (between @ np.array(sums)).max(axis=0)
            max_order.append(int(np.argmax(outside <= _TRUNCATION_FRACTION / 2 * self._allowed)) if whole else 0)
            self.truncated_power += float(np.clip(outside[max_order[-1]], 0, 1))
        self.kept = dataclasses.replace(grid, max_order=(max_order[0], max_order[1]))
        self._pilot = pilot
        # The other frequencies are assumed to have the same error relative to their power.
        self._pilot_fraction = float(np.abs(pilot).sum() / total)

    def _phase(self, begin: float, end: float) -> Progress:
        """Return a function that reports progress of a part of the whole, in per cent, which never decreases."""

        def forward(done: int, total: int) -> None:
            self._done = max(self._done, done)
            self._progress(self._done, total)

        return part(forward, begin, end)

    def __call__(self) -> tuple[SliceTable, float]:
        """Return the cheapest table and its measured error."""
        for storage in _STORAGES if np.prod(self.kept.shape) > _MAX_UNPACKED_NODES else _STORAGES[-1:]:
            refine, refusal = storage.interpolation, None
            while self._allowed >= storage.min_allowed:
                try:
                    table = self._build(storage, _SAFETY_FRACTION * self._allowed * refine)
                except _TooLargeError as too_large:
                    # Another format may need fewer intervals.
                    refusal = too_large
                    break
                error = self._measured(table) / _SAFETY_FRACTION
                if error <= self._allowed:
                    return table, error
                if refine < storage.min_interpolation:
                    break
                refine /= max(2.0, error / self._allowed)
        raise refusal or RequestError(
            f"tolerance: got {self._allowed:.2g} with a surface of height range {self._range:.3g} µm, wanted one that "
            f"float32 keeps up to κ = {self._max_kappa:.1f} rad/µm (measured error {error:.2g})"
        )

    def series(self, heights: NDArray[np.float64], settings: Settings) -> tuple[AmplitudeTable, float]:
        """Return the amplitude series of a tile, with the requested or required number of terms, and its error."""
        kind, origin = settings.representation, settings.heights_from
        heights = heights - (heights.min() if origin == "lowest" else heights.mean())
        x = self._max_kappa * float(np.abs(heights).max())
        count = settings.terms or _terms_needed(kind, heights, self._max_kappa, self._allowed)
        _check_size(self.kept.shape, 2 * count)
        grid = cast(OrderGrid, self.kept)
        table = AmplitudeTable.build(
            kind, heights, count, self._max_kappa, lambda a: grid.take(a, 0.5**0.5), self._phase(0.3, 0.8)
        )
        with np.errstate(over="ignore", invalid="ignore"):
            error = self._measured(table)
        found = (
            f"{kind}: {count} terms of heights from the {origin}, of a range of {self._range:.3g} µm, err by "
            f"{error:.2g} of the power, more than the tolerance {self._allowed:.2g}"
        )
        if not np.isfinite(error) or (error > self._allowed and settings.terms is None):
            raise RequestError(
                f"{found}: in float32 they grow to e^{x:.1f} and cancel; wanted 'chebyshev', or 'slices'"
            )
        if error > self._allowed:
            warnings.warn(found, stacklevel=5)
        return table, error

    def _build(self, storage: _Storage, allowed: float) -> SliceTable:
        intervals = self._intervals(allowed, storage.terms)
        _check_size(self.kept.shape, intervals * storage.terms)
        # Values are rounded as stored, so that the measured error includes rounding.
        return SliceTable.build(
            intervals, storage.terms, self._max_kappa, self._powers, storage.rounded, self._phase(0.3, 0.8)
        )

    def _between(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return κ, four per oscillation, and the matrix, (κ, n), that interpolates to them from Chebyshev nodes."""
        kappas = np.linspace(0, self._max_kappa, 16 + int(np.ceil(4 * self._x)), dtype=np.float64)
        vander = chebyshev_polynomials(position(kappas, self._max_kappa), self._nodes)
        return kappas, vander @ chebyshev_transform(self._nodes)

    def _intervals(self, allowed: float, terms: int) -> int:
        """Return the smallest number of intervals that keeps the allowed error of the pilot at every κ."""
        allowed *= self._pilot_fraction
        kappas, interpolate = self._between()
        exact = interpolate @ self._pilot
        coefficients = chebyshev_transform(self._nodes) @ self._pilot
        intervals = 1
        while True:
            at = (np.arange(intervals)[:, None] + (1 + chebyshev_nodes(terms)) / 2) / intervals * self._max_kappa
            vander = chebyshev_polynomials(position(at.ravel(), self._max_kappa), self._nodes)
            values = (vander @ coefficients).reshape(*at.shape, -1)
            interval, t = locate(kappas, self._max_kappa, intervals)
            weights = t[:, None] ** np.arange(terms) @ to_polynomial(terms)
            # For one κ after the other, as all at once would take more memory than the table.
            error = max(np.abs(w @ values[k] - e).sum() for k, w, e in zip(interval, weights, exact, strict=True))
            if error <= allowed:
                return intervals
            intervals = max(intervals + 1, int(intervals * min(2.0, 0.95 * (error / allowed) ** (1 / terms))))

    def _measured(self, table: SliceTable | AmplitudeTable) -> float:
        """Return the largest error of S over held-out κ: both ends, and others between, four per oscillation."""
        count = 12 + int(np.ceil(2 * self._x))
        golden = (np.sqrt(5) - 1) / 2
        held_out = self._max_kappa * np.concatenate([[0.0, 1.0], np.sqrt((np.arange(1, count) * golden) % 1)])
        max_error, report = 0.0, self._phase(0.8, 1.0)
        for number, kappa in enumerate(held_out, 1):
            # np.maximum keeps NaN.
            max_error = float(np.maximum(max_error, self._exact.error(self.kept, table.powers(kappa), kappa)))
            report(number, len(held_out))
        return max_error


def _terms_needed(kind: str, heights: NDArray[np.float64], max_kappa: float, allowed: float) -> int:
    """Return the number of terms that keeps Σ|Δη_m| within the allowed error at κ_max, where the remainder is largest.

    With ΔF the amplitudes of the remainder, Σ|Δη| ≤ 2‖ΔF‖ + ‖ΔF‖², and ‖ΔF‖² is its mean square over the tile.
    """
    height = float(np.abs(heights).max())
    x, u = max_kappa * height, heights / (height or 1.0)
    limit = 40 + int(3 * x)
    weights, remainder = series_weights(kind, limit, x), np.exp(1j * x * u)
    for n in range(limit):
        size = np.sqrt(np.mean(np.abs(remainder) ** 2))
        if n and size * (2 + size) <= _SAFETY_FRACTION * (1 - _TRUNCATION_FRACTION) * allowed:
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
    if 4.0 * np.prod(shape, dtype=float) * floats > _MAX_TABLE_BYTES:
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
