"""Heights as text: points x y z (.xyz), and a table of heights with or without a header (.asc).

.xyz: three numbers per line, points in any order, on a regular grid along x and y; a grid position without a point is a
missing pixel. Lines that begin with # are comments; in two of them, Gwyddion writes the units of lengths and of heights
("# Lateral units: m", "# Value units: m"). Row 0 has the smallest y.

.asc: a table of heights, starting with the top row of the image, with one of these headers:

    # Channel: Height                 exported by Gwyddion; lines in any order, others are ignored
    # Width: 5.000 µm                 or these four in this order, in any language: Kanal, Breite, Höhe, …
    # Height: 5.000 µm
    # Value units: m

    ncols 512                         an ESRI grid of square cells; rows start at the largest y
    nrows 512
    xllcorner 0
    yllcorner 0
    cellsize 0.05
    NODATA_value -9999

    # File Format = ASCII             of SPIP
    # x-pixels = 512
    # y-pixels = 512
    # x-length = 5000                 nm, or `x-unit`
    # y-length = 5000
    # z-unit = [nm]                   or, without it, Bit2nm
    # voidpixels = 0                  if any, a second table follows, in which they are 1

or without a header, if pixel size and unit are given as arguments.

.csv, .txt: either of them, points if there are three columns on a grid.

In all of them, a first line of names is skipped; it may hold units in brackets, as in "x [um],y [um],z [nm]". An empty
cell between commas, semicolons or tabs is a missing pixel.
"""

from __future__ import annotations

import io
import math
import re
import warnings
from contextlib import suppress
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...errors import RequestError
from ...files.reading import read_bytes
from . import scan
from .scan import Scan

_MAX_GRID_DEVIATION = 0.1  # of a coordinate, in pixels, owing to rounding in text
_MIN_POINT_FRACTION = 0.25  # of grid positions that have a point
_GWYDDION = "Channel", "Width", "Height", "Value units"
_SPIP_LINE = re.compile(r"#\s*([\w-]+)\s*[=:](.*)")
_HEADER_LINE = re.compile(r"#([^:\uff1a#]+)[:\uff1a](.*)")
_LENGTH = re.compile(r"([-+.,\deE]*)(.*)")
_BETWEEN_NAMES = re.compile(r"[;,\t]|(?<=[\])])\s+")
BRACKETS = re.compile(r"[\[(]([^\[(\])]*)[\])]\s*$")
_NUMBER = re.compile(r"[-+.]*\d|[-+]?(nan|inf(inity)?)\b", re.IGNORECASE)
_EMPTY_CELL = re.compile(r"^ *\t|\t *(?:\t|$)", re.MULTILINE)  # between tabs
_DECIMAL_COMMA = re.compile(r"[-+]?\d+,\d+(?:[eE][-+]?\d+)?")
_SPIP = {"x-pixels", "y-pixels", "x-length", "y-length"}
_ESRI = ("ncols", "nrows", "xllcorner", "yllcorner", "xllcenter", "yllcenter", "cellsize", "nodata_value")


def read_points(path: Path, unit: str | tuple[str, str] | None) -> Scan:
    """Read points x y z on a regular grid."""
    text, units = _below_names(contents(path))
    return _points(parse_table(text), unit, units)


def _below_names(text: str) -> tuple[str, tuple[str, str]]:
    """Return a text without its first line, if that holds names, and the units of lengths and of heights in it."""
    first, _, rest = text.lstrip().partition("\n")
    names = [name.strip(' "') for name in _BETWEEN_NAMES.split(first) if name.strip()]
    if not names or any(map(_NUMBER.match, names)) or first.startswith("#"):
        return text, _units_of_points(text)
    named = [match[1].strip() for name in names if (match := BRACKETS.search(name))]
    if len(named) == len(names) and len({*named[:2]}) == 1:
        return rest, (named[0], named[-1])
    return rest, _units_of_points(text)


def _units_of_points(text: str) -> tuple[str, str]:
    """Return the units that two successive comments name, in any language; empty if none do."""
    lines = _header_lines(text)
    for (_, along), (name, high) in pairwise(lines):
        if scan.is_length(along) and (scan.is_length(high) or name == "Value units"):
            return along, high
    return "", ""


