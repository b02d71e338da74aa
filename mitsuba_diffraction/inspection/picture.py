"""An inspection on one slide: the surface, its spectrum, and its predicted colours."""

from __future__ import annotations

import os
import textwrap
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..array_types import Real
from ..errors import RequestError
from ..files.outputs import METADATA
from ..files.writing import whole_file
from ..optics.color import auto_exposure, into_gamut, on_screen, radiance_to_linear_sRGB
from ..surface.heightfield import HeightField
from ..surface.periods import hann, repeated, with_uncertainty
from .predicted_colours import WAVELENGTHS, radiance
from .properties import Inspection, reference_plane

if TYPE_CHECKING:
    from matplotlib.axes import Axes


INCIDENCES = (0.0, 30.0, 60.0)  # degrees, of the rows of predicted colours
_MAX_BINS = 181  # of the spectrum along an axis
_ANGLES = np.arange(-89.75, 89.8, 0.5)
_MAX_FREQUENCY = 5.0  # cycles/µm, about the limit of visible light
_DECADES = 5


def save_picture(inspection: Inspection, path: str | os.PathLike[str], *, title: str | None = None) -> None:
    """Write a slide, 16 : 9, as PNG, PDF or SVG; the default title is the source of the heights.

    Raises:
        ValueError: if matplotlib knows no format of that ending.
        FileNotFoundError: if the folder does not exist.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12.8, 7.2), dpi=150)
    kinds = FigureCanvasAgg(figure).get_supported_filetypes()
    if Path(path).suffix.lower().removeprefix(".") not in kinds:
        raise RequestError(f"picture: got {os.fspath(path)!r}, wanted a file name that ends in .png, .pdf or .svg")
    source = inspection.height_field.source
    heading = textwrap.shorten(title or source, 80, placeholder=" …")
    figure.text(0.04, 0.95, heading, fontsize=17, weight="bold", va="center", parse_math=False)
    below = [] if title in (None, source) else [textwrap.shorten(source, 150, placeholder=" …")]
    below.append(_headline(inspection))
    figure.text(0.04, 0.927, "\n".join(below), fontsize=11, color="0.25", va="top", linespacing=1.35, parse_math=False)
    top = {"top": 0.82, "bottom": 0.41}
    left, middle, right = (
        figure.add_gridspec(1, 1, left=start, right=end, **top)[0]
        for start, end in ((0.04, 0.27), (0.43, 0.665), (0.705, 0.985))
    )
    lower = figure.add_gridspec(len(INCIDENCES), 1, top=0.285, bottom=0.085, hspace=0.16, left=0.115, right=0.985)
    _height_map(figure.add_subplot(left), piece_shown(inspection), inspection.extent)
    _spectrum(figure.add_subplot(middle), inspection)
    _facts(figure.add_subplot(right), inspection)
    _colours([figure.add_subplot(row) for row in lower], inspection)
    with whole_file(path) as temporary:
        figure.savefig(temporary, metadata=METADATA)


def _headline(inspection: Inspection) -> str:
    x, y = inspection.height_field.tile_size
    rows, columns = inspection.height_field.shape
    d_x, d_y = (p * 1e3 for p in inspection.height_field.pixel_size)
    pixel = f"{d_x:.4g}" if np.isclose(d_x, d_y, rtol=1e-3) else f"{d_x:.4g} × {d_y:.4g}"
    kind = "one tile of a surface that repeats, " if inspection.extent == "tile" else ""
    return f"{kind}{x:.3g} × {y:.3g} µm, {columns} × {rows} pixels of {pixel} nm"


def _height_map(axes: Axes, field: HeightField, extent: str) -> None:
    """Plot heights about the mean plane, +y upwards, with a scale bar in place of axes."""
    field = _square_cut(field)
    size_x, size_y = field.tile_size
    level = (field.heights - reference_plane(field, extent)[0]) * 1e3
    low, high = np.quantile(level, [0.002, 0.998])
    image = axes.imshow(
        level,
        extent=(0, size_x, 0, size_y),
        origin="lower",
        cmap="cividis",
        vmin=low,
        vmax=max(high, low + 1e-3),
        aspect="equal",
        interpolation="nearest",
    )
    axes.set(xticks=[], yticks=[], anchor="NW", xlabel="x →", ylabel="y →")
    axes.set_title("The surface", fontsize=12, loc="left")
    bar = axes.figure.colorbar(image, cax=axes.inset_axes([1.03, 0, 0.05, 1]))
    bar.set_label("height, nm", fontsize=10)
    bar.ax.tick_params(labelsize=9)
    length = _round_length(size_x / 4)
    y = size_y * 0.06
    box = {"facecolor": "black", "alpha": 0.6, "edgecolor": "none", "pad": 3}
    axes.plot([size_x * 0.05, size_x * 0.05 + length], [y, y], color="white", lw=4, solid_capstyle="butt")
    axes.text(size_x * 0.05, y + size_y * 0.04, f"{length:g} µm", color="white", fontsize=11, va="bottom", bbox=box)


def _shown(inspection: Inspection) -> HeightField:
    """Return the surface, a tile repeated, and a profile extended along its axis of one pixel to a square."""
    field, shape = inspection.height_field, inspection.height_field.shape
    if inspection.extent == "tile":
        field = repeated(field)
    for axis in (0, 1):
        if shape[axis] == 1 < shape[1 - axis]:
            count = min(field.shape[1 - axis], 256)
            sizes = list(field.pixel_size)
            sizes[1 - axis] = field.tile_size[axis] / count
            profile = np.take(field.heights, [0], axis)
            return HeightField(np.repeat(profile, count, axis), (sizes[0], sizes[1]), field.source)
    return field


def piece_shown(inspection: Inspection) -> HeightField:
    """Return a piece of a periodic surface: a dozen of the shortest periods, but at least four of the longest."""
    field = _shown(inspection)
    if inspection.extent == "sample" or not inspection.periods:
        return field
    lengths = [period.period for period in inspection.periods]
    side = max(12 * min(lengths), 4 * max(lengths))
    columns, rows = (max(1, round(side / pixel)) for pixel in field.pixel_size)
    return HeightField(field.heights[:rows, :columns], field.pixel_size, field.source)


def _square_cut(field: HeightField) -> HeightField:
    """Crop a long patch to at most twice its width."""
    rows, columns = field.shape
    size_x, size_y = field.tile_size
    rows = min(rows, max(1, int(rows * 2 * size_x / size_y)))
    columns = min(columns, max(1, int(columns * 2 * size_y / size_x)))
    return HeightField(field.heights[:rows, :columns], field.pixel_size, field.source)


def _round_length(length: float) -> float:
    """Return the largest 1, 2 or 5 times a power of ten that does not exceed a length."""
    power = 10.0 ** np.floor(np.log10(length))
    return float(max(step * power for step in (1, 2, 5) if step * power <= length * (1 + 1e-9)))


def _spectrum(axes: Axes, inspection: Inspection) -> None:
    """Plot the power spectrum of the levelled heights under a Hann window, in which a wave is a pair of spots."""
    field = _shown(inspection)
    level = field.heights - reference_plane(field, inspection.extent)[0]
    power = np.fft.fftshift(np.abs(np.fft.fft2(level * hann(level.shape))) ** 2)
    q_y, q_x = (np.fft.fftshift(np.fft.fftfreq(n, p)) for n, p in zip(level.shape, field.pixel_size[::-1], strict=True))
    limit = min(_MAX_FREQUENCY, max(q_x.max(), q_y.max()))
    if inspection.periods:
        limit = min(limit, 4.5 / inspection.periods[0].period)
    near_x, near_y = np.abs(q_x) <= limit, np.abs(q_y) <= limit
    q_x, q_y, power = _strongest(q_x[near_x], q_y[near_y], power[np.ix_(near_y, near_x)])
    top = power.max()
    decibel = np.log10(np.maximum(power / top, 10.0**-_DECADES)) if top > 0 else np.full_like(power, -_DECADES)
    axes.pcolormesh(q_x, q_y, decibel, cmap="magma", vmin=-_DECADES, vmax=0, shading="nearest", rasterized=True)
    axes.set(xlim=(-limit, limit), ylim=(-limit, limit), aspect="equal", facecolor="black")
    axes.set_xlabel("cycles/µm along x", fontsize=10)
    axes.set_ylabel("cycles/µm along y", fontsize=10)
    axes.tick_params(labelsize=9)
    axes.set_title("Its spectrum: spots are regular waves", fontsize=12, loc="left")
    # Labels are at spots of opposite sign, so that they do not overlap.
    for period, colour, spot in zip(inspection.periods, ("cyan", "lime"), (1, -1), strict=False):
        for sign in (1, -1):
            axes.plot(*(sign * period.q), "o", ms=13, mfc="none", mec=colour, mew=1.8, zorder=4)  # above all labels
        x, y = spot * period.q
        # Outwards, except near the edge of the plot.
        side = (-1 if x < -0.02 * limit else 1) * (-1 if abs(x) > 0.6 * limit else 1)
        axes.annotate(
            f"{period.period:.3g} µm",
            (x, y),
            xytext=(side * 10, 10 if y >= 0 else -20),
            textcoords="offset points",
            ha="left" if side > 0 else "right",
            color=colour,
            fontsize=11,
            bbox={"facecolor": "black", "alpha": 0.6, "edgecolor": "none", "pad": 2},
        )


def _strongest(q_x: Real, q_y: Real, power: Real) -> tuple[Real, Real, Real]:
    """Return the largest power in each bin of a coarser grid, as a single peak would be smaller than a pixel."""
    bins = []
    for axis, q in enumerate((q_x, q_y)):
        starts = np.unique(np.linspace(0, len(q), min(len(q), _MAX_BINS), endpoint=False).astype(int))
        bins.append(np.add.reduceat(q, starts) / np.diff([*starts, len(q)]))
        power = np.maximum.reduceat(power, starts, axis=1 - axis)
    return bins[0], bins[1], power


def _facts(axes: Axes, inspection: Inspection) -> None:
    """Write the most important numbers."""
    axes.set_axis_off()
    axes.set_title("In numbers", fontsize=12, loc="left")
    numbers = inspection.statistics
    lines = [
        ("roughness Sq", f"{numbers.Sq * 1e3:.3g} nm"),
        ("highest to lowest, Sz", f"{numbers.Sz * 1e3:.3g} nm"),
        ("slope, r.m.s.", f"{np.degrees(np.arctan(numbers.Sdq)):.2g}°"),
    ]
    for number, period in enumerate(inspection.periods):
        lines.append(
            (
                "period" if number == 0 else "second period",
                with_uncertainty(period.period, period.period_uncertainty) + " µm",
            )
        )
        lines.append(("   direction", with_uncertainty(period.direction, period.direction_uncertainty) + "°"))
    if not inspection.periods:
        lines.append(("period", "none stands out"))
    if inspection.extent == "sample":
        lines.append(("coherence length at most", f"{inspection.max_coherence_length:.3g} µm"))
    y = 0.95
    for name, value in lines:
        axes.text(0.0, y, name, fontsize=11.5, color="0.3", va="center", transform=axes.transAxes)
        axes.text(1.0, y, value, fontsize=11.5, weight="bold", va="center", ha="right", transform=axes.transAxes)
        y -= 0.095
    text = (
        "A spot q cycles/µm from the centre sends light\nof wavelength λ to sin(out) = sin(in) ± q·λ:\n"
        "red is deflected most, blue least."
    )
    axes.text(0.0, 0.0, text, fontsize=10.5, color="0.3", va="bottom", linespacing=1.4, transform=axes.transAxes)


def _colours(rows: list[Axes], inspection: Inspection) -> None:
    """Plot one strip for each angle of incidence, its specular direction marked."""
    radiances = radiance(inspection.spectrum, inspection.direction, np.array(INCIDENCES)[:, None], _ANGLES)
    rgb = into_gamut(radiance_to_linear_sRGB(radiances, WAVELENGTHS))
    # Exposed without the specular direction, which would make the rest black.
    off_specular = [strip[np.abs(_ANGLES - incidence) > 5] for strip, incidence in zip(rgb, INCIDENCES, strict=True)]
    shown = on_screen(rgb * auto_exposure(np.concatenate(off_specular)))
    for axes, strip, incidence in zip(rows, shown, INCIDENCES, strict=True):
        axes.imshow(strip[None], extent=(-90, 90, 0, 1), aspect="auto", interpolation="bilinear")
        axes.set(xlim=(-90, 90), xticks=np.arange(-90, 91, 30), xticklabels=[], yticks=[])
        axes.set_ylabel(f"light at {incidence:g}°", rotation=0, ha="right", va="center", fontsize=10.5)
        axes.plot([incidence], [1.0], marker="v", ms=9, color="black", clip_on=False)
    rows[-1].tick_params(labelsize=9.5)
    rows[-1].set_xticklabels([f"{angle}°".replace("-", "−") for angle in range(-90, 91, 30)])
    rows[-1].set_xlabel(
        "viewing angle from the surface's normal, across the lines (positive: opposite to the light)",
        fontsize=10,
    )
    plane = f"at {round(inspection.direction) + 0:d}° from x".replace("-", "−") if inspection.periods else "along x"
    rows[0].set_title(
        f"Predicted colours in daylight, in the plane {plane}   (▼ mirror direction)",
        fontsize=12,
        loc="left",
        pad=9,
    )
