"""A scene of Blender, exported by Mitsuba-Blender: `python scenes/blender.py ADDON exported.xml`, for docs/blender.md.

ADDON is a git checkout of the add-on, with tags; `pip install bpy==4.5.15 mitsuba==3.5.0`, or `bpy==5.0.1`, in an
environment of Python 3.11. A ring, a monkey, a pane, foil and a floor, unwrapped by Blender; a sun, two area lights and
a dim world; Blender's own number of samples. Lengths are metres.
"""

from __future__ import annotations

import importlib
import math
import os
import subprocess
import sys
import traceback
from pathlib import Path
from typing import NoReturn

import bpy
import mitsuba
from mathutils import Euler, Vector

SEGMENTS = 128  # of the ring


def material(name: str, colour: tuple[float, float, float], roughness: float, **inputs: float) -> None:
    """Give the active object a Principled BSDF, with other inputs by their names."""
    made = bpy.data.materials.new(name)
    made.use_nodes = True
    sockets = made.node_tree.nodes["Principled BSDF"].inputs
    sockets["Base Color"].default_value = (*colour, 1)
    sockets["Roughness"].default_value = roughness
    for key, value in inputs.items():
        sockets[key.replace("_", " ")].default_value = value
    bpy.context.object.data.materials.append(made)


def ring(inner: float, outer: float) -> None:
    """Add a flat ring as the active object, and unwrap it."""
    angles = [2 * math.pi * k / SEGMENTS for k in range(SEGMENTS)]
    points = [(r * math.cos(angle), r * math.sin(angle), 0) for angle in angles for r in (inner, outer)]
    faces = [(k, k + 1, (k + 3) % len(points), (k + 2) % len(points)) for k in range(0, len(points), 2)]
    mesh = bpy.data.meshes.new("Disc")
    mesh.from_pydata(points, [], faces)
    made = bpy.data.objects.new("Disc", mesh)
    bpy.context.collection.objects.link(made)
    bpy.context.view_layer.objects.active = made
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.ops.mesh.select_all(action="SELECT")
    bpy.ops.uv.unwrap()
    bpy.ops.object.mode_set(mode="OBJECT")


def degrees(*angles: float) -> tuple[float, ...]:
    """Return Euler angles in radians."""
    return tuple(math.radians(angle) for angle in angles)


def objects() -> None:
    """Add all objects with their materials."""
    ring(0.15, 0.6)
    bpy.context.object.location, bpy.context.object.rotation_euler = (-1.35, 0.1, 0.62), degrees(65, 0, 25)
    material("Disc", (0.8, 0.8, 0.8), 0.5)
    bpy.ops.mesh.primitive_monkey_add(size=1.5, location=(0, 0.1, 0.7), rotation=degrees(-20, 0, 12))
    bpy.ops.object.modifier_add(type="SUBSURF")
    bpy.context.object.modifiers[-1].levels = 3
    bpy.ops.object.shade_smooth()
    material("Skin", (0.012, 0.009, 0.008), 0.5)
    bpy.ops.mesh.primitive_plane_add(size=1.2, location=(1.3, 0, 0.64), rotation=degrees(85, 0, -20))
    material("Glass", (1, 1, 1), 0.0, Transmission_Weight=1.0)
    bpy.ops.mesh.primitive_plane_add(size=0.7, location=(0.1, -0.85, 0.03), rotation=degrees(6, 0, 10))
    material("Foil", (0.8, 0.8, 0.8), 0.2, Metallic=1.0)
    bpy.ops.mesh.primitive_plane_add(size=40)
    material("Floor", (0.02, 0.02, 0.023), 0.6)


def towards(location: tuple[float, ...], target: tuple[float, ...]) -> Euler:
    """Return the rotation of a light at a location that shines on the target."""
    return (Vector(target) - Vector(location)).to_track_quat("-Z", "Y").to_euler()


def lamp(location: tuple[float, ...], target: tuple[float, ...], size: float, watts: float) -> None:
    """Add a round area light that shines on the target."""
    bpy.ops.object.light_add(type="AREA", location=location, rotation=towards(location, target))
    added = bpy.context.object.data
    added.shape, added.size, added.energy = "DISK", size, watts


def lights() -> None:
    """Add the lights and the world: a high sun and lamp for the skin, and a lamp behind the pane."""
    bpy.ops.object.light_add(type="SUN", rotation=towards((-0.4, -0.15, 0.9), (0, 0, 0)))
    bpy.context.object.data.energy = 5
    lamp((1.6, 0.6, 4.2), (0, 0, 0.6), 0.2, 700)
    lamp((1.95, 1.6, 0.5), (0, -4.2, 1.6), 0.12, 3)
    world = bpy.context.scene.world = bpy.data.worlds.new("Sky")
    world.use_nodes = True
    world.node_tree.nodes["Background"].inputs["Color"].default_value = (0.015, 0.018, 0.024, 1)


def main(addon: str, output: str) -> None:
    """Make the scene and export it."""
    mitsuba.set_variant("scalar_rgb")
    sys.path.insert(0, addon)
    importlib.import_module("mitsuba-blender.io").register()
    for old in list(bpy.data.objects):
        bpy.data.objects.remove(old)
    objects()
    lights()
    bpy.ops.object.camera_add(location=(0, -4.2, 1.9), rotation=degrees(71, 0, 0))
    scene = bpy.context.scene
    scene.camera, bpy.context.object.data.lens = bpy.context.object, 39
    scene.render.resolution_x, scene.render.resolution_y = 960, 540
    scene.cycles.max_bounces = 4
    bpy.ops.export_scene.mitsuba(filepath=str(Path(output).resolve()))
    blender, renderer = bpy.app.version_string, mitsuba.__version__
    print(f"Blender {blender}, Mitsuba-Blender {version_of(addon)}, Mitsuba {renderer}: {output}")


def version_of(addon: str) -> str:
    """Return the last numbered release of the add-on and the commits since."""
    describe = ["git", "-C", addon, "describe", "--tags", "--match", "v*"]
    return subprocess.run(describe, capture_output=True, text=True, check=True).stdout.strip()


def run(*arguments: str) -> NoReturn:
    """Run `main` and end the process, without the exit handlers of Blender and Mitsuba: together they do not return."""
    code = 0
    try:
        main(*arguments)
    except Exception:
        traceback.print_exc()
        code = 1
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


if __name__ == "__main__":
    run(*sys.argv[1:])
