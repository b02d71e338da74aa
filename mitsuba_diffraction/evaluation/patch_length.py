"""Why the fit of PQ goes wrong: a patch that is no whole number of periods long, and is repeated all the same.

P tiles multiply the power of one tile by D(qT; P)², which for more than a few tiles is a comb of lines at q = m/T. The
peak curve can then only lie on a line, and the period that it tells is T/m with the whole number m for which the line
is strongest. That is the period d of the fingers only if T/d is a whole number; else it is off by up to d/(2m), and
where two lines are equally strong the peak jumps from one to the other as the wavelength changes.
"""

from __future__ import annotations

import numpy as np

from ..heightfield import HeightField
from ..precompute import precompute
from ..shader.evaluate import relative_radiance
from .model import relative_reflectance
from .surfaces import Surface
from .viewing_angle import INCIDENCE, MODEL, PeriodFit, ReflectanceMap, fit_period, viewing_angles, wavelengths


def cut(surface: Surface, length: float) -> HeightField:
    """A square patch of a surface, as a microscope sees it.

    Args:
        surface: a surface of many periods.
        length: wanted side, µm; rounded to whole pixels along the diffracting axis.

    Raises:
        ValueError: if the surface is smaller than that.
    """
    field = surface.height_field
    pixels = round(length / field.pixel_size[surface.axis])
    if not 0 < pixels <= min(field.shape):
        raise ValueError(f"length: got {length!r} µm, {pixels} pixels, wanted 1 to {min(field.shape)}")
    return HeightField(field.heights[:pixels, :pixels], field.pixel_size, field.source)


def fit_cut_patch(surface: Surface, patch: HeightField, method: str, step: float = 20.0) -> PeriodFit:
    """Fits the period to a cut patch at θ_i = 75°.

    PQ, as published, repeats the patch as often as the coherence length of sunlight covers it. The model takes the
    patch for a piece of a larger surface (extent "sample") with a coherence length of half of it.

    Args:
        surface: which the patch was cut from.
        patch: of `cut`.
        method: "model" or "pq".
        step: between wavelengths, nm.

    Raises:
        ValueError: if Mitsuba has no vectorised spectral variant set, or there is no light to fit.
    """
    nanometres, angles = wavelengths(step), viewing_angles()
    wi, wo = surface.direction(INCIDENCE), surface.direction(angles)
    if method == MODEL:
        spectrum = precompute(patch, extent="sample", coherence_length=min(patch.tile_size) / 2, tolerance=1e-2)
        values = relative_reflectance(spectrum, wi, wo, nanometres)
    else:
        everywhere = np.broadcast_to(wo, (nanometres.size, *wo.shape))
        repeated = np.repeat(nanometres[:, None], angles.size, axis=1)
        values = relative_radiance(patch, wi, everywhere, repeated, variant=method)
    return fit_period(ReflectanceMap(surface, method, INCIDENCE, nanometres, angles, np.asarray(values, np.float64)))


def period_of_heights(surface: Surface, patch: HeightField) -> float:
    """The mean period of the heights inside a patch, µm, without any optics.

    The frequency of the strongest wave along the diffracting axis, between a half and twice the published one: of the
    powers of the lines of the patch, tapered (Hann) and padded with zeros, added up.
    """
    heights = patch.heights.T if surface.axis == 1 else patch.heights
    lines = heights - heights.mean(axis=1, keepdims=True)
    count = 64 * lines.shape[1]
    power = (np.abs(np.fft.rfft(lines * np.hanning(lines.shape[1]), count, axis=1)) ** 2).sum(axis=0)
    q = np.fft.rfftfreq(count, patch.pixel_size[surface.axis])
    near = (q * surface.period > 0.5) & (q * surface.period < 2)
    return float(1 / q[near][power[near].argmax()])
