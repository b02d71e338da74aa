"""Installs the extension in Blender by its own operators and calls the panel's; run by a Python that has bpy.

python extension_in_blender.py EXTENSION.zip TABLES.npz SAVED.blend
"""

import contextlib
import json
import os
import subprocess
import sys

import bpy


def refused(**settings):
    """The message with which the operator refuses settings."""
    for name, value in settings.items():
        setattr(bpy.context.scene.diffraction, name, value)
    try:
        bpy.ops.material.diffraction_create()
    except RuntimeError as error:
        return str(error)


def mean_of_picture(path):
    """The mean of the middle of a small picture of the open file, its cube under its lamp and a grey sky."""
    scene = bpy.context.scene
    scene.render.engine, scene.cycles.device, scene.cycles.samples = "CYCLES", "CPU", 256
    scene.render.resolution_x = scene.render.resolution_y = 32
    scene.render.image_settings.file_format, scene.render.filepath = "OPEN_EXR", path
    bpy.ops.render.render(write_still=True)
    pixels = bpy.data.images.load(path).pixels[:]
    middle = [pixels[4 * (32 * row + column)] for row in range(13, 19) for column in range(13, 19)]
    return sum(middle) / len(middle)


def is_valid(extension):
    """Whether Blender's own validation of packages takes the file."""
    import bl_pkg

    script = os.path.join(os.path.dirname(bl_pkg.__file__), "cli", "blender_ext.py")
    words = [sys.executable, script, "validate", extension]
    done = subprocess.run(words, capture_output=True, text=True)
    print(done.stdout, done.stderr)
    return done.returncode == 0


def main(extension, tables, saved):
    bpy.ops.wm.read_factory_settings()
    bpy.ops.extensions.package_install_files(filepath=extension, repo="user_default", enable_on_install=True)
    settings, found = bpy.context.scene.diffraction, {}
    settings.file = tables
    for surface in settings.bl_rna.properties["surface"].enum_items:
        settings.surface = surface.identifier
        bpy.ops.material.diffraction_create()
        material = bpy.context.object.active_material
        group = material.node_tree.nodes["Diffraction"]
        found[surface.identifier] = {
            "name": material.name,
            "radial": bool(group.inputs["Radial"].default_value),
            "tangent": group.inputs["Tangent"].is_linked,
            "nodes": len(group.node_tree.nodes),
        }
    settings.surface, settings.medium = "foil", "Au"
    bpy.ops.material.diffraction_create()
    messages = [refused(surface="file", file=other) for other in ("/gone.npz", extension, __file__)]
    settings.surface, settings.medium, settings.coat = "film", "Al", 1.55  # neither is of a film
    bpy.ops.material.diffraction_create()
    kinds = {
        each.bl_idname for each in bpy.context.object.active_material.node_tree.nodes["Diffraction"].node_tree.nodes
    }
    coated = refused(surface="xenopeltis", medium="own", coat=1.55)
    settings.surface = "compact_disc"
    files = {"coated": f"{saved[:-6]}_coated.blend", "exact": saved}
    for kind, file in files.items():
        settings.exact = kind == "exact"
        bpy.ops.material.diffraction_create()
        bpy.ops.wm.save_as_mainfile(filepath=file)
    script = bpy.context.object.active_material.node_tree.nodes["Diffraction"]
    exact = {"node": script.bl_idname, "bytes": len(script.bytecode), "radial": script.inputs["Radial"].default_value}
    bpy.ops.preferences.addon_disable(module="bl_ext.user_default.diffraction_gratings")
    means = {}
    for kind, file in files.items():
        bpy.ops.wm.open_mainfile(filepath=file)
        means[kind] = mean_of_picture(f"{file}.exr")
    found = {"surfaces": found, "messages": messages, "coated": coated, "means": means, "exact": exact}
    found |= {"transparent": "ShaderNodeBsdfRefraction" in kinds}
    found |= {"version": bpy.app.version[:2], "valid": is_valid(extension)}
    print("FOUND", json.dumps(found))


if __name__ == "__main__":
    main(*map(os.path.abspath, sys.argv[1:]))
    with contextlib.suppress(OSError):
        sys.stdout.flush()
    os._exit(0)  # its add-ons print tracebacks when they are freed
