"""Files to height fields: round trips of every format of the core, and one line for every misuse."""

import struct
import warnings
import zlib
from contextlib import nullcontext

import gwyfile
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from PIL import Image

from mitsuba_diffraction.files import reading
from mitsuba_diffraction.surface.readers import gwyddion, read_height_field

HEIGHTS = np.array([[0.0, 0.1, 0.25], [0.3, 0.2, 0.05]])
"""µm"""
GREY = np.array([[0, 51, 255], [102, 7, 30]], dtype=np.uint8)


@pytest.fixture
def refuse(tmp_path):
    """Check that a file is refused in one line that names it and holds the text given."""

    def check(name, text, pixel_size=0.1, height_range=None, **more):
        with pytest.raises(ValueError, match=text) as caught:
            read_height_field(tmp_path / name, pixel_size, height_range, **more)
        assert name in str(caught.value)
        assert "\n" not in str(caught.value)

    return check


def png(width, height, bits, colour, data):
    """A PNG file by hand, for the kinds that Pillow does not write."""

    def chunk(name, content):
        return struct.pack(">I", len(content)) + name + content + struct.pack(">I", zlib.crc32(name + content))

    header = struct.pack(">IIBBBBB", width, height, bits, colour, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(data)) + chunk(b"IEND", b"")


# ---------------------------------------------------------------- round trips


@pytest.mark.filterwarnings("ignore:.*is their unit right")  # of heights that are drawn almost equal
@settings(max_examples=25, deadline=None)
@given(
    heights=npst.arrays(
        st.sampled_from(["<f8", ">f8", "<f4"]),
        npst.array_shapes(min_dims=2, max_dims=2, max_side=6),
        elements=st.floats(-5, 5, width=32),
    ),
    fortran=st.booleans(),
)
def test_npy_keeps_the_heights(tmp_path_factory, heights, fortran):
    path = tmp_path_factory.mktemp("npy") / "scan.npy"
    np.save(path, np.asfortranarray(heights) if fortran else heights)
    field = read_height_field(path, pixel_size=(1, 2))
    np.testing.assert_array_equal(field.heights, heights)
    assert field.pixel_size == (1, 2)
    assert field.source == "scan.npy"


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
@pytest.mark.parametrize(
    ("own", "expected"), [(0.05, (0.05, 0.05)), ((0.05, 0.1), (0.05, 0.1)), ([0.05], (0.05, 0.05))]
)
def test_npz_provides_its_pixel_size(tmp_path, save, own, expected):
    save(tmp_path / "scan.npz", heights=HEIGHTS, pixel_size=own)
    field = read_height_field(tmp_path / "scan.npz")
    np.testing.assert_array_equal(field.heights, HEIGHTS)
    assert field.pixel_size == expected
    assert read_height_field(tmp_path / "scan.npz", pixel_size=0.3).pixel_size == (0.3, 0.3)


@pytest.mark.parametrize("extension", ["png", "tif", "tiff", "PNG"])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_grey_pictures_are_scaled_by_the_full_range(tmp_path, extension, dtype):
    path = tmp_path / f"scan.{extension}"
    grey = GREY.astype(dtype) * (257 if dtype == np.uint16 else 1)
    Image.fromarray(grey).save(path)
    field = read_height_field(str(path), pixel_size=0.0586, height_range=0.375)
    np.testing.assert_allclose(field.heights, GREY / 255 * 0.375, rtol=1e-15)


@pytest.mark.parametrize("mode", ["RGB", "RGBA", "LA"])
def test_colour_that_is_grey_and_opaque_is_read(tmp_path, mode):
    Image.fromarray(GREY).convert(mode).save(tmp_path / "scan.png")
    field = read_height_field(tmp_path / "scan.png", 0.1, 0.375)
    np.testing.assert_allclose(field.heights, GREY / 255 * 0.375)


@pytest.mark.parametrize("size", [(0.0833333, 0.0833333), (0.1, 0.25)])
def test_a_tiff_of_this_package_has_its_scale(tmp_path, refuse, size):
    """Its pixels per cm, and the height range in the description; another program's description is not trusted."""
    counts = np.array([[0, 65535], [13107, 1]], np.uint16)
    tags = {270: "ImageJ=1.54f\nheight_range_um=0.8\n", 282: 1e4 / size[0], 283: 1e4 / size[1], 296: 3}
    Image.fromarray(counts).save(tmp_path / "plate.tif", tiffinfo={**tags, 305: "mitsuba_diffraction output"})
    field = read_height_field(tmp_path / "plate.tif")
    assert field.pixel_size == pytest.approx(size, rel=1e-5)
    np.testing.assert_allclose(field.heights, [[0, 0.8], [0.16, 0.8 / 65535]])
    field = read_height_field(tmp_path / "plate.tif", 0.5, 1.6)
    assert field.pixel_size == (0.5, 0.5)
    assert np.ptp(field.heights) == 1.6
    Image.fromarray(counts).save(tmp_path / "other.tif", tiffinfo=tags)
    refuse("other.tif", "height_range: missing for uint16 heights", pixel_size=None)


@pytest.mark.parametrize(
    ("unit", "micrometres"),
    [("micron", 1), ("um", 1), ("µm", 1), ("\\u00B5m", 1), ("nm", 1e-3), ("mm", 1e3), ("cm", 1e4), ("inch", 25_400)],
)
def test_a_tiff_of_imagej_has_the_scale_of_its_description(tmp_path, unit, micrometres):
    x, y = 0.05 / micrometres, 0.1 / micrometres
    kind = {"inch": 2, "cm": 3}.get(unit, 1)
    tags = {270: f"ImageJ=1.54f\nunit={unit}\nmin=0.0\n".encode(), 282: 1 / x, 283: 1 / y, 296: kind}
    Image.fromarray(HEIGHTS.astype(np.float32)).save(tmp_path / "scan.tif", tiffinfo=tags)
    assert read_height_field(tmp_path / "scan.tif").pixel_size == pytest.approx((0.05, 0.1), rel=1e-5)
    assert read_height_field(tmp_path / "scan.tif", 0.2).pixel_size == (0.2, 0.2)


def test_a_tiff_that_another_program_wrote_as_imagej_has_its_scale(tmp_path):
    tifffile = pytest.importorskip("tifffile")
    heights = HEIGHTS.astype(np.float32)
    metadata = {"unit": "um"}
    tifffile.imwrite(tmp_path / "scan.tif", heights, imagej=True, resolution=(1 / 0.05, 1 / 0.1), metadata=metadata)
    field = read_height_field(tmp_path / "scan.tif")
    assert field.pixel_size == pytest.approx((0.05, 0.1), rel=1e-5)
    np.testing.assert_array_equal(field.heights, heights)


