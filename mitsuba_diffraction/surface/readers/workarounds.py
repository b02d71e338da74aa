"""Work-arounds for SurfaceTopography: valid files that it refuses or misreads are rewritten first.

`tools/surfacetopography.md` has the smallest file for each, and what would make the work-around needless.

- .tmd: the comment has any length; the library reads 24 bytes.
- .x3p (ISO 25178-72): a zipped folder, heights as text in main.xml, empty offsets, invalid dates, and dashes in the
  revision are common; the library accepts none of them.
- .sur: since 2010 the data may be compressed by zlib (DSCOMPRESSED). The library refuses units that it does not know,
  as "a.u.".
- .ibw: a wave of two dimensions is an image, unless its columns have names; the library wants it to be square. Heights
  may have no unit.
- .spm, .000: lines and length of a part of a scan (`nanoscope`).
- .jpk-qi-data, .jpk-force-map: archives of force curves, with an image of the heights as in a .jpk.
- .jpk: the file states the size of the grid; an image may have only a part of its lines.
- .nms: lengths are in nm instead of mm, heights are linear between two integers of the header, and pixels without
  intensity were not measured.
"""

from __future__ import annotations

import io
import posixpath
import struct
import zipfile
import zlib
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from ...errors import RequestError
from ...files.reading import BAD_ARCHIVE, check_tiff, check_unpacked, parse_xml, read_bytes, unpacked_members
from . import nanoscope, scan

_TMD_COMMENT = 24  # bytes, of the only comment that the library reads
_SUR_HEADER, _SUR_SIZES = 512, struct.Struct("<2h")  # lengths of comment and private data, at `_SUR_AT`
_SUR_AT = 334
# Units of x, y and heights, of their steps, then of the axes: six texts of 16 bytes.
_SUR_UNITS, _SUR_UNIT = 180, 16
_NMS_HEADER = 3468
_IBW_HEADER, _IBW_SIZES = 384, 4  # bytes; offset of thirteen int32
_IBW_LABELS, _IBW_DIMENSIONS, _IBW_UNIT = 36, 132, 212  # offsets of four int32, of four int32, of a text
_TIFF = "jpk", "ps", "lext"
_JPK_GRID = ("ScanWidth", "ScanLength")  # pixels, by the library's names
_ZON, _ZON_COMPRESSED = b"KPK0", b"KPK1"  # first bytes of a .zon
_ZSTD_BLOCK, _XML_START = 2**22, 64  # bytes
_JPK_IMAGES = ("data-image.jpk-qi-image", "data-image.force")


class Rewritten(NamedTuple):
    """A file for the library.

    Attributes:
        contents: the bytes; of a path the library would read as many as a file declares, and it does not have.
        doubts: `Scan.doubt` by channel.
        has_unit_of_heights: if not, the library takes the unit of the surface.
    """

    contents: io.BytesIO
    doubts: Sequence[str] = ()
    has_unit_of_heights: bool = True


def rewritten(path: Path, name: str) -> Rewritten:
    """Return a file of the format `name` for the library.

    Raises:
        RequestError: if the file is not of this format.
    """
    if name == "jpk" and zipfile.is_zipfile(path):
        image = _jpk_image(path)
        check_tiff(image)
        return Rewritten(io.BytesIO(image))
    if name in _TIFF:
        check_tiff(read_bytes(path))
    if name not in (*_REWRITE, "di"):
        return Rewritten(_archive(path) if zipfile.is_zipfile(path) else io.BytesIO(read_bytes(path)))
    data = read_bytes(path)
    if name == "di":
        data, doubts = nanoscope.rewritten_nanoscope(data)
        return Rewritten(io.BytesIO(data), doubts)
    has_unit = {"sur": _sur_has_units(data)[2], "ibw": len(data) > _IBW_UNIT and data[_IBW_UNIT] != 0}.get(name, True)
    return Rewritten(io.BytesIO(_REWRITE[name](data)), has_unit_of_heights=has_unit)


def is_jpk(path: Path) -> bool:
    """Return whether a file is an archive of force curves of JPK."""
    with suppress(*BAD_ARCHIVE), zipfile.ZipFile(path) as archive:
        return "header.properties" in archive.namelist()
    return False


def _opened(path: Path) -> zipfile.ZipFile:
    try:
        return zipfile.ZipFile(path)
    except BAD_ARCHIVE as error:
        raise RequestError(f"a damaged archive ({error})") from None


def _archive(path: Path) -> io.BytesIO:
    """Return an archive whose members are as long as they are declared, after what precedes them in the file.

    Their XML has the limits of `parse_xml`.
    """
    data = read_bytes(path)
    with _opened(path) as archive:
        start = min((member.header_offset for member in archive.infolist()), default=0)
        members = unpacked_members(archive, archive.namelist(), len(data))
    before = data[:start]
    if before.startswith(_ZON_COMPRESSED):
        before = _ZON + before[len(_ZON) :]
        members = _decompressed(members, len(data))
    for content in members.values():
        if b"<" in content[:_XML_START]:
            with suppress(ElementTree.ParseError):  # what is no XML is refused by the library, if it reads it
                parse_xml(content)
    return _packed(members, before)


