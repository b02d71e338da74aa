"""Refractive indices n + ik, from the tables of Mitsuba's `conductor` and those of this package (data/ior)."""

from __future__ import annotations

import functools
from difflib import get_close_matches
from importlib import metadata
from numbers import Complex
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import RequestError
from ..settings import VISIBLE

_OWN = Path(__file__).parents[1] / "data" / "ior"
_SYMBOLS = {
    **{"aluminium": "Al", "aluminum": "Al", "beryllium": "Be", "chrome": "Cr", "chromium": "Cr", "copper": "Cu"},
    **{"gold": "Au", "iridium": "Ir", "mercury": "Hg", "molybdenum": "Mo", "nickel": "Ni", "niobium": "Nb"},
    **{"rhodium": "Rh", "silver": "Ag", "tantalum": "Ta", "titanium": "Ti", "tungsten": "W", "vanadium": "V"},
}


def refractive_index(
    wavelength: float, *, int_ior: complex | None = None, material: str | None = None, known: bool = False
) -> complex:
    """Return n + ik of the medium below a surface.

    Args:
        wavelength: µm, in vacuum.
        int_ior: of a dielectric, or n + ik.
        material: a conductor by Mitsuba's name ("Al", "Au", …), or "Ti". The tables, linear between their wavelengths
            and constant outside, are read without loading Mitsuba.
        known: whether to refuse infrared and ultraviolet wavelengths outside the table.

    Raises:
        ValueError: if not exactly one of `int_ior` and `material` is given, or it is unknown or out of range.
    """
    if (int_ior is None) == (material is None):
        raise RequestError(f"int_ior, material: got {int_ior!r}, {material!r}, wanted one of the two")
    if material is None:
        number = complex(int_ior) if isinstance(int_ior, Complex) and not isinstance(int_ior, bool) else complex("nan")
        if not (0.01 <= abs(number) <= 100 and number.real >= 0 and number.imag >= 0):
            raise RequestError(f"int_ior: got {int_ior!r}, wanted a refractive index, a number or n + ik with k ≥ 0")
        return number
    data = Path(str(metadata.distribution("mitsuba").locate_file("mitsuba/data/ior")))
    wavelengths, n, k = conductor(material, data)
    min_wavelength, max_wavelength = min(wavelengths[0], VISIBLE[0] * 1e-3), max(wavelengths[-1], VISIBLE[1] * 1e-3)
    if known and not min_wavelength * (1 - 1e-6) <= wavelength <= max_wavelength * (1 + 1e-6):
        raise RequestError(
            f"material: got {material!r} at {wavelength * 1e3:g} nm, wanted a wavelength from "
            f"{min_wavelength * 1e3:.4g} to {max_wavelength * 1e3:.4g} nm, where its index is known; elsewhere give "
            "n + ik as int_ior"
        )
    return complex(np.interp(wavelength, wavelengths, n), np.interp(wavelength, wavelengths, k))


def _near(name: str, known: list[str]) -> list[str]:
    """Return the names in `known` that may be meant: those of the same element or beginning, or of similar spelling."""
    lower = name.lower()
    if lower in _SYMBOLS:
        return [other for other in known if other.partition("_")[0] == _SYMBOLS[lower]]
    same = [other for other in known if other.lower().startswith(lower)]
    first = max((other for other in known if len(other) > 1 and lower.startswith(other.lower())), key=len, default=None)
    return [first] if first else same[:3] or get_close_matches(name, known)


@functools.cache
def conductor(material: str, folder: Path) -> tuple[NDArray[np.float64], ...]:
    """Return the table of a conductor from Mitsuba's folder of indices: wavelengths in µm, n and k, (J,) each."""
    tables = [path for at in (_OWN, folder) for path in at.glob("*.eta.spd")]
    folders = {path.name.removesuffix(".eta.spd"): path.parent for path in tables}
    known = sorted(folders)
    if material not in known:
        wanted = f"one of {', '.join(known) or 'none: no tables found'}"
        if near := _near(str(material), known):
            wanted = " or ".join(near)
        raise RequestError(f"material: got {material!r}, {'did you mean' if near else 'wanted'} {wanted}")
    (nm, n), (nm_k, k) = (np.loadtxt(folders[material] / f"{material}.{part}.spd").T for part in ("eta", "k"))
    return nm * 1e-3, n, np.interp(nm, nm_k, k)
