"""The tracks of an optical disc: parallel rows of pits with the run lengths of a modulated bit stream."""

from __future__ import annotations

from collections.abc import Mapping
from numbers import Integral

import numpy as np
from numpy.typing import NDArray

from ...errors import RequestError
from ..heightfield import HeightField
from .checks import check_pixels, check_positive, check_profile, generator

# Horizontal width of the walls of a pit, µm, which slope by about 45 to 60 degrees.
_WALL = 0.1

# Runs of at least 3 and at most 11 channel bits: the constraint (d, k) = (2, 10), whose capacity is C = 0.5418 bits.
# In sequences of maximum entropy, runs of n bits have the probability 2^{−Cn} (Immink 2004, Codes for
# Mass Data Storage Systems, chapter 4).
EIGHT_TO_FOURTEEN = {n: 2 ** (-0.5418 * n) for n in range(3, 12)}


def draw_tracks(
    *,
    period: float,
    depth: float,
    width: float,
    channel_bit: float,
    tracks: int,
    length: float,
    pixel_size: float,
    seed: int,
    runs: Mapping[int, float],
    name: str,
) -> HeightField:
    """A periodic patch of tracks along y, side by side along x; arguments as in `compact_disc`.

    Args:
        runs: run length in channel bits → probability.
        name: of the disc.
    """
    check_profile(period, depth)
    for label, value in (
        ("width", width),
        ("channel_bit", channel_bit),
        ("length", length),
        ("pixel_size", pixel_size),
    ):
        check_positive(label, value)
    if not (isinstance(tracks, Integral) and tracks >= 1):
        raise RequestError(f"tracks: got {tracks!r}, wanted a whole number of at least 1")
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
        # The axis of a pit, its round ends left off; the distance of each row from the nearest axis, round the torus.
        first, last = starts * channel_bit + width / 2, ends * channel_bit - width / 2
        place = (y - first[0]) % size[1] + first[0]
        before = np.searchsorted(first, place, side="right") - 1
        following = np.append(first[1:], first[0] + size[1])[before]
        along = np.maximum(np.minimum(place - last[before], following - place), 0)
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
    """Where pits start and end on a closed track of so many channel bits, in bits; pits and lands alternate."""
    lengths = np.array(list(runs))
    probability = np.array(list(runs.values())) / sum(runs.values())
    while True:
        drawn = rng.choice(lengths, size=bits // min(runs) + 1, p=probability)
        ends = np.cumsum(drawn)
        # A closed track has a whole number of bits, and equal numbers of pits and lands.
        last = np.searchsorted(ends, bits)
        if ends[last] == bits and last % 2 == 1:
            break
    turn = rng.uniform(0, bits)
    ends = ends[: last + 1].astype(np.float64)
    return ends[::2] - drawn[: last + 1 : 2] + turn, ends[::2] + turn
