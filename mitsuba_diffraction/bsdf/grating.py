"""The light diffracted by a grating at the wavelengths of a ray: value, density, samples."""

from __future__ import annotations

import functools
from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np

from ..errors import RequestError
from ..precomputation.recipe import Recipe
from ..progress import progress_bar
from ..settings import VISIBLE
from .device_tables import BELOW_ONE, larger, limited, opaque, smaller
from .directions import Geometry, Incidence, Interface, rotated
from .energy_factor import Coordinates
from .parameters import GratingRequest
from .polarisation import reflected, through_layer
from .theory import theory_of
from .varying import check_texture

# Of defensive samples, for lobes that the averages of the sampler miss. They are uniform in solid angle: where both
# directions are grazing, K G grows so fast that samples in proportion to the cosine would have large weights.
UNIFORM_PROBABILITY = 0.02
SCALE_MARGIN = 1.2  # of a growing `lateral_scale`, so that a search computes the spectrum once
_per_cent = functools.partial(progress_bar, unit="%")
_ROUND = "Sphere", "Cylinder", "BSplineCurve"  # shape types, which are bits
_Pair = tuple[Geometry, Incidence, tuple[Coordinates, Coordinates] | None]
"""Two directions, the incident light, the coordinates of both in the table of E."""


class Grating:
    """A spectrum on a surface, with its theory, between media.

    Attributes:
        spectrum: of the surface.
        recipe: from which the spectrum was built; None for a saved one.
        theory: the powers of orders, and R, E and other factors.
        coat: over the grating, or None.
        scales, orientation, from_radius: see `GratingRequest`.
    """

    def __init__(self, request: GratingRequest) -> None:
        self.coat, self.scales = request.coat, request.scales
        self.orientation, self.from_radius = request.orientation, request.from_radius
        given = request.spectrum_or_recipe
        self.recipe = given if isinstance(given, Recipe) else None
        self.spectrum = given.cached(_per_cent) if isinstance(given, Recipe) else given
        self.theory = theory_of(self.spectrum, request)
        self._check_window(self.theory.wavelengths[0])
        self._request = request
        # The grating is black at angles that the spectrum does not cover.
        self.min_cosine = opaque(np.cos(np.deg2rad(self.theory.largest_angle)) * (1 - 1e-6))

    @property
    def interface(self) -> Interface:
        """The media above and below, for the current parameters."""
        return self.theory.interface

    def lacks(self, wavelengths: tuple[float, float]) -> list[tuple[float, float]]:
        """Return the parts of a range of wavelengths, nm, at which the grating would be black."""
        (first, last), (shortest, longest) = wavelengths, self._range()
        parts = (first, min(last, shortest)), (max(first, longest), last)
        return [(low, high) for low, high in parts if high - low > 1e-6 * high]

    def cover(self, wavelengths: tuple[float, float]) -> None:
        """Extend the covered range to include the wavelengths (shortest, longest), nm in air.

        A spectrum from a recipe or a profile is computed again if it does not cover this range.

        Raises:
            RequestError: if an index or a saved spectrum does not cover them, or the coherence length is shorter.
        """
        self._check_window(wavelengths[1])
        for index in self._request.known_ranges:
            index.check(wavelengths)
        before = self.theory.light or wavelengths
        wavelengths = min(wavelengths[0], before[0]), max(wavelengths[1], before[1])
        if wavelengths == self.theory.light:
            return
        try:
            self.theory.cover(wavelengths)
        except RequestError:
            recipe = self._request.widened(wavelengths)
            if recipe is None:
                raise
            self._compute(recipe)
            self.theory.cover(wavelengths)

    def _compute(self, recipe: Recipe) -> None:
        """Take the spectrum of a recipe, with the parameters that the user may have changed since the request."""
        self.recipe, self.spectrum = recipe, recipe.cached(_per_cent)
        self.theory = theory_of(self.spectrum, self._request)
        self.theory.parameters_changed([])

    def _check_window(self, wavelength: float) -> None:
        """Check that a window of the coherence length has a far field at a wavelength in air, nm.

        Raises:
            RequestError: if it is shorter than the wavelength: lobes would be wider than the hemisphere.
        """
        coherence_length = self.spectrum.coherence_length
        if coherence_length < 1e-3 * wavelength * (1 - 1e-6):
            raise RequestError(
                f"coherence_length: got {coherence_length:.4g} µm with light of {wavelength:g} nm, wanted at least the "
                "wavelength: a shorter window has no far field"
            )

    def _range(self) -> tuple[float, float]:
        """Return the shortest and the longest wavelength that the spectrum and all indices cover, nm."""
        first, last = zip(*(index.wavelengths for index in self._request.known_ranges), strict=True)
        shortest, longest = np.clip(self.theory.wavelengths, max(first), min(last))
        return float(shortest), float(longest)

    def parameters_changed(self, keys: list[str]) -> None:
        """Check the parameters `keys` and recompute what depends on them; without keys, all parameters."""
        if not keys or "orientation" in keys:
            check_texture("orientation", self.orientation)
        if not keys or "lateral_scale" in keys:
            self._cover_lateral_scale()
        self.theory.parameters_changed(keys)

    def _cover_lateral_scale(self) -> None:
        """Compute the spectrum of a recipe again where the scale of lengths has grown beyond what it covers.

        Orders that do not overlap, which alone can be scaled, are computed in about a second.
        """
        _, lateral = self.scales
        lateral.read()
        light, scale = self.theory.light, float(lateral.values[-1])
        first, last = light or VISIBLE
        is_covered = scale <= 1 or first / scale >= self.theory.wavelengths[0] * (1 - 1e-6)
        if is_covered or not self.theory.scattering.resolved:
            return
        if (recipe := self._request.widened((first, last), scale * SCALE_MARGIN)) is not None:
            self._compute(recipe)
            if light is not None:
                self.theory.cover(light)

    def traverse(self, callback: mi.TraversalCallback) -> None:
        callback.put("orientation", self.orientation, mi.ParamFlags.Differentiable)
        self.theory.traverse(callback)

    def frame(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> tuple[mi.Float, mi.Float]:
        """Return sine and cosine of the angle from the tangent to the pattern's x axis."""
        sin, cos = dr.sincos(dr.deg2rad(self.orientation.eval_1(si, active)))
        if not self.from_radius:
            return sin, cos
        u, v = _radius_in_uv(si)
        radius = si.to_local(u * si.dp_du + v * si.dp_dv)
        square = dr.square(radius.x) + dr.square(radius.y)
        has_direction = square > 0
        scale = dr.rsqrt(dr.select(has_direction, square, 1))
        x, y = dr.select(has_direction, radius.x * scale, 1), radius.y * scale
        return sin * x + cos * y, cos * x - sin * y

    @dr.syntax
    def value_and_density(
        self,
        si: mi.SurfaceInteraction3f,
        wo: mi.Vector3f,
        active: mi.Bool,
        wo_is_sample: bool,
        transmission_probability: mi.Float,
    ) -> tuple[mi.UnpolarizedSpectrum, mi.Float]:
        """Return f cos θ_o and the density of `sample`.

        The transmittances of the front face of a coat and of the flat face of a sheet are not included.

        Args:
            si: the point, with ω_i.
            wo: ω_o.
            active: mask; without transmission both directions are above the surface.
            wo_is_sample: whether ω_o was drawn, and therefore nearly always lies in the lobe of an order.
            transmission_probability: of samples.
        """
        sin, cos = self.frame(si, active)
        # From here on along the pattern's axes.
        wi, wo = rotated(si.wi, sin, cos), rotated(wo, sin, cos)
        k_i, k_o = self.interface.wave_vector(wi), self.interface.wave_vector(wo)
        u, v = -k_i.tangent - k_o.tangent
        side_probability = dr.select(k_i.sign == k_o.sign, 1 - transmission_probability, transmission_probability)
        covered, si = self._covered(si)
        count = _count(covered)
        value, density = mi.UnpolarizedSpectrum(0.0), mi.Float(0.0)
        height_scale, lateral_scale = self.scales.ratio_and_lateral(si, active)
        pending = mi.UInt32(0)
        for channel, in_lobe in enumerate(covered):
            if self.interface.disperses:
                at = self.interface.at_wavelength(si.wavelengths[channel])
                u, v = -at.wave_vector(wi).tangent - at.wave_vector(wo).tangent
            frequency = lateral_scale * dr.rcp(self._above(si.wavelengths[channel]))
            in_lobe &= self.theory.scattering.meets(u * frequency, v * frequency, lateral_scale)
            pending |= dr.select(active & in_lobe, mi.UInt32(1 << channel), 0)
        # Most directions lie outside of all lobes at all wavelengths; unless drawn, they skip the branch.
        needed = pending != 0 if self.theory.scattering.resolved and not wo_is_sample else True
        # Arguments without derivatives are bound here: Dr.Jit passes all other state through the branch.
        diffracted = functools.partial(self._diffracted, si, pending, active)
        if needed:
            value, density = diffracted(wi, wo, height_scale, lateral_scale)
        # The mean over the covered wavelengths, as each of them is chosen with the same probability.
        uniform = _uniform_probability(count)
        density = (1 - uniform) * density * dr.abs(mi.Frame3f.cos_theta(wo)) / larger(count, 1)
        return value, side_probability * dr.fma(uniform, dr.inv_two_pi, density)

    def _above(self, wavelength: mi.Float) -> mi.Float:
        """Return λ in the medium above, µm, from λ in vacuum, nm."""
        return wavelength * (1e-3 / self.theory.media.outside)

    def _diffracted(
        self,
        si: mi.SurfaceInteraction3f,
        pending: mi.UInt32,
        active: mi.Bool,
        wi: mi.Vector3f,
        wo: mi.Vector3f,
        height_scale: mi.Float,
        lateral_scale: mi.Float,
    ) -> tuple[mi.UnpolarizedSpectrum, mi.Float]:
        """Return f cos θ_o, and the sum of the densities over the wavelengths; directions along the pattern's axes.

        `pending` has a bit for each covered wavelength at which ω_o lies in the lobe of an order or orders overlap.
        """
        pair = self._pair(self.interface, wi, wo, height_scale)
        geometry, incidence, coordinates = pair
        # Directions at angles that are not covered are black, but have a density, as they are drawn.
        within = smaller(*geometry.cosines()) >= self.min_cosine
        if self.interface.disperses:

            def pair_at(state: tuple, wavelength: mi.Float) -> tuple[_Pair, mi.Float | float]:
                interface, si_of_one = self.interface.at_wavelength(wavelength), mi.SurfaceInteraction3f(si)
                si_of_one.wavelengths = mi.UnpolarizedSpectrum(wavelength)
                of_one = self._pair(interface, *state)
                return of_one, self.theory.reflectance(si_of_one, of_one[0], active)[0]

            # R is part of the loop, so that its derivative matters; Dr.Jit removes values that nothing uses.
            derived = dr.grad_enabled(self.theory.reflectance(si, geometry, active))
            value, density = self._of_wavelengths(si, pending, pair_at, (wi, wo, height_scale), lateral_scale, derived)
            return dr.select(within, value, 0), density

        def constant(state: tuple, wavelength: mi.Float) -> tuple[_Pair, mi.Float | float]:
            return (state[0], incidence, state[1]), 1.0

        value, density = self._of_wavelengths(si, pending, constant, (geometry, coordinates), lateral_scale)
        value = dr.select(within, value * self.theory.reflectance(si, geometry, active), 0)
        return value, density

    def _pair(self, interface: Interface, wi: mi.Vector3f, wo: mi.Vector3f, height_scale: mi.Float) -> _Pair:
        """Return the geometry of two directions, the incident light, and the coordinates in the table of E."""
        k_i, k_o = interface.wave_vector(wi), interface.wave_vector(wo)
        geometry = Geometry.of(k_i, k_o, interface, height_scale, self.theory.shadowing)
        incidence = Incidence.of(k_i, k_o, interface, height_scale, geometry.kappa_sign)
        return geometry, incidence, self.theory.coordinates(geometry)

    @dr.syntax
    def _of_wavelengths(
        self,
        si: mi.SurfaceInteraction3f,
        pending: mi.UInt32,
        pair_at: Callable[[tuple, mi.Float], tuple[_Pair, mi.Float | float]],
        state: tuple,
        lateral_scale: mi.Float,
        derived: bool = False,
    ) -> tuple[mi.UnpolarizedSpectrum, mi.Float]:
        """Return f cos θ_o at the wavelengths in `pending`, and the sum of their densities times n_o².

        Each iteration evaluates one wavelength of each ray; few rays have several. A loop keeps the kernel small; with
        gradients it is unrolled, as Dr.Jit cannot differentiate it in reverse mode.

        Args:
            si, pending: see `_diffracted`.
            pair_at: returns the pair of directions, and a factor of the value, from `state` at a wavelength in nm.
            state: all arrays with derivatives.
            lateral_scale: of lengths along the surface.
            derived: whether the factor that `pair_at` returns has derivatives by other arrays.
        """
        value, density = mi.UnpolarizedSpectrum(0.0), mi.Float(0.0)
        add_wavelength = functools.partial(self._add_wavelength, si, pair_at)
        if dr.hint(derived or dr.grad_enabled(state, lateral_scale), mode="scalar"):
            for _ in range(len(value)):
                pending, value, density = add_wavelength(state, lateral_scale, pending, value, density)
        else:
            while pending != 0:
                pending, value, density = add_wavelength(state, lateral_scale, pending, value, density)
        return value, density

    def _add_wavelength(
        self,
        si: mi.SurfaceInteraction3f,
        pair_at: Callable[[tuple, mi.Float], tuple[_Pair, mi.Float | float]],
        state: tuple,
        lateral_scale: mi.Float,
        pending: mi.UInt32,
        value: mi.UnpolarizedSpectrum,
        density: mi.Float,
    ) -> tuple[mi.UInt32, mi.UnpolarizedSpectrum, mi.Float]:
        """Evaluate the first wavelength in `pending`; return `pending` without it, and the sums including it."""
        first_bit, wavelength = pending & (0 - pending), si.wavelengths[0]
        chosen = [first_bit == (1 << channel) for channel in range(len(value))]
        for channel in range(1, len(value)):
            wavelength = dr.select(chosen[channel], si.wavelengths[channel], wavelength)
        (geometry, incidence, pair), factor = pair_at(state, wavelength)
        incidence = incidence.at_wavelength(self._above(wavelength) / lateral_scale, lateral_scale)
        power, probability = self.theory.power_and_density(geometry, incidence, pair, pending != 0)
        square = dr.square(incidence.frequency)
        power *= square * factor
        value = value + mi.UnpolarizedSpectrum([dr.select(c, power, 0) for c in chosen])
        probability *= dr.square(geometry.outgoing.index)
        return pending - first_bit, value, dr.fma(probability, square, density)

    def mueller(
        self,
        value: mi.UnpolarizedSpectrum,
        ctx: mi.BSDFContext,
        si: mi.SurfaceInteraction3f,
        wo: mi.Vector3f,
        active: mi.Bool,
    ) -> mi.Spectrum:
        """Return `value` as a Mueller matrix in polarised variants, with T_i T_o of the face of a coat or sheet.

        It is the spectrum itself in other variants, and depolarises for materials without polarisation.
        """
        _, si = self._covered(si)
        directions, interface = (si.wi, wo), self.interface
        at = [interface.at_wavelength(wavelength) for wavelength in si.wavelengths]
        if interface.transmits and not interface.is_sheet and ctx.mode == mi.TransportMode.Radiance:
            # Radiance scales with n².
            vectors = [[of_channel.wave_vector(omega) for omega in directions] for of_channel in at]
            value = value * mi.UnpolarizedSpectrum([dr.square(k_i.index / k_o.index) for k_i, k_o in vectors])
        if not mi.is_polarized:
            for omega in directions:
                if self.coat is not None:
                    value = value * (1 - self.coat.reflectance(si, omega.z))
                elif interface.has_flat_face:
                    value = value * mi.UnpolarizedSpectrum([i.flat_face_transmittance(omega) for i in at])
            return value
        split = self.theory.split(value, si, self.frame(si, active), active)
        if self.coat is None and not interface.has_flat_face:
            return reflected(split, *directions, ctx.mode)
        etas, has_face = [of_channel.eta for of_channel in at], [omega.z < 0 for omega in directions]
        if self.coat is not None:
            etas, has_face = self.coat.etas(si), [mi.Bool(True)] * 2
        of_each = at if interface.disperses else [interface]
        inside = [[of_channel.wave_vector(omega).inner() for omega in directions] for of_channel in of_each]
        return through_layer(split, mi.UnpolarizedSpectrum(etas), directions, inside, has_face, ctx.mode)

    def _covered(self, si: mi.SurfaceInteraction3f) -> tuple[list[mi.Bool], mi.SurfaceInteraction3f]:
        """Return which of the wavelengths the spectrum and all indices cover, and the point with covered ones only.

        At wavelengths that are not covered the grating is black, and the index of a metal may be NaN: they are replaced
        by the shortest covered wavelength.
        """
        shortest, longest = self._range()
        replaced = mi.SurfaceInteraction3f(si)
        covered = [(w >= shortest * (1 - 1e-6)) & (w <= longest * (1 + 1e-6)) for w in si.wavelengths]
        for channel, is_covered in enumerate(covered):
            replaced.wavelengths[channel] = dr.select(is_covered, si.wavelengths[channel], shortest)
        return covered, replaced

    def transmittance(self, si: mi.SurfaceInteraction3f, cos: mi.Float, active: mi.Bool) -> mi.UnpolarizedSpectrum:
        """Return T of a plane, times T of the coat, at the cosine of an angle outside."""
        transmitted = self._r_and_t(si, cos, active)[1]
        return transmitted if self.coat is None else (1 - self.coat.reflectance(si, cos)) * transmitted

    def reflectance(self, si: mi.SurfaceInteraction3f, cos: mi.Float, active: mi.Bool) -> mi.UnpolarizedSpectrum:
        """Return R of a plane below the coat, at the cosine of an angle outside."""
        return self._r_and_t(si, cos, active)[0]

    def _r_and_t(
        self, si: mi.SurfaceInteraction3f, cos: mi.Float, active: mi.Bool
    ) -> tuple[mi.UnpolarizedSpectrum, mi.UnpolarizedSpectrum]:
        _, si = self._covered(si)
        return self.theory.boundary.r_and_t(si, cos if self.coat is None else self.coat.cos_inside(si, cos), active)

    def sample(
        self,
        si: mi.SurfaceInteraction3f,
        u: mi.Float,
        v: mi.Point2f,
        active: mi.Bool,
        transmission_probability: mi.Float,
    ) -> mi.Vector3f:
        """Draw a direction for one of the wavelengths; z = 0 where its order is evanescent."""
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
        # Only covered wavelengths are chosen.
        chosen = smaller(dr.floor(u * count), larger(count - 1, 0))
        rest = limited(u * count - chosen, 0, BELOW_ONE)
        wavelength, rank = si.wavelengths[0], mi.Float(0.0)
        for channel, is_covered in enumerate(covered):
            wavelength = dr.select(is_covered & (rank == chosen), si.wavelengths[channel], wavelength)
            rank += dr.select(is_covered, 1, 0)
        sin, cos = self.frame(si, active)
        height_scale, lateral_scale = self.scales.ratio_and_lateral(si, active)
        interface = interface.at_wavelength(wavelength)
        k_i = interface.wave_vector(rotated(si.wi, sin, cos))
        k_o = interface.scattered(k_i, reflects)
        incidence = Incidence.of(k_i, k_o, interface, height_scale)
        incidence = incidence.at_wavelength(
            dr.detach(self._above(wavelength) / lateral_scale), dr.detach(lateral_scale)
        )
        q, propagates = self.theory.scattering.sample(incidence, rest, v, active & ~uniform)
        tangent = k_o.tangent - incidence.wavelength * incidence.q_sign * q
        wo = rotated(mi.Vector3f(*tangent, 0), -sin, cos) / k_o.index
        wo.z = dr.select(propagates, dr.safe_sqrt(1 - dr.square(wo.x) - dr.square(wo.y)), 0)
        wo = dr.select(uniform, mi.warp.square_to_uniform_hemisphere(v), wo)
        return dr.detach(mi.Vector3f(wo.x, wo.y, k_o.sign * wo.z))

    def __str__(self) -> str:
        lines = [
            f"spectrum = {self.spectrum.source}",
            f"{self.spectrum.extent} = {self.spectrum.grid}",
            f"coherence_length = {self.spectrum.coherence_length:g} um",
            f"representation = {self.spectrum.representation}, {self.spectrum.megabytes:.3g} MB",
            *([] if self.coat is None else [f"coat = n = {self.coat.medium}"]),
            f"orientation = {self.orientation}{' from the radius' if self.from_radius else ''}",
            str(self.theory),
        ]
        return "\n".join(lines)


def _radius_in_uv(si: mi.SurfaceInteraction3f) -> tuple[mi.Float, mi.Float]:
    """Return the direction in UV space that points away from its centre, or across circles about the shape's axis.

    Its image on the surface is the radius, whatever the scale, shear or reflection of the UVs of a mesh. Those of
    Mitsuba's disk are polar, with the radius along u; on a sphere, a cylinder and a curve u runs around and v across.
    """
    kind = si.shape.shape_type()
    is_disk = kind == int(mi.ShapeType.Disk)
    is_round = (kind & sum(int(getattr(mi.ShapeType, name)) for name in _ROUND)) != 0
    u, v = si.uv - 0.5
    return dr.select(is_disk, 1, dr.select(is_round, 0, u)), dr.select(is_disk, 0, dr.select(is_round, 1, v))


def _count(covered: list[mi.Bool]) -> mi.Float:
    """Return how many wavelengths are covered."""
    return sum(dr.select(c, mi.Float(1), 0) for c in covered)


def _uniform_probability(covered: mi.Float) -> mi.Float:
    """Return the probability of uniform samples: one where no wavelength is covered."""
    return dr.select(covered > 0, mi.Float(UNIFORM_PROBABILITY), 1)
