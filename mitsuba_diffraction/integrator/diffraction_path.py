"""The class behind `<integrator type="diffraction_path">`."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from ..bsdf.light import is_black, recorded_wavelengths
from ..bsdf.mitsuba_internals import CURVES, ELLIPSOIDS, camera_rays, nested_plugin
from ..errors import RequestError
from ..parameter_documentation import Parameter, listed
from .eye_paths import EyeTracer, define_eye_paths
from .paths import Gratings, LightPaths, implements, unpacked
from .scene_cache import SceneCache

PARAMETERS = (
    Parameter("max_depth", "integer", "as in `path`: 2 is direct light, 3 a rainbow on a wall; −1 is no limit", "−1"),
    Parameter("rr_depth", "integer", "as in `path`: depth at which Russian roulette begins", "5"),
)

MANUAL = f"""Path tracer that also samples the light that gratings cast onto other surfaces.

Parameters (XML or dictionary):
{listed(PARAMETERS)}

The picture converges to the picture by `path` with the same parameters. A path tracer finds a small or distant light
via a grating only by chance. Here, where a path from the eye meets a grating, several directions are drawn, and a ray
is traced along one that is likely to meet a light (`candidates.py`). Where the first surface is a grating, the light of
a sun or a bulb is evaluated at 16 wavelengths, of which the film receives four (`lamps_without_extent.py`). The light
that gratings cast onto a wall, which appears as fireflies in `path`, is traced from the light:

With L a light, G a vertex on a surface whose BSDF is or contains a `diffraction_grating` (whichever component of it
reflects or transmits the light: both sides of `twosided` and of a film, all of a blend, the base), X a vertex on any
other surface, and E the eye, the paths

    L G⁺ X E    and    L G⁺ X (G | X)* X E

(⁺: one or more, *: any number) are traced from the light unless the vertex next to E is specular (perfect reflection or
refraction). Thus

    L G E, L G G E              from the eye: gratings alone, a lamp seen through a film
    L G X E, L G G X E          from the light: what they cast onto a wall, a film in a window onto the floor
    L G X X E, L G M X E        from the light: that wall lights another one; M is a mirror or a pane of glass
    L G X G E, L G X M E        from the eye: that wall seen in a grating or a mirror
    L X G X E, L M G X E        from the eye: light scattered by another surface before the grating

Light that a grating scatters to the eye is traced from the eye, as its narrow lobes seldom include the direction to a
pinhole. In L G X G E and L G X M E, half of the directions from an opaque X are drawn to points on gratings, with the
balance heuristic.

A path from the light starts at a point on a grating, drawn by area, and a light drawn for that point. One of four such
pairs is chosen with a probability proportional to the radiance that it receives, shadows included. Four paths are
continued from there by `sample` of the BSDFs, with the correction for shading normals and for BSDFs that are not
reciprocal; each X is connected to the sensor. There is one path from the light for 2 samples of the film, where a pilot
finds much of this light in the picture, to 64, where it finds little; the number depends on the scene alone. As in
`path`, a light without extent is not seen in a mirror: it is omitted where the grating next to it scatters by a delta
component.

Instances, curves and `sdfgrid` count as X, and so do shapes on which rays do not find the points that
Mitsuba draws there, as on a sphere with a scale that is not uniform. Direct light at an instance is drawn as that at a
grating.

