"""Check the error of scalar theory in two dimensions: `python tools/data/scalar_theory_2d.py [OUT.json]`.

For surfaces that vary along x and y, the error of scalar theory is determined by `volume_integral`, under the
conditions of `scalar_theory.scalar_error`, whose estimate stands beside it; five minutes of processor time. The tests
and docs/validation.md read the result.
"""

from __future__ import annotations

import itertools
import json
import math
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from volume_integral import Orders, extrapolated

import mitsuba_diffraction as md
from mitsuba_diffraction.files.writing import whole_file
from mitsuba_diffraction.precomputation.recipe import Recipe
from mitsuba_diffraction.scalar_theory.closed_form import (
    efficiency_difference,
    incident_direction,
    scalar_orders,
    tile_powers,
    transmitted_orders,
)
from mitsuba_diffraction.scalar_theory.validity import ERROR_WAVELENGTHS, INDEX, scalar_error

ROOT = Path(__file__).parents[2]
STORED = ROOT / "tests" / "data" / "scalar_theory_2d.json"
ANGLES, WEIGHTS = (0.0, 20.0), (1 / 3, 2 / 3)  # −20° is as 20°: all surfaces are symmetric in x
PERIODS, DEPTHS = (0.75, 1.2, 1.7, 2.3, 2.9), (0.1, 0.25)  # µm, of crossed sinusoids and checkerboards
SKINS = ("elaphe", "xenopeltis", "elaphe_afm", "xenopeltis_afm")
CUT = 3.0  # µm, the edge of a cut-out, of half a period
_PIXELS, _SQUARES = 32, 128  # along a period: of a sinusoid, of a checkerboard, whose steps need more


def crossed(period: float, depth: float) -> md.HeightField:
    """Return two sinusoids at right angles, `depth` from the lowest to the highest point, µm."""
    wave = np.sin(2 * np.pi * (np.arange(_PIXELS) + 0.5) / _PIXELS)
    return md.HeightField(depth / 4 * (wave[:, None] + wave), period / _PIXELS, f"crossed {period:g} × {depth:g} µm")


