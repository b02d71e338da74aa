"""Output files that are whole or not there."""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

import platformdirs


@contextmanager
def whole_file(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Gives a temporary path beside `path` and renames it onto `path` when the block ends well.

    A reader therefore sees the old file or the new one, never half of one. If the block raises (KeyboardInterrupt
    included) the temporary file is removed and `path` stays as it was. The temporary name ends like `path`, because
    writers choose the format by the ending.

    Args:
        path: where the finished file shall be; a symbolic link is followed.

    Yields:
        The path to write to, in the same folder (a rename across file systems would be a copy, and not whole).

    Raises:
        FileNotFoundError: if the folder does not exist.
        ValueError: if `path` is there and is not an ordinary file.
    """
    target = Path(os.path.realpath(path))
    if not target.parent.is_dir():
        raise FileNotFoundError(f"cannot write {os.fspath(path)!r}: its folder does not exist")
    if target.exists() and not target.is_file():
        raise ValueError(f"cannot write {os.fspath(path)!r}: it is there and is not an ordinary file")
    # Not tempfile.mkstemp: its files are private to their owner, and would stay so after the rename.
    temporary = target.with_name(f".{target.stem}-{secrets.token_hex(4)}{target.suffix}")
    try:
        yield temporary
        _sync(temporary, os.O_RDWR)
        os.replace(temporary, target)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


@contextmanager
def durable_file(path: str | os.PathLike[str]) -> Iterator[BinaryIO]:
    """Gives a stream whose content becomes `path` when the block ends well, and outlives a power cut from then on.

    For large files that one process writes again and again. The temporary file `.NAME.partial` beside `path` has one
    name: what a killed process left is written over by the next, and does not fill the disk.

    Raises:
        OSError: if it cannot be written (no space, no permission, no folder); `path` stays as it was.
    """
    target = Path(os.path.realpath(path))
    temporary = target.with_name(f".{target.name}.partial")
    try:
        with temporary.open("wb") as stream:
            yield stream
            stream.flush()
            os.fsync(stream.fileno())
        os.replace(temporary, target)
    except BaseException:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)
        raise
    if hasattr(os, "O_DIRECTORY"):  # the rename itself; not every system can
        _sync(target.parent, os.O_DIRECTORY)


def _sync(path: Path, flags: int) -> None:
    """Waits until a file or a folder is on the disk."""
    opened = os.open(path, flags)
    try:
        os.fsync(opened)
    finally:
        os.close(opened)


def refuse_unwritable(path: str | os.PathLike[str]) -> None:
    """Raises if no file can be made where `path` shall be: better before hours of work than after them.

    Raises:
        ValueError: with the reason.
    """
    try:
        with whole_file(path) as temporary:
            temporary.touch()
            raise _Writable
    except _Writable:
        pass
    except OSError as error:
        raise ValueError(f"cannot write {os.fspath(path)!r}: {error.strerror}" if error.strerror else error) from None


class _Writable(Exception):
    """Nothing stands in the way; the temporary file goes."""


def cache_folder() -> Path:
    """Where what took long to build is kept: $MITSUBA_DIFFRACTION_CACHE, or the user's cache folder."""
    named = os.environ.get("MITSUBA_DIFFRACTION_CACHE")
    return Path(named) if named else platformdirs.user_cache_path("mitsuba_diffraction")
