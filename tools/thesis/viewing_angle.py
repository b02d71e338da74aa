"""Reflectance over viewing angle and wavelength, its peak curve, and the period fitted to the peaks.

The evaluation of the thesis of 2014 (section 5.3): light at a fixed angle θ_i, every viewing angle θ_r in the plane of
the diffracting axis, every wavelength. For each wavelength the viewing angle of maximum reflectance gives a period
by the grating equation of the first order,

    d (sin θ_i + sin θ_r) = λ.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from published_surfaces import PublishedSurface
from scipy.signal import find_peaks

from mitsuba_diffraction import testing
from mitsuba_diffraction.errors import RequestError
from mitsuba_diffraction.precomputation.grating_spectrum import GratingSpectrum
from mitsuba_diffraction.shader_2014.evaluate import relative_radiance
from mitsuba_diffraction.shader_2014.quirks import Quirks
from mitsuba_diffraction.variants import is_supported

import mitsuba as mi  # isort: skip  (after LLVM has been chosen)

Array = NDArray[np.float64]

MODEL = "model"
METHODS = (MODEL, "flss", "nmm", "pq")
"""This project's model, and the variants of the shader that have a spectrum (gem has none)."""

INCIDENCE = 75.0
"""θ_i of the thesis, degrees."""
_MIN_RIDGE = 0.3  # height relative to the brightest ridge; its prominence is at least a third of that

_INDEX = 1.5  # of skin; the only one of the published shader
_R_0 = ((_INDEX - 1) / (_INDEX + 1)) ** 2


def relative_reflectance(spectrum: GratingSpectrum, wi: ArrayLike, wo: ArrayLike, wavelengths: ArrayLike) -> Array:
    """Return f cos θ_i of the BSDF, index 1.5, over f cos θ_i of a flat surface at normal incidence and exit.

        ρ(λ) = f cos θ_i · 2πσ_q² λ²/R₀ = R/R₀ · K G cos θ_i · 2πσ_q² S(q; κ) · E

    The coherence length of `spectrum` gives σ_q; 1/(2πσ_q²) is S(0) of a flat surface. This is the quantity that the
    shader shows (eq. 3.11 of the thesis): 1/λ² cancels.

    Args:
        spectrum: of the surface.
        wi: ω_i, (3,) along the axes of the surface.
        wo: ω_o, (..., 3).
        wavelengths: (n,) nm.

    Returns:
        (..., n).

    Raises:
        ValueError: if shapes do not match, or Mitsuba has no vectorised spectral variant set.
    """
    if not is_supported(mi.variant()):
        raise RequestError(f"variant: Mitsuba's is {mi.variant()}, wanted a spectral one such as llvm_ad_spectral")
    bsdf = mi.load_dict({"type": "diffraction_grating", "spectrum": spectrum, "int_ior": _INDEX})
    wi, wo, wavelengths = (np.asarray(values, np.float64) for values in (wi, wo, wavelengths))
    value = testing.evaluate(bsdf, wi, wo, wavelengths)
    flat = _R_0 / (2 * np.pi * spectrum.lobe_width**2 * (wavelengths * 1e-3) ** 2)
    cosine = np.where(wo[..., 2] > 0, wo[..., 2], 1)[..., None]
    return value / cosine * wi[2] / flat


def wavelengths(step: float = 5.0) -> Array:
    """Return wavelengths from 380 to 780 nm."""
    return np.arange(380.0, 780.0 + step / 2, step)


def viewing_angles(step: float = 0.1) -> Array:
    """Return viewing angles from one horizon to the other in degrees, without the horizons.

    The lobes of PQ as published are 0.3° wide in sunlight; with steps of half a degree their peaks are missed.
    """
    return np.arange(-90 + step, 90 - step / 2, step)


@dataclass(frozen=True, eq=False)
class ReflectanceMap:
    """Relative reflectance in one plane.

    Attributes:
        surface: the evaluated surface.
        method: one of `METHODS`.
        incidence: θ_i in degrees.
        wavelengths: (n,) nm.
        angles: θ_r in degrees: (m,), or (n, m) where a method has directions of its own for each wavelength (nmm;
            NaN where it has fewer). −θ_i is the specular direction.
        reflectance: (n, m), a flat mirror at normal incidence being one; NaN where the angle is.
    """

    surface: PublishedSurface
    method: str
    incidence: float
    wavelengths: Array
    angles: Array
    reflectance: Array

    @property
    def order(self) -> Array:
        """n = d (sin θ_i + sin θ_r)/λ with the published d, (n, m)."""
        sines = np.sin(np.deg2rad(self.incidence)) + np.sin(np.deg2rad(self.angles))
        return self.surface.period * sines / (self.wavelengths[:, None] * 1e-3)

    @property
    def discrete(self) -> bool:
        """Whether the method has directions of its own."""
        return self.angles.ndim == 2


