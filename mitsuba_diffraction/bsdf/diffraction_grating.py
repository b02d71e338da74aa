"""The class behind `<bsdf type="diffraction_grating">`."""

from __future__ import annotations

import functools
import operator
from collections.abc import Sequence

import mitsuba as mi

from ..errors import RequestError, did_you_mean
from ..optics.refractive_indices import DISPERSION
from ..parameter_documentation import Parameter, listed
from ..precomputation.recipe import MAX_PATCHES, Recipe, parameters_of_profile
from ..surface.gratings import PROFILES
from .base import living
from .layers import Layers
from .parameters import GratingRequest
from .thin_film import MAX_THICKNESS

PARAMETERS = (
    Parameter(
        "filename",
        "string",
        "a spectrum file (`.exr`), a recipe (`.toml`), whose spectrum is computed once and "
        "[cached](commands.md#caches-and-damaged-files), or the [name](commands.md#names-of-surfaces) of a profile or "
        "recipe of the package",
    ),
    Parameter("spectrum", "GratingSpectrum or RigorousSpectrum", "a spectrum from Python, in `load_dict` only"),
    Parameter(
        "profile",
        "string",
        f"an analytic surface instead of a file, one of {', '.join(f'`{name}`' for name in PROFILES)}. It takes the "
        "parameters of the function of that name in [`mitsuba_diffraction.gratings`](reference/surfaces.md), with "
        "lengths in µm, and [`coherence_length`](own_grating.md#coherence-length) (65 µm, 26 with a `seed`) and "
        "`largest_height_range` (20 µm). For a random surface (one with a `seed`), `patches` is the number of seeds "
        f"over which the spectrum is averaged, by default 48 for discs and 16 for the others, at most {MAX_PATCHES}",
    ),
    Parameter(
        "tolerance",
        "float",
        "[tolerance](own_grating.md#tolerance) of the spectrum; for a profile, or for a recipe, whose value it "
        "replaces",
    ),
    Parameter(
        "representation",
        "string",
        "for a profile or recipe, how the powers of orders are stored: as `slices` (default) or, for one tile, by a "
        "[series of the amplitudes](theory.md#tables), `taylor` or `chebyshev`",
    ),
    Parameter(
        "terms",
        "integer or string",
        "number of terms of a series, or `auto` (default): as many as the tolerance needs. An error above the "
        "tolerance is logged; an error of 1 or more is refused, unless `tolerance`, then also above 1, allows it",
    ),
    Parameter(
        "heights_from",
        "string",
        "for a series, the level of h = 0: `mean` (default), or `lowest`, as in the shader of 2014",
    ),
    Parameter(
        "theory",
        "string",
        "theory used for a `profile`: `scalar`, or `rigorous`, Maxwell's equations for line gratings in the given "
        "material; files and spectra specify their own",
        "scalar",
    ),
    Parameter(
        "int_ior, ext_ior",
        "float or string",
        "a dielectric: a number or a name, as in Mitsuba's `dielectric`; `int_ior` also a [medium with dispersion or a "
        f"file](materials.md#refractive-indices): {', '.join(f'`{name}`' for name in DISPERSION)}, or a table "
        "(`.spd`, `.csv`, `.yml`)",
        "1.5, air",
    ),
    Parameter(
        "material",
        "string",
        "a conductor instead: a name as in Mitsuba's `conductor`, or `Ti` (Johnson and Christy 1974), or a "
        "[file](materials.md#refractive-indices), or `none` for a perfect mirror, R = 1",
    ),
    Parameter(
        "eta, k",
        "float, spectrum or texture",
        "the index η + ik of a conductor instead, as in Mitsuba's `conductor`; `k` is 0 by default",
    ),
    Parameter(
        "thin_film_thickness",
        "float, texture or string",
        "thickness of a [film on the relief](materials.md#a-thin-film), µm along the normal; a string is the file of a "
        "picture, whose integers are from 0 (black) to 1 µm (white), or a list of the thicknesses of [several "
        f"films](materials.md#a-stack-of-films), from the outside in, at most {MAX_THICKNESS:g} in all. Scalar theory "
        "only",
        "0",
    ),
    Parameter(
        "thin_film_ior",
        "float or string",
        "index of the film: a number, a name or a file, as for `int_ior` or `material`; or a list of as many indices, "
        "such as `2.35, 1.38, 2.35` or `8 x (2.35, 1.38)`",
        "none",
    ),
    Parameter("thin_film_scale", "float, texture or string", "factor of the thickness of all films", "1"),
    Parameter(
        "orientation",
        "float, texture or string",
        "angle from the tangent dp/du to the pattern's x axis, degrees; `radial`: x points away from the centre, on "
        "meshes (0.5, 0.5) of UV space; `tangential`: x runs around it; or the file of a picture, of integers from 0° "
        "(black) to 360° (white)",
        "0",
    ),
    Parameter("height_scale", "float, texture or string", "scales the heights; a string is the file of a picture", "1"),
    Parameter(
        "lateral_scale",
        "float, texture or string",
        "scales the lengths along the surface by s: orders of a period T lie at m/(sT), lobes keep their width; for "
        "orders that do not overlap",
        "1",
    ),
    Parameter("shadowing", "string", "shadowing and masking, G: `v_cavity` or `none`", "v_cavity"),
    Parameter("conserve_energy", "boolean", "false leaves out the factor E, to compare with closed forms", "true"),
    Parameter(
        "coat_ior",
        "float or string",
        "index of a clear plane layer over the grating, as for `int_ior`; no layer if it equals that of the outside",
        "none",
    ),
    Parameter(
        "transmission",
        "string",
        "light that enters a dielectric: `none`, it is absorbed or reaches the base; `interface`, it enters the medium "
        "of `int_ior`, as in `roughdielectric`; `sheet`, it is transmitted by a film whose lower face is flat, with "
        "`ext_ior` on both sides. A rigorous spectrum must be built for it",
        "none",
    ),
    Parameter(
        "base",
        "BSDF, float or string",
        "layer below a dielectric surface (pigment): any BSDF that reflects and does not transmit; a number or a "
        "colour such as `#a0522d` means a diffuse one. It is multiplied by (1 − R_i)(1 − R_o), with R at the angles of "
        "ω_i and ω_o to the shading normal",
        "none",
    ),
)

