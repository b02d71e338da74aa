"""N slits: how the number of periods sharpens the orders (figures 5.5 and 5.6 of the thesis of 2014).

Light falls at right angles on N slits of width b, d apart. At the sine s of the angle behind them (Fraunhofer),

    I(s) = sinc²(b s/λ) · (sin(Nδ/2)/(N sin(δ/2)))²,     δ = 2π d s/λ,     I(0) = 1.

That is a finite number of tiles: the transform of one tile, here a slit, times D(q d; N) with q = s/λ.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..finite_tiles import tile_factor

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Slits:
    """The slits of figure 5.5, and the screen behind them.

    Attributes:
        count: N.
        width: b in µm.
        separation: d in µm.
        distance: of the screen, µm.
    """

    count: int
    width: float = 30.0
    separation: float = 150.0
    distance: float = 0.5e6

    def __post_init__(self) -> None:
        if isinstance(self.count, bool) or not isinstance(self.count, int) or self.count < 1:
            raise ValueError(f"count: got {self.count!r}, wanted a whole number of slits ≥ 1")
        if not (0 < self.width <= self.separation and self.distance > 0):
            raise ValueError(
                f"width, separation, distance: got {self.width!r}, {self.separation!r}, {self.distance!r}, "
                "wanted positive lengths in µm, the width at most the separation"
            )

    def sine(self, place: ArrayLike) -> Array:
        """s of places (...) on the screen, µm from its middle."""
        place = np.asarray(place, np.float64)
        return place / np.hypot(place, self.distance)


def analytic_intensity(slits: Slits, sine: ArrayLike, wavelength: ArrayLike) -> Array:
    """I(s) by the formula.

    Args:
        slits: the slits.
        sine: s, (...).
        wavelength: (...) nm; the two broadcast.
    """
    q = np.asarray(sine, np.float64) / (np.asarray(wavelength, np.float64) * 1e-3)
    half = np.pi * slits.separation * q  # δ/2
    at_order = np.abs(np.sin(half)) < 1e-9
    comb = np.where(at_order, 1, np.sin(slits.count * half) / (slits.count * np.where(at_order, 1, np.sin(half))))
    return np.sinc(slits.width * q) ** 2 * comb**2


def tiled_intensity(slits: Slits, sine: ArrayLike, wavelength: ArrayLike, samples: int = 1000) -> Array:
    """I(s) as this project sums a finite number of tiles: |A(q)|² D(q d; N)²/N², A from a sampled tile.

    The tile is one separation long, sampled at `samples` points, open where the slit is. Arguments as of
    `analytic_intensity`.
    """
    q = np.asarray(sine, np.float64) / (np.asarray(wavelength, np.float64) * 1e-3)
    open_ = round(slits.width / slits.separation * samples)
    x = ((np.arange(samples) + 0.5) / samples - 0.5) * slits.separation
    middle = np.abs(np.arange(samples) - (samples - 1) / 2) < open_ / 2
    amplitude = np.exp(-2j * np.pi * q[..., None] * x[middle]).mean(axis=-1)
    return np.abs(amplitude) ** 2 * (tile_factor(q * slits.separation, slits.count) / slits.count) ** 2
