"""Direct light at a vertex on a grating: candidates of which one is traced.

The lobes of a grating are narrow, and each has one of the wavelengths of a ray: a sample of the BSDF seldom leads to a
lamp. A candidate costs less than a ray. In each of J slots M directions are drawn by `sample` of the BSDF, with the
density p, and one of them is kept with a probability that is mostly proportional to a guess h of the radiance from
there (`unshadowed_light.py`):

    ω_1 … ω_M ~ p,    π_i = (1 − β) h(ω_i)/Σ h + β/M

One ray is traced along the direction that was kept, ω = ω_i, and finds L. With a light sample of the density p_L, and
the balance heuristic for the densities c J p and p_L, light of all wavelengths is estimated by

    Σ_slots  f(ω) |cos θ| L(ω) c/(M π_i) / (c J p(ω) + p_L(ω))    +    f(ω_L) |cos θ_L| L(ω_L) / (c J p(ω_L) + p_L(ω_L))

It is unbiased for any h and any c > 0, since E[g(ω)/(M π_i)] = ∫ g p (Talbot 2005): the sum of both is ∫ f |cos θ| L.
c = M: near lamps directions that are kept are M times as dense as p. β > 0 bounds the weight 1/(M π_i) by 1/β, where
an obstacle hides the lamp that h expects.

At later vertices, which add little to the noise, there is one slot with half as many candidates.

The first number of `sample` is stratified over all candidates, so that each slot has its own wavelength and each
candidate its order, whatever the BSDF; the other two follow a lattice with a random shift. Delta components are never
kept. Their light, and the path, are continued by an ordinary sample (`EyePaths`), which does not count other emitters.
"""

from __future__ import annotations

import functools

import drjit as dr
import mitsuba as mi
import numpy as np

from ..bsdf.base import gratings_in, gratings_left_out, is_grating
from ..bsdf.device_tables import BELOW_ONE, on_device, opaque
from ..bsdf.mitsuba_internals import (
    BLEND,
    BUMP_MAP,
    DIFFUSE,
    INSTANCE,
    NORMAL_MAP,
    ROUGH_CONDUCTOR,
    TWO_SIDED,
    parts,
)
from ..precomputation.grating_spectrum import GratingSpectrum
from ..precomputation.spectra import Spectrum
from ..spectrum.grids import OrderGrid
from .scene_cache import SceneCache
from .unshadowed_light import UnshadowedLight

CANDIDATES, LATER_CANDIDATES = 16, 8  # M, at the first vertex that scatters, and at later ones, which have J = 1
SLOTS, SLOTS_OF_CONTINUA = 4, 1  # J
DEFENSIVE_FRACTION = 0.1  # β
MIN_GAIN = 6.0  # of h by light samples over that in all directions, from which candidates are drawn in doubt
MAX_NARROW_LOBE = 0.05  # σ_q in cycles/µm, up to which each wavelength has its own slot
_AT_ONCE = 4  # candidates drawn in an iteration, of which M is a multiple
_DIRECTIONS = 2**15  # for this comparison
# Of a lattice with low discrepancy in two dimensions: 1/g and 1/g², g³ = g + 1.
_LATTICE = (0.7548776662466927, 0.5698402909980532)


class MetEmitters:
    """The emitters that rays meet, as `si.emitter(scene)` returns them.

    The environment is an opaque number, zero where there is none. Mitsuba's is a literal, which depends on the order in
    which threads load lamps: the same scene would have several kernels.
    """

    def __init__(self, scene: mi.Scene) -> None:
        self._environment = mi.EmitterPtr(scene.environment())
        dr.make_opaque(self._environment)

    def at(self, si: mi.SurfaceInteraction3f) -> mi.EmitterPtr:
        """Return the emitter that a ray meets."""
        return dr.select(si.is_valid(), si.shape.emitter(), self._environment)

    def towards(
        self, scene: mi.Scene, si: mi.SurfaceInteraction3f, origin: mi.SurfaceInteraction3f
    ) -> mi.DirectionSample3f:
        """Return the direction from a point to what a ray from there meets."""
        ds = mi.DirectionSample3f(scene, si, origin)
        ds.emitter = self.at(si)
        return ds


