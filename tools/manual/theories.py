"""Scalar and rigorous theory of one grating: costs, and errors relative to the solver, of 1200 lines/mm.

    python tools/manual/theories.py

prints the table of docs/speed.md, in minutes.
"""

from __future__ import annotations

import functools
import time
from dataclasses import dataclass

import mitsuba_diffraction  # noqa: F401  before Dr.Jit

import drjit as dr  # isort: skip
import mitsuba as mi  # isort: skip
import numpy as np

from mitsuba_diffraction.evaluation.benchmark.speed import Rays, seconds
from mitsuba_diffraction.precomputation.spectra import Spectrum, precompute
from mitsuba_diffraction.progress import Progress, cells, progress_bar, show, silent, table
from mitsuba_diffraction.rigorous import efficiencies, refractive_index
from mitsuba_diffraction.rigorous.rigorous_spectrum import RigorousSpectrum
from mitsuba_diffraction.scalar_theory.closed_form import efficiency_difference, profile_powers, scalar_orders
from mitsuba_diffraction.surface.gratings import ruled
from mitsuba_diffraction.surface.heightfield import HeightField
from mitsuba_diffraction.variants import choose_variant

COLUMNS = {
    "theory": "{.theory}",
    "build\nCPU s": "{.build_seconds:.2g}",
    "MB": "{.megabytes:.3g}",
    "error to the solver\nmean": "{.error:.1%}",
    "\nmax": "{.max_error:.1%}",
    "eval_pdf\nratio": "{.evaluate_ratio:.2f}",
    "in the\nlobes": "{.lobe_ratio:.2f}",
    "sample\nratio": "{.sample_ratio:.2f}",
}
_METAL = "Al"
_SAMPLE_COUNT = 60  # directions and wavelengths at which the solver is evaluated


@dataclass(frozen=True)
class TheoryCost:
    """Cost and accuracy of a theory.

    Attributes:
        theory: "scalar" or "rigorous".
        build_seconds: of processor time, of `precompute`.
        megabytes: of the table.
        error, max_error: Σ|Δη_m| / Σ η_m against the solver, including the errors of the theory and of the table; the
            mean and the maximum over directions, uniform over the hemisphere, and wavelengths from 400 to 700 nm;
            unpolarised.
        evaluate_ratio: speed of eval_pdf relative to roughconductor (Al), random directions, the same run.
        lobe_ratio: the same with ω_o sampled by the grating.
        sample_ratio: of sample.
    """

    theory: str
    build_seconds: float
    megabytes: float
    error: float
    max_error: float
    evaluate_ratio: float
    lobe_ratio: float
    sample_ratio: float


def compare_theories(
    height_field: HeightField,
    *,
    tolerance: float = 1e-2,
    count: int = 1 << 19,
    repetitions: int = 5,
    progress: Progress = silent,
) -> list[TheoryCost]:
    """Compare scalar, then rigorous theory of a surface of one row in aluminium, under the current variant of Mitsuba.

    Args:
        height_field: the surface.
        tolerance: of the rigorous table; minutes of work.
        count: rays at once.
        repetitions: of each timing, interleaved.
        progress: of the table, called with (steps done, steps in total).
    """
    spectra, built = {}, {}
    for theory, settings in (("scalar", {}), ("rigorous", {"material": _METAL, "tolerance": tolerance})):
        start = time.process_time()
        spectra[theory] = precompute(height_field, theory=theory, progress=progress, **settings)
        built[theory] = time.process_time() - start
    errors = _errors(height_field, spectra["rigorous"])
    taken = _seconds(spectra, count, repetitions)
    return [
        TheoryCost(
            theory,
            built[theory],
            spectrum.megabytes,
            float(np.mean(errors[theory])),
            float(np.max(errors[theory])),
            *(taken["rough", work] / taken[theory, work] for work in ("evaluate", "lobes", "sample")),
        )
        for theory, spectrum in spectra.items()
    ]


def _errors(height_field: HeightField, table: RigorousSpectrum) -> dict[str, list[float]]:
    """Return the errors of both theories at the same directions and wavelengths."""
    errors: dict[str, list[float]] = {"scalar": [], "rigorous": []}
    period, powers = height_field.tile_size[0], profile_powers(height_field)
    for cosine, azimuth, u in np.random.default_rng(0).random((_SAMPLE_COUNT, 3)):
        angle, wavelength = np.arccos(cosine), 0.4 + 0.3 * u
        sine = np.sin(angle)
        omega = -sine * np.cos(2 * np.pi * azimuth), -sine * np.sin(2 * np.pi * azimuth), cosine
        index = refractive_index(wavelength, material=_METAL)
        exact = efficiencies(height_field, omega, wavelength, int_ior=index, tolerance=2e-3)
        scalar = scalar_orders(powers, period, wavelength, np.rad2deg(angle), index, 360 * azimuth)
        errors["scalar"].append(efficiency_difference(scalar.unpolarised, exact.unpolarised))
        errors["rigorous"].append(efficiency_difference(table.efficiencies(omega, wavelength)[1], exact.unpolarised))
    return errors


def _seconds(spectra: dict[str, Spectrum], count: int, repetitions: int) -> dict[tuple[str, str], float]:
    bsdfs = {"rough": mi.load_dict({"type": "roughconductor", "material": _METAL})}
    for theory, spectrum in spectra.items():
        bsdfs[theory] = mi.load_dict({"type": "diffraction_grating", "spectrum": spectrum, "material": _METAL})
    rays, lobes = Rays(count), Rays(count)
    drawn = bsdfs["rigorous"].sample(mi.BSDFContext(), rays.si, rays.sample1, rays.sample2)[0]
    lobes.si, lobes.wo = rays.si, drawn.wo
    dr.eval(lobes.wo)
    work = {}
    for name, bsdf in bsdfs.items():
        work[name, "evaluate"] = functools.partial(rays.evaluate, bsdf)
        work[name, "lobes"] = functools.partial(lobes.evaluate, bsdf)
        work[name, "sample"] = functools.partial(rays.sample, bsdf)
    return seconds(work, repetitions)


def main() -> None:
    mi.set_variant(choose_variant(None))
    with progress_bar("rigorous efficiencies") as progress:
        costs = compare_theories(ruled(1200), progress=progress)
    show(table(COLUMNS, (cells(COLUMNS, cost) for cost in costs)), width=140)


if __name__ == "__main__":
    main()
