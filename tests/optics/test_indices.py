"""Refractive indices: names against published values, files as refractiveindex.info and Mitsuba write them."""

import re
import warnings
from pathlib import Path

import numpy as np
import pytest

from mitsuba_diffraction.optics.refractive_indices import DISPERSION, index_of, read_index, refractive_index

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
    page = (Path(__file__).parents[2] / "docs" / "materials.md").read_text()
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


def by_hand(number, c, x):
    """n of a formula of refractiveindex.info, from its document, coefficient by coefficient."""
    c = [0.0, *c, *[0.0] * (18 - len(c))]
    if number in (1, 2):
        poles = [c[i] ** (2 if number == 1 else 1) for i in range(3, 18, 2)]
        return np.sqrt(1 + c[1] + sum(c[2 + 2 * i] / (1 - pole / x**2) for i, pole in enumerate(poles)))
    if number in (3, 5):
        n = c[1] + sum(c[i] * x ** c[i + 1] for i in range(2, 17, 2))
        return np.sqrt(n) if number == 3 else n
    if number == 4:
        n = c[1] + c[2] * x ** c[3] / (x**2 - c[4] ** c[5]) + c[6] * x ** c[7] / (x**2 - c[8] ** c[9])
        return np.sqrt(n + sum(c[i] * x ** c[i + 1] for i in range(10, 17, 2)))
    if number == 6:
        return 1 + c[1] + sum(c[i] / (c[i + 1] - x**-2) for i in range(2, 17, 2))
    if number == 7:
        return c[1] + c[2] / (x**2 - 0.028) + c[3] / (x**2 - 0.028) ** 2 + c[4] * x**2 + c[5] * x**4 + c[6] * x**6
    if number == 8:
        lorentz = c[1] + c[2] * x**2 / (x**2 - c[3]) + c[4] * x**2
        return np.sqrt((1 + 2 * lorentz) / (1 - lorentz))
    return np.sqrt(c[1] + c[2] / (x**2 - c[3]) + c[4] * (x - c[5]) / ((x - c[5]) ** 2 + c[6]))


FORMULAS = [
    (1, "0.1 0.6 0.07 0.4 0.12 0.9 9.9"),
    (2, "0.2 1.1 0.02 0.3"),  # the pole of the last term is 0
    (3, "2.7 -0.01 2 0.02 -2 1e-3 -4 0.05"),
    (4, "2.2 0.3 1 0.1 2 0.02 2 9 2 -0.01 2 0.003 -4"),
    (4, "2.7 0.02 0 0.12 2"),  # at 1 µm a term without coefficients would be 0/0
    (5, "1.5 0.004 -2 1e-4 -4"),
    (6, "0 0.06 238 0.002 57"),
    (7, "3.4 0.14 0.03 -1e-3 1e-4 -1e-5"),
    (8, "0.3 0.1 0.02 -1e-3"),
    (9, "2.5 0.02 0.05 0.01 0.2 0.3"),
]


@pytest.mark.parametrize(("number", "coefficients"), FORMULAS)
def test_a_formula_has_its_index(tmp_path, number, coefficients):
    # Known to 400 µm, which leaves its rows in visible light as near to each other, where it is one number there.
    first, last = 0.3, 400.0 if number in (1, 5, 6) else 1.4
    text = f"formula {number}\n    wavelength_range: {first} {last}\n    coefficients: {coefficients}"
    found = read_index(write(tmp_path, "a.yml", YML.format(text)))
    x = np.random.default_rng(3).uniform(0.4, 1.4, 200)
    # Linear between rows of 1 nm: h² n″/8 where the index rises fastest.
    np.testing.assert_allclose(found(x), by_hand(number, [*map(float, coefficients.split())], x), rtol=1e-5)


