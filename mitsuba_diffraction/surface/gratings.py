"""Analytic height fields: classical gratings, technical surfaces, and synthetic replicas of natural ones.

Every profile returns exactly one period of a periodic surface (extent "tile" of the spectrum). `PROFILES` has their
names in scenes and recipes; profiles with defaults for all parameters are ready-made surfaces.

Lengths are in µm: `period` along x, `depth` from the lowest to the highest point; `samples` is the number of pixels per
period. Random surfaces take a `seed`, the `size` of the patch, one number or (x, y), and a `pixel_size`, both adjusted
so that the patch tiles seamlessly and has a whole number of pixels.

Raises:
    ValueError: if a length is not positive, the depth negative, or another argument out of the range that the message
        names.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

from ..errors import RequestError, check_whole, did_you_mean, is_number
from .heightfield import HeightField, as_pixel_size

MAX_PIXELS = 2**26
"""Of a profile: half a gigabyte of heights."""

MAX_PERIOD = 100.0
"""µm: orders of visible light are 0.3° apart, about the width of the sun. A period given in nm is larger."""

Array = NDArray[np.float64]


def check_pixels(columns: float, rows: float) -> None:
    """Refuse too large a patch before its memory is allocated."""
    if not columns * rows <= MAX_PIXELS:
        raise RequestError(f"got a patch of {columns:.4g} × {rows:.4g} pixels, wanted at most {MAX_PIXELS} in all")


def check_positive(name: str, value: float, unit: str = "in µm") -> None:
    if not (is_number(value) and value > 0):
        raise RequestError(f"{name}: got {value!r}, wanted a positive number {unit}")


def check_period(name: str, value: float) -> None:
    check_positive(name, value)
    if value > MAX_PERIOD:
        raise RequestError(
            f"{name}: got {value!r} µm, wanted at most {MAX_PERIOD:g}; is it in nm ({value / 1e3:g} µm)? A grating "
            "that is really that coarse may be given as an array of heights"
        )


def check_profile(period: float, depth: float, samples: int = 2) -> None:
    check_period("period", period)
    if not (is_number(depth) and depth >= 0):
        raise RequestError(f"depth: got {depth!r}, wanted a number in µm, zero or more")
    check_whole("samples", samples, 2)
    check_pixels(samples, 1)


def generator(seed: int) -> np.random.Generator:
    check_whole("seed", seed, 0)
    return np.random.default_rng(int(seed))


def phase(samples: int) -> Array:
    """Return x / period at the centres of the pixels, (samples,)."""
    return (np.arange(samples) + 0.5) / samples


def one_row(heights: Array, period: float, source: str) -> HeightField:
    return HeightField(heights[None, :], (period / len(heights), period), source)


def blazed(period: float = 2.5, depth: float = 0.246, *, samples: int = 512) -> HeightField:
    """Return a sawtooth h = depth · x / period, rising along +x, (1, samples).

    At normal incidence its facets reflect light towards −x: into ω_o = −λq with q = m / period, m = 2 depth / λ.
    """
    check_profile(period, depth, samples)
    return one_row(depth * phase(samples), period, f"blazed grating, period {period:g} µm, depth {depth:g} µm")


def ruled(lines_per_mm: float = 600.0, *, blaze_wavelength: float = 500.0, samples: int = 512) -> HeightField:
    """Return a blazed grating, (1, samples), with given lines per millimetre and blaze wavelength λ_B in nm.

    At the blaze wavelength the first order in Littrow mounting returns along the normal of the facets, at the blaze
    angle θ_B (Palmer 2020, Diffraction Grating Handbook, chapters 2 and 9). With the period d and the depth D of a
    groove,

        λ_B = 2 d sin θ_B,    D = d tan θ_B.

    In that mounting κD = 2π, so that scalar theory diffracts all power into the first order. λ_B is below 2 d.
    """
    check_positive("lines_per_mm", lines_per_mm, "of lines per mm")
    check_positive("blaze_wavelength", blaze_wavelength, "of nm")
    period = 1000 / lines_per_mm
    sine = blaze_wavelength * 1e-3 / (2 * period)
    if sine >= 1:
        raise RequestError(
            f"blaze_wavelength: got {blaze_wavelength:g} nm, wanted less than twice the period, {2000 * period:.4g} nm"
        )
    angle = np.arcsin(sine)
    source = f"ruled grating, {lines_per_mm:g} lines/mm, blazed for {blaze_wavelength:g} nm ({np.degrees(angle):.2f}°)"
    depth = period * np.tan(angle)
    check_profile(period, depth, samples)
    return one_row(depth * phase(samples), period, source)


def right_angled(period: float, facet_angle: float, *, samples: int = 512) -> HeightField:
    """Return two facets that meet at 90°, as a ruling diamond leaves them, (1, samples).

    The wider one rises along +x, by `facet_angle` in degrees, above 0 and at most 45.
    """
    check_profile(period, 0.0, samples)
    if not (is_number(facet_angle) and 0 < facet_angle <= 45):
        raise RequestError(f"facet_angle: got {facet_angle!r}, wanted degrees above 0 and at most 45")
    slope = np.tan(np.deg2rad(facet_angle))
    x = phase(samples)
    heights = period * np.minimum(x * slope, (1 - x) / slope)
    return one_row(heights, period, f"ruled grating, period {period:g} µm, facets of {facet_angle:g}°")


def transmission_300(*, facet_angle: float = 17.5, samples: int = 512) -> HeightField:
    """Return a ruled transmission grating of 300 lines/mm, `right_angled`, for a sheet of glass.

    17.5° is the groove angle that Thorlabs states for its 300/mm grating for visible light (GT25-03, in B270 glass,
    n = 1.52). The wide facets deflect light as prisms do, at normal incidence to the first order of about 0.55 µm.
    """
    return right_angled(1000 / 300, facet_angle, samples=samples)


def transmission_600(*, facet_angle: float = 28.7, samples: int = 512) -> HeightField:
    """Return a ruled transmission grating of 600 lines/mm, as `transmission_300`, with the angle of GT25-06V."""
    return right_angled(1000 / 600, facet_angle, samples=samples)


def sinusoidal(period: float, depth: float, *, samples: int = 512) -> HeightField:
    """Return a sinusoid h = (depth / 2) · sin(2π x / period), (1, samples), so |F_m|² = J_m(κ · depth / 2)²."""
    check_profile(period, depth, samples)
    heights = depth / 2 * np.sin(2 * np.pi * phase(samples))
    return one_row(heights, period, f"sinusoidal grating, period {period:g} µm, depth {depth:g} µm")


def lamellar(period: float, depth: float, *, duty: float = 0.5, samples: int = 512) -> HeightField:
    """Return a binary grating, (1, samples): the first part of the period is at `depth`, the rest at zero.

    `duty`, the width of the ridges relative to the period, is rounded to whole pixels.
    """
    check_profile(period, depth, samples)
    if not (is_number(duty) and 0 < duty < 1):
        raise RequestError(f"duty: got {duty!r}, wanted a fraction above 0 and below 1")
    high = round(duty * samples)
    if not 0 < high < samples:
        raise RequestError(f"duty: got {duty!r} with {samples} samples, wanted ridge and groove at least a pixel wide")
    heights = np.where(np.arange(samples) < high, depth, 0.0)
    return one_row(
        heights, period, f"lamellar grating, period {period:g} µm, depth {depth:g} µm, duty {high / samples:g}"
    )


def crossed(period: float, depth: float, *, period_y: float | None = None, samples: int = 128) -> HeightField:
    """Return the sum of sinusoids along x and y, (samples, samples): the orders are products |F_{m_x}|² |F_{m_y}|².

    *Each* sinusoid has the depth `depth`; their sum spans twice this depth. `period_y`, along y, is by default equal to
    `period`; both axes have as many `samples`.
    """
    check_profile(period, depth, samples)
    check_pixels(samples, samples)
    period_y = period if period_y is None else period_y
    check_period("period_y", period_y)
    wave = depth / 2 * np.sin(2 * np.pi * phase(samples))
    return HeightField(
        wave[:, None] + wave,
        (period / samples, period_y / samples),
        f"crossed grating, periods {period:g} × {period_y:g} µm, depth {depth:g} µm each",
    )


def foil(period: float = 1.0, depth: float = 0.15, *, directions: int = 2, samples: int = 64) -> HeightField:
    """Return crossed sinusoids of equal amplitude, as from successive interference exposures.

        h(x) = a Σ_j cos(2π k_j·x),    k_j = (cos α_j, sin α_j) / period

    Two directions, α = 0° and 90°, give a square lattice with depth = 4a; three, 0°, 60° and 120°, a hexagonal one with
    depth = 9a/2. Each wave alone has the orders J_m(κa)². `samples` is even.

    Returns:
        One tile: period × period, (samples, samples); or 2 period × 2 period/√3, about (2 samples/√3, 2 samples).
    """
    check_profile(period, depth, samples)
    if samples % 2:
        raise RequestError(f"samples: got {samples}, wanted an even number, so that the lowest point is on a pixel")
    if directions not in (2, 3):
        raise RequestError(f"directions: got {directions!r}, wanted 2 (crossed) or 3 (hexagonal)")
    # In units of the period. The highest and the lowest point are on pixels.
    if directions == 2:
        size, pixels, span = np.array([1.0, 1.0]), (samples, samples), 4.0
    else:
        # The lowest points lie at a third of the period along x and half of the tile along y.
        size, span = np.array([2.0, 2 / np.sqrt(3)]), 4.5
        pixels = (6 * round(samples / 3), 2 * round(samples / np.sqrt(3)))
    check_pixels(*pixels)
    x, y = (np.arange(n) / n * s for n, s in zip(pixels, size, strict=True))
    waves = np.zeros((len(y), len(x)))
    for j in range(directions):
        angle = np.pi / directions * j
        waves += np.cos(2 * np.pi * (np.cos(angle) * x + np.sin(angle) * y[:, None]))
    return HeightField(
        waves * depth / span,
        (float(size[0] * period / pixels[0]), float(size[1] * period / pixels[1])),
        f"embossed foil, {directions} directions, period {period:g} µm, depth {depth:g} µm",
    )


def film(period: float = 1 / 0.53, depth: float = 0.76, *, samples: int = 64) -> HeightField:
    """Return the embossing of diffraction glasses, a `foil` with two directions, for a transparent sheet.

    The film is sold as "double axis, 13,500 lines per inch", 530/mm. Its depth is not published; of two sinusoids, each
    of amplitude a = depth/4, the orders (±1, 0) and (0, ±1) have J_1(κa)² J_0(κa)² of the light, at most 11 % each
    where κa = 1.08. With κ = 2π (n − 1)/λ and n = 1.5 that is the depth here at λ = 0.55 µm.
    """
    return foil(period, depth, directions=2, samples=samples)


# Horizontal width of the walls of a pit, µm, which slope by about 45 to 60 degrees.
_WALL = 0.1

# Run length in channel bits → probability. Runs of at least 3 and at most 11 channel bits: the constraint
# (d, k) = (2, 10), whose capacity is C = 0.5418 bits. In sequences of maximum entropy, runs of n bits have the
# probability 2^{−Cn} (Immink 2004, Codes for Mass Data Storage Systems, chapter 4).
EIGHT_TO_FOURTEEN = {n: 2 ** (-0.5418 * n) for n in range(3, 12)}


def draw_tracks(
    name: str,
    runs: Mapping[int, float],
    period: float,
    depth: float,
    width: float,
    channel_bit: float,
    tracks: int,
    length: float,
    pixel_size: float,
    seed: int,
) -> HeightField:
    """Draw a periodic patch of tracks along y, side by side along x; `runs` as above, the others as `compact_disc`."""
    check_profile(period, depth)
    lengths = {"width": width, "channel_bit": channel_bit, "length": length, "pixel_size": pixel_size}
    for label, value in lengths.items():
        check_positive(label, value)
    check_whole("tracks", tracks, 1)
    shortest, longest = min(runs) * channel_bit, max(runs) * channel_bit
    if not _WALL <= width <= min(shortest, period - _WALL):
        raise RequestError(
            f"width: got {width!r} µm, wanted {_WALL:g} to {min(shortest, period - _WALL):.4g} (the shortest pit, and "
            "the land between tracks)"
        )
    if length < 4 * longest:
        raise RequestError(f"length: got {length!r} µm, wanted at least four of the longest pits, {4 * longest:.4g}")
    if pixel_size > width / 2:
        raise RequestError(f"pixel_size: got {pixel_size!r} µm, wanted at most half of a pit's width, {width / 2:.4g}")
    check_pixels(tracks * period / pixel_size, length / pixel_size)
    rng = generator(seed)
    bits = round(length / channel_bit)
    size = (tracks * period, bits * channel_bit)
    columns, rows = (round(s / pixel_size) for s in size)
    x = (np.arange(columns) + 0.5) * size[0] / columns
    y = (np.arange(rows) + 0.5) * size[1] / rows
    track = np.floor(x / period).astype(np.int64)
    across = x - (track + 0.5) * period
    heights = np.empty((rows, columns))
    for number in range(tracks):
        starts, ends = _pits(rng, bits, runs)
        # The axis of a pit without its round ends; the distance of each row from the nearest axis, on the closed track.
        first, last = starts * channel_bit + width / 2, ends * channel_bit - width / 2
        position = (y - first[0]) % size[1] + first[0]
        previous = np.searchsorted(first, position, side="right") - 1
        following = np.append(first[1:], first[0] + size[1])[previous]
        along = np.maximum(np.minimum(position - last[previous], following - position), 0)
        mine = track == number
        radius = np.hypot(along[:, None], across[mine])
        heights[:, mine] = np.clip(0.5 + (width / 2 - radius) / _WALL, 0, 1)
    return HeightField(
        heights * depth,
        (size[0] / columns, size[1] / rows),
        f"{name}, {tracks} tracks of {period:g} µm along x, pits {width:g} µm wide and {depth:g} µm deep seen through "
        f"seed {seed}",
    )


def _pits(
    rng: np.random.Generator, bits: int, runs: Mapping[int, float]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Draw starts and ends of the pits on a closed track, in channel bits; pits and lands alternate."""
    lengths = np.array(list(runs))
    probability = np.array(list(runs.values())) / sum(runs.values())
    while True:
        drawn = rng.choice(lengths, size=bits // min(runs) + 1, p=probability)
        ends = np.cumsum(drawn)
        # A closed track has a whole number of bits, and equal numbers of pits and lands.
        last = np.searchsorted(ends, bits)
        if ends[last] == bits and last % 2 == 1:
            break
    shift = rng.uniform(0, bits)
    ends = ends[: last + 1].astype(np.float64)
    return ends[::2] - drawn[: last + 1 : 2] + shift, ends[::2] + shift


def compact_disc(
    period: float = 1.6,
    depth: float = 0.11,
    *,
    width: float = 0.55,
    channel_bit: float = 0.2777,
    tracks: int = 20,
    length: float = 32.0,
    pixel_size: float = 0.05,
    seed: int = 0,
) -> HeightField:
    """Draw the metal layer of a compact disc.

    Tracks run along y and diffract along x. On Mitsuba's `disk` x is radial, so that an orientation of 0 is correct.

    From the standard (IEC 60908; ECMA-130 for the CD-ROM): a track pitch of 1.6 ± 0.1 µm, a substrate of index 1.55 ±
    0.1, pits and lands of 3 to 11 channel bits of T = 1/4.3218 MHz, which at 1.2 m/s are 0.2777 µm, so 0.83 to 3.05 µm.
    Depth and width are specified only indirectly, by the signals of a player; 0.11 µm and 0.55 µm are typical (λ/4n =
    0.126 µm at 780 nm maximises contrast, λ/8n the tracking signal). The lengths of pits and lands are random with the
    maximum-entropy distribution under that constraint.

    Heights describe the pits of the metal, as an instrument measures them without the polycarbonate. For a complete
    disc, use `coat_ior` = 1.55 of the plugin.

    Args:
        period: track pitch, µm.
        depth: geometric depth of the pits, which protrude towards the light, µm.
        width: of the pits at half their depth, µm; at most their length.
        channel_bit: length of a channel bit along the track, µm.
        tracks: number of tracks; times the period, the size of the patch along x.
        length: of the patch along y, µm, at least four pits, rounded to whole channel bits.
        pixel_size: µm, at most half of the width.
        seed: of the lengths of pits and lands.
    """
    return draw_tracks(
        "compact disc", EIGHT_TO_FOURTEEN, period, depth, width, channel_bit, tracks, length, pixel_size, seed
    )


# A run of 14 bits opens every sync frame of 1488 channel bits.
_MEAN_RUN = np.average(list(EIGHT_TO_FOURTEEN), weights=list(EIGHT_TO_FOURTEEN.values()))
_RUNS = {**EIGHT_TO_FOURTEEN, 14: float(_MEAN_RUN / 1488)}


def dvd(
    period: float = 0.74,
    depth: float = 0.105,
    *,
    width: float = 0.32,
    channel_bit: float = 0.1333,
    tracks: int = 43,
    length: float = 32.0,
    pixel_size: float = 0.05,
    seed: int = 0,
) -> HeightField:
    """Draw the metal layer of a DVD.

    As `compact_disc`, with the numbers of ECMA-267 (one layer): a track pitch of 0.74 µm, channel bits of 133.3 nm,
    pits and lands of 3 to 11 of them and 14 in sync codes, so 0.40 to 1.87 µm, read at 650 nm (λ/4n = 0.105 µm). The
    width of the pits is typical, not specified. For the polycarbonate, see `compact_disc`. As the period is
    about a wavelength, the directions of the orders are exact, but their efficiencies approximate.
    """
    return draw_tracks("DVD", _RUNS, period, depth, width, channel_bit, tracks, length, pixel_size, seed)


def morpho_ridges(
    period: float = 0.7,
    depth: float = 0.4,
    *,
    width: float = 0.3,
    size: float | tuple[float, float] = 31.5,
    pixel_size: float = 0.0625,
    seed: int = 0,
) -> HeightField:
    """Draw parallel ridges along y of unequal heights: the grating of a Morpho scale, **not its blue**.

    The blue is due to a stack of lamellae within each ridge, an interference filter that a height field cannot
    represent. This surface only models the scattering perpendicular to the ridges. Their uneven heights weaken the
    orders of the grating and scatter the rest (Kinoshita, Yoshioka & Kawagoe 2002, Proc. R. Soc. B 269, 1417–1421: a
    regular stack on irregular ridges, about 0.7 µm apart and 0.3 µm wide). Modelled on that description, neither
    measured nor of the real depth (about 2 µm, outside the range of scalar theory). For a blue butterfly, use a blue
    mirror.

    `period` is the mean spacing of the ridges, `width` theirs, below it; size_x is rounded to whole periods.
    """
    check_profile(period, depth)
    check_positive("width", width)
    if width >= period:
        raise RequestError(f"width: got {width!r} µm, wanted less than the period, {period:g}")
    rng = generator(seed)
    canvas = Canvas(size, pixel_size, pitch=(period, period), axis=0)
    # The height differs between ridges and varies along each, where one lamella ends and the next begins.
    uneven = canvas.noise(rng, 0.0, 1.0)
    x = (np.arange(canvas.heights.shape[1]) + 0.5) * canvas.pixel[0]
    for centre, offset in zip(canvas.centres(0), rng.normal(0, 0.15, canvas.count[0]), strict=True):
        column = int(centre / canvas.pixel[0]) % canvas.heights.shape[1]
        top = np.clip(1 + offset + 0.1 * uneven[:, column], 0.2, None)
        distance = np.abs((x - centre + canvas.size[0] / 2) % canvas.size[0] - canvas.size[0] / 2)
        canvas.heights += top[:, None] * smooth_step(width / 2 - distance, 0.06)
    return canvas.height_field(
        rng,
        depth,
        f"Morpho-like ridges (no lamellae), {canvas.count[0]} ridges of {canvas.pitch[0]:.4g} µm along x, "
        f"depth {depth:g} µm, seed {seed}",
    )


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

    def centres(self, axis: int) -> Array:
        """Return the centres of the pitches along x (0) or y (1), µm."""
        return (np.arange(self.count[axis], dtype=np.float64) + 0.5) * self.pitch[axis]

    def window(
        self, x: tuple[float, float], y: tuple[float, float]
    ) -> tuple[tuple[NDArray[np.signedinteger], ...], Array, Array]:
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

    def noise(self, rng: np.random.Generator, length_x: float, length_y: float) -> Array:
        """Draw periodic Gaussian noise, mean 0, variance 1, correlation exp(−x²/4 length_x² − …), (N_y, N_x)."""
        rows, columns = self.heights.shape
        q_x = np.fft.rfftfreq(columns, self.pixel[0])
        q_y = np.fft.fftfreq(rows, self.pixel[1])[:, None]
        filter_ = np.exp(-2 * np.pi**2 * ((q_x * length_x) ** 2 + (q_y * length_y) ** 2))
        filter_[0, 0] = 0
        field = np.fft.irfft2(np.fft.rfft2(rng.standard_normal((rows, columns))) * filter_, s=(rows, columns))
        return field / field.std()

    def at(self, field: Array, x: float, y: float) -> float:
        """Return the value of a field at a position, µm, wrapped."""
        rows, columns = field.shape
        return field[int(y / self.pixel[1]) % rows, int(x / self.pixel[0]) % columns]

    def height_field(self, rng: np.random.Generator, depth: float, source: str) -> HeightField:
        """Return the drawing, scaled to `depth` and shifted by a random offset, as seeds must not share a lattice."""
        heights = np.roll(self.heights - self.heights.min(), rng.integers(self.heights.shape), axis=(0, 1))
        return HeightField(heights / heights.max() * depth, self.pixel, source)


def smooth_step(x: Array, width: float) -> Array:
    """Return a smooth step from 0 to 1 at x = 0."""
    return (1 + erf(x / width)) / 2


def elaphe_synthetic(
    size: float | tuple[float, float] = 32.0,
    *,
    pixel_size: float = 0.0625,
    depth: float = 0.375,
    period: float = 1.144,
    seed: int = 0,
) -> HeightField:
    """Draw a synthetic replica of the shed skin of *Elaphe guttata*, not a measurement.

    Fingers along x that taper towards +x, side by side along **y**, the diffracting direction. Between two fingers a
    groove starts as a deep narrow crotch and widens up to the tips of the fingers, where the next row begins, 2.93
    periods further on. Granules sit on top of the fingers. Positions, lengths, widths, heights and tilts vary from
    finger to finger as in AFM scans of such skins. The shape is modelled on a 5.9 µm AFM scan of the LANE lab, Geneva.

    `period` is the mean distance from finger to finger. size_y is rounded to whole periods, and the pitch of the rows
    is adjusted to size_x; the patch holds at least two rows and four fingers.
    """
    check_profile(period, depth)
    rng = generator(seed)
    canvas = Canvas(size, pixel_size, pitch=(2.93 * period, period), axis=1)
    row_pitch, pitch = canvas.pitch

    # The lattice of crotches: it drifts slowly, rows shift against each other, and every crotch is displaced.
    drift_x = 0.08 * row_pitch * canvas.noise(rng, 8.0, 4.0)
    drift_y = 0.12 * pitch * canvas.noise(rng, 8.0, 8.0)
    granules = np.zeros_like(canvas.heights)
    for x, row_shift in zip(canvas.centres(0), rng.normal(0, 0.05 * pitch, canvas.count[0]), strict=True):
        for y in canvas.centres(1):
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


# Heights in µm as they were read off the mean unit cell of the AFM patch; the patch is scaled to `depth` at the end.


def _elaphe_groove(canvas: Canvas, rng: np.random.Generator, x_0: float, y_0: float) -> None:
    """Draw the groove between two fingers, from its crotch at (x_0, y_0) along +x."""
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
    groove = (
        smooth_step(half - np.abs(t), 0.105)
        * smooth_step(s, 0.05)
        * (1 - smooth_step(s - 1.09 + 0.15 * np.abs(t), 0.13))
    )
    dip = np.exp(-(((s - 0.1) / 0.1) ** 2) - ((t / (0.085 + 0.03 * np.clip(s / 0.2, 0, 1))) ** 2))
    canvas.heights[index] -= floor * groove + crotch * dip


def _elaphe_tip(canvas: Canvas, rng: np.random.Generator, x_0: float, y_0: float) -> None:
    """Draw the round edge where a finger ends on the next row, which lies lower there and rises again."""
    row_pitch, pitch = canvas.pitch
    x_tip = x_0 + row_pitch * (0.93 + rng.normal(0, 0.05))
    y_tip = y_0 - 0.1 * pitch
    drop = 0.028 * rng.uniform(0.4, 1.6)
    index, x, y = canvas.window((x_tip - 0.3 * row_pitch, x_tip + 0.8 * row_pitch), (y_tip - pitch, y_tip + pitch))
    t = (y - y_tip) / pitch
    s = (x - x_tip) / row_pitch + 0.5 * t**2
    canvas.heights[index] -= drop * smooth_step(s, 0.02) * np.exp(-np.maximum(s, 0) / 0.12) * np.exp(-((t / 0.42) ** 4))


def _elaphe_granules(canvas: Canvas, granules: Array, rng: np.random.Generator, x_0: float, y_0: float) -> None:
    """Draw a few large granules and some small ones along the ridge of a finger; overlaps keep the higher one."""
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


def xenopeltis_synthetic(
    size: float | tuple[float, float] = 32.0,
    *,
    pixel_size: float = 0.0625,
    depth: float = 0.443,
    period: float = 1.552,
    seed: int = 0,
) -> HeightField:
    """Draw a synthetic replica of the shed skin of *Xenopeltis unicolor*, not a measurement.

    Rows of short round fingers, which point along +x and rise towards their tips like roof tiles. Rows run along y, one
    period apart along **x**, the diffracting direction. They meander by 10 to 20 degrees and occasionally fork or end.
    Fingers are 0.36 periods apart along y, with small deep pits between them; some are joined. The shape is modelled on
    a 5.9 µm AFM scan of the LANE lab, Geneva.

    `period` is the mean distance from row to row. size_x is rounded to whole periods, and the pitch of the fingers is
    adjusted to size_y; the patch holds at least two rows and four fingers.
    """
    check_profile(period, depth)
    rng = generator(seed)
    canvas = Canvas(size, pixel_size, pitch=(period, 0.36 * period), axis=0)
    row_pitch, pitch = canvas.pitch

    meander = 0.11 * row_pitch * canvas.noise(rng, 6.0, 1.3)
    faults = _faults(canvas, rng)
    rows = [(x, None) for x in canvas.centres(0)] + [(fault.x, fault) for fault in faults if fault.extra]
    fingers = []
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
            fingers.append((x_0, y, row_pitch * (1 + rng.normal(0, 0.05))))
    for x_0, y_0, length in fingers:
        _xenopeltis_finger(canvas, rng, x_0, y_0, length)
    for x_0, y_0, length in fingers:
        _xenopeltis_pit(canvas, rng, x_0, y_0 + pitch / 2, length)
    canvas.heights += 0.005 * canvas.noise(rng, 0.07, 0.04) + 0.006 * canvas.noise(rng, 1.0, 1.0)
    return canvas.height_field(
        rng,
        depth,
        f"synthetic Xenopeltis skin, {canvas.count[0]} rows of {row_pitch:.4g} µm along x, "
        f"fingers of {pitch:.3g} µm along y, depth {depth:g} µm, seed {seed}",
    )


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
        """Return 1 inside the fault, 0 outside, smooth at its ends."""
        d = _wrapped(y - self.y, size_y)
        return float((erf((d + self.half) / 1.2) - erf((d - self.half) / 1.2)) / 2)


def _wrapped(distance: float, size: float) -> float:
    """Return the shortest distance on a circle of circumference `size`."""
    return (distance + size / 2) % size - size / 2


def _faults(canvas: Canvas, rng: np.random.Generator) -> list[_Fault]:
    """Draw separate faults, about one per 200 µm²; equally many add and remove a row, which keeps the mean pitch."""
    row_pitch = canvas.pitch[0]
    faults: list[_Fault] = []
    wanted = 2 * round(canvas.size[0] * canvas.size[1] / 400)
    for _ in range(20 * wanted):
        if len(faults) == wanted:
            break
        extra = len(faults) % 2 == 0
        # An added row lies between two rows, a missing row at the position of one.
        x = (rng.integers(canvas.count[0]) + (1.0 if extra else 0.5)) * row_pitch % canvas.size[0]
        fault = _Fault(x, rng.uniform(0, canvas.size[1]), rng.uniform(1.5, 3.0), extra)
        if all(
            abs(_wrapped(x - other.x, canvas.size[0])) > 3.2 * row_pitch
            or abs(_wrapped(fault.y - other.y, canvas.size[1])) > fault.half + other.half + 2.5
            for other in faults
        ):
            faults.append(fault)
    return faults[: len(faults) // 2 * 2]


def _present(faults: list[_Fault], own: _Fault | None, x: float, y: float, canvas: Canvas) -> bool:
    """Return whether the row at x has a finger at y; `own` is the fault that made the row, if one did."""
    if own is not None:
        return own.weight(y, canvas.size[1]) > 0.5
    return all(
        fault.extra
        or abs(_wrapped(x - fault.x, canvas.size[0])) > canvas.pitch[0] / 4
        or fault.weight(y, canvas.size[1]) < 0.5
        for fault in faults
    )


def _fault_shift(faults: list[_Fault], x: float, y: float, canvas: Canvas) -> float:
    """Return the shift of the row at x by the faults, µm: away from an added row, towards a missing one."""
    row_pitch = canvas.pitch[0]
    shift = 0.0
    for fault in faults:
        d = _wrapped(x - fault.x, canvas.size[0])
        nearest, sign = (row_pitch / 2, 1.0) if fault.extra else (row_pitch, -1.0)
        decay = np.exp(-max(abs(d) - nearest, 0.0) / (3 * row_pitch))
        shift += sign * np.sign(d) * row_pitch / 2 * decay * fault.weight(y, canvas.size[1])
    return float(shift)


def _xenopeltis_finger(canvas: Canvas, rng: np.random.Generator, x_0: float, y_0: float, length: float) -> None:
    """Draw a finger that rises from its root at x_0 to a round tip; where shapes overlap, the higher one stays."""
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
    finger = top * np.clip(s, 0, 1) ** 1.2 * smooth_step(half - np.abs(t), 0.17) * (1 - smooth_step(s - 1, 0.035))
    canvas.heights[index] = np.maximum(canvas.heights[index], finger)
    # Debris sticks to a few tips, as the scan shows.
    if rng.uniform() < 0.03:
        radius = rng.uniform(0.06, 0.13)
        debris = np.exp(-(((x - x_0) - 0.93 * length) ** 2 + (y - y_0) ** 2) / radius**2)
        canvas.heights[index] += rng.uniform(0.04, 0.1) * debris


def _xenopeltis_pit(canvas: Canvas, rng: np.random.Generator, x_0: float, y_0: float, length: float) -> None:
    """Draw the pit between two fingers, deepest near their roots."""
    pitch = canvas.pitch[1]
    depth = rng.uniform(0.01, 0.03) if rng.uniform() < 0.1 else rng.uniform(0.04, 0.11)
    start = 0.1 + rng.normal(0, 0.04)
    span = rng.uniform(0.55, 0.8)
    width = 0.17 * rng.uniform(0.7, 1.3)
    tilt = rng.normal(0.03, 0.06) * pitch / length
    index, x, y = canvas.window((x_0, x_0 + 1.1 * length), (y_0 - 0.9 * pitch, y_0 + 0.9 * pitch))
    s = (x - x_0) / length
    t = (y - y_0 - tilt * (x - x_0)) / pitch
    u = np.clip((s - start) / span, 0, 1)
    half = width * 2 * np.sqrt(u * (1 - u))  # an ellipse
    pit = smooth_step(half - np.abs(t), 0.12) * smooth_step(s - start - 0.03, 0.04) * (1 - u) ** 0.7
    canvas.heights[index] -= depth * pit


PROFILES: dict[str, Callable[..., HeightField]] = {
    "blazed": blazed,
    "sinusoidal": sinusoidal,
    "lamellar": lamellar,
    "crossed": crossed,
    "ruled": ruled,
    "transmission_300": transmission_300,
    "transmission_600": transmission_600,
    "foil": foil,
    "film": film,
    "compact_disc": compact_disc,
    "dvd": dvd,
    "elaphe_synthetic": elaphe_synthetic,
    "xenopeltis_synthetic": xenopeltis_synthetic,
    "morpho_ridges": morpho_ridges,
}
"""Name in recipes and scenes → function."""

RENAMED = {name: f"{name}_synthetic" for name in ("elaphe", "xenopeltis")}
"""Name of a profile until version 0.2 → its name now, as the measured skins have the former."""


def profile_name(name: object) -> str:
    """Return the name of a profile.

    Raises:
        RequestError: if there is no such profile.

    Warns:
        FutureWarning: if the name is a former one.
    """
    if isinstance(name, str) and name in RENAMED:
        warnings.warn(
            f"profile {name}: got the former name of {RENAMED[name]}, a synthetic skin; the measured one is the recipe "
            f"{name}.toml. The former name will be refused from version 0.4 on",
            FutureWarning,
            stacklevel=2,
        )
        return RENAMED[name]
    if not (isinstance(name, str) and name in PROFILES):
        raise RequestError(
            f"profile: got {name!r}, wanted one of {', '.join(PROFILES)}{did_you_mean(str(name), PROFILES)}"
        )
    return name


def __getattr__(name: str) -> Callable[..., HeightField]:
    if name in RENAMED:
        return PROFILES[profile_name(name)]
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


COHERENCE_LENGTHS: dict[str, float] = dict.fromkeys(
    ("compact_disc", "dvd", "elaphe_synthetic", "xenopeltis_synthetic", "morpho_ridges"), 26.0
)
"""Name of a random profile → coherence length in µm suitable for its default tile of about 32 µm.

The periodic patch has a comb of orders spaced by 1/32 cycles/µm; a coherence length below the size of the patch blurs
them into the smooth haze of an irregular surface.
"""

PATCHES: dict[str, int] = {
    **{"compact_disc": 48, "dvd": 48},
    **{"elaphe_synthetic": 16, "xenopeltis_synthetic": 16, "morpho_ridges": 16},
}
"""Name of a random profile → number of seeds over which its spectrum is averaged by default.

At 550 nm and normal incidence ∫|ΔS| dq relative to the mean over infinitely many other seeds is then below 0.08; for
discs it is smaller, since streaks are visible in their faint fans.
"""

__all__ = ["COHERENCE_LENGTHS", "PATCHES", "PROFILES", "right_angled", *PROFILES]
