"""Files to height fields: round trips of every format, and every misuse told in one line."""

import struct
import zlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from PIL import Image

from mitsuba_diffraction.readers import read_height_field

HEIGHTS = np.array([[0.0, 0.1, 0.25], [0.3, 0.2, 0.05]])
"""µm"""
GREY = np.array([[0, 51, 255], [102, 7, 30]], dtype=np.uint8)


@pytest.fixture
def refuse(tmp_path):
    """Check that a file is refused in one line that names it and holds the text given."""

    def check(name, text, pixel_size=0.1, height_range=None):
        with pytest.raises(ValueError, match=text) as caught:
            read_height_field(tmp_path / name, pixel_size, height_range)
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
    field = read_height_field(path, pixel_size=(0.1, 0.2))
    np.testing.assert_array_equal(field.heights, heights)
    assert field.pixel_size == (0.1, 0.2)
    assert field.source == "scan.npy"


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
@pytest.mark.parametrize(
    ("own", "expected"), [(0.05, (0.05, 0.05)), ((0.05, 0.1), (0.05, 0.1)), ([0.05], (0.05, 0.05))]
)
def test_npz_brings_its_pixel_size(tmp_path, save, own, expected):
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


def test_float_tiff_is_in_micrometres(tmp_path):
    Image.fromarray(HEIGHTS.astype(np.float32)).save(tmp_path / "scan.tif")
    field = read_height_field(tmp_path / "scan.tif", pixel_size=0.1)
    np.testing.assert_array_equal(field.heights, HEIGHTS.astype(np.float32))


@pytest.mark.parametrize("dtype", [np.uint8, np.int16, np.int32, np.uint64])
def test_integers_run_over_the_range_of_their_type(tmp_path, dtype):
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
    refuse(name, r"2 of 8 pixels are missing .*row 0, column 1; .*--fill-missing, fills them")
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


@pytest.mark.parametrize("name", ["scan.txt", "scan", "scan.png.bak"])
def test_an_unknown_extension_is_answered_with_the_known_ones(tmp_path, refuse, name):
    (tmp_path / name).write_bytes(b"1 2 3")
    refuse(name, r"wanted one of \.npy, \.npz, \.png, \.tif, \.tiff")


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
def test_what_are_not_heights_is_refused(tmp_path, refuse, array, text):
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


@settings(max_examples=150, deadline=None)
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


def test_an_archive_that_unpacks_to_too_much_is_refused(tmp_path, refuse, monkeypatch):
    np.savez_compressed(tmp_path / "scan.npz", heights=np.zeros((100, 100)))
    monkeypatch.setattr("mitsuba_diffraction.readers._MOST_BYTES", 1000)
    refuse("scan.npz", "wanted at most 1000")


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


def test_precision_is_never_lost_in_silence(tmp_path, refuse):
    # Pillow would halve the depth of these two, and take the next two for something else.
    (tmp_path / "rgb16.png").write_bytes(png(2, 1, 16, 2, b"\0" + b"\x12\x34" * 6))
    refuse("rgb16.png", "wanted opaque grey of 8 or 16 bit", height_range=1.0)
    (tmp_path / "la16.png").write_bytes(png(2, 1, 16, 4, b"\0" + b"\x12\x34" * 4))
    refuse("la16.png", "wanted opaque grey of 8 or 16 bit", height_range=1.0)
    Image.fromarray(GREY.astype(np.int32)).save(tmp_path / "int32.tif")
    refuse("int32.tif", "mode 'I'", height_range=1.0)
    Image.fromarray(GREY.astype(np.uint16)).save(tmp_path / "inverse.tif", tiffinfo={262: 0})
    refuse("inverse.tif", "black at zero", height_range=1.0)
