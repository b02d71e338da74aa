"""The measurement: every case, every representation, a ladder of tolerances."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..precompute import VISIBLE, check_tolerance
from ..spectrum import GratingSpectrum
from ..spectrum.slice_table import SliceTable
from .accuracy import Accuracy, Exact
from .approximation import Approximation, approximations
from .cases import Case
from .speed import Rays, rates

REPRESENTATIONS = ("slices", "svd", "chebyshev", "taylor")
TOLERANCES = (1e-2, 1e-3)


@dataclass(frozen=True)
class Result:
    """One line of the report.

    Attributes:
        surface: name of the case.
        extent: "tile" or "sample".
        representation: "taylor", "chebyshev", "svd" or "slices".
        tolerance: what was asked for.
        refused: why there is no such spectrum; then the rest is None.
        terms: of the series, or intervals of the slices.
        floats: that one evaluation of S reads from the table.
        megabytes: of the table.
        build_seconds: of `precompute`.
        evaluations: of eval_pdf per second, four wavelengths each.
        read_ratio: of bare reading of the same floats, which bounds any evaluation, to eval_pdf of roughconductor (Al).
        evaluate_ratio: to eval_pdf of roughconductor (Al) in the same run.
        sample_ratio: of sample to that of roughconductor (Al) in the same run.
        accuracy: against the float64 reference.
    """

    surface: str
    extent: str
    representation: str
    tolerance: float
    refused: str | None = None
    terms: int | None = None
    floats: int | None = None
    megabytes: float | None = None
    build_seconds: float | None = None
    evaluations: float | None = None
    read_ratio: float | None = None
    evaluate_ratio: float | None = None
    sample_ratio: float | None = None
    accuracy: Accuracy | None = None


def run(
    cases: Iterable[Case],
    *,
    representations: Sequence[str] = REPRESENTATIONS,
    tolerances: Sequence[float] = TOLERANCES,
    count: int = 1 << 19,
    repetitions: int = 5,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> tuple[list[Result], list[Approximation]]:
    """Measure under the variant in force.

    Args:
        cases: surfaces.
        representations: names as in `precompute`.
        tolerances: likewise.
        count: rays at once.
        repetitions: of each timing, interleaved.
        progress: called with (steps done, steps in all).

    Returns:
        A result for every combination, in order; and the real-time shaders on the tiles.

    Raises:
        ValueError: if a tolerance is out of range.
    """
    for tolerance in tolerances:
        check_tolerance(tolerance)
    cases = list(cases)
    results, shaders, total = [], [], len(cases) * len(tolerances) * len(representations)
    progress(0, total)
    rays = Rays(count)
    for case in cases:
        exact = Exact(case, VISIBLE)
        if case.extent == "tile":
            shaders += approximations(case, exact)
        for tolerance in tolerances:
            spectra: dict[str, tuple[GratingSpectrum, float] | str] = {}
            for representation in representations:
                spectra[representation] = _built(case, representation, tolerance)
                progress(len(results) + len(spectra), total)
            results += _measured(case, tolerance, spectra, exact, rays, repetitions)
    return results, shaders


def _built(case: Case, representation: str, tolerance: float) -> tuple[GratingSpectrum, float] | str:
    start = time.perf_counter()
    try:
        spectrum = case.spectrum(representation, tolerance)
    except ValueError as error:
        return str(error)
    return spectrum, time.perf_counter() - start


def _measured(
    case: Case,
    tolerance: float,
    spectra: dict[str, tuple[GratingSpectrum, float] | str],
    exact: Exact,
    rays: Rays,
    repetitions: int,
) -> list[Result]:
    bsdfs = {"roughconductor": mi.load_dict({"type": "roughconductor", "material": "Al"})}
    for name, built in spectra.items():
        if not isinstance(built, str):
            bsdfs[name] = mi.load_dict({"type": "diffraction_grating", "spectrum": built[0], "material": "Al"})
    work = {(name, "evaluate"): (lambda b=bsdf: rays.evaluate(b)) for name, bsdf in bsdfs.items()}
    work |= {(name, "sample"): (lambda b=bsdf: rays.sample(b)) for name, bsdf in bsdfs.items()}
    for name, built in spectra.items():
        if not isinstance(built, str):
            nodes = built[0].grid.shape[0] * built[0].grid.shape[1]
            floats = dr.zeros(mi.Float, 4 * nodes * -(-built[0].table.floats_per_node // 4))
            dr.make_opaque(floats)
            work[name, "read"] = lambda s=built[0], f=floats: rays.read(s, f)
    speed = rates(rays, work, repetitions)
    results = []
    for name, built in spectra.items():
        head = {"surface": case.name, "extent": case.extent, "representation": name, "tolerance": tolerance}
        if isinstance(built, str):
            results.append(Result(**head, refused=built))
            continue
        spectrum, seconds = built
        table = spectrum.table
        results.append(
            Result(
                **head,
                terms=table.intervals if isinstance(table, SliceTable) else table.series.terms,
                floats=spectrum.floats_per_evaluation,
                megabytes=spectrum.megabytes,
                build_seconds=seconds,
                evaluations=speed[name, "evaluate"],
                read_ratio=speed[name, "read"] / speed["roughconductor", "evaluate"],
                evaluate_ratio=speed[name, "evaluate"] / speed["roughconductor", "evaluate"],
                sample_ratio=speed[name, "sample"] / speed["roughconductor", "sample"],
                accuracy=exact.accuracy(spectrum),
            )
        )
    return results
