"""The lights of a scene: the wavelengths that are drawn, the maximum plausible luminance, light from below."""

from __future__ import annotations

import logging

import drjit as dr
import mitsuba as mi
import mitsuba.parser
import numpy as np
from numpy.typing import NDArray

from ..bsdf.base import is_grating
from ..bsdf.device_tables import on_device
from ..bsdf.light import recorded_wavelengths
from ..integrator.paths import implements

_log = logging.getLogger(__name__)


_DRAWS_PER_LIGHT = 2**14  # of four wavelengths, to estimate the spectrum of the light
_RAYS_OF_SENSOR = 4096  # to sample the visible surfaces and their lights
_MAX_LOBE_VALUE = 1e4  # of a BSDF with narrow lobes, 1/sr
_MAX_NOISE_FACTOR = 1e4  # of the luminance of a pixel over that of the brightest light


def draw_wavelengths_of_lights(scene: mi.Scene) -> None:
    """Make the sensors draw a quarter of the wavelengths, one of a ray's four, in the spectral lines of the lights.

    Mitsuba draws them in proportion to the response r(λ) of the film: about one in a hundred falls into a line of 1 nm,
    with a weight of a hundred. With s_l(λ) the spectrum of light l and ∫ r dλ = ∫ r s_l dλ = 1, they are drawn here
    from

        p ∝ r (1 + e/(3 max(1, ∫ r e dλ))),    e(λ) = max(0, max_l s_l(λ) − 4).

    For daylight and incandescent lamps p = r. The power of a light is disregarded, as it does not determine how much of
    its light arrives at a pixel. The film divides by p, and p > 0 where r > 0: the expectation of each channel is
    unchanged.
    """
    for sensor in scene.sensors():
        # The sensor draws wavelengths from this object of the film.
        distribution = mi.traverse(sensor.film().sensor_response_function())
        response = np.array(distribution["values"], np.float64)
        response /= response.sum()
        grid = np.linspace(*recorded_wavelengths(sensor.film()), response.size)
        lines = np.zeros_like(response)
        for emitter in scene.emitters():
            recorded = response * _emission(emitter, grid)
            lines = np.maximum(lines, recorded / (recorded.sum() or 1) - 4 * response)
        if lines.any():
            density = response + lines / (3 * max(1, lines.sum()))
            # Integers, so that Mitsuba's cumulative sums of them are exact in single precision.
            density = np.ceil(density * (2**23 / density.sum()))
            distribution["values"] = on_device(density)
            distribution.update()


def _emission(emitter: mi.Emitter, grid: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the spectrum of a light on a grid of equidistant wavelengths in nm, (n,), up to a factor.

    It is a histogram of wavelengths sampled by the light itself, so that narrow lines are not missed. A light whose
    spectrum varies over positions or directions is sampled at a single one. It is zero of lights that do not sample
    wavelengths, as with the texture `checkerboard`.
    """
    si = dr.zeros(mi.SurfaceInteraction3f)
    si.wi = mi.Vector3f(0, 0, -1)
    if not implements(emitter.sample_wavelengths, si, mi.Float(0.5)):
        return np.zeros(grid.size)
    numbers = (np.arange(_DRAWS_PER_LIGHT, dtype=np.float32) + 0.5) / _DRAWS_PER_LIGHT
    wavelengths, weights = emitter.sample_wavelengths(si, on_device(numbers))
    wavelengths, weights = (x.ravel() for x in np.broadcast_arrays(wavelengths, mi.unpolarized_spectrum(weights)))
    edges = np.append(grid, 2 * grid[-1] - grid[-2]) - (grid[1] - grid[0]) / 2
    return np.histogram(wavelengths, edges, weights=weights)[0]


def _visible_points(scene: mi.Scene) -> tuple[mi.SurfaceInteraction3f, mi.DirectionSample3f, mi.Spectrum]:
    """Trace rays of the first sensor, and draw a light for each point hit; return points, lights and weights."""
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, _RAYS_OF_SENSOR)
    # `irradiancemeter` has no other rays.
    ray, _ = scene.sensors()[0].sample_ray_differential(0, sampler.next_1d(), sampler.next_2d(), sampler.next_2d())
    si = scene.ray_intersect(mi.Ray3f(ray))
    return si, *scene.sample_emitter_direction(si, sampler.next_2d(), False, si.is_valid())


def max_plausible_luminance(scene: mi.Scene) -> float:
    """Return a luminance that no pixel should exceed by noise: 10⁴ times the luminance of the brightest light found.

    Point and directional lights have an irradiance E instead of a radiance L, and narrow lobes reflect up to some
    10⁴ E: they count as L = 10⁴ E. The result is infinite if no light is found.
    """
    si, light, weight = _visible_points(scene)
    sampled = mi.unpolarized_spectrum(weight) * light.pdf * dr.select(light.delta, _MAX_LOBE_VALUE, 1)
    seen = mi.unpolarized_spectrum(si.emitter(scene).eval(si))
    dr.eval(sampled, seen)  # in one kernel, instead of one that traces rays for each wavelength
    found = np.concatenate([np.ravel(values) for values in (*sampled, *seen)])
    brightest = found[np.isfinite(found)].max(initial=0)
    return float(brightest) * _MAX_NOISE_FACTOR if brightest > 0 else np.inf


def warn_of_missing_boxes(scene: mi.Scene) -> None:
    """Log a warning if shadow rays to distant lights end early, as a shape has no bounding box.

    Mitsuba 3.9.1 merges shapes of equal BSDFs to a mesh without one, and ends these rays at the sphere around boxes.
    """
    is_distant = any(emitter.flags() & +mi.EmitterFlags.Infinite for emitter in scene.emitters())
    if is_distant and not all(shape.bbox().valid() for shape in scene.shapes()):
        _log.warning(
            "Mitsuba merged shapes of equal BSDFs to a mesh without bounding box, past which light of the sky or the "
            "sun may leak; load the scene with optimize=False"
        )


def warn_of_light_from_below(scene: mi.Scene) -> None:
    """Log a warning for gratings without transmission that are seen or lit only from below, and therefore black."""
    gratings = [shape for shape in scene.shapes() if is_grating(shape.bsdf())]
    opaque = [shape for shape in gratings if not shape.bsdf().layers.interface.transmits]
    if not opaque or not scene.sensors():
        return
    si, light, weight = _visible_points(scene)
    dr.eval(si, light, weight)  # in one kernel, instead of one that traces rays for each count
    lit = dr.any(mi.unpolarized_spectrum(weight) != 0)
    seen_above, lit_above = si.wi.z > 0, lit & (mi.Frame3f.cos_theta(si.to_local(light.d)) > 0)
    for shape in opaque:
        on_shape = si.is_valid() & (si.shape == mi.ShapePtr(shape))
        bright = seen_above & lit_above
        if dr.count(on_shape & lit)[0] > 0 and dr.count(on_shape & bright)[0] == 0:
            cause = "lit" if dr.count(on_shape & seen_above)[0] > 0 else "seen"
            _log.warning(
                "diffraction_grating of shape %s is %s from below only, where it is black: transmission=sheet or "
                "interface transmits light, twosided adds a grating below",
                shape.id(),
                cause,
            )
