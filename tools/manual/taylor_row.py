"""Draw docs/taylor_row.png: a snake by 4, 10 and 20 Taylor terms, by stored spectra, and a difference.

    python tools/manual/taylor_row.py docs/taylor_row.png

All pictures have the same random numbers.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import matplotlib
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from mitsuba_diffraction.bsdf.theory import errors_shown
from mitsuba_diffraction.files.outputs import png_text
from mitsuba_diffraction.render import render
from mitsuba_diffraction.render.scene_file import SceneFile
from mitsuba_diffraction.render.spectral_image import save_preview
from mitsuba_diffraction.variants import choose_variant

import mitsuba as mi  # isort: skip  (after LLVM has been chosen)

SCENE = Path(__file__).parents[2] / "scenes" / "xenopeltis.xml"
WIDTH, SPP = 360, 36
CROP = 70, 24, 300, 224  # columns and rows of a picture: its middle
GAIN = 10  # of the difference, in sRGB


def pictures(folder: Path) -> list[Image.Image]:
    """Return the snake by 4, 10 and 20 terms and by slices, at one exposure."""
    chosen, exposure = [{"representation": "taylor", "terms": str(terms)} for terms in (4, 10, 20)], None
    found = []
    for parameters in ({"representation": "slices"}, *chosen):
        image = render(SceneFile(SCENE, {"skin": "xenopeltis_tile", **parameters}, size=(WIDTH, None)), spp=SPP)
        exposure = save_preview(image, folder / "picture.png", exposure)
        with Image.open(folder / "picture.png") as picture:
            found.append(picture.convert("RGB").crop(CROP))
    return [*found[1:], found[0]]


def main(output: str) -> None:
    """Render, and write the row."""
    mi.set_variant(choose_variant(None))
    with tempfile.TemporaryDirectory() as folder, errors_shown():  # few terms err, which is what is shown
        row = pictures(Path(folder))
    twenty, exact = (np.asarray(picture, np.int64) for picture in row[2:])
    row.append(Image.fromarray(np.clip(GAIN * np.abs(twenty - exact), 0, 255).astype(np.uint8)))
    titles = ("4 terms", "10 terms", "20 terms", "all (stored)", f"20 − all, × {GAIN}")
    font = ImageFont.truetype(str(Path(matplotlib.get_data_path()) / "fonts" / "ttf" / "DejaVuSans.ttf"), 30)
    width, height, gap, head = CROP[2] - CROP[0], CROP[3] - CROP[1], 6, 44
    canvas = Image.new("RGB", (len(row) * (width + gap) - gap, head + height), "white")
    draw = ImageDraw.Draw(canvas)
    for index, (title, picture) in enumerate(zip(titles, row, strict=True)):
        canvas.paste(picture, (index * (width + gap), head))
        draw.text((index * (width + gap) + width / 2, head / 2), title, "black", font, anchor="mm")
    canvas.quantize(256).save(output, pnginfo=png_text(), optimize=True)


if __name__ == "__main__":
    main(sys.argv[1])
