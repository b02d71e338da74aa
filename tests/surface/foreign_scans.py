"""Small synthetic scans in the layouts of instruments' files, of the same relief: 16 rows of 24 pixels.

A peak near the upper left corner (row 2, column 3) tells the orientation.
"""

import hashlib
import io
import struct
import zipfile
import zlib

import numpy as np

ROWS, COLUMNS = 16, 24
DX, DY = 0.25, 0.40  # µm
PEAK = (2, 3)


def relief():
    """Heights in µm; row 0 is the top row of the picture."""
    row, column = np.mgrid[0:ROWS, 0:COLUMNS]
    heights = 0.100 + 0.004 * row + 0.010 * column
    heights[PEAK] = 0.900
    return heights


def nms(missing=(), first=0, last=65535):
    """NanoFocus µsurf: header of 3468 bytes, spacing in nm, uint16 heights, then one byte of intensity per pixel."""
    low, high = 0.05, 1.05
    header = bytearray(3468)
    struct.pack_into("<2i", header, 0, 2, 1)  # 16 bit numbers, an area
    struct.pack_into("<2i", header, 8, first, last)  # the integers that stand for low and high
    struct.pack_into("<2d", header, 16, low, high)  # µm
    header[32:41] = b"OM_MS_2.0"
    header[1076:1092] = b"2020-01-01T00:00"
    struct.pack_into("<2I2d", header, 1368, COLUMNS, ROWS, DX * 1000, DY * 1000)
    struct.pack_into("<i", header, 1416, 1)  # there is an intensity
    numbers = np.rint((relief() - low) / (high - low) * (last - first) + first).astype("<u2")
    intensity = np.full((ROWS, COLUMNS), 128, "u1")
    for at in missing:
        intensity[at] = 0
    return bytes(header) + numbers.tobytes() + intensity.tobytes()


def tmd(comment):
    """TrueMap and GelSight: lengths and heights in mm; the comment ends with a zero byte and may have any length."""
    head = b"Binary TrueMap Data File v2.0\r\n\0" + comment + b"\0"
    sizes = struct.pack("<2I4f", COLUMNS, ROWS, COLUMNS * DX / 1000, ROWS * DY / 1000, 0.0, 0.0)
    return head + sizes + (relief() / 1000).astype("<f4").tobytes()


def sur(missing=(), streams=1, units=6 * ("µm",)):
    """Digital Surf, compressed: header of 512 bytes, a directory of streams, one zlib stream of int32."""
    step = 1e-4  # µm
    numbers = np.rint(relief() / step).astype("<i4")
    lowest, highest = int(numbers.min()), int(numbers.max())
    for at in missing:
        numbers[at] = lowest - 2
    parts = [part.tobytes() for part in np.array_split(numbers.ravel(), streams)]
    packed = [zlib.compress(part) for part in parts]
    sizes = [len(one) for pair in zip(parts, packed, strict=True) for one in pair]
    data = struct.pack(f"<{1 + len(sizes)}I", streams, *sizes) + b"".join(packed)

    def text(word, length=16):
        return word.encode("latin-1").ljust(length)

    header = b"DSCOMPRESSED" + struct.pack("<4h", 0, 1, 1, 2) + text("", 30) + text("", 30)
    header += struct.pack("<5h", 0, 0, 0, int(bool(missing)), 0) + struct.pack("<f4x", 0.0)
    header += struct.pack("<h5i", 32, lowest, highest, COLUMNS, ROWS, ROWS * COLUMNS)
    header += struct.pack("<3f", DX, DY, step)
    header += text("X") + text("Y") + text("Z") + b"".join(map(text, units))
    header += struct.pack("<3f3h12x7hf", 1, 1, 1, 0, 0, 0, 0, 0, 0, 1, 1, 2020, 0, 0.0)
    header += (
        struct.pack("<I6x2h128x", len(data), 0, 0) + struct.pack("<5f", 0, 0, 0, 0, 0) + text("", 13) + text("", 13)
    )
    assert len(header) == 512
    return header + data


REVISION = "ISO5436 - 2000"


