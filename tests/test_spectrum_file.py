"""The file of a spectrum, read by OpenEXR itself; what is refused; and that a save is whole or not there."""

import contextlib
import dataclasses
import resource

import numpy as np
import OpenEXR
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import mitsuba_diffraction as md
from mitsuba_diffraction import GratingSpectrum
from mitsuba_diffraction.spectrum.slice_table import SliceTable

SHAPES = [(1, 1), (1, 8), (7, 1), (5, 5), (4, 6)]
NUMBERS = ("height_range", "coherence_length", "wavelengths", "tolerance", "error", "pixel_size")


def make(representation="slices", shape=(4, 7), depth=0.2, source="by hand", **arguments):
    heights = np.random.default_rng(5).random(shape) * depth
    return md.precompute(md.HeightField(heights, (0.07, 0.0585), source), representation=representation, **arguments)


def table_of(spectrum):
    return spectrum.table.coefficients if spectrum.representation == "taylor" else spectrum.table.values


@pytest.fixture(params=["taylor", "slices"])
def saved(request, tmp_path):
    spectrum = make(request.param)
    spectrum.save(tmp_path / "saved.exr")
    return spectrum, tmp_path / "saved.exr"


def contents(path):
    """Header and pixels of an OpenEXR file, as copies."""
    file = OpenEXR.File(str(path), separate_channels=True)
    header = {name: value for name, value in file.header().items() if name != "channels"}
    return header, {name: np.array(channel.pixels) for name, channel in file.channels().items()}


def rewrite(path, header=(), channels=(), drop=()):
    """The file at `path` with other entries of the header or other channels."""
    entries, pixels = contents(path)
    entries.update(header)
    pixels.update(channels)
    for name in drop:
        entries.pop(name, None)
        pixels.pop(name, None)
    OpenEXR.File(entries, pixels).write(str(path))


# ---------------------------------------------------------------- what is in the file


@settings(max_examples=25)
@given(
    representation=st.sampled_from(["taylor", "slices"]),
    shape=st.sampled_from(SHAPES),
    depth=st.sampled_from([0.0, 0.05, 0.3]),
    coherence_length=st.floats(1.0, 1000.0),
    shortest=st.floats(360.0, 500.0),
    source=st.sampled_from(["", "scan.png", "gräben [µm]", "two\nlines", "x" * 400]),
)
def test_a_spectrum_comes_back_bit_for_bit(
    tmp_path_factory, representation, shape, depth, coherence_length, shortest, source
):
    path = tmp_path_factory.mktemp("round") / "trip.exr"
    spectrum = make(
        representation, shape, depth, source, coherence_length=coherence_length, wavelengths=(shortest, 830)
    )
    spectrum.save(path)
    back = GratingSpectrum.load(path)
    for name in (*NUMBERS, "source", "source_digest", "extent", "representation", "grid", "largest_kappa"):
        assert getattr(back, name) == getattr(spectrum, name), name
    assert table_of(back).dtype == table_of(spectrum).dtype
    np.testing.assert_array_equal(table_of(back), table_of(spectrum))
    q = np.random.default_rng(1).uniform(-2, 2, (5, 2))
    np.testing.assert_array_equal(back.evaluate(q, 9.0), spectrum.evaluate(q, 9.0))
    np.testing.assert_array_equal(back.powers(25.0), spectrum.powers(25.0))


def test_the_header_names_all_that_a_reader_needs(saved):
    spectrum, path = saved
    header = OpenEXR.File(str(path), separate_channels=True).header()
    numbers = {
        "pixelSize": spectrum.pixel_size,
        "tileSize": (7 * 0.07, 4 * 0.0585),
        "coherenceLength": (65.0,),
        "heightRange": (spectrum.height_range,),
        "wavelengths": (360.0, 830.0),
        "error": (spectrum.error,),
        "tolerance": (1e-3,),
    }
    for name, value in numbers.items():
        assert header[name].dtype == np.float64, name
        assert tuple(header[name]) == value, name
    assert header["representation"] == spectrum.representation
    assert header["source"] == "by hand"
    heights = np.random.default_rng(5).random((4, 7)) * 0.2
    assert header["sourceSha256"] == md.HeightField(heights, (0.07, 0.0585)).digest
    assert isinstance(header["formatVersion"], int)
    assert header["compression"] == OpenEXR.ZIP_COMPRESSION
    assert header["type"] == OpenEXR.scanlineimage


