"""Options of version 0.3 that stand for a value of a surface, `--pixel-size 1` for `SURFACE,pixel_size=1`.

Version 0.5 knows only those of `_LASTING`, which scripts rely on.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ..errors import RequestError, shell_command
from ..precomputation.recipe import FLAGS, SCAN_KEYS
from ..precomputation.surface_text import split_source
from ..settings import SPECTRUM_PARAMETERS
from ..surface.gratings import PROFILES
from .arguments import SURFACE

_KEYS = [key for key in (*SCAN_KEYS, *SPECTRUM_PARAMETERS) if key != "wavelengths"]  # which never was an option
FORMER = {f"--{key.replace('_', '-')}": key for key in _KEYS} | {"--plane": "prepare"}
"""Option → name of its value in a recipe."""

_LASTING = {
    "inspect": {"pixel_size", "height_range"},
    "precompute": {"representation", "tolerance", "coherence_length", "terms", "heights_from"},
}

Given = list[tuple[str, str, str]]
"""Options as they were given, the names of their values, and the values."""


def surface_argument(command: Any) -> Any:
    """Return the argument of a command that is a surface, or several; None if it has none."""
    arguments = (parameter for parameter in command.params if parameter.param_type_name == "argument")
    return next((argument for argument in arguments if SURFACE in (argument.metavar or "")), None)


def take_options(command: Any, arguments: Sequence[str]) -> tuple[list[str], Given]:
    """Return the other arguments of a command, and its former options.

    Raises:
        RequestError: if such an option has no value.
    """
    own = {option for parameter in command.params for option in (*parameter.opts, *parameter.secondary_opts)}
    others: list[str] = []
    given: Given = []
    words = iter(arguments)
    for word in words:
        option, equals, value = word.partition("=")
        key = FORMER.get(option)
        if key is None or option in own:
            others.append(word)
            others += words if word == "--" else ()
        elif option == "--plane":
            given.insert(0, (word, key, "level_plane"))
        elif key in FLAGS:
            given.append((word, key, value or "true"))
        else:
            value = value if equals else next(words, "")
            if not value:
                raise RequestError(f"{option}: got no value")
            given.append((shell_command(*([word] if equals else [option, value])), key, value))
    return others, given


def add_options(command: Any, context: Any, given: Given) -> str:
    """Add options to the surfaces of a command; return a note of the form that is to be used, or ""."""
    name = surface_argument(command).name
    found = context.params[name]
    if not found:
        raise RequestError(f"{', '.join(option.split()[0] for option, _, _ in given)}: got no surface")
    surfaces = [found] if isinstance(found, str) else list(found)
    are_scans = [_is_scan(surface) for surface in surfaces]
    for i, is_scan in enumerate(are_scans):
        for _, key, value in given:
            # Beside a scan they are its options; but those of the spectrum hold for all that `precompute` gets.
            if is_scan or not any(are_scans) or (command.name == "precompute" and key in SPECTRUM_PARAMETERS):
                surfaces[i] += f",{key}={value}"
    context.params[name] = surfaces[0] if isinstance(found, str) else surfaces
    former = [option for option, key, _ in given if key not in _LASTING.get(command.name, ())]
    if not former:
        return ""
    are, new = "is" if len(former) == 1 else "are", shell_command(*surfaces)
    return f"{' '.join(former)} {are} given as {new} from version 0.5 on"


def _is_scan(surface: str) -> bool:
    path = Path(split_source(surface)[0])
    is_file = path.is_file() or bool(path.suffix)
    return is_file and str(path) not in PROFILES and path.suffix.lower() not in (".toml", ".exr")
