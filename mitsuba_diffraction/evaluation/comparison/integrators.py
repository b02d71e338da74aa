"""Integrators that only the comparison needs: parts of what the path tracer or the shader shows."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..realtime_shader.lights import lights_of


def same_light(scene: mi.Scene) -> mi.SamplingIntegrator:
    """Return an integrator of the scene's own BSDFs under the lights that the shader supports.

    Only direct light of directional and point lights, with shadows: no sky, no other lights, no interreflection.

    Raises:
        ValueError: if the scene has no such light.
    """
    lights = lights_of(scene)

    class SameLight(mi.SamplingIntegrator):
        def sample(
            self,
            scene: mi.Scene,
            sampler: mi.Sampler,
            ray: mi.RayDifferential3f,
            medium: mi.Medium | None = None,
            active: mi.Bool = True,
        ) -> tuple[mi.Spectrum, mi.Bool, list[mi.Float]]:
            si = scene.ray_intersect(ray, active)
            active = active & si.is_valid()
            bsdf = si.bsdf(ray)
            radiance = mi.Spectrum(0)
            for light in lights:
                ds, _, irradiance = light.sample(si, active)
                lit = active & (scene.ray_test(si.spawn_ray_to(ds.p), active) ^ True)
                value = bsdf.eval(mi.BSDFContext(), si, si.to_local(ds.d), lit)
                radiance += dr.select(lit, value * irradiance, 0)
            return radiance, active, []

    return SameLight(mi.Properties("same_light"))


def without_gratings(shader: mi.SamplingIntegrator) -> mi.SamplingIntegrator:
    """Return an integrator of a `diffraction_shader` without gratings: other BSDFs, and those below gratings."""

    class WithoutGratings(mi.SamplingIntegrator):
        def sample(
            self,
            scene: mi.Scene,
            sampler: mi.Sampler,
            ray: mi.RayDifferential3f,
            medium: mi.Medium | None = None,
            active: mi.Bool = True,
        ) -> tuple[mi.Spectrum, mi.Bool, list[mi.Float]]:
            _, radiance, active = shader.shade(scene, ray, active)
            return mi.depolarizer(radiance), active, []

    return WithoutGratings(mi.Properties("without_gratings"))
