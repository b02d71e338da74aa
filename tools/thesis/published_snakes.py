"""The author's snakes beside the modelled ones: FLSS as published under one directional light, and path tracing.

python tools/thesis/published_snakes.py snakes.png
"""

from __future__ import annotations

import argparse
import re
import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from mitsuba_diffraction.evaluation.plots import figure, save_png
from mitsuba_diffraction.optics.color import XYZ_to_linear_sRGB, auto_exposure, into_gamut, on_screen
from mitsuba_diffraction.shader_2014.comparison.pictures import Pictures
from mitsuba_diffraction.variants import choose_variant

import mitsuba as mi  # isort: skip  (after LLVM has been chosen)

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "precompute" / "measured" / "published"
SNAKES = {"elaphe": "Elaphe guttata", "xenopeltis": "Xenopeltis unicolor"}
TITLES = "the author's snake", "FLSS as published, one light", "path tracer, sun and sky"
WIDTH, SIDE, CORNER = 1500, 150, (1187, 275)  # of the whole film, and of the part that is rendered, in pixels


def close_up(name: str, folder: Path) -> Path:
    """Write the scene of a snake with the film cropped to a part of its body; return its path."""
    scenes = ROOT / "scenes"
    text = (scenes / f"{name}.xml").read_text(encoding="utf-8")
    text = re.sub(r'value="(coil|lights|\.\./precompute)/', lambda found: f'value="{scenes / found[1]}/', text)
    text = text.replace('filename="lights/', f'filename="{scenes}/lights/')
    size = {"width": WIDTH, "height": WIDTH * 2 // 3, "crop_width": SIDE, "crop_height": SIDE}
    size |= dict(zip(("crop_offset_x", "crop_offset_y"), CORNER, strict=True))
    film = "".join(f'<integer name="{key}" value="{value}"/>' for key, value in size.items())
    text, count = re.subn(r'<integer name="width".*?/>\s*<integer name="height".*?/>', film, text, flags=re.DOTALL)
    assert count == 1
    path = folder / f"{name}.xml"
    path.write_text(text, encoding="utf-8")
    return path


def shown(xyz: NDArray[np.float64], surface: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Return a picture for a display, black where nothing diffracts."""
    rgb = into_gamut(XYZ_to_linear_sRGB(np.where(surface[..., None], xyz, 0)))
    return on_screen(rgb * auto_exposure(rgb[surface]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("figure", type=Path, help=".png")
    parser.add_argument("--spp", type=int, default=16, help="of the path tracer")
    arguments = parser.parse_args()
    mi.set_variant(choose_variant(None))
    drawn = figure(10.0, 7.0)
    axes = drawn.subplots(2, 3)
    for row, (name, title) in zip(axes, SNAKES.items(), strict=True):
        with tempfile.TemporaryDirectory() as folder:
            pictures = Pictures(close_up(name, Path(folder)), parameters={"light": "sun"}, pigment=False)
        shader = pictures.shaded(pictures.quirks, 4, 1)
        traced = pictures.path_traced(arguments.spp)
        print(f"{name}: brightness {shader.brightness:.3g}")
        with Image.open(FOLDER / f"snake_{name}_flss.jpg") as file:
            row[0].imshow(np.asarray(file))
        for panel, picture in zip(row[1:], (shader, traced), strict=True):
            panel.imshow(shown(picture.xyz, pictures.mask), interpolation="lanczos")
        row[0].set_ylabel(title, fontstyle="italic")
        for panel in row:
            panel.set(xticks=[], yticks=[])
            panel.spines[:].set_visible(False)
    for panel, title in zip(axes[0], TITLES, strict=True):
        panel.set_title(title, fontsize="medium")
    save_png(drawn, arguments.figure)


if __name__ == "__main__":
    main()
