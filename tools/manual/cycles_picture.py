"""Renders what `mitsuba-diffraction export` writes for Cycles, by Blender's Python package, and saves linear sRGB.

Run it by a Python that has bpy (`pip install bpy==4.5.15`, Python 3.11), and NumPy, which comes with it:

    python tools/manual/cycles_picture.py FILE SHAPE RADIUS|sky SAMPLES SIZE OUT.npy [SPACE] [LEFT,RIGHT,LOW,HIGH]

FILE is a shader (.osl), or the tables of the node group (.npz); SHAPE is plane, sphere, disc, or a pane or
pane_from_behind, with the lamp behind it. In another working SPACE of Blender 5.0 or later, such as "Linear Rec.2020",
OUT is RGB of that. Four fractions of the picture are a rectangle outside of which it is black. The wheel has no
`oslquery`, by which Blender's window finds the sockets of a shader; they are added by hand here. The scene is that of
`path_traced` in tests/export/test_cycles.py.
"""

import contextlib
import math
import os
import sys
import time

import bpy
import numpy as np

REPOSITORY = os.path.dirname(os.path.dirname(os.path.dirname(os.path.abspath(__file__))))
sys.path.append(os.path.join(REPOSITORY, "mitsuba_diffraction", "export", "assets", "blender"))  # nodes

INPUTS = (
    ("HeightScale", "NodeSocketFloat", 1.0),
    ("Orientation", "NodeSocketFloat", 0.0),
    ("Radial", "NodeSocketInt", 0),
    ("Tangent", "NodeSocketVector", (0.0, 0.0, 0.0)),
    ("Roughness", "NodeSocketFloat", 1.0),
    ("Tint", "NodeSocketColor", (1.0, 1.0, 1.0, 1.0)),
    ("BaseColor", "NodeSocketColor", (0.0, 0.0, 0.0, 1.0)),
)


def material_of(shader):
    """A material with the Script node of a shader, or the group of nodes of tables, and the node."""
    if shader.endswith(".npz"):
        import nodes as of_blender

        return of_blender.new_material("grating", of_blender.read_tables(shader))
    import _cycles

    compiled = f"{os.path.splitext(shader)[0]}.oso"
    if not _cycles.osl_compile(shader, compiled):
        sys.exit(f"{shader}: it does not compile")
    material = bpy.data.materials.new("grating")
    material.use_nodes = True
    nodes = material.node_tree.nodes
    nodes.clear()
    script = nodes.new("ShaderNodeScript")
    script.mode = "EXTERNAL"
    script.filepath = compiled
    for name, kind, value in INPUTS:
        script.inputs.new(kind, name).default_value = value
    script.outputs.new("NodeSocketShader", "BSDF")
    output = nodes.new("ShaderNodeOutputMaterial")
    material.node_tree.links.new(script.outputs["BSDF"], output.inputs["Surface"])
    return material, script


def emission(strength):
    material = bpy.data.materials.new("lamp")
    material.use_nodes = True
    nodes = material.node_tree.nodes
    nodes.clear()
    emitter, output = nodes.new("ShaderNodeEmission"), nodes.new("ShaderNodeOutputMaterial")
    emitter.inputs["Strength"].default_value = strength
    material.node_tree.links.new(emitter.outputs[0], output.inputs["Surface"])
    return material


def build(shader, shape, light, samples, size, space=None):
    """A square, a sphere, a disc with grooves around it or a pane, below a lamp of radiance 100 or under a sky of 1."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    if space:
        bpy.ops.wm.set_working_color_space(working_space=space)
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    cycles = scene.cycles
    cycles.device, cycles.samples, cycles.max_bounces = "CPU", samples, 1
    cycles.shading_system = shader.endswith(".osl")
    cycles.use_adaptive_sampling, cycles.use_denoising, cycles.sample_clamp_indirect = False, False, 0
    cycles.pixel_filter_type = "BOX"
    scene.render.resolution_x = scene.render.resolution_y = size
    scene.render.image_settings.file_format, scene.render.image_settings.color_depth = "OPEN_EXR", "32"
    scene.render.threads_mode, scene.render.threads = "FIXED", 2
    material, script = material_of(shader)
    if shape == "sphere":
        bpy.ops.mesh.primitive_uv_sphere_add(radius=1, segments=256, ring_count=128)
        bpy.ops.object.shade_smooth()
        tangent = material.node_tree.nodes.new("ShaderNodeTangent")
        tangent.direction_type, tangent.axis = "RADIAL", "Z"
        material.node_tree.links.new(tangent.outputs[0], script.inputs["Tangent"])
    else:
        bpy.ops.mesh.primitive_plane_add(size=2, rotation=(0, math.pi if shape == "pane_from_behind" else 0, 0))
        script.inputs["Radial"].default_value = type(script.inputs["Radial"].default_value)(shape == "disc")
    bpy.context.object.data.materials.append(material)
    world = scene.world = bpy.data.worlds.new("world")
    world.use_nodes = True
    grey = 1.0 if light == "sky" else 0.0
    world.node_tree.nodes["Background"].inputs[0].default_value = (grey, grey, grey, 1)
    if light != "sky":
        where, turned = ((0, -1, -3), (0, 0, 0)) if "pane" in shape else ((0, -1, 3), (math.pi, 0, 0))
        bpy.ops.mesh.primitive_circle_add(
            vertices=64, radius=float(light), fill_type="NGON", location=where, rotation=turned
        )
        bpy.context.object.data.materials.append(emission(100))
    bpy.ops.object.camera_add(location=(0, 0, 4))
    scene.camera = bpy.context.object
    scene.camera.data.angle = math.radians(40)
    return scene


def main(shader, shape, light, samples, size, out, *further):
    space = next((word for word in further if "," not in word), None)
    scene = build(shader, shape, light, int(samples), int(size), space)
    render = scene.render
    for border in (word for word in further if "," in word):
        render.use_border = True
        numbers = map(float, border.split(","))
        render.border_min_x, render.border_max_x, render.border_min_y, render.border_max_y = numbers
    scene.render.filepath = f"{os.path.splitext(out)[0]}.exr"
    began = time.process_time()
    bpy.ops.render.render(write_still=True)
    seconds = time.process_time() - began
    image = bpy.data.images.load(scene.render.filepath)
    values = np.empty(4 * int(size) ** 2, np.float32)
    image.pixels.foreach_get(values)
    np.save(out, values.reshape(int(size), int(size), 4)[::-1, :, :3])
    print(f"{out}: {seconds:.1f} s of processor time")


if __name__ == "__main__":
    main(*map(os.path.abspath, sys.argv[1:2]), *sys.argv[2:6], os.path.abspath(sys.argv[6]), *sys.argv[7:])
    with contextlib.suppress(OSError):
        sys.stdout.flush()
    os._exit(0)  # its add-ons print tracebacks when they are freed
