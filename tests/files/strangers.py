"""Files from strangers, and mutants of good ones: each is read, or refused in one line, within 10 s and 1 GB of memory.

As a program: `python strangers.py NAME…` of crafted files, `python strangers.py FORMAT:COUNT…` for so many mutants,
`python strangers.py SCAN:COUNT…` for those of an instrument's own file. Each is in a process of its own, a copy of the
program's, and each fault is printed in a line.
"""

import faulthandler
import functools
import gc
import io
import multiprocessing
import random
import re
import struct
import sys
import time
import warnings
import zipfile
import zlib
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "surface"))

import foreign_scans
import Imath
import OpenEXR
from PIL import Image

from mitsuba_diffraction.errors import is_bug
from mitsuba_diffraction.files.picture_file import read_picture
from mitsuba_diffraction.files.writing import UNSEALED, seal
from mitsuba_diffraction.optics.refractive_indices import read_index
from mitsuba_diffraction.precomputation.recipe import Recipe
from mitsuba_diffraction.precomputation.requested_surface import RequestedSurface
from mitsuba_diffraction.precomputation.spectra import load_spectrum, precompute
from mitsuba_diffraction.surface.gratings import PROFILES
from mitsuba_diffraction.surface.heightfield import HeightField
from mitsuba_diffraction.surface.readers import read_height_field

MAX_SECONDS, MAX_BYTES = 10, 10**9
RELIEF = foreign_scans.relief()

# ---------------------------------------------------------------- originals


def _saved(write):
    """The bytes of a file written by `write(stream)`."""
    stream = io.BytesIO()
    write(stream)
    return stream.getvalue()


def _of_file(suffix, write):
    """The bytes of a file written by `write(path)`."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / f"original{suffix}"
        write(path)
        return path.read_bytes()


def _gwy():
    import gwyfile

    def write(path):
        field = gwyfile.objects.GwyDataField(RELIEF * 1e-6, xreal=6e-6, yreal=6e-6, si_unit_xy="m", si_unit_z="m")
        container = gwyfile.objects.GwyContainer()
        container["/0/data/title"], container["/0/data"] = "Height", field
        container.tofile(str(path))

    return _of_file(".gwy", write)


def _gsf():
    head = b"Gwyddion Simple Field 1.0\nXRes = 24\nYRes = 16\nXReal = 6e-6\nYReal = 6e-6\nXYUnits = m\nZUnits = m\n"
    return head + bytes(4 - len(head) % 4) + (RELIEF * 1e-6).astype("<f4").tobytes()


def _points():
    lines = [f"{0.25 * x:.3f} {0.4 * y:.3f} {RELIEF[y, x]:.4f}" for y, x in np.ndindex(RELIEF.shape)]
    return "\n".join(lines).encode()


def _table(separator=" "):
    return "\n".join(separator.join(f"{h:.4f}" for h in row) for row in RELIEF).encode()


def _esri():
    return b"ncols 24\nnrows 16\nxllcorner 0\nyllcorner 0\ncellsize 0.25\nNODATA_value -9999\n" + _table()


def _spip():
    head = (
        "# File Format = ASCII\n# x-pixels = 24\n# y-pixels = 16\n# x-length = 6000\n# y-length = 6000\n# z-unit = um\n"
    )
    return head.encode() + _table()


def _nanoscope():
    settings = {"Scan Size": "6000 nm", "Samps/line": 24, "Lines": 16, "Aspect Ratio": "1:1"}
    return foreign_scans.nanoscope(RELIEF, settings, {"Aspect Ratio": "1:1", "Scan Size": "6 6 ~m"})


def _nanoscope_text():
    header = """\\*File list
