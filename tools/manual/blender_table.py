"""Renders gratings on a table by nodes in Cycles and path traced: blender_nodes.png and blender_paths.png in FOLDER.

    python tools/manual/blender_table.py FOLDER [WIDTH [SAMPLES [OF_DISC]]]

$BLENDER_PYTHON is a Python with bpy (tools/manual/cycles_picture.py). Both pictures have direct light alone, and
are denoised by Open Image Denoise. Cycles renders the disc, of which a sample seldom hits a lamp, once more with
OF_DISC samples, as a render region. Lengths are cm.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
from PIL import Image

from mitsuba_diffraction.optics.color import into_gamut, neutral_view

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "scenes"))
import anodised  # noqa: E402
import disc  # noqa: E402
import foil  # noqa: E402
import modelling  # noqa: E402
import snake  # noqa: E402

PERIOD, DEPTH = 1.8, 0.22  # of the dial, µm
PIGMENT = (0.016, 0.011, 0.009)
# Colour, roughness, metallic and index.
PAINTS = {
    "steel": ((0.55, 0.55, 0.56), 0.2, 1.0, 1.45),
    "leather": ((0.075, 0.026, 0.011), 0.6, 0.0, 1.45),
    "rim": ((0.28, 0.28, 0.29), 0.15, 0.0, 1.45),
    "eye": ((0.004, 0.003, 0.003), 0.1, 0.0, 1.45),
    "table": ((0.016, 0.021, 0.031), 0.4, 0.0, 1.3),
}
# Place, target, radius, radiance.
LAMPS = tuple((place, (0, 0, 0), 3.5, 300) for place in ((-16, 24, 34), (16, 12, 38), (-4, -2, 44)))
SKY, EXPOSURE = 0.05, -2.3  # of both pictures, stops
EYE, TARGET, FIELD = (0.5, -34, 27), (0.5, -0.6, 0.6), 37
REGION = (0.555, 0.955, 0.435, 0.85)  # of the disc: left, right, bottom, top


def placed(x, y, z, scale=1.0, degrees=0.0, flattened=1.0):
    """A matrix: scaled, rotated about z, moved."""
    c, s = scale * np.cos(np.deg2rad(degrees)), scale * np.sin(np.deg2rad(degrees))
    return [[c, -s, 0, x], [s, c, 0, y], [0, 0, scale * flattened, z], [0, 0, 0, 1]]


ON_TABLE, COILED, WATCH = placed(8.4, 4.6, 0.02), placed(-8.0, 0.8, 0.02, 0.6, -8), placed(0.2, -5.2, 0.9, 1.15, 4)
OBJECTS = (
    ("disc", ON_TABLE, "disc"),
    ("disc_rim", ON_TABLE, "rim"),
    ("foil", placed(8.4, -6.3, 0.02, 0.4, -10, 0.5), "foil"),
    ("snake", COILED, "snake"),
    ("eyes", COILED, "eye"),
    ("dial", WATCH, "dial"),
    ("case", WATCH, "steel"),
    ("hands", WATCH, "steel"),
    ("strap", WATCH, "leather"),
)


def meshes(folder):
    """Write the meshes as .ply for Mitsuba and as .npz for Blender."""
    top = disc.THICKNESS
    hands = [bar for hour in range(12) for bar in anodised.bar(30 * hour, 1.3, 1.6, 0.05, 0, 0.06)]
    for degrees, length, half_width, height in anodised.HANDS:
        hands += anodised.bar(degrees, -0.3, length, half_width, height - 0.025, height)
    sweep, v = snake.Sweep.along(700), np.linspace(0, 1, 33)
    rim = (
        ((disc.HOLE, top), (disc.METAL, top)),
        ((disc.RIM, top), (disc.EDGE, top)),
        ((disc.EDGE, top), (disc.EDGE, 0)),
    )
    sheets = {
        "disc": [modelling.revolved([(disc.METAL, top), (disc.RIM, top)], 512)],
        "disc_rim": [modelling.revolved(part, 256) for part in rim],
        "foil": [foil.sheet(400)],
        "snake": [(sweep.surface(v), sweep.u, v)],
        "dial": [modelling.revolved([(0.02, 0), (anodised.DIAL, 0)], 256)],
        "case": [modelling.revolved(anodised.smooth(np.array(anodised.CASE)), 256)],
        "hands": hands,
        "strap": [anodised.strap(-1), anodised.strap(1)],
    }
    turn = foil.shards(np.random.default_rng(6), 1200)[0]
    for name, rows in (("turn", turn[::-1]), ("turn_of_blender", turn)):  # v runs down in Mitsuba's pictures
        modelling.write_numbers(folder / f"{name}.exr", rows)
    snake.eyes(folder / "eyes.ply", sweep)
    for name, parts in sheets.items():
        modelling.write_sheets(folder / f"{name}.ply", parts)
    for name in (*sheets, "eyes"):
        path = folder / f"{name}.ply"
        mesh = modelling.mi.traverse(modelling.mi.load_dict({"type": "ply", "filename": str(path)}))
        columns = {"vertex_positions": 3, "vertex_normals": 3, "vertex_texcoords": 2, "faces": 3}
        np.savez(path.with_suffix(".npz"), **{key: np.reshape(mesh[key], (-1, n)) for key, n in columns.items()})


def tables(folder):
    """Write the tables of the nodes."""
    surfaces = {"disc": "compact_disc,material=Al", "foil": "foil,material=Al", "snake": "xenopeltis"}
    surfaces["dial"] = f"sinusoidal,period={PERIOD},depth={DEPTH},material=Al"
    for name, surface in surfaces.items():
        path = folder / f"{name}_tables.npz"
        subprocess.run(["mitsuba-diffraction", "export", surface, "-o", str(path), "--overwrite"], check=True)


def scene_file(folder, width):
    """Write the scene for `mitsuba-diffraction render`; return its path."""

    def rgb(name, colour):
        return f'<rgb name="{name}" value="{", ".join(map(str, colour))}"/>'

    def number(name, value):
        return f'<float name="{name}" value="{value}"/>'

    def text(name, value):
        return f'<string name="{name}" value="{value}"/>'

    def white(name, scale):
        return f'<spectrum name="{name}" type="d65">{number("scale", scale)}</spectrum>'

    def looking(place, target, before=""):
        joined = [", ".join(map(str, point)) for point in (place, target)]
        look = f'<lookat origin="{joined[0]}" target="{joined[1]}" up="0, 0, 1"/>'
        return f'<transform name="to_world">{before}{look}</transform>'

    aluminium = text("material", "Al")
    turn = text("filename", folder / "turn.exr") + text("filter_type", "nearest") + '<boolean name="raw" value="true"/>'
    turn = f'<texture type="bitmap" name="orientation">{turn}</texture>'
    inside = {
        "disc": text("profile", "compact_disc") + aluminium + number("coat_ior", 1.55),
        "foil": text("profile", "foil") + aluminium + turn,
        "dial": text("profile", "sinusoidal") + aluminium + number("period", PERIOD) + number("depth", DEPTH),
        "snake": text("filename", ROOT / "precompute" / "xenopeltis.toml")
        + f'<bsdf type="diffuse" name="base">{rgb("reflectance", PIGMENT)}</bsdf>',
    }
    bsdfs = {name: f'<bsdf type="diffraction_grating">{values}</bsdf>' for name, values in inside.items()}
    for name, (colour, *others) in PAINTS.items():
        values = rgb("base_color", colour)
        values += "".join(map(number, ("roughness", "metallic", "eta"), others))
        bsdfs[name] = f'<bsdf type="twosided"><bsdf type="principled">{values}</bsdf></bsdf>'
    size = f'<integer name="width" value="{width}"/><integer name="height" value="{width * 9 // 16}"/>'
    parts = [
        '<integrator type="diffraction_path"><integer name="max_depth" value="2"/></integrator>',
        f'<sensor type="perspective">{number("fov", FIELD)}{looking(EYE, TARGET)}',
        f'<film type="hdrfilm">{size}</film></sensor>',
        f'<emitter type="constant">{white("radiance", SKY)}</emitter>',
        f'<shape type="rectangle"><transform name="to_world"><scale value="200"/></transform>{bsdfs["table"]}</shape>',
    ]
    for name, matrix, kind in OBJECTS:
        place = f'<matrix value="{" ".join(map(str, np.ravel(matrix)))}"/>'
        mesh = f'{text("filename", folder / f"{name}.ply")}<transform name="to_world">{place}</transform>'
        parts.append(f'<shape type="ply">{mesh}{bsdfs[kind]}</shape>')
    for place, target, radius, radiance in LAMPS:
        light = f'<emitter type="area">{white("radiance", radiance)}</emitter>'
        parts.append(f'<shape type="disk">{looking(place, target, f"""<scale value="{radius}"/>""")}{light}</shape>')
    path = folder / "table.xml"
    path.write_text("\n".join(['<scene version="3.0.0">', *parts, "</scene>"]))
    return path


def main(folder, width=1280, samples=192, of_disc=640):
    folder.mkdir(exist_ok=True)
    meshes(folder)
    tables(folder)
    scene = {"objects": OBJECTS, "paints": PAINTS, "pigment": PIGMENT, "lamps": LAMPS, "sky": SKY}
    scene |= {"eye": EYE, "target": TARGET, "field": FIELD, "width": width, "samples": samples}
    scene |= {"region": REGION, "of_disc": of_disc}
    (folder / "scene.json").write_text(json.dumps(scene))
    script = Path(__file__).with_name("blender_table_in_cycles.py")
    subprocess.run([os.environ["BLENDER_PYTHON"], str(script), str(folder)], check=True)
    linear = 2**EXPOSURE * np.load(folder / "cycles.npy")
    Image.fromarray(np.uint8(np.round(255 * neutral_view(into_gamut(linear))))).save(folder / "blender_nodes.png")
    render = ["mitsuba-diffraction", "render", str(scene_file(folder, width)), "--spp", str(samples // 12), "--denoise"]
    output = ["--exposure", str(EXPOSURE), "-o", str(folder / "blender_paths.png"), "--overwrite"]
    subprocess.run([*render, *output], check=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]).absolute(), *map(int, sys.argv[2:]))
