"""Height fields from files: arrays, images, Gwyddion, text, and instrument formats.

Row 0 of a file is row 0 of `heights`, so that the top row of an image is at the lowest y (row ↔ +y, column ↔ +x), as
for a bitmap in Mitsuba. This holds for every format that stores an image, whatever its scan direction; formats with
explicit y (.xyz, ESRI grids) keep theirs.
"""

from __future__ import annotations

import os
import textwrap
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...errors import RequestError, is_number
from ...files.reading import check_file
from ..heightfield import HeightField
from . import gwyddion, h5_jpk, images, instruments, interferometers, nanonis, nanoscope, text, workarounds
from .scan import (
    MAX_FIELD,
    MAX_HEIGHT_RANGE,
    MAX_PIXEL,
    MIN_HEIGHT_RANGE,
    MIN_PIXEL,
    UTF_16,
    Scan,
    decoded,
    is_possible_size,
    micrometres,
    pair,
)

__all__ = ["read_height_field"]

_PIXELS_PER_BAND = 2**20
_MAX_TITLE = 200  # characters of the name of a channel
_MAX_QUOTE = 500  # characters of a library's error message, as some quote a damaged header in full
_WITHOUT_UNIT = {
    ".npy": images.read_npy,
    ".npz": images.read_npz,
    ".png": images.read_image,
    ".tif": images.read_image,
    ".tiff": images.read_image,
}
"""Extension → reader of formats with heights in µm, or scaled by `height_range`."""

# Extension → reader of formats with units and several channels.
_WITH_CHANNELS = {
    ".gwy": gwyddion.read_gwyddion,
    ".h5-jpk": h5_jpk.read_h5_jpk,
    ".sxm": nanonis.read_nanonis,
    nanoscope.TEXT: nanoscope.read_text,
}
# Extension → reader of single-channel formats with a unit.
_WITH_UNIT = {
    ".gsf": gwyddion.read_simple_field,
    ".xyz": text.read_points,
    ".asc": text.read_table,
    ".csv": text.read_csv,
    ".txt": text.read_csv,
    interferometers.WYKO: interferometers.read_wyko,
    interferometers.ZYGO: interferometers.read_zygo,
}
# First bytes of a file → the extension by which it is read if its own is unknown.
_MAGIC = {
    b"GWYP": ".gwy",
    b"GWYO": ".gwy",
    b"GWYQ": ".gwy",
    b"Gwyddion Simple Field": ".gsf",
    b"\\*File list": ".spm",
    b"\x93NUMPY": ".npy",
    b"\x89PNG": ".png",
    b"II*\0": ".tif",
    b"MM\0*": ".tif",
    b"ncols ": ".asc",
    b"# File Format = ASCII": ".asc",
    nanonis.FIRST_LINE: ".sxm",
    b"# Daisy frame view": ".asc",
    b'"\\*File list': nanoscope.TEXT,
    b"DIGITAL SURF": ".sur",
    b"DSCOMPRESSED": ".sur",
    b"Binary TrueMap": ".tmd",
    b"PK\3\4": ".x3p",
} | interferometers.MAGIC
_EXTENSIONS = (*_WITHOUT_UNIT, *_WITH_CHANNELS, *_WITH_UNIT)
_OF_MANY_PROGRAMS = (".dat", ".asc", ".csv", ".txt", ".xyz")
_HEADER_BYTES = 4096  # of a text

# R.m.s. slopes of surfaces are from a hundredth to a few; of pixels in nm taken for µm, a thousandth of that.
_MIN_SLOPE, _MAX_SLOPE = 3e-3, 30.0
_COARSE_PIXEL = 1.0  # µm; interferometers see polished surfaces with larger ones, but not what diffracts light
_UNITS = "unit (unit=um,unit=m: lateral lengths in µm, heights in m)"
_RANGE = "height_range, in µm,"


