"""Render every surface of this folder into one picture: python precompute/contact_sheet.py docs/ready_surfaces.png

Discs (compact_disc, dvd) are shown as discs, films and transmission gratings as a pane in front of a small
lamp, all others on a sphere and a plate. The light is a sun at the left, a narrow lamp, and a dim sky.
"""

from __future__ import annotations

import argparse
import math
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
from PIL import Image

from mitsuba_diffraction.files import whole_file
from mitsuba_diffraction.llvm import choose_variant
from mitsuba_diffraction.render import render
from mitsuba_diffraction.render.spectral_image import save_preview

HERE = Path(__file__).parent
DISCS = {"compact_disc", "dvd"}
PANES = {"film", "transmission_300", "transmission_600"}
SKINS = {f"{name}{kind}" for name in ("elaphe", "xenopeltis") for kind in ("", "_afm", "_synthetic")} | {
    "morpho_ridges"
}
METAL = '<string name="material" value="Al"/>'
SKIN = """<float name="int_ior" value="1.5"/>
    <bsdf type="diffuse" name="base"><rgb name="reflectance" value="0.02, 0.014, 0.01"/></bsdf>"""
# On a disk x is the radius: tracks, which run along y, run around the disk.
DISC = """<shape type="disk"><ref id="surface"/></shape>
<shape type="disk"><transform name="to_world"><scale value="0.2"/><translate z="0.002"/></transform>
    <bsdf type="diffuse"><rgb name="reflectance" value="0.01"/></bsdf></shape>"""
PANE = """<shape type="rectangle"><transform name="to_world"><scale value="1.4"/>
    <lookat origin="0, -2.1, 1.8" target="0, -4.2, 3.4" up="0, 0, 1"/></transform><ref id="surface"/></shape>
<shape type="sphere"><point name="center" x="0" y="0.2" z="0"/><float name="radius" value="0.06"/>
    <emitter type="area"><spectrum name="radiance" type="d65"><float name="scale" value="3"/></spectrum></emitter>
</shape>"""
SHEET = '<float name="int_ior" value="1.5"/><string name="transmission" value="sheet"/>'
SPHERE = """<shape type="sphere"><point name="center" x="0" y="0.15" z="0.42"/><float name="radius" value="0.42"/>
    <ref id="surface"/></shape>
<shape type="rectangle"><transform name="to_world"><scale x="1.0" y="0.85"/></transform>
    <ref id="surface"/></shape>"""
SCENE = """<scene version="3.0.0"><integrator type="path"><integer name="max_depth" value="3"/></integrator>
<sensor type="perspective"><float name="fov" value="{fov}"/><transform name="to_world">
    <lookat origin="0, -4.2, 3.4" target="0, 0, {height}" up="0, 0, 1"/></transform>
    <film type="hdrfilm"><rfilter type="gaussian"/></film></sensor>
<bsdf type="diffraction_grating" id="surface"><string name="filename" value="{recipe}"/>{coat}</bsdf>
{shapes}
<emitter type="directional"><vector name="direction" x="0.5" y="0.35" z="-0.9"/>
    <spectrum name="irradiance" type="d65"><float name="scale" value="{sun}"/></spectrum></emitter>
<shape type="rectangle"><transform name="to_world"><scale x="0.12" y="1.6"/>
    <lookat origin="-1.9, 0.3, 3.0" target="0, 0, 0" up="0, 1, 0"/></transform>
    <emitter type="area"><spectrum name="radiance" type="d65"><float name="scale" value="{lamp}"/></spectrum></emitter>
</shape>
<emitter type="constant"><spectrum name="radiance" value="{sky}"/></emitter></scene>"""


def panel(recipe: Path, folder: Path, size: int, spp: int) -> Image.Image:
    """Render the picture of one recipe."""
    scene, picture = folder / f"{recipe.stem}.xml", folder / f"{recipe.stem}.png"
    disc = recipe.stem in DISCS
    content = {"coat": METAL, "shapes": DISC if disc else SPHERE, "sun": 0.1, "lamp": 3, "sky": 0.0015, "fov": 22}
    if recipe.stem in SKINS:
        content |= {"coat": SKIN, "sun": 1.0, "sky": 0.001}
    if recipe.stem in PANES:
        content |= {"coat": SHEET, "shapes": PANE, "sun": 1e-9, "lamp": 1e-9, "sky": 1e-9, "fov": 50}
    text = SCENE.format(recipe=recipe.resolve().as_posix(), height=0 if disc else 0.25, **content)
    scene.write_text(text, encoding="utf-8")
    save_preview(render(scene, spp=spp, width=size, height=size), picture)
    return Image.open(picture).copy()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("output", type=Path)
    parser.add_argument("--size", type=int, default=160, help="pixels of a panel")
    parser.add_argument("--spp", type=int, default=96, help="samples per pixel")
    arguments = parser.parse_args()
    import mitsuba as mi  # after the package, which chooses LLVM

    mi.set_variant(choose_variant(None))
    # Tiles are skins that stand there already.
    recipes = sorted(path for path in HERE.glob("*.toml") if not path.stem.endswith("_tile"))
    columns = 6
    rows = math.ceil(len(recipes) / columns)
    inch = arguments.size / 96
    figure, axes = plt.subplots(
        rows, columns, figsize=(columns * inch * 1.04, rows * inch * 1.14), dpi=96, squeeze=False
    )
    with tempfile.TemporaryDirectory() as folder:
        for axis in axes.flat:
            axis.set_axis_off()
        for axis, recipe in zip(axes.flat, recipes, strict=False):
            axis.imshow(panel(recipe, Path(folder), arguments.size, arguments.spp))
            axis.set_title(recipe.stem, fontsize=10, pad=3)
    figure.subplots_adjust(0.01, 0.01, 0.99, 0.93, wspace=0.04, hspace=0.12)
    with whole_file(arguments.output) as temporary:
        figure.savefig(temporary)


if __name__ == "__main__":
    main()