\\Version: 0x09400000
\\*Ciao scan list
\\Scan Size: 6 ~m
\\Samps/line: 24
\\Lines: 16
\\*Ciao image list
\\Data offset: 81920
\\Data length: 1536
\\Samps/line: 24
\\Number of lines: 16
\\Scan Size: 6 6.4 ~m
\\*File list end
Height_Sensor(um)
"""
    return header.encode() + "\n".join(f"{h:.4f}" for h in RELIEF.ravel()).encode()


def _picture(kind, mode="L", **options):
    grey = np.uint8(255 * RELIEF)
    image = {
        "L": Image.fromarray(grey),
        "I;16": Image.fromarray(np.uint16(65535 * RELIEF)),
        "F": Image.fromarray(RELIEF.astype(np.float32)),
        "RGB": Image.fromarray(np.stack([grey, grey // 2, 255 - grey], -1)),
        "RGBA": Image.fromarray(np.stack([grey, grey // 2, 255 - grey, grey], -1)),
        "P": Image.fromarray(grey).convert("P"),
    }[mode]
    return _saved(lambda stream: image.save(stream, kind, **options))


@functools.cache
def _spectrum(surface="relief", **settings):
    surfaces = {
        "relief": HeightField(RELIEF * 0.2, (0.25, 0.4), "relief"),
        "rough": HeightField(np.random.default_rng(0).normal(0, 0.02, (48, 64)), 0.15, "noise"),
        "line": PROFILES["sinusoidal"](period=1.0, depth=0.05),
    }
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of coarse pixels
        return _of_file(".exr", precompute(surfaces[surface], **settings).save)


def _spectral_image():
    from mitsuba_diffraction.render.spectral_image import SpectralImage

    image = SpectralImage(np.array([450.0, 550.0, 650.0]), np.full((4, 6, 3), 0.5, np.float32), {"digest": "a"})
    return _of_file(".exr", image.save)


def _read_spectral_image(path):
    from mitsuba_diffraction.render.spectral_image import SpectralImage

    SpectralImage.load(path)


def _surface(path):
    RequestedSurface.of(path.read_bytes().decode("utf-8", "surrogateescape")).recipe.check()


def _scan(**options):
    return lambda path: read_height_field(path, fill_missing=True, **options)


_GREY = _scan(pixel_size=0.1, height_range=0.5)
_MICROMETRES = _scan(pixel_size=0.1, unit="um")
_INSTRUMENT = _scan()
_PAGE = b"REFERENCES: none\nDATA:\n  - type: tabulated nk\n    data: |\n        0.3 1.5 0.1\n        0.9 1.6 0.2\n"
_FORMULA = (
    b"DATA:\n  - type: formula 2\n    wavelength_range: 0.3 2.5\n    coefficients: 0 1.04 0.006 0.23 0.02 1.01 103\n"
)
_PROFILE = b'[surface]\nprofile = "blazed"\nperiod = 2.5\ndepth = 0.25\n\n[spectrum]\nwavelengths = [360.0, 830.0]\n'
_OF_SCAN = (
    b'[surface]\nscan = "scan.npy"\npixel_size = [0.1, 0.2]\nprepare = ["level_plane", { despike = 5.0 }]\n\n'
    b'[spectrum]\nextent = "tile"\ntolerance = 0.01\n'
)
_RIGOROUS = (
    b'[surface]\nprofile = "sinusoidal"\nperiod = 1.0\ndepth = 0.1\n[spectrum]\ntheory = "rigorous"\nmaterial = "Al"\n'
)

# Name → how a file of its suffix is made, and read.
FORMATS = {
    "npy": (".npy", lambda: _saved(lambda stream: np.save(stream, RELIEF)), _MICROMETRES),
    "npy_integers": (".npy", lambda: _saved(lambda stream: np.save(stream, np.uint8(255 * RELIEF))), _GREY),
    "npz": (".npz", lambda: _saved(lambda s: np.savez_compressed(s, heights=RELIEF, pixel_size=0.1)), _scan()),
    "gwy": (".gwy", _gwy, _scan()),
    "gsf": (".gsf", _gsf, _scan()),
    "xyz": (".xyz", _points, _scan(unit="um")),
    "csv": (".csv", lambda: _table(","), _MICROMETRES),
    "csv_points": (".csv", lambda: b"x [um],y [um],z [um]\n" + _points().replace(b" ", b","), _scan()),
    "asc": (".asc", lambda: foreign_scans.gwyddion_text().encode(), _scan()),
    "esri": (".asc", _esri, _scan(unit="um")),
    "spip": (".asc", _spip, _scan()),
    "wyko": (".asc", foreign_scans.wyko, _scan()),
    "zygo": (".xyz", foreign_scans.zygo, _scan()),
    "nanoscope_text": (".txt", _nanoscope_text, _scan()),
    "png": (".png", lambda: _picture("PNG"), _GREY),
    "png_16": (".png", lambda: _picture("PNG", "I;16"), _GREY),
    "png_grey_in_colour": (
        ".png",
        lambda: _saved(lambda s: Image.new("RGB", (24, 16), (9, 9, 9)).save(s, "PNG")),
        _GREY,
    ),
    "tiff": (".tif", lambda: _picture("TIFF"), _GREY),
    "tiff_16": (".tif", lambda: _picture("TIFF", "I;16"), _GREY),
    "tiff_float": (".tif", lambda: _picture("TIFF", "F"), _MICROMETRES),
    "tiff_compressed": (".tif", lambda: _picture("TIFF", compression="tiff_lzw"), _GREY),
    "x3p": (".x3p", lambda: foreign_scans.x3p(as_text=False), _INSTRUMENT),
    "x3p_text": (".x3p", foreign_scans.x3p, _INSTRUMENT),
    "sur": (".sur", foreign_scans.sur, _INSTRUMENT),
    "tmd": (".tmd", lambda: foreign_scans.tmd(b"comment"), _INSTRUMENT),
    "nms": (".nms", foreign_scans.nms, _INSTRUMENT),
    "ibw": (".ibw", foreign_scans.ibw, _INSTRUMENT),
    "jpk": (".jpk", foreign_scans.jpk, _INSTRUMENT),
    "jpk_archive": (".jpk-qi-data", lambda: foreign_scans.jpk(image="data-image.jpk-qi-image"), _INSTRUMENT),
    "park": (".tiff", foreign_scans.park, _INSTRUMENT),
    "nanoscope": (".spm", _nanoscope, _INSTRUMENT),
    "mdt": (".mdt", foreign_scans.mdt, _INSTRUMENT),
    "datx": (".datx", foreign_scans.datx, _INSTRUMENT),
    "opd": (".opd", foreign_scans.opd, _INSTRUMENT),
    "vk4": (".vk4", foreign_scans.vk4, _INSTRUMENT),
    "vk6": (".vk6", lambda: foreign_scans.vk4(wrapped=True), _INSTRUMENT),
    "zon": (".zon", foreign_scans.zon, _INSTRUMENT),
    "zon_compressed": (".zon", lambda: foreign_scans.zon(compressed=True), _INSTRUMENT),
    "os3d": (".os3d", foreign_scans.os3d, _INSTRUMENT),
    "zmg": (".zmg", foreign_scans.zmg, _INSTRUMENT),
    "plux": (".plux", foreign_scans.plux, _INSTRUMENT),
    "lext": (".lext", foreign_scans.lext, _INSTRUMENT),
    "oir": (".oir", foreign_scans.oir, _INSTRUMENT),
    "poir": (".poir", lambda: foreign_scans.oir(packed=True), _INSTRUMENT),
    "sxm": (".sxm", foreign_scans.sxm, _INSTRUMENT),
    "h5_jpk": (".h5-jpk", foreign_scans.h5_jpk, _INSTRUMENT),
    "recipe": (".toml", lambda: _PROFILE, lambda path: Recipe.load(path).check()),
    "recipe_of_scan": (".toml", lambda: _OF_SCAN, lambda path: Recipe.load(path).check()),
    "recipe_rigorous": (".toml", lambda: _RIGOROUS, lambda path: Recipe.load(path).check()),
    "index_page": (".yml", lambda: _PAGE, read_index),
    "index_formula": (".yml", lambda: _FORMULA, read_index),
    "index_csv": (".csv", lambda: b"wl,n\n0.3,1.5\n0.6,1.55\n0.9,1.6\nwl,k\n0.3,0.1\n0.9,0.2\n", read_index),
    "index_spd": (".spd", lambda: b"# nm n k\n300 1.5 0.1\n600 1.55 0.15\n900 1.6 0.2\n", read_index),
    "picture_png": (".png", lambda: _picture("PNG", "RGBA"), read_picture),
    "picture_palette": (".png", lambda: _picture("PNG", "P", transparency=3), read_picture),
    "picture_jpeg": (".jpg", lambda: _picture("JPEG", "RGB"), read_picture),
    "picture_tiff": (".tif", lambda: _picture("TIFF", "I;16"), read_picture),
    "picture_webp": (".webp", lambda: _picture("WEBP", "RGB"), read_picture),
    "picture_gif": (".gif", lambda: _picture("GIF", "P"), read_picture),
    "picture_bmp": (".bmp", lambda: _picture("BMP", "RGB"), read_picture),
    "picture_ppm": (".ppm", lambda: _picture("PPM", "RGB"), read_picture),
    "spectrum_of_tile": (".exr", lambda: _spectrum(tolerance=0.5, wavelengths=(780, 830)), load_spectrum),
    "spectrum_of_sample": (
        ".exr",
        lambda: _spectrum("rough", extent="sample", coherence_length=1.5, tolerance=0.1),
        load_spectrum,
    ),
    "spectrum_as_series": (
        ".exr",
        lambda: _spectrum(surface="line", representation="taylor", tolerance=0.1),
        load_spectrum,
    ),
    "spectrum_rigorous": (
        ".exr",
        lambda: _spectrum("line", theory="rigorous", material="Al", tolerance=0.5, wavelengths=(780, 830)),
        load_spectrum,
    ),
    "spectral_image": (".exr", _spectral_image, _read_spectral_image),
    "surface_text": (
        ".txt",
        lambda: b"blazed,period=2.5,depth=0.25,tolerance=0.01,wavelengths=400,wavelengths=700",
        _surface,
    ),
}

# ---------------------------------------------------------------- mutants

_NUMBER = re.compile(rb"[-+]?\d+\.?\d*(?:[eE][-+]?\d+)?")
_TEXTS = b"inf", b"-1", b"1e30", b"nan", b"0", b"text", b"", b"99999999999", b"1e400", b"-1e-30", b"[[1]]", b"\0"
_VALUES = np.inf, np.nan, -1, 1e30, 0, 2**31 - 1, -(2**31), 2**15, 10**6, 10**12


def mutant(content, random_):
    """A copy with a few changes: of bits, of the length, or of numbers."""
    inside = _inside(content)
    if inside is not None and random_.random() < 0.7:
        return inside(lambda part: _changed(part, random_), random_)
    return _changed(content, random_)


def _changed(content, random_):
    data = bytearray(content)
    for _ in range(random_.choice((1, 1, 1, 2, 4))):
        # A header is a small part of a large file.
        at = random_.randrange(min(len(data), random_.choice((len(data), 4096))) + 1)
        kind = random_.choice(("bits", "length", "text", "text", "binary"))
        numbers = list(_NUMBER.finditer(data, 0, 10**5)) if kind == "text" else []
        if kind == "bits" and at < len(data):
            data[at] ^= 1 << random_.randrange(8)
        elif kind == "length":
            end = min(len(data), at + random_.choice((1, 4, 100, len(data))))
            data[at:end] = random_.choice((b"", bytes(data[at:end]) * 2, bytes(random_.choice((1, 50)))))
        elif numbers:
            found = random_.choice(numbers)
            data[found.start() : found.end()] = random_.choice(_TEXTS)
        else:
            packed = _packed(random_)
            at = random_.choice((at, at // 4 * 4, at % 64))
            data[at : at + len(packed)] = packed
    return bytes(data)


def _packed(random_):
    value = random_.choice(_VALUES)
    order = random_.choice("<>")
    if random_.random() < 0.5:
        with np.errstate(over="ignore"):
            return np.array(value, order + random_.choice(("f4", "f8"))).tobytes()
    whole = int(value) if np.isfinite(value) else -1
    size = random_.choice((2, 4, 8))
    return (whole % 256**size).to_bytes(size, "little" if order == "<" else "big")


def _inside(content):
    """A function that changes what checksums or compression hide, if there are any."""
    if content.startswith((b"PK", b"VK6PK", b"KPK")):
        return lambda change, random_: _in_archive(content, change, random_)
    if content.startswith(b"\x89PNG"):
        return lambda change, random_: _in_png(content, change, random_)
    if content.startswith(b"\x76\x2f\x31\x01"):
        return lambda change, random_: _in_exr(content, random_)
    return None


def _in_archive(content, change, random_):
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    name = random_.choice(list(members))
    members[name] = change(members[name])
    stream = io.BytesIO()
    stream.write(content[: content.index(b"PK\3\4")])
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for other, part in members.items():
            archive.writestr(other, part)
    return stream.getvalue()


def _in_png(content, change, random_):
    at, chunks = 8, []
    while at < len(content):
        (size,) = struct.unpack_from(">I", content, at)
        chunks.append((content[at + 4 : at + 8], content[at + 8 : at + 8 + size]))
        at += 12 + size
    chosen = random_.randrange(len(chunks))
    name, part = chunks[chosen]
    chunks[chosen] = name, zlib.compress(change(zlib.decompress(part))) if name == b"IDAT" else change(part)
    return content[:8] + b"".join(
        struct.pack(">I", len(part)) + name + part + struct.pack(">I", zlib.crc32(name + part)) for name, part in chunks
    )


def _in_exr(content, random_):
    """The file with another value in its header, or in a channel."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "a.exr"
        path.write_bytes(content)
        file = OpenEXR.File(str(path), separate_channels=True)
        header = {name: value for name, value in file.header().items() if name not in ("channels", "dataWindow")}
        channels = {name: np.array(channel.pixels) for name, channel in file.channels().items()}
        numbers = [name for name, value in header.items() if isinstance(value, int | float | np.ndarray | str)]
        numbers = [name for name in numbers if name not in ("name", "format", "formatVersion", "contentSha256")]
        if random_.random() < 0.75 and numbers:
            name = random_.choice(numbers)
            header[name] = _other(header[name], random_)
        else:
            values = channels[random_.choice(list(channels))]
            with np.errstate(all="ignore"):
                if random_.random() < 0.5:
                    values[...] *= np.float32(random_.choice((-1, 1e30, 1e6, 0)))
                else:
                    values.flat[random_.randrange(values.size)] = random_.choice(_VALUES)
        try:
            OpenEXR.File(header, channels).write(str(path))
        except Exception:  # what cannot be written
            return content
        return path.read_bytes()


