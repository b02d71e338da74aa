"""The comparison from one scene to its numbers."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ...errors import RequestError
from ...progress import Progress, no_progress
from .difference import Difference, difference, noise, white_luminance
from .pictures import Picture, Pictures
from .quirk_shares import QuirkShares, quirk_shares

# The effect of quirks is measured in small pictures with little noise: 28 of them take about a minute on two cores.
QUIRKS_MAX_SIDE = 96
QUIRKS_SAMPLES = 256
QUIRKS_SHADING_POINTS = 9


@dataclass(frozen=True, eq=False)
class Comparison:
    """Results of a comparison.

    Attributes:
        scene: file name.
        shader: "flss", "nmm", "pq" or "gem".
        variant: Mitsuba's.
        seed: of the random numbers.
        pictures: by name: "path_traced", "same_light" (the project's model under the lights that the shader supports),
            "published" and "corrected" (the shader with and without its quirks).
        surface: (height, width) bool, the pixels that are compared: those covered by surfaces.
        white: the luminance that is shown as white.
        to_path_traced: difference of each other picture from the path-traced one.
        to_same_light: difference of the shader's pictures from "same_light".
        noise: the mean CIEDE2000 due to noise in the traced pictures; None for one sample per pixel.
        shader_reads: maximum number of texels (two numbers each) that one shading point of the shader reads.
        model_reads: packets (four numbers each) that one BRDF value of the project's model reads for a ray.
        truncated_fraction: maximum fraction of a line's power outside the shader's 3 × 3 texels; None if not used.
        coated: whether a grating has a coat, which the shader does not show.
        shares: fractions of the difference due to each quirk; None if not requested.
    """

    scene: str
    shader: str
    variant: str
    seed: int
    pictures: Mapping[str, Picture]
    surface: NDArray[np.bool_]
    white: float
    to_path_traced: Mapping[str, Difference]
    to_same_light: Mapping[str, Difference]
    noise: Mapping[str, float | None]
    shader_reads: int
    model_reads: int
    truncated_fraction: float | None
    coated: bool
    shares: QuirkShares | None


def compare(
    scene_path: str | os.PathLike[str],
    shader: str = "flss",
    *,
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
        shader: "flss", "nmm", "pq" or "gem".
        width: in pixels; default: that of the film.
        height: likewise.
        spp: samples per pixel of the path tracer.
        shading_points: per pixel of the shader, each with its whole spectrum.
        seed: of the random numbers, not negative.
        parameters: values for the scene's `$name` parameters.
        shares: measure the fraction of the difference that is due to each quirk.
        shares_side: the longer side, in pixels, of the pictures for `shares`; limited to that of the picture.
        progress: progress(label) is a context whose value is called with (done, total).

    Raises:
        FileNotFoundError: if there is no such scene.
        ValueError: if the request is wrong, or the shader cannot show the scene.
        RuntimeError: if rendering failed.
    """
    for name, count in (("spp", spp), ("shading_points", shading_points), ("shares_side", shares_side)):
        if count < 1:
            raise RequestError(f"{name}: got {count}, wanted a positive number")
    of = Pictures(scene_path, shader, width=width, height=height, seed=seed, parameters=parameters)
    pictures = {}
    with progress("path tracer") as bar:
        pictures["path_traced"] = of.path_traced(spp, bar)
    with progress("the same light") as bar:
        pictures["same_light"] = of.same_light(spp, bar)
    for name, quirks in (("published", of.quirks), ("corrected", ())):
        with progress(f"{shader}, {name}") as bar:
            pictures[name] = of.shaded(quirks, shading_points, spp, bar)
    reference, same_light = pictures["path_traced"].xyz, pictures["same_light"].xyz
    white = white_luminance(reference, of.surface)
    of_quirks = None
    if shares:
        scale = min(1.0, shares_side / max(of.surface.shape))
        columns, rows = (max(1, round(size * scale)) for size in of.film_size)
        small = Pictures(scene_path, shader, width=columns, height=rows, seed=seed, parameters=parameters)
        with progress("quirks") as bar:
            of_quirks = quirk_shares(small, QUIRKS_SAMPLES, QUIRKS_SHADING_POINTS, bar)
    return Comparison(
        scene=Path(scene_path).name,
        shader=shader,
        variant=mi.variant(),
        seed=seed,
        pictures=pictures,
        surface=of.surface,
        white=white,
        to_path_traced={
            name: difference(reference, pictures[name].xyz, of.surface, white)
            for name in ("same_light", "published", "corrected")
        },
        to_same_light={
            name: difference(same_light, pictures[name].xyz, of.surface, white) for name in ("published", "corrected")
        },
        noise={name: noise(picture.halves, of.surface, white) for name, picture in pictures.items()},
        shader_reads=of.shader_reads,
        model_reads=of.model_reads,
        truncated_fraction=of.truncated_fraction,
        coated=of.has_coat,
        shares=of_quirks,
    )
