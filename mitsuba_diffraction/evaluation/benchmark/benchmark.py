"""Speed against error: every case, every representation, a ladder of tolerances."""

from __future__ import annotations

import functools
import os
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import mitsuba as mi
import numpy as np
from rich.table import Table

from ... import outputs
from ...errors import RequestError
from ...files import whole_file
from ...grating_spectrum import GratingSpectrum
from ...outputs import metadata
from ...progress import table
from ...settings import VISIBLE, Settings
from ...spectrum.tables import SliceTable
from .. import report
from . import sampling, shader_speed
from .accuracy import Accuracy, Exact
from .cases import Case
from .sampling import Sampling
from .shader_speed import ShaderSpeed, shader_speeds
from .speed import Rays, blank, seconds

REPRESENTATIONS = ("slices", "svd", "chebyshev", "taylor")
TOLERANCES = (1e-2, 1e-3)

COLUMNS = {
    "surface": "{.surface}",
    "represen-\ntation": "{.representation}",
    "toler-\nance": "{.tolerance:g}",
    "terms": "{.terms}",
    "words\nread": "{.words}",
    "MB": "{.megabytes:.3g}",
    "build\ns": "{.build_seconds:.2g}",
    "L1\nerror": "{.accuracy.l1:.1e}",
    "ΔE00\nmean": "{0.accuracy.delta_e[0]:.3f}",
    "ΔE00\nmax": "{0.accuracy.delta_e[1]:.3f}",
    "eval_pdf\n10⁶/s": "{.millions:.1f}",
    "eval_pdf\nratio": "{.evaluate_ratio:.2f}",
    "reads\nratio": "{.read_ratio:.2f}",
    "sample\nratio": "{.sample_ratio:.2f}",
}


@dataclass(frozen=True)
class Result:
    """A representation of a surface.

    Attributes:
        surface: name of the case.
        extent: "tile" or "sample".
        representation: "taylor", "chebyshev", "svd" or "slices".
        tolerance: the requested one.
        refused: the reason why there is no such spectrum; the rest is then None.
        terms: of the series, or intervals of the slices.
        words: of 32 bits that one evaluation of S reads from the table.
        megabytes: of the table.
        build_seconds: of `precompute`.
        evaluations: of eval_pdf per second, four wavelengths each.
        read_ratio: speed of reading the same words alone, an upper bound, to eval_pdf of roughconductor (Al).
        evaluate_ratio: speed of eval_pdf to that of roughconductor (Al) in the same run.
        sample_ratio: speed of sample to that of roughconductor (Al) in the same run.
        accuracy: against the float64 reference.
    """

    surface: str
    extent: str
    representation: str
    tolerance: float
    refused: str | None = None
    terms: int | None = None
    words: int | None = None
    megabytes: float | None = None
    build_seconds: float | None = None
    evaluations: float | None = None
    read_ratio: float | None = None
    evaluate_ratio: float | None = None
    sample_ratio: float | None = None
    accuracy: Accuracy | None = None

    @property
    def millions(self) -> float:
        """Evaluations in 10⁶/s."""
        return self.evaluations / 1e6


