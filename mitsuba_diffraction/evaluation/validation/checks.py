"""Lists of checks: of the package, and of a given surface."""

from __future__ import annotations

from collections.abc import Callable

from ...precomputation.grating_spectrum import GratingSpectrum
from ...scalar_theory.validity import scalar_error
from ...surface.heightfield import HeightField
from ..benchmark.accuracy import against_reference
from ..record import GROUPS, Check, Record
from . import (
    analytic,
    conservation,
    coupled_waves,
    measured_gratings,
    rough_surface,
    transmission_grating,
)


def checks() -> tuple[Check, ...]:
    """Return the checks of `mitsuba-diffraction validate`, group by group."""
    modules = (analytic, measured_gratings, transmission_grating, rough_surface, conservation, coupled_waves)
    unsorted = [check for module in modules for check in module.CHECKS]
    return tuple(sorted(unsorted, key=lambda check: GROUPS.index(check.group)))


def surface_checks(height_field: HeightField, spectrum: GratingSpectrum) -> tuple[Check, ...]:
    """Return checks of the spectrum of a surface and of its BSDF."""

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
        check("range of scalar theory", lambda: scalar_range(height_field, spectrum.extent), "rigorous orders"),
    )


def scalar_range(height_field: HeightField, extent: str) -> Record:
    """Return the error of scalar theory, as `inspect` and `precompute` report it."""
    found = scalar_error(height_field, extent)
    return Record(found.reflected, 0.0, found.bound, note=str(found))
