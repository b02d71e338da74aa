"""Speed against error: all cases at several tolerances."""

from __future__ import annotations

import functools
import os
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import mitsuba as mi
import numpy as np
from rich.table import Table

from ...files.outputs import METADATA
from ...files.writing import whole_file
from ...precomputation.grating_spectrum import GratingSpectrum
from ...progress import Progress, cells, silent, table
from ...settings import VISIBLE, ScalarSettings
from ...spectrum.tables import SliceTable
from . import sampling
from .accuracy import Accuracy, Exact
from .cases import Case
from .measured import measured_bsdf
from .sampling import Sampling
from .speed import Rays, seconds

TOLERANCES = (1e-2, 1e-3)

RESULT_COLUMNS = {
    "surface": "{.surface}",
    "toler-\nance": "{.tolerance:g}",
    "inter-\nvals": "{.intervals}",
    "words\nread": "{.words}",
    "MB": "{.megabytes:.3g}",
    "build\ns": "{.build_seconds:.2g}",
    "L1\nerror": "{.accuracy.l1:.1e}",
    "ΔE00\nmean": "{0.accuracy.delta_e[0]:.3f}",
    "ΔE00\nmax": "{0.accuracy.delta_e[1]:.3f}",
    "eval_pdf\n10⁶/s": "{.millions:.1f}",
    "eval_pdf\nratio": "{.evaluate_ratio:.2f}",
    "sample\nratio": "{.sample_ratio:.2f}",
    "measured\neval_pdf": "{0.beside_measured[0]:.2f}",
    "measured\nsample": "{0.beside_measured[1]:.2f}",
}


@dataclass(frozen=True)
class Result:
    """A spectrum of a surface.

    Attributes:
        surface: name of the case.
        extent: "tile" or "sample".
        tolerance: the requested one.
        intervals: of κ in the table.
        words: of 32 bits that one evaluation of S reads from the table.
        megabytes: of the table.
        build_seconds: of `precompute`.
        evaluations: of eval_pdf per second of processor time, four wavelengths each.
        evaluate_ratio: speed of eval_pdf relative to roughconductor (Al) in the same run.
        sample_ratio: speed of sample relative to roughconductor (Al) in the same run.
        beside_measured: speeds of eval_pdf and sample relative to `measured_bsdf` in the same run.
        accuracy: against the float64 reference.
    """

    surface: str
    extent: str
    tolerance: float
    intervals: int
    words: int
    megabytes: float
    build_seconds: float
    evaluations: float
    evaluate_ratio: float
    sample_ratio: float
    beside_measured: tuple[float, float]
    accuracy: Accuracy

    @property
    def millions(self) -> float:
        """Evaluations in 10⁶/s."""
        return self.evaluations / 1e6


def run_benchmark(
    cases: Iterable[Case],
    *,
    tolerances: Sequence[float] = TOLERANCES,
    count: int = 1 << 19,
    repetitions: int = 5,
    progress: Progress = silent,
) -> list[Result]:
    """Measure under the current variant.

    Args:
        cases: surfaces.
        tolerances: of their spectra.
        count: rays at once.
        repetitions: of each timing, interleaved.
        progress: called with (steps done, steps in total).

    Returns:
        A result for every combination, in order.

    Raises:
        ValueError: if a tolerance is out of range, or a surface too large for it.
    """
    for tolerance in tolerances:
        ScalarSettings(tolerance=tolerance)
    cases = list(cases)
    results: list[Result] = []
    total = len(cases) * len(tolerances)
    progress(0, total)
    rays = Rays(count)
    for case in cases:
        exact = Exact(case, VISIBLE)
        for tolerance in tolerances:
            start = time.perf_counter()
            spectrum = case.spectrum(tolerance)
            build_seconds = time.perf_counter() - start
            results.append(_measured(case, spectrum, build_seconds, exact, rays, repetitions))
            progress(len(results), total)
    return results


def _measured(
    case: Case, spectrum: GratingSpectrum, build_seconds: float, exact: Exact, rays: Rays, repetitions: int
) -> Result:
    rough = mi.load_dict({"type": "roughconductor", "material": "Al"})
    grating = mi.load_dict({"type": "diffraction_grating", "spectrum": spectrum, "material": "Al"})
    work: dict[tuple[str, str], Callable[[], object]] = {}
    for name, bsdf in (("rough", rough), ("measured", measured_bsdf()), ("grating", grating)):
        work[name, "evaluate"] = functools.partial(rays.evaluate, bsdf)
        work[name, "sample"] = functools.partial(rays.sample, bsdf)
    assert isinstance(spectrum.table, SliceTable)  # the representation "auto"
    # Processor time, so that other work on the machine changes ratios little.
    taken = seconds(work, repetitions, time.process_time)
    return Result(
        surface=case.name,
        extent=case.extent,
        tolerance=spectrum.tolerance,
        intervals=spectrum.table.intervals,
        words=int(np.prod(spectrum.neighbours)) * spectrum.table.words_per_node,
        megabytes=spectrum.megabytes,
        build_seconds=build_seconds,
        evaluations=rays.count / taken["grating", "evaluate"],
        evaluate_ratio=taken["rough", "evaluate"] / taken["grating", "evaluate"],
        sample_ratio=taken["rough", "sample"] / taken["grating", "sample"],
        beside_measured=(
            taken["measured", "evaluate"] / taken["grating", "evaluate"],
            taken["measured", "sample"] / taken["grating", "sample"],
        ),
        accuracy=exact.accuracy(spectrum),
    )


def benchmark_tables(results: Sequence[Result], sampled: Sequence[Sampling]) -> list[Table]:
    """Return tables of speed and error, and of sampling, for a terminal."""
    return [
        table(RESULT_COLUMNS, (cells(RESULT_COLUMNS, result) for result in results)),
        table(sampling.SAMPLING_COLUMNS, (cells(sampling.SAMPLING_COLUMNS, row) for row in sampled)),
    ]


def save_speed_plot(results: Sequence[Result], path: str | os.PathLike[str]) -> None:
    """Plot error against speed, a line for each surface: right is faster, down is more accurate."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    figure = Figure(figsize=(6.5, 6), layout="constrained")  # with text that is read at 400 pixels
    axes = figure.subplots()
    axes.tick_params(labelsize=15)
    for index, surface in enumerate(dict.fromkeys(result.surface for result in results)):
        some = [result for result in results if result.surface == surface]
        axes.loglog(
            [r.evaluate_ratio for r in some], [r.accuracy.l1 for r in some],
            marker="osD^"[index % 4], markersize=7, linewidth=2, label=surface.replace("_", " "),
        )  # fmt: skip
    axes.axvline(1, color="0.6", linewidth=0.8, linestyle=":")
    axes.grid(alpha=0.25)
    # Speeds span less than two decades: ticks at 1, 2 and 5 of each, as plain numbers.
    axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_xlabel("speed relative to roughconductor (Al)", fontsize=16)
    axes.set_ylabel("error ∫|ΔS| dq", fontsize=16)
    figure.legend(loc="outside lower center", frameon=False, ncols=2, fontsize=14)
    with whole_file(path) as temporary:
        figure.savefig(temporary, format="png", dpi=130, metadata=METADATA)