def _other(value, random_):
    if isinstance(value, str):
        if random_.random() < 0.5:
            return _changed(value.encode(), random_).decode("latin-1").replace("\0", "")
        return random_.choice(("", "\x1b[31mred", 100_000 * "[", "x" * 10**6, '{"layout": 1, "values": ""}', "none"))
    other = random_.choice(_VALUES)
    if isinstance(value, np.ndarray):
        changed = np.array(value)
        changed.flat[random_.randrange(value.size)] = other
        return changed
    return type(value)(other) if np.isfinite(other) and abs(other) < 2**31 else value


# ---------------------------------------------------------------- crafted files


def _npz_of_zeros():
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("heights.npy", "w") as member:
        np.lib.format.write_array_header_1_0(member, {"descr": "<f8", "fortran_order": False, "shape": (16000, 16000)})
        for _ in range(16):
            member.write(bytes(8 * 16000 * 1000))
    return stream.getvalue()


def _npy_header():
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(stream, {"descr": "<f8", "fortran_order": False, "shape": (72000, 72000)})
    return stream.getvalue() + bytes(100)


def _black(side=13000, kind="PNG"):
    return _saved(lambda stream: Image.new("L", (side, side)).save(stream, kind, compress_level=1))


def _archive_of(main, name="main.xml"):
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        archive.writestr(name, main)
    return stream.getvalue()


