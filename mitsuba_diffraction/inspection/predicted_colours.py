"""Predicted colours: against the viewing angle, of single orders, and their uncertainty.

All in the plane of incidence that holds the wave vector of the main period, for a surface that reflects all wavelengths
alike (R = 1), under daylight (D65), without the energy factor E:

    L(λ) ∝ D65(λ) K G S(q e; κ)/λ² · cos θ_i,    q = (sin θ_i − sin θ_o)/λ,    κ = 2π (cos θ_i + cos θ_o)/λ

Angles are positive on the side opposite to the light: the specular direction is θ_o = θ_i. The uncertainty is the
effect of ±5 % of the height scale, the pixel size and the tip's broadening.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import grey_dilation, grey_erosion

from ..array_types import Real
from ..errors import RequestError
from ..optics.color import XYZ_to_linear_sRGB, daylight, delta_E, hex_code, into_gamut, radiance_to_XYZ
from ..optics.geometry import k_g
from ..precomputation.grating_spectrum import GratingSpectrum
from ..settings import VISIBLE
from ..surface.heightfield import HeightField
from ..surface.periods import Period, find_periods

MAX_COLOUR_COHERENCE_LENGTH = 20.0  # µm; at 65 µm orders of one wavelength are narrower than a pixel of the picture
WAVELENGTHS = np.arange(VISIBLE[0], VISIBLE[1] + 1, 2.0)  # nm; fine enough for these lobes


def illumination() -> Real:
    """Return D65 at `WAVELENGTHS`, of luminance Y = 1."""
    values = daylight(WAVELENGTHS)
    return values / radiance_to_XYZ(values, WAVELENGTHS)[1]


def radiance(
    spectrum: GratingSpectrum,
    direction: float,
    theta_i: ArrayLike,
    theta_o: ArrayLike,
    *,
    height_scale: float = 1.0,
    lateral_scale: float = 1.0,
) -> Real:
    """Compute L(λ), defined in the docstring of this module.

    Heights scaled by s have the spectrum S(q; s κ). A surface stretched by s has s² S(s q; κ), where the coherence
    length is scaled as well.

    Args:
        direction: of the wave vector e, degrees from +x.
        theta_i, theta_o: (...), degrees, broadcast against each other.
        height_scale, lateral_scale: of the heights, and of the lengths in the surface.

    Returns:
        (..., n) for the n `WAVELENGTHS`.
    """
    theta_i, theta_o = np.broadcast_arrays(np.deg2rad(theta_i), np.deg2rad(theta_o))
    cos_i, cos_o = np.cos(theta_i)[..., None], np.cos(theta_o)[..., None]
    wavelengths = WAVELENGTHS * 1e-3
    q = (np.sin(theta_i) - np.sin(theta_o))[..., None] / wavelengths
    kappa = 2 * np.pi * (cos_i + cos_o) / wavelengths
    along = np.deg2rad(direction)
    vector = lateral_scale * q[..., None] * np.array([np.cos(along), np.sin(along)])
    density = lateral_scale**2 * spectrum.evaluate(vector, height_scale * kappa)
    factor = k_g(cos_i, cos_o, (q * wavelengths) ** 2)
    return illumination() * factor * density / wavelengths**2 * cos_i


@dataclass(frozen=True)
class Colour:
    """The colour of a surface in one direction.

    Attributes:
        angle: of incidence, degrees.
        view: angle of the viewer, degrees.
        XYZ: (3,), of R = 1; Y = 1 for a white sheet in the place of the surface.
        sRGB: "#ffc08a": its brightest component is 255; colours outside the gamut are desaturated.
    """

    angle: float
    view: float
    XYZ: tuple[float, float, float]
    sRGB: str


def colours_at(spectrum: GratingSpectrum, direction: float, angles: ArrayLike, views: ArrayLike) -> tuple[Colour, ...]:
    """Predict the colours for each pair of angles of incidence (a,) and view (b,), degrees above −90 and below 90."""
    found = []
    for angle, view in product(np.ravel(angles).tolist(), np.ravel(views).tolist()):
        # A white sheet has the radiance D65 cos θ_i/π.
        factor = np.pi / np.cos(np.deg2rad(angle))
        XYZ = np.maximum(factor * radiance_to_XYZ(radiance(spectrum, direction, angle, view), WAVELENGTHS), 0)
        found.append(Colour(angle, view, tuple(XYZ.tolist()), hex_code(into_gamut(XYZ_to_linear_sRGB(XYZ)))))
    return tuple(found)


def order_angle(order: int, period: float, wavelength: float) -> float | None:
    """Return θ_o in degrees of an order at normal incidence, sin θ_o = m λ/period (µm); None if evanescent."""
    sine = order * wavelength / period
    return float(np.degrees(np.arcsin(sine))) if abs(sine) < 1 else None


def order_fraction(
    spectrum: GratingSpectrum,
    direction: float,
    period: float,
    order: int,
    wavelength: float,
    *,
    height_scale: float = 1.0,
    lateral_scale: float = 1.0,
) -> float:
    """Return the fraction of the reflected power in the orders ±m, at normal incidence (R = 1, K G = 1).

    S is integrated over squares of side 1/period about q = ±m e/period, at the κ of the order. An irregular surface
    spreads its orders over these squares; a grating has them at the centres. Period and wavelength are in µm, the
    period after scaling.
    """
    angle = order_angle(order, period, wavelength)
    if angle is None:
        return 0.0
    kappa = 2 * np.pi * (1 + np.cos(np.deg2rad(angle))) / wavelength
    # S is a sum of lobes of width σ_q: a sum over points σ_q apart is their integral.
    count = int(np.clip(np.ceil(1 / (period * spectrum.lobe_width)), 8, 400))
    offset = ((np.arange(count) + 0.5) / count - 0.5) / period
    along = np.deg2rad(direction)
    e, across = np.array([np.cos(along), np.sin(along)]), np.array([-np.sin(along), np.cos(along)])
    total = 0.0
    for sign in (1, -1):
        q = (sign * order / period + offset)[:, None, None] * e + offset[None, :, None] * across
        total += spectrum.evaluate(lateral_scale * q, np.float64(height_scale * kappa)).mean()
    return float(total * lateral_scale**2 / period**2)


CHANGE = 0.05  # relative change of a property, up and down
GREEN = 0.55  # µm, the wavelength for which orders are reported
ORDERS = (1, 2)


@dataclass(frozen=True)
class Change:
    """Change of period, orders and colours with one property of the scan.

    Attributes:
        what: "height scale", "pixel size" or "tip broadening".
        by: the change, +0.05 or −0.05.
        period: relative change of the main period.
        before, after: m → fraction of the reflected light in the orders ±m, at 550 nm and normal incidence.
        colour: m → ΔE00 in the direction of the order m of 550 nm before the change, of the brighter sign. The exposure
            gives the brightest order half the luminance of a white sheet before the change.
        tip_radius: of the tip that causes the broadening, µm; NaN for other changes.
    """

    what: str
    by: float
    period: float
    before: Mapping[int, float]
    after: Mapping[int, float]
    colour: Mapping[int, float]
    tip_radius: float = float("nan")


class _AtNormalIncidence(NamedTuple):
    """A surface at normal incidence: its spectrum, its main period and the direction of that, and how it is scaled."""

    spectrum: GratingSpectrum
    direction: float
    period: float
    scale: Mapping[str, float] = {}

    def fraction(self, order: int) -> float:
        """Return `order_fraction` at 550 nm."""
        return order_fraction(self.spectrum, self.direction, self.period, order, GREEN, **self.scale)

    def XYZ(self, theta_o: float) -> Real:
        """Return non-negative XYZ in a direction, degrees."""
        radiances = radiance(self.spectrum, self.direction, 0.0, theta_o, **self.scale)
        return np.maximum(radiance_to_XYZ(radiances, WAVELENGTHS), 0)


def changes(
    height_field: HeightField,
    spectrum: GratingSpectrum,
    main: Period,
    *,
    extent: str,
    measured: bool,
    build: Callable[[HeightField], GratingSpectrum],
) -> tuple[Change, ...]:
    """Compute two changes of each kind, + and −; for the tip only if the surface was measured.

    If h and −h have the same shape (sinusoid, sawtooth), a blunter and a sharper tip change the colours equally: one
    widens the ridges, the other the grooves.

    Height scale and pixel size scale the arguments of the spectrum (`radiance`). The tip changes the surface, whose
    periods and spectrum are computed again, by `build`, with the same settings. The spectrum must be valid for
    wavelengths from 360 nm/1.05.
    """
    angles = {m: angle for m in ORDERS if (angle := order_angle(m, main.period, GREEN)) is not None}
    before = _AtNormalIncidence(spectrum, main.direction, main.period)
    views = {m: max((angle, -angle), key=lambda theta_o: before.XYZ(theta_o)[1]) for m, angle in angles.items()}
    fractions = {m: before.fraction(m) for m in views}
    colours = {m: before.XYZ(theta_o) for m, theta_o in views.items()}
    brightest = max((XYZ[1] for XYZ in colours.values()), default=1.0)
    exposure = 0.5 / brightest if brightest > 0 else 1.0

    def change(what: str, by: float, after: _AtNormalIncidence, tip_radius: float = float("nan")) -> Change:
        new_fractions = {m: after.fraction(m) for m in views}
        colour = {m: float(delta_E(exposure * colours[m], exposure * after.XYZ(views[m]))) for m in views}
        return Change(what, by, after.period / main.period - 1, fractions, new_fractions, colour, tip_radius)

    found = []
    for by in (CHANGE, -CHANGE):
        found.append(change("height scale", by, before._replace(scale={"height_scale": 1 + by})))
    for by in (CHANGE, -CHANGE):
        wider = before._replace(period=main.period * (1 + by), scale={"lateral_scale": 1 + by})
        found.append(change("pixel size", by, wider))
    for by in (CHANGE, -CHANGE) if measured else ():
        try:
            other, radius = broadened(height_field, by, extent=extent)
        except RequestError:
            continue  # steps between adjacent pixels, which no tip explains
        period = same_period(find_periods(other, extent=extent), main).period
        found.append(change("tip broadening", by, before._replace(spectrum=build(other), period=period), radius))
    return tuple(found)


def same_period(found: tuple[Period, ...], main: Period) -> Period:
    """Return the period nearest to the main one in direction, within 10°, else the main one itself."""

    def angle(other: Period) -> float:
        return abs((other.direction - main.direction + 90) % 180 - 90)

    nearest = min(found, key=angle, default=main)
    return nearest if angle(nearest) < 10 else main


_HALVINGS = 12  # of the interval of tip radii


def scanned(height_field: HeightField, radius: float, *, extent: str = "sample") -> HeightField:
    """Return the surface as recorded by a tip of this radius, µm, or reconstructed from a record if it is negative.

    The lowest position of a paraboloid ρ²/2r over each point is the dilation of the heights by it; erosion by the same
    paraboloid restores all points that the tip touched (Villarrubia 1997, J. Res. NIST 102, 425–454):

        h_r(x) = max_ρ [h(x + ρ) − ρ²/2r],    h_{−r}(x) = min_ρ [h(x + ρ) + ρ²/2r]

    A "tile" is continued periodically, a "sample" by its edge.
    """
    heights = height_field.heights
    mode = "wrap" if extent == "tile" else "nearest"
    kernel_radius = np.sqrt(2 * abs(radius) * max(height_field.height_range, 1e-12))
    for axis, pixel in ((1, height_field.pixel_size[0]), (0, height_field.pixel_size[1])):
        half = min(int(np.ceil(kernel_radius / pixel)), heights.shape[axis] // 2)
        # A paraboloid is the sum of a parabola along x and one along y: one axis after the other.
        parabola = -((np.arange(-half, half + 1) * pixel) ** 2) / (2 * abs(radius))
        structure = parabola[None, :] if axis == 1 else parabola[:, None]
        heights = (grey_dilation if radius > 0 else grey_erosion)(heights, structure=structure, mode=mode)
    return HeightField(heights, height_field.pixel_size, height_field.source)


def broadened(height_field: HeightField, change: float, *, extent: str = "sample") -> tuple[HeightField, float]:
    """Return the surface with ridges wider by the fraction `change`, and the signed radius (µm) of the tip required.

    The width of ridges is measured by the area above mid-height, half way between the mean of the heights above the
    average and the mean of the heights below. The tip radius is found for which it grows by `change` (shrinks, if
    negative).

    Raises:
        ValueError: if no tip has that effect, as for a flat surface.
    """
    heights = height_field.heights
    if height_field.height_range < 1e-12:
        raise RequestError("height_field: got a flat surface, wanted one with ridges")
    high_part = heights > heights.mean()
    level = (heights[high_part].mean() + heights[~high_part].mean()) / 2
    above = np.mean(heights > level)

    def is_broadened(radius: float) -> bool:
        field = scanned(height_field, radius, extent=extent)
        return abs(np.mean(field.heights > level) / above - 1) >= abs(change)

    sign = float(np.sign(change))
    low, high = 0.0, min(height_field.pixel_size) / 8
    max_radius = max(height_field.tile_size) ** 2 / height_field.height_range
    while not is_broadened(sign * high):
        low, high = high, 2 * high
        if high > max_radius:
            raise RequestError("height_field: no tip broadens its ridges that much")
    for _ in range(_HALVINGS):
        middle_radius = (low + high) / 2
        if is_broadened(sign * middle_radius):
            high = middle_radius
        else:
            low = middle_radius
    return scanned(height_field, sign * high, extent=extent), sign * high
