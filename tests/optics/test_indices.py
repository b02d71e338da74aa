"""Refractive indices: names against published values, files as refractiveindex.info and Mitsuba write them."""

import re
from pathlib import Path

import numpy as np
import pytest

from mitsuba_diffraction.optics.materials import DISPERSION, index_of, read_index, refractive_index

PUBLISHED = [
    # name, µm, n, within; sources beside them
    ("BK7", 0.58756, 1.5168, 1e-4),  # Schott's n_d
    ("BK7", 0.48613, 1.52238, 1e-4),  # n_F
    ("BK7", 0.65627, 1.51432, 1e-4),  # n_C
    ("fused silica", 0.58756, 1.45846, 1e-4),  # Malitson's table
    ("fused_silica", 0.365015, 1.47453, 1e-4),
    ("polycarbonate", 0.5876, 1.585, 2e-3),  # data sheets of Makrolon and Lexan
    ("pmma", 0.5876, 1.4914, 2e-3),  # data sheets
    ("water", 0.58929, 1.33335, 1e-4),  # at 20 °C, Daimon and Masumura's table
    # Leertouwer, Wilts and Stavenga 2011, in the abstract.
    ("chitin", 0.4, 1.572, 5e-4),
    ("chitin", 0.5, 1.552, 5e-4),
    ("chitin", 0.6, 1.541, 5e-4),
    ("keratin", 0.4, 1.569, 5e-4),
    ("keratin", 0.5, 1.556, 5e-4),
    ("keratin", 0.6, 1.548, 5e-4),
]


@pytest.mark.parametrize(("name", "wavelength", "n", "within"), PUBLISHED)
def test_media_have_their_published_indices(name, wavelength, n, within):
    found = index_of("int_ior", name)
    assert found(wavelength).real == pytest.approx(n, abs=within)
    assert not found.absorbs


def test_the_manual_lists_the_media():
    page = (Path(__file__).parents[2] / "docs" / "plugin.md").read_text()
    rows = dict(re.findall(r"^\| `(\w+)` \| (1\.[\d., ]+) \|", page, re.MULTILINE))
    assert rows.keys() == DISPERSION.keys()
    for name, values in rows.items():
        found = index_of("int_ior", name)(np.array([0.4, 0.55, 0.7])).real
        assert values == ", ".join(f"{n:.4f}" for n in found)


def write(tmp_path, name, text):
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    return path


N = "wl,n\n0.4,1.5\n0.8,1.6\n"
YML = "DATA:\n  - type: {}\n"
FILES = [
    ("a.csv", N, 1.55),
    ("a.csv", "\ufeffwl,n,k\n0.4,1.5,0.1\n0.8,1.6,0.3\n", 1.55 + 0.2j),
    ("a.csv", N + "\nwl,k\n0.4,0.1\n0.6,0.5\n0.8,0.1\n", 1.55 + 0.5j),
    ("a.spd", "# nm, n\n400 1.5\n800 1.6\n", 1.55),
    ("a.spd", "400 1.5 0.1\n800 1.6 0.3\n", 1.55 + 0.2j),
    ("a.yml", YML.format("tabulated nk\n    data: |\n        0.4 1.5 0.1\n        0.8 1.6 0.3"), 1.55 + 0.2j),
    ("a.yml", YML.format("tabulated n\n    data: |\n        0.4 1.5\n        0.8 1.6"), 1.55),
    # n² = 1 + 1.25 at the infinite λ of the poles: 1 + 1.25 λ²/(λ² − 0)
    (
        "a.yml",
        YML.format("formula 1\n    wavelength_range: 0.4 0.8\n    coefficients: 0 1 0.1 0.25 0.2"),
        np.sqrt(1 + 1 * 0.36 / (0.36 - 0.01) + 0.25 * 0.36 / (0.36 - 0.04)),
    ),
    (
        "a.yml",
        YML.format("formula 2\n    wavelength_range: 0.4 0.8\n    coefficients: 0 1 0.01 0.25 0.04"),
        np.sqrt(1 + 1 * 0.36 / (0.36 - 0.01) + 0.25 * 0.36 / (0.36 - 0.04)),
    ),
    (
        "a.yml",
        YML.format("formula 3\n    wavelength_range: 0.4 0.8\n    coefficients: 2.25 -0.01 2 0.02 -2"),
        np.sqrt(2.25 - 0.01 * 0.36 + 0.02 / 0.36),
    ),
    (
        "a.yml",
        YML.format("formula 5\n    wavelength_range: 0.4 0.8\n    coefficients: 1.5 0.004 -2")
        + "  - type: tabulated k\n    data: |\n        0.3 0.2\n        0.9 0.2\n",
        1.5 + 0.004 / 0.36 + 0.2j,
    ),
]