@pytest.mark.parametrize(("kind", "unit", "micrometres"), [(2, "inch", 25_400), (3, "cm", 1e4)])
@pytest.mark.parametrize("description", ["", "ImageJ=1.54f\nunit=pixel\n"])
def test_a_scale_in_the_tags_for_printers_is_taken_with_a_warning(tmp_path, kind, unit, micrometres, description):
    def save(x, y):
        tags = {270: description, 282: micrometres / x, 283: micrometres / y, 296: kind}
        Image.fromarray(HEIGHTS.astype(np.float32)).save(tmp_path / "scan.tif", tiffinfo=tags)

    save(0.05, 0.1)
    with pytest.warns(UserWarning, match=rf"pixels per {unit} may be meant for a printer: taken .*; pixel_size, in µm"):
        assert read_height_field(tmp_path / "scan.tif").pixel_size == pytest.approx((0.05, 0.1), rel=1e-5)
    assert read_height_field(tmp_path / "scan.tif", 0.2).pixel_size == (0.2, 0.2)
    for idle in (352.8, 1e-5, 25_400):  # 72 dpi, and what no scan has
        save(idle, idle)
        with pytest.raises(ValueError, match="pixel_size: the file has none"):
            read_height_field(tmp_path / "scan.tif")


def test_float_tiff_is_in_micrometres(tmp_path):
    Image.fromarray(HEIGHTS.astype(np.float32)).save(tmp_path / "scan.tif")
    field = read_height_field(tmp_path / "scan.tif", pixel_size=0.1)
    np.testing.assert_array_equal(field.heights, HEIGHTS.astype(np.float32))


@pytest.mark.parametrize("dtype", [np.int32, np.uint32, np.int64, np.uint64])
def test_integers_in_a_tiny_part_of_their_range_are_refused(tmp_path, refuse, dtype):
    np.save(tmp_path / "scan.npy", GREY.astype(dtype))
    refuse("scan.npy", f"got {np.dtype(dtype)} heights from 0 to 255, a tiny part", height_range=0.5)


@pytest.mark.parametrize("dtype", [np.uint8, np.int16, np.int32, np.uint64])
def test_integers_are_scaled_by_the_range_of_their_type(tmp_path, dtype):
    scale = np.iinfo(dtype)
    np.save(tmp_path / "scan.npy", np.array([[scale.min, scale.max]], dtype=dtype))
    np.testing.assert_allclose(read_height_field(tmp_path / "scan.npy", 0.1, 0.5).heights, [[0.0, 0.5]])


def test_the_top_row_of_a_picture_is_the_first_row(tmp_path):
    grey = np.zeros((4, 3), dtype=np.uint8)
    grey[0] = 255
    Image.fromarray(grey).save(tmp_path / "scan.png")
    np.testing.assert_array_equal(read_height_field(tmp_path / "scan.png", 0.1, 1.0).heights[:, 0], [1, 0, 0, 0])


# ---------------------------------------------------------------- missing pixels

HOLED = np.array([[0.1, np.nan, 0.3, 0.4], [0.1, 0.2, np.inf, 0.4]])
"""µm; the two pixels are 0.2 and 0.3 by interpolation."""


def write_holed(path):
    if path.suffix == ".npy":
        np.save(path, HOLED)
    elif path.suffix == ".npz":
        np.savez(path, heights=HOLED)
    else:
        Image.fromarray(HOLED.astype(np.float32)).save(path)


@pytest.mark.parametrize("name", ["scan.npy", "scan.npz", "scan.tif"])
def test_missing_pixels_are_filled_on_request(tmp_path, refuse, name):
    write_holed(tmp_path / name)
    refuse(name, r"2 of 8 pixels are missing .*row 0, column 1; .*fill_missing, which interpolates them")
    field = read_height_field(tmp_path / name, 0.1, fill_missing=True)
    np.testing.assert_allclose(field.heights, [[0.1, 0.2, 0.3, 0.4]] * 2, rtol=1e-6)
    assert (field.filled, field.source) == (2, f"{name} (2 missing pixels filled)")


def test_a_scan_without_a_height_is_refused_by_name(tmp_path):
    np.save(tmp_path / "scan.npy", np.full((2, 3), np.nan))
    with pytest.raises(ValueError, match=r"scan\.npy: heights: all 6 pixels are missing"):
        read_height_field(tmp_path / "scan.npy", 0.1, fill_missing=True)


# ---------------------------------------------------------------- misuse of the arguments


def test_a_missing_file_is_a_missing_file(tmp_path):
    with pytest.raises(FileNotFoundError):
        read_height_field(tmp_path / "none.npy", 0.1)


@pytest.mark.parametrize("name", ["scan.text", "scan", "scan.png.bak"])
def test_an_unknown_extension_is_refused_with_the_known_ones(tmp_path, refuse, name):
    (tmp_path / name).write_bytes(b"1 2 3")
    refuse(name, r"wanted one of \.npy, \.npz, \.png, \.tif, \.tiff.*TrueMap \.tmd and others")


@pytest.mark.parametrize("name", ["scan.npy", "scan.png", "scan.tif", "scan.gsf", "scan.gwy", "scan.asc", "grid.asc"])
def test_content_decides_where_the_extension_is_unknown(tmp_path, name):
    path = tmp_path / name
    if name == "scan.npy":
        np.save(path, HEIGHTS)
    elif name in ("scan.png", "scan.tif"):
        Image.fromarray(GREY).save(path)
    elif name == "scan.gwy":
        write_gwy(path, {0: ("Height", gwy_field())})
    elif name == "scan.gsf":
        write_gsf(path)
    elif name == "scan.asc":
        path.write_text("# Channel: Height\n# Width: 3 um\n# Height: 4 um\n# Value units: nm\n1 2 3\n4 5 6\n")
    else:
        path.write_text("ncols 2\nnrows 2\nxllcorner 0\nyllcorner 0\ncellsize 1\n1 2\n3 4\n")
    more = {"height_range": 1.0} if name in ("scan.png", "scan.tif") else {}
    more |= {"unit": "um"} if name == "grid.asc" else {"pixel_size": 0.1}
    wanted = read_height_field(path, **more)
    found = read_height_field(path.rename(tmp_path / "scan.dat"), **more)
    np.testing.assert_array_equal(found.heights, wanted.heights)
    assert found.pixel_size == wanted.pixel_size


@pytest.mark.parametrize("pixel_size", [None, 0.0, -1.0, np.nan, "wide", (1.0, 2.0, 3.0)])
def test_the_pixel_size_must_be_known_and_positive(tmp_path, refuse, pixel_size):
    np.save(tmp_path / "scan.npy", HEIGHTS)
    refuse("scan.npy", "pixel_size: ", pixel_size=pixel_size)


@pytest.mark.parametrize("height_range", [None, 0.0, -1.0, np.inf, "high", True])
@pytest.mark.parametrize("name", ["scan.npy", "scan.png"])
def test_integers_need_a_height_range(tmp_path, refuse, name, height_range):
    np.save(tmp_path / "scan.npy", GREY)
    Image.fromarray(GREY).save(tmp_path / "scan.png")
    refuse(name, "height_range: ", height_range=height_range)


@pytest.mark.parametrize("name", ["scan.npy", "scan.tif"])
def test_floats_refuse_a_height_range(tmp_path, refuse, name):
    np.save(tmp_path / "scan.npy", HEIGHTS)
    Image.fromarray(HEIGHTS.astype(np.float32)).save(tmp_path / "scan.tif")
    refuse(name, r"height_range: got 0\.5 for float.* in µm", height_range=0.5)


# ---------------------------------------------------------------- misuse of the numbers


