"""Synthetic replica of the shed skin of Elaphe guttata."""

from __future__ import annotations

import numpy as np

from ..heightfield import HeightField
from .canvas import Array, Canvas, smooth_step
from .checks import check_profile, generator


def elaphe(
    size: float | tuple[float, float] = 32.0,
    *,
    pixel_size: float = 0.0625,
    depth: float = 0.375,
    period: float = 1.144,
    seed: int = 0,
) -> HeightField:
    """Synthetic replica of the shed skin of *Elaphe guttata*, not a measurement.

    Fingers along x that taper towards +x, side by side along **y**, the diffracting direction. Between two fingers a
    groove starts as a deep narrow crotch and widens up to the tips of the fingers, where the next row begins, 2.93
    periods further on. Granules sit on top of the fingers. Positions, lengths, widths, heights and tilts vary from
    finger to finger as in AFM scans of such skins. The shape is modelled on a 5.9 µm AFM scan of the LANE lab, Geneva.

    The patch tiles seamlessly: size_y is rounded to whole periods, and the pitch of the rows is adjusted to size_x.

    Args:
        size: approximate size of the patch, µm, one number or (x, y).
        pixel_size: µm, adjusted to a whole number of pixels per patch.
        depth: lowest to highest point, µm.
        period: mean distance from finger to finger along y, µm.
        seed: random seed.

    Returns:
        The patch, (round(size_y / pixel_size), round(size_x / pixel_size)).

    Raises:
        ValueError: if a length is not positive, the depth negative, the seed not a natural number, the size below two
            rows or four fingers, or the pixels too coarse for the fingers.
    """
    check_profile(period, depth)
    rng = generator(seed)
    canvas = Canvas(size, pixel_size, pitch=(2.93 * period, period), axis=1)
    row_pitch, pitch = canvas.pitch

    # The lattice of crotches: it drifts slowly, rows shift against each other, and every crotch has its own place.
    drift_x = 0.08 * row_pitch * canvas.noise(rng, 8.0, 4.0)
    drift_y = 0.12 * pitch * canvas.noise(rng, 8.0, 8.0)
    granules = np.zeros_like(canvas.heights)
    for x, row_shift in zip(canvas.places(0), rng.normal(0, 0.05 * pitch, canvas.count[0]), strict=True):
        for y in canvas.places(1):
            x_0 = x + canvas.at(drift_x, x, y) + rng.normal(0, 0.04 * row_pitch)
            y_0 = y + canvas.at(drift_y, x, y) + row_shift + rng.normal(0, 0.035 * pitch)
            _elaphe_groove(canvas, rng, x_0, y_0)
            _elaphe_tip(canvas, rng, x_0, y_0 + pitch / 2)
            _elaphe_granules(canvas, granules, rng, x_0, y_0 + pitch / 2)
    # Fibrils run along the fingers; the rest is roughness.
    canvas.heights += granules
    canvas.heights += 0.005 * canvas.noise(rng, 0.3, 0.04) + 0.008 * canvas.noise(rng, 1.5, 0.7)
    return canvas.height_field(
        rng,
        depth,
        f"synthetic Elaphe skin, {canvas.count[1]} fingers of {pitch:.4g} µm along y, "
        f"{canvas.count[0]} rows of {row_pitch:.4g} µm along x, depth {depth:g} µm, seed {seed}",
    )


# Heights in µm as they were read off the mean unit cell of the AFM patch; the patch is scaled to `depth` at the end.


def _elaphe_groove(canvas: Canvas, rng: np.random.Generator, x_0: float, y_0: float) -> None:
    """The groove between two fingers, from its crotch at (x_0, y_0) along +x."""
    row_pitch, pitch = canvas.pitch
    length = row_pitch * (0.97 + rng.normal(0, 0.035))
    tilt = (-0.1 + rng.normal(0, 0.05)) * pitch / row_pitch
    width = 0.38 + rng.normal(0, 0.035)
    floor = 0.09 * rng.uniform(0.8, 1.2)
    crotch = 0.03 + 0.09 * rng.beta(1, 3)
    index, x, y = canvas.window((x_0 - 0.15 * row_pitch, x_0 + 1.3 * row_pitch), (y_0 - 0.8 * pitch, y_0 + 0.8 * pitch))
    s = (x - x_0) / length
    t = (y - y_0 - tilt * (x - x_0)) / pitch
    half = width * np.clip(s, 0, 1) ** 0.7
    groove = (
        smooth_step(half - np.abs(t), 0.105)
        * smooth_step(s, 0.05)
        * (1 - smooth_step(s - 1.09 + 0.15 * np.abs(t), 0.13))
    )
    dip = np.exp(-(((s - 0.1) / 0.1) ** 2) - ((t / (0.085 + 0.03 * np.clip(s / 0.2, 0, 1))) ** 2))
    canvas.heights[index] -= floor * groove + crotch * dip


def _elaphe_tip(canvas: Canvas, rng: np.random.Generator, x_0: float, y_0: float) -> None:
    """The round edge where a finger ends on the next row, which lies lower there and rises again."""
    row_pitch, pitch = canvas.pitch
    x_tip = x_0 + row_pitch * (0.93 + rng.normal(0, 0.05))
    y_tip = y_0 - 0.1 * pitch
    drop = 0.028 * rng.uniform(0.4, 1.6)
    index, x, y = canvas.window((x_tip - 0.3 * row_pitch, x_tip + 0.8 * row_pitch), (y_tip - pitch, y_tip + pitch))
    t = (y - y_tip) / pitch
    s = (x - x_tip) / row_pitch + 0.5 * t**2
    canvas.heights[index] -= drop * smooth_step(s, 0.02) * np.exp(-np.maximum(s, 0) / 0.12) * np.exp(-((t / 0.42) ** 4))


def _elaphe_granules(canvas: Canvas, granules: Array, rng: np.random.Generator, x_0: float, y_0: float) -> None:
    """A few large granules and some small ones along the ridge of a finger; where two meet, the higher stays."""
    row_pitch, pitch = canvas.pitch
    for number, radius, height in ((rng.poisson(2.6), 0.12, 0.09), (rng.poisson(5.0), 0.055, 0.03)):
        for _ in range(number):
            size = rng.uniform(0.7, 1.35)
            along = rng.uniform(0.0, 0.9)
            x_g = x_0 + along * row_pitch
            y_g = y_0 - 0.1 * along * pitch + rng.normal(0, 0.08) * pitch
            r = radius * size
            index, x, y = canvas.window((x_g - 3.5 * r, x_g + 4.5 * r), (y_g - 3 * r, y_g + 3 * r))
            # Granules lean along the finger, as the scan shows them.
            stretch = np.where(x > x_g, 1.4, 1.0)
            granule = height * size * np.exp(-(((x - x_g) / (stretch * r)) ** 2) - ((y - y_g) / r) ** 2)
            granules[index] = np.maximum(granules[index], granule)
