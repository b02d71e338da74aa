"""Blazed grating: a sawtooth."""

from __future__ import annotations

from ..heightfield import HeightField
from .checks import check_profile
from .line_profile import one_row, phase


def blazed(period: float = 2.5, depth: float = 0.246, *, samples: int = 512) -> HeightField:
    """Sawtooth h = depth · x / period, rising along +x.

    At normal incidence its facets reflect light towards −x: into ω_o = −λq with q = m / period, m = 2 depth / λ.

    Args:
        period: along x, µm.
        depth: µm.
        samples: pixels per period.

    Returns:
        One period, (1, samples).

    Raises:
        ValueError: if the period is not positive, the depth negative, or samples below two.
    """
    check_profile(period, depth, samples)
    heights = depth * phase(samples)
    return one_row(heights, period, f"blazed grating, period {period:g} µm, depth {depth:g} µm")
