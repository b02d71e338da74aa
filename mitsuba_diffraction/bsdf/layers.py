"""The layers of the material: the face of a coat, the grating, and its base; each gets a share of the samples."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..errors import RequestError
from .base import base_from
from .coat import coat_from
from .grating import Grating
from .polarisation import of_plane, reflected
from .tables import BELOW_ONE, smaller

LEAST_SHARE = 0.1  # of the samples, for the grating and for its base: what each reflects is only estimated

Asked = tuple[bool, "mi.BSDFContext | None"]
"""Whether a request is for the grating, and what it asks of the base."""


class Layers:
    """A grating over a base, under a coat.

    Attributes:
        coat: or None.
        grating: component 0.
        base: or None; its components follow that of the grating.
        components: the flags of all components; the front face of the coat is the last one.
    """

    def __init__(self, props: mi.Properties) -> None:
        self.coat = coat_from(props)
        self.grating = Grating(props, self.coat)
        self.base = base_from(props)
        if self.base is not None and not self.grating.theory.material.transparent:
            raise RequestError("base: got a BSDF below a conductor or a perfect mirror, which let no light through")
        flags = mi.BSDFFlags.GlossyReflection | mi.BSDFFlags.Anisotropic | mi.BSDFFlags.FrontSide
        if self.grating.orientation.is_spatially_varying():
            flags = flags | mi.BSDFFlags.SpatiallyVarying
        self.components = [+flags, *(self.base.components if self.base is not None else [])]
        self.front = len(self.components)
        if self.coat is not None:
            self.components.append(mi.BSDFFlags.DeltaReflection | mi.BSDFFlags.FrontSide)

    def traverse(self, callback: mi.TraversalCallback) -> None:
        self.grating.traverse(callback)
        if self.base is not None:
            callback.put("base", self.base.bsdf, mi.ParamFlags.Differentiable)

    def _asked(self, ctx: mi.BSDFContext) -> Asked:
        grating = ctx.is_enabled(mi.BSDFFlags.GlossyReflection, 0)
        return grating, None if self.base is None else self.base.context(ctx, before=1)

    def _share(
        self, si: mi.SurfaceInteraction3f, asked: Asked, entering: mi.UnpolarizedSpectrum | None, active: mi.Bool
    ) -> mi.Float:
        """Return the share of samples that the grating gets; that of the base is the rest. About as they reflect."""
        grating, below = asked
        if not grating or below is None:
            return mi.Float(1.0 if grating else 0.0)
        entered = dr.mean(entering)
        reflected = 1 - entered
        returned = entered * self.base.albedo(si, active)
        return dr.detach(dr.clip(reflected / (reflected + returned), LEAST_SHARE, 1 - LEAST_SHARE))

    def _front_share(self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, asked: Asked, active: mi.Bool) -> mi.Float:
        """Return the share of samples that the coat's front face gets, about as it reflects beside all below."""
        if self.coat is None or not ctx.is_enabled(mi.BSDFFlags.DeltaReflection, self.front):
            return mi.Float(0.0)
        grating, below = asked
        if not grating and below is None:
            return mi.Float(1.0)
        cos = mi.Frame3f.cos_theta(si.wi)
        reflected = self.grating.theory.material(si, self.coat.cos_inside(cos), active)
        if below is not None:
            reflected += (1 - reflected) * self.base.albedo(si, active)
        return self.coat.share(cos, dr.mean(reflected))

    def evaluate(
        self,
        ctx: mi.BSDFContext,
        si: mi.SurfaceInteraction3f,
        wo: mi.Vector3f,
        active: mi.Bool,
        wo_is_sample: bool = False,
    ) -> tuple[mi.Spectrum, mi.Float]:
        """Evaluate f cos θ_o and the density, as `mi.BSDF.eval_pdf`; `wo_is_sample` as of `Grating.evaluate`."""
        cos_i, cos_o = mi.Frame3f.cos_theta(si.wi), mi.Frame3f.cos_theta(wo)
        active = active & (cos_i > 0) & (cos_o > 0)
        asked = grating, below = self._asked(ctx)
        value, pdf = mi.Spectrum(0.0), mi.Float(0.0)
        if grating:
            of_grating, pdf = self.grating.evaluate(si, wo, active, wo_is_sample)
            value = self.grating.mueller(of_grating, ctx, si, wo, active)
        if below is not None:
            entering = self.grating.entering(si, cos_i, active)
            share = self._share(si, asked, entering, active)
            of_base, density = self.base.bsdf.eval_pdf(below, si, wo, active)
            value += _attenuated(entering * self.grating.entering(si, cos_o, active), of_base)
            pdf = share * pdf + (1 - share) * density
        pdf *= 1 - self._front_share(ctx, si, asked, active)
        return dr.select(active, value, 0), dr.select(active, pdf, 0)

    def sample(
        self,
        ctx: mi.BSDFContext,
        si: mi.SurfaceInteraction3f,
        sample1: mi.Float,
        sample2: mi.Point2f,
        active: mi.Bool,
    ) -> tuple[mi.BSDFSample3f, mi.Spectrum]:
        """Draw a direction, as `mi.BSDF.sample`."""
        cos_i = mi.Frame3f.cos_theta(si.wi)
        active = active & (cos_i > 0)
        asked = grating, below = self._asked(ctx)
        bs, result = dr.zeros(mi.BSDFSample3f), mi.Spectrum(0.0)
        front_share = self._front_share(ctx, si, asked, active)
        of_front = active & (sample1 < front_share)
        if grating or below is not None:
            # From behind and along the horizon the front reflects all; Python's numbers cannot be divided by zero.
            below_front = dr.select(front_share < 1, 1 - front_share, 1)
            rest = smaller((sample1 - front_share) / below_front, BELOW_ONE)
            bs, result = self._sample_below(
                ctx, si, asked, 1 - front_share, rest, sample2, active & (sample1 >= front_share)
            )
        elif self.coat is None or not ctx.is_enabled(mi.BSDFFlags.DeltaReflection, self.front):
            return bs, result
        bs.eta = 1.0
        if self.coat is not None:
            bs.wo = dr.select(of_front, mi.reflect(si.wi), bs.wo)
            bs.pdf = dr.select(of_front, front_share, bs.pdf)
            bs.sampled_type = dr.select(of_front, mi.UInt32(+mi.BSDFFlags.DeltaReflection), bs.sampled_type)
            bs.sampled_component = dr.select(of_front, self.front, bs.sampled_component)
            mirrored = self._mirrored(si, ctx) / dr.select(of_front, front_share, 1)
            result = dr.select(of_front, mirrored, result)
        return bs, result

    def _mirrored(self, si: mi.SurfaceInteraction3f, ctx: mi.BSDFContext) -> mi.Spectrum:
        """Return F of the coat's front face."""
        value = mi.UnpolarizedSpectrum(self.coat.reflectance(mi.Frame3f.cos_theta(si.wi)))
        if not mi.is_polarized:
            return value
        return reflected(of_plane(value, self.coat.indices()), si.wi, mi.reflect(si.wi), ctx.mode)

    def _sample_below(
        self,
        ctx: mi.BSDFContext,
        si: mi.SurfaceInteraction3f,
        asked: Asked,
        part: mi.Float,
        sample1: mi.Float,
        sample2: mi.Point2f,
        active: mi.Bool,
    ) -> tuple[mi.BSDFSample3f, mi.Spectrum]:
        """Draw a direction from the grating or its base, which get `part` of all samples."""
        grating, below = asked
        cos_i = mi.Frame3f.cos_theta(si.wi)
        bs = dr.zeros(mi.BSDFSample3f)
        bs.sampled_type = mi.UInt32(+mi.BSDFFlags.GlossyReflection)
        entering = self.grating.entering(si, cos_i, active) if below is not None else None
        share = self._share(si, asked, entering, active)
        of_base = active & (sample1 >= share)
        if grating:
            bs.wo = self.grating.sample(si, sample1 / share, sample2, active & (sample1 < share))
        if below is not None:
            rest = smaller((sample1 - share) / (1 - share), BELOW_ONE)
            drawn, weight = self.base.bsdf.sample(below, si, rest, sample2, of_base)
            bs.wo = dr.select(of_base, drawn.wo, bs.wo)
            bs.sampled_type = dr.select(of_base, drawn.sampled_type, bs.sampled_type)
            bs.sampled_component = dr.select(of_base, drawn.sampled_component + 1, 0)
        value, bs.pdf = self.evaluate(ctx, si, bs.wo, active, wo_is_sample=True)
        valid = active & (bs.pdf > 0)
        # The direction does not follow the parameters, so its density must not either.
        result = dr.select(valid, value / dr.detach(dr.select(valid, bs.pdf, 1)), 0)
        if below is not None and self.base.has_delta:
            mirror = of_base & mi.has_flag(drawn.sampled_type, mi.BSDFFlags.Delta)
            cos_o = mi.Frame3f.cos_theta(drawn.wo)
            own = part * (1 - share)
            through = entering * self.grating.entering(si, cos_o, mirror) / own
            above = cos_o > 0
            bs.pdf = dr.select(mirror, dr.select(above, own * drawn.pdf, 0), bs.pdf)
            result = dr.select(mirror, dr.select(above, _attenuated(through, weight), 0), result)
        return bs, result

    def __str__(self) -> str:
        return str(self.grating)


def _attenuated(factor: mi.UnpolarizedSpectrum, value: mi.Spectrum) -> mi.Spectrum:
    """Return `value` (a Mueller matrix in polarised variants) times `factor`."""
    return mi.mueller.absorber(factor) @ value if mi.is_polarized else factor * value
