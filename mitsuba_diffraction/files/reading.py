"""Limits of what is read: files may come from strangers, and are checked before a parser or a library sees them.

The aim is that a file of less than 10 MB is read or refused within 10 s and 1 GB of memory, whatever it declares.
"""

from __future__ import annotations

import lzma
import math
import os
import struct
import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree

from ..errors import RequestError
from ..progress import bytes_text

MAX_FILE_BYTES = 2**31
MAX_SMALL_ARRAY_BYTES = 2**27  # of an array from a file of any size: 4096 × 4096 numbers in float64
MAX_EXPANSION = 16  # of a file into an array; numbers of 8 bits without compression expand into float64 by 8

# What zipfile raises of a damaged archive, and where a member is encrypted or compressed in an unknown way.
BAD_ARCHIVE = (
    zipfile.BadZipFile,
    zlib.error,
    lzma.LZMAError,
    EOFError,
    LookupError,
    NotImplementedError,
    OSError,
    RuntimeError,
    ValueError,
)
# What Pillow and NumPy raise of damaged files, with warnings as errors, beside OSError.
BAD_PICTURE = (
    ArithmeticError,
    EOFError,
    LookupError,
    SyntaxError,
    TypeError,
    UserWarning,
    ValueError,
    struct.error,
)
MAX_ELEMENTS = 2**20  # of an XML file
MAX_NESTING = 32  # of nested elements
MAX_TIFF_PAGES, MAX_TIFF_TAGS = 256, 2**13
_TIFF_SHAPE = 256, 257, 277  # tags of columns, rows and samples per pixel
_TIFF_INTEGERS = {3: "H", 4: "I", 16: "Q"}  # type of a tag → struct's


def check_file(path: str | os.PathLike[str], max_bytes: float = MAX_FILE_BYTES) -> None:
    """Raise unless a path is an ordinary file of at most `max_bytes`, or a folder, which fails when it is opened.

    Raises:
        FileNotFoundError: if it does not exist.
        RequestError: if it is too large, or a pipe or a device, which may be endless.
    """
    name = os.fspath(path)
    if "\0" in name:
        raise RequestError(f"got the file name {name!r}, wanted one without zero characters")
    if not os.path.exists(name):
        raise FileNotFoundError(f"{name}: no such file")
    if os.path.isdir(name):
        return
    if not os.path.isfile(name):
        raise RequestError(f"{name}: a pipe or a device, wanted an ordinary file")
    if (size := os.path.getsize(name)) > max_bytes:
        raise RequestError(f"{name}: got a file of {bytes_text(size)}, wanted at most {bytes_text(max_bytes)}")


def read_bytes(path: str | os.PathLike[str]) -> bytes:
    """Return the content of a file; for errors see `check_file`."""
    check_file(path)
    return Path(path).read_bytes()


def check_array(shape: Sequence[int], stored: int, item_bytes: int = 8, max_bytes: float = MAX_FILE_BYTES) -> None:
    """Check the shape that a file declares before its array is allocated.

    Args:
        shape: numbers along each axis.
        stored: bytes of the file.
        item_bytes: of a number in memory.
        max_bytes: of the array, whatever the file.

    Raises:
        RequestError: if one is negative, or the array has more than `MAX_EXPANSION` times the bytes of the file, and
            more than `MAX_SMALL_ARRAY_BYTES`.
    """
    count = math.prod(shape)
    limit = int(min(_max_unpacked_bytes(stored), max_bytes)) // item_bytes
    if count > limit or min(shape, default=0) < 0:
        got = " × ".join(map(str, shape))
        raise RequestError(
            f"got {got} numbers in {bytes_text(stored)}, wanted at most {limit}: crop it, or store it without "
            "compression"
        )


def _max_unpacked_bytes(stored: int) -> int:
    """Return how many bytes a file of `stored` bytes may take in memory."""
    return max(MAX_SMALL_ARRAY_BYTES, MAX_EXPANSION * stored)


