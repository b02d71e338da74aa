"""The light that a grating diffracts, at the wavelengths of a ray: its value, its density, its samples."""

from __future__ import annotations

import functools

import drjit as dr
import mitsuba as mi
import numpy as np

from ..errors import RequestError
from ..rigorous.spectrum import RigorousSpectrum
from .geometry import Geometry, Incidence, turned
from .media import Media
from .polarisation import reflected, through_layer
from .scales import Scales
from .surface import surface_from, warn_of_range
from .tables import BELOW_ONE, larger, limited, opaque, smaller
from .theories import RigorousTheory, ScalarTheory
from .transmission import Crossing, CrossingIncidence

# The share of samples that are uniform, for lobes that the sampler's averages miss; where both directions graze, K G
# grows faster than samples that follow the cosine could bear.
DEFENSIVE = 0.02


class Grating:
    """A spectrum on a surface, with its theory, between media.

    Attributes:
        spectrum: of the surface.
        recipe: behind the spectrum; None for a saved one.
        theory: R, E and what else multiplies the powers of orders.
        media: about the grating; `coat` is that of them.
        scales: of heights and of lengths along the surface; of rigorous theory one.
        orientation: degrees from the tangent to the pattern's x axis.
    """

    def __init__(self, props: mi.Properties, media: Media) -> None:
        self.media, self.coat = media, media.coat
        self.scales = Scales(props)
        self.spectrum, self.recipe = surface_from(props, media, self.scales.largest)
        rigorous = isinstance(self.spectrum, RigorousSpectrum)
        if not rigorous:
            warn_of_range(self.spectrum)
        if rigorous:
            self.theory = RigorousTheory(props, self.spectrum, media)
        else:
            self.theory = ScalarTheory(props, self.spectrum, media, self.scales)
        self.scattering = self.theory.scattering
        angle = props.get("orientation", 0.0)
        if isinstance(angle, float) and not np.isfinite(angle):
            raise RequestError(f"orientation: got {angle}, wanted degrees or a texture")
        self.orientation = props.get_texture("orientation", 0.0)
        # The spectrum says nothing beyond its largest angle: there the grating is black.
        self.least_cosine = opaque(np.cos(np.deg2rad(self.spectrum.largest_angle)) * (1 - 1e-6))

    def traverse(self, callback: mi.TraversalCallback) -> None:
        callback.put("orientation", self.orientation, mi.ParamFlags.Differentiable)
        self.theory.traverse(callback)

    def frame(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> tuple[mi.Float, mi.Float]:
        """Return sine and cosine of the angle from the tangent to the pattern's x axis."""
        return dr.sincos(dr.deg2rad(self.orientation.eval_1(si, active)))

    @dr.syntax
    def evaluate(
        self, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool, wo_is_sample: bool, passing: mi.Float
    ) -> tuple[mi.UnpolarizedSpectrum, mi.Float]:
        """Evaluate f cos θ_o of light from ω_o, and the density of `sample`.

        Under a coat, without the transmittances of its front face; of a sheet, without those of its flat face.

        Args:
            si: the point, with ω_i.
            wo: ω_o.
            active: mask; both directions lie above the surface, or light passes it.
            wo_is_sample: whether ω_o was drawn, so that nearly always it lies in the lobe of an order.
            passing: the share of samples on the other side.
        """
        sin, cos = self.frame(si, active)
        # From here on along the pattern's axes.
        wi, wo, outside = turned(si.wi, sin, cos), turned(wo, sin, cos), mi.Frame3f.cos_theta(wo)
        u, v, interface = -wi.x - wo.x, -wi.y - wo.y, self.theory.interface
        side_share = mi.Float(1.0)
        if interface is not None:
            i, o = interface.side(wi), interface.side(wo)
            u, v = -i.tangent - o.tangent
            outside = dr.abs(outside) * dr.square(o.outside)
            side_share = dr.select(i.sign == o.sign, 1 - passing, passing)
        covered, count = self._covered(si)
        value, density = mi.UnpolarizedSpectrum(0.0), mi.Float(0.0)
        # Most directions lie between the orders of a grating at all wavelengths: unless drawn, they skip what follows.
        skips = self.scattering.resolved and not wo_is_sample
        height_scale, lateral_scale = self.scales.at(si, active)
        needed = active & self._meets(si, u, v, lateral_scale) if skips else True
        # What has no derivative is bound here: Dr.Jit carries all other state through the branch.
        diffracted = functools.partial(self._diffracted, si, covered, active, wo_is_sample)
        if needed:
            value, density = diffracted(wi, wo, height_scale, lateral_scale)
        # The mean over the covered wavelengths: any of them may have chosen the direction.
        uniform = _uniform_share(count)
        density = (1 - uniform) * density * outside / larger(count, 1)
        return value, side_share * dr.fma(uniform, dr.inv_two_pi, density)

    def _frequency(self, si: mi.SurfaceInteraction3f, channel: int) -> mi.Float:
        """Return 1/λ in the medium above, cycles/µm."""
        return 1e3 * self.media.outside / si.wavelengths[channel]

    def _meets(self, si: mi.SurfaceInteraction3f, u: mi.Float, v: mi.Float, lateral_scale: mi.Float | None) -> mi.Bool:
        """Return whether (u, v) = λq lies in the lobe of an order at any wavelength."""
        result = mi.Bool(False)
        for channel in range(len(si.wavelengths)):
            frequency = self._frequency(si, channel)
            result |= self.scattering.meets(u * frequency, v * frequency, *_given(lateral_scale))
        return result

    def _diffracted(
        self,
        si: mi.SurfaceInteraction3f,
        covered: list[mi.Bool],
        active: mi.Bool,
        wo_is_sample: bool,
        wi: mi.Vector3f,
        wo: mi.Vector3f,
        height_scale: mi.Float,
        lateral_scale: mi.Float | None,
    ) -> tuple[mi.UnpolarizedSpectrum, mi.Float]:
        """Return f cos θ_o, and the sum over the wavelengths of the densities; directions along the pattern's axes."""
        interface, shadowing = self.theory.interface, self.theory.shadowing
        if interface is None:
            geometry = Geometry.of(wi, wo, self.coat, height_scale, shadowing, lateral_scale)
        else:
            sides = interface.side(wi), interface.side(wo)
            least = interface.least_kappa(height_scale)
            geometry = Crossing(*sides, mi.Float(height_scale), shadowing, least, lateral_scale)
        # Directions beyond the largest angle are black, but they are drawn: they have a density.
        within = smaller(*geometry.cosines()) >= self.least_cosine
        value, density = mi.UnpolarizedSpectrum(0.0), mi.Float(0.0)
        for channel in range(len(value)):
            frequency = self._frequency(si, channel)
            if interface is None:
                incidence = Incidence.of(wi, frequency, height_scale, self.coat, lateral_scale)
            else:
                flip = geometry.flip
                incidence = CrossingIncidence.of(*sides, interface, frequency, height_scale, flip, lateral_scale)
            power, share = self.scattering.evaluate(geometry, incidence, active & covered[channel], wo_is_sample)
            value[channel] = dr.select(within, power * dr.square(frequency), 0)
            density = dr.fma(share, dr.square(frequency), density)
        value = self.theory.weighted(value, si, geometry, active)
        if self.coat is not None:
            # The solid angle inside the coat is smaller: cos θ'_o dω'_o = cos θ_o dω_o/n².
            value *= wo.z / larger(geometry.cos_o, 1e-7)
        return value, density

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
        directions, interface = (si.wi, wo), self.theory.interface
        if interface is not None and not interface.is_sheet and ctx.mode == mi.TransportMode.Radiance:
            # Radiance is compressed along with the solid angle.
            i, o = interface.side(si.wi), interface.side(wo)
            value *= dr.square(i.outside / o.outside)
        if interface is not None and interface.has_flat_face:
            value *= interface.flat(si.wi) * interface.flat(wo)
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

    def _covered(self, si: mi.SurfaceInteraction3f) -> tuple[list[mi.Bool], mi.Float]:
        """Return which of the wavelengths the spectrum covers, and how many: at the others the grating is black."""
        index = 1 if isinstance(self.theory, RigorousTheory) and self.coat is None else self.media.index
        shortest, longest = (
            w * index * d for w, d in zip(self.spectrum.wavelengths, (1 - 1e-6, 1 + 1e-6), strict=True)
        )
        covered = [(wavelength >= shortest) & (wavelength <= longest) for wavelength in si.wavelengths]
        return covered, sum(dr.select(c, mi.Float(1), 0) for c in covered)

    def entering(self, si: mi.SurfaceInteraction3f, cos: mi.Float, active: mi.Bool) -> mi.UnpolarizedSpectrum:
        """Return 1 − R, times T of the coat, at the cosine of an angle outside."""
        if self.coat is None:
            return 1 - self.theory.material(si, cos, active)
        inside = self.coat.cos_inside(cos)
        return self.coat.transmittance(cos, inside) * (1 - self.theory.material(si, inside, active))

    def sample(
        self, si: mi.SurfaceInteraction3f, u: mi.Float, v: mi.Point2f, active: mi.Bool, passing: mi.Float
    ) -> mi.Vector3f:
        """Draw a direction for one of the wavelengths; along the horizon (z = 0) where its order is evanescent.

        The share `passing` of the samples lies on the other side.
        """
        covered, count = self._covered(si)
        interface = self.theory.interface
        if interface is not None:
            u_side, passes = u, u < passing
            u = dr.select(passes, u / larger(passing, 1e-7), (u - passing) / larger(1 - passing, 1e-7))
            u = limited(u, 0, BELOW_ONE)
        share = _uniform_share(count)
        # In scalar variants these are Python's, for which ~ is no negation.
        uniform, diffracted = u < share, u >= share
        u = (u - share) / larger(1 - share, DEFENSIVE)
        # Only wavelengths that the spectrum covers draw directions.
        chosen = smaller(dr.floor(u * count), larger(count - 1, 0))
        rest = limited(u * count - chosen, 0, BELOW_ONE)
        frequency, before = self._frequency(si, 0), mi.Float(0.0)
        for channel, use in enumerate(covered):
            frequency = dr.select(use & (before == chosen), self._frequency(si, channel), frequency)
            before += dr.select(use, 1, 0)
        frequency = dr.detach(frequency)
        wavelength = dr.rcp(frequency)
        sin, cos = (dr.detach(x) for x in self.frame(si, active))
        wi = turned(si.wi, sin, cos)
        height_scale, lateral_scale = (None if s is None else dr.detach(s) for s in self.scales.at(si, active))
        arguments = rest, v, active & diffracted, *_given(lateral_scale)
        if interface is None:
            incidence = Incidence.of(wi, frequency, height_scale, self.coat, lateral_scale)
            q, propagates = self.scattering.sample(incidence, *arguments)
            x = -wavelength * (cos * q.x - sin * q.y) - si.wi.x
            y = -wavelength * (sin * q.x + cos * q.y) - si.wi.y
            z = dr.select(propagates, dr.safe_sqrt(1 - dr.square(x) - dr.square(y)), 0)
            return dr.select(uniform, mi.warp.square_to_uniform_hemisphere(v), mi.Vector3f(x, y, z))
        i = interface.side(wi)
        o = interface.other(i, u_side >= passing)
        incidence = CrossingIncidence.of(i, o, interface, frequency, height_scale, None, lateral_scale)
        q, propagates = self.scattering.sample(incidence, *arguments)
        drawn = turned(mi.Vector3f(*(o.tangent - wavelength * incidence.mirrored * q), 0), -sin, cos) / o.outside
        z = dr.select(propagates, dr.safe_sqrt(1 - dr.square(drawn.x) - dr.square(drawn.y)), 0)
        drawn = dr.select(uniform, mi.warp.square_to_uniform_hemisphere(v), mi.Vector3f(drawn.x, drawn.y, z))
        return dr.detach(mi.Vector3f(drawn.x, drawn.y, o.sign * drawn.z))

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


def _given(lateral_scale: mi.Float | None) -> list[mi.Float]:
    """Return a lateral scale as an argument of spectra that can have one."""
    return [] if lateral_scale is None else [lateral_scale]


def _uniform_share(covered: mi.Float) -> mi.Float:
    """Return the share of samples that are uniform: all of them where no wavelength is covered."""
    return dr.select(covered > 0, mi.Float(DEFENSIVE), 1)