def checkerboard(period: float, depth: float) -> md.HeightField:
    """Return squares of half a period, high and low."""
    squares = np.kron(depth * np.eye(2), np.ones((_SQUARES // 2, _SQUARES // 2)))
    return md.HeightField(squares, period / _SQUARES, f"checkerboard {period:g} × {depth:g} µm")


def cut_out(skin: str, scale: float = 1.0) -> md.HeightField:
    """Return the middle of a measured skin, mirrored along x and y to one period, levelled."""
    whole = Recipe.load(ROOT / "precompute" / f"{skin}.toml").height_field()
    rows, columns = (round(CUT / pitch) for pitch in whole.pixel_size[::-1])
    first_row, first_column = ((size - count) // 2 for size, count in zip(whole.shape, (rows, columns), strict=True))
    piece = whole.heights[first_row : first_row + rows, first_column : first_column + columns]
    y, x = np.indices(piece.shape).reshape(2, -1)
    plane = np.stack([x, y, np.ones_like(x)], axis=1)
    piece = scale * (piece - (plane @ np.linalg.lstsq(plane, piece.ravel(), rcond=None)[0]).reshape(piece.shape))
    both = np.concatenate([piece, piece[::-1]])
    return md.HeightField(np.concatenate([both, both[:, ::-1]], axis=1), whole.pixel_size, f"{skin} × {scale:g}")


def surfaces() -> Iterator[tuple[md.HeightField, float, float, bool]]:
    """Yield surfaces, points and layers per µm, and whether they have steps."""
    yield crossed(2.0, 0.15), 20, 100, False
    for name in ("foil_crossed", "foil_hexagonal"):
        foil = Recipe.load(ROOT / "precompute" / f"{name}.toml").height_field()
        yield md.HeightField(foil.heights, foil.pixel_size, name), 20, 100, False
    for depth, period in itertools.product(DEPTHS, PERIODS):
        yield crossed(period, depth), 20, 100, False
    for skin in SKINS:
        yield cut_out(skin), 10, 60, False
    for depth, period in itertools.product(DEPTHS, PERIODS):
        yield checkerboard(period, depth), 20, 100, True
    for skin in SKINS:
        yield cut_out(skin, 0.5), 10, 60, False


def kind_of(case: dict[str, Any]) -> str:
    """Return "smooth", "checkerboard" or "measured"."""
    name = case["surface"].split()[0]
    return "measured" if name in SKINS else "checkerboard" if name == "checkerboard" else "smooth"


def solved(surface: md.HeightField, points: float, layers: float, stepped: bool) -> dict[str, Any]:
    """Return the estimated and the solved error of scalar theory, of reflected and of transmitted light."""
    began, period = time.process_time(), surface.tile_size
    powers = tile_powers(surface, min(ERROR_WAVELENGTHS))
    estimate = scalar_error(surface)
    heights = surface.heights
    unit = 4 if stepped else 2  # voxels that an edge of the checkerboard must not cut, at either resolution
    counts = tuple(unit * math.ceil(points * length / unit) for length in period[::-1])
    if stepped:
        heights = heights[:: _SQUARES // 2, :: _SQUARES // 2]
    count = 2 * math.ceil(layers * np.ptp(heights) / 2)
    errors, lost = np.zeros(2), 0.0
    for wavelength in ERROR_WAVELENGTHS:
        for angle, weight in zip(ANGLES, WEIGHTS, strict=True):
            light = incident_direction(angle, 0.0)
            exact = extrapolated(heights, period, light, wavelength, INDEX, counts, count, stepped=stepped)
            pairs = (
                (scalar_orders(powers, period, wavelength, angle, INDEX), exact.reflected, exact.eta),
                (
                    transmitted_orders(powers, period, wavelength, angle, INDEX),
                    exact.transmitted,
                    exact.eta_transmitted,
                ),
            )
            for n, (found, m, eta) in enumerate(pairs):
                where = {tuple(pair): k for k, pair in enumerate(m.tolist())}
                wanted = eta.mean(axis=0)[[where[tuple(pair)] for pair in found.m.tolist()]]
                errors[n] += weight / len(ERROR_WAVELENGTHS) * efficiency_difference(found.unpolarised, wanted)
            lost = max(lost, _lost(exact))
    return {
        "surface": surface.source,
        "period": [round(length, 4) for length in period],
        "range": round(float(np.ptp(heights)), 4),
        "voxels": [*counts, count],
        "estimated": [float(f"{value:.4g}") for value in (estimate.reflected, estimate.transmitted)],
        "error": [float(f"{value:.4g}") for value in errors],
        "lost": float(f"{lost:.1e}"),
        "seconds": round(time.process_time() - began),
    }


def rms_factor(cases: Sequence[dict[str, Any]], part: int) -> float:
    """Return the r.m.s. factor between estimate and error, of reflected (0) or transmitted (1) light."""
    ratios = [case["estimated"][part] / case["error"][part] for case in cases]
    return float(np.exp(np.sqrt(np.mean(np.log(ratios) ** 2))))


def rows() -> list[str]:
    """Return the rows of a table, of which docs/validation.md has some."""

    def pair(case: dict[str, Any], part: int) -> str:
        return ", ".join(f"{100 * float(f'{case[name][part]:.2g}'):.3g} %" for name in ("error", "estimated"))

    cases = json.loads(STORED.read_text(encoding="utf-8"))["cases"]
    return [f"| {case['surface']} | {case['range']:.2f} µm | {pair(case, 0)} | {pair(case, 1)} |" for case in cases]


def _lost(found: Orders) -> float:
    """Return the missing energy as a fraction of the reflected light."""
    return found.lost / float(found.eta.sum(axis=1).min())


def make(path: Path) -> None:
    """Solve all surfaces; what `path` holds already is kept."""
    content: dict[str, Any] = {
        "made by": "python tools/data/scalar_theory_2d.py",
        "units": "period and range of heights in µm; voxels along y, x and z at the coarser resolution; estimated: by "
        "scalar_error; error: solved; both of reflected and of transmitted light, means over 450, 550 and 650 nm and "
        f"0°, 20° and −20°, n = {INDEX}; lost: |1 − R − T|/R, the largest",
        "cases": json.loads(path.read_text())["cases"] if path.exists() else [],
    }
    for surface, *resolution in surfaces():
        if any(case["surface"] == surface.source for case in content["cases"]):
            continue
        content["cases"].append(solved(surface, *resolution))
        print(content["cases"][-1], flush=True)
        text = json.dumps(content, ensure_ascii=False).replace('{"surface"', '\n{"surface"')
        with whole_file(path) as temporary:
            Path(temporary).write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    if sys.argv[1:] == ["table"]:
        print("\n".join(rows()))
    else:
        make(Path(sys.argv[1]) if len(sys.argv) > 1 else STORED)
