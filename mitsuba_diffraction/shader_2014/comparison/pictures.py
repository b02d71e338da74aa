"""One scene, rendered by the path tracer and by the shader."""

from __future__ import annotations

import functools
import os
import re
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ...bsdf.device_tables import on_device
from ...errors import RequestError
from ...optics.color import radiance_to_XYZ
from ...progress import Progress, part, silent
from ...render import SpectralImage
from ...render.passes import split
from ...render.scene import recorded_range, shows_gratings
from ...render.scene_file import SceneFile
from ...render.spectral_film import channel_wavelengths
from ...render.sums import Accumulation, ratio
from ...render.trace_pass import (
    check_memory,
    collect,
    equal_ranges,
    pass_seed,
    rotated_sampler,
    sampler_of,
    trace_pass,
    unfolded,
)
from ...settings import VISIBLE
from .. import tristimulus
from ..diffraction_shader import PUBLISHED_BRIGHTNESS, SceneShader, checked_brightness, parameters_of_variant
from ..flss import FLSS
from ..lights import lights_of
from ..quirks import Quirks
from ..shaded_gratings import gratings_of, sum_along
from ..shader import Shader, TextureShader
from ..tristimulus import EMISSION, emission_of_primaries


@functools.cache
def _part_integrator(variant: str) -> type:
    """Define an integrator of radiance(scene, ray, active), once for a variant, on which its base class depends.

    It is not defined for each function: a class is a reference cycle, and keeps alive what its methods refer to.
    """

    class PartIntegrator(mi.SamplingIntegrator):
        def __init__(self, radiance: Callable[..., tuple[mi.Spectrum, mi.Bool]]) -> None:
            mi.SamplingIntegrator.__init__(self, mi.Properties("part"))
            self.radiance = radiance

        def sample(
            self,
            scene: mi.Scene,
            sampler: mi.Sampler,
            ray: mi.RayDifferential3f,
            medium: mi.Medium | None = None,
            active: mi.Bool = True,
        ) -> tuple[mi.Spectrum, mi.Bool, list[mi.Float]]:
            return *self.radiance(scene, ray, active), []

    return PartIntegrator


def _integrator(radiance: Callable[..., tuple[mi.Spectrum, mi.Bool]]) -> mi.SamplingIntegrator:
    """Return an integrator of radiance(scene, ray, active), which returns radiance and whether a surface was hit."""
    return _part_integrator(mi.variant())(radiance)


def same_light(scene: mi.Scene) -> mi.SamplingIntegrator:
    """Return an integrator of the scene's own BSDFs under the lights that the shader supports.

    Only direct light of directional and point lights, with shadows: no sky, no other lights, no interreflection.

    Raises:
        ValueError: if the scene has no such light.
    """
    lights = lights_of(scene)

    def radiance(scene: mi.Scene, ray: mi.RayDifferential3f, active: mi.Bool) -> tuple[mi.Spectrum, mi.Bool]:
        def at_hit(si: mi.SurfaceInteraction3f, bsdf: mi.BSDFPtr, active: mi.Bool) -> tuple[mi.Spectrum]:
            result = mi.Spectrum(0)
            for light in lights:
                ds, _, irradiance = light.sample(si, active)
                lit = active & ~scene.ray_test(si.spawn_ray_to(ds.p), active)
                value = bsdf.eval(mi.BSDFContext(), si, si.to_local(ds.d), lit)
                result += dr.select(lit, value * irradiance, 0)
            return (result,)

        (result,), active = sum_along(scene, ray, active, at_hit)
        return result, active

    return _integrator(radiance)


def without_gratings(shader: SceneShader) -> mi.SamplingIntegrator:
    """Return an integrator of a `diffraction_shader` without gratings: only other BSDFs, and BSDFs below gratings."""

    def radiance(scene: mi.Scene, ray: mi.RayDifferential3f, active: mi.Bool) -> tuple[mi.Spectrum, mi.Bool]:
        _, value, active = shader.shade(scene, ray, active)
        return mi.depolarizer(value), active

    return _integrator(radiance)


NO_SHADOWS = "no_shadows"

LUMINANCE = (0.2126, 0.7152, 0.0722)  # of linear sRGB (IEC 61966-2-1)

# Some seconds of work on two cores, so that progress is shown.
_MAX_POINTS_PER_DISPATCH = 2**16

ColourOfRay = Callable[["mi.RayDifferential3f"], "mi.Color3f"]
"""Ray → linear sRGB of the gratings that it meets."""


