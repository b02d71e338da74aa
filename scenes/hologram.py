"""A picture as a hologram of dots, as textures for hologram.xml: `python scenes/hologram.py`, or with a PICTURE.

Each pixel has three stripes, each a sinusoidal grating that diffracts red, green or blue light of the lamp to the eye
in its first order. With ω_i and ω_o the directions from the stripe to the lamp and to the eye, the grating equation is

    (cos φ, sin φ)/(s T) = −(ω_i + ω_o)_∥/λ

where φ is `orientation` and s `lateral_scale`. The first order has the fraction J_1(κa)² of the light: the amplitude a
of the groove, and so `height_scale`, determines the brightness of the stripe. Lengths of the scene are in cm, lengths
of gratings in µm.
"""

from __future__ import annotations

import argparse
import functools
from pathlib import Path

import numpy as np
from modelling import Array, command, write_numbers
from PIL import Image
from scipy.special import j1, jnp_zeros

from mitsuba_diffraction.color import spectrum_to_linear_sRGB

_GALLERY = Path(__file__).parents[1] / "docs" / "gallery"
# A preview (.png), or what gallery.py makes of it.
PICTURE = next(_GALLERY.glob("snake_xenopeltis_sun.[jp]*g"), _GALLERY / "snake_xenopeltis_sun.jpg")
PERIOD, DEPTH = 1.5, 0.25  # µm, as in hologram.xml
WIDTH = 16.0  # cm, of the hologram; the picture determines its height
WAVELENGTHS = np.array([0.620, 0.535, 0.460])  # µm, of the stripes
BAND = 0.06  # relative width of the band of wavelengths that reaches the eye, by the width of the lamp
LIGHT, EYE = (-12.0, 22.0, 52.0), (0.0, -44.0, 44.0)  # of hologram.xml
WHITE_QUANTILE = 0.995  # of the stripes' brightness, shown with the maximum efficiency of a grating


def stripe_brightness(linear: Array) -> Array:
    """Return the brightness of the three stripes, from 0 to 1, for linear sRGB (rows, columns, 3)."""
    wavelengths = np.arange(380, 781) * 1e-3
    bands = np.exp(-0.5 * ((wavelengths[:, None] / WAVELENGTHS - 1) / BAND) ** 2)
    stripes = np.maximum(linear @ np.linalg.inv(spectrum_to_linear_sRGB(bands.T, 1e3 * wavelengths)), 0)
    return np.minimum(stripes / np.quantile(stripes.max(-1), WHITE_QUANTILE), 1)


def directions(points: Array, target: Array) -> Array:
    """Return unit vectors (..., 3) from points to one target."""
    offset = target - points
    return offset / np.linalg.norm(offset, axis=-1, keepdims=True)


def gratings(brightness: Array, light: Array, eye: Array) -> tuple[Array, Array, Array]:
    """Return lateral scale, height scale and orientation in degrees of stripes, (rows, 3 columns) each.

    Args:
        brightness: (rows, columns, 3) of red, green and blue; row 0 is at the top.
        light, eye: positions relative to the centre of the hologram, cm.
    """
    rows, columns = brightness.shape[0], 3 * brightness.shape[1]
    pixel = WIDTH / columns
    x, y = (np.arange(columns) + 0.5) * pixel - WIDTH / 2, (rows / 2 - np.arange(rows) - 0.5) * 3 * pixel
    points = np.stack([*np.meshgrid(x, y), np.zeros((rows, columns))], -1)
    cosines = -directions(points, light) - directions(points, eye)
    wavelength = np.tile(WAVELENGTHS, columns // 3)
    lateral = wavelength / np.hypot(cosines[..., 0], cosines[..., 1]) / PERIOD
    # J_1(x)² up to its maximum; for Al without a coat, the other factors hardly depend on the wavelength.
    x = np.linspace(0, jnp_zeros(1, 1)[0], 500)
    phase = np.interp(brightness.reshape(rows, columns), (j1(x) / j1(x[-1])) ** 2, x)
    heights = phase * wavelength / (-np.pi * cosines[..., 2]) / DEPTH
    return lateral, heights, np.rad2deg(np.arctan2(cosines[..., 1], cosines[..., 0]))


def make(folder: Path, picture: Path, light: Array, eye: Array, count: int) -> None:
    """Write hologram_lateral.exr, hologram_heights.exr and hologram_turn.exr, `count` pixels wide."""
    with Image.open(picture) as image:
        size = count, round(count * image.height / image.width)
        srgb = np.asarray(image.convert("RGB").resize(size, Image.Resampling.LANCZOS), np.float64) / 255
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    found = gratings(stripe_brightness(linear), light, eye)
    for name, values in zip(("lateral", "heights", "turn"), found, strict=True):
        write_numbers(folder / f"hologram_{name}.exr", values)
    print(f"periods {PERIOD * found[0].min():.2f} to {PERIOD * found[0].max():.2f} µm, ", end="")
    print(f"depths up to {DEPTH * found[1].max():.3f} µm")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Convert a picture to the textures of hologram.xml.")
    parser.add_argument("picture", nargs="?", type=Path, default=PICTURE, help="any RGB picture")
    for name, position in (("light", LIGHT), ("eye", EYE)):
        parser.add_argument(f"--{name}", nargs=3, type=float, default=position, metavar=("X", "Y", "Z"))
    parser.add_argument("--pixels", type=int, default=400, help="of the picture, across")
    options = parser.parse_args()
    settings = {"picture": options.picture, "light": np.array(options.light), "eye": np.array(options.eye)}
    command(functools.partial(make, **settings, count=options.pixels))
