"""The wavelengths of the light in a scene, which the tables of its gratings must cover, and surfaces without light."""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import numpy as np

from ..errors import RequestError
from ..settings import VISIBLE
from ..variants import is_supported
from .base import gratings_in
from .device_tables import on_device
from .mitsuba_internals import parts

STEP = 0.25  # nm, less than the width of lines


def recorded_wavelengths(film: mi.Film) -> tuple[float, float]:
    """Return (shortest, longest) wavelength that a film records, nm; a film without a response records visible light.

    Raises:
        RequestError: if its response has no end.
    """
    response = film.sensor_response_function()
    if response is None:
        return VISIBLE
    shortest, longest = (float(w) for w in response.wavelength_range())
    if not 0 < shortest < longest < np.inf:
        raise RequestError(f"film: got bands of {shortest:g} to {longest:g} nm, wanted a range of wavelengths")
    return shortest, longest


def cover_light(scene: mi.Scene, sensor: mi.Sensor | int | None = None) -> None:
    """Make the gratings of a scene cover the wavelengths at which its lights emit and its films record.

    Args:
        scene: with its current parameters.
        sensor: the sensor of a picture, or its number; default: all sensors of the scene.

    Raises:
        RequestError: if the tables of a grating cannot cover the light. It names the range, and how to widen it.
    """
    if not is_supported(mi.variant()):
        return
    gratings = {id(bsdf): bsdf for shape in scene.shapes() for bsdf in gratings_in(shape.bsdf())}
    sensors = scene.sensors()
    if sensor is not None:
        sensors = [sensor] if isinstance(sensor, mi.Sensor) else sensors[sensor : sensor + 1]
    if not gratings or not sensors:
        return
    ranges = [recorded_wavelengths(one.film()) for one in sensors]
    first, last = min(low for low, _ in ranges), max(high for _, high in ranges)
    for bsdf in gratings.values():
        shortest, longest = first, last
        for low, high in bsdf.layers.grating.lacks((first, last)):
            if not any(_emits(emitter, low, high) for emitter in scene.emitters()):
                shortest, longest = (high, longest) if low == first else (shortest, low)
        if shortest < longest:
            bsdf.cover((shortest, longest))


def _emits(emitter: mi.Emitter, low: float, high: float) -> bool:
    """Return whether a light may emit in [low, high] nm.

    Lights without a spectrum are assumed to emit all visible light. A spectrum need not be that of the emission (that
    of `sunsky` is the albedo of the ground): a light is dark only where all its spectra and its samples are zero.

    Samples of wavelengths do not answer this: for some spectra Mitsuba draws samples from a part of their range.
    """
    textures = parts(emitter, mi.Texture)
    if not textures or any(texture.is_spatially_varying() for texture in textures):
        return low < VISIBLE[1] and high > VISIBLE[0]
    si = _at_wavelengths(low, high)
    rng = mi.PCG32(size=dr.width(si.wavelengths))
    values = [texture.eval(si) for texture in textures]
    if not any(dr.any(value > 0, axis=None) for value in values):
        _, value = emitter.sample_direction(si, mi.Point2f(rng.next_float32(), rng.next_float32()))
        values = [mi.unpolarized_spectrum(value)]
    return any(bool(dr.any(value > 0, axis=None)) for value in values)


def is_black(bsdf: mi.BSDF | None, low: float, high: float) -> bool:
    """Return whether a BSDF is known to reflect and transmit nothing in [low, high] nm, as that of lamps by default.

    Only a surface that is diffuse and equal everywhere is evaluated: the values of others at some directions and points
    say nothing of the rest.
    """
    if bsdf is None:
        return True
    is_diffuse = bsdf.flags() == mi.BSDFFlags.DiffuseReflection | mi.BSDFFlags.FrontSide
    if not is_diffuse or any(texture.is_spatially_varying() for texture in parts(bsdf, mi.Texture)):
        return False
    si = _at_wavelengths(low, high)
    rng = mi.PCG32(size=dr.width(si.wavelengths))
    si.uv = mi.Point2f(rng.next_float32(), rng.next_float32())
    si.wi = mi.Vector3f(0.6, 0.0, 0.8)
    value = mi.unpolarized_spectrum(bsdf.eval(mi.BSDFContext(), si, mi.Vector3f(0.0, 0.6, 0.8)))
    return bool(dr.all(value == 0, axis=None))


def _at_wavelengths(low: float, high: float) -> mi.SurfaceInteraction3f:
    """Return interactions at wavelengths spread over [low, high] nm."""
    count = math.ceil((high - low) / STEP)
    wavelengths = low + (np.arange(count) + 0.5) * (high - low) / count
    si = dr.zeros(mi.SurfaceInteraction3f, wavelengths.size)
    si.wavelengths = type(si.wavelengths)(on_device(wavelengths))
    return si
