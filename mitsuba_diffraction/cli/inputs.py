"""The files that a command reads: those referenced by scenes and recipes."""

from __future__ import annotations

import html
import os
import re
from collections.abc import Mapping
from pathlib import Path

from ..errors import RequestError
from ..recipe import Recipe

_VALUE = re.compile(r"""=\s*(?:"([^"]*)"|'([^']*)')""")
_DEFAULT = re.compile(r"""<default\s[^>]*>""")
_ATTRIBUTE = re.compile(r"""(\w+)\s*=\s*(?:"([^"]*)"|'([^']*)')""")


def files_read(path: str | os.PathLike[str], parameters: Mapping[str, str] | None = None) -> set[Path]:
    """A scene, recipe or scan, and all files that it may read. Errs on the side of too many.

    Every XML attribute that names an existing file counts, whatever its element, after substitution of the parameters;
    included scenes and recipes are followed. Names are resolved as in Mitsuba: relative to the scene, to the file that
    references them, to the current folder, and to folders named in the XML. Nothing is refused here.

    Args:
        path: the scene, recipe or scan.
        parameters: values for the scene's `$name` parameters.

    Returns:
        The files that exist.
    """
    given = dict(parameters or {})
    defaults: dict[str, str] = {}
    folders = [Path(path).parent, Path()]
    found: set[Path] = set()
    waiting = [Path(path), *map(Path, given.values())]
    while waiting:
        file = waiting.pop()
        if not os.path.isfile(file) or file in found:
            continue
        found.add(file)
        if file.suffix.lower() == ".toml":
            try:
                recipe = Recipe.load(file)
            except (RequestError, OSError):
                continue  # reported by the command itself
            if "scan" in recipe.surface:
                waiting.append(recipe.folder / recipe.surface["scan"])
        elif file.suffix.lower() == ".xml":
            text = file.read_bytes().decode("utf-8", "surrogateescape")
            for element in _DEFAULT.findall(text):
                attributes = {name: html.unescape(a or b) for name, a, b in _ATTRIBUTE.findall(element)}
                defaults.setdefault(attributes.get("name", ""), attributes.get("value", ""))
            rest = _DEFAULT.sub("", text)  # a default counts where its name is used
            values = {_put_in(html.unescape(a or b), {**defaults, **given}) for a, b in _VALUE.findall(rest)} - {""}
            places = list(dict.fromkeys([*folders, file.parent]))
            folders += [place / value for value in values for place in places if os.path.isdir(place / value)]
            waiting += [place / value for value in values for place in [*folders, file.parent]]
    return found


def _put_in(text: str, parameters: Mapping[str, str]) -> str:
    for _ in range(8):  # a value may refer to another parameter
        if "$" not in text:
            break
        for name in sorted(parameters, key=len, reverse=True):
            text = text.replace(f"${name}", parameters[name])
    return text
