"""Output files that are whole or not there."""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


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
        os.replace(temporary, target)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
