"""A scene as a command requests it: its file, what it names and requests, its digest, and the scene itself."""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import drjit as dr
import mitsuba as mi
import mitsuba.parser
import numpy as np

from ..bsdf.mitsuba_internals import parser_config
from ..errors import RequestError, did_you_mean, root_cause
from ..files.picture_file import IN_ENVIRONMENT, IN_TEXTURE, check_picture
from ..files.writing import examples_folder, refuse_other_than_utf8, whole_file
from ..precomputation.recipe import Recipe, source_named
from ..progress import progress_bar
from ..variants import is_supported
from .parser_state import children_of, resolved_file
from .replacements import Replacements, check_replacements, replace_bsdfs, warn_of_unused_replacements
from .scene import instantiated, move_first_sensor, replace_path, unwrap_integrators
from .scene_light import draw_wavelengths_of_lights
from .scene_limits import check_depth, check_nesting
from .scene_numbers import read_numbers
from .spectral_film import replace_films

_PLUGINS = ("diffraction_grating", "diffraction_path", "diffraction_shader")
_PICTURES = {"bitmap": IN_TEXTURE, "envmap": IN_ENVIRONMENT}  # plugins that read one
_FORMATS_WITH_ALPHA = {"luminance_alpha", "rgba", "xyza"}


@dataclass(frozen=True)
class SceneFile:
    """An XML scene, and what a command requests of it. It is parsed once; `load` makes a new scene each time.

    Attributes:
        path: of the XML file. File names in it are relative to its folder.
        parameters: values for its `$name` parameters (`-Dname=value` of Mitsuba's command line).
        replacements: id of a BSDF → parameters of the grating that replaces it. Of a BSDF that holds others
            (`twosided`, `mask`, `normalmap`, `bumpmap`, `blendbsdf`), these are replaced; only a `twosided` around a
            grating that transmits light is removed. Below a dielectric of scalar theory the BSDF remains as `base`,
            unless that is given; "none" stands for none.
        size: (width, height) of the full film in pixels; the crop window is scaled with it. If only one of them is
            given, the aspect ratio is preserved; by default, the size is that of the scene.
        motion: of the first sensor: an affine map of world space, 16 numbers in row-major order, applied after its
            `to_world`.

    Raises:
        ValueError: if a size is not positive. Other faults are found when the file is first needed: a FileNotFoundError
            if there is no such file, a ValueError if the scene is wrong, a parameter is unknown to it, or no BSDF has
            one of the ids.
    """

    path: str | os.PathLike[str]
    parameters: Mapping[str, str] = field(default_factory=dict)
    replacements: Replacements = field(default_factory=dict)
    size: tuple[int | None, int | None] = (None, None)
    motion: tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        for name, size in zip(("width", "height"), self.size, strict=True):
            if size is not None and size < 1:
                raise RequestError(f"{name}: got {size}, wanted a positive number of pixels")

    def __getstate__(self) -> dict[str, Any]:
        """Return what is sent to other processes: the fields, not the parsed file."""
        return {item.name: getattr(self, item.name) for item in fields(self)}

    def viewed(self, **changes: Any) -> SceneFile:
        """Return the same file with another size or motion, without parsing it again."""
        other = replace(self, **changes)
        other.__dict__["_content"] = self._content
        return other

    @cached_property
    def _content(self) -> tuple[bytes, mi.parser.ParserState, mi.FileResolver]:
        """The bytes of the file, what the parser makes of them, with gratings in the place of BSDFs, and its folders.

        These are the folder of the file and those of its `<path value="…"/>`, which the parser adds.
        """
        path = Path(self.path)
        refuse_other_than_utf8(os.path.realpath(path))
        if path.is_dir():
            scenes = ", ".join(sorted(file.name for file in path.glob("*.xml"))) or "none"
            raise RequestError(f"{path}: got a folder, wanted a scene (.xml); this folder holds {scenes}")
        if path.suffix == ".blend":
            raise RequestError(f"{path}: got a file of Blender, wanted a scene (.xml), which Mitsuba-Blender exports")
        if not path.is_file():
            is_example = (examples_folder() / "scenes" / path.name).is_file()
            hint = "; mitsuba-diffraction examples writes it" if is_example else ""
            raise FileNotFoundError(f"{path}: no such file{hint}")
        folders = mi.FileResolver(mi.file_resolver())
        folders.prepend(str(path.resolve().parent))
        with self._searching(folders):
            config = parser_config()
            check_nesting(path.resolve(), self.parameters)
            state = mi.parser.parse_file(config, str(path.resolve()), **self.parameters)
            resolved = mi.parser.ParserState(state)
            mi.parser.transform_resolve(config, resolved)
            check_depth(resolved)
            if self.replacements:
                mi.parser.transform_resolve(config, state)
                replace_bsdfs(state, self.replacements)
            _refuse_missing_files(path, state)
        return path.read_bytes(), state, folders

    @contextmanager
    def _searching(self, folders: mi.FileResolver) -> Iterator[None]:
        """Search these folders for files, and raise exceptions as ValueError with the cause in one line."""
        before = mi.file_resolver()
        mi.set_file_resolver(folders)
        try:
            yield
        except Exception as error:
            alternatives = _alternatives(Path(self.path), str(error), self.parameters)
            raise RequestError(f"{self.path}: {root_cause(error)}{alternatives}") from error
        finally:
            mi.set_file_resolver(before)

    @contextmanager
    def parsed(self) -> Iterator[tuple[mi.parser.ParserConfig, mi.parser.ParserState]]:
        """Yield a copy of the parsed scene; in the block, Mitsuba searches the folders of the scene first.

        Raises:
            FileNotFoundError: if there is no such file.
            ValueError: if it is a folder, or parsing or the block fails, with the cause in one line.
        """
        _, state, folders = self._content
        with self._searching(folders):
            yield parser_config(), mi.parser.ParserState(state)

    def files(self) -> list[Path]:
        """Return the files that the scene names: itself, included files, files of its plugins, scans of its recipes.

        Tables of spectra (`<spectrum filename="…"/>`) are not included, as the parser keeps only their values. For
        errors see `parsed`; a wrong recipe is an error, too.
        """
        with self.parsed() as (_, state):
            texts = [
                _file_named(node, key)
                for node in state.nodes
                for key in node.props.keys()  # noqa: SIM118 (no mapping; items() fails before a variant is set)
                if node.props.type(key) == mi.Properties.Type.String
            ]
            named = [*map(resolved_file, state.files), *texts]
        # Numbers of a spectrum can be too long for a file name, at which Path.is_file raises.
        found = [file for file in named if os.path.isfile(file)]
        recipes = [Recipe.load(file) for file in found if file.suffix.lower() == ".toml"]
        return [*found, *(scan for recipe in recipes for scan in recipe.files)]

    def sample_count(self) -> int | None:
        """Return the sample_count of the sampler of the first sensor, or None; for errors see `parsed`."""
        with self.parsed() as (_, state):
            counts = [sampler.get("sample_count") for sampler in _of_first_sensor(state, mi.ObjectType.Sampler)]
            count = next((count for count in counts if count is not None), None)
            if count is not None and count < 1:
                raise RequestError(f"sample_count: got {count}, wanted a positive number of samples")
        return count

    def has_alpha(self) -> bool:
        """Return whether the film of the first sensor has a `pixel_format` with alpha; for errors see `parsed`."""
        with self.parsed() as (_, state):
            formats = [str(film.get("pixel_format", "rgb")) for film in _of_first_sensor(state, mi.ObjectType.Film)]
        return any(name.lower() in _FORMATS_WITH_ALPHA for name in formats)

    def digest(self) -> str:
        """Return the SHA-256 of a valid scene: its XML after substitution of parameters, and the files it references.

        Files enter by content, not by path; a recipe includes the scan it references. For errors see `parsed`.
        """
        content = hashlib.sha256(self._content[0])
        with self.parsed() as (_, state):
            for node in state.nodes:
                content.update(f"{node.props.plugin_name()}\n".encode())
                for name, value in node.props.items():
                    named = _file_named(node, name) if isinstance(value, str) else None
                    if named is None or not os.path.isfile(named):
                        content.update(f"{name}={_exact_text(value)}\n".encode())
                    elif named.suffix.lower() == ".toml":
                        content.update(Recipe.load(named).digest().encode())
                    else:
                        with open(named, "rb") as stream:
                            while block := stream.read(2**24):
                                content.update(block)
        return content.hexdigest()

    def load(self) -> mi.Scene:
        """Load the scene in the current variant and replace its film by a spectral one.

        The film becomes a `specfilm` of float32 whose channels are hat functions at `channel_wavelengths()` with areas
        of `channel_weights()`: divided by these, a channel is spectral radiance per nm, averaged over the hat. The
        channels cover visible light, or the bands of a `specfilm` that lie outside it. Size, crop and reconstruction
        filter are taken from the scene. `path` becomes `diffraction_path`, where that supports the scene.

        Raises:
            FileNotFoundError: if there is no such file.
            ValueError: if no spectral variant is set, a parameter is unknown to the scene, no BSDF has one of the ids,
                or the scene is wrong.
        """
        if not is_supported(mi.variant()):
            raise RequestError(f"variant: got {mi.variant()!r}, wanted a spectral one, such as 'llvm_ad_spectral'")
        with self.parsed() as (config, state):
            if self.replacements:
                check_replacements(self.replacements)
                warn_of_unused_replacements(state, self.replacements)
            replace_films(state, *self.size)
            unwrap_integrators(state)
            replace_path(state)
            read_numbers(config, state)
            if self.motion is not None:
                move_first_sensor(state, self.motion)
            scene = instantiated(config, state)
        if not isinstance(scene, mi.Scene):
            raise RequestError(f"{self.path}: the file holds a {type(scene).__name__}, wanted a scene")
        if scene.integrator() is None:
            raise RequestError(
                f'{self.path}: the scene has no integrator, wanted one, such as <integrator type="path"/>'
            )
        if scene.integrator().aov_names():
            raise RequestError(
                f"{self.path}: the integrator gives {scene.integrator().aov_names()}, wanted radiance only"
            )
        draw_wavelengths_of_lights(scene)
        return scene


