"""The parsed XML of a scene: its files, the models that are made at first use, what it requests, its digest."""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import drjit as dr
import mitsuba as mi
import mitsuba.parser
import numpy as np

from ..errors import RequestError, did_you_mean, root_cause
from ..files.writing import examples_folder, refuse_other_than_utf8, whole_file
from ..precomputation.recipe import Recipe, source_named
from ..progress import progress_bar
from .parser_state import children_of, resolved_file
from .scene_materials import Materials, replace_materials

_PLUGINS = ("diffraction_grating", "diffraction_path", "diffraction_shader")
_FORMATS_WITH_ALPHA = {"luminance_alpha", "rgba", "xyza"}


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
    if path.suffix == ".blend":
        raise RequestError(f"{path}: got a file of Blender, wanted a scene (.xml), which Mitsuba-Blender exports")
    if not path.is_file():
        is_example = (examples_folder() / "scenes" / path.name).is_file()
        hint = "; mitsuba-diffraction examples writes it" if is_example else ""
        raise FileNotFoundError(f"{path}: no such file{hint}")
    resolver = mi.file_resolver()
    beside_scene = mi.FileResolver(resolver)
    beside_scene.prepend(str(path.resolve().parent))
    mi.set_file_resolver(beside_scene)
    try:
        config = mi.parser.ParserConfig(mi.variant() or "scalar_spectral")
        state = mi.parser.parse_file(config, str(path.resolve()), **(parameters or {}))
        if materials:
            mi.parser.transform_resolve(config, state)
            replace_materials(state, materials)
        _refuse_missing_files(path, state)
        yield config, state
    except Exception as error:
        raise RequestError(f"{path}: {root_cause(error)}{_alternatives(path, str(error), parameters or {})}") from error
    finally:
        mi.set_file_resolver(resolver)


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
        return f"; the scene's parameters are {', '.join(sorted(_parameters_of(scene))) or 'none'}"
    return ""


def _parameters_of(scene: Path) -> set[str]:
    """Return the names of the parameters that a scene uses or has defaults for."""
    text = scene.read_text(encoding="utf-8", errors="replace")
    return {*re.findall(r"\$(\w+)", text), *re.findall(r'<default\s+name="(\w+)"', text)}


def files_of_scene(
    path: str | os.PathLike[str], parameters: Mapping[str, str] | None = None, materials: Materials | None = None
) -> list[Path]:
    """Return the files that a scene names: itself, included files, files of its plugins, scans of its recipes.

    Tables of spectra (`<spectrum filename="…"/>`) are not included, as the parser keeps only their values. For errors
    see `parsed`; a wrong recipe is an error, too.
    """
    with parsed(path, parameters, materials) as (_, state):
        texts = [
            _file_named(node, key)
            for node in state.nodes
            for key in node.props.keys()  # noqa: SIM118 (no mapping; items() fails before a variant is set)
            if node.props.type(key) == mi.Properties.Type.String
        ]
        named = [*map(resolved_file, state.files), *texts]
    # Numbers of a spectrum can be too long for a file name, at which Path.is_file raises.
    found = [file for file in named if os.path.isfile(file)]
    return [*found, *(scan for file in found if file.suffix.lower() == ".toml" for scan in Recipe.load(file).files)]


def _refuse_missing_files(path: Path, state: mi.parser.ParserState) -> None:
    """Raise RequestError if a mesh, texture or named surface is missing, before spectra are computed for the scene.

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
        if resolved_file(name).is_file():
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
    children = [k for sensor in sensors[:1] for k in children_of(state, sensor.props, kind).values()]
    return [mi.Properties(state.nodes[k].props) for k in children]


def _file_named(node: mi.parser.SceneNode, name: str) -> Path:
    """Return the file that a text of a plugin names, if there is one: also that of a surface by its name."""
    text = node.props[name]
    if name == "filename" and node.props.plugin_name() == "diffraction_grating":
        return Path(source_named(str(resolved_file(text))))
    return resolved_file(text)


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


def _exact_text(value: Any) -> str:
    """Format a property as text without loss; Mitsuba's own abbreviates spectra and rounds."""
    if dr.is_array_v(value):
        return str(list(value))
    if hasattr(value, "wavelengths"):
        return f"{list(value.wavelengths)} {list(value.values)}"
    return str(np.array(value.matrix).tolist() if hasattr(value, "matrix") else value)
