"""Arguments shared by several commands."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Annotated

import typer

from .. import outputs
from ..errors import RequestError

Value = bool | int | float | str


def scene_parameters(define: Sequence[str] | None) -> dict[str, str]:
    """Return the scene parameters from the options -D NAME=VALUE."""
    parameters = {}
    for item in define or []:
        name, equals, value = item.partition("=")
        if not (name and equals):
            raise RequestError(f"-D: got {item!r}, wanted NAME=VALUE")
        _refuse_other_than_utf8(item)
        if name in parameters:
            raise RequestError(f"-D {name}: got it twice, wanted one value")
        # File names on the command line are relative to the current folder. A bare word or number is not a file name,
        # even if a file of that name exists.
        named = os.path.isfile(value) and (os.path.dirname(value) or Path(value).suffix[1:2].isalpha())
        parameters[name] = str(Path(value).resolve()) if named else value
    return parameters


Define = Annotated[list[str] | None, typer.Option("-D", metavar="NAME=VALUE", help="set a parameter of the scene")]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="replace existing files, but never inputs")]
Variant = Annotated[str | None, typer.Option(help="Mitsuba variant; default: the fastest spectral one")]
# Options that affect where and how files are written, but not their content.
_NOT_OF_THE_REQUEST = frozenset(
    {"output", "json", "csv", "plot", "markdown", "figures", "overwrite", "resume", "checkpoint", "dask"}
)


def claim(context: typer.Context, reads: Iterable[Path], writes: Iterable[tuple[str, Path]]) -> None:
    """Claim the outputs of a command (`outputs.claim`); the request is its command line without defaults.

    Raises:
        ValueError: as `outputs.claim`, or if a file name is not UTF-8, which OpenEXR and Mitsuba require.
    """
    reads, writes = list(reads), list(writes)
    for path in [*reads, *(path for _, path in writes)]:
        _refuse_other_than_utf8(os.path.realpath(path))
    request = {
        parameter.name: context.params[parameter.name]
        for parameter in context.command.params
        if parameter.name not in _NOT_OF_THE_REQUEST and context.params.get(parameter.name) != parameter.default
    }
    if "define" in request:
        request["define"] = scene_parameters(request["define"])
    request["command"] = context.command.name
    outputs.claim(request, reads, writes, overwrite=context.params["overwrite"])


def check_suffix(option: str, path: Path, *suffixes: str) -> None:
    """Raise ValueError unless the name of an output ends in one of these."""
    if path.suffix.lower() not in suffixes:
        wanted = " or ".join(filter(None, [", ".join(suffixes[:-1]), suffixes[-1]]))
        raise RequestError(f"{option}: got {path}, wanted a file name that ends in {wanted}")


def surface_of(text: str) -> tuple[str, dict[str, Value]]:
    """Return the parts of RECIPE|PROFILE[,name=value…]; numbers, true and false are read as such."""
    source, *items = text.split(",")
    values: dict[str, Value] = {}
    for name, equals, value in (item.strip().partition("=") for item in items):
        if not (name and equals and value) or name in values:
            raise RequestError(f"{text}: got {name + equals + value!r}, wanted name=value, each name once")
        values[name] = _read(value)
    return source, values


def _read(text: str) -> Value:
    for kind in (int, float):
        with suppress(ValueError):
            return kind(text)
    return {"true": True, "false": False}.get(text, text)


def materials_of(texts: Sequence[str] | None) -> dict[str, dict[str, Value]]:
    """Return the parameters of the gratings that take the place of BSDFs, from the options --material ID=…."""
    materials: dict[str, dict[str, Value]] = {}
    for text in texts or []:
        name, equals, rest = text.partition("=")
        source, values = surface_of(rest)
        if not (name and equals and source):
            raise RequestError(f"--material: got {text!r}, wanted ID=RECIPE|PROFILE[,name=value…]")
        if name in materials:
            raise RequestError(f"--material {name}: got it twice, wanted one grating")
        is_file = Path(source).suffix.lower() in (".toml", ".exr")
        if is_file and not os.path.isfile(source):
            raise FileNotFoundError(f"{source}: no such file")
        # The scene has a folder of its own, to which its file names are relative.
        materials[name] = {**({"filename": os.path.abspath(source)} if is_file else {"profile": source}), **values}
    return materials


def _refuse_other_than_utf8(text: str) -> None:
    try:
        text.encode()
    except UnicodeEncodeError:
        raise RequestError(f"{text}: wanted names of files and folders in UTF-8") from None
