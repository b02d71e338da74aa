"""Loading of Mitsuba scenes with a spectral film."""

from __future__ import annotations

import hashlib
import logging
import os
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import drjit as dr
import mitsuba as mi
import mitsuba.parser
import numpy as np
from numpy.typing import NDArray

from ..bsdf.base import is_grating
from ..errors import RequestError, root_cause
from ..llvm import is_supported
from ..recipe import Recipe
from ..settings import VISIBLE

_log = logging.getLogger(__name__)

# The spacing of the channels, nm.
#
# With 5 nm, colours differ from the exact ones by ΔE₂₀₀₀ ≤ 0.05 for lines 5 nm wide and by 0.6 for the worst laser line
# (10 nm: 1.3 and 3.2; 23.5 nm: 90), and the orders of a grating, 5–20 nm wide at a coherence length of 65 µm, are
# resolved. The spacing affects memory but not time, as `film` adds a sample to at most eight channels.
_STEP = 5.0

# Wavelengths are drawn from a density on a grid as fine as this, nm, which is less than a lamp's lines are wide.
_DENSITY_STEP = 0.25
_DRAWS_PER_LIGHT = 2**14  # of four wavelengths, to learn its spectrum

Materials = Mapping[str, Mapping[str, bool | float | str]]
"""Id of a BSDF → parameters of the grating that takes its place."""

_RAYS_OF_SENSOR = 4096  # to find out what is seen, and how it is lit
_PEAK_OF_LOBES = 1e4  # of a BSDF, 1/sr
_OF_NOISE = 1e4
_MOST_PIXELS = 2**25  # above 7680 × 4320; see also `film.check_memory`
_DEFAULT_SIZE = (768, 576)  # that of Mitsuba's films


def channel_wavelengths() -> NDArray[np.float64]:
    """Return the centres of the film's channels, (n,), nm; their hats lie inside the range of Mitsuba's spectra."""
    return np.arange(VISIBLE[0] + _STEP, VISIBLE[1] - _STEP / 2, _STEP)


def channel_weights() -> NDArray[np.float64]:
    """Return the area of the response of each channel, (n,); the recorded value divided by it is radiance.

    Mitsuba samples wavelengths in proportion to the sum of the responses of the film. Hats of unit area would spend
    half of the samples where the eye is insensitive; these weights follow the density of Mitsuba's RGB film,
    sech²(0.0072 (λ − 538 nm)) (Radziszewski, Boryczko and Alda 2009), which reduces colour noise by a quarter, like 1.8
    times the samples. The lower bound of one quarter limits the noise of a channel to twice that of the best one.
    """
    return np.maximum(np.cosh(0.0072 * (channel_wavelengths() - 538)) ** -2, 0.25)


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
    `channel_weights()`: divided by these, a channel is spectral radiance per nm, averaged over the hat. Size, crop and
    reconstruction filter are those of the scene. File names in the scene are relative to its folder.

    Args:
        width: of the full film in pixels; the crop window is scaled with it. If only one of width and height is given,
            the aspect ratio is preserved.
        height: likewise.
        parameters: values for the scene's `$name` parameters (`-Dname=value` of Mitsuba's command line).
        materials: id of a BSDF → parameters of the `diffraction_grating` that takes its place. A `twosided` stays, and
            what is in it is replaced, unless the grating transmits light.
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
            _warn_of_unused_materials(config, state, materials)
        _replace_films(state, width, height)
        _take_radiance_alone(state)
        if motion is not None:
            _move_first_sensor(state, motion)
        mi.parser.transform_all(config, state)
        # Serially: on several threads, Mitsuba 3.9.1 crashed once in a loop of loads and renderings.
        config.parallel = False
        scene = mi.parser.instantiate(config, state)
    if not isinstance(scene, mi.Scene):
        raise RequestError(f"{path}: the file holds a {type(scene).__name__}, wanted a scene")
    if scene.integrator() is None:
        raise RequestError(f'{path}: the scene has no integrator, wanted one, such as <integrator type="path"/>')
    if scene.integrator().aov_names():
        raise RequestError(f"{path}: the integrator gives {scene.integrator().aov_names()}, wanted radiance alone")
    _draw_wavelengths_of_lights(scene)
    return scene


