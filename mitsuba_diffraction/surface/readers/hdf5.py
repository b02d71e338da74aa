"""HDF5 files, which may name other files, and expand without bound: both is refused before they are read."""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ...errors import RequestError
from ...files.reading import MAX_EXPANSION, MAX_NESTING, check_array, check_unpacked, read_bytes
from ...machine import at_most
from .scan import EXTRA

if TYPE_CHECKING:
    import h5py

MAX_OBJECTS = 2**12  # groups, data sets and attributes
_MEMORY = 2**29  # bytes for what a file declares, beside multiples of its own
_HEAP = b"GCOL\1\0\0\0"  # of values of variable length, such as texts; its size follows, then entries
_HEAP_SIZE, _HEAP_ENTRY = struct.Struct("<Q"), struct.Struct("<H6xQ")  # of an entry its number and length


@contextmanager
def opened(path: Path) -> Iterator[h5py.File]:
    """Yield a file whose numbers and texts are in itself, and within the limits of `check_array`.

    Raises:
        RequestError: if h5py is missing, or the file is not so.
        Exception: as h5py raises it of a damaged file.
    """
    try:
        import h5py
    except ImportError as error:
        raise RequestError(f"an instrument's own format: wanted h5py, {EXTRA} ({error})") from None
    content = read_bytes(path)
    with h5py.File(path, "r") as file:
        texts = sum(_check(node, len(content)) for node in _nodes(file))
        # Several texts may be one and the same in the file.
        check_unpacked(texts * _largest_heap(content), len(content))
        # Of a text the length is known to the library alone, which allocates it before it looks.
        with at_most(_MEMORY + MAX_EXPANSION * len(content)):
            yield file


def _nodes(root: h5py.Group) -> Iterator[h5py.Group | h5py.Dataset]:
    """Yield groups and data sets by hard links, each once."""
    import h5py

    level, seen, count = [root], set(), 0
    for _ in range(MAX_NESTING):
        below = []
        for node in level:
            if (number := h5py.h5o.get_info(node.id).addr) in seen:
                continue
            seen.add(number)
            yield node
            count += 1 + len(node.attrs)
            links = {name: node.get(name, getlink=True) for name in node} if isinstance(node, h5py.Group) else {}
            if any(isinstance(link, h5py.ExternalLink) for link in links.values()):
                raise RequestError("got HDF5 with a link to another file, wanted one that is whole")
            if (count := count + len(links)) > MAX_OBJECTS:
                raise RequestError(f"got HDF5 of more than {MAX_OBJECTS} groups, data sets and attributes")
            below += [node[name] for name, link in links.items() if isinstance(link, h5py.HardLink)]
        level = below
    if level:
        raise RequestError(f"got HDF5 of more than {MAX_NESTING} levels of groups")


def _check(node: h5py.Group | h5py.Dataset, stored: int) -> int:
    """Check what a group or a data set declares; return the number of its values of variable length."""
    import h5py

    tables = [node.attrs.get_id(name) for name in node.attrs]
    if isinstance(node, h5py.Dataset):
        if node.external or node.is_virtual:
            raise RequestError("got HDF5 whose numbers are in another file, wanted one that is whole")
        check_array(node.chunks or (), stored, node.dtype.itemsize)
        tables.append(node)
    for table in tables:
        check_array(table.shape or (), stored, max(table.dtype.itemsize, 1))
    return sum(math.prod(table.shape or ()) * _texts(table.dtype) for table in tables)


def _texts(kind: np.dtype) -> int:
    """Return how many values of variable length a value of this type has."""
    import h5py

    if kind.subdtype is not None:
        return math.prod(kind.subdtype[1]) * _texts(kind.subdtype[0])
    if kind.fields is not None:
        return sum(_texts(field[0]) for field in kind.fields.values())
    inner = h5py.check_vlen_dtype(kind)
    if isinstance(inner, np.dtype) and _texts(inner):
        raise RequestError("got HDF5 with arrays of variable length in others, wanted none")
    return int(kind.hasobject)


def _largest_heap(content: bytes) -> int:
    """Return the number of bytes that one value of variable length has at most.

    Raises:
        RequestError: if a heap is damaged: the library, which walks through it, would never come to its end.
    """
    largest, at = 0, content.find(_HEAP)
    while at >= 0:
        size, *_ = _HEAP_SIZE.unpack_from(content.ljust(at + 16, b"\0"), at + len(_HEAP))
        largest, end = max(largest, size), min(at + size, len(content))
        entry = at + len(_HEAP) + _HEAP_SIZE.size
        while entry + _HEAP_ENTRY.size <= end:
            number, length = _HEAP_ENTRY.unpack_from(content, entry)
            # The entry 0 is what is free, with its own head.
            step = length if number == 0 else _HEAP_ENTRY.size + length
            if step < _HEAP_ENTRY.size or step > end - entry:
                raise RequestError("got HDF5 with a damaged heap of texts")
            entry += step + -step % 8
        at = content.find(_HEAP, at + len(_HEAP))
    return min(largest, len(content))