def _points(points: NDArray[np.float64], unit: str | tuple[str, str] | None, units: tuple[str, str] = ("", "")) -> Scan:
    """Put points on their grid; `units` are those of the file."""
    along = scan.scale(units[0], scan.pair(unit)[0], "its lengths")
    high = scan.scale_of_heights(units[1], unit)
    heights, (d_x, d_y) = gridded(points)
    pixel_size = (d_x * along, d_y * along) if d_x and d_y else None  # a single line determines only one of them
    doubt = ""
    if np.allclose((d_x, d_y), 1) and (points[:, :2] % 1 == 0).all():
        doubt = f"x and y are whole numbers, which may be those of pixels: taken for lengths, one pixel is {along:g} µm"
    return Scan(heights * high, pixel_size, doubt=doubt)


def gridded(points: NDArray[np.float64]) -> tuple[NDArray[np.float64], tuple[float, float]]:
    """Return the heights (N_y, N_x) of points on a regular grid, NaN for missing points, and its spacings."""
    if points.shape[1] != 3:
        raise RequestError(f"got {points.shape[1]} numbers in a line, wanted three: x y z")
    if not np.isfinite(points[:, :2]).all():
        raise RequestError("got a point without x or y")
    (column, columns, d_x), (row, rows, d_y) = (_grid(points[:, axis], name) for axis, name in enumerate("xy"))
    if columns * rows * _MIN_POINT_FRACTION > len(points):
        raise RequestError(f"{len(points)} points on a grid of {columns} × {rows}: wanted a regular grid along x and y")
    position = row * columns + column
    if len(np.unique(position)) != len(position):
        raise RequestError("two points at one position: wanted a regular grid along x and y")
    heights = np.full(rows * columns, np.nan)
    heights[position] = points[:, 2]
    return heights.reshape(rows, columns), (d_x, d_y)


def read_csv(path: Path, unit: str | tuple[str, str] | None) -> Scan:
    """Read points x y z, or a table of heights."""
    text, units = _below_names(contents(path))
    numbers = parse_table(text)
    is_points = numbers.shape[1] == 3 and _may_be_points(numbers)
    return _points(numbers, unit, units) if is_points else _heights(text, unit, units[1])


def read_table(path: Path, unit: str | tuple[str, str] | None) -> Scan:
    """Read a table of heights."""
    text = contents(path)
    if text.lstrip()[:5].lower() == "ncols":
        return _esri(text, unit)
    text, units = _below_names(text)
    return _heights(text, unit, units[1])


def _heights(text: str, unit: str | tuple[str, str] | None, own: str = "") -> Scan:
    """Read a table of heights; `own` is their unit in a file without a header."""
    spip = {match[1].lower(): match[2].strip() for line in text.splitlines() if (match := _SPIP_LINE.match(line))}
    if spip.keys() >= _SPIP:
        return _spip(spip, parse_table(text), unit)
    header = _gwyddion_header(text)
    heights = parse_table(text)
    rows, columns = heights.shape
    if not header and columns == 3 and _may_be_points(heights):
        raise RequestError("three numbers a line that may be points x y z: wanted the extension .xyz for points")
    if np.isnan(heights[0, 0]) and all(_is_even(line[1:]) for line in (heights[0], heights[:, 0])):
        raise RequestError("the first line and column may be coordinates: wanted heights alone, or points x y z")
    along, _ = scan.pair(unit)
    scale = scan.scale_of_heights(header.get("Value units", own), unit)
    pixel_size = None
    if "Width" in header and "Height" in header:
        pixel_size = (_length(header["Width"], along) / columns, _length(header["Height"], along) / rows)
    return Scan(heights * scale, pixel_size, header.get("Channel", ""))


def _gwyddion_header(text: str) -> dict[str, str]:
    """Return what the comments of Gwyddion's export say, by the English names of `_GWYDDION`."""
    lines = _header_lines(text)
    found = {name: value for name, value in lines if name in _GWYDDION and value}
    if "Width" in found:
        return found
    # In other languages, some with "Value units" in English, their order tells: two lengths between a name and a unit.
    for four in zip(lines, lines[1:], lines[2:], lines[3:], strict=False):
        values = [value for _, value in four]
        if _has_unit(values[1]) and _has_unit(values[2]) and not _has_unit(values[0]):
            return {name: value for name, value in zip(_GWYDDION, values, strict=True) if value}
    return found


