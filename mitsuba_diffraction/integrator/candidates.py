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

The first number of `sample` is stratified over all candidates, so that each slot has its own wavelength and each
candidate its order, whatever the BSDF; the other two follow a lattice with a random shift. Delta components are never
kept. Their light, and the path, are continued by an ordinary sample (`EyePaths`), which does not count other emitters.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..bsdf.base import gratings_in
from ..bsdf.device_tables import BELOW_ONE, opaque
from ..precomputation.spectra import Spectrum
from ..rigorous.rigorous_spectrum import RigorousSpectrum
from ..spectrum.grids import OrderGrid
from .unshadowed_light import UnshadowedLight

CANDIDATES = 16  # M
SLOTS, SLOTS_OF_CONTINUA = 4, 1  # J
DEFENSIVE_FRACTION = 0.1  # β
MIN_GAIN = 6.0  # of h by light samples over that in all directions, from which candidates are drawn
MIN_SEPARATION = 4.0  # of orders, in standard deviations of their lobes, from which each wavelength has its own slot
_DIRECTIONS = 2**15  # for this comparison
# Of a lattice with low discrepancy in two dimensions: 1/g and 1/g², g³ = g + 1.
_LATTICE = (0.7548776662466927, 0.5698402909980532)


class Candidates:
    """Direct light at the gratings of a scene.

    Attributes:
        light: h.
    """

    def __init__(self, scene: mi.Scene, shapes: list[mi.Shape]) -> None:
        self.light = UnshadowedLight(scene)
        slots = [self._slots(scene, shape) for shape in shapes]
        self.any = any(slots)
        ids = [dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape))[0] for shape in shapes]
        self._size = dr.opaque(mi.UInt32, max(ids, default=0) + 1)
        table = np.zeros(max(ids, default=0) + 1, np.uint32)
        table[ids] = slots
        self._table = mi.UInt32(table)
        self._count, self._fraction = dr.opaque(mi.UInt32, CANDIDATES), opaque(DEFENSIVE_FRACTION)

    def _slots(self, scene: mi.Scene, shape: mi.Shape) -> int:
        """Return J of a shape, zero where lights are about as bright in all directions."""
        if not self.light.has_extent:
            return 0
        rng = mi.PCG32(size=_DIRECTIONS)

        def number() -> mi.Float:
            return mi.Float(rng.next_float32())

        at = shape.sample_position(0.0, mi.Point2f(number(), number()))
        si = mi.SurfaceInteraction3f(at, dr.zeros(mi.Spectrum))
        drawn, _ = scene.sample_emitter_direction(si, mi.Point2f(number(), number()), False)
        has_extent = (drawn.pdf > 0) & ~drawn.delta
        anywhere = mi.warp.square_to_uniform_sphere(mi.Point2f(number(), number()))
        of_lights = dr.sum(dr.select(has_extent, self.light(at.p, drawn.d, True), 0)) / dr.maximum(
            dr.count(has_extent), 1
        )
        if float(of_lights[0]) < MIN_GAIN * float(dr.mean(self.light(at.p, anywhere, True))[0]):
            return 0
        separate = all(_separates_orders(grating.spectrum) for grating in gratings_in(shape.bsdf()))
        return SLOTS if separate else SLOTS_OF_CONTINUA

    def slots(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.UInt32:
        """Return J at a point, zero where no candidates are drawn."""
        shape_id = dr.reinterpret_array(mi.UInt32, si.shape)
        return dr.gather(mi.UInt32, self._table, shape_id, active & (shape_id < self._size))

    def relative_density(self, slots: mi.UInt32) -> mi.Float:
        """Return c J."""
        return mi.Float(slots * self._count)

    @dr.syntax
    def sample(
        self,
        scene: mi.Scene,
        sampler: mi.Sampler,
        si: mi.SurfaceInteraction3f,
        bsdf: mi.BSDFPtr,
        slots: mi.UInt32,
        active: mi.Bool,
    ) -> mi.Spectrum:
        """Return the light of all slots, the first sum above."""
        ctx, result = mi.BSDFContext(), mi.Spectrum(0)
        active = mi.Bool(active)
        shift, jitter = sampler.next_2d(active), sampler.next_1d(active)
        count, total = mi.Float(self._count), mi.Float(slots * self._count)
        slot, number = mi.UInt32(0), mi.UInt32(0)
        while active & (slot < slots):
            chosen, uniform = sampler.next_1d(active), sampler.next_1d(active)
            is_uniform = sampler.next_1d(active) < self._fraction
            pick = mi.UInt32(uniform * count)
            omega, guess, sum_of_guesses = mi.Vector3f(0, 0, 1), mi.Float(0), mi.Float(0)
            candidate = mi.UInt32(0)
            while candidate < self._count:
                u = dr.minimum((mi.Float(number) + jitter) / total, BELOW_ONE)
                bs, _ = bsdf.sample(ctx, si, u, _lattice_point(number, shift), active)
                usable = active & (bs.pdf > 0) & ~mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
                h = dr.select(usable, self.light(si.p, si.to_world(bs.wo), usable), 0)
                sum_of_guesses += h
                # A single random number serves all decisions: given one of them, it is uniform after division.
                takes = chosen * sum_of_guesses < h
                rest = chosen * sum_of_guesses
                rest = dr.select(takes, rest / h, (rest - h) / (sum_of_guesses - h))
                chosen = dr.select(h > 0, rest, chosen)
                takes = dr.select(is_uniform, candidate == pick, takes)
                omega, guess = dr.select(takes, bs.wo, omega), dr.select(takes, h, guess)
                candidate += 1
                number += 1
            fraction = guess / sum_of_guesses
            weight = 1 / (dr.fma(count * fraction, 1 - self._fraction, self._fraction))
            kept = active & (guess > 0)
            value, pdf = bsdf.eval_pdf(ctx, si, omega, kept)
            kept &= dr.any(value != 0)
            ray = si.spawn_ray(si.to_world(omega))
            found = scene.ray_intersect(ray, kept)
            ds = mi.DirectionSample3f(scene, found, si)
            pdf_emitter = scene.pdf_emitter_direction(si, ds, kept)
            emitted = ds.emitter.eval(found, kept)
            weight *= count / dr.fma(total, pdf, pdf_emitter)
            result += dr.select(kept, value * emitted * weight, 0)
            slot += 1
        return result


def _lattice_point(number: mi.UInt32, shift: mi.Point2f) -> mi.Point2f:
    """Return a point of the lattice with a random shift, in the unit square."""
    point = mi.Float(number) * mi.Point2f(_LATTICE) + shift
    return dr.minimum(point - dr.floor(point), BELOW_ONE)


def _separates_orders(spectrum: Spectrum) -> bool:
    """Return whether the wavelengths of a ray have lobes of their own: orders are separate along an axis at least."""
    if isinstance(spectrum, RigorousSpectrum):
        periods = [spectrum.axes.period]
    elif isinstance(spectrum.grid, OrderGrid):
        grid = spectrum.grid
        periods = [period for period, m in zip(grid.tile_size, grid.max_order, strict=True) if m > 0]
    else:
        periods = []
    return any(1 / period > MIN_SEPARATION * spectrum.lobe_width for period in periods)