def _zon_of_zeros():
    """Each row is followed by bytes that are not used, 1.3 GB in all."""

    def change(members):
        name = next(name for name in members if name.startswith("4cdb0c75"))
        members[name] = struct.pack("<4i", 24, 16, 4, 8 * 10**7) + bytes(16 * 8 * 10**7)

    return foreign_scans.zon(True, change)


def _lying_archive():
    """A member of 1 GB that is declared to have 100 bytes."""
    content = bytearray(_archive_of(bytes(10**9)))
    for signature, at in ((b"PK\3\4", 22), (b"PK\1\2", 24)):
        struct.pack_into("<I", content, content.index(signature) + at, 100)
    return bytes(content)


def _black_exr(side=16001):
    def write_rows(path):
        header = OpenEXR.Header(side, side)
        header["compression"] = Imath.Compression(Imath.Compression.ZIP_COMPRESSION)
        header["channels"] = {"S0.500,0nm": Imath.Channel(Imath.PixelType(Imath.PixelType.FLOAT))}
        header |= {
            "spectralLayoutVersion": b"1.0",
            "emissiveUnits": b"W.m^-2.sr^-1",
            "contentSha256": UNSEALED.encode(),
        }
        file = OpenEXR.OutputFile(str(path), header)
        for start in range(0, side, 1000):
            rows = min(1000, side - start)
            file.writePixels({"S0.500,0nm": bytes(4 * rows * side)}, rows)
        file.close()

    return _of_file(".exr", write_rows)


