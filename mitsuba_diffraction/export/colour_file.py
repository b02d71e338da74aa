"""A file of colours (.bin) for the material for three.js, which shades by them.

    "MDCF", the length of the header (uint32), a header in JSON, arrays

Numbers are little-endian. The header has the version of the format, the kind ("table" or "orders"), the numbers of
`ColourTable` or `OrderColours`, the frame of the surface, and names, types and shapes of the arrays, which follow each
other. Its length is a multiple of four.
"""

from __future__ import annotations

import json
import os
import re
from dataclasses import fields
from typing import Any

import numpy as np

from ..errors import RequestError
from ..files.outputs import MARK, plain
from ..files.writing import whole_file
from ..optics.media import MediumBelow
from .colour_table import ColourTable, OrderColours, Viewed, colours_of

_MAGIC = b"MDCF"
_VERSION = 3


def check_base(base: str | None, below: MediumBelow) -> None:
    """Refuse a base that is no colour, or below a medium that light does not cross.

    Raises:
        RequestError: if it is.
    """
    if base is not None and not re.fullmatch("#[0-9a-fA-F]{6}", base):
        raise RequestError(f"base: got {base}, wanted a colour such as #a0522d")
    if base is not None and not below.transparent:
        raise RequestError(f"base: got {base} below {below}, wanted a dielectric, such as int_ior=1.5")


def write_colours(
    viewed: Viewed, path: str | os.PathLike[str], orientation: float | str = 0.0, base: str | None = None
) -> ColourTable | OrderColours:
    """Write the colours of a surface in daylight and return them.

    Args:
        viewed: the surface in its media.
        path: of the file.
        orientation: degrees from the tangent along u to the pattern's x axis; or radial or tangential, of discs.
        base: colour below a dielectric, sRGB as in HTML, "#a0522d"; None for black.

    Raises:
        ValueError: if the base is wrong or lies below another material, or too many separate orders propagate.
    """
    check_base(base, viewed.below)
    colours = colours_of(viewed)
    arrays, numbers = {}, {}
    for field in fields(colours):
        value = getattr(colours, field.name)
        if isinstance(value, np.ndarray):
            arrays[field.name] = value.astype("<u4" if value.dtype == np.uint32 else "<f4")
        else:
            numbers[field.name] = value
    index = viewed.below.index_at(0.55)
    header: dict[str, Any] = {
        "format": MARK,
        "version": _VERSION,
        "kind": "table" if isinstance(colours, ColourTable) else "orders",
        "source": viewed.spectrum.source,
        "material": str(viewed.below),
        "illuminant": "CIE D65",
        "orientation": orientation,
        "base": base or "#000000",
        "index": index.real / viewed.coat if viewed.below.transparent else 1.0,
        "height_scale": viewed.height_scale,
        **numbers,
        "coat": viewed.coat,
        "min_cosine": float(np.cos(np.radians(viewed.spectrum.largest_angle))),
        "arrays": [
            {"name": name, "type": "uint32" if array.dtype == "<u4" else "float32", "shape": list(array.shape)}
            for name, array in arrays.items()
        ],
    }
    text = json.dumps(plain(header), ensure_ascii=True).encode()
    text += b" " * (-len(text) % 4)
    with whole_file(path) as temporary, open(temporary, "wb") as stream:
        stream.write(_MAGIC + len(text).to_bytes(4, "little") + text)
        for array in arrays.values():
            stream.write(array.tobytes())
    return colours