def read_height_field(
    path: str | os.PathLike[str],
    pixel_size: float | tuple[float, float] | None = None,
    height_range: float | None = None,
    fill_missing: bool = False,
    *,
    channel: str | int | None = None,
    unit: str | tuple[str, str] | None = None,
    keep_missing: bool = False,
) -> HeightField:
    """Read a height field.

    | format | contents | required arguments |
    |---|---|---|
    | .npy | floats are µm, or `unit`; integers run over the full range of their type | pixel_size; integers: \
        height_range |
    | .npz | array `heights`, as .npy, and optionally `pixel_size` in µm, one number or (x, y) | as .npy |
    | .png, .tif, .tiff | 8 or 16 bit grey; colour if grey and opaque but for annotation | pixel_size, height_range |
    | .tif, .tiff | 32 bit float, µm, or `unit` | pixel_size |
    | .tif | relief that `design` wrote | |
    | .tif, .tiff | Park Systems, with the extra `instruments` | |
    | .gwy, .gsf | Gwyddion, Gwyddion Simple Field | unit, if the file has none |
    | .sxm | Nanonis | |
    | .xyz | points x y z on a regular grid | unit, if it has none |
    | .asc, .txt | table of heights by Gwyddion, SPIP or Nanoscope Analysis, ESRI grid | unit and pixel_size, if it \
        has none |
    | .asc, .xyz | Wyko ASCII, Zygo XYZ | |
    | .csv, .txt | points or a table of heights, after a line of names or none | unit; pixel_size of a table |
    | .spm, .000, .nid, .ibw, .sdf, .x3p, … | instrument formats, with the extra `instruments` | |

    Args:
        path: the file; its extension determines the format, or its content if the extension is unknown.
        pixel_size: µm, one number or (x, y). Overrides the pixel size of the file; required if the file has none.
        height_range: height of the full range of the integer type (black to white), µm; heights start at zero.
            For integers only. Overrides the range of the file.
        fill_missing: interpolate NaN or infinite pixels (`heightfield.harmonic_fill`), do not refuse them; `source`
            and `filled` of the height field report their number.
        channel: of a file with several (.gwy and instrument formats), by name or number. None selects the one that
            holds lengths, or the first one named height or topography; `source` reports which.
        unit: of lengths, e.g. "nm", for a file without one; ("um", "nm") if lateral lengths and heights differ, of
            which the second overrides the unit in the file. `pixel_size` is in µm in any case.
        keep_missing: keep missing pixels as NaN, for the steps of `prepare`.

    Returns:
        The heights in µm, row by row as in the image.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if the file or the arguments are invalid, or the pixels or the field are too small or too large for
            a scan; one line that names the file.

    Warns:
        UserWarning: if the heights are too small or too large for a scan, or if the file contradicts itself about its
            pixel size.
    """
    path = Path(path)
    check_file(path)
    hint = f"; on the command line: {path.name},pixel_size=…"
    try:
        # Numbers that overflow become infinite, and are refused as missing pixels or invalid lengths.
        with np.errstate(over="ignore", invalid="ignore"):
            scan = _read(path, channel, unit)
            integers = scan.numbers.dtype.kind in "iu"
            height_range = scan.height_range if height_range is None else height_range
            if pixel_size is None and scan.pixel_size is None and height_range is None and integers:
                raise RequestError(
                    f"pixel_size, height_range: both missing for {scan.numbers.dtype} heights, wanted one number or "
                    f"(x, y) in µm, and the height in µm from black to white{hint},height_range=…"
                )
            heights = _as_micrometres(scan.numbers, height_range)
        if not (fill_missing or keep_missing) and scan.numbers.dtype.kind in "iu" and np.ma.is_masked(scan.numbers):
            fraction = np.ma.getmaskarray(scan.numbers).mean()
            raise RequestError(
                f"{fraction:.2%} of the pixels are coloured, annotation on a grey picture; they can be "
                "treated as missing, and fill_missing interpolates them from their surroundings"
            )
        is_given = pixel_size is not None
        doubt = "" if is_given else scan.doubt
        pixel_size = scan.pixel_size if pixel_size is None else pixel_size
        if pixel_size is None:
            raise RequestError(f"pixel_size: the file has none, wanted one number or (x, y) in µm{hint}")
        source = f"{path.name}, {scan.channel[:_MAX_TITLE]}" if scan.channel else path.name
        field = HeightField(heights, pixel_size, source, fill_missing=fill_missing, keep_missing=keep_missing)
        _check_scale(field, not keep_missing, _RANGE if integers else _UNITS)
        if is_given:
            _doubt_pixel_size(field)
    # Pillow raises OSError for a damaged image, the system for unreadable paths (a folder, permissions).
    except (RequestError, OSError, MemoryError) as error:
        raise RequestError(f"{path}: {textwrap.shorten(str(error), _MAX_QUOTE, placeholder=' …')}") from error
    if doubt:
        warnings.warn(f"{source}: {doubt}; pixel_size, in µm, sets another scale", stacklevel=2)
    if scan.doubt_of_heights:
        warnings.warn(f"{source}: {scan.doubt_of_heights}; {_UNITS} sets another", stacklevel=2)
    return field


