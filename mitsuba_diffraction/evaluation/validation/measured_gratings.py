"""Scalar and rigorous theory against the manufacturer's measured efficiencies of four ruled gratings.

Only the facet angle is fitted (`ruled_fit`); `precompute/ruled_fits.py` stores the angles.
"""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING

import numpy as np

from .record import Check, Record
from .ruled_fit import LINES_PER_MM, littrow_curve, measured, stored_angles

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MAX_RMS_DIFFERENCE = 0.05
"""Of rigorous theory; R150 exceeds it: see docs/validation.md."""

_WITHOUT_BOUND = ("R150",)
_COLOURS = {"rigorous": "#d95f02", "scalar": "#7570b3"}


def difference(name: str, theory: str) -> Record:
    """Compute the root mean square difference from the measured efficiencies."""
    wavelengths, wanted = measured(name)
    angle = stored_angles()[name][theory]
    found = littrow_curve(name, angle, wavelengths, theory == "rigorous")
    scale = found @ wanted / (found @ found)
    rms, scaled = (float(np.sqrt(((factor * found - wanted) ** 2).mean())) for factor in (1, scale))
    bound = MAX_RMS_DIFFERENCE if theory == "rigorous" and name not in _WITHOUT_BOUND else None
    note = f"rms over {len(wanted)} wavelengths, facets of {angle:.2f}°; {scaled:.3f} if all are scaled by {scale:.3f}"
    return Record(rms, 0.0, bound, note=note)


def plot(step: float = 4.0) -> Figure:
    """Plot the measured efficiencies of each grating and the curves of both theories; a point every `step` nm."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.5, 6.6), layout="constrained")
    panels = figure.subplots(2, 2, sharex=True, sharey=True).ravel()
    for panel, name in zip(panels, LINES_PER_MM, strict=True):
        wavelengths, wanted = measured(name)
        fine = np.arange(wavelengths[0], wavelengths[-1], 1e-3 * step)
        for theory, colour in _COLOURS.items():
            angle, rms = stored_angles()[name][theory], difference(name, theory).measured
            panel.plot(
                1e3 * fine,
                littrow_curve(name, angle, fine, theory == "rigorous"),
                color=colour,
                linestyle="-" if theory == "rigorous" else "--",
                label=f"{theory} theory, facets of {angle:.1f}°: rms {rms:.3f}",
            )
        panel.plot(1e3 * wavelengths, wanted, "o", color="black", markersize=3.5, label="measured")
        lines = LINES_PER_MM[name]
        for ratio in ("2/3", "2/5"):
            top, bottom = map(int, ratio.split("/"))
            anomaly = 1e6 / lines * top / bottom
            if 1e3 * wavelengths[0] < anomaly < 1e3 * wavelengths[-1]:
                panel.axvline(anomaly, color="0.75", linewidth=1, zorder=0)
                panel.text(anomaly, 0.985, f" λ/d = {ratio}", color="0.4", fontsize=8, va="top")
        panel.set_title(f"{name}: {lines:g} lines/mm", fontsize=10)
        panel.legend(frameon=False, fontsize=8, loc="lower right")
        panel.set_ylim(0, 1)
        panel.grid(alpha=0.2)
    for panel in panels[2:]:
        panel.set_xlabel("wavelength / nm")
    for panel in panels[::2]:
        panel.set_ylabel("efficiency of order 1, Littrow")
    return figure


CHECKS = tuple(
    Check(
        "literature",
        f"{name}, {lines:g} lines/mm, measured: {theory} theory",
        functools.partial(difference, name, theory),
        "data/gratings/README.md",
    )
    for name, lines in LINES_PER_MM.items()
    for theory in ("scalar", "rigorous")
)
