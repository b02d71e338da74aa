"""The contents of a scan file, units of length, and the choice among several channels."""

from __future__ import annotations

import codecs
from collections.abc import Sequence
from dataclasses import dataclass

from numpy.typing import NDArray

from ...errors import RequestError, pip_install
from ...settings import Settings

EXTRA = pip_install("instruments")

# What a scan that diffracts light can be, µm; outside, a unit is wrong.
MIN_HEIGHT_RANGE, MAX_HEIGHT_RANGE = 2e-4, Settings.largest_height_range
MIN_PIXEL, MAX_PIXEL, MAX_FIELD = 1e-4, 100.0, 5e4

_MICROMETRES = {
    "m": 1e6,
    "cm": 1e4,
    "mm": 1e3,
    "um": 1.0,
    "µm": 1.0,  # micro sign
    "μm": 1.0,  # Greek mu
    "micron": 1.0,
    "nm": 1e-3,
    "Å": 1e-4,
    "\N{ANGSTROM SIGN}": 1e-4,
    "Angstrom": 1e-4,
    "pm": 1e-6,
}
UNITS = "m, cm, mm, um, nm, Å, pm"


def is_length(unit: str) -> bool:
    """Return whether this is a unit of length."""
    return unit.strip() in _MICROMETRES


def micrometres(unit: str, what: str) -> float:
    """Return the length of one `unit` in µm."""
    if not (isinstance(unit, str) and is_length(unit)):
        raise RequestError(f"{what}: got the unit {unit!r}, wanted a length ({UNITS})")
    return _MICROMETRES[unit.strip()]


def is_possible_size(pixel_size: tuple[float, float], shape: tuple[int, int]) -> bool:
    """Return whether a scan can have these pixels, (x, y) µm, and this size; `shape` is (rows, columns)."""
    (x, y), (rows, columns) = pixel_size, shape
    return min(x, y) >= MIN_PIXEL and max(x, y) <= MAX_PIXEL and max(x * columns, y * rows) <= MAX_FIELD


def scale(own: str, given: str, what: str) -> float:
    """Return the unit of a file, or else the given one, in µm."""
    if not (own or given):
        raise RequestError(
            f"unit: the file names none for {what}, wanted one of {UNITS} (or two: along the surface, of the heights)"
        )
    return micrometres(own or given, what)


def scale_of_heights(own: str, unit: str | tuple[str, str] | None, what: str = "the heights") -> float:
    """Return the unit of the heights in µm: the second of two given ones, or that of the file, or the given one."""
    given = pair(unit)[1]
    return scale(own if unit is None or isinstance(unit, str) else "", given, what)


def pair(unit: str | tuple[str, str] | None) -> tuple[str, str]:
    """Return the given units of lateral lengths and heights; empty if none."""
    if unit is None:
        return "", ""
    units = (unit, unit) if isinstance(unit, str) else unit
    if not (isinstance(units, tuple | list) and len(units) == 2):
        raise RequestError(f"unit: got {unit!r}, wanted a unit of length, or two: along the surface and of the heights")
    for one in units:
        micrometres(one, "unit")
    return units[0], units[1]


UTF_16 = codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE
"""First bytes of such a text."""


def decoded(content: bytes) -> str:
    """Return a text in UTF-16 (with its mark), UTF-8, or else Latin-1, in which programs on Windows write µ and °."""
    if content.startswith(UTF_16):
        return content.decode("utf-16", errors="replace")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:
        return content.decode("latin-1")


# Names of the height channel in instrument files.
_HEIGHT_NAMES = ("height", "topograph", "z-axis", "zsensor", "z sensor")
_RETRACE = ("retrace", "backward")  # in the name of a channel whose lines were scanned on the way back


@dataclass(frozen=True)
class Scan:
    """The contents of a file.

    Attributes:
        numbers: (N_y, N_x); floats are µm, NaN or masked where missing; integers use the full range of their type.
        pixel_size: (x, y) in µm; None if the file has none.
        channel: the name of the channel, in formats with several.
        doubt: how the file contradicts itself about the pixel size, or leaves it in doubt.
        doubt_of_heights: the same, of the unit of the heights.
        height_range: of the full range of integers, µm; None if the file has none.
    """

    numbers: NDArray
    pixel_size: tuple[float, float] | None = None
    channel: str = ""
    doubt: str = ""
    height_range: float | None = None
    doubt_of_heights: str = ""


@dataclass(frozen=True)
class Channel:
    """A channel of a file: its number, its name, whether it holds lengths of an area, and whether it is a line."""

    number: int
    name: str
    is_length: bool
    is_line: bool = False

    def __str__(self) -> str:
        return f"{self.number} {self.name!r}"


def choose_channel(channels: Sequence[Channel], wanted: str | int | None) -> Channel:
    """Return the named channel, or the channel of the heights.

    Args:
        wanted: number, name or unique part of a name (case-insensitive). None selects the only channel of lengths, or
            the first one named as heights, trace before retrace.
    """
    if wanted is None:
        lengths = [channel for channel in channels if channel.is_length]
        named = [c for c in lengths if _is_height(c.name.lower())]
        if not lengths:
            lines = ", which are lines, such as a profile" if channels and all(c.is_line for c in channels) else ""
            raise RequestError(f"wanted a channel of heights in a unit of length, got {_listed(channels)}{lines}")
        if not named and len(lengths) > 1:
            raise RequestError(f"channel: which of {_listed(lengths)}?")
        return min(named or lengths, key=lambda channel: any(word in channel.name.lower() for word in _RETRACE))
    if isinstance(wanted, int) and not isinstance(wanted, bool):
        found = [channel for channel in channels if channel.number == wanted]
    elif isinstance(wanted, str):
        found = [channel for channel in channels if channel.name.lower() == wanted.lower()]
        found = found or [channel for channel in channels if wanted.lower() in channel.name.lower()]
        if not found and wanted.isdecimal():
            found = [channel for channel in channels if channel.number == int(wanted)]
    else:
        raise RequestError(f"channel: got {wanted!r}, wanted a name or a number")
    if len(found) != 1:
        raise RequestError(f"channel: got {wanted!r}, wanted one of {_listed(found or channels)}")
    if not found[0].is_length:
        what = "is a line, such as a profile; wanted heights of an area" if found[0].is_line else "holds no lengths"
        raise RequestError(f"channel: {found[0]} {what}")
    return found[0]


def _is_height(name: str) -> bool:
    return name.partition(" (")[0] == "z" or any(word in name for word in _HEIGHT_NAMES)


def _listed(channels: Sequence[Channel]) -> str:
    return ", ".join(map(str, channels)) or "none"
