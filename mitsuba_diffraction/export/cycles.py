"""A shader for Blender's Cycles (.osl): its tables are arrays in its text.

Arrays are parameters of the shader: their values then cost nothing when it runs, and Blender shows no sockets for them.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from ..array_types import Real
from ..files.outputs import MARK
from ..files.writing import whole_file
from .shader_tables import ShaderTables
from .working_spaces import WORKING_SPACES

_ASSETS = Path(__file__).parent / "assets"


def write_shader(tables: ShaderTables, path: str | os.PathLike[str]) -> None:
    """Write the shader of these tables."""
    arrays: dict[str, tuple[str, Real]] = {
        "Edges": ("float", tables.edges),
        "Colours": ("color", tables.colours),
        "Eta": ("float", tables.index.real),
        "Absorption": ("float", tables.index.imag),
        "Powers": ("float", tables.powers),
    }
    numbers: dict[str, object] = {"bins": len(tables.colours), "width": f"{tables.lobe_width:.6g}"}
    if tables.columns is None or tables.rows is None or tables.albedo is None:
        assert tables.frequencies is not None
        arrays |= {"Frequencies": ("float", tables.frequencies)}
        choice = "orders"
        numbers |= {"count": len(tables.powers)}
    else:
        arrays |= {"Rows": ("float", tables.rows), "Columns": ("float", tables.columns)}
        arrays |= {"Albedo": ("float", tables.albedo)}
        choice = "continuum"
        numbers |= {"columns": tables.columns.shape[1] - 1, "cells": len(tables.powers)}
        numbers |= dict(zip(("lights", "azimuths", "cosines"), tables.albedo.shape, strict=True))
    numbers |= {
        "slices": tables.powers.shape[-1],
        "max_kappa": f"{tables.max_kappa:.9g}",
        "max_scale": f"{tables.max_height_scale:.3g}",
        "entering": f"{tables.entering:.4g}",
        "to_rec2020": _product(WORKING_SPACES["Linear Rec.2020"]),
        "to_acescg": _product(WORKING_SPACES["ACEScg"]),
        "mark": MARK,
        "what": tables.what,
        "name": re.sub(r"\W", "_", f"diffraction_{Path(path).stem}", flags=re.ASCII),
        "arrays": "\n".join(_parameter(name, kind, values) for name, (kind, values) in arrays.items()),
    }
    text = _filled("cycles.osl", {**numbers, "choice": _filled(f"{choice}.osl", numbers).rstrip()})
    with whole_file(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def _filled(name: str, values: Mapping[str, object]) -> str:
    """Return a template with its places filled in."""
    text = (_ASSETS / name).read_text(encoding="utf-8")
    return re.sub(r"\{\{(\w+)\}\}", lambda found: str(values[found[1]]), text)


def _product(matrix: Real) -> str:
    """Return the product of a matrix and the colour c."""
    rows = ("dot(vector({:.6g}, {:.6g}, {:.6g}), vector(c))".format(*row) for row in matrix)
    return f"color({', '.join(rows)})"


def _parameter(name: str, kind: str, values: ArrayLike) -> str:
    """Return an array as a parameter of the shader."""
    flat = [f"{x:.6g}" for x in np.ravel(values)]
    if kind == "color":
        flat = [f"color({r}, {g}, {b})" for r, g, b in zip(flat[::3], flat[1::3], flat[2::3], strict=True)]
    lines = [", ".join(flat[start : start + 16]) for start in range(0, len(flat), 16)]
    return f"    {kind} {name}[{len(flat)}] = {{\n        " + ",\n        ".join(lines) + "\n    },"
