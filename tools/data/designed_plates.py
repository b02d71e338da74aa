"""Compare designed plates with Maxwell's equations: `python tools/data/designed_plates.py [OUT.json]`.

Small plates of glass are designed for a picture; the efficiencies of all their orders are computed by
`volume_integral`, five minutes of processor time. The tests and the table of docs/designed_reliefs.md read the
result. `python tools/data/designed_plates.py table` prints the table.
"""

from __future__ import annotations

import json
import math
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from volume_integral import extrapolated

import mitsuba_diffraction as md
from mitsuba_diffraction.files.writing import whole_file
from mitsuba_diffraction.inverse_design import Design
from mitsuba_diffraction.inverse_design.far_field import lobes_in_bins
from mitsuba_diffraction.inverse_design.plate import Plate
from mitsuba_diffraction.inverse_design.target import wanted_fractions
from mitsuba_diffraction.scalar_theory.closed_form import (
    efficiency_difference,
    scalar_orders,
    tile_powers,
    transmitted_orders,
)

Array = NDArray[np.float64]

STORED = Path(__file__).parents[2] / "tests" / "data" / "designed_plates.json"
INDEX = 1.5
WAVELENGTHS = (450.0, 550.0, 650.0)
ANGLE, TOOL_BLUR = 17.5, 0.13  # as by default
# Texel in µm, their number along the period, height range in µm, and whether the light is reflected or transmitted.
PLATES = (
    (0.6, 8, 0.4, "reflected"),
    (0.8, 8, 0.4, "reflected"),
    (1.2, 6, 0.4, "reflected"),
    (0.6, 8, 0.8, "reflected"),
    (0.8, 8, 0.8, "reflected"),
    (0.6, 8, 0.8, "transmitted"),
)
POINTS, LAYERS = 4.5, 25.0  # per wavelength in air, at the coarser resolution
_DIGITS = 7  # of efficiencies, as fractions of the incident light


def picture() -> Array:
    """Return the target, a disc beside the mirror direction."""
    y, x = np.mgrid[1:-1:48j, -1:1:48j]
    return (np.hypot(x - 0.3, y) < 0.4).astype(float)


def designed(texel: float, texels: int, height_range: float, light: str) -> Design:
    """Design the plate."""
    index = INDEX if light == "transmitted" else None
    return md.design(picture(), texel, texels, height_range, ANGLE, WAVELENGTHS, index, tool_blur=TOOL_BLUR)


def predicted(plate: Design, wavelength: float) -> tuple[NDArray[np.int64], Array, Array | float]:
    """Return the orders, (n, 2), their efficiencies by scalar theory, unpolarised, and a factor; wavelength in nm.

    Efficiencies are those of the relief. The flat face of a sheet transmits the factor of each order.
    """
    powers = tile_powers(plate.height_field, wavelength * 1e-3)
    arguments = powers, 2 * (plate.plate.period,), wavelength * 1e-3, 0.0, INDEX
    if plate.plate.int_ior is None:
        reflected = scalar_orders(*arguments)
        return reflected.m, reflected.unpolarised, 1.0
    inside, outside = (transmitted_orders(*arguments, sheet=sheet) for sheet in (False, True))
    kept = {tuple(m): n for n, m in enumerate(inside.m.tolist())}
    eta = inside.unpolarised[[kept[tuple(m)] for m in outside.m.tolist()]]
    return outside.m, eta, np.divide(outside.unpolarised, eta, out=np.ones_like(eta), where=eta > 0)


def solved(plate: Design, wavelength: float, refined: float = 1.0) -> dict[str, Any]:
    """Solve Maxwell's equations for unpolarised light along the normal; `refined` multiplies the voxels per length."""
    began, period, heights = time.process_time(), plate.plate.period, plate.height_field.heights
    points, layers = (
        2 * math.ceil(refined * per_wavelength * length / (2e-3 * wavelength))
        for per_wavelength, length in ((POINTS, period), (LAYERS, np.ptp(heights)))
    )
    found = extrapolated(
        heights,
        (period, period),
        np.array([0.0, 0.0, 1.0]),
        wavelength * 1e-3,
        INDEX,
        (points, points),
        layers,
    )
    reflects = plate.plate.int_ior is None
    m, eta = (found.reflected, found.eta) if reflects else (found.transmitted, found.eta_transmitted)
    return {
        "orders": m.tolist(),
        "efficiencies": eta.mean(axis=0).round(_DIGITS).tolist(),
        "iterations": found.iterations,
        "lost": float(f"{found.lost:.1e}"),
        "seconds": round(time.process_time() - began),
    }