def warn_of_gratings(scene: mi.Scene) -> None:
    """Say in the log which gratings lie on meshes without UVs, and which are black as light reaches them from below.

    Apart from `load_spectral_scene`, since a rendering may load its scene again, on workers too.
    """
    _warn_of_missing_uvs(scene)
    _warn_of_light_from_below(scene)


def _warn_of_unused_materials(
    config: mi.parser.ParserConfig, state: mi.parser.ParserState, materials: Materials
) -> None:
    """Log a line for each grating that takes the place of a BSDF that nothing in the scene refers to."""
    mi.parser.transform_resolve(config, state)
    # From all objects of the scene but its BSDFs.
    waiting = [k for k in _children(state, state.root.props) if state.nodes[k].type != mi.ObjectType.BSDF]
    used = set()
    while waiting:
        used.add(node := waiting.pop())
        waiting += [child for child in _children(state, state.nodes[node].props) if child not in used]
    for name in materials:
        if state.id_to_index[name] not in used:
            _log.warning("material %s: no shape has the BSDF of that id, and the picture is as without it", name)


def _warn_of_light_from_below(scene: mi.Scene) -> None:
    """Say in the log which gratings are black because they are seen, or lit, from below only and transmit nothing.

    By rays of the first sensor, one light of each.
    """
    gratings = [shape for shape in scene.shapes() if is_grating(shape.bsdf())]
    opaque = [shape for shape in gratings if not shape.bsdf().layers.interface.transmits]
    if not opaque or not scene.sensors():
        return
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, _RAYS_OF_SENSOR)
    ray, _ = scene.sensors()[0].sample_ray(0, sampler.next_1d(), sampler.next_2d(), sampler.next_2d())
    si = scene.ray_intersect(mi.Ray3f(ray))
    light, weight = scene.sample_emitter_direction(si, sampler.next_2d(), False, si.is_valid())
    lit = dr.any(mi.unpolarized_spectrum(weight) != 0)
    seen_above, lit_above = si.wi.z > 0, lit & (mi.Frame3f.cos_theta(si.to_local(light.d)) > 0)
    for shape in opaque:
        here = si.is_valid() & (si.shape == mi.ShapePtr(shape))
        bright = seen_above & lit_above
        if dr.count(here & lit)[0] > 0 and dr.count(here & bright)[0] == 0:
            side = "lit" if dr.count(here & seen_above)[0] > 0 else "seen"
            _log.warning(
                "diffraction_grating of shape %s is %s from below only, where it is black: transmission=sheet or "
                "interface lets light pass, twosided puts a second relief there",
                shape.id(),
                side,
            )


def max_plausible_luminance(scene: mi.Scene) -> float:
    """Return a luminance that no pixel exceeds by noise: 10⁴ times that of the brightest light, as sampled.

    The light that the first sensor sees, or that is sampled from the surfaces that it sees, has a radiance L. Point and
    directional lights have an irradiance E instead, and narrow lobes reflect up to some 10⁴ E: they count as L = 10⁴ E.
    It is infinite where no light was found.
    """
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, _RAYS_OF_SENSOR)
    ray, _ = scene.sensors()[0].sample_ray(0, sampler.next_1d(), sampler.next_2d(), sampler.next_2d())
    si = scene.ray_intersect(mi.Ray3f(ray))
    light, weight = scene.sample_emitter_direction(si, sampler.next_2d(), False, si.is_valid())
    sampled = mi.unpolarized_spectrum(weight) * light.pdf * dr.select(light.delta, _PEAK_OF_LOBES, 1)
    seen = mi.unpolarized_spectrum(si.emitter(scene).eval(si))
    found = np.concatenate([np.ravel(values) for values in (*sampled, *seen)])
    brightest = found[np.isfinite(found)].max(initial=0)
    return float(brightest) * _OF_NOISE if brightest > 0 else np.inf


