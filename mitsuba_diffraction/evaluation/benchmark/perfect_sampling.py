"""Sampling that no table can surpass: directions drawn in proportion to f cos θ_o at the four wavelengths of a ray."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from ...bsdf.base import gratings_in
from ...bsdf.layers import Layers

_CANDIDATES = 32


def sample_perfectly(scene: mi.Scene) -> None:
    """Make the gratings of a scene draw directions with nearly that density; for measurements, as it takes long."""
    for grating in {grating for shape in scene.shapes() for grating in gratings_in(shape.bsdf())}:
        grating.layers = _Resampled(grating.layers)


class _Resampled:
    """Layers of a grating, of whose own directions one of several is chosen in proportion to its mean weight.

    The density of the choice tends to mean_λ(f cos θ_o) / R with the number of candidates, R = ∫ mean_λ(f cos θ_o) dω
    (resampling, Talbot 2005). R is estimated by the mean of the candidates' weights.
    """

    def __init__(self, layers: Layers) -> None:
        self._layers = layers

    def __getattr__(self, name: str) -> Any:
        return getattr(self._layers, name)

    def evaluate(
        self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool
    ) -> tuple[mi.Spectrum, mi.Float]:
        """Evaluate f cos θ_o and the density, as `mi.BSDF.eval_pdf`."""
        value, _ = self._layers.evaluate(ctx, si, wo, active)
        _, _, total = self._choose(ctx, si, _random_numbers(wo.x, wo.y), active)
        return value, dr.select(total > 0, dr.mean(value) / total, 0)

    def sample(
        self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, sample1: mi.Float, sample2: mi.Point2f, active: mi.Bool
    ) -> tuple[mi.BSDFSample3f, mi.Spectrum]:
        """Draw a direction, as `mi.BSDF.sample`."""
        bs, weight, total = self._choose(ctx, si, _random_numbers(sample1, sample2.x), active)
        mean = dr.mean(weight)
        valid = active & (mean > 0)
        bs.pdf = dr.select(valid, bs.pdf * mean / total, 0)
        return bs, dr.select(valid, weight * total / mean, 0)

    @dr.syntax
    def _choose(
        self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, rng: mi.PCG32, active: mi.Bool
    ) -> tuple[mi.BSDFSample3f, mi.Spectrum, mi.Float]:
        """Return the direction that is chosen, its weight, and the mean over the candidates of their mean weights."""
        chosen, chosen_weight, total = dr.zeros(mi.BSDFSample3f), mi.Spectrum(0), mi.Float(0)
        number = mi.UInt32(0)
        while number < _CANDIDATES:
            sample1, sample2 = rng.next_float32(), mi.Point2f(rng.next_float32(), rng.next_float32())
            bs, weight = self._layers.sample(ctx, si, sample1, sample2, active)
            mean = dr.mean(weight)
            total += mean
            takes = rng.next_float32() * total < mean
            chosen = dr.select(takes, bs, chosen)
            chosen_weight = dr.select(takes, weight, chosen_weight)
            number += 1
        return chosen, chosen_weight, total / _CANDIDATES


def _random_numbers(first: mi.Float, second: mi.Float) -> mi.PCG32:
    """Return random numbers that depend on two numbers."""
    state, sequence = mi.sample_tea_32(
        dr.reinterpret_array(mi.UInt32, mi.Float(first)), dr.reinterpret_array(mi.UInt32, mi.Float(second))
    )
    return mi.PCG32(initstate=mi.UInt64(state), initseq=mi.UInt64(sequence))
