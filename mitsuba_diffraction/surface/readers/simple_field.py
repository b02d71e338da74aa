"""Gwyddion Simple Field (.gsf): a header of text, zero bytes to a multiple of four, 32 bit floats.

The format: Gwyddion user guide, "Simple field files", http://gwyddion.net/documentation/user-guide-en/gsf.html
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ...errors import RequestError
from . import scan
from .scan import MOST_BYTES, Scan

_MAGIC = b"Gwyddion Simple Field 1.0\n"
_LONGEST_HEADER = 2**20


def read(path: Path, unit: str | tuple[str, str] | None) -> Scan:
    """Read the field of a file; the top row of its image is row 0.

    Raises:
        ValueError: if it is not in this format, or truncated.
    """
    with path.open("rb") as file:
        head = file.read(_LONGEST_HEADER)
        if not head.startswith(_MAGIC):
            raise RequestError("not a Gwyddion Simple Field, which begins with 'Gwyddion Simple Field 1.0'")
        end = head.find(b"\0")
        if end < 0:
            raise RequestError("the header does not end: a truncated file")
        fields = _fields(head[len(_MAGIC) : end])
        columns, rows = (_count(fields, name) for name in ("XRes", "YRes"))
        if 4 * rows * columns > MOST_BYTES:
            raise RequestError(f"got {columns} × {rows} pixels, wanted at most {MOST_BYTES} bytes")
        start = end + 4 - end % 4
        size = path.stat().st_size
        if size != start + 4 * rows * columns:
            raise RequestError(f"got {size} bytes, wanted {start + 4 * rows * columns} for {columns} × {rows} pixels")
        file.seek(start)
        numbers = np.frombuffer(file.read(4 * rows * columns), "<f4").reshape(rows, columns)
    along, high = (
        fields.get(name, "") or given for name, given in zip(("XYUnits", "ZUnits"), scan.pair(unit), strict=True)
    )
    if not high:
        raise RequestError(f"unit: the file names none for its heights, wanted one of {scan.UNITS}")
    heights = numbers.astype(np.float64) * scan.micrometres(high, "ZUnits")
    if not ("XReal" in fields and "YReal" in fields):
        return Scan(heights, None, fields.get("Title", ""))
    if not along:
        raise RequestError(f"unit: the file names none along the surface, wanted one of {scan.UNITS}")
    scale = scan.micrometres(along, "XYUnits")
    pixel_size = (_length(fields, "XReal") * scale / columns, _length(fields, "YReal") * scale / rows)
    return Scan(heights, pixel_size, fields.get("Title", ""))


def _fields(header: bytes) -> dict[str, str]:
    fields = {}
    for line in header.decode("utf-8").splitlines():
        name, equals, value = line.partition("=")
        if not equals:
            raise RequestError(f"the header: got the line {line[:60]!r}, wanted 'name = value'")
        fields[name.strip()] = value.strip()
    return fields


def _count(fields: dict[str, str], name: str) -> int:
    text = fields.get(name, "none")
    if not (text.isascii() and text.isdecimal() and len(text) < 10 and int(text) > 0):
        raise RequestError(f"{name}: got {text}, wanted a number of pixels")
    return int(text)


def _length(fields: dict[str, str], name: str) -> float:
    try:
        value = float(fields[name])
    except ValueError:
        value = np.nan
    if not (np.isfinite(value) and value > 0):
        raise RequestError(f"{name}: got {fields[name]}, wanted a positive length")
    return value
