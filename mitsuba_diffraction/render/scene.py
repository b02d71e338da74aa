"""Loading of Mitsuba scenes with a spectral film."""

from __future__ import annotations

import hashlib
import logging
import os
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import mitsuba.parser
import numpy as np
from numpy.typing import NDArray

from ..bsdf.base import gratings_in, is_grating
from ..bsdf.diffraction_grating import check
from ..bsdf.light import cover_light, recorded_wavelengths
from ..errors import RequestError, root_cause
from ..files import refuse_other_than_utf8
from ..llvm import is_supported
from ..precomputation import is_rigorous
from ..recipe import Recipe
from ..settings import VISIBLE

_log = logging.getLogger(__name__)

# Spacing of the channels, nm, at most.
#
# With 5 nm, colours differ from the exact ones by ΔE₂₀₀₀ ≤ 0.05 for lines 5 nm wide and by at most 0.6 for laser lines
# (10 nm: 1.3 and 3.2; 23.5 nm: 90), and the orders of a grating, 5–20 nm wide at a coherence length of 65 µm, are
# resolved. The spacing affects memory but not time, as `film` adds a sample to at most eight channels.
_CHANNEL_STEP = 5.0

_STEPS_PER_CHANNEL = 20  # of the density from which wavelengths are drawn; a step is narrower than a lamp's lines
_DRAWS_PER_LIGHT = 2**14  # of four wavelengths, to estimate the spectrum of the light

Materials = Mapping[str, Mapping[str, bool | float | str]]
"""Id of a BSDF → parameters of the grating that replaces it."""

_PLUGINS = ("diffraction_grating", "diffraction_path", "diffraction_shader")
# Of BSDFs; `principled` has `spec_trans`.
_TRANSMITTING = {"dielectric", "roughdielectric", "thindielectric", "principledthin", "null"}
_RAYS_OF_SENSOR = 4096  # to sample the visible surfaces and their lights
_MAX_LOBE_VALUE = 1e4  # of a BSDF with narrow lobes, 1/sr
_MAX_NOISE_FACTOR = 1e4  # of the luminance of a pixel over that of the brightest light
_MAX_PIXELS = 2**25  # above 7680 × 4320; see also `film.check_memory`
_FORMATS_WITH_ALPHA = {"luminance_alpha", "rgba", "xyza"}
_DEFAULT_SIZE = (768, 576)  # width and height of Mitsuba's films


SpectralRange = tuple[float, float]
"""(shortest, longest) wavelength that a film records, nm."""


def channel_wavelengths(spectral_range: SpectralRange = VISIBLE) -> NDArray[np.float64]:
    """Return the centres of the film's channels, (n,), nm, equidistant; the hat functions lie inside the range."""
    count = max(2, round((spectral_range[1] - spectral_range[0]) / _CHANNEL_STEP) - 1)
    return np.linspace(*spectral_range, count + 2)[1:-1]


def channel_weights(spectral_range: SpectralRange = VISIBLE) -> NDArray[np.float64]:
    """Return the area of the response of each channel, (n,); the recorded value divided by it is radiance.

    Mitsuba samples wavelengths in proportion to the sum of the responses of the film. With hats of unit area, half of
    the samples would have wavelengths to which the eye is insensitive. These weights follow the density of Mitsuba's
    RGB film, sech²(0.0072 (λ − 538 nm)) (Radziszewski, Boryczko and Alda 2009). They reduce colour noise by a quarter,
    as much as 1.8 times the samples would. The lower bound of one quarter limits the noise of a channel to twice the
    noise of the best one.
    """
    return np.maximum(np.cosh(0.0072 * (channel_wavelengths(spectral_range) - 538)) ** -2, 0.25)


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
            _check_materials(materials)
            _warn_of_unused_materials(state, materials)
        _replace_films(state, width, height)
        _unwrap_integrators(state)
        if materials:
            _trace_cast_light(state)
        if motion is not None:
            _move_first_sensor(state, motion)
        mi.parser.transform_all(config, state)
        _round_sample_counts(state)
        # Serially: on several threads, Mitsuba 3.9.1 crashed once in a loop of loads and renderings.
        config.parallel = False
        scene = mi.parser.instantiate(config, state)
        if isinstance(scene, mi.Scene):
            cover_light(scene)
    if not isinstance(scene, mi.Scene):
        raise RequestError(f"{path}: the file holds a {type(scene).__name__}, wanted a scene")
    if scene.integrator() is None:
        raise RequestError(f'{path}: the scene has no integrator, wanted one, such as <integrator type="path"/>')
    if scene.integrator().aov_names():
        raise RequestError(f"{path}: the integrator gives {scene.integrator().aov_names()}, wanted radiance only")
    _draw_wavelengths_of_lights(scene)
    return scene


