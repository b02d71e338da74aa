"""The file of a spectrum, read by OpenEXR itself; what is refused; and that a save is whole or not there."""

import dataclasses
import functools
import os
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import OpenEXR
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import mitsuba_diffraction as md
from mitsuba_diffraction import GratingSpectrum
from mitsuba_diffraction.energy.table import EnergyTable, Layout
from mitsuba_diffraction.files.writing import seal
from mitsuba_diffraction.precomputation.grating_spectrum import SCALAR_FORMAT_VERSION
from mitsuba_diffraction.spectrum.grids import SplineGrid
from mitsuba_diffraction.spectrum.tables import SliceTable

SHAPES = [(1, 1), (1, 8), (7, 1), (5, 5), (4, 6)]
NUMBERS = (
    *("height_range", "coherence_length", "wavelengths", "tolerance", "error", "pixel_size"),
    *("largest_angle", "truncated_power", "unresolved_power"),
)
# Random numbers, which tell a table that was read from one that was made.
_LAYOUT = Layout(0.18, 1, 4, 1, 3, (1.2, 1 / 0.36), False)
ENERGY = EnergyTable(_LAYOUT, np.random.default_rng(0).integers(0, 256, (1, 1, *_LAYOUT.shape), np.uint8))


def make(shape=(4, 7), depth=0.2, source="by hand", **arguments):
    heights = np.random.default_rng(5).random(shape) * depth
    field = md.HeightField(heights, (0.07, 0.0585), source)
    return dataclasses.replace(md.precompute(field, **arguments), energy=ENERGY)


def make_sample(shape=(10, 9), depth=0.2, source="by hand", **arguments):
    # Four pixels of 0.07 µm: the shortest coherence length that a scan of any size supports.
    arguments = {"extent": "sample", "coherence_length": 0.2801, "tolerance": 0.05, **arguments}
    return make(shape, depth, source, **arguments)


@functools.cache
def built(extent):
    return make() if extent == "tile" else make_sample()


@pytest.fixture(params=["tile", "sample"])
def saved(request, tmp_path):
    spectrum = built(request.param)
    spectrum.save(tmp_path / "saved.exr")
    return spectrum, tmp_path / "saved.exr"


@pytest.mark.parametrize("coherence_length", [65.0, 0.8])
def test_a_loaded_spectrum_shares_the_tables_of_the_built_one(tmp_path, coherence_length):
    spectrum = make(shape=(16, 16), tolerance=0.05, coherence_length=coherence_length)
    assert isinstance(spectrum.grid, SplineGrid) == (coherence_length < 1)
    spectrum.save(tmp_path / "saved.exr")
    assert GratingSpectrum.load(tmp_path / "saved.exr").digest == spectrum.digest


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
    seal(path)


# ---------------------------------------------------------------- what is in the file


def assert_the_same(back, spectrum):
    for name in (*NUMBERS, "source", "source_digest", "extent", "representation", "grid", "max_kappa"):
        assert getattr(back, name) == getattr(spectrum, name), name
    assert back.table.values.dtype == spectrum.table.values.dtype
    np.testing.assert_array_equal(back.table.values, spectrum.table.values)
    assert back.energy_table().as_plain() == ENERGY.as_plain()
    q = np.random.default_rng(1).uniform(-2, 2, (5, 2))
    np.testing.assert_array_equal(back.evaluate(q, 9.0), spectrum.evaluate(q, 9.0))
    np.testing.assert_array_equal(back.powers(25.0), spectrum.powers(25.0))


@settings(max_examples=30)
@given(
    shape=st.sampled_from(SHAPES),
    depth=st.sampled_from([0.0, 0.05, 0.3]),
    coherence_length=st.floats(1.0, 1000.0),
    shortest=st.floats(360.0, 500.0),
    largest_angle=st.sampled_from([90.0, 60, 100 / 3]),
    source=st.sampled_from(["", "scan.png", "gräben [µm]", "two\nlines", "x" * 400]),
)
def test_a_spectrum_is_loaded_bit_for_bit(
    tmp_path_factory, shape, depth, coherence_length, shortest, largest_angle, source
):
    path = tmp_path_factory.mktemp("round") / "trip.exr"
    spectrum = make(
        shape,
        depth,
        source,
        coherence_length=coherence_length,
        wavelengths=(shortest, 830),
        largest_angle=largest_angle,
    )
    spectrum.save(path)
    assert_the_same(GratingSpectrum.load(path), spectrum)