def _alternatives(scene: Path, error: str, parameters: Mapping[str, str]) -> str:
    """Return the alternatives to a missing include, plugin or parameter, as the end of a message."""
    if (missing := re.search(r'included file "(.+?)" not found', error)) is not None:
        folder = scene.resolve().parent / Path(missing[1]).parent
        available = sorted(path.stem for path in folder.glob("*.xml"))
        return f"; {Path(missing[1]).parent} holds {', '.join(available) or 'none'}"
    if (missing := re.search(r"undefined parameter: \$(\w+)", error)) is not None:
        unknown = sorted(set(parameters) - _parameters_of(scene))
        return f"; set it by -D {missing[1]}=…" + (f" instead of {', '.join(unknown)}" if unknown else "")
    if (missing := re.search(r'Plugin "(\w+)" not found', error)) is not None:
        return did_you_mean(missing[1], _PLUGINS)
    if "unused parameters" in error:
        others = _parameters_of(scene) - set(re.findall(r"\$(\w+)=", error))
        return f"; the scene's parameters are {', '.join(sorted(others)) or 'none'}"
    return ""


def _parameters_of(scene: Path) -> set[str]:
    """Return the names of the parameters that a scene uses or has defaults for."""
    text = scene.read_text(encoding="utf-8", errors="replace")
    return {*re.findall(r"\$(\w+)", text), *re.findall(r'<default\s+name="(\w+)"', text)}


