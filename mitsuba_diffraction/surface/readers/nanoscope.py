"""Headers of Nanoscope files (.spm, .000, …), and the text that Nanoscope Analysis exports.

A header has a section for the scan as it was set, and one for each image. `Aspect Ratio` is width to length. Where it
is not 1:1, and there is no `Slow Axis Size`, the two equal numbers of `Scan Size` are the sides of the square of which
a part was scanned. If a scan was stopped, they are the sides of the whole scan. The library takes them for the sides of
the image. Where the lines of an image do not fit its data, it takes the lines that were set.

The text has the same header, whose lines may be in quotes, then the names of one or more channels, with their units, as
in "Height_Sensor(nm)", and a line of numbers for each pixel, row by row.
"""

from __future__ import annotations

import re
from itertools import dropwhile
from pathlib import Path
from typing import NamedTuple

from ...errors import RequestError
from . import scan, text
from .scan import Channel, Scan, choose_channel

TEXT = ".txt of Nanoscope"
"""In the place of an extension."""
_END = re.compile(rb"\\\*File list end[^\n]*", re.IGNORECASE)
_SET = ("ciao scan list", "afm list", "stm list", "nc afm list")
_IMAGES = ("ciao image list", "afm image list", "stm image list", "ncafm image list", "image list")
_ALWAYS_32_BITS = 0x09200000  # from this version of the program on, whatever `Bytes/pixel` is
_MAX_DEVIATION = 0.02  # between lengths that follow from different fields; an aspect ratio may be rounded


class _Image(NamedTuple):
    columns: int
    lines: int
    width: float
    length: float
    unit: str
    doubt: str


def rewritten_nanoscope(data: bytes) -> tuple[bytes, list[str]]:
    """Return a file whose image sections have the right lines and sizes, and `Scan.doubt` of each image."""
    if (end := _END.search(data)) is None:
        return data, []
    lines = data[: end.end()].decode("latin-1").splitlines()
    sections = _sections(lines)
    settings = _settings(sections)
    shift = 2 * end.end() + 2**10  # of the data, behind a header that becomes a little longer
    doubts = []
    for section, fields, at in sections:
        if section not in _IMAGES:
            continue
        try:
            image = _image(fields, settings, int(sections[0][1].get("version", "0"), 16))
            lines[at["data offset"]] = f"\\Data offset: {int(fields['data offset']) + shift}"
        except (KeyError, ValueError, IndexError, ZeroDivisionError, OverflowError):
            return data, []  # the library says what is missing
        lines[at["samps/line"]] = f"\\Samps/line: {image.columns}"
        lines[at["number of lines"]] = f"\\Number of lines: {image.lines}"
        lines[at["scan size"]] = f"\\Scan Size: {image.width!r} {image.length!r} {image.unit}"
        doubts.append(image.doubt)
    header = "\r\n".join([*lines, ""]).encode("latin-1")
    return header.ljust(shift, b"\0") + data, doubts


def is_text(path: Path) -> bool:
    """Return whether a file that begins as one of Nanoscope is a text: in others, zero bytes follow the header."""
    data = path.read_bytes()
    return b"\0" not in data or data.startswith(scan.UTF_16)


def read_text(path: Path, unit: str | tuple[str, str] | None, channel: str | int | None) -> Scan:
    """Read a channel of the text of Nanoscope Analysis; its first row is row 0."""
    lines = [line.strip('" ') for line in text.contents(path).splitlines()]
    body = [line for line in dropwhile(lambda line: line.lower() != "\\*file list end", lines) if line][1:]
    if not body:
        raise RequestError("a text of Nanoscope that is cut, wanted a header that ends, names of channels, and numbers")
    units = [match[1] if (match := text.BRACKETS.search(name)) else "" for name in body[0].split()]
    names = zip(body[0].split(), units, strict=True)
    channels = [Channel(k, name, scan.is_length(own) or not own) for k, (name, own) in enumerate(names)]
    chosen = choose_channel(channels, channel)
    table = text.parse_table("\n".join(body[1:]))
    if table.shape[1] != len(channels):
        raise RequestError(f"got {table.shape[1]} numbers in a line, wanted {len(channels)}: {body[0][:60]}")
    sections = _sections(lines)
    images = [fields for section, fields, _ in sections if section in _IMAGES]
    try:
        # As if a number were a byte.
        count = {"data length": str(len(table)), "bytes/pixel": "1"}
        image = _image(images[0] | count, _settings(sections), 0)
    except (KeyError, ValueError, IndexError, ZeroDivisionError, OverflowError) as error:
        raise RequestError(f"the header of a text of Nanoscope: {error} is missing or wrong in an image list") from None
    if image.columns * image.lines != len(table):
        raise RequestError(f"got {len(table)} pixels, wanted {image.columns} × {image.lines}")
    heights = table[:, chosen.number].reshape(image.lines, image.columns)
    along = scan.scale(image.unit.replace("~", "µ"), scan.pair(unit)[0], "the width")
    high = scan.scale_of_heights(units[chosen.number], unit)
    pixel_size = image.width * along / image.columns, image.length * along / image.lines
    return Scan(heights * high, pixel_size, chosen.name, image.doubt)


