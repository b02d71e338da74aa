"""The textures of hologram.xml: `python scenes/hologram.py`; `mitsuba-diffraction hologram` takes any picture."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
from modelling import Array, command
from PIL import Image

from mitsuba_diffraction.inverse_design import hologram

# sRGB, from the body outwards.
BANDS = np.array([[1, 0.9, 0.3], [1, 0.65, 0], [1, 0.05, 0.05], [0.9, 0, 0.8], [0.1, 0.2, 1], [0, 0.8, 0.9]])


def butterfly(columns: int) -> Array:
    """Return sRGB colours, 16 : 9: wings in bands of full colour with dark veins, on black."""
    x, y = np.meshgrid(np.linspace(-1.6, 1.6, columns), np.linspace(0.9, -0.9, round(columns * 9 / 16)))
    x, y = np.abs(x), y + 0.15
    colours = np.zeros((*x.shape, 3))
    # Lower and upper wings: middle and half the range of the polar angle in degrees, length, panes between veins.
    for middle, half, length, panes in ((-48, 44, 0.83, 5), (28, 45, 1.4, 6)):
        angle = (np.rad2deg(np.arctan2(y, x)) - middle) / half
        depth = np.hypot(x, y) / (length * np.sqrt(np.clip(1 - np.abs(angle) ** 2.5, 1e-9, 1)))
        bands = BANDS[np.minimum(len(BANDS) * depth, len(BANDS) - 1).astype(int)]
        vein = np.abs((angle + 1) / 2 * panes % 1 - 0.5) > 0.46
        colours = np.where((depth < 1)[..., None], np.where(vein[..., None], 0, bands), colours)
    colours[(x / 0.05) ** 2 + ((y - 0.02) / 0.45) ** 2 < 1] = 1, 0.9, 0.7
    return colours


def make(folder: Path, columns: int = 400) -> None:
    """Write hologram_lateral.exr, hologram_heights.exr and hologram_turn.exr, `columns` pixels wide."""
    with tempfile.TemporaryDirectory() as temporary:
        picture = Path(temporary) / "butterfly.png"
        Image.fromarray(np.uint8(255 * butterfly(2 * columns))).save(picture)
        hologram.write(picture, folder, columns)


if __name__ == "__main__":
    command(make)
