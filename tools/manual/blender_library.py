"""Writes a library of materials for Blender's asset browser. Run it by a Python that has bpy 4.5, which 5 can read:

    python tools/manual/blender_library.py diffraction_gratings.zip FOLDER

The ZIP is what `mitsuba-diffraction export -o diffraction_gratings.zip` writes. FOLDER gets ten materials with previews
in `diffraction_gratings.blend`, and their catalogue, `blender_assets.cats.txt`. Add it in Preferences → File Paths →
Asset Libraries.
"""

import contextlib
import math
import os
import sys
import tempfile
import uuid
import zipfile

import bpy
import numpy as np

CATALOGUE = str(uuid.uuid5(uuid.NAMESPACE_URL, "https://github.com/mitsuba_diffraction/gratings"))
SIZE, SAMPLES = 128, 48  # of a preview
READY = ("compact_disc", "dvd", "foil", "xenopeltis", "elaphe")
# Name: table or profile, period and depth in µm; medium; coat; mesh of the preview; whether it is radial.
MATERIALS = {
    "Compact disc": ("compact_disc", "Al", 1.55, "plane", True),
    "DVD": ("dvd", "Al", 1.55, "plane", True),
    "Embossed foil": ("foil", "Al", 1.0, "sphere", False),
    "Holographic star": (("sinusoidal", 1.5, 0.15), "Al", 1.0, "plane", False),
    "Rainbow steel, 1200 lines per mm": (("sinusoidal", 0.833, 0.12), "Ag", 1.0, "sphere", False),
    "Blazed grating": (("blazed", 1.667, 0.275), "Al", 1.0, "plane", False),
    "Skin of Xenopeltis": ("xenopeltis", None, 1.0, "sphere", False),
    "Skin of Elaphe": ("elaphe", None, 1.0, "sphere", False),
    "Watch dial": (("sinusoidal", 1.8, 0.22), "Ag", 1.0, "plane", True),
    "Engraved gold": (("lamellar", 2.0, 0.1), "Au", 1.0, "sphere", False),
}


def code_of(extension, folder):
    """The modules of the extension, and the folder of its tables."""
    with zipfile.ZipFile(extension) as archive:
        archive.extractall(os.path.join(folder, "gratings_of_extension"))
    sys.path.insert(0, folder)
    from gratings_of_extension import line_gratings, nodes

    return nodes, line_gratings, os.path.join(folder, "gratings_of_extension", "tables")


def material(name, code):
    """A material of `MATERIALS` and the mesh of its preview."""
    nodes, line_gratings, folder = code
    surface, medium, coat, mesh, radial = MATERIALS[name]
    if surface in READY:
        tables = nodes.read_tables(os.path.join(folder, f"{surface}.npz"))
    else:
        base = nodes.read_tables(os.path.join(folder, "foil.npz"))
        tables = line_gratings.line_grating(*surface, 0.5, base)
    if medium:
        tables["index"] = np.load(os.path.join(folder, "metals.npz"))[medium]
    tables["coat"] = np.array(coat)
    made, group = nodes.new_material(name, tables)
    group.inputs["Radial"].default_value = radial
    if medium is None:
        group.inputs["BaseColor"].default_value = (0.02, 0.014, 0.011, 1)
    tangent = made.node_tree.nodes.new("ShaderNodeTangent")
    tangent.direction_type = "UV_MAP"
    made.node_tree.links.new(tangent.outputs[0], group.inputs["Tangent"])
    if name == "Holographic star":
        nodes.add_star(made.node_tree, group)
    return made, mesh


def stage():
    """A camera and two lamps before a grey sky, and the meshes of the previews."""
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    cycles = scene.cycles
    cycles.device, cycles.samples, cycles.use_adaptive_sampling, cycles.use_denoising = "CPU", SAMPLES, False, True
    scene.render.resolution_x = scene.render.resolution_y = SIZE
    scene.render.film_transparent = True
    scene.render.image_settings.file_format = "PNG"
    for place, size in (((-3, 1, 4), 0.5), ((3, -1.5, 4.5), 0.4)):
        bpy.ops.object.light_add(type="AREA", location=place)
        lamp = bpy.context.object
        lamp.data.shape, lamp.data.size, lamp.data.energy = "DISK", size, 250
        lamp.rotation_euler = (-lamp.location).to_track_quat("-Z", "Y").to_euler()
    bpy.ops.object.camera_add(location=(0, -2.6, 3.4))
    camera = scene.camera = bpy.context.object
    camera.rotation_euler = (-camera.location).to_track_quat("-Z", "Y").to_euler()
    camera.data.angle = math.radians(33)
    world = scene.world = bpy.data.worlds.new("world")
    world.use_nodes = True
    world.node_tree.nodes["Background"].inputs[0].default_value = (0.12, 0.12, 0.12, 1)
    bpy.ops.mesh.primitive_uv_sphere_add(radius=1, segments=128, ring_count=64)
    bpy.ops.object.shade_smooth()
    sphere = bpy.context.object
    bpy.ops.mesh.primitive_plane_add(size=2)
    return {"sphere": sphere, "plane": bpy.context.object}


def preview(made, mesh, meshes, folder):
    """Render a material, and keep the picture as its preview."""
    for name, each in meshes.items():
        each.hide_render = name != mesh
        each.data.materials.clear()
    meshes[mesh].data.materials.append(made)
    path = bpy.context.scene.render.filepath = os.path.join(folder, "preview.png")
    bpy.ops.render.render(write_still=True)
    image = bpy.data.images.load(path)
    kept = made.preview_ensure()
    kept.image_size = (SIZE, SIZE)
    kept.image_pixels_float = image.pixels[:]
    bpy.data.images.remove(image)


def main(extension, folder):
    os.makedirs(folder, exist_ok=True)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    with tempfile.TemporaryDirectory() as temporary:
        code, meshes = code_of(extension, temporary), stage()
        for name in MATERIALS:
            made, mesh = material(name, code)
            preview(made, mesh, meshes, temporary)
            made.asset_mark()
            made.use_fake_user = True
            made.asset_data.catalog_id = CATALOGUE
            made.asset_data.author = "mitsuba_diffraction"
            made.asset_data.license = "MIT" if name.startswith("Skin") else "BSD-3-Clause"
            made.asset_data.tags.new("diffraction")
    for each in list(bpy.data.objects):
        bpy.data.objects.remove(each)
    bpy.data.orphans_purge(do_recursive=True)
    with open(os.path.join(folder, "blender_assets.cats.txt"), "w", encoding="utf-8") as file:
        file.write(f"VERSION 1\n\n{CATALOGUE}:Diffraction gratings:Diffraction gratings\n")
    path = os.path.join(folder, "diffraction_gratings.blend")
    bpy.ops.wm.save_as_mainfile(filepath=path, compress=True)
    print(f"{path}: {len(MATERIALS)} materials, {os.path.getsize(path) / 1e6:.2f} MB")


if __name__ == "__main__":
    main(*map(os.path.abspath, sys.argv[1:]))
    with contextlib.suppress(OSError):
        sys.stdout.flush()
    os._exit(0)  # its add-ons print tracebacks when they are freed
