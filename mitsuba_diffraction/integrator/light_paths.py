"""Paths from the light: light that gratings cast onto other surfaces, and its splats on the film."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from .eye_paths import Gratings, ratio, surviving_wavelengths


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
        self._scalar: list[Splats] = []
        if dr.is_jit_v(mi.Float):
            self._count = dr.zeros(mi.UInt32, 1)
            self._columns = [dr.empty(mi.Float, capacity) for _ in range(2 + 2 * dr.size_v(mi.Spectrum))]
            self._path, self._vertex = dr.empty(mi.UInt32, capacity), dr.empty(mi.UInt32, capacity)
            dr.make_opaque(self._count)

    def add(self, splats: Splats, path: mi.UInt32, vertex: mi.UInt32, active: mi.Bool) -> None:
        """Add the contribution of a path at one of its vertices."""
        if not dr.is_jit_v(mi.Float):
            if active:
                self._scalar.append(splats)
            return
        slot = dr.scatter_inc(self._count, mi.UInt32(0), active)
        active = active & (slot < dr.opaque(mi.UInt32, self.capacity))
        values = (*splats.position, *splats.wavelengths, *splats.value)
        for column, value in zip(self._columns, values, strict=True):
            dr.scatter(column, value, slot, active)
        dr.scatter(self._path, path, slot, active)
        dr.scatter(self._vertex, vertex, slot, active)

    def count(self) -> int:
        """Return how many contributions were added; evaluates the recorded loop."""
        if not dr.is_jit_v(mi.Float):
            return len(self._scalar)
        dr.eval(self._count, self._columns, self._path, self._vertex)
        return int(self._count[0])

    def content(self) -> list[Splats]:
        """Return all contributions, if there are no more than `capacity`."""
        count = self.count()
        if not dr.is_jit_v(mi.Float) or count == 0:
            return self._scalar
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
    the angle between ω_j and the *shading* normal, as a path tracer has it (Veach 1997, section 5.3). `sample` of the
    BSDF gives f_j |cos θ'_j|/p with the angle θ' of ω'_j, so that the correction is |cos θ_j/cos θ'_j|; where BSDFs
    turn the normal themselves it is the ratio of their values both ways.

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
        step = _PATHS_AT_ONCE if dr.is_jit_v(mi.Float) else 1
        capacity = min(step, count)
        for first in range(0, count, step):
            buffer = SplatBuffer(capacity)
            self._trace(seed, first, min(step, count - first), self.pixels / count, buffer)
            if buffer.count() > capacity:
                # Once more, with the same random numbers.
                capacity = buffer.count()
                buffer = SplatBuffer(capacity)
                self._trace(seed, first, min(step, count - first), self.pixels / count, buffer)
            yield from buffer.content()

    @dr.syntax
    def _trace(self, seed: mi.UInt32 | int, first: int, count: int, scale: float, buffer: SplatBuffer) -> None:
        """Trace the paths from the number `first` on, and add their contributions to the sensor to `buffer`."""
        path = dr.arange(mi.UInt32, count) if dr.is_jit_v(mi.Float) else 0
        path += dr.opaque(mi.UInt32, first)
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
            plain = active & (self.gratings.hold(si, active) ^ True)
            position, value, reached = self._connect(si, bsdf, _next_2d(rng), plain)
            buffer.add(Splats(position, ray.wavelengths, value * power * throughput), path, depth, reached)
            ray, weight, _ = self._scatter(si, bsdf, rng, active)
            throughput *= weight
            ray.wavelengths = surviving_wavelengths(ray.wavelengths, power * throughput)
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
            total += weight
            takes = (weight > 0) & (_next_1d(rng) * total < weight)
            point, normal = dr.select(takes, ps.p, point), dr.select(takes, ps.n, normal)
            direction = dr.select(takes, ds.d, direction)
            received, delta = dr.select(takes, radiance, received), dr.select(takes, ds.delta, delta)
            own = dr.select(takes, weight, own)
            candidate += 1
        power = response * received * (total / (own * _CANDIDATES))

        wavelengths = surviving_wavelengths(wavelengths, power)
        # All of the surface at that point, with its tangents, as a ray along the normal meets it.
        off = mi.math.RayEpsilon * (1 + dr.max(dr.abs(point)))
        si = self.scene.ray_intersect(mi.Ray3f(point + normal * off, -normal, 2 * off, time, wavelengths), total > 0)
        active = si.is_valid()
        if dr.hint(not dr.is_jit_v(mi.Float) and not active, mode="scalar"):
            return mi.Ray3f(), power, active
        active &= self.gratings.hold(si, active)
        si.wi = si.to_local(direction)
        power *= dr.abs(dr.dot(direction, si.n))
        ray, weight, mirrored = self._scatter(si, si.bsdf(), rng, active)
        power *= weight
        ray.wavelengths = surviving_wavelengths(ray.wavelengths, power)
        # `path` does not see a light without extent in a mirror.
        active &= dr.any(power != 0) & ((mirrored & delta) ^ True)
        return ray, power, active

    def _scatter(
        self, si: mi.SurfaceInteraction3f, bsdf: mi.BSDF, rng: mi.PCG32, active: mi.Bool
    ) -> tuple[mi.Ray3f, mi.Spectrum, mi.Bool]:
        """Sample the next ray; return it, T_{j+1}/T_j, and whether it was specular."""
        ctx = mi.BSDFContext(mi.TransportMode.Importance)
        bs, weight = bsdf.sample(ctx, si, _next_1d(rng), _next_2d(rng), active)
        mirrored = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        ray = si.spawn_ray(si.to_world(bs.wo))
        turn = dr.abs(ratio(mi.Frame3f.cos_theta(si.wi), mi.Frame3f.cos_theta(bs.wo)))
        if self.gratings.perturbed:
            forth = dr.sum(bsdf.eval(ctx, si, bs.wo, active & (mirrored ^ True)))
            back = dr.sum(bsdf.eval(mi.BSDFContext(), _from(si, bs.wo), si.wi, active & (mirrored ^ True)))
            turn = dr.select(mirrored, turn, ratio(back, forth))
        turn *= dr.abs(ratio(dr.dot(ray.d, si.n), dr.dot(si.to_world(si.wi), si.n)))
        return ray, dr.select(active, weight * turn, 0), mirrored

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