def _header_lines(text: str) -> list[tuple[str, str]]:
    """Return name and value of each comment "# name: value"."""
    found = (match for line in text.splitlines() if (match := _HEADER_LINE.match(line)))
    return [(match[1].strip(), match[2].strip()) for match in found if match[1].strip()]


def _spip(header: dict[str, str], table: NDArray[np.float64], unit: str | tuple[str, str] | None) -> Scan:
    """Return the scan of SPIP's header, by the names in it in lower case."""

    def number(name: str) -> float:
        try:
            value = abs(float(header[name]))
        except ValueError:
            value = math.inf
        if not math.isfinite(value):
            raise RequestError(f"the header: got {header[name][:60]!r} for {name!r}, wanted a number")
        return value

    columns, rows = int(number("x-pixels")), int(number("y-pixels"))
    tables = 2 if header.get("voidpixels") not in (None, "", "0") else 1
    if table.size != tables * columns * rows:
        raise RequestError(f"got {table.size} numbers, wanted {rows} lines of {columns}, {tables} of each")
    heights, *void = table.reshape(tables, rows, columns)
    if void:
        heights = np.where(void[0] == 1, np.nan, heights)
    along, _ = scan.pair(unit)
    own, steps = header.get("z-unit", "").strip("[]"), 1.0
    if not own and "bit2nm" in header:
        own, steps = "nm", number("bit2nm")
    width, length = (
        number(f"{axis}-length") * scan.scale(header.get(f"{axis}-unit", "nm"), along, f"{axis}-unit") for axis in "xy"
    )
    return Scan(heights * (steps * scan.scale_of_heights(own, unit)), (width / columns, length / rows))


def is_gwyddion_export(start: bytes) -> bool:
    """Return whether a file begins as a text that Gwyddion exported, in any language."""
    # The end of `start` may be in the middle of a character.
    return "Width" in _gwyddion_header(start.decode("utf-8", errors="ignore"))


def _has_unit(value: str) -> bool:
    """Return whether a text is a number and a unit of length."""
    match = _LENGTH.match(value)
    return match is not None and bool(match[1]) and scan.is_length(match[2])


def _esri(text: str, unit: str | tuple[str, str] | None) -> Scan:
    lines = text.lstrip().splitlines()
    header: dict[str, float] = {}
    for line in lines:
        words = line.split()
        if not words or words[0].lower() not in _ESRI:
            break
        try:
            header[words[0].lower()] = float(words[1])
        except (IndexError, ValueError):
            raise RequestError(f"the header: got the line {line[:60]!r}, wanted a name and a number") from None
    if not {"ncols", "nrows", "cellsize"} <= header.keys():
        raise RequestError(f"the header of an ESRI grid: got {', '.join(header)}, wanted ncols, nrows and cellsize")
    along, high = (scan.scale("", given, "its lengths") for given in scan.pair(unit))
    heights = parse_table("\n".join(lines[len(header) :]))
    if heights.shape != (header["nrows"], header["ncols"]):
        raise RequestError(
            f"got {heights.shape[0]} lines of {heights.shape[1]}, wanted {header['nrows']:g} of {header['ncols']:g}"
        )
    if "nodata_value" in header:
        heights = np.where(heights == header["nodata_value"], np.nan, heights)
    return Scan(heights[::-1] * high, 2 * (header["cellsize"] * along,))


def contents(path: Path) -> str:
    """Return a text in UTF-8 or Latin-1, whose lines end with \\n."""
    text = scan.decoded(read_bytes(path)).replace("\r\n", "\n").replace("\r", "\n")
    if "\0" in text:
        raise RequestError("not a text: it holds zero bytes")
    return text


