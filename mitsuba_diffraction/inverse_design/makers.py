"""Files for makers of a relief: a mesh, the layers of its levels, and the master of a mould."""

from __future__ import annotations

import errno
import os
from pathlib import Path
from typing import Any

import numpy as np

from ..array_types import Real
from ..errors import RequestError, pip_install
from ..files.outputs import MARK
from ..files.writing import whole_file
from ..surface.heightfield import HeightField
from .output import simple_field
from .result import Design

_STL_FACE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_END_OF_GDS = bytes([0, 4, 4, 0])  # the record ENDLIB
_MAX_LAYER = 2**15 - 1  # a layer is two bytes with a sign
_BASE = 1.0  # µm, of the solid below the lowest point


def save_stl(field: HeightField, path: str | os.PathLike[str]) -> None:
    """Write one period as a closed solid, a binary STL in µm: the relief over pixel centres, on a base of 1 µm.

    The first row and column are repeated at the end, so that periods fit each other.
    """
    heights = np.pad(field.heights - field.heights.min() + _BASE, ((0, 1), (0, 1)), mode="wrap")
    axes = [np.arange(n) * size for n, size in zip(heights.shape, field.pixel_size[::-1], strict=True)]
    y, x = np.meshgrid(*axes, indexing="ij")
    top, bottom = np.stack([x, y, heights], axis=-1), np.stack([x, y, np.zeros_like(x)], axis=-1)
    strips = [np.stack([low, high]) for low, high in ((bottom[0], top[0]), (top[-1], bottom[-1]))]
    strips += [np.stack([low, high]) for low, high in ((top[:, 0], bottom[:, 0]), (bottom[:, -1], top[:, -1]))]
    corners = np.concatenate([_triangles(grid) for grid in (top, bottom[::-1], *strips)])
    faces = np.zeros(len(corners), _STL_FACE)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    faces["normal"] = normals / np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-30)
    faces["corners"] = corners
    header = f"{MARK}; one period, um".encode("ascii").ljust(80)
    with whole_file(path) as temporary:
        temporary.write_bytes(header + np.uint32(len(faces)).astype("<u4").tobytes() + faces.tobytes())


def _triangles(points: Real) -> Real:
    """Return the two triangles of each cell of a grid of points, (rows, columns, 3): (n, 3, 3)."""
    a, b, c, d = points[:-1, :-1], points[:-1, 1:], points[1:, 1:], points[1:, :-1]
    return np.concatenate([np.stack(corners, axis=-2).reshape(-1, 3, 3) for corners in ((a, b, c), (a, c, d))])


def save_gds(design: Design, path: str | os.PathLike[str]) -> None:
    """Write the texels of one period as GDSII in µm: texels of level k on layer k, none for level 0.

    Raises:
        ValueError: as `check_gds`.
    """
    gdstk, levels = check_gds(design.plate.levels)
    library = gdstk.Library(name="RELIEF", unit=1e-6, precision=1e-9)
    cell, texel = library.new_cell("PERIOD"), design.plate.texel
    steps = np.rint(design.texels / design.plate.height_range * (levels - 1)).astype(int)
    for row, line in enumerate(steps):
        starts = np.flatnonzero(np.diff(line, prepend=-1))
        for start, end in zip(starts, [*starts[1:], len(line)], strict=True):
            if line[start] > 0:
                corners = (start * texel, row * texel), (end * texel, (row + 1) * texel)
                cell.add(gdstk.rectangle(*corners, layer=int(line[start])))
    cell.add(gdstk.Label(MARK, (0, 0), layer=0))
    with whole_file(path) as temporary:
        library.write_gds(temporary)
        if not temporary.read_bytes().endswith(_END_OF_GDS):  # gdstk ignores a full disk
            raise OSError(errno.EIO, "only a part could be written; the disk may be full")


def check_gds(levels: int | None) -> tuple[Any, int]:
    """Return gdstk and the number of levels.

    Raises:
        ValueError: if the heights are not levels, or more than there are layers, or gdstk is not installed.
    """
    if levels is None:
        raise RequestError("levels: got none, and gds has a layer for each, wanted their number")
    if levels > _MAX_LAYER + 1:
        raise RequestError(f"levels: got {levels}, wanted at most {_MAX_LAYER + 1} for gds, one for each layer")
    try:
        import gdstk
    except ModuleNotFoundError:
        raise RequestError(f"export: gdstk is not installed; {pip_install('gds')}") from None
    return gdstk, levels


def save_master(design: Design, path: str | os.PathLike[str]) -> None:
    """Write the master of a mould as .gsf: its copies, turned over, are the relief."""
    field = design.height_field
    heights = design.plate.height_range - field.heights[:, ::-1]
    master = HeightField(heights, field.pixel_size, f"master of {field.source}")
    with whole_file(path) as temporary:
        temporary.write_bytes(simple_field(master))


EXPORTS = {
    "stl": (".stl", "one period as a closed solid, in µm, on a base of 1 µm"),
    "gds": (".gds", "one period, the texels of level k on layer k"),
    "master": ("_master.gsf", "the master of a mould, mirrored and upside down"),
}
"""By name: how its file ends, and what is in it."""


def export_paths(names: list[str], path: Path) -> dict[str, Path]:
    """Return the file of each export beside the relief in `path`.

    Raises:
        ValueError: on an unknown name.
    """
    if unknown := [name for name in names if name not in EXPORTS]:
        raise RequestError(f"export: got {unknown[0]!r}, wanted one of {', '.join(EXPORTS)}")
    return {name: path.with_name(path.stem + EXPORTS[name][0]) for name in dict.fromkeys(names)}


def export(design: Design, paths: dict[str, Path]) -> None:
    """Write the files of `export_paths`."""
    for name, path in paths.items():
        if name == "stl":
            save_stl(design.height_field, path)
        elif name == "gds":
            save_gds(design, path)
        else:
            save_master(design, path)
