"""Draw docs/first_scene.png: `md.example_scene` of three surfaces.

python tools/manual/first_scene.py docs/first_scene.png
"""

from __future__ import annotations

import sys

import numpy as np
from PIL import Image

import mitsuba_diffraction as md
from mitsuba_diffraction.files.outputs import png_text
from mitsuba_diffraction.optics.color import auto_exposure, into_gamut, on_screen

import mitsuba as mi  # isort: skip  (after LLVM has been chosen)

SURFACES = ({"surface": "compact_disc"}, {"surface": "xenopeltis_synthetic", "int_ior": 1.5}, {"surface": "foil"})


def main(output: str) -> None:
    """Render, and write the row."""
    mi.set_variant("llvm_ad_spectral")
    row = []
    for surface in SURFACES:
        rgb = into_gamut(mi.render(mi.load_dict(md.example_scene(spp=256, **surface))).numpy())
        row.append(on_screen(rgb * auto_exposure(rgb)))
    Image.fromarray(np.hstack(row)).save(output, pnginfo=png_text(), optimize=True)


if __name__ == "__main__":
    main(sys.argv[1])
