"""The figure of a comparison: pictures, the same close-up of each, the difference of each, and its causes."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter

from ...files.outputs import METADATA
from ...files.writing import whole_file
from ...optics.color import XYZ_to_linear_sRGB, into_gamut, on_screen
from .side_by_side import Comparison
from .summary import CAUSES, titles

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_WIDTH, _GAP, _DPI = 16.0, 0.12, 100  # inches
_TITLE, _TEXT = 24, 19  # points; the figure is still read at a quarter of its size
_CLOSE_UP = 0.3  # of the width and height of a picture
_MAX_CAUSES = 6


def shown(comparison: Comparison, name: str) -> NDArray[np.uint8]:
    """Return a picture of the comparison for a display, at its exposure: (height, width, 3).

    Diffraction alone is on black, as in the published pictures.
    """
    found = comparison.to_path_traced.get(name)
    exposure = (1 if found is None else found.exposure) / comparison.white
    xyz = comparison.pictures[name].xyz * exposure
    if not comparison.pigment:
        xyz = np.where(comparison.mask[..., None], xyz, 0)
    return on_screen(into_gamut(XYZ_to_linear_sRGB(xyz)))


def close_up(picture: NDArray[np.uint8]) -> tuple[slice, slice]:
    """Return the window of a picture (height, width, 3) that is most colourful, by the range of the channels."""
    size = [min(length, max(2, round(_CLOSE_UP * length))) for length in picture.shape[:2]]
    colour = uniform_filter(np.ptp(picture, axis=-1).astype(float), size, mode="constant")
    row, column = np.unravel_index(int(colour.argmax()), colour.shape)
    starts = [
        int(np.clip(middle - length // 2, 0, whole - length))
        for middle, length, whole in zip((row, column), size, picture.shape[:2], strict=True)
    ]
    return slice(starts[0], starts[0] + size[0]), slice(starts[1], starts[1] + size[1])


def _difference(comparison: Comparison, name: str) -> tuple[NDArray[np.float64], float, str]:
    """Return a map of CIEDE2000, its mean, and what it is, for the column of a picture.

    Of the shader the difference from this model in the same light; of the path-traced picture, what this model lacks in
    that light.
    """
    if name == "path_traced":
        found = comparison.to_path_traced["same_light"]
        return found.delta_e, found.mean, "left out by any such shader: sky,\nand light between surfaces"
    found = comparison.to_same_light[name]
    if name == "published":
        return found.delta_e, found.mean, "what it gets wrong"
    if name == "corrected":
        return found.delta_e, found.mean, "what remains"
    corrected = comparison.to_same_light[name.removesuffix("published") + "corrected"]
    return found.delta_e, found.mean, f"what it gets wrong\n({corrected.mean:.1f} if corrected)"


def _title(comparison: Comparison, name: str) -> str:
    if name == "path_traced":
        return "path traced"
    of = {"published": "published", "corrected": "corrected"}
    title = titles(comparison)[name]
    return f"shader ({title.split()[0]}), {of[name]}" if name in of else title


def comparison_figure(comparison: Comparison, *, others: bool = False) -> Figure:
    """Plot the path-traced picture and the shader as published and corrected, or the other shaders as published.

    Below each are the same close-up and a map of the difference, below all the causes, where they were measured.
    """
    from matplotlib.figure import Figure
    from matplotlib.patches import Rectangle

    names = [f"{kind}_published" for kind in comparison.others] if others else ["path_traced", "published", "corrected"]
    columns = max(3, len(names))
    width = (_WIDTH - (columns + 1) * _GAP) / columns
    height = width * comparison.mask.shape[0] / comparison.mask.shape[1]
    costs = None if others else comparison.costs
    causes = [] if costs is None else sorted(costs.visible(), key=lambda name: -costs.quirks[name].rise)
    causes = causes[:_MAX_CAUSES]
    bars = 0.42 * len(causes) + 0.6 if causes else 0.0
    total = 0.6 + 3 * height + 2 * _GAP + 1.5 + bars
    result = Figure(figsize=(_WIDTH, total))

    def panel(column: int, top: float, wide: float = width, high: float = height) -> Axes:
        left = _GAP + column * (width + _GAP)
        axes = result.add_axes((left / _WIDTH, 1 - (top + high) / total, wide / _WIDTH, high / total))
        axes.set(xticks=[], yticks=[])
        axes.spines[:].set_visible(False)
        return axes

    window = close_up(shown(comparison, "path_traced"))
    found = [_difference(comparison, name) for name in names]
    limit = max(2.0, float(np.ceil(np.nanpercentile(_difference(comparison, "published")[0], 95))))
    tops = 0.6 + (height + _GAP) * np.arange(3)
    for column, (name, (delta_e, mean, words)) in enumerate(zip(names, found, strict=True)):
        picture = shown(comparison, name)
        axes = panel(column, tops[0])
        axes.imshow(picture)
        axes.set_title(_title(comparison, name), fontsize=_TITLE, parse_math=False)
        rows, lines = window
        corner, size = (lines.start, rows.start), (lines.stop - lines.start, rows.stop - rows.start)
        axes.add_patch(Rectangle(corner, *size, fill=False, edgecolor="white", linewidth=1.5))
        panel(column, tops[1]).imshow(picture[window], interpolation="bicubic")
        axes = panel(column, tops[2])
        image = axes.imshow(delta_e, cmap="inferno", vmin=0, vmax=limit, interpolation="nearest")
        axes.set_facecolor("0.88")
        axes.text(0.03, 0.94, f"{mean:.1f}", fontsize=1.4 * _TITLE, weight="bold", va="top", transform=axes.transAxes)
        axes.set_xlabel(words, fontsize=_TEXT)
    below = tops[2] + height + 0.85
    bar = result.colorbar(image, cax=panel(0, below, width, 0.16), orientation="horizontal", extend="max")
    bar.set_ticks(ticks := [0, limit / 2, limit], labels=[f"{tick:g}" for tick in ticks])
    bar.ax.tick_params(labelsize=_TEXT)
    words = "difference of colour, CIEDE2000, and its mean"
    result.text((width + 3 * _GAP) / _WIDTH, 1 - (below + 0.08) / total, words, fontsize=_TEXT, va="center")
    if costs is not None and causes:
        axes = panel(0, below + 1.15, _WIDTH, bars - 0.7)
        box = axes.get_position()
        axes.set_position((0.27, box.y0, 0.62, box.height))
        values = [costs.quirks[name].rise for name in causes]
        axes.bar_label(axes.barh(range(len(causes)), values, color="C0"), fmt="%.1f", fontsize=_TEXT, padding=6)
        axes.set_yticks(range(len(causes)), [CAUSES[name] for name in causes], fontsize=_TEXT)
        axes.tick_params(axis="y", length=0)
        axes.invert_yaxis()
        axes.set_xlim(min(0.0, *values), max(1.0, *values))  # so that noise does not look like an effect
        axes.set_title(
            "why: what each deviation alone adds to the corrected shader (together, they damp each other)",
            fontsize=_TEXT,
        )
    return result


def save_figure(comparison: Comparison, path: str | os.PathLike[str], *, others: bool = False) -> None:
    """Write `comparison_figure` as PNG, atomically."""
    with whole_file(path) as temporary:
        figure = comparison_figure(comparison, others=others)
        figure.savefig(temporary, format="png", dpi=_DPI, metadata=METADATA)
