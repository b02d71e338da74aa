"""Refractive indices of a scene: read from its parameters, and at run time over the wavelength."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..errors import RequestError, is_number
from ..optics.materials import (
    DISPERSION,
    MAX_INDEX,
    MIN_INDEX,
    RefractiveIndex,
    constant,
    index_of,
    is_dispersive,
    is_file,
)
from ..settings import VISIBLE
from .base import nested_plugin
from .device_tables import PacketTable, integer_part, limited, opaque

MAX_INDEX_NODES = 4000


def index_from(name: str, index: float | str, absorbing: bool = False) -> RefractiveIndex:
    """Return the absolute index of a parameter.

    Args:
        name: of the parameter, for messages.
        index: a number; a name of `DISPERSION`, or of a preset of Mitsuba's `dielectric`; or a file.
        absorbing: whether conductors and media that absorb light are valid, too.

    Raises:
        RequestError: if it is none of these.
    """
    if not isinstance(index, str):
        if not (is_number(index) and MIN_INDEX <= index <= MAX_INDEX):
            raise RequestError(
                f"{name}: got {index!r}, wanted a positive index of refraction, or a name such as 'bk7' "
                f"({MIN_INDEX:g} to {MAX_INDEX:g})"
            )
        return constant(_of_dielectric(float(index)))
    if is_dispersive(index):
        found = index_of(name, str(mi.file_resolver().resolve(index)) if is_file(index) else index)
        if found.absorbs and not absorbing:
            raise RequestError(
                f"{name}: got {index}, with k up to {found.values.imag.max():.3g}, wanted a transparent medium; "
                "give it as material"
            )
        return found
    try:
        return constant(_of_dielectric(index))
    except RuntimeError as error:
        known = str(error).partition("Valid choices are:")[2].strip()
    presets = [preset for preset in known.split(", ") if not is_dispersive(preset)]
    wanted = f"a number, a file or one of {', '.join([*DISPERSION, *presets])}"
    if not absorbing:
        raise RequestError(f"{name}: got {index!r}, wanted {wanted}")
    try:
        return index_of(name, index)
    except RequestError as error:
        reason = str(error).replace("material: ", f"{name}: ")
        raise RequestError(f"{reason}, a number, a name as for int_ior, or a file") from None


def _of_dielectric(index: float | str) -> float:
    """Return the index that Mitsuba's `dielectric` has for a number or the name of a preset."""
    interface = nested_plugin("dielectric", int_ior=index, ext_ior=1.0)
    return float(np.ravel(mi.traverse(interface)["eta"])[0])


def absolute_index(name: str, index: float | str) -> float:
    """Return the index of a medium whose dispersion is left out, such as the one outside."""
    return index_from(name, index).nominal.real


class Dispersion:
    """n + ik relative to the medium outside, linear between equidistant wavelengths; constant outside of its table.

    Attributes:
        wavelengths: (first, last) of the nodes, nm: the table and visible light.
    """

    def __init__(self, index: RefractiveIndex, outside: float) -> None:
        grid = nodes_of(index)
        self.wavelengths = float(grid[0]), float(grid[-1])
        values = index(grid * 1e-3) / outside
        self.table = PacketTable(np.stack([values.real, values.imag], -1), width=2)
        self.first, self.last = opaque(grid[0]), opaque(len(grid) - 1)
        self.per_nanometre = opaque((len(grid) - 1) / (grid[-1] - grid[0]))

    def __call__(self, wavelength: mi.Float) -> mi.Complex2f:
        """Return n + ik at wavelengths in vacuum, nm."""
        x = limited((wavelength - self.first) * self.per_nanometre, 0, self.last)
        node = dr.minimum(integer_part(x), integer_part(self.last) - 1)
        low, high = self.table(node), self.table(node + 1)
        return mi.Complex2f(*dr.lerp(low, high, x - mi.Float(mi.Int32(node))))


def nodes_of(index: RefractiveIndex) -> np.ndarray:
    """Return equidistant wavelengths of a table and visible light, at most 1 nm apart unless there are too many, nm."""
    first, last = index.range
    first, last = (min(VISIBLE[0], np.ceil(first)), max(VISIBLE[1], np.floor(last))) if first else VISIBLE
    return np.linspace(first, last, min(round(last - first), MAX_INDEX_NODES) + 1)
