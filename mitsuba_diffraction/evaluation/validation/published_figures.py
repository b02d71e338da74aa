"""Figures of the published maps beside those of this project, and the table of their correlations."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ...files import whole_file
from ...outputs import METADATA
from ...progress import Progress, silent
from ..report import markdown, save_markdown
from .figures import figure
from .published_maps import (
    CORRECTED,
    ENCODINGS,
    METHODS,
    PUBLISHED,
    PUBLISHED_MAPS,
    TRUNCATED,
    Grid,
    agreement,
    correlation_against_height,
    encoded,
    grid,
    linear_rgb,
)
from .viewing_angle import MODEL

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Array = NDArray[np.float64]

FILES = ("published_maps.png", "published_maps.md", "published_heights.png")
COLUMNS = ("map", "method", *(f"correlation, {encoding}" for encoding in ENCODINGS))
_TITLES = {PUBLISHED: "FLSS as published", CORRECTED: "FLSS corrected", MODEL: "this model"}
_SERIES = {PUBLISHED: "series converged", TRUNCATED: "37 terms from the lowest point"}
_HEIGHTS = np.arange(0.30, 0.92, 0.05)  # µm


@dataclass(frozen=True, eq=False)
class Row:
    """A published map and those of this project.

    Attributes:
        name: of the surface.
        pixels: of the author's map.
        maps: method → (n, 3) linear RGB.
    """

    name: str
    pixels: Grid
    maps: Mapping[str, Array]


def row(name: str, step: int = 2, methods: Iterable[str] = METHODS) -> Row:
    """Evaluate the maps of one of `PUBLISHED_MAPS` at every `step`-th pixel."""
    published = PUBLISHED_MAPS[name]
    pixels = grid(published, step)
    return Row(published.name, pixels, {method: linear_rgb(published, method, pixels.wo) for method in methods})


def plot_maps(rows: Iterable[Row]) -> Figure:
    """Plot the author's maps on the left and those of this project beside them, each titled with its correlation."""
    rows = list(rows)
    drawn = figure(3.1 * (1 + len(rows[0].maps)), 3.3 * len(rows))
    axes = drawn.subplots(len(rows), 1 + len(rows[0].maps), squeeze=False)
    for one, panels in zip(rows, axes, strict=True):
        pictures = {f"{one.name}, published": one.pixels.colours}
        for method, linear in one.maps.items():
            found = agreement(one.pixels, linear)
            pictures[f"{_TITLES[method]}: {found.correlation:.3f}"] = encoded(linear, found.brightness)
        for (title, colours), panel in zip(pictures.items(), panels, strict=True):
            panel.imshow(one.pixels.picture(colours), interpolation="nearest")
            panel.set_title(title, fontsize=11)
            panel.set_axis_off()
    return drawn


def table(rows: Iterable[Row]) -> list[list[str]]:
    """Return the correlations as rows of `COLUMNS`."""
    return [
        [one.name, _TITLES[method], *(f"{agreement(one.pixels, linear, kind).correlation:.3f}" for kind in ENCODINGS)]
        for one in rows
        for method, linear in one.maps.items()
    ]


def plot_heights(curves: Mapping[str, Mapping[str, Array]]) -> Figure:
    """Plot correlation against height range, a panel for each surface: name → method → (n,) at the heights."""
    drawn = figure(4.2 * len(curves), 3.6)
    axes = drawn.subplots(1, len(curves), sharey=True, squeeze=False)[0]
    for panel, (name, of_methods) in zip(axes, curves.items(), strict=True):
        published = PUBLISHED_MAPS[name]
        for method, values in of_methods.items():
            panel.plot(_HEIGHTS, values, marker="o", markersize=4, label=_SERIES[method])
        panel.axvline(published.height, color="0.4", linestyle="--", linewidth=1, label="height in the maps")
        panel.set_title(published.name, fontsize=11)
        panel.set_xlabel("height, black to white / µm")
        panel.set_ylim(0, 1.02)
        panel.grid(alpha=0.3)
    axes[0].set_ylabel("correlation with the published map")
    drawn.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False)
    return drawn


def save_published(
    folder: str | os.PathLike[str],
    *,
    step: int = 2,
    progress: Progress = silent,
) -> list[list[str]]:
    """Write `FILES` into a folder: the maps, their correlations, and these against the heights of the skins.

    Args:
        folder: of the files; it exists.
        step: between pixels of the published pictures.
        progress: called with (steps done, steps in total).

    Returns:
        Rows of `COLUMNS`.
    """
    folder, skins = Path(folder), ("elaphe", "xenopeltis")
    total = len(PUBLISHED_MAPS) + len(skins)
    rows = []
    for name in PUBLISHED_MAPS:
        rows.append(row(name, step))
        progress(len(rows), total)
    curves: dict[str, dict[str, Array]] = {}
    for name in skins:
        curves[name] = {
            method: correlation_against_height(PUBLISHED_MAPS[name], method, _HEIGHTS)
            for method in (PUBLISHED, TRUNCATED)
        }
        progress(len(rows) + len(curves), total)
    for name, drawn in (("published_maps.png", plot_maps(rows)), ("published_heights.png", plot_heights(curves))):
        with whole_file(folder / name) as temporary:
            # Of all colours: a palette is too coarse for dark maps.
            drawn.savefig(temporary, format="png", dpi=100, metadata=METADATA)
    found = table(rows)
    save_markdown(markdown(COLUMNS, found, texts=2), folder / "published_maps.md")
    return found