MANUAL = f"""A diffraction grating, given by the power spectrum of e^{{iκh}}, with h the height of its surface.

Parameters (XML or dictionary):
{listed(PARAMETERS)}

The x axis of the pattern is dp_du projected onto the plane perpendicular to the shading normal n; the y axis is n × x,
independent of dp_dv. The pattern therefore keeps its physical scale under stretched or sheared UVs, and mirrored UVs
rotate it without reflecting it. The back of a `twosided` shows its mirror image. On a mesh without UVs, x follows the
first edge of each triangle and is discontinuous: add UVs. Where dp_du vanishes, Mitsuba chooses an axis.

The BRDF is R · K · G · S(q; κ)/λ² · E, with q = −(ω_i + ω_o)_∥/λ along the pattern's axes and
κ = 2π (cos θ_i + cos θ_o)/λ. R is the power reflectance at the half vector (`fresnel.py`, with a film `thin_film.py`),
K, G and the gain Γ of orders are computed in `optics/geometry.py`, S in `orders.py` (orders) or `continuum.py` (a
lattice). E (`energy_factor.py`) bounds the albedo by about one. Without shadowing there is no E, as K diverges near the
horizon. In rigorous theory the BRDF is Σ_m η_m Γ N(q − m/T; σ_q² I)/λ² (`rigorous_orders.py`).

With transmission (`directions.py`), light is incident from above or below; transmitted light has the factor n_o², where
n_o is the index of the medium of ω_o, and T instead of R. The flat face of a sheet reflects light from below
specularly; in rigorous theory its reflections are part of the efficiencies. Under a coat (`coat.py`) all this holds for
the wavelengths and directions inside it, and its front face reflects specularly. A saved spectrum must cover the
shorter wavelengths inside; one built from a recipe or a profile does.

In polarised variants, scalar theory polarises as a plane perpendicular to the half vector does; rigorous theory uses
the Mueller matrices of the orders. A perfect mirror depolarises.
"""


