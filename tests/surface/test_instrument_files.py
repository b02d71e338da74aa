"""Instruments' own files: real Nanosurf scans of gratings, through the reader and through the maker's own."""

import importlib.util
import re
import struct
import sys
import warnings
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from mitsuba_diffraction.files import reading
from mitsuba_diffraction.surface import prepare
from mitsuba_diffraction.surface.heightfield import HeightField
from mitsuba_diffraction.surface.periods import find_periods
from mitsuba_diffraction.surface.readers import instruments, read_height_field
from mitsuba_diffraction.surface.readers.scan import EXTRA

needs_the_extra = pytest.mark.skipif(
    importlib.util.find_spec("SurfaceTopography") is None, reason=f"SurfaceTopography is missing: {EXTRA}"
)

PITCH = 0.3143
"""µm, of the line grating grid.nid"""
CROSSED = ("circles", "squares_holes", "circles_holes")
"""Of structures about 10 µm apart along two axes."""


@pytest.fixture
def nid():
    """nid(name): the path of a scan that comes with NSFopen."""

    def find(name):
        found = importlib.util.find_spec("NSFopen")
        if found is None:
            pytest.skip("NSFopen is missing, which brings the scans")
        return Path(found.submodule_search_locations[0]) / "example" / "Plane_Removal" / f"{name}.nid"

    return find


@pytest.fixture
def by_its_maker(nid):
    """by_its_maker(name): the forward scan as NSFopen reads it, the top row of the picture first."""

    def read(name):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # NSFopen's use of pandas
            from NSFopen.read import read as open_nid

            scan = open_nid(str(nid(name)))
            forward = scan.data["Image"]["Forward"]
            heights = forward["Z-Axis" if name == "grid" else "Topography"]
        sizes = [scan.param[axis]["range"][0] * 1e6 for axis in "XY"]
        # NSFopen gives the lines as they were scanned, upwards.
        return HeightField(heights[::-1] * 1e6, (sizes[0] / heights.shape[1], sizes[1] / heights.shape[0]), name)

    return read


def apart(one, other):
    """The angle between two lines, degrees."""
    return abs((one - other + 90) % 180 - 90)


# ---------------------------------------------------------------- real scans


def test_a_line_grating_has_its_pitch(by_its_maker):
    (found,) = find_periods(prepare.level_plane(by_its_maker("grid")))
    assert found.period == pytest.approx(PITCH, rel=0.01)
    assert found.direction == pytest.approx(-45, abs=1)
    assert found.period_uncertainty < 0.002
    assert found.strength > 0.9
    # The greatest value of the continuous power spectrum, by brute force.
    heights = prepare.level_plane(by_its_maker("grid")).heights
    places = (np.arange(256) - 127.5) * 3 / 256
    q_x, q_y = np.linspace(2.1, 2.35, 51), np.linspace(-2.35, -2.1, 51)
    window = np.outer(np.hanning(256), np.hanning(256))
    power = np.abs(
        np.exp(-2j * np.pi * np.outer(q_y, places)) @ (window * heights) @ np.exp(-2j * np.pi * np.outer(places, q_x))
    )
    row, column = np.unravel_index(power.argmax(), power.shape)
    assert found.period == pytest.approx(1 / np.hypot(q_x[column], q_y[row]), abs=2 * found.period_uncertainty)


@pytest.mark.few(1)
@pytest.mark.parametrize("name", CROSSED)
def test_crossed_structures_have_their_pitches(by_its_maker, name):
    first, second = find_periods(prepare.level_plane(by_its_maker(name)))
    for found in (first, second):
        assert found.period == pytest.approx(10, rel=0.02)
        # The scanner distorts the scan, and a quarter holds so few periods that a peak meets its opposite.
        assert found.period_uncertainty < 0.06 * found.period
    assert apart(first.direction, second.direction) == pytest.approx(90, abs=1)


def test_a_real_scan_is_prepared_to_a_tile(by_its_maker):
    steps = ["level_plane", "align_lines", "despike", {"rotate": 45.5}, {"crop_periods": "x"}]
    ready = prepare.apply_steps(by_its_maker("grid"), steps)
    found = find_periods(ready)[0]
    assert found.direction == pytest.approx(0, abs=0.2)
    waves = ready.tile_size[0] / found.period
    assert waves == pytest.approx(round(waves), abs=3 * waves * found.period_uncertainty / found.period + 0.02)
    assert "despike" in ready.source
    # Found to a hundredth of a bin of the 6.7 periods.
    length = float(re.search(r"× ([0-9.]+) nm along x", ready.source)[1])
    assert length == pytest.approx(316.6, rel=0.01 / 6.7 + 1e-3)


# ---------------------------------------------------------------- the extra


@pytest.mark.few(1)
@needs_the_extra
@pytest.mark.parametrize("name", ["grid", "circles"])
def test_nid_is_read_as_by_its_maker(nid, by_its_maker, name):
    field, expected = read_height_field(nid(name)), by_its_maker(name)
    np.testing.assert_allclose(field.heights, expected.heights, atol=1e-12)
    assert field.pixel_size == pytest.approx(expected.pixel_size)
    assert field.source.startswith(f"{name}.nid, Scan forward")


@needs_the_extra
def test_a_channel_is_selected_by_name(nid):
    forward = read_height_field(nid("grid"))
    backward = read_height_field(nid("grid"), channel="scan backward")
    assert backward.source == "grid.nid, Scan backward (Z-Axis)"
    assert np.abs(backward.heights - forward.heights).max() > 1e-3
    np.testing.assert_array_equal(read_height_field(nid("grid"), channel=1).heights, backward.heights)
    for wrong in ("scan", "Phase", 7):
        with pytest.raises(ValueError, match=r"grid\.nid: channel: got .*0 'Scan forward .*1 'Scan backward"):
            read_height_field(nid("grid"), channel=wrong)