def warn_of_gratings(scene: mi.Scene) -> None:
    """Log a warning for gratings on meshes without UVs, and for gratings that are black as they are lit from below.

    Not part of `load_spectral_scene`, since a rendering may load its scene again, also on workers.
    """
    _warn_of_missing_uvs(scene)
    _warn_of_light_from_below(scene)


def _warn_of_unused_materials(state: mi.parser.ParserState, materials: Materials) -> None:
    """Log a warning for each grating that replaces a BSDF to which nothing in the scene refers."""
    # Follow references from all objects of the scene except its BSDFs.
    waiting = [k for k in _children(state, state.root.props).values() if state.nodes[k].type != mi.ObjectType.BSDF]
    used = set()
    while waiting:
        used.add(node := waiting.pop())
        waiting += [child for child in _children(state, state.nodes[node].props).values() if child not in used]
    for name in materials:
        if state.id_to_index[name] not in used:
            _log.warning("material %s: no shape uses the BSDF with that id, so the picture is unaffected", name)


def _warn_of_light_from_below(scene: mi.Scene) -> None:
    """Log a warning for gratings without transmission that are seen or lit only from below, and therefore black."""
    gratings = [shape for shape in scene.shapes() if is_grating(shape.bsdf())]
    opaque = [shape for shape in gratings if not shape.bsdf().layers.interface.transmits]
    if not opaque or not scene.sensors():
        return
    si, light, weight = _visible_points(scene)
    lit = dr.any(mi.unpolarized_spectrum(weight) != 0)
    seen_above, lit_above = si.wi.z > 0, lit & (mi.Frame3f.cos_theta(si.to_local(light.d)) > 0)
    for shape in opaque:
        on_shape = si.is_valid() & (si.shape == mi.ShapePtr(shape))
        bright = seen_above & lit_above
        if dr.count(on_shape & lit)[0] > 0 and dr.count(on_shape & bright)[0] == 0:
            cause = "lit" if dr.count(on_shape & seen_above)[0] > 0 else "seen"
            _log.warning(
                "diffraction_grating of shape %s is %s from below only, where it is black: transmission=sheet or "
                "interface transmits light, twosided adds a grating below",
                shape.id(),
                cause,
            )


def _visible_points(scene: mi.Scene) -> tuple[mi.SurfaceInteraction3f, mi.DirectionSample3f, mi.Spectrum]:
    """Trace rays of the first sensor, and draw a light for each point hit; return points, lights and weights."""
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, _RAYS_OF_SENSOR)
    ray, _ = scene.sensors()[0].sample_ray(0, sampler.next_1d(), sampler.next_2d(), sampler.next_2d())
    si = scene.ray_intersect(mi.Ray3f(ray))
    return si, *scene.sample_emitter_direction(si, sampler.next_2d(), False, si.is_valid())