def test_channels_are_float32_and_named_after_what_they_hold(saved):
    spectrum, path = saved
    file = OpenEXR.File(str(path), separate_channels=True)
    assert len(file.parts) == 1
    pixels = {name: channel.pixels for name, channel in file.channels().items()}
    assert {values.dtype for values in pixels.values()} == {np.dtype(np.float32)}
    if spectrum.representation == "taylor":
        assert len(pixels) == 2 * spectrum.table.series.terms
        # By the definition of the channel: the mean of the third power of the scaled heights is its order zero.
        heights = np.random.default_rng(5).random((4, 7)) * 0.2
        middle, half = (heights.max() + heights.min()) / 2, np.ptp(heights) / 2
        rows, columns = pixels["F{(h/H)^003}.re"].shape
        got = pixels["F{(h/H)^003}.re"][rows // 2, columns // 2]
        assert got == pytest.approx((((heights - middle) / half) ** 3).mean(), abs=1e-7)
        assert pixels["F{(h/H)^003}.im"][rows // 2, columns // 2] == pytest.approx(0, abs=1e-7)
    else:
        assert len(pixels) == 4 * spectrum.table.intervals
        np.testing.assert_array_equal(pixels["eta(001.2)"], spectrum.table.values[1, 2])


def test_more_than_a_thousand_intervals_keep_their_order(tmp_path):
    powers = np.random.default_rng(2).random((1003, 4, 1, 3)).astype(np.float32)
    spectrum = make(shape=(1, 3))
    spectrum = dataclasses.replace(spectrum, table=SliceTable(spectrum.largest_kappa, powers))
    spectrum.save(tmp_path / "deep.exr")
    np.testing.assert_array_equal(GratingSpectrum.load(tmp_path / "deep.exr").table.values, powers)


# ---------------------------------------------------------------- what is refused


def refusal(path, kind=ValueError):
    with pytest.raises(kind) as caught:
        GratingSpectrum.load(path)
    message = str(caught.value)
    assert path.name in message
    assert "\n" not in message
    return message


def test_another_version_is_refused(saved):
    rewrite(saved[1], {"formatVersion": 2})
    assert "version 2" in refusal(saved[1])


def test_an_unknown_representation_is_refused(saved):
    rewrite(saved[1], {"representation": "wavelets"})
    assert "'wavelets'" in refusal(saved[1])


def test_an_unknown_extent_is_refused(saved):
    rewrite(saved[1], {"extent": "ribbon"})
    assert "ribbon" in refusal(saved[1])


def test_a_picture_is_refused(tmp_path):
    path = tmp_path / "picture.exr"
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, {"RGB": np.zeros((4, 4, 3), np.float32)}).write(str(path))
    assert "not a grating spectrum" in refusal(path)


@pytest.mark.parametrize(
    "name",
    [
        *("format", "formatVersion", "representation", "extent", "heightRange", "pixelSize", "tileSize"),
        *("coherenceLength", "wavelengths", "tolerance", "error", "source", "sourceSha256"),
    ],
)
def test_a_missing_entry_of_the_header_is_refused(saved, name):
    rewrite(saved[1], drop=[name])
    refusal(saved[1])


@pytest.mark.parametrize("which", [0, 3, -1])
def test_a_missing_channel_is_refused(saved, which):
    name = sorted(contents(saved[1])[1])[which]
    rewrite(saved[1], drop=[name])
    refusal(saved[1])


def test_a_channel_that_is_not_known_is_refused(saved):
    pixels = contents(saved[1])[1]
    rewrite(saved[1], channels={"alpha": next(iter(pixels.values()))})
    assert "alpha" in refusal(saved[1])


def test_half_precision_is_refused(saved):
    pixels = contents(saved[1])[1]
    rewrite(saved[1], channels={name: values.astype(np.float16) for name, values in pixels.items()})
    refusal(saved[1])


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("heightRange", np.array([np.nan])),
        ("heightRange", np.array([-1.0])),
        ("pixelSize", np.array([0.0, -1.0])),
        ("pixelSize", np.array([0.1, 0.1, 0.1])),
        ("tileSize", np.array([np.nan, 1.0])),
        ("coherenceLength", np.array([0.0])),
        ("coherenceLength", "65"),
        ("wavelengths", np.array([360.0])),
        ("wavelengths", np.array([830.0, 360.0])),
        ("tolerance", np.array([0.0])),
        ("error", np.array([np.nan])),
        ("source", 3),
    ],
)
def test_numbers_that_cannot_be_are_refused(saved, name, value):
    rewrite(saved[1], {name: value})
    refusal(saved[1])


