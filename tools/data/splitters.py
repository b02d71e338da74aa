"""Check scalar theory for published beam splitters: `python tools/data/splitters.py [DESIGN.json …]`.

The designs are those of `reference_designs/diffractive_splitter` of invrs-gym (© 2025 invrs.io LLC, MIT): pillars of
glass, n = 1.46, on glass, in pixels of 0.04 µm and a period of 7.2 µm, which split light of 0.6328 µm from the glass,
at normal incidence, into 7 × 7 orders in air. Each is solved by `volume_integral`, for unpolarised light, with `LAYERS`
layers of voxels and with one and a half times as many; the error decreases with the square of their thickness and is
extrapolated (Richardson). A weak order needs that, as its amplitude is a small difference of large ones: order 0 of the
stored designs is 54 to 74 % too strong with 18 layers. The voxels are the pixels, whose walls are thus exact. Two
minutes of processor time, or twice as many for a design that is not symmetric about its diagonal. Results are added to
`tests/data/splitters.json`, which docs/validation.md reads. Without an argument the stored results are printed.
"""

from __future__ import annotations

import base64
import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from volume_integral import solve

import mitsuba_diffraction as md
from mitsuba_diffraction.files.writing import whole_file
from mitsuba_diffraction.scalar_theory.closed_form import tile_powers, transmitted_at

Array = NDArray[np.float64]

STORED = Path(__file__).parents[2] / "tests" / "data" / "splitters.json"
PIXEL, WAVELENGTH, INDEX = 0.04, 0.6328, 1.46  # µm
LAYERS = 12
FROM_GLASS = np.array([0.0, 0.0, -1.0])
_MAX_ORDER = 3  # along each axis


def published(path: Path) -> tuple[NDArray[np.bool_], float]:
    """Return the pillars of a design of invrs-gym, rows ↔ +y, and their height in µm."""
    design = json.loads(path.read_text(encoding="utf-8"))

    def array(name: str) -> Array:
        content = design[name][1]["array"][1]
        return np.frombuffer(base64.b64decode(content["bytes"]), content["dtype"]).reshape(content["shape"])

    # Their first axis is x.
    return array("density").T > 0.5, float(array("thickness_grating"))


def stored_pillars(case: dict[str, Any]) -> NDArray[np.bool_]:
    """Return the pillars of a stored case."""
    bits = np.unpackbits(np.frombuffer(base64.b64decode(case["pillars"]), np.uint8))
    side = round(case["period"] / PIXEL)
    return bits[: side * side].reshape(side, side).astype(bool)


def scalar(pillars: NDArray[np.bool_], height: float) -> Array:
    """Return the efficiencies of the 7 × 7 orders by scalar theory, rows ↔ m_y from −3, columns ↔ m_x."""
    relief = md.HeightField(height * pillars, PIXEL)
    powers = tile_powers(relief, WAVELENGTH)
    found = transmitted_at(powers, relief.tile_size, WAVELENGTH, np.zeros(2), INDEX, from_below=True)
    return _target(found.m, found.unpolarised)


def rigorous(pillars: NDArray[np.bool_], height: float, layers: int) -> Array:
    """Return the same by Maxwell's equations, for a number of layers of voxels."""
    # Then p is s with x and y exchanged.
    symmetric = bool((pillars == pillars.T).all())
    period = (pillars.shape[1] * PIXEL, pillars.shape[0] * PIXEL)
    found = solve(
        height * pillars,
        period,
        FROM_GLASS,
        WAVELENGTH,
        INDEX,
        pillars.shape,
        layers,
        tolerance=3e-4,
        stepped=True,
        polarisations=(0,) if symmetric else (0, 1),
    )
    orders = _target(found.transmitted, found.eta_transmitted.mean(axis=0))
    return (orders + orders.T) / 2 if symmetric else orders


def _target(m: NDArray[np.int64], eta: Array) -> Array:
    orders = np.zeros((2 * _MAX_ORDER + 1,) * 2)
    inside = np.abs(m).max(axis=1) <= _MAX_ORDER
    columns, rows = m[inside].T + _MAX_ORDER
    orders[rows, columns] = eta[inside]
    return orders


def solved(path: Path) -> dict[str, Any]:
    """Return a case: the design, its orders at both resolutions and extrapolated."""
    began, (pillars, height) = time.process_time(), published(path)
    coarse, fine = (rigorous(pillars, height, layers) for layers in (LAYERS, LAYERS * 3 // 2))
    orders = fine + (fine - coarse) / (1.5**2 - 1)
    of = {"coarse": coarse, "fine": fine, "orders": orders}
    return {
        "design": path.stem,
        "period": round(pillars.shape[0] * PIXEL, 4),
        "height": round(height, 5),
        "layers": LAYERS,
        **{name: [float(f"{value:.4g}") for value in values.ravel()] for name, values in of.items()},
        "seconds": round(time.process_time() - began),
        "pillars": base64.b64encode(np.packbits(pillars).tobytes()).decode(),
    }


def row(case: dict[str, Any]) -> str:
    """Return a row of a table: total and order 0 by both theories, and their differences."""
    by_scalar, exact = scalar(stored_pillars(case), case["height"]).ravel(), np.array(case["orders"])
    names = [f"{values.sum():.3f}, {values[values.size // 2]:.4f}" for values in (by_scalar, exact)]
    error = np.abs(by_scalar - exact)
    differences = (
        f"{by_scalar.sum() / exact.sum() - 1:+.1%}, {np.median(error / exact):.0%}, {(error / exact).max():.0%}"
    )
    return f"| {case['design'][-16:]} | {' | '.join(names)} | {differences} |"


def make(paths: list[Path]) -> None:
    """Solve designs, and add them to what is stored."""
    content: dict[str, Any] = {
        "made by": "python tools/data/splitters.py reference_designs/diffractive_splitter/*.json",
        "source": "pillars and heights: invrs-gym, © 2025 invrs.io LLC, MIT",
        "units": "period and height in µm; coarse, fine, orders: fraction of the incident light in the 7 × 7 orders, "
        "m_y and m_x from −3, with `layers` and 1.5 `layers` layers, and extrapolated; pillars: bits of pixels, rows "
        "along +y, base64",
        "cases": json.loads(STORED.read_text(encoding="utf-8"))["cases"] if STORED.exists() else [],
    }
    for path in paths:
        content["cases"] = [case for case in content["cases"] if case["design"] != path.stem] + [solved(path)]
        text = json.dumps(content, ensure_ascii=False).replace('{"design"', '\n{"design"')
        with whole_file(STORED) as temporary:
            Path(temporary).write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    make([Path(name) for name in sys.argv[1:]])
    print("| design | scalar: total, order 0 | rigorous | total, median and largest difference of an order |")
    print("\n".join(row(case) for case in json.loads(STORED.read_text(encoding="utf-8"))["cases"]))
