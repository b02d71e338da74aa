"""The light that a grating diffracts, at the wavelengths of a ray: its value, its density, its samples."""

from __future__ import annotations

import functools

import drjit as dr
import mitsuba as mi
import numpy as np

from ..errors import RequestError
from .geometry import Geometry, Incidence, Interface, turned
from .parameters import Media, Scales, check_texture, surface_from
from .polarisation import reflected, through_layer
from .tables import BELOW_ONE, larger, limited, opaque, smaller
from .theory import Scattering, theory_of

# The probability of uniform samples, for lobes that the sampler's averages miss; where both directions graze, K G grows
# faster than samples that follow the cosine could bear.
UNIFORM_PROBABILITY = 0.02


class Grating:
    """A spectrum on a surface, with its theory, between media.

    Attributes:
        spectrum: of the surface.
        recipe: behind the spectrum; None for a saved one.
        theory: R, E and what else multiplies the powers of orders.
        coat: over the grating, or None.
        scales: of heights and of lengths along the surface; of rigorous theory one.
        orientation: degrees from the tangent to the pattern's x axis.
    """

    def __init__(self, props: mi.Properties, media: Media) -> None:
        self.coat = media.coat
        self.scales = Scales(props)
        self.spectrum, self.recipe = surface_from(props, media, self.scales.max_scale)
        self.theory = theory_of(props, self.spectrum, media, self.scales)
        angle = props.get("orientation", 0.0)
        if isinstance(angle, float) and not np.isfinite(angle):
            raise RequestError(f"orientation: got {angle}, wanted degrees or a texture")
        self.orientation = props.get_texture("orientation", 0.0)
        check_texture("orientation", self.orientation)
        # The spectrum says nothing outside of its largest angle: there the grating is black.
        self.min_cosine = opaque(np.cos(np.deg2rad(self.spectrum.largest_angle)) * (1 - 1e-6))

    @property
    def scattering(self) -> Scattering:
        """K G S cos θ_o and its sampler."""
        return self.theory.scattering

    @property
    def interface(self) -> Interface:
        """The media above and below, as the parameters are now."""
        return self.theory.interface

    def traverse(self, callback: mi.TraversalCallback) -> None:
        callback.put("orientation", self.orientation, mi.ParamFlags.Differentiable)
        self.theory.traverse(callback)

    def frame(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> tuple[mi.Float, mi.Float]:
        """Return sine and cosine of the angle from the tangent to the pattern's x axis."""
        return dr.sincos(dr.deg2rad(self.orientation.eval_1(si, active)))

    @dr.syntax
    def evaluate(
        self,
        si: mi.SurfaceInteraction3f,
        wo: mi.Vector3f,
        active: mi.Bool,
        wo_is_sample: bool,
        transmission_probability: mi.Float,
    ) -> tuple[mi.UnpolarizedSpectrum, mi.Float]:
        """Evaluate f cos θ_o of light from ω_o, and the density of `sample`.

        Under a coat, without the transmittances of its front face.

        Args:
            si: the point, with ω_i.
            wo: ω_o.
            active: mask; both directions lie above the surface, or light is transmitted.
            wo_is_sample: whether ω_o was drawn, so that nearly always it lies in the lobe of an order.
            transmission_probability: of samples.
        """
        sin, cos = self.frame(si, active)
        # From here on along the pattern's axes.
        wi, wo = turned(si.wi, sin, cos), turned(wo, sin, cos)
        k_i, k_o = self.interface.wave_vector(wi), self.interface.wave_vector(wo)
        u, v = -k_i.tangent - k_o.tangent
        outside = dr.abs(mi.Frame3f.cos_theta(wo)) * dr.square(k_o.index)
        of_side = dr.select(k_i.sign == k_o.sign, 1 - transmission_probability, transmission_probability)
        covered, si = self._covered(si)
        count = _count(covered)
        value, density = mi.UnpolarizedSpectrum(0.0), mi.Float(0.0)
        height_scale, lateral_scale = self.scales.at(si, active)
        near = mi.UInt32(0)
        for channel, seen in enumerate(covered):
            frequency = lateral_scale * dr.rcp(self._wavelength(si, channel))
            seen &= self.scattering.meets(u * frequency, v * frequency, lateral_scale)
            near |= dr.select(active & seen, mi.UInt32(1 << channel), 0)
        # Most directions lie between the orders of a grating at all wavelengths: unless drawn, they skip what follows.
        needed = near != 0 if self.scattering.resolved and not wo_is_sample else True
        # What has no derivative is bound here: Dr.Jit carries all other state through the branch.
        diffracted = functools.partial(self._diffracted, si, near, active)
        if needed:
            value, density = diffracted(wi, wo, height_scale, lateral_scale)
        # The mean over the covered wavelengths: any of them may have chosen the direction.
        uniform = _uniform_probability(count)
        density = (1 - uniform) * density * outside / larger(count, 1)
        return value, of_side * dr.fma(uniform, dr.inv_two_pi, density)

    def _wavelength(self, si: mi.SurfaceInteraction3f, channel: int) -> mi.Float:
        """Return λ in the medium above, µm."""
        return si.wavelengths[channel] * (1e-3 / self.theory.media.outside)

    def _diffracted(
        self,
        si: mi.SurfaceInteraction3f,
        near: mi.UInt32,
        active: mi.Bool,
        wi: mi.Vector3f,
        wo: mi.Vector3f,
        height_scale: mi.Float,
        lateral_scale: mi.Float,
    ) -> tuple[mi.UnpolarizedSpectrum, mi.Float]:
        """Return f cos θ_o, and the sum over the wavelengths of the densities; directions along the pattern's axes.

        `near` has a bit for each wavelength that is covered; where orders are resolved, only if ω_o lies in the lobe of
        one.
        """
        interface = self.interface
        k_i, k_o = interface.wave_vector(wi), interface.wave_vector(wo)
        geometry = Geometry.of(k_i, k_o, interface, height_scale, self.theory.shadowing)
        incidence = Incidence.of(k_i, k_o, interface, height_scale, geometry.flip)
        pair = self.theory.coordinates(geometry)
        value, density = self._of_wavelengths(si, incidence, near, geometry, pair, lateral_scale)
        # Directions outside of the largest angle are black, but they are drawn: they have a density.
        within = smaller(*geometry.cosines()) >= self.min_cosine
        value = dr.select(within, value * self.theory.reflectance(si, geometry, active), 0)
        if interface.has_flat_face:
            value *= interface.flat(wi) * interface.flat(wo)
        return value, density

    @dr.syntax
    def _of_wavelengths(
        self,
        si: mi.SurfaceInteraction3f,
        incidence: Incidence,
        near: mi.UInt32,
        geometry: Geometry,
        pair: tuple | None,
        lateral_scale: mi.Float,
    ) -> tuple[mi.UnpolarizedSpectrum, mi.Float]:
        """Return f cos θ_o without R of the wavelengths that `near` has, and the sum of their densities.

        Each pass evaluates one wavelength of each ray; few rays have several in `near`. A loop keeps the kernel small;
        as Dr.Jit cannot differentiate it backwards, it is unrolled where there are gradients.
        """
        value, density = mi.UnpolarizedSpectrum(0.0), mi.Float(0.0)
        add_first = functools.partial(self._add_first, si, incidence)
        if dr.hint(dr.grad_enabled(geometry, lateral_scale), mode="scalar"):
            for _ in range(len(value)):
                near, value, density = add_first(geometry, pair, lateral_scale, near, value, density)
        else:
            while near != 0:
                near, value, density = add_first(geometry, pair, lateral_scale, near, value, density)
        return value, density

    def _add_first(
        self,
        si: mi.SurfaceInteraction3f,
        incidence: Incidence,
        geometry: Geometry,
        pair: tuple | None,
        lateral_scale: mi.Float,
        near: mi.UInt32,
        value: mi.UnpolarizedSpectrum,
        density: mi.Float,
    ) -> tuple[mi.UInt32, mi.UnpolarizedSpectrum, mi.Float]:
        """Return `near` without its first wavelength, and the sums with that."""
        first, wavelength = near & (0 - near), self._wavelength(si, 0)
        chosen = [first == (1 << channel) for channel in range(len(value))]
        for channel in range(1, len(value)):
            wavelength = dr.select(chosen[channel], self._wavelength(si, channel), wavelength)
        incidence = incidence.at(wavelength / lateral_scale, lateral_scale)
        power, probability = self.theory.evaluate(geometry, incidence, pair, near != 0)
        square = dr.square(incidence.frequency)
        power *= square
        value += mi.UnpolarizedSpectrum([dr.select(c, power, 0) for c in chosen])
        return near - first, value, dr.fma(probability, square, density)

    def mueller(
        self,
        value: mi.UnpolarizedSpectrum,
        ctx: mi.BSDFContext,
        si: mi.SurfaceInteraction3f,
        wo: mi.Vector3f,
        active: mi.Bool,
    ) -> mi.Spectrum:
        """Return `value` as light that is split into s and p where the variant and the material know them.

        Under a coat, after both passes through it, T_i T_o.
        """
        _, si = self._covered(si)
        directions, interface = (si.wi, wo), self.interface
        if interface.transmits and not interface.is_sheet and ctx.mode == mi.TransportMode.Radiance:
            # Radiance is compressed along with the solid angle.
            k_i, k_o = interface.wave_vector(si.wi), interface.wave_vector(wo)
            value *= dr.square(k_i.index / k_o.index)
        if self.coat is None:
            if not mi.is_polarized:
                return value
            return reflected(self.theory.split(value, si, self.frame(si, active), active), *directions, ctx.mode)
        inside = [self.coat.refracted(omega) for omega in directions]
        if mi.is_polarized:
            value *= self.coat.absorption(inside[0].z) * self.coat.absorption(inside[1].z)
            split = self.theory.split(value, si, self.frame(si, active), active)
            return through_layer(split, self.coat.eta, directions, inside, ctx.mode)
        for omega, refracted in zip(directions, inside, strict=True):
            value *= self.coat.transmittance(omega.z, refracted.z)
        return value

    def _covered(self, si: mi.SurfaceInteraction3f) -> tuple[list[mi.Bool], mi.SurfaceInteraction3f]:
        """Return which of the wavelengths are covered: at the others the grating is black.

        And the point with the shortest wavelength instead of those, at which a metal may be no number.
        """
        limits = np.array(self.spectrum.wavelengths) * self.theory.covered_index
        shortest, longest = np.clip(limits, *self.theory.material.wavelengths)
        known = mi.SurfaceInteraction3f(si)
        covered = [(w >= shortest * (1 - 1e-6)) & (w <= longest * (1 + 1e-6)) for w in si.wavelengths]
        for channel, keep in enumerate(covered):
            known.wavelengths[channel] = dr.select(keep, si.wavelengths[channel], shortest)
        return covered, known

    def entering(self, si: mi.SurfaceInteraction3f, cos: mi.Float, active: mi.Bool) -> mi.UnpolarizedSpectrum:
        """Return 1 − R, times T of the coat, at the cosine of an angle outside."""
        through = 1 - self.reflectance(si, cos, active)
        return through if self.coat is None else self.coat.transmittance(cos, self.coat.cos_inside(cos)) * through

    def reflectance(self, si: mi.SurfaceInteraction3f, cos: mi.Float, active: mi.Bool) -> mi.UnpolarizedSpectrum:
        """Return R of a plane below the coat, at the cosine of an angle outside."""
        _, si = self._covered(si)
        return self.theory.material(si, cos if self.coat is None else self.coat.cos_inside(cos), active)

    def sample(
        self,
        si: mi.SurfaceInteraction3f,
        u: mi.Float,
        v: mi.Point2f,
        active: mi.Bool,
        transmission_probability: mi.Float,
    ) -> mi.Vector3f:
        """Draw a direction for one of the wavelengths; along the horizon (z = 0) where its order is evanescent."""
        covered, si = self._covered(si)
        count = _count(covered)
        interface, reflects = self.interface, mi.Bool(True)
        if interface.transmits:
            reflects, p = u >= transmission_probability, transmission_probability
            u = dr.select(reflects, (u - p) / larger(1 - p, 1e-7), u / larger(p, 1e-7))
            u = limited(u, 0, BELOW_ONE)
        uniform_probability = _uniform_probability(count)
        uniform = u < uniform_probability
        u = (u - uniform_probability) / larger(1 - uniform_probability, UNIFORM_PROBABILITY)
        # Only wavelengths that the spectrum covers draw directions.
        chosen = smaller(dr.floor(u * count), larger(count - 1, 0))
        rest = limited(u * count - chosen, 0, BELOW_ONE)
        wavelength, before = self._wavelength(si, 0), mi.Float(0.0)
        for channel, use in enumerate(covered):
            wavelength = dr.select(use & (before == chosen), self._wavelength(si, channel), wavelength)
            before += dr.select(use, 1, 0)
        sin, cos = self.frame(si, active)
        height_scale, lateral_scale = self.scales.at(si, active)
        k_i = interface.wave_vector(turned(si.wi, sin, cos))
        k_o = interface.scattered(k_i, reflects)
        incidence = Incidence.of(k_i, k_o, interface, height_scale)
        incidence = incidence.at(dr.detach(wavelength / lateral_scale), dr.detach(lateral_scale))
        q, propagates = self.scattering.sample(incidence, rest, v, active & ~uniform)
        tangent = k_o.tangent - incidence.wavelength * incidence.mirrored * q
        wo = turned(mi.Vector3f(*tangent, 0), -sin, cos) / k_o.index
        wo.z = dr.select(propagates, dr.safe_sqrt(1 - dr.square(wo.x) - dr.square(wo.y)), 0)
        wo = dr.select(uniform, mi.warp.square_to_uniform_hemisphere(v), wo)
        return dr.detach(mi.Vector3f(wo.x, wo.y, k_o.sign * wo.z))

    def __str__(self) -> str:
        lines = [
            f"spectrum = {self.spectrum.source}",
            f"{self.spectrum.extent} = {self.spectrum.grid}",
            f"coherence_length = {self.spectrum.coherence_length:g} um",
            f"representation = {self.spectrum.representation}, {self.spectrum.megabytes:.3g} MB",
            *([] if self.coat is None else [f"coat = {self.coat}"]),
            f"orientation = {self.orientation}",
            str(self.theory),
        ]
        return "\n".join(lines)


def _count(covered: list[mi.Bool]) -> mi.Float:
    """Return how many wavelengths are covered."""
    return sum(dr.select(c, mi.Float(1), 0) for c in covered)


def _uniform_probability(covered: mi.Float) -> mi.Float:
    """Return the probability of uniform samples: one where no wavelength is covered."""
    return dr.select(covered > 0, mi.Float(UNIFORM_PROBABILITY), 1)
