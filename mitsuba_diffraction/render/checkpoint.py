"""Checkpoints of unfinished renderings.

A checkpoint is an uncompressed `.npz` file (noise does not compress) with the fields of `Accumulation` and the `digest`
of the request (`passes.Job`). The comment of the archive is the SHA-256 of the file (`files.seal`). It takes 8 bytes
per pixel and channel, 710 MB for 1280 × 720 pixels, and twice that while it is being replaced.
"""

from __future__ import annotations

import os
from dataclasses import fields
from pathlib import Path
from zipfile import BadZipFile, ZipFile

import numpy as np

from ..errors import RequestError
from ..files import UNSEALED, is_intact, seal, whole_file
from .accumulation import Accumulation


def checkpoint_path(picture: Path) -> Path:
    """The path of the checkpoint of a picture, next to it."""
    return picture.with_name(f"{picture.name}.checkpoint")


def save_checkpoint(path: str | os.PathLike[str], digest: str, sums: Accumulation) -> None:
    """Writes a checkpoint atomically: after a kill or a power cut, `path` is either the old or the new one.

    Raises:
        OSError: if it cannot be written; the old one is kept.
    """
    with whole_file(path) as temporary:
        with open(temporary, "wb") as stream:
            np.savez(stream, digest=digest, **vars(sums))
        with ZipFile(temporary, "a") as archive:
            archive.comment = UNSEALED.encode()
        seal(temporary)


def load_checkpoint(path: str | os.PathLike[str], digest: str) -> Accumulation | None:
    """Reads a checkpoint.

    Args:
        path: the file.
        digest: of the request.

    Returns:
        The sums, or None if there is no such file.

    Raises:
        ValueError: if it is damaged, not a checkpoint, or one of another request.
    """
    if not os.path.exists(path):
        return None
    with open(path, "rb") as stream:
        try:
            if not is_intact(path):
                raise RequestError("its contents do not match its digest")
            with np.load(stream) as content:
                found = content["digest"].item()
                if found == digest:
                    read = {name: content[name] for name in (field.name for field in fields(Accumulation))}
                    return Accumulation(**{name: value if value.ndim else value.item() for name, value in read.items()})
        # Raised by NumPy and zipfile for damaged files.
        except (ValueError, KeyError, TypeError, EOFError, AttributeError, RuntimeError, OSError, BadZipFile) as error:
            raise RequestError(f"{os.fspath(path)}: not a checkpoint, or a damaged one ({error})") from None
    raise RequestError(
        f"{os.fspath(path)}: of another rendering: the scene or a file that it references, an option or a version has "
        "changed; repeat the original command, or remove the file to start over"
    )
