"""Arguments shared by several commands: surfaces, scenes, numbers and outputs."""

from __future__ import annotations

import functools
import inspect
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import MISSING, fields
from pathlib import Path
from typing import Annotated, Any, ParamSpec, TypeVar, get_type_hints

import numpy as np
import typer
from numpy.typing import NDArray

from ..errors import RequestError
from ..files.writing import refuse_other_than_utf8
from ..precomputation.requested_surface import RequestedSurface
from ..precomputation.surface_text import absolute
from ..progress import say

P = ParamSpec("P")
Request = TypeVar("Request")

_MAX_VALUES = 10_000  # of a range first:last:step


def scene_parameters(define: Sequence[str] | None) -> dict[str, str]:
    """Return the scene parameters from the options -D NAME=VALUE."""
    parameters = {}
    for item in define or []:
        name, equals, value = item.partition("=")
        if not (name and equals):
            raise RequestError(f"-D: got {item!r}, wanted NAME=VALUE")
        refuse_other_than_utf8(item)
        if name in parameters:
            raise RequestError(f"-D {name}: got it twice, wanted one value")
        parameters[name] = absolute(value)
    return parameters


Define = Annotated[list[str] | None, typer.Option("-D", metavar="NAME=VALUE", help="set a parameter of the scene")]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="replace files of other programs, too, but never inputs")]
SURFACE = "SURFACE[,name=value…]"
KEYS_OF_RECIPES = (
    "name=value: what a recipe may say, such as the parameters of a profile, pixel_size and height_range of a scan, "
    "extent, coherence_length, tolerance"
)
Variant = Annotated[str | None, typer.Option(help="Mitsuba variant; default: the fastest spectral one")]


def as_command(kind: Callable[P, Request]) -> Callable[[Callable[[Request], None]], Callable[P, None]]:
    """Make a function of a request a command, whose arguments and options are the fields of the data class `kind`."""
    hints = get_type_hints(kind, include_extras=True)
    parameters = [
        inspect.Parameter(
            field.name,
            inspect.Parameter.POSITIONAL_OR_KEYWORD,
            default=inspect.Parameter.empty if field.default is MISSING else field.default,
            annotation=hints[field.name],
        )
        for field in fields(kind)  # type: ignore[arg-type]
    ]

    def decorate(run: Callable[[Request], None]) -> Callable[P, None]:
        @functools.wraps(run)
        def command(*arguments: P.args, **options: P.kwargs) -> None:
            run(kind(*arguments, **options))

        command.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        command.__annotations__ = hints
        return command

    return decorate


@contextmanager
def named_as_options(names: Mapping[str, str]) -> Iterator[None]:
    """Name the options of the command line, not the parameters of Python, where a message begins with one of these."""
    try:
        yield
    except RequestError as error:
        name, colon, rest = str(error).partition(":")
        raise RequestError(names.get(name, name) + colon + rest) from error.__cause__


def check_suffix(option: str, path: Path, *suffixes: str) -> None:
    """Raise RequestError unless the name of an output ends in one of the suffixes."""
    if path.suffix.lower() not in suffixes:
        wanted = " or ".join(filter(None, [", ".join(suffixes[:-1]), suffixes[-1]]))
        raise RequestError(f"{option}: got {path}, wanted a file name that ends in {wanted}")


def parse_numbers(option: str, text: str) -> NDArray[np.float64]:
    """Return the numbers in "30", "0,30,60" or "0:60:5" (60 included), (n,), at most 10,000."""
    try:
        if ":" not in text:
            return np.array([float(part) for part in text.split(",")])
        first, last, step = (float(part) for part in text.split(":"))
        count = (last - first) / step
        if not 0 <= count < _MAX_VALUES:
            raise ValueError
        return first + step * np.arange(int(count + 1e-9) + 1, dtype=np.float64)
    except (ValueError, ZeroDivisionError):
        raise RequestError(f"{option}: got {text!r}, wanted a number, numbers as 0,30,60, or first:last:step") from None


def incidence_of(option: str, text: str) -> NDArray[np.float64] | str:
    """Return angles of incidence as `angles_of`, or the text of a Littrow mounting, which is checked later."""
    return text if text.startswith("littrow") else angles_of(option, text)


def angles_of(option: str, text: str) -> NDArray[np.float64]:
    """Return angles from the normal in degrees, (n,), given as in `parse_numbers`."""
    found = parse_numbers(option, text)
    if (wrong := found[~(np.abs(found) < 90)]).size:
        raise RequestError(f"{option}: got {wrong[0]:g}, wanted degrees above −90 and below 90")
    return found


def replacements_of(texts: Sequence[str] | None) -> dict[str, dict[str, Any]]:
    """Return the parameters of the gratings that replace BSDFs, by id, from the options --material ID=…."""
    replacements: dict[str, dict[str, Any]] = {}
    for text in texts or []:
        name, equals, rest = text.partition("=")
        if not (name and equals and rest.partition(",")[0]):
            raise RequestError(f"--material: got {text!r}, wanted ID=SURFACE[,name=value…]")
        requested = RequestedSurface.of(rest)
        source, values = requested.source, dict(requested.values)
        if name in replacements:
            raise RequestError(f"--material {name}: got it twice, wanted one grating")
        if requested.kind == "scan":
            raise RequestError(
                f"--material {name}: got {source}, wanted a recipe (.toml), a spectrum (.exr) or a profile"
            )
        is_file = requested.kind != "profile"
        if lists := [key for key, value in values.items() if isinstance(value, list)]:
            raise RequestError(f"--material {name}: got a list, {lists[0]}, which a recipe has, but no scene")
        if is_file and not os.path.isfile(source):
            raise FileNotFoundError(f"{source}: no such file")
        if requested.is_film and values.keys().isdisjoint(("transmission", "material", "coat_ior", "base")):
            values["transmission"] = "sheet"
            say("note", f"material {name}: {source} transmits light (transmission=sheet); transmission=none does not")
        # Absolute, as file names in a scene are relative to the folder of the scene.
        replacements[name] = {**({"filename": os.path.abspath(source)} if is_file else {"profile": source}), **values}
    return replacements
