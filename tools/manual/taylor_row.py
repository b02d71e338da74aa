"""Draw docs/taylor_row.jpg: a snake by 6, 15 and 20 Taylor terms, of heights from the lowest point and the mean.

    python tools/manual/taylor_row.py taylor_row.png

All pictures have the same random numbers and the same exposure.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import matplotlib
from PIL import Image, ImageDraw, ImageFont

from mitsuba_diffraction.bsdf.theory import errors_shown
from mitsuba_diffraction.files.outputs import png_text
from mitsuba_diffraction.render import render
from mitsuba_diffraction.render.scene_file import SceneFile
from mitsuba_diffraction.render.spectral_image import save_preview
from mitsuba_diffraction.variants import choose_variant

import mitsuba as mi  # isort: skip  (after LLVM has been chosen)

SCENE = Path(__file__).parents[2] / "scenes" / "xenopeltis.xml"
WIDTH, SPP = 480, 36
CROP = 60, 32, 420, 300  # columns and rows of a picture: its middle
TERMS = (6, 15, 20)
ROWS = {"lowest": "heights from the lowest point:", "mean": "heights from the mean:"}
GAP, HEAD = 8, 112


def main(output: str) -> None:
    """Render, and write the rows."""
    mi.set_variant(choose_variant(None))
    exposure = None

    def picture(**parameters: str) -> Image.Image:
        nonlocal exposure
        image = render(SceneFile(SCENE, {"skin": "xenopeltis_tile", **parameters}, size=(WIDTH, None)), spp=SPP)
        exposure = save_preview(image, Path(folder) / "picture.png", exposure)
        with Image.open(Path(folder) / "picture.png") as shown:
            return shown.convert("RGB").crop(CROP)

    width, height = CROP[2] - CROP[0], CROP[3] - CROP[1]
    canvas = Image.new("RGB", ((len(TERMS) + 1) * (width + GAP) - GAP, len(ROWS) * (HEAD + height)), "white")
    draw = ImageDraw.Draw(canvas)
    font = ImageFont.truetype(str(Path(matplotlib.get_data_path()) / "fonts" / "ttf" / "DejaVuSans.ttf"), 36)
    with tempfile.TemporaryDirectory() as folder, errors_shown():  # few terms err, which is what is shown
        exact = picture(representation="slices")
        for row, (name, words) in enumerate(ROWS.items()):
            top = row * (HEAD + height)
            draw.text((0, top + 0.28 * HEAD), words, "black", font, anchor="lm")
            for column, terms in enumerate((*TERMS, None)):
                left, title = column * (width + GAP), f"{terms} terms" if terms else "all terms"
                shown = picture(representation="taylor", terms=str(terms), heights_from=name) if terms else exact
                canvas.paste(shown, (left, top + HEAD))
                draw.text((left, top + 0.72 * HEAD), title, "black", font, anchor="lm")
    canvas.save(output, pnginfo=png_text(), optimize=True)


if __name__ == "__main__":
    main(sys.argv[1])
