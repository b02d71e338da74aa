"""OpenEXR files of spectra: float32, ZIP, one part, sealed by the digest of their content."""

from __future__ import annotations

import contextlib
import errno
import io
import math
import os
import sys
import threading
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR

from ..errors import RequestError
from ..files.outputs import MARK
from ..files.reading import check_array
from ..files.writing import UNSEALED, is_intact, seal, whole_file

# Raised by what takes values of a header that are of another type, size or depth than those written.
MALFORMED = (ArithmeticError, AttributeError, IndexError, MemoryError, RecursionError, TypeError, ValueError)
# Streams belong to the whole process, and Mitsuba loads plugins on several threads.
_silencing = threading.Lock()


@contextlib.contextmanager
def silence() -> Iterator[io.StringIO]:
    """Silence the messages of the OpenEXR library about a damaged file, from Python and from C; yield those to Python.

    For damaged pixels it raises no exception.
    """
    with _silencing:
        sys.stderr.flush()
        saved, null = os.dup(2), os.open(os.devnull, os.O_WRONLY)
        try:
            os.dup2(null, 2)
            with contextlib.redirect_stdout(io.StringIO()) as messages:
                yield messages
        finally:
            os.dup2(saved, 2)
            os.close(saved)
            os.close(null)


def doubles(*values: float) -> np.ndarray:
    """Return numbers for a header in double precision: a Python float would be written in single precision."""
    return np.array(values, np.float64)


def write_channels(
    path: str | os.PathLike[str],
    kind: str,
    version: int,
    header: Mapping[str, Any],
    channels: Mapping[str, np.ndarray],
    recipe: str,
) -> None:
    """Write a spectrum of the format `kind` atomically; `recipe` is the digest of its recipe."""
    header = {
        "type": OpenEXR.scanlineimage,
        "compression": OpenEXR.ZIP_COMPRESSION,
        "format": kind,
        "formatVersion": version,
        **header,
        "recipeSha256": recipe,
        "contentSha256": UNSEALED,
        "writtenBy": MARK,
    }
    with whole_file(path) as temporary:
        OpenEXR.File(header, dict(channels)).write(str(temporary))
        refuse_incomplete(temporary)
        seal(temporary)


def refuse_incomplete(path: Path) -> None:
    """Raise OSError if the last rows of an OpenEXR file are missing: on a full disk its writer may lose them silently.

    The last rows are at the end of the file.
    """
    with silence():
        try:
            file = OpenEXR.InputFile(str(path))
            header = file.header()
            last = header["dataWindow"].max.y
            file.channel(next(iter(header["channels"])), scanLine1=last, scanLine2=last)
        except Exception:
            raise OSError(errno.EIO, "only a part could be written; the disk may be full") from None


def read_channels(path: Path, kind: str, version: int, recipe: str | None) -> tuple[dict[str, Any], dict[str, Any]]:
    """Read header and channels of a file that `write` wrote."""
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    wanted = f"wanted a {kind.removeprefix('mitsuba_diffraction ')}, as mitsuba-diffraction precompute writes it"
    # Before OpenEXR reads it, which finds only some damage.
    if not is_intact(path):
        raise RequestError(f"{path}: damaged, or another file (its SHA-256 is wrong or missing); {wanted}")
    try:
        header, channels = load_exr(path)
    except RequestError as error:
        raise RequestError(f"{path}: {error}; {wanted}") from None
    if header.get("format") != kind:
        raise RequestError(f"{path}: an OpenEXR file of another kind; {wanted}")
    if header.get("formatVersion") != version:
        raise RequestError(
            f"{path}: got format version {header.get('formatVersion')}, wanted {version}; "
            "build the spectrum again with this version of mitsuba_diffraction"
        )
    if recipe not in (None, header.get("recipeSha256")):
        raise RequestError(f"{path}: a spectrum of another recipe")
    return header, channels


def load_exr(path: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return header and channels of an OpenEXR file of one part; its size is checked before pixels are read.

    Raises:
        RequestError: if it is none, damaged, or larger than its bytes can be.
    """
    with silence() as messages:
        try:
            declared = OpenEXR.File(str(path), header_only=True).header()
            (left, top), (right, bottom) = (corner.tolist() for corner in declared["dataWindow"])
            shape = bottom - top + 1, right - left + 1, len(declared["channels"])
            check_array(shape, path.stat().st_size, item_bytes=4, max_bytes=math.inf)
            file = OpenEXR.File(str(path), separate_channels=True)
            header, channels = file.header(), file.channels()
        except RequestError:
            raise
        except Exception as error:
            raise RequestError(f"cannot be read as OpenEXR, is it whole? ({one_line(error)})") from None
    if text := " ".join(messages.getvalue().split()):
        raise RequestError(f"cannot be read as OpenEXR, is it whole? ({text})")
    return header, channels


def one_line(error: Exception) -> str:
    """Return the message of an exception as one line."""
    return " ".join(str(error).split())
