"""The paths that are traced from the eye."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from .gratings import Gratings
from .ratio import ratio


def define() -> type:
    """The class for the variant in force: its base class belongs to that variant."""

    class EyePaths(mi.SamplingIntegrator):
        """Mitsuba's `path` without the paths that are traced from the light (see `diffraction_path`)."""

        def __init__(self, gratings: Gratings, max_depth: int, rr_depth: int) -> None:
            mi.SamplingIntegrator.__init__(self, mi.Properties("eye_paths"))
            self.gratings = gratings
            # Opaque, so that all depths run the same kernel.
            self.max_depth = dr.opaque(mi.UInt32, max_depth % 2**32)
            self.rr_depth = dr.opaque(mi.UInt32, rr_depth)

        @dr.syntax
        def sample(
            self,
            scene: mi.Scene,
            sampler: mi.Sampler,
            ray: mi.RayDifferential3f,
            medium: mi.Medium | None = None,
            active: mi.Bool = True,
        ) -> tuple[mi.Spectrum, mi.Bool, list[mi.Float]]:
            ctx = mi.BSDFContext()
            si = scene.ray_intersect(ray, active)
            seen = si.is_valid() & active
            result = _emitted(si.emitter(scene), si, mi.Bool(active))
            ray = mi.Ray3f(ray)
            throughput, eta = mi.Spectrum(1.0), mi.Float(1.0)
            depth = mi.UInt32(1)
            active = seen & (depth < self.max_depth)
            # Whether a vertex so far is no grating, and whether the first one is one or scattered as a mirror does.
            met, mirrored = mi.Bool(False), mi.Bool(False)
            while active:
                bsdf = si.bsdf(ray)
                on_grating = self.gratings.hold(si, active)
                from_light = on_grating & met & (mirrored ^ True)

                # A light is looked for.
                looks = active & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
                point = sampler.next_2d(active)
                looks &= from_light ^ True
                ds, emitted = scene.sample_emitter_direction(si, point, True, looks)
                looks &= ds.pdf != 0
                wo = si.to_local(ds.d)
                value, pdf = bsdf.eval_pdf(ctx, si, wo, looks)
                share = dr.select(ds.delta, 1, _power_heuristic(ds.pdf, pdf))
                result += dr.select(looks, throughput * value * emitted * share, 0)

                # The path goes on, and may meet a light.
                bs, weight = bsdf.sample(ctx, si, sampler.next_1d(active), sampler.next_2d(active), active)
                throughput *= weight
                eta *= bs.eta
                delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
                mirrored |= (depth == 1) & (delta | on_grating)
                met |= on_grating ^ True
                active &= dr.any(throughput != 0)
                ray = si.spawn_ray(si.to_world(bs.wo))
                ray.wavelengths = carried(ray.wavelengths, throughput)
                following = scene.ray_intersect(ray, active)
                ds = mi.DirectionSample3f(scene, following, si)
                pdf = _density(scene, si, ds, active)
                # A light that is never looked for is found only from here.
                found = active & ((from_light & (pdf > 0)) ^ True)
                share = _power_heuristic(bs.pdf, dr.select(delta, 0, pdf))
                result += dr.select(found, throughput * _emitted(ds.emitter, following, found) * share, 0)

                si = following
                depth += 1
                active &= si.is_valid() & (depth < self.max_depth)
                # Russian roulette, as `path` has it.
                survival = dr.minimum(dr.max(throughput) * dr.square(eta), 0.95)
                gambles = depth >= self.rr_depth
                active &= (gambles ^ True) | (sampler.next_1d(active) < survival)
                throughput *= dr.select(gambles, ratio(1, survival), 1)
            return result, seen, []

    return EyePaths


def carried(wavelengths: mi.Spectrum, throughput: mi.Spectrum) -> mi.Spectrum:
    """Return wavelengths for the rest of a path: the strongest of them in the place of those that carry nothing more.

    A grating sends the wavelengths different ways. At the next one a direction would be drawn for any of the four, and
    three of four paths would end. What stands in the place of a wavelength without throughput adds nothing.
    """
    strongest, most = wavelengths[0], throughput[0]
    for wavelength, power in zip(wavelengths, throughput, strict=True):
        strongest, most = dr.select(power > most, wavelength, strongest), dr.maximum(power, most)
    return dr.select(throughput > 0, wavelengths, strongest)


# Scalar variants have None where there is no emitter.


def _density(scene: mi.Scene, si: mi.SurfaceInteraction3f, ds: mi.DirectionSample3f, active: mi.Bool) -> mi.Float:
    return mi.Float(0.0) if ds.emitter is None else scene.pdf_emitter_direction(si, ds, active)


def _emitted(emitter: mi.Emitter, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.Spectrum:
    return mi.Spectrum(0.0) if emitter is None else emitter.eval(si, active)


def _power_heuristic(a: mi.Float, b: mi.Float) -> mi.Float:
    return ratio(dr.square(a), dr.square(a) + dr.square(b))
