"""The table of orders: NIST's coupled waves, Fresnel's formulas, energy, reciprocity, directions, and the command."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest

import mitsuba_diffraction as md
from mitsuba_diffraction.export.exported_grating import ExportedGrating
from mitsuba_diffraction.export.order_table import write_order_table
from mitsuba_diffraction.optics.geometry import fresnel
from mitsuba_diffraction.optics.media import MediumBelow

SCATMECH = json.loads((Path(__file__).parents[1] / "data" / "scatmech_orders.json").read_text(encoding="utf-8"))


def rows_of(path):
    """The rows of a file, with numbers as numbers."""
    with open(path, newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(line for line in file if not line.startswith("#")))
    words = ("side", "polarisation")
    return [{name: text if name in words else float(text or "nan") for name, text in row.items()} for row in rows]


def table(path, surface, wavelengths, angles, azimuths=0.0, theory="rigorous", material=None, int_ior=None):
    grating = ExportedGrating(surface, theory, MediumBelow.of(material, int_ior), np.min(wavelengths) * 1e-3)
    count = write_order_table(grating, path, wavelengths, angles, azimuths)
    rows = rows_of(path)
    assert len(rows) == count
    return rows


def chosen(rows, **values):
    return [row for row in rows if all(row[name] == value for name, value in values.items())]


def triangle(samples=1000, apex=0.8):
    x = (np.arange(samples) + 0.5) / samples
    return md.HeightField(
        0.2 * np.where(x < apex, x / apex, (1 - x) / (1 - apex))[None], (1 / samples, 1.0), "triangle"
    )


PROFILES = {
    "sinusoidal": lambda: md.gratings.sinusoidal(1.0, 0.2),
    "triangular": triangle,
    "lamellar": lambda: md.gratings.lamellar(1.0, 0.2, duty=0.4, samples=4000),
}


_PAULI = np.array([[[1, 0], [0, 1]], [[1, 0], [0, -1]], [[0, 1], [1, 0]], [[0, 1j], [-1j, 0]]])


@pytest.mark.few(5)
@pytest.mark.parametrize(
    "case", SCATMECH, ids=lambda case: "{profile}-{index}-{type}-{angle}-{rotation}".format(**case)
)
def test_efficiencies_and_amplitudes_agree_with_scatmech(case, tmp_path):
    index = complex(*case["index"])
    surface, wavelength = PROFILES[case["profile"]](), 1e3 * case["wavelength"]
    # Its azimuth has the other sign, and so has its last Stokes parameter.
    rows = table(tmp_path / "t.csv", surface, wavelength, case["angle"], -case["rotation"], int_ior=index)
    rows = chosen(rows, side=("reflected", "transmitted")[case["type"]])
    mirror = np.diag([1, 1, 1, -1])
    wanted = {int(m): mirror @ np.reshape(values, (4, 4)) @ mirror for m, values in case["mueller"].items()}
    total, steps = sum(matrix[0, 0] for matrix in wanted.values()), case["profile"] != "lamellar"
    for name, sign in (("s", 1), ("p", -1), ("mean", 0)):
        found = {int(row["m"]): row["efficiency"] for row in chosen(rows, polarisation=name)}
        assert found.keys() == wanted.keys()
        error = sum(abs(found[m] - matrix[0, 0] - sign * matrix[0, 1]) for m, matrix in wanted.items()) / total
        # It has 150 steps in the place of a slope, and the fields of a metal with edges converge slowly.
        assert error < (1e-2 if index.imag else 5e-3 if steps else 3e-3), name
    for m, matrix in wanted.items():
        s, p = (chosen(rows, polarisation=name, m=m)[0] for name in "sp")
        jones = np.array([[row[f"to_{to}_re"] + 1j * row[f"to_{to}_im"] for row in (s, p)] for to in "sp"])
        found = np.einsum("iab,bc,jcd,ad->ij", _PAULI, jones, _PAULI, jones.conj()).real / 2
        assert np.abs(found - matrix).max() < (0.03 if steps else 5e-3) * total


def test_amplitudes_of_a_plane_are_those_of_fresnel(tmp_path):
    n, angle = 1.5, 40
    rows = table(tmp_path / "t.csv", md.gratings.sinusoidal(1.0, 0.0), 500, angle, 30, int_ior=n)
    i, o = np.cos(np.deg2rad(angle)), np.sqrt(1 - (np.sin(np.deg2rad(angle)) / n) ** 2)
    root = np.sqrt(n * o / i)  # of the power of unit amplitudes
    expected = {
        ("reflected", "s"): [(i - n * o) / (i + n * o), 0, 0, 0],
        ("reflected", "p"): [0, 0, (n * i - o) / (n * i + o), 0],
        ("transmitted", "s"): [2 * i / (i + n * o) * root, 0, 0, 0],
        ("transmitted", "p"): [0, 0, 2 * i / (n * i + o) * root, 0],
    }
    for (side, polarisation), amplitudes in expected.items():
        (row,) = chosen(rows, side=side, polarisation=polarisation, m=0)
        found = [row[name] for name in ("to_s_re", "to_s_im", "to_p_re", "to_p_im")]
        np.testing.assert_allclose(found, amplitudes, atol=1e-8)
        assert row["efficiency"] == pytest.approx(np.square(amplitudes).sum(), abs=1e-8)


@pytest.mark.parametrize("material", [{"int_ior": 1.5}, {"material": "Al"}])
def test_power_is_what_the_material_leaves_and_light_may_be_reversed(material, tmp_path):
    surface, angle, azimuth = md.gratings.blazed(1.1, 0.3), 35.0, 25.0
    rows = table(tmp_path / "t.csv", surface, 600, angle, azimuth, **material)
    for name in ("s", "p", "mean"):
        total = sum(row["efficiency"] for row in chosen(rows, polarisation=name))
        assert total == pytest.approx(1, abs=1e-5) if "int_ior" in material else 0.7 < total < 0.97
    for row in rows:
        if row["polarisation"] != "mean":
            squares = sum(row[f"to_{name}_{part}"] ** 2 for name in "sp" for part in ("re", "im"))
            assert squares == pytest.approx(row["efficiency"], abs=1e-8)
    (order,) = chosen(rows, polarisation="mean", side="reflected", m=1)
    back = np.rad2deg([np.arccos(order["w"]), np.arctan2(-order["v"], -order["u"])])
    reversed_rows = table(tmp_path / "r.csv", surface, 600, *back, **material)
    (again,) = chosen(reversed_rows, polarisation="mean", side="reflected", m=1)
    assert again["efficiency"] == pytest.approx(order["efficiency"], rel=2e-3)
    light = -np.array([np.sin(np.deg2rad(angle)) * f(np.deg2rad(azimuth)) for f in (np.cos, np.sin)])
    np.testing.assert_allclose([again["u"], again["v"]], light, atol=1e-8)


@pytest.mark.parametrize("theory", ["scalar", "rigorous"])
def test_directions_follow_the_grating_equation(theory, tmp_path):
    wavelength, period, n = 0.5, 0.8, 1.6
    surface = md.gratings.sinusoidal(period, 0.1)
    rows = table(tmp_path / "t.csv", surface, 1e3 * wavelength, [0, 50], [0, 70], theory, int_ior=n)
    for row in rows:
        index, sign = {"reflected": (1, 1), "transmitted": (n, -1)}[row["side"]]
        theta, phi = np.deg2rad([row["theta_deg"], row["phi_deg"]])
        expected = np.array([np.sin(theta) * np.cos(phi) - row["m"] * wavelength / period, np.sin(theta) * np.sin(phi)])
        np.testing.assert_allclose([row["u"], row["v"]], expected / index, atol=1e-8)
        assert np.hypot(row["u"], row["v"]) ** 2 + row["w"] ** 2 == pytest.approx(1, abs=1e-7)
        assert np.sign(row["w"]) == sign
    assert len(chosen(rows, theta_deg=0, phi_deg=0, polarisation="s", side="transmitted")) == 5
    assert len(chosen(rows, theta_deg=0, phi_deg=0, polarisation="s", side="reflected")) == 3


def test_scalar_theory_agrees_with_efficiencies_and_conserves_energy(tmp_path):
    surface = md.gratings.crossed(1.6, 0.35)
    rows = table(tmp_path / "t.csv", surface, [450, 600], [0, 40], theory="scalar", int_ior=1.5)
    for side, transmission in (("reflected", "none"), ("transmitted", "interface")):
        expected = md.efficiencies(surface, [1e-9, 40], [450, 600], int_ior=1.5, transmission=transmission)
        for a, theta in enumerate((0, 40)):
            for w, wavelength in enumerate((450, 600)):
                of_light = chosen(rows, side=side, theta_deg=theta, wavelength_nm=wavelength)
                everything = chosen(rows, theta_deg=theta, wavelength_nm=wavelength, polarisation="mean")
                total = sum(row["efficiency"] for row in everything)
                assert total <= 1 + 1e-8
                for row in of_light:
                    if row["polarisation"] == "s":
                        whole = expected.order(int(row["m"]), int(row["n"]))[a, w, 0]
                        assert row["efficiency"] == pytest.approx(whole, rel=0.05 if total > 0.999 else 1e-6, abs=1e-9)
    mirror = table(tmp_path / "m.csv", surface, 550, 0, theory="scalar", material="none")
    assert sum(row["efficiency"] for row in chosen(mirror, polarisation="mean")) <= 1


def test_the_table_of_a_littrow_mounting_has_the_angle_of_each_wavelength(tmp_path):
    rows = table(tmp_path / "t.csv", md.gratings.ruled(600), [450, 600], "littrow", theory="scalar", material="Al")
    for row in chosen(rows, m=1, polarisation="mean"):
        # The order travels back: (u, v, w) is minus the direction of the light.
        theta = np.deg2rad(row["theta_deg"])
        np.testing.assert_allclose([row["u"], row["v"], row["w"]], [-np.sin(theta), 0, np.cos(theta)], atol=1e-9)
    assert {row["wavelength_nm"] for row in chosen(rows, m=1)} == {450, 600}


def test_the_command_writes_a_table(command, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    words = "blazed,period=1.2,depth=0.2,theory=rigorous,material=Al", "--wavelength", "500,600", "--angle", "0,30"
    for _ in range(2):  # what the same command wrote may be written again
        code, said, error = command("export", *words, "-o", "o.csv")
        assert (code, error) == (0, "")
    assert "Al, rigorous theory" in said
    rows = rows_of("o.csv")
    expected = md.efficiencies(md.gratings.blazed(1.2, 0.2), [0, 30], [500, 600], theory="rigorous", material="Al")
    (row,) = chosen(rows, theta_deg=30, wavelength_nm=600, m=1, polarisation="p")
    assert row["efficiency"] == pytest.approx(expected.order(1)[1, 1, 1], rel=1e-6)
    assert "# period 1.2 um along x; grooves along y; z is" in Path("o.csv").read_text()
    (plane,) = command("export", "sinusoidal,period=1,depth=0", "--wavelength", "500", "--angle", "40", "-o", "f.csv")[
        :1
    ]
    assert plane == 0
    (row,) = (
        row for row in rows_of("f.csv") if row["m"] == 0 and row["side"] == "reflected" and row["polarisation"] == "s"
    )
    assert row["efficiency"] == pytest.approx(fresnel(np.cos(np.deg2rad(40)), 1.5)[0], rel=1e-6)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("export blazed", "Missing option '-o'"),
        ("export blazed -o t.txt", "-o: got t.txt, wanted a file name that ends in"),
        ("export elaphe -o t.csv", "elaphe: got an irregular surface, which has no orders, wanted a grating"),
        ("export xenopeltis_synthetic -o t.json", "xenopeltis_synthetic: got an irregular surface"),
        ("export foil,theory=rigorous -o t.csv", "wanted a surface that does not change along y"),
        ("export blazed,theory=exact -o t.csv", "theory: got 'exact', wanted one of scalar, rigorous"),
        ("export blazed,material=Al,int_ior=1.5 -o t.csv", "material: got 'Al' and int_ior 1.5, wanted one of the two"),
        ("export blazed,material=Unobtainium -o t.csv", "Unobtainium"),
        ("export blazed,deepth=1 -o t.csv", "blazed: got deepth, wanted some of"),
        ("export blazed --angle 95 -o t.csv", "--angle: got 95, wanted degrees above −90 and below 90"),
        ("export blazed --azimuth 400 -o t.csv", "--azimuth: got 400, wanted degrees from −360 to 360"),
        ("export blazed --wavelength 5 -o t.csv", "--wavelength: got 5, wanted nm from 10 to"),
        ("export gone.exr -o t.csv", "gone.exr: got a saved spectrum for t.csv, wanted the recipe, the profile"),
        ("export gone.toml -o t.csv", "gone.toml: no such file"),
        ("export blazed,depth=90 -o t.csv", "heights: got a range of 89.82 µm, wanted at most 20"),
    ],
)
def test_a_wrong_command_is_one_line(command, line, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, _, error = command(line)
    assert code == 2
    assert message in error
    assert error.splitlines()[-1].startswith("mitsuba-diffraction: error:")
    assert not list(tmp_path.iterdir())


@pytest.mark.few(1)
@pytest.mark.parametrize("phi", [30, 0, 90, 200])
def test_s_of_light_along_the_normal_is_the_limit_that_the_header_names(phi, tmp_path):
    grating = md.gratings.sinusoidal(1.0, 0.1)
    at_normal, near = (table(tmp_path / "n.csv", grating, 600, theta, phi, int_ior=1.5) for theta in (0, 1e-5))
    names = [f"to_{to}_{part}" for to in "sp" for part in ("re", "im")]
    for row, other in zip(at_normal, near, strict=True):
        np.testing.assert_allclose([row[name] for name in names], [other[name] for name in names], atol=1e-6)
    # Order 0 of light along s has an amplitude along s alone where the grooves are along s or across it.
    (row,) = chosen(at_normal, m=0, side="reflected", polarisation="s")
    s = -np.sin(np.deg2rad(phi)), np.cos(np.deg2rad(phi))
    te, tm = (
        chosen(table(tmp_path / "n.csv", grating, 600, 0, of, int_ior=1.5), m=0, side="reflected", polarisation="s")[0]
        for of in (0, 90)
    )
    along = s[1] ** 2 * te["to_s_re"] + s[0] ** 2 * tm["to_s_re"]
    assert row["to_s_re"] == pytest.approx(along, abs=1e-6)
    assert "(-sin phi, cos phi, 0)" in (tmp_path / "n.csv").read_text()


def test_the_far_infrared_of_a_table_adds_no_orders(tmp_path):
    (tmp_path / "glass.csv").write_text("wl,n\n0.3,1.5\n1.1,1.5\n10,30\n")
    tile = md.gratings.crossed(2.0, 0.1, samples=24)
    indices = str(tmp_path / "glass.csv"), 1.5
    found, wanted = (table(tmp_path / "a.csv", tile, 600, 20, theory="scalar", int_ior=index) for index in indices)
    assert [list(row.values())[:7] for row in found] == [list(row.values())[:7] for row in wanted]
    np.testing.assert_allclose(*([row["efficiency"] for row in rows] for rows in (found, wanted)), atol=1e-8)


@pytest.mark.few(1)
@pytest.mark.parametrize("theory", ["rigorous", "scalar"])
def test_glass_transmits_however_it_is_named(theory, command, tmp_path, monkeypatch):
    """A recipe with the index as a number has been right; n at 550 nm of the data sheet."""
    monkeypatch.chdir(tmp_path)
    index = 1.51852
    (tmp_path / "glass.csv").write_text(f"wl,n\n0.3,{index}\n1.1,{index}\n")
    surface = '[surface]\nprofile = "sinusoidal"\nperiod = 1.3\ndepth = 0.1\n[spectrum]\ntheory = "rigorous"\n'

    def rows(*named):
        found = []
        for number, (name, value) in enumerate(named):
            recipe = tmp_path / f"{number}.toml"
            recipe.write_text(f"{surface}{name} = {value!r}\n")
            for text in (
                f"{recipe},theory={theory}",
                f"sinusoidal,period=1.3,depth=0.1,theory={theory},{name}={value}",
            ):
                line = ("export", text, "-o", "o.csv", "--wavelength", "550", "--angle", "10", "--overwrite")
                assert command(*line)[0] == 0
                found.append(rows_of("o.csv"))
            code, said, _ = command(
                "efficiency", f"{recipe},theory={theory},transmission=interface", "--wavelength", "550"
            )
            assert (code, "transmitted orders inside" in said) == (0, True)
        return found

    wanted, *others = rows(
        ("int_ior", index), *((name, value) for name in ("int_ior", "material") for value in ("BK7", "glass.csv"))
    )
    transmitted = sum(row["efficiency"] for row in chosen(wanted, side="transmitted", polarisation="mean"))
    reflected = sum(row["efficiency"] for row in chosen(wanted, side="reflected", polarisation="mean"))
    assert transmitted > 0.94
    assert transmitted + reflected == pytest.approx(1, abs=2e-3 if theory == "rigorous" else 0.02)
    for other in others:
        assert [(row["side"], row["m"]) for row in other] == [(row["side"], row["m"]) for row in wanted]
        np.testing.assert_allclose(*([row["efficiency"] for row in some] for some in (other, wanted)), atol=2e-5)