def _warn_of_missing_uvs(scene: mi.Scene) -> None:
    """Log a line if gratings lie on meshes without texture coordinates; meshes lose their ids when they are merged."""
    bsdfs = [shape.bsdf() for shape in scene.shapes() if shape.is_mesh() and not shape.has_vertex_texcoords()]
    if names := sorted({bsdf.id() or "a BSDF" for bsdf in bsdfs if "DiffractionGrating[" in str(bsdf)}):
        _log.warning(
            "%s: on a mesh without UVs, where the grating changes its direction from triangle to triangle; "
            "wanted a mesh with UVs",
            ", ".join(names),
        )


def _draw_wavelengths_of_lights(scene: mi.Scene) -> None:
    """Make the sensors draw a quarter of the wavelengths, one of a ray's four, in the spectral lines of the lights.

    Mitsuba draws them in proportion to the response r(λ) of the film: one in some hundred meets a line of 1 nm, and
    counts a hundredfold. With s_e(λ) the spectrum of the light e and ∫ r dλ = ∫ r s_e dλ = 1, they are drawn here from

        p ∝ r (1 + e/(3 max(1, ∫ r e dλ))),    e(λ) = max(0, max_e s_e(λ) − 4).

    Daylight and incandescent lamps leave p = r. How strong the lights are does not enter, as it says little of what
    arrives at a pixel. The film divides by p, and p > 0 where r > 0: every channel keeps its expectation.
    """
    emissions = [_emission(emitter) for emitter in scene.emitters()]
    for sensor in scene.sensors():
        # Sensor and film share this object.
        drawn_from = mi.traverse(sensor.film().sensor_response_function())
        response = np.array(drawn_from["values"], np.float64)
        response /= response.sum()
        lines = np.zeros_like(response)
        for emission in emissions:
            seen = response * emission
            lines = np.maximum(lines, seen / (seen.sum() or 1) - 4 * response)
        if lines.any():
            density = response + lines / (3 * max(1, lines.sum()))
            # Whole numbers, whose sums are exact in single precision: Mitsuba adds them up to invert their sum.
            density = np.ceil(density * (2**23 / density.sum()))
            drawn_from["values"] = type(drawn_from["values"])(density.astype(np.float32))
            drawn_from.update()


def _emission(emitter: mi.Emitter) -> NDArray[np.float64]:
    """Return the spectrum of a light on the grid of the density, (n,), up to a factor.

    It is a histogram of wavelengths that the light draws itself, so that no line is too narrow. A light that is not the
    same everywhere is seen at one place or in one direction.
    """
    place = dr.zeros(mi.SurfaceInteraction3f)
    place.wi = mi.Vector3f(0, 0, -1)
    numbers = (np.arange(_DRAWS_PER_LIGHT, dtype=np.float32) + 0.5) / _DRAWS_PER_LIGHT
    wavelengths, weights = emitter.sample_wavelengths(place, mi.Float(numbers))
    wavelengths, weights = (x.ravel() for x in np.broadcast_arrays(wavelengths, mi.unpolarized_spectrum(weights)))
    edges = np.arange(VISIBLE[0] - _DENSITY_STEP / 2, VISIBLE[1] + _DENSITY_STEP, _DENSITY_STEP)
    return np.histogram(wavelengths, edges, weights=weights)[0]


def named_sample_count(path: str | os.PathLike[str], parameters: Mapping[str, str] | None = None) -> int | None:
    """Return the sample_count of the sampler of a scene's first sensor, None if unspecified; errors as of `parsed`."""
    with parsed(path, parameters) as (_, state):
        sensor = next((node for node in state.nodes if node.type == mi.ObjectType.Sensor), None)
        for sampler in _children(state, sensor.props, mi.ObjectType.Sampler) if sensor else ():
            if (count := state.nodes[sampler].props.get("sample_count")) is not None:
                if count < 1:
                    raise RequestError(f"sample_count: got {count}, wanted a positive number of samples")
                return int(count)
    return None


def scene_digest(
    path: str | os.PathLike[str], parameters: Mapping[str, str] | None = None, materials: Materials | None = None
) -> str:
    """Return the SHA-256 of a valid scene: its XML after substitution of parameters, and the files it references.

    Files enter by content, not by path; a recipe includes the scan it references. Errors as of `parsed`.
    """
    content = hashlib.sha256(Path(path).read_bytes())
    with parsed(path, parameters, materials) as (_, state):
        for node in state.nodes:
            content.update(f"{node.props.plugin_name()}\n".encode())
            for name, value in node.props.items():
                named = _resolved(value) if name == "filename" else None
                if named is None or not named.is_file():
                    content.update(f"{name}={_in_full(value)}\n".encode())
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


