"""The comparison from one scene to its numbers."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
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
from .quirk_shares import QuirkShares, quirk_shares

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
        surface: (height, width) bool, the pixels that are compared: those covered by gratings.
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
        shares: fractions of the difference due to each quirk; None if not requested.
    """

    scene: str
    shader: str
    others: tuple[str, ...]
    settings: Mapping[str, object]
    variant: str
    seed: int
    pictures: Mapping[str, Picture]
    pigment: bool
    surface: NDArray[np.bool_]
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
    shares: QuirkShares | None

    def time_of_error(self, name: str) -> float:
        """Return the seconds after which the path tracer has the mean CIEDE2000 of a picture; NaN if not measured."""
        _, seconds, errors = zip(*self.few_samples, strict=True) if self.few_samples else ((), (), ())
        return time_of_error(self.to_path_traced[name].mean, seconds, errors)


def compare(
    scene_path: str | os.PathLike[str],
    shader: str = "flss",
    *,
    others: Sequence[str] = (),
    terms: int | None = None,
    window: str | None = None,
    interpolation: str | None = None,
    brightness: float | None = None,
    pigment: bool = False,
    width: int | None = None,
    height: int | None = None,
    spp: int = 64,
    shading_points: int = 4,
    seed: int = 0,
    parameters: Mapping[str, str] | None = None,
    shares: bool = True,
    shares_side: int = QUIRKS_MAX_SIDE,
    progress: Callable[[str], AbstractContextManager[Progress]] = no_progress,
) -> Comparison:
    """Render a scene with the path tracer and with the shader under the current variant, and compare.

    Args:
        scene_path: an XML scene whose integrator is a path tracer, with a directional or point light.
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
        shares: measure the fraction of the difference that is due to each quirk.
        shares_side: the longer side, in pixels, of the pictures for `shares`; limited to the longer side of the
            picture.
        progress: progress(label) is a context whose value is called with (done, total).

    Raises:
        FileNotFoundError: if there is no such scene.
        ValueError: if the request is wrong, or the shader cannot show the scene.
        RuntimeError: if rendering failed.
    """
    for name, count in (("spp", spp), ("shading_points", shading_points), ("shares_side", shares_side)):
        if count < 1:
            raise RequestError(f"{name}: got {count}, wanted a positive number")
    for kind in (shader, *others):  # before a spectrum is computed
        if kind not in VARIANTS:
            raise RequestError(f"shader: got {kind!r}, wanted one of {', '.join(VARIANTS)}")
    settings = {"terms": terms, "window": window, "interpolation": interpolation}
    settings = {name: value for name, value in settings.items() if value is not None}
    for name in settings:
        if not any(name in parameters_of_variant(kind) for kind in (shader, *others)):
            raise RequestError(f"{name}: got {settings[name]!r}, which {', '.join((shader, *others))} cannot use")
    open_scene = functools.partial(
        Pictures,
        scene_path,
        shader,
        seed=seed,
        parameters=parameters,
        settings=settings,
        brightness=brightness,
        pigment=pigment,
    )
    of = open_scene(width=width, height=height)
    for other in others:
        of.use(other)  # refuses a scene that it cannot show
    of.use(shader)
    pictures, reads = {}, {}
    with progress("path tracer") as bar:
        pictures["path_traced"] = of.path_traced(spp, bar)
    reference, few_samples = pictures["path_traced"].xyz, []
    white = white_luminance(reference, of.surface)
    for count in (count for count in FEW_SAMPLES if count < spp):
        few = of.path_traced(count, seed=seed + 1)
        few_samples.append((count, few.seconds, difference(reference, few.xyz, of.surface, white).mean))
    with progress("the same light") as bar:
        pictures["same_light"] = of.same_light(shading_points, spp, bar)
    for kind in (shader, *others):
        of.use(kind)
        for name, quirks in (("published", of.quirks), ("corrected", ())):
            key = name if kind == shader else f"{kind}_{name}"
            with progress(f"{kind}, {name}") as bar:
                pictures[key] = of.shaded(quirks, shading_points, spp, bar)
            reads[key] = of.shader_reads
        if kind == shader:
            truncated_fraction, series_error = of.truncated_fraction, of.series_error
    same_light, of_quirks = pictures["same_light"].xyz, None
    if shares:
        scale = min(1.0, shares_side / max(of.surface.shape))
        columns, rows = (max(1, round(size * scale)) for size in of.film_size)
        small = open_scene(width=columns, height=rows)
        with progress("quirks") as bar:
            of_quirks = quirk_shares(small, QUIRKS_SAMPLES, QUIRKS_SHADING_POINTS, bar)
    return Comparison(
        scene=Path(scene_path).name,
        shader=shader,
        others=tuple(others),
        settings=settings,
        variant=mi.variant(),
        seed=seed,
        pictures=pictures,
        pigment=pigment,
        surface=of.surface,
        white=white,
        to_path_traced={
            name: difference(reference, pictures[name].xyz, of.surface, white)
            for name in pictures
            if name != "path_traced"
        },
        to_same_light={name: difference(same_light, pictures[name].xyz, of.surface, white) for name in reads},
        few_samples=tuple(few_samples),
        noise={name: noise(picture.halves, of.surface, white) for name, picture in pictures.items()},
        shader_reads=reads,
        model_reads=of.model_reads,
        truncated_fraction=truncated_fraction,
        series_error=series_error,
        samples=of.has_samples,
        patches=of.patches,
        coated=of.has_coat,
        shares=of_quirks,
    )
