"""The integrator `diffraction_shader`."""

from __future__ import annotations

import math
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..bsdf.device_tables import opaque
from ..bsdf.fresnel import Dielectric
from ..bsdf.layers import Layers
from ..errors import RequestError
from ..parameter_documentation import Parameter, listed
from .evaluate import VARIANTS
from .lights import Light, lights_of, per_nanometre
from .pq import PQ
from .quirks import Quirks
from .shaded_gratings import Shaded, gratings_of, in_place, recipe_of_layers, sum_along
from .shader import Shader
from .tristimulus import Emission

PUBLISHED_BRIGHTNESS = 1000.0
"""Every variant of the published program has it, unless its slider is moved (github.com/simplay/Bachelor-Thesis)."""

PARAMETERS = (
    Parameter("variant", "string", "`flss`, `nmm`, `pq`, `nmm_pq` or `gem`", "flss"),
    Parameter("as_published", "boolean", "with all quirks of the published shader, or with none", "true"),
    Parameter(
        "schlick, relative, …",
        "boolean",
        "overrides `as_published` for one quirk; `shader_2014.quirks.Quirks` lists them",
    ),
    Parameter(
        "brightness",
        "float",
        "the slider of the published program, a factor of the diffraction alone; 0 is its default. `pq` and `nmm_pq` "
        "halve it, `gem` divides it by 4000; radiance that is not relative has none",
        "1000",
    ),
    Parameter(
        "terms",
        "integer",
        "Taylor terms; default: 37 (`nmm` 31, `pq` 39) as published; corrected, as many as an error of 1e-4 requires; "
        "not for `gem`",
    ),
    Parameter("window", "string", "`texel` or `4sigma`; overrides `one_texel`; for `flss` and `nmm` only"),
    Parameter("interpolation", "string", "`sinc` or `linear`; for `pq` and `nmm_pq` only", "sinc"),
    Parameter("spacing", "float", "period, µm; default: of the strongest Fourier component along x; for `gem` only"),
    Parameter("roughness", "float", "width of the highlight, 1/µm; for `gem` only", "5"),
    Parameter("shadows", "boolean", "cast shadow rays", "false"),
    Parameter("diffuse_weight", "float", "weight of a BSDF below the grating; the thesis gives no number", "0.5"),
)

MANUAL = f"""Real-time shader of structural colour, for the scenes that a path tracer renders.

Parameters (XML or dictionary):
{listed(PARAMETERS)}

Gratings (`diffraction_grating`, also inside `twosided`, normal and bump maps, masks and blends) are shaded from their
heights, which must be given by a recipe or a profile; of several patches, the first is used. Rigorous theory and
lateral scales are refused, and coats are ignored. All other BSDFs are evaluated unchanged. Only direct light of
directional and point lights is shaded; other lights, the background and interreflection are omitted.

The shader computes RGB. It is converted to a spectrum of that colour (`Emission`), which any film can record; a
colour outside the gamut of sRGB has negative radiance at some wavelengths. Corrected, FLSS and NMM are in the scene's
units and show the direct light of a path tracer without a coat and without the factor E of the BRDF.
"""