@pytest.mark.parametrize(
    ("array", "text"),
    [
        (HEIGHTS * 1j, "type complex128"),
        (HEIGHTS > 0, "type bool"),
        (np.array([["a"]]), "type <U1"),
        (np.zeros((2, 2), dtype=[("h", float)]), "real floats"),
        (HEIGHTS[None], r"shape \(1, 2, 3\)"),
        (HEIGHTS[0], r"shape \(3,\)"),
        (np.zeros((0, 4)), r"shape \(0, 4\)"),
        (
            np.array([[1.0, np.nan], [np.inf, 0.0]]),
            "2 of 4 pixels are missing or not finite, the first at row 0, column 1",
        ),
    ],
)
def test_arrays_that_are_not_heights_are_refused(tmp_path, refuse, array, text):
    np.save(tmp_path / "scan.npy", array)
    np.savez(tmp_path / "scan.npz", heights=array)
    refuse("scan.npy", text)
    refuse("scan.npz", text)


def test_pickles_are_not_opened(tmp_path, refuse):
    class Trap:
        def __reduce__(self):
            return (pytest.fail, ("the reader executed a file",))

    np.save(tmp_path / "scan.npy", np.array([[Trap()]], dtype=object), allow_pickle=True)
    np.savez(tmp_path / "scan.npz", heights=np.array([[Trap()]], dtype=object))
    refuse("scan.npy", "allow_pickle=False")
    refuse("scan.npz", "allow_pickle=False")


def test_an_archive_must_hold_heights(tmp_path, refuse):
    np.savez(tmp_path / "scan.npz", surface=HEIGHTS)
    refuse("scan.npz", r"got the arrays \['surface'\], wanted 'heights'")


@pytest.mark.parametrize("own", ["0.1", [0.1, 0.2, 0.3], [[0.1]]])
def test_an_archive_must_hold_a_sound_pixel_size(tmp_path, refuse, own):
    np.savez(tmp_path / "scan.npz", heights=HEIGHTS, pixel_size=own)
    refuse("scan.npz", "pixel_size: got an array", pixel_size=None)


# ---------------------------------------------------------------- damaged files