Without a grating, with max_depth of 0 or 1, in polarised variants, with `ellipsoids` and curves that transmit light,
which rays of Mitsuba 3.9.1 meet from outside only, and for sensors other than `perspective` and `thinlens`, this is
`path`. So it is with max_depth of 2 where all lights have an extent and are about as bright in all directions.
hide_emitters, and films with sample_border, are refused. It can be nested in `aov`. Gradients are computed by `path`
(forward) and `prb` (backward), single rays (`sample`) by `path`.
"""


def define() -> type:
    """Define the plugin class for the current variant, as its base class depends on the variant."""
    eye_class = define_eye_paths()

    class DiffractionPath(mi.SamplingIntegrator):
        __doc__ = MANUAL

        def __init__(self, props: mi.Properties) -> None:
            mi.SamplingIntegrator.__init__(self, props)
            self.max_depth, self.rr_depth = props.get("max_depth", -1), props.get("rr_depth", 5)
            if props.get("hide_emitters", False):
                raise RequestError("hide_emitters: got true, wanted false: diffraction_path shows all lights")
            self.path = nested_plugin("path", max_depth=self.max_depth, rr_depth=self.rr_depth)
            self.cache = SceneCache()

        def parts(self, scene: mi.Scene, sensor: mi.Sensor) -> tuple[mi.SamplingIntegrator, LightPaths | None]:
            """Return the tracers of paths from the eye and from the light; None for the light without such paths."""
            self.cache.follow(scene, sensor)
            gratings = _lit_gratings(scene, sensor, self.max_depth, self.cache)
            if gratings is None:
                return self.path, None
            of_both = scene, sensor, gratings, self.cache, self.max_depth, self.rr_depth
            eye = eye_class(EyeTracer(*of_both))
            if 0 <= self.max_depth < 3 or not gratings.shapes:
                return (eye if eye.candidates.any or eye.lamps.any else self.path), None
            return eye, (None if _is_all_black(scene, sensor, gratings, self.cache) else LightPaths(*of_both))

        def sample(
            self,
            scene: mi.Scene,
            sampler: mi.Sampler,
            ray: mi.RayDifferential3f,
            medium: mi.Medium | None = None,
            active: mi.Bool = True,
        ) -> tuple[mi.Spectrum, mi.Bool, list[mi.Float]]:
            # A single ray has no film to splat to: all light is traced from the eye.
            return self.path.sample(scene, sampler, ray, medium, active)

        def render(
            self,
            scene: mi.Scene,
            sensor: mi.Sensor | int = 0,
            seed: mi.UInt32 | int = 0,
            spp: int = 0,
            develop: bool = True,
            evaluate: bool = True,
        ) -> mi.TensorXf:
            if isinstance(sensor, int):
                sensor = scene.sensors()[sensor]
            eye, light = self.parts(scene, sensor)
            if eye is self.path:
                return eye.render(scene, sensor, seed, spp, develop, evaluate)
            spp = _trace_eye_paths(scene, sensor, eye, seed, spp)
            if light is not None:
                _add_light_paths(sensor, light, seed, spp)
            return sensor.film().develop() if develop else mi.TensorXf()

        # Dr.Jit does not differentiate splats. Derivatives are taken of `path` instead, which has the same expectation:
        # backward by `prb`; forward by `path` itself, as `prb` fails there in spectral variants of Mitsuba 3.9.1.

        def render_forward(
            self, scene: mi.Scene, params: object, sensor: mi.Sensor, seed: mi.UInt32 | int = 0, spp: int = 0
        ) -> mi.TensorXf:
            return self.path.render_forward(scene, params, sensor, seed, spp)

        def render_backward(
            self,
            scene: mi.Scene,
            params: object,
            grad_in: mi.TensorXf,
            sensor: mi.Sensor,
            seed: mi.UInt32 | int = 0,
            spp: int = 0,
        ) -> None:
            prb = nested_plugin("prb", max_depth=self.max_depth, rr_depth=self.rr_depth)
            prb.render_backward(scene, params, grad_in, sensor, seed, spp)

        def to_string(self) -> str:
            return f"DiffractionPath[\n  max_depth = {self.max_depth},\n  rr_depth = {self.rr_depth}\n]"

    return DiffractionPath


def _lit_gratings(scene: mi.Scene, sensor: mi.Sensor, max_depth: int, cache: SceneCache) -> Gratings | None:
    """Return the gratings from which light is traced; None if all paths are traced as in `path`.

    Raises:
        ValueError: if the film takes samples outside its edge (`sample_border`).
    """
    if 0 <= max_depth < 2 or mi.is_polarized:
        return None
    # Points of the scene can be connected to `perspective` and `thinlens`.
    if not implements(sensor.sample_direction, dr.zeros(mi.SurfaceInteraction3f), mi.Point2f(0.5)):
        return None
    gratings = Gratings(scene, cache)
    if not (gratings.shapes or gratings.instanced) or not scene.emitters():
        return None
    # Paths from the light would have other obstacles than those from the eye.
    if any(map(_has_other_obstacles, (*scene.shapes(), *gratings.members))):
        return None
    film = sensor.film()
    if gratings.shapes and film.sample_border() and film.rfilter().border_size() > 0:
        raise RequestError(
            "sample_border: got true, wanted false: points outside the film's edge cannot be connected to it"
        )
    return gratings


def _has_other_obstacles(shape: mi.Shape) -> bool:
    """Return whether rays miss the back of a shape that they can enter, so that paths cannot be reversed."""
    if shape.class_name() in CURVES:
        return mi.has_flag(shape.bsdf().flags(), mi.BSDFFlags.Transmission | mi.BSDFFlags.Null)
    return shape.class_name() in ELLIPSOIDS


def _is_all_black(scene: mi.Scene, sensor: mi.Sensor, gratings: Gratings, cache: SceneCache) -> bool:
    """Return whether no shape but gratings reflects or transmits light that the film records."""
    recorded = recorded_wavelengths(sensor.film())
    others = [shape for shape in scene.shapes() if shape not in gratings]
    return cache.once("all black", lambda: all(is_black(shape.bsdf(), *recorded) for shape in others))


def _trace_eye_paths(scene: mi.Scene, sensor: mi.Sensor, eye: Any, seed: mi.UInt32 | int, spp: int) -> int:
    """Put paths from the eye into the film of a sensor; return the samples per pixel."""
    sampler, spp, ray, weight, position = camera_rays(scene, sensor, seed, spp)
    received, valid = eye.trace(scene, sampler, ray, weight)
    block = sensor.film().create_block()
    block.set_coalesce(block.coalesce() and spp >= 4)
    opacity = dr.select(valid, mi.Float(1), 0)
    weight_of_film = 1.0
    for wavelengths, value in received:
        _put(sensor.film(), block, position, wavelengths, value, opacity, weight_of_film)
        # Further light is at the same sample.
        opacity = weight_of_film = 0.0
    sensor.film().put_block(block)
    return spp


def _add_light_paths(sensor: mi.Sensor, light: LightPaths, seed: mi.UInt32 | int, spp: int) -> None:
    """Add paths from the light to the film of a sensor, which contains `spp` paths from the eye per pixel."""
    film = sensor.film()
    # The film divides by its sum of weights, to which splats add zero: their values are multiplied by spp instead.
    block = film.create_block()
    corner = mi.Vector2f(film.crop_offset())
    for splats in light.splats(seed, light.count(spp)):
        position, wavelengths, value = unpacked(splats)
        _put(film, block, position + corner, wavelengths, value * spp, 0.0, 0.0)
    film.put_block(block)


def _put(
    film: mi.Film,
    block: mi.ImageBlock,
    position: mi.Point2f,
    wavelengths: mi.Spectrum,
    value: mi.Spectrum,
    alpha: mi.Float | float,
    weight: float,
) -> None:
    if mi.has_flag(film.flags(), mi.FilmFlags.Special):
        block.put(position, film.prepare_sample(value, wavelengths, block.channel_count(), weight, alpha))
    else:
        block.put(position, wavelengths, value, alpha, weight)
