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

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from ..errors import RequestError, check_whole, did_you_mean, is_number
from .drawing import (
    Canvas,
    check_period,
    check_pixels,
    check_positive,
    check_profile,
    generator,
    one_row,
    phase,
    smooth_step,
)
from .heightfield import HeightField
from .skins import elaphe_synthetic, xenopeltis_synthetic


def blazed(period: float = 2.5, depth: float = 0.246, *, samples: int = 512) -> HeightField:
    """Return a sawtooth h = depth · x / period, rising along +x, (1, samples).

    At normal incidence its facets reflect light towards −x: into ω_o = −λq with q = m / period, m = 2 depth / λ.
    """
    check_profile(period, depth, samples)
    return one_row(depth * phase(samples), period, f"blazed grating, period {period:g} µm, depth {depth:g} µm")


def ruled(
    lines_per_mm: float = 600.0,
    *,
    blaze_wavelength: float | None = None,
    blaze_angle: float | None = None,
    blaze_ior: float | None = None,
    samples: int = 512,
) -> HeightField:
    """Return a blazed grating, (1, samples), with given lines per millimetre and blaze wavelength or angle.

    At the blaze wavelength the first order in Littrow mounting returns along the normal of the facets, at the blaze
    angle θ_B (Palmer 2020, Diffraction Grating Handbook, chapters 2 and 9). With the period d and the depth D of a
    groove,

        λ_B = 2 d sin θ_B,    D = d tan θ_B.

    In that mounting κD = 2π, so that scalar theory diffracts all power into the first order. λ_B is below 2 d.

    With `blaze_ior`, the index n of glass, it is blazed for light that a sheet transmits at normal incidence: facets
    deflect it, as prisms do, into the order at θ,

        λ_B = d sin θ,    n sin θ_B = sin(θ_B + θ).

    Args:
        lines_per_mm: per millimetre.
        blaze_wavelength: λ_B, nm; 500 if neither is given.
        blaze_angle: or θ_B, degrees.
        blaze_ior: index of the sheet; None for reflected light.
        samples: pixels.
    """
    check_positive("lines_per_mm", lines_per_mm, "of lines per mm")
    if blaze_ior is not None and not (is_number(blaze_ior) and 1 < blaze_ior < 10):
        raise RequestError(f"blaze_ior: got {blaze_ior!r}, wanted an index above 1")
    period = 1000 / lines_per_mm
    if blaze_angle is None:
        blaze_wavelength = 500.0 if blaze_wavelength is None else blaze_wavelength
        facet = _blaze_angle(period, blaze_wavelength, blaze_ior)
    else:
        if blaze_wavelength is not None:
            raise RequestError(f"blaze_angle: got {blaze_angle!r} and blaze_wavelength, wanted one of the two")
        limit = 90.0 if blaze_ior is None else np.degrees(np.arcsin(1 / blaze_ior))
        if not (is_number(blaze_angle) and 0 < blaze_angle < limit):
            raise RequestError(f"blaze_angle: got {blaze_angle!r}, wanted degrees above 0 and below {limit:.4g}")
        facet = float(np.deg2rad(blaze_angle))
        path = 2 * np.sin(facet) if blaze_ior is None else np.sin(np.arcsin(blaze_ior * np.sin(facet)) - facet)
        blaze_wavelength = float(1e3 * period * path)
    used = "reflection" if blaze_ior is None else f"transmission, n = {blaze_ior:g}"
    source = f"ruled grating, {lines_per_mm:g} lines/mm, blazed for {blaze_wavelength:.4g} nm in {used}"
    depth = period * np.tan(facet)
    check_profile(period, depth, samples)
    return one_row(depth * phase(samples), period, f"{source} ({np.degrees(facet):.2f}°)")


def _blaze_angle(period: float, wavelength: float, ior: float | None) -> float:
    """Return θ_B of `ruled` in radians, for a period in µm and a blaze wavelength in nm."""
    check_positive("blaze_wavelength", wavelength, "of nm")
    if wavelength < 10:
        raise RequestError(f"blaze_wavelength: got {wavelength:g} nm, wanted at least 10 nm, not µm")
    sine = wavelength * 1e-3 / (period if ior else 2 * period)
    if sine >= 1:
        longest = "the period" if ior else "twice the period"
        raise RequestError(
            f"blaze_wavelength: got {wavelength:g} nm, wanted less than {longest}, {wavelength / sine:.4g} nm"
        )
    return float(np.arcsin(sine) if ior is None else np.arctan(sine / (ior - np.sqrt(1 - sine**2))))


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
        f"{name}, {tracks} tracks of {period:g} µm along x, pits {width:g} µm wide and {depth:g} µm deep, seed {seed}",
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


def profile_name(name: object) -> str:
    """Return the name of a profile.

    Raises:
        RequestError: if there is no such profile.
    """
    if not (isinstance(name, str) and name in PROFILES):
        raise RequestError(
            f"profile: got {name!r}, wanted one of {', '.join(PROFILES)}{did_you_mean(str(name), PROFILES)}"
        )
    return name


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
