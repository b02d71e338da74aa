"""Refractive indices n + ik, as Mitsuba's `conductor` has them."""

from __future__ import annotations

import functools
from importlib import metadata
from numbers import Complex
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import RequestError


def refractive_index(wavelength: float, *, int_ior: complex | None = None, material: str | None = None) -> complex:
    """n + ik of what lies below a surface.

    Args:
        wavelength: µm, in vacuum.
        int_ior: of a dielectric, or n + ik.
        material: a conductor by Mitsuba's name ("Al", "Au", …): the tables that come with Mitsuba, linear between their
            wavelengths and constant beyond them, are read without loading it.

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
    return complex(np.interp(wavelength, wavelengths, n), np.interp(wavelength, wavelengths, k))


@functools.cache
def conductor(material: str, folder: Path) -> tuple[NDArray[np.float64], ...]:
    """The table of a conductor in Mitsuba's folder of indices: wavelengths in µm, n and k there, (J,) each.

    Raises:
        ValueError: if there is none of that name.
    """
    known = sorted(path.name.removesuffix(".eta.spd") for path in folder.glob("*.eta.spd"))
    if material not in known:
        close = [name for name in known if name.lower().startswith(str(material)[:2].lower())]
        raise RequestError(
            f"material: got {material!r}, "
            + (f"did you mean {' or '.join(close)}? " if close else "")
            + f"wanted one of {', '.join(known) or 'none: no tables found'}"
        )
    (nm, n), (nm_k, k) = (np.loadtxt(folder / f"{material}.{part}.spd").T for part in ("eta", "k"))
    return nm * 1e-3, n, np.interp(nm, nm_k, k)
