"""How far colours can be trusted: what ±5 % of the height scale, the pixel size and the tip's broadening change."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...color import delta_E, spectrum_to_XYZ
from ...errors import RequestError
from ...spectrum import GratingSpectrum
from ...surface.heightfield import HeightField
from ...surface.periods import Period, find_periods
from .colours import WAVELENGTHS, order_angle, order_share, radiance
from .tip import broadened

SHARE = 0.05
"""The change that is tried, both ways."""

GREEN = 0.55
"""µm, the wavelength for which orders are told."""

ORDERS = (1, 2)


@dataclass(frozen=True)
class Change:
    """What becomes of period and orders when one thing about the scan was different.

    Attributes:
        what: "height scale", "pixel size" or "tip broadening".
        by: the change, +0.05 or −0.05.
        period: of the main period, a share of it.
        before, after: m → share of the reflected light in the orders ±m, 550 nm at normal incidence.
        colour: m → ΔE00 of what is seen where the order m of 550 nm went before, on its brighter side. The brighter
            of the orders has half of the luminance of a white sheet before.
        tip_radius: of the tip that broadens so much, µm; NaN for the others.
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
    """A surface and how it is scaled."""

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
    """Two of each kind, + and −; of the tip only if it is a scan.

    A blunter and a sharper tip change a surface that is the same upside down, such as a sinusoid or a sawtooth, alike:
    one widens the ridges, the other the grooves, and h and −h have the same powers.

    Height scale and pixel size scale the arguments of the one spectrum (`radiance`); the tip makes another surface, of
    which periods are searched for and a spectrum is built.

    Args:
        height_field: the surface.
        spectrum: of it, for wavelengths from 360 nm divided by 1.05.
        main: its main period.
        extent: "tile" or "sample".
        measured: whether it is a scan.
        build: makes spectra alike.
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
    """The period that is nearest to the main one in direction, else the main one itself."""

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
    """XYZ, not negative, of what is seen at normal incidence in the direction in which `period` sends 550 nm."""
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
