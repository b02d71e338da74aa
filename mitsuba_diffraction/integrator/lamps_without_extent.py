"""Light of lamps without extent at the first grating from the eye, at wavelengths that are drawn for it.

Only a light sample finds a directional, point or spot light. The directions are given, so that a lobe of a grating has
light of a few nanometres, and seldom at one of the four wavelengths of a ray. At the first vertex from the eye nothing
depends on the wavelengths yet. There one of these lamps is drawn, with the probability P, beside the sample of another
light, and is evaluated at K = 16 wavelengths, each from another K-th of the sensor's distribution, with the weight w of
the sensor:

    v_k = w(λ_k) f(λ_k) |cos θ| E(λ_k) 4/(K P)

Beside all other light at the four wavelengths of the ray, the film receives four of these values. With V their sum and
ξ a random number, these are the ones in whose part of the sum, in order of the wavelengths, ξ V/4, (1 + ξ) V/4,
(2 + ξ) V/4 and (3 + ξ) V/4 lie (systematic resampling, Kitagawa 1996). Each counts V/4. A value v is thus kept v/(V/4)
times in the mean, and the expectation of each channel of the film is unchanged.
"""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..bsdf.device_tables import BELOW_ONE, on_device, opaque, smaller
from .scene_cache import SceneCache

_PACKETS = 4  # K/4


class LampsWithoutExtent:
    """The lamps without extent of a scene.

    Attributes:
        any: whether the scene draws any.
    """

    def __init__(self, scene: mi.Scene, sensor: mi.Sensor, cache: SceneCache) -> None:
        flags = np.array([emitter.flags() for emitter in scene.emitters()])
        # Light samples do not find a surface that emits in one direction, `directionalarea`.
        is_lamp = (flags & +mi.EmitterFlags.Delta > 0) & (flags & +mi.EmitterFlags.Surface == 0)
        self._lamps = cache.once("lamps without extent", lambda: Emitters(scene, is_lamp))
        self._others = cache.once("other emitters", lambda: Emitters(scene, ~is_lamp))
        self.sensor, self.any = sensor, self._lamps.any

    @dr.syntax
    def light(
        self, scene: mi.Scene, sampler: mi.Sampler, si: mi.SurfaceInteraction3f, active: mi.Bool
    ) -> tuple[mi.Spectrum, mi.Spectrum]:
        """Return four wavelengths in nm, and the values of lamps at a point there."""
        ctx, bsdf, nowhere = mi.BSDFContext(), si.bsdf(), dr.zeros(mi.SurfaceInteraction3f)
        point, shift, number = sampler.next_2d(active), sampler.next_1d(active), sampler.next_1d(active)
        ds, _ = scene.sample_emitter_direction(si, self._lamps.of(point, active), True, active)
        wo = si.to_local(ds.d)
        reached = active & ds.delta & (ds.pdf > 0)
        wavelengths = [mi.Spectrum(0) for _ in range(_PACKETS)]
        values = [mi.Spectrum(0) for _ in range(_PACKETS)]
        packet = mi.UInt32(0)
        while dr.hint(
            reached & (packet < _PACKETS), exclude=[self, ctx, bsdf, nowhere, si, ds, point, shift, wo, reached]
        ):
            # Four wavelengths, each from a quarter of the distribution.
            drawn, weight = self.sensor.sample_wavelengths(nowhere, (mi.Float(packet) + shift) / (4 * _PACKETS))
            other = mi.SurfaceInteraction3f(si)
            other.wavelengths = drawn
            value = bsdf.eval(ctx, other, wo, reached)
            lit = reached & dr.any(value != 0)
            # Not `eval_direction`, which `directionalarea` lacks, and for which a projector lights all around.
            value *= weight * ds.emitter.sample_direction(other, point, lit)[1]
            for k in range(_PACKETS):
                wavelengths[k] = mi.Spectrum(dr.select(packet == k, drawn, wavelengths[k]))
                values[k] = mi.Spectrum(dr.select(lit & (packet == k), value, values[k]))
            packet += 1
        in_order = [(wavelengths[k][j], values[k][j]) for j in range(4) for k in range(_PACKETS)]
        kept, value = resampled(in_order, number)
        # The scene draws one of all emitters.
        probability = ds.pdf / self._lamps.probability
        return kept, dr.select(reached, value / (_PACKETS * probability), 0)

    def others(self, point: mi.Point2f, active: mi.Bool) -> tuple[mi.Point2f, mi.Float, mi.Bool]:
        """Return numbers for which the scene draws another emitter, its probability to do so, and if there is one."""
        if not self._others.any:
            return point, mi.Float(1), ~active
        drawn = dr.select(active, self._others.of(point, active), point)
        return drawn, dr.select(active, self._others.probability, 1), mi.Bool(True)


class Emitters:
    """Some emitters of a scene, drawn with the probabilities of the scene.

    Args:
        chosen: which ones, of all.

    Attributes:
        any: whether the scene draws any of them: not those whose `sampling_weight` is zero.
        probability: that the scene draws one of them.
    """

    def __init__(self, scene: mi.Scene, chosen: NDArray[np.bool_]) -> None:
        count = chosen.size
        # A single number where all are equal.
        all_of_them = np.full(count, scene.pdf_emitter(dr.arange(mi.UInt32, count)), np.float64)
        probabilities = all_of_them[chosen]
        self.any = bool(probabilities.any())
        if not self.any:
            return
        self.probability = opaque(probabilities.sum())
        self._choice = mi.DiscreteDistribution(on_device(probabilities))
        self._first = on_device((np.cumsum(all_of_them) - all_of_them)[chosen])
        self._range = on_device(probabilities)

    def of(self, point: mi.Point2f, active: mi.Bool) -> mi.Point2f:
        """Return the numbers for which `sample_emitter_direction` of the scene draws one of them."""
        index, rest = self._choice.sample_reuse(point.x, active)
        first, extent = dr.gather(mi.Float, self._first, index, active), dr.gather(mi.Float, self._range, index, active)
        return mi.Point2f(smaller(dr.fma(rest, extent, first), BELOW_ONE), point.y)


def resampled(samples: Sequence[tuple[mi.Float, mi.Float]], number: mi.Float) -> tuple[mi.Spectrum, mi.Spectrum]:
    """Keep four of any number of wavelengths and values by systematic resampling."""
    of_each = sum(value for _, value in samples) / 4
    kept, before = [samples[0][0]] * 4, mi.Float(0)
    for wavelength, value in samples:
        for i in range(4):
            kept[i] = dr.select((value > 0) & (before <= (number + i) * of_each), wavelength, kept[i])
        before += value
    return mi.Spectrum(kept), mi.Spectrum(of_each)
