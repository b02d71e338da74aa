"""Surface statistics (ISO 25178-2), and the effect of a blunt tip on a surface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import grey_dilation, grey_erosion

from ..errors import RequestError
from ..surface.heightfield import HeightField

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Statistics:
    """A height field in numbers. Sa, Sq, Sz and Sdq are about the reference plane (ISO 25178-2, without filters).

    Attributes:
        Sa: arithmetical mean height, mean |h|, µm.
        Sq: root mean square height, µm.
        Sz: maximum height, highest to lowest, µm.
        Sdq: root mean square slope (gradient between neighbouring pixels), a number.
        steepest: slope, in degrees, that one in a hundred of the pixels that are not flat exceeds.
        tilt: of the reference plane, degrees from level.
        tilt_height: height difference of the reference plane from corner to corner of the patch, µm.
        levels: how many different heights there are.
        step: smallest difference between two of them, µm; 0 where all are equal.
    """

    Sa: float
    Sq: float
    Sz: float
    Sdq: float
    steepest: float
    tilt: float
    tilt_height: float
    levels: int
    step: float


def statistics(height_field: HeightField, *, extent: str = "sample") -> Statistics:
    """Compute the statistics of a height field, about `reference_plane`."""
    heights = height_field.heights
    plane, slopes = reference_plane(height_field, extent)
    level = heights - plane
    gradients = [
        np.gradient(level, pixel, axis=axis) if level.shape[axis] > 1 else np.zeros_like(level)
        for axis, pixel in ((1, height_field.pixel_size[0]), (0, height_field.pixel_size[1]))
    ]
    slope = np.hypot(*gradients)
    # Walls of few pixels between plateaus are slopes, too.
    sloping = slope[slope > 1e-9 * max(slope.max(), 1e-300)]
    values = np.unique(heights)
    # What arithmetic makes of equal numbers is no difference.
    steps = np.diff(values)
    steps = steps[steps > 1e-9 * max(np.abs(values).max(), 1e-300)]
    return Statistics(
        Sa=float(np.abs(level).mean()),
        Sq=float(np.sqrt(np.mean(level**2))),
        Sz=float(np.ptp(level)),
        Sdq=float(np.sqrt(np.mean(slope**2))),
        steepest=float(np.degrees(np.arctan(np.quantile(sloping, 0.99)))) if sloping.size else 0.0,
        tilt=float(np.degrees(np.arctan(np.hypot(*slopes)))),
        tilt_height=float(np.ptp(plane)),
        levels=len(steps) + 1,
        step=float(steps.min()) if len(steps) else 0.0,
    )


def reference_plane(height_field: HeightField, extent: str) -> tuple[Array, tuple[float, float]]:
    """Return the plane to which heights refer, (N_y, N_x) µm, and its slopes along x and y.

    For a sample, the least-squares plane; for a tile, which is periodic, a level one.
    """
    rows, columns = height_field.shape
    if extent == "tile":
        return np.full((rows, columns), height_field.heights.mean()), (0.0, 0.0)
    # On a full grid the three unknowns do not mix.
    x = (np.arange(columns) - (columns - 1) / 2) * height_field.pixel_size[0]
    y = (np.arange(rows) - (rows - 1) / 2) * height_field.pixel_size[1]
    mean = height_field.heights.mean()
    slope_x = float(height_field.heights.mean(axis=0) @ x / max(x @ x, 1e-300))
    slope_y = float(height_field.heights.mean(axis=1) @ y / max(y @ y, 1e-300))
    return mean + slope_x * x + slope_y * y[:, None], (slope_x, slope_y)


_HALVINGS = 12


def scanned(height_field: HeightField, radius: float, *, extent: str = "sample") -> HeightField:
    """Return the surface as a tip of this radius records it or, for a negative radius, as it was before.

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
    """Return the surface with ridges wider by `share`, and the radius (µm, signed) of the tip that widens them so.

    The width of ridges is measured by the area above mid-height, half way between the mean of the heights above the
    average and the mean of those below; a tip radius is sought for which it grows by `share` (shrinks, if negative).

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
