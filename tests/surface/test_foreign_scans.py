"""Instruments' files of kinds that SurfaceTopography misreads or refuses, or that need a language."""

import re
import struct
from contextlib import nullcontext

import foreign_scans
import numpy as np
import pytest
from foreign_scans import (
    COLUMNS,
    DX,
    DY,
    REVISION,
    ROWS,
    datx,
    h5_jpk,
    ibw,
    jpk,
    lext,
    mdt,
    nms,
    oir,
    opd,
    os3d,
    park,
    plux,
    sur,
    sxm,
    tmd,
    vk4,
    wyko,
    x3p,
    zmg,
    zon,
    zygo,
)
from test_instrument_files import needs_the_extra

from mitsuba_diffraction.files import reading
from mitsuba_diffraction.surface.readers import read_height_field

MISSING = [(7, 11), (7, 12)]
INSTRUMENTS = {
    "spacing_in_nm.nms": (nms, {}),
    "without_intensity.nms": (nms, {"missing": MISSING, "first": 1000, "last": 60000}),
    "comment_of_24_bytes.tmd": (tmd, {"comment": b"Created by TrueMap v6\r\n"}),
    "no_comment.tmd": (tmd, {"comment": b""}),
    "long_comment.tmd": (tmd, {"comment": b"a gel on a coin, " * 9}),
    "compressed.sur": (sur, {"missing": MISSING}),
    "three_streams.sur": (sur, {"streams": 3}),
    "heights_as_text.x3p": (x3p, {"missing": MISSING}),
    "en_dash.x3p": (x3p, {"as_text": False, "revision": REVISION.replace("-", "\u2013")}),
    "amended.x3p": (x3p, {"as_text": False, "revision": "ISO25178-72:2017/DAM1"}),
    "empty_offset.x3p": (x3p, {"as_text": False, "offset": ""}),
    "no_date.x3p": (x3p, {"as_text": False, "date": "yesterday"}),
    "zipped_folder.x3p": (x3p, {"as_text": False, "folder": "a scan/"}),
    "scan.zip": (x3p, {"missing": MISSING, "folder": "scan/"}),
    "int16.tiff": (park, {}),
    "float.tif": (park, {"floats": True}),
    "image.ibw": (ibw, {}),
    "big_endian.ibw": (ibw, {"order": ">"}),
    "layer.ibw": (ibw, {"layers": 1}),
    "image.jpk": (jpk, {}),
    "image.jpk-qi-image": (jpk, {}),
    "image.tif": (jpk, {}),
    "curves.jpk-qi-data": (jpk, {"image": "data-image.jpk-qi-image"}),
    "curves.zip": (jpk, {"image": "data-image.jpk-qi-image"}),
    "curves.jpk-force-map": (jpk, {"image": "data-image.force"}),
    "scan.mdt": (mdt, {}),
    "scan.datx": (datx, {}),
    "scan.opd": (opd, {}),
    "scan.vk4": (vk4, {}),
    "scan.vk6": (vk4, {"wrapped": True}),
    "scan.os3d": (os3d, {}),
    "scan.zmg": (zmg, {}),
    "scan.plux": (plux, {}),
    "scan.lext": (lext, {}),
    "scan.oir": (oir, {}),
    "scan.poir": (oir, {"packed": True}),
}
INTERFEROMETERS = {
    "scan.asc": (wyko, {"missing": MISSING}),
    "nanometres.txt": (wyko, {"in_nm": True, "blocks": ["Intensity"]}),
    "opd.asc": (wyko, {"heights": "OPD", "blocks": ["Image", "SecArr_0"]}),
}
LANGUAGES = {
    "german.txt": ("Kanal:", "Breite:", "H\u00f6he:", "Werteinheiten:"),
    "english_units.txt": ("Kanal:", "Breite:", "H\u00f6he:", "Value units:"),
    "french.txt": ("Canal\u00a0:", "Largeur :", "Hauteur :", "Unit\u00e9s de valeur :"),
    "english.txt": ("Channel:", "Width:", "Height:", "Value units:"),
    "chinese.asc": (
        "\u30c1\u30e3\u30f3\u30cd\u30eb\uff1a",
        "\u5e45\uff1a",
        "\u9ad8\u3055\uff1a",
        "\u5358\u4f4d\uff1a",
    ),
}


def check(path, missing=()):
    field = read_height_field(path, keep_missing=bool(missing))
    wanted = foreign_scans.relief()
    for at in missing:
        wanted[at] = np.nan
    assert field.pixel_size == pytest.approx((DX, DY), rel=1e-6)
    assert field.shape == (ROWS, COLUMNS)
    np.testing.assert_allclose(field.heights, wanted, atol=2e-5)


