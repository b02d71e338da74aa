"""Compute the map of errors of scalar theory: `python tools/data/scalar_theory_map.py [OUT.json]`.

For sinusoids of many periods and depths, in a dielectric and in aluminium, it compares scalar efficiencies with those
of `mitsuba_diffraction.rigorous`, of reflected and, in the dielectric, of transmitted light; eight minutes on two
cores. `scalar_theory.py` reads it.
"""

from __future__ import annotations

import itertools
import json
import multiprocessing
import os
import sys
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np
from rich.progress import track

from mitsuba_diffraction import gratings, rigorous
from mitsuba_diffraction.files.writing import whole_file
from mitsuba_diffraction.scalar_theory.closed_form import (
    efficiency_difference,
    scalar_orders,
    sinusoid_powers,
    transmitted_orders,
)
from mitsuba_diffraction.scalar_theory.validity import MAP

# In wavelengths. Multiples of λ and of λ/n are avoided: at a Rayleigh anomaly the error has a narrow peak.
PERIODS = (0.97, 1.45, 2.05, 2.7, 3.5, 4.7, 6.7, 9.4, 13.7, 20.3)
DEPTHS = (0.05, 0.1, 0.2, 0.35, 0.5, 0.75, 1.0, 1.4, 2.0)
# Degrees: of incidence, and from the plane perpendicular to the grooves (90: light along the grooves).
DIRECTIONS = ((0, 0), (20, 0), (40, 0), (60, 0), (40, 45), (60, 45), (40, 90), (60, 90))
DIELECTRIC = 1.5 + 0j
MATERIALS = {
    "dielectric": DIELECTRIC,
    "Al": rigorous.refractive_index(0.55, material="Al"),
    "transmitted": DIELECTRIC,
    "transmitted from below": DIELECTRIC,
}
TOLERANCE = 3e-3
SAMPLES = 512


def solved(job: tuple[str, tuple[int, int], float, float]) -> tuple[float, float]:
    """Return the error of scalar theory, and the error of the rigorous efficiencies, for λ = 1 µm."""
    material, (angle, azimuth), depth, period = job
    index, transmits, below = MATERIALS[material], material.startswith("transmitted"), material.endswith("below")
    sine = np.sin(np.deg2rad(angle)) / (index.real if below else 1)
    cosine = np.sqrt(1 - sine**2) * (-1 if below else 1)
    light = -sine * np.cos(np.deg2rad(azimuth)), -sine * np.sin(np.deg2rad(azimuth)), cosine
    surface = gratings.sinusoidal(period, depth, samples=SAMPLES)
    found = rigorous.efficiencies(surface, light, 1.0, int_ior=index, tolerance=TOLERANCE)
    if transmits:
        scalar = transmitted_orders(sinusoid_powers(depth), period, 1.0, angle, index.real, azimuth, below)
        exact = found.transmission
    else:
        scalar = scalar_orders(sinusoid_powers(depth), period, 1.0, angle, index, azimuth)
        exact = found.reflection
    if not np.array_equal(exact.m, scalar.m):
        raise RuntimeError(f"{job}: got the orders {scalar.m}, wanted {exact.m}")
    return efficiency_difference(scalar.unpolarised, exact.unpolarised), found.error


def make(path: Path) -> None:
    """Solve all cases and write the map atomically."""
    jobs = list(itertools.product(MATERIALS, DIRECTIONS, DEPTHS, PERIODS))
    with ProcessPoolExecutor(os.cpu_count(), multiprocessing.get_context("spawn")) as pool:
        found = list(track(pool.map(solved, jobs, chunksize=4), "rigorous efficiencies", total=len(jobs)))
    errors, changes = (np.reshape(part, (len(MATERIALS), len(DIRECTIONS), -1)) for part in zip(*found, strict=True))
    content = {
        "made by": "python tools/data/scalar_theory_map.py",
        "units": "periods and depths in wavelengths; directions in degrees: of incidence, and of the plane of "
        "incidence from that perpendicular to the grooves; error[material][direction]: Σ|Δη| / Σ η of unpolarised "
        "light, all periods of the first depth first; change: the largest at the last raise of harmonics",
        "periods": PERIODS,
        "depths": DEPTHS,
        "directions": DIRECTIONS,
        "index": {name: [index.real, index.imag] for name, index in MATERIALS.items()},
        "change": {name: float(f"{change.max():.2g}") for name, change in zip(MATERIALS, changes, strict=True)},
        "error": {
            name: [[float(f"{x:.3g}") for x in row] for row in error]
            for name, error in zip(MATERIALS, errors, strict=True)
        },
    }
    text = json.dumps(content, ensure_ascii=False).replace("], [", "],\n[")
    with whole_file(path) as temporary:
        Path(temporary).write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    os.environ["OPENBLAS_NUM_THREADS"] = "1"
    make(Path(sys.argv[1]) if len(sys.argv) > 1 else MAP)
