"""The files of a design: the relief as .gsf and 16-bit TIFF, its recipe, and a picture of what it casts."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image

from ..files.outputs import MARK, METADATA
from ..files.writing import encoded_file, whole_file
from ..optics.color import into_gamut, on_screen, plain_view
from ..settings import VISIBLE, ScalarSettings
from ..surface.heightfield import HeightField
from .result import Design

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SUFFIXES = (".gsf", ".tif", ".toml", ".png")
_IMAGE_DESCRIPTION, _RESOLUTION, _RESOLUTION_UNIT, _SOFTWARE = 270, (282, 283), 296, 305  # tags of TIFF
_TO_ASCII = {ord("µ"): "u", ord("×"): "x"}  # of which tags of TIFF consist
_RECIPE_TOLERANCE = 0.01  # of the recipe; finer tables take minutes, for differences that no picture shows
_PLOTTED_WAVELENGTHS = np.arange(400.0, 701.0, 10.0)  # nm


def save(design: Design, path: str | os.PathLike[str]) -> tuple[Path, ...]:
    """Write the files of a design, which have the name of `path` and the `SUFFIXES`; return their paths.

    Row 0 of the relief is at the lowest y, as in all files that the package reads. White (65535) of the TIFF is
    `height_range` of the design; its description says so.

    Raises:
        FileNotFoundError: if the folder does not exist.
    """
    paths = tuple(Path(path).with_suffix(suffix) for suffix in SUFFIXES)
    field, plate = design.height_field, design.plate
    with whole_file(paths[0]) as temporary:
        temporary.write_bytes(simple_field(field))
    save_tiff(field, plate.height_range, paths[1])
    with whole_file(paths[2]) as temporary:
        temporary.write_text(_recipe(design, paths[0].name), encoding="utf-8")
    save_design_picture(design, paths[3])
    return paths


def _recipe(design: Design, scan: str) -> str:
    """Return the contents of the recipe of a relief in the file `scan`."""
    plate, deepest = design.plate, float(f"{np.ptp(design.height_field.heights) * 1.01:.3g}")
    settings = {
        "extent": '"tile"',
        "coherence_length": f"{plate.coherence_length:.6g}",
        "tolerance": f"{_RECIPE_TOLERANCE}",
        **({} if plate.light == VISIBLE else {"wavelengths": f"[{plate.light[0]:.1f}, {plate.light[1]:.1f}]"}),
        **({"largest_height_range": f"{deepest}"} if deepest > ScalarSettings().largest_height_range else {}),
    }
    lines = [f"{name} = {value}" for name, value in settings.items()]
    head = f'# {MARK}: {design.height_field.source}\n[surface]\nscan = "{scan}"\n\n[spectrum]\n'
    return head + "\n".join(lines) + "\n"


def save_tiff(field: HeightField, height_range: float, path: str | os.PathLike[str]) -> None:
    """Write heights as a 16-bit TIFF, `height_range` in µm from black to white.

    Its scale is in the tags of the resolution, in pixels per cm, and in the description as ImageJ writes it: `unit` of
    lengths, and a straight line from grey levels to heights, c₀ + c₁ g in `vunit`.
    """
    counts = np.rint(field.heights / height_range * 65535).astype(np.uint16)
    description = (
        f"ImageJ=1.54f\nunit=cm\ncf=0\nc0=0\nc1={height_range / 65535:.10g}\nvunit=um\nmin=0\nmax=65535\n"
        f"pixel_um={field.pixel_size[0]:.9g}\nheight_range_um={height_range:g}\nrows=from the lowest y\n"
        f"source={field.source.translate(_TO_ASCII)}\n"
    )
    tags = {
        _IMAGE_DESCRIPTION: description,
        _SOFTWARE: MARK,
        _RESOLUTION_UNIT: 3,  # cm
        **{tag: 1e4 / size for tag, size in zip(_RESOLUTION, field.pixel_size, strict=True)},
    }
    with encoded_file(path) as stream:
        Image.fromarray(counts).save(stream, "TIFF", tiffinfo=tags)


def simple_field(field: HeightField) -> bytes:
    """Return the contents of a Gwyddion Simple Field."""
    rows, columns = field.shape
    width, height = (f"{1e-6 * length:.9g}" for length in field.tile_size)
    header = (
        f"Gwyddion Simple Field 1.0\nXRes = {columns}\nYRes = {rows}\nXReal = {width}\nYReal = {height}\n"
        f"XYUnits = m\nZUnits = m\nTitle = {field.source}\nComment = {MARK}\n"
    ).encode()
    padding = b"\0" * (4 - len(header) % 4)
    return header + padding + (1e-6 * field.heights).astype("<f4").tobytes()


def save_design_picture(design: Design, path: str | os.PathLike[str]) -> None:
    """Write target, predicted picture, relief and efficiency over wavelength as one PNG."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12, 3.4), dpi=150, layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(1, 4, width_ratios=(1, 1, 1.15, 1.1))
    edge = float(design.plate.edges(1)[1])
    difference = design.colour_difference
    title = "predicted" if np.isnan(difference) else f"predicted, ΔE00 {difference:.1f}"
    right = -edge if design.plate.mirrored else edge
    for axes, name, light in zip(panels[:2], ("target", title), design.seen, strict=True):
        axes.imshow(on_screen(into_gamut(light), plain_view), extent=(-right, right, -edge, edge), origin="lower")
        axes.set(title=name, xlabel="direction, x", ylabel="direction, y")
    field = design.height_field
    image = panels[2].imshow(field.heights, extent=(0, field.tile_size[0], 0, field.tile_size[1]), origin="lower")
    figure.colorbar(image, ax=panels[2])
    panels[2].set(title="relief, heights in µm", xlabel="x, µm", ylabel="y, µm")
    _plot_efficiency(panels[3], design)
    with whole_file(path) as temporary:
        figure.savefig(temporary, metadata=METADATA)


def _plot_efficiency(axes: Axes, design: Design) -> None:
    own, plotted = design.wavelengths, _PLOTTED_WAVELENGTHS
    if not (own.min() >= VISIBLE[0] and own.max() <= VISIBLE[1]):
        plotted = own.mean() * np.linspace(0.8, 1.2, 31)
    axes.plot(plotted, 100 * design.in_picture(design.efficiencies(plotted), plotted), color="black")
    axes.plot(own, 100 * design.in_picture(design.efficiency), "o", color="black", ms=4)
    axes.set(title="light in the picture", xlabel="wavelength, nm", ylabel="% of usable light", ylim=(0, 100))
