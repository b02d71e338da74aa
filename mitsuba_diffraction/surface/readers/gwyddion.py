"""Gwyddion's own files (.gwy): a tree of named components in binary.

The format: Gwyddion user guide, "Gwyddion native file format",
http://gwyddion.net/documentation/user-guide-en/gwyfile-format.html. An object is its name, a zero byte, the number of
bytes that follow (uint32) and its components; a component is its name, a zero byte, a letter for its type, and its
value. All numbers are little-endian. Every size is checked against the remaining bytes before it is used.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...errors import RequestError
from . import scan
from .scan import MOST_BYTES, Channel, Scan, choose

_NUMBERS = {"b": "<B", "c": "<B", "i": "<i", "q": "<q", "d": "<d"}
_ARRAYS = {"C": 1, "I": 4, "Q": 8, "D": 8}  # bytes of an element
_FIELD, _TITLE = re.compile(r"/(\d{1,9})/data"), re.compile(r"/(\d{1,9})/data/title")
_LONGEST_NAME = 4096


def read(path: Path, unit: str | tuple[str, str] | None, channel: str | int | None) -> Scan:
    """Read one data field; the top row of its image is row 0. Masks are ignored.

    Raises:
        ValueError: if it is not a Gwyddion file, is truncated, or has no such channel.
    """
    if path.stat().st_size > MOST_BYTES:
        raise RequestError(f"got {path.stat().st_size} bytes, wanted at most {MOST_BYTES}")
    data = path.read_bytes()
    if data[:4] != b"GWYP":
        raise RequestError("not a Gwyddion file, which begins with 'GWYP'")
    name, inside = _Bytes(data, 4, len(data)).object()
    if name != "GwyContainer":
        raise RequestError(f"got a {name!r}, wanted a GwyContainer")
    fields: dict[int, dict[str, object]] = {}
    titles: dict[int, str] = {}
    for name, value in inside.components():
        if (match := _FIELD.fullmatch(name)) and isinstance(value, tuple) and value[0] == "GwyDataField":
            fields[int(match[1])] = dict(value[1].components())
        elif (match := _TITLE.fullmatch(name)) and isinstance(value, str):
            titles[int(match[1])] = value
    given = scan.pair(unit)
    described = {n: (_unit(field, "si_unit_xy") or given[0], _unit(field, "si_unit_z")) for n, field in fields.items()}
    channels = [
        Channel(n, titles.get(n, "untitled"), scan.is_length(z) or not z) for n, (_, z) in sorted(described.items())
    ]
    chosen = choose(channels, channel)
    along, high = described[chosen.number]
    high = high or given[1]
    for what, one in (("heights", high), ("width", along)):
        if not one:
            raise RequestError(f"unit: the file names none for the {what}, wanted one of {scan.UNITS}")
    heights, size = _heights(fields[chosen.number])
    scale = scan.micrometres(along, "the width")
    rows, columns = heights.shape
    pixel_size = (size[0] * scale / columns, size[1] * scale / rows)
    return Scan(heights * scan.micrometres(high, "the heights"), pixel_size, chosen.name)


def _heights(field: dict[str, object]) -> tuple[NDArray[np.float64], tuple[float, float]]:
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
    """A part of the file, from `place` to `end`."""

    def __init__(self, data: bytes, place: int, end: int) -> None:
        self._data, self._place, self._end = data, place, end

    def object(self) -> tuple[str, _Bytes]:
        """Read the name and the content of an object here, and move past it."""
        name = self._text(_LONGEST_NAME)
        size = self._number("<I")
        start = self._skip(size)
        return name, _Bytes(self._data, start, start + size)

    def components(self) -> Iterator[tuple[str, object]]:
        """Yield name and value of each component: (name, content) of an object, an array of doubles, or None."""
        while self._place < self._end:
            yield self._text(_LONGEST_NAME), self._value()

    def _value(self) -> object:
        kind = chr(self._number("<B"))
        if kind == "o":
            return self.object()
        if kind == "s":
            return self._text()
        if kind in _NUMBERS:
            return self._number(_NUMBERS[kind])
        if kind not in "SOCIQD":
            raise RequestError(f"a component of the unknown type {kind!r}")
        count = self._number("<I")
        if kind in _ARRAYS:
            start = self._skip(count * _ARRAYS[kind])
            return np.frombuffer(self._data, "<f8", count, start) if kind == "D" else None
        # Each text or object takes at least a byte, so that this ends where the bytes do.
        for _ in range(count):
            self._text() if kind == "S" else self.object()
        return None

    def _skip(self, count: int) -> int:
        """Skip bytes and return where they begin."""
        start = self._place
        if count > self._end - start:
            raise RequestError("the file ends, or a part of it, before what it announces: truncated or damaged")
        self._place += count
        return start

    def _number(self, kind: str) -> int | float:
        return struct.unpack_from(kind, self._data, self._skip(struct.calcsize(kind)))[0]

    def _text(self, longest: int | None = None) -> str:
        end = self._end if longest is None else min(self._end, self._place + longest)
        zero = self._data.find(b"\0", self._place, end)
        if zero < 0:
            raise RequestError("a text without an end: truncated or damaged")
        start = self._skip(zero + 1 - self._place)
        return self._data[start:zero].decode("utf-8")
