"""Height fields by formula: classical gratings, technical surfaces, and synthetic stand-ins for natural ones.

Every profile is one exact period of a surface that repeats for ever: a tile (extent "tile" of the spectrum). Lengths
are in µm. One surface, one file; a new one is added to `PROFILES`, and scenes and recipes know its name. Called without
parameters, a profile that has values for all of them is a ready surface.
"""

from __future__ import annotations

from collections.abc import Callable

from ..heightfield import HeightField
from .blazed import blazed
from .compact_disc import compact_disc
from .crossed import crossed
from .dvd import dvd
from .elaphe import elaphe
from .foil import foil
from .lamellar import lamellar
from .morpho_ridges import morpho_ridges
from .ruled import ruled
from .sinusoidal import sinusoidal
from .xenopeltis import xenopeltis

PROFILES: dict[str, Callable[..., HeightField]] = {
    "blazed": blazed,
    "sinusoidal": sinusoidal,
    "lamellar": lamellar,
    "crossed": crossed,
    "ruled": ruled,
    "foil": foil,
    "compact_disc": compact_disc,
    "dvd": dvd,
    "elaphe": elaphe,
    "xenopeltis": xenopeltis,
    "morpho_ridges": morpho_ridges,
}
"""Name of a profile, as recipes and scenes write it → the function that makes it."""

COHERENCE_LENGTHS: dict[str, float] = dict.fromkeys(
    ("compact_disc", "dvd", "elaphe", "xenopeltis", "morpho_ridges"), 26.0
)
"""Name of a profile that is drawn at random → coherence length in µm that suits the tile of its default size,
about 32 µm.

A patch that repeats has a comb of orders, 1/32 µm apart; light coherent over less than the patch blurs them into the
smooth haze of an irregular surface.
"""

PATCHES: dict[str, int] = {"compact_disc": 48, "dvd": 48, "elaphe": 16, "xenopeltis": 16, "morpho_ridges": 16}
"""Name of a profile that is drawn at random → over how many seeds its spectrum is averaged by default.

At 550 nm and normal incidence ∫|ΔS| dq to the mean of as many other seeds as one likes is then below 0.08; of discs it
is less, since the eye sees streaks in their faint fans.
"""

__all__ = ["COHERENCE_LENGTHS", "PATCHES", "PROFILES", *PROFILES]
