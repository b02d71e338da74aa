"""HDF5 files, which may name other files, and expand without bound: both is refused before they are read."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ...errors import RequestError
from ...files.reading import MAX_NESTING, check_array, check_unpacked, read_bytes
from .scan import EXTRA

if TYPE_CHECKING:
    import h5py

MAX_OBJECTS = 2**12  # groups, data sets and attributes
_HEAP = b"GCOL\1\0\0\0"  # of values of variable length, such as texts; its size follows, in 8 bytes


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
    """Return the number of bytes that one value of variable length has at most."""
    largest, at = 0, content.find(_HEAP)
    while at >= 0:
        at += len(_HEAP)
        largest = max(largest, int.from_bytes(content[at : at + 8], "little"))
        at = content.find(_HEAP, at)
    return min(largest, len(content))
