"""Instruments' files of kinds that SurfaceTopography misreads or refuses, or that need a language."""

import foreign_scans
import numpy as np
import pytest
from foreign_scans import COLUMNS, DX, DY, REVISION, ROWS, nms, park, sur, tmd, x3p
from test_instrument_files import needs_the_extra

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


@needs_the_extra
@pytest.mark.parametrize("name", INSTRUMENTS)
def test_kinds_that_the_library_misreads_are_read_right(name, tmp_path):
    write, settings = INSTRUMENTS[name]
    (tmp_path / name).write_bytes(write(**settings))
    check(tmp_path / name, settings.get("missing", ()))


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
    "name", ["no_comment.tmd", "compressed.sur", "heights_as_text.x3p", "en_dash.x3p", "int16.tiff"]
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
    field = read_height_field(tmp_path / "scan.xyz", unit="um")
    assert field.pixel_size == pytest.approx((1, 1))
    assert np.ptp(field.heights) == pytest.approx(0.7)
    (tmp_path / "both.xyz").write_text("0 0 1,000\n1 0 1.5\n0 1 2\n1 1 2")
    with pytest.raises(ValueError, match="not a table of numbers"):
        read_height_field(tmp_path / "both.xyz", unit="um")


@pytest.mark.parametrize("text", ["1,2\n3,4\n5\n", "1,2\n3,\n5,6\n"])
def test_damaged_lines_with_commas_are_no_decimals(text, tmp_path):
    (tmp_path / "scan.asc").write_text(text)
    with pytest.raises(ValueError, match="not a table of numbers"):
        read_height_field(tmp_path / "scan.asc", unit="um", pixel_size=1.0)
