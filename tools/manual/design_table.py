"""Print the tables of docs/designed_reliefs.md: what depth, levels, texels and time bring, and other targets.

    python tools/manual/design_table.py           # all rows
    python tools/manual/design_table.py cat ring  # those whose names contain one of the words
    python tools/manual/design_table.py bound     # of other targets: what the lobes of the orders allow
    python tools/manual/design_table.py colours   # ΔE00 of two coloured pictures, by plate
    python tools/manual/design_table.py sunset.png  # one of them, its prediction and its relief

Times are of the processor, on one core.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import scipy.optimize
from numpy.typing import NDArray

import mitsuba_diffraction as md
from mitsuba_diffraction.files.picture_file import read_picture
from mitsuba_diffraction.inverse_design.output import save_design_picture
from mitsuba_diffraction.inverse_design.plate import Plate
from mitsuba_diffraction.inverse_design.result import Design
from mitsuba_diffraction.inverse_design.search import WHITE, _Search, far_field_of
from mitsuba_diffraction.inverse_design.target import wanted_fractions
from mitsuba_diffraction.rigorous.solver import one_thread

CAT = Path(__file__).parents[2] / "precompute" / "designed" / "cat.png"
PLATES: dict[str, Mapping[str, float]] = {
    "default": {},
    "0.4 µm deep": {"height_range": 0.4},
    "1.6 µm deep": {"height_range": 1.6},
    "16 levels": {"levels": 16},
    "8 levels": {"levels": 8},
    "16 × 16 texels": {"texels": 16},
    "48 × 48 texels": {"texels": 48},
    "6 starts": {"starts": 6},
    "96 starts": {"starts": 96},
}


def targets() -> dict[str, NDArray[np.float64]]:
    """Return pictures that cover a tenth to a half of the window, (96, 96), rows from the top."""
    y, x = np.mgrid[1:-1:96j, -1:1:96j]
    a, b = (x + 0.25) / np.where(x < -0.25, 0.65, 0.5), (y - 0.05) / 0.65
    heart = (a**2 + b**2 - 1) ** 3 < a**2 * b**3
    bar = (x > 0.55) & (x < 0.8) & (y > -0.3)
    found = {
        "disc": np.hypot(x, y) < 0.36,
        "diamond": np.abs(x) + np.abs(y - 0.1) < 0.7,
        "ring": np.abs(np.hypot(x, y) - 0.6) < 0.15,
        "cross": (np.minimum(np.abs(x), np.abs(y)) < 0.22) & (np.hypot(x, y) < 0.85),
        "four bars": (np.abs(x) < 0.85) & (np.abs(y) < 0.85) & ((x + 0.85) % 0.5 < 0.25),
        "heart and bar": heart | bar,
        "heart and two bars": heart | bar | ((np.abs(x) < 0.85) & (np.abs(y + 0.85) < 0.12)),
        "square": np.maximum(np.abs(x), np.abs(y)) < 0.7,
    }
    return {name: picture.astype(float) for name, picture in found.items()}


def row(name: str, target: NDArray[np.float64], options: Mapping[str, float]) -> str:
    """Design a plate; return its line, with the ranges over wavelengths and the processor time."""
    began = time.process_time()
    found = md.design(target, **options)
    seconds = time.process_time() - began
    light, correlation = found.efficiency, found.correlation
    cells = (
        name,
        f"{target.mean():.2f}",
        f"{100 * light.min():.0f}–{100 * light.max():.0f} %",
        f"{correlation.min():.2f}–{correlation.max():.2f}",
        f"{found.unevenness.mean():.2f}",
        *(f"{100 * found.changed[error].min():.0f} %" for error in ("blur +20 %", "depth +5 %")),
        f"{seconds:.0f} s",
    )
    return f"| {' | '.join(cells)} |"


def bound(name: str, target: NDArray[np.float64]) -> str:
    """Return the line of the orders that fit a target best at 670 nm, of any powers ≥ 0, whatever relief had them."""
    plate = Plate(0.8, 32, 0.8, 17.5, np.array([670.0]), None, None, 0.13)
    wanted = wanted_fractions(target, plate)
    lobes = far_field_of(plate, wanted, plate.coherence_length, 3, np.float64).lobes[0]
    lobes, wanted = lobes[:, lobes.sum(axis=0) > 1e-3], wanted[0]
    count = lobes.shape[1]

    def loss(flat: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        difference = lobes @ flat.reshape(count, count) @ lobes.T - wanted
        scale = (wanted**2).sum()
        return float((difference**2).sum() / scale), (2 * lobes.T @ difference @ lobes / scale).ravel()

    limits, options = scipy.optimize.Bounds(0, np.inf), {"maxiter": 400, "ftol": 1e-10, "gtol": 0}
    start = np.full(count**2, 1 / count**2)
    powers = scipy.optimize.minimize(loss, start, jac=True, method="L-BFGS-B", bounds=limits, options=options).x
    found = lobes @ powers.reshape(count, count) @ lobes.T
    light = found[wanted > 0.1 * wanted.max()].sum() / powers.sum()
    return f"| {name} | {100 * light:.0f} % | {np.corrcoef(found.ravel(), wanted.ravel())[0, 1]:.2f} |"


def coloured() -> dict[str, NDArray[np.float64]]:
    """Return two coloured pictures, linear sRGB (96, 96, 3), rows from the top."""
    y, x = np.mgrid[1:-1:96j, -1:1:96j]
    colours = {
        "red": (255, 0, 0),
        "blue": (0, 80, 255),
        "orange": (255, 140, 30),
        "dusk": (40, 60, 160),
        "sun": (255, 230, 120),
        "sea": (20, 40, 90),
    }
    linear = {}
    for name, encoded in colours.items():
        c = np.array(encoded) / 255
        linear[name] = np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)
    shapes = np.zeros((96, 96, 3))
    shapes[np.hypot(x + 0.45, y) < 0.38] = linear["red"]
    shapes[(np.abs(x - 0.45) < 0.33) & (np.abs(y) < 0.33)] = linear["blue"]
    height = (y[..., None] + 1) / 2
    sunset = linear["orange"] * (1 - height) + linear["dusk"] * height
    sunset[np.hypot(x, y + 0.15) < 0.3] = linear["sun"]
    sunset[y < -0.35] = linear["sea"]
    return {"red disc, blue square": shapes, "sunset": sunset}


@one_thread()
def of_own_reliefs(target: NDArray[np.float64], starts: int) -> Design:
    """Return a design whose light of each wavelength is that of a relief for it alone; its relief is the last one."""
    plate = Plate(0.8, 32, 0.8, 17.5, WHITE, None, None, 0.13)
    wanted = wanted_fractions(target, plate)
    predicted = []
    for wavelength, part in zip(WHITE, wanted, strict=True):
        own = replace(plate, wavelengths=np.array([wavelength]))
        search = _Search(own, part[None], starts, lambda *_: None, lambda *_: None)
        search(0)
        found = Design.of(search.heights[:, ::-1], own, part[None, :, ::-1])
        predicted.append(found.predicted[0])
    return replace(Design.of(found.texels, plate, wanted[..., ::-1]), predicted=np.array(predicted))


def main(words: Sequence[str]) -> None:
    """Print the rows whose names contain one of the words, or all."""
    if list(words) == ["bound"]:
        for name, target in targets().items():
            print(bound(name, target), flush=True)
        return
    if list(words) and words[0].endswith("sunset.png"):
        save_design_picture(md.design(coloured()["sunset"], starts=6, height_range=3.2), words[0])
        return
    if list(words) == ["colours"]:
        plates: dict[str, Mapping[str, int | float]] = {
            "default": {"starts": 6},
            "3.2 µm deep": {"starts": 6, "height_range": 3.2},
            "64 × 64 texels, 3.2 µm deep": {"starts": 2, "texels": 64, "height_range": 3.2},
        }
        for name, target in coloured().items():
            differences = [f"{md.design(target, **plate).colour_difference:.1f}" for plate in plates.values()]
            differences.append(f"{of_own_reliefs(target, 6).colour_difference:.1f}")
            print(f"| {name} | {' | '.join(differences)} |", flush=True)
        return
    cat = read_picture(CAT)
    requests = [(f"cat, {name}", cat, options) for name, options in PLATES.items()]
    requests += [(name, target, {}) for name, target in targets().items()]
    requests += [(f"{name}, laser of 670 nm", targets()[name], {"wavelengths": 670}) for name in ("four bars", "ring")]
    for request in requests:
        if not words or any(word in request[0] for word in words):
            print(row(*request), flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
