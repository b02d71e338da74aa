"""Height fields from files: NumPy arrays, grey PNG and TIFF pictures.

Row 0 of a file is row 0 of `heights`, so the top row of a picture lies at the lowest y (row ↔ +y, column ↔ +x).
"""

from __future__ import annotations

import os
import struct
import tokenize
import warnings
import zipfile
import zlib
from collections.abc import Callable
from numbers import Real
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from .heightfield import HeightField

_Read = tuple[NDArray, object]
"""What stands in a file: the numbers, and the pixel size where the file has it (else None)."""

_SHOWN = 300
"""Longest text of an error, characters, that is passed on: a header gone bad is quoted whole by some libraries."""

_MOST_BYTES = 2**31
"""Largest array that is unpacked from an archive."""


def read_height_field(
    path: str | os.PathLike[str],
    pixel_size: float | tuple[float, float] | None = None,
    height_range: float | None = None,
    fill_missing: bool = False,
) -> HeightField:
    """Read a height field.

    | format | numbers | height_range |
    |---|---|---|
    | .npy | floats are µm; integers run over the full range of their type | integers: required; floats: refused |
    | .npz | array `heights`, as .npy, and optionally `pixel_size` in µm, one number or (x, y) | as .npy |
    | .png, .tif, .tiff | 8 or 16 bit grey; colour is accepted where it is grey and opaque | required |
    | .tif, .tiff | 32 bit float, µm | refused |

    Args:
        path: the file; its extension names the format.
        pixel_size: µm, one number or (x, y). Goes before that of the file; required where the file has none.
        height_range: from the least to the greatest number that the integer type holds (black to white), µm. The
            heights start at zero there.
        fill_missing: fill the pixels that are NaN or infinite from their surroundings (`missing.fill_missing`), not
            refuse them. `source` and `filled` of the height field tell how many they were.

    Returns:
        The heights, row by row as they stand in the file.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if the file or the arguments are wrong; one line that names the file.
    """
    path = Path(path)
    try:
        return _read(path, pixel_size, height_range, fill_missing)
    except FileNotFoundError:
        raise
    # OSError is what Pillow raises for a damaged picture, and the system for what cannot be read (a folder, rights).
    except (ValueError, OSError) as error:
        raise ValueError(" ".join(f"{path}: {str(error)[:_SHOWN]}".split())) from error


def _read(path: Path, pixel_size: object, height_range: object, fill_missing: object) -> HeightField:
    extension = path.suffix.lower()
    if extension not in _FORMATS:
        raise ValueError(f"got the extension {path.suffix!r}, wanted one of {', '.join(_FORMATS)}")
    if path.stat().st_size == 0:
        raise ValueError("the file is empty")
    numbers, own_pixel_size = _FORMATS[extension](path)
    heights = _as_micrometres(numbers, height_range)
    pixel_size = own_pixel_size if pixel_size is None else pixel_size
    if pixel_size is None:
        raise ValueError("pixel_size: the file has none, wanted one number or (x, y) in µm")
    return HeightField(heights, pixel_size, source=path.name, fill_missing=fill_missing)


def _as_micrometres(numbers: NDArray, height_range: object) -> NDArray[np.float64]:
    """Integers scaled by the full range of their type, floats as they are; (N_y, N_x) µm."""
    if numbers.dtype.kind not in "iuf":
        raise ValueError(f"got numbers of type {numbers.dtype}, wanted real floats in µm or integers")
    if numbers.ndim != 2 or numbers.size == 0:
        raise ValueError(f"got an array of shape {numbers.shape}, wanted (rows, columns), at least (1, 1)")
    if numbers.dtype.kind == "f":
        if height_range is not None:
            raise ValueError(
                f"height_range: got {height_range!r} for {numbers.dtype} heights, wanted none: they are in µm"
            )
        return numbers.astype(np.float64)
    if height_range is None:
        raise ValueError(
            f"height_range: missing for {numbers.dtype} heights, wanted the height in µm from black to white"
        )
    if isinstance(height_range, bool) or not isinstance(height_range, Real):
        raise ValueError(f"height_range: got {height_range!r}, wanted a number in µm")
    if not (np.isfinite(height_range) and height_range > 0):
        raise ValueError(f"height_range: got {height_range!r}, wanted a positive number in µm")
    scale = np.iinfo(numbers.dtype)
    return (numbers.astype(np.float64) - scale.min) / (float(scale.max) - scale.min) * float(height_range)


# ---------------------------------------------------------------- formats

_DAMAGED = (SyntaxError, TypeError, KeyError, EOFError, IndexError, OverflowError, struct.error, UserWarning)
"""What Pillow and NumPy raise, besides OSError and ValueError, when the bytes of a file are wrong."""


