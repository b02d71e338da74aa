"""The comparison from one scene to its numbers."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ...errors import RequestError
from ...progress import Progress, no_progress
from ..diffraction_shader import parameters_of_variant
from ..evaluate import VARIANTS
from .difference import Difference, difference, noise, time_of_error, white_luminance
from .pictures import Picture, Pictures
from .quirk_costs import QuirkCosts, quirk_costs

# The effect of quirks is measured in small pictures with little noise: 25 take about a minute on two cores.
QUIRKS_MAX_SIDE = 72
QUIRKS_SAMPLES = 64
QUIRKS_SHADING_POINTS = 4

FEW_SAMPLES = (1, 4, 16, 64)
"""Per pixel of the pictures by which the path tracer's time for an error is measured."""


@dataclass(frozen=True, eq=False)
class Comparison:
    """Results of a comparison.

    Attributes:
        scene: file name.
        shader: one of `VARIANTS`.
        others: further shaders.
        settings: of the shaders: terms, window, interpolation, where they differ from the default.
        variant: Mitsuba's.
        seed: of the random numbers.
        pictures: by name: "path_traced", "same_light" (the project's model under the lights that the shader supports),
            "published" and "corrected" (the shader with and without its quirks), and for each of `others`, such as nmm,
            "nmm_published" and "nmm_corrected".
        pigment: whether what lies below the gratings is shown, in all pictures alike.
        mask: (height, width) bool, the pixels that are compared: those covered by gratings.
        white: the luminance that is shown as white.
        to_path_traced: difference of each other picture from the path-traced one.
        to_same_light: difference of the shader's pictures from "same_light", at the same points.
        few_samples: (samples, seconds, mean CIEDE2000 to "path_traced") of path-traced pictures of another seed.
        noise: the mean CIEDE2000 due to noise in the traced pictures; None for one sample per pixel.
        shader_reads: maximum number of texels (two numbers each) that one shading point of the shader reads, by name of
            its picture.
        model_reads: packets (four numbers each) that one BRDF value of the project's model reads for a ray.
        truncated_fraction: maximum fraction of a line's power outside the shader's neighbourhood; None if not used.
        series_error: of the Taylor series, corrected; None if not used.
        samples: whether a surface is a scan, a piece of an irregular surface.
        patches: maximum number of patches over which this model averages; the shader has the first.
        coated: whether a grating has a coat, which the shader does not show.
        costs: fractions of the difference due to each quirk; None if not requested.
    """

    scene: str
    shader: str
    others: tuple[str, ...]
    settings: Mapping[str, object]
    variant: str
    seed: int
    pictures: Mapping[str, Picture]
    pigment: bool
    mask: NDArray[np.bool_]
    white: float
    to_path_traced: Mapping[str, Difference]
    to_same_light: Mapping[str, Difference]
    few_samples: tuple[tuple[int, float, float], ...]
    noise: Mapping[str, float | None]
    shader_reads: Mapping[str, int]
    model_reads: int
    truncated_fraction: float | None
    series_error: float | None
    samples: bool
    patches: int
    coated: bool
    costs: QuirkCosts | None

    def time_of_error(self, name: str) -> float:
        """Return the seconds after which the path tracer has the mean CIEDE2000 of a picture; NaN if not measured."""
        _, seconds, errors = zip(*self.few_samples, strict=True) if self.few_samples else ((), (), ())
        return time_of_error(self.to_path_traced[name].mean, seconds, errors)


@dataclass(frozen=True)
class ComparisonRequest:
    """A comparison of a scene by the path tracer and by the shader.

    Attributes:
        scene: an XML scene whose integrator is a path tracer, with a directional or point light.
        shader: one of `VARIANTS`; the effect of its quirks is measured.
        others: further ones.
        terms: number of Taylor terms; default: as published, or, corrected, as many as needed.
        window: "texel" or "4sigma" (flss, nmm); default: as published "texel", corrected "4sigma".
        interpolation: "sinc" or "linear" (pq, nmm_pq).
        brightness: of the shader, 1000 in the published program. Default: chosen for each picture so that the mean
            luminance of its diffraction equals this model's under the same light.
        pigment: show what lies below the gratings; the published pictures show diffraction alone.
        width: in pixels; default: the width of the film.
        height: likewise.
        spp: samples per pixel of the path tracer.
        shading_points: per pixel of the shader, each with its whole spectrum.
        seed: of the random numbers, not negative.
        parameters: values for the scene's `$name` parameters.
        costs: measure the fraction of the difference that is due to each quirk.
        costs_side: the longer side, in pixels, of the pictures for `costs`; limited to the longer side of the
            picture.
    """

    scene: str | os.PathLike[str]
    shader: str = "flss"
    others: Sequence[str] = ()
    terms: int | None = None
    window: str | None = None
    interpolation: str | None = None
    brightness: float | None = None
    pigment: bool = False
    width: int | None = None
    height: int | None = None
    spp: int = 64
    shading_points: int = 4
    seed: int = 0
    parameters: Mapping[str, str] = field(default_factory=dict)
    costs: bool = True
    costs_side: int = QUIRKS_MAX_SIDE

    def __post_init__(self) -> None:
        for name in ("spp", "shading_points", "costs_side"):
            if (count := getattr(self, name)) < 1:
                raise RequestError(f"{name}: got {count}, wanted a positive number")
        for kind in self.shaders:  # before a spectrum is computed
            if kind not in VARIANTS:
                raise RequestError(f"shader: got {kind!r}, wanted one of {', '.join(VARIANTS)}")
        for name, value in self.settings.items():
            if not any(name in parameters_of_variant(kind) for kind in self.shaders):
                raise RequestError(f"{name}: got {value!r}, which {', '.join(self.shaders)} cannot use")

    @property
    def shaders(self) -> tuple[str, ...]:
        """All shaders."""
        return self.shader, *self.others

    @property
    def settings(self) -> dict[str, object]:
        """What is requested of the shaders besides the default."""
        requested = {name: getattr(self, name) for name in ("terms", "window", "interpolation")}
        return {name: value for name, value in requested.items() if value is not None}

    def pictures(self, width: int | None, height: int | None) -> Pictures:
        """Load the scene for pictures of this size in pixels."""
        return Pictures(
            self.scene,
            self.shader,
            width=width,
            height=height,
            seed=self.seed,
            parameters=self.parameters,
            settings=self.settings,
            brightness=self.brightness,
            pigment=self.pigment,
        )