def refuse_wrong(props: mi.Properties) -> None:
    """Check the names and the types of all parameters, before anything is computed.

    Raises:
        RequestError: with the known names, if one is unknown; if one is a colour, a vector or a spectrum, or an object
            where it must be a number or a text.
    """
    types = {name: parameter.type for parameter in PARAMETERS for name in parameter.name.split(", ")}
    kinds, objects, profile = mi.Properties.Type, dict(props.objects()), props.get("profile")
    is_known = isinstance(profile, str) and profile in PROFILES
    nested = {name for name, value in objects.items() if isinstance(value, mi.BSDF)}  # `base_from` names others
    # `profile_name` refuses unknown profiles.
    known = {*types, *(parameters_of_profile(profile) if is_known else ())}
    if (profile is None or is_known) and (unknown := sorted(set(props.keys()) - known - nested)):
        of_profiles = [name for name in PROFILES if profile is None and unknown[0] in parameters_of_profile(name)]
        if of_profiles:
            raise RequestError(f"{unknown[0]}: got it without profile, wanted it with one of {', '.join(of_profiles)}")
        similar = did_you_mean(unknown[0], known)
        raise RequestError(f"{', '.join(unknown)}: unknown, wanted one of {', '.join(sorted(known))}{similar}")
    for name in props.keys():  # noqa: SIM118
        kind, wanted = props.type(name), types.get(name, "float or string")
        is_base = name in nested and ("BSDF" in wanted or name not in types)
        is_texture = isinstance(objects.get(name), mi.Texture) and "texture" in wanted
        # Vectors are refused as other numbers and names are.
        is_vector = kind == kinds.Vector and (wanted in ("float", "float or string") or name == "material")
        is_spectrum = "spectrum" in wanted and kind == kinds.Spectrum
        is_plain = kind in (kinds.Bool, kinds.Integer, kinds.Float, kinds.String)
        if not (is_plain or is_base or is_texture or is_spectrum or is_vector):
            got = type(objects[name]).__name__ if name in objects else kind.name.lower()
            raise RequestError(f"{name}: got a {got}, wanted {wanted}")


def check(props: mi.Properties) -> None:
    """Check all parameters without computing a spectrum.

    Raises:
        RequestError: if a name is unknown or a value wrong.
        FileNotFoundError: if there is no such file.
    """
    refuse_wrong(props)
    given = GratingRequest.of(props).spectrum_or_recipe
    if isinstance(given, Recipe):
        given.check()


def define() -> type:
    """Return the plugin's class for the variant in force: its base class belongs to that variant."""

    class DiffractionGrating(mi.BSDF):
        __doc__ = MANUAL

        def __init__(self, props: mi.Properties) -> None:
            # The initialiser of the base class registers the object, which Dr.Jit then calls in all scenes as long as
            # it exists, even if only a traceback refers to it: therefore errors must occur before.
            refuse_wrong(props)
            self.layers = Layers(GratingRequest.of(props))
            self.spectrum = self.layers.grating.spectrum
            mi.BSDF.__init__(self, props)
            living.add(self)
            self.m_components = self.layers.components
            self.m_flags = functools.reduce(operator.or_, self.m_components)

        def cover(self, wavelengths: tuple[float, float]) -> None:
            """Take the wavelengths of the light in a scene, see `Grating.cover`."""
            try:
                self.layers.grating.cover(wavelengths)
            except RequestError as error:
                raise RequestError(f"{self.id() or 'diffraction_grating'}: {error}") from None
            self.spectrum = self.layers.grating.spectrum

        def traverse(self, callback: mi.TraversalCallback) -> None:
            self.layers.traverse(callback)

        def parameters_changed(self, keys: Sequence[str] = ()) -> None:
            self.layers.parameters_changed(list(keys))
            self.spectrum = self.layers.grating.spectrum

        def eval_pdf(
            self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool = True
        ) -> tuple[mi.Spectrum, mi.Float]:
            return self.layers.eval_pdf(ctx, si, wo, active)

        def eval(
            self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool = True
        ) -> mi.Spectrum:
            return self.layers.eval_pdf(ctx, si, wo, active)[0]

        def pdf(
            self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool = True
        ) -> mi.Float:
            return self.layers.eval_pdf(ctx, si, wo, active)[1]

        def eval_diffuse_reflectance(self, si: mi.SurfaceInteraction3f, active: mi.Bool = True) -> mi.Spectrum:
            albedo = self.layers.albedo(si, mi.Bool(active))
            return mi.depolarizer(mi.Spectrum(albedo)) if mi.is_polarized else albedo

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
