"""Images of JPK in HDF5 (.h5-jpk), read by h5py, which SurfaceTopography brings.

/Measurement_000 has the grid, in attributes `position-pattern.grid.*`: `ilength` pixels on `ulength` along a line,
`jlength` lines on `vlength`. Its groups Channel_000, … hold a matrix of integers, (pixels, frames), whose lines start
at the bottom of the image unless the grid is reflected; `net-encoder.scaling` has their unit.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ...errors import RequestError
from ...files.reading import check_array
from . import hdf5, scan
from .scan import Channel, Scan, choose_channel

if TYPE_CHECKING:
    import h5py

_GRID, _SCALING = "position-pattern.grid", "net-encoder.scaling"


def read_h5_jpk(path: Path, unit: str | tuple[str, str] | None, channel: str | int | None) -> Scan:
    """Read the first frame of one channel; the top row of its image is row 0."""
    try:
        with hdf5.opened(path) as file:
            return _scan(file["Measurement_000"], unit, channel, path.stat().st_size)
    except RequestError:
        raise
    except Exception as error:  # as of `read_instrument`
        raise RequestError(f"a damaged file of JPK, or not one ({type(error).__name__}: {error})") from None


def _scan(measurement: h5py.Group, unit: str | tuple[str, str] | None, channel: str | int | None, stored: int) -> Scan:
    groups = [measurement[name] for name in sorted(measurement) if name.startswith("Channel_")]
    units = [_text(group, f"{_SCALING}.unit.unit") for group in groups]
    named = zip(map(_name, groups), units, strict=True)
    channels = [Channel(number, name, scan.is_length(own)) for number, (name, own) in enumerate(named)]
    chosen = choose_channel(channels, channel)
    group, grid = groups[chosen.number], measurement.attrs
    columns, rows = (int(grid[f"{_GRID}.{name}"]) for name in ("ilength", "jlength"))
    matrix = next(group[name] for name in group if name != "thumbnail")
    frames = matrix.shape[1]
    if matrix.shape[0] != rows * columns or not matrix.size:
        raise RequestError(f"got {matrix.shape[0]} pixels in {frames} frames, wanted {columns} × {rows}")
    check_array((rows, columns), stored)
    multiplier, offset = (float(group.attrs[f"{_SCALING}.{name}"]) for name in ("multiplier", "offset"))
    heights = (multiplier * np.asarray(matrix[:, 0], np.float64) + offset).reshape(rows, columns)
    if _text(measurement, f"{_GRID}.reflect") != "true":
        heights = heights[::-1]
    along = scan.micrometres(_text(measurement, f"{_GRID}.unit.unit"), "the grid")
    high = scan.scale_of_heights(units[chosen.number], unit)
    width, length = (float(grid[f"{_GRID}.{name}"]) * along for name in ("ulength", "vlength"))
    name = chosen.name + (f", frame 1 of {frames}" if frames > 1 else "")
    return Scan(heights * high, (width / columns, length / rows), name)


def _name(group: h5py.Group) -> str:
    retrace = " (retrace)" if _text(group, "retrace") == "true" else ""
    return (_text(group, "channel.fancy-name") or _text(group, "channel.name") or "untitled") + retrace


def _text(group: h5py.Group, name: str) -> str:
    value = group.attrs.get(name, "")
    return value.decode(errors="replace") if isinstance(value, bytes) else str(value)