@pytest.mark.parametrize("name", ["scan.npy", "scan.npz", "scan.png", "scan.tif"])
def test_empty_foreign_and_cut_files_are_refused(tmp_path, refuse, name):
    path = tmp_path / name
    noise = np.random.default_rng(0).integers(0, 256, (40, 40), dtype=np.uint8)
    if name == "scan.npy":
        np.save(path, noise)
    elif name == "scan.npz":
        np.savez_compressed(path, heights=noise)
    else:
        Image.fromarray(noise).save(path)
    whole = path.read_bytes()
    path.write_bytes(b"")
    refuse(name, "empty")
    path.write_bytes(b"this is not what the name says\n" * 9)
    refuse(name, "not a")
    for length in (1, 10, 60, len(whole) // 2):
        path.write_bytes(whole[:length])
        refuse(name, name, height_range=1.0)
    path.unlink()
    path.mkdir()
    refuse(name, name)


@given(name=st.sampled_from(["scan.npy", "scan.npz", "scan.png", "scan.tif"]), data=st.data())
def test_a_changed_byte_gives_heights_or_one_line(tmp_path_factory, name, data):
    path = tmp_path_factory.mktemp("changed") / name
    if name == "scan.npy":
        np.save(path, GREY)
    elif name == "scan.npz":
        np.savez_compressed(path, heights=GREY, pixel_size=0.1)
    else:
        Image.fromarray(GREY).save(path)
    content = bytearray(path.read_bytes())
    content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    path.write_bytes(content)
    try:
        message = ""
        assert np.isfinite(read_height_field(path, 0.1, 1.0).heights).all()
    except ValueError as error:
        message = str(error)
    assert not message or (name in message and "\n" not in message)


def test_several_pages_are_refused(tmp_path, refuse):
    page = Image.fromarray(GREY)
    page.save(tmp_path / "scan.tif", save_all=True, append_images=[page, page])
    refuse("scan.tif", "got 3 pages", height_range=1.0)
    page.save(tmp_path / "scan.png", save_all=True, append_images=[Image.fromarray(GREY[::-1])])
    refuse("scan.png", "got 2 pages", height_range=1.0)


@pytest.mark.parametrize("factor", [0.6, 3])
def test_a_picture_that_unpacks_to_too_much_is_refused(tmp_path, refuse, monkeypatch, factor):
    Image.fromarray(np.zeros((30, 30), dtype=np.uint8)).save(tmp_path / "scan.png")
    # Pillow warns above its limit and raises above twice that.
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", int(900 / (2 * factor)))
    refuse("scan.png", "too large", height_range=1.0)


@pytest.mark.parametrize("side", [10_000, 14_000, 65_535])  # Pillow warns of the first, and raises for the others
def test_a_header_that_claims_too_many_pixels_is_refused(tmp_path, refuse, side):
    """The tags of Park Systems are looked for before the picture is read."""
    Image.fromarray(GREY).save(tmp_path / "scan.tif", tiffinfo={256: side, 257: side})
    refuse("scan.tif", "too large, wanted at most 89478485 pixels: crop it, or export", height_range=1.0)


def test_an_archive_that_unpacks_to_too_much_is_refused(tmp_path, refuse, monkeypatch):
    np.savez_compressed(tmp_path / "scan.npz", heights=np.zeros((100, 100)))
    monkeypatch.setattr(reading, "MAX_SMALL_ARRAY_BYTES", 1000)
    refuse("scan.npz", "got 100 × 100 numbers in 0.. kB, wanted at most")


def test_coloured_annotation_on_a_grey_picture_is_missing(tmp_path, refuse):
    x = np.arange(60) / 60
    grey = np.round(100 + 80 * np.sin(2 * np.pi * 3 * x) * np.ones((50, 1))).astype(np.uint8)
    picture = np.repeat(grey[..., None], 3, axis=-1)
    picture[42:45, 5:25] = (255, 0, 0)
    Image.fromarray(picture).save(tmp_path / "bar.png")
    refuse("bar.png", r"2\.00% of the pixels are coloured, annotation .*fill_missing interpolates", height_range=1.0)
    kept = read_height_field(tmp_path / "bar.png", 0.1, 1.0, keep_missing=True)
    assert kept.gaps.sum() == kept.gaps[42:45, 5:25].sum() == 60
    filled = read_height_field(tmp_path / "bar.png", 0.1, 1.0, fill_missing=True)
    assert filled.filled == 60
    # The surroundings go on: no trench, and no wall, of the bar.
    np.testing.assert_allclose(filled.heights, grey / 255, atol=0.12)
    np.testing.assert_array_equal(filled.heights[:40], grey[:40] / 255)
    picture[20:40] = (0, 200, 30)
    Image.fromarray(picture).save(tmp_path / "bar.png")
    refuse("bar.png", "colour picture", height_range=1.0, fill_missing=True)


def test_colours_transparency_and_palettes_are_refused(tmp_path, refuse):
    colour = np.stack([GREY, GREY, GREY[::-1]], axis=-1)
    Image.fromarray(colour).save(tmp_path / "colour.png")
    refuse("colour.png", "colour picture", height_range=1.0)
    Image.fromarray(np.stack([GREY, GREY, GREY, GREY], axis=-1), "RGBA").save(tmp_path / "clear.png")
    refuse("clear.png", "transparent", height_range=1.0)
    Image.fromarray(GREY).convert("P").save(tmp_path / "palette.png")
    refuse("palette.png", "mode 'P'", height_range=1.0)
    Image.fromarray(GREY).save(tmp_path / "key.png", transparency=7)
    refuse("key.png", "wanted opaque grey", height_range=1.0)


def test_lost_precision_is_refused(tmp_path, refuse):
    # Pillow would halve the depth of these two, and take the next two for something else.
    (tmp_path / "rgb16.png").write_bytes(png(2, 1, 16, 2, b"\0" + b"\x12\x34" * 6))
    refuse("rgb16.png", "wanted opaque grey of 8 or 16 bit", height_range=1.0)
    (tmp_path / "la16.png").write_bytes(png(2, 1, 16, 4, b"\0" + b"\x12\x34" * 4))
    refuse("la16.png", "wanted opaque grey of 8 or 16 bit", height_range=1.0)
    Image.fromarray(GREY.astype(np.int32)).save(tmp_path / "int32.tif")
    refuse("int32.tif", "mode 'I'", height_range=1.0)
    Image.fromarray(GREY.astype(np.uint16)).save(tmp_path / "inverse.tif", tiffinfo={262: 0})
    refuse("inverse.tif", "black at zero", height_range=1.0)


# ---------------------------------------------------------------- Gwyddion: written by another program's library


def gwy_field(heights=HEIGHTS, xy="m", z="m", **more):
    size = {"xreal": 3e-6, "yreal": 4e-6} | more
    return gwyfile.objects.GwyDataField(np.asarray(heights) * 1e-6, si_unit_xy=xy, si_unit_z=z, **size)


def write_gwy(path, channels):
    """A file with these channels: number → (title, data field)."""
    container = gwyfile.objects.GwyContainer()
    # Not the whole path: how long it is would differ between the examples of a property.
    container["/filename"] = path.name
    container["/0/mask"] = gwy_field(np.ones_like(HEIGHTS))
    for number, (title, field) in channels.items():
        container[f"/{number}/data/title"] = title
        container[f"/{number}/data"] = field
        container[f"/{number}/data/visible"] = True
    container.tofile(str(path))


def component(name, kind, value):
    return name.encode() + b"\0" + kind.encode() + value


def gwy_bytes(inside, name=b"GwyContainer"):
    return b"GWYP" + name + b"\0" + struct.pack("<I", len(inside)) + inside


def test_gwy_provides_its_scale_and_the_top_row_is_the_first(tmp_path):
    write_gwy(tmp_path / "scan.gwy", {0: ("Height (measured)", gwy_field())})
    field = read_height_field(tmp_path / "scan.gwy")
    np.testing.assert_allclose(field.heights, HEIGHTS, rtol=1e-14)
    assert field.pixel_size == pytest.approx((1.0, 2.0))
    assert field.source == "scan.gwy, Height (measured)"
    assert read_height_field(tmp_path / "scan.gwy", pixel_size=0.5).pixel_size == (0.5, 0.5)


def write_field(path, heights, size, xy, z):
    """The same field as .gwy or .gsf; numbers as they stand in the file."""
    if path.suffix == ".gwy":
        size = {"xreal": size[0], "yreal": size[1]}
        field = gwyfile.objects.GwyDataField(np.asarray(heights), si_unit_xy=xy, si_unit_z=z, **size)
        container = gwyfile.objects.GwyContainer()
        container["/0/data"] = field
        container.tofile(str(path))
    else:
        sizes = f"XRes = 3\nYRes = 2\nXReal = {size[0]}\nYReal = {size[1]}\nXYUnits = {xy}\nZUnits = {z}\n"
        write_gsf(path, f"Gwyddion Simple Field 1.0\n{sizes}", heights)


@pytest.mark.parametrize("name", ["scan.gwy", "scan.gsf"])
@pytest.mark.parametrize("xy", ["m", "um", "nm"])
@pytest.mark.parametrize("z", ["m", "µm", "Å"])
def test_a_prefix_of_a_unit_of_gwyddion_is_no_factor(tmp_path, name, xy, z):
    write_field(tmp_path / name, HEIGHTS * 1e-6, (3e-6, 4e-6), xy, z)
    field = read_height_field(tmp_path / name)
    np.testing.assert_allclose(field.heights, HEIGHTS, rtol=1e-6)
    assert field.pixel_size == pytest.approx((1.0, 2.0))
    # Tilted by more than a scan can be high.
    write_field(tmp_path / name, HEIGHTS * 1e-5, (3e-5, 4e-5), xy, z)
    field = read_height_field(tmp_path / name, keep_missing=True)
    np.testing.assert_allclose(field.heights, HEIGHTS * 10, rtol=1e-6)


@pytest.mark.parametrize("name", ["scan.gwy", "scan.gsf"])
@pytest.mark.parametrize(("xy", "along"), [("um", 1.0), ("nm", 1e-3), ("m", 1e6)])
@pytest.mark.parametrize(("z", "high"), [("um", 1.0), ("nm", 1e-3), ("Å", 1e-4)])
def test_lengths_that_are_possible_only_in_the_prefixed_unit_are_taken_in_it(tmp_path, name, xy, along, z, high):
    write_field(tmp_path / name, HEIGHTS / high, (3 / along, 4 / along), xy, z)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        field = read_height_field(tmp_path / name)
    taken = [f"its lengths are taken in {xy}", f"its heights are taken in {z}"][xy == "m" :]
    for words, warning in zip(taken, caught, strict=True):
        assert words in str(warning.message)
    np.testing.assert_allclose(field.heights, HEIGHTS, rtol=1e-6)
    assert field.pixel_size == pytest.approx((1.0, 2.0))
    # Units and sizes that are given leave no doubt.
    assert read_height_field(tmp_path / name, 0.5, unit=("um", z)).height_range == pytest.approx(np.ptp(HEIGHTS))


def gwy_object(name, *components):
    inside = b"".join(components)
    return name.encode() + b"\0" + struct.pack("<I", len(inside)) + inside


def gwy_unit(unit):
    return gwy_object("GwySIUnit", component("unitstr", "s", unit + b"\0"))


def gwy_data(xy=b"m", z=b"m", scale=1e-6):
    return gwy_object(
        "GwyDataField",
        component("xres", "i", struct.pack("<i", 3)),
        component("yres", "i", struct.pack("<i", 2)),
        component("xreal", "d", struct.pack("<d", 3 * scale)),
        component("yreal", "d", struct.pack("<d", 4 * scale)),
        component("si_unit_xy", "o", gwy_unit(xy)),
        component("si_unit_z", "o", gwy_unit(z)),
        component("data", "D", struct.pack("<I6d", 6, *(scale * HEIGHTS).ravel())),
    )


@pytest.mark.parametrize("name", ["scan.gwy", "scan.1x"])
def test_gwy_of_version_1_is_read(tmp_path, refuse, name):
    """Components of its container are the number of a GLib type, a name and a value."""
    whole = b"GWYO" + gwy_object(
        "GwyContainer",
        struct.pack("<I", 20) + b"/0/show\0" + b"\1",
        struct.pack("<I", 60) + b"/0/base/min\0" + struct.pack("<d", 0.5),
        struct.pack("<I", 80) + b"/0/data\0" + gwy_data(),
        struct.pack("<I", 64) + b"/0/data/title\0" + b"Topography\0",
    )
    (tmp_path / name).write_bytes(whole)
    field = read_height_field(tmp_path / name)
    np.testing.assert_allclose(field.heights, HEIGHTS, rtol=1e-14)
    assert field.pixel_size == pytest.approx((1.0, 2.0))
    assert field.source == f"{name}, Topography"
    for length in range(4, len(whole)):
        (tmp_path / name).write_bytes(whole[:length])
        refuse(name, name)
    (tmp_path / name).write_bytes(b"GWYO" + gwy_object("GwyContainer", struct.pack("<I", 99) + b"/0/data\0"))
    refuse(name, "a component of the unknown type '99'")
    (tmp_path / name).write_bytes(b"GWYQ" + whole[4:])
    refuse(name, "save it as .gwy of Gwyddion 2")


def test_a_micro_sign_of_windows_is_read(tmp_path):
    unit = "µm".encode("latin-1")
    title = component("/0/data/title", "s", "Höhe\0".encode("latin-1"))
    data = component("/0/data", "o", gwy_data(unit, unit, 1.0))
    (tmp_path / "scan.gwy").write_bytes(gwy_bytes(data + title))
    with pytest.warns(UserWarning, match="taken in µm"):
        field = read_height_field(tmp_path / "scan.gwy")
    np.testing.assert_allclose(field.heights, HEIGHTS, rtol=1e-14)
    assert field.pixel_size == pytest.approx((1.0, 2.0))
    assert field.source == "scan.gwy, Höhe"
    header = GSF.replace("e-6", "").replace("= m", "= µm")
    write_gsf(tmp_path / "scan.gsf", header, HEIGHTS, "latin-1")
    with pytest.warns(UserWarning, match="taken in µm"):
        field = read_height_field(tmp_path / "scan.gsf")
    np.testing.assert_allclose(field.heights, HEIGHTS, rtol=1e-6)
    assert field.pixel_size == pytest.approx((1.0, 2.0))


def test_the_channel_is_that_of_the_heights_or_the_named_one(tmp_path, refuse):
    other = gwy_field(HEIGHTS * 2)
    channels = {0: ("Phase", gwy_field(z="deg")), 1: ("Amplitude", other), 2: ("ZSensor", gwy_field())}
    write_gwy(tmp_path / "scan.gwy", channels)
    assert read_height_field(tmp_path / "scan.gwy").source == "scan.gwy, ZSensor"
    for name in ("Amplitude", "amplitude", "ampl", 1, "1"):
        np.testing.assert_allclose(read_height_field(tmp_path / "scan.gwy", channel=name).heights, HEIGHTS * 2)
    refuse("scan.gwy", "0 'Phase' holds no lengths", channel="Phase")
    refuse(
        "scan.gwy", "channel: got 'Friction', wanted one of 0 'Phase', 1 'Amplitude', 2 'ZSensor'", channel="Friction"
    )
    refuse("scan.gwy", "wanted one of 0 'Phase', 1 'Amplitude'", channel="a")
    refuse("scan.gwy", "channel: got True", channel=True)
    write_gwy(tmp_path / "scan.gwy", {0: ("One", other), 1: ("Two", other)})
    refuse("scan.gwy", r"channel: which of 0 'One', 1 'Two'\?")
    write_gwy(tmp_path / "scan.gwy", {0: ("Phase", gwy_field(z="deg"))})
    refuse("scan.gwy", "wanted a channel of heights in a unit of length, got 0 'Phase'")
    np.save(tmp_path / "scan.npy", HEIGHTS)
    refuse("scan.npy", "channel: got 'Height' for .npy, which holds one only", channel="Height")


def test_a_missing_unit_is_refused(tmp_path, refuse):
    write_gwy(tmp_path / "scan.gwy", {0: ("Height", gwy_field(HEIGHTS * 1e6, xy=None, z=None, xreal=3.0, yreal=4.0))})
    refuse("scan.gwy", "unit: the file names none for the heights")
    field = read_height_field(tmp_path / "scan.gwy", unit=("um", "nm"))
    np.testing.assert_allclose(field.heights, HEIGHTS * 1e-3, rtol=1e-12)
    assert field.pixel_size == pytest.approx((1.0, 2.0))
    for wrong in ("V", ("m",), ("m", "m", "m"), 3):
        refuse("scan.gwy", "unit: ", unit=wrong)
    np.save(tmp_path / "scan.npy", HEIGHTS * 1e3)
    np.testing.assert_allclose(read_height_field(tmp_path / "scan.npy", 0.1, unit="nm").heights, HEIGHTS, rtol=1e-12)
    np.save(tmp_path / "scan.npy", np.uint8(HEIGHTS * 10))
    refuse("scan.npy", r"unit: got 'nm' for integers in \.npy, wanted it without", unit="nm", height_range=1.0)


@pytest.mark.parametrize(
    ("pixel", "scale", "fault"),
    [
        (1e-5, 1.0, r"pixel_size: got 1e-05 × 1e-05 µm, a field of .*, wanted pixels of 0\.0001 to 100 µm"),
        (250e3, 1.0, "pixel_size: got 2.5e[+]05"),
        (0.1, 1e-6, r"got heights of a range of 3e-07 µm, wanted 0\.0002 to 20 µm: is their unit right\? unit \("),
        (0.1, 1e6, "got heights of a range of 3e[+]05 µm"),
    ],
)
def test_a_scan_of_an_impossible_scale_is_named(tmp_path, refuse, pixel, scale, fault):
    # Regression: a picture in metres was a mirror, and pixels of a quarter of a metre were taken.
    heights = np.float32(HEIGHTS / np.ptp(HEIGHTS) * 0.3 * scale)
    Image.fromarray(heights).save(tmp_path / "scan.tif")
    np.save(tmp_path / "scan.npy", heights)
    for name in ("scan.tif", "scan.npy"):
        if fault.startswith("pixel_size"):
            refuse(name, fault, pixel_size=pixel)
        else:
            with pytest.warns(UserWarning, match=f"{name}: {fault}"):
                read_height_field(tmp_path / name, pixel)
    Image.fromarray(GREY).save(tmp_path / "scan.png")
    with pytest.warns(UserWarning, match=r"right\? height_range, in µm, sets another"):
        read_height_field(tmp_path / "scan.png", 0.1, height_range=100)
    if scale < 1:
        field = read_height_field(tmp_path / "scan.tif", pixel, unit=("um", "m"))
        assert field.height_range == pytest.approx(0.3, rel=1e-5)


DOUBLES = struct.pack("<I", 6) + np.zeros(6).tobytes()
GOOD = (
    component("xres", "i", struct.pack("<i", 3))
    + component("yres", "i", struct.pack("<i", 2))
    + component("xreal", "d", struct.pack("<d", 1))
    + component("yreal", "d", struct.pack("<d", 1))
    + component("data", "D", DOUBLES)
)


def in_field(inside):
    return gwy_bytes(component("/0/data", "o", b"GwyDataField\0" + struct.pack("<I", len(inside)) + inside))


@pytest.mark.parametrize(
    ("content", "text"),
    [
        (b"GWYX" + bytes(30), "not a Gwyddion file"),
        (b"GWYO" + bytes(30), "wanted a GwyContainer"),
        (b"GWYPGwyContainer", "text without an end"),
        (gwy_bytes(b"")[:-1], "truncated"),
        (gwy_bytes(b"", b"GwyGraph"), "wanted a GwyContainer"),
        (gwy_bytes(b""), "got none"),
        (gwy_bytes(component("a", "S", struct.pack("<I", 2**31 - 1) + b"x\0")), "text without an end"),
        (gwy_bytes(component("a", "O", struct.pack("<I", 2**31 - 1))), "text without an end"),
        (gwy_bytes(component("a", "D", struct.pack("<I", 2**32 - 1))), "truncated"),
        (gwy_bytes(component("a", "C", struct.pack("<I", 2**32 - 1))), "truncated"),
        (gwy_bytes(component("a", "z", b"")), "unknown type 'z'"),
        (gwy_bytes(component("a", "o", b"B\0" + struct.pack("<I", 99))), "truncated"),
        (gwy_bytes(b"\xff\xfe\0ix"), "truncated"),
        (in_field(GOOD.replace(b"xres\0i\x03", b"xres\0i\x04")), "4 × 2 pixels with 6 heights"),
        (in_field(GOOD.replace(b"xres\0i\x03\0\0\0", b"xres\0i\xff\xff\xff\xff")), "data field of -1 × 2"),
        (in_field(GOOD.replace(struct.pack("<d", 1), struct.pack("<d", np.nan))), "size"),
        (in_field(b""), "data field of None"),
    ],
)
def test_gwy_files_with_wrong_sizes_are_refused(tmp_path, refuse, content, text):
    (tmp_path / "scan.gwy").write_bytes(content)
    refuse("scan.gwy", text, unit="m")


def test_gwy_of_great_depth_or_many_parts_is_read_once_from_the_top(tmp_path, refuse, monkeypatch):
    """Objects that are not needed are skipped, and each component is read once."""
    deep = b""
    for _ in range(5000):
        deep = component("b", "o", b"A\0" + struct.pack("<I", len(deep)) + deep)
    many = b"".join(component(str(k), "i", bytes(4)) for k in range(100_000))
    (tmp_path / "scan.gwy").write_bytes(
        gwy_bytes(component("a", "o", b"A\0" + struct.pack("<I", len(deep)) + deep) + many)
    )
    values, read = [], gwyddion._Bytes._value
    monkeypatch.setattr(gwyddion._Bytes, "_value", lambda self, kind: (values.append(kind), read(self, kind))[1])
    refuse("scan.gwy", "got none")
    assert values == ["o", *100_000 * "i"]


@pytest.mark.parametrize(("pixel", "doubted"), [(39, True), (0.039, False), (3.9e-4, True), (0.39, False), (4, False)])
def test_a_pixel_size_that_heights_contradict_is_doubted_by_name(tmp_path, pixel, doubted):
    x = np.arange(64)
    heights = 0.1 * np.sin(2 * np.pi * x / 25) + 0.005 * (x[:, None] % 2)
    np.save(tmp_path / "scan.npy", heights)
    words = rf"pixel_size: got {pixel:.4g} × {pixel:.4g} µm .*: is it in µm\?"
    with pytest.warns(UserWarning, match=words) if doubted else nullcontext():
        read_height_field(tmp_path / "scan.npy", pixel)
    np.save(tmp_path / "scan.npy", 0 * heights)
    assert read_height_field(tmp_path / "scan.npy", pixel).height_range == 0


# ---------------------------------------------------------------- Gwyddion's simple field

GSF = "Gwyddion Simple Field 1.0\nXRes = 3\nYRes = 2\nXReal = 3e-6\nYReal = 4e-6\nXYUnits = m\nZUnits = m\nTitle = Z\n"


def write_gsf(path, header=GSF, heights=HEIGHTS * 1e-6, encoding="utf-8"):
    text = header.encode(encoding)
    path.write_bytes(text + bytes(4 - len(text) % 4) + np.asarray(heights, "<f4").tobytes())


@pytest.mark.parametrize("padding", range(4))
def test_gsf_is_read_at_every_padding(tmp_path, padding):
    write_gsf(tmp_path / "scan.gsf", GSF + f"Comment = {'x' * padding}\n")
    field = read_height_field(tmp_path / "scan.gsf")
    np.testing.assert_allclose(field.heights, HEIGHTS, rtol=1e-6)
    assert field.pixel_size == pytest.approx((1.0, 2.0))
    assert field.source == "scan.gsf, Z"


def test_gsf_without_a_scale_is_refused(tmp_path, refuse):
    write_gsf(tmp_path / "scan.gsf", "Gwyddion Simple Field 1.0\nXRes = 3\nYRes = 2\n", HEIGHTS * 1e3)
    refuse("scan.gsf", "unit: the file names none for the heights")
    refuse("scan.gsf", "pixel_size: the file has none", pixel_size=None, unit="nm")
    field = read_height_field(tmp_path / "scan.gsf", 0.1, unit="nm")
    np.testing.assert_allclose(field.heights, HEIGHTS, rtol=1e-6)


@pytest.mark.parametrize(
    ("old", "new", "text"),
    [
        ("1.0", "2.0", "not a Gwyddion Simple Field"),
        ("XRes = 3", "XRes = 4", "bytes, wanted"),
        ("XRes = 3", "XRes = 999999999", "wanted 8000000104"),
        ("XRes = 3", "XRes = -3", "XRes: got -3"),
        ("XRes = 3\n", "", "XRes: got none"),
        ("XReal = 3e-6", "XReal = wide", "XReal: got wide"),
        ("XReal = 3e-6", "XReal = -1", "XReal: got -1"),
        ("ZUnits = m", "ZUnits = V", "the heights: got the unit 'V'"),
        ("Title = Z", "Title", "wanted 'name = value'"),
    ],
)
def test_wrong_gsf_headers_are_refused(tmp_path, refuse, old, new, text):
    write_gsf(tmp_path / "scan.gsf", GSF.replace(old, new))
    refuse("scan.gsf", text)


# ---------------------------------------------------------------- text


def points(heights=HEIGHTS, d_x=0.1, d_y=0.2, order=None, digits=8):
    y, x = np.mgrid[: heights.shape[0], : heights.shape[1]]
    table = np.stack([5 + x.ravel() * d_x, -3 + y.ravel() * d_y, heights.ravel()], axis=1)
    table = table if order is None else table[order]
    return "\n".join(" ".join(f"{value:.{digits}g}" for value in line) for line in table) + "\n"


@pytest.mark.parametrize("delimiter", [" ", "\t", ", ", ";"])
def test_points_are_read_in_any_order(tmp_path, delimiter):
    text = "# made by hand\n" + points(order=[4, 2, 0, 1, 5, 3]).replace(" ", delimiter)
    (tmp_path / "scan.xyz").write_text(text)
    field = read_height_field(tmp_path / "scan.xyz", unit="um")
    np.testing.assert_allclose(field.heights, HEIGHTS)
    assert field.pixel_size == pytest.approx((0.1, 0.2))
    # Along the surface in micrometres, the heights in nanometres.
    np.testing.assert_allclose(read_height_field(tmp_path / "scan.xyz", unit=("um", "nm")).heights, HEIGHTS * 1e-3)


def test_points_with_rounded_coordinates_are_read(tmp_path):
    heights = np.random.default_rng(0).random((40, 50))
    (tmp_path / "scan.xyz").write_text(points(heights, 0.0123, 0.0234, digits=4))
    field = read_height_field(tmp_path / "scan.xyz", unit="um")
    np.testing.assert_allclose(field.heights, heights, rtol=1e-3)
    assert field.pixel_size == pytest.approx((0.0123, 0.0234), rel=1e-3)


def test_absent_points_are_missing_pixels(tmp_path, refuse):
    (tmp_path / "scan.xyz").write_text(points(order=[0, 2, 3, 4, 5]))
    refuse("scan.xyz", "1 of 6 pixels are missing or not finite, the first at row 0, column 1", unit="um")
    assert read_height_field(tmp_path / "scan.xyz", unit="um", keep_missing=True).gaps.sum() == 1


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1 2\n3 4\n", "got 2 numbers in a line, wanted three"),
        ("0 0 1\n0 1\n", "not a table of numbers"),
        ("0 0 1\nNo Data\n", "not a table of numbers"),
        ("# nothing\n", "holds no numbers"),
        ("0 0 1\n0 0 2\n1 0 1\n1 1 1", "two points at one position"),
        ("0 0 1\n1 0 2\n1.4 1 1\n3 1 1", "regular grid"),
        ("0 nan 1\n1 0 2\n", "without x or y"),
        (" ".join(map(str, [0, 0, 1])) + "\n100 100 1\n1 1 1\n2 2 1\n", "wanted a regular grid"),
        ("0 0 1\0", "zero bytes"),
        ("0 0 1,5,2\n", "not a table of numbers"),
    ],
)
def test_points_that_are_no_grid_are_refused(tmp_path, refuse, text, message):
    (tmp_path / "scan.xyz").write_text(text)
    refuse("scan.xyz", message, unit="um")


