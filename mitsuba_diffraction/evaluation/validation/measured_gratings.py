"""Scalar and rigorous theory against the manufacturer's measured efficiencies of four ruled gratings.

Gratings and measurements: `data/gratings/README.md`. The grooves are modelled as two aluminium facets with an apex of
90°, in the first order of a Littrow mount, in unpolarised light. Only the facet angle is fitted.
"""

from __future__ import annotations

import functools
import json
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ...rigorous.efficiencies import efficiencies
from ...scalar_theory import profile_powers, scalar_orders
from ...surface.gratings import right_angled
from .record import Check, Record

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Real = NDArray[np.float64]

DATA = Path(__file__).parents[2] / "data" / "gratings"
FITS = DATA / "fits.json"
LINES_PER_MM = {"R150": 150.0, "R400": 400.0, "B600": 600.0, "R831": 831.0}
THEORIES = ("scalar", "rigorous")
STYLES = {"rigorous": {"color": "#d95f02", "linestyle": "-"}, "scalar": {"color": "#7570b3", "linestyle": "--"}}
"""Of curves, by theory."""

MAX_RMS_DIFFERENCE = 0.05
"""Of rigorous theory; R150 exceeds it: see docs/validation.md."""
_WITHOUT_BOUND = ("R150",)

# Rakić et al. 1998, table 2: f, Γ and ω of the intraband term and of four interband terms; ħω_p. eV.
_PLASMA = 14.98
_INTRABAND = 0.523, 0.047
_INTERBAND = ((0.227, 0.333, 0.162), (0.050, 0.312, 1.544), (0.166, 1.351, 1.808), (0.030, 3.382, 3.473))
_EV_MICROMETRE = 1.239842


def aluminium(wavelength: float) -> complex:
    """Return n + ik of aluminium at a wavelength in µm by the Lorentz–Drude model of Rakić et al. (1998).

    The measurements extend further into the infrared than Mitsuba's table; where they overlap, both agree to 5 %.
    """
    energy = _EV_MICROMETRE / wavelength
    strength, damping = _INTRABAND
    permittivity = 1 - strength * _PLASMA**2 / (energy * (energy + 1j * damping))
    for strength, damping, resonance in _INTERBAND:
        permittivity += strength * _PLASMA**2 / (resonance**2 - energy**2 - 1j * energy * damping)
    return complex(np.sqrt(permittivity))


def littrow(name: str, facet_angle: float, wavelengths: Real, rigorous: bool) -> Real:
    """Compute η₁, (n,), in the Littrow mount for unpolarised light, by rigorous or by scalar theory.

    Args:
        name: one of `LINES_PER_MM`.
        facet_angle: degrees.
        wavelengths: µm, (n,).
        rigorous: the theory.
    """
    period, found = 1000 / LINES_PER_MM[name], []
    surface = right_angled(period, facet_angle)
    for wavelength in wavelengths:
        index, sine = aluminium(wavelength), wavelength / (2 * period)
        if rigorous:
            harmonics = int(1.5 * period / wavelength) + 10
            direction = -sine, 0.0, np.sqrt(1 - sine**2)
            exact = efficiencies(surface, direction, wavelength, int_ior=index, harmonics=harmonics)
            orders, powers = exact.orders, exact.unpolarised
        else:
            angle = float(np.rad2deg(np.arcsin(sine)))
            scalar = scalar_orders(profile_powers(surface), period, wavelength, angle, index)
            orders, powers = scalar.m, scalar.unpolarised
        found.append(powers[orders == 1][0])
    return np.array(found)


@functools.cache
def measured(name: str) -> tuple[Real, Real]:
    """Return measured wavelengths in µm and η₁ of a grating of `DATA`, (n,) each."""
    nanometres, found = np.loadtxt(DATA / f"{name}.csv", delimiter=",", skiprows=2, usecols=(0, 1), unpack=True)
    return nanometres * 1e-3, found


@functools.cache
def stored_angles() -> dict[str, dict[str, float]]:
    """Return ruled grating, or grooves of T300 → theory → fitted angle in degrees (`precompute/ruled_fits.py`)."""
    stored = json.loads(FITS.read_text(encoding="utf-8"))
    return {**stored["facet angles"], **stored["groove angles"]}


def rms_difference(found: Real, wanted: Real) -> float:
    """Return the root mean square difference of efficiencies."""
    return float(np.sqrt(((found - wanted) ** 2).mean()))


def best_factor(found: Real, wanted: Real) -> float:
    """Return the factor for `found` that gives the least rms difference."""
    return float(found @ wanted / (found @ found))


def difference(name: str, theory: str) -> Record:
    """Compute the root mean square difference from the measured efficiencies."""
    wavelengths, wanted = measured(name)
    angle = stored_angles()[name][theory]
    found = littrow(name, angle, wavelengths, theory == "rigorous")
    scale = best_factor(found, wanted)
    bound = MAX_RMS_DIFFERENCE if theory == "rigorous" and name not in _WITHOUT_BOUND else None
    note = (
        f"rms over {len(wanted)} wavelengths, facets of {angle:.2f}°; "
        f"{rms_difference(scale * found, wanted):.3f} if all are scaled by {scale:.3f}"
    )
    return Record(rms_difference(found, wanted), 0.0, bound, note=note)


def plot(step: float = 4.0) -> Figure:
    """Plot the measured efficiencies of each grating and the curves of both theories; a point every `step` nm."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.5, 6.6), layout="constrained")
    panels = figure.subplots(2, 2, sharex=True, sharey=True).ravel()
    for panel, name in zip(panels, LINES_PER_MM, strict=True):
        wavelengths, wanted = measured(name)
        fine = np.arange(wavelengths[0], wavelengths[-1], 1e-3 * step)
        for theory, style in STYLES.items():
            angle, rms = stored_angles()[name][theory], difference(name, theory).measured
            label = f"{theory} theory, facets of {angle:.1f}°: rms {rms:.3f}"
            panel.plot(1e3 * fine, littrow(name, angle, fine, theory == "rigorous"), label=label, **style)
        panel.plot(1e3 * wavelengths, wanted, "o", color="black", markersize=3.5, label="measured")
        for top, bottom in ((2, 3), (2, 5)):
            anomaly = 1e6 / LINES_PER_MM[name] * top / bottom
            if 1e3 * wavelengths[0] < anomaly < 1e3 * wavelengths[-1]:
                panel.axvline(anomaly, color="0.75", linewidth=1, zorder=0)
                panel.text(anomaly, 0.985, f" λ/d = {top}/{bottom}", color="0.4", fontsize=8, va="top")
        panel.set_title(f"{name}: {LINES_PER_MM[name]:g} lines/mm", fontsize=10)
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
    for theory in THEORIES
)
