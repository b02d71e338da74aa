"""Figures of docs/materials.md: a hologram with films, anodised titanium, and the stack of films of a jewel beetle.

python tools/manual/thin_film.py docs/thin_film.png docs/film_stack.png

Curves and colours are computed by the plugin, at the centres of lobes; points by closed forms, J_m² K with R by the
package tmm. Lines are contours of R by tmm.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import mitsuba_diffraction as md  # before Dr.Jit

import mitsuba as mi  # isort: skip
import numpy as np
import tmm
from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh
from numpy.typing import NDArray
from scipy.special import jv

from mitsuba_diffraction.bsdf.testing import evaluate_pdf
from mitsuba_diffraction.evaluation.plots import figure, save_png
from mitsuba_diffraction.settings import lobe_width

Array = NDArray[np.float64]

PERIOD, DEPTH, PLASTIC, SULPHIDE, OXIDE = 1.5, 0.1667, 1.5, 2.35, 2.4  # µm; indices
FILMS = {0.02: "#c6dbef", 0.04: "#9ecae1", 0.08: "#2171b5", 0.16: "#08306b"}  # µm, with colours
OXIDES = {0.0: "0.5", 0.02: "#b8860b", 0.05: "#1f4e9c", 0.12: "#e0a000", 0.16: "#a030a0", 0.2: "#20908c"}
WAVELENGTHS = np.linspace(0.38, 0.78, 101)  # µm
# Stavenga, Wilts, Leertouwer and Hariyama 2011: indices of the layers from the outside in; number of layers and
# measured peak (µm) of the green elytra and of their purple stripes. Below them is chitin, n = 1.517 + 8.8e-3 µm²/λ².
LAYERS, PARTS = (1.7, 1.6), {"green": (16, 0.53), "purple stripe": (12, 0.7)}
ANGLES = np.linspace(0, 75, 31)  # degrees


def efficiencies(spectrum: md.GratingSpectrum, order: int, angle: float = 0.0, **parameters: Any) -> Array:
    """Return the efficiency of an order at an angle of incidence, of the plugin inside its coat, at `WAVELENGTHS`."""
    bsdf = mi.load_dict({"type": "diffraction_grating", "spectrum": spectrum, "conserve_energy": False, **parameters})
    index = parameters.get("coat_ior", 1.0)
    incident = [np.sin(np.deg2rad(angle)), 0, np.cos(np.deg2rad(angle))]
    x = -incident[0] - order * WAVELENGTHS / PERIOD
    wo = np.stack([x, 0 * x, np.sqrt(1 - x**2)], -1)
    wavelengths = np.repeat(1e3 * WAVELENGTHS[:, None], 4, axis=1)
    value = evaluate_pdf(bsdf, np.broadcast_to(incident, wo.shape), wo, wavelengths)[0][:, 0]
    # The peak of a lobe is n_o² η cos θ_o/(2π σ_q² λ²).
    faces = np.ones_like(x)
    if index > 1:
        faces = transmitted(np.arcsin(incident[0] + 0 * x), index) * transmitted(np.arcsin(-x), index)
    return value * WAVELENGTHS**2 * 2 * np.pi * lobe_width(spectrum.coherence_length) ** 2 / wo[:, 2] / faces


def transmitted(angles: Array, index: float) -> Array:
    """Return T of the face of the coat for unpolarised light."""
    pairs = [[tmm.interface_T(p, 1, index, t, np.arcsin(np.sin(t) / index)) for p in "sp"] for t in np.abs(angles)]
    return np.mean(pairs, axis=1)


def expected(order: int, film: float) -> Array:
    """Return J_m² K R of the sinusoid in plastic at normal incidence, by tmm."""
    sine = order * WAVELENGTHS / PERIOD / PLASTIC
    cos = np.sqrt(1 - sine**2)
    kappa = 2 * np.pi * PLASTIC * (1 + cos) / WAVELENGTHS
    k = (1 + cos) ** 2 / (cos * (1 + cos) ** 2)
    half = np.arcsin(sine) / 2
    stack, thickness = [PLASTIC, SULPHIDE, PLASTIC], [np.inf, film, np.inf]
    r = [
        np.mean([tmm.coh_tmm(p, stack, thickness, a, w)["R"] for p in "sp"])
        for a, w in zip(half, WAVELENGTHS, strict=True)
    ]
    return jv(order, kappa * DEPTH / 2) ** 2 * k * r


def beetle(panel: Axes, plane: md.GratingSpectrum, part: str) -> QuadMesh:
    """Draw R of the quarter-wave layers of a part of a beetle over wavelength and angle; return the map of colours."""
    count, peak = PARTS[part]
    thicknesses = [peak / (4 * n) for n in LAYERS]
    repeated = [f"{count // 2} x ({', '.join(f'{x:.6g}' for x in pair)})" for pair in (LAYERS, thicknesses)]
    stack = {"int_ior": "chitin", "thin_film_ior": repeated[0], "thin_film_thickness": repeated[1]}
    found = np.array([efficiencies(plane, 0, angle, shadowing="none", **stack) for angle in ANGLES])
    layers, depths = list(LAYERS) * (count // 2), [np.inf, *thicknesses * (count // 2), np.inf]
    r = np.array(
        [
            [
                np.mean([tmm.coh_tmm(p, [1, *layers, 1.517 + 8.8e-3 / w**2], depths, a, w)["R"] for p in "sp"])
                for w in WAVELENGTHS
            ]
            for a in np.deg2rad(ANGLES)
        ]
    )
    print(f"{part}: largest difference {np.abs(found - r).max():.1e}")
    above = 1e3 * WAVELENGTHS[r[0] > r[0].max() / 2]
    print(f"{part}: maximum {100 * r[0].max():.0f} %, more than half of it from {above[0]:.0f} to {above[-1]:.0f} nm")
    grid = 1e3 * WAVELENGTHS, ANGLES
    colours = panel.pcolormesh(*grid, 100 * found, vmin=0, vmax=50, cmap="magma", shading="gouraud", rasterized=True)
    panel.contour(*grid, 100 * r, [10, 20, 30, 40], colors="w", linewidths=0.8, linestyles="dashed")
    panel.axvline(1e3 * peak, color="w", linewidth=0.8, linestyle="dotted")
    panel.set_title(f"{part}: {count} layers, published peak {1e3 * peak:.0f} nm", fontsize=9)
    panel.set_xlabel("wavelength (nm)")
    return colours


def main(output: Path, of_stack: Path) -> None:
    """Draw the figures."""
    mi.set_variant("llvm_ad_spectral")
    drawn = figure(9.5, 3.4)
    panels = drawn.subplots(1, 3)
    relief = md.precompute(md.gratings.sinusoidal(PERIOD, DEPTH), wavelengths=(240.0, 830.0))
    plane = md.precompute(md.gratings.sinusoidal(PERIOD, 0.0))
    for order, panel in enumerate(panels[:2]):
        for film, colour in FILMS.items():
            plastic = {"int_ior": PLASTIC, "coat_ior": PLASTIC, "thin_film_ior": SULPHIDE, "thin_film_thickness": film}
            found = efficiencies(relief, order, shadowing="none", **plastic)
            panel.plot(1e3 * WAVELENGTHS, 100 * found, color=colour, label=f"{1e3 * film:.0f} nm")
            panel.plot(1e3 * WAVELENGTHS[::10], 100 * expected(order, film)[::10], "o", color=colour, markersize=3)
            print(f"order {order}, {film} µm: largest difference {np.abs(found - expected(order, film)).max():.1e}")
        panel.set_title(f"ZnS in plastic, order {order}", fontsize=9)
    for oxide, colour in OXIDES.items():
        parameters = {"material": "Ti", "thin_film_ior": OXIDE, "thin_film_thickness": oxide}
        found = efficiencies(plane, 0, **parameters)
        panels[2].plot(1e3 * WAVELENGTHS, 100 * found, color=colour, label=f"{1e3 * oxide:.0f} nm")
    panels[2].set_title("titanium under its oxide, order 0", fontsize=9)
    for panel in panels:
        panel.set_xlabel("wavelength (nm)")
        panel.set_ylim(0)
        panel.legend(fontsize=7)
    panels[0].set_ylabel("efficiency (%)")
    save_png(drawn, output)
    drawn = figure(9.5, 3.4)
    panels = drawn.subplots(1, 2, sharey=True)
    for panel, part in zip(panels, PARTS, strict=True):
        colours = beetle(panel, plane, part)
    panels[0].set_ylabel("angle of incidence (degrees)")
    drawn.colorbar(colours, ax=panels, label="reflectance (%)")
    save_png(drawn, of_stack)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("output", type=Path)
    parser.add_argument("of_stack", type=Path)
    main(**vars(parser.parse_args()))