def compared(plate: Design, wavelength: float, m: NDArray[np.int64], rigorous: Array) -> dict[str, float]:
    """Compare the efficiencies η of orders m with the prediction; all but `total` as fractions of the light in orders.

    Returns:
        light, rigorous_light: in the target; correlation, rigorous_correlation: with the target; misdirected: Σ|Δη|;
        worst: the maximum of |Δη|; total: rigorous by predicted Σ η.
    """
    at = int(np.argmin(np.abs(plate.wavelengths - wavelength)))
    orders, scalar, factor = predicted(plate, wavelength)
    where = {tuple(pair): n for n, pair in enumerate(m.tolist())}
    exact = factor * rigorous[[where[tuple(pair)] for pair in orders.tolist()]]
    scalar = factor * scalar
    wanted, inside = plate.wanted[at], plate.inside[at]
    edges, period, length = plate.plate.edges(len(wanted)), plate.plate.period, plate.plate.coherence_length
    along_x, along_y = (lobes_in_bins(edges, one, period, wavelength * 1e-3, length) for one in orders.T)
    found: dict[str, float] = {}
    for name, eta in (("", scalar / scalar.sum()), ("rigorous_", exact / exact.sum())):
        image = (along_y * eta) @ along_x.T
        found[f"{name}light"] = float(image[inside].sum())
        found[f"{name}correlation"] = float(np.corrcoef(wanted.ravel(), image.ravel())[0, 1])
    found["misdirected"] = efficiency_difference(scalar / scalar.sum(), exact / exact.sum())
    found["worst"] = float(np.abs(scalar / scalar.sum() - exact / exact.sum()).max())
    found["total"] = float(exact.sum() / scalar.sum())
    return found


def compared_case(case: dict[str, Any]) -> tuple[Design, dict[float, dict[str, float]]]:
    """Return the plate of a stored case, and for each wavelength its comparison."""
    plate = of_case(case)
    rigorous = {of["wavelength"]: (np.array(of["orders"]), np.array(of["efficiencies"])) for of in case["solved"]}
    return plate, {wavelength: compared(plate, wavelength, *pair) for wavelength, pair in rigorous.items()}


def of_case(case: dict[str, Any]) -> Design:
    """Return the plate of a stored case, from the heights of its texels."""
    *lengths, light = case["plate"]
    index = INDEX if light == "transmitted" else None
    plate = Plate(*lengths, ANGLE, np.array(WAVELENGTHS), index, None, TOOL_BLUR)
    heights, wanted = np.array(case["heights"]), wanted_fractions(picture(), plate)
    return Design.of(heights, plate, wanted[..., ::-1] if plate.mirrored else wanted)


def rows() -> list[str]:
    """Return the rows of a table, of which docs/designed_reliefs.md has some, with the ranges over the wavelengths."""

    def between(values: list[float], digits: int, unit: float = 1.0) -> str:
        first, last = (f"{value / unit:.{digits}f}" for value in (min(values), max(values)))
        return first if first == last else f"{first}–{last}"

    found = []
    cases = json.loads(STORED.read_text(encoding="utf-8"))["cases"]
    for case in sorted(cases, key=lambda case: PLATES.index(tuple(case["plate"]))):
        plate, of_wavelengths = compared_case(case)
        values = {name: [of[name] for of in of_wavelengths.values()] for name in next(iter(of_wavelengths.values()))}
        kept = [exact / scalar for exact, scalar in zip(values["rigorous_light"], values["light"], strict=True)]
        cells = (
            case["plate"][-1],
            f"{plate.plate.texel:g} µm",
            f"{plate.plate.height_range:g} µm",
            f"{between(values['light'], 0, 0.01)} %",
            f"{between(kept, 1, 0.01)} %",
            f"{between(values['rigorous_correlation'], 2)}",
            f"{between(values['misdirected'], 1, 0.01)} %",
            f"{between(values['worst'], 1, 0.01)} %",
        )
        found.append(f"| {' | '.join(cells)} |")
    return found


def make(path: Path) -> None:
    """Design and solve all plates; what `path` holds already is kept."""
    content: dict[str, Any] = {"made by": "python tools/data/designed_plates.py"}
    content["units"] = (
        "plate: texel in µm, texels, height range in µm, light; heights of the texels in µm; wavelength in nm; "
        "efficiencies of orders (m_x, m_y), transmitted ones in the glass, for unpolarised light along the normal, as "
        "fractions of the incident light; "
        f"n = {INDEX}"
    )
    content["cases"] = json.loads(path.read_text())["cases"] if path.exists() else []
    for plate in PLATES:
        if any(tuple(case["plate"]) == plate for case in content["cases"]):
            continue
        found = designed(*plate)
        case = {"plate": plate, "heights": found.texels.round(6).tolist(), "solved": []}
        for wavelength in WAVELENGTHS:
            case["solved"].append({"wavelength": wavelength, **solved(found, wavelength)})
            m, eta = (np.array(case["solved"][-1][name]) for name in ("orders", "efficiencies"))
            print(plate, wavelength, compared(found, wavelength, m, eta), case["solved"][-1]["seconds"], flush=True)
        content["cases"].append(case)
        text = json.dumps(content, ensure_ascii=False).replace('{"plate"', '\n{"plate"').replace('{"wave', '\n{"wave')
        with whole_file(path) as temporary:
            Path(temporary).write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    if sys.argv[1:] == ["table"]:
        print("\n".join(rows()))
    else:
        make(Path(sys.argv[1]) if len(sys.argv) > 1 else STORED)