class Candidates:
    """Direct light at the gratings of a scene.

    Attributes:
        light: h.
        any: whether candidates are drawn on any of the shapes.
    """

    def __init__(
        self,
        scene: mi.Scene,
        emitters: MetEmitters,
        shapes: list[mi.Shape],
        instanced: list[mi.Shape],
        cache: SceneCache,
    ) -> None:
        """Choose J of all gratings.

        Args:
            scene: with lights.
            emitters: of the scene.
            shapes: on which points can be drawn.
            instanced: of groups, whose instances are in the scene.
            cache: of this scene.
        """
        self.emitters, self.light = emitters, cache.once("light", lambda: UnshadowedLight(scene))
        numbers = cache.once("slots", lambda: self._numbers_of_slots(scene, shapes, instanced))
        slots = dict(zip((*shapes, *instanced), numbers, strict=True))
        shapes = [shape for shape in slots if slots[shape]]
        self.any = bool(shapes)
        self._bsdfs: list[mi.BSDF] = []
        ids = [dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape))[0] for shape in shapes]
        self._size = dr.opaque(mi.UInt32, max(ids, default=0) + 1)
        # Of each shape J, and the number of its BSDF.
        table = np.zeros((max(ids, default=0) + 1, 2), np.uint32)
        for shape, row in zip(shapes, ids, strict=True):
            bsdf = shape.bsdf()
            if not any(bsdf is known for known in self._bsdfs):
                self._bsdfs.append(bsdf)
            table[row] = slots[shape], next(k for k, known in enumerate(self._bsdfs) if bsdf is known)
        self._table = on_device(table, mi.UInt32)
        self._fraction = opaque(DEFENSIVE_FRACTION)

    def _numbers_of_slots(self, scene: mi.Scene, shapes: list[mi.Shape], instanced: list[mi.Shape]) -> list[int]:
        """Return J of each shape."""
        u = _random(0)
        points = {shape: shape.sample_position(0.0, mi.Point2f(u.x, u.y)).p for shape in shapes}
        points |= dict.fromkeys(instanced, _points_of_instances(scene, u) if instanced else None)
        return [self._slots(scene, shape, on_shape) for shape, on_shape in points.items()]

    def _slots(self, scene: mi.Scene, shape: mi.Shape, points: mi.Point3f) -> int:
        """Return J of a shape with these points.

        Where lobes are narrow, candidates help below a uniform sky, too: each has a wavelength and an order of its own.
        Not so beside a sun, whose noise is left. A continuum needs lamps that are much brighter than other directions;
        an environment alone is found as well by its own samples.
        """
        if not self.light.has_extent:
            return 0
        narrow = all(_has_narrow_lobes(grating.spectrum) for grating in gratings_in(shape.bsdf()))
        if narrow and self.light.is_whole:
            return SLOTS
        if not (narrow or self.light.has_outlines):
            return 0
        u, v = (mi.Point2f(numbers.x, numbers.y) for numbers in map(_random, (1, 2)))
        si = dr.zeros(mi.SurfaceInteraction3f, _DIRECTIONS)
        si.p = points
        drawn, _ = scene.sample_emitter_direction(si, u, False)
        has_extent = (drawn.pdf > 0) & ~drawn.delta
        anywhere = mi.warp.square_to_uniform_sphere(v)
        of_lights = dr.sum(dr.select(has_extent, self.light(si.p, drawn.d, True), 0)) / dr.maximum(
            dr.count(has_extent), 1
        )
        if float(of_lights[0]) < MIN_GAIN * float(dr.mean(self.light(si.p, anywhere, True))[0]):
            return 0
        return SLOTS if narrow else SLOTS_OF_CONTINUA

    def numbers(self, si: mi.SurfaceInteraction3f, is_later: mi.Bool, active: mi.Bool) -> tuple[mi.UInt32, mi.UInt32]:
        """Return J and M at a point; J is zero where no candidates are drawn."""
        shape_id = dr.reinterpret_array(mi.UInt32, si.shape)
        slots = dr.gather(mi.UInt32, self._table, 2 * shape_id, active & (shape_id < self._size))
        slots = dr.select(is_later & (slots > 0), 1, slots)
        return slots, dr.select(is_later, mi.UInt32(LATER_CANDIDATES), CANDIDATES)

    @dr.syntax
    def sample(
        self,
        scene: mi.Scene,
        sampler: mi.Sampler,
        si: mi.SurfaceInteraction3f,
        numbers: tuple[mi.UInt32, mi.UInt32],
        probability: mi.Float,
        active: mi.Bool,
    ) -> mi.Spectrum:
        """Return the light of all slots, the first sum above.

        Args:
            scene, sampler, si, active: as in Mitsuba.
            numbers: J and M.
            probability: that of the emitters that are drawn.
        """
        ctx, result, bsdf = mi.BSDFContext(), mi.Spectrum(0), si.bsdf()
        shift, jitter = sampler.next_2d(active), sampler.next_1d(active)
        number = dr.gather(mi.UInt32, self._table, 2 * dr.reinterpret_array(mi.UInt32, si.shape) + 1, active)
        slots, candidates = numbers
        count, total = mi.Float(candidates), mi.Float(slots * candidates)
        slot = mi.UInt32(0)
        while dr.hint(
            active & (slot < slots),
            exclude=[self, scene, ctx, bsdf, si, number, slots, candidates, count, total, shift, jitter, probability],
        ):
            pick = sampler.next_1d(active)
            pick = dr.select(sampler.next_1d(active) < self._fraction, mi.UInt32(pick * count), candidates)
            first = (mi.Float(slot * candidates) + jitter) / total
            of_slot = candidates, first, 1 / total, shift, sampler.next_1d(active), pick
            omega, fraction = self._kept(number, si, of_slot, active)
            kept = active & (fraction > 0)
            value, pdf = bsdf.eval_pdf(ctx, si, omega, kept)
            kept &= dr.any(value != 0)
            found = scene.ray_intersect(si.spawn_ray(si.to_world(omega)), kept)
            ds = self.emitters.towards(scene, found, si)
            pdf_emitter = scene.pdf_emitter_direction(si, ds, kept)
            emitted = ds.emitter.eval(found, kept)
            # c/(M π)
            weight = count / dr.fma(count * fraction, 1 - self._fraction, self._fraction)
            weight /= dr.fma(total, pdf, pdf_emitter / probability)
            result += dr.select(kept, value * emitted * weight, 0)
            slot += 1
        return result

    def _kept(
        self, number: mi.UInt32, si: mi.SurfaceInteraction3f, of_slot: tuple, active: mi.Bool
    ) -> tuple[mi.Vector3f, mi.Float]:
        """Return the candidate that is kept, and its h/Σ h; `number` is that of the BSDF in `_bsdfs`.

        `of_slot`: M; the first number of `sample` for the first candidate, and its step; the shift of the lattice; a
        random number for the choice by h; the candidate chosen without h, or M.

        The BSDFs themselves are called, not `BSDFPtr`: then Dr.Jit leaves out what is computed besides the direction.
        """
        if len(self._bsdfs) == 1:
            return self._kept_of(self._bsdfs[0], si, of_slot, active)
        return dr.switch(number, [functools.partial(self._kept_of, bsdf) for bsdf in self._bsdfs], si, of_slot, active)

    @dr.syntax
    def _kept_of(
        self, bsdf: mi.BSDF, si: mi.SurfaceInteraction3f, of_slot: tuple, active: mi.Bool
    ) -> tuple[mi.Vector3f, mi.Float]:
        """Draw the candidates of one BSDF, as `_kept`.

        What depends on the point alone, such as textures, is computed once in an iteration, as Dr.Jit finds equal
        expressions.
        """
        candidates, u, step, shift, chosen, pick = of_slot
        ctx, marks_failure = mi.BSDFContext(), _marks_failure(bsdf)
        at_once = (1, _AT_ONCE)[marks_failure]  # densities make kernels large
        omega, guess, sum_of_guesses = mi.Vector3f(0, 0, 1), mi.Float(0), mi.Float(0)
        candidate = mi.UInt32(0)
        while dr.hint(candidate < candidates, exclude=[self, bsdf, si, ctx, candidates, u, step, shift, pick, active]):
            for _ in range(at_once):
                position = dr.minimum(dr.fma(mi.Float(candidate), step, u), BELOW_ONE)
                # The direction alone is used.
                with gratings_left_out(marks_failure):
                    bs, _ = bsdf.sample(ctx, si, position, _lattice_point(position / step, shift), active)
                usable = active & ~mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
                usable &= (bs.wo.z != 0) if dr.hint(marks_failure, mode="scalar") else (bs.pdf > 0)
                h = dr.select(usable, self.light(si.p, si.to_world(bs.wo), usable), 0)
                sum_of_guesses += h
                # A single random number serves all decisions: given one of them, it is uniform after division.
                scaled = chosen * sum_of_guesses
                takes = scaled < h
                scaled = dr.select(takes, scaled / h, (scaled - h) / (sum_of_guesses - h))
                chosen = dr.select(h > 0, scaled, chosen)
                takes = dr.select(pick < candidates, candidate == pick, takes)
                omega, guess = dr.select(takes, bs.wo, omega), dr.select(takes, h, guess)
                candidate += 1
        return omega, dr.select(guess > 0, guess / sum_of_guesses, 0)


