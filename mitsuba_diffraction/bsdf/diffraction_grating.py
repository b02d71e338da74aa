"""The class behind `<bsdf type="diffraction_grating">`."""

from __future__ import annotations

import functools
import operator

import drjit as dr
import mitsuba as mi
import numpy as np

from ..errors import RequestError, is_number
from ..geometry import SHADOWING
from ..manual import Parameter, listed
from ..rigorous.spectrum import RigorousSpectrum
from ..settings import SUN_COHERENCE_LENGTH, VISIBLE
from ..surface.heightfield import HeightField
from .base import base_from
from .coat import coat_from
from .geometry import Geometry, Incidence
from .polarisation import Split, of_orders, of_plane, reflected, through_layer, unpolarised
from .reflectance import reflectance_from
from .rigorous_parameters import check_parameters
from .shared import SharedTables
from .surface import surface_from, warn_of_range
from .tables import BELOW_ONE, larger, limited, opaque, smaller

# The share of samples that are uniform, for lobes that the sampler's averages miss; where both directions graze, K G
# grows faster than samples that follow the cosine could bear.
DEFENSIVE = 0.02
LEAST_SHARE = 0.1  # of the samples, for the grating and for its base: what each reflects is only estimated

PARAMETERS = (
    Parameter("filename", "string", "a saved spectrum (.exr) or a recipe (.toml)"),
    Parameter("spectrum", "GratingSpectrum or RigorousSpectrum", "the same from Python, in load_dict"),
    Parameter(
        "profile",
        "string",
        "a grating by formula instead of a file, with the parameters of the function of that name in "
        "`mitsuba_diffraction.gratings`, all lengths in µm, and coherence_length and largest_height_range as in "
        "`precompute`",
    ),
    Parameter("tolerance", "float", "of a profile or instead of that of a recipe, as in `precompute`"),
    Parameter(
        "theory",
        "string",
        "of a profile: scalar, or rigorous, Maxwell's equations for the material that is given and for gratings of one "
        "row; files and spectra say which they are. Rigorous efficiencies exclude height_scale, shadowing, fresnel and "
        "base",
        "scalar",
    ),
    Parameter("int_ior, ext_ior", "float or string", "a dielectric, as in Mitsuba's `dielectric`", "1.5, air"),
    Parameter(
        "material", "string", 'a conductor instead, as in Mitsuba\'s `conductor`; "none" is the perfect mirror, R = 1'
    ),
    Parameter("fresnel", "string", "exact, or Schlick's approximation schlick", "exact"),
    Parameter("orientation", "float or texture", "degrees from the tangent dp_du to the pattern's x axis", "0"),
    Parameter("height_scale", "float", "scales the heights", "1"),
    Parameter("shadowing", "string", "v_cavity or none", "v_cavity"),
    Parameter("conserve_energy", "boolean", "false leaves out E, to compare with closed forms", "true"),
    Parameter(
        "coat_ior",
        "float or string",
        "index of a clear plane layer over the grating, as for int_ior; that of the outside is no layer",
        "none",
    ),
    Parameter("coat_absorption", "float", "of the layer, 1/µm", "0"),
    Parameter("coat_thickness", "float", "of the layer, µm; it matters only with coat_absorption", "0"),
    Parameter(
        "base",
        "BSDF",
        "what lies under a dielectric surface (pigment): any BSDF that reflects and lets nothing through. Its value "
        "is multiplied by (1 − R_i)(1 − R_o), R at the angles of ω_i and ω_o to the surface",
        "none",
    ),
)

