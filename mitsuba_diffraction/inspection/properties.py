"""The report on a surface before rendering: statistics, periods, and reasons to distrust a rendering."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field

import numpy as np

from ..array_types import Real
from ..files.outputs import plain
from ..precomputation.grating_spectrum import GratingSpectrum
from ..precomputation.spectra import precompute
from ..progress import Progress, part, silent
from ..scalar_theory.validity import ScalarError, scalar_error
from ..settings import SUN_COHERENCE_LENGTH, VISIBLE, ScalarSettings, lobe_width
from ..spectrum.sample import MIN_PIXELS, effective_coherence_length, standard_error
from ..surface.heightfield import HeightField
from ..surface.periods import Period, find_periods, hann
from ..surface.prepare import white_noise
from .predicted_colours import CHANGE, MAX_COLOUR_COHERENCE_LENGTH, Change, changes, same_period

_TOLERANCE = 0.02
_MAX_PIECE_SIZE = 20.0  # µm, side of the part of a large scan from which colours are predicted
_MIN_PIECE_PIXEL = 0.04  # µm, to which smaller pixels of that part are averaged; light requires 0.09 µm
_MIN_PIECE_COUNT = 16  # pixels along each side of that part, where they are coarse: twice what a window requires


@dataclass(frozen=True)
class Inspection:
    """A surface in numbers.

    Attributes:
        height_field: the surface.
        extent: "tile" or "sample".
        statistics: heights, slopes, tilt.
        periods: see `find_periods`; strongest first, empty if none is significant.
        max_coherence_length: what a scan supports, µm, at most that of sunlight; a tile supports any.
        coherence_length: the requested one, limited to `max_coherence_length`, µm.
        standard_error: of the spectrum of a sample at that coherence length, a fraction of the reflected power; None of
            a tile.
        scalar_error: of scalar theory for this surface.
        changes: effects of ±5 % of height scale, pixel size and, for a scan, tip broadening; empty without a period.
        concerns: reasons to distrust a rendering.
        piece: the part of the surface from which colours and changes are predicted, the middle of a large scan.
        spectrum: of `piece`, with at most `MAX_COLOUR_COHERENCE_LENGTH`, for predicted colours.
    """

    height_field: HeightField
    extent: str
    statistics: Statistics
    periods: tuple[Period, ...]
    max_coherence_length: float
    coherence_length: float
    standard_error: float | None
    scalar_error: ScalarError
    changes: tuple[Change, ...]
    concerns: tuple[str, ...]
    piece: HeightField = field(repr=False)
    spectrum: GratingSpectrum = field(repr=False)

    @property
    def direction(self) -> float:
        """The direction, in degrees, of the plane in which colours are shown: along the main period, else along x."""
        return self.periods[0].direction if self.periods else 0.0

    def as_json(self) -> dict[str, object]:
        """Return all numbers by name, lengths in µm; None for NaN and infinity."""
        rows, columns = self.height_field.shape
        return plain(
            {
                "source": self.height_field.source,
                "extent": self.extent,
                "pixels": [columns, rows],
                "pixel_size": self.height_field.pixel_size,
                "size": self.height_field.tile_size,
                "filled": self.height_field.filled,
                "statistics": self.statistics,
                "periods": self.periods,
                "carried_coherence_length": self.max_coherence_length,
                "coherence_length": self.coherence_length,
                "standard_error": self.standard_error,
                "scalar_error": self.scalar_error,
                "changes": self.changes,
                "concerns": self.concerns,
                "size_of_colours": self.piece.tile_size,
            }
        )


def inspect(
    height_field: HeightField,
    *,
    extent: str = "sample",
    coherence_length: float = SUN_COHERENCE_LENGTH,
    measured: bool = True,
    progress: Progress = silent,
) -> Inspection:
    """Inspect a surface.

    Args:
        height_field: the surface.
        extent: "sample": a piece of a larger, irregular surface; "tile": it repeats periodically.
        coherence_length: the requested one, µm.
        measured: whether it is a scan; tilt, steps of the heights and the tip matter only for scans.
        progress: called with (per cent done, 100).

    Raises:
        ValueError: on an unknown extent, a coherence length that is not positive, or a sample of too few pixels.
    """
    ScalarSettings(extent=extent, coherence_length=coherence_length)
    sun = SUN_COHERENCE_LENGTH
    limit = effective_coherence_length(height_field, sun) if extent == "sample" else max(sun, coherence_length)
    used = min(float(coherence_length), limit)
    piece = _middle(height_field) if extent == "sample" else height_field
    colours_length = min(used, MAX_COLOUR_COHERENCE_LENGTH)
    if extent == "sample":
        coarse = MIN_PIXELS * max(height_field.pixel_size)
        colours_length = effective_coherence_length(piece, max(colours_length, min(used, coarse)))
    # The two changes of the tip need spectra of their own.
    parts = iter([(0.15, 0.4), (0.4, 0.7), (0.7, 1.0)] if measured else [(0.15, 1.0)])

    def build(field: HeightField) -> GratingSpectrum:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # on pixels and coherence, which `concerns` reports
            spectrum = precompute(
                field,
                extent=extent,
                coherence_length=colours_length,
                # Scaling heights by 1 + CHANGE is equivalent to shorter wavelengths.
                wavelengths=(VISIBLE[0] / (1 + CHANGE), VISIBLE[1]),
                tolerance=_TOLERANCE,
                progress=part(progress, *next(parts)),
            )
        assert isinstance(spectrum, GratingSpectrum)  # of scalar theory, the default
        return spectrum

    numbers = statistics(height_field, extent=extent)
    shortest = VISIBLE[0] * 1e-3
    progress(1, 100)
    periods = find_periods(height_field, extent=extent)
    progress(5, 100)
    scatter = (
        standard_error(height_field, coherence_length=used, max_kappa=4 * np.pi / shortest, max_frequency=2 / shortest)
        if extent == "sample"
        else None
    )
    progress(15, 100)
    spectrum = build(piece)
    scalar = scalar_error(height_field, extent)
    main = [same_period(find_periods(piece, extent=extent), one) for one in periods[:1]]
    result = Inspection(
        height_field=height_field,
        extent=extent,
        statistics=numbers,
        periods=periods,
        max_coherence_length=limit,
        coherence_length=used,
        standard_error=scatter,
        scalar_error=scalar,
        changes=changes(piece, spectrum, main[0], extent=extent, measured=measured, build=build) if main else (),
        concerns=concerns(height_field, numbers, used, extent=extent, measured=measured, scalar=scalar),
        piece=piece,
        spectrum=spectrum,
    )
    progress(100, 100)
    return result


def _middle(scan: HeightField) -> HeightField:
    """Return the middle of a scan, its pixels averaged to about `_MIN_PIECE_PIXEL`.

    It is at most `_MAX_PIECE_SIZE` or `_MIN_PIECE_COUNT` pixels wide.
    """
    counts = [
        min(n, max(_MIN_PIECE_COUNT, round(_MAX_PIECE_SIZE / size)))
        for n, size in zip(scan.shape, scan.pixel_size[::-1], strict=True)
    ]
    if 1 in scan.shape or (
        tuple(counts) == scan.shape and scan.heights.size <= (_MAX_PIECE_SIZE / _MIN_PIECE_PIXEL) ** 2
    ):
        return scan
    rows, columns = (slice((n - count) // 2, (n + count) // 2) for n, count in zip(scan.shape, counts, strict=True))
    y, x = (
        min(max(1, int(_MIN_PIECE_PIXEL / size)), count // 4)
        for size, count in zip(scan.pixel_size[::-1], counts, strict=True)
    )
    heights = scan.heights[rows, columns]
    heights = heights[: len(heights) // y * y, : heights.shape[1] // x * x]
    means = heights.reshape(len(heights) // y, y, -1, x).mean(axis=(1, 3))
    return HeightField(means, (scan.pixel_size[0] * x, scan.pixel_size[1] * y), scan.source)


@dataclass(frozen=True)
class Statistics:
    """A height field in numbers. Sa, Sq, Sz and Sdq are about the reference plane (ISO 25178-2, without filters).

    Attributes:
        Sa: arithmetical mean height, mean |h|, µm.
        Sq: root mean square height, µm.
        Sz: maximum height, highest to lowest, µm.
        Sdq: root mean square slope (gradient between neighbouring pixels), a number.
        steepest: slope, in degrees, that one in a hundred of the pixels that are not flat exceeds.
        tilt: of the reference plane, degrees from level.
        tilt_height: height difference of the reference plane from corner to corner of the patch, µm.
        levels: number of different heights.
        step: smallest difference between two of them, µm; 0 if all are equal.
    """

    Sa: float
    Sq: float
    Sz: float
    Sdq: float
    steepest: float
    tilt: float
    tilt_height: float
    levels: int
    step: float


def statistics(height_field: HeightField, *, extent: str = "sample") -> Statistics:
    """Compute the statistics of a height field, about `reference_plane`."""
    heights = height_field.heights
    plane, slopes = reference_plane(height_field, extent)
    level = heights - plane
    gradients = [
        np.gradient(level, pixel, axis=axis) if level.shape[axis] > 1 else np.zeros_like(level)
        for axis, pixel in ((1, height_field.pixel_size[0]), (0, height_field.pixel_size[1]))
    ]
    slope = np.hypot(*gradients)
    # Only sloping pixels, so that the walls of a binary grating count.
    sloping = slope[slope > 1e-9 * max(slope.max(), 1e-300)]
    values = np.unique(heights)
    # Differences by rounding do not count.
    steps = np.diff(values)
    steps = steps[steps > 1e-9 * max(np.abs(values).max(), 1e-300)]
    return Statistics(
        Sa=float(np.abs(level).mean()),
        Sq=float(np.sqrt(np.mean(level**2))),
        Sz=float(np.ptp(level)),
        Sdq=float(np.sqrt(np.mean(slope**2))),
        steepest=float(np.degrees(np.arctan(np.quantile(sloping, 0.99)))) if sloping.size else 0.0,
        tilt=float(np.degrees(np.arctan(np.hypot(*slopes)))),
        tilt_height=float(np.ptp(plane)),
        levels=len(steps) + 1,
        step=float(steps.min()) if len(steps) else 0.0,
    )


def reference_plane(height_field: HeightField, extent: str) -> tuple[Real, tuple[float, float]]:
    """Return the reference plane of the heights, (N_y, N_x) µm, and its slopes along x and y.

    For a sample, the least-squares plane; for a tile, which is periodic, a level plane.
    """
    rows, columns = height_field.shape
    if extent == "tile":
        return np.full((rows, columns), height_field.heights.mean()), (0.0, 0.0)
    # On a full grid the three unknowns are independent.
    x = (np.arange(columns) - (columns - 1) / 2) * height_field.pixel_size[0]
    y = (np.arange(rows) - (rows - 1) / 2) * height_field.pixel_size[1]
    mean = height_field.heights.mean()
    slope_x = float(height_field.heights.mean(axis=0) @ x / max(x @ x, 1e-300))
    slope_y = float(height_field.heights.mean(axis=1) @ y / max(y @ y, 1e-300))
    return mean + slope_x * x + slope_y * y[:, None], (slope_x, slope_y)


_MAX_PIXEL_SIZE = 0.09  # µm: a quarter of the shortest wavelength, as grazing incidence and exit require
_BLUE, _GREEN = 0.45, 0.55  # µm
_MAX_FRACTION_AT_LIMIT = 0.02  # of the power above four fifths of the Nyquist limit
_MAX_STEP_SCATTER = 1e-3  # fraction of light scattered by the steps of the heights
_MAX_DEFLECTION = 1.0  # degrees
_MIN_WAVELENGTHS = 5  # of green light, across a scan
_MAX_NOISE = 0.5  # of Sq: a quarter of the variance
_MAX_SLOPE = 45.0  # degrees, above which light is reflected twice


def concerns(
    height_field: HeightField,
    numbers: Statistics,
    coherence_length: float,
    *,
    extent: str,
    measured: bool,
    scalar: ScalarError,
) -> tuple[str, ...]:
    """Return concerns about the surface as sentences; none if all is well.

    The coherence length, µm, is limited to what the surface supports. Surfaces given by a formula (not `measured`) are
    not checked for tilt and steps.
    """
    found = []
    axes = zip(height_field.pixel_size, height_field.shape[::-1], strict=True)
    coarsest = max([pixel for pixel, count in axes if count > 1], default=0.0)
    if coarsest > _MAX_PIXEL_SIZE:
        found.append(
            f"Pixels of {coarsest * 1e3:.0f} nm are too coarse for light: orders above {1 / (2 * coarsest):.2g} "
            "cycles/µm are missing. Scan again with pixels of at most 90 nm."
        )
    if warning := scalar.warning:
        found.append(f"{warning[0].upper()}{warning[1:]}.")
    if measured:
        found += _concerns_of_a_scan(height_field, numbers, coherence_length, extent)
    return tuple(found)


def _concerns_of_a_scan(
    height_field: HeightField, numbers: Statistics, coherence_length: float, extent: str
) -> list[str]:
    """Return concerns about how a surface was measured; for arguments see `concerns`."""
    found = []
    width = min(height_field.tile_size)
    if extent == "sample" and width < _MIN_WAVELENGTHS * _GREEN:
        lobe = np.degrees(_GREEN * lobe_width(coherence_length))
        found.append(
            f"The scan is {width:.3g} µm wide, {width / _GREEN:.2g} wavelengths of green light: an order is "
            f"±{lobe:.2g}° wide, and colours run into each other. Scan 20 µm or more, or, for whole periods of a "
            "grating, use extent=tile."
        )
    noise = white_noise(height_field.heights)
    if noise > _MAX_NOISE * numbers.Sq:
        found.append(
            f"Noise of {noise * 1e3:.2g} nm is {noise / numbers.Sq:.0%} of the roughness Sq: periods and colours may "
            "be those of the noise. Scan more slowly, or a rougher part of the surface."
        )
    # A slope s deflects all light by 2s and shifts q by 2s/λ. Less than a lobe is invisible, a degree always too much.
    shift = 2 * np.tan(np.deg2rad(numbers.tilt)) / _GREEN
    if shift > lobe_width(coherence_length) or 2 * numbers.tilt > _MAX_DEFLECTION:
        found.append(
            f"The scan is tilted by {numbers.tilt:.2g}° ({numbers.tilt_height * 1e3:.0f} nm from corner to corner), "
            f"which deflects all reflected light by {2 * numbers.tilt:.2g}°. Level it: prepare=level_plane."
        )
    at_limit = _fraction_at_limit(height_field)
    if at_limit > _MAX_FRACTION_AT_LIMIT:
        found.append(
            f"{at_limit:.0%} of the light at 450 nm is diffracted by detail of less than 2.5 pixels: noise, or detail "
            "too fine for the pixels, which appears in wrong directions. Scan again with smaller pixels, or filter the "
            "noise."
        )
    # Rounding to steps is noise of variance step²/12 and scatters (κ step)²/12 of the light.
    scattered = (4 * np.pi / _BLUE * numbers.step) ** 2 / 12
    if 16 <= numbers.levels <= 256 and scattered > _MAX_STEP_SCATTER:
        found.append(
            f"Heights have {numbers.levels} levels, {numbers.step * 1e3:.2g} nm apart (8 bit?): rounding scatters "
            f"{scattered:.1%} of blue light. Export 16 bit or floats."
        )
    if height_field.filled:
        found.append(
            f"{height_field.filled} pixels of the scan were missing and are filled: the heights there are a guess."
        )
    if numbers.steepest > _MAX_SLOPE:
        found.append(
            f"One sloping pixel in a hundred is steeper than {numbers.steepest:.0f}°: light is reflected more than "
            "once there, which is not computed, and a tip does not reach down such walls."
        )
    return found


def _fraction_at_limit(height_field: HeightField) -> float:
    """Return the fraction of the power at 450 nm and normal incidence above 0.8 of the Nyquist limit."""
    phase = np.exp(1j * 4 * np.pi / _BLUE * height_field.centred)
    power = np.abs(np.fft.fft2(phase * hann(phase.shape))) ** 2
    outer_y, outer_x = (np.abs(np.fft.fftfreq(count)) > 0.4 for count in power.shape)
    return float(power[outer_y[:, None] | outer_x].sum() / power.sum())
