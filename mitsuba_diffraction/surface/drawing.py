"""What profiles are drawn with: checks of their sizes, random numbers, and a canvas for small shapes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

from ..array_types import Real
from ..errors import RequestError, check_whole, is_number
from .heightfield import HeightField, as_pixel_size

MAX_PIXELS = 2**26
"""Of a profile: half a gigabyte of heights."""

_MIN_PERIOD, MAX_PERIOD = 1e-3, 100.0
"""µm: atoms are closer than the first; of the second, orders of visible light are 0.3° apart, about the width of the
sun. A period or a depth given in nm is larger."""


def check_pixels(columns: float, rows: float) -> None:
    """Refuse too large a patch before its memory is allocated."""
    if not columns * rows <= MAX_PIXELS:
        raise RequestError(f"got a patch of {columns:.4g} × {rows:.4g} pixels, wanted at most {MAX_PIXELS} in all")


def check_positive(name: str, value: float, unit: str = "in µm") -> None:
    if not (is_number(value) and value > 0):
        raise RequestError(f"{name}: got {value!r}, wanted a positive number {unit}")


def check_period(name: str, value: float) -> None:
    check_positive(name, value)
    if value < _MIN_PERIOD:
        raise RequestError(f"{name}: got {value!r} µm, wanted at least {_MIN_PERIOD:g}")
    if value > MAX_PERIOD:
        raise RequestError(
            f"{name}: got {value!r} µm, wanted at most {MAX_PERIOD:g}; is it in nm ({value / 1e3:g} µm)? A grating "
            "that is really that coarse may be given as an array of heights"
        )


def check_profile(period: float, depth: float, samples: int = 2) -> None:
    check_period("period", period)
    if not (is_number(depth) and depth >= 0):
        raise RequestError(f"depth: got {depth!r}, wanted a number in µm, zero or more")
    if depth > MAX_PERIOD:
        raise RequestError(f"depth: got {depth!r} µm, wanted at most {MAX_PERIOD:g}; is it in nm ({depth / 1e3:g} µm)?")
    check_whole("samples", samples, 2)
    check_pixels(samples, 1)


def generator(seed: int) -> np.random.Generator:
    check_whole("seed", seed, 0)
    return np.random.default_rng(int(seed))


def phase(samples: int) -> Real:
    """Return x / period at the centres of the pixels, (samples,)."""
    return (np.arange(samples) + 0.5) / samples


def one_row(heights: Real, period: float, source: str) -> HeightField:
    return HeightField(heights[None, :], (period / len(heights), period), source)


class Canvas:
    """A periodic patch for drawing small shapes, which wrap around at its edges.

    Attributes:
        size: (x, y) µm, along the diffracting axis rounded to a whole number of pitches.
        count: numbers of pitches along x and y.
        pitch: (x, y) µm, mean spacings, which divide the size.
        heights: (N_y, N_x) µm.
    """

    def __init__(
        self, size: float | tuple[float, float], pixel_size: float, pitch: tuple[float, float], axis: int
    ) -> None:
        try:
            self.size = as_pixel_size(size)
        except RequestError:
            raise RequestError(f"size: got {size!r}, wanted a positive number or (x, y) in µm") from None
        check_positive("pixel_size", pixel_size)
        if self.size[0] < 2 * pitch[0] or self.size[1] < 4 * pitch[1]:
            raise RequestError(
                f"size: got {size!r} µm, wanted at least 2 × 4 mean spacings, {2 * pitch[0]:.4g} × {4 * pitch[1]:.4g} "
                "µm"
            )
        if pixel_size > min(pitch) / 4:
            raise RequestError(f"pixel_size: got {pixel_size!r} µm, wanted at most {min(pitch) / 4:.4g} µm")
        check_pixels(*(s / pixel_size for s in self.size))
        columns, rows = (round(s / pixel_size) for s in self.size)
        self.count = tuple(round(s / p) for s, p in zip(self.size, pitch, strict=True))
        # The period is preserved: along its axis the size is adjusted, not the pitch.
        x, y = (pitch[i] * self.count[i] if i == axis else self.size[i] for i in (0, 1))
        self.size = (x, y)
        self.pitch = tuple(s / n for s, n in zip(self.size, self.count, strict=True))
        self.pixel = (self.size[0] / columns, self.size[1] / rows)
        self.heights = np.zeros((rows, columns))

    def centres(self, axis: int) -> Real:
        """Return the centres of the pitches along x (0) or y (1), µm."""
        return (np.arange(self.count[axis], dtype=np.float64) + 0.5) * self.pitch[axis]

    def window(
        self, x: tuple[float, float], y: tuple[float, float]
    ) -> tuple[tuple[NDArray[np.signedinteger], ...], Real, Real]:
        """Return the pixels of the box x[0]…x[1], y[0]…y[1] µm.

        Returns:
            index: of the pixels in `heights`, wrapped.
            X, Y: centres of the pixels, (1, n_x) and (n_y, 1), µm, not wrapped.
        """
        columns, rows = (
            np.arange(int(np.floor(a / p)), min(int(np.ceil(b / p)), int(np.floor(a / p)) + n))
            for (a, b), p, n in zip((x, y), self.pixel, self.heights.shape[::-1], strict=True)
        )
        index = np.ix_(rows % self.heights.shape[0], columns % self.heights.shape[1])
        x_index, y_index = columns[None, :].astype(np.float64), rows[:, None].astype(np.float64)
        return index, (x_index + 0.5) * self.pixel[0], (y_index + 0.5) * self.pixel[1]

    def noise(self, rng: np.random.Generator, length_x: float, length_y: float) -> Real:
        """Draw periodic Gaussian noise, mean 0, variance 1, correlation exp(−x²/4 length_x² − …), (N_y, N_x)."""
        rows, columns = self.heights.shape
        q_x = np.fft.rfftfreq(columns, self.pixel[0])
        q_y = np.fft.fftfreq(rows, self.pixel[1])[:, None]
        filter_ = np.exp(-2 * np.pi**2 * ((q_x * length_x) ** 2 + (q_y * length_y) ** 2))
        filter_[0, 0] = 0
        field = np.fft.irfft2(np.fft.rfft2(rng.standard_normal((rows, columns))) * filter_, s=(rows, columns))
        return field / field.std()

    def value_at(self, field: Real, x: float, y: float) -> float:
        """Return the value of a field at a position, µm, wrapped."""
        rows, columns = field.shape
        return field[int(y / self.pixel[1]) % rows, int(x / self.pixel[0]) % columns]

    def height_field(self, rng: np.random.Generator, depth: float, source: str) -> HeightField:
        """Return the drawing, scaled to `depth` and shifted by a random offset, as seeds must not share a lattice."""
        heights = np.roll(self.heights - self.heights.min(), rng.integers(self.heights.shape), axis=(0, 1))
        return HeightField(heights / heights.max() * depth, self.pixel, source)


def smooth_step(x: Real, width: float) -> Real:
    """Return a smooth step from 0 to 1 at x = 0."""
    return (1 + erf(x / width)) / 2