def parse_table(text: str) -> NDArray[np.float64]:
    """Parse numbers in lines of equal length, separated by white space, commas or semicolons; empty cells are NaN."""
    first = next((line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")), "")
    if not first:
        raise RequestError("the file holds no numbers")
    numbers, point = first.replace(";", " ").split(), str.maketrans(",", ".")
    if len(numbers) > 1 and all(map(_DECIMAL_COMMA.fullmatch, numbers)):
        text, first = text.translate(point), first.translate(point)
    delimiter = next((mark for mark in (";", ",") if mark in first), None)
    try:
        if delimiter is None and _EMPTY_CELL.search(text):
            with suppress(ValueError):
                return _with_empty_cells(text, "\t")
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            return np.loadtxt(io.StringIO(text), dtype=np.float64, comments="#", delimiter=delimiter, ndmin=2)
    except (ValueError, UserWarning) as error:
        if delimiter is not None:
            with suppress(ValueError):
                return _with_empty_cells(text, delimiter)
        if len(numbers) > 1 and "," in text and "." not in re.sub("#.*", "", text):
            # Commas are decimal, but the first line has whole numbers, too.
            with suppress(RequestError):
                return parse_table(text.translate(point))
        raise RequestError(f"not a table of numbers ({error})") from None


def _with_empty_cells(text: str, delimiter: str) -> NDArray[np.float64]:
    """Return a table whose empty cells are NaN, without lines and columns of such cells at its edges.

    Raises:
        ValueError: if it is no table of numbers, or (tabs that align numbers) a column between others is empty.
    """
    lines = [line for line in (line.partition("#")[0] for line in text.splitlines()) if line.strip()]
    table = np.array([[float(cell) if cell.strip() else np.nan for cell in line.split(delimiter)] for line in lines])
    rows, columns = (np.flatnonzero(~np.isnan(table).all(axis=axis)) for axis in (1, 0))
    if not rows.size:
        raise RequestError("no numbers")
    table = table[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    if delimiter == "\t" and len(columns) < table.shape[1]:
        raise RequestError("tabs that align numbers")
    return table


def _grid(coordinates: NDArray[np.float64], axis: str) -> tuple[NDArray[np.int64], int, float]:
    """Return the index of each coordinate on its regular grid, the grid's length, and its spacing (0 for one point)."""
    values = np.unique(coordinates)
    if values[-1] == values[0]:
        return np.zeros(len(coordinates), np.int64), 1, 0.0
    gaps = np.diff(values)
    if not np.isfinite(gaps).all():
        raise RequestError(f"{axis} goes from {values[0]:g} to {values[-1]:g}: wanted a grid along x and y")
    # Coordinates closer than a tenth of the widest gap are equal up to rounding.
    starts = np.concatenate([[0], np.flatnonzero(gaps > _MAX_GRID_DEVIATION * gaps.max()) + 1])
    middles = np.add.reduceat(values, starts) / np.diff(np.append(starts, len(values)))
    # Step by step, to avoid accumulating rounding errors; across a column without points a step is two.
    steps = np.diff(middles)
    index = np.concatenate([[0], np.cumsum(np.rint(steps / np.median(steps)))])
    if not (np.diff(index) > 0).all():
        raise RequestError(f"{axis} is not on a regular grid: wanted a grid along x and y")
    spacing, origin = np.polyfit(index, middles, 1)
    index = np.rint((coordinates - origin) / spacing)
    off = np.abs(coordinates - origin - index * spacing).max() / spacing
    if not off <= _MAX_GRID_DEVIATION:
        raise RequestError(f"{axis} lies up to {off:.2f} of a pixel off a regular grid: wanted a grid along x and y")
    return index.astype(np.int64), int(index.max()) + 1, float(spacing)


def _may_be_points(table: NDArray[np.float64]) -> bool:
    try:
        (_, columns, _), (_, rows, _) = (_grid(table[:, axis], "x") for axis in range(2))
    except (ValueError, OverflowError):
        return False
    return columns * rows == len(table) > 1


def _is_even(numbers: NDArray[np.float64]) -> bool:
    """Return whether these are the coordinates of at least three pixels."""
    steps = np.diff(numbers)
    return len(steps) > 1 and bool(np.allclose(steps, steps[0], rtol=_MAX_GRID_DEVIATION)) and bool(steps[0])


def _length(text: str, unit: str) -> float:
    """Parse a length in its own unit, or else in the given one; in µm."""
    number, own = _LENGTH.findall(text)[0]
    try:
        value = float(number.replace(",", "."))
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise RequestError(f"the header: got the length {text[:60]!r}, wanted a number and a unit")
    return value * scan.micrometres(own.strip() or unit, "the header")
