"""Refractive indices of a scene: read from its parameters, and at run time over the wavelength."""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
import numpy as np

from ..errors import RequestError, is_number
from ..optics.refractive_indices import (
    DISPERSION,
    MAX_INDEX,
    MIN_INDEX,
    KnownRange,
    RefractiveIndex,
    constant,
    index_of,
    is_dispersive,
    is_file,
    max_index,
)
from ..settings import VISIBLE
from .device_tables import PacketTable, integer_part, limited, on_device, opaque
from .mitsuba_internals import nested_plugin, parts

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


class Dispersion:
    """n + ik of media relative to the one outside, linear between equidistant wavelengths; constant outside of them."""

    def __init__(self, media: Sequence[RefractiveIndex], outside: float) -> None:
        grid = nodes_of(*media)
        values = np.stack([index(grid * 1e-3) for index in media]) / outside
        self.table = PacketTable(np.stack([values.real, values.imag], -1), width=2)
        self.first, self.last = opaque(grid[0]), opaque(len(grid) - 1)
        self.per_nanometre = opaque((len(grid) - 1) / (grid[-1] - grid[0]))

    def position(self, wavelength: mi.Float) -> tuple[mi.UInt32, mi.Float]:
        """Return the node below a wavelength in vacuum, nm, and the distance from it in steps."""
        x = limited((wavelength - self.first) * self.per_nanometre, 0, self.last)
        node = dr.minimum(integer_part(x), integer_part(self.last) - 1)
        return node, x - mi.Float(mi.Int32(node))

    def index_at(self, position: tuple[mi.UInt32, mi.Float], medium: mi.UInt32 | None = None) -> mi.Complex2f:
        """Return n + ik at a `position`, of the first medium by default."""
        node, fraction = position
        if medium is not None:
            node = medium * (integer_part(self.last) + 1) + node
        return mi.Complex2f(*dr.lerp(self.table(node), self.table(node + 1), fraction))

    def __call__(self, wavelength: mi.Float) -> mi.Complex2f:
        """Return n + ik of the first medium at wavelengths in vacuum, nm."""
        return self.index_at(self.position(wavelength))


def nodes_of(*media: RefractiveIndex) -> np.ndarray:
    """Return equidistant wavelengths of tables and visible light, at most 1 nm apart unless there are too many, nm."""
    (first, last), max_nodes = VISIBLE, 10 * MAX_INDEX_NODES // max(10, len(media))
    for start, end in (index.range for index in media):
        if start:
            first, last = min(first, np.ceil(start)), max(last, np.floor(end))
    return np.linspace(first, last, min(round(last - first), max_nodes) + 1)


def range_of_texture(name: str, texture: mi.Texture) -> KnownRange:
    """Return where η or k is known: a spectrum that lists values is black outside of them, others have no end."""
    shortest, longest = 0.0, np.inf
    if "values" in mi.traverse(texture):
        shortest, longest = texture.wavelength_range()
    for part in parts(texture, mi.Texture):
        low, high = range_of_texture(name, part).wavelengths
        shortest, longest = max(shortest, low), min(longest, high)
    return KnownRange(name, "its spectrum", (float(shortest), float(longest)))


def check_eta_and_k(eta: mi.Texture, k: mi.Texture, *known: KnownRange) -> None:
    """Check η + ik at the pixels of pictures, and at wavelengths 1 nm apart where both are `known`.

    Mitsuba's textures take any number when parameters change.

    Raises:
        RequestError: if it is no index: negative, not a number, or out of range.
    """
    lows, highs = zip(*(of_one.wavelengths for of_one in known), strict=True)
    first, last = max(lows), min(highs)
    first, last = first or VISIBLE[0], last if np.isfinite(last) else VISIBLE[1]
    shape, count = (1, 1), int(np.clip(last - first, 1, MAX_INDEX_NODES))
    if eta.is_spatially_varying() or k.is_spatially_varying():
        shape = tuple(np.clip(np.maximum(eta.resolution(), k.resolution()), _TRIED, _MAX_TRIED))
        count = int(np.prod(shape))
    index = np.arange(count)
    si = dr.zeros(mi.SurfaceInteraction3f, count)
    u, v = (index % shape[0] + 0.5) / shape[0], (index // shape[0] % shape[1] + 0.5) / shape[1]
    si.uv = mi.Point2f(on_device(u), on_device(v))
    # In an order that has nothing to do with the pixels, and between the ends, where tables are black.
    fraction = (index + 0.5) / count if shape == (1, 1) else (index * 0.6180339887 + 0.5) % 1
    wavelengths = first + (last - first) * fraction
    si.wavelengths = type(si.wavelengths)(on_device(wavelengths))
    size: float | np.ndarray = 0.0
    limit = max_index(1e-3 * wavelengths)
    for name, texture in (("eta", eta), ("k", k)):
        values = np.array(dr.detach(texture.eval(si)[0]))
        if (bad := np.flatnonzero(~((values >= 0) & (values <= limit)))).size:
            raise RequestError(f"{name}: got {values[bad[0]]:g}, wanted 0 to {limit[bad[0]]:g}")
        size = np.hypot(size, values)
    if np.min(size) < MIN_INDEX:
        raise RequestError(f"eta: got an index eta + ik of {np.min(size):g}, wanted {MIN_INDEX:g} to {MAX_INDEX:g}")
