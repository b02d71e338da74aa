"""The tables of a shader as a file (.npz) for the node group of assets/blender, which needs NumPy alone to read it."""

from __future__ import annotations

import os
import zipfile

import numpy as np

from ..files.outputs import MARK
from ..files.writing import whole_file
from .shader_tables import ShaderTables
from .working_spaces import WORKING_SPACES, nonnegative_colours

_FORMAT = 1  # raised when a group of an earlier version would read a file wrongly


def write_node_tables(tables: ShaderTables, path: str | os.PathLike[str]) -> None:
    """Write the arrays of `ShaderTables` by name, without those that are None, and non-negative colours.

    `colours` are (working spaces, bins, 3), `spaces` their names and `matrices` from linear sRGB.
    """
    arrays = {name: value for name, value in vars(tables).items() if value is not None}
    arrays |= {
        "format": _FORMAT,
        "spaces": np.array(list(WORKING_SPACES)),
        "matrices": np.stack(list(WORKING_SPACES.values())),
        "signed_colours": tables.colours,
        "colours": nonnegative_colours(tables.edges, tables.colours),
        "max_height_scale": tables.max_height_scale,
    }
    single = {k: v.astype(np.float32) if getattr(v, "dtype", None) == np.float64 else v for k, v in arrays.items()}
    with whole_file(path) as temporary:
        np.savez_compressed(temporary, **single)
        with zipfile.ZipFile(temporary, "a") as archive:
            archive.comment = MARK.encode()
