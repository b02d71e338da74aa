"""Scalar and rigorous theory against the manufacturer's measured efficiencies of four ruled gratings.

Gratings and measurements: `data/gratings/README.md`. The grooves are modelled as two aluminium facets with an apex of
90°, in the first order of a Littrow mount, in unpolarised light. Only the facet angle is fitted.
"""

from __future__ import annotations

import functools
import json
from pathlib import Path

import numpy as np

from ...array_types import Real
from ...rigorous.solver import efficiencies
from ...scalar_theory.closed_form import profile_powers, scalar_orders
from ...settings import THEORIES
from ...surface.gratings import right_angled
from ..record import Check, Record

DATA = Path(__file__).parents[2] / "data" / "gratings"
FITS = DATA / "fits.json"
LINES_PER_MM = {"R150": 150.0, "R400": 400.0, "B600": 600.0, "R831": 831.0}

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
    height_field = right_angled(period, facet_angle)
    for wavelength in wavelengths:
        index, sine = aluminium(wavelength), wavelength / (2 * period)
        if rigorous:
            harmonics = int(1.5 * period / wavelength) + 10
            direction = -sine, 0.0, np.sqrt(1 - sine**2)
            orders = efficiencies(height_field, direction, wavelength, int_ior=index, harmonics=harmonics).reflection
        else:
            angle = float(np.rad2deg(np.arcsin(sine)))
            orders = scalar_orders(profile_powers(height_field), period, wavelength, angle, index)
        found.append(orders.unpolarised[orders.m == 1][0])
    return np.array(found)


@functools.cache
def measured(name: str) -> tuple[Real, Real]:
    """Return measured wavelengths in µm and η₁ of a grating of `DATA`, (n,) each."""
    nanometres, found = np.loadtxt(DATA / f"{name}.csv", delimiter=",", skiprows=2, usecols=(0, 1), unpack=True)
    return nanometres * 1e-3, found


@functools.cache
def stored_angles() -> dict[str, dict[str, float]]:
    """Return ruled grating, or grooves of T300 → theory → fitted angle in degrees (`tools/data/ruled_fits.py`)."""
    stored = json.loads(FITS.read_text(encoding="utf-8"))
    return {**stored["facet angles"], **stored["groove angles"]}


def rms_difference(found: Real, wanted: Real) -> float:
    """Return the root mean square difference of efficiencies."""
    return float(np.sqrt(((found - wanted) ** 2).mean()))


def best_factor(found: Real, wanted: Real) -> float:
    """Return the factor for `found` that gives the least rms difference."""
    return float(found @ wanted / (found @ found))


def rms_from_measured(name: str, theory: str) -> Record:
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


CHECKS = tuple(
    Check(
        "literature",
        f"{name}, {lines:g} lines/mm, measured: {theory} theory",
        functools.partial(rms_from_measured, name, theory),
        "data/gratings/README.md",
    )
    for name, lines in LINES_PER_MM.items()
    for theory in THEORIES
)
