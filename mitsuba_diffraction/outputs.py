"""Protection of files: a command overwrites neither its inputs nor files that were made for another request.

A command declares the files it reads and writes (`claim`). Every output carries a digest of the request (`made_for`),
by which a later run of the same command recognises its own files. It is stored in the header of OpenEXR, text chunks of
PNG, metadata of PDF, SVG and WebP, an entry of JSON, or a comment in Markdown.
"""

from __future__ import annotations

import dataclasses
import hashlib
import itertools
import json
import math
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from .errors import RequestError
from .files import final_path, refuse_unwritable, whole_file

if TYPE_CHECKING:
    from PIL.PngImagePlugin import PngInfo

_MEGABYTE = 2**20
# Of the running command: real path of an output → the text that it has to carry.
_claims: dict[Path, str] = {}


def claim(
    request: Mapping[str, object],
    reads: Sequence[str | os.PathLike[str]],
    writes: Sequence[tuple[str, str | os.PathLike[str]]],
    *,
    overwrite: bool = False,
) -> None:
    """Refuse to overwrite protected files before any work is done, and mark those that are written from now on.

    Args:
        request: everything that determines the output, by name. File names are stored relative to the output, so that
            a folder may be moved.
        reads: input files.
        writes: (option, file) of each output.
        overwrite: replace outputs of other requests. Inputs are never replaced.

    Raises:
        ValueError: if an output is also an input, is named twice, exists and was not made for this request, or cannot
            be written.
    """
    planned: dict[str, str] = {}
    for option, path in writes:
        if read := next((read for read in reads if _is_same(path, read)), None):
            by = "" if os.path.abspath(path) == os.path.abspath(read) else f" as {read}"
            raise RequestError(f"{option}: got {path}, which is read{by} and would be lost; wanted another name")
        name = os.path.realpath(path).casefold()  # names that differ in case only may be the same file
        if name in planned:
            raise RequestError(f"{option}: {path} would be written twice, for {planned[name]} too; wanted another name")
        planned[name] = option
    _claims.clear()
    for option, path in writes:
        if not Path(path).parent.is_dir():
            raise RequestError(f"{option}: got {path}, but the folder {Path(path).parent} is not there")
        refuse_unwritable(path)
        real = final_path(path)
        _claims[real] = _mark(option, request, real.parent)
        if os.path.exists(path) and not overwrite and not _carries(real, _claims[real]):
            raise RequestError(
                f"{option}: {path} exists and was not made by this command with these options; --overwrite replaces it"
            )


def made_for(path: str | os.PathLike[str]) -> str | None:
    """Return the mark of an output, ASCII; None if no command has claimed it."""
    return _claims.get(final_path(path))


def metadata(path: str | os.PathLike[str]) -> dict[str, str]:
    """Return the mark as metadata for Matplotlib's `savefig`, under a key common to PNG, PDF and SVG."""
    request = made_for(path)
    return {} if request is None else {"Keywords": request}


def png_text(path: str | os.PathLike[str]) -> PngInfo:
    """Return the mark as text chunks for Pillow's `save`."""
    from PIL.PngImagePlugin import PngInfo

    text = PngInfo()
    for name, value in metadata(path).items():
        text.add_text(name, value)
    return text


def save_json(content: object, path: str | os.PathLike[str]) -> None:
    """Write a dataclass, or a dictionary of such and of sequences, as a JSON file, whole or not at all.

    What is not finite becomes null.
    """
    content = plain(content)
    request = made_for(path)
    marked = content if request is None else {**content, "made for": request}
    with whole_file(path) as temporary:
        temporary.write_text(json.dumps(marked, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


def plain(value: object) -> object:
    """Convert to what JSON has: dataclasses become dictionaries, tuples lists, and floats that are not finite None."""
    if dataclasses.is_dataclass(value):
        value = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {name: plain(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def free_name(stem: str, files_of: Callable[[str], Iterable[Path]], reads: Sequence[str | os.PathLike[str]]) -> str:
    """Return a default name: the first of `stem`, `stem`_2, … none of whose files (`files_of`) is an input."""
    names = (stem if number == 1 else f"{stem}_{number}" for number in itertools.count(1))
    return next(name for name in names if not any(_is_same(path, read) for path in files_of(name) for read in reads))


def _is_same(path: str | os.PathLike[str], other: str | os.PathLike[str]) -> bool:
    """Return whether two names are of one file that exists, be it by a link."""
    return os.path.exists(path) and os.path.exists(other) and os.path.samefile(path, other)


def _mark(option: str, request: Mapping[str, object], folder: Path) -> str:
    told = json.dumps([option, _relative(request, folder)], sort_keys=True, default=str)
    return f"mitsuba_diffraction request {hashlib.sha256(told.encode('utf-8', 'surrogateescape')).hexdigest()}"


def _relative(value: object, folder: Path) -> object:
    if isinstance(value, Mapping):
        return {name: _relative(item, folder) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [_relative(item, folder) for item in value]
    if isinstance(value, str | Path) and os.path.exists(value):
        return Path(os.path.relpath(os.path.realpath(value), folder)).as_posix()
    return value


def _carries(path: Path, mark: str) -> bool:
    """Return whether a file carries the mark; all formats store it near the beginning or the end."""
    with open(path, "rb") as stream:
        if mark.encode() in stream.read(_MEGABYTE):
            return True
        stream.seek(max(0, stream.seek(0, os.SEEK_END) - _MEGABYTE))
        return mark.encode() in stream.read()