MANUAL = f"""A diffraction grating, given by the spectrum of its phase.

Parameters (XML or dictionary):
{listed(PARAMETERS)}

The x axis of the pattern is dp_du projected onto the plane perpendicular to the shading normal n; the y axis is n × x,
independent of dp_dv. The pattern therefore keeps its physical scale under stretched or sheared UVs, and mirrored UVs
rotate it without reflecting it; the back of a `twosided` shows its mirror image. On a mesh without UVs x follows the
first edge of each triangle and is discontinuous: such a mesh needs UVs. Where dp_du vanishes Mitsuba picks an axis.

The BRDF is R · K · G · S(q; κ)/λ² · E: R the power reflectance at the half vector, K and G as in `geometry.py`, S as in
`orders.py` (orders) or `spline_spectrum.py` (a lattice), with q = −(ω_i + ω_o)/λ along the pattern's axes
and κ = 2π (cos θ_i + cos θ_o)/λ. E, as in `energy.py`, bounds the albedo by one; it is one where the albedo is
below one without it. Without shadowing K diverges as 1/cos θ near the horizon, and there is no E.

Of rigorous theory the BRDF is Σ_m η_m N(q − m/T; σ_q² I)/λ², as in `rigorous_orders.py`: R, K, G and E are in η_m.

Under a coat (`coat.py`) all this holds inside of it, where wavelengths are shorter and directions steeper; the front
face of the coat is a mirror. A saved spectrum must cover the shorter wavelengths; one built from a recipe or a profile
does.

In polarised variants scalar theory reflects s and p light as a plane perpendicular to the half vector does; rigorous
theory uses the Mueller matrices of the orders. A perfect mirror and Schlick's formula depolarise.
"""


