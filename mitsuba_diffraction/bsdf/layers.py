"""The layers of the material: the face of a coat, the grating, and its base; each gets a share of the samples."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..errors import RequestError
from .base import base_from
from .geometry import turned
from .grating import Grating
from .media import Media
from .polarisation import of_plane, reflected
from .tables import BELOW_ONE, smaller
from .transmission import Interface

LEAST_SHARE = 0.1  # of the samples, for the grating and for its base: what each reflects is only estimated


@dataclass(frozen=True)
class Asked:
    """What a request is for.

    Attributes:
        reflected, passed: light of the grating on its own side and on the other one.
        face: the coat's front face or the flat face of a sheet.
        below: what it asks of the base.
    """

    reflected: bool
    passed: bool
    face: bool
    below: mi.BSDFContext | None

    @property
    def grating(self) -> bool:
        """Whether it is for any light of the grating."""
        return self.reflected or self.passed


class Layers:
    """A grating over a base, under a coat.

    Attributes:
        coat: or None.
        grating: component 0.
        base: or None; its components follow that of the grating.
        components: the flags of all components: the grating, light that passes it, those of the base, and, as the last
            one, the front face of a coat or the flat face of a sheet.
    """

    def __init__(self, props: mi.Properties) -> None:
        media = Media.of(props)
        self.coat = media.coat
        self.grating = Grating(props, media)
        self.base = base_from(props)
        if self.base is not None and not self.grating.theory.material.transparent:
            raise RequestError("base: got a BSDF below a conductor or a perfect mirror, which let no light through")
        flags = mi.BSDFFlags.GlossyReflection | mi.BSDFFlags.Anisotropic | mi.BSDFFlags.FrontSide
        if self.grating.orientation.is_spatially_varying() or any(scale.varies for scale in self.grating.scales):
            flags = flags | mi.BSDFFlags.SpatiallyVarying
        self.components = [+flags, *(self.base.components if self.base is not None else [])]
        face = self.coat and mi.BSDFFlags.FrontSide
        if self.interface is not None:
            both = mi.BSDFFlags.FrontSide | mi.BSDFFlags.BackSide
            passes = (flags & ~+mi.BSDFFlags.GlossyReflection) | mi.BSDFFlags.GlossyTransmission | both
            self.components = [+(flags | both), +passes]
            if self.interface.has_flat_face:
                face = mi.BSDFFlags.BackSide
            if not self.interface.is_sheet:
                self.components[1] |= +mi.BSDFFlags.NonSymmetric
        self.face = len(self.components)
        if face:
            self.components.append(mi.BSDFFlags.DeltaReflection | face)

    @property
    def interface(self) -> Interface | None:
        """The media where light passes, as the parameters are now."""
        return self.grating.theory.interface

    def traverse(self, callback: mi.TraversalCallback) -> None:
        self.grating.traverse(callback)
        if self.base is not None:
            callback.put("base", self.base.bsdf, mi.ParamFlags.Differentiable)

    def _asked(self, ctx: mi.BSDFContext) -> Asked:
        return Asked(
            ctx.is_enabled(mi.BSDFFlags.GlossyReflection, 0),
            self.interface is not None and ctx.is_enabled(mi.BSDFFlags.GlossyTransmission, 1),
            len(self.components) > self.face and ctx.is_enabled(mi.BSDFFlags.DeltaReflection, self.face),
            None if self.base is None else self.base.context(ctx),
        )

    def _passing(self, si: mi.SurfaceInteraction3f, asked: Asked) -> mi.Float:
        """Return the share of the grating's samples on the other side, about as much as is transmitted."""
        if not asked.passed or not asked.reflected:
            return mi.Float(1.0 if asked.passed else 0.0)
        return dr.detach(self.interface.transmitted(turned(si.wi, *self.grating.frame(si, True))))

    def _share(
        self, si: mi.SurfaceInteraction3f, asked: Asked, entering: mi.UnpolarizedSpectrum | None, active: mi.Bool
    ) -> mi.Float:
        """Return the share of samples that the grating gets; that of the base is the rest. About as they reflect."""
        if not asked.grating or asked.below is None:
            return mi.Float(1.0 if asked.grating else 0.0)
        entered = dr.mean(entering)
        reflected = 1 - entered
        returned = entered * self.base.albedo(si, active)
        return dr.detach(dr.clip(reflected / (reflected + returned), LEAST_SHARE, 1 - LEAST_SHARE))

    def _face_share(self, si: mi.SurfaceInteraction3f, asked: Asked, active: mi.Bool) -> mi.Float:
        """Return the share of samples that a smooth face gets, about as it reflects beside all below."""
        if not asked.face:
            return mi.Float(0.0)
        cos = mi.Frame3f.cos_theta(si.wi)
        rest = asked.grating or asked.below is not None
        if self.coat is None:
            return dr.select(cos < 0, dr.detach(self._face(si)) if rest else mi.Float(1.0), 0)
        if not rest:
            return mi.Float(1.0)
        reflected = self.grating.theory.material(si, self.coat.cos_inside(cos), active)
        if asked.below is not None:
            reflected += (1 - reflected) * self.base.albedo(si, active)
        return self.coat.share(cos, dr.mean(reflected))

    def _face(self, si: mi.SurfaceInteraction3f) -> mi.Float:
        """Return F of the smooth face."""
        cos = mi.Frame3f.cos_theta(si.wi)
        return mi.fresnel(dr.abs(cos), self.interface.eta)[0] if self.coat is None else self.coat.reflectance(cos)

    def _above(self, cos: mi.Float) -> mi.Bool:
        """Return whether a direction is one from which light is scattered."""
        return cos > 0 if self.interface is None else cos != 0

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
        asked = self._asked(ctx)
        active = active & self._above(cos_i) & self._above(cos_o)
        if asked.reflected != asked.passed and self.interface is not None:
            active = active & ((cos_i * cos_o > 0) == asked.reflected)
        value, pdf = mi.Spectrum(0.0), mi.Float(0.0)
        if asked.grating:
            passing = self._passing(si, asked)
            of_grating, pdf = self.grating.evaluate(si, wo, active, wo_is_sample, passing)
            value = self.grating.mueller(of_grating, ctx, si, wo, active)
        if asked.below is not None:
            entering = self.grating.entering(si, cos_i, active)
            share = self._share(si, asked, entering, active)
            of_base, density = self.base.bsdf.eval_pdf(asked.below, si, wo, active)
            value += _attenuated(entering * self.grating.entering(si, cos_o, active), of_base)
            pdf = share * pdf + (1 - share) * density
        pdf *= 1 - self._face_share(si, asked, active)
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
        active = active & self._above(mi.Frame3f.cos_theta(si.wi))
        asked = self._asked(ctx)
        bs, result = dr.zeros(mi.BSDFSample3f), mi.Spectrum(0.0)
        bs.eta = 1.0
        face_share = self._face_share(si, asked, active)
        of_face = active & (sample1 < face_share)
        if asked.grating or asked.below is not None:
            # From behind and along the horizon the face reflects all; Python's numbers cannot be divided by zero.
            below_face = dr.select(face_share < 1, 1 - face_share, 1)
            rest = smaller((sample1 - face_share) / below_face, BELOW_ONE)
            bs, result = self._sample_below(
                ctx, si, asked, 1 - face_share, rest, sample2, active & (sample1 >= face_share)
            )
        if asked.face:
            bs.wo = dr.select(of_face, mi.reflect(si.wi), bs.wo)
            bs.pdf = dr.select(of_face, face_share, bs.pdf)
            bs.eta = dr.select(of_face, 1, bs.eta)
            bs.sampled_type = dr.select(of_face, mi.UInt32(+mi.BSDFFlags.DeltaReflection), bs.sampled_type)
            bs.sampled_component = dr.select(of_face, self.face, bs.sampled_component)
            mirrored = self._mirrored(si, ctx) / dr.select(of_face, face_share, 1)
            result = dr.select(of_face, mirrored, result)
        return bs, result

    def _mirrored(self, si: mi.SurfaceInteraction3f, ctx: mi.BSDFContext) -> mi.Spectrum:
        """Return what the smooth face reflects."""
        value = mi.UnpolarizedSpectrum(self._face(si))
        if not mi.is_polarized:
            return value
        eta = self.interface.eta if self.coat is None else self.coat.eta
        split = of_plane(value, [mi.Complex2f(eta, 0)] * len(value))
        return reflected(split, si.wi, mi.reflect(si.wi), ctx.mode)

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
        cos_i, below = mi.Frame3f.cos_theta(si.wi), asked.below
        bs = dr.zeros(mi.BSDFSample3f)
        bs.eta = 1.0
        bs.sampled_type = mi.UInt32(+mi.BSDFFlags.GlossyReflection)
        entering = self.grating.entering(si, cos_i, active) if below is not None else None
        share = self._share(si, asked, entering, active)
        of_base = active & (sample1 >= share)
        if asked.grating:
            passing = self._passing(si, asked)
            bs.wo = self.grating.sample(si, sample1 / share, sample2, active & (sample1 < share), passing)
        if asked.passed:
            passes = bs.wo.z * cos_i < 0
            bs.sampled_type = dr.select(passes, mi.UInt32(+mi.BSDFFlags.GlossyTransmission), bs.sampled_type)
            bs.sampled_component = dr.select(passes, mi.UInt32(1), 0)
            if not self.interface.is_sheet:
                eta = dr.detach(self.interface.eta)
                bs.eta = dr.select(passes, dr.select(cos_i > 0, eta, dr.rcp(eta)), 1)
        if below is not None:
            rest = smaller((sample1 - share) / (1 - share), BELOW_ONE)
            below_sample, weight = self.base.bsdf.sample(below, si, rest, sample2, of_base)
            bs.wo = dr.select(of_base, below_sample.wo, bs.wo)
            bs.sampled_type = dr.select(of_base, below_sample.sampled_type, bs.sampled_type)
            bs.sampled_component = dr.select(of_base, below_sample.sampled_component + 1, 0)
        value, bs.pdf = self.evaluate(ctx, si, bs.wo, active, wo_is_sample=True)
        valid = active & (bs.pdf > 0)
        # The direction does not follow the parameters, so its density must not either.
        result = dr.select(valid, value / dr.detach(dr.select(valid, bs.pdf, 1)), 0)
        if below is not None and self.base.has_delta:
            mirror = of_base & mi.has_flag(below_sample.sampled_type, mi.BSDFFlags.Delta)
            cos_o = mi.Frame3f.cos_theta(below_sample.wo)
            own = part * (1 - share)
            through = entering * self.grating.entering(si, cos_o, mirror) / own
            above = cos_o > 0
            bs.pdf = dr.select(mirror, dr.select(above, own * below_sample.pdf, 0), bs.pdf)
            result = dr.select(mirror, dr.select(above, _attenuated(through, weight), 0), result)
        return bs, result


def _attenuated(factor: mi.UnpolarizedSpectrum, value: mi.Spectrum) -> mi.Spectrum:
    """Return `value` (a Mueller matrix in polarised variants) times `factor`."""
    return mi.mueller.absorber(factor) @ value if mi.is_polarized else factor * value
