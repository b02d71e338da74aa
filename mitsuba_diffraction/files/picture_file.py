"""Pictures of users, in sRGB, as linear radiance."""

from __future__ import annotations

import math
import os
import re
import warnings
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageOps

from ..errors import RequestError
from ..progress import bytes_text
from .reading import BAD_PICTURE, MAX_FILE_BYTES, check_file

PICTURE_FORMATS = ("PNG", "JPEG", "TIFF", "WEBP", "GIF", "BMP", "PPM")
"""What a picture may be, by Pillow's names; it would run another program for some others, such as EPS."""
MAX_PICTURE_PIXELS, MAX_LENGTH = 2**26, 2**15  # in all, and along an edge
MAX_EDGE = 2048  # pixels; a larger picture is reduced
_PIXELS_PER_STRIP = 2**21
IN_TEXTURE, IN_ENVIRONMENT = 10, 26  # bytes of memory for a number of a picture that Mitsuba 3.9.1 loads, measured
_SMALL_FILE, _MAX_MEMORY = 10**7, 10**9  # bytes; see `reading`
_HEADER_BYTES = 2**16
_OF_PICTURES = b"\x89PNG", b"\xff\xd8", b"BM", b"P6", b"v/1\1"  # first bytes of those that Mitsuba reads


def read_picture(path: Path, invert: bool = False) -> NDArray[np.float64]:
    """Return linear radiance from 0 to 1, (rows, columns) or (rows, columns, 3), of a picture in sRGB.

    What is transparent is dark. With `invert`, what is opaque has the radiance of the negative. A picture of more than
    `MAX_EDGE` pixels along an edge is reduced to means over squares of pixels.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is not an opaque picture of one of `PICTURE_FORMATS`, or too large.
    """
    check_file(path)
    try:
        with warnings.catch_warnings(), Image.open(path, formats=PICTURE_FORMATS) as image:
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            width, height = image.size
            if width * height > MAX_PICTURE_PIXELS or max(image.size) > MAX_LENGTH:
                raise RequestError(
                    f"{path}: got {width} × {height} pixels, wanted at most {MAX_PICTURE_PIXELS}, and {MAX_LENGTH} "
                    "along an edge: make it smaller"
                )
            ImageOps.exif_transpose(image, in_place=True)
            # Pillow opens PGM files of 16 bits, and older versions PNG files, as integers of 32 bits.
            if image.mode == "F" or (image.mode == "I" and image.format not in ("PNG", "PPM")):
                raise RequestError(f"{path}: got numbers of 32 bits, wanted a picture of 8 or 16 bits per channel")
            # Pillow inverts such a TIFF of 8 bits, but not of 16.
            white_is_zero = image.mode.startswith("I;16") and getattr(image, "tag_v2", {}).get(262) == 0
            step = math.ceil(max(image.size) / MAX_EDGE)
            rows = step * max(1, _PIXELS_PER_STRIP // (step * image.width))
            linear = np.concatenate(
                [
                    _reduced(_linear(image.crop((0, top, image.width, bottom)), invert != white_is_zero), step)
                    for top, bottom in _strips(image.height, rows)
                ]
            )
    except (*BAD_PICTURE, OSError, Image.DecompressionBombError) as error:
        if isinstance(error, RequestError) or getattr(error, "errno", None):
            raise
        raise RequestError(
            f"{path}: not a picture that can be read ({error}), wanted {', '.join(PICTURE_FORMATS)}"
        ) from None
    is_grey = linear.ndim == 3 and (linear == linear[..., :1]).all()
    return np.ascontiguousarray(linear[..., 0]) if is_grey else linear


def check_picture(path: str, in_memory: int) -> None:
    """Check the numbers that a picture declares, before Mitsuba loads it; other files are left to it.

    A .pfm is not compressed, and needs no limit: it takes what its bytes do, times these factors.

    Args:
        path: the file.
        in_memory: bytes for a number, `IN_TEXTURE` or `IN_ENVIRONMENT`.

    Raises:
        RequestError: if a file of less than 10 MB would take more than 1 GB, a larger one more than `MAX_FILE_BYTES` as
            numbers in float32, or its header cannot be read.
    """
    if not os.path.isfile(path):
        return
    count, stored = _declared_numbers(path), os.path.getsize(path)
    limit = _MAX_MEMORY // in_memory if stored < _SMALL_FILE else MAX_FILE_BYTES // 4
    if count > limit:
        raise RequestError(
            f"{path}: got a picture of {count} numbers in {bytes_text(stored)}, wanted at most {limit}: make it smaller"
        )


def _declared_numbers(path: str) -> int:
    """Return how many numbers a picture has by its header, 0 of what is none."""
    with open(path, "rb") as stream:
        start = stream.read(_HEADER_BYTES)
    if start.startswith(b"#?"):
        if not (sizes := re.findall(rb"[-+][XY]\s+(\d+)\s+[-+][XY]\s+(\d+)", start)):
            raise RequestError(f"{path}: got a picture of Radiance without its size, wanted one as -Y 512 +X 1024")
        return max(3 * int(rows) * int(columns) for rows, columns in sizes)
    import OpenEXR

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            if OpenEXR.isOpenExrFile(path):
                header = OpenEXR.File(path, header_only=True).header()
                low, high = header["dataWindow"]
                return math.prod(int(n) for n in high - low + 1) * len(header["channels"])
            with Image.open(path, formats=(*PICTURE_FORMATS, "TGA")) as image:
                return image.width * image.height * len(image.getbands())
        except Image.DecompressionBombError:  # raised above twice as many pixels, before their number is known
            return MAX_FILE_BYTES
        except Exception as error:  # OpenEXR raises exceptions of many kinds
            if start.startswith(_OF_PICTURES):
                raise RequestError(f"{path}: not a picture that can be read ({error})") from None
            return 0  # what is no picture is refused by Mitsuba


def _strips(height: int, rows: int) -> list[tuple[int, int]]:
    """Return the first row, and that after the last, of strips of a picture."""
    return [(top, min(top + rows, height)) for top in range(0, height, rows)]


def _linear(image: Image.Image, negative: bool) -> NDArray[np.float64]:
    """Return the linear radiance of a part of a picture."""
    if image.mode.startswith("I"):
        codes, maximum = np.clip(np.asarray(image, np.int64), 0, 65535), 65535
    else:
        codes, maximum = np.asarray(image.convert("L" if image.mode in ("1", "L", "LA") else "RGB")), 255
    encoded = np.arange(maximum + 1) / maximum
    if negative:
        encoded = 1 - encoded
    # IEC 61966-2-1.
    linear = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)[codes]
    if image.mode.endswith(("A", "a")) or "transparency" in image.info:
        alpha = np.asarray(image.convert("RGBA"), np.float64)[..., 3] / 255
        return linear * (alpha if linear.ndim == 2 else alpha[..., None])
    return linear


def _reduced(picture: NDArray[np.float64], step: int) -> NDArray[np.float64]:
    """Return the means over squares of `step` × `step` pixels, of fewer at the last edges."""
    for axis in (0, 1):
        first = np.arange(0, picture.shape[axis], step)
        counts = np.diff(first, append=picture.shape[axis])
        sums = np.add.reduceat(np.moveaxis(picture, axis, -1), first, axis=-1)
        picture = np.moveaxis(sums / counts, -1, axis)
    return picture
