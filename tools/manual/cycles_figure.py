"""Makes docs/cycles.png: gratings in Cycles above the same path traced; `python tools/manual/cycles_figure.py OUT.png`.

$BLENDER_PYTHON is a Python with bpy (tools/manual/cycles_picture.py).
"""

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from PIL import Image

from mitsuba_diffraction.files.outputs import png_text
from mitsuba_diffraction.optics.color import into_gamut, neutral_view

SIZE, RADIUS, EXPOSURE = 160, 0.15, 1.0
PANEL, GAP = 318, 3
ZOOM = {"plane": 3, "disc": 3, "sphere": 6}
PANELS = (
    ("plane", "foil", {"coherence_length": 20.0}),
    ("disc", "blazed", {"period": 1.6, "depth": 0.12, "coherence_length": 20.0}),
    ("sphere", "sinusoidal", {"period": 1.6, "depth": 0.2, "coherence_length": 12.0}),
)


def in_cycles(folder, shape, profile, parameters):
    shader, out = folder / "grating.osl", folder / "grating.npy"
    values = "".join(f",{name}={value}" for name, value in parameters.items())
    export = ["mitsuba-diffraction", "export", f"{profile},material=Al{values}", "-o", str(shader), "--overwrite"]
    subprocess.run(export, check=True)
    script = Path(__file__).with_name("cycles_picture.py")
    words = [os.environ["BLENDER_PYTHON"], script, shader, shape, RADIUS, 300, SIZE, out]
    subprocess.run([str(word) for word in words], check=True)
    return np.load(out)


def path_traced(shape, profile, parameters):
    import mitsuba as mi

    mi.set_variant("llvm_ad_spectral")
    to = mi.ScalarTransform4f()
    around = {"orientation": "radial"} if shape == "disc" else {}
    bsdf = {"type": "diffraction_grating", "profile": profile, "material": "Al", **parameters, **around}
    lamp = {"type": "area", "radiance": {"type": "d65", "scale": 100.0}}
    film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    camera = to.look_at([0, 0, 4], [0, 0, 0], [0, 1, 0])
    place = to.translate([0, -1, 3]).rotate([1, 0, 0], 180).scale(RADIUS)
    scene = {
        "type": "scene",
        "integrator": {"type": "diffraction_path", "max_depth": 2},
        "camera": {"type": "perspective", "fov": 40, "to_world": camera, "film": film},
        "shape": {"type": "sphere" if shape == "sphere" else "rectangle", "bsdf": bsdf},
        "lamp": {"type": "disk", "to_world": place, "emitter": lamp},
    }
    return np.array(mi.render(mi.load_dict(scene), spp=256))


def centre(picture, zoom):
    """The middle of a picture, as large as a panel."""
    first, side = (SIZE - PANEL // zoom) // 2, PANEL // zoom
    box = (first, first, first + side, first + side)
    return picture.crop(box).resize((PANEL, PANEL), Image.Resampling.NEAREST)


def main(out):
    rows = [[], []]
    with tempfile.TemporaryDirectory() as folder:
        for panel in PANELS:
            rows[0].append(in_cycles(Path(folder), *panel))
            rows[1].append(path_traced(*panel))
    sheet = Image.new("RGB", (3 * PANEL + 2 * GAP, 2 * PANEL + GAP), "#808080")
    for line, row in enumerate(rows):
        for column, linear in enumerate(row):
            shown = Image.fromarray(np.uint8(np.round(255 * neutral_view(into_gamut(EXPOSURE * linear)))))
            sheet.paste(centre(shown, ZOOM[PANELS[column][0]]), (column * (PANEL + GAP), line * (PANEL + GAP)))
    sheet.save(out, optimize=True, pnginfo=png_text())


if __name__ == "__main__":
    main(sys.argv[1])
