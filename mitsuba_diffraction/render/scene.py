"""Loading of Mitsuba scenes with a spectral film."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager

import mitsuba as mi
import mitsuba.parser
import numpy as np

from ..bsdf.base import gratings_in
from ..bsdf.light import cover_light, recorded_wavelengths
from ..errors import RequestError
from ..variants import is_supported
from .parsed_scene import parsed
from .parser_state import children_of
from .scene_film import SpectralRange, replace_films
from .scene_light import draw_wavelengths_of_lights, warn_of_light_from_below
from .scene_materials import Materials, check_materials, warn_of_unused_materials

_log = logging.getLogger(__name__)


def recorded_range(scene: mi.Scene) -> SpectralRange:
    """Return the range of the first sensor of a scene from `load_spectral_scene`."""
    shortest, longest = recorded_wavelengths(scene.sensors()[0].film())
    return round(shortest, 6), round(longest, 6)


def load_spectral_scene(
    path: str | os.PathLike[str],
    *,
    width: int | None = None,
    height: int | None = None,
    parameters: Mapping[str, str] | None = None,
    materials: Materials | None = None,
    motion: tuple[float, ...] | None = None,
) -> mi.Scene:
    """Load an XML scene in the current variant and replace its film by a spectral one.

    The film becomes a `specfilm` of float32 whose channels are hat functions at `channel_wavelengths()` with areas of
    `channel_weights()`: divided by these, a channel is spectral radiance per nm, averaged over the hat. The channels
    cover visible light, or the bands of a `specfilm` that lie outside it. Size, crop and reconstruction filter are
    taken from the scene. File names in the scene are relative to its folder.

    Args:
        width: of the full film in pixels; the crop window is scaled with it. If only one of width and height is given,
            the aspect ratio is preserved.
        height: likewise.
        parameters: values for the scene's `$name` parameters (`-Dname=value` of Mitsuba's command line).
        materials: id of a BSDF → parameters of the `diffraction_grating` that replaces it. Of a BSDF that holds others
            (`twosided`, `mask`, `normalmap`, `bumpmap`, `blendbsdf`), these are replaced; only a `twosided` around a
            grating that transmits light is removed. Below a dielectric of scalar theory the BSDF remains as `base`,
            unless that is given; "none" stands for none. `path` becomes `diffraction_path`.
        motion: of the first sensor: an affine map of world space, 16 numbers in row-major order, applied after its
            `to_world`.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if no spectral variant is set, a size is not positive, a parameter is unknown to the scene, no BSDF
            has one of the ids, or the scene is wrong.
    """
    if not is_supported(mi.variant()):
        raise RequestError(f"variant: got {mi.variant()!r}, wanted a spectral one, such as 'llvm_ad_spectral'")
    for name, size in (("width", width), ("height", height)):
        if size is not None and size < 1:
            raise RequestError(f"{name}: got {size}, wanted a positive number of pixels")
    with parsed(path, parameters, materials) as (config, state):
        if materials:
            check_materials(materials)
            warn_of_unused_materials(state, materials)
        replace_films(state, width, height)
        _unwrap_integrators(state)
        if materials:
            _trace_cast_light(state)
        if motion is not None:
            _move_first_sensor(state, motion)
        scene = instantiated(config, state)
    if not isinstance(scene, mi.Scene):
        raise RequestError(f"{path}: the file holds a {type(scene).__name__}, wanted a scene")
    if scene.integrator() is None:
        raise RequestError(f'{path}: the scene has no integrator, wanted one, such as <integrator type="path"/>')
    if scene.integrator().aov_names():
        raise RequestError(f"{path}: the integrator gives {scene.integrator().aov_names()}, wanted radiance only")
    draw_wavelengths_of_lights(scene)
    return scene


def instantiated(config: mi.parser.ParserConfig, state: mi.parser.ParserState) -> mi.Object:
    """Return the object of a parsed file, whose gratings cover its light if it is a scene; inside of `parsed`."""
    mi.parser.transform_all(config, state)
    _round_sample_counts(state)
    # Serially: on several threads, Mitsuba 3.9.1 crashed once in a loop of loads and renderings.
    config.parallel = False
    scene = mi.parser.instantiate(config, state)
    if isinstance(scene, mi.Scene):
        cover_light(scene)
    return scene


def warn_of_gratings(scene: mi.Scene) -> None:
    """Log a warning for gratings on meshes without UVs, and for gratings that are black as they are lit from below.

    Not part of `load_spectral_scene`, since a rendering may load its scene again, also on workers.
    """
    _warn_of_missing_uvs(scene)
    warn_of_light_from_below(scene)


def _warn_of_missing_uvs(scene: mi.Scene) -> None:
    """Log a warning if gratings are on meshes without texture coordinates; named by BSDF, as merged meshes lose ids."""
    bsdfs = [shape.bsdf() for shape in scene.shapes() if shape.is_mesh() and not has_uvs(shape)]
    if names := sorted({bsdf.id() or "a BSDF" for bsdf in bsdfs if gratings_in(bsdf)}):
        _log.warning(
            "%s: on a mesh without UVs, where the direction of the grating differs from triangle to triangle; "
            "wanted a mesh with UVs",
            ", ".join(names),
        )


def has_uvs(mesh: mi.Shape) -> bool:
    """Return whether a mesh has UVs; Mitsuba 3.10 renames the method."""
    return mesh.has_texcoords() if hasattr(mesh, "has_texcoords") else mesh.has_vertex_texcoords()


def _unwrap_integrators(state: mi.parser.ParserState) -> None:
    """Replace integrators that add other quantities to radiance by the integrator nested in them."""
    for node in state.nodes:
        is_wrapper = node.type == mi.ObjectType.Integrator and node.props.plugin_name() in ("aov", "moment")
        if is_wrapper and (inner := children_of(state, node.props, mi.ObjectType.Integrator)):
            node.props = mi.Properties(state.nodes[next(iter(inner.values()))].props)


def _trace_cast_light(state: mi.parser.ParserState) -> None:
    """Replace `path` by `diffraction_path` where that supports the scene: the same picture, without fireflies."""
    unsupported = any("sample_border" in node.props for node in state.nodes)
    for node in state.nodes:
        hides = mi.Properties(node.props).get("hide_emitters", False)
        if node.props.plugin_name() == "path" and not (hides or unsupported):
            node.props.set_plugin_name("diffraction_path")


def _move_first_sensor(state: mi.parser.ParserState, motion: tuple[float, ...]) -> None:
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
