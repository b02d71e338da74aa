"""How much work a sample of the BSDF does: effective fraction, variance at equal time, time of a whole picture."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..bsdf import probe
from ..wavelengths import VISIBLE
from .cases import Case
from .speed import seconds

ANGLES = (0.0, 30.0, 60.0, 75.0, 85.0)
_AZIMUTHS = (0.0, 30.0, 60.0, 90.0)
_WAVELENGTHS = 4  # draws of the four wavelengths of a ray

COLUMNS = {
    "surface": "{.surface}",
    **{f"fraction\n{angle:g}°": f"{{0.fractions[{index}]:.2f}}" for index, angle in enumerate(ANGLES)},
    "largest\nweight": "{.largest_weight:.1f}",
    "variance of\ncosine sampling": "{.variance_ratio:.0f}",
    "picture\ntime": "{.picture_ratio:.2f}",
}


@dataclass(frozen=True)
class Sampling:
    """How well a surface is sampled.

    Attributes:
        surface: name of the case.
        fractions: E[w]²/E[w²] at each of `ANGLES`, the least over azimuths; R = 1.
        largest_weight: of all samples drawn.
        variance_ratio: of cosine sampling to the BSDF's own, under a uniform sky, at equal time; the least over angles.
        picture_ratio: seconds of a sphere under sun and sky, to the same with roughconductor (Al), at equal samples.
    """

    surface: str
    fractions: tuple[float, ...]
    largest_weight: float
    variance_ratio: float
    picture_ratio: float


def measure(
    cases: Sequence[Case],
    *,
    count: int = 1 << 16,
    size: int = 128,
    spp: int = 64,
    repetitions: int = 3,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[Sampling]:
    """Measures under the variant in force.

    Args:
        cases: surfaces.
        count: samples for each direction and draw of wavelengths.
        size: of the picture, pixels.
        spp: of the picture, samples per pixel.
        repetitions: of each timing, interleaved.
        progress: called with (steps done, steps in all).
    """
    results = []
    for case in cases:
        grating = {"type": "diffraction_grating", "spectrum": case.spectrum()}
        mirror = mi.load_dict({**grating, "material": "none"})
        drawn = np.array([[_fraction(mirror, angle, phi, count) for phi in _AZIMUTHS] for angle in ANGLES])
        pictures = {
            "grating": _sphere({**grating, "material": "Al"}, size),
            "rough": _sphere({"type": "roughconductor", "material": "Al"}, size),
        }
        work = {name: lambda s=scene: dr.eval(mi.render(s, spp=spp)) for name, scene in pictures.items()}
        taken = seconds(work, repetitions)
        results.append(
            Sampling(
                surface=case.name,
                fractions=tuple(drawn[..., 0].min(axis=1).tolist()),
                largest_weight=float(drawn[..., 1].max()),
                variance_ratio=min(_against_cosine(mirror, angle, count, repetitions) for angle in ANGLES),
                picture_ratio=taken["grating"] / taken["rough"],
            )
        )
        progress(len(results), len(cases))
    return results


def _wavelengths(shift: float) -> np.ndarray:
    """Equally spaced, shifted together, as Mitsuba's path tracer takes them: (4,) nm."""
    return VISIBLE[0] + (VISIBLE[1] - VISIBLE[0]) * (shift + np.arange(4)) / 4


def _fraction(bsdf: mi.BSDF, angle: float, azimuth: float, count: int) -> tuple[float, float]:
    """E[w]²/E[w²] and the largest w, the weight averaged over the four wavelengths; mean over draws of wavelengths."""
    wi = np.broadcast_to(probe.direction(angle, azimuth), (count, 3))
    fractions, largest = [], 0.0
    for draw in range(_WAVELENGTHS):
        _, weights, _ = probe.sample(bsdf, wi, _wavelengths((draw + 0.5) / _WAVELENGTHS), seed=draw)
        weight = weights.mean(axis=1)
        fractions.append(weight.mean() ** 2 / (weight**2).mean())
        largest = max(largest, float(weight.max()))
    return float(np.mean(fractions)), largest


def _against_cosine(bsdf: mi.BSDF, angle: float, count: int, repetitions: int) -> float:
    """Variance times seconds of cosine sampling, over those of the BSDF's own sampling, under a uniform sky."""
    random = np.random.default_rng(1)
    si = probe.interaction(np.broadcast_to(probe.direction(angle, 30.0), (count, 3)), _wavelengths(0.3))
    sample1, sample2 = mi.Float(random.random(count)), mi.Point2f(random.random((2, count)))
    dr.eval(si, sample1, sample2)

    def own() -> mi.Float:
        return dr.mean(mi.unpolarized_spectrum(bsdf.sample(mi.BSDFContext(), si, sample1, sample2)[1]))

    def cosine() -> mi.Float:
        wo = mi.warp.square_to_cosine_hemisphere(sample2)
        value = dr.mean(mi.unpolarized_spectrum(bsdf.eval(mi.BSDFContext(), si, wo)))
        return value / mi.warp.square_to_cosine_hemisphere_pdf(wo)

    ways = {"cosine": cosine, "own": own}
    taken = seconds({name: lambda way=way: dr.eval(way()) for name, way in ways.items()}, repetitions)
    costs = {name: np.array(way(), np.float64).var() * taken[name] for name, way in ways.items()}
    return float(costs["cosine"] / costs["own"])


def _sphere(bsdf: dict, size: int) -> mi.Scene:
    """A sphere under sun and sky."""
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