def _in_full(value: object) -> str:
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
        ValueError: if parsing or the block fails, with the cause in one line.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    resolver = mi.file_resolver()
    beside_scene = mi.FileResolver(resolver)
    beside_scene.prepend(str(path.resolve().parent))
    mi.set_file_resolver(beside_scene)
    try:
        config = mi.parser.ParserConfig(mi.variant() or "scalar_spectral")
        state = mi.parser.parse_file(config, str(path.resolve()), **(parameters or {}))
        _replace_materials(state, materials or {})
        _refuse_missing_files(path, state)
        yield config, state
    except Exception as error:
        raise RequestError(f"{path}: {root_cause(error)}{_what_there_is(path, str(error))}") from error
    finally:
        mi.set_file_resolver(resolver)


def _replace_materials(state: mi.parser.ParserState, materials: Materials) -> None:
    """Put gratings in the place of BSDFs; see `load_spectral_scene`."""
    bsdfs = {node.props.id(): k for k, node in enumerate(state.nodes) if node.type == mi.ObjectType.BSDF}
    for name, values in materials.items():
        if name not in bsdfs:
            known = ", ".join(sorted(filter(None, bsdfs))) or "none: its BSDFs have no ids"
            raise RequestError(f"material: got the id {name!r}, the ids of BSDFs in the scene are {known}")
        grating = mi.Properties("diffraction_grating")
        for key, value in dict(values).items():
            grating[key] = value
        node = state.nodes[bsdfs[name]]
        if node.props.plugin_name() == "twosided" and grating.get("transmission", "none") == "none":
            both_sides = mi.Properties("twosided")
            both_sides["bsdf"] = _add(state, mi.ObjectType.BSDF, grating)
            grating = both_sides
        grating.set_id(name)
        state.nodes[bsdfs[name]].props = grating


def files_of_scene(
    path: str | os.PathLike[str], parameters: Mapping[str, str] | None = None, materials: Materials | None = None
) -> list[Path]:
    """Return the files that a scene names: itself, what it includes, files of its plugins, scans of its recipes.

    Tables of spectra (`<spectrum filename="…"/>`) are not among them: of these the parser keeps the values alone.
    Errors as of `parsed`, or if a recipe is wrong.
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
        # The grating tells which spectra there are instead.
        if not isinstance(name, str) or node.props.plugin_name() == "diffraction_grating":
            continue
        if not _resolved(name).is_file():
            text = path.read_text(encoding="utf-8", errors="replace")
            made = re.search(r"made by:\s+(python \S+\.py(?: && python \S+\.py)*)", text)
            raise RequestError(f"{name}: no such file" + (f"; it is made by: {made[1]}" if made else ""))


def _take_radiance_alone(state: mi.parser.ParserState) -> None:
    """Replace integrators that add other quantities to radiance by the one inside of them."""
    for node in state.nodes:
        adds_others = node.type == mi.ObjectType.Integrator and node.props.plugin_name() in ("aov", "moment")
        if adds_others and (inner := list(_children(state, node.props, mi.ObjectType.Integrator))):
            node.props = mi.Properties(state.nodes[inner[0]].props)


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
        # Each film adds nodes, which may reallocate the list and invalidate references into it: properties are read as
        # a copy and written by index.
        props = mi.Properties(state.nodes[index].props)
        if kind == mi.ObjectType.Film:
            state.nodes[index].props = _spectral_film(state, props, width, height)
        elif kind == mi.ObjectType.Sensor and not _children(state, props, mi.ObjectType.Film):
            props["film"] = _add(state, mi.ObjectType.Film, _spectral_film(state, mi.Properties(), width, height))
            state.nodes[index].props = props


def _children(state: mi.parser.ParserState, props: mi.Properties, kind: mi.ObjectType | None = None) -> dict[int, str]:
    """Return index in the parser's list → name of the children of a node; of one kind, if it is given."""
    # Of a copy: Mitsuba refuses what no plugin reads, and this counts as reading.
    references = [
        (value.index(), name)
        for name, value in mi.Properties(props).items()
        if isinstance(value, mi.Properties.ResolvedReference)
    ]
    return {index: name for index, name in references if kind in (None, state.nodes[index].type)}