@pytest.mark.parametrize(("name", "text", "wanted"), FILES)
def test_a_file_has_its_index(tmp_path, name, text, wanted):
    found = read_index(write(tmp_path, name, text))
    assert found.range == (400.0, 800.0)
    tolerance = 1e-6 if name == "a.yml" else 1e-12
    assert complex(found(0.6)) == pytest.approx(complex(wanted), abs=tolerance)


def test_k_of_a_second_file_is_read(tmp_path):
    write(tmp_path, "gold.k.spd", "300 3\n900 3\n")
    assert complex(read_index(write(tmp_path, "gold.eta.spd", "400 0.2\n800 0.4\n"))(0.6)) == pytest.approx(0.3 + 3j)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.csv", "", "wanted n"),
        ("a.spd", "", "got no numbers"),
        ("a.yml", "", "not a table of refractive indices"),
        ("a.csv", "0.4,1.5\n", "wanted a header 'wl,n'"),
        (
            "a.csv",
            "wl,n\n400,1.5\n800,1.6\n",
            r"got wavelengths from 400 to 800 µm: a table in nm\?",
        ),
        ("a.spd", "0.4 1.5\n0.8 1.6\n", r"got wavelengths from 0.4 to 0.8 nm: a table in µm\? .spd files have nm"),
        ("a.csv", "wl,n,k\n0.4,1.5,-0.1\n0.8,1.6,0\n", "got k = -0.1, wanted k from 0 to 100"),
        ("a.csv", "wl,n\n0.4,1.5\n0.3,1.6\n", "wavelengths of n that do not ascend"),
        ("a.csv", "wl,n\n0.4,nan\n0.8,1.6\n", "not finite"),
        ("a.csv", N + "\nwl,k\n0.5,0.1\n0.8,0.1\n", "got n from 400 to 800 nm and k from 500 to 800 nm"),
        ("a.csv", "wl,n\n0.4,1.5,2\n", "not a table"),
        ("a.csv", "wl,n\n0.4,x\n", "not a table"),
        ("a.yml", YML.format("formula 7\n    wavelength_range: 0.4 0.8\n    coefficients: 1"), "dispersion formula 7"),
        ("a.yml", "DATA: [", "not YAML"),
        ("a.spd", "400\n800\n", "one column"),
    ],
)
def test_wrong_files_are_refused_in_one_line(tmp_path, name, text, message):
    path = write(tmp_path, name, text)
    with pytest.raises(ValueError, match=message) as error:
        read_index(path)
    assert str(error.value).startswith(f"{path}: ")
    assert "\n" not in str(error.value)
    with pytest.raises(FileNotFoundError, match="no such file"):
        read_index(tmp_path / "b.csv")


def test_a_file_is_read_again_where_it_has_changed(tmp_path):
    path = write(tmp_path, "a.csv", N)
    assert read_index(path)(0.6).real == pytest.approx(1.55)
    write(tmp_path, "a.csv", "wl,n\n0.40,1.7\n0.80,1.7\n")
    assert read_index(path)(0.6).real == pytest.approx(1.7)


def test_light_outside_of_a_file_is_refused_by_name(tmp_path):
    path = write(tmp_path, "a.csv", N)
    assert refractive_index(0.6, int_ior=str(path), known=True) == pytest.approx(1.55)
    with pytest.raises(ValueError, match=r"int_ior: got '.+a\.csv' at 900 nm, wanted a wavelength from 400 to 800 nm"):
        refractive_index(0.9, int_ior=str(path), known=True)
    with pytest.raises(ValueError, match=r"int_ior: got 'glass', wanted a number, a file or one of BK7"):
        refractive_index(0.6, int_ior="glass")
