"""The spectrum of a piece of a larger, irregular surface, by Welch's method (Welch 1967), and its standard error.

Its power spectrum is estimated from windowed segments,

    S(q; κ) = (d_x d_y/P) Σ_p |Σ_n a(x_n − x_p) e^{iκh_n} e^{−2πi q·x_n}|² / Σ_n a²            [µm²]

averaged over P positions x_p; d is the pixel size. All windows lie inside the scan, without wrapping around.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.fft
import scipy.ndimage
from numpy.typing import NDArray

from ..errors import RequestError
from ..settings import lobe_width
from ..surface.heightfield import HeightField
from .grids import SHIFTS, OrderGrid, SplineGrid
from .tables import derivative_bound
from .tile import phase_wave

# Windows are truncated at ±3 σ_s, where their amplitude is e^{−9/2}, 1 %.
_SUPPORT = 6.0
# Largest coherence length relative to the scan: the window is then three quarters of the scan, with three positions σ_s
# apart along each axis.
_MAX_COHERENCE_FRACTION = 0.5
MIN_PIXELS = 4  # in a coherence length
MAX_BATCH_SIZE = 1 << 17  # numbers that are transformed at once


class WindowAxis(NamedTuple):
    """The window along one axis, a at the pixels, (W,), Σ a² = 1, and its positions: the first pixel of each, (P,)."""

    window: NDArray[np.float64]
    starts: NDArray[np.int64]


UNIFORM = WindowAxis(np.ones(1), np.zeros(1, np.int64))  # the window along an axis of one pixel


def effective_coherence_length(height_field: HeightField, requested: float) -> float:
    """Return the coherence length in µm that a scan supports: `requested`, but at most half of its shorter side.

    An axis of one pixel imposes no limit: the surface is uniform along it.

    Raises:
        ValueError: if it is below four pixels, too short for a window.
    """
    lobe_width(requested)
    axes = list(zip(height_field.tile_size, height_field.pixel_size, height_field.shape[::-1], strict=True))
    effective = min([float(requested), *(_MAX_COHERENCE_FRACTION * size for size, _, count in axes if count > 1)])
    for _, pixel, count in axes:
        if count > 1 and effective < MIN_PIXELS * pixel * (1 - 1e-9):
            limit = ""
            if effective < requested:
                limit = f", of which the scan of {axes[0][0]:.4g} × {axes[1][0]:.4g} µm supports {effective:.4g}"
            raise RequestError(
                f"coherence_length: got {requested:g} µm{limit}; wanted at least "
                f"{MIN_PIXELS} pixels of {pixel:.4g} µm{'' if limit else ': is pixel_size right, in µm?'}"
            )
    return effective


def window_axes(height_field: HeightField, coherence_length: float) -> list[WindowAxis]:
    """Return the windows along x and y for a coherence length (µm) that the scan supports; `UNIFORM` for one pixel.

    a(x) = exp(−x²/2σ_s²) with σ_s = L_c/4, about the centre of its support, 6σ_s rounded up to whole pixels. The
    positions are evenly spaced from edge to edge of the scan, at most σ_s apart, rounded to whole pixels.
    """
    return [
        _axis(count, pixel, coherence_length / 4) if count > 1 else UNIFORM
        for count, pixel in zip(height_field.shape[::-1], height_field.pixel_size, strict=True)
    ]


def mean_periodogram(
    wave: NDArray[np.complex64], x: WindowAxis, y: WindowAxis, shape: tuple[int, int]
) -> NDArray[np.float64]:
    """Compute (1/P) Σ_p |Σ_n a(x_n − x_p) wave_n e^{−2πi q·x_n}|² over all positions of the windows along x and y.

    The result has q as in `scipy.fft.fft2` of segments padded with zeros to `shape`, (rows, columns). Transforms are in
    single precision, whose error is below 1e-6 of the power.
    """
    window = np.outer(y.window, x.window).astype(np.float32)
    segments = np.lib.stride_tricks.sliding_window_view(wave, window.shape)
    positions = np.array([(row, column) for row in y.starts for column in x.starts])
    total, step = np.zeros(shape), max(1, MAX_BATCH_SIZE // (shape[0] * shape[1]))
    for first in range(0, len(positions), step):
        row, column = positions[first : first + step].T
        # Rows of zeros need no transform along x.
        along_x = scipy.fft.fft(segments[row, column] * window, shape[1], axis=2, overwrite_x=True, workers=2)
        transform = scipy.fft.fft(along_x, shape[0], axis=1, overwrite_x=True, workers=2)
        total += (transform.real**2 + transform.imag**2).sum(axis=0)
    return total / len(positions)


def _axis(count: int, pixel: float, sigma: float) -> WindowAxis:
    width = min(count, max(MIN_PIXELS, _rounded_up(_SUPPORT * sigma / pixel)))
    x = (np.arange(width) - (width - 1) / 2) * pixel
    window = np.exp(-(x**2) / (2 * sigma**2))
    positions = np.rint(np.linspace(0, count - width, _rounded_up((count - width) * pixel / sigma) + 1))
    return WindowAxis(window / np.linalg.norm(window), positions.astype(np.int64))


def _rounded_up(value: float) -> int:
    """Return the ceiling, tolerant of rounding errors just above an integer."""
    return int(np.ceil(value * (1 - 1e-9)))


_UNIFORM_SIGMAS = 6.0  # half width of the lobe along an axis on which the surface is uniform, in σ_q


class _Lags:
    """One axis: the lags τ of the autocorrelation, and the frequency lattice of its transform."""

    def __init__(
        self, axis: WindowAxis, pixel: float, coherence_length: float, spacing: float, max_frequency: float
    ) -> None:
        self.axis, self.is_uniform = axis, axis is UNIFORM
        sigma = lobe_width(coherence_length)
        if self.is_uniform:
            pixel, max_frequency = 1 / (4 * _UNIFORM_SIGMAS * sigma), _UNIFORM_SIGMAS * sigma
            lags = int(np.ceil(6 * coherence_length / 4 * np.sqrt(2) / pixel))
        else:
            lags = len(axis.window) - 1
        # The lattice must resolve the longest lag.
        self.count = scipy.fft.next_fast_len(max(int(np.ceil(1 / (spacing * pixel))), 2 * lags + 1), real=True)
        self.spacing = 1 / (self.count * pixel)
        self.limit = np.inf if self.is_uniform else 1 / (2 * pixel)
        self.max_q = min(max_frequency, self.limit)
        # At the last frequency, too, three nodes contribute.
        self.max_order = int(np.rint(self.max_q / self.spacing)) + 1
        self.lags = np.arange(-lags, lags + 1)
        # The least-squares projection on splines: the transform of B over the transform of B's autocorrelation at
        # integers.
        x = self.lags / self.count
        self.projection = np.sinc(x) ** 3 * 60 / (33 + 26 * np.cos(2 * np.pi * x) + np.cos(4 * np.pi * x))
        # The autocorrelation of the window, for a uniform axis.
        tau = self.lags * pixel
        self.uniform = np.exp(-(tau**2) / (4 * (coherence_length / 4) ** 2))


class SamplePowers:
    """The B-spline coefficients c_m(κ) of S(q; κ).

    S is band-limited: it is the transform of an autocorrelation that is zero beyond the width of the window. One
    transform gives the coefficients, and others S itself on shifted lattices, from which their error follows.

    Attributes:
        grid: all nodes whose splines overlap the frequencies that light reaches and the pixels resolve.
        transforms: the number of Fourier transforms for one κ.
    """

    def __init__(
        self, height_field: HeightField, coherence_length: float, spacing: float, max_frequency: float
    ) -> None:
        """Take the scan, its effective coherence length in µm, spacing and largest frequency of the nodes in 1/µm."""
        self._height_field = height_field
        self._lags = [
            _Lags(axis, pixel, coherence_length, spacing, max_frequency)
            for axis, pixel in zip(window_axes(height_field, coherence_length), height_field.pixel_size, strict=True)
        ]
        x, y = self._lags
        self._windows = x.axis, y.axis
        self.transforms = len(self._windows[0].starts) * len(self._windows[1].starts)
        self.grid = SplineGrid((x.spacing, y.spacing), (x.max_order, y.max_order), (x.limit, y.limit))
        self._max_q = x.max_q, y.max_q

    def _autocorrelation(self, kappa: float) -> NDArray[np.complex128]:
        """Compute ρ(τ) of the windowed phase, averaged over positions: (lags τ_y, lags τ_x ≥ 0); ρ(0) = 1."""
        axis_x, axis_y = self._windows
        width, height = len(axis_x.window), len(axis_y.window)
        # Padded with zeros, so that the lags do not wrap around.
        shape = scipy.fft.next_fast_len(2 * height - 1), scipy.fft.next_fast_len(2 * width - 1)
        power = mean_periodogram(phase_wave(self._height_field.centred, kappa), axis_x, axis_y, shape)
        half = np.conj(scipy.fft.rfft2(power, norm="forward"))
        half = half[np.arange(-height + 1, height) % shape[0], :width]
        x, y = self._lags
        # Along a uniform axis the single row or column is extended by the autocorrelation of the window.
        if y.is_uniform:
            half = half * y.uniform[:, None]
        if x.is_uniform:
            half = half * x.uniform[x.lags >= 0]
        return half

    def _transform(self, half: NDArray[np.complex128]) -> NDArray[np.float64]:
        """Transform from lags to the nodes of the grid, times Δ_x Δ_y: fractions of the power."""
        x, y = self._lags
        padded = np.zeros((y.count, x.count // 2 + 1), np.complex128)
        padded[y.lags % y.count, : half.shape[1]] = half
        full = scipy.fft.hfft2(padded, (y.count, x.count), norm="forward", overwrite_x=True, workers=2)
        m_x, m_y = (np.arange(-lags.max_order, lags.max_order + 1) for lags in self._lags)
        return full[np.ix_(m_y % y.count, m_x % x.count)]

    def __call__(self, kappa: float) -> NDArray[np.float64]:
        """Compute c_m(κ), (rows, columns), with Σ c = 1 over all frequencies; κ in rad/µm."""
        x, y = self._lags
        return self._transform(self._autocorrelation(kappa) * y.projection[:, None] * x.projection[x.lags >= 0])

    def derivative_bound(self, n: int) -> float:
        """Return an upper bound of ∫|∂ⁿS/∂κⁿ| dq, µmⁿ: the mean of the bounds of all windows."""
        x, y = self._windows
        weights = np.outer(y.window, x.window) ** 2
        segments = np.lib.stride_tricks.sliding_window_view(self._height_field.heights, weights.shape)
        return float(np.mean([derivative_bound(segments[j, i], weights, n) for j in y.starts for i in x.starts]))

    def reached(self, powers: NDArray[np.float64]) -> float:
        """Return the fraction of the power at frequencies that light reaches and pixels resolve, from c_m."""
        return self.grid.within(powers, self._max_q)

    def error(self, kept: OrderGrid | SplineGrid, powers: NDArray[np.float32], kappa: float) -> float:
        """Return ∫|S_approx − S_exact| dq over the frequencies that light reaches; arguments of `TilePowers.error`."""
        autocorrelation = self._autocorrelation(kappa)

        def exact(*shift: int) -> NDArray[np.float64]:
            x, y = (
                np.exp(-2j * np.pi * SHIFTS[s] * lags.lags / lags.count)
                for s, lags in zip(shift, self._lags, strict=True)
            )
            return self._transform(autocorrelation * y[:, None] * x[self._lags[0].lags >= 0])

        return self.grid.error(kept, powers, exact, self._max_q)


# Batches of segments, unlike segments, reveal correlation of a surface over more than the width of a window.
_BATCH_COUNT = 4  # along each axis
_KAPPA_COUNT = 4


def standard_error(
    height_field: HeightField, *, coherence_length: float, max_kappa: float, max_frequency: float
) -> float:
    """Return ∫ dq of the standard error of S(q; κ), a fraction of the reflected power; the maximum over four κ.

    Welch's estimate Ŝ is the mean of P periodograms S_p. Periodograms of overlapping windows are correlated. Where the
    phase results from many independent features (Welch 1967, eq. 10 and 11; a is the window, Σ a² = 1),

        ρ_ij = (Σ_n a(x_n − x_i) a(x_n − x_j))²,     var Ŝ(q) = σ²(q)/P_eff,     1/P_eff = Σ_ij ρ_ij/P²,

    with σ² the variance of one periodogram. It follows from the scatter of the means S_b of at most four batches of
    neighbouring positions along each axis; ⟨·⟩ is weighted by their number, r_b is the mean of ρ within batch b:

        ⟨(S_b − Ŝ)²⟩ = σ² (⟨r_b⟩ − 1/P_eff).

    The variance is averaged over three by three frequencies 1/6σ_s apart, about one lobe, before its root is taken.
    For normally distributed errors the mean of ∫|ΔS| dq, the measure of `GratingSpectrum.error`, is √(2/π) = 0.8 of
    it.

    Args:
        height_field: the scan.
        coherence_length: in µm, supported by the scan.
        max_kappa: κ up to which S is wanted, rad/µm.
        max_frequency: largest |q_x| and |q_y| that light reaches, cycles/µm.
    """
    axes = window_axes(height_field, coherence_length)
    correlation, within = 1.0, 1.0
    for axis in axes:
        rho = _correlation(axis)
        correlation *= rho.mean()
        within *= sum(rho[np.ix_(batch, batch)].sum() / len(batch) for batch in _batches(axis)) / len(axis.starts)
    if within - correlation < 1e-12:
        return 0.0  # a single pixel
    inside_x, inside_y = (
        np.abs(scipy.fft.fftfreq(len(axis.window), pixel)) <= max_frequency
        for axis, pixel in zip(axes, height_field.pixel_size, strict=True)
    )
    errors = []
    for kappa in max_kappa * np.arange(1, _KAPPA_COUNT + 1) / _KAPPA_COUNT:
        variance = _batch_variance(phase_wave(height_field.centred, kappa), axes) * correlation / (within - correlation)
        smooth = scipy.ndimage.uniform_filter(variance, 3, mode="wrap")
        errors.append(inside_y @ np.sqrt(np.maximum(smooth, 0)) @ inside_x)
    return float(max(errors))


def _correlation(axis: WindowAxis) -> NDArray[np.float64]:
    """Compute ρ_ij of the positions along one axis, (P, P)."""
    width = len(axis.window)
    overlap = np.correlate(axis.window, axis.window, "full")[width - 1 :]
    distance = np.abs(axis.starts[:, None] - axis.starts)
    return np.where(distance < width, overlap[np.minimum(distance, width - 1)], 0) ** 2


def _batches(axis: WindowAxis) -> list[NDArray[np.int64]]:
    positions = np.arange(len(axis.starts))
    return np.array_split(positions, min(_BATCH_COUNT, len(positions)))


def _batch_variance(wave: NDArray[np.complex64], axes: list[WindowAxis]) -> NDArray[np.float64]:
    """Compute ⟨(S_b − Ŝ)²⟩ at the frequencies of the transform of the window, (W_y, W_x), S times Δ_x Δ_y."""
    x, y = axes
    shape = len(y.window), len(x.window)
    means, weights = [], []
    for rows in _batches(y):
        for columns in _batches(x):
            batch = WindowAxis(x.window, x.starts[columns]), WindowAxis(y.window, y.starts[rows])
            means.append(mean_periodogram(wave, *batch, shape) / (shape[0] * shape[1]))
            weights.append(len(rows) * len(columns))
    mean = np.average(means, axis=0, weights=weights)
    return np.average((np.array(means) - mean) ** 2, axis=0, weights=weights)
