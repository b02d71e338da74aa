"""What stands in the way of a right picture, each with what to do about it."""

from __future__ import annotations

import numpy as np

from ...coherence import lobe_width
from ...scalar_theory import ScalarError
from ...surface.heightfield import HeightField
from ...surface.periods import hann
from .statistics import Statistics

_COARSE = 0.09  # µm: a quarter of the shortest wavelength, as light of grazing incidence and exit wants
_BLUE, _GREEN = 0.45, 0.55  # µm
_LIMIT_SHARE = 0.02  # of the power beyond four fifths of the Nyquist limit
_STEP_SHARE = 1e-3  # of the light that steps of the heights scatter
_TURNED = 1.0  # degrees
_STEEP = 45.0  # degrees: light is reflected twice


def concerns(
    height_field: HeightField,
    numbers: Statistics,
    coherence_length: float,
    *,
    measured: bool,
    scalar: ScalarError,
) -> tuple[str, ...]:
    """Sentences, none if all is well.

    Args:
        height_field: the surface.
        numbers: its statistics.
        coherence_length: of the light, as far as the surface carries it, µm.
        measured: whether it is a scan; a formula has neither tilt nor steps of its own.
        scalar: the error of scalar theory.
    """
    found = []
    axes = zip(height_field.pixel_size, height_field.shape[::-1], strict=True)
    coarsest = max([pixel for pixel, count in axes if count > 1], default=0.0)
    if coarsest > _COARSE:
        found.append(
            f"Pixels of {coarsest * 1e3:.0f} nm are too coarse for light: orders beyond {1 / (2 * coarsest):.2g} "
            "cycles/µm are missing. Scan again with pixels of at most 90 nm."
        )
    if beyond := scalar.warning:
        found.append(f"{beyond[0].upper()}{beyond[1:]}.")
    if not measured:
        return tuple(found)
    # A slope s turns all light by 2s, q by 2s/λ; less than a lobe is not seen, but a degree is too much in any case.
    shift = 2 * np.tan(np.deg2rad(numbers.tilt)) / _GREEN
    if shift > lobe_width(coherence_length) or 2 * numbers.tilt > _TURNED:
        found.append(
            f"The scan is tilted by {numbers.tilt:.2g}° ({numbers.tilt_height * 1e3:.0f} nm from corner to corner), "
            f"which turns all reflected light by {2 * numbers.tilt:.2g}°. Level it: --prepare level_plane."
        )
    at_limit = _share_at_limit(height_field)
    if at_limit > _LIMIT_SHARE:
        found.append(
            f"{at_limit:.0%} of the light at 450 nm goes to detail of less than 2.5 pixels: noise, or detail too fine "
            "for the pixels, which shows in wrong directions. Scan again with smaller pixels, or filter the noise."
        )
    # Rounding to steps is noise of variance step²/12 and scatters (κ step)²/12 of the light.
    scattered = (4 * np.pi / _BLUE * numbers.step) ** 2 / 12
    if 16 <= numbers.levels <= 256 and scattered > _STEP_SHARE:
        found.append(
            f"Heights stand on {numbers.levels} levels, {numbers.step * 1e3:.2g} nm apart (8 bit?): rounding scatters "
            f"{scattered:.1%} of blue light. Export 16 bit or floats."
        )
    if height_field.filled:
        found.append(
            f"{height_field.filled} pixels of the scan were missing and are filled: where they remain, the heights are "
            "a guess."
        )
    if numbers.steepest > _STEEP:
        found.append(
            f"One sloping pixel in a hundred is steeper than {numbers.steepest:.0f}°: light is reflected more than "
            "once there, which is not computed, and a tip does not reach down such walls."
        )
    return tuple(found)


def _share_at_limit(height_field: HeightField) -> float:
    """The share of the phase's power at 450 nm and normal incidence beyond 0.8 of the Nyquist limit."""
    phase = np.exp(1j * 4 * np.pi / _BLUE * height_field.centred)
    power = np.abs(np.fft.fft2(phase * hann(phase.shape))) ** 2
    outside = np.zeros(power.shape, bool)
    for axis, count in enumerate(power.shape):
        if count > 1:
            far = np.abs(np.fft.fftfreq(count)) > 0.4
            outside |= far[:, None] if axis == 0 else far
    return float(power[outside].sum() / power.sum())
