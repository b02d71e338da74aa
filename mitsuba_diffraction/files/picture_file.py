"""Pictures of users, in sRGB, as linear radiance."""

from __future__ import annotations

import math
import os
import warnings
from contextlib import suppress
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageOps

from ..errors import RequestError
from .reading import BAD_PICTURE, check_array, check_file

PICTURE_FORMATS = ("PNG", "JPEG", "TIFF", "WEBP", "GIF", "BMP", "PPM")
"""What a picture may be, by Pillow's names; it would run another program for some others, such as EPS."""
MAX_PICTURE_PIXELS, MAX_LENGTH = 2**26, 2**15  # in all, and along an edge
MAX_EDGE = 2048  # pixels; a larger picture is reduced
_PIXELS_PER_STRIP = 2**21


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


def check_picture(path: str) -> None:
    """Check the pixels that a picture declares, before Mitsuba reads it; other files are left to it.

    Raises:
        RequestError: if its numbers in float32 are more than `check_array` allows.
    """
    if not os.path.isfile(path):
        return
    shape: tuple[int, ...] = ()
    import OpenEXR

    # What cannot be opened is reported by Mitsuba; OpenEXR raises exceptions of many kinds.
    with warnings.catch_warnings(), suppress(Exception):
        warnings.simplefilter("ignore")
        if OpenEXR.isOpenExrFile(path):
            header = OpenEXR.File(path, header_only=True).header()
            low, high = header["dataWindow"]
            shape = *(int(n) for n in high - low + 1), len(header["channels"])
        else:
            with Image.open(path, formats=(*PICTURE_FORMATS, "TGA")) as image:
                shape = *image.size, len(image.getbands())
    check_array(shape, os.path.getsize(path), 4)


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
