"""Renders the scene that tools/manual/blender_table.py wrote into a folder, by nodes in Cycles; run by it."""

import contextlib
import json
import math
import os
import sys

import bpy
import numpy as np
from mathutils import Matrix, Vector

REPOSITORY = os.path.dirname(os.path.dirname(os.path.dirname(os.path.abspath(__file__))))
sys.path.append(os.path.join(REPOSITORY, "mitsuba_diffraction", "export", "assets", "blender"))


def grating(folder, name, pigment):
    """A material of tables; the x axis of the pattern runs along u."""
    import nodes as of_blender

    tables = of_blender.read_tables(os.path.join(folder, f"{name}_tables.npz"))
    tables["coat"] = np.array(1.55 if name == "disc" else 1.0)
    material, group = of_blender.new_material(name, tables)
    group.inputs["BaseColor"].default_value = (*pigment, 1)
    tangent = material.node_tree.nodes.new("ShaderNodeTangent")
    tangent.direction_type = "UV_MAP"
    material.node_tree.links.new(tangent.outputs[0], group.inputs["Tangent"])
    if name == "foil":
        turn = material.node_tree.nodes.new("ShaderNodeTexImage")
        turn.image = bpy.data.images.load(os.path.join(folder, "turn_of_blender.exr"))
        turn.image.colorspace_settings.name, turn.interpolation = "Non-Color", "Closest"
        material.node_tree.links.new(turn.outputs["Color"], group.inputs["Orientation"])
    return material


def paint(name, colour, roughness, metallic, index):
    material = bpy.data.materials.new(name)
    material.use_nodes = True
    inputs = material.node_tree.nodes["Principled BSDF"].inputs
    values = {"Base Color": (*colour, 1), "Roughness": roughness, "Metallic": metallic, "IOR": index}
    for key, value in values.items():
        inputs[key].default_value = value
    return material


def towards(place, target):
    return (Vector(target) - Vector(place)).to_track_quat("-Z", "Y").to_euler()


def added(name, data, **where):
    made = bpy.data.objects.new(name, data)
    for key, value in where.items():
        setattr(made, key, value)
    bpy.context.collection.objects.link(made)
    return made


def build(folder, of):
    materials = {name: paint(name, *values) for name, values in of["paints"].items()}
    materials |= {name: grating(folder, name, of["pigment"]) for name in ("disc", "foil", "snake", "dial")}
    for name, matrix, kind in of["objects"]:
        read = np.load(os.path.join(folder, f"{name}.npz"))
        mesh = bpy.data.meshes.new(name)
        mesh.from_pydata(read["vertex_positions"].tolist(), [], read["faces"].tolist())
        uvs = read["vertex_texcoords"][read["faces"].ravel()].astype(np.float32)
        mesh.uv_layers.new(name="UVMap").data.foreach_set("uv", uvs.ravel())
        mesh.normals_split_custom_set_from_vertices(read["vertex_normals"].tolist())
        mesh.materials.append(materials[kind])
        added(name, mesh, matrix_world=Matrix(matrix))
    bpy.ops.mesh.primitive_plane_add(size=400)
    bpy.context.object.data.materials.append(materials["table"])
    for place, target, radius, radiance in of["lamps"]:
        light = bpy.data.lights.new("lamp", "AREA")
        light.shape, light.size, light.energy = "DISK", 2 * radius, radiance * (math.pi * radius) ** 2
        added("lamp", light, location=place, rotation_euler=towards(place, target))
    scene = bpy.context.scene
    world = scene.world = bpy.data.worlds.new("world")
    world.use_nodes = True
    world.node_tree.nodes["Background"].inputs[0].default_value = (of["sky"],) * 3 + (1,)
    camera = bpy.data.cameras.new("camera")
    camera.angle = math.radians(of["field"])
    scene.camera = added("camera", camera, location=of["eye"], rotation_euler=towards(of["eye"], of["target"]))
    return scene


def main(folder):
    with open(os.path.join(folder, "scene.json"), encoding="utf-8") as file:
        of = json.load(file)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = build(folder, of)
    scene.render.engine = "CYCLES"
    cycles = scene.cycles
    cycles.device, cycles.samples, cycles.max_bounces = "CPU", of["samples"], 0
    cycles.use_adaptive_sampling, cycles.use_denoising, cycles.sample_clamp_indirect = False, True, 0
    cycles.denoising_input_passes = "RGB"  # the normals are those of the facets that are drawn, which are noise
    width, height = of["width"], of["width"] * 9 // 16
    scene.render.resolution_x, scene.render.resolution_y = width, height
    scene.render.image_settings.file_format, scene.render.image_settings.color_depth = "OPEN_EXR", "32"
    found = rendered(scene, os.path.join(folder, "cycles.exr"))
    left, right, bottom, top = (round(x * n) for x, n in zip(of["region"], (width, width, height, height), strict=True))
    limits = scene.render
    limits.border_min_x, limits.border_max_x, limits.border_min_y, limits.border_max_y = of["region"]
    limits.use_border, cycles.samples = True, of["of_disc"]
    region = np.s_[height - top + 1 : height - bottom - 1, left + 1 : right - 1]  # Cycles rounds in its own way
    found[region] = rendered(scene, os.path.join(folder, "disc.exr"))[region]
    np.save(os.path.join(folder, "cycles.npy"), found)


def rendered(scene, path):
    """Linear sRGB, (rows, columns, 3)."""
    scene.render.filepath = path
    bpy.ops.render.render(write_still=True)
    image = bpy.data.images.load(path)
    values = np.empty(4 * image.size[0] * image.size[1], np.float32)
    image.pixels.foreach_get(values)
    return values.reshape(image.size[1], image.size[0], 4)[::-1, :, :3].copy()


if __name__ == "__main__":
    main(os.path.abspath(sys.argv[1]))
    with contextlib.suppress(OSError):
        sys.stdout.flush()
    os._exit(0)  # its add-ons print tracebacks when they are freed
