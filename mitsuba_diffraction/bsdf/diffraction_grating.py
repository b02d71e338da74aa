"""The class behind `<bsdf type="diffraction_grating">`."""

from __future__ import annotations

import functools
import operator

import mitsuba as mi

from ..errors import RequestError
from ..manual import Parameter, listed
from ..recipe import Recipe, parameters_of_profile
from ..surface.gratings import PROFILES
from .base import base_from
from .layers import Layers
from .parameters import GratingRequest

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
    Parameter("tolerance", "float", "for a profile, or to override a recipe, as in `precompute`"),
    Parameter(
        "representation",
        "string",
        "likewise: slices (default), or, of the orders of one tile, a series of amplitudes, taylor or chebyshev",
    ),
    Parameter("terms", "integer", "of a series; by default as many as the tolerance needs"),
    Parameter("heights_from", "string", "of a series, the level of h = 0: mean (default) or lowest"),
    Parameter(
        "theory",
        "string",
        "for a profile: scalar, or rigorous, Maxwell's equations for the given material and gratings of one row; files "
        "and spectra have their theory. Rigorous efficiencies exclude height_scale, lateral_scale, shadowing, fresnel "
        "and base",
        "scalar",
    ),
    Parameter("int_ior, ext_ior", "float or string", "a dielectric, as in Mitsuba's `dielectric`", "1.5, air"),
    Parameter(
        "material", "string", 'a conductor instead, as in Mitsuba\'s `conductor`; "none" is the perfect mirror, R = 1'
    ),
    Parameter("fresnel", "string", "exact, or Schlick's approximation schlick", "exact"),
    Parameter(
        "orientation",
        "float, texture or string",
        "degrees from the tangent dp_du to the pattern's x axis; or radial, x points away from the centre (0.5, 0.5) "
        "of UV space, or tangential, around it; or the file of a picture, of integers from 0° (black) to 360° (white)",
        "0",
    ),
    Parameter("height_scale", "float, texture or string", "scales the heights; a string is the file of a picture", "1"),
    Parameter(
        "lateral_scale",
        "float, texture or string",
        "scales the lengths along the surface, but not the widths of lobes; for orders that do not overlap",
        "1",
    ),
    Parameter("shadowing", "string", "v_cavity or none", "v_cavity"),
    Parameter("conserve_energy", "boolean", "false leaves out E, to compare with closed forms", "true"),
    Parameter(
        "coat_ior",
        "float or string",
        "index of a clear plane layer over the grating, as for int_ior; with that of the outside there is no layer",
        "none",
    ),
    Parameter("coat_absorption", "float", "of the layer, 1/µm", "0"),
    Parameter("coat_thickness", "float", "of the layer, µm; it matters only with coat_absorption", "0"),
    Parameter(
        "transmission",
        "string",
        "of a dielectric: none, transmitted light is absorbed or reaches the base; interface, there is the medium of "
        "int_ior below, as in `roughdielectric`; sheet, a film with a flat lower face and ext_ior on both sides. A "
        "rigorous spectrum must be built for it",
        "none",
    ),
    Parameter(
        "base",
        "BSDF, float or string",
        "what lies under a dielectric surface (pigment): any BSDF that only reflects; a number or a colour such as "
        "#a0522d is that of a diffuse one. Its value is multiplied by "
        "(1 − R_i)(1 − R_o), R at the angles of ω_i and ω_o to the surface",
        "none",
    ),
)

