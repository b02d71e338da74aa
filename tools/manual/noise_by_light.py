"""Noise² × time of `diffraction_path` beside `path`, for a plate under ten kinds of light: `python
tools/manual/noise_by_light.py [SURFACE …]`.

Pictures of 40 × 40 pixels at depth 2, five of each integrator in turn, with 64 samples per pixel. The noise is the
variance of a pixel between pictures, the time that of the processor, its median. docs/speed.md has the range of each
surface. A minute for each surface.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

import mitsuba_diffraction  # noqa: F401 (before Mitsuba, so that Dr.Jit has an LLVM that works)

import mitsuba as mi  # isort: skip

SIZE, SAMPLES, PICTURES = 40, 64, 5
PRECOMPUTE = Path(__file__).parents[2] / "precompute"
SURFACES: dict[str, dict[str, Any]] = {
    "compact disc": {"profile": "compact_disc", "coherence_length": 26.0},
    "foil": {"filename": str(PRECOMPUTE / "foil_crossed.toml")},
    "sinusoid": {"profile": "sinusoidal", "period": 2.0, "depth": 0.2},
    "skin": {"filename": str(PRECOMPUTE / "xenopeltis.toml")},
}


def uniform(value: float) -> dict[str, Any]:
    """Return a spectrum."""
    return {"type": "uniform", "value": value}


def sky(radiance: float = 1.0) -> dict[str, Any]:
    """Return a sky of the same radiance everywhere."""
    return {"type": "constant", "radiance": uniform(radiance)}


def sky_with_sun(peak: float, side: int = 2, clouds: bool = False) -> dict[str, Any]:
    """Return a sky of 0.05 with a square sun of `side` of 128 pixels."""
    pixels = np.full((64, 128, 3), 0.05, np.float32)
    if clouds:
        pixels[:32] *= np.random.default_rng(3).uniform(0.2, 4, (32, 128, 1))
    pixels[20 : 20 + side, 40 : 40 + side] = peak
    upright = mi.ScalarTransform4f().rotate([1, 0, 0], 90)
    return {"sky": {"type": "envmap", "bitmap": mi.Bitmap(pixels), "to_world": upright}}


def lamp(scale: float, textured: bool = False) -> dict[str, Any]:
    """Return a rectangle that faces the plate."""
    pixels = np.random.default_rng(5).uniform(0, 1, (16, 16, 1)) ** 6 * np.ones(3)
    picture = {"type": "bitmap", "bitmap": mi.Bitmap(pixels.astype(np.float32)), "raw": False}
    place = mi.ScalarTransform4f().look_at([-1.5, 2.5, 3.0], [0, 0, 0], [0.3, 1, 0.2]).scale(scale)
    emitter = {"type": "area", "radiance": picture if textured else uniform(1.0)}
    return {"type": "rectangle", "to_world": place, "emitter": emitter, "bsdf": black()}


def black() -> dict[str, Any]:
    """Return a black wall."""
    return {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": uniform(0.0)}}


def window() -> dict[str, Any]:
    """Return four black walls around an opening to the sky."""
    places = (-4.0, 1.0, 2.5, 6.0), (3.0, 1.0, 2.5, 6.0), (-0.5, 4.5, 1.0, 2.5), (-0.5, -2.5, 1.0, 2.5)
    walls = {
        f"wall{number}": {
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f().translate([x, y, 3.2]).scale([width, height, 1]),
            "bsdf": black(),
        }
        for number, (x, y, width, height) in enumerate(places)
    }
    return {**walls, "sky": sky()}


LIGHTS: dict[str, Callable[[], dict[str, Any]]] = {
    "uniform sky": lambda: {"sky": sky()},
    "lamp": lambda: {"lamp": lamp(0.5)},
    "lamp and sky": lambda: {"lamp": lamp(0.5), "sky": sky(0.2)},
    "large lamp": lambda: {"lamp": lamp(3.0)},
    "sky, sun × 20": lambda: sky_with_sun(1.0),
    "sky, sun × 600": lambda: sky_with_sun(30.0),
    "sky, sun × 20,000": lambda: sky_with_sun(1000.0),
    "clouds, sun × 100": lambda: sky_with_sun(5.0, 4, clouds=True),
    "textured lamp": lambda: {"lamp": lamp(1.2, textured=True)},
    "window": window,
}


def scene(surface: str, light: str, integrator: str) -> mi.Scene:
    """Return a scene of a plate."""
    film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}}
    view = mi.ScalarTransform4f().look_at([0.6, -2.4, 3.0], [0, 0, 0], [0, 0, 1])
    grating = {"type": "diffraction_grating", "material": "Al", **SURFACES[surface]}
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": integrator, "max_depth": 2},
            "sensor": {"type": "perspective", "fov": 32, "to_world": view, "film": film},
            "plate": {"type": "rectangle", "bsdf": grating},
            **LIGHTS[light](),
        },
        optimize=False,
    )


def compare(surface: str, light: str) -> tuple[float, float]:
    """Return the ratios of time and of noise² to those of `path`."""
    scenes = [scene(surface, light, integrator) for integrator in ("path", "diffraction_path")]
    times, pictures = np.zeros((2, PICTURES)), np.zeros((2, PICTURES, SIZE, SIZE, 3))
    for number in range(-1, PICTURES):
        for which, built in enumerate(scenes):
            began = time.process_time()
            picture = np.array(mi.render(built, spp=SAMPLES, seed=number + 1))
            if number >= 0:  # the first compiles
                times[which, number] = time.process_time() - began
                pictures[which, number] = picture
    noise = pictures.var(axis=1, ddof=1).mean(axis=(1, 2, 3)) / pictures.mean(axis=(1, 2, 3, 4)) ** 2
    seconds = np.median(times, axis=1)
    return float(seconds[1] / seconds[0]), float(noise[1] / noise[0])


if __name__ == "__main__":
    mi.set_variant("llvm_ad_spectral")
    print("| surface | light | time | noise² | noise² × time |\n|---|---|---|---|---|")
    for name in sys.argv[1:] or SURFACES:
        for kind in LIGHTS:
            slower, noisier = compare(name, kind)
            print(f"| {name} | {kind} | {slower:.2f} | {noisier:.3f} | {slower * noisier:.2f} |", flush=True)