@pytest.mark.parametrize("shape", [(1, 9), (10, 1), (10, 9), (1, 1)])
def test_a_sample_is_loaded_bit_for_bit(tmp_path, shape):
    # An axis of one pixel has no end: its limit is infinite, in the file as well.
    spectrum = make_sample(shape)
    assert [limit == np.inf for limit in spectrum.grid.limit] == [n == 1 for n in shape[::-1]]
    spectrum.save(tmp_path / "sample.exr")
    assert_the_same(GratingSpectrum.load(tmp_path / "sample.exr"), spectrum)


@pytest.mark.parametrize("way", ["tile", "sample"])
def test_the_header_names_all_that_a_reader_needs(tmp_path, way):
    spectrum = make(largest_angle=80) if way == "tile" else make_sample(largest_angle=80)
    shape = (4, 7) if way == "tile" else (10, 9)
    spectrum.save(tmp_path / "saved.exr")
    header = OpenEXR.File(str(tmp_path / "saved.exr"), separate_channels=True).header()
    numbers = {
        "pixelSize": spectrum.pixel_size,
        "coherenceLength": (65.0 if way == "tile" else 0.2801,),
        "heightRange": (spectrum.height_range,),
        "wavelengths": (360.0, 830.0),
        "error": (spectrum.error,),
        "tolerance": (1e-3 if way == "tile" else 0.05,),
        "largestAngle": (80.0,),
        "dropped": (spectrum.truncated_power,),
        "beyond": (spectrum.unresolved_power,),
    }
    if way == "tile":
        numbers["tileSize"] = (7 * 0.07, 4 * 0.0585)
    else:
        numbers["spacing"] = spectrum.grid.spacing
        numbers["limit"] = (1 / (2 * 0.07), 1 / (2 * 0.0585))
    for name, value in numbers.items():
        assert header[name].dtype == np.float64, name
        assert tuple(header[name]) == value, name
    assert (header["representation"], header["extent"]) == (spectrum.representation, way)
    assert header["source"] == "by hand"
    heights = np.random.default_rng(5).random(shape) * 0.2
    assert header["sourceSha256"] == md.HeightField(heights, (0.07, 0.0585)).digest
    assert isinstance(header["formatVersion"], int)
    assert header["compression"] == OpenEXR.ZIP_COMPRESSION
    assert header["type"] == OpenEXR.scanlineimage