@pytest.mark.parametrize("name", INTERFEROMETERS)
def test_wyko_ascii_has_its_scale(name, tmp_path):
    write, settings = INTERFEROMETERS[name]
    (tmp_path / name).write_bytes(write(**settings))
    check(tmp_path / name, settings.get("missing", ()))
    assert read_height_field(tmp_path / name, fill_missing=True).source.startswith(f"{name}, A relief")


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"Wavelength": None}, "the header: got 'none' for 'Wavelength', wanted a positive number"),
        ({"Pixel_size": None}, "pixel_size: the file has none"),
        ({"Pixel_size": -1}, "the header: got '-1' for 'Pixel_size'"),
        ({"heights": "Other"}, "without heights, wanted a block RAW_DATA"),
    ],
)
def test_wyko_ascii_without_a_scale_is_refused(settings, message, tmp_path):
    (tmp_path / "scan.asc").write_bytes(wyko(**settings))
    with pytest.raises(ValueError, match=message):
        read_height_field(tmp_path / "scan.asc")


def test_zygo_points_are_pixels(tmp_path):
    path = tmp_path / "scan.xyz"
    path.write_bytes(zygo(missing=MISSING))
    field, wanted = read_height_field(path, keep_missing=True), foreign_scans.relief()
    assert field.gaps.sum() == len(MISSING)
    assert field.gaps[MISSING[0]]
    assert field.gaps[MISSING[1]]
    np.testing.assert_allclose(field.heights[~field.gaps], wanted[~field.gaps], atol=1e-6)
    assert field.pixel_size == pytest.approx((DX, DX))
    path.write_bytes(zygo(resolution=0))
    with pytest.raises(ValueError, match="pixel_size: the file has none"):
        read_height_field(path)
    np.testing.assert_allclose(read_height_field(path, 0.5).heights, wanted, atol=1e-6)
    # Without its header nothing says that these are no lengths.
    path.write_bytes(zygo().partition(b"#\n")[2])
    with pytest.warns(UserWarning, match="may be those of pixels: taken for lengths, one pixel is 1 µm"):
        assert read_height_field(path, unit="um").pixel_size == pytest.approx((1, 1))
    assert read_height_field(path, 0.5, unit="um").pixel_size == (0.5, 0.5)
    path.write_bytes(zygo(kind="ASCII Data File - Format 2"))
    with pytest.raises(ValueError, match="'Zygo ASCII Data File - Format 2', whose heights"):
        read_height_field(path)


@pytest.mark.filterwarnings("ignore:.*whole numbers", "ignore:.*is their unit right")
@pytest.mark.parametrize(("name", "write"), [("scan.asc", wyko), ("scan.xyz", zygo)])
def test_a_cut_text_of_an_interferometer_gives_heights_or_one_line(name, write, tmp_path):
    whole = write(missing=MISSING)
    for length in range(0, len(whole) - 40, 23):  # the last number may be cut
        (tmp_path / name).write_bytes(whole[:length])
        with pytest.raises(ValueError, match=name) as caught:
            read_height_field(tmp_path / name)
        assert "\n" not in str(caught.value)


SPIP = {"x-pixels": COLUMNS, "y-pixels": ROWS, "x-length": 1e3 * DX * COLUMNS, "y-length": 1e3 * DY * ROWS}


def spip(missing=(), mark="=", scale=1e3, **fields):
    """Text of SPIP: a header, heights by rows, and then, if any are void, where they are; lengths in nm."""
    heights, void = foreign_scans.relief() * scale, np.zeros((ROWS, COLUMNS), int)
    for at in missing:
        heights[at], void[at] = 0, 1
    fields = {**SPIP, "voidpixels": len(missing), **fields}
    lines = ["# File Format = ASCII", *(f"# {name.replace('_', '-')} {mark}{value}" for name, value in fields.items())]
    lines.append("# Start of Data:")
    for table in (heights, void) if missing else (heights,):
        lines += ["\t".join(f"{number:.6g}" for number in row) for row in table]
    return "\n".join(lines)


@pytest.mark.parametrize(
    "settings",
    [
        {"z_unit": "nm"},
        {"z_unit": " [nm]", "missing": MISSING},
        {"z_unit": " µm", "scale": 1},
        {"Bit2nm": 0.5, "scale": 2e3},
        {"z_unit": "nm", "x_unit": "um", "y_unit": "um", "x_length": DX * COLUMNS, "y_length": DY * ROWS, "mark": ":"},
    ],
)
@pytest.mark.parametrize("name", ["scan.asc", "scan.txt"])
def test_text_of_spip_has_its_scale(settings, name, tmp_path):
    settings = {name.replace("_length", "-length"): value for name, value in settings.items()}
    (tmp_path / name).write_text(spip(**settings))
    check(tmp_path / name, settings.get("missing", ()))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({}, "unit: the file names none for the heights"),
        ({"z_unit": "V"}, "the heights: got the unit 'V'"),
        ({"z_unit": "nm", "x-pixels": "1e400"}, "got '1e400' for 'x-pixels', wanted a number"),
        ({"z_unit": "nm", "x-pixels": COLUMNS + 1}, f"got {ROWS * COLUMNS} numbers, wanted {ROWS} lines of"),
        ({"z_unit": "nm", "x-length": "wide"}, "the header: got 'wide' for 'x-length'"),
    ],
)
def test_wrong_text_of_spip_is_refused(settings, message, tmp_path):
    (tmp_path / "scan.asc").write_text(spip(**settings))
    with pytest.raises(ValueError, match=message):
        read_height_field(tmp_path / "scan.asc")


