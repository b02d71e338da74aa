"""Compare the photograph of the light of a skin on a screen with its rendering: a table, and docs/screen.png.

    mitsuba-diffraction render scenes/screen.xml -o screen.exr
    python scenes/screen.py screen.exr docs/screen.png

In both pictures light of the mirror direction is saturated. Distances are from its centre to where a colour channel
is brightest, the middle of where it exceeds 90 % of its maximum: to the right, along the spectrum of the fingers side
by side, and up and down, to the rows of the fingers one behind the other. One scale, in mm per pixel, is fitted to the
distances in the spectrum, and the rendering is shown in it.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import colour
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from scipy import ndimage

from mitsuba_diffraction.files.writing import whole_file
from mitsuba_diffraction.optics.color import into_gamut, on_screen, radiance_to_linear_sRGB
from mitsuba_diffraction.render import SpectralImage

PHOTOGRAPH = Path(__file__).parents[1] / "precompute" / "measured" / "published" / "elaphe_photograph.jpg"
SCREEN_WIDTH = 130.0
"""mm, of the screen that the rendering shows from edge to edge."""
SPECTRUM, ROWS = (0.35, 0.8), (0.09, 0.19)
"""Where the orders are searched, as distances from the mirror direction relative to the width of the photograph."""
WIDTH, GAP = 650, 8  # pixels of the figure, and between its pictures

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Light:
    """Light on the screen.

    Attributes:
        rgb: linear sRGB (rows, columns, 3), relative.
        mirror: (column, row) of the centre of the mirror direction.
    """

    rgb: Array
    mirror: tuple[float, float]

    @classmethod
    def of(cls, rgb: Array) -> Light:
        """Find the mirror direction: the centroid of the largest region where all channels exceed half their maxima."""
        regions, _ = ndimage.label((rgb > rgb.max((0, 1)) / 2).all(-1))
        row, column = ndimage.center_of_mass(regions == np.argmax(np.bincount(regions.ravel())[1:]) + 1)
        return cls(rgb, (float(column), float(row)))

    def distances(self, width: float) -> tuple[Array, Array]:
        """Return the distances in pixels of spectrum and rows, (3,) each; `width` is the width of the photograph."""
        column, row = (round(x) for x in self.mirror)
        band = round(width / 50)
        along = self.rgb[row - band : row + band + 1].mean(0)
        across = self.rgb[:, column - 2 * band : column + 2 * band + 1].mean(1)
        up, down = across[row::-1], across[row:]
        first, last = (round(fraction * width) for fraction in SPECTRUM)
        near, far = (round(fraction * width) for fraction in ROWS)
        spectrum = [_brightest(along[column:, k], first, last) for k in range(3)]
        rows = [np.mean([_brightest(half[:, k], near, far) for half in (up, down)]) for k in range(3)]
        return np.array(spectrum), np.array(rows)


def _brightest(values: Array, first: int, last: int) -> float:
    """Return the middle of where values exceed 90 % of their maximum between two positions."""
    values = ndimage.gaussian_filter1d(values, len(values) / 100)[first:last]
    return float(first + np.flatnonzero(values > 0.9 * values.max()).mean())


def labelled(pictures: Mapping[str, NDArray[np.uint8]]) -> Image.Image:
    """Return pictures of one size, (rows, columns, 3) sRGB, one below the other, each with its name."""
    rows, columns = next(iter(pictures.values())).shape[:2]
    result = Image.new("RGB", (columns, len(pictures) * (rows + GAP) - GAP), "white")
    draw = ImageDraw.Draw(result)
    for index, (name, picture) in enumerate(pictures.items()):
        top = index * (rows + GAP)
        result.paste(Image.fromarray(picture), (0, top))
        draw.text((columns - 12, top + rows - 10), name, "white", ImageFont.load_default(20), anchor="rs")
    return result


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("rendering", type=Path, help="of scenes/screen.xml")
    parser.add_argument("figure", type=Path)
    arguments = parser.parse_args()
    with Image.open(PHOTOGRAPH) as picture:
        shown = picture.convert("RGB")
    photograph = Light.of(colour.cctf_decoding(np.asarray(shown) / 255, function="sRGB"))
    image = SpectralImage.load(arguments.rendering)
    rendering = Light.of(into_gamut(radiance_to_linear_sRGB(image.radiance, image.wavelengths)))
    step = SCREEN_WIDTH / rendering.rgb.shape[1]

    spectrum, rows = photograph.distances(shown.width)
    # The range of the search in the rendering follows from the scale, which starts with the spectrum of the photograph.
    scale = 0.05 * 1568 / shown.width
    for _ in range(3):
        found = [step * distance for distance in rendering.distances(shown.width * scale / step)]
        scale = float((found[0] @ spectrum) / (spectrum @ spectrum))
    print(f"one scale: {scale:.4f} mm per pixel, {scale * shown.width:.1f} mm for the {shown.width} pixels")
    print("| channel | photograph, pixels: spectrum | rows | rendering, mm: spectrum | rows | ratio: spectrum | rows |")
    print("|---|---:|---:|---:|---:|---:|---:|")
    for k, name in enumerate(("red", "green", "blue")):
        pixels, mm = (spectrum[k], rows[k]), (found[0][k], found[1][k])
        print(f"| {name} | {pixels[0]:.0f} | {pixels[1]:.0f} | {mm[0]:.1f} | {mm[1]:.1f} | ", end="")
        print(" | ".join(f"{length / scale / pixel:.3f}" for length, pixel in zip(mm, pixels, strict=True)), "|")

    height = round(WIDTH * shown.height / shown.width)
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(height) + 0.5)
    factor = shown.width / WIDTH
    columns = rendering.mirror[0] + (x * factor - photograph.mirror[0]) * scale / step
    lines = rendering.mirror[1] + (y * factor - photograph.mirror[1]) * scale / step
    below = np.stack(
        [ndimage.map_coordinates(rendering.rgb[..., k], [lines, columns], order=1, cval=0.0) for k in range(3)], -1
    )
    # Of the exposures in steps of a quarter of a stop, that whose spectrum is on average as bright as the photograph's.
    start, end = (round(photograph.mirror[0] / factor + fraction * WIDTH) for fraction in SPECTRUM)
    middle = round(photograph.mirror[1] / factor)
    spectrum_of = np.s_[middle - 3 : middle + 4, start:end]
    above = np.asarray(shown.resize((WIDTH, height)))
    exposures = 2 ** np.arange(-4, 4, 0.25) / below[spectrum_of].max()
    below = min(
        (on_screen(below * exposure) for exposure in exposures),
        key=lambda picture: abs(picture[spectrum_of].mean() - above[spectrum_of].mean()),
    )
    figure = labelled({"photograph": above, "rendering": below})
    with whole_file(arguments.figure) as temporary:
        figure.save(temporary, "PNG", optimize=True)


if __name__ == "__main__":
    main()
