"""Render every surface of this folder into one picture: python tools/manual/contact_sheet.py ready_surfaces.png

Reflecting surfaces are on the same arch below two long lamps, discs are flat below two small ones, and films and
transmission gratings are a pane before three. Metals have a dim sky, skins black pigment. Pictures are denoised.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.font_manager import findfont
from PIL import Image, ImageDraw, ImageFont

from mitsuba_diffraction.files.writing import whole_file
from mitsuba_diffraction.render import render
from mitsuba_diffraction.render.denoise import denoised_picture
from mitsuba_diffraction.render.scene_file import SceneFile
from mitsuba_diffraction.render.spectral_image import save_preview
from mitsuba_diffraction.variants import choose_variant

RECIPES = Path(__file__).parents[2] / "precompute"
sys.path.insert(0, str(RECIPES.parent / "scenes"))
COLUMNS = 3
WIDTH, HEIGHT, GAP, TEXT = 400, 280, 16, 56
"""Pixels of a panel, between panels, and of the two lines below it."""

METAL = '<string name="material" value="Al"/>'
COATED = METAL + '<float name="coat_ior" value="1.55"/>'
SHEET = '<float name="int_ior" value="1.5"/><string name="transmission" value="sheet"/>'


def skin(pigment: str, orientation: float = 0) -> str:
    """Return the parameters of a skin above its pigment, linear sRGB; its orientation in degrees."""
    return f"""<float name="int_ior" value="1.5"/><float name="orientation" value="{orientation}"/>
    <bsdf type="diffuse" name="base"><rgb name="reflectance" value="{pigment}"/></bsdf>"""


@dataclass(frozen=True)
class Panel:
    """One surface of the sheet.

    Attributes:
        text: below its name.
        kind: arch, disc or pane.
        material: parameters of the BSDF besides the recipe.
    """

    text: str
    kind: str = "arch"
    material: str = METAL


DARK, RED, BLUE = "0.004, 0.003, 0.0025", "0.01, 0.004, 0.002", "0.001, 0.002, 0.006"
PANELS = {
    "compact_disc": Panel("tracks of pits, 1.6 µm apart, under plastic", "disc", COATED),
    "dvd": Panel("tracks of pits, 0.74 µm apart, under plastic", "disc", COATED),
    "blaze": Panel("the blazed grating of the thesis, 400 lines/mm"),
    "ruled_600": Panel("ruled grating, 600 lines/mm"),
    "ruled_1200": Panel("ruled grating, 1200 lines/mm"),
    "foil_crossed": Panel("embossed foil, grooves in two directions"),
    "foil_hexagonal": Panel("embossed foil, grooves in three directions"),
    "xenopeltis": Panel("skin of Xenopeltis unicolor, scan of 65 µm", material=skin(DARK)),
    "xenopeltis_afm": Panel("the same skin, scan of 20 µm", material=skin(DARK)),
    "xenopeltis_synthetic": Panel("the same skin, synthetic", material=skin(DARK)),
    "elaphe": Panel("skin of Elaphe guttata, scan of 65 µm", material=skin(RED, 90)),
    "elaphe_afm": Panel("the same skin, scan of 6 µm", material=skin(RED, 90)),
    "elaphe_synthetic": Panel("the same skin, synthetic", material=skin(RED, 90)),
    "morpho_ridges": Panel("ridges of a Morpho's scale, without its blue", material=skin(BLUE)),
    "film": Panel("film of diffraction glasses, 530 lines/mm crosswise", "pane", SHEET),
    "transmission_300": Panel("transmission grating, 300 lines/mm", "pane", SHEET),
    "transmission_600": Panel("transmission grating, 600 lines/mm", "pane", SHEET),
}

# On a disk x is the radius: tracks, which run along y, run around the disk.
OBJECTS = {
    "arch": '<shape type="ply"><string name="filename" value="arch.ply"/><ref id="surface"/></shape>',
    "disc": """<shape type="disk"><transform name="to_world"><scale value="1.3"/><translate z="0.05"/></transform>
    <ref id="surface"/></shape>
<shape type="disk"><transform name="to_world"><scale value="0.33"/><translate z="0.052"/></transform>
    <bsdf type="diffuse"><rgb name="reflectance" value="0.02"/></bsdf></shape>""",
}
LAMP = """<bsdf type="diffuse"><spectrum name="reflectance" value="0"/></bsdf>
    <emitter type="area"><spectrum name="radiance" type="d65"><float name="scale" value="{}"/></spectrum></emitter>"""
LONG = """<shape type="rectangle"><transform name="to_world"><scale x="0.2" y="7"/>
    <lookat origin="{}, 3.5, 7" target="0, 0, 0" up="0, 1, 0"/></transform>{}</shape>"""
SMALL = '<shape type="sphere"><point name="center" x="{}" y="{}" z="{}"/><float name="radius" value="{}"/>{}</shape>'
LIT = """<scene version="3.0.0"><integrator type="path"><integer name="max_depth" value="2"/></integrator>
<sensor type="perspective"><float name="fov" value="32"/><transform name="to_world">
    <lookat origin="0, -3.4, 5.4" target="0, -0.05, 0.1" up="0, 0, 1"/></transform>
    <sampler type="multijitter"/><film type="hdrfilm"><rfilter type="gaussian"/></film></sensor>