@pytest.mark.parametrize("names", [("Lateral units", "Value units"), ("Laterale Einheiten", "Werteinheiten")])
@pytest.mark.parametrize("name", ["scan.xyz", "scan.txt"])
def test_points_of_gwyddion_have_the_units_of_its_comments(names, name, tmp_path):
    row, column = np.mgrid[:ROWS, :COLUMNS]
    points = np.stack([1e-3 * DX * column, 1e-3 * DY * row, 1e-6 * foreign_scans.relief()], -1).reshape(-1, 3)
    np.savetxt(tmp_path / name, points, header=f"Channel: Topography\n{names[0]}: mm\n{names[1]}: m", fmt="%.8g")
    check(tmp_path / name)
    (tmp_path / name).write_text((tmp_path / name).read_text().replace(f"{names[1]}: m", "Value units: V"))
    with pytest.raises(ValueError, match="the heights: got the unit 'V'"):
        read_height_field(tmp_path / name)


def nanoscope_text(channels, quote="", lines=ROWS):
    """Text of Nanoscope Analysis: its header, the names of channels, and a line of numbers for each pixel."""
    header = f"""\\*File list
\\Version: 0x09400000
\\*Ciao scan list
\\Scan Size: {DX * COLUMNS} ~m
\\Samps/line: {COLUMNS}
\\Lines: {ROWS}
\\*Ciao image list
\\Data offset: 81920
\\Data length: {4 * ROWS * COLUMNS}
\\Samps/line: {COLUMNS}
\\Number of lines: {lines}
\\Scan Size: {DX * COLUMNS} {DY * lines} ~m
\\*File list end"""
    numbers = np.stack(list(channels.values()), -1).reshape(-1, len(channels))
    rows = ["\t".join(f"{number:.6f}" for number in pixel) for pixel in numbers]
    return "\n".join([*(quote + line + quote for line in header.splitlines()), "\t".join(channels), *rows])


@pytest.mark.parametrize("quote", ["", '"'])
@pytest.mark.parametrize("name", ["scan.txt", "scan.export"])
def test_text_of_nanoscope_analysis_is_no_binary_file(quote, name, tmp_path):
    # Regression: not read as a file of Bruker Dimension (KeyError).
    relief = foreign_scans.relief()
    channels = {"Peak_Force_Error(nN)": relief, "Height_Sensor(nm)": 1e3 * relief, "Height(um)": 2 * relief}
    (tmp_path / name).write_text(nanoscope_text(channels, quote), encoding="latin-1")
    check(tmp_path / name)
    assert read_height_field(tmp_path / name).source == f"{name}, Height_Sensor(nm)"
    np.testing.assert_allclose(read_height_field(tmp_path / name, channel="Height(um)").heights, 2 * relief, atol=1e-5)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (nanoscope_text({"Height": foreign_scans.relief()}), "unit: the file names none for the heights"),
        (nanoscope_text({"Error(V)": foreign_scans.relief()}), "wanted a channel of heights .* got 0 'Error"),
        (nanoscope_text({"Height(nm)": foreign_scans.relief()}, lines=ROWS + 1), f"wanted {COLUMNS} × {ROWS + 1}"),
        (nanoscope_text({"Height(nm)": np.ones((2, 2))}).replace("Samps/line", "Samples"), "'samps/line' is missing"),
        (nanoscope_text({"Height(nm)": np.ones((2, 2))}).partition("\\*File list end")[0], "that is cut"),
        (nanoscope_text({"Height(nm)": np.ones((2, 2))}).replace("(nm)", "(nm)\tPhase(deg)"), "1 numbers in a line"),
    ],
)
def test_wrong_text_of_nanoscope_analysis_is_refused(text, message, tmp_path):
    (tmp_path / "scan.txt").write_text(text)
    with pytest.raises(ValueError, match=message) as caught:
        read_height_field(tmp_path / "scan.txt")
    assert "\n" not in str(caught.value)


