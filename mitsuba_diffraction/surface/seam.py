"""The seam of a tiled patch."""

from __future__ import annotations

import numpy as np

from .heightfield import HeightField

_VISIBLE = 1.5
"""Ratio of steps above which a seam is visible."""

_LEAST = 0.002
"""µm; a step of 2 nm scatters (4π·0.002/0.45)² = 0.3 % of the blue light that falls on it."""


def seam_steps(height_field: HeightField) -> dict[str, tuple[float, float]]:
    """Height steps between adjacent pixels across the seam and inside the patch.

    Returns:
        For each axis of more than two pixels, "x" or "y": the r.m.s. step from the last pixel to the first, and from
        each pixel to the next, µm. Missing pixels are ignored.
    """
    found = {}
    for axis, heights in (("x", height_field.heights), ("y", height_field.heights.T)):
        if heights.shape[1] > 2:
            inside, across = np.diff(heights, axis=1), heights[:, 0] - heights[:, -1]
            found[axis] = (float(np.sqrt(np.nanmean(across**2))), float(np.sqrt(np.nanmean(inside**2))))
    return found


def seam_matters(steps: dict[str, tuple[float, float]]) -> bool:
    """Whether a seam is visible: the period of the tiling would then act as a grating."""
    return any(across > max(_VISIBLE * inside, _LEAST) for across, inside in steps.values())
