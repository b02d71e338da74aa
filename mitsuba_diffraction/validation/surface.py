"""The checks that make sense for a surface of one's own."""

from __future__ import annotations

import functools

import numpy as np

from ..heightfield import HeightField
from ..inspection.statistics import statistics
from ..scalar_theory import TRUSTED, equivalent_depth, expected_error
from ..spectrum import GratingSpectrum
from .checks import Check, Finding
from .conservation import against_reference, energy, parseval, reciprocity

_WAVELENGTH = 0.55  # µm, the middle of the visible range


def surface_checks(height_field: HeightField, spectrum: GratingSpectrum) -> tuple[Check, ...]:
    """Checks of the spectrum of a surface and of the BSDF that shows it."""

    def check(name: str, run: functools.partial[Finding], source: str) -> Check:
        return Check("surface", name, run, source)

    return (
        check("Parseval", functools.partial(parseval, spectrum), "Σ_m η_m = 1"),
        check(
            "table against heights",
            functools.partial(against_reference, height_field, spectrum),
            "reference.power_spectrum, float64",
        ),
        check("reciprocity", functools.partial(reciprocity, spectrum), "f(ω_i, ω_o) = f(ω_o, ω_i)"),
        check("albedo of a perfect mirror", functools.partial(energy, spectrum), "at most one"),
        check(
            "range of scalar theory", functools.partial(scalar_range, height_field, spectrum), "coupled waves, stored"
        ),
    )


def main_period(spectrum: GratingSpectrum) -> float:
    """1/|q| of the strongest light beside the mirror's own, in µm; NaN if there is none.

    At the smallest κ of the visible range, where a spectrum looks most like the one of the heights.
    """
    q_x, q_y = spectrum.grid.frequencies()
    distance = np.hypot(q_x, q_y[:, None])
    kappa = min(4 * np.pi / (spectrum.wavelengths[1] * 1e-3), spectrum.largest_kappa)
    powers = np.where(distance > 4 * spectrum.lobe_width, spectrum.powers(kappa), 0)
    strongest = np.unravel_index(np.argmax(powers), powers.shape)
    return float(1 / distance[strongest]) if powers[strongest] > 1e-6 else float("nan")


def scalar_range(height_field: HeightField, spectrum: GratingSpectrum) -> Finding:
    """What scalar theory is expected to get wrong about a sinusoid of the same period and roughness."""
    period = main_period(spectrum)
    # About the mean plane of a sample: a tilt turns the light and is no roughness.
    depth = equivalent_depth(statistics(height_field, extent=spectrum.extent).Sq)
    if np.isnan(period):
        return Finding(0.0, 0.0, 0.0, TRUSTED, "no light beside the mirror's own")
    found = expected_error(period, depth, _WAVELENGTH)
    note = f"as of a sinusoid, {period:.3g} × {depth:.2g} µm, at 550 nm, ≤ 20°; a share of the light"
    if np.isnan(found):
        return Finding(0.0, float("nan"), float("inf"), TRUSTED, f"outside of what is stored: {note}")
    return Finding(0.0, found, found, TRUSTED, note)
