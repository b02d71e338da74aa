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
    KnownRange,
    RefractiveIndex,
    constant,
    index_of,
    is_dispersive,
    is_file,
)
from ..settings import VISIBLE
from .base import nested_plugin, parts
from .device_tables import PacketTable, integer_part, limited, opaque

MAX_INDEX_NODES = 200_000  # 1 nm apart for tables that end at 200 µm
_TRIED = 32  # points along u and v, at least, at which a texture of an index is checked
_MAX_TRIED = 2048


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
                f"{name}: got {index}, with k up to {found.max_k(VISIBLE):.3g}, wanted a transparent medium; "
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
    """n + ik relative to the medium outside, linear between equidistant wavelengths; constant outside of its table."""

    def __init__(self, index: RefractiveIndex, outside: float) -> None:
        grid = nodes_of(index)
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


def known_spectrum(name: str, texture: mi.Texture) -> KnownRange:
    """Return where η or k is known: a spectrum that lists values is black outside of them, others have no end."""
    shortest, longest = 0.0, np.inf
    if "values" in mi.traverse(texture):
        shortest, longest = texture.wavelength_range()
    for part in parts(texture, mi.Texture):
        low, high = known_spectrum(name, part).wavelengths
        shortest, longest = max(shortest, low), min(longest, high)
    return KnownRange(name, "its spectrum", (float(shortest), float(longest)))


def check_spectra(eta: mi.Texture, k: mi.Texture) -> None:
    """Check η + ik at the pixels of pictures, and at wavelengths 1 nm apart where both are known.

    Mitsuba's textures take any number when parameters change.

    Raises:
        RequestError: if it is no index: negative, not a number, or out of range.
    """
    ranges = [known_spectrum(name, texture).wavelengths for name, texture in (("eta", eta), ("k", k))]
    first, last = max(low for low, _ in ranges), min(high for _, high in ranges)
    first, last = first or VISIBLE[0], last if np.isfinite(last) else VISIBLE[1]
    shape, count = (1, 1), int(np.clip(last - first, 1, MAX_INDEX_NODES))
    if eta.is_spatially_varying() or k.is_spatially_varying():
        shape = tuple(np.clip(np.maximum(eta.resolution(), k.resolution()), _TRIED, _MAX_TRIED))
        count = int(np.prod(shape))
    index = np.arange(count)
    si = dr.zeros(mi.SurfaceInteraction3f, count)
    si.uv = mi.Point2f((index % shape[0] + 0.5) / shape[0], (index // shape[0] % shape[1] + 0.5) / shape[1])
    # In an order that has nothing to do with the pixels, and between the ends, where tables are black.
    fraction = (index + 0.5) / count if shape == (1, 1) else (index * 0.6180339887 + 0.5) % 1
    si.wavelengths = type(si.wavelengths)(mi.Float(first + (last - first) * fraction))
    size: float | np.ndarray = 0.0
    for name, texture in (("eta", eta), ("k", k)):
        values = np.array(dr.detach(texture.eval(si)[0]))
        if (bad := values[~((values >= 0) & (values <= MAX_INDEX))]).size:
            raise RequestError(f"{name}: got {bad[0]:g}, wanted 0 to {MAX_INDEX:g}")
        size = np.hypot(size, values)
    if np.min(size) < MIN_INDEX:
        raise RequestError(f"eta: got an index eta + ik of {np.min(size):g}, wanted {MIN_INDEX:g} to {MAX_INDEX:g}")
