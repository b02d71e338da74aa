"""Pictures of users: PNG, JPEG, TIFF and others of Pillow, in sRGB, as linear radiance."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageOps

from ..errors import RequestError
from .reading import check_file


def read_picture(path: Path, invert: bool = False) -> NDArray[np.float64]:
    """Return linear radiance from 0 to 1, (rows, columns) or (rows, columns, 3), of a picture in sRGB.

    What is transparent is dark. With `invert`, what is opaque has the radiance of the negative.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is not an opaque picture.
    """
    check_file(path)
    try:
        with Image.open(path) as opened:
            image = ImageOps.exif_transpose(opened)
            # Pillow opens PGM files of 16 bits, and older versions PNG files, as integers of 32 bits.
            if image.mode == "F" or (image.mode == "I" and opened.format not in ("PNG", "PPM")):
                raise RequestError(f"{path}: got numbers of 32 bits, wanted a picture of 8 or 16 bits per channel")
            alpha: NDArray[np.float64] | float = 1.0
            if image.mode.endswith(("A", "a")) or "transparency" in image.info:
                alpha = np.asarray(image.convert("RGBA"), np.float64)[..., 3] / 255
            if image.mode.startswith("I"):
                encoded = np.asarray(image, np.float64) / 65535
            else:
                encoded = np.asarray(image.convert("L" if image.mode in ("1", "L", "LA") else "RGB"), np.float64) / 255
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        if isinstance(error, RequestError) or getattr(error, "errno", None):
            raise
        raise RequestError(f"{path}: not a picture that can be read ({error})") from None
    if encoded.ndim == 3 and (encoded == encoded[..., :1]).all():
        encoded = encoded[..., 0]
    if invert:
        encoded = 1 - encoded
    # IEC 61966-2-1.
    linear = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    return linear * (alpha if encoded.ndim == 2 or isinstance(alpha, float) else alpha[..., None])
