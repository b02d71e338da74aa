"""Which frequencies propagate: regions of the frequency plane, one for each bin of directions of incidence and λ.

Light that comes in from s = ω_i,t and leaves at the frequency q propagates if |λq + s| ≤ 1: q lies in a disc that holds
q = 0 and grows with 1/λ about it. So the union of the discs of a bin is that of the largest 1/λ and, as discs are
larger than bins, of the s on the border of the bin.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from .arithmetic import larger, limited
from .incidence import Incidence
from .tables import opaque

_STEP = 0.02  # between the s that stand for a border
_BEYOND = 1e-4  # for rounding at run time


@dataclass(frozen=True)
class _Resolution:
    """How many bins there are.

    They are equal in cos θ_i, so that they are finest where the horizon is near the mirror direction; in azimuth, which
    moves the horizon along itself there; and in 1/λ.
    """

    cosines: int
    azimuths: int
    frequencies: int


COARSE, FINE = _Resolution(8, 32, 4), _Resolution(32, 64, 4)
FEW = 48  # rows: regions of no more take little memory, so that there can be many


class HorizonBins:
    """The bins, and the region of each."""

    def __init__(self, wavelengths: tuple[float, float], rows: int) -> None:
        """Takes (shortest, longest) in nm and the number of rows of a region."""
        self.resolution = FINE if rows <= FEW else COARSE
        self._first, self._last = 1e3 / wavelengths[1], 1e3 / wavelengths[0]
        self.first = opaque(self._first)
        self.per_frequency = opaque(self.resolution.frequencies / (self._last - self._first))

    def bin(self, incidence: Incidence) -> mi.UInt32:
        """The bin of one wavelength and where it comes from; beyond the ends, the nearest."""
        wi, bins = incidence.wi, self.resolution
        cosine = _cell(wi.z * bins.cosines, bins.cosines)
        azimuth = _cell((_azimuth(wi.x, wi.y) + 2) * (bins.azimuths / 4), bins.azimuths)
        frequency = _cell((incidence.frequency - self.first) * self.per_frequency, bins.frequencies)
        return (frequency * bins.cosines + cosine) * bins.azimuths + azimuth

    def columns(self, low: NDArray[np.float64], high: NDArray[np.float64]) -> NDArray[np.float64]:
        """The interval of q_x that propagates for some q_y of a row, low ≤ q_y ≤ high (rows,), all in cycles/µm.

        Returns:
            (bins, rows, 2), the first and last q_x; where there are none, the first is larger.
        """
        bins = self.resolution
        largest = np.linspace(self._first, self._last, bins.frequencies + 1)[1:, None]
        largest, low, high = (np.asarray(x, np.float32) for x in (largest, low, high))
        result = np.empty((bins.frequencies, bins.cosines, bins.azimuths, len(low), 2))
        # The border is represented by points: each disc is enlarged to cover those up to half a step away.
        square = (1 + _STEP / 2 + _BEYOND) ** 2
        for cosine, azimuth in np.ndindex(bins.cosines, bins.azimuths):
            s_x, s_y = (s[:, None, None].astype(np.float32) for s in _border(bins, cosine, azimuth))
            y = np.clip(0, low / largest + s_y, high / largest + s_y)
            half = np.where(y**2 < square, np.sqrt(np.maximum(square - y**2, 0)), -np.inf)
            result[:, cosine, azimuth, :, 0] = largest * (-s_x - half).min(axis=0)
            result[:, cosine, azimuth, :, 1] = largest * (half - s_x).max(axis=0)
        return result.reshape(-1, len(low), 2)


def _cell(x: mi.Float, count: int) -> mi.UInt32:
    return mi.UInt32(limited(x, 0, count - 1))


def _azimuth(x: mi.Float, y: mi.Float) -> mi.Float:
    """−2 to 2, instead of −π to π: the place on a square |x| + |y| = 1, which needs no arc tangent."""
    along = x / larger(dr.abs(x) + dr.abs(y), 1e-12)
    return dr.select(y >= 0, 1 - along, along - 1)


def _border(bins: _Resolution, cosine: int, azimuth: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """s_x and s_y (n,) of the border of a bin, at most `_STEP` apart."""
    radius = np.sqrt(1 - (np.array([cosine + 1, cosine]) / bins.cosines) ** 2)
    # No arc is longer than twice its part of the square.
    ends = (azimuth + np.linspace(0, 1, int(np.ceil(8 / bins.azimuths / _STEP)) + 1)) / (bins.azimuths / 4) - 2
    # The inverse of `_azimuth`.
    along = 1 - np.abs(ends)
    angle = np.arctan2(np.sign(ends) * (1 - np.abs(along)), along)
    sides = np.linspace(*radius, int(np.ceil((radius[1] - radius[0]) / _STEP)) + 1)
    r = np.concatenate([np.repeat(radius, len(angle)), sides, sides])
    a = np.concatenate([angle, angle, np.repeat(angle[[0, -1]], len(sides))])
    return r * np.cos(a), r * np.sin(a)