def compare(
    request: ComparisonRequest, progress: Callable[[str], AbstractContextManager[Progress]] = no_progress
) -> Comparison:
    """Render a scene with the path tracer and with the shader under the current variant, and compare.

    Args:
        request: what is rendered and measured.
        progress: progress(label) is a context whose value is called with (done, total).

    Raises:
        FileNotFoundError: if there is no such scene.
        ValueError: if the shader cannot show the scene.
        RuntimeError: if rendering failed.
    """
    of = request.pictures(request.width, request.height)
    for kind in (*request.others, request.shader):
        of.use(kind)  # refuses a scene that it cannot show
    with progress("path tracer") as bar:
        pictures = {"path_traced": of.path_traced(request.spp, bar)}
    reference = pictures["path_traced"].xyz
    white = white_luminance(reference, of.mask)
    few_samples = _few_samples(request, of, reference, white)
    with progress("the same light") as bar:
        pictures["same_light"] = of.same_light(request.shading_points, request.spp, bar)
    reads, truncated_fraction, series_error = _add_shaded(pictures, request, of, progress)
    to = functools.partial(_differences, pictures, of.mask, white)
    return Comparison(
        scene=Path(request.scene).name,
        shader=request.shader,
        others=tuple(request.others),
        settings=request.settings,
        variant=mi.variant(),
        seed=request.seed,
        pictures=pictures,
        pigment=request.pigment,
        mask=of.mask,
        white=white,
        to_path_traced=to("path_traced", [name for name in pictures if name != "path_traced"]),
        to_same_light=to("same_light", reads),
        few_samples=few_samples,
        noise={name: noise(picture.halves, of.mask, white) for name, picture in pictures.items()},
        shader_reads=reads,
        model_reads=of.model_reads,
        truncated_fraction=truncated_fraction,
        series_error=series_error,
        samples=of.has_samples,
        patches=of.patches,
        coated=of.has_coat,
        costs=_costs(request, of, progress) if request.costs else None,
    )


def _differences(
    pictures: Mapping[str, Picture], mask: NDArray[np.bool_], white: float, reference: str, names: Iterable[str]
) -> dict[str, Difference]:
    """Return the differences of pictures from the one called `reference`."""
    return {name: difference(pictures[reference].xyz, pictures[name].xyz, mask, white) for name in names}


def _few_samples(
    request: ComparisonRequest, of: Pictures, reference: NDArray[np.float64], white: float
) -> tuple[tuple[int, float, float], ...]:
    """Return samples, seconds and mean CIEDE2000 of path-traced pictures with fewer samples than requested."""
    found = []
    for count in (count for count in FEW_SAMPLES if count < request.spp):
        few = of.path_traced(count, seed=request.seed + 1)
        found.append((count, few.seconds, difference(reference, few.xyz, of.mask, white).mean))
    return tuple(found)


def _add_shaded(
    pictures: dict[str, Picture],
    request: ComparisonRequest,
    of: Pictures,
    progress: Callable[[str], AbstractContextManager[Progress]],
) -> tuple[dict[str, int], float | None, float | None]:
    """Add the pictures of the shaders; return reads by picture, and truncated fraction and error of the first shader's.

    The numbers are those of the corrected picture.
    """
    reads, found = {}, {}
    for kind in request.shaders:
        of.use(kind)
        for name, quirks in (("published", of.quirks), ("corrected", ())):
            key = name if kind == request.shader else f"{kind}_{name}"
            with progress(f"{kind}, {name}") as bar:
                pictures[key] = of.shaded(quirks, request.shading_points, request.spp, bar)
            reads[key] = of.shader_reads
        found[kind] = of.truncated_fraction, of.series_error
    return reads, *found[request.shader]


def _costs(
    request: ComparisonRequest, of: Pictures, progress: Callable[[str], AbstractContextManager[Progress]]
) -> QuirkCosts:
    """Return the fractions of the difference due to each quirk, from small pictures."""
    scale = min(1.0, request.costs_side / max(of.mask.shape))
    columns, rows = (max(1, round(size * scale)) for size in of.film_size)
    small = request.pictures(columns, rows)
    with progress("quirks") as bar:
        return quirk_costs(small, QUIRKS_SAMPLES, QUIRKS_SHADING_POINTS, bar)
