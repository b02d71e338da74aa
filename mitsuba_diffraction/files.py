"""Output files that are whole or not there, and that tell whether they still are what was written."""

from __future__ import annotations

import hashlib
import os
import re
import secrets
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

import platformdirs

from .errors import RequestError

try:
    import fcntl
except ImportError:  # Windows, where nothing tells whether a temporary file is still being written
    fcntl = None

# Temporary path → what it becomes.
_being_written: dict[str, Path] = {}


def final_path(path: str | os.PathLike[str]) -> Path:
    """The real path of a file; of a temporary one that `whole_file` gave, what it becomes."""
    real = os.path.realpath(path)
    return _being_written.get(real, Path(real))


@contextmanager
def whole_file(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Gives a temporary path beside `path` and renames it onto `path` when the block ends well.

    A reader therefore sees the old file or the new one, never half of one, whatever else writes the same file, and from
    the end of the block on the new one outlives a power cut. If the block raises (KeyboardInterrupt included) the
    temporary file is removed and `path` stays as it was. The temporary name ends like `path`, because writers choose
    the format by the ending. It is locked while it is written; unlocked ones, left by a kill, are removed here.

    Args:
        path: where the finished file shall be; a symbolic link is followed.

    Yields:
        The path to write to, in the same folder (a rename across file systems would be a copy, and not whole).

    Raises:
        FileNotFoundError: if the folder does not exist.
        ValueError: if `path` is there and is not an ordinary file.
        OSError: if it cannot be written (no space, no permission); `path` stays as it was.
    """
    target = Path(os.path.realpath(path))
    if str(target) in _being_written:  # a writer that was given a temporary path
        yield target
        return
    if not target.parent.is_dir():
        raise FileNotFoundError(f"cannot write {os.fspath(path)!r}: its folder does not exist")
    if target.exists() and not target.is_file():
        raise RequestError(f"cannot write {os.fspath(path)!r}: it is there and is not an ordinary file")
    _remove_what_a_kill_left(target)
    temporary, opened = _locked_temporary(target)
    _being_written[str(temporary)] = target
    try:
        try:
            yield temporary
            os.fsync(opened)
        finally:
            if fcntl is None:  # Windows renames no open file
                os.close(opened)
        os.replace(temporary, target)
    except BaseException:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)
        raise
    finally:
        del _being_written[str(temporary)]
        if fcntl is not None:
            os.close(opened)
    if hasattr(os, "O_DIRECTORY"):  # the rename itself; not every system can
        folder = os.open(target.parent, os.O_DIRECTORY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)


def _locked_temporary(target: Path) -> tuple[Path, int]:
    """A new file beside `target`, and the descriptor that holds its lock."""
    while True:
        # Not tempfile.mkstemp: its files are private to their owner, and would stay so after the rename.
        temporary = target.with_name(f".{target.stem}-{secrets.token_hex(8)}{target.suffix}")
        opened = os.open(temporary, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o666)
        if fcntl is not None:
            with suppress(OSError):  # a file system without locks
                fcntl.flock(opened, fcntl.LOCK_EX)
        if temporary.exists():  # another process has not taken it for a dead one's before it was locked
            return temporary, opened
        os.close(opened)


def _remove_what_a_kill_left(target: Path) -> None:
    if fcntl is None:
        return
    ours = re.compile(re.escape(f".{target.stem}-") + "[0-9a-f]{16}" + re.escape(target.suffix))
    with suppress(OSError), os.scandir(target.parent) as entries:
        for left in [Path(entry.path) for entry in entries if ours.fullmatch(entry.name)]:
            with suppress(OSError), left.open("rb") as stream:  # locked, gone meanwhile, or of another user
                fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
                left.unlink()


def refuse_unwritable(path: str | os.PathLike[str]) -> None:
    """Raises if no file can be made where `path` shall be: better before hours of work than after them.

    Raises:
        ValueError: with the reason.
    """
    try:
        with whole_file(path):
            raise _Writable
    except _Writable:
        pass
    except OSError as error:
        raise RequestError(f"cannot write {os.fspath(path)!r}: {error.strerror}" if error.strerror else error) from None


class _Writable(Exception):
    """Nothing stands in the way; the temporary file goes."""


def cache_folder() -> Path:
    """Where what took long to build is kept: $MITSUBA_DIFFRACTION_CACHE, or the user's cache folder."""
    named = os.environ.get("MITSUBA_DIFFRACTION_CACHE")
    return Path(named) if named else platformdirs.user_cache_path("mitsuba_diffraction")


def refuse_special(path: str | os.PathLike[str]) -> None:
    """Raises if `path` is a pipe or a device, which may have no end.

    Raises:
        ValueError: if so.
    """
    if os.path.exists(path) and not (os.path.isfile(path) or os.path.isdir(path)):
        raise RequestError(f"{os.fspath(path)}: a pipe or a device, wanted an ordinary file")


# --- a digest inside the file itself ---

_BEFORE_DIGEST = "SHA-256 of this file with zeros for it: "
_ZEROS = 64 * "0"
UNSEALED = _BEFORE_DIGEST + _ZEROS
"""Text that has to stand in the first or last megabyte of a file for `seal`."""
_MEGABYTE = 2**20


def seal(path: str | os.PathLike[str]) -> None:
    """Puts the SHA-256 of a file into the place that `UNSEALED` (or an earlier digest) keeps in it.

    Raises:
        ValueError: if it has no such place.
    """
    with open(path, "r+b") as stream:
        place = _place_of_digest(stream)
        if place is None:
            raise RequestError(f"{os.fspath(path)}: has no place for its digest")
        digest = _digest(stream, place)
        stream.seek(place)
        stream.write(digest)


def is_intact(path: str | os.PathLike[str]) -> bool | None:
    """Whether every bit of a sealed file is what was written; None if it is not sealed."""
    with open(path, "rb") as stream:
        place = _place_of_digest(stream)
        if place is None:
            return None
        stream.seek(place)
        return stream.read(len(_ZEROS)) == _digest(stream, place)


def _place_of_digest(stream: BinaryIO) -> int | None:
    size = stream.seek(0, os.SEEK_END)
    for start in (0, max(0, size - _MEGABYTE)):
        stream.seek(start)
        found = stream.read(_MEGABYTE).find(_BEFORE_DIGEST.encode())
        if found >= 0:
            return start + found + len(_BEFORE_DIGEST)
    return None


def _digest(stream: BinaryIO, place: int) -> bytes:
    content = hashlib.sha256()
    stream.seek(0)
    left = place
    while block := stream.read(min(left, 16 * _MEGABYTE)):
        content.update(block)
        left -= len(block)
    content.update(_ZEROS.encode())
    stream.seek(place + len(_ZEROS))
    while block := stream.read(16 * _MEGABYTE):
        content.update(block)
    return content.hexdigest().encode()