def reflectance_map(
    surface: PublishedSurface,
    method: str = MODEL,
    *,
    incidence: float = INCIDENCE,
    wavelengths: ArrayLike | None = None,
    angles: ArrayLike | None = None,
    quirks: Quirks | None = None,
) -> ReflectanceMap:
    """Evaluate a surface over viewing angle and wavelength.

    The model is evaluated by `relative_reflectance`; the shader by
    `shader_2014.evaluate.relative_radiance`. At a viewing angle, NMM has only the wavelengths
    λ_n = T (sin θ_i + sin θ_r)/n, T being the length of the tile. Conversely, it has a wavelength only at the angles of
    the tile's orders, where it equals FLSS. These are the angles of its map.

    Args:
        surface: the surface.
        method: one of `METHODS`.
        incidence: θ_i in degrees.
        wavelengths: (n,) nm; default: every 5 nm from 380 to 780 nm.
        angles: (m,) viewing angles θ_r in degrees; default: every 0.1°. Not for nmm.
        quirks: of the shader; as published if none are given.

    Raises:
        ValueError: if an argument is wrong, or Mitsuba has no vectorised spectral variant set.
    """
    if not 0 <= incidence < 90:
        raise RequestError(f"incidence: got {incidence!r}, wanted degrees from the normal, 0 or more, below 90")
    nanometres = np.arange(380.0, 782.5, 5.0) if wavelengths is None else np.asarray(wavelengths, np.float64)
    wi = surface.direction(incidence)
    if method == "nmm":
        angles = _order_angles(surface, incidence, nanometres)
    else:
        angles = viewing_angles() if angles is None else np.asarray(angles, np.float64)
    if method == MODEL:
        values = relative_reflectance(surface.spectrum, wi, surface.direction(angles), nanometres).T
    else:
        everywhere = np.broadcast_to(angles, (nanometres.size, angles.shape[-1]))
        values = relative_radiance(
            surface.height_field,
            wi,
            surface.direction(np.nan_to_num(everywhere)),
            np.broadcast_to(nanometres[:, None], everywhere.shape),
            variant=method,
            quirks=quirks,
            coherence_length=surface.shader_coherence_length,
        )
        values = np.where(np.isnan(everywhere), np.nan, values)
    return ReflectanceMap(surface, method, float(incidence), nanometres, angles, np.asarray(values, np.float64))


def _order_angles(surface: PublishedSurface, incidence: float, nanometres: Array) -> Array:
    """Return θ_r of the tile's orders, except order zero, at each wavelength, (n, m) degrees; NaN if evanescent."""
    tile = surface.height_field.tile_size[surface.axis] * 1e3
    sine = np.sin(np.deg2rad(incidence))
    first, last = (int(tile * sines / nanometres.min()) for sines in (sine - 1, sine + 1))
    orders = np.concatenate([np.arange(first, 0), np.arange(1, last + 1)])
    sines = orders * nanometres[:, None] / tile - sine
    return np.rad2deg(np.arcsin(np.where(np.abs(sines) < 1, sines, np.nan)))


def peak_angles(found: ReflectanceMap, between: tuple[float, float] = (-90.0, 90.0)) -> Array:
    """Return θ_r of the maximum reflectance outside the specular peak, for each wavelength.

    Args:
        found: the map.
        between: range of the viewing angles in which the maximum is searched, degrees.

    Outside means nearer to order one than to order zero of the published period: d (sin θ_i + sin θ_r) > λ/2. The
    position of the peak between the samples is the vertex of a parabola in the direction cosine through the logarithms
    of three samples, which is exact for a Gaussian lobe. A method with directions of its own is not interpolated.

    Returns:
        (n,) degrees; NaN where the reflectance is zero.
    """
    angles = np.broadcast_to(found.angles, found.reflectance.shape)
    outside = np.nan_to_num(np.where(found.order > 0.5, found.reflectance, 0))
    within = np.where((angles >= between[0]) & (angles <= between[1]), outside, 0)
    cosine = np.sin(np.deg2rad(angles))
    rows = np.arange(len(outside))
    peak = within.argmax(axis=1)
    position = cosine[rows, peak]
    if not found.discrete:
        inner = np.clip(peak, 1, outside.shape[1] - 2)
        samples = inner[:, None] + (-1, 0, 1)
        x, y = (np.take_along_axis(array, samples, axis=1) for array in (cosine, outside))
        # At an end of the range the maximum need not be a peak.
        usable = (inner == peak) & (y.min(axis=1) > 0) & (y[:, 1] >= y[:, ::2].max(axis=1))
        position = np.where(usable, _vertex(x, np.log(np.where(y > 0, y, 1))), position)
    return np.where(within[rows, peak] > 0, np.rad2deg(np.arcsin(position)), np.nan)


