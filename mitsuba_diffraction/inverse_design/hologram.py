"""A picture as a hologram of dots: textures of the gratings of `scenes/hologram.xml`.

Each pixel has three stripes, each a sinusoidal grating that diffracts red, green or blue light of the lamp to the eye
in its first order. With ω_i and ω_o the directions from the stripe to the lamp and to the eye, the grating equation is

    (cos φ, sin φ)/(s T) = −(ω_i + ω_o)_∥/λ

where φ is `orientation` and s `lateral_scale`. The first order has the fraction J_1(κa)² of the light: the amplitude a
of the groove, and so `height_scale`, determines the brightness of the stripe. Lengths of the scene are in cm, lengths
of gratings in µm.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import OpenEXR
from PIL import Image
from scipy.special import j1, jnp_zeros

from ..array_types import Real
from ..errors import RequestError
from ..files.outputs import MARK
from ..files.picture_file import read_picture
from ..files.writing import whole_file
from ..optics.color import radiance_to_linear_sRGB

PERIOD, DEPTH = 1.5, 0.25  # µm, as in hologram.xml
SIZE = 16.0, 9.0  # cm, of the hologram
STRIPE_WAVELENGTHS = np.array([0.620, 0.535, 0.460])  # µm, of the stripes
BAND = 0.06  # relative width of the band of wavelengths that reaches the eye, by the width of the lamp
LIGHT, EYE = (-12.0, 22.0, 52.0), (0.0, -44.0, 44.0)  # of hologram.xml
WHITE_QUANTILE = 0.995  # of the stripes' brightness, shown with the maximum efficiency of a grating


def stripe_brightness(linear: Real) -> Real:
    """Return the brightness of the three stripes, from 0 to 1, for linear sRGB (rows, columns, 3)."""
    wavelengths = np.arange(380, 781) * 1e-3
    bands = np.exp(-0.5 * ((wavelengths[:, None] / STRIPE_WAVELENGTHS - 1) / BAND) ** 2)
    stripes = np.maximum(linear @ np.linalg.inv(radiance_to_linear_sRGB(bands.T, 1e3 * wavelengths)), 0)
    return np.minimum(stripes / max(np.quantile(stripes.max(-1), WHITE_QUANTILE), 1e-3), 1)


def directions(points: Real, target: Real) -> Real:
    """Return unit vectors (..., 3) from points to one target."""
    offset = target - points
    return offset / np.linalg.norm(offset, axis=-1, keepdims=True)


def stripes(brightness: Real, width: float = SIZE[0]) -> tuple[Real, Real, Real]:
    """Return lateral scale, height scale and orientation in degrees of stripes, (rows, 3 columns) each.

    Args:
        brightness: (rows, columns, 3) of red, green and blue; row 0 is at the top.
        width: of the hologram, cm.
    """
    rows, columns = brightness.shape[0], 3 * brightness.shape[1]
    pixel = width / columns
    x, y = (np.arange(columns) + 0.5) * pixel - width / 2, (rows / 2 - np.arange(rows) - 0.5) * 3 * pixel
    points = np.stack([*np.meshgrid(x, y), np.zeros((rows, columns))], -1)
    cosines = -directions(points, np.array(LIGHT)) - directions(points, np.array(EYE))
    wavelength = np.tile(STRIPE_WAVELENGTHS, columns // 3)
    lateral = wavelength / np.hypot(cosines[..., 0], cosines[..., 1]) / PERIOD
    # J_1(x)² up to its maximum; for Al without a coat, the other factors hardly depend on the wavelength.
    x = np.linspace(0, jnp_zeros(1, 1)[0], 500)
    phase = np.interp(brightness.reshape(rows, columns), (j1(x) / j1(x[-1])) ** 2, x)
    heights = phase * wavelength / (-np.pi * cosines[..., 2]) / DEPTH
    return lateral, heights, np.rad2deg(np.arctan2(cosines[..., 1], cosines[..., 0]))


def fitted(picture: str | os.PathLike[str], columns: int) -> Real:
    """Return a picture in linear sRGB with its proportions, in the middle of the hologram, which is dark beside it.

    Args:
        picture: its file; what is transparent is dark.
        columns: pixels of the hologram across.

    Raises:
        FileNotFoundError: if there is no such file.
        RequestError: if it is no picture, or a black one.
    """
    size = columns, round(columns * SIZE[1] / SIZE[0])
    radiance = np.atleast_3d(read_picture(Path(picture)))
    if radiance.max() <= 0:
        raise RequestError(f"{picture}: got a black picture, wanted light in it")
    factor = min(wanted / given for wanted, given in zip(size, radiance.shape[1::-1], strict=True))
    inner = [max(1, round(factor * length)) for length in radiance.shape[1::-1]]
    channels = [Image.fromarray(np.float32(channel)) for channel in np.moveaxis(radiance, -1, 0)]
    # LANCZOS overshoots.
    fine = [np.clip(channel.resize(inner, Image.Resampling.LANCZOS), 0, 1) for channel in channels]
    canvas = np.zeros((size[1], size[0], 3))
    x, y = (size[0] - inner[0]) // 2, (size[1] - inner[1]) // 2
    canvas[y : y + inner[1], x : x + inner[0]] = np.stack(fine, -1)
    return canvas


def textures_in(folder: Path) -> list[Path]:
    """Return the paths of the textures in a folder: lateral scale, height scale and orientation."""
    return [folder / f"hologram_{name}.exr" for name in ("lateral", "heights", "turn")]


def write(
    picture: str | os.PathLike[str], folder: Path, columns: int = 400, width: float = SIZE[0]
) -> tuple[Real, Real, Real]:
    """Write the textures of a picture, `columns` pixels and `width` cm wide; return them. For errors see `fitted`."""
    found = stripes(stripe_brightness(fitted(picture, columns)), width)
    header = {"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION, "comments": MARK}
    for path, values in zip(textures_in(folder), found, strict=True):
        # The last row of a file is at v = 1 in Mitsuba, the top of the picture.
        with whole_file(path) as temporary:
            OpenEXR.File(header, {"Y": np.ascontiguousarray(values[::-1]).astype(np.float16)}).write(str(temporary))
    return found