def _check_scale(field: HeightField, levelled: bool, remedy: str) -> None:
    """Refuse pixels or a size that no scan has, and warn of such heights; one still to be levelled may be tilted."""
    (x, y), size = field.pixel_size, max(field.tile_size)
    if not is_possible_size(field.pixel_size, field.shape):
        raise RequestError(
            f"pixel_size: got {x:.4g} × {y:.4g} µm, a field of {size:.4g} µm, wanted pixels of {MIN_PIXEL:g} to "
            f"{MAX_PIXEL:g} µm and at most {MAX_FIELD:g} µm: is their unit right? pixel_size, in µm, "
            "sets them"
        )
    height_range = float(np.nanmax(field.heights) - np.nanmin(field.heights))
    if 0 < height_range < MIN_HEIGHT_RANGE or (levelled and height_range > MAX_HEIGHT_RANGE):
        warnings.warn(
            f"{field.source}: got heights of a range of {height_range:.3g} µm, wanted {MIN_HEIGHT_RANGE:g} to "
            f"{MAX_HEIGHT_RANGE:g} µm: is their unit right? {remedy} sets another",
            stacklevel=3,
        )


def _doubt_pixel_size(field: HeightField) -> None:
    """Warn of a pixel size that possible heights contradict, as one in nm does."""
    (x, y), heights = field.pixel_size, field.heights
    height_range = np.nanmax(heights) - np.nanmin(heights)
    slope = _rms_slope(field)
    contradicted = (slope < _MIN_SLOPE and max(x, y) > _COARSE_PIXEL) or slope > _MAX_SLOPE
    if contradicted and MIN_HEIGHT_RANGE <= height_range <= MAX_HEIGHT_RANGE:
        warnings.warn(
            f"{field.source}: pixel_size: got {x:.4g} × {y:.4g} µm for heights of a range of "
            f"{height_range:.3g} µm, an r.m.s. slope of {slope:.2g}: is it in µm?",
            stacklevel=3,
        )