def max_plausible_luminance(scene: mi.Scene) -> float:
    """Return a luminance that no pixel should exceed by noise: 10⁴ times the luminance of the brightest light found.

    Point and directional lights have an irradiance E instead of a radiance L, and narrow lobes reflect up to some
    10⁴ E: they count as L = 10⁴ E. The result is infinite if no light is found.
    """
    si, light, weight = _visible_points(scene)
    sampled = mi.unpolarized_spectrum(weight) * light.pdf * dr.select(light.delta, _MAX_LOBE_VALUE, 1)
    seen = mi.unpolarized_spectrum(si.emitter(scene).eval(si))
    found = np.concatenate([np.ravel(values) for values in (*sampled, *seen)])
    brightest = found[np.isfinite(found)].max(initial=0)
    return float(brightest) * _MAX_NOISE_FACTOR if brightest > 0 else np.inf


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


def _draw_wavelengths_of_lights(scene: mi.Scene) -> None:
    """Make the sensors draw a quarter of the wavelengths, one of a ray's four, in the spectral lines of the lights.

    Mitsuba draws them in proportion to the response r(λ) of the film: about one in a hundred falls into a line of 1 nm,
    with a weight of a hundred. With s_l(λ) the spectrum of light l and ∫ r dλ = ∫ r s_l dλ = 1, they are drawn here
    from

        p ∝ r (1 + e/(3 max(1, ∫ r e dλ))),    e(λ) = max(0, max_l s_l(λ) − 4).

    For daylight and incandescent lamps p = r. The power of a light is disregarded, as it does not determine how much of
    its light arrives at a pixel. The film divides by p, and p > 0 where r > 0: the expectation of each channel is
    unchanged.
    """
    for sensor in scene.sensors():
        # The sensor draws wavelengths from this object of the film.
        distribution = mi.traverse(sensor.film().sensor_response_function())
        response = np.array(distribution["values"], np.float64)
        response /= response.sum()
        grid = np.linspace(*recorded_wavelengths(sensor.film()), response.size)
        lines = np.zeros_like(response)
        for emitter in scene.emitters():
            recorded = response * _emission(emitter, grid)
            lines = np.maximum(lines, recorded / (recorded.sum() or 1) - 4 * response)
        if lines.any():
            density = response + lines / (3 * max(1, lines.sum()))
            # Integers, so that Mitsuba's cumulative sums of them are exact in single precision.
            density = np.ceil(density * (2**23 / density.sum()))
            distribution["values"] = type(distribution["values"])(density.astype(np.float32))
            distribution.update()


