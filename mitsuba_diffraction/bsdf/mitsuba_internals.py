"""What depends on the internals of a release of Mitsuba: names of its classes, and methods that may be renamed."""

from __future__ import annotations

import functools
from typing import Any

import mitsuba as mi

# Class names of plugins.
INSTANCE, SHAPE_GROUP = "Instance", "ShapeGroupPlugin"
RECTANGLE, DISK, SPHERE = "Rectangle", "Disk", "Sphere"
# Shapes of which rays miss the back.
ELLIPSOIDS, CURVES = ("Ellipsoids", "EllipsoidsMesh"), ("LinearCurve", "BSplineCurve")
TWO_SIDED, BLEND, NORMAL_MAP, BUMP_MAP = "TwoSidedBRDF", "BlendBSDF", "NormalMap", "BumpMap"
DIFFUSE, ROUGH_CONDUCTOR = "SmoothDiffuse", "RoughConductor"
DIRECTIONAL, POINT = "DirectionalEmitter", "PointLight"
INDEPENDENT = "IndependentSampler"


def nested_plugin(kind: str, **parameters: object) -> mi.Object:
    """Make a plugin without children.

    mi.load_dict replaces Mitsuba's file resolver during the call, while other threads construct plugins that may use
    it.
    """
    props = mi.Properties(kind)
    for name, value in parameters.items():
        props[name] = value
    return mi.PluginManager.instance().create_object(props)


def parts(plugin: mi.Object, kind: type) -> list[Any]:
    """Return the objects of a class that a plugin holds as parameters, such as both BSDFs of a `twosided`."""
    callback = _collector()(kind)
    plugin.traverse(callback)
    return callback.found


@functools.cache
def _collector() -> type:
    """Define the callback of `parts`, once: a class is a reference cycle, and keeps alive what its methods hold."""

    class Collector(mi.TraversalCallback):
        def __init__(self, kind: type) -> None:
            mi.TraversalCallback.__init__(self)
            self.kind, self.found = kind, list[Any]()

        def put(self, name: str, value: object, *rest: object) -> None:
            if isinstance(value, self.kind):
                self.found.append(value)

    return Collector


def has_uvs(mesh: mi.Shape) -> bool:
    """Return whether a mesh has UVs; Mitsuba 3.10 renames the method."""
    return mesh.has_texcoords() if hasattr(mesh, "has_texcoords") else mesh.has_vertex_texcoords()


def parser_config() -> mi.parser.ParserConfig:
    """Return the settings of the parser for the current variant, if there is one."""
    config = mi.parser.ParserConfig(mi.variant() or "scalar_spectral")
    # A merged mesh has no bounding box in Mitsuba 3.9.1.
    config.merge_meshes = False
    return config


def camera_rays(
    scene: mi.Scene, sensor: mi.Sensor, seed: mi.UInt32 | int, spp: int
) -> tuple[mi.Sampler, int, mi.RayDifferential3f, mi.Spectrum, mi.Vector2f]:
    """Prepare the film of a sensor; return its sampler, samples per pixel, rays, their weights and positions.

    They are those of Mitsuba's integrators in Python. With `spp` 0 there are as many as the sampler of the sensor has.
    """
    camera = nested_plugin("prb")
    sampler, spp = camera.prepare(sensor, seed, spp)
    return sampler, spp, *camera.sample_rays(scene, sensor, sampler)
