"""Print albedos as in docs/plugin.md: of a perfect mirror with each built-in profile, and each recipe.

    python docs/albedos.py                    # all surfaces; the spectra of recipes are built first
    python docs/albedos.py film.toml crossed

Directions are random, half of them at more than 70°, wavelengths uniform from 360 to 830 nm.
"""

from __future__ import annotations

import mitsuba_diffraction  # noqa: F401  before Dr.Jit

import mitsuba as mi  # isort: skip

import argparse
import inspect
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mitsuba_diffraction import testing
from mitsuba_diffraction.evaluation.report import markdown
from mitsuba_diffraction.llvm import choose_variant
from mitsuba_diffraction.surface.gratings import PROFILES

RECIPES = sorted(Path(__file__).parents[1].joinpath("precompute").glob("*.toml"))
DIRECTIONS, SAMPLES = 512, 1 << 11
LARGEST, MORE_SAMPLES = 12, 1 << 15  # albedos that are measured again, more than one of 100
SHEETS = ("film", "transmission_300", "transmission_600")  # also measured as clear sheets, light from both sides
SIZES = {"period": 2.5, "depth": 0.25}  # µm, of profiles without default ones


def albedos(
    bsdf: mi.BSDF, omega: NDArray[np.float64], wavelengths: NDArray[np.float64], samples: int, seed: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the albedo in directions (n, 3) at wavelengths (n,) in nm, by samples of the BSDF, and its error, (n,)."""
    channels = len(mi.UnpolarizedSpectrum(0))
    context = mi.BSDFContext(mi.TransportMode.Importance)
    wavelengths = np.repeat(np.repeat(wavelengths[:, None], channels, 1), samples, 0)
    _, weights, _ = testing.sample(bsdf, np.repeat(omega, samples, 0), wavelengths, seed, context)
    weights = weights[:, 0].reshape(len(omega), samples)
    return weights.mean(1), weights.std(1) / np.sqrt(samples)


def sizes(name: str) -> dict[str, float]:
    """Return the sizes that a profile requires."""
    parameters = inspect.signature(PROFILES[name]).parameters.values()
    return {of.name: SIZES[of.name] for of in parameters if of.default is of.empty}


def row(name: str, parameters: dict[str, object]) -> list[str]:
    """Return the row of one surface: 99th percentile, maximum with its standard error, direction and wavelength."""
    bsdf, random = mi.load_dict({"type": "diffraction_grating", **parameters}), np.random.default_rng(0)
    theta = random.uniform(np.where(np.arange(DIRECTIONS) % 2, 0, 70), 89)
    phi, wavelengths = random.uniform(0, 360, DIRECTIONS), random.uniform(360, 830, DIRECTIONS)
    omega = testing.direction(theta, phi)
    if "transmission" in parameters:
        omega[::4, 2] *= -1
        omega[1::4, 2] *= -1
    found, _ = albedos(bsdf, omega, wavelengths, SAMPLES, 1)
    largest = np.argsort(found)[-LARGEST:]
    again, error = albedos(bsdf, omega[largest], wavelengths[largest], MORE_SAMPLES, 2)
    at = np.argmax(again)
    where = f"{theta[largest[at]]:.0f}°, {phi[largest[at]]:.0f}°, {wavelengths[largest[at]]:.0f} nm"
    percentile = np.sort(again)[-1 - DIRECTIONS // 100]
    return [name, f"{percentile:.3f}", f"{again[at]:.3f} ± {error[at]:.3f}", where]


def main() -> None:
    mi.set_variant(choose_variant(None))
    surfaces: dict[str, dict[str, object]] = {
        **{path.name: {"filename": str(path), "material": "none"} for path in RECIPES},
        **{name: {"profile": name, "material": "none", **sizes(name)} for name in PROFILES},
        **{f"{name}, sheet": {"profile": name, "int_ior": 1.52, "transmission": "sheet"} for name in SHEETS},
    }
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("surfaces", nargs="*", choices=[[], *surfaces], metavar="SURFACE")
    chosen = parser.parse_args().surfaces or list(surfaces)
    columns = ("surface", "99 of 100", "maximum", "at θ, φ, λ")
    print(markdown(columns, []), end="")
    for name in chosen:
        print("| " + " | ".join(row(name, surfaces[name])) + " |", flush=True)


if __name__ == "__main__":
    main()
