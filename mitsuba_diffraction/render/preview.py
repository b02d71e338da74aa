"""8-bit previews of spectral images."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

from ..color import XYZ_to_linear_sRGB, auto_exposure, into_gamut, on_screen, spectrum_to_XYZ
from ..files import whole_file
from ..outputs import png_text
from .spectral_image import SpectralImage

if TYPE_CHECKING:
    from .denoise import Guides


def save_preview(
    image: SpectralImage, path: str | os.PathLike[str], exposure: float | None = None, guides: Guides | None = None
) -> float:
    """Write an 8-bit sRGB preview of a spectral image, in the format given by the suffix of `path`.

    Spectra → XYZ → linear sRGB → `into_gamut` → × exposure → `roll_off` → sRGB's transfer function.

    Args:
        image: the spectral image.
        path: the file, such as `picture.png`.
        exposure: the factor for linear sRGB; by default `auto_exposure`.
        guides: of the same pixels (`denoise.guides`), to denoise the preview.

    Returns:
        The exposure.

    Raises:
        ValueError: if Pillow does not support the suffix.
    """
    from PIL import Image

    XYZ = spectrum_to_XYZ(image.radiance, image.wavelengths)
    if guides is not None:
        from .denoise import denoised

        XYZ = denoised(XYZ, guides)
    rgb = into_gamut(XYZ_to_linear_sRGB(XYZ))
    if exposure is None:
        exposure = auto_exposure(rgb)
    with whole_file(path) as temporary:
        Image.fromarray(on_screen(rgb * exposure)).save(temporary, pnginfo=png_text(path))
    return exposure