def _decompressed(members: Mapping[str, bytes], stored: int) -> dict[str, bytes]:
    """Return members of a .zon that are compressed by zstandard, which SurfaceTopography requires."""
    import zstandard

    found, count = dict[str, bytes](), 0
    for name, content in members.items():
        blocks = []
        try:
            with zstandard.ZstdDecompressor().stream_reader(content) as stream:
                while block := stream.read(_ZSTD_BLOCK):
                    check_unpacked(count := count + len(block), stored)
                    blocks.append(block)
        except zstandard.ZstdError as error:
            raise RequestError(f"a damaged archive ({error})") from None
        found[name] = b"".join(blocks)
    return found


def _packed(members: Mapping[str, bytes], before: bytes = b"") -> io.BytesIO:
    """Return an archive, without compression, after other bytes."""
    whole = io.BytesIO()
    whole.write(before)
    with zipfile.ZipFile(whole, "w") as written:
        for name, content in members.items():
            written.writestr(name, content)
    whole.seek(0)
    return whole


def _jpk_image(path: Path) -> bytes:
    with _opened(path) as archive:
        if (image := next((name for name in archive.namelist() if name in _JPK_IMAGES), None)) is None:
            raise RequestError(
                f"an archive without an image of the heights ({' or '.join(_JPK_IMAGES)}): save that image with "
                "JPK's program, as .jpk or .jpk-qi-image"
            )
        return unpacked_members(archive, [image], path.stat().st_size)[image]


def _tmd(data: bytes) -> bytes:
    magic, _, rest = data.partition(b"\0")
    comment, end, numbers = rest.partition(b"\0")
    if not (magic.startswith(b"Binary TrueMap Data File") and end):
        raise RequestError("not a TrueMap file, which begins with 'Binary TrueMap Data File' and a comment")
    return magic + b"\0" + comment[: _TMD_COMMENT - 1].ljust(_TMD_COMMENT, b"\0") + numbers


def _sur(data: bytes) -> bytes:
    data = _with_known_units(data)
    if not data.startswith(b"DSCOMPRESSED") or len(data) < _SUR_HEADER + 4:
        return data
    start = _SUR_HEADER + sum(_SUR_SIZES.unpack_from(data, _SUR_AT))
    try:
        (count,) = struct.unpack_from("<I", data, start)
        sizes = struct.unpack_from(f"<{2 * count}I", data, start + 4)
        begin, streams = start + 4 + 8 * count, []
        check_unpacked(sum(sizes[::2]), len(data))
        for raw, packed in zip(sizes[::2], sizes[1::2], strict=True):
            streams.append(zlib.decompressobj().decompress(data[begin : begin + packed], raw))
            begin += packed
    except (struct.error, zlib.error) as error:
        raise RequestError(f"a compressed Digital Surf file whose heights cannot be decompressed ({error})") from None
    return b"DIGITAL SURF" + data[12:start] + b"".join(streams)


def _sur_units(data: bytes) -> list[bytes]:
    return [data[at : at + _SUR_UNIT] for at in range(_SUR_UNITS, _SUR_UNITS + 6 * _SUR_UNIT, _SUR_UNIT)]


def _sur_has_units(data: bytes) -> list[bool]:
    """Return whether each unit is a length."""
    # In old files, "æ" is the micro sign of MS-DOS.
    units = (unit.decode("latin-1").strip(" \0").replace("æ", "µ") for unit in _sur_units(data))
    return [scan.is_length(unit) for unit in units]


def _with_known_units(data: bytes) -> bytes:
    """Return a file whose units are lengths, those of the heights like those of the surface, or else none at all."""
    units, (x, y, z, *_) = _sur_units(data), _sur_has_units(data)
    if not (x and y):
        units = 6 * [bytes(_SUR_UNIT)]
    elif not z:
        units[2:] = 4 * units[:1]
    return data[:_SUR_UNITS] + b"".join(units) + data[_SUR_UNITS + 6 * _SUR_UNIT :]