def test_channels_are_float32_with_documented_names(tmp_path):
    spectrum = make(depth=0.02)
    spectrum.save(tmp_path / "saved.exr")
    file = OpenEXR.File(str(tmp_path / "saved.exr"), separate_channels=True)
    assert len(file.parts) == 1
    pixels = {name: channel.pixels for name, channel in file.channels().items()}
    assert {values.dtype for values in pixels.values()} == {np.dtype(np.float32)}
    heights = np.random.default_rng(5).random((4, 7)) * spectrum.height_range
    heights *= spectrum.height_range / np.ptp(heights)
    u = (heights.ravel()[:, None] - heights.ravel()).ravel()
    centre = spectrum.max_kappa / 2
    # One interval of all κ: order zero, the mean over all pairs of pixels, is Σ a_p t^p, t = −1 to 1.
    assert len(pixels) == 4 * spectrum.table.intervals == 4
    row, column = (n // 2 for n in pixels["S(000.0)"].shape)
    for t in (-1.0, -0.2, 0.6, 1.0):
        eta = np.exp(1j * centre * (1 + t) * u).mean().real
        cubic = sum(pixels[f"S(000.{p})"][row, column] * t**p for p in range(4))
        assert cubic == pytest.approx(eta, abs=1e-3)


def test_more_than_a_thousand_intervals_keep_their_order(tmp_path):
    powers = np.random.default_rng(2).normal(0, 0.01, (1003, 4, 1, 3)).astype(np.float32)
    powers[:, 0, 0, 1] += 1
    spectrum = make(shape=(1, 3))
    spectrum = dataclasses.replace(spectrum, table=SliceTable(spectrum.max_kappa, powers))
    spectrum.save(tmp_path / "deep.exr")
    np.testing.assert_array_equal(GratingSpectrum.load(tmp_path / "deep.exr").table.values, powers)


# ---------------------------------------------------------------- what is refused


def refusal(path, kind=ValueError, change="it is none"):
    try:
        GratingSpectrum.load(path)
    except kind as error:
        message = str(error)
    else:
        pytest.fail(f"{path.name} was read although {change}")
    assert path.name in message
    assert "\n" not in message
    return message


def test_another_version_is_refused(saved):
    for version in (SCALAR_FORMAT_VERSION - 1, SCALAR_FORMAT_VERSION + 1):
        rewrite(saved[1], {"formatVersion": version})
        assert f"version {version}" in refusal(saved[1])


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("wavelets", "got representation 'wavelets', wanted one of slices, taylor, chebyshev"),
        ("svd", "got representation 'svd', wanted one of slices, taylor, chebyshev"),
        ("taylor", "is missing"),
    ],
)
def test_another_representation_is_refused(saved, name, message):
    rewrite(saved[1], {"representation": name})
    assert message in refusal(saved[1])


def test_an_unknown_extent_is_refused(saved):
    rewrite(saved[1], {"extent": "ribbon"})
    assert "ribbon" in refusal(saved[1])


def test_a_picture_is_refused(tmp_path):
    path = tmp_path / "picture.exr"
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, {"RGB": np.zeros((4, 4, 3), np.float32)}).write(str(path))
    assert "its SHA-256 is wrong or missing" in refusal(path)


def grid_entry(spectrum):
    return "tileSize" if spectrum.extent == "tile" else "spacing"


def test_a_missing_entry_of_the_header_is_refused(saved):
    spectrum, path = saved
    content = path.read_bytes()
    for name in (
        *("format", "formatVersion", "representation", "extent", "heightRange", "pixelSize", grid_entry(spectrum)),
        *("coherenceLength", "wavelengths", "tolerance", "error", "source", "sourceSha256"),
        *("largestAngle", "dropped", "beyond", "channelCount"),
    ):
        path.write_bytes(content)
        rewrite(path, drop=[name])
        refusal(path, change=f"{name} was missing")


def test_a_missing_limit_of_a_sample_is_refused(tmp_path):
    path = tmp_path / "saved.exr"
    make_sample().save(path)
    rewrite(path, drop=["limit"])
    assert "'limit' is missing" in refusal(path)


def test_a_missing_channel_is_refused(saved):
    content, names = saved[1].read_bytes(), sorted(contents(saved[1])[1])
    for name in (names[0], names[3], names[-1]):
        saved[1].write_bytes(content)
        rewrite(saved[1], drop=[name])
        refusal(saved[1], change=f"{name} was missing")


def test_a_channel_that_is_not_known_is_refused(saved):
    pixels = contents(saved[1])[1]
    rewrite(saved[1], channels={"alpha": next(iter(pixels.values()))})
    assert "alpha" in refusal(saved[1])


def test_half_precision_is_refused(saved):
    pixels = contents(saved[1])[1]
    rewrite(saved[1], channels={name: values.astype(np.float16) for name, values in pixels.items()})
    refusal(saved[1])


