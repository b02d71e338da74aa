"""The spectrum of a piece of a larger, irregular surface, by Welch's method (`welch.py`)."""

from __future__ import annotations

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from ..coherence import lobe_width
from ..surface.heightfield import HeightField
from ..welch import UNIFORM, WindowAxis, mean_periodogram, window_axes
from .spline_grid import SplineGrid

# Along an axis on which the surface is uniform the lobe is followed to this many σ_q.
_UNIFORM_REACH = 6.0


class _Lags:
    """One axis: the lags τ of the autocorrelation, and the frequency lattice that its transform falls on."""

    def __init__(self, axis: WindowAxis | None, pixel: float, coherence_length: float, spacing: float, reach: float):
        self.axis = axis
        sigma = lobe_width(coherence_length)
        if axis is None:
            pixel, reach = 1 / (4 * _UNIFORM_REACH * sigma), _UNIFORM_REACH * sigma
            lags = int(np.ceil(6 * coherence_length / 4 * np.sqrt(2) / pixel))
        else:
            lags = len(axis.window) - 1
        # The lattice must resolve the longest lag.
        self.count = scipy.fft.next_fast_len(max(int(np.ceil(1 / (spacing * pixel))), 2 * lags + 1), real=True)
        self.spacing = 1 / (self.count * pixel)
        self.limit = np.inf if axis is None else 1 / (2 * pixel)
        self.reached = min(reach, self.limit)
        # Three nodes hold at the last frequency, too. Beyond the Nyquist limit S repeats.
        self.largest = int(np.rint(self.reached / self.spacing)) + 1
        self.lags = np.arange(-lags, lags + 1)
        self.pixel = pixel
        # The transform of B, and of Σ_k B(x − k) times itself: dividing projects on the splines in the least squares.
        x = self.lags / self.count
        self.projection = np.sinc(x) ** 3 * 60 / (33 + 26 * np.cos(2 * np.pi * x) + np.cos(4 * np.pi * x))
        # Of a uniform axis, the autocorrelation of the window itself.
        tau = self.lags * pixel
        self.uniform = np.exp(-(tau**2) / (4 * (coherence_length / 4) ** 2))


class SamplePowers:
    """The B-spline coefficients c_m(κ) of S(q; κ).

    S is band-limited: it is the transform of an autocorrelation that ends at the windows' width. So the coefficients
    come from one transform of it, and S itself can be had at any other lattice exactly, which measures their error.

    Attributes:
        grid: all nodes whose splines hold where light reaches and the pixels resolve.
    """

    def __init__(self, height_field: HeightField, coherence_length: float, spacing: float, reach: float) -> None:
        """Takes the scan, the coherence length it carries (µm), and the spacing and reach of the nodes (cycles/µm)."""
        self._phase = height_field.centred
        self._lags = [
            _Lags(axis, pixel, coherence_length, spacing, reach)
            for axis, pixel in zip(window_axes(height_field, coherence_length), height_field.pixel_size, strict=True)
        ]
        x, y = self._lags
        self.grid = SplineGrid((x.spacing, y.spacing), (x.largest, y.largest), (x.limit, y.limit))
        self._reached = x.reached, y.reached
        self._random = np.random.default_rng(0)

    def _autocorrelation(self, kappa: float) -> NDArray[np.complex128]:
        """ρ(τ) of the windowed phase, averaged over the places: (lags τ_y, lags τ_x ≥ 0); ρ(0) = 1."""
        axis_x, axis_y = (lags.axis or UNIFORM for lags in self._lags)
        width, height = len(axis_x.window), len(axis_y.window)
        # Padded with zeros, so that the lags do not wrap around.
        shape = scipy.fft.next_fast_len(2 * height - 1), scipy.fft.next_fast_len(2 * width - 1)
        power = mean_periodogram(np.exp(1j * kappa * self._phase), axis_x, axis_y, shape)
        half = np.conj(scipy.fft.rfft2(power, norm="forward"))
        half = half[np.arange(-height + 1, height) % shape[0], :width]
        x, y = self._lags
        # Along a uniform axis the only row, or column, is drawn out by the window's own autocorrelation.
        if y.axis is None:
            half = half * y.uniform[:, None]
        if x.axis is None:
            half = half * x.uniform[x.lags >= 0]
        return half

    def _transform(self, half: NDArray[np.complex128]) -> NDArray[np.float64]:
        """From lags to the nodes of the grid, times the area of a cell: shares of the power."""
        x, y = self._lags
        padded = np.zeros((y.count, x.count // 2 + 1), np.complex128)
        padded[y.lags % y.count, : half.shape[1]] = half
        full = scipy.fft.hfft2(padded, (y.count, x.count), norm="forward", overwrite_x=True, workers=2)
        m_x, m_y = (np.arange(-lags.largest, lags.largest + 1) for lags in self._lags)
        return full[np.ix_(m_y % y.count, m_x % x.count)]

    def __call__(self, kappa: float) -> NDArray[np.float64]:
        """c_m(κ), (rows, columns), with Σ c = 1 over all frequencies; κ in rad/µm."""
        x, y = self._lags
        return self._transform(self._autocorrelation(kappa) * y.projection[:, None] * x.projection[x.lags >= 0])

    def reached(self, powers: NDArray[np.float64]) -> float:
        """The share of the power where light reaches and the pixels resolve; takes c_m of the grid."""
        return self.grid.within(powers, self._reached)

    def error(self, kept: SplineGrid, powers: NDArray[np.float32], kappa: float) -> float:
        """∫|S_approx − S_exact| dq where light reaches, by the rule of rectangles on a shifted lattice.

        Args:
            kept: the smaller grid of the approximation.
            powers: c_m on it; zero outside.
            kappa: κ in rad/µm.
        """
        shift = self._random.uniform(-0.5, 0.5, 2)
        ramp = [np.exp(-2j * np.pi * s * lags.lags / lags.count) for s, lags in zip(shift, self._lags, strict=True)]
        exact = self._transform(self._autocorrelation(kappa) * ramp[1][:, None] * ramp[0][self._lags[0].lags >= 0])
        return self.grid.error(kept, powers, exact, shift, self._reached)
