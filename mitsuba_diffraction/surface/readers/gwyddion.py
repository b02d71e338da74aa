"""Files of Gwyddion: .gwy, a tree of named components in binary, and .gsf, a header of text and 32 bit floats.

The formats: Gwyddion user guide, "Gwyddion native file format" and "Simple field files",
http://gwyddion.net/documentation/user-guide-en/gwyfile-format.html and gsf.html.

An object of a .gwy file is its name, a zero byte, the number of bytes that follow (uint32) and its components; a
component is its name, a zero byte, a letter for its type, and its value. All numbers are little-endian. Every size is
checked against the remaining bytes before it is used.

Lengths are in the base unit, metres, even if the text of the unit has a prefix, as in files of Gwyddion 1.x. Other
programs write lengths in the prefixed unit; it is taken where metres are impossible.

In files of Gwyddion 1.x, which begin with GWYO, a component of a container is the number of its type in GLib (uint32),
its name, a zero byte, and its value; within other objects it is as above.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import RequestError
from ...files.reading import read_bytes
from . import scan
from .scan import MAX_FIELD, MIN_HEIGHT_RANGE, Channel, Scan, choose_channel, is_possible_size

_NUMBERS = {"b": "<B", "c": "<B", "i": "<i", "q": "<q", "d": "<d"}
_ARRAYS = {"C": 1, "I": 4, "Q": 8, "D": 8}  # bytes of an element
_FIELD, _TITLE = re.compile(r"/(\d{1,9})/data"), re.compile(r"/(\d{1,9})/data/title")
_GLIB_TYPES = {16: "c", 20: "b", 24: "i", 40: "q", 60: "d", 64: "s", 80: "o"}
_MAX_NAME_LENGTH = 4096

_SIMPLE = b"Gwyddion Simple Field 1.0\n"
_MAX_HEADER_LENGTH = 2**20


def read_gwyddion(path: Path, unit: str | tuple[str, str] | None, channel: str | int | None) -> Scan:
    """Read one data field of a .gwy file; the top row of its image is row 0. Masks are ignored."""
    data = read_bytes(path)
    if data[:4] == b"GWYQ":
        raise RequestError("a Gwyddion file with sizes of 64 bits ('GWYQ'): save it as .gwy of Gwyddion 2, or as .gsf")
    if data[:4] not in (b"GWYP", b"GWYO"):
        raise RequestError("not a Gwyddion file, which begins with 'GWYP', or 'GWYO' in version 1")
    name, inside = _Bytes(data, 4, len(data)).content()
    if name != "GwyContainer":
        raise RequestError(f"got a {name!r}, wanted a GwyContainer")
    fields: dict[int, dict[str, Any]] = {}
    titles: dict[int, str] = {}
    for name, value in inside.components(glib_types=data[:4] == b"GWYO"):
        if (match := _FIELD.fullmatch(name)) and isinstance(value, tuple) and value[0] == "GwyDataField":
            fields[int(match[1])] = dict(value[1].components())
        elif (match := _TITLE.fullmatch(name)) and isinstance(value, str):
            titles[int(match[1])] = value
    units = {n: _unit(field, "si_unit_z") for n, field in fields.items()}
    channels = [Channel(n, titles.get(n, "untitled"), scan.is_length(z) or not z) for n, z in sorted(units.items())]
    chosen = choose_channel(channels, channel)
    field = fields[chosen.number]
    heights, size = _heights(field)
    return _scan(heights, size, chosen.name, (_unit(field, "si_unit_xy"), units[chosen.number]), unit)


def _scan(
    numbers: NDArray[np.float64],
    size: tuple[float, float] | None,
    name: str,
    own: tuple[str, str],
    unit: str | tuple[str, str] | None,
) -> Scan:
    """Return a field as a scan; its lateral lengths and its heights have the units `own`, or else the given ones."""
    high = scan.scale_of_heights(own[1], unit)
    pixel_size, doubt, doubt_of_heights, max_range = None, "", "", MAX_FIELD
    if size is not None:
        rows, columns = numbers.shape
        x, y = size[0] / columns, size[1] / rows
        along = scan.scale(own[0], scan.pair(unit)[0], "the width")
        if own[0]:
            along, doubt = _taken(own[0], "lengths", lambda one: is_possible_size((x * one, y * one), numbers.shape))
        pixel_size, max_range = (x * along, y * along), max(size) * along
    if own[1] and not isinstance(unit, tuple | list):
        finite = numbers[np.isfinite(numbers)]
        height_range = float(np.ptp(finite)) if finite.size else 0.0
        high, doubt_of_heights = _taken(
            own[1], "heights", lambda one: MIN_HEIGHT_RANGE <= height_range * one <= max_range
        )
    return Scan(numbers * high, pixel_size, name, doubt, doubt_of_heights=doubt_of_heights)


def _taken(unit: str, what: str, is_possible: Callable[[float], bool]) -> tuple[float, str]:
    """Return the base unit in µm, or the prefixed `unit` with a doubt where only in it the lengths are possible."""
    base, prefixed = scan.micrometres("m", "unit"), scan.micrometres(unit, "unit")
    if base == prefixed or is_possible(base) or not is_possible(prefixed):
        return base, ""
    return prefixed, f"its {what} are taken in {unit}, as written, since they cannot be in m, which Gwyddion reads"


def _heights(field: dict[str, Any]) -> tuple[NDArray[np.float64], tuple[float, float]]:
    """Return the array of a data field, and its width and height, in the units of the file."""
    columns, rows, values = field.get("xres"), field.get("yres"), field.get("data")
    if not (isinstance(columns, int) and isinstance(rows, int) and columns > 0 and rows > 0):
        raise RequestError(f"a data field of {columns!r} × {rows!r} pixels")
    if not isinstance(values, np.ndarray) or len(values) != rows * columns:
        count = len(values) if isinstance(values, np.ndarray) else 0
        raise RequestError(f"a data field of {columns} × {rows} pixels with {count} heights")
    size = field.get("xreal", 1.0), field.get("yreal", 1.0)  # defaults of the format
    if not all(isinstance(s, float) and np.isfinite(s) and s > 0 for s in size):
        raise RequestError(f"a data field of the size {size}, wanted positive lengths")
    return values.astype(np.float64).reshape(rows, columns), size


def _unit(field: dict[str, object], name: str) -> str:
    value = field.get(name)
    if value is None:
        return ""
    text = dict(value[1].components()).get("unitstr", "") if isinstance(value, tuple) else None
    if not isinstance(text, str):
        raise RequestError(f"a damaged unit, {name}")
    return text


class _Bytes:
    """A part of the file, from `offset` to `end`."""

    def __init__(self, data: bytes, offset: int, end: int) -> None:
        self._data, self._offset, self._end = data, offset, end

    def content(self) -> tuple[str, _Bytes]:
        """Read the name and the content of an object here, and move past it."""
        name = self._text(_MAX_NAME_LENGTH)
        size = int(self._number("<I"))
        start = self._skip(size)
        return name, _Bytes(self._data, start, start + size)

    def components(self, glib_types: bool = False) -> Iterator[tuple[str, Any]]:
        """Yield name and value of each component: (name, content) of an object, an array of doubles, or None."""
        while self._offset < self._end:
            kind = None
            if glib_types:
                number = int(self._number("<I"))
                kind = _GLIB_TYPES.get(number, str(number))
            name = self._text(_MAX_NAME_LENGTH)
            yield name, self._value(kind or chr(int(self._number("<B"))))

    def _value(self, kind: str) -> Any:
        if kind == "o":
            return self.content()
        if kind == "s":
            return self._text()
        if kind in _NUMBERS:
            return self._number(_NUMBERS[kind])
        if kind not in "SOCIQD":
            raise RequestError(f"a component of the unknown type {kind!r}")
        count = int(self._number("<I"))
        if kind in _ARRAYS:
            start = self._skip(count * _ARRAYS[kind])
            return np.frombuffer(self._data, "<f8", count, start) if kind == "D" else None
        # Each text or object takes at least a byte, so that this ends where the bytes do.
        for _ in range(count):
            self._text() if kind == "S" else self.content()
        return None

    def _skip(self, count: int) -> int:
        """Skip bytes and return where they begin."""
        start = self._offset
        if count > self._end - start:
            raise RequestError("the file ends, or a part of it, before what it announces: truncated or damaged")
        self._offset += count
        return start

    def _number(self, kind: str) -> int | float:
        return struct.unpack_from(kind, self._data, self._skip(struct.calcsize(kind)))[0]

    def _text(self, longest: int | None = None) -> str:
        end = self._end if longest is None else min(self._end, self._offset + longest)
        zero = self._data.find(b"\0", self._offset, end)
        if zero < 0:
            raise RequestError("a text without an end: truncated or damaged")
        start = self._skip(zero + 1 - self._offset)
        return scan.decoded(self._data[start:zero])


def read_simple_field(path: Path, unit: str | tuple[str, str] | None) -> Scan:
    """Read the field of a .gsf file; the top row of its image is row 0."""
    with path.open("rb") as file:
        head = file.read(_MAX_HEADER_LENGTH)
        if not head.startswith(_SIMPLE):
            raise RequestError("not a Gwyddion Simple Field, which begins with 'Gwyddion Simple Field 1.0'")
        end = head.find(b"\0")
        if end < 0:
            raise RequestError("the header does not end: a truncated file")
        fields = _fields(head[len(_SIMPLE) : end])
        columns, rows = (_count(fields, name) for name in ("XRes", "YRes"))
        start = end + 4 - end % 4
        length = path.stat().st_size
        if length != start + 4 * rows * columns:
            raise RequestError(f"got {length} bytes, wanted {start + 4 * rows * columns} for {columns} × {rows} pixels")
        file.seek(start)
        numbers = np.frombuffer(file.read(4 * rows * columns), "<f4").reshape(rows, columns)
    size = (_length(fields, "XReal"), _length(fields, "YReal")) if fields.keys() >= {"XReal", "YReal"} else None
    own = fields.get("XYUnits", ""), fields.get("ZUnits", "")
    return _scan(numbers.astype(np.float64), size, fields.get("Title", ""), own, unit)


def _fields(header: bytes) -> dict[str, str]:
    fields = {}
    for line in scan.decoded(header).splitlines():
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
