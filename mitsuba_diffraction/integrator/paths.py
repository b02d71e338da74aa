"""Paths from the eye and paths from the light, the shapes that are gratings, and splats on the film.

`diffraction_path` says which paths are traced from which end.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..bsdf.base import contains_grating, is_grating, nested


def ratio(a: mi.Float, b: mi.Float) -> mi.Float:
    """Return a/b, and zero where b is zero."""
    return dr.select(b != 0, a / b, 0)


class Gratings:
    """The shapes whose BSDF is or holds a `diffraction_grating` and on which points can be drawn by area.

    A shape counts as a whole, whichever component of its BSDF reflects: both sides of `twosided`, all of a blend, and
    the base. Instances and curves, on which Mitsuba draws no points, do not count.

    Attributes:
        shapes: of the scene.
    """

    def __init__(self, scene: mi.Scene) -> None:
        surfaces = [(shape, shape.bsdf()) for shape in scene.shapes()]
        areas = [(shape, _area(shape)) for shape, bsdf in surfaces if bsdf is not None and contains_grating(bsdf)]
        areas = [(shape, area) for shape, area in areas if area > 0]
        self.shapes = [shape for shape, _ in areas]
        if not self.shapes:
            return
        self._choice = mi.DiscreteDistribution([area for _, area in areas])
        numbers = [dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape))[0] for shape in self.shapes]
        kinds = [2 if _is_alone(shape.bsdf()) else 1 for shape in self.shapes]
        self._size = dr.opaque(mi.UInt32, max(numbers) + 1)
        self._table = dr.zeros(mi.UInt32, max(numbers) + 1)
        dr.scatter(self._table, mi.UInt32(kinds), mi.UInt32(numbers))
        dr.eval(self._table)

    def __contains__(self, shape: mi.Shape) -> bool:
        return any(shape is one for one in self.shapes)

    def hold(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> tuple[mi.Bool, mi.Bool]:
        """Return whether a point lies on one of the shapes, and whether its BSDF is a grating alone.

        Alone, or on both sides of `twosided`, it is reciprocal, and no other BSDF sees its wavelengths.
        """
        number = dr.reinterpret_array(mi.UInt32, si.shape)
        kind = dr.gather(mi.UInt32, self._table, number, active & (number < self._size))
        return kind > 0, kind == 2

    def sample(self, time: mi.Float, u: mi.Float, v: mi.Point2f) -> mi.PositionSample3f:
        """Sample a point on the shapes, uniform by area; `pdf` is the density in area."""
        index, probability = self._choice.sample_pmf(u)
        # A call by mi.ShapePtr would record this for every shape, also for those that do not implement it.
        point = dr.switch(index, [shape.sample_position for shape in self.shapes], time, v)
        point.pdf *= probability
        return point


def implements(method: Callable[..., object], *arguments: object) -> bool:
    """Return whether a plugin implements a method, which Mitsuba tells only when it is called."""
    try:
        method(*arguments)
    except RuntimeError as error:
        if "not implemented" not in str(error):
            raise
        return False
    return True


def _area(shape: mi.Shape) -> float:
    """Return the area of a shape, zero where Mitsuba draws no points."""
    if not (implements(shape.sample_position, 0.0, mi.Point2f(0.5)) and implements(shape.surface_area)):
        return 0.0
    return float(shape.surface_area()[0])


def _is_alone(bsdf: mi.BSDF) -> bool:
    sides = nested(bsdf)
    return not sides if is_grating(bsdf) else bsdf.class_name() == "TwoSidedBRDF" and all(map(_is_alone, sides))


def define_eye_paths() -> type:
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
            result = si.emitter(scene).eval(si, active)
            ray = mi.Ray3f(ray)
            throughput, eta = mi.Spectrum(1.0), mi.Float(1.0)
            depth = mi.UInt32(1)
            active = seen & (depth < self.max_depth)
            # Whether a vertex so far is no grating, and whether the first one is one or scattered as a mirror does.
            met, mirrored = mi.Bool(False), mi.Bool(False)
            while active:
                bsdf = si.bsdf(ray)
                on_grating, alone = self.gratings.hold(si, active)
                at = with_surviving_wavelengths(si, throughput, alone)
                from_light = on_grating & met & (mirrored ^ True)

                # A light is looked for.
                looks = active & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
                point = sampler.next_2d(active)
                looks &= from_light ^ True
                ds, emitted = scene.sample_emitter_direction(si, point, True, looks)
                looks &= ds.pdf != 0
                wo = si.to_local(ds.d)
                value, pdf = bsdf.eval_pdf(ctx, at, wo, looks)
                share = dr.select(ds.delta, 1, _power_heuristic(ds.pdf, pdf))
                result += dr.select(looks, throughput * value * emitted * share, 0)

                # The path goes on, and may meet a light.
                bs, weight = bsdf.sample(ctx, at, sampler.next_1d(active), sampler.next_2d(active), active)
                throughput *= weight
                eta *= bs.eta
                delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
                mirrored |= (depth == 1) & (delta | on_grating)
                met |= on_grating ^ True
                active &= dr.any(throughput != 0)
                ray = si.spawn_ray(si.to_world(bs.wo))
                following = scene.ray_intersect(ray, active)
                ds = mi.DirectionSample3f(scene, following, si)
                pdf = scene.pdf_emitter_direction(si, ds, active)
                # A light that is never looked for is found only from here.
                found = active & ((from_light & (pdf > 0)) ^ True)
                share = _power_heuristic(bs.pdf, dr.select(delta, 0, pdf))
                result += dr.select(found, throughput * ds.emitter.eval(following, found) * share, 0)

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


def with_surviving_wavelengths(
    si: mi.SurfaceInteraction3f, throughput: mi.Spectrum, active: mi.Bool
) -> mi.SurfaceInteraction3f:
    """Return an interaction in which the strongest wavelength replaces those without throughput.

    A grating diffracts the wavelengths into different directions. At the next one a direction would be drawn for any of
    the four, and three of four paths would end. A replaced wavelength has no throughput and adds nothing.
    """
    strongest, maximum = si.wavelengths[0], throughput[0]
    for wavelength, power in zip(si.wavelengths, throughput, strict=True):
        strongest, maximum = dr.select(power > maximum, wavelength, strongest), dr.maximum(power, maximum)
    replaced = mi.SurfaceInteraction3f(si)
    replaced.wavelengths = dr.select(active & (throughput <= 0), strongest, si.wavelengths)
    return replaced


def _power_heuristic(a: mi.Float, b: mi.Float) -> mi.Float:
    return ratio(dr.square(a), dr.square(a) + dr.square(b))


# ---------------------------------------------------------------- from the light


@dataclass(frozen=True, eq=False)
class Splats:
    """n contributions, n ≥ 1.

    Attributes:
        position: pixels from the corner of the crop window.
        wavelengths: four, drawn by the sensor, nm.
        value: Σ value δ(x − position) over all splats has the expectation L(x), x in pixels, in the form in which the
            sensor gives radiance to the film: divided by the density of the wavelengths and times the film's response.
    """

    position: mi.Point2f
    wavelengths: mi.Spectrum
    value: mi.Spectrum


class SplatBuffer:
    """A buffer for the contributions of paths, any number of each, from inside a recorded loop.

    Threads fill it in any order; `content` is sorted by path and vertex.

    Attributes:
        capacity: contributions beyond it are only counted.
    """

    def __init__(self, capacity: int) -> None:
        self.capacity = capacity
        self._count = dr.zeros(mi.UInt32, 1)
        self._columns = [dr.empty(mi.Float, capacity) for _ in range(2 + 2 * dr.size_v(mi.Spectrum))]
        self._path, self._vertex = dr.empty(mi.UInt32, capacity), dr.empty(mi.UInt32, capacity)
        dr.make_opaque(self._count)

    def add(self, splats: Splats, path: mi.UInt32, vertex: mi.UInt32, active: mi.Bool) -> None:
        """Add the contribution of a path at one of its vertices."""
        slot = dr.scatter_inc(self._count, mi.UInt32(0), active)
        active = active & (slot < dr.opaque(mi.UInt32, self.capacity))
        values = (*splats.position, *splats.wavelengths, *splats.value)
        for column, value in zip(self._columns, values, strict=True):
            dr.scatter(column, value, slot, active)
        dr.scatter(self._path, path, slot, active)
        dr.scatter(self._vertex, vertex, slot, active)

    def count(self) -> int:
        """Return how many contributions were added; evaluates the recorded loop."""
        dr.eval(self._count, self._columns, self._path, self._vertex)
        return int(self._count[0])

    def content(self) -> list[Splats]:
        """Return all contributions, if there are no more than `capacity`."""
        count = self.count()
        if count == 0:
            return []
        order = np.lexsort((np.array(self._vertex)[:count], np.array(self._path)[:count]))
        columns = [dr.gather(mi.Float, column, mi.UInt32(order)) for column in self._columns]
        channels = dr.size_v(mi.Spectrum)
        position, wavelengths, value = columns[:2], columns[2 : 2 + channels], columns[2 + channels :]
        return [Splats(mi.Point2f(position), mi.Spectrum(wavelengths), mi.Spectrum(value))]


_PATHS_AT_ONCE = 2**20  # some 150 MB
_CANDIDATES = 4
# For each sample of the film, which costs more. A path reaches one pixel or none, so that walls are grainy with fewer.
_PATHS_PER_SAMPLE = 0.5


class LightPaths:
    """Traces L G⁺ X ((G | X)* X)? E (see `diffraction_path`) from the first grating on, and connects to the sensor.

    With y₁ on a grating, drawn with density p(y₁), and a light in the direction ω₁ drawn with density p(ω₁), a path
    carries the power

        T₁ = L(ω₁) |ω₁·n₁| / (p(y₁) p(ω₁)),    T_{j+1} = T_j f_j(ω_j, ω'_j) |cos θ_j| |ω'_j·n_j| / (p(ω'_j) |ω_j·n_j|)

    from y_j to y_{j+1}: ω_j points back to where light comes from, ω'_j on to y_{j+1}, n is the geometric normal, and θ
    the angle between ω_j and the *shading* normal, as a path tracer has it (Veach 1997, section 5.3). f_j is `eval`
    from ω'_j to ω_j, as of a path from the eye. Where the BSDF is reciprocal, `sample` gives f_j |cos θ'_j|/p with the
    angle θ' of ω'_j, so that the correction is |cos θ_j/cos θ'_j|; at a mirror or clear glass these are the angles to
    the normal that takes ω_j to ω'_j.

    y₁ and ω₁ are one of four candidates, chosen in proportion to what it receives, shadows included (resampling, Talbot
    2005): where most of a grating is in the shadow, most paths begin in the light all the same.
    """

    def __init__(self, scene: mi.Scene, sensor: mi.Sensor, gratings: Gratings, max_depth: int, rr_depth: int) -> None:
        self.scene, self.sensor, self.gratings = scene, sensor, gratings
        # Opaque, so that all depths run the same kernel.
        self.max_depth = dr.opaque(mi.UInt32, max_depth % 2**32)
        self.pixels = math.prod(map(int, sensor.film().crop_size()))
        self.rr_depth = dr.opaque(mi.UInt32, rr_depth)

    def count(self, spp: int) -> int:
        """Return how many paths are traced for `spp` samples per pixel."""
        return max(1, round(_PATHS_PER_SAMPLE * spp * self.pixels))

    def splats(self, seed: mi.UInt32 | int, count: int) -> Iterator[Splats]:
        """Trace `count` paths. The contributions and their order depend on the seed and the count alone."""
        capacity = min(_PATHS_AT_ONCE, count)
        for first in range(0, count, _PATHS_AT_ONCE):
            paths = min(_PATHS_AT_ONCE, count - first)
            buffer = SplatBuffer(capacity)
            self._trace(seed, first, paths, self.pixels / count, buffer)
            if buffer.count() > capacity:
                # Once more, with the same random numbers.
                capacity = buffer.count()
                buffer = SplatBuffer(capacity)
                self._trace(seed, first, paths, self.pixels / count, buffer)
            yield from buffer.content()

    @dr.syntax
    def _trace(self, seed: mi.UInt32 | int, first: int, count: int, scale: float, buffer: SplatBuffer) -> None:
        """Trace the paths from the number `first` on, and add their contributions to the sensor to `buffer`."""
        path = dr.arange(mi.UInt32, count) + dr.opaque(mi.UInt32, first)
        rng = mi.PCG32()
        # Other numbers than the sampler draws from the same seed.
        key = mi.UInt32(seed) ^ 0x9E3779B9
        dr.make_opaque(key)
        state, sequence = mi.sample_tea_32(path, key)
        rng.seed(mi.UInt64(state), mi.UInt64(sequence))
        ray, power, active = self._start(rng)
        power *= dr.opaque(mi.Float, scale)
        si = self.scene.ray_intersect(ray, active)
        depth = mi.UInt32(2)
        active &= si.is_valid()
        throughput = mi.Spectrum(1)
        while active:
            bsdf = si.bsdf(ray)
            on_grating, alone = self.gratings.hold(si, active)
            plain = active & (on_grating ^ True)
            position, value, reached = self._connect(si, bsdf, _next_2d(rng), plain)
            buffer.add(Splats(position, ray.wavelengths, value * power * throughput), path, depth, reached)
            ray, weight, _ = self._scatter(si, bsdf, power * throughput, alone, rng, active)
            throughput *= weight
            depth += 1
            gambles = depth >= self.rr_depth
            # As of `path`, without the indices passed: unlike radiance, power does not change with them.
            survival = dr.minimum(dr.max(throughput), 0.95)
            active &= dr.any(throughput != 0) & (depth < self.max_depth)
            active &= (gambles ^ True) | (_next_1d(rng) < survival)
            throughput *= dr.select(gambles, ratio(1, survival), 1)
            si = self.scene.ray_intersect(ray, active)
            active &= si.is_valid()

    @dr.syntax
    def _start(self, rng: mi.PCG32) -> tuple[mi.Ray3f, mi.Spectrum, mi.Bool]:
        """Sample a path from a light to a grating: the scattered ray, its power, and whether there is one."""
        time = mi.Float(self.sensor.shutter_open())
        if dr.hint(self.sensor.shutter_open_time() > 0, mode="scalar"):
            time += _next_1d(rng) * self.sensor.shutter_open_time()
        wavelengths, response = self.sensor.sample_wavelengths(dr.zeros(mi.SurfaceInteraction3f), _next_1d(rng))

        point, normal, direction = mi.Point3f(0), mi.Normal3f(0), mi.Vector3f(0)
        received, delta = mi.Spectrum(0), mi.Bool(False)
        total, own = mi.Float(0), mi.Float(1)
        candidate = mi.UInt32(0)
        while candidate < _CANDIDATES:
            ps = self.gratings.sample(time, _next_1d(rng), _next_2d(rng))
            place = mi.SurfaceInteraction3f(ps, wavelengths)
            place.time = time
            ds, radiance = self.scene.sample_emitter_direction(place, _next_2d(rng), True)
            radiance *= ratio(1, ps.pdf)
            # Not zero at grazing incidence, where the shading normal may still see the light.
            weight = dr.mean(radiance) * (dr.abs(dr.dot(ps.n, ds.d)) + 0.1)
            # The direction to a point of the same shape may be NaN.
            weight = dr.select(weight > 0, weight, 0)
            total += weight
            takes = (weight > 0) & (_next_1d(rng) * total < weight)
            point, normal = dr.select(takes, ps.p, point), dr.select(takes, ps.n, normal)
            direction = dr.select(takes, ds.d, direction)
            received, delta = dr.select(takes, radiance, received), dr.select(takes, ds.delta, delta)
            own = dr.select(takes, weight, own)
            candidate += 1
        power = response * received * (total / (own * _CANDIDATES))

        # All of the surface at that point, with its tangents, as a ray along the normal meets it.
        off = mi.math.RayEpsilon * (1 + dr.max(dr.abs(point)))
        si = self.scene.ray_intersect(mi.Ray3f(point + normal * off, -normal, 2 * off, time, wavelengths), total > 0)
        active = si.is_valid()
        on_grating, alone = self.gratings.hold(si, active)
        active &= on_grating
        si.wi = si.to_local(direction)
        power *= dr.abs(dr.dot(direction, si.n))
        ray, weight, mirrored = self._scatter(si, si.bsdf(), power, alone, rng, active)
        power *= weight
        # `path` does not see a light without extent in a mirror.
        active &= dr.any(power != 0) & ((mirrored & delta) ^ True)
        return ray, power, active

    def _scatter(
        self,
        si: mi.SurfaceInteraction3f,
        bsdf: mi.BSDF,
        power: mi.Spectrum,
        reciprocal: mi.Bool,
        rng: mi.PCG32,
        active: mi.Bool,
    ) -> tuple[mi.Ray3f, mi.Spectrum, mi.Bool]:
        """Sample the next ray; return it, T_{j+1}/T_j, and whether it was specular."""
        ctx = mi.BSDFContext(mi.TransportMode.Importance)
        at = with_surviving_wavelengths(si, power, reciprocal)
        bs, weight = bsdf.sample(ctx, at, _next_1d(rng), _next_2d(rng), active)
        mirrored = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        ray = si.spawn_ray(si.to_world(bs.wo))
        # The normal that refracts ω_j into ω'_j; light that is not refracted goes straight on.
        normal = si.wi + bs.eta * bs.wo
        bends = dr.squared_norm(normal) > 1e-8
        turn = dr.select(bends, dr.abs(ratio(dr.dot(si.wi, normal), dr.dot(bs.wo, normal))), 1)
        turn = dr.select(mirrored, turn, dr.abs(ratio(mi.Frame3f.cos_theta(si.wi), mi.Frame3f.cos_theta(bs.wo))))
        weight *= turn
        # Other BSDFs need not be reciprocal, or turn the normal themselves.
        reverses = active & ((mirrored | reciprocal) ^ True)
        value = bsdf.eval(mi.BSDFContext(), _from(si, bs.wo), si.wi, reverses)
        weight = dr.select(reverses, value * ratio(1, bsdf.pdf(ctx, si, bs.wo, reverses)), weight)
        weight *= dr.abs(ratio(dr.dot(ray.d, si.n), dr.dot(si.to_world(si.wi), si.n)))
        return ray, dr.select(active, weight, 0), mirrored

    def _connect(
        self, si: mi.SurfaceInteraction3f, bsdf: mi.BSDF, lens: mi.Point2f, active: mi.Bool
    ) -> tuple[mi.Point2f, mi.Spectrum, mi.Bool]:
        """Connect a point to the sensor: position on the film, importance per unit of power, visibility."""
        active = active & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
        ds, importance = self.sensor.sample_direction(si, lens, active)
        active &= ds.pdf > 0
        active &= self.scene.ray_test(si.spawn_ray_to(ds.p), active) ^ True
        value = bsdf.eval(mi.BSDFContext(), _from(si, si.to_local(ds.d)), si.wi, active)
        value *= importance * dr.abs(ratio(dr.dot(ds.d, si.n), dr.dot(si.to_world(si.wi), si.n)))
        return ds.uv, value, active & dr.any(value != 0)


def _from(si: mi.SurfaceInteraction3f, wi: mi.Vector3f) -> mi.SurfaceInteraction3f:
    """Return the same point seen from elsewhere."""
    seen = mi.SurfaceInteraction3f(si)
    seen.wi = wi
    return seen


def _next_1d(rng: mi.PCG32) -> mi.Float:
    return mi.Float(rng.next_float32())


def _next_2d(rng: mi.PCG32) -> mi.Point2f:
    return mi.Point2f(_next_1d(rng), _next_1d(rng))
