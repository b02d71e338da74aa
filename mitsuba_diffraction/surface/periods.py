"""Periods and directions of a height field, from the peaks of its periodogram.

A periodogram is P(q) = |Σ_n w_n h_n e^{−2πi q·x_n}|²/Σ_n w_n² of heights levelled to second order, w being a Hann
window; white noise has its variance as mean. A regular wave is sharpest in the periodogram of the whole scan. A wave
that wanders is spread over many frequencies there, each with a random power. It stands out better from the mean of the
periodograms of nine overlapping quarters (Welch 1967, "The use of fast Fourier transform for the estimation of power
spectra", IEEE Transactions on Audio and Electroacoustics 15(2), 70–73). Of the two, the one whose strongest peak
exceeds the significant power by the larger factor is used first.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import chain

import numpy as np
from scipy import ndimage
from scipy.fft import fft2
from scipy.special import gammainccinv, gammaincinv

from ..array_types import Real
from ..errors import check_whole
from ..settings import ScalarSettings
from .heightfield import HeightField, harmonic_fill

_MIN_WAVES = 2.5  # across the window, so that the peaks at q and −q do not overlap
_LOBE_RADIUS = 2.5  # of a peak, bins: a Hann window has no power further away
_INDEPENDENT_WINDOWS = 9 / (3 + 4 / 36)  # equivalent to three that overlap by half, with powers correlated by 1/36
_FALSE_ALARM_PROBABILITY = 1e-4  # of a detection in noise
_MIN_STRENGTH = 1e-2  # fraction of the variance, to exclude hum of the instrument and uneven background
_MIN_DENSITY = 1e-9  # of the background, relative to the variance: between waves without noise there is only rounding
_MIN_RING_SIZE = 24  # frequencies from which a lower quartile is taken
_MIN_FUNDAMENTAL = 0.1  # power relative to its harmonic, for a wave of two or three times the period to be the period
# Waves that differ by less in direction and length count as one that varies over the surface.
_MAX_SAME_ANGLE, _MAX_SAME_LENGTH = 30.0, 0.1  # degrees, fraction
# Ratio of the excess in the quarters to that in the whole, above which a wave is irregular; 1 for a regular wave.
_MIN_IRREGULAR_RATIO = 1.25
_MAX_REPETITIONS = 8  # of a tile along each axis
_MAX_REPEATED_PIXELS = 2**22
_MAX_CANDIDATES = 200  # local maxima considered


@dataclass(frozen=True)
class Period:
    """A period of a height field.

    Attributes:
        period: µm, perpendicular to the lines.
        direction: degrees of the wave vector from +x towards +y, in (−90, 90].
        period_uncertainty: standard deviation over the quarters of the scan, µm; 0 of a tile.
        direction_uncertainty: the same of the direction, degrees.
        strength: fraction of the variance of the levelled heights in this wave, without harmonics.
    """

    period: float
    direction: float
    period_uncertainty: float
    direction_uncertainty: float
    strength: float

    @property
    def q(self) -> Real:
        """The wave vector, (2,), cycles/µm."""
        phi = np.deg2rad(self.direction)
        return np.array([np.cos(phi), np.sin(phi)]) / self.period

    def __str__(self) -> str:
        """Return "1.144 ± 0.012 µm along −89.7 ± 0.2° from x"."""
        direction = with_uncertainty(self.direction, self.direction_uncertainty)
        return f"{with_uncertainty(self.period, self.period_uncertainty)} µm along {direction}° from x"

    @classmethod
    def of(cls, q: Real, covariance: Real, strength: float) -> Period:
        """Make a period from a frequency (2,) in cycles/µm and its covariance (2, 2)."""
        length = float(np.hypot(*q))
        along, across = q / length, np.array([-q[1], q[0]]) / length
        degrees = float(np.degrees(np.arctan2(q[1], q[0])))
        return cls(
            period=1 / length,
            # −90° up to rounding becomes 90°.
            direction=min(float(degrees - 180 * np.ceil((degrees - 90) / 180 - 1e-12)), 90.0),
            period_uncertainty=float(np.sqrt(along @ covariance @ along)) / length**2,
            direction_uncertainty=float(np.degrees(np.sqrt(across @ covariance @ across) / length)),
            strength=strength,
        )


def with_uncertainty(value: float, uncertainty: float) -> str:
    """Format as 1.144 ± 0.012: the uncertainty to two digits, the value to the same number of decimals."""
    if not (np.isfinite(uncertainty) and uncertainty > 0):
        return f"{value:.4g}"
    decimals = int(np.clip(1 - np.floor(np.log10(uncertainty)), 0, 6))
    # Adding zero removes the sign of −0.
    return f"{round(value, decimals) + 0.0:.{decimals}f} ± {uncertainty:.{decimals}f}".replace("-", "−")


def find_periods(height_field: HeightField, count: int = 2, *, extent: str = "sample") -> tuple[Period, ...]:
    """Find the strongest periods of a height field.

    A wave is detected where the periodogram exceeds the background by a factor that noise on an exactly known
    background would exceed in one of ten thousand height fields. The background follows from the largest of three lower
    quartiles: over frequencies of similar magnitude, and along the row and the column of the frequency, because of the
    streaks of a scan. If a wave of two or three times the period is also significant, it is the period, and the first
    wave is its harmonic.

    A parabola through the logarithm of the power gives the frequency of the peak, and the quarters of the scan,
    weighted by their powers there, its standard deviation: what another part of the surface, half as long and wide,
    would have.

    A tile is repeated until it holds several of its periods, which are orders of its lattice, and exact.

    Args:
        height_field: need not be levelled; missing pixels are filled first.
        count: largest number of periods.
        extent: "tile": the patch repeats periodically; "sample": it is a piece of a larger surface.

    Returns:
        Strongest first. Those less than 30° and 10 % apart, and harmonics, are one. Empty if none is significant
        (noise, a flat surface) or has 1 % of the variance.

    Raises:
        ValueError: if count is not a positive integer, or the extent is unknown.
    """
    check_whole("count", count, 1)
    ScalarSettings(extent=extent)
    if extent == "tile":
        return _periods_of_tile(height_field, count)
    heights = harmonic_fill(height_field.heights, height_field.pixel_size)
    variance = float(levelled(heights).var())
    if not np.sqrt(variance) > 1e-13 * np.abs(heights).max():  # flat up to rounding
        return ()
    shape, pixel_size = heights.shape, height_field.pixel_size
    parts = [[heights[rows, columns] for columns in _halves(shape[1])] for rows in _halves(shape[0])]
    whole = _Periodogram([heights], pixel_size, variance)
    quarters = _Periodogram([part for row in parts for part in row], pixel_size, variance)
    corners = [
        _Periodogram([part], pixel_size, variance) for row in (parts[0], parts[-1]) for part in (row[0], row[-1])
    ]
    peaks = whole.peaks()
    if quarters.excess > _MIN_IRREGULAR_RATIO * whole.excess:
        peaks = chain(quarters.peaks(), whole.peaks(2 * _MIN_WAVES))
    found: list[Period] = []
    for q, strength in peaks:
        if not any(_same_wave(q, other.q) for other in found):
            found.append(_period(q, strength, corners))
        if len(found) == count:
            break
    return tuple(sorted(found, key=lambda period: -period.strength))


def _period(q: Real, strength: float, corners: list[_Periodogram]) -> Period:
    """Return the period of a peak; its uncertainty is the spread over the corners, weighted by their powers."""
    summits, power = zip(*(corner.summit(q) for corner in corners), strict=True)
    weight = np.array(power) / max(sum(power), 1e-300)
    apart = np.array(summits) - q
    return Period.of(q, (weight * apart.T) @ apart / max(1 - weight @ weight, 0.5), strength)


def powers_of_heights(height_field: HeightField, extent: str) -> tuple[Real, Real, float]:
    """Compute the power spectrum of the heights: of a tile as it is, of a sample levelled and under a Hann window.

    Returns:
        |q| in cycles/µm and the power |FFT|², both (N_y, N_x), and the r.m.s. height, µm. The power is zero where
        heights differ by rounding errors only.
    """
    heights = height_field.centred - height_field.centred.mean() if extent == "tile" else levelled(height_field.heights)
    power = np.abs(np.fft.fft2(heights if extent == "tile" else hann(heights.shape) * heights)) ** 2
    if extent == "tile":
        power[0, 0] = 0
    scale = float(heights.std())
    if not scale > 1e-13 * np.abs(height_field.heights).max():
        power, scale = np.zeros_like(power), 0.0
    q = [np.fft.fftfreq(n, p) for n, p in zip(heights.shape[::-1], height_field.pixel_size, strict=True)]
    return np.hypot(*np.meshgrid(*q)), power, scale


class _Periodogram:
    """The mean periodogram of equally large parts of a scan, and its significant peaks."""

    def __init__(self, parts: list[Real], pixel_size: tuple[float, float], variance: float) -> None:
        """Take the heights of the parts and the variance of the whole, µm and µm²."""
        shape = parts[0].shape
        window = hann(shape)
        self._parts = [window * levelled(part) / np.linalg.norm(window) for part in parts]
        self._positions = [np.arange(n) * p for n, p in zip(shape[::-1], pixel_size, strict=True)]
        self.size = np.array(shape[::-1]) * pixel_size
        self._floor = _MIN_DENSITY * variance
        self._count = _INDEPENDENT_WINDOWS ** round(np.log(len(parts)) / np.log(3))
        # Waves along x and y at each frequency.
        self._waves = np.array(np.meshgrid(*(np.rint(np.fft.fftfreq(n) * n) for n in shape[::-1])))
        x, y = self._waves
        # One of q and −q, if the parts hold enough waves.
        self._usable = ((x > 0) | ((x == 0) & (y > 0))) & (np.hypot(x, y) >= _MIN_WAVES)

    @cached_property
    def _power(self) -> Real:
        return np.mean([np.abs(fft2(part, workers=2)) ** 2 for part in self._parts], axis=0)

    @cached_property
    def _candidates(self) -> dict[tuple[int, int], float]:
        """The significant local maxima, highest first, and their powers relative to the threshold of significance."""
        power, found = self._power, {}
        if not self._usable.any():
            return {}
        rings = _background(np.hypot(*self._waves), power, self._count, 1 if min(power.shape) > 1 else 2)
        rings = np.maximum(rings, self._floor)
        # The mean of K periodograms of noise has a gamma distribution. Adjacent windows contain the same streak.
        streaks = self._count**0.5
        level = gammainccinv(self._count, _FALSE_ALARM_PROBABILITY / self._usable.sum()) / self._count
        of_streak = gammainccinv(streaks, _FALSE_ALARM_PROBABILITY / max(power.shape)) / streaks
        maximum = self._usable & (power == ndimage.maximum_filter(power, 3, mode="wrap")) & (power > level * rings)
        highest = np.argwhere(maximum)[np.argsort(-power[maximum], kind="stable")][:_MAX_CANDIDATES]
        self._maxima = self._waves[(slice(None), *highest.T)].T
        for row, column in highest.tolist():
            streak = max(
                _streak(power[row], self._waves[0, row], column, self._waves[1, row, column], streaks),
                _streak(power[:, column], self._waves[1, :, column], row, self._waves[0, row, column], streaks),
            )
            if power[row, column] > of_streak * streak:
                found[row, column] = float(power[row, column] / (level * rings[row, column]))
        return found

    @property
    def excess(self) -> float:
        """The largest power of a peak relative to the threshold of significance; 0 without a peak."""
        return max(self._candidates.values(), default=0.0)

    def peaks(self, max_waves: float = np.inf) -> Iterator[tuple[Real, float]]:
        """Yield the frequencies, cycles/µm, and strengths of peaks of at most so many waves, highest first."""
        for at in self._candidates:
            waves = self._fundamental(at)
            if np.hypot(*waves) >= max_waves:
                continue
            # The highest maximum of an irregular wave may be hidden by the streaks of its row and column.
            waves = next(
                (other for other in self._maxima if _same_wave(waves / self.size, other / self.size, 1)), waves
            )
            # The summit is at most one bin away along each axis. It takes long to find in a large scan.
            if self._strength(waves / self.size, _LOBE_RADIUS + 2**0.5) < _MIN_STRENGTH:
                continue
            q = self.summit(waves / self.size)[0]
            if (strength := self._strength(q)) >= _MIN_STRENGTH:
                yield q, strength

    def _fundamental(self, at: tuple[int, int]) -> Real:
        """Return the waves across the parts of the longest period with this peak as third or second harmonic."""
        waves = self._waves[:, at[0], at[1]]
        near = [other for other in self._candidates if self._power[other] > _MIN_FUNDAMENTAL * self._power[at]]
        rows, columns = np.transpose(near)
        others = self._waves[:, rows, columns].T
        others = others * np.sign(others @ waves + 0.5)[:, None]
        for order in (3, 2):
            miss = np.abs(others - waves / order).max(axis=1)
            if miss.min() <= 1:
                return np.asarray(others[np.argmin(miss)])
        return np.asarray(waves)

    def _strength(self, q: Real, radius: float = _LOBE_RADIUS) -> float:
        """Return the fraction of the power in the lobes about q and −q, of a radius in bins."""
        away = np.hypot(*(self._waves - (q * self.size)[:, None, None]))
        return float(min(2 * self._power[away <= radius].sum() / self._power.sum(), 1.0))

    def summit(self, q: Real) -> tuple[Real, float]:
        """Return the maximum of the power near a frequency, at most one bin away, and the power there."""
        start, step = q, 0.5 / self.size
        for _ in range(4):
            x, y = (q[axis] + step[axis] * np.array([-1, 0, 1]) for axis in (0, 1))
            waves = [np.exp(-2j * np.pi * np.outer(f, p)) for f, p in zip((x, y), self._positions, strict=True)]
            power = np.mean([np.abs(waves[1] @ part @ waves[0].T) ** 2 for part in self._parts], axis=0)
            level = np.log(np.maximum(power, 1e-300))
            for axis, (low, middle, high) in enumerate((level[1], level[:, 1])):
                bend = low - 2 * middle + high
                if len(self._positions[axis]) > 1:
                    q = q + step * np.eye(2)[axis] * (
                        np.clip((low - high) / 2 / bend, -1, 1) if bend < 0 else np.sign(high - low)
                    )
            q = np.clip(q, start - 2 * step, start + 2 * step)
        return q, float(power[1, 1])


def _periods_of_tile(tile: HeightField, count: int) -> tuple[Period, ...]:
    # In one period of a profile, harmonics are significant sooner than the period.
    for times in (_MAX_REPETITIONS,) if 1 in tile.shape else (1, 2, 4, _MAX_REPETITIONS):
        if found := find_periods(repeated(tile, times), count):
            orders = [np.rint(period.q * tile.tile_size) for period in found]
            return tuple(
                Period.of(order / tile.tile_size, np.zeros((2, 2)), period.strength) if order.any() else period
                for order, period in zip(orders, found, strict=True)
            )
    return ()


def repeated(tile: HeightField, times: int = _MAX_REPETITIONS) -> HeightField:
    """Repeat a tile along each axis, `times` times or as often as `_MAX_REPEATED_PIXELS` allows."""
    while tile.heights.size * times**2 > _MAX_REPEATED_PIXELS and times > 1:
        times //= 2
    return HeightField(np.tile(tile.heights, (times, times)), tile.pixel_size, tile.source)


def _streak(line: Real, waves: Real, k: int, across: float, count: float) -> float:
    """Return the mean power of the streak in a row or column of a periodogram near index k, outside the lobe there."""
    # The band of an irregular skin is the wider the further it is from the centre.
    lobe = int(np.ceil(_LOBE_RADIUS))
    radius = min(max(_MIN_RING_SIZE // 2, int(np.hypot(waves[k], across) / 2)), (len(line) - 1) // 2)
    if radius <= 2 * lobe:
        return 0.0
    away = (k + np.r_[-radius:-lobe, lobe + 1 : radius + 1]) % len(line)
    # White, if lines jump, or falling with the square of the frequency, if they drift.
    drift = np.minimum((waves[away] ** 2 + across**2) / (waves[k] ** 2 + across**2), 1.5**2)
    quartile = max(np.quantile(line[away], 0.25), np.quantile(line[away] * drift, 0.25))
    return float(quartile * count / gammaincinv(count, 0.25))


def _background(waves: Real, power: Real, count: float, ratio: float) -> Real:
    """Return the mean power of noise from lower quartiles over frequencies of similar magnitude, by power laws.

    Args:
        waves: |q| in bins.
        power: mean of `count` independent periodograms.
        ratio: smallest ratio of the ends of a ring of frequencies, which holds 24 or more and is one bin wide or more.
    """
    length, order = waves.ravel(), np.argsort(waves, axis=None, kind="stable")
    order = order[np.searchsorted(length[order], 0.5) :]
    sizes = length[order]
    edges = [0]
    while edges[-1] < len(order):
        end = max(sizes[edges[-1]] + 1, sizes[edges[-1]] * ratio)
        edges.append(max(int(np.searchsorted(sizes, end)), edges[-1] + _MIN_RING_SIZE))
    rings = np.split(order, edges[1:-1])
    middle = np.array([np.log(length[ring]).mean() for ring in rings])
    level = np.zeros(power.size)
    for _ in range(2):  # the second time without the slope within a ring
        quartile = [np.quantile(power.ravel()[ring] / np.exp(level[ring]), 0.25) for ring in rings]
        values = np.log(np.maximum(np.array(quartile) * count / gammaincinv(count, 0.25), 1e-300))
        points = middle
        if len(rings) > 1:  # the first power law extends to the longest wave
            slope = (values[1] - values[0]) / (middle[1] - middle[0])
            points, values = np.r_[0.0, middle], np.r_[values[0] - slope * middle[0], values]
        level += np.interp(np.log(np.maximum(length, 1)), points, values)
    return np.exp(level).reshape(power.shape)


def _halves(count: int) -> list[slice]:
    """Return the ends and the middle of a row of pixels, each half as long; a short row as it is."""
    half = count // 2
    return (
        [slice(start, start + half) for start in (0, (count - half) // 2, count - half)] if half > 7 else [slice(count)]
    )


def levelled(heights: Real) -> Real:
    """Return heights about the quadratic surface that fits them best, (N_y, N_x)."""
    # Orthonormal polynomials along each axis, as far as the points determine them.
    y, x = (np.linalg.qr(np.vander(np.linspace(-1, 1, n), min(n, 3), increasing=True))[0] for n in heights.shape)
    coefficients = y.T @ (heights - heights.mean()) @ x
    coefficients[np.add.outer(np.arange(y.shape[1]), np.arange(x.shape[1])) > 2] = 0
    return np.asarray(heights - heights.mean() - y @ coefficients @ x.T)


def hann(shape: tuple[int, int]) -> Real:
    """Return the Hann window of a patch without its zeros, (N_y, N_x); one along an axis of a single pixel."""
    return np.outer(*(np.sin(np.pi * (np.arange(n) + 0.5) / n) ** 2 for n in shape))


def _same_wave(one: Real, other: Real, orders: int = 1000) -> bool:
    """Return whether two wave vectors belong to one period that varies, or to its harmonics up to some order."""
    short, long = sorted((np.hypot(*one), np.hypot(*other)))
    angle = np.degrees(np.arctan2(abs(one[0] * other[1] - one[1] * other[0]), abs(one @ other)))
    order = np.clip(np.rint(long / short), 1, orders)
    return bool(angle < _MAX_SAME_ANGLE and abs(long / short / order - 1) < _MAX_SAME_LENGTH)