def _with_channel(name):
    header = {"spectralLayoutVersion": "1.0", "emissiveUnits": "W.m^-2.sr^-1"}
    pixels = {channel: np.ones((2, 2), np.float32) for channel in ("S0.400nm", name)}
    return _of_file(".exr", lambda path: OpenEXR.File(header, pixels).write(str(path)))


def _with(powers=lambda values: values, representation="slices", **changed):
    """A spectrum with other powers, or other entries of its header."""

    def write_changed(path):
        path.write_bytes(_spectrum("line", representation=representation, tolerance=0.1))
        file = OpenEXR.File(str(path), separate_channels=True)
        header = {name: value for name, value in file.header().items() if name not in ("channels", "dataWindow")}
        channels = {name: powers(np.array(channel.pixels)) for name, channel in file.channels().items()}
        OpenEXR.File(header | changed, channels).write(str(path))

    return _of_file(".exr", write_changed)


def _with_pages(count, tags):
    """A file of JPK whose first page is followed by so many pages, each of which has so many tags."""
    content = foreign_scans.jpk()
    (first,) = struct.unpack_from("<I", content, 4)
    next_page = first + 2 + 12 * struct.unpack_from("<H", content, first)[0]
    page = struct.pack("<H", tags) + tags * struct.pack("<HHII", 254, 1, 1, 8)
    offsets = [len(content) + k * (len(page) + 4) for k in range(count)]
    pages = b"".join(page + struct.pack("<I", offset) for offset in [*offsets[1:], 0])
    return content[:next_page] + struct.pack("<I", offsets[0]) + content[next_page + 4 :] + pages