def test_points_need_a_unit_and_a_line_a_pixel_size(tmp_path, refuse):
    (tmp_path / "scan.xyz").write_text(points())
    refuse("scan.xyz", "unit: the file names none for its lengths")
    (tmp_path / "scan.xyz").write_text(points(HEIGHTS[:1]))
    refuse("scan.xyz", "pixel_size: the file has none", pixel_size=None, unit="um")
    assert read_height_field(tmp_path / "scan.xyz", (0.1, 1.0), unit="um").shape == (1, 3)


MATRIX = "\n".join("\t".join(str(h * 1e-6) for h in row) for row in HEIGHTS)


@pytest.mark.parametrize("encoding", ["utf-8", "latin-1"])
def test_a_table_exported_by_gwyddion_is_read(tmp_path, encoding):
    header = "# Channel: Height (forward)\n# Width: 0.300 µm\n# Height: 400 nm\n# Value units: m\n"
    (tmp_path / "scan.asc").write_bytes((header + MATRIX).encode(encoding))
    field = read_height_field(tmp_path / "scan.asc")
    np.testing.assert_allclose(field.heights, HEIGHTS)
    assert field.pixel_size == pytest.approx((0.1, 0.2))
    assert field.source == "scan.asc, Height (forward)"


def test_lengths_of_a_header_without_a_unit_are_in_the_given_one(tmp_path):
    (tmp_path / "scan.asc").write_text("# Width: 50\n# Height: 2.50\n1 2 3 4 5\n")
    assert read_height_field(tmp_path / "scan.asc", unit="nm").pixel_size == pytest.approx((0.01, 0.0025))


