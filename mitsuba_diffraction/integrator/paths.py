"""Paths from the light, the shapes that are gratings, and splats on the film; `eye_paths.py` has the other paths.

The manual of `diffraction_path` lists which paths are traced from which end.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..bsdf.base import gratings_in, gratings_left_out, is_grating
from ..bsdf.device_tables import on_device
from ..bsdf.mitsuba_internals import CURVES, INSTANCE, SHAPE_GROUP, TWO_SIDED, parts
from .scene_cache import SceneCache


def quotient(a: mi.Float, b: mi.Float) -> mi.Float:
    """Return a/b, and zero where b is zero."""
    return dr.select(b != 0, a / b, 0)


def random_numbers(seed: mi.UInt32 | int, key: int, index: mi.UInt32) -> mi.PCG32:
    """Return random numbers of each index, independent of the numbers that samplers draw from the same seed."""
    mixed = mi.UInt32(seed) ^ key
    dr.make_opaque(mixed)
    state, sequence = mi.sample_tea_32(index, mixed)
    return mi.PCG32(initstate=mi.UInt64(state), initseq=mi.UInt64(sequence))


def loops_traced_once() -> AbstractContextManager:
    """Return a context in which Dr.Jit records the body of a loop once.

    By default, it records it again without variables that the body does not change, nested loops four times; recording
    is most of the time of a small picture. Here loops exclude what they do not change instead.
    """
    return dr.scoped_set_flag(dr.JitFlag.OptimizeLoops, False)


def widen(si: mi.SurfaceInteraction3f) -> None:
    """Make all members of an interaction as wide as it is: narrow ones have a loop recorded again."""
    width = dr.width(si.t)
    si.time += dr.zeros(mi.Float, width)
    si.duv_dx, si.duv_dy = dr.zeros(mi.Vector2f, width), dr.zeros(mi.Vector2f, width)


class Gratings:
    """The shapes whose BSDF is or holds a `diffraction_grating` and on which points can be drawn by area.

    A shape counts as a whole, whichever component of its BSDF reflects: both sides of `twosided`, all of a blend, and
    the base. Shapes on which Mitsuba draws no points do not count, as instances, curves and `sdfgrid`.

    Attributes:
        shapes: list of `mi.Shape`.
        members: all shapes of groups, if the scene has instances.
        instanced: those with gratings, whose instances do not count.
        has_mixture: whether one of the shapes is a mixture, see `is_mixture`.
        are_all: whether no other shape of the scene holds a grating.
        only: whether, in addition, the BSDFs of the shapes consist of gratings only, see `classify`.
    """

    def __init__(self, scene: mi.Scene, cache: SceneCache) -> None:
        shapes = [shape for shape in scene.shapes() if gratings_in(shape.bsdf())]
        areas = cache.once("areas", lambda: _areas(scene, shapes))
        self.shapes = [shape for shape, area in zip(shapes, areas, strict=True) if area > 0]
        has_instances = any(shape.class_name() == INSTANCE for shape in scene.shapes())
        groups = [shape for shape in parts(scene, mi.Shape) if shape.class_name() == SHAPE_GROUP]
        self.members = [shape for group in groups for shape in parts(group, mi.Shape) if has_instances]
        self.instanced = [shape for shape in self.members if gratings_in(shape.bsdf())]
        if self.shapes:
            # Of a list with one number Mitsuba makes a literal.
            self._choice = mi.DiscreteDistribution(on_device([area for area in areas if area > 0]))
        kinds = [_kind_of(shape.bsdf()) for shape in self.shapes]
        self.has_mixture = _MIXTURE in kinds
        self.are_all = len(self.shapes) == len(shapes) and not self.instanced
        self.only = self.are_all and all(kind == _GRATING_ONLY for kind in kinds)
        ids = [dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape))[0] for shape in (*self.shapes, *self.instanced)]
        if not ids:
            return
        kinds += [_INSTANCED] * len(self.instanced)
        self._size = dr.opaque(mi.UInt32, max(ids) + 1)
        table = np.zeros(max(ids) + 1)
        table[ids] = kinds
        self._table = on_device(table, mi.UInt32)

    def __contains__(self, shape: mi.Shape) -> bool:
        return any(shape is grating for grating in self.shapes)

    def classify(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> tuple[mi.Bool, mi.Bool]:
        """Return whether a point lies on one of the shapes, and whether its BSDF consists of gratings only.

        Such a BSDF (a grating, or a `twosided` of gratings) is reciprocal, and its wavelengths can be replaced, as no
        other BSDF receives them.
        """
        kind = self._kind(si, active)
        return (kind > 0) & (kind != _INSTANCED), kind == _GRATING_ONLY

    def is_mixture(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.Bool:
        """Return whether a point lies on one of the shapes, on a BSDF that transmits light and holds other BSDFs."""
        return self._kind(si, active) == _MIXTURE

    def contains(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.Bool:
        """Return whether a point lies on one of the shapes or on an instance of those of groups."""
        return self._kind(si, active) > 0

    def _kind(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.UInt32:
        shape_id = dr.reinterpret_array(mi.UInt32, si.shape)
        return dr.gather(mi.UInt32, self._table, shape_id, active & (shape_id < self._size))

    def sample(self, time: mi.Float, u: mi.Float, v: mi.Point2f, active: mi.Bool) -> mi.PositionSample3f:
        """Sample a point on the shapes, uniformly by area; `pdf` is the density per unit area."""
        if not self.shapes:
            return dr.zeros(mi.PositionSample3f)
        index, probability = self._choice.sample_pmf(u, active)
        # A call via mi.ShapePtr would also be recorded for shapes that do not implement it.
        point = dr.switch(index, [shape.sample_position for shape in self.shapes], time, v, active)
        point.pdf *= probability
        return point

    def pdf_direction(self, si: mi.SurfaceInteraction3f, ray: mi.Ray3f) -> mi.Float:
        """Return the density of `sample` per unit solid angle, of a point that a ray hits."""
        if not self.shapes:
            return mi.Float(0)
        return quotient(dr.square(si.t), self._choice.sum() * dr.abs(dr.dot(si.n, ray.d)))


def implements(method: Callable[..., object], *arguments: object) -> bool:
    """Return whether a plugin implements a method; Mitsuba reports this only when the method is called."""
    try:
        method(*arguments)
    except RuntimeError as error:
        if "not implemented" not in str(error):
            raise
        return False
    return True


def _areas(scene: mi.Scene, shapes: list[mi.Shape]) -> list[float]:
    """Return the area of each shape, zero where Mitsuba cannot draw points or rays do not find them."""
    areas = [_area(shape) for shape in shapes]
    found = iter(_are_found(scene, [shape for shape, area in zip(shapes, areas, strict=True) if area > 0]))
    return [area if area > 0 and next(found) else 0.0 for area in areas]


def _area(shape: mi.Shape) -> float:
    """Return the area of a shape, zero if Mitsuba cannot draw points on it."""
    if not (implements(shape.sample_position, 0.0, mi.Point2f(0.5)) and implements(shape.surface_area)):
        return 0.0
    return float(shape.surface_area()[0])


def _are_found(scene: mi.Scene, shapes: list[mi.Shape]) -> NDArray[np.bool_]:
    """Return on which shapes rays find the points that Mitsuba draws there.

    They do not on a sphere with a scale that is not uniform, and on a disk after `rotate` about an axis that is not of
    unit length, whose inverse in Mitsuba 3.9.1 is that of another transform.
    """
    if not shapes:
        return np.zeros(0, bool)
    rng = mi.PCG32(size=len(shapes) * _DRAWN_POINTS)
    point = mi.Point2f(rng.next_float32(), rng.next_float32())
    index = dr.arange(mi.UInt32, len(shapes) * _DRAWN_POINTS) // _DRAWN_POINTS
    drawn = dr.switch(index, [shape.sample_position for shape in shapes], mi.Float(0), point, mi.Bool(True))
    found = scene.ray_test(_ray_to(drawn.p, drawn.n, mi.Float(0), mi.Spectrum(0)))
    return np.array(found).reshape(len(shapes), -1).mean(1) > _MIN_FOUND


def _ray_to(point: mi.Point3f, normal: mi.Normal3f, time: mi.Float, wavelengths: mi.Spectrum) -> mi.Ray3f:
    """Return a short ray along the normal of a surface that meets it at a point."""
    offset = mi.math.RayEpsilon * (1 + dr.max(dr.abs(point)))
    return mi.Ray3f(point + normal * offset, -normal, 2 * offset, time, wavelengths)


def _is_grating_only(bsdf: mi.BSDF) -> bool:
    """Return whether a BSDF is a grating without `base`, or a `twosided` of such gratings."""
    components = parts(bsdf, mi.BSDF)
    if is_grating(bsdf):
        return not components
    return bsdf.class_name() == TWO_SIDED and all(map(_is_grating_only, components))


def _kind_of(bsdf: mi.BSDF) -> int:
    """Return the kind of a BSDF with gratings.

    `mask` counts as no mixture: the densities of its samples leave out the opacity.
    """
    flags = bsdf.flags()
    transmits = flags & +mi.BSDFFlags.GlossyTransmission and not flags & +mi.BSDFFlags.Null
    if transmits and not _holds_gratings_only(bsdf):
        return _MIXTURE
    return _GRATING_ONLY if _is_grating_only(bsdf) else _WITH_GRATINGS


def _holds_gratings_only(bsdf: mi.BSDF) -> bool:
    """Return whether all BSDFs that hold no others are gratings."""
    return is_grating(bsdf) or (bool(nested := parts(bsdf, mi.BSDF)) and all(map(_holds_gratings_only, nested)))


_WITH_GRATINGS, _GRATING_ONLY, _INSTANCED, _MIXTURE = range(1, 5)  # kinds of shapes
_DRAWN_POINTS, _MIN_FOUND = 1024, 0.995  # on a shape, and the fraction of them that rays find
_DENSITY_TOLERANCE = 5e-3  # relative, of the density of a sample and that of its direction, more than by rounding


def with_surviving_wavelengths(
    si: mi.SurfaceInteraction3f, throughput: mi.Spectrum, active: mi.Bool
) -> mi.SurfaceInteraction3f:
    """Return an interaction in which the strongest wavelength replaces those without throughput.

    A grating diffracts the wavelengths into different directions, so that usually one of four keeps its throughput. The
    next grating would sample a direction for any of the four, and three of four paths would end. A replaced wavelength
    has no throughput and adds nothing.
    """
    strongest, maximum = si.wavelengths[0], throughput[0]
    for wavelength, power in zip(si.wavelengths, throughput, strict=True):
        strongest, maximum = dr.select(power > maximum, wavelength, strongest), dr.maximum(power, maximum)
    replaced = mi.SurfaceInteraction3f(si)
    replaced.wavelengths = dr.select(active & (throughput <= 0), strongest, si.wavelengths)
    return replaced


def has_failed(bs: mi.BSDFSample3f, density: mi.Float) -> mi.Bool:
    """Return whether a sample failed in the part of a mixture that drew it, but got the value of another part.

    `density` is that of `pdf`. Where a one-sided part of `blendbsdf` is lit from behind, or draws a direction below the
    horizon, Mitsuba 3.9.1 adds its density, which `pdf` does not hold, and returns the light of the other part once
    more.
    """
    differs = ~(dr.abs(density - bs.pdf) <= _DENSITY_TOLERANCE * bs.pdf)
    return differs & ~mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)


# ---------------------------------------------------------------- from the light


class SplatBuffer:
    """Buffer for the contributions of paths, any number of each, from inside a recorded loop.

    Threads fill it in any order; `content` is sorted by path and vertex.

    Attributes:
        capacity: number of contributions stored; further ones are only counted.
    """

    def __init__(self, capacity: int) -> None:
        self.capacity = capacity
        self._count = dr.zeros(mi.UInt32, 1)
        self._columns = [dr.empty(mi.Float, capacity) for _ in range(2 + 2 * dr.size_v(mi.Spectrum))]
        self._path, self._vertex = dr.empty(mi.UInt32, capacity), dr.empty(mi.UInt32, capacity)
        dr.make_opaque(self._count)

    def add(self, splat: Iterable[mi.Float], path: mi.UInt32, vertex: mi.UInt32, active: mi.Bool) -> None:
        """Add the contribution of a path at one of its vertices: position, wavelengths, value."""
        slot = dr.scatter_inc(self._count, mi.UInt32(0), active)
        active = active & (slot < dr.opaque(mi.UInt32, self.capacity))
        for column, number in zip(self._columns, splat, strict=True):
            dr.scatter(column, number, slot, active)
        dr.scatter(self._path, path, slot, active)
        dr.scatter(self._vertex, vertex, slot, active)

    def count(self) -> int:
        """Return how many contributions were added; evaluates the recorded loop."""
        dr.eval(self._count, self._columns, self._path, self._vertex)
        return int(self._count[0])

    def content(self) -> NDArray[np.float32]:
        """Return all contributions; their number must not exceed `capacity`."""
        count = self.count()
        order = np.lexsort((np.array(self._vertex)[:count], np.array(self._path)[:count]))
        return np.stack([np.array(column)[order] for column in self._columns], axis=1)


def unpacked(splats: NDArray[np.float32]) -> tuple[mi.Point2f, mi.Spectrum, mi.Spectrum]:
    """Return positions, wavelengths and values of contributions, see `LightPaths.splats`.

    Fewer than two are followed by zeros: arrays of one number, and empty ones, have kernels of their own.
    """
    splats = np.pad(splats, ((0, max(2 - len(splats), 0)), (0, 0)))
    x, y, *rest = (on_device(column) for column in splats.T)
    half = len(rest) // 2
    return mi.Point2f(x, y), mi.Spectrum(rest[:half]), mi.Spectrum(rest[half:])


_MAX_STARTS_PER_LAUNCH = 2**18  # some 150 MB
_BRANCHES = 4  # paths of each start
_NUM_CANDIDATES = 4  # of the first grating vertex and light direction
_MIN_LIGHT_PATHS, _MAX_LIGHT_PATHS = -6, -1  # log₂ r, see below
_PILOT_PATHS, _LIGHTS_AT_POINT, _PILOT_SEED = 2**13, 16, 0x50494C4F


class LightPaths:
    """Tracer of the paths L G⁺ X ((G | X)* X)? E (see `diffraction_path`), from the first grating to the sensor.

    With y₁ on a grating, drawn with density p(y₁), and a light in the direction ω₁ drawn with density p(ω₁), a path
    carries the power

        T₁ = L(ω₁) |ω₁·n₁| / (p(y₁) p(ω₁)),    T_{j+1} = T_j f_j(ω_j, ω'_j) |cos θ_j| |ω'_j·n_j| / (p(ω'_j) |ω_j·n_j|)

    from y_j to y_{j+1}: ω_j points towards the light (to y_{j−1}), ω'_j to y_{j+1}, n is the geometric normal, and θ is
    the angle between ω_j and the *shading* normal, as in a path tracer (Veach 1997, section 5.3). f_j is `eval` of the
    reverse path, with ω'_j as `wi` and ω_j as `wo`. For a reciprocal BSDF, `sample` returns f_j |cos θ'_j|/p with the
    angle θ' of ω'_j, so that the correction is |cos θ_j/cos θ'_j|; for specular reflection and refraction these are the
    angles to the normal at which ω_j is reflected or refracted into ω'_j.

    y₁ and ω₁ are one of four candidates, chosen with a probability proportional to the radiance received, shadows
    included (resampling, Talbot 2005). Even where a grating is mostly in shadow, most paths then begin at a lit point.
    Finding it takes as long as tracing a path. Thus each start has four paths, between which the first random number of
    `sample` at y₁ is stratified: each of the four wavelengths usually has a direction of its own.

    There are r paths for each sample of the film. Relative to the square of radiance, they add a variance of V/r to
    that of a sample, V_e, and take 2 r times as long, or so. r = √(V/(2 V_e)) minimises variance × time. V_e is taken
    as 1/2, and r is rounded to a power of two from 1/64 to 1/2. V is that of a pilot of other paths, and radiance the
    mean of direct light over the film, plus that of the pilot. Thus r depends on the scene alone.
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
        self.scene, self.sensor, self.gratings = scene, sensor, gratings
        # Opaque, so that all depths run the same kernel.
        self.max_depth = dr.opaque(mi.UInt32, max_depth % 2**32)
        self.pixels = math.prod(map(int, sensor.film().crop_size()))
        self.rr_depth = dr.opaque(mi.UInt32, rr_depth)
        # Curves stop rays that come from outside alone: light would leave points of gratings inside of them.
        shapes = (*scene.shapes(), *gratings.members)
        self.tests_reverse = any(shape.class_name() in CURVES for shape in shapes)
        self._capacity = float(_BRANCHES)  # contributions that a buffer takes, per start
        self.per_sample = cache.once("light paths", self._number_per_sample)

    def count(self, spp: int) -> int:
        """Return the number of paths for `spp` samples per pixel."""
        return max(1, round(self.per_sample * spp * self.pixels))

    def _number_per_sample(self) -> float:
        """Return r."""
        splats = np.concatenate(list(self.splats(_PILOT_SEED, _PILOT_PATHS)))
        # Of a path for each sample.
        values = splats[:, -dr.size_v(mi.Spectrum) :].mean(axis=1) * (_PILOT_PATHS / self.pixels)
        radiance = float(np.nanmean(self._direct_light())) + values.sum() / _PILOT_PATHS
        variance = np.square(values / (radiance or 1)).sum() / _PILOT_PATHS
        exponent = 0.5 * math.log2(variance) if variance > 0 else -math.inf
        return 2.0 ** round(min(max(exponent, _MIN_LIGHT_PATHS), _MAX_LIGHT_PATHS))

    def _direct_light(self) -> mi.Float:
        """Return the radiance of surfaces at random points of the film by direct light, from samples of lights."""
        index = dr.arange(mi.UInt32, _PILOT_PATHS)
        of_point, of_light = (random_numbers(_PILOT_SEED, k, index // k) for k in (_LIGHTS_AT_POINT, 1))
        time, wavelength = mi.Float(self.sensor.shutter_open()), _next_1d(of_point)
        ray, weight = self.sensor.sample_ray(time, wavelength, _next_2d(of_point), mi.Point2f(0.5))
        si = self.scene.ray_intersect(ray)
        ds, emitted = self.scene.sample_emitter_direction(si, _next_2d(of_light), True, si.is_valid())
        value = si.bsdf().eval(mi.BSDFContext(), si, si.to_local(ds.d), ds.pdf > 0)
        return dr.block_sum(dr.mean(weight * emitted * value) / _LIGHTS_AT_POINT, _LIGHTS_AT_POINT)

    def splats(self, seed: mi.UInt32 | int, count: int) -> Iterator[NDArray[np.float32]]:
        """Trace `count` paths, or up to three more; yield contributions, (n, 10).

        They and their order depend on seed and count alone.

        Each is a position x in pixels from the corner of the crop window, four wavelengths in nm, drawn by the sensor,
        and their values: Σ value δ(x − position) has the expectation L(x), in the form in which the sensor gives
        radiance to the film: divided by the density of the wavelengths and times the film's response.
        """
        starts = -(-count // _BRANCHES)
        for first in range(0, starts, _MAX_STARTS_PER_LAUNCH):
            launched = min(_MAX_STARTS_PER_LAUNCH, starts - first)
            while True:
                buffer = SplatBuffer(math.ceil(self._capacity * launched))
                with loops_traced_once():
                    self._trace(seed, first, launched, self.pixels / (starts * _BRANCHES), buffer)
                if buffer.count() <= buffer.capacity:
                    break
                # Repeated with the same random numbers and a larger buffer, which later launches have at once.
                self._capacity = 1.1 * buffer.count() / launched
            yield buffer.content()

    @dr.syntax
    def _trace(self, seed: mi.UInt32 | int, first: int, count: int, scale: float, buffer: SplatBuffer) -> None:
        """Trace the paths of `count` starts from the number `first` on; add their contributions to `buffer`."""
        start = dr.arange(mi.UInt32, count) + dr.opaque(mi.UInt32, first)
        rng = random_numbers(seed, 0x9E3779B9, start)
        first_si, power, delta, active = self._start(rng)
        power *= dr.opaque(mi.Float, scale)
        widen(first_si)
        si = mi.SurfaceInteraction3f(first_si)
        branch, depth = mi.UInt32(0), mi.UInt32(1)
        carried, throughput = mi.Spectrum(power), mi.Spectrum(1)
        branches = dr.opaque(mi.UInt32, _BRANCHES)
        while dr.hint(active, exclude=[self, buffer, start, first_si, power, delta, branches]):
            bsdf = si.bsdf()
            on_grating, grating_only = self.gratings.classify(si, active)
            position, value, connected = self._connect(si, bsdf, _next_2d(rng), active & (on_grating ^ True))
            splat = (*position, *si.wavelengths, *(value * carried))
            buffer.add(splat, start * branches + branch, depth, connected)
            at_start = depth == 1
            u = _next_1d(rng)
            u = dr.select(at_start, (mi.Float(branch) + u) / mi.Float(branches), u)
            ray, weight, specular = self._scatter(si, bsdf, carried, grating_only, u, _next_2d(rng), active)
            carried *= weight
            # That of the grating is not part of it.
            throughput = dr.select(at_start, 1, throughput * weight)
            # `path` does not find a light without extent by specular reflection.
            goes_on = dr.any(carried != 0) & ((at_start & specular & delta) ^ True)
            depth += 1
            roulette = depth >= self.rr_depth
            # As in `path`, but without η²: refraction scales radiance, not power.
            survival = dr.minimum(dr.max(throughput), 0.95)
            goes_on &= (depth < self.max_depth) & ((roulette ^ True) | (_next_1d(rng) < survival))
            factor = dr.select(roulette, quotient(1, survival), 1)
            carried *= factor
            throughput *= factor
            next_si = self.scene.ray_intersect(ray, active & goes_on)
            goes_on &= next_si.is_valid()
            if dr.hint(self.tests_reverse, mode="scalar"):
                goes_on &= self.scene.ray_test(next_si.spawn_ray_to(first_si.p), goes_on & at_start) ^ True
            # Where a path ends, the next branch begins.
            si = dr.select(goes_on, next_si, first_si)
            carried = dr.select(goes_on, carried, power)
            depth = dr.select(goes_on, depth, 1)
            branch = dr.select(goes_on, branch, branch + 1)
            active &= branch < branches

    @dr.syntax
    def _start(self, rng: mi.PCG32) -> tuple[mi.SurfaceInteraction3f, mi.Spectrum, mi.Bool, mi.Bool]:
        """Sample a light and a point on a grating, whose `wi` points to it.

        Return them, the power T₁, whether the light has no extent, and whether the sample is valid.
        """
        time = mi.Float(self.sensor.shutter_open())
        if dr.hint(self.sensor.shutter_open_time() > 0, mode="scalar"):
            time += _next_1d(rng) * self.sensor.shutter_open_time()
        wavelengths, response = self.sensor.sample_wavelengths(dr.zeros(mi.SurfaceInteraction3f), _next_1d(rng))

        point, normal, direction = mi.Point3f(0), mi.Normal3f(0), mi.Vector3f(0)
        received, delta = mi.Spectrum(0), mi.Bool(False)
        total_weight, chosen_weight = mi.Float(0), mi.Float(1)
        candidate = mi.UInt32(0)
        while dr.hint(candidate < _NUM_CANDIDATES, exclude=[self, time, wavelengths]):
            ps = self.gratings.sample(time, _next_1d(rng), _next_2d(rng), True)
            candidate_si = mi.SurfaceInteraction3f(ps, wavelengths)
            candidate_si.time = time
            ds, radiance = self.scene.sample_emitter_direction(candidate_si, _next_2d(rng), True)
            radiance *= quotient(1, ps.pdf)
            # Positive at grazing incidence, where the shading normal may still face the light.
            # Not a mean: Dr.Jit computes it with the number of paths as a literal.
            weight = dr.sum(radiance) * (dr.abs(dr.dot(ps.n, ds.d)) + 0.1)
            # The direction to a point of the same shape may be NaN.
            weight = dr.select(weight > 0, weight, 0)
            total_weight += weight
            chosen = (weight > 0) & (_next_1d(rng) * total_weight < weight)
            point, normal = dr.select(chosen, ps.p, point), dr.select(chosen, ps.n, normal)
            direction = dr.select(chosen, ds.d, direction)
            received, delta = dr.select(chosen, radiance, received), dr.select(chosen, ds.delta, delta)
            chosen_weight = dr.select(chosen, weight, chosen_weight)
            candidate += 1
        power = response * received * (total_weight / (chosen_weight * _NUM_CANDIDATES))

        # The complete interaction at that point, with tangents and UVs.
        si = self.scene.ray_intersect(_ray_to(point, normal, time, wavelengths), total_weight > 0)
        active = si.is_valid()
        si.wi = si.to_local(direction)
        power *= dr.abs(dr.dot(direction, si.n))
        return si, power, delta, active & self.gratings.classify(si, active)[0]

    def _scatter(
        self,
        si: mi.SurfaceInteraction3f,
        bsdf: mi.BSDF,
        power: mi.Spectrum,
        reciprocal: mi.Bool,
        u: mi.Float,
        v: mi.Point2f,
        active: mi.Bool,
    ) -> tuple[mi.Ray3f, mi.Spectrum, mi.Bool]:
        """Sample the next ray; return it, T_{j+1}/T_j, and whether the scattering was specular."""
        ctx = mi.BSDFContext(mi.TransportMode.Importance)
        si_bsdf = with_surviving_wavelengths(si, power, reciprocal)
        bs, weight = bsdf.sample(ctx, si_bsdf, u, v, active)
        specular = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        ray = si.spawn_ray(si.to_world(bs.wo))
        # |cos θ_j/cos θ'_j|, to the normal that reflects or refracts ω_j into ω'_j; one if the direction is unchanged.
        normal = si.wi + bs.eta * bs.wo
        deflected = dr.squared_norm(normal) > 1e-8
        cos_ratio = dr.select(deflected, dr.abs(quotient(dr.dot(si.wi, normal), dr.dot(bs.wo, normal))), 1)
        cos_ratio_shading = dr.abs(quotient(mi.Frame3f.cos_theta(si.wi), mi.Frame3f.cos_theta(bs.wo)))
        weight *= dr.select(specular, cos_ratio, cos_ratio_shading)
        # Other BSDFs may not be reciprocal, or may perturb the normal themselves. The direction of a failed sample has
        # no meaning, and may be one in which the perturbed BSDF, or another part of it, is not zero.
        evaluates_reverse = active & ((specular | reciprocal) ^ True)
        with gratings_left_out(self.gratings.only):
            density = bsdf.pdf(ctx, si, bs.wo, evaluates_reverse)
            active = active & ~(self.gratings.is_mixture(si, active) & has_failed(bs, density))
            evaluates_reverse &= active & (bs.pdf > 0)
            value = bsdf.eval(mi.BSDFContext(), _with_wi(si, bs.wo), si.wi, evaluates_reverse)
        weight = dr.select(evaluates_reverse, value * quotient(1, density), weight)
        weight *= dr.abs(quotient(dr.dot(ray.d, si.n), dr.dot(si.to_world(si.wi), si.n)))
        return ray, dr.select(active, weight, 0), specular

    def _connect(
        self, si: mi.SurfaceInteraction3f, bsdf: mi.BSDF, lens: mi.Point2f, active: mi.Bool
    ) -> tuple[mi.Point2f, mi.Spectrum, mi.Bool]:
        """Connect a point to the sensor: return position on the film, importance per unit power, and visibility."""
        active = active & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
        ds, importance = self.sensor.sample_direction(si, lens, active)
        active &= ds.pdf > 0
        active &= self.scene.ray_test(si.spawn_ray_to(ds.p), active) ^ True
        with gratings_left_out(self.gratings.are_all):
            value = bsdf.eval(mi.BSDFContext(), _with_wi(si, si.to_local(ds.d)), si.wi, active)
        value *= importance * dr.abs(quotient(dr.dot(ds.d, si.n), dr.dot(si.to_world(si.wi), si.n)))
        return ds.uv, value, active & dr.any(value != 0)


def _with_wi(si: mi.SurfaceInteraction3f, wi: mi.Vector3f) -> mi.SurfaceInteraction3f:
    """Return the same interaction with another incident direction."""
    changed = mi.SurfaceInteraction3f(si)
    changed.wi = wi
    return changed


def _next_1d(rng: mi.PCG32) -> mi.Float:
    return mi.Float(rng.next_float32())


def _next_2d(rng: mi.PCG32) -> mi.Point2f:
    return mi.Point2f(_next_1d(rng), _next_1d(rng))
