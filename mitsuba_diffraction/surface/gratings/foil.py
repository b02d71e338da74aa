"""Embossed holographic foil: sinusoids in two or three directions."""

from __future__ import annotations

import numpy as np

from ...errors import RequestError
from ..heightfield import HeightField
from .checks import check_pixels, check_profile


def foil(period: float = 1.0, depth: float = 0.15, *, directions: int = 2, samples: int = 64) -> HeightField:
    """Crossed sinusoids of equal amplitude, as from successive interference exposures.

        h(x) = a Σ_j cos(2π k_j·x),    k_j = (cos α_j, sin α_j) / period

    Two directions, α = 0° and 90°, give a square lattice with depth = 4a; three, 0°, 60° and 120°, a hexagonal one with
    depth = 9a/2. Each wave alone has the orders J_m(κa)².

    Args:
        period: of each wave, µm.
        depth: lowest to highest point of the sum, µm.
        directions: 2 or 3.
        samples: pixels per period, even.

    Returns:
        One tile: period × period, (samples, samples); or 2 period × 2 period/√3, about (2 samples/√3, 2 samples).

    Raises:
        ValueError: if the period is not positive, the depth negative, samples not even or below two, or there are
            other directions than these.
    """
    check_profile(period, depth, samples)
    if samples % 2:
        raise RequestError(f"samples: got {samples}, wanted an even number, so that the lowest point is on a pixel")
    if directions not in (2, 3):
        raise RequestError(f"directions: got {directions!r}, wanted 2 (crossed) or 3 (hexagonal)")
    # In units of the period. The highest and the lowest point are on pixels.
    if directions == 2:
        size, pixels = np.array([1.0, 1.0]), (samples, samples)
    else:
        size = np.array([2.0, 2 / np.sqrt(3)])
        # The lowest points lie at a third of the period along x and half of the tile along y.
        pixels = (6 * round(samples / 3), 2 * round(samples / np.sqrt(3)))
    check_pixels(*pixels)
    x, y = (np.arange(n) / n * s for n, s in zip(pixels, size, strict=True))
    waves = np.zeros((len(y), len(x)))
    for j in range(directions):
        angle = np.pi / directions * j
        waves += np.cos(2 * np.pi * (np.cos(angle) * x + np.sin(angle) * y[:, None]))
    span = 4.0 if directions == 2 else 4.5
    return HeightField(
        waves * depth / span,
        tuple(float(s * period / n) for s, n in zip(size, pixels, strict=True)),
        f"embossed foil, {directions} directions, period {period:g} µm, depth {depth:g} µm",
    )
