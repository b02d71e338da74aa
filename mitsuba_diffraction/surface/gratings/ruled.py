"""Ruled grating, specified by lines per millimetre and blaze wavelength as in catalogues."""

from __future__ import annotations

from numbers import Real

import numpy as np

from ...errors import RequestError
from ..heightfield import HeightField
from .blazed import blazed


def ruled(lines_per_mm: float = 600.0, *, blaze_wavelength: float = 500.0, samples: int = 512) -> HeightField:
    """Blazed grating with given lines per millimetre and blaze wavelength.

    The blaze wavelength λ_B is that of the first order in Littrow mounting, where light returns along the normal of the
    facets, at the blaze angle θ_B (Palmer 2020, Diffraction Grating Handbook, chapters 2 and 9). With the
    period d and the depth D of a groove,

        λ_B = 2 d sin θ_B,    D = d tan θ_B.

    In that mounting κD = 2π, so that scalar theory diffracts all power into the first order.

    Args:
        lines_per_mm: grooves per millimetre; the period is 1000 / lines_per_mm in µm.
        blaze_wavelength: λ_B in nm.
        samples: pixels per period.

    Returns:
        One period, (1, samples), rising along +x.

    Raises:
        ValueError: if a number is not positive, samples are below two, or the blaze wavelength is not below twice the
            period.
    """
    for name, value, unit in (
        ("lines_per_mm", lines_per_mm, "lines per mm"),
        ("blaze_wavelength", blaze_wavelength, "nm"),
    ):
        if not (isinstance(value, Real) and np.isfinite(value) and value > 0):
            raise RequestError(f"{name}: got {value!r}, wanted a positive number of {unit}")
    period = 1000 / lines_per_mm
    sine = blaze_wavelength * 1e-3 / (2 * period)
    if sine >= 1:
        raise RequestError(
            f"blaze_wavelength: got {blaze_wavelength:g} nm, wanted less than twice the period, {2000 * period:.4g} nm"
        )
    angle = np.arcsin(sine)
    heights = blazed(period, period * np.tan(angle), samples=samples)
    return HeightField(
        heights.heights,
        heights.pixel_size,
        f"ruled grating, {lines_per_mm:g} lines/mm, blazed for {blaze_wavelength:g} nm ({np.degrees(angle):.2f}°)",
    )