def run(
    cases: Iterable[Case],
    *,
    representations: Sequence[str] = REPRESENTATIONS,
    tolerances: Sequence[float] = TOLERANCES,
    count: int = 1 << 19,
    shading_points: int = 1 << 14,
    repetitions: int = 5,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> tuple[list[Result], list[ShaderSpeed]]:
    """Measure under the current variant.

    Args:
        cases: surfaces.
        representations: names as in `precompute`.
        tolerances: likewise.
        count: rays at once.
        shading_points: of the real-time shaders at once.
        repetitions: of each timing, interleaved.
        progress: called with (steps done, steps in all).

    Returns:
        A result for every combination, in order; and the real-time shaders on the tiles.

    Raises:
        ValueError: if a tolerance is out of range.
    """
    for tolerance in tolerances:
        Settings(tolerance=tolerance)
    cases = list(cases)
    results, shaders, total = [], [], len(cases) * len(tolerances) * len(representations)
    progress(0, total)
    rays = Rays(count)
    for case in cases:
        exact = Exact(case, VISIBLE)
        if case.extent == "tile":
            shaders += shader_speeds(case, exact, count=shading_points, repetitions=min(repetitions, 3))
        for tolerance in tolerances:
            built: dict[str, tuple[GratingSpectrum, float]] = {}
            refused: dict[str, str] = {}
            for representation in representations:
                start = time.perf_counter()
                try:
                    spectrum = case.spectrum(representation, tolerance)
                    built[representation] = spectrum, time.perf_counter() - start
                except RequestError as error:
                    refused[representation] = str(error)
                progress(len(results) + len(built) + len(refused), total)
            measured = _measured(built, exact, rays, repetitions)
            for representation in representations:
                head = case.name, case.extent, representation, tolerance
                found = measured.get(representation, {"refused": refused.get(representation)})
                results.append(Result(*head, **found))
    return results, shaders


def _measured(
    built: dict[str, tuple[GratingSpectrum, float]], exact: Exact, rays: Rays, repetitions: int
) -> dict[str, dict[str, object]]:
    bsdfs = {"rough": mi.load_dict({"type": "roughconductor", "material": "Al"})}
    work = {}
    for name, (spectrum, _) in built.items():
        bsdfs[name] = mi.load_dict({"type": "diffraction_grating", "spectrum": spectrum, "material": "Al"})
        work[name, "read"] = functools.partial(rays.read, spectrum, blank(spectrum))
    for name, bsdf in bsdfs.items():
        work[name, "evaluate"] = functools.partial(rays.evaluate, bsdf)
        work[name, "sample"] = functools.partial(rays.sample, bsdf)
    taken = seconds(work, repetitions)
    return {
        name: {
            "terms": table.intervals if isinstance(table := spectrum.table, SliceTable) else table.series.terms,
            "words": int(np.prod(spectrum.neighbours)) * table.words_per_node,
            "megabytes": spectrum.megabytes,
            "build_seconds": build_seconds,
            "evaluations": rays.count / taken[name, "evaluate"],
            "read_ratio": taken["rough", "evaluate"] / taken[name, "read"],
            "evaluate_ratio": taken["rough", "evaluate"] / taken[name, "evaluate"],
            "sample_ratio": taken["rough", "sample"] / taken[name, "sample"],
            "accuracy": exact.accuracy(spectrum),
        }
        for name, (spectrum, build_seconds) in built.items()
    }


def cells(result: Result) -> list[str]:
    """Return the values of `COLUMNS` as texts."""
    if result.refused is None:
        return report.cells(COLUMNS, result)
    head = [text.format(result) for text in list(COLUMNS.values())[:3]]
    return [*head, "refused", *[""] * (len(COLUMNS) - len(head) - 1)]


def tables(results: Sequence[Result], shaders: Sequence[ShaderSpeed], sampled: Sequence[Sampling]) -> list[Table]:
    """Return tables of speed and error, of the real-time shaders and of sampling, for a terminal."""
    return [
        table(COLUMNS, map(cells, results), texts=2),
        table(shader_speed.COLUMNS, (report.cells(shader_speed.COLUMNS, row) for row in shaders), texts=2),
        table(sampling.COLUMNS, (report.cells(sampling.COLUMNS, row) for row in sampled)),
    ]


def save_json(
    results: Sequence[Result],
    shaders: Sequence[ShaderSpeed],
    sampled: Sequence[Sampling],
    path: str | os.PathLike[str],
) -> None:
    """Write all results atomically."""
    outputs.save_json({"speed and error": results, "real-time shader": shaders, "sampling": sampled}, path)


def save_plot(results: Sequence[Result], path: str | os.PathLike[str]) -> None:
    """Plot error against speed, one panel for each surface: right is faster, down is more accurate."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    surfaces = list(dict.fromkeys(result.surface for result in results))
    columns = min(3, len(surfaces))
    rows = -(-len(surfaces) // columns)
    figure = Figure(figsize=(max(6.5, 3.2 * columns), 2.6 * rows + 1), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True)
    representations = list(dict.fromkeys(result.representation for result in results))
    for panel, surface in zip(axes.flat, surfaces, strict=False):
        for index, representation in enumerate(representations):
            some = [
                r for r in results
                if (r.surface, r.representation) == (surface, representation) and r.refused is None
            ]  # fmt: skip
            panel.loglog(
                [r.evaluate_ratio for r in some], [r.accuracy.l1 for r in some],
                marker="osD^"[index % 4], markersize=4, linewidth=1, label=representation,
            )  # fmt: skip
        panel.axvline(1, color="0.6", linewidth=0.8, linestyle=":")
        panel.set_title(surface, fontsize="medium")
        panel.grid(alpha=0.25)
    # Speeds span less than two decades: 1, 2 and 5 in each, as plain numbers.
    axes.flat[0].xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.flat[0].xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
    axes.flat[0].xaxis.set_minor_formatter(NullFormatter())
    for panel in axes.flat[len(surfaces) :]:
        panel.set_axis_off()
    figure.supxlabel("evaluations per second, as a multiple of Mitsuba's roughconductor (Al)")
    figure.supylabel("error ∫|ΔS| dq")
    handles, labels = axes.flat[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=len(labels), frameon=False)
    with whole_file(path) as temporary:
        figure.savefig(temporary, format="png", dpi=130, metadata=metadata(path))
