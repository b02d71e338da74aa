"""Parsed scenes as they are traced: their integrators, sensors and samplers, and warnings of their gratings."""

from __future__ import annotations

import functools
import logging
import operator
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import mitsuba as mi
import mitsuba.parser
import numpy as np
from numpy.typing import NDArray

from ..bsdf.base import gratings_in
from ..bsdf.device_tables import on_device
from ..bsdf.light import cover_light, recorded_wavelengths
from ..bsdf.mitsuba_internals import has_uvs
from ..errors import RequestError
from .parser_state import children_of
from .scene_light import warn_of_light_from_below
from .spectral_film import SpectralRange

_log = logging.getLogger(__name__)


def recorded_range(scene: mi.Scene) -> SpectralRange:
    """Return the range of the first sensor of a scene from `SceneFile.load`."""
    shortest, longest = recorded_wavelengths(scene.sensors()[0].film())
    return round(shortest, 6), round(longest, 6)


def instantiated(config: mi.parser.ParserConfig, state: mi.parser.ParserState) -> mi.Object:
    """Return the object of a parsed file, inside of `SceneFile.parsed`; gratings of a scene cover its light."""
    mi.parser.transform_all(config, state)
    _round_sample_counts(state)
    # Serially: on several threads, Mitsuba 3.9.1 crashed once in a loop of loads and renderings.
    config.parallel = False
    scene = mi.parser.instantiate(config, state)
    if isinstance(scene, mi.Scene):
        cover_light(scene)
    return scene


def warn_of_gratings(scene: mi.Scene) -> None:
    """Log a warning for gratings on shapes without UVs, and for gratings that are black as they are lit from below.

    Not part of `SceneFile.load`, since workers load the scene of a rendering again.
    """
    _warn_of_missing_uvs(scene)
    warn_of_light_from_below(scene)


def _warn_of_missing_uvs(scene: mi.Scene) -> None:
    """Log a warning if gratings are on shapes without UVs; named by BSDF, as merged meshes lose ids."""
    _warn_of_shapes(
        [shape for shape in scene.shapes() if shape.is_mesh() and not has_uvs(shape)],
        "on a mesh without UVs, where the direction of the grating differs from triangle to triangle; wanted a mesh "
        "with UVs",
    )
    without = {int(getattr(mi.ShapeType, kind)): kind.lower() for kind in ("LinearCurve", "SDFGrid", "Ellipsoids")}
    for number, kind in without.items():
        _warn_of_shapes(
            [shape for shape in scene.shapes() if shape.shape_type() == number],
            f"on {kind}, which has no UVs: the direction of the grating is discontinuous; wanted a mesh with UVs",
        )


def _warn_of_shapes(shapes: Sequence[mi.Shape], warning: str) -> None:
    bsdfs = [shape.bsdf() for shape in shapes]
    if names := sorted({bsdf.id() or "a BSDF" for bsdf in bsdfs if gratings_in(bsdf)}):
        _log.warning("%s: %s", ", ".join(names), warning)


def shows_gratings(scene: mi.Scene, across: int = 1) -> NDArray[np.bool_]:
    """Return a mask of the pixels that show a grating, (height, width).

    Args:
        scene: as loaded.
        across: each of across² rays of a pixel hits a grating; by default the one through its centre.

    Raises:
        ValueError: if no pixel does.
    """
    sensor = scene.sensors()[0]
    columns, rows = sensor.film().crop_size()
    y, x = np.mgrid[: across * rows, : across * columns].reshape(2, -1) + 0.5
    position = mi.Point2f(on_device(x / (across * columns)), on_device(y / (across * rows)))
    si = scene.ray_intersect(mi.Ray3f(sensor.sample_ray(0.0, 0.5, position, mi.Point2f(0.5))[0]))
    shapes = [shape for shape in scene.shapes() if gratings_in(shape.bsdf())]
    hit = functools.reduce(operator.or_, (si.shape == mi.ShapePtr(shape) for shape in shapes), mi.Bool(False))
    shown = np.broadcast_to(np.array(hit), x.shape).reshape(rows, across, columns, across).all(axis=(1, 3))
    if not shown.any():
        raise RequestError("scene: no pixel shows only a grating, there is nothing to compare")
    return np.asarray(shown)


def unwrap_integrators(state: mi.parser.ParserState) -> None:
    """Replace integrators that add other quantities to radiance by the integrator nested in them."""
    for node in state.nodes:
        is_wrapper = node.type == mi.ObjectType.Integrator and node.props.plugin_name() in ("aov", "moment")
        if is_wrapper and (inner := children_of(state, node.props, mi.ObjectType.Integrator)):
            node.props = mi.Properties(state.nodes[next(iter(inner.values()))].props)


def replace_path(state: mi.parser.ParserState) -> None:
    """Replace `path` by `diffraction_path` where that supports the scene: the same picture.

    It has less noise of lamps seen in gratings, and no white specks. Deep paths take up to three times as long.
    """
    unsupported = any("sample_border" in node.props for node in state.nodes)
    for node in state.nodes:
        hides = mi.Properties(node.props).get("hide_emitters", False)
        if node.props.plugin_name() == "path" and not (hides or unsupported):
            node.props.set_plugin_name("diffraction_path")


def move_first_sensor(state: mi.parser.ParserState, motion: tuple[float, ...]) -> None:
    for node in state.nodes:
        if node.type == mi.ObjectType.Sensor:
            # The parser holds matrices in double precision.
            before = np.array(node.props["to_world"].matrix) if "to_world" in node.props else np.eye(4)
            node.props["to_world"] = mi.ScalarTransform4d(np.reshape(motion, (4, 4)) @ before)
            return


@contextmanager
def no_warnings() -> Iterator[None]:
    """Let Mitsuba print errors alone: its samplers warn each time that they round a number of samples up."""
    level = mi.log_level()
    mi.set_log_level(mi.LogLevel.Error)
    try:
        yield
    finally:
        mi.set_log_level(level)


def _round_sample_counts(state: mi.parser.ParserState) -> None:
    """Replace the numbers of samples of a scene by what its samplers draw, without their warnings."""
    for node in state.nodes:
        if node.type == mi.ObjectType.Sampler and isinstance(node.props.get("sample_count"), int):
            with no_warnings():
                sampler = mi.PluginManager.instance().create_object(mi.Properties(node.props))
            node.props["sample_count"] = sampler.sample_count()