MANUAL = f"""A diffraction grating, given by the power spectrum of e^{{iκh}}, h the height of its surface.

Parameters (XML or dictionary):
{listed(PARAMETERS)}

The x axis of the pattern is dp_du projected onto the plane perpendicular to the shading normal n; the y axis is n × x,
independent of dp_dv. The pattern therefore keeps its physical scale under stretched or sheared UVs, and mirrored UVs
rotate it without reflecting it; the back of a `twosided` shows its mirror image. On a mesh without UVs x follows the
first edge of each triangle and is discontinuous: such a mesh needs UVs. Where dp_du vanishes Mitsuba picks an axis.

The BRDF is R · K · G · S(q; κ)/λ² · E: R the power reflectance at the half vector, K and G as in `geometry.py`, S as in
`orders.py` (orders) or `continuum.py` (a lattice), with q = −(ω_i + ω_o)_∥/λ along the pattern's axes
and κ = 2π (cos θ_i + cos θ_o)/λ. Orders have K and G of their own, and a gain Γ that compensates the part of a lobe
below the horizon; a continuum has those of the pair of directions. E, as in `energy.py`, bounds the albedo by about
one; it is one where the albedo without it is below one. Without shadowing K diverges as 1/cos θ near the horizon, and
there is no E.

For rigorous theory the BRDF is Σ_m η_m Γ N(q − m/T; σ_q² I)/λ², as in `rigorous_orders.py`: η_m includes R, K, G and
E. With a transmission the sum has the factor n_o², n_o the index of the medium of ω_o. The efficiencies of a sheet
include all of its light: the reflection by its flat face is a lobe of order 0, which is specular in scalar theory, and
multiple reflections inside contribute to the orders.

With a transmission (`geometry.py`), light is incident from above or below: q and κ have the indices of both media,
transmitted light has 1 − R instead of R, and G is another one (`geometry.k_g`). From below, the flat face of a sheet
reflects specularly.

Under a coat (`coat.py`) all this holds inside it, where wavelengths are shorter and directions steeper; the front face
of the coat reflects specularly. A saved spectrum must cover the shorter wavelengths; one built from a recipe or a
profile does.

In polarised variants, scalar theory splits s and p light like a plane perpendicular to the half vector; rigorous
theory uses the Mueller matrices of the orders. A perfect mirror and Schlick's formula depolarise.
"""


def refuse_unknown(props: mi.Properties) -> None:
    """Check the names of all parameters but nested BSDFs, before anything is computed.

    Raises:
        RequestError: with the known names, if one is unknown.
    """
    known = {name for parameter in PARAMETERS for name in parameter.name.split(", ")}
    if "profile" in props:
        if (profile := props["profile"]) not in PROFILES:
            return  # `surface_from` lists them
        known.update(parameters_of_profile(profile))
    nested = {name for name, value in props.objects() if isinstance(value, mi.BSDF)}
    if unknown := sorted(set(props.keys()) - known - nested):
        raise RequestError(f"{', '.join(unknown)}: unknown, wanted one of {', '.join(sorted(known))}")


def check(props: mi.Properties) -> None:
    """Check all parameters without computing a spectrum.

    Raises:
        RequestError: if a name is unknown or a value wrong.
        FileNotFoundError: if there is no such file.
    """
    refuse_unknown(props)
    base_from(props)
    surface = GratingRequest.of(props).surface
    if isinstance(surface, Recipe):
        surface.check()


def define() -> type:
    """Return the plugin's class for the variant in force: its base class belongs to that variant."""

    class DiffractionGrating(mi.BSDF):
        __doc__ = MANUAL

        def __init__(self, props: mi.Properties) -> None:
            # The initialiser of the base class registers the object, which Dr.Jit then calls in all scenes as long as
            # it exists, even if only a traceback refers to it: therefore errors must occur before.
            refuse_unknown(props)
            self.layers = Layers(props)
            self.spectrum = self.layers.grating.spectrum
            mi.BSDF.__init__(self, props)
            self.m_components = self.layers.components
            self.m_flags = functools.reduce(operator.or_, self.m_components)

        def traverse(self, callback: mi.TraversalCallback) -> None:
            self.layers.traverse(callback)

        def parameters_changed(self, keys: list[str] = ()) -> None:
            self.layers.grating.theory.parameters_changed(keys)

        def eval_pdf(
            self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool = True
        ) -> tuple[mi.Spectrum, mi.Float]:
            return self.layers.evaluate(ctx, si, wo, active)

        def eval(
            self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool = True
        ) -> mi.Spectrum:
            return self.layers.evaluate(ctx, si, wo, active)[0]

        def pdf(
            self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool = True
        ) -> mi.Float:
            return self.layers.evaluate(ctx, si, wo, active)[1]

        def sample(
            self,
            ctx: mi.BSDFContext,
            si: mi.SurfaceInteraction3f,
            sample1: mi.Float,
            sample2: mi.Point2f,
            active: mi.Bool = True,
        ) -> tuple[mi.BSDFSample3f, mi.Spectrum]:
            return self.layers.sample(ctx, si, sample1, sample2, active)

        def to_string(self) -> str:
            lines = "\n".join(f"  {line}," for line in str(self.layers.grating).splitlines())
            return f"DiffractionGrating[\n{lines}\n]"

    return DiffractionGrating
