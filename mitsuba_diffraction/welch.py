"""Welch's method: the windows of an averaged periodogram on a scan (Welch 1967).

A scan is a sample of a larger, irregular surface. Its power spectrum is estimated from windowed segments,

    S(q; κ) = (d_x d_y/P) Σ_p |Σ_n a(x_n − x_p) e^{iκh_n} e^{−2πi q·x_n}|² / Σ_n a²            [µm²]

averaged over P positions x_p; d is the pixel size. No window extends beyond the edge or wraps around.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from .coherence import lobe_width
from .errors import RequestError
from .surface.heightfield import HeightField

# Windows are truncated at ±3 σ_s, where their amplitude is e^{−9/2}, 1 %.
_SUPPORT = 6.0
# Windows of three quarters of the scan leave room for three positions along each axis, σ_s apart.
_LARGEST = 0.5
_FEWEST_PIXELS = 4
# Segments are transformed in batches of about this many numbers.
_BATCH = 1 << 17


@dataclass(frozen=True, eq=False)
class WindowAxis:
    """The windows along one axis.

    Attributes:
        window: a, (W,), sampled at the pixels, Σ a² = 1.
        starts: first pixel of each position.
    """

    window: NDArray[np.float64] = field(repr=False)
    starts: NDArray[np.int64] = field(repr=False)


UNIFORM = WindowAxis(np.ones(1), np.zeros(1, np.int64))
"""The window along an axis of one pixel."""


def carried_coherence_length(height_field: HeightField, asked: float) -> float:
    """The coherence length in µm that a scan supports: `asked`, but at most half of its shorter side.

    An axis of one pixel imposes no limit: the surface is uniform along it.

    Raises:
        ValueError: if it is below four pixels, too short for a window.
    """
    lobe_width(asked)
    axes = list(zip(height_field.tile_size, height_field.pixel_size, height_field.shape[::-1], strict=True))
    carried = min([float(asked), *(_LARGEST * size for size, _, count in axes if count > 1)])
    for _, pixel, count in axes:
        if count > 1 and carried < _FEWEST_PIXELS * pixel * (1 - 1e-9):
            raise RequestError(
                f"coherence_length: got {asked:g} µm, of which the scan of {axes[0][0]:.4g} × {axes[1][0]:.4g} µm "
                f"carries {carried:.4g}; wanted at least {_FEWEST_PIXELS} pixels ({_FEWEST_PIXELS * pixel:.4g} µm)"
            )
    return carried


def window_axes(height_field: HeightField, coherence_length: float) -> tuple[WindowAxis | None, WindowAxis | None]:
    """The windows along x and y for a coherence length (µm) that the scan supports; None for an axis of one pixel.

    a(x) = exp(−x²/2σ_s²) with σ_s = L_c/4, about the centre of its support, 6σ_s rounded up to whole pixels. The
    positions are evenly spaced from edge to edge of the scan, at most σ_s apart, rounded to whole pixels.
    """
    sigma = coherence_length / 4
    return tuple(
        _axis(count, pixel, sigma) if count > 1 else None
        for count, pixel in zip(height_field.shape[::-1], height_field.pixel_size, strict=True)
    )


def mean_periodogram(
    wave: NDArray[np.complex128], x: WindowAxis, y: WindowAxis, shape: tuple[int, int]
) -> NDArray[np.float64]:
    """(1/P) Σ_p |Σ_n a(x_n − x_p) wave_n e^{−2πi q·x_n}|² over all positions of the windows along x and y.

    Args:
        wave: (rows, columns) at the pixels.
        x: windows along x.
        y: windows along y.
        shape: (rows, columns) of the result, at least those of the window: q as in `scipy.fft.fft2` of zero-padded
            segments.
    """
    window = np.outer(y.window, x.window)
    segments = np.lib.stride_tricks.sliding_window_view(wave, window.shape)
    places = np.array([(row, column) for row in y.starts for column in x.starts])
    total, step = np.zeros(shape), max(1, _BATCH // (shape[0] * shape[1]))
    for first in range(0, len(places), step):
        row, column = places[first : first + step].T
        transform = scipy.fft.fft2(segments[row, column] * window, shape, overwrite_x=True, workers=2)
        total += (transform.real**2 + transform.imag**2).sum(axis=0)
    return total / len(places)


def _axis(count: int, pixel: float, sigma: float) -> WindowAxis:
    width = min(count, max(_FEWEST_PIXELS, _rounded_up(_SUPPORT * sigma / pixel)))
    x = (np.arange(width) - (width - 1) / 2) * pixel
    window = np.exp(-(x**2) / (2 * sigma**2))
    places = _rounded_up((count - width) * pixel / sigma) + 1
    return WindowAxis(window / np.linalg.norm(window), np.rint(np.linspace(0, count - width, places)).astype(np.int64))


def _rounded_up(value: float) -> int:
    """The ceiling, tolerant of rounding errors just above an integer."""
    return int(np.ceil(value * (1 - 1e-9)))
