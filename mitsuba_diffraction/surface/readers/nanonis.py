"""Scans of Nanonis (.sxm): a header of text, then images of big-endian float32.

In the header, a line `:NAME:` precedes the lines of its value. DATA_INFO is a table, with a line for each channel,
which has an image forward, one backward, or both. After the line `:SCANIT_END:` and the bytes 1A 04 the images follow
each other; their lines stand in the order of scanning, upwards if SCAN_DIR is `up`, and those of backward images from
right to left. Lengths are in m; pixels that were not scanned are NaN.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from ...errors import RequestError
from ...files.reading import read_bytes
from . import scan
from .scan import Channel, Scan, choose_channel

FIRST_LINE = b":NANONIS_VERSION:"
_END, _START = b":SCANIT_END:", b"\x1a\x04"


class _Image(NamedTuple):
    name: str
    unit: str
    is_backward: bool


def read_nanonis(path: Path, unit: str | tuple[str, str] | None, channel: str | int | None) -> Scan:
    """Read one image of a .sxm file; the top row of the image is row 0."""
    header, end, rest = read_bytes(path).partition(_END)
    _, start, data = rest.partition(_START)
    if not (header.startswith(FIRST_LINE) and end and start):
        raise RequestError("not a whole scan of Nanonis, which has a header from ':NANONIS_VERSION:' to ':SCANIT_END:'")
    fields = _fields(scan.decoded(header))
    columns, rows = (int(number) for number in _numbers(fields, "SCAN_PIXELS"))
    width, length = (1e6 * number for number in _numbers(fields, "SCAN_RANGE"))
    images = _images(fields.get("DATA_INFO", ""))
    if 4 * columns * rows * len(images) > len(data):
        raise RequestError(f"got {len(data)} bytes of images, wanted {len(images)} of {columns} × {rows} pixels")
    channels = [Channel(number, image.name, scan.is_length(image.unit)) for number, image in enumerate(images)]
    chosen = choose_channel(channels, channel)
    image = images[chosen.number]
    numbers = np.frombuffer(data, ">f4", rows * columns, 4 * rows * columns * chosen.number).reshape(rows, columns)
    heights = numbers[:, ::-1] if image.is_backward else numbers
    if fields.get("SCAN_DIR") == "up":
        heights = heights[::-1]
    scale = scan.scale_of_heights(image.unit, unit)
    return Scan(heights.astype(np.float64) * scale, (width / columns, length / rows), chosen.name)


def _fields(header: str) -> dict[str, str]:
    """Return the values of a header by their names."""
    fields, name = dict[str, str](), ""
    for line in header.splitlines():
        if line.startswith(":") and line.endswith(":"):
            name = line.strip(":")
        else:
            fields[name] = f"{fields.get(name, '')}\n{line}".strip()
    return fields


def _numbers(fields: dict[str, str], name: str) -> tuple[float, float]:
    """Return the two positive numbers of a field, along x and y."""
    try:
        x, y = map(float, fields[name].split())
    except (KeyError, ValueError):
        x = y = np.nan
    if not (0 < x < np.inf and 0 < y < np.inf):
        raise RequestError(f"{name}: got {fields.get(name, 'none')[:60]!r}, wanted two positive numbers")
    return x, y


def _images(table: str) -> list[_Image]:
    """Return the images of each channel, in the order of their data."""
    images = []
    for row in table.splitlines()[1:]:
        values = row.split()
        if len(values) < 4 or values[3] not in ("both", "forward", "backward"):
            raise RequestError(f"DATA_INFO: got {row[:60]!r}, wanted channel, name, unit and direction of the images")
        for direction in ("forward", "backward") if values[3] == "both" else values[3:4]:
            images.append(_Image(f"{values[1]} ({direction})", values[2], direction == "backward"))
    return images
