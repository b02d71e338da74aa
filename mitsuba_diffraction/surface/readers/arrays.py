"""NumPy arrays (.npy, .npz); pickles are never loaded."""

from __future__ import annotations

import tokenize
import warnings
import zipfile
import zlib
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from ...errors import RequestError
from .scan import DAMAGED, MOST_BYTES, Scan


def read_npy(path: Path) -> Scan:
    """The array of a file."""
    with path.open("rb") as file:
        return Scan(_load_array(file))


def read_npz(path: Path) -> Scan:
    """The array `heights` of an archive, and its `pixel_size`, if any."""
    try:
        with zipfile.ZipFile(path) as archive:
            unpacked = max((member.file_size for member in archive.infolist()), default=0)
            if unpacked > MOST_BYTES:
                raise RequestError(f"got an array of {unpacked} bytes, wanted at most {MOST_BYTES}")
            names = [name.removesuffix(".npy") for name in archive.namelist()]
            if "heights" not in names:
                raise RequestError(f"got the arrays {names}, wanted 'heights' and optionally 'pixel_size'")
            with archive.open("heights.npy") as file:
                heights = _load_array(file)
            if "pixel_size" not in names:
                return Scan(heights)
            with archive.open("pixel_size.npy") as file:
                pixel_size = _load_array(file)
    except RequestError:
        raise
    except (zipfile.BadZipFile, EOFError, KeyError, NotImplementedError, RuntimeError, ValueError, zlib.error) as error:
        raise RequestError(f"not a whole .npz archive ({error})") from None
    if pixel_size.dtype.kind not in "iuf" or pixel_size.shape not in ((), (1,), (2,)):
        raise RequestError(
            f"pixel_size: got an array of type {pixel_size.dtype} and shape {pixel_size.shape}, "
            "wanted one number or (x, y) in µm"
        )
    values = tuple(float(value) for value in pixel_size.ravel())
    return Scan(heights, values if len(values) == 2 else values[0])


def _load_array(file: BinaryIO) -> NDArray:
    """An array in NumPy's format; pickles are refused."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", UserWarning)
            return np.lib.format.read_array(file, allow_pickle=False)
    except (*DAMAGED, ValueError, MemoryError, tokenize.TokenError) as error:
        raise RequestError(f"not an array that can be read ({error})") from None
