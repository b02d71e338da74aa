"""The integrator `diffraction_shader`."""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ...bsdf.layers import Layers
from ...errors import RequestError
from ...manual import Parameter, listed
from .base import Shader, SpectralWeights
from .evaluate import VARIANTS
from .lights import Light, lights_of, spectrum_of
from .picture import Emission, decode, encode
from .quirks import Quirks
from .surfaces import Surface, along_pattern, heights_of, surfaces_of, transmitted

PARAMETERS = (
    Parameter("variant", "string", "flss, nmm, pq or gem", "flss"),
    Parameter("as_published", "boolean", "with all peculiarities of the published shader, or with none", "true"),
    Parameter(
        "fresnel_squared, window_pi, …",
        "boolean",
        "one peculiarity on or off, overriding as_published; `Quirks` lists them",
    ),
    Parameter("terms", "integer", "Taylor terms; not for gem", "37"),
    Parameter("interpolation", "string", "sinc or linear; for pq only", "sinc"),
    Parameter("spacing", "float", "the period d in µm, by default that of the strongest wave along x; for gem only"),
    Parameter("roughness", "float", "of the highlight, 1/µm; for gem only", "5"),
    Parameter("shadows", "boolean", "test whether a surface blocks the light", "false"),
    Parameter("diffuse_weight", "float", "weight of a BSDF below the grating; the thesis gives no number", "0.5"),
)

MANUAL = f"""Real-time shader of structural colour, for the scenes that a path tracer renders.

Parameters (XML or dictionary):
{listed(PARAMETERS)}

Gratings (`diffraction_grating`, also inside `twosided`) are shaded from their heights, which must come from a recipe or
a profile. Rigorous theory is refused, and coats are ignored. All other BSDFs are evaluated unchanged. Only direct light
of directional and point lights is shaded; other lights, the background and interreflection are omitted.

The shader computes RGB. It is converted to a spectrum of that colour (`Emission`), which any film can record; a
colour outside the gamut of sRGB has negative radiance at some wavelengths. Corrected, FLSS and NMM are in the scene's
units and show the direct light of a path tracer with fresnel="schlick", without a coat and without the factor E of the
BRDF.
"""


@dataclass(frozen=True, eq=False)
class Prepared:
    """Lights of a scene and, for each surface, its shader with one table per light."""

    lights: list[Light]
    surfaces: list[tuple[Surface, Shader, list[SpectralWeights]]]


