"""Arguments that several commands take."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Annotated

import typer

from ..errors import RequestError
from ..outputs import claimed


def scene_parameters(define: Sequence[str] | None) -> dict[str, str]:
    """The scene's parameters from the -D NAME=VALUE of a command line.

    Raises:
        ValueError: if one is not of that form, not UTF-8, or given twice.
    """
    parameters = {}
    for item in define or []:
        name, equals, value = item.partition("=")
        if not (name and equals):
            raise RequestError(f"-D: got {item!r}, wanted NAME=VALUE")
        _refuse_other_than_utf8(item)
        if name in parameters:
            raise RequestError(f"-D {name}: got it twice, wanted one value")
        # A file named on the command line is relative to where the command is given. A bare word or number is no file,
        # whatever lies there under that name.
        named = os.path.isfile(value) and (os.path.dirname(value) or Path(value).suffix[1:2].isalpha())
        parameters[name] = str(Path(value).resolve()) if named else value
    return parameters


Overwrite = Annotated[
    bool, typer.Option("--overwrite", help="replace files that were made otherwise; never those that are read")
]
# They decide where and how, not what is written.
_NOT_OF_THE_REQUEST = frozenset(
    {"output", "json", "plot", "markdown", "figures", "overwrite", "resume", "checkpoint", "dask"}
)


def claim(
    context: typer.Context,
    reads: Iterable[Path],
    writes: Iterable[tuple[str, Path]],
    scratch: Iterable[Path] = (),
) -> None:
    """`outputs.claimed` until the command ends; its request is what the command line says, but for defaults.

    Raises:
        ValueError: as `outputs.claimed`, or if a file name is not UTF-8, which neither OpenEXR nor Mitsuba can take.
    """
    reads, writes, scratch = list(reads), list(writes), list(scratch)
    for path in [*reads, *(path for _, path in writes)]:
        _refuse_other_than_utf8(os.path.realpath(path))
    request = {
        parameter.name: context.params[parameter.name]
        for parameter in context.command.params
        if parameter.name not in _NOT_OF_THE_REQUEST and context.params.get(parameter.name) != parameter.default
    }
    if "define" in request:
        request["define"] = scene_parameters(request["define"])
    context.with_resource(
        claimed(
            {"command": context.command.name, **request},
            reads,
            writes,
            scratch=scratch,
            overwrite=context.params["overwrite"],
        )
    )


def _refuse_other_than_utf8(text: str) -> None:
    try:
        text.encode()
    except UnicodeEncodeError:
        raise RequestError(f"{text}: wanted names of files and folders in UTF-8") from None
