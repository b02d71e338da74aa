"""Uncertainty of the predicted colours, and reasons to distrust a picture.

Uncertainty is the effect of ±5 % of the height scale, the pixel size and the tip's broadening.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..color import delta_E, spectrum_to_XYZ
from ..errors import RequestError
from ..grating_spectrum import GratingSpectrum
from ..scalar_theory import ScalarError
from ..settings import lobe_width
from ..surface.heightfield import HeightField
from ..surface.periods import Period, find_periods, hann
from .colours import WAVELENGTHS, order_angle, order_share, radiance
from .statistics import Statistics, broadened

SHARE = 0.05
"""The change that is tried, both ways."""

GREEN = 0.55
"""µm, the wavelength for which orders are reported."""

ORDERS = (1, 2)


@dataclass(frozen=True)
class Change:
    """Change of period and orders with one property of the scan.

    Attributes:
        what: "height scale", "pixel size" or "tip broadening".
        by: the change, +0.05 or −0.05.
        period: of the main period, a share of it.
        before, after: m → share of the reflected light in the orders ±m, 550 nm at normal incidence.
        colour: m → ΔE00 in the direction of the order m of 550 nm before the change, on its brighter side. Exposure
            gives the brighter of the orders half of the luminance of a white sheet before the change.
        tip_radius: of the tip that broadens the ridges so, µm; NaN for other changes.
    """

    what: str
    by: float
    period: float
    before: Mapping[int, float]
    after: Mapping[int, float]
    colour: Mapping[int, float]
    tip_radius: float = float("nan")


@dataclass(frozen=True)
class _View:
    """A surface and its scale."""

    spectrum: GratingSpectrum
    period: float
    height_scale: float = 1.0
    lateral_scale: float = 1.0


def changes(
    height_field: HeightField,
    spectrum: GratingSpectrum,
    main: Period,
    *,
    extent: str,
    measured: bool,
    build: Callable[[HeightField], GratingSpectrum],
) -> tuple[Change, ...]:
    """Compute two changes of each kind, + and −; of the tip only if the surface is a scan.

    A blunter and a sharper tip have equal effects on a surface that is equal to its negative, such as a sinusoid or a
    sawtooth: one widens the ridges, the other the grooves, and h and −h have the same powers.

    Height scale and pixel size scale the arguments of the one spectrum (`radiance`); the tip makes another surface,
    whose periods and spectrum are computed anew.

    Args:
        height_field: the surface.
        spectrum: of it, for wavelengths from 360 nm divided by 1.05.
        main: its main period.
        extent: "tile" or "sample".
        measured: whether it is a scan.
        build: builds a spectrum with the same settings.
    """
    orders = [m for m in ORDERS if order_angle(m, main.period, GREEN) is not None]
    before = _View(spectrum, main.period)
    sides = {m: _brighter_side(before, main, m) for m in orders}
    shares = {m: _share(before, main, m) for m in orders}
    colours = {m: _XYZ(before, main, sides[m], main.period) for m in orders}
    brightest = max((XYZ[1] for XYZ in colours.values()), default=1.0)
    exposure = 0.5 / brightest if brightest > 0 else 1.0

    def change(what: str, by: float, after: _View, tip_radius: float = float("nan")) -> Change:
        after_shares = {m: _share(after, main, m) for m in orders}
        colour = {
            m: float(delta_E(exposure * colours[m], exposure * _XYZ(after, main, sides[m], main.period)))
            for m in orders
        }
        return Change(what, by, after.period / main.period - 1, shares, after_shares, colour, tip_radius)

    found = []
    for by in (SHARE, -SHARE):
        found.append(change("height scale", by, _View(spectrum, main.period, height_scale=1 + by)))
    for by in (SHARE, -SHARE):
        found.append(change("pixel size", by, _View(spectrum, main.period * (1 + by), lateral_scale=1 + by)))
    for by in (SHARE, -SHARE) if measured else ():
        try:
            other, radius = broadened(height_field, by, extent=extent)
        except RequestError:
            continue  # steps from one pixel to the next: no tip is that sharp
        period = _same_period(find_periods(other, extent=extent), main)
        found.append(change("tip broadening", by, _View(build(other), period), radius))
    return tuple(found)


def _same_period(found: tuple[Period, ...], main: Period) -> float:
    """Return the period nearest to the main one in direction, else the main one itself."""

    def apart(other: Period) -> float:
        return abs((other.direction - main.direction + 90) % 180 - 90)

    near = [other for other in found if apart(other) < 10]
    return min(near, key=apart).period if near else main.period


def _share(view: _View, main: Period, order: int) -> float:
    return order_share(
        view.spectrum,
        main.direction,
        view.period,
        order,
        GREEN,
        height_scale=view.height_scale,
        lateral_scale=view.lateral_scale,
    )


def _XYZ(view: _View, main: Period, order: int, period: float) -> NDArray[np.float64]:
    """Return non-negative XYZ at normal incidence in the direction to which `period` diffracts 550 nm."""
    light = radiance(
        view.spectrum,
        main.direction,
        0.0,
        order_angle(order, period, GREEN),
        height_scale=view.height_scale,
        lateral_scale=view.lateral_scale,
    )
    return np.maximum(spectrum_to_XYZ(light, WAVELENGTHS), 0)


def _brighter_side(view: _View, main: Period, order: int) -> int:
    return max((order, -order), key=lambda m: _XYZ(view, main, m, main.period)[1])


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
    """Return concerns about the surface as sentences; none if all is well.

    Args:
        height_field: the surface.
        numbers: its statistics.
        coherence_length: of the light, limited to what the surface supports, µm.
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
    """Return the share of the phase's power at 450 nm and normal incidence beyond 0.8 of the Nyquist limit."""
    phase = np.exp(1j * 4 * np.pi / _BLUE * height_field.centred)
    power = np.abs(np.fft.fft2(phase * hann(phase.shape))) ** 2
    outside = np.zeros(power.shape, bool)
    for axis, count in enumerate(power.shape):
        if count > 1:
            far = np.abs(np.fft.fftfreq(count)) > 0.4
            outside |= far[:, None] if axis == 0 else far
    return float(power[outside].sum() / power.sum())
