"""Heights as arrays: NumPy files (pickles are never loaded) and greyscale pictures."""

from __future__ import annotations

import math
import re
import tokenize
import warnings
import zipfile
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from ...errors import RequestError
from ...files.outputs import MARK
from ...files.reading import BAD_ARCHIVE, BAD_PICTURE, check_array
from . import scan
from .scan import Scan


def read_npy(path: Path) -> Scan:
    """Read the array of a file."""
    stored = path.stat().st_size
    with path.open("rb") as file:
        return Scan(_load_array(file, stored, stored))


def read_npz(path: Path) -> Scan:
    """Read the array `heights` of an archive, and its `pixel_size`, if any."""
    try:
        with zipfile.ZipFile(path) as archive:
            names = [name.removesuffix(".npy") for name in archive.namelist()]
            if "heights" not in names:
                raise RequestError(f"got the arrays {names}, wanted 'heights' and optionally 'pixel_size'")
            heights = _load_member(archive, "heights.npy", path)
            if "pixel_size" not in names:
                return Scan(heights)
            pixel_size = _load_member(archive, "pixel_size.npy", path)
    except RequestError:
        raise
    except BAD_ARCHIVE as error:
        raise RequestError(f"not a whole .npz archive ({error})") from None
    if pixel_size.dtype.kind not in "iuf" or pixel_size.shape not in ((), (1,), (2,)):
        raise RequestError(
            f"pixel_size: got an array of type {pixel_size.dtype} and shape {pixel_size.shape}, "
            "wanted one number or (x, y) in µm"
        )
    x, y = np.broadcast_to(pixel_size, 2).tolist()
    return Scan(heights, (float(x), float(y)))


def _load_member(archive: zipfile.ZipFile, name: str, path: Path) -> NDArray:
    """Read an array of an archive."""
    with archive.open(name) as file:
        return _load_array(file, archive.getinfo(name).file_size, path.stat().st_size)


