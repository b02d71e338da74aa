"""The report of a benchmark: a table on the terminal, JSON, and a picture."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Sequence

from rich.table import Table

from ..files import whole_file
from ..outputs import metadata
from ..outputs import save_json as write_json
from .approximation import Approximation
from .run import Result
from .sampling import ANGLES, Sampling

_COLUMNS = (
    "surface", "represen-\ntation", "toler-\nance", "terms", "floats\nread", "MB", "build\ns", "L1\nerror",
    "peak\nerror", "ΔE00\nmean", "ΔE00\nmax", "eval_pdf\n10⁶/s", "eval_pdf\nratio", "reads\nratio", "sample\nratio",
)  # fmt: skip


def cells(result: Result) -> list[str]:
    """One line of the table, as texts."""
    head = [result.surface, result.representation, f"{result.tolerance:g}"]
    if result.refused is not None:
        return [*head, "refused", *[""] * (len(_COLUMNS) - len(head) - 1)]
    accuracy = result.accuracy
    return [
        *head,
        str(result.terms),
        str(result.floats),
        f"{result.megabytes:.3g}",
        f"{result.build_seconds:.2g}",
        f"{accuracy.l1:.1e}",
        f"{accuracy.peak:.1e}",
        f"{accuracy.delta_e[0]:.3f}",
        f"{accuracy.delta_e[1]:.3f}",
        f"{result.evaluations / 1e6:.1f}",
        f"{result.evaluate_ratio:.2f}",
        f"{result.read_ratio:.2f}",
        f"{result.sample_ratio:.2f}",
    ]


def table(results: Sequence[Result]) -> Table:
    """Speed and error for a terminal."""
    return _table(_COLUMNS, 2, [cells(result) for result in results])


def sampling_table(sampling: Sequence[Sampling]) -> Table:
    """How well the surfaces are sampled, for a terminal."""
    columns = ("surface", *(f"fraction\n{angle:g}°" for angle in ANGLES), "largest\nweight")
    rows = [
        [
            s.surface,
            *(f"{fraction:.2f}" for fraction in s.fractions),
            f"{s.largest_weight:.1f}",
            f"{s.variance_ratio:.0f}",
            f"{s.picture_ratio:.2f}",
        ]
        for s in sampling
    ]
    return _table((*columns, "variance of\ncosine sampling", "picture\ntime"), 1, rows)


def shader_table(shaders: Sequence[Approximation]) -> Table:
    """The real-time shaders, for a terminal."""
    columns = ("surface", "shader", "texel reads", "speed\nratio", "ΔE00\nmean", "ΔE00\nmax")
    rows = [
        [
            s.surface,
            s.variant + (", as published" if s.as_published else ", corrected"),
            str(s.texel_reads),
            f"{s.evaluate_ratio:.1e}",
            f"{s.delta_e[0]:.2f}",
            f"{s.delta_e[1]:.1f}",
        ]
        for s in shaders
    ]
    return _table(columns, 2, rows)


def _table(columns: Sequence[str], texts: int, rows: Sequence[Sequence[str]]) -> Table:
    """Of which the first `texts` columns hold texts, the others numbers."""
    shown = Table(box=None, pad_edge=False)
    for index, column in enumerate(columns):
        shown.add_column(column, justify="left" if index < texts else "right", no_wrap=True)
    for row in rows:
        shown.add_row(*row)
    return shown


def save_json(
    results: Sequence[Result],
    shaders: Sequence[Approximation],
    sampling: Sequence[Sampling],
    path: str | os.PathLike[str],
) -> None:
    """Write all, whole or not at all."""
    content = {
        "speed and error": [dataclasses.asdict(result) for result in results],
        "real-time shader": [dataclasses.asdict(s) for s in shaders],
        "sampling": [dataclasses.asdict(s) for s in sampling],
    }
    write_json(content, path)


def save_plot(results: Sequence[Result], path: str | os.PathLike[str]) -> None:
    """Draw error against speed, one panel for each surface: right is faster, down is more accurate."""
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