@needs_the_extra
def test_digital_surf_without_lengths_is_read_in_those_given(tmp_path):
    path = tmp_path / "scan.sur"
    for units, given, message in (
        (6 * ("a.u.",), "um", "unit: the file names none for its lengths"),
        (2 * ("µm", "µm", "a.u."), "um", "unit: the file names none for the heights"),
        (2 * ("a.u.", "a.u.", "µm"), ("um", "um"), "unit: the file names none for its lengths"),
    ):
        path.write_bytes(sur(units=units))
        with pytest.raises(ValueError, match=message):
            read_height_field(path)
        field = read_height_field(path, unit=given)
        assert field.pixel_size == pytest.approx((DX, DY))
        np.testing.assert_allclose(field.heights, foreign_scans.relief(), atol=2e-5)


@needs_the_extra
@pytest.mark.parametrize(
    ("name", "write"),
    [
        *(("scan.sur", sur), ("scan.asc", wyko), ("scan.xyz", zygo)),
        ("scan.txt", lambda: nanoscope_text({"Height(nm)": 1e3 * foreign_scans.relief()}).encode("latin-1")),
        ("spip.asc", lambda: spip(z_unit="nm").encode()),
    ],
)
def test_the_second_unit_overrides_that_of_the_heights_in_a_file(name, write, tmp_path):
    # Regression: the warning of an implausible scale named a remedy that was ignored.
    (tmp_path / name).write_bytes(write())
    plain = read_height_field(tmp_path / name)
    for unit in ("cm", ("cm", "m")):
        with pytest.warns(UserWarning, match=r"unit \(unit=um") if unit == ("cm", "m") else nullcontext():
            field = read_height_field(tmp_path / name, unit=unit)
        assert field.pixel_size == plain.pixel_size
    ratio = field.height_range / plain.height_range
    assert ratio in (pytest.approx(1e6), pytest.approx(1e9))


@pytest.mark.slow
@needs_the_extra
def test_an_igor_wave_without_units_is_read_with_those_given(tmp_path):
    path = tmp_path / "scan.ibw"
    path.write_bytes(ibw(units=(b"", b"")))
    with pytest.raises(ValueError, match="unit: the file names none for its lengths"):
        read_height_field(path)
    field = read_height_field(path, unit="m")
    assert field.pixel_size == pytest.approx((DX, DY))
    np.testing.assert_allclose(field.heights, foreign_scans.relief(), atol=2e-5)
    # Igor's own scale is a step of one.
    path.write_bytes(ibw(units=(b"", b""), steps=(1, 1)))
    with pytest.raises(ValueError, match="pixel_size: the file has none"):
        read_height_field(path, unit="m")
    assert read_height_field(path, (DX, DY), unit="m").shape == (ROWS, COLUMNS)
    path.write_bytes(ibw(units=(b"m", b"")))
    with pytest.raises(ValueError, match="unit: the file names none for the heights"):
        read_height_field(path)
    np.testing.assert_allclose(read_height_field(path, unit="m").heights, field.heights)


@needs_the_extra
def test_named_columns_of_an_igor_wave_are_curves(tmp_path):
    (tmp_path / "scan.ibw").write_bytes(ibw(column_names=["Raw", "Deflection", *map(str, range(ROWS - 2))]))
    with pytest.raises(ValueError, match=r"wanted a channel of heights .* got 0 'Raw', 1 'Deflection'"):
        read_height_field(tmp_path / "scan.ibw")
    with pytest.raises(ValueError, match=r"channel: 0 'Raw' is a line, such as a profile"):
        read_height_field(tmp_path / "scan.ibw", channel="Raw")


@needs_the_extra
def test_a_profile_is_refused_as_a_line(tmp_path):
    wave = bytearray(ibw())
    struct.pack_into("<4i", wave, 132, ROWS * COLUMNS, 0, 0, 0)
    (tmp_path / "scan.ibw").write_bytes(wave)
    with pytest.raises(ValueError, match=r"in a unit of length, got 0 '.*', which are lines, such as a profile"):
        read_height_field(tmp_path / "scan.ibw")


@needs_the_extra
def test_a_damaged_igor_wave_is_refused_in_one_line(tmp_path, caplog):
    (tmp_path / "scan.ibw").write_bytes(ibw(layers=1).replace(struct.pack("<3i", COLUMNS, ROWS, 1), b"\x09" * 12))
    with pytest.raises(ValueError, match="not read as a file of Igor binary wave"):
        read_height_field(tmp_path / "scan.ibw")
    assert not caplog.records


@needs_the_extra
def test_an_igor_wave_and_its_note_may_disagree(tmp_path):
    (tmp_path / "scan.ibw").write_bytes(
        ibw(note=f"FastScanSize: {COLUMNS * DX * 1e-6}\rSlowScanSize: 2.56e-5\rScanPoints: {COLUMNS}\rScanLines: 64\r")
    )
    check(tmp_path / "scan.ibw")  # stopped after a quarter
    (tmp_path / "scan.ibw").write_bytes(
        ibw(note=f"FastScanSize: 6e-6\rSlowScanSize: 6e-6\rScanPoints: {COLUMNS}\rScanLines: {ROWS}\r")
    )
    with pytest.warns(UserWarning, match="its wave has 6 × 6.4 µm, but its note 6 × 6 µm"):
        check(tmp_path / "scan.ibw")


