"""The lists of checks: of the product, and of a surface of one's own."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ..scalar_theory import TRUSTED, equivalent_depth, expected_error
from ..spectrum import GratingSpectrum
from ..surface.heightfield import HeightField
from ..surface.periods import find_periods
from . import analytic, bumps, conservation, coupled_waves, measured_gratings, rough_surface, viewing_angle
from .accuracy import against_reference
from .inspection.statistics import statistics
from .record import GROUPS, Check, Record

_WAVELENGTH = 0.55  # µm, the middle of the visible range


def checks() -> tuple[Check, ...]:
    """What `mitsuba-diffraction validate` runs, group by group."""
    modules = (analytic, bumps, viewing_angle, measured_gratings, rough_surface, conservation, coupled_waves)
    every = [check for module in modules for check in module.CHECKS]
    return tuple(sorted(every, key=lambda check: GROUPS.index(check.group)))


def surface_checks(height_field: HeightField, spectrum: GratingSpectrum) -> tuple[Check, ...]:
    """Checks of the spectrum of a surface and of the BSDF that shows it."""

    def check(name: str, measure: Callable[[], Record], source: str) -> Check:
        return Check("surface", name, measure, source)

    return (
        check("Parseval", lambda: conservation.parseval(spectrum), "Σ_m η_m = 1"),
        check(
            "table against heights",
            lambda: against_reference(height_field, spectrum),
            "reference.power_spectrum, float64",
        ),
        check("reciprocity", lambda: conservation.reciprocity(spectrum), "f(ω_i, ω_o) = f(ω_o, ω_i)"),
        check("albedo of a perfect mirror", lambda: conservation.energy(spectrum), "at most one"),
        check("range of scalar theory", lambda: scalar_range(height_field, spectrum.extent), "coupled waves, stored"),
    )


def main_period(height_field: HeightField, extent: str) -> float:
    """The strongest period in µm; NaN if there is none."""
    found = find_periods(height_field, 1, extent=extent)
    return found[0].period if found else float("nan")


def scalar_range(height_field: HeightField, extent: str) -> Record:
    """What scalar theory is expected to get wrong about a sinusoid of the same period and roughness."""
    period = main_period(height_field, extent)
    # About the mean plane of a sample: a tilt turns the light and is no roughness.
    depth = equivalent_depth(statistics(height_field, extent=extent).Sq)
    if np.isnan(period):
        return Record(0.0, 0.0, TRUSTED, note="no period stands out")
    found = expected_error(period, depth, _WAVELENGTH)
    note = f"as of a sinusoid, {period:.3g} × {depth:.2g} µm, at 550 nm, ≤ 20°; a share of the light"
    return Record(found, 0.0, TRUSTED, note=note if np.isfinite(found) else f"outside of what is stored: {note}")