@pytest.mark.parametrize("width", ["a" + " " * 200_000 + "b", "1" * 200_000 + " x y"])
def test_a_header_line_of_any_length_is_read(tmp_path, refuse, width):
    # In steps that grow with the square of the length, this would take hours.
    (tmp_path / "scan.asc").write_text(f"# Width: {width}\n# Height: 1 m\n1 2\n")
    refuse("scan.asc", "the header: got", unit="m")


def test_a_table_without_a_scale_is_refused(tmp_path, refuse):
    (tmp_path / "scan.asc").write_text(MATRIX)
    refuse("scan.asc", "unit: the file names none")
    refuse("scan.asc", "pixel_size: the file has none", pixel_size=None, unit="m")
    np.testing.assert_allclose(read_height_field(tmp_path / "scan.asc", 0.1, unit="m").heights, HEIGHTS)


def test_a_table_that_may_be_points_is_refused(tmp_path, refuse):
    (tmp_path / "scan.asc").write_text(points())
    refuse("scan.asc", "wanted the extension .xyz", unit="um")


@pytest.mark.parametrize(("name", "mark"), [("scan.csv", ","), ("scan.csv", ";"), ("scan.txt", "\t")])
def test_numbers_of_a_csv_are_read(tmp_path, refuse, name, mark):
    path = tmp_path / name
    path.write_text("\n".join(mark.join(str(h) for h in row) for row in HEIGHTS))
    np.testing.assert_allclose(read_height_field(path, 0.1, unit="um").heights, HEIGHTS)
    refuse(name, "pixel_size: the file has none", pixel_size=None, unit="um")
    refuse(name, "unit: the file names none")
    lines = points(digits=8).replace(" ", mark)
    for names in ("", f"x{mark}y{mark}height\n", f'"X"{mark}"Y"{mark}"Z (a. u.)"\n'):
        path.write_text(names + lines)
        field = read_height_field(path, unit="um")
        np.testing.assert_allclose(field.heights, HEIGHTS)
        assert field.pixel_size == pytest.approx((0.1, 0.2))
        refuse(name, "unit: the file names none for its lengths")
    path.write_text(f"x [um]{mark}y [um]{mark}Height (nm)\n" + lines)
    field = read_height_field(path)
    np.testing.assert_allclose(field.heights, 1e-3 * HEIGHTS)
    assert field.pixel_size == pytest.approx((0.1, 0.2))
    path.write_text(f"x [V]{mark}y [V]{mark}z [V]\n" + lines)
    refuse(name, "its lengths: got the unit 'V'")


