"""Paths from the eye, and the shapes of a scene that are gratings."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..bsdf.base import contains_grating, nested


def ratio(a: mi.Float, b: mi.Float) -> mi.Float:
    """Return a/b, and zero where b is zero: scalar variants raise there."""
    divides = b != 0
    return dr.select(divides, a / dr.select(divides, b, 1), 0)


class Gratings:
    """The shapes whose BSDF is or holds a `diffraction_grating` and on which points can be drawn by area.

    A shape counts as a whole, whichever component of its BSDF reflects: both sides of `twosided`, all of a blend, and
    the base. Instances and curves, on which Mitsuba draws no points, do not count.

    Attributes:
        shapes: of the scene.
        perturbed: whether the scene has a BSDF that perturbs the shading normal: a normal or a bump map.
    """

    def __init__(self, scene: mi.Scene) -> None:
        surfaces = [(shape, shape.bsdf()) for shape in scene.shapes()]
        surfaces = [(shape, bsdf) for shape, bsdf in surfaces if bsdf is not None]
        self.perturbed = any(_perturbs(bsdf) for _, bsdf in surfaces)
        areas = [(shape, _area(shape)) for shape, bsdf in surfaces if contains_grating(bsdf)]
        areas = [(shape, area) for shape, area in areas if area > 0]
        self.shapes = [shape for shape, _ in areas]
        if not self.shapes:
            return
        self._choice = mi.DiscreteDistribution([area for _, area in areas])
        if dr.is_jit_v(mi.Float):
            numbers = [dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape))[0] for shape in self.shapes]
            self._size = dr.opaque(mi.UInt32, max(numbers) + 1)
            self._table = dr.zeros(mi.UInt32, max(numbers) + 1)
            dr.scatter(self._table, mi.UInt32(1), mi.UInt32(numbers))
            self._pointers = dr.reinterpret_array(mi.ShapePtr, mi.UInt32(numbers))
            dr.eval(self._table, self._pointers)

    def __contains__(self, shape: mi.Shape) -> bool:
        return any(shape is one for one in self.shapes)

    def hold(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.Bool:
        """Return whether a point lies on one of the shapes."""
        if not dr.is_jit_v(mi.Float):
            return si.shape in self
        number = dr.reinterpret_array(mi.UInt32, si.shape)
        return dr.gather(mi.UInt32, self._table, number, active & (number < self._size)) == 1

    def sample(self, time: mi.Float, u: mi.Float, v: mi.Point2f) -> mi.PositionSample3f:
        """Sample a point on the shapes, uniform by area; `pdf` is the density in area."""
        index, share = self._choice.sample_pmf(u)
        if dr.is_jit_v(mi.Float):
            point = dr.gather(mi.ShapePtr, self._pointers, index).sample_position(time, v)
        else:
            point = self.shapes[index].sample_position(time, v)
        point.pdf *= share
        return point


def _area(shape: mi.Shape) -> float:
    """Return the area of a shape, zero where Mitsuba draws no points."""
    try:
        shape.sample_position(0.0, mi.Point2f(0.5))
        area = shape.surface_area()
    except RuntimeError as error:
        if "not implemented" not in str(error):
            raise
        return 0.0
    return float(area[0] if dr.is_jit_v(mi.Float) else area)


def _perturbs(bsdf: mi.BSDF) -> bool:
    return bsdf.class_name() in ("NormalMap", "BumpMap") or any(map(_perturbs, nested(bsdf)))


def define() -> type:
    """Define the class for the current variant, to which its base class belongs."""

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
                ray.wavelengths = surviving_wavelengths(ray.wavelengths, throughput)
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


def surviving_wavelengths(wavelengths: mi.Spectrum, throughput: mi.Spectrum) -> mi.Spectrum:
    """Return wavelengths for the rest of a path: the strongest replaces those without throughput.

    A grating diffracts the wavelengths into different directions. At the next one a direction would be drawn for any of
    the four, and three of four paths would end. A replaced wavelength has no throughput and adds nothing.
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