def define() -> type:
    """The plugin's class for the variant in force: its base class belongs to that variant."""

    class DiffractionGrating(mi.BSDF):
        __doc__ = MANUAL

        def __init__(self, props: mi.Properties) -> None:
            # Mitsuba registers an object when its base class is initialised, and Dr.Jit then calls it in every scene as
            # long as anything holds it, be it a traceback: all that may fail comes first.
            self.coat = coat_from(props)
            self.spectrum, self._recipe = surface_from(props, self.coat)
            self.rigorous = isinstance(self.spectrum, RigorousSpectrum)
            if not self.rigorous:
                warn_of_range(self.spectrum)
            self.reflectance = (
                check_parameters(props, self.spectrum, self.coat)
                if self.rigorous
                else reflectance_from(props, self.coat)
            )
            self.orientation = _orientation(props)
            height_scale = props.get("height_scale", 1.0)
            if not is_number(height_scale):
                raise RequestError(f"height_scale: got {height_scale!r}, wanted a number")
            self.height_scale = mi.Float(height_scale)
            self.shadowing = props.get("shadowing", "v_cavity")
            if self.shadowing not in SHADOWING:
                raise RequestError(f"shadowing: got {self.shadowing!r}, wanted one of {', '.join(SHADOWING)}")
            self.conserve_energy = props.get("conserve_energy", True)
            if not isinstance(self.conserve_energy, bool):
                raise RequestError(f"conserve_energy: got {self.conserve_energy!r}, wanted true or false")
            self._tables = SharedTables.of(self.spectrum)
            self.scattering = self._tables.scattering
            # The spectrum says nothing beyond its largest angle: there the grating is black.
            self.least_cosine = opaque(np.cos(np.deg2rad(self.spectrum.largest_angle)) * (1 - 1e-6))
            self.base = base_from(props)
            if self.base is not None and not self.reflectance.transparent:
                raise RequestError("base: got a BSDF below a conductor or a perfect mirror, which let no light through")
            self._update()
            mi.BSDF.__init__(self, props)
            flags = mi.BSDFFlags.GlossyReflection | mi.BSDFFlags.Anisotropic | mi.BSDFFlags.FrontSide
            if self.orientation.is_spatially_varying():
                flags = flags | mi.BSDFFlags.SpatiallyVarying
            # The grating is component 0; those of the base follow, and the front face of the coat.
            self.m_components = [+flags, *(self.base.components if self.base is not None else [])]
            self.front = len(self.m_components)
            if self.coat is not None:
                self.m_components.append(mi.BSDFFlags.DeltaReflection | mi.BSDFFlags.FrontSide)
            self.m_flags = functools.reduce(operator.or_, self.m_components)

        def _update(self) -> None:
            """What depends on parameters that can change."""
            if self.rigorous:
                self.energy = None
                return
            shortest = VISIBLE[0] / (1 if self.coat is None else self.coat.relative)
            largest = shortest / self.spectrum.wavelengths[0]
            if self.coat is not None and largest < 1 - 1e-6:
                raise RequestError(
                    f"coat_ior: got {self.coat.index:g}, and a spectrum for wavelengths from "
                    f"{self.spectrum.wavelengths[0]:g} nm; inside the coat they are shorter: build it from "
                    f"{shortest:.4g} nm"
                )
            # At wavelengths that the spectrum does not cover the grating is black, and κ is less at the others.
            largest = max(largest, 1.0)
            scale = np.max(self.height_scale)
            if not 0 <= scale <= largest * (1 + 1e-6):
                raise RequestError(
                    f"height_scale: got {scale:.6g}, wanted 0 to {largest:.4g}: the spectrum was built for "
                    f"wavelengths from {self.spectrum.wavelengths[0]:g} nm; for larger heights build it from "
                    f"{shortest:.4g} nm divided by the scale"
                )
            dr.make_opaque(self.height_scale)
            self.energy = self._tables.energy(self.shadowing, self.height_scale) if self.conserve_energy else None

        def traverse(self, callback: mi.TraversalCallback) -> None:
            callback.put("orientation", self.orientation, mi.ParamFlags.Differentiable)
            if not self.rigorous:
                callback.put("height_scale", self.height_scale, mi.ParamFlags.Differentiable)
            self.reflectance.traverse(callback)
            if self.base is not None:
                callback.put("base", self.base.bsdf, mi.ParamFlags.Differentiable)

        def parameters_changed(self, keys: list[str] = ()) -> None:
            if not keys or "height_scale" in keys:
                self._update()
            self.reflectance.update()

        def _frame(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> tuple[mi.Float, mi.Float]:
            """Sine and cosine of the angle from the tangent to the pattern's x axis."""
            return dr.sincos(dr.deg2rad(self.orientation.eval_1(si, active)))

        @dr.syntax
        def _grating(
            self, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool, drawn: bool
        ) -> tuple[mi.UnpolarizedSpectrum, mi.Float]:
            """f cos θ_o of the grating, and the density of its own samples, for directions above the surface.

            `drawn` tells that the directions are samples, so that nearly all of them meet an order.
            """
            sin, cos = self._frame(si, active)
            # From here on along the pattern's axes.
            wi, wo, outside = _turned(si.wi, sin, cos), _turned(wo, sin, cos), mi.Frame3f.cos_theta(wo)
            covered, count = self._covered(si)
            value, density = mi.UnpolarizedSpectrum(0.0), mi.Float(0.0)
            # Most directions lie between the orders of a grating at all wavelengths: unless drawn, they jump over what
            # follows.
            jumps = self.scattering.apart and not drawn
            needed = active & self._meets(si, -wi.x - wo.x, -wi.y - wo.y) if jumps else True
            # What has no derivative is bound here: Dr.Jit carries all other state through the branch.
            scattered, height_scale = functools.partial(self._scattered, si, covered, active, drawn), self.height_scale
            if needed:
                value, density = scattered(wi, wo, height_scale)
            # The mean over the covered wavelengths: any of them may have chosen the direction.
            diffuse = _diffuse_share(count)
            density = (1 - diffuse) * density * outside / larger(count, 1)
            return value, dr.fma(diffuse, dr.inv_two_pi, density)

        def _meets(self, si: mi.SurfaceInteraction3f, u: mi.Float, v: mi.Float) -> mi.Bool:
            """Whether the lobe of an order holds (u, v) = λq at any wavelength."""
            result = mi.Bool(False)
            for wavelength in si.wavelengths:
                frequency = 1e3 / wavelength
                result |= self.scattering.meets(u * frequency, v * frequency)
            return result

        def _scattered(
            self,
            si: mi.SurfaceInteraction3f,
            covered: list[mi.Bool],
            active: mi.Bool,
            drawn: bool,
            wi: mi.Vector3f,
            wo: mi.Vector3f,
            height_scale: mi.Float,
        ) -> tuple[mi.UnpolarizedSpectrum, mi.Float]:
            """f cos θ_o, and the sum over the wavelengths of the densities; directions along the pattern's axes."""
            geometry = Geometry.of(wi, wo, self.coat)
            # Directions beyond the largest angle are black, but they are drawn: they have a density.
            within = smaller(geometry.cos_i, geometry.cos_o) >= self.least_cosine
            value, density = mi.UnpolarizedSpectrum(0.0), mi.Float(0.0)
            for channel in range(len(value)):
                wavelength = si.wavelengths[channel] * 1e-3  # µm
                frequency = dr.rcp(wavelength)
                incidence = Incidence.of(wi, frequency, height_scale, self.coat)
                surface = () if self.rigorous else (height_scale, self.shadowing == "v_cavity")
                power, share = self.scattering.evaluate(geometry, *surface, incidence, active & covered[channel], drawn)
                value[channel] = dr.select(within, power * dr.square(frequency), 0)
                density = dr.fma(share, dr.square(frequency), density)
            if not self.rigorous:
                if self.energy is not None:
                    inside = mi.UnpolarizedSpectrum(si.wavelengths) * (1e-3 / geometry.index)
                    value *= self.energy.factor(*geometry.inside(), inside)
                value *= self.reflectance(si, geometry.cos_half(), active)
            if self.coat is not None:
                # The solid angle inside the coat is smaller: cos θ'_o dω'_o = cos θ_o dω_o/n².
                value *= wo.z / larger(geometry.cos_o, 1e-7)
            return value, density

        def _mueller(
            self,
            value: mi.UnpolarizedSpectrum,
            ctx: mi.BSDFContext,
            si: mi.SurfaceInteraction3f,
            wo: mi.Vector3f,
            active: mi.Bool,
        ) -> mi.Spectrum:
            """`value` as light that is split into s and p where the variant and the material know them.

            Under a coat, after both passes through it, T_i T_o.
            """
            directions = si.wi, wo
            if self.coat is None:
                return reflected(self._split(value, si, active), *directions, ctx.mode) if mi.is_polarized else value
            inside = [self.coat.refracted(omega) for omega in directions]
            if mi.is_polarized:
                value *= self.coat.absorption(inside[0].z) * self.coat.absorption(inside[1].z)
                return through_layer(self._split(value, si, active), self.coat.eta, directions, inside, ctx.mode)
            for omega, refracted in zip(directions, inside, strict=True):
                value *= self.coat.transmittance(omega.z, refracted.z)
            return value

        def _split(self, value: mi.UnpolarizedSpectrum, si: mi.SurfaceInteraction3f, active: mi.Bool) -> Split:
            """How the grating splits `value` into s and p."""
            if not self.rigorous:
                index = self.reflectance.index(si, active)
                return unpolarised(value) if index is None else of_plane(value, index)
            sin, cos = self._frame(si, active)
            relative = 1e3 if self.coat is None else 1e3 * self.coat.relative

            def entries(channel: int, source: mi.Vector3f, exit_: mi.Vector3f) -> list[list[mi.Float]]:
                frequency = relative / si.wavelengths[channel]
                return self.scattering.mueller(_turned(source, sin, cos), _turned(exit_, sin, cos), frequency, active)

            return of_orders(value, entries, mi.Vector3f(-sin, cos, 0))

        def _covered(self, si: mi.SurfaceInteraction3f) -> tuple[list[mi.Bool], mi.Float]:
            """Which of the wavelengths the spectrum covers, and how many: at the others the grating is black."""
            index = 1 if self.coat is None else self.coat.relative
            shortest, longest = (
                w * index * d for w, d in zip(self.spectrum.wavelengths, (1 - 1e-6, 1 + 1e-6), strict=True)
            )
            covered = [(wavelength >= shortest) & (wavelength <= longest) for wavelength in si.wavelengths]
            return covered, sum(dr.select(c, mi.Float(1), 0) for c in covered)

        def _entering(self, si: mi.SurfaceInteraction3f, cos: mi.Float, active: mi.Bool) -> mi.UnpolarizedSpectrum:
            """1 − R, times T of the coat, at the cosine of an angle outside."""
            if self.coat is None:
                return 1 - self.reflectance(si, cos, active)
            inside = self.coat.cos_inside(cos)
            return self.coat.transmittance(cos, inside) * (1 - self.reflectance(si, inside, active))

        def _lobes(self, ctx: mi.BSDFContext) -> tuple[bool, mi.BSDFContext | None]:
            """Whether `ctx` asks for the grating, and what it asks of the base."""
            grating = ctx.is_enabled(mi.BSDFFlags.GlossyReflection, 0)
            return grating, None if self.base is None else self.base.context(ctx, before=1)

        def _share(
            self,
            si: mi.SurfaceInteraction3f,
            lobes: tuple[bool, mi.BSDFContext | None],
            entering: mi.UnpolarizedSpectrum,
            active: mi.Bool,
        ) -> mi.Float:
            """The share of samples that the grating gets; that of the base is the rest. About as they reflect."""
            grating, below = lobes
            if not grating or below is None:
                return mi.Float(1.0 if grating else 0.0)
            entered = dr.mean(entering)
            reflected = 1 - entered
            returned = entered * self.base.albedo(si, active)
            return dr.detach(dr.clip(reflected / (reflected + returned), LEAST_SHARE, 1 - LEAST_SHARE))

        def _front_share(
            self,
            ctx: mi.BSDFContext,
            si: mi.SurfaceInteraction3f,
            lobes: tuple[bool, mi.BSDFContext | None],
            active: mi.Bool,
        ) -> mi.Float:
            """The share of samples that the coat's front face gets, about as it reflects beside all below."""
            if self.coat is None or not ctx.is_enabled(mi.BSDFFlags.DeltaReflection, self.front):
                return mi.Float(0.0)
            grating, below = lobes
            if not grating and below is None:
                return mi.Float(1.0)
            cos = mi.Frame3f.cos_theta(si.wi)
            reflected = self.reflectance(si, self.coat.cos_inside(cos), active)
            if below is not None:
                reflected += (1 - reflected) * self.base.albedo(si, active)
            return self.coat.share(cos, dr.mean(reflected))

        def eval_pdf(
            self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool = True
        ) -> tuple[mi.Spectrum, mi.Float]:
            return self._eval_pdf(ctx, si, wo, active, drawn=False)

        def _eval_pdf(
            self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool, *, drawn: bool
        ) -> tuple[mi.Spectrum, mi.Float]:
            cos_i, cos_o = mi.Frame3f.cos_theta(si.wi), mi.Frame3f.cos_theta(wo)
            active = active & (cos_i > 0) & (cos_o > 0)
            lobes = grating, below = self._lobes(ctx)
            value, pdf = mi.Spectrum(0.0), mi.Float(0.0)
            if grating:
                of_grating, pdf = self._grating(si, wo, active, drawn)
                value = self._mueller(of_grating, ctx, si, wo, active)
            if below is not None:
                entering = self._entering(si, cos_i, active)
                share = self._share(si, lobes, entering, active)
                of_base, density = self.base.bsdf.eval_pdf(below, si, wo, active)
                value += _attenuated(entering * self._entering(si, cos_o, active), of_base)
                pdf = share * pdf + (1 - share) * density
            pdf *= 1 - self._front_share(ctx, si, lobes, active)
            return dr.select(active, value, 0), dr.select(active, pdf, 0)

        def eval(
            self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool = True
        ) -> mi.Spectrum:
            return self.eval_pdf(ctx, si, wo, active)[0]

        def pdf(
            self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool = True
        ) -> mi.Float:
            return self.eval_pdf(ctx, si, wo, active)[1]

        def sample(
            self,
            ctx: mi.BSDFContext,
            si: mi.SurfaceInteraction3f,
            sample1: mi.Float,
            sample2: mi.Point2f,
            active: mi.Bool = True,
        ) -> tuple[mi.BSDFSample3f, mi.Spectrum]:
            cos_i = mi.Frame3f.cos_theta(si.wi)
            active = active & (cos_i > 0)
            lobes = grating, below = self._lobes(ctx)
            bs = dr.zeros(mi.BSDFSample3f)
            front_share = self._front_share(ctx, si, lobes, active)
            of_front = active & (sample1 < front_share)
            if grating or below is not None:
                # From behind and along the horizon the front reflects all; Python's numbers cannot be divided by zero.
                below_front = dr.select(front_share < 1, 1 - front_share, 1)
                rest = smaller((sample1 - front_share) / below_front, BELOW_ONE)
                bs, result = self._sample_below(
                    ctx, si, lobes, 1 - front_share, rest, sample2, active & (sample1 >= front_share)
                )
            elif self.coat is not None and ctx.is_enabled(mi.BSDFFlags.DeltaReflection, self.front):
                result = mi.Spectrum(0.0)
            else:
                return bs, mi.Spectrum(0.0)
            bs.eta = 1.0
            if self.coat is not None:
                bs.wo = dr.select(of_front, mi.reflect(si.wi), bs.wo)
                bs.pdf = dr.select(of_front, front_share, bs.pdf)
                bs.sampled_type = dr.select(of_front, mi.UInt32(+mi.BSDFFlags.DeltaReflection), bs.sampled_type)
                bs.sampled_component = dr.select(of_front, self.front, bs.sampled_component)
                mirrored = self._front(si, ctx) / dr.select(of_front, front_share, 1)
                result = dr.select(of_front, mirrored, result)
            return bs, result

        def _front(self, si: mi.SurfaceInteraction3f, ctx: mi.BSDFContext) -> mi.Spectrum:
            """F of the coat's front face."""
            value = mi.UnpolarizedSpectrum(self.coat.reflectance(mi.Frame3f.cos_theta(si.wi)))
            if not mi.is_polarized:
                return value
            return reflected(of_plane(value, self.coat.indices()), si.wi, mi.reflect(si.wi), ctx.mode)

        def _sample_below(
            self,
            ctx: mi.BSDFContext,
            si: mi.SurfaceInteraction3f,
            lobes: tuple[bool, mi.BSDFContext | None],
            part: mi.Float,
            sample1: mi.Float,
            sample2: mi.Point2f,
            active: mi.Bool,
        ) -> tuple[mi.BSDFSample3f, mi.Spectrum]:
            """A sample of the grating or its base, which get `part` of all samples."""
            grating, below = lobes
            cos_i = mi.Frame3f.cos_theta(si.wi)
            bs = dr.zeros(mi.BSDFSample3f)
            bs.sampled_type = mi.UInt32(+mi.BSDFFlags.GlossyReflection)
            entering = self._entering(si, cos_i, active) if below is not None else None
            share = self._share(si, lobes, entering, active)
            of_base = active & (sample1 >= share)
            if grating:
                bs.wo = self._draw(si, sample1 / share, sample2, active & (sample1 < share))
            if below is not None:
                rest = smaller((sample1 - share) / (1 - share), BELOW_ONE)
                drawn, weight = self.base.bsdf.sample(below, si, rest, sample2, of_base)
                bs.wo = dr.select(of_base, drawn.wo, bs.wo)
                bs.sampled_type = dr.select(of_base, drawn.sampled_type, bs.sampled_type)
                bs.sampled_component = dr.select(of_base, drawn.sampled_component + 1, 0)
            value, bs.pdf = self._eval_pdf(ctx, si, bs.wo, active, drawn=True)
            valid = active & (bs.pdf > 0)
            # The direction does not follow the parameters, so its density must not either.
            result = dr.select(valid, value / dr.detach(dr.select(valid, bs.pdf, 1)), 0)
            if below is not None and self.base.has_delta:
                mirror = of_base & mi.has_flag(drawn.sampled_type, mi.BSDFFlags.Delta)
                cos_o = mi.Frame3f.cos_theta(drawn.wo)
                own = part * (1 - share)
                through = entering * self._entering(si, cos_o, mirror) / own
                above = cos_o > 0
                bs.pdf = dr.select(mirror, dr.select(above, own * drawn.pdf, 0), bs.pdf)
                result = dr.select(mirror, dr.select(above, _attenuated(through, weight), 0), result)
            return bs, result

        def _draw(self, si: mi.SurfaceInteraction3f, u: mi.Float, v: mi.Point2f, active: mi.Bool) -> mi.Vector3f:
            """A direction for one of the wavelengths; below the horizon (z = 0) where its order is evanescent."""
            covered, count = self._covered(si)
            share = _diffuse_share(count)
            # In scalar variants these are Python's, for which ~ is no negation.
            diffuse, diffracted = u < share, u >= share
            u = (u - share) / larger(1 - share, DEFENSIVE)
            # Only wavelengths that the spectrum covers draw directions.
            chosen = smaller(dr.floor(u * count), larger(count - 1, 0))
            rest = limited(u * count - chosen, 0, BELOW_ONE)
            wavelength, before = mi.Float(si.wavelengths[0]), mi.Float(0.0)
            for channel, use in enumerate(covered):
                wavelength = dr.select(use & (before == chosen), si.wavelengths[channel], wavelength)
                before += dr.select(use, 1, 0)
            wavelength = dr.detach(wavelength) * 1e-3
            sin, cos = (dr.detach(x) for x in self._frame(si, active))
            towards, frequency = _turned(si.wi, sin, cos), dr.rcp(wavelength)
            incidence = Incidence.of(towards, frequency, self.height_scale, self.coat)
            q, propagates = self.scattering.sample(incidence, rest, v, active & diffracted)
            x = -wavelength * (cos * q.x - sin * q.y) - si.wi.x
            y = -wavelength * (sin * q.x + cos * q.y) - si.wi.y
            z = dr.select(propagates, dr.safe_sqrt(1 - dr.square(x) - dr.square(y)), 0)
            return dr.select(diffuse, mi.warp.square_to_uniform_hemisphere(v), mi.Vector3f(x, y, z))

        # What the real-time shader asks of a grating: `evaluation.realtime_shader.surfaces.ShadedGrating`.

        def heights(self) -> tuple[HeightField, float]:
            """The height field and its coherence length in µm.

            Raises:
                ValueError: for a saved spectrum, which does not hold heights.
            """
            if self._recipe is None:
                raise RequestError(
                    "diffraction_shader: it needs heights, and a saved spectrum does not hold them; give the grating a "
                    "recipe (filename=….toml) or a profile"
                )
            coherence_length = self._recipe.spectrum.get("coherence_length", SUN_COHERENCE_LENGTH)
            return self._recipe.height_field(), float(coherence_length)

        def along_pattern(self, si: mi.SurfaceInteraction3f, omega: mi.Vector3f, active: mi.Bool) -> mi.Vector3f:
            """A direction of the shading frame, along the pattern's axes."""
            return _turned(omega, *self._frame(si, active))

        def transmitted(self, si: mi.SurfaceInteraction3f, cos_o: mi.Float, active: mi.Bool) -> mi.UnpolarizedSpectrum:
            """(1 − R_i)(1 − R_o): what the surface, and its coat, let through to the base and back."""
            return self._entering(si, mi.Frame3f.cos_theta(si.wi), active) * self._entering(si, cos_o, active)

        def to_string(self) -> str:
            lines = [
                f"spectrum = {self.spectrum.source}",
                f"{self.spectrum.extent} = {self.spectrum.grid}",
                f"coherence_length = {self.spectrum.coherence_length:g} um",
                f"representation = {self.spectrum.representation}, {self.spectrum.megabytes:.3g} MB",
                f"reflectance = {self.reflectance}",
                *([] if self.coat is None else [f"coat = {self.coat}"]),
                f"orientation = {self.orientation}",
                f"height_scale = {self.height_scale}",
                f"shadowing = {self.shadowing}",
                f"energy = {self.energy or ('conserved by itself' if self.conserve_energy else 'not conserved')}",
            ]
            if self.rigorous:
                del lines[-3:]
            return "DiffractionGrating[\n" + "".join(f"  {line},\n" for line in lines) + "]"

    return DiffractionGrating


def _orientation(props: mi.Properties) -> mi.Texture:
    angle = props.get("orientation", 0.0)
    if isinstance(angle, float) and not np.isfinite(angle):
        raise RequestError(f"orientation: got {angle}, wanted degrees or a texture")
    return props.get_texture("orientation", 0.0)


def _diffuse_share(covered: mi.Float) -> mi.Float:
    """Return the share of samples that are uniform: all of them where no wavelength is covered."""
    return dr.select(covered > 0, mi.Float(DEFENSIVE), 1)


def _turned(omega: mi.Vector3f, sin: mi.Float, cos: mi.Float) -> mi.Vector3f:
    """ω along the pattern's axes."""
    return mi.Vector3f(cos * omega.x + sin * omega.y, cos * omega.y - sin * omega.x, omega.z)


def _attenuated(factor: mi.UnpolarizedSpectrum, value: mi.Spectrum) -> mi.Spectrum:
    """`value` (a Mueller matrix in polarised variants) times `factor`."""
    return mi.mueller.absorber(factor) @ value if mi.is_polarized else factor * value