def _h5_jpk(change):
    """A file of JPK in HDF5 without its heights, in which `change(group)` puts others."""
    import h5py

    whole = io.BytesIO(foreign_scans.h5_jpk())
    with h5py.File(whole, "a") as file:
        group = file["Measurement_000/Channel_002"]
        del group["Height"]
        change(group)
    return whole.getvalue()


def _linked(group):
    import h5py

    group["Height"] = h5py.ExternalLink("linked_heights.h5-jpk", "/Measurement_000/Channel_001/Height")


def _datx(deep=False):
    """A file of Zygo: 8,000 groups in each other, or a table of 400 texts that are one and the same, of 4 MB."""
    import h5py

    whole = io.BytesIO(foreign_scans.datx())
    with h5py.File(whole, "a") as file:
        if deep:
            group = file.create_group("Attributes")
            for _ in range(8_000):
                group = group.create_group("a")
        else:
            kind = file["MetaData"].dtype
            rows = [*file["MetaData"], *((b"x", b"%d" % k, b"y") for k in range(400)), (b"x", b"y", 2**22 * b"x")]
            del file["MetaData"]
            table = file.create_dataset("MetaData", data=np.array(rows, kind))
            at, size = table.id.get_offset(), 48  # of three references
    content = bytearray(whole.getvalue())
    if not deep:
        for row in range(3, 403):
            end = at + (row + 1) * size
            content[end - 16 : end] = content[at + 403 * size + size - 16 : at + 404 * size]
    return bytes(content)


def _endless_heap():
    """A file of Zygo whose heap of texts ends with free space of no length, so that HDF5 never comes to its end."""
    content = bytearray(foreign_scans.datx())
    at = content.index(b"GCOL") + 16
    while struct.unpack_from("<H", content, at)[0]:
        at += 16 + (struct.unpack_from("<Q", content, at + 8)[0] + 7) // 8 * 8
    struct.pack_into("<Q", content, at + 8, 0)
    return bytes(content)


def _aliases():
    lists = "".join(f"a{i}: &a{i} [{', '.join(8 * [f'*a{i - 1}' if i else '1'])}]\n" for i in range(8))
    return f"{lists}DATA:\n  - type: formula 1\n    wavelength_range: 0.3 2\n    coefficients: *a7\n".encode()


_STEPS = b'[surface]\nscan = "scan.npy"\npixel_size = 0.1\nprepare = [' + 1000 * b'"level_plane", ' + b"]\n"

