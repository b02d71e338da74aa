"""The map of where scalar theory holds, drawn: `python -m mitsuba_diffraction.validation.scalar_range MAP.png`."""

from __future__ import annotations

import os
import sys
from typing import TYPE_CHECKING

import numpy as np

from .. import gratings
from ..files import whole_file
from ..heightfield import HeightField
from ..scalar_theory import equivalent_depth, error_map, expected_error

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_VISIBLE = (0.4, 0.7)  # µm
# At which end of the line the name stands, where beside it (points), and aligned how.
_LABELS = {
    "blaze": (0, (7, 2), "left"),
    "Elaphe": (1, (-7, -6), "right"),
    "Xenopeltis": (1, (7, -10), "left"),
    "compact disc": (0, (0, 10), "right"),
}
_LEVELS = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5)


def known_surfaces() -> dict[str, tuple[float, float]]:
    """Name → (period, depth of the sinusoid of the same roughness), µm."""
    surfaces: dict[str, tuple[float, HeightField]] = {
        "blaze": (2.5, gratings.blazed(2.5, 0.246)),
        "Elaphe": (1.144, gratings.elaphe(16, seed=1)),
        "Xenopeltis": (1.552, gratings.xenopeltis(16, seed=1)),
        "compact disc": (1.6, gratings.compact_disc()),
    }
    return {name: (period, equivalent_depth(field.heights.std())) for name, (period, field) in surfaces.items()}


def draw_map() -> Figure:
    """Error over period/λ and depth/λ; known surfaces are lines from 400 to 700 nm."""
    from matplotlib.figure import Figure

    periods, depths, _, _ = error_map()
    x = np.geomspace(periods[0], periods[-1], 160)
    y = np.geomspace(depths[0], depths[-1], 120)
    errors = np.array([[expected_error(period, depth, 1.0) for period in x] for depth in y])
    figure = Figure(figsize=(7.2, 5.2), layout="constrained")
    axes = figure.add_subplot()
    shown = axes.pcolormesh(x, y, np.log10(errors), cmap="YlOrRd", vmin=-2.7, vmax=0.3, rasterized=True)
    lines = axes.contour(x, y, errors, levels=_LEVELS, colors="black", linewidths=0.8)
    axes.clabel(lines, fmt=lambda level: f"{100 * level:g} %", fontsize=9, inline_spacing=2)
    for name, (period, depth) in known_surfaces().items():
        ends = np.array(_VISIBLE)
        axes.plot(period / ends, depth / ends, color="white", linewidth=4.5, solid_capstyle="round")
        axes.plot(period / ends, depth / ends, color="#08519c", linewidth=2.5, solid_capstyle="round")
        end, offset, side = _LABELS[name]
        axes.annotate(
            name,
            (period / _VISIBLE[end], depth / _VISIBLE[end]),
            xytext=offset,
            textcoords="offset points",
            ha=side,
            va="center",
            color="#08519c",
            fontsize=10,
            fontweight="bold",
        )
    axes.set(xscale="log", yscale="log", xlabel="period / wavelength", ylabel="depth / wavelength")
    axes.set_xticks([1, 2, 3, 5, 10, 20], [*map(str, (1, 2, 3, 5, 10, 20))], minor=False)
    axes.set_yticks([0.05, 0.1, 0.2, 0.5, 1, 2], [*map(str, (0.05, 0.1, 0.2, 0.5, 1, 2))], minor=False)
    axes.minorticks_off()
    axes.set_title(
        "Error of scalar theory: sinusoid, n = 1.5, incidence 0° to 20°, unpolarised\n"
        "blue: known surfaces, from 700 nm (lower left) to 400 nm (upper right)",
        fontsize=10,
    )
    bar = figure.colorbar(shown, label="error, share of the reflected light", ticks=np.log10([0.005, *_LEVELS, 1]))
    bar.ax.set_yticklabels(["0.5 %", *(f"{100 * level:g} %" for level in _LEVELS), "100 %"])
    return figure


def save_map(path: str | os.PathLike[str]) -> None:
    """Write the map as a PNG, whole or not at all."""
    with whole_file(path) as temporary:
        draw_map().savefig(temporary, dpi=130)


if __name__ == "__main__":
    save_map(sys.argv[1] if len(sys.argv) > 1 else "scalar_theory.png")
