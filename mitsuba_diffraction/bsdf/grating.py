"""The light that a grating diffracts, at the wavelengths of a ray: its value, its density, its samples."""

from __future__ import annotations

import functools

import drjit as dr
import mitsuba as mi
import numpy as np

from ..errors import RequestError
from ..rigorous.spectrum import RigorousSpectrum
from .energy import Place
from .geometry import Geometry, Incidence, turned
from .media import Media
from .orders import OrderSpectrum
from .polarisation import reflected, through_layer
from .rigorous_orders import RigorousOrders
from .scales import Scales, check_texture
from .spline_spectrum import SplineSpectrum
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
        coat: over the grating, or None.
        scales: of heights and of lengths along the surface; of rigorous theory one.
        orientation: degrees from the tangent to the pattern's x axis.
    """

    def __init__(self, props: mi.Properties, media: Media) -> None:
        self.coat = media.coat
        self.scales = Scales(props)
        self.spectrum, self.recipe = surface_from(props, media, self.scales.max_scale)
        if isinstance(self.spectrum, RigorousSpectrum):
            self.theory = RigorousTheory(props, self.spectrum, media)
        else:
            warn_of_range(self.spectrum)
            self.theory = ScalarTheory(props, self.spectrum, media, self.scales)
        angle = props.get("orientation", 0.0)
        if isinstance(angle, float) and not np.isfinite(angle):
            raise RequestError(f"orientation: got {angle}, wanted degrees or a texture")
        self.orientation = props.get_texture("orientation", 0.0)
        check_texture("orientation", self.orientation)
        # The spectrum says nothing beyond its largest angle: there the grating is black.
        self.least_cosine = opaque(np.cos(np.deg2rad(self.spectrum.largest_angle)) * (1 - 1e-6))

    @property
    def scattering(self) -> OrderSpectrum | SplineSpectrum | RigorousOrders:
        """K G S cos θ_o and its sampler."""
        return self.theory.scattering

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

        Under a coat, without the transmittances of its front face.

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
        height_scale, lateral_scale = self.scales.at(si, active)
        near = mi.UInt32(0)
        for channel, seen in enumerate(covered):
            if self.scattering.resolved:
                frequency = dr.rcp(self._wavelength(si, channel))
                seen &= self.scattering.meets(u * frequency, v * frequency, lateral_scale)
            near |= dr.select(active & seen, mi.UInt32(1 << channel), 0)
        # Most directions lie between the orders of a grating at all wavelengths: unless drawn, they skip what follows.
        needed = near != 0 if self.scattering.resolved and not wo_is_sample else True
        # What has no derivative is bound here: Dr.Jit carries all other state through the branch.
        diffracted = functools.partial(self._diffracted, si, near, active)
        if needed:
            value, density = diffracted(wi, wo, height_scale, lateral_scale)
        # The mean over the covered wavelengths: any of them may have chosen the direction.
        uniform = _uniform_share(count)
        density = (1 - uniform) * density * outside / larger(count, 1)
        return value, side_share * dr.fma(uniform, dr.inv_two_pi, density)

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
        lateral_scale: mi.Float | float,
    ) -> tuple[mi.UnpolarizedSpectrum, mi.Float]:
        """Return f cos θ_o, and the sum over the wavelengths of the densities; directions along the pattern's axes.

        `near` has a bit for each wavelength that is covered; where orders are resolved, only if ω_o lies in the lobe of
        one.
        """
        interface, shadowing, energy = self.theory.interface, self.theory.shadowing, self.theory.energy
        if interface is None:
            geometry = Geometry.of(wi, wo, self.coat, height_scale, shadowing, lateral_scale)
            incidence = Incidence.of(wi, height_scale, self.coat, lateral_scale)
        else:
            sides = interface.side(wi), interface.side(wo)
            least = interface.least_kappa(height_scale)
            geometry = Crossing.of(*sides, mi.Float(height_scale), shadowing, least, lateral_scale)
            incidence = CrossingIncidence.of(*sides, interface, height_scale, geometry.flip, lateral_scale)
        places = energy and energy.places(*geometry.inside(), geometry.height_scale, lateral_scale)
        value, density = self._of_wavelengths(si, incidence, near, geometry, places)
        # Directions beyond the largest angle are black, but they are drawn: they have a density.
        within = smaller(*geometry.cosines()) >= self.least_cosine
        value = dr.select(within, self.theory.times_reflectance(value, si, geometry, active), 0)
        if interface is not None and interface.has_flat_face:
            value *= interface.flat(wi) * interface.flat(wo)
        if self.coat is not None:
            # The solid angle inside the coat is smaller: cos θ'_o dω'_o = cos θ_o dω_o/n².
            value *= wo.z / larger(geometry.cos_o, 1e-7)
        return value, density

    @dr.syntax
    def _of_wavelengths(
        self,
        si: mi.SurfaceInteraction3f,
        incidence: Incidence | CrossingIncidence,
        near: mi.UInt32,
        geometry: Geometry | Crossing,
        places: tuple[Place, Place] | None,
    ) -> tuple[mi.UnpolarizedSpectrum, mi.Float]:
        """Return f cos θ_o without R of the wavelengths that `near` has, and the sum of their densities.

        Each pass evaluates one wavelength of each ray; few rays have several in `near`. A loop keeps the kernel small;
        as Dr.Jit cannot differentiate it backwards, it is unrolled where there are gradients.
        """
        value, density = mi.UnpolarizedSpectrum(0.0), mi.Float(0.0)
        add_first = functools.partial(self._add_first, si, incidence)
        if dr.hint(dr.grad_enabled(geometry), mode="scalar"):
            for _ in range(len(value)):
                near, value, density = add_first(geometry, places, near, value, density)
        else:
            while near != 0:
                near, value, density = add_first(geometry, places, near, value, density)
        return value, density

    def _add_first(
        self,
        si: mi.SurfaceInteraction3f,
        incidence: Incidence | CrossingIncidence,
        geometry: Geometry | Crossing,
        places: tuple[Place, Place] | None,
        near: mi.UInt32,
        value: mi.UnpolarizedSpectrum,
        density: mi.Float,
    ) -> tuple[mi.UInt32, mi.UnpolarizedSpectrum, mi.Float]:
        """Return `near` without its first wavelength, and the sums with that."""
        first, wavelength = near & (0 - near), self._wavelength(si, 0)
        chosen = [first == (1 << channel) for channel in range(len(value))]
        for channel in range(1, len(value)):
            wavelength = dr.select(chosen[channel], self._wavelength(si, channel), wavelength)
        incidence = incidence.at(wavelength)
        power, share = self.scattering.evaluate(geometry, incidence, near != 0)
        if places is not None:
            power *= self.theory.energy.factor(places, incidence.frequency * geometry.index)
        square = dr.square(incidence.frequency)
        power *= square
        value += mi.UnpolarizedSpectrum([dr.select(c, power, 0) for c in chosen])
        return near - first, value, dr.fma(share, square, density)

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
        index = 1 if isinstance(self.theory, RigorousTheory) and self.coat is None else self.theory.media.index
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
        wavelength, before = self._wavelength(si, 0), mi.Float(0.0)
        for channel, use in enumerate(covered):
            wavelength = dr.select(use & (before == chosen), self._wavelength(si, channel), wavelength)
            before += dr.select(use, 1, 0)
        wavelength = dr.detach(wavelength)
        sin, cos = (dr.detach(x) for x in self.frame(si, active))
        wi = turned(si.wi, sin, cos)
        height_scale, lateral_scale = (dr.detach(s) for s in self.scales.at(si, active))
        arguments = rest, v, active & diffracted
        if interface is None:
            incidence = Incidence.of(wi, height_scale, self.coat, lateral_scale).at(wavelength)
            q, propagates = self.scattering.sample(incidence, *arguments)
            x = -wavelength * (cos * q.x - sin * q.y) - si.wi.x
            y = -wavelength * (sin * q.x + cos * q.y) - si.wi.y
            z = dr.select(propagates, dr.safe_sqrt(1 - dr.square(x) - dr.square(y)), 0)
            return dr.select(uniform, mi.warp.square_to_uniform_hemisphere(v), mi.Vector3f(x, y, z))
        i = interface.side(wi)
        o = interface.other(i, u_side >= passing)
        incidence = CrossingIncidence.of(i, o, interface, height_scale, lateral_scale=lateral_scale).at(wavelength)
        q, propagates = self.scattering.sample(incidence, *arguments)
        wo = turned(mi.Vector3f(*(o.tangent - wavelength * incidence.mirrored * q), 0), -sin, cos) / o.outside
        wo.z = dr.select(propagates, dr.safe_sqrt(1 - dr.square(wo.x) - dr.square(wo.y)), 0)
        wo = dr.select(uniform, mi.warp.square_to_uniform_hemisphere(v), wo)
        return dr.detach(mi.Vector3f(wo.x, wo.y, o.sign * wo.z))

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


def _uniform_share(covered: mi.Float) -> mi.Float:
    """Return the share of samples that are uniform: all of them where no wavelength is covered."""
    return dr.select(covered > 0, mi.Float(DEFENSIVE), 1)
