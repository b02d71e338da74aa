"""All figures and the table of the evaluation, into a folder."""

from __future__ import annotations

import csv
import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..files import whole_file
from ..outputs import made_for, png_text
from ..outputs import save_markdown as write_markdown
from ..shader.quirks import Quirks
from . import plots
from .brdf_map import MAP_METHODS, PROJECTIONS, brdf_map
from .patch_length import cut, fit_cut_patch, period_of_heights
from .surfaces import Surface, chosen
from .viewing_angle import METHODS, MODEL, PeriodFit, ReflectanceMap, fit_period, reflectance_map, wavelengths

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MAP_COHERENCE = {"blaze": 6.5}
"""µm, of the BRDF maps: in sunlight the orders of the blaze would be thinner than a pixel."""

CUT = "elaphe"
"""The surface on which the published fit of PQ goes wrong."""

PATCH_LENGTHS = tuple(np.arange(6.0, 10.01, 0.125).tolist())
"""µm: AFM patches of such skins are as short as this."""

_MODEL_EVERY = 4  # patches; of a piece of a surface its spectrum takes seconds


@dataclass(frozen=True)
class Row:
    """A line of the table of fitted periods.

    Attributes:
        surface: what was looked at.
        method: one of `viewing_angle.METHODS`.
        as_published: of the shader: with its published peculiarities, or with none; None for the model.
        fit: what came out.
    """

    surface: Surface
    method: str
    as_published: bool | None
    fit: PeriodFit

    @property
    def name(self) -> str:
        """The method, for people."""
        manner = {None: "", True: ", as published", False: ", corrected"}[self.as_published]
        return plots.TITLES[self.method] + manner


def period_rows(surface: Surface, maps: Iterable[ReflectanceMap], step: float = 5.0) -> list[Row]:
    """The fits of a surface: of maps that are there already (the shader as published), and of the shader corrected.

    Args:
        surface: what to look at.
        maps: as `reflectance_map` gives them.
        step: between wavelengths of what is still to be evaluated, nm.
    """
    rows = []
    for found in maps:
        model = found.method == MODEL
        rows.append(Row(surface, found.method, None if model else True, fit_period(found)))
        if not model:
            corrected = reflectance_map(
                surface, found.method, incidence=found.incidence, wavelengths=wavelengths(step),
                quirks=Quirks.corrected(),
            )  # fmt: skip
            rows.append(Row(surface, found.method, False, fit_period(corrected)))
    return rows


def figure_names(surfaces: Iterable[str] | None = None) -> list[str]:
    """The files that `save_figures` writes."""
    wanted = chosen(surfaces)
    of_surfaces = [f"{kind}_{name}.png" for name in wanted for kind in ("viewing_angle", "brdf")]
    cut_patch = ["patch_length.png"] if CUT in wanted else []
    return [*of_surfaces, *cut_patch, "slits.png", "slit_patterns.png", "periods.md", "periods.csv"]


def save_figures(
    folder: str | os.PathLike[str],
    *,
    surfaces: Iterable[str] | None = None,
    step: float = 5.0,
    side: int = 200,
    patch_lengths: Sequence[float] = PATCH_LENGTHS,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[Path]:
    """Evaluates and draws, as chapter 5 of the thesis of 2014 does, under Mitsuba's variant in force.

    Written, each whole or not at all: for every surface `viewing_angle_NAME.png` and `brdf_NAME.png`; `slits.png`,
    `slit_patterns.png`; with Elaphe `patch_length.png`; and the fitted periods, `periods.md` and `periods.csv`.

    Args:
        folder: where to write; made if it is not there.
        surfaces: names among `surfaces.SURFACES`; all by default.
        step: between wavelengths, nm.
        side: pixels of a BRDF map.
        patch_lengths: µm, of the cut patches.
        progress: called with (steps done, steps in all).

    Returns:
        The files.

    Raises:
        ValueError: on an unknown surface, or where Mitsuba has no vectorised spectral variant set.
    """
    wanted = chosen(surfaces)
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    files: list[Path] = []
    rows: list[Row] = []
    done, total = 0, 2 * len(wanted) + (CUT in wanted) + 1

    def step_done(path: Path, drawn: Figure) -> None:
        nonlocal done
        _save(drawn, path)
        files.append(path)
        done += 1
        progress(done, total)

    for name, surface in wanted.items():
        maps = [reflectance_map(surface, method, wavelengths=wavelengths(step)) for method in METHODS]
        rows += period_rows(surface, maps, step)
        step_done(folder / f"viewing_angle_{name}.png", plots.plot_reflectance(maps))
        mapped = surface.coherent_over(MAP_COHERENCE[name]) if name in MAP_COHERENCE else surface
        step_done(
            folder / f"brdf_{name}.png",
            plots.plot_brdf_maps(
                [
                    [brdf_map(mapped, method, projection=projection, side=side) for method in MAP_METHODS]
                    for projection in PROJECTIONS
                ]
            ),
        )
    if CUT in wanted:
        step_done(folder / "patch_length.png", patch_figure(wanted[CUT], patch_lengths))
    _save(plots.plot_slits(), folder / "slits.png")
    step_done(folder / "slit_patterns.png", plots.plot_slit_patterns())
    tables = [folder / "periods.md", folder / "periods.csv"]
    save_markdown(rows, tables[0])
    save_csv(rows, tables[1])
    return [*files, folder / "slits.png", *tables]


def patch_figure(surface: Surface, lengths: Sequence[float]) -> Figure:
    """`plots.plot_patch_fits` for patches of the lengths (µm): PQ on all of them, the model on every fourth."""
    patches = [cut(surface, length) for length in lengths]
    lengths = [patch.tile_size[surface.axis] for patch in patches]
    heights = [period_of_heights(surface, patch) for patch in patches]
    fits = {
        method: [
            (length, fit_cut_patch(surface, patch, method))
            for length, patch in zip(lengths[::every], patches[::every], strict=True)
        ]
        for method, every in (("pq", 1), (MODEL, _MODEL_EVERY))
    }
    return plots.plot_patch_fits(surface, lengths, heights, fits)


_HEAD = ("surface", "method", "period / nm", "variance / nm²", "thesis: period / nm", "thesis: variance / nm²")


def _cells(row: Row) -> tuple[str, ...]:
    mean, variance = row.surface.published
    variance_found = f"{row.fit.variance:.3f}"
    return row.surface.name, row.name, f"{row.fit.mean:.2f}", variance_found, f"{mean:.2f}", f"{variance:.2f}"


def save_markdown(rows: Iterable[Row], path: str | os.PathLike[str]) -> None:
    """The table of fitted periods in Markdown, whole or not at all."""
    lines = [_HEAD, ("---", "---", *["---:"] * (len(_HEAD) - 2)), *map(_cells, rows)]
    write_markdown("".join(f"| {' | '.join(cells)} |\n" for cells in lines), path)


def save_csv(rows: Iterable[Row], path: str | os.PathLike[str]) -> None:
    """The table of fitted periods as comma-separated values, whole or not at all; a comment may follow."""
    request = made_for(path)
    with whole_file(path) as temporary, open(temporary, "w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows([_HEAD, *map(_cells, rows)])
        if request is not None:
            file.write(f"# {request}\n")


def _save(drawn: Figure, path: Path) -> None:
    with whole_file(path) as temporary:
        temporary.write_bytes(plots.png(drawn, pnginfo=png_text(path)))