def _add(state: mi.parser.ParserState, kind: mi.ObjectType, props: mi.Properties) -> mi.Properties.ResolvedReference:
    """Append a node and return a reference to it for its parent."""
    node = mi.parser.SceneNode()
    node.type = kind
    node.props = props
    state.nodes.append(node)
    return mi.Properties.ResolvedReference(len(state.nodes) - 1)


def _whole(film: mi.Properties, name: str, default: int) -> int:
    value = film.get(name, default)
    if not isinstance(value, int):
        raise RequestError(f"film: {name} is {value!r}, wanted a whole number of pixels")
    return value


def _spectral_film(
    state: mi.parser.ParserState, old: mi.Properties, width: int | None, height: int | None
) -> mi.Properties:
    """Return the properties of a spectral film with the crop window of `old`."""
    old_size = tuple(_whole(old, name, size) for name, size in zip(("width", "height"), _DEFAULT_SIZE, strict=True))
    if width is None:
        width = old_size[0] if height is None else max(1, round(height * old_size[0] / old_size[1]))
    if height is None:
        height = max(1, round(width * old_size[1] / old_size[0]))

    film = mi.Properties("specfilm")
    film.set_id(old.id())
    film["width"], film["height"] = width, height
    film["component_format"] = "float32"
    for axis, new, was in (("x", width, old_size[0]), ("y", height, old_size[1])):
        extent = "width" if axis == "x" else "height"
        offset = _whole(old, f"crop_offset_{axis}", 0)
        size = _whole(old, f"crop_{extent}", was - offset)
        start = min(round(offset * new / was), new - 1)
        end = min(max(round((offset + size) * new / was), start + 1), new)
        film[f"crop_offset_{axis}"], film[f"crop_{extent}"] = start, end - start
    if film["crop_width"] * film["crop_height"] > _MOST_PIXELS:
        raise RequestError(
            f"film: got {film['crop_width']} × {film['crop_height']} pixels, wanted at most {_MOST_PIXELS} in all"
        )
    if "sample_border" in old:
        film["sample_border"] = old["sample_border"]
    for index, name in _children(state, old, mi.ObjectType.ReconstructionFilter).items():
        film[name] = mi.Properties.ResolvedReference(index)
    triangle = 1 - np.abs(np.linspace(-1, 1, round(2 * _STEP / _DENSITY_STEP) + 1))
    for number, (centre, weight) in enumerate(zip(channel_wavelengths(), channel_weights(), strict=True)):
        hat = mi.Properties("regular")
        hat["wavelength_min"], hat["wavelength_max"] = float(centre - _STEP), float(centre + _STEP)
        hat["values"] = ", ".join(f"{weight / _STEP * share:.17g}" for share in triangle)
        # Channels are numbered, as the parser refuses names with a dot; films keep the order of names.
        film[f"channel_{number:03d}"] = _add(state, mi.ObjectType.Texture, hat)
    return film


def _what_there_is(scene: Path, error: str) -> str:
    """Return what is available in place of a missing include or an unknown parameter, to end a message."""
    if (missing := re.search(r'included file "(.+?)" not found', error)) is not None:
        folder = scene.resolve().parent / Path(missing[1]).parent
        there = sorted(path.stem for path in folder.glob("*.xml"))
        return f"; {Path(missing[1]).parent} holds {', '.join(there) or 'none'}"
    if (missing := re.search(r"undefined parameter: \$(\w+)", error)) is not None:
        return f"; set it by -D {missing[1]}=…"
    if "unused parameters" in error:
        text = scene.read_text(encoding="utf-8", errors="replace")
        known = sorted({*re.findall(r"\$(\w+)", text), *re.findall(r'<default\s+name="(\w+)"', text)})
        return f"; the scene's parameters are {', '.join(known) or 'none'}"
    return ""
