"""Outputs of commands: which files may be overwritten, and the mark by which the package recognises its own files.

Three rules: an input is never overwritten; a file with the mark may be; any other file needs `--overwrite`.

All files that the package writes carry `MARK`: OpenEXR in the header, PNG in text chunks, JPEG, Markdown and CSV in a
comment, PDF, SVG and WebP in their metadata, JSON as an entry.
"""

from __future__ import annotations

import dataclasses
import itertools
import json
import math
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import RequestError
from .writing import refuse_other_than_utf8, refuse_unwritable, whole_file

if TYPE_CHECKING:
    from PIL.PngImagePlugin import PngInfo

MARK = "mitsuba_diffraction output"
METADATA = {"Keywords": MARK}
"""The mark as metadata for Matplotlib's `savefig`, under a key common to PNG, PDF and SVG."""
_MAX_MARK_DISTANCE = 2**20  # bytes from the beginning or the end of a file


def check_outputs(
    reads: Sequence[str | os.PathLike[str]],
    writes: Sequence[tuple[str, str | os.PathLike[str]]],
    *,
    overwrite: bool = False,
) -> None:
    """Apply the three rules before any work is done.

    Args:
        reads: input files.
        writes: (option, file) of each output.
        overwrite: whether files without the mark may be overwritten.

    Raises:
        ValueError: if an output is also an input, is named twice, exists without the mark, or cannot be written, or
            if a name is not UTF-8, which OpenEXR and Mitsuba require.
    """
    planned: dict[str, str] = {}
    for path in [*reads, *(path for _, path in writes)]:
        refuse_other_than_utf8(os.path.realpath(path))
    for option, path in writes:
        if read := next((read for read in reads if _is_same(path, read)), None):
            by = "" if os.path.abspath(path) == os.path.abspath(read) else f" as {read}"
            raise RequestError(f"{option}: would overwrite {path}, which is read{by}; wanted another name")
        name = os.path.realpath(path).casefold()  # names that differ in case only may be the same file
        if name in planned:
            raise RequestError(f"{option}: {path} would be written twice, for {planned[name]} too; wanted another name")
        planned[name] = option
    for option, path in writes:
        if not Path(path).parent.is_dir():
            raise RequestError(f"{option}: got {path}, but the folder {Path(path).parent} is not there")
        refuse_unwritable(path)
        if os.path.exists(path) and not (overwrite or _is_ours(path)):
            raise RequestError(f"{option}: {path} exists and is not a {MARK}; --overwrite replaces it")


def png_text() -> PngInfo:
    """Return the mark as text chunks for Pillow's `save`."""
    from PIL.PngImagePlugin import PngInfo

    text = PngInfo()
    for name, value in METADATA.items():
        text.add_text(name, value)
    return text


def save_json(content: object, path: str | os.PathLike[str]) -> None:
    """Write a dataclass, or a dictionary of dataclasses and sequences, as a JSON file, atomically.

    Numbers that are not finite become null.
    """
    with whole_file(path) as temporary:
        marked = {**plain(content), "format": MARK}
        temporary.write_text(json.dumps(marked, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


def plain(value: Any) -> Any:
    """Convert to JSON types: dataclasses become dictionaries, tuples lists, and floats that are not finite None."""
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
    """Return whether two names refer to one existing file, possibly by a link."""
    return os.path.exists(path) and os.path.exists(other) and os.path.samefile(path, other)


def _is_ours(path: str | os.PathLike[str]) -> bool:
    """Return whether a file carries the mark; all formats store it near the beginning or the end."""
    with open(path, "rb") as stream:
        if MARK.encode() in stream.read(_MAX_MARK_DISTANCE):
            return True
        stream.seek(max(0, stream.seek(0, os.SEEK_END) - _MAX_MARK_DISTANCE))
        return MARK.encode() in stream.read()