def define() -> type:
    """Define the plugin class for the current variant, as its base class depends on the variant."""

    class DiffractionShader(mi.SamplingIntegrator):
        __doc__ = MANUAL

        def __init__(self, props: mi.Properties) -> None:
            # As in `DiffractionGrating`: anything that may fail precedes the registration of the object by Mitsuba.
            self.variant = props.get("variant", "flss")
            if self.variant not in VARIANTS:
                raise RequestError(f"variant: got {self.variant!r}, wanted one of {', '.join(VARIANTS)}")
            quirks = Quirks.as_published() if _boolean(props, "as_published", True) else Quirks.corrected()
            self.quirks = replace(quirks, **{name: props[name] for name in Quirks.names() if name in props})
            self.settings = {name: props[name] for name in _settings(self.variant) if name in props}
            self.shadows = _boolean(props, "shadows", False)
            self.diffuse_weight = props.get("diffuse_weight", 0.5)
            if not (isinstance(self.diffuse_weight, int | float) and 0 <= self.diffuse_weight <= 1):
                raise RequestError(f"diffuse_weight: got {self.diffuse_weight!r}, wanted 0 to 1")
            self.emission = Emission()
            mi.SamplingIntegrator.__init__(self, props)
            self._shaders: list[tuple[Layers, Shader]] = []
            self.prepared: Prepared | None = None

        def set_quirks(self, quirks: Quirks) -> None:
            """Set the quirks for the next `prepare`; existing textures are kept."""
            self.quirks = quirks
            self._shaders = [(grating, shader.with_quirks(quirks)) for grating, shader in self._shaders]

        def prepare(self, scene: mi.Scene) -> Prepared:
            """Read the lights and the gratings of a scene.

            Raises:
                ValueError: if the shader does not support them.
            """
            lights = lights_of(scene)
            surfaces = []
            for surface in surfaces_of(scene):
                shader, r_0 = self.shader_of(surface.layers), _normal_reflectance(surface.layers)
                surfaces.append((surface, shader, [shader.weights(r_0, light.spectrum) for light in lights]))
            self.prepared = Prepared(lights, surfaces)
            return self.prepared

        def shader_of(self, layers: Layers) -> Shader:
            """Return the shader of a grating; its textures are computed once."""
            for known, shader in self._shaders:
                if known is layers:
                    return shader
            height_field, coherence_length = heights_of(layers)
            settings = dict(self.settings, shadowing=layers.grating.theory.shadowing)
            if self.variant != "gem":
                settings["coherence_length"] = coherence_length
            shader = VARIANTS[self.variant](height_field, self.quirks, **settings)
            self._shaders.append((layers, shader))
            return shader

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
            self.prepare(scene)
            rgb, radiance, active = self.shade(scene, ray, active)
            radiance += self.emission(rgb, ray.wavelengths, active)
            return mi.depolarizer(radiance), active, []

        def shade(
            self, scene: mi.Scene, ray: mi.RayDifferential3f, active: mi.Bool = True
        ) -> tuple[mi.Color3f, mi.UnpolarizedSpectrum, mi.Bool]:
            """Shade the surface hit by a ray.

            Returns:
                Linear sRGB of gratings from the shader; radiance of all other BSDFs, per nm at the wavelengths of the
                ray; and whether a surface was hit.
            """
            prepared = self.prepared or self.prepare(scene)
            si = scene.ray_intersect(ray, active)
            active = active & si.is_valid()
            bsdf = si.bsdf(ray)
            masks = [active & surface.contains(bsdf, si.wi) for surface, _, _ in prepared.surfaces]
            on_other = active
            for surface, _, _ in prepared.surfaces:
                on_other = on_other & (surface.is_of(bsdf) ^ True)
            rgb, radiance = mi.Color3f(0), mi.UnpolarizedSpectrum(0)
            for index, light in enumerate(prepared.lights):
                ds, falloff, irradiance = light.sample(si, active)
                lit = mi.Bool(True)
                if self.shadows:
                    lit = scene.ray_test(si.spawn_ray_to(ds.p), active) ^ True
                direction = si.to_local(ds.d)
                value = mi.unpolarized_spectrum(bsdf.eval(mi.BSDFContext(), si, direction, on_other & lit))
                radiance += dr.select(on_other & lit, value * irradiance, 0)
                for (surface, shader, weights), mask in zip(prepared.surfaces, masks, strict=True):
                    lit_mask = mask & lit
                    layers = surface.layers
                    local_si = mi.SurfaceInteraction3f(si)
                    local_si.wi = mi.Vector3f(si.wi.x, si.wi.y, surface.side * si.wi.z)
                    wi = mi.Vector3f(direction.x, direction.y, surface.side * direction.z)
                    colour = shader.rgb(
                        along_pattern(layers, local_si, wi, lit_mask),
                        along_pattern(layers, local_si, local_si.wi, lit_mask),
                        weights[index],
                        lit_mask,
                        layers.grating.scales.height.value,
                    )
                    grating_weight = mi.Float(1)
                    if layers.base is not None:
                        below = mi.unpolarized_spectrum(layers.base.bsdf.eval(mi.BSDFContext(), local_si, wi, lit_mask))
                        if self.quirks.constant_blend:
                            grating_weight = mi.Float(1 - self.diffuse_weight)
                            below *= self.diffuse_weight
                        else:
                            below *= transmitted(layers, local_si, mi.Frame3f.cos_theta(wi), lit_mask)
                        radiance += dr.select(lit_mask, below * irradiance, 0)
                    rgb += dr.select(lit_mask, grating_weight * falloff * colour, 0)
            if self.quirks.power_gamma:
                rgb = decode(encode(rgb, True))
            return dr.select(active, rgb, 0), radiance, active

        def to_string(self) -> str:
            on = [name for name in Quirks.names() if getattr(self.quirks, name)]
            return (
                f"DiffractionShader[\n  variant = {self.variant},\n  quirks = {', '.join(on) or 'none'},\n"
                f"  shadows = {self.shadows}\n]"
            )

    return DiffractionShader


def _boolean(props: mi.Properties, name: str, default: bool) -> bool:
    value = props.get(name, default)
    if not isinstance(value, bool):
        raise RequestError(f"{name}: got {value!r}, wanted true or false")
    return value


def _settings(variant: str) -> tuple[str, ...]:
    """Return the parameters specific to a variant of the shader."""
    return {"pq": ("terms", "interpolation"), "gem": ("spacing", "roughness")}.get(variant, ("terms",))


def _normal_reflectance(layers: Layers) -> NDArray[np.float64]:
    """Return R at normal incidence at `tristimulus.wavelengths`, (401,)."""
    return spectrum_of(lambda si: layers.grating.theory.material(si, mi.Float(1), mi.Bool(True)))