@needs_the_extra
def test_a_jpk_image_of_a_part_of_the_grid_has_its_pixels(tmp_path):
    (tmp_path / "stopped.jpk").write_bytes(jpk(lines=2 * ROWS))
    with pytest.warns(UserWarning, match=f"image of {COLUMNS} × {ROWS} pixels, of a grid of {COLUMNS} × {2 * ROWS}"):
        check(tmp_path / "stopped.jpk")


@needs_the_extra
def test_trace_of_jpk_is_read_before_retrace(tmp_path):
    (tmp_path / "scan.jpk").write_bytes(jpk(retrace=True))
    check(tmp_path / "scan.jpk")
    assert read_height_field(tmp_path / "scan.jpk", channel=0).source == "scan.jpk, Height (measured, retrace)"


@pytest.mark.parametrize("direction", ["up", "down"])
@pytest.mark.parametrize("images", ["both", "forward", "backward"])
@pytest.mark.parametrize("name", ["scan.sxm", "scan"])
def test_a_scan_of_nanonis_is_read(tmp_path, direction, images, name):
    path = tmp_path / name
    path.write_bytes(sxm(direction, images=images))
    for way, factor in {"forward": 1, "backward": 2}.items():
        if images in ("both", way):
            field = read_height_field(path, channel=f"Z ({way})")
            np.testing.assert_allclose(field.heights, factor * foreign_scans.relief(), rtol=1e-6)
            assert field.pixel_size == pytest.approx((DX, DY))
    assert read_height_field(path).source == f"{name}, Z ({'backward' if images == 'backward' else 'forward'})"


@pytest.mark.filterwarnings("ignore:.*has non-uft-8 characters")
@pytest.mark.parametrize("direction", ["up", "down"])
def test_another_reader_of_nanonis_finds_the_same(tmp_path, direction):
    read = pytest.importorskip("nanonispy2.read", exc_type=ImportError)
    path = tmp_path / "scan.sxm"
    path.write_bytes(sxm(direction))
    other = read.Scan(str(path))
    np.testing.assert_allclose(1e6 * other.header["scan_range"], (COLUMNS * DX, ROWS * DY))
    lines = slice(None, None, -1 if direction == "up" else 1)  # it keeps the order of scanning
    for way, columns in {"forward": slice(None), "backward": slice(None, None, -1)}.items():
        heights = read_height_field(path, channel=f"Z ({way})").heights
        np.testing.assert_array_equal(heights, 1e6 * other.signals["Z"][way][lines, columns].astype(np.float64))


