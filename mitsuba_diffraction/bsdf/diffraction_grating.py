"""The class behind `<bsdf type="diffraction_grating">`."""

from __future__ import annotations

import functools
import operator

import mitsuba as mi

from ..manual import Parameter, listed
from .layers import Layers

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
        "representation",
        "string",
        "likewise: slices (default), or, of the orders of one tile, a series of amplitudes, taylor or chebyshev",
    ),
    Parameter("terms", "integer", "of a series; by default as many as the tolerance needs"),
    Parameter("heights_from", "string", "of a series, the level of h = 0: mean (default) or lowest"),
    Parameter(
        "theory",
        "string",
        "of a profile: scalar, or rigorous, Maxwell's equations for the material that is given and for gratings of one "
        "row; files and spectra say which they are. Rigorous efficiencies exclude height_scale, lateral_scale, "
        "shadowing, fresnel and base",
        "scalar",
    ),
    Parameter("int_ior, ext_ior", "float or string", "a dielectric, as in Mitsuba's `dielectric`", "1.5, air"),
    Parameter(
        "material", "string", 'a conductor instead, as in Mitsuba\'s `conductor`; "none" is the perfect mirror, R = 1'
    ),
    Parameter("fresnel", "string", "exact, or Schlick's approximation schlick", "exact"),
    Parameter("orientation", "float or texture", "degrees from the tangent dp_du to the pattern's x axis", "0"),
    Parameter("height_scale", "float or texture", "scales the heights", "1"),
    Parameter(
        "lateral_scale",
        "float or texture",
        "scales the lengths along the surface, but not the lobes, of orders that do not overlap",
        "1",
    ),
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
        "transmission",
        "string",
        "light that enters a dielectric: none, it is absorbed or reaches the base; interface, it enters the medium of "
        "int_ior, as in `roughdielectric`; sheet, it passes a film with one flat face, below, and ext_ior on both "
        "sides. A rigorous spectrum must be built for it",
        "none",
    ),
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
`orders.py` (orders) or `continuum.py` (a lattice), with q = −(ω_i + ω_o)/λ along the pattern's axes
and κ = 2π (cos θ_i + cos θ_o)/λ. E, as in `energy.py`, bounds the albedo by one; it is one where the albedo is
below one without it. Without shadowing K diverges as 1/cos θ near the horizon, and there is no E.

Of rigorous theory the BRDF is Σ_m η_m N(q − m/T; σ_q² I)/λ², as in `rigorous_orders.py`: R, K, G and E are in η_m.
Where light passes, the sum has the factor n_o², n_o the index of the medium of ω_o. The efficiencies of a sheet hold
all of its light: what its flat face reflects is a lobe of order 0, where scalar theory has a mirror, and light that is
reflected back and forth inside leaves in the orders into which it is diffracted.

With a transmission (`geometry.py`), light passes the grating from either side: q and κ as above with the indices of
both media, 1 − R for R, and the K and G of `geometry.transmitted`. From below, a sheet's flat face is a mirror.

Under a coat (`coat.py`) all this holds inside of it, where wavelengths are shorter and directions steeper; the front
face of the coat is a mirror. A saved spectrum must cover the shorter wavelengths; one built from a recipe or a profile
does.

In polarised variants scalar theory splits s and p light as a plane perpendicular to the half vector does; rigorous
theory uses the Mueller matrices of the orders. A perfect mirror and Schlick's formula depolarise.
"""


def define() -> type:
    """Return the plugin's class for the variant in force: its base class belongs to that variant."""

    class DiffractionGrating(mi.BSDF):
        __doc__ = MANUAL

        def __init__(self, props: mi.Properties) -> None:
            # Mitsuba registers an object when its base class is initialised, and Dr.Jit then calls it in every scene as
            # long as anything holds it, be it a traceback: all that may fail comes first.
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