def _refuse_missing_files(path: Path, state: mi.parser.ParserState) -> None:
    """Raise RequestError if a mesh, picture or named surface is missing, before spectra are computed for the scene.

    Or if a picture is too large (`check_picture`).

    Models of the package's scenes are made here, if a comment says how: "… made by: python scenes/disc.py". In other
    cases the message quotes that command.
    """
    for node in state.nodes:
        name = node.props.get("filename")
        if not isinstance(name, str):
            continue
        if node.props.plugin_name() == "diffraction_grating":
            # If it is a file, the error of the grating lists the available spectra.
            source_named(str(resolved_file(name)))
            continue
        if (file := resolved_file(name)).is_file():
            if (in_memory := _PICTURES.get(node.props.plugin_name())) is not None:
                check_picture(str(file), in_memory)
            continue
        text = path.read_text(encoding="utf-8", errors="replace")
        made = re.search(r"made by:\s+(python\s+\S+\.py(?:\s+&&\s+python\s+\S+\.py)*)", text)
        if made and Path(name).parent == Path("models"):
            _make_models(re.findall(r"scenes/(\w+)\.py", made[1]), path.resolve().parent / "models")
        if not resolved_file(name).is_file():
            maker = f"; it is made by: {' '.join(made[1].split())}" if made else ""
            raise RequestError(f"{name}: no such file{maker}")


