"""DVD: tracks of pits, 0.74 µm apart."""

from __future__ import annotations

import numpy as np

from ..heightfield import HeightField
from .tracks import EIGHT_TO_FOURTEEN, draw_tracks

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
    """The metal of a DVD.

    As `compact_disc`, with the numbers of ECMA-267 (one layer): a track pitch of 0.74 µm, channel bits of 133.3 nm,
    pits and lands of 3 to 11 of them and 14 in sync codes, so 0.40 to 1.87 µm, read at 650 nm (λ/4n = 0.105 µm). The
    width of the pits is typical, not specified. What `compact_disc` says of the layer holds here, too. As the period is
    about a wavelength, the directions of the orders are exact, but their efficiencies approximate.

    Args, Returns, Raises: those of `compact_disc`.
    """
    return draw_tracks(
        period=period,
        depth=depth,
        width=width,
        channel_bit=channel_bit,
        tracks=tracks,
        length=length,
        pixel_size=pixel_size,
        seed=seed,
        runs=_RUNS,
        name="DVD",
    )