def _random(sequence: int) -> mi.Point3f:
    """Return `_DIRECTIONS` points in the unit cube, always the same for a sequence."""
    rng = mi.PCG32(size=_DIRECTIONS, initseq=sequence)
    return mi.Point3f(*(mi.Float(rng.next_float32()) for _ in range(3)))


def _points_of_instances(scene: mi.Scene, u: mi.Point3f) -> mi.Point3f:
    """Map points of the unit cube to the boxes around all instances, as Mitsuba does not draw points on them."""
    boxes = [shape.bbox() for shape in scene.shapes() if shape.class_name() == INSTANCE]
    low, high = (
        mi.Point3f(*map(on_device, np.array(corners).T))
        for corners in zip(*((box.min, box.max) for box in boxes), strict=True)
    )
    which = dr.arange(mi.UInt32, _DIRECTIONS) % len(boxes)
    low, high = (dr.gather(mi.Point3f, corner, which) for corner in (low, high))
    return low + (high - low) * u


def _marks_failure(bsdf: mi.BSDF) -> bool:
    """Return whether `sample` of a BSDF, where it fails, returns a direction in the surface, or one without any light.

    Then `pdf` is not needed. So do gratings, BSDFs of Mitsuba that perturb or flip the frame, and blends of parts that
    only reflect, in which a direction below the horizon has no value.
    """
    name, nested = bsdf.class_name(), parts(bsdf, mi.BSDF)
    if is_grating(bsdf) or name in (ROUGH_CONDUCTOR, DIFFUSE):
        return True
    if name == BLEND and bsdf.flags() & +mi.BSDFFlags.Transmission:
        return False
    return name in (TWO_SIDED, NORMAL_MAP, BUMP_MAP, BLEND) and all(map(_marks_failure, nested))


def _lattice_point(number: mi.Float, shift: mi.Point2f) -> mi.Point2f:
    """Return a point of the lattice with a random shift, in the unit square."""
    point = dr.floor(number) * mi.Point2f(_LATTICE) + shift
    return dr.minimum(point - dr.floor(point), BELOW_ONE)


def _has_narrow_lobes(spectrum: Spectrum) -> bool:
    """Return whether the wavelengths of a ray have lobes of their own: narrow ones, of orders."""
    is_continuum = isinstance(spectrum, GratingSpectrum) and not isinstance(spectrum.grid, OrderGrid)
    return not is_continuum and spectrum.lobe_width < MAX_NARROW_LOBE
