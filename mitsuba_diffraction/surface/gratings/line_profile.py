"""One row of heights: a grating that is uniform along y."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..heightfield import HeightField

Array = NDArray[np.float64]


def phase(samples: int) -> Array:
    """x / period at the centres of the pixels, (samples,)."""
    return (np.arange(samples) + 0.5) / samples


def one_row(heights: Array, period: float, source: str) -> HeightField:
    return HeightField(heights[None, :], (period / len(heights), period), source)