def unpacked_members(archive: zipfile.ZipFile, members: Sequence[str], stored: int) -> dict[str, bytes]:
    """Return the content of members of an archive of `stored` bytes, as many bytes as it declares.

    Raises:
        RequestError: if they are larger than `check_array` allows, or damaged.
    """
    try:
        sizes = {name: archive.getinfo(name).file_size for name in members}
        check_unpacked(sum(sizes.values()), stored)
        found = {}
        for name, size in sizes.items():
            with archive.open(name) as stream:
                # Without a size, all that the member really holds would be unpacked.
                found[name] = stream.read(size)
        return found
    except RequestError:
        raise
    except BAD_ARCHIVE as error:
        raise RequestError(f"a damaged archive ({error})") from None


def check_unpacked(count: int, stored: int) -> None:
    """Check the number of bytes that a file of `stored` bytes declares to hold, compressed; errors of `check_array`."""
    limit = min(_max_unpacked_bytes(stored), MAX_FILE_BYTES)
    if count > limit:
        raise RequestError(
            f"got {bytes_text(stored)} that unpack to {bytes_text(count)}, wanted at most {bytes_text(limit)}"
        )


def check_tiff(content: bytes) -> None:
    """Check the chain of pages of a TIFF, which may lead into its data, and the sizes of their pictures.

    What is no TIFF, or ends within a page, is left to whatever reads it.

    Raises:
        RequestError: if it has more than `MAX_TIFF_PAGES` pages or `MAX_TIFF_TAGS` tags in all, or a picture that
            `check_array` refuses.
    """
    order = {b"II": "<", b"MM": ">"}.get(content[:2])
    if order is None or len(content) < 16:
        return
    is_big = struct.unpack_from(f"{order}H", content, 2)[0] == 43
    number, offset = (
        struct.Struct(f"{order}{'Q' if is_big else 'H'}"),
        struct.Struct(f"{order}{'Q' if is_big else 'I'}"),
    )
    (at,), pages, tags = offset.unpack_from(content, 8 if is_big else 4), 0, 0
    while 0 < at <= len(content) - number.size:
        (count,) = number.unpack_from(content, at)
        pages, tags, end = pages + 1, tags + count, at + number.size + count * (20 if is_big else 12)
        if pages > MAX_TIFF_PAGES or tags > MAX_TIFF_TAGS:
            raise RequestError(f"got a TIFF of more than {MAX_TIFF_PAGES} pages or {MAX_TIFF_TAGS} tags, wanted fewer")
        if end > len(content) - offset.size:
            return
        check_array(_picture_shape(content, at + number.size, count, order, is_big), len(content), item_bytes=2)
        (at,) = offset.unpack_from(content, end)


def _picture_shape(content: bytes, start: int, count: int, order: str, is_big: bool) -> tuple[int, ...]:
    """Return columns, rows and samples of the picture of a page of a TIFF, of the tags that it has."""
    shape = dict.fromkeys(_TIFF_SHAPE, 1)
    for at in range(start, start + count * (20 if is_big else 12), 20 if is_big else 12):
        tag, kind = struct.unpack_from(f"{order}2H", content, at)
        if tag in shape and kind in _TIFF_INTEGERS:
            (shape[tag],) = struct.unpack_from(order + _TIFF_INTEGERS[kind], content, at + (12 if is_big else 8))
    return tuple(shape.values())


class _Bounded(ElementTree.TreeBuilder):
    """Builds a tree of few levels and without definitions of its own, by which a short text may expand without end."""

    def __init__(self) -> None:
        super().__init__()
        self._count, self._depth = 0, 0

    def start(self, tag: str, attributes: dict[str, str]) -> ElementTree.Element:
        self._count, self._depth = self._count + 1, self._depth + 1
        if self._count > MAX_ELEMENTS or self._depth > MAX_NESTING:
            raise RequestError(f"got XML of more than {MAX_ELEMENTS} elements or {MAX_NESTING} levels")
        return super().start(tag, attributes)

    def end(self, tag: str) -> ElementTree.Element:
        self._depth -= 1
        return super().end(tag)

    def doctype(self, name: str, public: str | None, system: str | None) -> None:
        raise RequestError(f"got XML with a document type, {name[:60]!r}, wanted none")


def parse_xml(content: bytes) -> ElementTree.Element:
    """Return the root of an XML file.

    Raises:
        RequestError: if it has too many elements or levels, or a document type.
        ElementTree.ParseError: if it is not XML.
    """
    return ElementTree.fromstring(content, ElementTree.XMLParser(target=_Bounded()))