def _make_models(scripts: list[str], folder: Path) -> None:
    """Make what is missing of the models of a scene, by the scripts of the package, not by those beside the scene.

    In another process, as they need another variant. Files that exist are kept.
    """
    scenes = examples_folder() / "scenes"
    scripts = [script for script in scripts if (scenes / f"{script}.py").is_file()]
    for script in scripts:
        with progress_bar(f"models by {script}.py", "", "made once"), TemporaryDirectory() as made:
            # Without the current folder, whose modules are the user's.
            program = f"import sys; sys.path[:] = [sys.argv[1], *filter(None, sys.path)]; import pathlib, {script}\n"
            program += f"{script}.make(pathlib.Path(sys.argv[2]))"
            done = subprocess.run([sys.executable, "-c", program, str(scenes), made], capture_output=True)
            if done.returncode:
                last = " ".join(done.stderr.decode(errors="replace").split()[-30:])
                raise RuntimeError(f"models: {script}.py failed ({last})")
            folder.mkdir(exist_ok=True)
            for file in Path(made).iterdir():
                if not (folder / file.name).exists():
                    with whole_file(folder / file.name) as temporary:
                        shutil.copyfile(file, temporary)


def _of_first_sensor(state: mi.parser.ParserState, kind: mi.ObjectType) -> list[mi.Properties]:
    """Return the properties of the children of a kind of the first sensor, if there is one."""
    sensors = [node for node in state.nodes if node.type == mi.ObjectType.Sensor]
    children = [k for sensor in sensors[:1] for k in children_of(state, sensor.props, kind).values()]
    return [mi.Properties(state.nodes[k].props) for k in children]


def _file_named(node: mi.parser.SceneNode, name: str) -> Path:
    """Return the file that a text of a plugin names, if there is one: also that of a surface by its name."""
    text = node.props[name]
    if name == "filename" and node.props.plugin_name() == "diffraction_grating":
        return Path(source_named(str(resolved_file(text))))
    return resolved_file(text)


def _exact_text(value: Any) -> str:
    """Format a property as text without loss; Mitsuba's own abbreviates spectra and rounds."""
    if dr.is_array_v(value):
        return str(list(value))
    if hasattr(value, "wavelengths"):
        return f"{list(value.wavelengths)} {list(value.values)}"
    return str(np.array(value.matrix).tolist() if hasattr(value, "matrix") else value)
