"""Sampling efficiency of the BSDF: effective sample fraction, variance at equal time, time of a whole picture."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...bsdf import testing
from ...bsdf.device_tables import on_device
from ...progress import Progress, silent
from ...settings import VISIBLE
from .cases import Case
from .speed import seconds

_ANGLES = (0.0, 30.0, 60.0, 75.0, 85.0)
_AZIMUTHS = (0.0, 30.0, 60.0, 90.0)
_WAVELENGTH_DRAWS = 4  # sets of four wavelengths

SAMPLING_COLUMNS = {
    "surface": "{.surface}",
    **{f"fraction\n{angle:g}°": f"{{0.fractions[{index}]:.2f}}" for index, angle in enumerate(_ANGLES)},
    "largest\nweight": "{.largest_weight:.1f}",
    "variance of\ncosine sampling": "{.variance_ratio:.0f}",
    "picture\ntime": "{.picture_ratio:.2f}",
}


@dataclass(frozen=True)
class Sampling:
    """Sampling efficiency of a surface.

    Attributes:
        surface: name of the case.
        fractions: E[w]²/E[w²] at each of `_ANGLES`, the minimum over azimuths; R = 1.
        largest_weight: maximum weight of all samples drawn.
        variance_ratio: of cosine sampling to the BSDF's own, under a uniform sky, at equal time; the minimum
            over angles.
        picture_ratio: seconds of a sphere under sun and sky, to the same with roughconductor (Al), at equal samples.
    """

    surface: str
    fractions: tuple[float, ...]
    largest_weight: float
    variance_ratio: float
    picture_ratio: float


def measure(
    cases: Sequence[Case],
    tolerance: float,
    *,
    count: int = 1 << 16,
    size: int = 128,
    spp: int = 64,
    repetitions: int = 3,
    progress: Progress = silent,
) -> list[Sampling]:
    """Measure under the current variant.

    Args:
        cases: surfaces.
        tolerance: of their spectra.
        count: samples for each direction and draw of wavelengths.
        size: of the picture, pixels.
        spp: of the picture, samples per pixel.
        repetitions: of each timing, interleaved.
        progress: called with (steps done, steps in total).
    """
    results = []
    for case in cases:
        grating = {"type": "diffraction_grating", "spectrum": case.spectrum(tolerance=tolerance)}
        mirror = mi.load_dict({**grating, "material": "none"})
        fractions, max_weights = zip(*(_fraction(mirror, angle, count) for angle in _ANGLES), strict=True)
        pictures = {
            "grating": _sphere({**grating, "material": "Al"}, size),
            "rough": _sphere({"type": "roughconductor", "material": "Al"}, size),
        }
        work = {name: lambda s=scene: dr.eval(mi.render(s, spp=spp)) for name, scene in pictures.items()}
        taken = seconds(work, repetitions)
        results.append(
            Sampling(
                surface=case.name,
                fractions=fractions,
                largest_weight=max(max_weights),
                variance_ratio=min(_against_cosine(mirror, angle, count, repetitions) for angle in _ANGLES),
                picture_ratio=taken["grating"] / taken["rough"],
            )
        )
        progress(len(results), len(cases))
    return results


def _wavelengths(shift: ArrayLike) -> NDArray[np.float64]:
    """Return equally spaced wavelengths as Mitsuba's path tracer draws them: (..., 4) nm from shifts (..., 1)."""
    return VISIBLE[0] + (VISIBLE[1] - VISIBLE[0]) * (np.asarray(shift, np.float64) + np.arange(4)) / 4


def _fraction(bsdf: mi.BSDF, angle: float, count: int) -> tuple[float, float]:
    """Return the minimum of E[w]²/E[w²] over azimuths, and the maximum w; the weight w is a mean over four wavelengths.

    The ratio is averaged over draws of wavelengths.
    """
    drawn = _wavelengths((np.arange(_WAVELENGTH_DRAWS)[:, None] + 0.5) / _WAVELENGTH_DRAWS)
    shape = len(_AZIMUTHS), _WAVELENGTH_DRAWS, count
    wi = np.broadcast_to(testing.direction(angle, np.array(_AZIMUTHS))[:, None, None], (*shape, 3))
    wavelengths = np.broadcast_to(drawn[:, None], (*shape, 4))
    _, weights, _ = testing.sample(bsdf, wi.reshape(-1, 3), wavelengths.reshape(-1, 4))
    weight = weights.mean(axis=1).reshape(shape)
    fractions = (weight.mean(axis=-1) ** 2 / (weight**2).mean(axis=-1)).mean(axis=-1)
    return float(fractions.min()), float(weight.max())


def _against_cosine(bsdf: mi.BSDF, angle: float, count: int, repetitions: int) -> float:
    """Return variance times seconds of cosine sampling, relative to the BSDF's own sampling, under a uniform sky."""
    random = np.random.default_rng(1)
    si = testing.interaction(np.broadcast_to(testing.direction(angle, 30.0), (count, 3)), _wavelengths(0.3))
    sample1, sample2 = on_device(random.random(count)), mi.Point2f(*map(on_device, random.random((2, count))))
    dr.eval(si, sample1, sample2)

    def own() -> mi.Float:
        return dr.mean(mi.unpolarized_spectrum(bsdf.sample(mi.BSDFContext(), si, sample1, sample2)[1]))

    def cosine() -> mi.Float:
        wo = mi.warp.square_to_cosine_hemisphere(sample2)
        value = dr.mean(mi.unpolarized_spectrum(bsdf.eval(mi.BSDFContext(), si, wo)))
        return value / mi.warp.square_to_cosine_hemisphere_pdf(wo)

    samplers = {"cosine": cosine, "own": own}
    work = {name: functools.partial(lambda draw: dr.eval(draw()), draw) for name, draw in samplers.items()}
    times = seconds(work, repetitions)
    costs = {name: np.array(draw(), np.float64).var() * times[name] for name, draw in samplers.items()}
    return float(costs["cosine"] / costs["own"])


def _sphere(bsdf: dict, size: int) -> mi.Scene:
    """Return a scene of a sphere under sun and sky."""
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": 4},
            "sensor": {
                "type": "perspective",
                "fov": 30,
                "to_world": mi.ScalarTransform4f().look_at(origin=[0, -4, 1], target=[0, 0, 0], up=[0, 0, 1]),
                "film": {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}},
            },
            "sphere": {"type": "sphere", "bsdf": bsdf},
            "sun": {"type": "directional", "direction": [-0.4, 0.6, -0.7]},
            "sky": {"type": "constant"},
        }
    )