NK = YML.format("tabulated nk\n    data: |\n        {}")
PAGES = {
    # text, range in nm, n + ik at 0.6 µm
    "k narrower than n": (
        YML.format("tabulated n\n    data: |\n        0.2 1.5\n        1.0 1.9\n")
        + "  - type: tabulated k\n    data: |\n        0.31 0.2\n        0.7 0.2\n",
        (310, 700),
        1.7 + 0.2j,
    ),
    "metal of the far infrared": (
        NK.format("0.4 1.0 6.0\n        0.8 2.0 8.0\n        200 300 420"),
        (400, 2e5),
        1.5 + 7j,
    ),
    "equal rows": (
        NK.format("0.4 1.6 0.1\n        0.6 1.5 0.3\n        0.6 1.5 0.3\n        1 1 0"),
        (400, 1e3),
        1.5 + 0.3j,
    ),
    "nearly equal rows": (
        NK.format("0.4 1.6 0.1\n        0.6 1.5 0.3\n        0.6 1.52 0.304\n        1 1 0"),
        (400, 1e3),
        1.51 + 0.302j,
    ),
    "noise about k = 0": (NK.format("0.4 1.6 0.1\n        0.6 1.5 -0.0002\n        1 1 -0.004"), (400, 1e3), 1.5),
    "by photon energy": (NK.format("1 1 0\n        0.6 1.5 0.1\n        0.4 1.6 0.2"), (400, 1e3), 1.5 + 0.1j),
    "exchanged rows": (
        NK.format("0.4 1.6 0\n        0.6 1.5 0.1\n        1 1 0\n        0.9 1 0\n        1.2 1 0"),
        (400, 1200),
        1.5 + 0.1j,
    ),
    "impossible outside of 0.3 to 1.1 µm": (
        NK.format("0.2 -9 0\n        0.21 1.7 0\n        0.6 1.5 0.1\n        2 1 0\n        3 1 -2\n        4 1 1"),
        (210, 2000),
        1.5 + 0.1j,
    ),
    "glass whose k ends before n": (
        YML.format("formula 5\n    wavelength_range: 0.4 0.9\n    coefficients: 1.7")
        + "  - type: tabulated k\n    data: |\n        0.5 1e-5\n        0.7 2e-8\n",
        (400, 900),
        1.7 + 5.01e-6j,
    ),
    "glass whose k is known elsewhere": (
        YML.format("formula 5\n    wavelength_range: 0.4 0.9\n    coefficients: 1.7")
        + "  - type: tabulated k\n    data: |\n        0.28 -0.0\n        0.29 -0.0\n",
        (400, 900),
        1.7,
    ),
    "one row": (NK.format("0.6 1.5 0.1"), (600, 600), 1.5 + 0.1j),
}


@pytest.mark.parametrize("page", PAGES)
def test_a_page_is_known_where_its_n_and_k_are(tmp_path, page):
    text, known, wanted = PAGES[page]
    found = read_index(write(tmp_path, "a.yml", text))
    assert found.range == pytest.approx(known)
    assert complex(found(0.6)) == pytest.approx(complex(wanted), abs=1e-12)
    assert not found.is_constant


@pytest.mark.parametrize(
    ("page", "light", "words"),
    [
        ("glass whose k ends before n", (480, 690), "no k from 400 to 500 nm, taken as 0"),
        ("glass whose k ends before n", (690, 710), "no k from 700 to 900 nm, taken as 0"),
        ("glass whose k ends before n", (500, 700), ""),
        ("glass whose k is known elsewhere", (450, 460), "no k from 400 to 900 nm, taken as 0"),
        ("noise about k = 0", (400, 800), "k down to -0.004, taken as 0"),
        ("noise about k = 0", (400, 500), ""),
    ],
)
def test_k_that_is_taken_as_zero_is_said_each_time(tmp_path, page, light, words):
    path = write(tmp_path, "a.yml", PAGES[page][0])
    for _ in range(2):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            index_of("material", path).known_range("material").check(light)
        assert [str(one.message) for one in caught] == ([f"material: a.yml has {words}"] if words else [])


@pytest.mark.parametrize("name", ["a.yml", "a.csv"])
def test_a_page_of_the_far_infrared_is_read_in_micrometres(tmp_path, name):
    # Regression: refused as a table in nm, so that n of 500 µm would have been taken at 500 nm.
    rows = "200 1.6\n        998 1.7"
    text = YML.format(f"tabulated n\n    data: |\n        {rows}") if name == "a.yml" else "wl,n\n200,1.6\n998,1.7\n"
    found = read_index(write(tmp_path, name, text))
    assert found.range == pytest.approx((2e5, 9.98e5))
    assert complex(found(599)) == pytest.approx(1.65)
    with pytest.raises(ValueError, match=r"table of 200000 to 998000 nm .*; wavelengths of \.csv and \.yml are in µm"):
        refractive_index(0.5, int_ior=str(tmp_path / name), known=True)