def test_impossible_numbers_are_refused(saved):
    spectrum, path = saved
    content = path.read_bytes()
    for name, value in (
        ("heightRange", np.array([np.nan])),
        ("heightRange", np.array([-1.0])),
        ("pixelSize", np.array([0.0, -1.0])),
        ("pixelSize", np.array([0.1, 0.1, 0.1])),
        (grid_entry(spectrum), np.array([np.nan, 1.0])),
        ("largestAngle", np.array([91.0])),
        ("dropped", np.array([-0.1])),
        ("beyond", np.array([np.nan])),
        ("extent", "ribbon"),
        ("coherenceLength", np.array([0.0])),
        ("coherenceLength", "65"),
        ("wavelengths", np.array([360.0])),
        ("wavelengths", np.array([830.0, 360.0])),
        ("tolerance", np.array([0.0])),
        ("error", np.array([np.nan])),
        ("source", 3),
    ):
        path.write_bytes(content)
        rewrite(path, {name: value})
        refusal(path, change=f"{name} was {value}")


def test_pixels_that_are_not_numbers_are_refused(saved):
    name, values = next(iter(contents(saved[1])[1].items()))
    values[0, 0] = np.nan
    rewrite(saved[1], channels={name: values})
    refusal(saved[1])


def test_a_file_cut_short_is_refused_without_noise(saved, capfd):
    content = saved[1].read_bytes()
    for left in (0, 3, 100, len(content) // 2, len(content) * 9 // 10, -3):
        saved[1].write_bytes(content[:left])
        refusal(saved[1], change=f"only {len(content[:left])} of {len(content)} bytes were left")
    # The message is all that a person sees: the library's own lines would stand above it.
    assert capfd.readouterr() == ("", "")


def test_files_are_read_on_several_threads(saved, capfd):
    # Regression: two at a time left the streams of the process redirected for good.
    streams = sys.stdout, sys.stderr
    with ThreadPoolExecutor(4) as threads:
        list(threads.map(lambda _: GratingSpectrum.load(saved[1]), range(40)))
    assert (sys.stdout, sys.stderr) == streams
    os.write(2, b"told")
    assert capfd.readouterr() == ("", "told")


def test_any_flipped_bit_is_refused(saved):
    # Regression: of twelve flipped bits, four gave another picture without a word.
    content = saved[1].read_bytes()
    rng = np.random.default_rng(4)
    for offset in [0, len(content) - 1, *rng.integers(len(content), size=100)]:
        damaged = bytearray(content)
        damaged[offset] ^= 1 << rng.integers(8)
        saved[1].write_bytes(damaged)
        refusal(saved[1], change=f"byte {offset} changed")


def test_a_spectrum_without_its_digest_is_refused(saved):
    entries, pixels = contents(saved[1])
    del entries["contentSha256"]
    OpenEXR.File(entries, pixels).write(str(saved[1]))
    assert "SHA-256 is wrong or missing" in refusal(saved[1])


def test_text_is_refused(tmp_path):
    path = tmp_path / "text.exr"
    path.write_text("not a picture")
    assert "its SHA-256 is wrong or missing" in refusal(path)


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


@pytest.mark.posix("limits of a process")
def test_a_disk_that_is_full_leaves_the_old_file(tmp_path, full_disk):
    path = tmp_path / "saved.exr"
    make().save(path)
    before = path.read_bytes()
    large = make((65, 65), 1.0, tolerance=1e-2)
    with full_disk(20_000), pytest.raises((OSError, RuntimeError)):
        large.save(path)
    assert path.read_bytes() == before
    assert [entry.name for entry in tmp_path.iterdir()] == ["saved.exr"]


def test_a_save_over_an_old_file_replaces_it(saved):
    other = make((3, 3))
    other.save(saved[1])
    assert GratingSpectrum.load(saved[1]).source_digest == other.source_digest
    assert [path.name for path in saved[1].parent.iterdir()] == ["saved.exr"]


def test_a_folder_that_is_not_there_is_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match="folder does not exist"):
        make().save(tmp_path / "nowhere" / "saved.exr")


def test_names_that_are_not_ascii_are_fine(tmp_path):
    make().save(tmp_path / "häutung µm.exr")
    assert GratingSpectrum.load(tmp_path / "häutung µm.exr").source == "by hand"