def _vertex(x: Array, y: Array) -> Array:
    """Return x of the vertex of the parabola through three points, (n, 3) each; the middle one is not the lowest."""
    left, right = x[:, 1] - x[:, 0], x[:, 2] - x[:, 1]
    slope_left, slope_right = (y[:, 1] - y[:, 0]) / left, (y[:, 2] - y[:, 1]) / right
    curvature = (slope_right - slope_left) / (left + right)
    slope = (slope_left * right + slope_right * left) / (left + right)
    return x[:, 1] - np.divide(slope, 2 * curvature, out=np.zeros_like(slope), where=curvature < 0)


def grating_equation(period: float, incidence: float, wavelengths: ArrayLike, order: int = 1) -> Array:
    """Return θ_r = arcsin(nλ/d − sin θ_i) in degrees (eq. 5.2), NaN where the order is evanescent.

    Args:
        period: d in µm.
        incidence: θ_i in degrees.
        wavelengths: (...) nm.
        order: n.
    """
    sines = order * np.asarray(wavelengths, np.float64) * 1e-3 / period - np.sin(np.deg2rad(incidence))
    return np.rad2deg(np.arcsin(np.where(np.abs(sines) < 1, sines, np.nan)))


class PeriodFit(NamedTuple):
    """The period fitted to the peaks of a map: its mean (nm) and variance (nm²) over the wavelengths."""

    mean: float
    variance: float

    @property
    def deviation(self) -> float:
        """Standard deviation over the wavelengths, nm."""
        return float(np.sqrt(self.variance))


def fit_period(found: ReflectanceMap, between: tuple[float, float] = (-90.0, 90.0)) -> PeriodFit:
    """Return mean and variance over the wavelengths of d = λ/(sin θ_i + sin θ_r) at the peaks (table 5.1).

    Args:
        found: the map.
        between: range of the viewing angles, as in `peak_angles`.

    Raises:
        ValueError: if the reflectance outside the specular peak is zero at some wavelength.
    """
    angles = peak_angles(found, between)
    if np.isnan(angles).any():
        dark = found.wavelengths[np.isnan(angles)]
        raise RequestError(f"reflectance: got none outside of the specular peak at {dark[0]:g} nm, wanted a peak")
    periods = found.wavelengths / (np.sin(np.deg2rad(found.incidence)) + np.sin(np.deg2rad(angles)))
    return PeriodFit(float(periods.mean()), float(periods.var()))


class Ridge(NamedTuple):
    """A period (nm) whose order is bright at all wavelengths; its mean reflectance relative to the brightest ridge."""

    period: float
    height: float


def ridges(found: ReflectanceMap) -> list[Ridge]:
    """Return the ridges of a map from the period d/2 to 2d, the brightest first.

    A map is resampled over 1/d = (sin θ_i + sin θ_r)/λ, divided by its maximum at each wavelength, and averaged over
    the wavelengths. Not for methods with directions of their own.
    """
    if found.discrete:
        raise RequestError(f"found: got a map of {found.method}, wanted one with all viewing angles")
    frequency = np.linspace(0.5, 2.0, 6001) / (1e3 * found.surface.period)
    sines = np.sin(np.deg2rad(found.incidence)) + np.sin(np.deg2rad(found.angles))
    rows = np.stack(
        [
            np.interp(frequency, sines / nanometres, row)
            for nanometres, row in zip(found.wavelengths, found.reflectance, strict=True)
        ]
    )
    mean = (rows / rows.max(axis=1, keepdims=True)).mean(axis=0)
    mean /= mean.max()
    (peaks, _) = find_peaks(mean, height=_MIN_RIDGE, prominence=_MIN_RIDGE / 3)
    return [Ridge(float(1 / frequency[i]), float(mean[i])) for i in peaks[np.argsort(mean[peaks])[::-1]]]