def _rms_slope(field: HeightField) -> float:
    """Return the r.m.s. slope of a height field, 0 of missing pixels alone; by bands of rows, for the memory."""
    (x, y), (rows, columns) = field.pixel_size, field.shape
    sums, counts, band = np.zeros(2), np.zeros(2), max(1, _PIXELS_PER_BAND // columns)
    for first in range(0, rows, band):
        part = field.heights[first : first + band + 1]
        for axis, step in enumerate((np.diff(part[:band], axis=1) / x, np.diff(part, axis=0) / y)):
            known = step[np.isfinite(step)]
            sums[axis] += known @ known
            counts[axis] += known.size
    return float(np.sqrt((sums / np.maximum(counts, 1)).sum()))


def _read(path: Path, channel: str | int | None, unit: str | tuple[str, str] | None) -> Scan:
    extension = path.suffix.lower()
    known = extension in _EXTENSIONS or instruments.format_of(extension) is not None
    if (not known or extension in _OF_MANY_PROGRAMS) and path.is_file():
        extension = _extension_of_content(path)
    if extension in (".tif", ".tiff") and (tag := images.private_tag(path, instruments.PRIVATE_TIFF)):
        extension = instruments.PRIVATE_TIFF[tag]
    instrument = instruments.format_of(extension) is not None
    if extension not in _EXTENSIONS and not instrument:
        raise RequestError(
            f"got the extension {path.suffix!r}, wanted one of {', '.join(_EXTENSIONS)}, or an instrument's: "
            f"{instruments.NAMES}"
        )
    if path.stat().st_size == 0:
        raise RequestError("the file is empty")
    if channel is not None and not (instrument or extension in _WITH_CHANNELS):
        raise RequestError(f"channel: got {channel!r} for {extension}, which holds one only")
    if instrument:
        return instruments.read_instrument(path, unit, channel, extension)
    if extension in _WITH_CHANNELS:
        return _WITH_CHANNELS[extension](path, unit, channel)
    if extension in _WITH_UNIT:
        return _WITH_UNIT[extension](path, unit)
    read = _WITHOUT_UNIT[extension](path)
    return read if unit is None else _in_unit(read, unit, extension)


def _in_unit(read: Scan, unit: str | tuple[str, str], extension: str) -> Scan:
    """Return a scan of a format without units whose lengths are in `unit`."""
    if read.numbers.dtype.kind != "f":
        raise RequestError(
            f"unit: got {unit!r} for integers in {extension}, wanted it without: their height_range is in µm"
        )
    along, high = (micrometres(name, "unit") for name in pair(unit))
    size = None if read.pixel_size is None else (along * read.pixel_size[0], along * read.pixel_size[1])
    return replace(read, numbers=read.numbers * high, pixel_size=size)


def _extension_of_content(path: Path) -> str:
    """Guess the format from the first bytes; if that fails, return the file's own extension."""
    with open(path, "rb") as stream:
        start = stream.read(_HEADER_BYTES)
    if start.startswith(UTF_16):
        start = decoded(start).encode()
    if text.is_gwyddion_export(start):
        return ".asc"
    found = next((extension for magic, extension in _MAGIC.items() if start.startswith(magic)), path.suffix.lower())
    if found == ".spm" and nanoscope.is_text(path):
        return nanoscope.TEXT
    return ".jpk-qi-data" if found == ".x3p" and workarounds.is_jpk(path) else found


def _as_micrometres(numbers: NDArray, height_range: float | None) -> NDArray[np.float64]:
    """Scale integers by the full range of their type, floats unchanged; (N_y, N_x) µm."""
    if numbers.dtype.kind not in "iuf":
        raise RequestError(f"got numbers of type {numbers.dtype}, wanted real floats in µm or integers")
    if numbers.ndim != 2 or numbers.size == 0:
        raise RequestError(f"got an array of shape {numbers.shape}, wanted (rows, columns), at least (1, 1)")
    if numbers.dtype.kind == "f":
        if height_range is not None:
            raise RequestError(
                f"height_range: got {height_range!r} for {numbers.dtype} heights, wanted none: they are in µm"
            )
        return numbers.astype(np.float64)
    if height_range is None:
        raise RequestError(
            f"height_range: missing for {numbers.dtype} heights, wanted the height in µm from black to white"
        )
    if not (is_number(height_range) and height_range > 0):
        raise RequestError(f"height_range: got {height_range!r}, wanted a positive number in µm")
    scale = np.iinfo(numbers.dtype)
    minimum, maximum = int(numbers.min()), int(numbers.max())
    if numbers.dtype.itemsize > 2 and 0 < (maximum - minimum) * 2**16 < scale.max - scale.min:
        raise RequestError(
            f"height_range: got {numbers.dtype} heights from {minimum} to {maximum}, a tiny part of the range of "
            "their type; wanted floats in µm, or a type that they fill, such as uint16"
        )
    heights = numbers.astype(np.float64)
    heights -= scale.min  # in place: each further array would take the memory of a large scan again
    heights /= float(scale.max) - scale.min
    heights *= float(height_range)
    return heights
