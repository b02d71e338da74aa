"""Measured efficiencies of ruled gratings, with the facet angle as the only unknown.

Gratings and measurements: `data/gratings/README.md`. The grooves are modelled as two aluminium facets with an apex of
90°, in the first order of a Littrow mount, in unpolarised light.
"""

from __future__ import annotations

import functools
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from ...errors import RequestError
from ...rigorous.efficiencies import efficiencies
from ...scalar_theory import profile_powers, scalar_orders
from ...surface.gratings import right_angled

Real = NDArray[np.float64]

DATA = Path(__file__).parents[2] / "data" / "gratings"
FITS = DATA / "fits.json"
LINES_PER_MM = {"R150": 150.0, "R400": 400.0, "B600": 600.0, "R831": 831.0}

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


def littrow(period: float, facet_angle: float, wavelength: float, rigorous: bool) -> float:
    """Compute η₁ in the Littrow mount for unpolarised light, by rigorous or by scalar theory.

    Args:
        period, wavelength: µm.
        facet_angle: degrees.
    """
    surface, index = right_angled(period, facet_angle), aluminium(wavelength)
    sine = wavelength / (2 * period)
    if rigorous:
        harmonics = int(1.5 * period / wavelength) + 10
        direction = -sine, 0.0, np.sqrt(1 - sine**2)
        found = efficiencies(surface, direction, wavelength, int_ior=index, harmonics=harmonics)
        return float(found.unpolarised[found.orders == 1][0])
    scalar = scalar_orders(profile_powers(surface), period, wavelength, float(np.rad2deg(np.arcsin(sine))), index)
    return float(scalar.unpolarised[scalar.m == 1][0])


@dataclass(frozen=True, eq=False)
class Fit:
    """A theory, fitted to a measured grating.

    Attributes:
        facet_angle: degrees.
        efficiencies: η₁ at the measured wavelengths, (n,).
        rms: root mean square difference from the measured efficiencies.
    """

    facet_angle: float
    efficiencies: Real
    rms: float


def measured(name: str) -> tuple[Real, Real]:
    """Return measured wavelengths in µm and η₁ of a grating of `LINES_PER_MM`, (n,) each.

    Raises:
        ValueError: if there is no such grating.
    """
    if name not in LINES_PER_MM:
        raise RequestError(f"grating: got {name!r}, wanted one of {', '.join(LINES_PER_MM)}")
    nanometres, found = np.loadtxt(DATA / f"{name}.csv", delimiter=",", skiprows=2, unpack=True)
    return nanometres * 1e-3, found


def littrow_curve(name: str, facet_angle: float, wavelengths: Real, rigorous: bool) -> Real:
    """Compute η₁ of a grating of `LINES_PER_MM` at wavelengths in µm, (n,), by `littrow`."""
    period = 1000 / LINES_PER_MM[name]
    return np.array([littrow(period, facet_angle, wavelength, rigorous) for wavelength in wavelengths])


@functools.cache
def stored_angles() -> dict[str, dict[str, float]]:
    """Return facet angles (degrees) found by `fit`, by grating and theory (`precompute/ruled_fits.py`)."""
    return json.loads(FITS.read_text(encoding="utf-8"))["facet angles"]


def fit(name: str, rigorous: bool) -> Fit:
    """Fit the facet angle to a measured grating in the mean square, by rigorous or by scalar theory.

    With rigorous theory this takes up to a minute.

    Raises:
        ValueError: if there is no such grating.
    """
    wavelengths, wanted = measured(name)
    period = 1000 / LINES_PER_MM[name]

    def difference(angle: float) -> tuple[Real, float]:
        found = littrow_curve(name, angle, wavelengths, rigorous)
        return found, float(np.sqrt(((found - wanted) ** 2).mean()))

    blaze = np.rad2deg(np.arcsin(wavelengths[np.argmax(wanted)] / (2 * period)))
    best = minimize_scalar(
        lambda angle: difference(angle)[1],
        bounds=(0.8 * blaze, 1.25 * blaze),
        method="bounded",
        options={"xatol": 0.02},
    )
    return Fit(float(best.x), *difference(best.x))