# Name → a file that is refused, the suffix of its name, and how it is read.
CRAFTED = {
    "aliases": (".yml", _aliases, read_index),
    "deep_page": (".yml", lambda: 100_000 * b"[", read_index),
    "range_without_end": (".yml", lambda: _FORMULA.replace(b"0.3 2.5", b"0 inf"), read_index),
    "large_page": (".yml", lambda: b"[" + 500_000 * b"1," + b"]", read_index),
    "dotted_key": (".toml", lambda: b"a" + 40_000 * b".a" + b" = 1\n", Recipe.load),
    "many_steps": (".toml", lambda: _STEPS, Recipe.load),
    "zero_in_a_name": (".toml", lambda: _OF_SCAN.replace(b"scan.npy", b"a\\u0000b.npy"), FORMATS["recipe"][2]),
    "many_commas": (".txt", lambda: b"blazed" + 20_000 * b",a", _surface),
    "comment_of_spaces": (".scan", lambda: b"#" + 4000 * b" " + b"1 2\n", _MICROMETRES),
    "npy_header": (".npy", _npy_header, _MICROMETRES),
    "no_wavelength": (".exr", lambda: _with_channel("S0.0Hz"), _read_spectral_image),
    "no_number": (".exr", lambda: _with_channel("S0.1e400nm"), _read_spectral_image),
    "nested_energy": (".exr", lambda: _with(energy=100_000 * "["), load_spectrum),
    "wavelength_of_zero": (".exr", lambda: _with(wavelengths=np.array([0.0, 830.0])), load_spectrum),
    "large_tile": (".exr", lambda: _with(tileSize=np.array([1e12, 1e12])), load_spectrum),
    "negative_powers": (".exr", lambda: _with(lambda values: -values), load_spectrum),
    "large_powers": (".exr", lambda: _with(lambda values: values + np.float32(1e30)), load_spectrum),
    "many_channels": (".exr", lambda: _with(representation="taylor", channelCount=2**31 - 1), load_spectrum),
    "long_source": (".exr", lambda: _with(source="x" * 3_000_000), load_spectrum),
}
# The same, of files that take seconds to make, or need the extra.
SLOWLY_CRAFTED = {
    "many_pages": (".jpk", lambda: _with_pages(200, 4000), _INSTRUMENT),
    "npz_of_zeros": (".npz", _npz_of_zeros, _MICROMETRES),
    "black_scan": (".png", _black, _GREY),
    "black_picture": (".png", _black, read_picture),
    "elements": (".x3p", lambda: _archive_of(b"<a>" + 3_000_000 * b"<b/>" + b"</a>"), _INSTRUMENT),
    "nested_elements": (".x3p", lambda: _archive_of(50_000 * b"<a>" + 50_000 * b"</a>"), _INSTRUMENT),
    "many_elements": (".x3p", lambda: _archive_of(b"<a>" + 15_000_000 * b"<b/>" + b"</a>"), _INSTRUMENT),
    "heights_of_a_device": (
        ".h5-jpk",
        lambda: _h5_jpk(lambda g: g.create_dataset("Height", (384, 1), "i4", external=[("/dev/zero", 0, 1536)])),
        _INSTRUMENT,
    ),
    "linked_heights": (".h5-jpk", lambda: _h5_jpk(_linked), _INSTRUMENT),
    "long_texts": (".datx", _datx, _INSTRUMENT),
    "endless_heap": (".datx", _endless_heap, _INSTRUMENT),
    "deep_groups": (".datx", lambda: _datx(deep=True), _INSTRUMENT),
    "elements_of_another": (
        ".plux",
        lambda: _archive_of(b"<a>" + 15_000_000 * b"<b/>" + b"</a>", "index.xml"),
        _INSTRUMENT,
    ),
    "zstandard": (".zon", _zon_of_zeros, _INSTRUMENT),
    "lying_archive": (".x3p", _lying_archive, _INSTRUMENT),
    "lying_archive_of_another": (".plux", _lying_archive, _INSTRUMENT),
    "black_spectral_image": (".exr", _black_exr, _read_spectral_image),
    "black_spectrum": (".exr", _black_exr, load_spectrum),
}
# Files that are read, as large as the limits allow.
LARGE = {
    "brackets": (".csv", lambda: b"a" + 200_000 * b"[" + b"\n1,2\n3,4\n", _MICROMETRES),
    "large_picture": (".png", lambda: _black(8192), read_picture),
    "large_scan": (".png", lambda: _black(4096), _GREY),
    "long_text": (".xyz", lambda: b"\n".join(b"%d %d 1" % divmod(k, 700) for k in range(700 * 700)), _scan(unit="um")),
}

# ---------------------------------------------------------------- the judge


def fault(read, path, refused=None):
    """What is wrong with how a file is read or refused, or ""; `refused`: which of the two it must be, if either."""
    start, found, was_refused, before = time.process_time(), "", False, _peak()
    try:
        read(path)
    except MemoryError:
        found = "more than 1 GB"
    except Exception as error:
        was_refused = True
        if is_bug(type(error)):
            found = f"a bug: {type(error).__name__}: {str(error)[:200]}"
        elif re.search("MemoryError|Unable to allocate", str(error)):
            found = f"more than 1 GB: {str(error)[:200]!r}"
        elif "\n" in str(error):
            found = f"not refused in one line: {str(error)[:200]!r}"
        elif refused is False:
            found = f"refused: {str(error)[:200]}"
    if refused and not was_refused:
        found += " read"
    if before < (peak := _peak()) > MAX_BYTES:  # what a library catches is not raised
        found += f" {peak / 1e9:.2f} GB"
    if (seconds := time.process_time() - start) > MAX_SECONDS:
        found += f" {seconds:.1f} s"
    return found