class SceneShader:
    """The shader of a scene, for a ray.

    Attributes:
        variant, quirks, settings: of the shader, and its own parameters.
        shadows: whether shadow rays are cast.
        diffuse_weight: of a BSDF below a grating, with the quirk `constant_blend`.
        brightness: of the diffraction.
        lights: of the scene, by `prepare`: those that are supported.
        gratings: likewise, their BSDFs.
        outer: the BSDFs of shapes that are gratings or in which gratings are nested.
        shaded: what replaces the layers of each grating.
    """

    def __init__(self, props: mi.Properties) -> None:
        """Read the parameters of the integrator.

        Raises:
            RequestError: if one is wrong.
        """
        self.variant = props.get("variant", "flss")
        if self.variant not in VARIANTS:
            raise RequestError(f"variant: got {self.variant!r}, wanted one of {', '.join(VARIANTS)}")
        quirks = Quirks.as_published() if _boolean(props, "as_published", True) else Quirks.corrected()
        self.quirks = replace(quirks, **{name: props[name] for name in Quirks.names() if name in props})
        self.settings = {name: props[name] for name in parameters_of_variant(self.variant) if name in props}
        self.shadows = _boolean(props, "shadows", False)
        self.diffuse_weight = props.get("diffuse_weight", 0.5)
        if not (isinstance(self.diffuse_weight, int | float) and 0 <= self.diffuse_weight <= 1):
            raise RequestError(f"diffuse_weight: got {self.diffuse_weight!r}, wanted 0 to 1")
        self.brightness = checked_brightness(props.get("brightness", PUBLISHED_BRIGHTNESS))
        self._shaders: list[tuple[Layers, Shader]] = []
        self.lights: list[Light] = []
        self.gratings: list[mi.BSDF] = []
        self.outer: list[mi.BSDF] = []
        self.shaded: list[Shaded] = []

    def set_quirks(self, quirks: Quirks) -> None:
        """Set the quirks for the next `prepare`; existing textures are kept."""
        self.quirks = quirks
        self._shaders = [(grating, shader.with_quirks(quirks)) for grating, shader in self._shaders]

    def prepare(self, scene: mi.Scene) -> None:
        """Read the lights and the gratings of a scene.

        Raises:
            ValueError: if the shader does not support them.
        """
        self.lights, (self.gratings, self.outer) = lights_of(scene), gratings_of(scene)
        base_weight = self.diffuse_weight if self.quirks.constant_blend else None
        self.shaded = []
        for layers in (bsdf.layers for bsdf in self.gratings):
            shader, r_0 = self.shader_of(layers), _normal_reflectance(layers)
            weights = [shader.weights(r_0, light.irradiance) for light in self.lights]
            scale = self.brightness * shader.brightness_unit if shader.has_free_scale else 1.0
            self.shaded.append(Shaded(layers, shader, weights, base_weight, opaque(scale)))

    def shader_of(self, layers: Layers) -> Shader:
        """Return the shader of a grating; its textures are computed once."""
        for known, shader in self._shaders:
            if known is layers:
                return shader
        recipe = recipe_of_layers(layers)
        settings = dict(self.settings, shadowing=layers.grating.theory.shadowing)
        if self.variant != "gem":
            settings["corrected_coherence_length"] = float(recipe.settings.coherence_length)
            boundary = layers.grating.theory.boundary
            settings["exact_fresnel"] = isinstance(boundary, Dielectric)
            settings["extent"] = recipe.settings.extent
            settings["max_height_scale"] = float(layers.grating.scales.height.values[-1])
        shader = VARIANTS[self.variant](recipe.height_field(), self.quirks, **settings)
        self._shaders.append((layers, shader))
        return shader

    def shade(
        self, scene: mi.Scene, ray: mi.RayDifferential3f, active: mi.Bool = True
    ) -> tuple[mi.Color3f, mi.UnpolarizedSpectrum, mi.Bool]:
        """Shade the surface hit by a ray.

        Returns:
            Linear sRGB of gratings from the shader; radiance of all other BSDFs, per nm at the wavelengths of the
            ray; and whether a surface was hit.
        """
        if not self.lights:
            self.prepare(scene)

        def at_hit(
            si: mi.SurfaceInteraction3f, bsdf: mi.BSDFPtr, active: mi.Bool
        ) -> tuple[mi.Color3f, mi.UnpolarizedSpectrum]:
            rgb, radiance = mi.Color3f(0), mi.UnpolarizedSpectrum(0)
            of_grating = mi.Bool(False)
            for outer in self.outer:
                of_grating |= bsdf == mi.BSDFPtr(outer)
            for index, light in enumerate(self.lights):
                ds, falloff, irradiance = light.sample(si, active)
                lit = mi.Bool(active)
                if self.shadows:
                    lit &= ~scene.ray_test(si.spawn_ray_to(ds.p), active)
                direction = si.to_local(ds.d)

                def value(
                    light: int | None,
                    active: mi.Bool,
                    at: mi.SurfaceInteraction3f = si,
                    wo: mi.Vector3f = direction,
                ) -> mi.UnpolarizedSpectrum:
                    for shaded in self.shaded:
                        shaded.light = light
                    return mi.unpolarized_spectrum(bsdf.eval(mi.BSDFContext(), at, wo, active))

                others, both = value(None, lit), value(index, lit & of_grating)
                radiance += dr.select(lit, others * irradiance, 0)
                colour = mi.Color3f(*((both - others)[channel] for channel in range(3)))
                rgb += dr.select(lit & of_grating, falloff * colour, 0)
            return rgb, radiance

        with in_place(self.gratings, self.shaded):
            (rgb, radiance), active = sum_along(scene, ray, active, at_hit)
        return dr.select(active, rgb, 0), radiance, active

    def __str__(self) -> str:
        on = [name for name in Quirks.names() if getattr(self.quirks, name)]
        return (
            f"DiffractionShader[\n  variant = {self.variant},\n  quirks = {', '.join(on) or 'none'},\n"
            f"  brightness = {self.brightness:g},\n  shadows = {self.shadows}\n]"
        )


def define() -> type:
    """Define the plugin class for the current variant, as its base class depends on the variant."""

    class DiffractionShader(mi.SamplingIntegrator):
        __doc__ = MANUAL

        def __init__(self, props: mi.Properties) -> None:
            # As in `DiffractionGrating`: anything that may fail precedes the registration of the object by Mitsuba.
            self.scene_shader, self.emission = SceneShader(props), Emission()
            mi.SamplingIntegrator.__init__(self, props)

        def sample(
            self,
            scene: mi.Scene,
            sampler: mi.Sampler,
            ray: mi.RayDifferential3f,
            medium: mi.Medium | None = None,
            active: mi.Bool = True,
        ) -> tuple[mi.Spectrum, mi.Bool, list[mi.Float]]:
            # Once per picture, as lights and materials may have changed. (Overriding `render` and calling Mitsuba's
            # would leave its Ctrl-C handler installed.)
            self.scene_shader.prepare(scene)
            rgb, radiance, active = self.scene_shader.shade(scene, ray, active)
            radiance += self.emission(rgb, ray.wavelengths, active)
            return mi.depolarizer(radiance), active, []

        def to_string(self) -> str:
            return str(self.scene_shader)

    return DiffractionShader


def _boolean(props: mi.Properties, name: str, default: bool) -> bool:
    value = props.get(name, default)
    if not isinstance(value, bool):
        raise RequestError(f"{name}: got {value!r}, wanted true or false")
    return value


def checked_brightness(value: object) -> float:
    """Return a brightness as a number; zero is the default, as in the published code.

    Raises:
        ValueError: if it is not a finite number, or negative.
    """
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value < math.inf:
        raise RequestError(f"brightness: got {value!r}, wanted a finite number that is not negative")
    return float(value) or PUBLISHED_BRIGHTNESS


def parameters_of_variant(variant: str) -> tuple[str, ...]:
    """Return the parameters specific to a variant of the shader."""
    if variant == "gem":
        return "spacing", "roughness"
    return "terms", "interpolation" if issubclass(VARIANTS[variant], PQ) else "window"


def _normal_reflectance(layers: Layers) -> NDArray[np.float64]:
    """Return R at normal incidence at `tristimulus.wavelengths`, (401,)."""
    return per_nanometre(lambda si: layers.grating.theory.boundary(si, mi.Float(1), mi.Bool(True)))
