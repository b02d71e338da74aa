"""Compute the stored rigorous results: `python tools/data/rigorous_reference.py [OUT.json]`.

Needs the extra "reference" (meent); about ten minutes on two cores. `scalar_theory.py` and
`validation/coupled_waves.py` read them.
"""

from __future__ import annotations

import itertools
import json
import multiprocessing
import os
import sys
from concurrent.futures import ProcessPoolExecutor
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
from coupled_waves import Efficiencies, converged
from rich.progress import track

from mitsuba_diffraction.evaluation.validation.coupled_waves import STORED
from mitsuba_diffraction.files.writing import whole_file

DIELECTRIC = 1.5
TOLERANCE = 3e-3
"""Change of the orders at the last refinement, as a fraction of the reflected power."""

# Of the map. Multiples of λ and of λ/n are avoided: near a Rayleigh anomaly every method converges slowly.
MAP_PERIODS = (0.97, 1.45, 2.05, 2.7, 3.5, 4.7, 6.7, 9.4, 13.7, 20.3)  # period/λ
MAP_DEPTHS = (0.05, 0.1, 0.2, 0.35, 0.5, 0.75, 1.0, 1.4, 2.0)  # depth/λ
MAP_ANGLES = (0.0, 20.0)

# Profile, periods, depths, wavelengths (µm), angles (degrees); all combinations.
DIELECTRIC_CASES = (
    ("sinusoidal", (1.75, 2.5, 5.0), (0.1, 0.25), (0.45, 0.65), (0.0, 20.0, 40.0, 60.0)),
    ("blazed", (2.5, 5.0), (0.25, 0.5), (0.45, 0.65), (0.0, 20.0, 40.0, 60.0)),
    ("triangular", (2.5, 5.0), (0.25,), (0.45, 0.65), (0.0, 20.0, 40.0, 60.0)),
)
METAL = "Al"
METAL_CASES = (
    ("sinusoidal", (2.5,), (0.15,), (0.55,), (0.0, 20.0, 40.0)),
    ("blazed", (2.5,), (0.25,), (0.55,), (0.0, 20.0, 40.0)),
    ("triangular", (2.5,), (0.25,), (0.55,), (0.0, 20.0, 40.0)),
)
# TM converges slowly for staircases of metal.
METAL_LIMITS = {"max_harmonics": 50, "max_layers": 64}


def metal_index(name: str, wavelength: float) -> complex:
    """Return n + ik of a metal by Mitsuba's name at a wavelength in µm, as in Mitsuba's `conductor`."""
    import mitsuba as mi

    if not mi.variant():
        mi.set_variant("llvm_ad_spectral")
    metal = mi.traverse(mi.load_dict({"type": "conductor", "material": name}))
    n, k = (np.interp(wavelength * 1e3, metal[f"{x}.wavelengths"], metal[f"{x}.values"]) for x in ("eta", "k"))
    return complex(n, k)


def _numbers(values: np.ndarray) -> list[float]:
    # Converged to about four digits.
    return [float(f"{value:.5g}") for value in values]


def _convergence_of(found: Efficiencies) -> dict[str, Any]:
    return {
        "harmonics": found.harmonics,
        "layers": found.layers,
        "change": float(f"{found.change:.2g}"),
        "lost": None if np.isnan(found.lost) else float(f"{found.lost:.1g}"),
        "orders": [int(found.orders[0]), int(found.orders[-1])],
    }


def _cases() -> list[dict[str, Any]]:
    cases = []
    for material, lists in (("dielectric", DIELECTRIC_CASES), (METAL, METAL_CASES)):
        for profile, *axes in lists:
            for period, depth, wavelength, angle in itertools.product(*axes):
                index = complex(DIELECTRIC) if material == "dielectric" else metal_index(material, wavelength)
                cases.append(
                    {
                        "profile": profile,
                        "period": period,
                        "depth": depth,
                        "wavelength": wavelength,
                        "angle": angle,
                        "material": material,
                        "index": [index.real, index.imag],
                    }
                )
    return cases


def _solved(job: dict[str, Any]) -> dict[str, Any]:
    """Return a case, or a point of the map, with its efficiencies."""
    if "profile" in job:
        geometry = (job[name] for name in ("profile", "period", "depth", "wavelength", "angle"))
        limits = {} if job["material"] == "dielectric" else METAL_LIMITS
        found = converged(*geometry, complex(*job["index"]), tolerance=TOLERANCE, **limits)
        return job | _convergence_of(found) | {"te": _numbers(found.te), "tm": _numbers(found.tm)}
    arguments = job["period"], job["depth"], 1.0, job["angle"]
    found = converged("sinusoidal", *arguments, complex(DIELECTRIC), tolerance=TOLERANCE)
    return job | _convergence_of(found) | {"unpolarised": _numbers((found.te + found.tm) / 2)}


def all_jobs() -> list[dict[str, Any]]:
    """Return the gratings and the points of the map that are solved."""
    points = itertools.product(MAP_PERIODS, MAP_DEPTHS, MAP_ANGLES)
    return _cases() + [{"period": period, "depth": depth, "angle": angle} for period, depth, angle in points]


def make(path: Path, jobs: list[dict[str, Any]], workers: int | None = None) -> None:
    """Solve jobs on several cores and write the results atomically."""
    # meent's matrices are small: one thread for each process is fastest.
    os.environ["OPENBLAS_NUM_THREADS"] = "1"
    with ProcessPoolExecutor(workers, multiprocessing.get_context("spawn")) as pool:
        results = list(track(pool.map(_solved, jobs), "coupled waves", total=len(jobs)))
    write(path, results)


def write(path: Path, results: list[dict[str, Any]]) -> None:
    """Write the results as JSON, atomically."""
    cases = [result for result in results if "profile" in result]
    table = [result for result in results if "profile" not in result]
    content = {
        "made by": "python tools/data/rigorous_reference.py",
        "with": {name: metadata.version(name) for name in ("meent", "numpy", "scipy")},
        "tolerance": TOLERANCE,
        "units": "period, depth, wavelength in µm (in wavelengths in the map), angle in degrees from the normal, light "
        "from −x; index n + ik; efficiencies are shares of the incident power, from the first to the last of orders",
        "map index": DIELECTRIC,
        "cases": cases,
        "map": table,
    }
    # One line for each result.
    text = (
        json.dumps(content, ensure_ascii=False)
        .replace('{"profile"', '\n{"profile"')
        .replace('{"period"', '\n{"period"')
    )
    with whole_file(path) as temporary:
        Path(temporary).write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    make(Path(sys.argv[1]) if len(sys.argv) > 1 else STORED, all_jobs())