def write(path, content):
    """Write a file; a spectrum with the digest that it then has."""
    path.unlink(missing_ok=True)  # ext4 waits for the disk where a file is written anew
    path.write_bytes(content)
    if path.suffix == ".exr":
        with suppress(ValueError):  # a picture has no placeholder for it
            seal(path)


def format_named(name):
    """The suffix of a format, or of an instrument's own file, how it is made, and how it is read."""
    return FORMATS[name] if name in FORMATS else (Path(name).suffix, Path(name).read_bytes, _INSTRUMENT)


def faults_of_mutants(name, count, folder, seed=0):
    """Yield the number and the fault of those among `count` mutants that have one."""
    suffix, make, read = format_named(name)
    original, path = make(), folder / f"original{suffix}"
    np.save(folder / "scan.npy", RELIEF)
    write(path, original)
    read(path)
    for number in range(count):
        write(path, mutant(original, random.Random(f"{name} {seed} {number}")))
        if found := fault(read, path):
            yield number, found


_in_memory_at_first = None  # bytes; None: not counted


def _peak():
    """The most bytes in memory so far beside those at first."""
    if _in_memory_at_first is None:
        return 0
    import resource

    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - _in_memory_at_first


def _limit_memory():
    """Count the memory from now on; twice `MAX_BYTES` of addresses, so that what is too much can be counted."""
    import resource

    global _in_memory_at_first
    pages = [int(count) * resource.getpagesize() for count in Path("/proc/self/statm").read_text().split()]
    _in_memory_at_first = pages[1]
    resource.setrlimit(resource.RLIMIT_AS, (pages[0] + 2 * MAX_BYTES, resource.RLIM_INFINITY))


def _in_a_copy(name, seconds, action):
    """Run an action in a copy of this process, which has imported what it needs; one that does not end well is a fault.

    After so many seconds it ends with a traceback of where it was. A copy has no threads but the one that makes it, and
    would wait for those of OpenEXR.
    """
    threads = OpenEXR.global_thread_count()

    def run():
        OpenEXR.set_global_thread_count(threads)
        faulthandler.dump_traceback_later(seconds, exit=True)
        action()

    print(f"{name} …", file=sys.stderr, flush=True)
    process = multiprocessing.get_context("fork").Process(target=run)
    OpenEXR.set_global_thread_count(0)
    process.start()
    OpenEXR.set_global_thread_count(threads)
    process.join()
    if process.exitcode:
        print(f"{name}: ended with {process.exitcode}", flush=True)


def _print_faults_of_mutants(kind, count, folder):
    _limit_memory()
    for number, found in faults_of_mutants(kind, count, folder):
        print(f"{kind} {number}: {found}", flush=True)


def _print_fault(name, read, path):
    _limit_memory()
    if found := fault(read, path, name not in LARGE):
        print(f"{name}: {found}", flush=True)


def _print_faults(names):
    """Print the faults of crafted files and of mutants ("FORMAT:COUNT"), each in its own copy, in little memory."""
    crafted = {**CRAFTED, **SLOWLY_CRAFTED, **LARGE}
    first_of_a_kind = {(suffix, read): kind for kind, (suffix, _, read) in reversed(FORMATS.items())}
    with TemporaryDirectory() as name_of_folder:
        folder = Path(name_of_folder)
        np.save(folder / "scan.npy", RELIEF)
        # What reading imports is not counted, and imported once.
        kinds = {name.rpartition(":")[0] or first_of_a_kind.get(crafted[name][::2]) for name in names}
        for kind in kinds - {None}:
            suffix, make, read = format_named(kind)
            path = folder / f"original{suffix}"
            write(path, make())
            read(path)
        gc.freeze()
        for name in names:
            kind, _, count = name.rpartition(":")
            if kind:
                action = functools.partial(_print_faults_of_mutants, kind, int(count), folder)
                _in_a_copy(name, 60 + int(count) / 2, action)
            else:
                suffix, make, read = crafted[name]
                path = folder / f"{name}{suffix}"
                if name in CRAFTED:
                    write(path, make())
                else:  # memory that a large file is made in would hide what reading it takes
                    _in_a_copy(f"making {name}", 60, lambda: write(path, make()))  # noqa: B023
                _in_a_copy(name, 60, functools.partial(_print_fault, name, read, path))
                path.unlink(missing_ok=True)


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    _print_faults(sys.argv[1:])