@needs_the_extra
def test_surface_data_of_iso_25178_are_read(tmp_path):
    # Written by hand: ISO 25178-71, binary, 16 bit, metres.
    counts = np.array([[0, 100, 300], [-50, 7, 20]], "<i2")
    header = struct.pack("<8s10s12s12sHHddddBBB", b"bISO-1.0", *[b" "] * 3, 3, 2, 2e-7, 4e-7, 1e-9, -1, 0, 5, 0)
    path = tmp_path / "scan.sdf"
    path.write_bytes(header + counts.tobytes())
    field = read_height_field(path)
    np.testing.assert_allclose(field.heights, counts * 1e-3, atol=1e-12)
    assert field.pixel_size == pytest.approx((0.2, 0.4))


@needs_the_extra
def test_missing_pixels_of_an_instrument_stay_missing(tmp_path):
    counts = np.array([[0, 100, -(2**15)], [-50, 7, 20]], "<i2")  # the least number marks them
    header = struct.pack("<8s10s12s12sHHddddBBB", b"bISO-1.0", *[b" "] * 3, 3, 2, 2e-7, 4e-7, 1e-9, -1, 0, 5, 0)
    (tmp_path / "scan.sdf").write_bytes(header + counts.tobytes())
    with pytest.raises(ValueError, match="1 of 6 pixels are missing"):
        read_height_field(tmp_path / "scan.sdf")
    assert read_height_field(tmp_path / "scan.sdf", keep_missing=True).gaps[0, 2]


@needs_the_extra
@pytest.mark.parametrize("length", [1, 11, 500, 3000, 8000, 100_000])
def test_a_cut_scan_is_refused_in_one_line(nid, tmp_path, length):
    path = tmp_path / "cut.nid"
    path.write_bytes(nid("circles").read_bytes()[:length])
    with pytest.raises(ValueError, match=r"cut\.nid: ") as caught:
        read_height_field(path)
    assert "\n" not in str(caught.value)


@needs_the_extra
@pytest.mark.parametrize(
    ("old", "new"),
    [
        (b"Points=256", b"Points=99999999999"),
        (b"Points=256", b"Points=-4"),
        (b"Dim0Range=5e-05", b"Dim0Range=nan"),
        (b"Dim2Unit=m", b"Dim2Unit=V"),
        (b"SaveBits=16", b"SaveBits=9999"),
        (b"GroupCount=2", b"GroupCount=x"),
    ],
)
def test_a_header_with_wrong_sizes_is_refused_in_one_line(nid, tmp_path, old, new):
    path = tmp_path / "lie.nid"
    path.write_bytes(nid("circles").read_bytes().replace(old, new))
    with pytest.raises(ValueError, match=r"lie\.nid: ") as caught:
        read_height_field(path)
    assert "\n" not in str(caught.value)


@needs_the_extra
@pytest.mark.parametrize("extension", [*instruments.FORMATS, ".000", ".123"])
def test_every_format_refuses_files_of_other_formats(tmp_path, extension):
    path = tmp_path / f"scan{extension}"
    for content in (b"", b"no scan at all\n" * 20, bytes(range(256)) * 8, b"PK\x05\x06" + bytes(18)):
        path.write_bytes(content)
        with pytest.raises(ValueError, match=f"scan\\{extension}: ") as caught:
            read_height_field(path)
        assert "\n" not in str(caught.value)


@needs_the_extra
def test_an_archive_that_unpacks_to_too_much_is_refused(tmp_path, monkeypatch):
    import zipfile

    with zipfile.ZipFile(tmp_path / "scan.x3p", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("main.xml", bytes(100_000))
    monkeypatch.setattr(reading, "MAX_SMALL_ARRAY_BYTES", 1000)
    with pytest.raises(ValueError, match=r"got .* kB that unpack to 100 kB, wanted at most"):
        read_height_field(tmp_path / "scan.x3p")


@needs_the_extra
def test_a_channel_without_a_name_is_listed(tmp_path, monkeypatch):
    from SurfaceTopography.IO import lookup_reader_by_format

    line = SimpleNamespace(index=0, name=None, dim=1, data_kind=SimpleNamespace(value="height"))
    monkeypatch.setitem(lookup_reader_by_format, "sur", lambda path: SimpleNamespace(channels=[line]))
    (tmp_path / "line.sur").write_bytes(b"anything")
    for channel in (None, "height"):
        with pytest.raises(ValueError, match=r"0 'untitled'"):
            read_height_field(tmp_path / "line.sur", channel=channel)


def test_a_missing_extra_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "SurfaceTopography", None)
    monkeypatch.setitem(sys.modules, "SurfaceTopography.IO", None)
    (tmp_path / "scan.nid").write_bytes(b"[DataSet]\r\n")
    with pytest.raises(ValueError, match=r"pip install 'mitsuba_diffraction\[instruments\]'"):
        read_height_field(tmp_path / "scan.nid")


def test_formats_that_may_hold_more_than_heights_are_not_passed_on():
    # MATLAB, HDF5, netCDF, pickles: no instrument's own, and readers of great power; .datx is Zygo's HDF5.
    for extension in (".mat", ".h5", ".hdf5", ".nc", ".pkl", ".npy", ".npz", ".txt", ".zip", ".hgt"):
        assert instruments.format_of(extension) is None