def _emission(emitter: mi.Emitter, grid: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the spectrum of a light on a grid of equidistant wavelengths in nm, (n,), up to a factor.

    It is a histogram of wavelengths sampled by the light itself, so that narrow lines are not missed. A light whose
    spectrum varies over positions or directions is sampled at a single one.
    """
    si = dr.zeros(mi.SurfaceInteraction3f)
    si.wi = mi.Vector3f(0, 0, -1)
    numbers = (np.arange(_DRAWS_PER_LIGHT, dtype=np.float32) + 0.5) / _DRAWS_PER_LIGHT
    wavelengths, weights = emitter.sample_wavelengths(si, mi.Float(numbers))
    wavelengths, weights = (x.ravel() for x in np.broadcast_arrays(wavelengths, mi.unpolarized_spectrum(weights)))
    edges = np.append(grid, 2 * grid[-1] - grid[-2]) - (grid[1] - grid[0]) / 2
    return np.histogram(wavelengths, edges, weights=weights)[0]


def named_sample_count(path: str | os.PathLike[str], parameters: Mapping[str, str] | None = None) -> int | None:
    """Return the sample_count of the sampler of a scene's first sensor, or None; for errors see `parsed`."""
    with parsed(path, parameters) as (_, state):
        counts = [sampler.get("sample_count") for sampler in _of_first_sensor(state, mi.ObjectType.Sampler)]
        count = next((count for count in counts if count is not None), None)
        if count is not None and count < 1:
            raise RequestError(f"sample_count: got {count}, wanted a positive number of samples")
    return count


def has_alpha(path: str | os.PathLike[str], parameters: Mapping[str, str] | None = None) -> bool:
    """Return whether the film of a scene's first sensor has a `pixel_format` with alpha; for errors see `parsed`."""
    with parsed(path, parameters) as (_, state):
        formats = [str(film.get("pixel_format", "rgb")) for film in _of_first_sensor(state, mi.ObjectType.Film)]
    return any(name.lower() in _FORMATS_WITH_ALPHA for name in formats)


def _of_first_sensor(state: mi.parser.ParserState, kind: mi.ObjectType) -> list[mi.Properties]:
    """Return the properties of the children of a kind of the first sensor, if there is one."""
    sensors = [node for node in state.nodes if node.type == mi.ObjectType.Sensor]
    children = [k for sensor in sensors[:1] for k in _children(state, sensor.props, kind).values()]
    return [mi.Properties(state.nodes[k].props) for k in children]


def scene_digest(
    path: str | os.PathLike[str], parameters: Mapping[str, str] | None = None, materials: Materials | None = None
) -> str:
    """Return the SHA-256 of a valid scene: its XML after substitution of parameters, and the files it references.

    Files enter by content, not by path; a recipe includes the scan it references. For errors see `parsed`.
    """
    content = hashlib.sha256(Path(path).read_bytes())
    with parsed(path, parameters, materials) as (_, state):
        for node in state.nodes:
            content.update(f"{node.props.plugin_name()}\n".encode())
            for name, value in node.props.items():
                named = _resolved(value) if isinstance(value, str) else None
                if named is None or not named.is_file():
                    content.update(f"{name}={_exact_text(value)}\n".encode())
                elif named.suffix.lower() == ".toml":
                    content.update(Recipe.load(named).digest().encode())
                else:
                    with open(named, "rb") as stream:
                        while block := stream.read(2**24):
                            content.update(block)
    return content.hexdigest()


def _resolved(name: object) -> Path:
    """Return the path of a file that a scene names."""
    return Path(str(mi.file_resolver().resolve(str(name))))


def _exact_text(value: Any) -> str:
    """Format a property as text without loss; Mitsuba's own abbreviates spectra and rounds."""
    if dr.is_array_v(value):
        return str(list(value))
    if hasattr(value, "wavelengths"):
        return f"{list(value.wavelengths)} {list(value.values)}"
    return str(np.array(value.matrix).tolist() if hasattr(value, "matrix") else value)


@contextmanager
def parsed(
    path: str | os.PathLike[str], parameters: Mapping[str, str] | None, materials: Materials | None = None
) -> Iterator[tuple[mi.parser.ParserConfig, mi.parser.ParserState]]:
    """Parse a scene; in the block, Mitsuba searches the folder of the scene first.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is a folder, or parsing or the block fails, with the cause in one line.
    """
    path = Path(path)
    refuse_other_than_utf8(os.path.realpath(path))
    if path.is_dir():
        scenes = ", ".join(sorted(file.name for file in path.glob("*.xml"))) or "none"
        raise RequestError(f"{path}: got a folder, wanted a scene (.xml); this folder holds {scenes}")
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    resolver = mi.file_resolver()
    beside_scene = mi.FileResolver(resolver)
    beside_scene.prepend(str(path.resolve().parent))
    mi.set_file_resolver(beside_scene)
    try:
        config = mi.parser.ParserConfig(mi.variant() or "scalar_spectral")
        state = mi.parser.parse_file(config, str(path.resolve()), **(parameters or {}))
        if materials:
            mi.parser.transform_resolve(config, state)
            _replace_materials(state, materials)
        _refuse_missing_files(path, state)
        yield config, state
    except Exception as error:
        raise RequestError(f"{path}: {root_cause(error)}{_alternatives(path, str(error))}") from error
    finally:
        mi.set_file_resolver(resolver)


def _check_materials(materials: Materials) -> None:
    """Raise RequestError if a parameter of a grating is wrong, before a spectrum is computed for any of them."""
    for name, values in materials.items():
        try:
            check(_grating(values))
        except RequestError as error:
            raise RequestError(f"material {name}: {error}") from None


def _grating(values: Mapping[str, bool | float | str]) -> mi.Properties:
    """Return the properties of a grating with these parameters."""
    grating = mi.Properties("diffraction_grating")
    for key, value in values.items():
        if (key, value) != ("base", "none"):
            grating[key] = value
    return grating


def _has_base(values: Mapping[str, bool | float | str]) -> bool:
    """Return whether a BSDF can lie below a grating, and none is given: below a dielectric, in scalar theory."""
    if {"material", "base"} & values.keys() or values.get("transmission", "none") != "none":
        return False
    path = _resolved(values.get("filename", ""))
    if path.suffix.lower() == ".toml" and path.is_file():
        return Recipe.load(path).settings.theory == "scalar"
    return values.get("theory") != "rigorous" and not is_rigorous(path)


def _transmits(props: mi.Properties) -> bool:
    """Return whether a BSDF that holds no other transmits light."""
    return props.plugin_name() in _TRANSMITTING or mi.Properties(props).get("spec_trans", 0.0) != 0


def _replace_materials(state: mi.parser.ParserState, materials: Materials) -> None:
    """Replace BSDFs by gratings; see `load_spectral_scene`."""
    bsdfs = {node.props.id(): k for k, node in enumerate(state.nodes) if node.type == mi.ObjectType.BSDF}
    for name, values in materials.items():
        if name not in bsdfs:
            known = ", ".join(sorted(filter(None, bsdfs))) or "none: its BSDFs have no ids"
            raise RequestError(f"material: got the id {name!r}, the ids of BSDFs in the scene are {known}")
        try:
            replaced = _with_grating(state, bsdfs[name], values)
        except RequestError as error:
            raise RequestError(f"material {name}: {error}") from None
        replaced.set_id(name)
        state.nodes[bsdfs[name]].props = replaced


def _with_grating(state: mi.parser.ParserState, index: int, values: Mapping[str, bool | float | str]) -> mi.Properties:
    """Return a BSDF without id in which gratings replace the BSDFs that hold no others; a nested `null` remains.

    BSDFs that others in the scene may refer to are copied.
    """
    # A copy, as adding nodes invalidates references to them.
    props = mi.Properties(state.nodes[index].props)
    props.set_id("")
    inner = {} if props.plugin_name() == "diffraction_grating" else _children(state, props, mi.ObjectType.BSDF)
    parts = {
        key: _with_grating(state, k, values) for key, k in inner.items() if state.nodes[k].props.plugin_name() != "null"
    }
    if parts:
        if props.plugin_name() == "twosided" and values.get("transmission", "none") != "none":
            return next(iter(parts.values()))
        for key, part in parts.items():
            props[key] = _add(state, mi.ObjectType.BSDF, part)
        return props
    grating = _grating(values)
    if _has_base(values):
        if _transmits(props):
            raise RequestError(
                "got a dielectric in the place of a BSDF that transmits light, wanted transmission=sheet or "
                "interface, a metal (material=Al), or base=none"
            )
        grating["base"] = _add(state, mi.ObjectType.BSDF, props)
    return grating


def files_of_scene(
    path: str | os.PathLike[str], parameters: Mapping[str, str] | None = None, materials: Materials | None = None
) -> list[Path]:
    """Return the files that a scene names: itself, included files, files of its plugins, scans of its recipes.

    Tables of spectra (`<spectrum filename="…"/>`) are not included, as the parser keeps only their values. For errors
    see `parsed`; a wrong recipe is an error, too.
    """
    with parsed(path, parameters, materials) as (_, state):
        texts = [
            node.props[key]
            for node in state.nodes
            for key in node.props.keys()  # noqa: SIM118 (no mapping; items() fails before a variant is set)
            if node.props.type(key) == mi.Properties.Type.String
        ]
        named = [_resolved(name) for name in [*state.files, *texts]]
    found = [file for file in named if file.is_file()]
    return [*found, *(scan for file in found if file.suffix.lower() == ".toml" for scan in Recipe.load(file).files)]


def _refuse_missing_files(path: Path, state: mi.parser.ParserState) -> None:
    """Raise RequestError if a mesh or texture is missing, before spectra are computed for the scene.

    The message quotes the command that a comment of the scene gives for them: "… made by: python scenes/disc.py".
    """
    for node in state.nodes:
        name = node.props.get("filename")
        # The error of the grating lists the available spectra.
        if not isinstance(name, str) or node.props.plugin_name() == "diffraction_grating":
            continue
        if not _resolved(name).is_file():
            text = path.read_text(encoding="utf-8", errors="replace")
            made = re.search(r"made by:\s+(python \S+\.py(?: && python \S+\.py)*)", text)
            raise RequestError(f"{name}: no such file" + (f"; it is made by: {made[1]}" if made else ""))


def _unwrap_integrators(state: mi.parser.ParserState) -> None:
    """Replace integrators that add other quantities to radiance by the integrator nested in them."""
    for node in state.nodes:
        is_wrapper = node.type == mi.ObjectType.Integrator and node.props.plugin_name() in ("aov", "moment")
        if is_wrapper and (inner := _children(state, node.props, mi.ObjectType.Integrator)):
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


def _replace_films(state: mi.parser.ParserState, width: int | None, height: int | None) -> None:
    """Replace all films by spectral ones, and add one to sensors without a film."""
    kinds = [node.type for node in state.nodes]
    if mi.ObjectType.Sensor not in kinds:
        raise RequestError("the scene has no sensor")
    for index, kind in enumerate(kinds):
        # Each film adds nodes, which may reallocate the list and invalidate references to its elements: properties are
        # read as a copy and written by index.
        props = mi.Properties(state.nodes[index].props)
        if kind == mi.ObjectType.Film:
            state.nodes[index].props = _spectral_film(state, props, width, height)
        elif kind == mi.ObjectType.Sensor and not _children(state, props, mi.ObjectType.Film):
            props["film"] = _add(state, mi.ObjectType.Film, _spectral_film(state, mi.Properties(), width, height))
            state.nodes[index].props = props


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


def _children(state: mi.parser.ParserState, props: mi.Properties, kind: mi.ObjectType | None = None) -> dict[str, int]:
    """Return name → index in the parser's list of the children of a node; if `kind` is given, only of this kind."""
    # Of a copy: reading marks a property as used, and Mitsuba reports unused ones as errors.
    copy, kind_of_reference = mi.Properties(props), mi.Properties.Type.ResolvedReference
    references = [(name, copy[name].index()) for name in copy.keys() if copy.type(name) == kind_of_reference]  # noqa: SIM118
    return {name: index for name, index in references if kind in (None, state.nodes[index].type)}


def _add(state: mi.parser.ParserState, kind: mi.ObjectType, props: mi.Properties) -> mi.Properties.ResolvedReference:
    """Append a node and return a reference to it for its parent."""
    node = mi.parser.SceneNode()
    node.type = kind
    node.props = props
    state.nodes.append(node)
    return mi.Properties.ResolvedReference(len(state.nodes) - 1)


def _integer(film: mi.Properties, name: str, default: int) -> int:
    value = film.get(name, default)
    if not isinstance(value, int):
        raise RequestError(f"film: {name} is {value!r}, wanted a whole number of pixels")
    return value


def _spectral_film(
    state: mi.parser.ParserState, old: mi.Properties, width: int | None, height: int | None
) -> mi.Properties:
    """Return the properties of a spectral film with the crop window of `old`."""
    old_size = tuple(_integer(old, name, size) for name, size in zip(("width", "height"), _DEFAULT_SIZE, strict=True))
    if width is None:
        width = old_size[0] if height is None else max(1, round(height * old_size[0] / old_size[1]))
    if height is None:
        height = max(1, round(width * old_size[1] / old_size[0]))

    film = mi.Properties("specfilm")
    film.set_id(old.id())
    film["width"], film["height"] = width, height
    film["component_format"] = "float32"
    for axis, new, old_extent in (("x", width, old_size[0]), ("y", height, old_size[1])):
        extent = "width" if axis == "x" else "height"
        offset = _integer(old, f"crop_offset_{axis}", 0)
        size = _integer(old, f"crop_{extent}", old_extent - offset)
        start = min(round(offset * new / old_extent), new - 1)
        end = min(max(round((offset + size) * new / old_extent), start + 1), new)
        film[f"crop_offset_{axis}"], film[f"crop_{extent}"] = start, end - start
    if film["crop_width"] * film["crop_height"] > _MAX_PIXELS:
        raise RequestError(
            f"film: got {film['crop_width']} × {film['crop_height']} pixels, wanted at most {_MAX_PIXELS} in all"
        )
    if "sample_border" in old:
        film["sample_border"] = old["sample_border"]
    for name, index in _children(state, old, mi.ObjectType.ReconstructionFilter).items():
        film[name] = mi.Properties.ResolvedReference(index)
    spectral_range = _spectral_range(state, old)
    centres = channel_wavelengths(spectral_range)
    step = float(centres[1] - centres[0])
    triangle = 1 - np.abs(np.linspace(-1, 1, 2 * _STEPS_PER_CHANNEL + 1))
    for number, (centre, weight) in enumerate(zip(centres, channel_weights(spectral_range), strict=True)):
        hat = mi.Properties("regular")
        hat["wavelength_min"], hat["wavelength_max"] = float(centre - step), float(centre + step)
        hat["values"] = ", ".join(f"{weight / step * value:.17g}" for value in triangle)
        # Channels are numbered, as the parser refuses names with a dot; films order channels by name.
        film[f"channel_{number:03d}"] = _add(state, mi.ObjectType.Texture, hat)
    return film


def _spectral_range(state: mi.parser.ParserState, film: mi.Properties) -> SpectralRange:
    """Return the wavelengths from the shortest to the longest of a film's bands if some are not visible, else these."""
    if film.plugin_name() != "specfilm":
        return VISIBLE
    textures = [
        mi.Properties(state.nodes[index].props) for index in _children(state, film, mi.ObjectType.Texture).values()
    ]
    ranges = [mi.PluginManager.instance().create_object(texture).wavelength_range() for texture in textures]
    tables = [film[name].wavelengths for name in film.keys() if film.type(name) == mi.Properties.Type.Spectrum]  # noqa: SIM118
    ranges += [(min(table), max(table)) for table in tables if len(table)]
    if not ranges:
        return VISIBLE
    first, last = float(min(low for low, _ in ranges)), float(max(high for _, high in ranges))
    if VISIBLE[0] <= first and last <= VISIBLE[1]:
        return VISIBLE
    # Of a narrow line, at least two channels.
    middle, half = (first + last) / 2, max((last - first) / 2, 1.5 * _CHANNEL_STEP)
    return middle - half, middle + half


def _alternatives(scene: Path, error: str) -> str:
    """Return the alternatives to a missing include, plugin or parameter, as the end of a message."""
    if (missing := re.search(r'included file "(.+?)" not found', error)) is not None:
        folder = scene.resolve().parent / Path(missing[1]).parent
        available = sorted(path.stem for path in folder.glob("*.xml"))
        return f"; {Path(missing[1]).parent} holds {', '.join(available) or 'none'}"
    if (missing := re.search(r"undefined parameter: \$(\w+)", error)) is not None:
        return f"; set it by -D {missing[1]}=…"
    if (missing := re.search(r'Plugin "(\w+)" not found', error)) is not None:
        similar = get_close_matches(missing[1], _PLUGINS, n=1)
        return f"; did you mean {similar[0]}?" if similar else ""
    if "unused parameters" in error:
        text = scene.read_text(encoding="utf-8", errors="replace")
        known = sorted({*re.findall(r"\$(\w+)", text), *re.findall(r'<default\s+name="(\w+)"', text)})
        return f"; the scene's parameters are {', '.join(known) or 'none'}"
    return ""