def _read_npy(path: Path) -> _Read:
    with path.open("rb") as file:
        return _load_array(file), None


def _read_npz(path: Path) -> _Read:
    try:
        with zipfile.ZipFile(path) as archive:
            unpacked = max((member.file_size for member in archive.infolist()), default=0)
            if unpacked > _MOST_BYTES:
                raise ValueError(f"got an array of {unpacked} bytes, wanted at most {_MOST_BYTES}")
            names = [name.removesuffix(".npy") for name in archive.namelist()]
            if "heights" not in names:
                raise ValueError(f"got the arrays {names}, wanted 'heights' and optionally 'pixel_size'")
            with archive.open("heights.npy") as file:
                heights = _load_array(file)
            if "pixel_size" not in names:
                return heights, None
            with archive.open("pixel_size.npy") as file:
                pixel_size = _load_array(file)
    except (zipfile.BadZipFile, EOFError, KeyError, NotImplementedError, RuntimeError, zlib.error) as error:
        raise ValueError(f"not a whole .npz archive ({error})") from None
    if pixel_size.dtype.kind not in "iuf" or pixel_size.shape not in ((), (1,), (2,)):
        raise ValueError(
            f"pixel_size: got an array of type {pixel_size.dtype} and shape {pixel_size.shape}, "
            "wanted one number or (x, y) in µm"
        )
    values = tuple(float(value) for value in pixel_size.ravel())
    return heights, values if len(values) == 2 else values[0]


def _load_array(file: object) -> NDArray:
    """An array in NumPy's format, without pickles."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", UserWarning)
            return np.lib.format.read_array(file, allow_pickle=False)
    except (*_DAMAGED, ValueError, MemoryError, tokenize.TokenError) as error:
        raise ValueError(f"not an array that can be read ({error})") from None


def _read_picture(path: Path) -> _Read:
    with warnings.catch_warnings():
        # What Pillow only warns of (pictures that unpack to a great size, damaged metadata) is an error here.
        warnings.simplefilter("error", Image.DecompressionBombWarning)
        warnings.simplefilter("error", UserWarning)
        try:
            with Image.open(path, formats=("PNG", "TIFF")) as picture:
                pages = getattr(picture, "n_frames", 1)
                if pages != 1:
                    raise ValueError(f"got {pages} pages or frames, wanted one")
                return _numbers_of(picture), None
        except UnidentifiedImageError:
            raise ValueError("not a PNG or TIFF picture that can be read") from None
        except (Image.DecompressionBombError, Image.DecompressionBombWarning) as error:
            raise ValueError(f"too large ({error})") from None
        except (
            SyntaxError,
            TypeError,
            KeyError,
            EOFError,
            IndexError,
            OverflowError,
            struct.error,
            UserWarning,
        ) as error:
            raise ValueError(f"a damaged picture ({type(error).__name__}: {error})") from None


def _numbers_of(picture: Image.Image) -> NDArray:
    """The one channel of a grey picture in its own precision: uint8, uint16 or float32."""
    mode = picture.mode
    # How the numbers are packed in the file; Pillow forgets it when it loads them.
    packing = str(picture.tile[0][3]) if picture.tile else ""
    white_is_zero = picture.format == "TIFF" and picture.tag_v2.get(262) == 0
    sixteen = mode.startswith("I;16") and "I;16" in packing and not white_is_zero
    # Older Pillow opens a PNG of 16 bit as 32 bit integers.
    sixteen = sixteen or (mode == "I" and picture.format == "PNG")
    channels = mode in ("RGB", "RGBA", "LA") and ";16" not in packing
    if not (mode in ("L", "F") or sixteen or channels) or "transparency" in picture.info:
        raise ValueError(
            f"got a picture of Pillow mode {mode!r} ({packing}), wanted opaque grey of 8 or 16 bit, black at zero, "
            "or (TIFF) 32 bit float"
        )
    pixels = np.asarray(picture)
    if channels:
        return _grey(pixels, mode)
    return pixels.astype(np.uint16) if sixteen else pixels


def _grey(pixels: NDArray, mode: str) -> NDArray:
    """The one channel of a picture whose colours are equal and whose alpha is opaque."""
    if mode.endswith("A") and not (pixels[..., -1] == 255).all():
        raise ValueError("got a picture with transparent pixels, wanted an opaque grey one")
    colours = pixels[..., : len(mode.removesuffix("A"))]
    if not (colours == colours[..., :1]).all():
        raise ValueError("got a colour picture, wanted a grey one")
    return colours[..., 0]


_FORMATS: dict[str, Callable[[Path], _Read]] = {
    ".npy": _read_npy,
    ".npz": _read_npz,
    ".png": _read_picture,
    ".tif": _read_picture,
    ".tiff": _read_picture,
}
"""Extension → the function that reads it."""
