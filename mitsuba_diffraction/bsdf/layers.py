"""The layers of a surface: the face of a coat, the grating, and its base. A sample is drawn from one of them."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from .base import left_out
from .device_tables import BELOW_ONE, smaller
from .directions import Interface, rotated
from .grating import Grating
from .parameters import GratingRequest
from .polarisation import of_facets, reflected

MIN_LAYER_PROBABILITY = 0.1  # of sampling the grating, and its base, as their powers are only estimated


@dataclass(frozen=True)
class RequestedComponents:
    """The components requested by a context.

    Attributes:
        reflection, transmission: of the grating.
        face: the coat's front face or the flat face of a sheet.
        base: the context for the base; None if it is not requested.
    """

    reflection: bool
    transmission: bool
    face: bool
    base: mi.BSDFContext | None

    @property
    def grating(self) -> bool:
        """Whether a component of the grating is requested."""
        return self.reflection or self.transmission


class Layers:
    """A grating over a base, under a coat.

    Attributes:
        coat: or None.
        grating: component 0.
        base: or None; its components follow the component of the grating.
        components: the flags of all components, in this order: reflection and transmission of the grating; the
            components of the base; the front face of a coat or the flat face of a sheet.
    """

    def __init__(self, request: GratingRequest) -> None:
        self.coat, self.base = request.coat, request.base
        self.grating = Grating(request)
        flags = mi.BSDFFlags.GlossyReflection | mi.BSDFFlags.Anisotropic | mi.BSDFFlags.FrontSide
        varying = [*self.grating.scales, self.grating.theory.boundary]
        varies = self.grating.orientation.is_spatially_varying() or any(part.varies for part in varying)
        if varies or self.grating.from_radius:
            flags = flags | mi.BSDFFlags.SpatiallyVarying
        self.components = [+flags, *(self.base.components if self.base is not None else [])]
        face = self.coat and mi.BSDFFlags.FrontSide
        if self.interface.transmits:
            both = mi.BSDFFlags.FrontSide | mi.BSDFFlags.BackSide
            transmission = (flags & ~+mi.BSDFFlags.GlossyReflection) | mi.BSDFFlags.GlossyTransmission | both
            self.components = [+(flags | both), +transmission]
            if self.interface.has_flat_face:
                face = mi.BSDFFlags.BackSide
            if not self.interface.is_sheet:
                self.components[1] |= +mi.BSDFFlags.NonSymmetric
        self.face = len(self.components)
        if face:
            self.components.append(mi.BSDFFlags.DeltaReflection | face)

    @property
    def interface(self) -> Interface:
        """The media above and below the relief, for the current parameters."""
        return self.grating.interface

    def traverse(self, callback: mi.TraversalCallback) -> None:
        self.grating.traverse(callback)
        if self.base is not None:
            callback.put("base", self.base.bsdf, mi.ParamFlags.Differentiable)

    def parameters_changed(self, keys: list[str]) -> None:
        """Check the parameters `keys` and recompute what depends on them; without keys, all parameters."""
        if self.base is not None and (not keys or "base" in keys):
            self.base.check()
        self.grating.parameters_changed(keys)

    def _requested(self, ctx: mi.BSDFContext) -> RequestedComponents:
        return RequestedComponents(
            ctx.is_enabled(mi.BSDFFlags.GlossyReflection, 0),
            self.interface.transmits and ctx.is_enabled(mi.BSDFFlags.GlossyTransmission, 1),
            len(self.components) > self.face and ctx.is_enabled(mi.BSDFFlags.DeltaReflection, self.face),
            None if self.base is None else self.base.context(ctx),
        )

    def _transmission_probability(self, si: mi.SurfaceInteraction3f, requested: RequestedComponents) -> mi.Float:
        """Return the probability that a sample of the grating is transmitted, about its transmitted fraction."""
        if not requested.transmission or not requested.reflection:
            return mi.Float(1.0 if requested.transmission else 0.0)
        return dr.detach(self.interface.transmission_probability(rotated(si.wi, *self.grating.frame(si, True))))

    def _grating_probability(
        self,
        si: mi.SurfaceInteraction3f,
        requested: RequestedComponents,
        transmittance: mi.UnpolarizedSpectrum | None,
        active: mi.Bool,
    ) -> mi.Float:
        """Return the probability of sampling the grating instead of the base, about its fraction of the power."""
        if not requested.grating or requested.base is None:
            return mi.Float(1.0 if requested.grating else 0.0)
        entered = dr.mean(transmittance)
        reflected = 1 - entered
        assert self.base is not None
        returned = entered * self.base.albedo(si, active)
        return dr.detach(dr.clip(reflected / (reflected + returned), MIN_LAYER_PROBABILITY, 1 - MIN_LAYER_PROBABILITY))

    def _face_probability(
        self, si: mi.SurfaceInteraction3f, requested: RequestedComponents, active: mi.Bool
    ) -> mi.Float:
        """Return the probability of sampling the smooth face, about its fraction of the power."""
        if not requested.face:
            return mi.Float(0.0)
        cos = mi.Frame3f.cos_theta(si.wi)
        rest = requested.grating or requested.base is not None
        if self.coat is None:
            return dr.select(cos < 0, dr.detach(dr.mean(self._face(si))) if rest else mi.Float(1.0), 0)
        if not rest:
            return mi.Float(1.0)
        reflected = self.grating.reflectance(si, cos, active)
        if requested.base is not None and self.base is not None:
            reflected += (1 - reflected) * self.base.albedo(si, active)
        front = dr.mean(self.coat.reflectance(si, cos))
        return dr.detach(dr.clip(front / (front + dr.square(1 - front) * dr.mean(reflected)), 0, 1))

    def albedo(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.UnpolarizedSpectrum:
        """Return the reflectance of a plane of the material and of the diffuse base under it, as a guide of denoisers.

        It is one where light is transmitted. Diffraction, which moves light from one direction to another, is left out.
        """
        cos = mi.Frame3f.cos_theta(si.wi)
        if self.interface.transmits:
            return mi.UnpolarizedSpectrum(1.0)
        active = active & (cos > 0)
        reflected = self.grating.reflectance(si, cos, active)
        if self.coat is not None:
            front = self.coat.reflectance(si, cos)
            reflected = front + dr.square(1 - front) * reflected
        if self.base is not None:
            of_base = mi.unpolarized_spectrum(self.base.bsdf.eval_diffuse_reflectance(si, active))
            reflected += self.grating.transmittance(si, cos, active) * of_base
        return dr.select(active, dr.clip(reflected, 0, 1), 0)

    def _face_indices(self, si: mi.SurfaceInteraction3f) -> list[mi.Float]:
        """Return n behind the smooth face relative to that before it, at each wavelength."""
        if self.coat is not None:
            return self.coat.etas(si)
        return [self.interface.at_wavelength(wavelength).eta for wavelength in si.wavelengths]

    def _face(self, si: mi.SurfaceInteraction3f) -> mi.UnpolarizedSpectrum:
        """Return F of the smooth face."""
        cos = dr.abs(mi.Frame3f.cos_theta(si.wi))
        return mi.UnpolarizedSpectrum([mi.fresnel(cos, eta)[0] for eta in self._face_indices(si)])

    def eval_pdf(
        self,
        ctx: mi.BSDFContext,
        si: mi.SurfaceInteraction3f,
        wo: mi.Vector3f,
        active: mi.Bool,
        wo_is_sample: bool = False,
    ) -> tuple[mi.Spectrum, mi.Float]:
        """Return f cos θ_o and the density, as `mi.BSDF.eval_pdf`; `wo_is_sample` as in `Grating.value_and_density`."""
        if left_out.get():
            return mi.Spectrum(0.0), mi.Float(0.0)
        cos_i, cos_o = mi.Frame3f.cos_theta(si.wi), mi.Frame3f.cos_theta(wo)
        requested = self._requested(ctx)
        active = active & self.interface.is_incident(cos_i) & self.interface.is_incident(cos_o)
        if requested.reflection != requested.transmission and self.interface.transmits:
            active = active & ((cos_i * cos_o > 0) == requested.reflection)
        value, pdf = mi.Spectrum(0.0), mi.Float(0.0)
        if requested.grating:
            p_transmission = self._transmission_probability(si, requested)
            of_grating, pdf = self.grating.value_and_density(si, wo, active, wo_is_sample, p_transmission)
            value = self.grating.mueller(of_grating, ctx, si, wo, active)
        if requested.base is not None and self.base is not None:
            transmittance = self.grating.transmittance(si, cos_i, active)
            p_grating = self._grating_probability(si, requested, transmittance, active)
            of_base, density = self.base.bsdf.eval_pdf(requested.base, si, wo, active)
            value += _attenuated(transmittance * self.grating.transmittance(si, cos_o, active), of_base)
            pdf = p_grating * pdf + (1 - p_grating) * density
        pdf *= 1 - self._face_probability(si, requested, active)
        return dr.select(active, value, 0), dr.select(active, pdf, 0)

    def sample(
        self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, sample1: mi.Float, sample2: mi.Point2f, active: mi.Bool
    ) -> tuple[mi.BSDFSample3f, mi.Spectrum]:
        """Draw a direction, as `mi.BSDF.sample`."""
        active = active & self.interface.is_incident(mi.Frame3f.cos_theta(si.wi))
        requested = self._requested(ctx)
        bs, result = dr.zeros(mi.BSDFSample3f), mi.Spectrum(0.0)
        bs.eta = 1.0
        p_face = self._face_probability(si, requested, active)
        of_face = active & (sample1 < p_face)
        if requested.grating or requested.base is not None:
            # The face reflects all light from below and at the horizon.
            complement = dr.select(p_face < 1, 1 - p_face, 1)
            rest = smaller((sample1 - p_face) / complement, BELOW_ONE)
            bs, result = self._sample_below(ctx, si, requested, 1 - p_face, rest, sample2, active & (sample1 >= p_face))
        if requested.face:
            bs.wo = dr.select(of_face, mi.reflect(si.wi), bs.wo)
            bs.pdf = dr.select(of_face, p_face, bs.pdf)
            bs.eta = dr.select(of_face, 1, bs.eta)
            bs.sampled_type = dr.select(of_face, mi.UInt32(+mi.BSDFFlags.DeltaReflection), bs.sampled_type)
            bs.sampled_component = dr.select(of_face, self.face, bs.sampled_component)
            weight_of_face = self._face_matrix(si, ctx) / dr.select(of_face, p_face, 1)
            result = dr.select(of_face, weight_of_face, result)
        return bs, result

    def _face_matrix(self, si: mi.SurfaceInteraction3f, ctx: mi.BSDFContext) -> mi.Spectrum:
        """Return the specular reflectance of the smooth face, a Mueller matrix in polarised variants."""
        value = self._face(si)
        if not mi.is_polarized:
            return value
        etas = self._face_indices(si)

        def planes(cos_half: mi.Float, reflects: mi.Bool) -> list[mi.Matrix4f]:
            return [mi.mueller.specular_reflection(dr.abs(cos_half), mi.Complex2f(eta, 0)) for eta in etas]

        split = of_facets(value, planes, etas[0])
        return reflected(split, si.wi, mi.reflect(si.wi), ctx.mode)

    def _sample_below(
        self,
        ctx: mi.BSDFContext,
        si: mi.SurfaceInteraction3f,
        requested: RequestedComponents,
        probability: mi.Float,
        sample1: mi.Float,
        sample2: mi.Point2f,
        active: mi.Bool,
    ) -> tuple[mi.BSDFSample3f, mi.Spectrum]:
        """Draw a direction from the grating or its base; the face is not sampled with the probability `probability`."""
        cos_i, base_context = mi.Frame3f.cos_theta(si.wi), requested.base
        bs = dr.zeros(mi.BSDFSample3f)
        bs.eta = 1.0
        bs.sampled_type = mi.UInt32(+mi.BSDFFlags.GlossyReflection)
        transmittance = self.grating.transmittance(si, cos_i, active) if base_context is not None else None
        p_grating = self._grating_probability(si, requested, transmittance, active)
        of_base = active & (sample1 >= p_grating)
        if requested.grating:
            p_transmission = self._transmission_probability(si, requested)
            bs.wo = self.grating.sample(
                si, sample1 / p_grating, sample2, active & (sample1 < p_grating), p_transmission
            )
        if requested.transmission:
            transmitted = bs.wo.z * cos_i < 0
            bs.sampled_type = dr.select(transmitted, mi.UInt32(+mi.BSDFFlags.GlossyTransmission), bs.sampled_type)
            bs.sampled_component = dr.select(transmitted, mi.UInt32(1), 0)
            if not self.interface.is_sheet:
                eta = dr.detach(self.interface.eta)
                bs.eta = dr.select(transmitted, dr.select(cos_i > 0, eta, dr.rcp(eta)), 1)
        if base_context is not None and self.base is not None:
            rest = smaller((sample1 - p_grating) / (1 - p_grating), BELOW_ONE)
            base_sample, weight = self.base.bsdf.sample(base_context, si, rest, sample2, of_base)
            # A sample that fails has no direction.
            bs.wo = dr.select(of_base, dr.select(base_sample.pdf > 0, base_sample.wo, 0), bs.wo)
            bs.sampled_type = dr.select(of_base, base_sample.sampled_type, bs.sampled_type)
            bs.sampled_component = dr.select(of_base, base_sample.sampled_component + 1, 0)
        value, bs.pdf = self.eval_pdf(ctx, si, bs.wo, active, wo_is_sample=True)
        valid = active & (bs.pdf > 0)
        # Neither the direction nor its density is differentiated by the parameters.
        result = dr.select(valid, value / dr.detach(dr.select(valid, bs.pdf, 1)), 0)
        if base_context is not None and self.base is not None and self.base.has_delta:
            is_delta = of_base & mi.has_flag(base_sample.sampled_type, mi.BSDFFlags.Delta)
            cos_o = mi.Frame3f.cos_theta(base_sample.wo)
            base_probability = probability * (1 - p_grating)
            throughput = transmittance * self.grating.transmittance(si, cos_o, is_delta) / base_probability
            above = cos_o > 0
            bs.pdf = dr.select(is_delta, dr.select(above, base_probability * base_sample.pdf, 0), bs.pdf)
            result = dr.select(is_delta, dr.select(above, _attenuated(throughput, weight), 0), result)
        return bs, result


def _attenuated(factor: mi.UnpolarizedSpectrum, value: mi.Spectrum) -> mi.Spectrum:
    """Return `value` (a Mueller matrix in polarised variants) times `factor`."""
    return mi.mueller.absorber(factor) @ value if mi.is_polarized else factor * value