def _load_array(file: IO[bytes], size: int, stored: int) -> NDArray:
    """Read an array of `size` bytes in NumPy's format, from a file of `stored` bytes; pickles are refused."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", UserWarning)
            version = np.lib.format.read_magic(file)
            header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
            shape, _, dtype = header(file)
            check_array(shape, stored)
            if dtype.itemsize * math.prod(shape) > size:
                raise RequestError(f"got {size} bytes, wanted {' × '.join(map(str, shape))} numbers: truncated")
            file.seek(0)
            return np.lib.format.read_array(file, allow_pickle=False)
    except RequestError:
        raise
    except (*BAD_PICTURE, MemoryError, tokenize.TokenError) as error:
        raise RequestError(f"not an array that can be read ({error})") from None


_IMAGEJ_UNIT = re.compile(r"^unit=(.+)$", re.MULTILINE)
_INCH = 25_400.0  # µm
_HEIGHT_RANGE = re.compile(r"^height_range_um=(\d+\.?\d*(?:e[-+]?\d+)?)$", re.MULTILINE)
MAX_ANNOTATION_FRACTION = 0.25  # of pixels that are coloured, such as a scale bar; a colour map has more


def private_tag(path: Path, tags: Iterable[int]) -> int | None:
    """Return which of these tags a TIFF has, None if it has none of them."""
    with warnings.catch_warnings(), suppress(*BAD_PICTURE, OSError, Image.DecompressionBombError):
        warnings.simplefilter("ignore")  # `read_image` refuses what is too large
        with Image.open(path, formats=("TIFF",)) as picture:
            return next((tag for tag in tags if tag in picture.tag_v2), None)
    return None


def read_image(path: Path) -> Scan:
    """Read the channel of an image."""
    with warnings.catch_warnings():
        # Warnings of Pillow (decompression bombs, damaged metadata) are errors here.
        warnings.simplefilter("error", Image.DecompressionBombWarning)
        warnings.simplefilter("error", UserWarning)
        try:
            with Image.open(path, formats=("PNG", "TIFF")) as picture:
                check_array(picture.size, path.stat().st_size)
                pages = getattr(picture, "n_frames", 1)
                if pages != 1:
                    raise RequestError(f"got {pages} pages or frames, wanted one")
                pixel_size, doubt = _pixel_size(picture)
                return Scan(_numbers_of(picture), pixel_size, doubt=doubt, height_range=_own_height_range(picture))
        except UnidentifiedImageError:
            raise RequestError("not a PNG or TIFF picture that can be read") from None
        except (Image.DecompressionBombError, Image.DecompressionBombWarning) as error:
            raise RequestError(
                f"too large, wanted at most {Image.MAX_IMAGE_PIXELS} pixels: crop it, or export .npy, .gsf or .gwy "
                f"({error})"
            ) from None
        except RequestError:
            raise
        except BAD_PICTURE as error:
            raise RequestError(f"a damaged picture ({type(error).__name__}: {error})") from None


def _own_height_range(picture: Image.Image) -> float | None:
    """Return the height range, µm, of a TIFF that this package wrote (`inverse_design/output.py`)."""
    if picture.format != "TIFF" or picture.tag_v2.get(305) != MARK:
        return None
    found = _HEIGHT_RANGE.search(str(picture.tag_v2.get(270, "")))
    return None if found is None else float(found[1])


def _pixel_size(picture: Image.Image) -> tuple[tuple[float, float] | None, str]:
    """Return the pixel size (x, y), µm, of a TIFF, None if it has none that a scan can have, and `Scan.doubt`.

    The tags 282 and 283 are pixels per unit: the unit in the description, if ImageJ wrote it, or else an inch or a
    centimetre (296). Other programs set these for printers, whatever the pixels are.
    """
    if picture.format != "TIFF":
        return None, ""
    tags = picture.tag_v2
    resolution = [float(tags.get(tag, 0)) for tag in (282, 283)]
    # Pillow decodes it as Latin-1.
    description = scan.decoded(str(tags.get(270, "")).encode("latin-1", errors="replace"))
    named = _IMAGEJ_UNIT.search(description) if description.startswith("ImageJ=") else None
    unit = named[1].strip().replace("\\u00B5", "µ") if named else ""
    sure = unit == "inch" or scan.is_length(unit) or tags.get(305) == MARK
    if not sure or not unit:
        unit = {2: "inch", 3: "cm"}.get(tags.get(296, 2), "")
    # NaN, as of 0/0, is not positive.
    if not (unit and all(number > 0 for number in resolution)):
        return None, ""
    length = _INCH if unit == "inch" else scan.micrometres(unit, "unit")
    size = length / resolution[0], length / resolution[1]
    if sure:
        return size, ""
    if not scan.is_possible_size(size, picture.size[::-1]):
        return None, ""
    of_tags = f"{resolution[0]:.6g} × {resolution[1]:.6g} pixels per {unit}"
    return size, f"{of_tags} may be meant for a printer: taken as its scale"


def _numbers_of(picture: Image.Image) -> NDArray:
    """Return the channel of a greyscale image in its own precision: uint8, uint16 or float32."""
    mode = picture.mode
    # The pixel format of the file, which Pillow discards on loading.
    packing = str(picture.tile[0][3]) if picture.tile else ""
    white_is_zero = picture.format == "TIFF" and picture.tag_v2.get(262) == 0
    sixteen = mode.startswith("I;16") and "I;16" in packing and not white_is_zero
    # Older versions of Pillow open 16 bit PNG files as 32 bit integers.
    sixteen = sixteen or (mode == "I" and picture.format == "PNG")
    channels = mode in ("RGB", "RGBA", "LA") and ";16" not in packing
    if not (mode in ("L", "F") or sixteen or channels) or "transparency" in picture.info:
        raise RequestError(
            f"got a picture of Pillow mode {mode!r} ({packing}), wanted opaque grey of 8 or 16 bit, black at zero, "
            "or (TIFF) 32 bit float"
        )
    pixels = np.asarray(picture)
    if channels:
        return _grey(pixels, mode)
    return pixels.astype(np.uint16) if sixteen else pixels


def _grey(pixels: NDArray, mode: str) -> NDArray:
    """Return the common channel of a colour image that is grey and opaque; coloured annotation on it is masked."""
    if mode.endswith("A") and not (pixels[..., -1] == 255).all():
        raise RequestError("got a picture with transparent pixels, wanted an opaque grey one")
    colours = pixels[..., : len(mode.removesuffix("A"))]
    coloured = (colours != colours[..., :1]).any(axis=-1)
    if coloured.mean() > MAX_ANNOTATION_FRACTION:
        raise RequestError(
            "got a colour picture, wanted a grey one: colours of a map are no heights; export the data itself (.gwy, "
            ".gsf, a .tif of 32 bit) or choose a grey palette"
        )
    return np.ma.masked_array(colours[..., 0], coloured) if coloured.any() else colours[..., 0]