def test_a_stopped_scan_of_nanonis_has_missing_pixels(tmp_path):
    (tmp_path / "scan.sxm").write_bytes(sxm(rows=ROWS // 2))
    field = read_height_field(tmp_path / "scan.sxm", keep_missing=True)
    np.testing.assert_array_equal(field.gaps, np.arange(ROWS)[:, None] * np.ones(COLUMNS) >= ROWS // 2)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (sxm()[:-1], "bytes of images, wanted 4 of 24 × 16 pixels"),
        (sxm()[:200], "not a whole scan of Nanonis"),
        (sxm()[1:], "not a whole scan of Nanonis"),
        (sxm(unit="V"), "wanted a channel of heights in a unit of length, got 0 'Current"),
        (sxm().replace(b"       24       16", b"       24       no"), "SCAN_PIXELS: got '.*no'"),
        (sxm().replace(b":SCAN_RANGE:", b":SCAN_OTHER:"), "SCAN_RANGE: got 'none'"),
        (sxm().replace(b"\tboth\t8", b"\tboat\t8"), "DATA_INFO: got '.*boat"),
    ],
)
def test_a_damaged_scan_of_nanonis_is_refused_in_one_line(tmp_path, data, message):
    (tmp_path / "scan.sxm").write_bytes(data)
    with pytest.raises(ValueError, match=message) as caught:
        read_height_field(tmp_path / "scan.sxm")
    assert "\n" not in str(caught.value)


@needs_the_extra
def test_jpk_in_hdf5_is_read(tmp_path):
    path = tmp_path / "scan.h5-jpk"
    for reflect in (False, True):
        path.write_bytes(h5_jpk(reflect))
        check(path)
    assert read_height_field(path).source == "scan.h5-jpk, Height, frame 1 of 2"
    back = read_height_field(path, channel="retrace")
    assert back.source == "scan.h5-jpk, Height (retrace), frame 1 of 2"
    np.testing.assert_allclose(back.heights, 2 * foreign_scans.relief(), atol=1e-5)
    with pytest.raises(ValueError, match="0 'Error Signal' holds no lengths"):
        read_height_field(path, channel=0)
    path.write_bytes(h5_jpk(pixels=ROWS))
    with pytest.raises(ValueError, match=f"got {ROWS} pixels in 2 frames, wanted {COLUMNS} × {ROWS}"):
        read_height_field(path)
    path.write_bytes(h5_jpk()[:3000])
    with pytest.raises(ValueError, match="a damaged file of JPK, or not one") as caught:
        read_height_field(path)
    assert "\n" not in str(caught.value)


def _virtual(group, shape):
    import h5py

    layout = h5py.VirtualLayout(shape, "i4")
    layout[...] = h5py.VirtualSource("other.h5", "heights", shape)
    group.create_virtual_dataset("Height", layout)


def _nested(group, shape):
    import h5py

    group.create_dataset("Height", shape, "i4")
    kind = h5py.h5t.py_create(h5py.vlen_dtype(h5py.string_dtype()), logical=True)
    h5py.h5a.create(group.id, b"a", kind, h5py.h5s.create_simple((1,)))


@needs_the_extra
def test_sizes_of_an_igor_wave_that_cancel_are_refused(tmp_path):
    # Regression: 2 GB of memory, as the library compares their sum with the file.
    data = bytearray(ibw())
    struct.pack_into("<2i", data, 36, 10**9, -(10**9))
    (tmp_path / "scan.ibw").write_bytes(data)
    with pytest.raises(ValueError, match=r"an Igor wave whose parts have \(.*-1000000000.*\) bytes"):
        read_height_field(tmp_path / "scan.ibw")


@needs_the_extra
@pytest.mark.parametrize("compressed", [False, True])
def test_an_archive_after_a_thumbnail_is_read(compressed, tmp_path):
    (tmp_path / "scan.zon").write_bytes(zon(compressed))
    field = read_height_field(tmp_path / "scan.zon")
    assert field.pixel_size == pytest.approx((DX, DX))
    np.testing.assert_allclose(field.heights, foreign_scans.relief(), atol=1e-3)
    if compressed:
        (tmp_path / "scan.zon").write_bytes(zon(compressed).replace(b"\x28\xb5\x2f\xfd", b"none"))
        with pytest.raises(ValueError, match="a damaged archive"):
            read_height_field(tmp_path / "scan.zon")


# How heights stand in the file → why they are refused.
STRANGE_HDF5 = {
    "chunk": (
        lambda group, shape: group.create_dataset(
            "Height", shape, "i4", chunks=(shape[0], 10**6), maxshape=(384, None)
        ),
        "got 384 × 1000000 numbers in .* kB",
    ),
    "virtual": (_virtual, "numbers are in another file"),
    "device": (
        lambda group, shape: group.create_dataset("Height", shape, "i4", external=[("/dev/zero", 0, 1536)]),
        "numbers are in another file",
    ),
    "arrays_in_arrays": (_nested, "arrays of variable length in others"),
}


@needs_the_extra
@pytest.mark.parametrize("name", STRANGE_HDF5)
def test_hdf5_that_expands_or_names_other_files_is_refused(name, tmp_path):
    import h5py

    (tmp_path / "scan.h5-jpk").write_bytes(h5_jpk())
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["heights"] = np.arange(ROWS * COLUMNS, dtype="i4")[:, None]
    with h5py.File(tmp_path / "scan.h5-jpk", "a") as file:
        group = file["Measurement_000/Channel_002"]
        del group["Height"]
        change, message = STRANGE_HDF5[name]
        change(group, (ROWS * COLUMNS, 1))
    with pytest.raises(ValueError, match=message) as caught:
        read_height_field(tmp_path / "scan.h5-jpk")
    assert "\n" not in str(caught.value)


@needs_the_extra
def test_curves_of_jpk_are_not_unpacked(tmp_path, monkeypatch):
    (tmp_path / "scan.jpk-qi-data").write_bytes(jpk(image="data-image.jpk-qi-image", curves=300_000))
    monkeypatch.setattr(reading, "MAX_SMALL_ARRAY_BYTES", 100_000)
    monkeypatch.setattr(reading, "MAX_EXPANSION", 0.1)
    check(tmp_path / "scan.jpk-qi-data")
    monkeypatch.setattr(reading, "MAX_SMALL_ARRAY_BYTES", 1000)
    with pytest.raises(ValueError, match=r"got .* kB that unpack to .* wanted at most 1.0 kB"):
        read_height_field(tmp_path / "scan.jpk-qi-data")
    (tmp_path / "scan.jpk-qi-data").write_bytes(jpk(image="data-image.other"))
    (tmp_path / "scan.jpk-force").write_bytes(jpk(image="data-image.other"))
    for name in ("scan.jpk-qi-data", "scan.jpk-force"):
        with pytest.raises(
            ValueError, match=r"an archive without an image of the heights .* save that image .* as \.jpk"
        ):
            read_height_field(tmp_path / name)


# Name → settings of the scan, fields of the image, its columns and lines, its size in µm, and what is in doubt.
# The layouts of the headers are those of files in the tests and issues of pySPM.
NANOSCOPE = {
    "whole.spm": (
        {"Scan Size": "93000 nm", "Samps/line": 16, "Lines": 16, "Aspect Ratio": "1:1"},
        {"Aspect Ratio": "1:1", "Scan Size": "93 93 ~m"},
        (16, 16),
        (93, 93),
        None,
    ),
    "stopped.spm": (
        {"Scan Size": "300 nm", "Samps/line": 32, "Lines": 32, "Aspect Ratio": "1:1"},
        {"Aspect Ratio": "0.516184", "Scan Size": "300 300 nm", "Valid data len X": 32, "Valid data len Y": 22},
        (32, 22),
        (0.300, 0.300 * 22 / 32),
        "Aspect Ratio: 0.516184, .* Number of lines: 22, .* taken as 32 × 22 pixels on 300 × 206.2 nm; pixel_size",
    ),
    "two_to_one.spm": (
        {"Scan Size": "10000 nm", "Samps/line": 32, "Lines": 16, "Aspect Ratio": "2:1"},
        {"Aspect Ratio": "2:1", "Scan Size": "10 10 ~m"},
        (32, 16),
        (10, 5),
        None,
    ),
    "two_to_one_of_a_square.spm": (
        {"Scan Size": "10000 nm", "Samps/line": 32, "Lines": 32, "Aspect Ratio": "1:1"},
        {"Aspect Ratio": "2:1", "Scan Size": "10 10 ~m"},
        (32, 16),
        (10, 5),
        None,
    ),
    "two_to_one_as_set.spm": (
        {"Scan Size": "10000 nm", "Samps/line": 32, "Lines": 16, "Aspect Ratio": "2:1"},
        {"Aspect Ratio": "1:1", "Scan Size": "10 10 ~m"},
        (32, 16),
        (10, 5),
        "Aspect Ratio: 1:1, .* as set: Aspect Ratio: 2:1",
    ),
    "two_to_one_in_full.spm": (
        {"Scan Size": "10000 nm", "Samps/line": 32, "Lines": 16, "Aspect Ratio": "2:1"},
        {"Aspect Ratio": "2:1", "Scan Size": "10 5 ~m"},
        (32, 16),
        (10, 5),
        None,
    ),
    "two_to_one.004": ({}, {"Aspect ratio": "2:1", "Scan size": "10 ~m"}, (32, 16), (10, 5), None),
    "slow_axis.spm": (
        {"Scan Size": "10000 nm", "Slow Axis Size": "5000 nm", "Samps/line": 32, "Lines": 16, "Aspect Ratio": "2:1"},
        {"Aspect Ratio": "2:1", "Scan Size": "10 10 ~m"},
        (32, 16),
        (10, 5),
        None,
    ),
    "slow_axis_stopped.spm": (
        {"Scan Size": "10000 nm", "Slow Axis Size": "10000 nm", "Samps/line": 32, "Lines": 32, "Aspect Ratio": "1:1"},
        {"Aspect Ratio": "0.516184", "Scan Size": "10 10 ~m"},
        (32, 22),
        (10, 10 * 22 / 32),
        None,
    ),
    "oblong_pixels.spm": (
        {"Scan Size": "600 nm", "Samps/line": 32, "Lines": 16, "Aspect Ratio": "1:1"},
        {"Aspect Ratio": "1:1", "Scan Size": "600 600 nm"},
        (32, 16),
        (0.6, 0.6),
        None,
    ),
    "half_of_the_lines.spm": (
        {"Scan Size": "600 nm", "Samps/line": 32, "Lines": 32, "Aspect Ratio": "1:1"},
        {"Aspect Ratio": "1:1", "Scan Size": "600 600 nm"},
        (32, 16),
        (0.6, 0.6),
        "taken as 32 × 16 pixels on 600 × 600 nm",
    ),
    "enlarged.spm": (
        {"Scan Size": "600 nm", "Samps/line": 32, "Lines": 32, "Aspect Ratio": "1:1"},
        {"Aspect Ratio": "1:1", "Scan Size": "300 300 nm"},
        (16, 16),
        (0.3, 0.3),
        None,
    ),
    # The image section has the lines of a square, the settings half of those that there are.
    "sixteen_to_one.001": (
        {"Scan size": "65000 nm", "Samps/line": 64, "Lines": 2, "Aspect ratio": "16:1"},
        {"Aspect ratio": "1:1", "Scan size": "65 65 ~m", "Valid data len X": 64, "Valid data len Y": 4},
        (64, 4),
        (65, 65 / 16),
        "Number of lines: 64, Valid data len Y: 4; as set: Aspect Ratio: 16:1, .* taken as 64 × 4 pixels",
    ),
}


@needs_the_extra
@pytest.mark.parametrize("name", INSTRUMENTS)
def test_kinds_that_the_library_misreads_are_read_right(name, tmp_path):
    write, settings = INSTRUMENTS[name]
    (tmp_path / name).write_bytes(write(**settings))
    check(tmp_path / name, settings.get("missing", ()))


@needs_the_extra
@pytest.mark.parametrize("name", NANOSCOPE)
def test_a_part_of_a_scan_has_its_own_size(name, tmp_path):
    settings, image, (columns, lines), size, doubt = NANOSCOPE[name]
    row, column = np.mgrid[:lines, :columns]
    heights = 0.1 + 0.004 * row + 0.01 * column
    whole = foreign_scans.nanoscope(heights, settings, image, (64, 64) if columns == 64 else None)
    (tmp_path / name).write_bytes(whole)
    with pytest.warns(UserWarning, match=doubt) if doubt else nullcontext():
        field = read_height_field(tmp_path / name)
    assert field.shape == (lines, columns)
    assert field.tile_size == pytest.approx(size)
    np.testing.assert_allclose(field.heights, heights, atol=2e-5)
    assert read_height_field(tmp_path / name, pixel_size=0.3).pixel_size == (0.3, 0.3)


@needs_the_extra
@pytest.mark.filterwarnings("ignore:.*disagree")
@pytest.mark.parametrize("name", ["stopped.spm", "sixteen_to_one.001"])
def test_a_damaged_header_gives_heights_or_one_line(name, tmp_path):
    settings, image, (columns, lines), *_ = NANOSCOPE[name]
    whole = foreign_scans.nanoscope(np.ones((lines, columns)), settings, image)
    lengths = range(0, len(whole), 97)
    changed = [re.sub(rb"(?<=: )[^\r]+", new, whole, count=n) for new in (b"", b"-1", b"0", b"x") for n in range(1, 20)]
    for content in [*(whole[:length] for length in lengths), *changed]:
        (tmp_path / name).write_bytes(content)
        message = ""
        try:
            read_height_field(tmp_path / name)
        except ValueError as error:
            message = str(error)
        assert "\n" not in message


@pytest.mark.parametrize("encoding", ["utf-8", "cp1252"])
@pytest.mark.parametrize("comma", [False, True])
@pytest.mark.parametrize("name", LANGUAGES)
def test_the_export_of_gwyddion_is_read_in_any_language(name, comma, encoding, tmp_path):
    text = foreign_scans.gwyddion_text(LANGUAGES[name], comma)
    if name.startswith("chinese") and encoding != "utf-8":
        return
    (tmp_path / name).write_bytes(text.encode(encoding))
    check(tmp_path / name)


@needs_the_extra
@pytest.mark.parametrize(
    "name",
    [
        "no_comment.tmd",
        "compressed.sur",
        "heights_as_text.x3p",
        "en_dash.x3p",
        "int16.tiff",
        "image.jpk",
        "curves.jpk-qi-data",
    ],
)
def test_what_is_not_read_is_refused_in_one_line(name, tmp_path):
    write, settings = INSTRUMENTS[name]
    whole = write(**settings)
    for part in (whole[: len(whole) // 2], whole[:40], b"PK\3\4" + bytes(64), b"none of them" + bytes(64)):
        (tmp_path / name).write_bytes(part)
        with pytest.raises(ValueError, match=name) as caught:
            read_height_field(tmp_path / name)
        assert "\n" not in str(caught.value)
        assert "damaged one" not in str(caught.value)


@pytest.mark.parametrize("mark", [" ", ";"])
def test_whole_numbers_stand_among_those_with_decimal_commas(mark, tmp_path):
    lines = [
        mark.join((f"{x}", f"{y}", f"{0.1 * x + 0.2 * y:g}".replace(".", ","))) for y in range(3) for x in range(4)
    ]
    (tmp_path / "scan.xyz").write_text("\n".join(lines))
    with pytest.warns(UserWarning, match="whole numbers, which may be those of pixels"):
        field = read_height_field(tmp_path / "scan.xyz", unit="um")
    assert field.pixel_size == pytest.approx((1, 1))
    assert np.ptp(field.heights) == pytest.approx(0.7)
    (tmp_path / "both.xyz").write_text("0 0 1,000\n1 0 1.5\n0 1 2\n1 1 2")
    with pytest.raises(ValueError, match="not a table of numbers"):
        read_height_field(tmp_path / "both.xyz", unit="um")


@pytest.mark.parametrize("text", ["1,2\n3,4\n5\n", "1,2\n3,4,\n5,6\n"])
def test_damaged_lines_with_commas_are_no_decimals(text, tmp_path):
    (tmp_path / "scan.asc").write_text(text)
    with pytest.raises(ValueError, match="not a table of numbers"):
        read_height_field(tmp_path / "scan.asc", unit="um", pixel_size=1.0)