@dataclass(frozen=True, eq=False)
class Picture:
    """A rendering.

    Attributes:
        image: spectral radiance.
        samples: per pixel.
        seconds: of rendering, without loading the scene and compiling kernels.
        brightness: of the shader; None where there is no free scale.
        halves: XYZ (2, height, width, 3) of two independent pictures with half of the samples each; None for a
            picture with an odd number of samples.
        xyz: (height, width, 3), CIE XYZ as `color` scales it.
    """

    image: SpectralImage
    samples: int
    seconds: float
    brightness: float | None = None
    halves: NDArray[np.float64] | None = None
    xyz: NDArray[np.float64] = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "xyz", radiance_to_XYZ(self.image.radiance, self.image.wavelengths))


class Pictures:
    """The pictures of a scene at one size, under the current variant.

    Attributes:
        scene: Mitsuba's.
        film_size: (width, height) of the whole film; a picture shows its crop window.
        mask: (height, width) bool, the pixels covered by gratings.
        shaders: of the gratings.
        spectra: of the gratings.
        has_base: whether something lies below a grating.
        has_samples: whether a grating is a scan, a piece of an irregular surface.
        patches: maximum number of patches over which the spectrum of a grating is averaged.
        has_coat: whether a layer lies above a grating.
    """

    def __init__(
        self,
        scene_path: str | os.PathLike[str],
        shader: str = "flss",
        *,
        width: int | None = None,
        height: int | None = None,
        seed: int = 0,
        parameters: Mapping[str, str] | None = None,
        settings: Mapping[str, object] | None = None,
        brightness: float | None = None,
        pigment: bool = True,
    ) -> None:
        """Load the scene; see `SceneFile.load`.

        Args:
            scene_path: an XML scene whose integrator is a path tracer.
            shader: one of `VARIANTS`.
            width: in pixels; default: the width of the film.
            height: likewise.
            seed: of the random numbers, not negative.
            parameters: values for the scene's `$name` parameters.
            settings: further parameters of the `diffraction_shader`: terms, window, interpolation.
            brightness: of the shader. Default: chosen for each of its pictures so that their diffraction has the mean
                luminance of the diffraction in `same_light`.
            pigment: show what lies below the gratings, too.

        Raises:
            FileNotFoundError: if there is no such scene.
            ValueError: if the request is wrong, or the shader cannot show the scene.
        """
        self._settings = settings or {}
        self._brightness = None if brightness is None else checked_brightness(brightness)
        self._luminance: float | None = None  # of the diffraction in `same_light`, mean over the gratings
        if seed < 0:
            raise RequestError(f"seed: got {seed}, wanted an integer that is not negative")
        scene_file = SceneFile(scene_path, parameters or {}, size=(width, height))
        _check_lights(scene_file)
        self.scene = scene_file.load()
        if hasattr(self.scene.integrator(), "scene_shader"):
            raise RequestError(f"{scene_path}: its integrator is the shader itself, wanted a path tracer (type='path')")
        if (found := recorded_range(self.scene)) != VISIBLE:
            raise RequestError(f"{scene_path}: got a film of {found[0]:g} to {found[1]:g} nm, wanted visible light")
        gratings, _ = gratings_of(self.scene)
        if not gratings:
            raise RequestError("no shape has a diffraction_grating, there is nothing to compare")
        if not pigment:
            for bsdf in gratings:
                bsdf.layers.base = None
        self.seed = seed
        self._others: dict[tuple[bool, bool, int], Picture] = {}
        self.use(shader)
        self.film_size = tuple(int(size) for size in self.scene.sensors()[0].film().size())
        self.mask = shows_gratings(self.scene, across=4)

    def use(self, shader: str) -> None:
        """Choose the shader, one of `VARIANTS`, of the next pictures."""
        own = {name: value for name, value in self._settings.items() if name in parameters_of_variant(shader)}
        brightness = self._brightness or PUBLISHED_BRIGHTNESS
        request = {"type": "diffraction_shader", "variant": shader, "brightness": brightness, **own}
        self._shader: SceneShader = mi.load_dict(request).scene_shader
        # Refuses a scene that the shader cannot show.
        self._shader.prepare(self.scene)
        self.shaders: list[Shader] = [shaded.shader for shaded in self._shader.shaded]
        layers = [shaded.layers for shaded in self._shader.shaded]
        self.spectra = [one.grating.spectrum for one in layers]
        self.has_base = any(one.base is not None for one in layers)
        recipes = [one.grating.recipe for one in layers]
        self.has_samples = any(recipe.settings.extent == "sample" for recipe in recipes)
        self.patches = max(recipe.patches for recipe in recipes)
        self.has_coat = any(one.coat is not None for one in layers)

    @property
    def quirks(self) -> tuple[str, ...]:
        """Names of the `Quirks` that affect this scene with this shader, and "no_shadows"."""
        own = {*self.shaders[0].own_quirks, *(("constant_blend",) if self.has_base else ())}
        textures = [shader for shader in self.shaders if isinstance(shader, TextureShader)]
        if all(shader.extent == "tile" for shader in textures):
            own -= {"periodic_scan"}
        return (*(name for name in Quirks.names() if name in own), NO_SHADOWS)

    @property
    def shader_reads(self) -> int:
        """Maximum number of texels that one shading point of the shader reads."""
        return max(shader.texel_reads for shader in self.shaders)

    @property
    def model_reads(self) -> int:
        """Maximum number of packets of up to 16 bytes that one BRDF value of the model reads for a ray."""
        packets = [np.prod(s.neighbours) * -(-s.table.words_per_node // 4) for s in self.spectra]
        return len(mi.UnpolarizedSpectrum(0)) * int(max(packets))

    @property
    def truncated_fraction(self) -> float | None:
        """Maximum fraction of a line's power outside the shader's neighbourhood; None for other shaders."""
        fractions = [shader.truncated_fraction for shader in self.shaders if isinstance(shader, FLSS)]
        return max(fractions, default=None)

    @property
    def series_error(self) -> float | None:
        """Maximum error of the shader's Taylor series (`series_error`); None for gem."""
        errors = [shader.textures.error for shader in self.shaders if isinstance(shader, TextureShader)]
        return max(errors, default=None)

    def path_traced(self, samples: int, progress: Progress = silent, seed: int | None = None) -> Picture:
        """Render by the scene's own integrator; with another seed if one is given."""
        return self._traced(self.scene.integrator(), samples, progress, seed=seed)

    def same_light(self, samples: int, others: int, progress: Progress = silent) -> Picture:
        """Render the scene's BSDFs under the lights that the shader supports; see `same_light` of this module.

        Gratings are evaluated at the points of `shaded`, each at all wavelengths of the shader, and the light of other
        BSDFs is the same picture: noise cancels in the difference from the corrected shader. For arguments see
        `shaded`.
        """
        self._choose(())
        model, rest = same_light(self.scene), without_gratings(self._shader)
        wavelengths_and_weights = list(_wavelengths_of_the_shader())

        def colour(ray: mi.RayDifferential3f) -> mi.Color3f:
            rgb = mi.Color3f(0)
            for wavelengths, weights in wavelengths_and_weights:
                ray.wavelengths = wavelengths
                whole, other = (
                    mi.unpolarized_spectrum(integrator.sample(self.scene, None, ray)[0]) for integrator in (model, rest)
                )
                for channel in range(3):
                    rgb[channel] += dr.dot(weights[channel], whole - other)
                dr.eval(rgb)
            return rgb

        picture, self._luminance = self._at_points(colour, samples, others, progress)
        return picture

    def shaded(self, quirks: Collection[str], samples: int, others: int, progress: Progress = silent) -> Picture:
        """Render what the shader's integrator converges to, with far fewer samples.

        The integrator computes the colour of a shading point from 81 wavelengths, and shows it at the four
        wavelengths of a ray. Here the colours are averaged over a pixel, and the spectrum Σ_c RGB_c b_c(λ) follows from
        the average. All other BSDFs, which are cheap, are sampled separately.

        Args:
            quirks: names of the quirks that are as published, others are corrected.
            samples: shading points per pixel.
            others: samples per pixel of all BSDFs other than gratings.
            progress: called with (done, total).
        """
        self._choose(quirks)
        has_free_scale = any(shader.has_free_scale for shader in self.shaders)
        is_fitted = has_free_scale and self._brightness is None
        if is_fitted and self._luminance is None:
            self.same_light(samples, others)
            self._choose(quirks)
        picture, _ = self._at_points(
            lambda ray: self._shader.shade(self.scene, ray)[0],
            *(samples, others, progress),
            brightness=self._shader.brightness if has_free_scale else None,
            luminance=self._luminance if is_fitted else None,
        )
        return picture

    def _choose(self, quirks: Collection[str]) -> None:
        self._shader.set_quirks(Quirks(**{name: name in quirks for name in Quirks.names()}))
        self._shader.shadows = NO_SHADOWS not in quirks
        self._shader.prepare(self.scene)
        self.shaders = [shaded.shader for shaded in self._shader.shaded]

    def _at_points(
        self,
        colour: ColourOfRay,
        samples: int,
        others: int,
        progress: Progress,
        brightness: float | None = None,
        luminance: float | None = None,
    ) -> tuple[Picture, float]:
        """Add the colours of gratings at points of the pixels to the light of all other BSDFs.

        Colours and their `brightness` are scaled to a mean `luminance` over the gratings, if one is given. Returns the
        picture and that mean; for other arguments see `shaded`.
        """
        known = (self._shader.quirks.constant_blend, self._shader.shadows, others)
        if known not in self._others:
            self._others[known] = self._traced(without_gratings(self._shader), others, silent, halves=False)
        rest = self._others[known]
        # Two independent halves tell the noise.
        counts = (samples,) if samples % 2 else (samples // 2, samples // 2)
        parts = [
            self._colours(colour, count, index, part(progress, index / len(counts), (index + 1) / len(counts)))
            for index, count in enumerate(counts)
        ]
        mean = float(np.mean([rgb[self.mask] @ LUMINANCE for rgb, _ in parts]))
        if luminance is not None and not mean > 0:
            raise RequestError(f"brightness: got diffraction of the mean luminance {mean:.3g}, wanted a positive one")
        scale = 1.0 if luminance is None else luminance / mean
        radiance = [rest.image.radiance + scale * rgb @ _channel_emission().T for rgb, _ in parts]
        wavelengths = rest.image.wavelengths
        halves = np.array([radiance_to_XYZ(half, wavelengths) for half in radiance]) if len(parts) > 1 else None
        seconds = rest.seconds + sum(seconds for _, seconds in parts)
        image = SpectralImage(wavelengths, np.mean(radiance, axis=0))
        brightness = None if brightness is None else scale * brightness
        return Picture(image, samples, seconds, brightness, halves), scale * mean

    def _traced(
        self,
        integrator: mi.Integrator,
        samples: int,
        progress: Progress,
        halves: bool = True,
        seed: int | None = None,
    ) -> Picture:
        seed = self.seed if seed is None else seed
        rows, columns = self.mask.shape
        passes = split(self.scene, samples, 2 if halves else 1)
        check_memory(self.scene, max(passes))
        trace_pass(self.scene, 1, seed, integrator)  # compiles the kernels
        sums = Accumulation.empty(rows, columns)
        pair = np.zeros((2, rows, columns, 4))  # sums of XYZ and of the filter, of every other pass
        begin = time.perf_counter()
        for index, some in enumerate(passes):
            traced = trace_pass(self.scene, some, pass_seed(seed, index), integrator)
            sums.add(traced, some)
            pair[index % 2, ..., :3] += radiance_to_XYZ(traced[..., :-1], channel_wavelengths())
            pair[index % 2, ..., 3] += traced[..., -1]
            progress(sums.samples, sum(passes))
        seconds = time.perf_counter() - begin
        image = SpectralImage(channel_wavelengths(), sums.radiance())
        in_halves = ratio(pair[..., :3], pair[..., 3:]) if halves and len(passes) > 1 else None
        return Picture(image, sums.samples, seconds, halves=in_halves)

    def _colours(
        self, colour: ColourOfRay, samples: int, half: int, progress: Progress
    ) -> tuple[NDArray[np.float64], float]:
        """Return linear sRGB of the gratings, (height, width, 3), and seconds; `half` selects the random numbers."""
        rows, columns = self.mask.shape
        per_dispatch = max(1, _MAX_POINTS_PER_DISPATCH // samples)
        firsts = range(0, rows * columns, per_dispatch)
        # Compiles the kernels. With two pixels, as Dr.Jit compiles other kernels for a single sample.
        self._averaged([self._shade(colour, 0, 2, samples, half)] * -(-rows * columns // 2))
        begin = time.perf_counter()
        points = []
        for index, first in enumerate(firsts):
            points.append(self._shade(colour, first, min(per_dispatch, rows * columns - first), samples, half))
            progress(index + 1, len(firsts))
        return self._averaged(points), time.perf_counter() - begin

    def _averaged(self, points: list[NDArray[np.float32]]) -> NDArray[np.float64]:
        """Return the means over the pixels, (height, width, 3), of `_shade`, with equally many points per pixel."""
        rows, columns = self.mask.shape
        x, y, *rgb = (on_device(column) for column in np.concatenate(points, axis=1))
        channels = [dr.opaque(mi.Float, channel, shape=len(x)) for channel in range(3)]
        rfilter = self.scene.sensors()[0].film().rfilter()
        count = dr.opaque(mi.UInt32, len(x) // (rows * columns))
        sums = collect(rfilter, mi.Point2f(x, y), channels, rgb, (rows, columns), (0, 0, 0), equal_ranges(count), 3)
        values = unfolded(sums, (rows, columns)).astype(np.float64)
        return ratio(values[..., :3], values[..., 3:])

    def _shade(self, colour: ColourOfRay, first: int, count: int, samples: int, half: int) -> NDArray[np.float32]:
        """Shade points of `count` pixels, from `first` on: (5, n), position in the picture and linear sRGB."""
        sensor = self.scene.sensors()[0]
        columns, rows = (int(size) for size in sensor.film().crop_size())
        sampler = sampler_of(mi.load_dict({"type": "multijitter"}), samples)
        samples = sampler.sample_count()  # rounded up to a product of two similar numbers
        sampler.set_samples_per_wavefront(samples)
        seed = pass_seed(self.seed, 2 * first + half)
        sampler.seed(seed, count * samples)
        pixel = dr.opaque(mi.UInt32, first) + dr.arange(mi.UInt32, count * samples) // samples
        sampler = rotated_sampler(sampler, seed, pixel)
        position = mi.Point2f(mi.Float(pixel % columns), mi.Float(pixel // columns)) + sampler.next_2d()
        # Colours are of all wavelengths: 0.5 is a dummy.
        size = mi.Vector2f(columns, rows)
        ray, _ = sensor.sample_ray(sampler.next_1d(), 0.5, position / size, sampler.next_2d())
        rgb = colour(mi.RayDifferential3f(ray))
        dr.eval(position, rgb)
        return np.concatenate([np.array(position), np.array(rgb)])


def supported_lights(scene_file: SceneFile) -> tuple[str, ...] | None:
    """Return the values of a scene's parameter `light` that the shader supports; None if its lights are supported."""
    scene = Path(scene_file.path)
    with scene_file.parsed() as (_, state):
        emitters = {node.props.plugin_name() for node in state.nodes if node.type == mi.ObjectType.Emitter}
    if emitters & {"directional", "point"}:
        return None
    text = scene.read_text(encoding="utf-8", errors="replace")
    if "lights/$light.xml" not in text:
        return ()
    lights = {path.stem: path.read_text("utf-8") for path in sorted((scene.parent / "lights").glob("*.xml"))}
    return tuple(name for name, light in lights.items() if re.search(r'<emitter type="(directional|point)"', light))


def _check_lights(scene_file: SceneFile) -> None:
    """Raise RequestError if the shader supports no light of a scene, before any spectrum is computed."""
    if (lights := supported_lights(scene_file)) is not None:
        advice = f"; choose {' or '.join(f'-D light={name}' for name in lights)}" if lights else ""
        raise RequestError(
            f"{scene_file.path}: the scene has no directional or point light, and the shader knows no other{advice}"
        )


def _channel_emission() -> NDArray[np.float64]:
    """Return b_c of `emission_of_primaries`, averaged over the hats of the film's channels: (n, 3).

    b_c is linear between nodes at the centres of the hats, so that the average is (b₋ + 4b + b₊)/6.
    """
    b = emission_of_primaries()
    averages = (b[:-2] + 4 * b[1:-1] + b[2:]) / 6
    assert np.array_equal(EMISSION[1:-1], channel_wavelengths())
    return averages


def _wavelengths_of_the_shader() -> Iterator[tuple[mi.UnpolarizedSpectrum, list[mi.UnpolarizedSpectrum]]]:
    """Return the shader's wavelengths, as many at a time as a ray has, and their weights in linear sRGB."""
    step = int(tristimulus.WAVELENGTH_STEP)
    to_xyz = step * tristimulus.light_weights(np.ones_like(tristimulus.wavelengths()))
    to_rgb = to_xyz @ tristimulus.rgb_matrix(cie_rgb_matrix=False).T
    columns = np.column_stack([tristimulus.wavelengths(), to_rgb])[::step]
    count = len(mi.UnpolarizedSpectrum(0))
    # The last ones are repeated without weight.
    fill = np.repeat(columns[-1:] * [1, 0, 0, 0], -len(columns) % count, axis=0)
    for some in np.split(np.concatenate([columns, fill]), -(-len(columns) // count)):
        emissions = [mi.UnpolarizedSpectrum(*column) for column in some.T.tolist()]
        dr.make_opaque(emissions)  # so that all share a kernel
        yield emissions[0], emissions[1:]
