"""The evaluation of the thesis of 2014 (chapter 5) for the real-time shader and for this model: figures and a table.

    python tools/thesis/evaluation.py FOLDER [SURFACE …]

`docs/published.md` discusses them.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from brdf_map import MAP_METHODS, PROJECTIONS, BRDFMap, brdf_map
from published_surfaces import SURFACES, PublishedSurface
from viewing_angle import (
    METHODS,
    MODEL,
    ReflectanceMap,
    fit_period,
    grating_equation,
    peak_angles,
    reflectance_map,
    ridges,
    wavelengths,
)

from mitsuba_diffraction.evaluation.plots import figure, save_png
from mitsuba_diffraction.evaluation.report import markdown, save_markdown
from mitsuba_diffraction.progress import Progress, progress_bar, silent
from mitsuba_diffraction.shader_2014.quirks import Quirks
from mitsuba_diffraction.variants import choose_variant

import mitsuba as mi  # isort: skip  (after LLVM has been chosen)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.cm import ScalarMappable
    from matplotlib.figure import Figure

FILES = (*(f"{kind}_{name}.png" for name in SURFACES for kind in ("viewing_angle", "brdf")), "periods.md")
MAP_COHERENCE = {"blaze": 6.5}
"""µm, of the BRDF maps: in sunlight the orders of the blaze would be thinner than a pixel."""

TITLES = {MODEL: "this model", "flss": "FLSS", "nmm": "NMM", "pq": "PQ", "nmm_pq": "NMM and PQ", "gem": "GEM"}
_PEAK = "#d62728"
_MIN_SHOWN = 1e-3  # of the maximum reflectance outside the specular peak


def plot_reflectance(maps: Sequence[ReflectanceMap]) -> Figure:
    """Plot reflectance over wavelength and viewing angle, with the peak curve and the grating equation on top.

    One panel for each map; all maps are of one surface and one θ_i. The panels show all viewing angles, or those near
    the range of the published map. Each panel has a logarithmic scale of three decades below its maximum reflectance
    outside the specular peak.
    """
    columns = min(2, len(maps))
    rows = -(-len(maps) // columns)
    drawn = figure(3.1 * columns + 0.9, 3.1 * rows + 1.3)
    axes = drawn.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    for panel, found in zip(axes.ravel(), maps, strict=True):
        image = _draw_map(panel, found)
        fit = fit_period(found)
        panel.set_title(f"{TITLES[found.method]}\npeak at {fit.mean:.1f} ± {fit.deviation:.2f} nm")
    surface, incidence = maps[0].surface, maps[0].incidence
    for panel in axes[-1]:
        panel.set_xlabel("wavelength λ / nm")
    for panel in axes[:, 0]:
        panel.set_ylabel("viewing angle θ$_r$ / °")
    bar = drawn.colorbar(image, ax=axes, pad=0.01)
    bar.set_label("reflectance / maximum outside the mirror direction")
    drawn.suptitle(f"{surface.name}: light at θ$_i$ = {incidence:g}°, mirror direction at θ$_r$ = {-incidence:g}°")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    drawn.legend(handles, labels, loc="outside lower center", frameon=False)
    return drawn


def _draw_map(panel: Axes, found: ReflectanceMap) -> ScalarMappable:
    from matplotlib.collections import LineCollection
    from matplotlib.colors import LogNorm

    maximum = np.nanmax(np.where(found.order > 0.5, found.reflectance, 0))
    shown = np.clip(found.reflectance / maximum, _MIN_SHOWN, 1)
    style = {"cmap": "viridis", "norm": LogNorm(_MIN_SHOWN, 1), "rasterized": True}
    if found.discrete:
        # A line for each order; nothing is evaluated between them.
        panel.set_facecolor("0.85")
        points = np.stack([np.broadcast_to(found.wavelengths[:, None], shown.shape), found.angles], axis=-1)
        steps = np.stack([points[:-1], points[1:]], axis=2).reshape(-1, 2, 2)
        image = panel.add_collection(LineCollection(steps, array=shown[:-1].ravel(), linewidths=0.9, **style))
    else:
        image = panel.pcolormesh(found.wavelengths, found.angles, shown.T, shading="nearest", **style)
    panel.plot(
        found.wavelengths, peak_angles(found), color=_PEAK, linewidth=2.5, label="peak of this map: its brightest angle"
    )
    period = found.surface.period
    equation = grating_equation(period, found.incidence, found.wavelengths)
    panel.plot(
        found.wavelengths, equation, color="black", linewidth=1, linestyle=(0, (4, 4)),
        label=f"order of the period that the thesis names, {1e3 * period:g} nm",
    )  # fmt: skip
    panel.set_xlim(found.wavelengths[[0, -1]])
    low, high = found.surface.angles
    if high - low < 180:
        for angle in (low, high):
            panel.axhline(angle, color="white", linewidth=0.8)
        panel.axhline(np.nan, color="0.7", linewidth=0.8, label="range of the published map")
    panel.set_ylim(max(-90, low - 12), min(90, high + 12))
    if high - low == 180:
        panel.set_yticks(range(-90, 91, 30))
    return image


def plot_brdf_maps(maps: Sequence[Sequence[BRDFMap]]) -> Figure:
    """Plot BRDF maps of one surface and one light, a row for each projection and a column for each method.

    The ticks beside the diffracting axis mark the orders at 450, 550 and 650 nm by the grating equation.
    """
    drawn = figure(2.5 * len(maps[0]) + 0.3, 2.75 * len(maps) + 0.5)
    axes = drawn.subplots(len(maps), len(maps[0]), squeeze=False)
    for row, panels in zip(maps, axes, strict=True):
        for column, (found, panel) in enumerate(zip(row, panels, strict=True)):
            _draw_brdf(panel, found, labelled=column == 0)
    first = maps[0][0]
    theta, phi = first.incidence
    coherence = first.surface.coherence_length
    drawn.suptitle(
        f"{first.surface.name}: light from θ$_i$ = {theta:g}°, φ$_i$ = {phi:g}°, coherent over {coherence:g} µm"
    )
    return drawn


def _draw_brdf(panel: Axes, found: BRDFMap, labelled: bool) -> None:
    half = [(axis[1] - axis[0]) / 2 for axis in (found.x, found.y)]
    extent = (found.x[0] - half[0], found.x[-1] + half[0], found.y[0] - half[1], found.y[-1] + half[1])
    alpha = ~np.isnan(found.rgb[..., 0])
    picture = np.concatenate([found.picture, alpha[..., None]], axis=-1)
    panel.imshow(picture, origin="lower", extent=extent, interpolation="nearest")
    panel.set_title(f"{TITLES[found.method]}, exposure {float(f'{found.exposure:.2g}'):g}", fontsize=9)
    _mark_orders(panel, found)
    panel.tick_params(labelsize=7)
    if found.projection == "hemisphere":
        panel.set_xticks((-90, -45, 0, 45, 90))
        panel.set_yticks((-90, -45, 0, 45, 90))
    if labelled:
        names = {"hemisphere": ("θ$_o$ cos φ$_o$ / °", "θ$_o$ sin φ$_o$ / °"), "uv": ("u", "v")}[found.projection]
        panel.set_xlabel(names[0], fontsize=9)
        panel.set_ylabel(names[1], fontsize=9)
    panel.set_frame_on(False)


def _mark_orders(panel: Axes, found: BRDFMap) -> None:
    """Mark the orders by ticks beside them, which do not cover the colours."""
    across = 1 - found.surface.axis
    size = found.x[-1] - found.x[0]
    for order in (-2, -1, 1, 2):
        for nanometres, tint in ((450.0, "#6677ff"), (550.0, "#33cc33"), (650.0, "#ff4433")):
            position = found.position_of_order(nanometres, order)
            ends = np.stack([position, position])
            ends[:, across] += np.array([0.08, 0.12]) * size
            panel.plot(*ends.T, color=tint, linewidth=1)
            if nanometres == 550 and np.isfinite(position).all():
                position[across] += 0.15 * size
                panel.text(*position, f"{order}", color="0.7", size=7, ha="center", va="center")


PERIOD_COLUMNS = (
    "surface",
    "method",
    "all angles: period ± deviation / nm",
    "published angles",
    "thesis, final text",
    "ridges: period / nm (relative height)",
)


def period_rows(surface: PublishedSurface, maps: Iterable[ReflectanceMap], step: float = 5.0) -> list[list[str]]:
    """Return the fits as rows of `PERIOD_COLUMNS`: available maps, the shader as published and corrected.

    Args:
        surface: of the maps.
        maps: from `reflectance_map`.
        step: between wavelengths of the maps of the corrected shader, which are evaluated here, nm.
    """
    rows = []
    for found in maps:
        name, fits = TITLES[found.method], {"": found}
        if found.method != MODEL:
            corrected = reflectance_map(
                surface,
                found.method,
                incidence=found.incidence,
                wavelengths=wavelengths(step),
                quirks=Quirks.corrected(),
            )
            fits = {", as published": found, ", corrected": corrected}
        for manner, one in fits.items():
            everywhere, there = fit_period(one), fit_period(one, surface.angles)
            final = surface.final.get(found.method) if manner != ", corrected" else None
            bright = [] if one.discrete else ridges(one)[:4]
            numbers = [
                *(f"{fit.mean:.2f} ± {fit.deviation:.2f}" for fit in (everywhere, there)),
                "{:.2f}, {:.2f}".format(*final) if final else "–",
                ", ".join(f"{ridge.period:.0f} ({ridge.height:.2f})" for ridge in bright) or "–",
            ]
            rows.append([surface.name, name + manner, *numbers])
    return rows


def save_figures(
    folder: str | os.PathLike[str],
    *,
    surfaces: Sequence[str] = tuple(SURFACES),
    step: float = 5.0,
    side: int = 200,
    progress: Progress = silent,
) -> None:
    """Evaluate and plot as in chapter 5 of the thesis of 2014, under the current variant of Mitsuba.

    Written atomically: for every surface `viewing_angle_NAME.png` and `brdf_NAME.png`; and the fitted
    periods, `periods.md`.

    Args:
        folder: of the files; created if missing.
        surfaces: names among `published_surfaces.SURFACES`.
        step: between wavelengths, nm.
        side: pixels of a BRDF map.
        progress: called with (figures done, figures in total).

    Raises:
        ValueError: if Mitsuba has no vectorised spectral variant set.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    rows: list[list[str]] = []
    for number, name in enumerate(surfaces):
        surface = SURFACES[name]
        maps = [reflectance_map(surface, method, wavelengths=wavelengths(step)) for method in METHODS]
        rows += period_rows(surface, maps, step)
        save_png(plot_reflectance(maps), folder / f"viewing_angle_{name}.png")
        progress(2 * number + 1, 2 * len(surfaces))
        mapped = surface.with_coherence_length(MAP_COHERENCE[name]) if name in MAP_COHERENCE else surface
        brdf_maps = [
            [brdf_map(mapped, method, projection=projection, side=side) for method in MAP_METHODS]
            for projection in PROJECTIONS
        ]
        save_png(plot_brdf_maps(brdf_maps), folder / f"brdf_{name}.png")
        progress(2 * number + 2, 2 * len(surfaces))
    save_markdown(markdown(PERIOD_COLUMNS, rows, texts=6), folder / "periods.md")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="of the figures and the table; created if missing")
    parser.add_argument(
        "surfaces", nargs="*", metavar="SURFACE", default=list(SURFACES), help=f"of {', '.join(SURFACES)}"
    )
    options = parser.parse_args()
    mi.set_variant(choose_variant(None))
    with progress_bar("figures") as progress:
        save_figures(options.folder, surfaces=options.surfaces, progress=progress)


if __name__ == "__main__":
    main()
