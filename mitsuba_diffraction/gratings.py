"""Height fields by formula: classical gratings, and synthetic stand-ins for two snake skins.

Every profile is one exact period of a surface that repeats for ever: a tile (extent "tile" of the spectrum). Lengths
are in µm. The classical profiles are sampled at the centres of their pixels.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from numbers import Integral, Real

import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

from .heightfield import HeightField, as_pixel_size

Array = NDArray[np.float64]


def blazed(period: float, depth: float, *, samples: int = 512) -> HeightField:
    """Sawtooth h = depth · x / period, rising along +x.

    At normal incidence its facets mirror the light towards −x: into ω_o = −λq with q = m / period, m = 2 depth / λ.

    Args:
        period: length of a tooth along x, µm.
        depth: height of a tooth, µm.
        samples: pixels per period.

    Returns:
        One period, (1, samples).

    Raises:
        ValueError: if the period is not positive, the depth negative, or samples below two.
    """
    _check_profile(period, depth, samples)
    heights = depth * _phase(samples)
    return _one_row(heights, period, f"blazed grating, period {period:g} µm, depth {depth:g} µm")


def sinusoidal(period: float, depth: float, *, samples: int = 512) -> HeightField:
    """Sinusoid h = (depth / 2) · sin(2π x / period), so |F_m|² = J_m(κ · depth / 2)².

    Args:
        period: wavelength of the surface along x, µm.
        depth: from the valleys to the peaks, µm.
        samples: pixels per period.

    Returns:
        One period, (1, samples).

    Raises:
        ValueError: if the period is not positive, the depth negative, or samples below two.
    """
    _check_profile(period, depth, samples)
    heights = depth / 2 * np.sin(2 * np.pi * _phase(samples))
    return _one_row(heights, period, f"sinusoidal grating, period {period:g} µm, depth {depth:g} µm")


def lamellar(period: float, depth: float, *, duty: float = 0.5, samples: int = 512) -> HeightField:
    """Binary grating: the first part of the period stands at `depth`, the rest at zero.

    Args:
        period: distance from ridge to ridge along x, µm.
        depth: height of the ridges, µm.
        duty: fraction of the period that is high; rounded to whole pixels.
        samples: pixels per period.

    Returns:
        One period, (1, samples).

    Raises:
        ValueError: if the period is not positive, the depth negative, samples below two, or if the ridge or the
            groove is narrower than half a pixel.
    """
    _check_profile(period, depth, samples)
    if not (isinstance(duty, Real) and 0 < duty < 1):
        raise ValueError(f"duty: got {duty!r}, wanted a fraction above 0 and below 1")
    high = round(duty * samples)
    if not 0 < high < samples:
        raise ValueError(f"duty: got {duty!r} with {samples} samples, wanted ridge and groove at least a pixel wide")
    heights = np.where(np.arange(samples) < high, depth, 0.0)
    return _one_row(
        heights, period, f"lamellar grating, period {period:g} µm, depth {depth:g} µm, duty {high / samples:g}"
    )


def crossed(period: float, depth: float, *, period_y: float | None = None, samples: int = 128) -> HeightField:
    """Sum of a sinusoid along x and one along y, so that the orders are products |F_m|² = |F_{m_x}|² |F_{m_y}|².

    Args:
        period: wavelength along x, µm.
        depth: from the valleys to the peaks of *each* sinusoid, µm; the sum spans twice that.
        period_y: wavelength along y, µm; that along x if left out.
        samples: pixels per period in either direction.

    Returns:
        One period in each direction, (samples, samples).

    Raises:
        ValueError: if a period is not positive, the depth negative, or samples below two.
    """
    _check_profile(period, depth, samples)
    period_y = period if period_y is None else period_y
    _check_positive("period_y", period_y)
    wave = depth / 2 * np.sin(2 * np.pi * _phase(samples))
    return HeightField(
        wave[:, None] + wave,
        (period / samples, period_y / samples),
        f"crossed grating, periods {period:g} × {period_y:g} µm, depth {depth:g} µm each",
    )


def elaphe(
    size: float | tuple[float, float] = 32.0,
    *,
    pixel_size: float = 0.0625,
    depth: float = 0.375,
    period: float = 1.144,
    seed: int = 0,
) -> HeightField:
    """Synthetic stand-in for the shed skin of *Elaphe guttata*, not a measurement.

    Fingers along x that taper towards +x, side by side along **y**: the diffracting direction is y. Between two
    fingers a groove starts as a deep narrow crotch and widens up to the fingers' tips, where the next row of fingers
    begins, 2.93 periods further on. Granules sit on top of the fingers. Positions, lengths, widths, heights and tilts
    scatter from finger to finger as in the AFM scans of such skins. The shape was drawn after a 5.9 µm AFM scan of
    the LANE lab, Geneva.

    The patch has no seams, so it holds whole numbers of fingers and rows. size_y is rounded to whole periods, so that
    the period is kept; the pitch of the rows fills size_x.

    Args:
        size: wanted extent of the patch, µm, one number or (x, y).
        pixel_size: wanted pixel, µm; adjusted so that a whole number of pixels fills the patch.
        depth: lowest to highest point, µm.
        period: mean distance from finger to finger along y, µm.
        seed: of the random numbers; the same seed gives the same skin.

    Returns:
        The patch, (round(size_y / pixel_size), round(size_x / pixel_size)).

    Raises:
        ValueError: if a length is not positive, the depth negative, the seed not a natural number, the size below two
            rows or four fingers, or the pixels too coarse for the fingers.
    """
    _check_profile(period, depth)
    rng = _generator(seed)
    canvas = _Canvas(size, pixel_size, pitch=(2.93 * period, period), axis=1)
    row_pitch, pitch = canvas.pitch

    # The lattice of crotches: it drifts slowly, rows shift against each other, and every crotch has its own place.
    drift_x = 0.08 * row_pitch * canvas.noise(rng, 8.0, 4.0)
    drift_y = 0.12 * pitch * canvas.noise(rng, 8.0, 8.0)
    granules = np.zeros_like(canvas.heights)
    for x, row_shift in zip(canvas.places(0), rng.normal(0, 0.05 * pitch, canvas.count[0]), strict=True):
        for y in canvas.places(1):
            x_0 = x + canvas.at(drift_x, x, y) + rng.normal(0, 0.04 * row_pitch)
            y_0 = y + canvas.at(drift_y, x, y) + row_shift + rng.normal(0, 0.035 * pitch)
            _elaphe_groove(canvas, rng, x_0, y_0)
            _elaphe_tip(canvas, rng, x_0, y_0 + pitch / 2)
            _elaphe_granules(canvas, granules, rng, x_0, y_0 + pitch / 2)
    # Fibrils run along the fingers; the rest is roughness.
    canvas.heights += granules
    canvas.heights += 0.005 * canvas.noise(rng, 0.3, 0.04) + 0.008 * canvas.noise(rng, 1.5, 0.7)
    return canvas.height_field(
        rng,
        depth,
        f"synthetic Elaphe skin, {canvas.count[1]} fingers of {pitch:.4g} µm along y, "
        f"{canvas.count[0]} rows of {row_pitch:.4g} µm along x, depth {depth:g} µm, seed {seed}",
    )


def xenopeltis(
    size: float | tuple[float, float] = 32.0,
    *,
    pixel_size: float = 0.0625,
    depth: float = 0.443,
    period: float = 1.552,
    seed: int = 0,
) -> HeightField:
    """Synthetic stand-in for the shed skin of *Xenopeltis unicolor*, not a measurement.

    Rows of short round fingers: the fingers point along +x and rise towards their tips, like roof tiles; a row runs
    along y, the next follows one period further along **x**, which is the diffracting direction. Rows meander by 10 to
    20 degrees and now and then fork or end. Fingers stand 0.36 periods apart along y, with small deep pits between
    them, and here and there two are joined. The shape was drawn after a 5.9 µm AFM scan of the LANE lab, Geneva.

    The patch has no seams, so it holds whole numbers of rows and fingers. size_x is rounded to whole periods, so that
    the period is kept; the pitch of the fingers fills size_y.

    Args:
        size: wanted extent of the patch, µm, one number or (x, y).
        pixel_size: wanted pixel, µm; adjusted so that a whole number of pixels fills the patch.
        depth: lowest to highest point, µm.
        period: mean distance from row to row along x, µm.
        seed: of the random numbers; the same seed gives the same skin.

    Returns:
        The patch, (round(size_y / pixel_size), round(size_x / pixel_size)).

    Raises:
        ValueError: if a length is not positive, the depth negative, the seed not a natural number, the size below two
            rows or four fingers, or the pixels too coarse for the fingers.
    """
    _check_profile(period, depth)
    rng = _generator(seed)
    canvas = _Canvas(size, pixel_size, pitch=(period, 0.36 * period), axis=0)
    row_pitch, pitch = canvas.pitch

    meander = 0.11 * row_pitch * canvas.noise(rng, 6.0, 1.3)
    faults = _faults(canvas, rng)
    rows = [(x, None) for x in canvas.places(0)] + [(fault.x, fault) for fault in faults if fault.extra]
    grooves, tips = [], []
    for x, own in rows:
        # Every row has a phase of its own, and a finger more or less than its neighbours where there are many.
        count = canvas.count[1] + round(rng.normal(0, 0.012 * canvas.count[1]))
        row_phase = rng.uniform()
        for index in range(count):
            y = (index + row_phase + rng.normal(0, 0.09)) * canvas.size[1] / count
            if not _present(faults, own, x, y, canvas):
                continue
            x_0 = x + _fault_shift(faults, x, y, canvas)
            x_0 += canvas.at(meander, x_0, y)
            length = row_pitch * (1 + rng.normal(0, 0.05))
            tips.append((x_0, y, length))
            grooves.append((x_0, y + pitch / 2, length))
    for x_0, y_0, length in tips:
        _xenopeltis_finger(canvas, rng, x_0, y_0, length)
    for x_0, y_0, length in grooves:
        _xenopeltis_pit(canvas, rng, x_0, y_0, length)
    canvas.heights += 0.005 * canvas.noise(rng, 0.07, 0.04) + 0.006 * canvas.noise(rng, 1.0, 1.0)
    return canvas.height_field(
        rng,
        depth,
        f"synthetic Xenopeltis skin, {canvas.count[0]} rows of {row_pitch:.4g} µm along x, "
        f"fingers of {pitch:.3g} µm along y, depth {depth:g} µm, seed {seed}",
    )


PROFILES: dict[str, Callable[..., HeightField]] = {
    "blazed": blazed,
    "sinusoidal": sinusoidal,
    "lamellar": lamellar,
    "crossed": crossed,
    "elaphe": elaphe,
    "xenopeltis": xenopeltis,
}
"""Name of a profile, as recipes and scenes write it → the function that makes it."""


# ---------------------------------------------------------------- the classical profiles


def _phase(samples: int) -> Array:
    """x / period at the centres of the pixels, (samples,)."""
    return (np.arange(samples) + 0.5) / samples


def _one_row(heights: Array, period: float, source: str) -> HeightField:
    return HeightField(heights[None, :], (period / len(heights), period), source)


def _check_positive(name: str, value: float) -> None:
    if not (isinstance(value, Real) and np.isfinite(value) and value > 0):
        raise ValueError(f"{name}: got {value!r}, wanted a positive number in µm")


def _check_profile(period: float, depth: float, samples: int = 2) -> None:
    _check_positive("period", period)
    if not (isinstance(depth, Real) and np.isfinite(depth) and depth >= 0):
        raise ValueError(f"depth: got {depth!r}, wanted a number in µm, zero or more")
    if not (isinstance(samples, Integral) and samples >= 2):
        raise ValueError(f"samples: got {samples!r}, wanted a whole number of at least 2")


def _generator(seed: int) -> np.random.Generator:
    if not (isinstance(seed, Integral) and seed >= 0):
        raise ValueError(f"seed: got {seed!r}, wanted a whole number, zero or more")
    return np.random.default_rng(int(seed))


# ---------------------------------------------------------------- drawing on a torus


class _Canvas:
    """A periodic patch on which small shapes are drawn; what leaves it on one side comes back on the other.

    Attributes:
        size: (x, y) µm, along the diffracting axis rounded to a whole number of pitches.
        count: whole numbers of pitches along x and y.
        pitch: (x, y) µm, the mean distances that fill the size.
        heights: (N_y, N_x) µm.
    """

    def __init__(
        self, size: float | tuple[float, float], pixel_size: float, pitch: tuple[float, float], axis: int
    ) -> None:
        try:
            self.size = as_pixel_size(size)
        except ValueError:
            raise ValueError(f"size: got {size!r}, wanted a positive number or (x, y) in µm") from None
        _check_positive("pixel_size", pixel_size)
        if self.size[0] < 2 * pitch[0] or self.size[1] < 4 * pitch[1]:
            raise ValueError(
                f"size: got {size!r} µm, wanted at least 2 rows × 4 fingers, {2 * pitch[0]:.4g} × {4 * pitch[1]:.4g} µm"
            )
        if pixel_size > min(pitch) / 4:
            raise ValueError(f"pixel_size: got {pixel_size!r} µm, wanted at most {min(pitch) / 4:.4g} µm")
        columns, rows = (round(s / pixel_size) for s in self.size)
        self.count = tuple(round(s / p) for s, p in zip(self.size, pitch, strict=True))
        # The period is what is seen: along its axis the size gives way, not the pitch.
        self.size = tuple(pitch[i] * self.count[i] if i == axis else self.size[i] for i in (0, 1))
        self.pitch = tuple(s / n for s, n in zip(self.size, self.count, strict=True))
        self.pixel = (self.size[0] / columns, self.size[1] / rows)
        self.heights = np.zeros((rows, columns))

    def places(self, axis: int) -> Array:
        """Centres of the pitches along x (0) or y (1), µm."""
        return (np.arange(self.count[axis]) + 0.5) * self.pitch[axis]

    def window(self, x: tuple[float, float], y: tuple[float, float]) -> tuple[tuple[Array, Array], Array, Array]:
        """Pixels of the box x[0]…x[1], y[0]…y[1] µm.

        Returns:
            index: of the pixels in `heights`, wrapped round.
            X, Y: centres of the pixels, (1, n_x) and (n_y, 1), µm, not wrapped.
        """
        columns, rows = (
            np.arange(int(np.floor(a / p)), min(int(np.ceil(b / p)), int(np.floor(a / p)) + n))
            for (a, b), p, n in zip((x, y), self.pixel, self.heights.shape[::-1], strict=True)
        )
        index = np.ix_(rows % self.heights.shape[0], columns % self.heights.shape[1])
        return index, (columns[None, :] + 0.5) * self.pixel[0], (rows[:, None] + 0.5) * self.pixel[1]

    def noise(self, rng: np.random.Generator, length_x: float, length_y: float) -> Array:
        """Periodic Gaussian noise, mean 0, standard deviation 1, correlation exp(−x²/4 length_x² − …), (N_y, N_x)."""
        rows, columns = self.heights.shape
        q_x = np.fft.rfftfreq(columns, self.pixel[0])
        q_y = np.fft.fftfreq(rows, self.pixel[1])[:, None]
        filter_ = np.exp(-2 * np.pi**2 * ((q_x * length_x) ** 2 + (q_y * length_y) ** 2))
        filter_[0, 0] = 0
        field = np.fft.irfft2(np.fft.rfft2(rng.standard_normal((rows, columns))) * filter_, s=(rows, columns))
        return field / field.std()

    def at(self, field: Array, x: float, y: float) -> float:
        """Value of a field at a place, µm, wrapped round."""
        rows, columns = field.shape
        return field[int(y / self.pixel[1]) % rows, int(x / self.pixel[0]) % columns]

    def height_field(self, rng: np.random.Generator, depth: float, source: str) -> HeightField:
        """What was drawn, scaled to `depth`, from a random origin: two seeds do not share a lattice."""
        heights = np.roll(self.heights - self.heights.min(), rng.integers(self.heights.shape), axis=(0, 1))
        return HeightField(heights / heights.max() * depth, self.pixel, source)


def _step(x: Array, width: float) -> Array:
    """Smooth step from 0 to 1 at x = 0."""
    return (1 + erf(x / width)) / 2


# ---------------------------------------------------------------- Elaphe
# Heights in µm as they were read off the mean unit cell of the AFM patch; the patch is scaled to `depth` at the end.


def _elaphe_groove(canvas: _Canvas, rng: np.random.Generator, x_0: float, y_0: float) -> None:
    """The groove between two fingers, from its crotch at (x_0, y_0) along +x."""
    row_pitch, pitch = canvas.pitch
    length = row_pitch * (0.97 + rng.normal(0, 0.035))
    tilt = (-0.1 + rng.normal(0, 0.05)) * pitch / row_pitch
    width = 0.38 + rng.normal(0, 0.035)
    floor = 0.09 * rng.uniform(0.8, 1.2)
    crotch = 0.03 + 0.09 * rng.beta(1, 3)
    index, x, y = canvas.window((x_0 - 0.15 * row_pitch, x_0 + 1.3 * row_pitch), (y_0 - 0.8 * pitch, y_0 + 0.8 * pitch))
    s = (x - x_0) / length
    t = (y - y_0 - tilt * (x - x_0)) / pitch
    half = width * np.clip(s, 0, 1) ** 0.7
    groove = _step(half - np.abs(t), 0.105) * _step(s, 0.05) * (1 - _step(s - 1.09 + 0.15 * np.abs(t), 0.13))
    dip = np.exp(-(((s - 0.1) / 0.1) ** 2) - ((t / (0.085 + 0.03 * np.clip(s / 0.2, 0, 1))) ** 2))
    canvas.heights[index] -= floor * groove + crotch * dip


def _elaphe_tip(canvas: _Canvas, rng: np.random.Generator, x_0: float, y_0: float) -> None:
    """The round edge where a finger ends on the next row, which lies lower there and rises again."""
    row_pitch, pitch = canvas.pitch
    x_tip = x_0 + row_pitch * (0.93 + rng.normal(0, 0.05))
    y_tip = y_0 - 0.1 * pitch
    drop = 0.028 * rng.uniform(0.4, 1.6)
    index, x, y = canvas.window((x_tip - 0.3 * row_pitch, x_tip + 0.8 * row_pitch), (y_tip - pitch, y_tip + pitch))
    t = (y - y_tip) / pitch
    s = (x - x_tip) / row_pitch + 0.5 * t**2
    canvas.heights[index] -= drop * _step(s, 0.02) * np.exp(-np.maximum(s, 0) / 0.12) * np.exp(-((t / 0.42) ** 4))


def _elaphe_granules(canvas: _Canvas, granules: Array, rng: np.random.Generator, x_0: float, y_0: float) -> None:
    """A few large granules and some small ones along the ridge of a finger; where two meet, the higher stays."""
    row_pitch, pitch = canvas.pitch
    for number, radius, height in ((rng.poisson(2.6), 0.12, 0.09), (rng.poisson(5.0), 0.055, 0.03)):
        for _ in range(number):
            size = rng.uniform(0.7, 1.35)
            along = rng.uniform(0.0, 0.9)
            x_g = x_0 + along * row_pitch
            y_g = y_0 - 0.1 * along * pitch + rng.normal(0, 0.08) * pitch
            r = radius * size
            index, x, y = canvas.window((x_g - 3.5 * r, x_g + 4.5 * r), (y_g - 3 * r, y_g + 3 * r))
            # Granules lean along the finger, as the scan shows them.
            stretch = np.where(x > x_g, 1.4, 1.0)
            granule = height * size * np.exp(-(((x - x_g) / (stretch * r)) ** 2) - ((y - y_g) / r) ** 2)
            granules[index] = np.maximum(granules[index], granule)


# ---------------------------------------------------------------- Xenopeltis


@dataclass(frozen=True)
class _Fault:
    """A stretch along y where there is a row more or a row less: rows fork or join at its ends.

    Attributes:
        x, y: centre, µm.
        half: half the length along y, µm.
        extra: True for a row more, False for a row less.
    """

    x: float
    y: float
    half: float
    extra: bool

    def weight(self, y: float, size_y: float) -> float:
        """1 inside the fault, 0 outside, smooth at its ends."""
        d = _wrapped(y - self.y, size_y)
        return float((erf((d + self.half) / 1.2) - erf((d - self.half) / 1.2)) / 2)


def _wrapped(distance: float, size: float) -> float:
    """Shortest distance on a circle of circumference `size`."""
    return (distance + size / 2) % size - size / 2


def _faults(canvas: _Canvas, rng: np.random.Generator) -> list[_Fault]:
    """Faults apart from each other, about one per 200 µm²; as many rows more as less, so that the mean pitch stays."""
    row_pitch = canvas.pitch[0]
    faults: list[_Fault] = []
    wanted = 2 * round(canvas.size[0] * canvas.size[1] / 400)
    for _ in range(20 * wanted):
        if len(faults) == wanted:
            break
        extra = len(faults) % 2 == 0
        # A row more lies between two rows, a row less in the place of one.
        x = (rng.integers(canvas.count[0]) + (1.0 if extra else 0.5)) * row_pitch % canvas.size[0]
        fault = _Fault(x, rng.uniform(0, canvas.size[1]), rng.uniform(1.5, 3.0), extra)
        if all(
            abs(_wrapped(x - other.x, canvas.size[0])) > 3.2 * row_pitch
            or abs(_wrapped(fault.y - other.y, canvas.size[1])) > fault.half + other.half + 2.5
            for other in faults
        ):
            faults.append(fault)
    return faults[: len(faults) // 2 * 2]


def _present(faults: list[_Fault], own: _Fault | None, x: float, y: float, canvas: _Canvas) -> bool:
    """Whether the row at x has a finger at y; `own` is the fault that made the row, if one did."""
    if own is not None:
        return own.weight(y, canvas.size[1]) > 0.5
    return all(
        fault.extra
        or abs(_wrapped(x - fault.x, canvas.size[0])) > canvas.pitch[0] / 4
        or fault.weight(y, canvas.size[1]) < 0.5
        for fault in faults
    )


def _fault_shift(faults: list[_Fault], x: float, y: float, canvas: _Canvas) -> float:
    """How far the faults push the row at x along x, µm: away from a row more, towards a row less."""
    row_pitch = canvas.pitch[0]
    shift = 0.0
    for fault in faults:
        d = _wrapped(x - fault.x, canvas.size[0])
        nearest, sign = (row_pitch / 2, 1.0) if fault.extra else (row_pitch, -1.0)
        decay = np.exp(-max(abs(d) - nearest, 0.0) / (3 * row_pitch))
        shift += sign * np.sign(d) * row_pitch / 2 * decay * fault.weight(y, canvas.size[1])
    return float(shift)


def _xenopeltis_finger(canvas: _Canvas, rng: np.random.Generator, x_0: float, y_0: float, length: float) -> None:
    """A finger that rises from its root at x_0 to a round tip; the higher of it and what is there stays."""
    pitch = canvas.pitch[1]
    # Some are swollen and join their neighbour.
    swollen = rng.uniform() < 0.1
    top = rng.uniform(0.08, 0.12) if swollen else rng.uniform(0.05, 0.11)
    width = 0.75 if swollen else 0.5 + rng.normal(0, 0.05)
    tilt = rng.normal(0.03, 0.06) * pitch / length
    index, x, y = canvas.window((x_0 - 0.1 * length, x_0 + 1.2 * length), (y_0 - 1.4 * pitch, y_0 + 1.4 * pitch))
    s = (x - x_0) / length
    t = (y - y_0 - tilt * (x - x_0)) / pitch
    cap = np.sqrt(np.clip(1 - np.clip((s - 0.75) / 0.25, 0, None) ** 2, 0, 1))
    taper = 0.1 if swollen else 0.4
    half = width * (1 - taper * np.clip(s, 0, 1)) * cap
    finger = top * np.clip(s, 0, 1) ** 1.2 * _step(half - np.abs(t), 0.17) * (1 - _step(s - 1, 0.035))
    canvas.heights[index] = np.maximum(canvas.heights[index], finger)
    # Debris sticks to a few tips, as the scan shows.
    if rng.uniform() < 0.03:
        radius = rng.uniform(0.06, 0.13)
        debris = np.exp(-(((x - x_0) - 0.93 * length) ** 2 + (y - y_0) ** 2) / radius**2)
        canvas.heights[index] += rng.uniform(0.04, 0.1) * debris


def _xenopeltis_pit(canvas: _Canvas, rng: np.random.Generator, x_0: float, y_0: float, length: float) -> None:
    """The pit between two fingers, deepest near their roots."""
    pitch = canvas.pitch[1]
    depth = rng.uniform(0.01, 0.03) if rng.uniform() < 0.1 else rng.uniform(0.04, 0.11)
    start = 0.1 + rng.normal(0, 0.04)
    reach = rng.uniform(0.55, 0.8)
    width = 0.17 * rng.uniform(0.7, 1.3)
    tilt = rng.normal(0.03, 0.06) * pitch / length
    index, x, y = canvas.window((x_0, x_0 + 1.1 * length), (y_0 - 0.9 * pitch, y_0 + 0.9 * pitch))
    s = (x - x_0) / length
    t = (y - y_0 - tilt * (x - x_0)) / pitch
    u = np.clip((s - start) / reach, 0, 1)
    half = width * 2 * np.sqrt(u * (1 - u))  # an ellipse
    pit = _step(half - np.abs(t), 0.12) * _step(s - start - 0.03, 0.04) * (1 - u) ** 0.7
    canvas.heights[index] -= depth * pit
