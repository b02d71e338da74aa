"""Lamellar (binary) grating."""

from __future__ import annotations

from numbers import Real

import numpy as np

from ...errors import RequestError
from ..heightfield import HeightField
from .checks import check_profile
from .line_profile import one_row


def lamellar(period: float, depth: float, *, duty: float = 0.5, samples: int = 512) -> HeightField:
    """Binary grating: the first part of the period is at `depth`, the rest at zero.

    Args:
        period: along x, µm.
        depth: height of the ridges, µm.
        duty: width of the ridges relative to the period, rounded to whole pixels.
        samples: pixels per period.

    Returns:
        One period, (1, samples).

    Raises:
        ValueError: if the period is not positive, the depth negative, samples below two, or if the ridge or the
            groove is narrower than half a pixel.
    """
    check_profile(period, depth, samples)
    if not (isinstance(duty, Real) and 0 < duty < 1):
        raise RequestError(f"duty: got {duty!r}, wanted a fraction above 0 and below 1")
    high = round(duty * samples)
    if not 0 < high < samples:
        raise RequestError(f"duty: got {duty!r} with {samples} samples, wanted ridge and groove at least a pixel wide")
    heights = np.where(np.arange(samples) < high, depth, 0.0)
    return one_row(
        heights, period, f"lamellar grating, period {period:g} µm, depth {depth:g} µm, duty {high / samples:g}"
    )