@pytest.mark.parametrize("name", ["scan.csv", "scan.txt", "scan.xyz", "scan.asc"])
@pytest.mark.parametrize("mark", [",", ";", "\t", " "])
def test_a_line_of_names_is_skipped_in_every_text(tmp_path, name, mark):
    path = tmp_path / name
    if name != "scan.asc":
        lines = points(digits=8).replace(" ", mark)
        for names in ("x y z", "X Y Information"):
            path.write_text(f"{names.replace(' ', mark)}\n{lines}")
            np.testing.assert_allclose(read_height_field(path, unit="um").heights, HEIGHTS)
        path.write_text(f"x [um]{mark}y [um]{mark}nanometres (nm)\n{lines}")
        np.testing.assert_allclose(read_height_field(path).heights, 1e-3 * HEIGHTS)
    if name != "scan.xyz":
        lines = "\n".join(mark.join(str(h) for h in [*row, 0.1]) for row in HEIGHTS)
        path.write_text(f"heights [nm]\n{lines}")
        np.testing.assert_allclose(read_height_field(path, 0.1).heights[:, :3], 1e-3 * HEIGHTS)


@pytest.mark.parametrize("mark", [",", ";", "\t", " \t "])
@pytest.mark.parametrize("comma", [False, True])
def test_empty_cells_are_missing(tmp_path, refuse, mark, comma):
    heights = np.random.default_rng(0).uniform(0.1, 0.4, (4, 5))
    heights[1, 1:3], heights[0, 4], heights[2, 0], heights[3] = np.nan, np.nan, np.nan, [0, np.nan, 0.5, np.nan, 1]
    cells = [["" if np.isnan(h) else f"{h:.6g}" for h in row] for row in heights]
    text = "\n".join(mark.join(row) for row in cells)
    if comma and mark == ",":
        return
    text = text.replace(".", ",") if comma else text
    empty = mark * 4
    for more in (text, f"{text}\n{empty}\n", text.replace("\n", f"{mark}\n") + mark):  # an empty line, or column
        (tmp_path / "scan.csv").write_text(more)
        found = read_height_field(tmp_path / "scan.csv", 0.1, unit="um", keep_missing=True).heights
        np.testing.assert_allclose(found, heights, rtol=1e-5)
    refuse("scan.csv", "6 of 20 pixels are missing", unit="um")
    lines = points(digits=6).replace(" ", mark).splitlines()
    (tmp_path / "scan.xyz").write_text("\n".join([*lines[:-1], lines[-1].rpartition(mark)[0] + mark]))
    found = read_height_field(tmp_path / "scan.xyz", unit="um", keep_missing=True).heights
    assert np.isnan(found).sum() == 1


