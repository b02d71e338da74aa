"""Figures of docs/validation.md: efficiencies of gratings as measured, by scalar theory and by rigorous theory.

python tools/manual/measured_figures.py docs/measured_gratings.png docs/measured_transmission.png
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from mitsuba_diffraction.evaluation.plots import figure, save_png
from mitsuba_diffraction.evaluation.validation import measured_gratings as ruled
from mitsuba_diffraction.evaluation.validation import transmission_grating as t300

if TYPE_CHECKING:
    from matplotlib.figure import Figure

STYLES = {"rigorous": {"color": "#d95f02", "linestyle": "-"}, "scalar": {"color": "#7570b3", "linestyle": "--"}}
"""Of curves, by theory."""


def plot_ruled(step: float = 4.0) -> Figure:
    """Plot the measured efficiencies of each grating and the curves of both theories; a point every `step` nm."""
    drawn = figure(9.5, 6.6)
    panels = drawn.subplots(2, 2, sharex=True, sharey=True).ravel()
    for panel, name in zip(panels, ruled.LINES_PER_MM, strict=True):
        wavelengths, wanted = ruled.measured(name)
        fine = np.arange(wavelengths[0], wavelengths[-1], 1e-3 * step)
        for theory, style in STYLES.items():
            angle, rms = ruled.stored_angles()[name][theory], ruled.rms_from_measured(name, theory).measured
            label = f"{theory} theory, facets of {angle:.1f}°: rms {rms:.3f}"
            panel.plot(1e3 * fine, ruled.littrow(name, angle, fine, theory == "rigorous"), label=label, **style)
        panel.plot(1e3 * wavelengths, wanted, "o", color="black", markersize=3.5, label="measured")
        for top, bottom in ((2, 3), (2, 5)):
            anomaly = 1e6 / ruled.LINES_PER_MM[name] * top / bottom
            if 1e3 * wavelengths[0] < anomaly < 1e3 * wavelengths[-1]:
                panel.axvline(anomaly, color="0.75", linewidth=1, zorder=0)
                panel.text(anomaly, 0.985, f" λ/d = {top}/{bottom}", color="0.4", fontsize=8, va="top")
        panel.set_title(f"{name}: {ruled.LINES_PER_MM[name]:g} lines/mm", fontsize=10)
        panel.legend(frameon=False, fontsize=8, loc="lower right")
        panel.set_ylim(0, 1)
        panel.grid(alpha=0.2)
    for panel in panels[2:]:
        panel.set_xlabel("wavelength / nm")
    for panel in panels[::2]:
        panel.set_ylabel("efficiency of order 1, Littrow")
    return drawn


def plot_transmission() -> Figure:
    """Return the measured efficiencies, and the curves of both theories and both shapes, each with its factor."""
    drawn = figure(9.5, 3.8)
    panels = drawn.subplots(1, 2, sharey=True)
    wavelengths, wanted = ruled.measured("T300")
    for panel, shape in zip(panels, t300.GROOVES, strict=True):
        for theory, style in STYLES.items():
            angle = ruled.stored_angles()[shape][theory]
            found = t300.curve(shape, angle, theory == "rigorous")
            factor, rms = t300.scaled(found)
            label = f"{theory} theory, {angle:.1f}°, × {factor:.2f}: rms {rms:.3f}"
            panel.plot(1e3 * wavelengths, factor * found, label=label, **style)
        panel.plot(1e3 * wavelengths, wanted, "o", color="black", markersize=3.5, label="measured")
        panel.set_title(f"300 lines/mm in glass, {shape}", fontsize=10)
        panel.legend(frameon=False, fontsize=8, loc="lower left")
        panel.set_ylim(0, 0.8)
        panel.set_xlabel("wavelength / nm")
        panel.grid(alpha=0.2)
    panels[0].set_ylabel("transmitted efficiency of order 1")
    return drawn


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("ruled", type=Path, help="figure of the ruled gratings (.png)")
    parser.add_argument("transmission", type=Path, help="figure of the transmission grating (.png)")
    options = parser.parse_args()
    save_png(plot_ruled(), options.ruled)
    save_png(plot_transmission(), options.transmission)


if __name__ == "__main__":
    main()
