"""Crossed grating: two perpendicular sinusoids."""

from __future__ import annotations

import numpy as np

from ..heightfield import HeightField
from .checks import check_period, check_pixels, check_profile
from .line_profile import phase


def crossed(period: float, depth: float, *, period_y: float | None = None, samples: int = 128) -> HeightField:
    """Sum of a sinusoid along x and one along y, so that the orders are products |F_m|² = |F_{m_x}|² |F_{m_y}|².

    Args:
        period: wavelength along x, µm.
        depth: peak to valley of *each* sinusoid, µm; their sum spans twice that.
        period_y: wavelength along y, µm; default: that along x.
        samples: pixels per period in either direction.

    Returns:
        One period in each direction, (samples, samples).

    Raises:
        ValueError: if a period is not positive, the depth negative, or samples below two.
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