<bsdf type="diffraction_grating" id="surface"><string name="filename" value="{recipe}"/>{material}</bsdf>
{objects}{lamps}
<shape type="rectangle"><transform name="to_world"><scale value="40"/><translate z="-0.3"/></transform>
    <bsdf type="diffuse"><spectrum name="reflectance" value="0.004"/></bsdf></shape>
<emitter type="constant"><spectrum name="radiance" type="d65"><float name="scale" value="{sky}"/></spectrum></emitter>
</scene>"""
NIGHT = """<scene version="3.0.0"><integrator type="path"><integer name="max_depth" value="3"/></integrator>
<sensor type="perspective"><float name="fov" value="60"/><transform name="to_world">
    <lookat origin="0, 0, 0" target="0, 1, 0" up="0, 0, 1"/></transform>
    <sampler type="multijitter"/><film type="hdrfilm"><rfilter type="gaussian"/></film></sensor>
<bsdf type="diffraction_grating" id="surface"><string name="filename" value="{recipe}"/>{material}</bsdf>
<shape type="rectangle"><transform name="to_world"><scale x="0.46" y="0.3"/><rotate x="1" angle="-90"/>
    <translate y="1"/></transform><ref id="surface"/></shape>
{lamps}
<emitter type="constant"><spectrum name="radiance" type="d65"><float name="scale" value="0.0006"/></spectrum></emitter>
</scene>"""


def write_arch(path: Path) -> None:
    """Write the mesh of the sheet, an arch along x, slightly bent along y."""
    from modelling import write_sheets

    x, y = np.linspace(-1.6, 1.6, 161), np.linspace(-1.1, 1.1, 81)
    z = 0.75 * (np.cos(np.pi * x / 3.2) - 0.5) - 0.1 * y[:, None] ** 2
    points = np.stack([*np.broadcast_arrays(x, y[:, None], z)], -1)
    write_sheets(path, [(points, (x + 1.6) / 3.2, (y + 1.1) / 2.2)])


def picture(name: str, folder: Path, spp: int) -> Image.Image:
    """Render the panel of one recipe; the mesh `arch.ply` is in the folder."""
    panel = PANELS[name]
    content = {"recipe": (RECIPES / f"{name}.toml").as_posix(), "material": panel.material}
    if panel.kind == "pane":
        lamps = "".join(SMALL.format(x, 6, z, 0.1, LAMP.format(3)) for x, z in ((-1.6, 0.9), (0, 0), (1.6, -0.9)))
        text = NIGHT.format(lamps=lamps, **content)
    else:
        if panel.kind == "disc":
            lamps = "".join(SMALL.format(x, 3.5, 7, 0.3, LAMP.format(60)) for x in (-4, 2.5))
        else:
            lamps = "".join(LONG.format(x, LAMP.format(20)) for x in (-4, 2.5))
        sky = 0.01 if "base" in panel.material else 0.06 if panel.kind == "disc" else 0.3
        text = LIT.format(objects=OBJECTS[panel.kind], lamps=lamps, sky=sky, **content)
    scene, made = folder / f"{name}.xml", folder / f"{name}.png"
    scene.write_text(text, encoding="utf-8")
    image = render(SceneFile(scene, size=(WIDTH, HEIGHT)), spp=spp)
    loaded = SceneFile(scene, size=(WIDTH, HEIGHT)).load()
    save_preview(image, made, denoise=lambda xyz: denoised_picture(loaded, xyz))
    return Image.open(made).copy()


def sheet(pictures: Mapping[str, Image.Image]) -> Image.Image:
    """Return the pictures in columns, the name of the recipe and its line below each."""
    rows = -(-len(pictures) // COLUMNS)
    size = COLUMNS * (WIDTH + GAP) + GAP, rows * (HEIGHT + TEXT + GAP) + GAP
    result = Image.new("RGB", size, "white")
    draw = ImageDraw.Draw(result)
    large, small = (ImageFont.truetype(findfont("DejaVu Sans"), points) for points in (19, 15))
    for index, (name, shown) in enumerate(pictures.items()):
        row, column = divmod(index, COLUMNS)
        left, top = GAP + column * (WIDTH + GAP), GAP + row * (HEIGHT + TEXT + GAP)
        result.paste(shown, (left, top))
        draw.text((left, top + HEIGHT + 6), name, "black", large)
        draw.text((left, top + HEIGHT + 32), PANELS[name].text, "#444", small)
    return result


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("output", type=Path)
    parser.add_argument("--spp", type=int, default=49, help="samples per pixel")
    arguments = parser.parse_args()
    import mitsuba as mi  # after the package, which chooses LLVM

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_arch(folder / "arch.ply")
        mi.set_variant(choose_variant(None))
        pictures = {name: picture(name, folder, arguments.spp) for name in PANELS}
    with whole_file(arguments.output) as temporary:
        sheet(pictures).save(temporary, "PNG")


if __name__ == "__main__":
    main()
