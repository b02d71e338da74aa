"""The ridges on a scale of a Morpho butterfly, without their lamellae."""

from __future__ import annotations

import numpy as np

from ...errors import RequestError
from ..heightfield import HeightField
from .canvas import Canvas, smooth_step
from .checks import check_positive, check_profile, generator


def morpho_ridges(
    period: float = 0.7,
    depth: float = 0.4,
    *,
    width: float = 0.3,
    size: float | tuple[float, float] = 31.5,
    pixel_size: float = 0.0625,
    seed: int = 0,
) -> HeightField:
    """Parallel ridges along y of unequal heights: the grating of a Morpho scale, **not its blue**.

    The blue is due to a stack of lamellae within each ridge, an interference filter that a height field cannot
    represent; this surface only models the scattering perpendicular to the ridges. Their uneven heights weaken the
    orders of the grating and scatter the rest (Kinoshita, Yoshioka & Kawagoe 2002, Proc. R. Soc. B 269, 1417–1421: a
    regular stack on irregular ridges, about 0.7 µm apart and 0.3 µm wide). Modelled on that description, neither
    measured nor of the real depth (about 2 µm, beyond scalar theory). For a blue butterfly, use a blue mirror.

    Args:
        period: mean spacing of the ridges along x, µm.
        depth: lowest to highest point, µm.
        width: of the ridges, µm.
        size: extent of the patch, µm, one number or (x, y); size_x is rounded to whole periods.
        pixel_size: µm, adjusted to a whole number of pixels per patch.
        seed: random seed.

    Returns:
        The patch, which tiles seamlessly.

    Raises:
        ValueError: if a length is not positive, the depth negative, the ridges wider than the period, the seed not a
            natural number, or the size too small or the pixels too coarse for the ridges.
    """
    check_profile(period, depth)
    check_positive("width", width)
    if width >= period:
        raise RequestError(f"width: got {width!r} µm, wanted less than the period, {period:g}")
    rng = generator(seed)
    canvas = Canvas(size, pixel_size, pitch=(period, period), axis=0)
    # The height differs between ridges and varies along each, where one lamella ends and the next begins.
    uneven = canvas.noise(rng, 0.0, 1.0)
    x = (np.arange(canvas.heights.shape[1]) + 0.5) * canvas.pixel[0]
    for centre, offset in zip(canvas.places(0), rng.normal(0, 0.15, canvas.count[0]), strict=True):
        column = int(centre / canvas.pixel[0]) % canvas.heights.shape[1]
        top = np.clip(1 + offset + 0.1 * uneven[:, column], 0.2, None)
        distance = np.abs((x - centre + canvas.size[0] / 2) % canvas.size[0] - canvas.size[0] / 2)
        canvas.heights += top[:, None] * smooth_step(width / 2 - distance, 0.06)
    return canvas.height_field(
        rng,
        depth,
        f"Morpho-like ridges (no lamellae), {canvas.count[0]} ridges of {canvas.pitch[0]:.4g} µm along x, "
        f"depth {depth:g} µm, seed {seed}",
    )
