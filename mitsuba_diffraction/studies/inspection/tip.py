"""What a blunt tip does to a scan: dilation by a paraboloid, and erosion, which undoes what can be undone."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import grey_dilation, grey_erosion

from ...errors import RequestError
from ...surface.heightfield import HeightField

_HALVINGS = 12


def scanned(height_field: HeightField, radius: float, *, extent: str = "sample") -> HeightField:
    """The surface as a tip of this radius records it, or, for a negative radius, as it was before.

    The lowest place that a paraboloid ρ²/2r can reach over each point is the dilation of the heights by it; erosion by
    the same gives back all that the tip touched (Villarrubia 1997, J. Res. NIST 102, 425–454):

        h_r(x) = max_ρ [h(x + ρ) − ρ²/2r],    h_{−r}(x) = min_ρ [h(x + ρ) + ρ²/2r]

    Args:
        height_field: the surface.
        radius: r at the apex, µm.
        extent: a "tile" is continued by itself, a "sample" by its edge.

    Returns:
        Heights on the same pixels.
    """
    heights = height_field.heights
    mode = "wrap" if extent == "tile" else "nearest"
    reach = np.sqrt(2 * abs(radius) * max(height_field.height_range, 1e-12))
    for axis, pixel in ((1, height_field.pixel_size[0]), (0, height_field.pixel_size[1])):
        half = min(int(np.ceil(reach / pixel)), heights.shape[axis] // 2)
        # A paraboloid is the sum of a parabola along x and one along y: one axis after the other.
        parabola = -((np.arange(-half, half + 1) * pixel) ** 2) / (2 * abs(radius))
        structure = parabola[None, :] if axis == 1 else parabola[:, None]
        heights = (grey_dilation if radius > 0 else grey_erosion)(heights, structure=structure, mode=mode)
    return HeightField(heights, height_field.pixel_size, height_field.source)


def broadened(height_field: HeightField, share: float, *, extent: str = "sample") -> tuple[HeightField, float]:
    """The surface whose ridges are wider by `share`, and the radius (µm, signed) of the tip that makes them so.

    How wide ridges are is told by the area above mid-height, half way between the mean of the heights above the average
    and the mean of those below; the tip's radius is searched for with which it grows by `share` (shrinks, if negative).

    Raises:
        ValueError: if no tip does that: a flat surface.
    """
    heights = height_field.heights
    if height_field.height_range < 1e-12:
        raise RequestError("height_field: got a flat surface, wanted one with ridges")
    high_part = heights > heights.mean()
    level = (heights[high_part].mean() + heights[~high_part].mean()) / 2
    above = np.mean(heights > level)

    def reached(radius: float) -> bool:
        field = scanned(height_field, radius, extent=extent)
        return abs(np.mean(field.heights > level) / above - 1) >= abs(share)

    sign = float(np.sign(share))
    low, high = 0.0, min(height_field.pixel_size) / 8
    largest = max(height_field.tile_size) ** 2 / height_field.height_range
    while not reached(sign * high):
        low, high = high, 2 * high
        if high > largest:
            raise RequestError("height_field: no tip broadens its ridges that much")
    for _ in range(_HALVINGS):
        middle_radius = (low + high) / 2
        if reached(sign * middle_radius):
            high = middle_radius
        else:
            low = middle_radius
    return scanned(height_field, sign * high, extent=extent), sign * high
