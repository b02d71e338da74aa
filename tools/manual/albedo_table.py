"""Print the table of docs/materials.md on the conservation of energy: `albedo_table.py [NAME …]`."""

from __future__ import annotations

import logging
import sys
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

import mitsuba_diffraction as md  # before Mitsuba, so that Dr.Jit has an LLVM that works
from mitsuba_diffraction import testing

import mitsuba as mi  # isort: skip

RECIPES = sorted((Path(__file__).parents[2] / "precompute").glob("*.toml"))
SQUARE = {"period": 2.5, "depth": 0.25}
PROFILES: dict[str, dict[str, Any]] = {
    "morpho_ridges": {},
    "blazed": SQUARE,
    "sinusoidal": SQUARE,
    "lamellar": SQUARE,
    "crossed": SQUARE,
}
SCALES = {"lateral_scale": 0.3, "height_scale": 1.7}
COUNT, LARGEST = 512, 32  # directions; the ones with the largest albedos are measured again
SAMPLES, MORE_SAMPLES = 1 << 13, 1 << 17


def walls(round_edges: bool) -> md.GratingSpectrum:
    """Return the spectrum of random walls, 1.2 µm high."""
    noise = gaussian_filter(np.random.default_rng(1).normal(size=(256, 256)), 8, mode="wrap")
    heights = 1.2 * (noise > 0)
    return md.precompute(md.HeightField(gaussian_filter(heights, 2, mode="wrap") if round_edges else heights, 0.08))


def surfaces() -> dict[str, dict[str, Any]]:
    """Return the parameters of all surfaces."""
    found: dict[str, dict[str, Any]] = {path.name: {"filename": str(path)} for path in RECIPES}
    found |= {name: {"profile": name, **values} for name, values in PROFILES.items()}
    scaled = {"blazed": SQUARE, "ruled": {}, "sinusoidal": {"period": 2.0, "depth": 0.2}, "crossed": SQUARE}
    found |= {f"{name}, scaled": {"profile": name, **values, **SCALES} for name, values in scaled.items()}
    found["sinusoidal, 1 µm"] = {"profile": "sinusoidal", "period": 2.0, "depth": 0.2, "coherence_length": 1.0}
    return found | {"walls, round": {"spectrum": walls(True)}, "walls, sharp": {"spectrum": walls(False)}}


def albedos(
    bsdf: mi.BSDF, omega: NDArray[np.floating], wavelengths: NDArray[np.floating], samples: int, seed: int
) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
    """Return the albedos of the BSDF's own samples, and their standard errors, (n,)."""
    si = testing.interaction(np.repeat(omega, samples, 0), np.repeat(np.tile(wavelengths, (4, 1)).T, samples, 0))
    u = np.random.default_rng(seed).random((3, len(omega) * samples), np.float32)
    weights = bsdf.sample(mi.BSDFContext(), si, mi.Float(u[0]), mi.Point2f(mi.Float(u[1]), mi.Float(u[2])))[1]
    of_direction = np.array(mi.unpolarized_spectrum(weights)[0], np.float64).reshape(len(omega), samples)
    return of_direction.mean(1), of_direction.std(1) / np.sqrt(samples)


def main(names: list[str]) -> None:
    mi.set_variant("llvm_ad_spectral")
    logging.disable(logging.WARNING)
    random = np.random.default_rng(7)
    theta = np.where(random.random(COUNT) < 0.5, random.uniform(70, 89, COUNT), random.uniform(0, 89, COUNT))
    omega, wavelengths = testing.direction(theta, random.uniform(0, 360, COUNT)), random.uniform(360, 830, COUNT)
    print("| surface | 99 of 100 | maximum | its standard error |\n|---|---|---|---|")
    for name, parameters in surfaces().items():
        if names and name not in names:
            continue
        bsdf = mi.load_dict({"type": "diffraction_grating", "material": "none", **parameters})
        mean, error = albedos(bsdf, omega, wavelengths, SAMPLES, 0)
        largest = np.argsort(mean)[-LARGEST:]
        mean[largest], error[largest] = albedos(bsdf, omega[largest], wavelengths[largest], MORE_SAMPLES, 1)
        print(f"| {name} | {np.percentile(mean, 99):.3f} | {mean.max():.3f} | {error[mean.argmax()]:.4f} |", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