def x3p(as_text=True, revision=REVISION, folder="", missing=(), date="", offset="0.0"):
    """X3P (ISO 25178-72): a zip of main.xml and, unless the heights stand in it as text, a file of doubles. Metres."""
    heights = relief() * 1e-6
    for at in missing:
        heights[at] = np.nan
    binary = heights.astype("<f8").tobytes()
    if as_text:
        data = "".join("<Datum/>" if np.isnan(h) else f"<Datum>{h:.12E}</Datum>" for h in heights.ravel())
        data = f"<DataList>{data}</DataList>"
    else:
        digest = hashlib.md5(binary).hexdigest()
        data = (
            "<DataLink><PointDataLink>bindata/data.bin</PointDataLink>"
            f"<MD5ChecksumPointData>{digest}</MD5ChecksumPointData></DataLink>"
        )

    def axis(name, kind, step):
        content = f"<AxisType>{kind}</AxisType><DataType>D</DataType><Increment>{step:E}</Increment>"
        return f"<{name}>{content}<Offset>{offset}</Offset></{name}>"

    axes = axis("CX", "I", DX * 1e-6) + axis("CY", "I", DY * 1e-6) + axis("CZ", "A", 1.0)
    size = f"<MatrixDimension><SizeX>{COLUMNS}</SizeX><SizeY>{ROWS}</SizeY><SizeZ>1</SizeZ></MatrixDimension>"
    main = (
        '<?xml version="1.0" encoding="UTF-8"?>\n<p:ISO5436_2 xmlns:p="http://www.opengps.eu/2008/ISO5436_2">'
        f"<Record1><Revision>{revision}</Revision><FeatureType>SUR</FeatureType><Axes>{axes}</Axes></Record1>"
        f"<Record2><Date>{date}</Date></Record2><Record3>{size}{data}</Record3>"
        "<Record4><ChecksumFile>md5checksum.hex</ChecksumFile></Record4></p:ISO5436_2>\n"
    ).encode()
    members = {"main.xml": main, "md5checksum.hex": hashlib.md5(main).hexdigest().encode() + b" *main.xml\n"}
    if not as_text:
        members["bindata/data.bin"] = binary
    whole = io.BytesIO()
    with zipfile.ZipFile(whole, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            archive.writestr(zipfile.ZipInfo(folder + name, (2020, 1, 1, 0, 0, 0)), content)
    return whole.getvalue()


def tiff(strip, tags):
    """A little-endian TIFF of one page and one strip of pixels; tags: number → (type, count, bytes)."""
    tags = {273: (4, 1, struct.pack("<I", 8)), 279: (4, 1, struct.pack("<I", len(strip)))} | tags
    body, entries = strip + b"\0" * (len(strip) % 2), b""
    for number in sorted(tags):
        kind, count, value = tags[number]
        entries += struct.pack("<2HI", number, kind, count)
        if len(value) > 4:
            entries += struct.pack("<I", 8 + len(body))
            body += value + b"\0" * (len(value) % 2)
        else:
            entries += value.ljust(4, b"\0")
    directory = struct.pack("<H", len(tags)) + entries + struct.pack("<I", 0)
    return b"II*\0" + struct.pack("<I", 8 + len(body)) + body + directory


def park(floats=False):
    """Park Systems: a TIFF whose picture is a preview in false colours; the data are in private tags.

    Height = gain · (factor · number + offset), in the unit of the header; the first line stored is the lowest of the
    picture. The numbers are int16 in version 1 of the header, which this is.
    """
    gain, factor, offset = 5e-4, 1.0, 20.0  # µm, 1, 1
    numbers = (relief()[::-1] / gain - offset) / factor
    numbers = numbers.astype("<f4") if floats else np.rint(numbers).astype("<i2")

    def wide(word, length):
        return word.encode("utf-16-le").ljust(2 * length, b"\0")

    header = (
        struct.pack("<I", 0) + wide("Z Height", 32) + wide("Contact", 8) + struct.pack("<d4I", 0.0, 0, 0, COLUMNS, ROWS)
    )
    header += struct.pack("<dId3I", 0.0, 0, 0.0, 1, 0, 0) + struct.pack(
        "<6d", COLUMNS * DX, ROWS * DY, 0.0, 0.0, 1.0, 0.0
    )
    header += wide("um", 8) + struct.pack("<2d", 0.0, 0.0) + struct.pack("<3d", gain, factor, offset) + wide("um", 8)
    header += struct.pack("<3i3I", 0, 0, 0, 0, 0, 0)
    if floats:  # version 2 of the header
        header += (
            struct.pack("<2d", 1.0, 1.0) + 3 * wide("", 8) + struct.pack("<3I2d", 2, 0, 0, 0.0, 0.0) + wide("", 16)
        )
    low, high = relief().min(), relief().max()
    preview = np.rint((relief() - low) / (high - low) * 255).astype("u1")
    ramp = np.arange(256, dtype="<u2") * 257
    return tiff(
        preview.tobytes(),
        {
            256: (3, 1, struct.pack("<H", COLUMNS)),
            257: (3, 1, struct.pack("<H", ROWS)),
            258: (3, 1, struct.pack("<H", 8)),  # bits
            259: (3, 1, struct.pack("<H", 1)),  # not compressed
            262: (3, 1, struct.pack("<H", 3)),  # palette
            277: (3, 1, struct.pack("<H", 1)),
            278: (3, 1, struct.pack("<H", ROWS)),
            320: (3, 768, np.concatenate([ramp, ramp // 2, ramp // 4]).astype("<u2").tobytes()),
            50432: (4, 1, struct.pack("<I", 0x0E031301)),
            50433: (4, 1, struct.pack("<I", 0x01000002 if floats else 0x01000001)),
            50434: (1, numbers.nbytes, numbers.tobytes()),
            50435: (1, len(header), header),
        },
    )


def ibw(order="<", steps=(DX * 1e-6, DY * 1e-6), units=(b"m", b"m"), layers=0, column_names=(), note=""):
    """Igor binary wave, version 5: rows are along x, columns along y, upwards; the first index runs fastest.

    Args:
        order: of bytes.
        steps: along x and y.
        units: along the surface, and of the heights, which are in metres.
        layers: number of images; 0 for a wave of two dimensions.
        column_names: of the columns.
        note: lines "name: value".
    """
    wave = np.asarray(relief()[::-1].T * 1e-6, f"{order}f4")
    names = b"".join(name.encode().ljust(32, b"\0") for name in ("", *column_names)) if column_names else b""
    sizes = 4 * [0], [0, len(names), 0, 0]
    head = struct.pack(f"{order}hh4i4i4i3i", 5, 0, 320 + wave.nbytes, 0, len(note), 0, *sizes[0], *sizes[1], 0, 0, 0)
    header = struct.pack(f"{order}3IihhI2xh32siI", 0, 0, 0, wave.size, 2, 0, 0, 1, b"scan", 0, 0)
    header += struct.pack(f"{order}4i4d4d", COLUMNS, ROWS, layers, 0, *steps, 1, 1, 0, 0, 0, 0)
    header += struct.pack("4s4s4s8x", units[1], units[0], units[0])
    assert (len(head), len(header)) == (64, 168)
    return head + header.ljust(320, b"\0") + max(layers, 1) * wave.tobytes("F") + note.encode() + names


def sxm(direction="down", rows=ROWS, images="both", unit="m"):
    """Nanonis: the relief forward, and twice its heights backward, after an image of the current."""
    header = f""":NANONIS_VERSION:
2
:SCANIT_TYPE:
              FLOAT            MSBFIRST
:SCAN_PIXELS:
       {COLUMNS}       {ROWS}
:SCAN_TIME:
             1.0E-1             1.0E-1
:SCAN_RANGE:
           {COLUMNS * DX * 1e-6:E}           {ROWS * DY * 1e-6:E}
:SCAN_OFFSET:
             0.000000E+0         0.000000E+0
:SCAN_DIR:
{direction}
:BIAS:
            2.0E-1
:ACQ_TIME:
       10.0
:COMMENT:
probe: 5 µm

:DATA_INFO:
\tChannel\tName\tUnit\tDirection\tCalibration\tOffset
\t0\tCurrent\tA\tboth\t1.000E-9\t0.000E+0
\t14\tZ\t{unit}\t{images}\t8.820E-8\t0.000E+0

:SCANIT_END:


"""
    heights = relief() * 1e-6
    heights[rows:] = np.nan  # not scanned
    heights = heights[::-1] if direction == "up" else heights
    stored = {"forward": heights, "backward": 2 * heights[:, ::-1]}
    chosen = stored.values() if images == "both" else [stored[images]]
    data = np.stack([np.zeros_like(heights), np.zeros_like(heights), *chosen]).astype(">f4")
    return header.encode("latin-1") + b"\x1a\x04" + data.tobytes()


def mdt():
    """NT-MDT: one frame of int16, upwards, with the scales of x, y (µm) and heights (nm)."""
    numbers = np.rint(relief()[::-1] * 1e4).astype("<i2")  # tenths of a nanometre
    scales = struct.pack("<ffhffhffh", 0, DX, -2, 0, DY, -2, 0, 0.1, -1)
    variables = scales + struct.pack("<BBHH", 0, 0, COLUMNS, ROWS)
    body = variables + struct.pack("<4H", 0, COLUMNS, ROWS, 0) + numbers.tobytes()
    date = 2026, 11, 29, 12, 0, 0
    frame = struct.pack("<IH", 22 + len(body), 0) + struct.pack(">H", 1) + struct.pack("<7H", *date, len(variables))
    return struct.pack("<II4xH19x", 0xFF93B001, len(frame) + len(body), 0) + frame + body


def datx():
    """Zygo's HDF5: a table of texts names the data set, whose attributes have its scales; downwards, in nm."""
    import h5py

    text = h5py.string_dtype("ascii")
    entries = [
        ("Root", "Measurement", "{1}"),
        ("{1}", "Surface", "{2}"),
        ("{2}", "Path", "/Data/Surface/{3}"),
    ]
    converter = np.dtype([("Category", text), ("BaseUnit", text), ("Parameters", h5py.vlen_dtype(np.float64))])
    whole = io.BytesIO()
    with h5py.File(whole, "w") as file:
        table = np.dtype([("Source", text), ("Link", text), ("Destination", text)])
        file["MetaData"] = np.array([tuple(word.encode() for word in entry) for entry in entries], table)
        surface = file.create_dataset("/Data/Surface/{3}", data=relief() * 1000)
        surface.attrs["Unit"] = np.array([b"NanoMeters"], object).astype(text)
        surface.attrs["No Data"] = np.array([1e308])
        steps = (
            ("X", "LateralCat", "Pixels", DX),
            ("Y", "LateralCat", "Pixels", DY),
            ("Z", "HeightCat", "NanoMeters", 1),
        )
        for axis, category, unit, step in steps:
            value = np.empty(1, converter)
            value[0] = category.encode(), unit.encode(), np.array([0.0, step * 1e-6, 0.0, 0.0])
            surface.attrs.create(f"{axis} Converter", value, dtype=converter)
    return whole.getvalue()


def opd():
    """Wyko OPD: a directory of blocks; a column after the other, upwards, in units of Wavelength / Mult, nm."""
    numbers = np.ascontiguousarray(relief()[::-1].T * 1000 / (600 / 2), "<f4")
    raw = struct.pack("<3H", COLUMNS, ROWS, 4) + numbers.tobytes()
    blocks = [
        ("Wavelength", 7, struct.pack("<f", 600)),
        ("Mult", 6, struct.pack("<h", 2)),
        ("Aspect", 7, struct.pack("<f", DY / DX)),
        ("Pixel_size", 7, struct.pack("<f", DX / 1000)),
        ("Title", 5, b"A relief".ljust(20, b"\0")),
        ("RAW_DATA", 3, raw),
    ]

    def entry(name, kind, length):
        return struct.pack("<16shiH", name.encode(), kind, length, 0)

    directory = entry("Directory", 1, 24 * (len(blocks) + 1))
    directory += b"".join(entry(name, kind, len(content)) for name, kind, content in blocks)
    return b"\1\0" + directory + b"".join(content for _, _, content in blocks)


def vk4(wrapped=False):
    """Keyence VK4: a table of offsets, settings, and an image of uint32, downwards, in pm; `wrapped` as VK6, zipped."""
    names = 80 * [0]
    names[:8] = 320, 2026, 11, 29, 12, 0, 0, 60
    names[42], names[43], names[44] = round(DX * 1e6), round(DY * 1e6), 100  # pm of a pixel, and of a step of heights
    offsets = 18 * [0]
    offsets[6] = 12 + 4 * (len(offsets) + len(names))
    numbers = np.rint(relief() * 1e4).astype("<u4")
    image = struct.pack("<7I", COLUMNS, ROWS, 32, 0, numbers.nbytes, 0, 2**32 - 1) + bytes(768) + numbers.tobytes()
    whole = b"VK4_" + bytes(8) + struct.pack("<98I", *offsets, *names) + image
    if not wrapped:
        return whole
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as written:
        written.writestr("Vk4File", whole)
    return b"VK6" + archive.getvalue()


def zon(compressed=False, changes=lambda members: None):
    """Keyence ZON: a ZIP after a thumbnail; its members, of UUIDs, have settings, heights in nm and what is invalid.

    Pixels are square, and each member may be compressed by zstandard. `changes` may replace members.
    """
    numbers = np.rint(relief() * 1000).astype("<i4")
    members = {
        "cbc1d39b-215f-4d56-a20e-cf8e5f570755": b"<Device><DeviceModelName>VR</DeviceModelName>"
        b"<DeviceSerialId>1</DeviceSerialId></Device>",
        "1d35862b-3b48-4df2-9235-833ef590b043": b"<Scan><ScanDateTime>2026-11-29T12:00:00</ScanDateTime></Scan>",
        "686613b8-27b5-4a29-8ffc-438c2780873e": f"<Unit><XYCalibration><MeterPerPixel>{DX * 1e-6}</MeterPerPixel>"
        "</XYCalibration><ZCalibration><MeterPerUnit>1e-9</MeterPerUnit></ZCalibration></Unit>".encode(),
        "4cdb0c75-5706-48cc-a9a1-adf395d609ae": struct.pack("<4i", COLUMNS, ROWS, 4, 4 * COLUMNS) + numbers.tobytes(),
        "9e7ca6dd-0e6a-4d7b-8986-f0a7b773c916": struct.pack("<4i", COLUMNS, ROWS, 1, COLUMNS) + bytes(ROWS * COLUMNS),
    }
    changes(members)
    if compressed:
        import zstandard

        members = {name: zstandard.compress(content) for name, content in members.items()}
    whole = io.BytesIO()
    with zipfile.ZipFile(whole, "w") as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return (b"KPK1" if compressed else b"KPK0") + struct.pack("<I", 6) + b"a BMP " + whole.getvalue()


def h5_jpk(reflect=False, frames=2, multiplier=-1e-13, pixels=ROWS * COLUMNS):
    """JPK in HDF5: matrices of pixels by frames, of which the first has the relief; retrace before trace."""
    import h5py

    offset = 3e-7  # m, of height = multiplier · number + offset
    whole = io.BytesIO()
    with h5py.File(whole, "w") as file:
        group = file.create_group("Measurement_000")
        grid = {"ilength": COLUMNS, "jlength": ROWS, "ulength": COLUMNS * DX * 1e-6, "vlength": ROWS * DY * 1e-6}
        grid |= {"unit.unit": b"m", "reflect": str(reflect).lower().encode()}
        group.attrs.update({f"position-pattern.grid.{name}": value for name, value in grid.items()})
        channels = [("error", "Error Signal", False, "V", 1), ("height", "Height", True, "m", 2)]
        channels.append(("height", "Height", False, "m", 1))
        for number, (name, fancy, retrace, unit, factor) in enumerate(channels):
            channel = group.create_group(f"Channel_{number:03}")
            channel.attrs.update({"channel.name": name.encode(), "channel.fancy-name": fancy.encode()})
            scaling = {"multiplier": multiplier, "offset": offset, "unit.unit": unit.encode()}
            channel.attrs.update({f"net-encoder.scaling.{key}": value for key, value in scaling.items()})
            channel.attrs["retrace"] = str(retrace).lower().encode()
            heights = relief() if reflect else relief()[::-1]
            numbers = np.rint((factor * heights * 1e-6 - offset) / multiplier).astype("<i4").ravel()[:pixels]
            channel["Height" if name == "height" else "Error"] = np.stack([numbers, *(frames - 1) * [0 * numbers]], 1)
            channel["thumbnail"] = np.zeros((4, 1), "i4")
    return whole.getvalue()


def jpk(lines=ROWS, image="", curves=0, retrace=False):
    """JPK: a TIFF whose first page is a preview, with the size of the grid; channels are on further pages, upwards.

    Args:
        lines: of the grid, of which the image has the first ones.
        image: name of this TIFF in an archive of force curves; "" for the TIFF itself.
        curves: bytes of force curves in that archive.
        retrace: whether twice the heights, as retrace, stand before them.
    """
    import tifffile

    step, offset = 1e-10, 2e-7  # m, of height = step · number + offset
    numbers = np.rint((relief()[::-1] * 1e-6 - offset) / step).astype("<i4")
    first = [
        (0x8003, "s", 0, "2025-05-20 17:48:42.479 CEST", True),
        *((0x8042 + i, "d", 1, length * 1e-6, True) for i, length in enumerate((COLUMNS * DX, lines * DY))),
        (0x8044, "d", 1, 0.0, True),
        (0x8045, "i", 1, 0, True),
        (0x8046, "I", 1, COLUMNS, True),
        (0x8047, "I", 1, lines, True),
        (0x8052, "s", 0, "contact", True),
    ]
    height = [
        (0x8050, "s", 0, "measuredHeight", True),
        (0x8051, "i", 1, 0, True),
        (0x8052, "s", 0, "Height (measured)", True),
        (0x8080, "i", 1, 2, True),
        (0x8081, "s", 0, "nominal", True),
        (0x8090, "s", 0, "raw", True),
        (0x80C0, "s", 0, "nominal", True),
        (0x80D2, "s", 0, "m", True),
        (0x80D3, "s", 0, "LinearScaling", True),
        (0x80D4, "d", 1, step, True),
        (0x80D5, "d", 1, offset, True),
    ]
    whole = io.BytesIO()
    with tifffile.TiffWriter(whole) as file:
        file.write(np.zeros((8, 8), "u1"), extratags=first, metadata=None, photometric="minisblack")
        if retrace:
            back = [(0x8051, "i", 1, 1, True) if tag[0] == 0x8051 else tag for tag in height]
            file.write(2 * numbers, extratags=back, metadata=None, photometric="minisblack")
        file.write(numbers, extratags=height, metadata=None, photometric="minisblack")
    if not image:
        return whole.getvalue()
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as written:
        written.writestr("header.properties", "jpk-data-file=spm-quantitative-image-data-file\n")
        written.writestr("index/0/segments/0/channels/vDeflection.dat", bytes(curves))
        written.writestr(image, whole.getvalue())
    return archive.getvalue()


def os3d():
    """OmniSurf3D: texts with their lengths, sizes, and heights of float32, downwards, all in µm."""
    texts = b"".join(struct.pack("<I", len(text)) + text for text in (b"a relief", b"2026-11-29T12:00:00"))
    sizes = struct.pack("<2i4d", COLUMNS, ROWS, DX, DY, 0.0, 0.0)
    return b"OmniSurf3D" + struct.pack("<2i", 1, 0) + texts + sizes + relief().astype("<f4").tobytes()


def zmg():
    """Zeta: header of 201 bytes, a comment, and uint16, downwards; steps in µm."""
    step, comment = 1e-4, b"a relief"
    sizes = struct.pack("<2I4s3f8sI", COLUMNS, ROWS, b"", DX, DY, step, b"", len(comment))
    head = b"Zeta-Instruments" + bytes(69) + sizes + bytes(10 + 68 + 6)
    return head + comment + np.rint(relief() / step).astype("<u2").tobytes()


def plux():
    """Sensofar: an archive of an index in XML, and a layer of float32, downwards, in µm."""
    index = f"""<xml><GENERAL><IMAGE_SIZE_X>{COLUMNS}</IMAGE_SIZE_X><IMAGE_SIZE_Y>{ROWS}</IMAGE_SIZE_Y>
<FOV_X>{DX}</FOV_X><FOV_Y>{DY}</FOV_Y><DATE>2026-11-29</DATE></GENERAL>
<INFO><ITEM_0><NAME>Device</NAME><VALUE>S neox</VALUE></ITEM_0>
</INFO><LAYER_0><FILENAME_Z>LAYER_0.raw</FILENAME_Z></LAYER_0></xml>"""
    whole = io.BytesIO()
    with zipfile.ZipFile(whole, "w") as archive:
        archive.writestr("index.xml", index)
        archive.writestr("LAYER_0.raw", relief().astype("<f4").tobytes())
    return whole.getvalue()


def lext():
    """Olympus LEXT: a TIFF with an overview, whose texts have the scale, and a page of heights, uint16, downwards."""
    import tifffile

    step = 100  # pm
    scale = f"""<TiffTagDescData><HeightInfo><HeightDataPerPixelX>{DX * 1e6}</HeightDataPerPixelX>
<HeightDataPerPixelY>{DY * 1e6}</HeightDataPerPixelY><HeightDataPerPixelZ>{step}</HeightDataPerPixelZ>
<HeightDataUnitX>1</HeightDataUnitX><HeightDataUnitY>1</HeightDataUnitY><HeightDataUnitZ>1</HeightDataUnitZ>
</HeightInfo></TiffTagDescData>"""
    calibration = "".join(f"<MakerCalibrationValue{axis}>1000000</MakerCalibrationValue{axis}>" for axis in "XYZ")
    common = f"<ImageCommonSettingsInfo>{calibration}</ImageCommonSettingsInfo>"
    settings = f"<ExifTagDescData>{common}</ExifTagDescData>\0".encode()
    whole = io.BytesIO()
    with tifffile.TiffWriter(whole) as file:
        page = {"metadata": None, "photometric": "minisblack"}
        tags = [(65000, "I", 1, 0, True)]
        file.write(np.zeros((ROWS, COLUMNS), "u1"), description=scale, extratags=tags, **page)
        file.write(np.rint(relief() * 1e6 / step).astype("<u2"), description="HEIGHT", **page)
    # The place of a directory of one entry, which follows.
    content = whole.getvalue()
    placeholder, tag = (struct.pack("<2H2I", number, 4, 1, at) for number, at in ((65000, 0), (34665, len(content))))
    content = content.replace(placeholder, tag)
    return content + struct.pack("<3H3I", 1, 41995, 2, len(settings), len(content) + 18, 0) + settings


def oir(packed=False):
    """Olympus OIR: chunks of properties in XML, of names, and of uint16, downwards; `packed` as POIR, zipped."""
    step, words = 1e-4, "commonphase:imageDefinition"  # µm

    def text(word):
        return struct.pack("<I", len(word)) + word.encode()

    def block(kind, content):
        return struct.pack("<I8I", kind, 1, 1, 0, 0, 1, 1, 1, 1) + content

    def xyz(name, values, kind):
        inner = "".join(f"<{kind}:{axis}>{value}</{kind}:{axis}>" for axis, value in zip("xyz", values, strict=True))
        return f"<commonphase:{name}>{inner}</commonphase:{name}>"

    channels = "".join(
        f"""<commonphase:channel id="{name}"><{words}><commonphase:imageType>{kind}</commonphase:imageType>
<commonphase:depth>2</commonphase:depth></{words}>{xyz("length", (DX, DY, step), "commonparam")}
{xyz("pixelUnit", 3 * ("um",), "commonphase")}</commonphase:channel>"""
        for name, kind in (("a1", "HEIGHT"), ("a2", "INTENSITY"))
    )
    properties = f"""<lsmimage:imageProperties><commonimage:general>
<base:creationDateTime>2026-11-29</base:creationDateTime></commonimage:general><commonimage:microscope><base:name>OLS</base:name></commonimage:microscope><commonimage:imageInfo>
<commonimage:width>{COLUMNS}</commonimage:width><commonimage:height>{ROWS}</commonimage:height><commonimage:phase>
<commonphase:group>{channels}</commonphase:group></commonimage:phase></commonimage:imageInfo><commonimage:acquisition>
<commonimage:microscopeConfiguration><commonimage:pixelCalibration><commonparam:x>1</commonparam:x>
</commonimage:pixelCalibration></commonimage:microscopeConfiguration></commonimage:acquisition>
</lsmimage:imageProperties>"""
    prefix, names = text("t001_0_1") + bytes(4), text("a1") + bytes(4) + text("a2") + bytes(4)
    blocks = block(2, text(properties)) + block(6, struct.pack("<I", 1) + prefix)
    blocks += block(8, struct.pack("<I", 2) + names)
    heights = np.rint(relief() / step).astype("<u2").tobytes()
    named = struct.pack("<2I", 0, len(heights)) + text("t001_0_1_a1_0")
    chunks = struct.pack("<2i", len(blocks), 0) + blocks
    chunks += struct.pack("<2i", len(named), 3) + named + struct.pack("<2I", len(heights), 4) + heights
    numbers = (12, 0, 1, 2, 100, 2, 0, 0, 17, 0, 1, 0, 0, 0)
    head = b"OLYMPUSRAWFORMAT" + struct.pack("<14I8s4I", *numbers, b"UNKNOWN", 1, 1, 2**32 - 1, 2**32 - 1)
    whole = head + chunks + struct.pack("<i", -1)
    if not packed:
        return whole
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as written:
        written.writestr("a scan.oir", whole)
    return archive.getvalue()


def nanoscope(heights, settings=(), image=(), sizes=None):
    """Nanoscope: a header of text, padded, then the lines of each image, upwards.

    Args:
        heights: µm.
        settings, image: fields of the sections of the scan as it was set and of the image.
        sizes: samples per line and lines of the header, if not those of the heights.
    """
    step = 20 / 65536 * 0.1  # µm, of 20 V at 100 nm/V
    numbers = np.rint(heights[::-1] / step).astype("<i2")
    samples, lines = sizes or heights.shape[::-1]

    def section(name, **fields):
        return [f"\\*{name}", *(f"\\{key}: {value}" for key, value in fields.items())]

    start = 4096
    text = [
        *section("File list", Version="0x05120000", **{"Start context": "OL", "Data length": start}),
        *section("Scanner list", **{"@Sens. Zsens": "V 100.0000 nm/V"}),
        *section("Ciao scan list", **{"Operating mode": "Image"}, **dict(settings)),
        *section(
            "Ciao image list",
            **{"Data offset": start, "Data length": numbers.nbytes, "Bytes/pixel": 2, "Start context": "OL"},
            **{"Samps/line": samples, "Number of lines": lines},
            **dict(image),
            **{"@2:Image Data": 'S [Height] "Height"', "@2:Z scale": "V [Sens. Zsens] (0.0003051758 V/LSB) 20.00000 V"},
        ),
        "\\*File list end",
    ]
    header = "".join(f"{line}\r\n" for line in text).encode("latin-1") + b"\x1a"
    assert len(header) < start
    return header.ljust(start, b"\0") + numbers.tobytes()


def wyko(missing=(), in_nm=False, heights="RAW_DATA", blocks=(), **more):
    """Wyko ASCII: a line is a column of the picture, upwards; heights in units of Wavelength / Mult, nm."""
    wavelength, mult = 600.0, 2.0
    fields = {"Wavelength": wavelength, "Mult": mult, "Pixel_size": DX / 1000, "Aspect": DY / DX, "Title": "A relief"}
    text = [f"Wyko ASCII Data File Format 0\t{int(in_nm)}\t1", f"X Size\t{COLUMNS}", f"Y Size\t{ROWS}"]
    text += ["Block Name\tType\tSize\tValue", *(f"{k}\t7\t4\t{v}" for k, v in (fields | more).items() if v is not None)]
    for name in blocks:
        text += [f"{name}\t3\t{2 * relief().size}\t", *("\t".join(ROWS * ["128"]) for _ in range(COLUMNS))]
    numbers = (relief() * 1000 / (1 if in_nm else wavelength / mult))[::-1].T
    lines = [[f"{number:.6f}" for number in column] for column in numbers]
    for row, column in missing:
        lines[column][ROWS - 1 - row] = "Bad"
    text += [f"{heights}\t3\t{4 * relief().size}\t", *("\t".join(line) for line in lines)]
    return ("\r\n".join(text) + "\r\n").encode()


def zygo(missing=(), resolution=DX, kind="XYZ Data File - Format 1"):
    """Zygo's XYZ: 13 lines, then pixel numbers and heights in µm; the origin is the upper left corner."""
    points = [f"{x + 10} {y + 20} {z:.6f}" for (y, x), z in np.ndenumerate(relief())]
    for row, column in missing:
        points[row * COLUMNS + column] = f"{column + 10} {row + 20} No Data"
    text = [f"Zygo {kind}", '0 9 2 0 "Tue Aug 25 16:59:23 2026"', "0 0 0 0 0 0", f"10 20 {COLUMNS} {ROWS}"]
    text += ['"a comment, # 1"', '""', '""', f"0 0.5 6.328e-07 0.5 1 0 {resolution * 1e-6} 1787677163"]
    text += ['1200 1200 0 0 1 0 ""', "0 0 1 36 0 1 0 0 0 0", "1 1 100 0 0 0 0 0 0", '0 ""', "1 0.01"]
    return ("\n".join([*text, "#", *points, "#"]) + "\n").encode()


def gwyddion_text(labels=("Channel:", "Width:", "Height:", "Value units:"), comma=False):
    """The text export of Gwyddion; its header and its decimal mark are those of the language of the program."""
    values = "Topographie", f"{COLUMNS * DX:.3f} µm", f"{ROWS * DY:.3f} µm", "m"
    text = "".join(f"# {label} {value}\n" for label, value in zip(labels, values, strict=True))
    text += "".join("\t".join(f"{h * 1e-6:.6e}" for h in row) + "\n" for row in relief())
    return text.replace(".", ",") if comma else text
