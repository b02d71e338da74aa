"""Sinusoidal grating."""

from __future__ import annotations

import numpy as np

from ..heightfield import HeightField
from .checks import check_profile
from .line_profile import one_row, phase


def sinusoidal(period: float, depth: float, *, samples: int = 512) -> HeightField:
    """Sinusoid h = (depth / 2) · sin(2π x / period), so |F_m|² = J_m(κ · depth / 2)².

    Args:
        period: along x, µm.
        depth: peak to valley, µm.
        samples: pixels per period.

    Returns:
        One period, (1, samples).

    Raises:
        ValueError: if the period is not positive, the depth negative, or samples below two.
    """
    check_profile(period, depth, samples)
    heights = depth / 2 * np.sin(2 * np.pi * phase(samples))
    return one_row(heights, period, f"sinusoidal grating, period {period:g} µm, depth {depth:g} µm")