def test_pixels_that_are_not_numbers_are_refused(saved):
    name, values = next(iter(contents(saved[1])[1].items()))
    values[0, 0] = np.nan
    rewrite(saved[1], channels={name: values})
    refusal(saved[1])


@pytest.mark.parametrize("left", [0, 3, 100, 0.5, 0.9, -3])
def test_a_file_cut_short_is_refused_without_noise(saved, left, capfd):
    content = saved[1].read_bytes()
    saved[1].write_bytes(content[: int(left * len(content)) if 0 < left < 1 else left])
    refusal(saved[1])
    # The message is all that a person sees: the library's own lines would stand above it.
    assert capfd.readouterr() == ("", "")


def test_bytes_gone_bad_are_refused_or_harmless(saved):
    content = bytearray(saved[1].read_bytes())
    rng = np.random.default_rng(4)
    for _ in range(40):
        damaged = content.copy()
        damaged[rng.integers(len(content))] ^= 1 << rng.integers(8)
        saved[1].write_bytes(damaged)
        with contextlib.suppress(ValueError):
            GratingSpectrum.load(saved[1])


def test_text_is_refused(tmp_path):
    path = tmp_path / "text.exr"
    path.write_text("not a picture")
    assert "not a readable OpenEXR file" in refusal(path)


def test_a_folder_and_nothing_are_refused(tmp_path):
    folder = tmp_path / "folder.exr"
    folder.mkdir()
    refusal(folder, (ValueError, OSError))
    assert "no such file" in refusal(tmp_path / "nothing.exr", FileNotFoundError)


# ---------------------------------------------------------------- whole or not at all


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_a_save_that_fails_leaves_the_old_file(saved, monkeypatch, error):
    class Broken:
        def __init__(self, header, channels):
            pass

        def write(self, path):
            with open(path, "wb") as file:
                file.write(b"half")
            raise error("in the middle")

    before = saved[1].read_bytes()
    monkeypatch.setattr(OpenEXR, "File", Broken)
    with pytest.raises(error, match="in the middle"):
        make().save(saved[1])
    assert saved[1].read_bytes() == before
    assert [path.name for path in saved[1].parent.iterdir()] == ["saved.exr"]


def test_a_disk_that_is_full_leaves_the_old_file(tmp_path):
    path = tmp_path / "saved.exr"
    make().save(path)
    before = path.read_bytes()
    large = make("slices", (65, 65), 1.0, tolerance=1e-2)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, hard))
    try:
        with pytest.raises((OSError, RuntimeError)):
            large.save(path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert path.read_bytes() == before
    assert [entry.name for entry in tmp_path.iterdir()] == ["saved.exr"]


def test_a_save_over_an_old_file_replaces_it(saved):
    other = make("slices", (3, 3))
    other.save(saved[1])
    assert GratingSpectrum.load(saved[1]).source_digest == other.source_digest
    assert [path.name for path in saved[1].parent.iterdir()] == ["saved.exr"]


def test_a_folder_that_is_not_there_is_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match="folder does not exist"):
        make().save(tmp_path / "nowhere" / "saved.exr")


def test_names_that_are_not_ascii_are_fine(tmp_path):
    make().save(tmp_path / "häutung µm.exr")
    assert GratingSpectrum.load(tmp_path / "häutung µm.exr").source == "by hand"
