"""The file in which an unfinished rendering waits.

It is NumPy's `.npz`, not compressed (noise does not shrink): the fields of `Accumulation`, and `digest`, that of the
request (`passes.Job`). The comment of the zip archive is the SHA-256 of the file (`files.seal`). It takes 8 bytes per
pixel and channel, 690 MB for 1280 × 720 pixels; while one is written, the one before is there as well.
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
    """Where the checkpoint of a picture lies: beside it."""
    return picture.with_name(f"{picture.name}.checkpoint")


def save_checkpoint(path: str | os.PathLike[str], digest: str, sums: Accumulation) -> None:
    """Writes a checkpoint. At any moment, be it of a kill or a power cut, `path` is the old one or the new one.

    Raises:
        OSError: if it cannot be written; the old one stays.
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
        path: where it lies.
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
                raise RequestError("its bytes are not those that were written")
            with np.load(stream) as content:
                found = content["digest"].item()
                if found == digest:
                    read = {name: content[name] for name in (field.name for field in fields(Accumulation))}
                    return Accumulation(**{name: value if value.ndim else value.item() for name, value in read.items()})
        # What NumPy and zipfile raise, wherever the damage is.
        except (ValueError, KeyError, TypeError, EOFError, AttributeError, RuntimeError, OSError, BadZipFile) as error:
            raise RequestError(f"{os.fspath(path)}: not a checkpoint, or a damaged one ({error})") from None
    raise RequestError(
        f"{os.fspath(path)}: of another rendering: the scene or a file that it names, an option, or a version is not "
        "what it was; give what was given then, or remove the file to begin anew"
    )