def _x3p(data: bytes) -> bytes:
    try:
        archive = zipfile.ZipFile(io.BytesIO(data))
        names = archive.namelist()
        mains = [name for name in names if posixpath.basename(name).lower() == "main.xml"]
        if not mains:
            raise RequestError("not an X3P file, which is an archive that contains main.xml")
        main = min(mains, key=len)
        root = parse_xml(unpacked_members(archive, [main], len(data))[main])
    except RequestError:
        raise
    except (*BAD_ARCHIVE, ElementTree.ParseError) as error:
        raise RequestError(f"not an X3P file, which is an archive that contains main.xml ({error})") from None
    for element in root.iter():
        element.tag = element.tag.rpartition("}")[2]
    if (record := root.find("Record2")) is not None:  # date and instrument
        root.remove(record)
    if (revision := root.find("Record1/Revision")) is not None:
        revision.text = "ISO5436 - 2000"
    for axis in root.findall("Record1/Axes/*"):
        for empty in [child for child in axis if not (child.text or "").strip() and not len(child)]:
            axis.remove(empty)
    members = {}
    record, kind = root.find("Record3"), root.find("Record1/Axes/CZ/DataType")
    if record is not None and (listed := record.find("DataList")) is not None and kind is not None:
        texts = [(datum.text or "").rpartition(";")[2].strip() for datum in listed.iter("Datum")]
        try:
            heights = np.array([float(text) if text else np.nan for text in texts], "<f8")
        except ValueError as error:
            raise RequestError(f"an X3P file whose heights are text, but no numbers ({error})") from None
        record.remove(listed)
        kind.text, members["data.bin"] = "D", heights.tobytes()
        ElementTree.SubElement(ElementTree.SubElement(record, "DataLink"), "PointDataLink").text = "data.bin"
    # The names of members are relative to main.xml.
    inside = {name.replace("\\", "/").removeprefix(posixpath.dirname(main)).strip("/"): name for name in names}
    for link in root.findall("Record3/DataLink/*"):
        name = (link.text or "").strip().replace("\\", "/").removeprefix("./").strip("/")
        if name in inside:
            link.text, members[name] = name, unpacked_members(archive, [inside[name]], len(data))[inside[name]]
    return _packed({"main.xml": ElementTree.tostring(root), **members}).getvalue()


def _ibw(data: bytes) -> bytes:
    order = "<" if data[:1] == b"\5" else ">"
    if len(data) < _IBW_HEADER or struct.unpack_from(f"{order}h", data)[0] != 5:
        return data
    sizes = struct.unpack_from(f"{order}13i", data, _IBW_SIZES)
    if min(sizes) < 0 or sum(sizes) > len(data):
        raise RequestError(f"an Igor wave whose parts have {sizes} bytes, wanted at most {len(data)} in all")
    (columns_named,) = struct.unpack_from(f"{order}4x i", data, _IBW_LABELS)
    *sides, third, fourth = struct.unpack_from(f"{order}4i", data, _IBW_DIMENSIONS)
    if min(sides) < 2 or third or fourth or columns_named:
        return data
    third = struct.pack(f"{order}i", 1)
    return data[: _IBW_DIMENSIONS + 8] + third + data[_IBW_DIMENSIONS + 12 :]


_REWRITE: dict[str, Callable[[bytes], bytes]] = {"tmd": _tmd, "sur": _sur, "x3p": _x3p, "ibw": _ibw}


def ibw(note: dict[str, str], size: tuple[float, float], shape: tuple[int, int]) -> str:
    """Return `Scan.doubt` of an Igor wave of that size, µm, by the note of an Asylum microscope."""
    try:
        set_size = [1e6 * float(note[name]) for name in ("FastScanSize", "SlowScanSize")]
        counts = [float(note[name]) for name in ("ScanPoints", "ScanLines")]
        expected = [length * n / count for length, n, count in zip(set_size, shape[::-1], counts, strict=True)]
    except (KeyError, ValueError, ZeroDivisionError):
        return ""
    if np.allclose(size, expected, rtol=0.02):
        return ""
    return (
        f"its wave has {size[0]:.4g} × {size[1]:.4g} µm, but its note {expected[0]:.4g} × {expected[1]:.4g} µm "
        "(FastScanSize, SlowScanSize, ScanPoints, ScanLines): taken as the wave has it"
    )


def jpk(metadata: dict[str, Any], shape: tuple[int, int]) -> tuple[float, float, str]:
    """Return the part of the grid that an image of JPK covers, along x and y, and `Scan.doubt`."""
    columns, rows = (metadata.get(name) for name in _JPK_GRID)
    if not (isinstance(columns, int) and isinstance(rows, int) and min(columns, rows) > 0):
        return 1.0, 1.0, ""
    if (columns, rows) == shape[::-1]:
        return 1.0, 1.0, ""
    part = f"an image of {shape[1]} × {shape[0]} pixels, of a grid of {columns} × {rows}"
    return shape[1] / columns, shape[0] / rows, f"{part}: taken for a part of the size of the grid"


def nms(path: Path, heights: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """Return the heights of a NanoFocus file, masked where not measured, and the factor of the library's lengths."""
    data = path.read_bytes()
    first, last = struct.unpack_from("<2i", data, 8)
    low, high = struct.unpack_from("<2d", data, 16)
    numbers = (heights - low) * ((2**16 - 2) / ((high - low) or 1.0))
    if last > first:
        heights = low + (np.rint(numbers) - first) * ((high - low) / (last - first))
    intensity = np.frombuffer(data, np.uint8, offset=_NMS_HEADER + 2 * heights.size)[: heights.size]
    if intensity.size == heights.size and intensity.any():
        heights = np.ma.masked_array(heights, intensity.reshape(heights.shape) == 0)
    return heights, 1e-6
