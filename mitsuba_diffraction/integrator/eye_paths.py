"""Paths from the eye: `path` without the paths that are traced from the light.

At each vertex, light is found in three ways: by a sample of the emitters, by candidates (`candidates.py`), and where
the next ray, of the BSDF or towards a point on a grating, meets an emitter. Light of lamps without extent at the first
vertex has wavelengths of its own (`lamps_without_extent.py`).
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..bsdf.base import gratings_left_out
from .candidates import Candidates, MetEmitters
from .lamps_without_extent import LampsWithoutExtent
from .paths import Gratings, has_failed, loops_traced_once, quotient, widen, with_surviving_wavelengths
from .scene_cache import SceneCache

_GRATING_PROBABILITY = 0.5  # of a direction to a point on a grating
_VISIBILITY_TOLERANCE = 1e-3  # relative, of the distance to that point

Received = tuple["mi.Spectrum", "mi.Spectrum"]
"""Four wavelengths in nm, and radiance times the weight of the sensor there."""


@dataclass(frozen=True)
class _Vertex:
    """A vertex of paths from the eye.

    Attributes:
        si: at its own wavelengths.
        si_bsdf: at those at which the BSDF is evaluated.
        bsdf: of the surface.
        to_gratings: whether some of the directions are drawn to points on gratings.
        probability: of the emitters of which one is drawn.
        slots, candidates: J and M of `candidates.py`.
    """

    si: mi.SurfaceInteraction3f
    si_bsdf: mi.SurfaceInteraction3f
    bsdf: mi.BSDFPtr
    to_gratings: mi.Bool
    probability: mi.Float
    slots: mi.UInt32
    candidates: mi.UInt32

    @property
    def bsdf_probability(self) -> mi.Float:
        """The probability of a direction to be drawn by the BSDF."""
        return dr.select(self.to_gratings, 1 - _GRATING_PROBABILITY, 1)


@dataclass(frozen=True)
class _Direction:
    """The direction of the next ray: a sample of the BSDF, or `guided` to a point on a grating.

    Attributes:
        to_point, distance: the ray to that point.
        value, pdf: of the BSDF in its direction.
        bs, weight: the sample.
        delta: whether the sample is of a delta component.
    """

    guided: mi.Bool
    to_point: mi.Ray3f
    distance: mi.Float
    value: mi.Spectrum
    pdf: mi.Float
    bs: mi.BSDFSample3f
    weight: mi.Spectrum
    delta: mi.Bool


class EyeTracer:
    """Tracer of the paths from the eye through a scene.

    Attributes:
        candidates: those of direct light.
        lamps: those without extent.
    """

    def __init__(
        self,
        scene: mi.Scene,
        sensor: mi.Sensor,
        gratings: Gratings,
        cache: SceneCache,
        max_depth: int,
        rr_depth: int,
    ) -> None:
        self.gratings = gratings
        self.emitters = MetEmitters(scene)
        self.candidates = Candidates(scene, self.emitters, gratings.shapes, gratings.instanced, cache)
        self.lamps = LampsWithoutExtent(scene, sensor, cache)
        # Whether L G X G E and L G X M E are short enough: a literal, which removes what serves them alone.
        self.guides = bool(gratings.shapes) and not 0 <= max_depth < 4
        # Opaque, so that all depths run the same kernel.
        self.max_depth = dr.opaque(mi.UInt32, max_depth % 2**32)
        self.rr_depth = dr.opaque(mi.UInt32, rr_depth)

    @dr.syntax
    def trace(
        self,
        scene: mi.Scene,
        sampler: mi.Sampler,
        ray: mi.RayDifferential3f,
        response: mi.Spectrum,
        active: mi.Bool,
        draws_wavelengths: bool,
    ) -> tuple[list[Received], mi.Bool]:
        """Return the light along a ray, weighted by `response`, and its validity; see `EyePaths.trace`."""
        si = scene.ray_intersect(ray, active)
        # Alpha is the same as in `path`: null interactions are transparent, an environment is not.
        valid = mi.Bool(scene.environment() is not None)
        result = self.emitters.at(si).eval(si, active)
        ray_wavelengths = mi.Spectrum(ray.wavelengths)
        throughput, eta = mi.Spectrum(1.0), mi.Float(1.0)
        depth = mi.UInt32(1)
        active = active & si.is_valid() & (depth < self.max_depth)
        if dr.hint(draws_wavelengths, mode="scalar"):
            first_on_grating = self.gratings.contains(si, active)
            of_lamps = self.lamps.light(scene, sampler, si, first_on_grating)
        # Whether an earlier vertex is not on a grating; whether the first vertex is on one or scatters specularly;
        # whether an earlier vertex does not.
        has_other_vertex, from_eye_only, has_scattered = mi.Bool(False), mi.Bool(False), mi.Bool(False)
        widen(si)
        while dr.hint(active, exclude=[self, scene]):
            bsdf = si.bsdf()
            on_grating, grating_only = self.gratings.classify(si, active)
            si_bsdf = with_surviving_wavelengths(si, throughput, grating_only)
            from_light = on_grating & has_other_vertex & (from_eye_only ^ True)
            # In L G X G E, few directions from X that the BSDF samples lead to the first G.
            to_gratings = (
                mi.Bool(self.guides) & active & from_eye_only & (on_grating ^ True) & _is_smooth_reflector(bsdf)
            )
            samples_emitter = active & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
            point = sampler.next_2d(active)
            samples_emitter &= from_light ^ True
            probability = mi.Float(1)
            if dr.hint(draws_wavelengths, mode="scalar"):
                point, probability, has_other = self.lamps.others(point, first_on_grating & (depth == 1))
                samples_emitter &= has_other
            slots, candidates = self.candidates.numbers(si, has_scattered, samples_emitter)
            vertex = _Vertex(si, si_bsdf, bsdf, to_gratings, probability, slots, candidates)
            result += self._light_of_an_emitter(scene, vertex, point, throughput, samples_emitter)
            if dr.hint(self.candidates.any, mode="scalar"):
                light = self.candidates.sample(scene, sampler, si_bsdf, (slots, candidates), probability, slots > 0)
                result += dr.select(slots > 0, throughput * light, 0)

            # The last vertex of a path has no other light to find than that of candidates, but for specular light.
            is_last = (slots > 0) & (depth + 1 >= self.max_depth)
            has_ended = active & is_last & ~mi.has_flag(bsdf.flags(), mi.BSDFFlags.Delta)
            drawn = self._direction(sampler, vertex, active, has_ended)
            valid |= has_ended
            active &= ~has_ended
            delta = drawn.delta
            eta *= dr.select(drawn.guided, 1, drawn.bs.eta)
            valid |= active & (mi.has_flag(drawn.bs.sampled_type, mi.BSDFFlags.Null) ^ True)
            active &= ~is_last | delta
            from_eye_only |= (depth == 1) & (delta | on_grating)
            has_other_vertex |= on_grating ^ True
            has_scattered |= ~delta
            next_si, factor, ds, mis_weight, is_sampled = self._continued(scene, vertex, drawn, active)
            throughput *= factor
            active &= dr.any(throughput != 0)
            # Emitters that are never sampled are not found by paths from the light.
            counts = active & ((from_light & is_sampled) ^ True) & (delta | (slots == 0))
            result += dr.select(counts, throughput * ds.emitter.eval(next_si, counts) * mis_weight, 0)

            si = next_si
            depth += 1
            active &= si.is_valid() & (depth < self.max_depth)
            # Russian roulette, as in `path`
            survival = dr.minimum(dr.max(throughput) * dr.square(eta), 0.95)
            roulette = depth >= self.rr_depth
            active &= (roulette ^ True) | (sampler.next_1d(active) < survival)
            throughput *= dr.select(roulette, quotient(1, survival), 1)
        found = [(ray_wavelengths, response * result)]
        if dr.hint(draws_wavelengths, mode="scalar"):
            found = [*found, of_lamps]
        return found, valid

    def _light_of_an_emitter(
        self, scene: mi.Scene, vertex: _Vertex, point: mi.Point2f, throughput: mi.Spectrum, active: mi.Bool
    ) -> mi.Spectrum:
        """Return the light of an emitter that the scene draws, weighted against other ways to find it."""
        ds, emitted = scene.sample_emitter_direction(vertex.si, point, True, active)
        ds.pdf /= vertex.probability
        emitted *= vertex.probability
        wo = vertex.si.to_local(ds.d)
        value, pdf = vertex.bsdf.eval_pdf(mi.BSDFContext(), vertex.si_bsdf, wo, active & (ds.pdf != 0))
        mis_weight = _power_heuristic(ds.pdf, vertex.bsdf_probability * pdf)
        of_candidates = mi.Float(vertex.slots * vertex.candidates) * pdf
        mis_weight = dr.select(vertex.slots > 0, quotient(ds.pdf, ds.pdf + of_candidates), mis_weight)
        mis_weight = dr.select(ds.delta, 1, mis_weight)
        return dr.select(active & (ds.pdf != 0), throughput * value * emitted * mis_weight, 0)

    def _direction(self, sampler: mi.Sampler, vertex: _Vertex, active: mi.Bool, has_ended: mi.Bool) -> _Direction:
        """Draw the direction of the next ray."""
        ctx, si, bsdf = mi.BSDFContext(), vertex.si, vertex.bsdf
        guided = vertex.to_gratings & (sampler.next_1d(active) < _GRATING_PROBABILITY)
        ps = self.gratings.sample(si.time, sampler.next_1d(active), sampler.next_2d(active), guided)
        to_point = si.spawn_ray_to(ps.p)
        distance = dr.norm(ps.p - to_point.o)
        with gratings_left_out(self.gratings.are_all):
            value, pdf = bsdf.eval_pdf(ctx, vertex.si_bsdf, si.to_local(to_point.d), guided)
        active = active & ~has_ended
        unguided = active & (guided ^ True)
        bs, weight = bsdf.sample(ctx, vertex.si_bsdf, sampler.next_1d(active), sampler.next_2d(active), unguided)
        if self.gratings.has_mixture:
            in_mixture = self.gratings.is_mixture(si, unguided)
            density = bsdf.pdf(ctx, vertex.si_bsdf, bs.wo, in_mixture)
            weight = dr.select(in_mixture & has_failed(bs, density), 0, weight)
        delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        return _Direction(guided, to_point, distance, value, pdf, bs, weight, delta)

    def _continued(
        self, scene: mi.Scene, vertex: _Vertex, drawn: _Direction, active: mi.Bool
    ) -> tuple[mi.SurfaceInteraction3f, mi.Spectrum, mi.DirectionSample3f, mi.Float, mi.Bool]:
        """Trace the next ray.

        Return what it meets, the factor of the throughput, the direction to there, the weight of an emitter there
        against emitter sampling, and whether that could have drawn it.
        """
        si, to_gratings, guided = vertex.si, vertex.to_gratings, drawn.guided
        next_ray = si.spawn_ray(dr.select(guided, drawn.to_point.d, si.to_world(drawn.bs.wo)))
        next_si = scene.ray_intersect(next_ray, active)
        ds = self.emitters.towards(scene, next_si, si)
        pdf_emitter = scene.pdf_emitter_direction(si, ds, active) / vertex.probability
        # Emitters are left to emitter sampling, whose weights ignore points on gratings.
        on_target, _ = self.gratings.classify(next_si, to_gratings & next_si.is_valid())
        on_target &= pdf_emitter == 0
        grating_pdf = dr.select(on_target, self.gratings.pdf_direction(next_si, next_ray), 0)
        is_visible = dr.abs(next_si.t - drawn.distance) < _VISIBILITY_TOLERANCE * drawn.distance
        hidden = guided & ~(on_target & is_visible)
        bsdf_pdf = vertex.bsdf_probability * dr.select(guided, drawn.pdf, drawn.bs.pdf)
        value = dr.select(guided, drawn.value, drawn.weight * drawn.bs.pdf)
        mixed = dr.select(hidden, 0, value * quotient(1, bsdf_pdf + _GRATING_PROBABILITY * grating_pdf))
        factor = dr.select(to_gratings & (drawn.delta ^ True), mixed, drawn.weight / vertex.bsdf_probability)
        mis_weight = _power_heuristic(bsdf_pdf, dr.select(drawn.delta, 0, pdf_emitter))
        return next_si, factor, ds, mis_weight, pdf_emitter > 0


def define_eye_paths() -> type:
    """Define the class for the current variant, as its base class depends on the variant."""

    class EyePaths(mi.SamplingIntegrator):
        """Mitsuba's `path` without the paths that are traced from the light (see `diffraction_path`)."""

        def __init__(self, tracer: EyeTracer) -> None:
            mi.SamplingIntegrator.__init__(self, mi.Properties("eye_paths"))
            self.tracer, self.candidates, self.lamps = tracer, tracer.candidates, tracer.lamps

        def sample(
            self,
            scene: mi.Scene,
            sampler: mi.Sampler,
            ray: mi.RayDifferential3f,
            medium: mi.Medium | None = None,
            active: mi.Bool = True,
        ) -> tuple[mi.Spectrum, mi.Bool, list[mi.Float]]:
            # All light at the wavelengths of the ray.
            with loops_traced_once():
                ((_, radiance),), valid = self.tracer.trace(scene, sampler, ray, mi.Spectrum(1), active, False)
            return radiance, valid, []

        def trace(
            self, scene: mi.Scene, sampler: mi.Sampler, ray: mi.RayDifferential3f, weight: mi.Spectrum
        ) -> tuple[list[Received], mi.Bool]:
            """Return four wavelengths in nm and radiance times the weight of the sensor there, and validity.

            If there are lamps without extent, a second pair has their light at the first vertex.
            """
            with loops_traced_once():
                return self.tracer.trace(scene, sampler, ray, weight, True, self.lamps.any)

    return EyePaths


def _is_smooth_reflector(bsdf: mi.BSDF) -> mi.Bool:
    """Return whether a BSDF has a value for all reflected directions, and no transmission, which would change η."""
    transmits = mi.has_flag(bsdf.flags(), mi.BSDFFlags.Transmission | mi.BSDFFlags.Null)
    return mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth) & (transmits ^ True)


def _power_heuristic(a: mi.Float, b: mi.Float) -> mi.Float:
    """Return the weight; zero, as in `path`, where a is infinite, as for a lamp at grazing incidence."""
    weight = dr.square(a) / (dr.square(a) + dr.square(b))
    return dr.select(dr.isfinite(weight), weight, 0)