def test_cells_that_are_no_pixels_are_not_missing(tmp_path, refuse):
    (tmp_path / "scan.txt").write_text("0.1\t\t0.2\n0.3\t\t0.4\n")  # tabs that align
    np.testing.assert_array_equal(
        read_height_field(tmp_path / "scan.txt", 0.1, unit="um").heights, [[0.1, 0.2], [0.3, 0.4]]
    )
    (tmp_path / "scan.csv").write_text(",0,0.1,0.2\n0,1,2,3\n0.1,4,5,7\n0.2,1,1,2\n")
    refuse("scan.csv", "the first line and column may be coordinates", unit="um")
    for text in ("1,,2\n3,four,5\n", ",\n", " ;\n;\n", "\t;", "x,y,z\n,,\n"):
        (tmp_path / "scan.csv").write_text(text)
        refuse("scan.csv", "not a table of numbers", unit="um")


@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-le", "utf-16-be", "utf-8-sig"])
def test_a_text_of_windows_with_a_byte_order_mark_is_read(tmp_path, encoding):
    header = "# Channel: Höhe\n# Width: 0.300 µm\n# Height: 400 nm\n# Value units: m\n"
    for name, text in {"scan.csv": points(digits=8), "scan.xyz": points(digits=8), "export": header + MATRIX}.items():
        mark = "" if encoding in ("utf-16", "utf-8-sig") else "\ufeff"
        (tmp_path / name).write_bytes((mark + text).replace("\n", "\r\n").encode(encoding))
        field = read_height_field(tmp_path / name, unit=None if name == "export" else "um")
        np.testing.assert_allclose(field.heights, HEIGHTS)
        assert field.pixel_size == pytest.approx((0.1, 0.2))


def test_a_table_of_whole_decimal_commas_is_read_as_csv(tmp_path):
    (tmp_path / "scan.csv").write_text("\n".join(";".join(str(h).replace(".", ",") for h in row) for row in HEIGHTS))
    np.testing.assert_allclose(read_height_field(tmp_path / "scan.csv", 0.1, unit="um").heights, HEIGHTS)


ESRI = "ncols 3\nnrows 2\nxllcorner 10\nyllcorner 20\ncellsize 0.1\nNODATA_value -9999\n"


def test_an_esri_grid_is_read_from_the_top_down(tmp_path, refuse):
    (tmp_path / "scan.asc").write_text(ESRI + "1 2 3\n4 -9999 6\n")
    field = read_height_field(tmp_path / "scan.asc", unit=("um", "nm"), keep_missing=True)
    np.testing.assert_allclose(field.heights, np.array([[4, np.nan, 6], [1, 2, 3]]) * 1e-3)
    assert field.pixel_size == pytest.approx((0.1, 0.1))
    refuse("scan.asc", "unit: the file names none for its lengths")
    (tmp_path / "scan.asc").write_text(ESRI + "1 2 3\n")
    refuse("scan.asc", "got 1 lines of 3, wanted 2 of 3", unit="um")
    (tmp_path / "scan.asc").write_text("ncols 3\nnrows\n1 2 3\n")
    refuse("scan.asc", "the header: got the line 'nrows'", unit="um")
    (tmp_path / "scan.asc").write_text("ncols 3\nnrows 1\n1 2 3\n")
    refuse("scan.asc", "wanted ncols, nrows and cellsize", unit="um")


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("scan.xyz", "1e308 0 1\n-1e308 0 2\n", "x goes from -1e\\+308 to 1e\\+308"),
        ("scan.xyz", "0 0 1e308\n1 0 1\n", "1 of 2 pixels are missing or not finite"),
        ("scan.asc", "# Value units: m\n1e308 2\n", "1 of 2 pixels are missing or not finite"),
        ("scan.asc", "1e308 0 1\n-1e308 0 2\n0 0 1\n", "2 of 9 pixels are missing or not finite"),
        ("scan.asc", "0 inf 1\n1 nan 2\n", "2 of 6 pixels are missing or not finite"),
    ],
)
def test_numbers_outside_the_range_of_a_float_are_refused_in_one_line(tmp_path, refuse, name, text, message):
    (tmp_path / name).write_text(text)
    refuse(name, message, unit="m")


def test_signalling_numbers_are_missing_pixels(tmp_path, refuse):
    """A bit pattern that complains when it is turned into a double."""
    write_gsf(tmp_path / "scan.gsf")
    content = (tmp_path / "scan.gsf").read_bytes()
    (tmp_path / "scan.gsf").write_bytes(content[:-4] + b"\x01\x00\x80\x7f")
    refuse("scan.gsf", "1 of 6 pixels are missing or not finite")


# ---------------------------------------------------------------- damaged files of these formats


def write_each(path):
    if path.suffix == ".gwy":
        write_gwy(path, {0: ("Height", gwy_field())})
    elif path.suffix == ".gsf":
        write_gsf(path)
    elif path.suffix == ".xyz":
        path.write_text(points())
    elif path.suffix == ".csv":
        path.write_text("x [um],y [um],z [nm]\n" + points().replace(" ", ","))
    else:
        path.write_text(ESRI + "1 2 3\n4 5 6\n")


@pytest.mark.not_quick
@pytest.mark.parametrize("name", ["scan.gwy", "scan.gsf"])
def test_every_cut_of_a_binary_file_is_refused(tmp_path, refuse, name):
    write_each(tmp_path / name)
    whole = (tmp_path / name).read_bytes()
    for length in range(len(whole)):
        (tmp_path / name).write_bytes(whole[:length])
        refuse(name, name, unit="m")


@given(name=st.sampled_from(["scan.gwy", "scan.gsf", "scan.xyz", "scan.asc", "scan.csv"]), data=st.data())
def test_changed_bytes_give_heights_or_one_line(tmp_path_factory, name, data):
    path = tmp_path_factory.mktemp("changed") / name
    write_each(path)
    content = bytearray(path.read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    path.write_bytes(content)
    try:
        message = ""
        assert np.isfinite(read_height_field(path, 0.1, unit="um").heights).all()
    except (ValueError, UserWarning) as error:  # a warning of heights that cannot be right
        message = str(error)
    assert not message or (name in message and "\n" not in message)