def test_a_second_file_of_k_that_changes_is_read_again(tmp_path):
    path = write(tmp_path, "gold.eta.spd", "400 0.2\n800 0.4\n")
    for k in (3.0, 4.5):
        write(tmp_path, "gold.k.spd", f"300 {k}\n900 {k}\n{'1000 1' if k > 4 else ''}")
        assert complex(read_index(path)(0.6)) == pytest.approx(0.3 + 1j * k)


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
        ("a.spd", "0.4 1.5\n0.8 1.6\n", r"got wavelengths from 0.4 to 0.8 nm: a table in µm\? .spd files have nm"),
        ("a.csv", "wl,n,k\n0.4,1.5,-0.1\n0.8,1.6,0\n", "got k = -0.1, wanted k from 0 to 100"),
        ("a.csv", N + N[5:] + N[5:], "neither ascend nor descend"),
        ("a.csv", "wl,n\n0.4,1.5\n0.4,1.7\n0.8,1.6\n", r"got n = 1\.5 and 1\.7 at 400 nm"),
        ("a.csv", "wl,n\n0.4,nan\n0.8,1.6\n", "got n = nan, wanted n from 0.01 to 100"),
        ("a.csv", "wl,n\nnan,1.5\n0.8,1.6\n", "wavelengths of n that are not positive numbers"),
        ("a.csv", "wl,n\n3,nan\n8,1.6\n", "got n = nan"),
        ("a.csv", N + "\nwl,k\n0.9,0.1\n1.8,0.1\n", "got n from 400 to 800 nm and k from 900 to 1800 nm"),
        ("a.csv", "wl,n\n0.4,1.5,2\n", "not a table"),
        ("a.csv", "wl,n\n0.4,x\n", "not a table"),
        (
            "a.yml",
            YML.format("formula 10\n    wavelength_range: 0.4 0.8\n    coefficients: 1"),
            "dispersion formula 10",
        ),
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


@pytest.mark.parametrize(
    ("name", "offered"),
    [
        *((name, "") for name in ("iron", "steel", "Fe", "Si", "silicon", "Al2O3", "glass")),
        *(("aluminum", "Al"), ("Alu", "Al"), ("alumnium", "Al"), ("al", "Al"), ("Al_palik", "Al"), ("ag", "Ag")),
        *(("Ni", "Ni_palik"), ("nickle", "Ni_palik"), ("chrom", "Cr"), ("cu2o", "Cu2O or Cu2O_palik")),
    ],
)
def test_a_conductor_is_offered_by_meaning(name, offered):
    with pytest.raises(ValueError, match=f"material: got '{name}', ") as error:
        index_of("material", name)
    message = str(error.value)
    if offered:
        assert message.endswith(f"did you mean {offered}")
    else:
        assert "did you mean" not in message
        assert message.endswith("or a file, such as a page of refractiveindex.info (.yml)")


def test_a_metal_that_ends_in_the_infrared_says_where_another_index_is():
    with pytest.raises(ValueError, match=r"light of 1064 nm, .* \(Al\).* a page of refractiveindex\.info"):
        refractive_index(1.064, material="Al", known=True)


def test_a_file_is_read_again_where_it_has_changed(tmp_path):
    path = write(tmp_path, "a.csv", N)
    assert read_index(path)(0.6).real == pytest.approx(1.55)
    write(tmp_path, "a.csv", "wl,n\n0.40,1.7\n0.80,1.7\n")
    assert read_index(path)(0.6).real == pytest.approx(1.7)


def test_light_outside_of_a_file_is_refused_by_name(tmp_path):
    path = write(tmp_path, "a.csv", N)
    assert refractive_index(0.6, int_ior=str(path), known=True) == pytest.approx(1.55)
    with pytest.raises(ValueError, match=r"int_ior: got light of 900 nm, and a table of 400 to 800 nm \(a\.csv\)"):
        refractive_index(0.9, int_ior=str(path), known=True)
    with pytest.raises(ValueError, match=r"int_ior: got 'glass', wanted a number, a file or one of BK7"):
        refractive_index(0.6, int_ior="glass")
