"""Text that interferometers export, with its scale: Wyko ASCII (.asc) and Zygo's XYZ Data File (.xyz).

Wyko: lines "name, type, length, value", then a block of heights in fringes, or in nm. A line of the block is a column
of the image, upwards; `Pixel_size` is in mm, and that along y is `Aspect` times as large. "Bad" was not measured.

    Wyko ASCII Data File Format 0    0    1
    X Size    736
    Y Size    480
    Block Name    Type    Size    Value
    Wavelength    7    4    599.300049
    Aspect    7    4    0.868421
    Pixel_size    7    4    0.000193
    RAW_DATA    3    1412880

Zygo: 13 lines of numbers and quoted texts, and between two lines "#" the points: column, row and height in µm, or "No
Data". Line 4 ends with the numbers of columns and rows; the seventh number of line 8 is the pixel size in m, zero if
unknown. Rows start at the top of the image.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ...errors import RequestError
from . import scan, text
from .scan import Scan

WYKO, ZYGO = ".asc of Wyko", ".xyz of Zygo"
"""In the place of an extension."""
MAGIC = {b"Wyko ASCII Data File": WYKO, b"Zygo XYZ Data File": ZYGO, b"Zygo ASCII Data File": ZYGO}
_HEIGHTS, _OTHER = ("RAW_DATA", "RAW DATA", "OPD", "Raw", "SAMPLE_DATA"), ("Image", "Intensity", "SecArr_0")
_ZYGO_LINES = 13


def read_wyko(path: Path, unit: str | tuple[str, str] | None) -> Scan:
    """Read the first block of heights of a Wyko ASCII file."""
    high = scan.scale_of_heights("nm", unit)
    first, *lines = text.contents(path).splitlines()
    fields: dict[str, str] = {}
    at = 0
    while at < len(lines):
        name, *values = (word.strip() for word in lines[at].split("\t"))
        at += 1
        if name in _HEIGHTS:
            break
        fields[name] = values[-1] if values else ""
        if name in _OTHER:
            at += int(_number(fields, "X Size"))
    else:
        raise RequestError(f"a Wyko ASCII file without heights, wanted a block {', '.join(_HEIGHTS)}")
    columns, rows = (int(_number(fields, name)) for name in ("X Size", "Y Size"))
    heights = text.parse_table("\n".join(lines[at : at + columns]).replace("Bad", "nan"))
    if heights.shape != (columns, rows):
        raise RequestError(f"got {heights.shape[0]} lines of {heights.shape[1]} heights, wanted {columns} of {rows}")
    if first.split("\t")[1:2] in ([], ["0"]):
        heights = heights * (_number(fields, "Wavelength") / _number(fields, "Mult", "1"))
    pixel_size = None
    if "Pixel_size" in fields:
        along_x = 1e3 * _number(fields, "Pixel_size")
        pixel_size = along_x, along_x * _number(fields, "Aspect", "1")
    return Scan(high * heights.T[::-1], pixel_size, fields.get("Title", ""))


def read_zygo(path: Path, unit: str | tuple[str, str] | None) -> Scan:
    """Read the points of a Zygo XYZ file."""
    high = scan.scale_of_heights("um", unit)
    first, *lines = (line.strip() for line in text.contents(path).splitlines())
    if "XYZ" not in first:
        raise RequestError(
            f"{first[:60]!r}, whose heights are fractions of a fringe: export XYZ, .dat or .datx instead"
        )
    marks = [number for number, line in enumerate(lines) if line == "#"]
    if not marks or marks[0] < _ZYGO_LINES - 1:
        raise RequestError(f"a Zygo XYZ file that is cut, wanted {_ZYGO_LINES} lines and, between lines '#', points")
    try:
        columns, rows = map(int, lines[2].split()[2:])
        resolution = 1e6 * float(lines[6].split()[6])
    except (IndexError, ValueError):
        raise RequestError(
            f"lines 4 and 8 of a Zygo XYZ file: got {lines[2][:60]!r} and {lines[6][:60]!r}, wanted 4 and 8 numbers"
        ) from None
    end = marks[1] if len(marks) > 1 else len(lines)
    points = text.parse_table("\n".join(lines[marks[0] + 1 : end]).replace("No Data", "nan"))
    if len(points) != columns * rows:
        raise RequestError(f"got {len(points)} points, wanted {columns} × {rows}")
    heights, (d_x, d_y) = text.gridded(points)
    pixel_size = (resolution * d_x, resolution * d_y) if np.isfinite(resolution) and resolution > 0 else None
    return Scan(heights * high, pixel_size)


def _number(fields: dict[str, str], name: str, otherwise: str = "none") -> float:
    found = fields.get(name, otherwise)
    try:
        value = float(found)
    except ValueError:
        value = np.nan
    if not 0 < value < np.inf:
        raise RequestError(f"the header: got {found[:60]!r} for {name!r}, wanted a positive number")
    return value
