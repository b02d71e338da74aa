"""Units of length in instrument files, in µm."""

from __future__ import annotations

from ...errors import RequestError

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
    """Whether this is a unit of length."""
    return unit.strip() in _MICROMETRES


def micrometres(unit: str, what: str) -> float:
    """One of `unit` in µm.

    Raises:
        ValueError: if it is not a unit of length.
    """
    if not (isinstance(unit, str) and is_length(unit)):
        raise RequestError(f"{what}: got the unit {unit!r}, wanted a length ({UNITS})")
    return _MICROMETRES[unit.strip()]


def pair(unit: str | tuple[str, str] | None) -> tuple[str, str]:
    """The given units of lateral lengths and heights; empty if none.

    Raises:
        ValueError: if it is neither one unit of length nor two.
    """
    if unit is None:
        return "", ""
    units = (unit, unit) if isinstance(unit, str) else unit
    if not (isinstance(units, tuple | list) and len(units) == 2):
        raise RequestError(f"unit: got {unit!r}, wanted a unit of length, or two: along the surface and of the heights")
    for one in units:
        micrometres(one, "unit")
    return units[0], units[1]
