"""Atomic writing of files, and digests that detect damage."""

from __future__ import annotations

import glob
import hashlib
import io
import os
import secrets
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

import platformdirs

from ..errors import RequestError

_being_written: set[str] = set()  # temporary paths
_RENAMING_TRIES = 10
_SECONDS_BETWEEN_TRIES = 0.1
_OPEN_ELSEWHERE = {5, 32}  # error codes of Windows, which renames no file over one that a program has open


@contextmanager
def whole_file(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a temporary path next to `path`, and rename it to `path` if the block succeeds.

    A reader sees either the old or the new file, whichever process writes it, and after the block the new file is on
    disk (fsync). If the block raises, including KeyboardInterrupt, the temporary file is removed and `path` is left
    unchanged. The temporary name has the suffix of `path`, by which writers choose the format. A lock beside it is held
    while it is being written; temporary files without one, left by killed processes, are removed here. Symbolic links
    are followed.

    Raises:
        FileNotFoundError: if the folder does not exist.
        ValueError: if `path` exists and is not an ordinary file.
        OSError: if it cannot be written (no space, no permission, on Windows a program that has `path` open); `path`
            is left unchanged.
    """
    target = Path(os.path.realpath(path))
    if str(target) in _being_written:  # a writer called with a temporary path
        yield target
        return
    if not target.parent.is_dir():
        raise FileNotFoundError(f"cannot write {os.fspath(path)!r}: its folder does not exist")
    if target.exists() and not target.is_file():
        raise RequestError(f"cannot write {os.fspath(path)!r}: it exists and is not an ordinary file")
    _remove_stale_temporaries(target)
    # Not tempfile.mkstemp, whose files are readable by their owner only, also after the rename.
    temporary = target.with_name(f".{target.stem}-{secrets.token_hex(8)}{target.suffix}")
    _being_written.add(str(temporary))
    try:
        with _locked(_lock_of_temporary(temporary), wait=True):
            try:
                temporary.touch(exist_ok=False)
                yield temporary
                with open(temporary, "r+b") as stream:
                    os.fsync(stream.fileno())
                _rename(temporary, target)
            finally:
                with suppress(OSError):
                    temporary.unlink(missing_ok=True)
    except OSError as error:
        if error.errno is None or error.filename not in (None, str(temporary)):
            raise
        # A full disk, with the name that the caller knows.
        raise OSError(error.errno, error.strerror, os.fspath(path)) from error
    finally:
        _being_written.remove(str(temporary))
    if hasattr(os, "O_DIRECTORY"):  # Windows opens no folders
        folder = os.open(target.parent, os.O_DIRECTORY)
        try:
            os.fsync(folder)  # makes the rename itself durable
        finally:
            os.close(folder)


def _rename(temporary: Path, target: Path) -> None:
    """Rename a file; while a program on Windows, such as a viewer, has `target` open, try for a second."""
    for remaining in reversed(range(_RENAMING_TRIES)):
        try:
            os.replace(temporary, target)
            return
        except PermissionError as error:
            if getattr(error, "winerror", None) not in _OPEN_ELSEWHERE:
                raise
            if not remaining:
                problem = "another program has it open, or it is write-protected"
                raise PermissionError(error.errno, problem, str(target)) from None
        time.sleep(_SECONDS_BETWEEN_TRIES)


def examples_folder() -> Path:
    """Return the folder that holds the scenes and recipes of the package.

    In a checkout they are beside the package; setup.py copies them into it.
    """
    package = Path(__file__).parents[1]
    for root in (package / "examples", package.parent):
        if (root / "scenes").is_dir():
            return root
    raise RuntimeError(f"{package}: the package was installed without its scenes and recipes")


@contextmanager
def encoded_file(path: str | os.PathLike[str]) -> Iterator[BinaryIO]:
    """Yield a buffer named `path`, and write its contents to `path` by `whole_file` if the block succeeds.

    For Pillow, which ignores the bytes that a full disk does not take when it writes to a file itself.
    """
    buffer = io.BytesIO()
    buffer.name = os.fspath(path)  # its suffix selects the format
    yield buffer
    with whole_file(path) as temporary:
        temporary.write_bytes(buffer.getbuffer())


@contextmanager
def exclusive(path: str | os.PathLike[str]) -> Iterator[None]:
    """Let no other process into the same block for `path`: it holds a lock file next to it meanwhile.

    Raises:
        RequestError: if another process is in it.
    """
    path = Path(path)
    try:
        with _locked(path.with_name(f".{path.name}.lock")):
            yield
    except _HeldElsewhere:
        raise RequestError(f"{path}: another process is writing it, wanted one at a time") from None


class _HeldElsewhere(Exception):
    """Another process holds a lock."""


@contextmanager
def _locked(file: Path, wait: bool = False) -> Iterator[bool]:
    """Hold a lock file, which is removed afterwards; yield False where the file system has no locks.

    Raises:
        _HeldElsewhere: if another process holds it, unless `wait`.
    """
    from filelock import FileLock, Timeout  # takes 0.1 s

    lock = FileLock(file, timeout=-1 if wait else 0)
    with suppress(OSError):
        try:
            lock.acquire()
        except Timeout:
            raise _HeldElsewhere from None
    try:
        yield lock.is_locked
    finally:
        if lock.is_locked:
            with suppress(OSError):  # before it is released, which on Windows removes it
                file.unlink()
            lock.release()


def _lock_of_temporary(temporary: Path) -> Path:
    return temporary.with_name(f"{temporary.name}.lock")


def discard(path: str | os.PathLike[str]) -> None:
    """Remove a file, if it exists, and temporary files that killed processes left beside it."""
    Path(path).unlink(missing_ok=True)
    _remove_stale_temporaries(Path(path))


def _remove_stale_temporaries(target: Path) -> None:
    name = f".{glob.escape(target.stem)}-{16 * '[0-9a-f]'}{glob.escape(target.suffix)}"
    locks = {*target.parent.glob(f"{name}.lock"), *map(_lock_of_temporary, target.parent.glob(name))}
    for lock in locks:
        with suppress(OSError, _HeldElsewhere), _locked(lock) as held:
            if held:
                lock.with_suffix("").unlink(missing_ok=True)


def refuse_unwritable(path: str | os.PathLike[str]) -> None:
    """Raise if `path` cannot be written, to be called before long computations."""
    try:
        with suppress(_Writable), whole_file(path):
            raise _Writable
    except OSError as error:
        raise RequestError(f"cannot write {os.fspath(path)!r}: {error.strerror}" if error.strerror else error) from None


class _Writable(Exception):
    """`path` can be written; discards the temporary file."""


def refuse_other_than_utf8(text: str) -> None:
    """Raise if a file name, or a text that holds one, is not UTF-8."""
    try:
        text.encode()
    except UnicodeEncodeError:
        raise RequestError(f"{text}: wanted names of files and folders in UTF-8") from None


def cache_folder() -> Path:
    """Return the folder of cached results: $MITSUBA_DIFFRACTION_CACHE, or the user's cache folder."""
    named = os.environ.get("MITSUBA_DIFFRACTION_CACHE")
    return Path(named) if named else platformdirs.user_cache_path("mitsuba_diffraction")


# --- a digest inside the file itself ---

_BEFORE_DIGEST = "SHA-256 of this file with zeros for it: "
_ZEROS = 64 * "0"
_BYTES_PER_BLOCK = 2**24
UNSEALED = _BEFORE_DIGEST + _ZEROS
"""Placeholder for the digest; see `seal`."""


def seal(path: str | os.PathLike[str]) -> None:
    """Replace the placeholder `UNSEALED`, or an earlier digest, by the SHA-256 of the file."""
    with open(path, "r+b") as stream:
        if (found := _digest(stream)) is None:
            raise RequestError(f"{os.fspath(path)}: has no placeholder for its digest")
        offset, digest = found
        stream.seek(offset)
        stream.write(digest)


def is_intact(path: str | os.PathLike[str]) -> bool | None:
    """Return whether a sealed file is unchanged; None if it is not sealed."""
    with open(path, "rb") as stream:
        if (found := _digest(stream)) is None:
            return None
        offset, digest = found
        stream.seek(offset)
        return stream.read(len(_ZEROS)) == digest


def _digest(stream: BinaryIO) -> tuple[int, bytes] | None:
    """Return the offset of the digest in a file and its expected value; None if there is no placeholder for one."""
    # By blocks, as a mapping of the file would count as memory of the process.
    mark, read, end_of_read = _BEFORE_DIGEST.encode(), b"", 0
    while (found := read.find(mark)) < 0:
        if not (block := stream.read(_BYTES_PER_BLOCK)):
            return None
        read = read[-len(mark) :] + block
        end_of_read += len(block)
    offset = end_of_read - len(read) + found + len(mark)
    stream.seek(0)
    digest = hashlib.sha256()
    while block := stream.read(min(_BYTES_PER_BLOCK, offset - stream.tell())):
        digest.update(block)
    digest.update(_ZEROS.encode())
    stream.seek(offset + len(_ZEROS))
    while block := stream.read(_BYTES_PER_BLOCK):
        digest.update(block)
    return offset, digest.hexdigest().encode()
