"""How much work a sample of the BSDF does: effective fraction, variance at equal time, time of a whole picture."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from .cases import Case

ANGLES = (0.0, 30.0, 60.0, 75.0, 85.0)
_AZIMUTHS = (0.0, 30.0, 60.0, 90.0)
_WAVELENGTHS = 4  # draws of the four wavelengths of a ray


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
    """Measure under the variant in force.

    Args:
        cases: surfaces.
        count: samples for each direction and draw of wavelengths.
        size: of the picture, pixels.
        spp: of the picture, samples per pixel.
        repetitions: of the picture, interleaved.
        progress: called with (steps done, steps in all).
    """
    results = []
    for case in cases:
        spectrum = case.spectrum()
        mirror = mi.load_dict({"type": "diffraction_grating", "spectrum": spectrum, "material": "none"})
        drawn = [[_fraction(mirror, angle, azimuth, count) for azimuth in _AZIMUTHS] for angle in ANGLES]
        variance = min(_against_cosine(mirror, angle, count) for angle in ANGLES)
        metal = {"type": "diffraction_grating", "spectrum": spectrum, "material": "Al"}
        rough = {"type": "roughconductor", "material": "Al"}
        seconds = _pictures([metal, rough], size, spp, repetitions)
        results.append(
            Sampling(
                surface=case.name,
                fractions=tuple(min(fraction for fraction, _ in several) for several in drawn),
                largest_weight=max(largest for several in drawn for _, largest in several),
                variance_ratio=variance,
                picture_ratio=seconds[0] / seconds[1],
            )
        )
        progress(len(results), len(cases))
    return results


def _interaction(angle: float, azimuth: float, shift: float, count: int) -> mi.SurfaceInteraction3f:
    theta, phi = np.deg2rad([angle, azimuth])
    si = dr.zeros(mi.SurfaceInteraction3f, count)
    wi = np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)
    si.wi = mi.Vector3f(*(dr.full(mi.Float, float(x), count) for x in wi))
    # Equally spaced, shifted together, as Mitsuba's path tracer takes them.
    wavelengths = 360 + 470 * ((shift + np.arange(4)) / 4)
    si.wavelengths = mi.UnpolarizedSpectrum(*(dr.full(mi.Float, float(x), count) for x in wavelengths))
    return si


def _fraction(bsdf: mi.BSDF, angle: float, azimuth: float, count: int) -> tuple[float, float]:
    """E[w]²/E[w²] and the largest w, the weight averaged over the four wavelengths; mean over draws of wavelengths."""
    random = np.random.default_rng(0)
    fractions, largest = [], 0.0
    for draw in range(_WAVELENGTHS):
        si = _interaction(angle, azimuth, (draw + 0.5) / _WAVELENGTHS, count)
        sample1 = mi.Float(random.random(count))
        sample2 = mi.Point2f(mi.Float(random.random(count)), mi.Float(random.random(count)))
        _, weight = bsdf.sample(mi.BSDFContext(), si, sample1, sample2)
        weight = np.array(weight, np.float64).mean(axis=0)
        fractions.append(weight.mean() ** 2 / (weight**2).mean())
        largest = max(largest, float(weight.max()))
    return float(np.mean(fractions)), largest


def _against_cosine(bsdf: mi.BSDF, angle: float, count: int) -> float:
    """Variance times seconds of cosine sampling, over those of the BSDF's own sampling, under a uniform sky."""
    random = np.random.default_rng(1)
    si = _interaction(angle, 30.0, 0.3, count)
    sample1 = mi.Float(random.random(count))
    sample2 = mi.Point2f(mi.Float(random.random(count)), mi.Float(random.random(count)))
    dr.eval(sample1, sample2)

    def own() -> mi.Float:
        return _over_wavelengths(bsdf.sample(mi.BSDFContext(), si, sample1, sample2)[1])

    def cosine() -> mi.Float:
        wo = mi.warp.square_to_cosine_hemisphere(sample2)
        value = bsdf.eval(mi.BSDFContext(), si, wo)
        return _over_wavelengths(value) / mi.warp.square_to_cosine_hemisphere_pdf(wo)

    costs = []
    for way in (cosine, own):
        seconds = _seconds(lambda way=way: dr.eval(way()), 5)
        costs.append(np.array(way(), np.float64).var() * seconds)
    return float(costs[0] / costs[1])


def _over_wavelengths(value: mi.Spectrum) -> mi.Float:
    return sum(value[channel] for channel in range(len(value))) / len(value)


def _seconds(call: Callable[[], None], repetitions: int) -> float:
    call()
    dr.sync_thread()
    times = []
    for _ in range(repetitions):
        start = time.perf_counter()
        call()
        dr.sync_thread()
        times.append(time.perf_counter() - start)
    return statistics.median(times)


def _pictures(bsdfs: Sequence[dict], size: int, spp: int, repetitions: int) -> list[float]:
    """Seconds of a sphere with each BSDF under sun and sky: medians of interleaved repetitions."""
    scenes = [
        mi.load_dict(
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
        for bsdf in bsdfs
    ]
    calls = [lambda s=scene: dr.eval(mi.render(s, spp=spp)) for scene in scenes]
    seconds: list[list[float]] = [[] for _ in calls]
    for call in calls:
        call()
    dr.sync_thread()
    for _ in range(repetitions):
        for times, call in zip(seconds, calls, strict=True):
            start = time.perf_counter()
            call()
            dr.sync_thread()
            times.append(time.perf_counter() - start)
    return [statistics.median(times) for times in seconds]
