"""Analytic height fields: classical gratings, technical surfaces, and synthetic replicas of natural ones.

Every profile is exactly one period of a periodic surface (extent "tile" of the spectrum). Lengths are in µm. Each has
its own file and an entry in `PROFILES`, the names used in scenes and recipes. Profiles with defaults for all parameters
are ready-made surfaces.
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
"""Name in recipes and scenes → function."""

COHERENCE_LENGTHS: dict[str, float] = dict.fromkeys(
    ("compact_disc", "dvd", "elaphe", "xenopeltis", "morpho_ridges"), 26.0
)
"""Name of a random profile → coherence length in µm suitable for its default tile of about 32 µm.

The periodic patch has a comb of orders spaced by 1/32 cycles/µm; a coherence length below the size of the patch blurs
them into the smooth haze of an irregular surface.
"""

PATCHES: dict[str, int] = {"compact_disc": 48, "dvd": 48, "elaphe": 16, "xenopeltis": 16, "morpho_ridges": 16}
"""Name of a profile that is drawn at random → over how many seeds its spectrum is averaged by default.

At 550 nm and normal incidence ∫|ΔS| dq to the mean of as many other seeds as one likes is then below 0.08; of discs it
is less, since the eye sees streaks in their faint fans.
"""

__all__ = ["COHERENCE_LENGTHS", "PATCHES", "PROFILES", *PROFILES]