def _sections(lines: list[str]) -> list[tuple[str, dict[str, str], dict[str, int]]]:
    """Return, of each section of a header, its name, its fields and their lines, all names in lower case."""
    sections: list[tuple[str, dict[str, str], dict[str, int]]] = []
    for number, line in enumerate(lines):
        name, _, value = line.strip().removeprefix("\\").partition(": ")
        if name.startswith("*"):
            sections.append((name[1:].lower(), {}, {}))
        elif sections:
            sections[-1][1][name.lower()], sections[-1][2][name.lower()] = value.strip(), number
    return sections


def _settings(sections: list[tuple[str, dict[str, str], dict[str, int]]]) -> dict[str, str]:
    """Return the fields of the scan as it was set."""
    settings: dict[str, str] = {}
    for section, fields, _ in sections:
        if section in _SET:
            settings |= fields
    return settings


def _image(fields: dict[str, str], settings: dict[str, str], version: int) -> _Image:
    """Return the grid and the size of an image from its section and from the settings of the scan."""
    columns, lines = _number(fields["samps/line"]), _number(fields["number of lines"])
    width, length, unit = _size(fields["scan size"])
    aspect, set_aspect = _aspect(fields) or _aspect(settings) or 1.0, _aspect(settings) or 1.0
    count, pixel_bytes = int(fields["data length"]), {int(fields.get("bytes/pixel", "2"))}
    if version >= _ALWAYS_32_BITS:
        pixel_bytes.add(4)
    valid = _number(fields.get("valid data len x", "0")), _number(fields.get("valid data len y", "0"))
    refilled = count not in {columns * lines * b for b in pixel_bytes} and count in {
        valid[0] * valid[1] * b for b in pixel_bytes
    }
    if refilled:
        width, length, (columns, lines) = width * valid[0] / columns, length * valid[1] / lines, valid
    if "slow axis size" in settings:
        return _Image(columns, lines, width, length, unit, "")
    set_columns, set_lines = (_number(settings.get(name, "0")) for name in ("samps/line", "lines"))
    # What the settings yield for the lines of the image, if these are as far apart as those that were set.
    part = lines / columns * set_columns / set_lines if set_columns and set_lines else lines / columns
    expected = [width / set_aspect * part] if set_columns and set_lines and _aspect(settings) else []
    if width == length and not refilled:
        expected.append(width / aspect)
        square_pixels = width * lines / columns
        if aspect != 1:
            length = square_pixels if set_aspect != 1 else width * part
        elif set_aspect != 1 and _agree(square_pixels, width / set_aspect * part):
            length = square_pixels
    doubt = ""
    if refilled or not all(_agree(length, other) for other in expected):
        stated = _listed(fields, "Scan Size", "Aspect Ratio", "Samps/line", "Number of lines", "Valid data len Y")
        planned = _listed(settings, "Aspect Ratio", "Samps/line", "Lines")
        doubt = (
            f"fields of its header disagree ({stated}; as set: {planned}): taken as {columns} × {lines} pixels "
            f"on {width:.4g} × {length:.4g} {unit.replace('~', 'µ')}"
        )
    return _Image(columns, lines, width, length, unit, doubt)


def _listed(fields: dict[str, str], *names: str) -> str:
    return ", ".join(f"{name}: {fields[name.lower()]}" for name in names if name.lower() in fields)


def _agree(one: float, other: float) -> bool:
    return abs(one - other) <= _MAX_DEVIATION * abs(one)


def _number(value: str) -> int:
    return int(value.split()[0])  # settings may list one for each channel


def _aspect(fields: dict[str, str]) -> float | None:
    """Return width to length, as in `2:1` or `0.516`; None without such an entry."""
    over, _, under = fields.get("aspect ratio", "").partition(":")
    try:
        aspect = float(over) / float(under or 1)
    except (ValueError, ZeroDivisionError):
        return None
    return aspect if aspect > 0 else None


def _size(value: str) -> tuple[float, float, str]:
    """Return width, length and unit of a `Scan Size`; one number is the side of a square."""
    words = value.split()
    try:
        return float(words[0]), float(words[1]), " ".join(words[2:])
    except (IndexError, ValueError):
        return float(words[0]), float(words[0]), " ".join(words[1:])
