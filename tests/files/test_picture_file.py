"""Pictures of users: which files are pictures, and what their numbers mean."""

import numpy as np
import pytest
from PIL import EpsImagePlugin, Image

from mitsuba_diffraction.files import picture_file
from mitsuba_diffraction.files.picture_file import read_picture


def test_postscript_is_not_run(tmp_path, monkeypatch):
    def run(*arguments, **options):
        raise AssertionError("Ghostscript was started")

    monkeypatch.setattr(EpsImagePlugin, "Ghostscript", run)
    Image.new("RGB", (8, 8), (200, 10, 10)).save(tmp_path / "a.eps")
    (tmp_path / "a.eps").rename(tmp_path / "a.png")
    with pytest.raises(ValueError, match=r"a\.png: not a picture that can be read .* wanted PNG, JPEG"):
        read_picture(tmp_path / "a.png")


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_a_tiff_whose_zero_is_white_is_no_negative(kind, tmp_path):
    maximum = np.iinfo(kind).max
    stored = np.array([[0, maximum // 3, maximum]], kind)
    # Of 8 bits, Pillow inverts what it writes, too.
    Image.fromarray(stored if kind == np.uint16 else maximum - stored).save(tmp_path / "a.tif", tiffinfo={262: 0})
    dark = ((2 / 3 + 0.055) / 1.055) ** 2.4
    np.testing.assert_allclose(read_picture(tmp_path / "a.tif"), [[1, dark, 0]], atol=0.01)
    np.testing.assert_allclose(read_picture(tmp_path / "a.tif", invert=True)[0, [0, 2]], [0, 1])


def test_a_large_picture_is_reduced_to_means(tmp_path, monkeypatch):
    rows, columns = np.mgrid[:7, :10]
    colours = np.stack([20 * rows, 25 * columns, 9 * rows + 9 * columns], -1).astype(np.uint8)
    Image.fromarray(colours).save(tmp_path / "a.png")
    whole = read_picture(tmp_path / "a.png")
    monkeypatch.setattr(picture_file, "MAX_EDGE", 4)  # three pixels become one
    monkeypatch.setattr(picture_file, "_PIXELS_PER_STRIP", 40)
    means = [[whole[y : y + 3, x : x + 3].mean((0, 1)) for x in range(0, 10, 3)] for y in range(0, 7, 3)]
    np.testing.assert_allclose(read_picture(tmp_path / "a.png"), means, rtol=1e-12)


def test_a_picture_of_too_many_pixels_is_refused_before_it_is_unpacked(tmp_path, monkeypatch):
    monkeypatch.setattr(picture_file, "MAX_PICTURE_PIXELS", 99)
    Image.new("L", (10, 10)).save(tmp_path / "a.png")
    with pytest.raises(ValueError, match=r"a\.png: got 10 × 10 pixels, wanted at most 99"):
        read_picture(tmp_path / "a.png")
