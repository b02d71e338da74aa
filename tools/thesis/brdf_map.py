"""BRDF maps: the colours of a surface, lit from one direction, over all viewing directions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from published_surfaces import PublishedSurface
from viewing_angle import MODEL, relative_reflectance, wavelengths

from mitsuba_diffraction.bsdf.testing import direction
from mitsuba_diffraction.errors import RequestError
from mitsuba_diffraction.optics.color import auto_exposure, daylight, into_gamut, on_screen, radiance_to_linear_sRGB
from mitsuba_diffraction.shader_2014.evaluate import VARIANTS, colour

Array = NDArray[np.float64]

MAP_METHODS = (MODEL, *VARIANTS)
PROJECTIONS = ("hemisphere", "uv")


@dataclass(frozen=True, eq=False)
class BRDFMap:
    """Colours over viewing directions.

    Attributes:
        surface: the evaluated surface.
        method: one of `MAP_METHODS`.
        projection: "hemisphere": a disc, the radius θ_o and the angle φ_o of the direction to the viewer. "uv": the
            plane of (u, v), minus the sums of the direction cosines of light and viewer, where an order m of a tile
            lies at (u, v) = λ m/T for any direction of the light.
        incidence: (θ_i, φ_i) in degrees.
        x, y: (side,) centres of the pixels: θ_o cos φ_o and θ_o sin φ_o in degrees, or u and v.
        rgb: (side, side, 3) linear sRGB, rows ↔ y; NaN where the direction is not above the surface.
        exposure: the factor of `picture`.
    """

    surface: PublishedSurface
    method: str
    projection: str
    incidence: tuple[float, float]
    x: Array
    y: Array
    rgb: Array
    exposure: float

    @property
    def picture(self) -> Array:
        """sRGB (side, side, 3) from 0 to 1; 0.5 grey outside."""
        return np.where(np.isnan(self.rgb), 0.5, on_screen(into_gamut(self.rgb) * self.exposure) / 255)

    def position_of_order(self, nanometres: float, order: int) -> Array:
        """Return (x, y) of an order n in the map by the grating equation with the published period; NaN if evanescent.

        The direction cosines of light and viewer along the diffracting axis add up to −nλ/d, across it to zero.
        """
        sums = np.zeros(2)
        sums[self.surface.axis] = order * nanometres * 1e-3 / self.surface.period
        out = -sums - direction(*self.incidence)[:2]
        sine = np.hypot(*out)
        if sine >= 1:
            return np.full(2, np.nan)
        return sums if self.projection == "uv" else out * (np.rad2deg(np.arcsin(sine)) / max(sine, 1e-12))


def brdf_map(
    surface: PublishedSurface,
    method: str = MODEL,
    *,
    projection: str = "hemisphere",
    incidence: tuple[float, float] = (30.0, 0.0),
    side: int = 240,
) -> BRDFMap:
    """Evaluate a surface over the outgoing hemisphere under D65.

    The model's relative reflectance, at every 5 nm, becomes XYZ and sRGB; the shader's variants, as published, give
    their own linear RGB. Each map has its own exposure by `color.auto_exposure`, and stores it.

    Args:
        surface: the surface.
        method: one of `MAP_METHODS`.
        projection: one of `PROJECTIONS`.
        incidence: (θ_i, φ_i) in degrees, φ_i from the x axis.
        side: pixels along x and along y.

    Raises:
        ValueError: if an argument is wrong, or Mitsuba has no vectorised spectral variant set.
    """
    if projection not in PROJECTIONS:
        raise RequestError(f"projection: got {projection!r}, wanted one of {', '.join(PROJECTIONS)}")
    wi = direction(*incidence)
    if not wi[2] > 0:
        raise RequestError(f"incidence: got {incidence!r}, wanted an angle from the normal below 90 degrees first")
    axis = (np.arange(side) + 0.5) / side * 2 - 1
    if projection == "hemisphere":
        x = y = 90 * axis
        theta, phi = np.hypot(*np.meshgrid(x, y)), np.rad2deg(np.arctan2(y[:, None], x))
        wo = direction(theta, phi)
        above = theta < 90
    else:
        x, y = axis - wi[0], axis - wi[1]
        out = -np.stack(np.meshgrid(x, y), axis=-1) - wi[:2]
        z = 1 - (out**2).sum(axis=-1)
        above = z > 0
        wo = np.concatenate([out, np.sqrt(np.maximum(z, 0))[..., None]], axis=-1)
    rgb = np.full((side, side, 3), np.nan)
    rgb[above] = _linear_rgb(surface, method, wi, wo[above])
    shown = into_gamut(rgb[above])
    return BRDFMap(surface, method, projection, incidence, x, y, rgb, auto_exposure(shown))


def _linear_rgb(surface: PublishedSurface, method: str, wi: Array, wo: Array) -> Array:
    if method != MODEL:
        settings = {} if method == "gem" else {"coherence_length": surface.shader_coherence_length}
        return colour(surface.height_field, wi, wo, variant=method, **settings)
    nanometres = wavelengths()
    values = relative_reflectance(surface.spectrum, wi, wo, nanometres)
    return radiance_to_linear_sRGB(values * daylight(nanometres), nanometres)
