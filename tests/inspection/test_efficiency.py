"""Efficiencies over angles and wavelengths: closed forms, both theories, table, plot, CSV and command."""

import csv
from pathlib import Path

import numpy as np
import pytest
from scipy.special import jv

import mitsuba_diffraction as md
from mitsuba_diffraction.optics.geometry import fresnel
from mitsuba_diffraction.scalar_theory.closed_form import profile_powers, scalar_orders, tile_powers

ANGLES, WAVELENGTHS = [0.0, 20.0, -50.0], [450.0, 600.0]


@pytest.mark.parametrize("theory", ["scalar", "rigorous"])
def test_a_flat_surface_reflects_by_fresnels_formulas(theory):
    flat = md.HeightField(np.zeros((1, 32)), (0.05, 1.0), "flat")
    found = md.efficiencies(flat, [0, 40, np.rad2deg(np.arctan(1.5))], 500, theory=theory, int_ior=1.5)
    np.testing.assert_allclose(found.order(0)[:, 0].T, fresnel(np.cos(np.deg2rad(found.angles)), 1.5), atol=1e-9)
    np.testing.assert_allclose(found.values.sum(axis=0), found.order(0), atol=1e-9)


def test_the_far_infrared_of_a_table_adds_no_orders(tmp_path):
    (tmp_path / "glass.csv").write_text("wl,n\n0.3,1.5\n1.1,1.5\n10,30\n")
    tile = md.gratings.crossed(2.0, 0.1, samples=24)
    found, wanted = (
        md.efficiencies(tile, 20, 600, int_ior=index, transmission="interface")
        for index in (str(tmp_path / "glass.csv"), 1.5)
    )
    np.testing.assert_array_equal(found.orders, wanted.orders)
    np.testing.assert_allclose(found.values, wanted.values, atol=1e-9)


@pytest.mark.parametrize("azimuth", [0, 37])
@pytest.mark.parametrize("theory", ["scalar", "rigorous"])
def test_a_flat_film_transmits_by_fresnels_formulas(theory, azimuth):
    flat, angles = md.HeightField(np.zeros((1, 32)), (0.05, 1.0), "flat"), [0, 40, 56.3]
    reflected = np.stack(fresnel(np.cos(np.deg2rad(angles)), 1.5), axis=-1)

    def found(transmission):
        of = md.efficiencies(flat, angles, 500, theory=theory, transmission=transmission, azimuth=azimuth)
        np.testing.assert_allclose(of.values.sum(axis=0), of.order(0), atol=1e-9)
        return of.order(0)[:, 0]

    np.testing.assert_allclose(found("interface"), 1 - reflected, atol=1e-9)
    if theory == "rigorous":
        # (1 − R)² (1 + R² + R⁴ + …)
        np.testing.assert_allclose(found("sheet"), (1 - reflected) / (1 + reflected), atol=1e-6)
    else:
        mean = 1 - reflected.mean(axis=1, keepdims=True)
        np.testing.assert_allclose(found("sheet"), (1 - reflected) * mean, atol=1e-9)


@pytest.mark.parametrize("transmission", ["interface", "sheet"])
def test_both_theories_agree_on_transmission_of_a_shallow_grating(transmission):
    shallow = md.gratings.sinusoidal(3.35, 0.3)
    scalar, rigorous = (
        md.efficiencies(shallow, [0, 30], 500, theory=theory, transmission=transmission)
        for theory in ("scalar", "rigorous")
    )
    np.testing.assert_array_equal(scalar.orders, rigorous.orders)
    # Away from the normal the sign of an order matters.
    assert np.abs(rigorous.order(1) - rigorous.order(-1))[1].min() > 0.03
    assert np.abs(scalar.unpolarised - rigorous.unpolarised).sum(axis=0).max() < 0.02


def test_transmitted_orders_of_a_film_are_products():
    # Two sinusoids of amplitude 0.19 µm at right angles; along the normal, κ = 2π (1 − n cos θ_o)/λ.
    found = md.efficiencies(md.gratings.film(), 0, 550, transmission="interface")
    for m in ((0, 0), (1, 0), (0, -1), (1, -1)):
        cosine = np.sqrt(1 - (m[0] ** 2 + m[1] ** 2) * (0.53 * 0.55 / 1.5) ** 2)
        kappa, sine = 2 * np.pi * (1.5 * cosine - 1) / 0.55, np.sqrt(1 - cosine**2)
        v = np.array([1.5 * sine, 1 - 1.5 * cosine])
        i, o = np.abs(v[1]) / np.hypot(*v), np.abs(1.5 * sine * sine - v[1] * cosine) / np.hypot(*v)
        k = i * o * (v @ v) / (cosine * v[1] ** 2)
        powers = (jv(m[0], 0.19 * kappa) * jv(m[1], 0.19 * kappa)) ** 2
        expected = k * (1 - np.mean(fresnel(i, 1.5))) * powers
        assert found.order(*m).mean() == pytest.approx(expected, rel=1e-4)


def test_a_sinusoid_of_a_perfect_mirror_agrees_with_the_closed_form():
    period, depth, angle, wavelength = 4.0, 0.1, 25.0, 0.5
    found = md.efficiencies(md.gratings.sinusoidal(period, depth), angle, 500, material="none")
    # The model as it is written in docs/theory.md; of so shallow a relief E is nearly one.
    incident, leaving = np.sin(np.deg2rad(angle)), found.orders * wavelength / period - np.sin(np.deg2rad(angle))
    cos_i, cos_o = np.sqrt(1 - incident**2), np.sqrt(1 - leaving**2)
    between = incident * leaving + cos_i * cos_o
    k = (1 + between) ** 2 / (cos_i * cos_o * (cos_i + cos_o) ** 2)
    g = np.minimum(1, 2 * (cos_i + cos_o) * np.minimum(cos_i, cos_o) / (1 + between))
    expected = k * g * jv(found.orders, 2 * np.pi * (cos_i + cos_o) / wavelength * depth / 2) ** 2
    assert list(found.orders) == list(range(-4, 12))
    values = found.values[:, 0, 0, 0]
    assert (values <= expected + 1e-12).all()
    np.testing.assert_allclose(values[:-1], expected[:-1], rtol=1.5e-3)
    np.testing.assert_allclose(values[-1], expected[-1], rtol=0.015)  # at grazing exit


@pytest.mark.parametrize("m", [(0, 0), (1, 0), (-2, 1), (3, -3)])
def test_the_powers_of_a_crossed_grating_are_products(m):
    powers = tile_powers(md.gratings.crossed(2.5, 0.25, period_y=2.0), shortest=0.4)
    kappa = np.array([0.0, 3.0, 20.0, 31.4])
    expected = (jv(m[0], kappa * 0.125) * jv(m[1], kappa * 0.125)) ** 2
    np.testing.assert_allclose(powers(np.array(m), kappa), expected, atol=1e-9)


def test_the_orders_of_a_tile_without_change_along_y_are_those_of_its_profile():
    blaze = md.gratings.blazed(2.5, 0.3)
    tile = md.HeightField(np.repeat(blaze.heights, 8, axis=0), (blaze.pixel_size[0], 0.25))
    flat = scalar_orders(profile_powers(blaze), 2.5, 0.5, 35.0, 1.5, 20.0)
    found = scalar_orders(tile_powers(tile, 0.5), tile.tile_size, 0.5, 35.0, 1.5, 20.0)
    along_x = found.m[:, 1] == 0
    np.testing.assert_array_equal(found.m[along_x, 0], flat.m)
    np.testing.assert_allclose(found.s[along_x], flat.s, atol=1e-13)
    assert np.abs(found.s[~along_x]).max() < 1e-20


def test_the_orders_of_a_tile_rotate_with_it():
    # Turned by a quarter, x becomes y and y becomes −x.
    tile = md.HeightField(np.random.default_rng(1).random((16, 24)) * 0.1, 0.1)
    turned = md.HeightField(np.rot90(tile.heights, -1), 0.1)
    found = md.efficiencies(tile, 30, 500)
    other = md.efficiencies(turned, 30, 500, azimuth=90)
    assert len(found.orders) > 20
    for x, y in found.axes["order"]:
        np.testing.assert_allclose(found.order(x, y), other.order(-y, x), atol=1e-12)


def test_values_agree_with_those_of_one_direction_and_wavelength():
    blaze = md.gratings.blazed(2.0, 0.25)
    found = md.efficiencies(blaze, ANGLES, WAVELENGTHS, theory="rigorous", material="Al", azimuth=30)
    assert found.values.shape == (len(found.orders), 3, 2, 2)
    light = -np.sin(np.deg2rad(-50.0)) * np.array([np.cos(np.pi / 6), 0.5])
    one = md.rigorous.efficiencies(blaze, (*light, np.cos(np.deg2rad(50.0))), 0.6, material="Al")
    propagates = np.isin(found.orders, one.orders)
    np.testing.assert_allclose(found.values[propagates, 2, 1], np.stack([one.s, one.p], axis=1), atol=1e-12)
    assert not found.values[~propagates, 2, 1].any()


@pytest.mark.parametrize("theory", ["scalar", "rigorous"])
def test_a_blaze_in_littrow_mount_diffracts_light_back_to_its_source(theory):
    # sin θ = λ/2T; facets perpendicular to the light.
    period, wavelength = 5.0, 0.5
    angle = np.arcsin(wavelength / (2 * period))
    blaze = md.gratings.blazed(period, period * np.tan(angle))
    found = md.efficiencies(blaze, [np.rad2deg(angle), -np.rad2deg(angle)], 500, theory=theory, material="Al")
    fraction = found.unpolarised[:, :, 0] / found.unpolarised[:, :, 0].sum(axis=0)
    assert fraction[list(found.orders).index(1), 0] > 0.93
    assert fraction[list(found.orders).index(-1), 1] < 0.02


@pytest.mark.parametrize(("mounting", "m"), [("littrow", 1), ("littrow:2", 2), ("littrow:-1", -1)])
def test_in_littrow_mounting_the_order_returns_to_the_source(mounting, m, tmp_path):
    grating = md.gratings.ruled(600, blaze_wavelength=500)
    found = md.efficiencies(grating, mounting, WAVELENGTHS, material="Al")
    assert found.values.shape == (len(found.orders), 1, 2, 2)
    for w, (wavelength, angle) in enumerate(zip(WAVELENGTHS, found.incidence[0], strict=True)):
        # The grating equation with θ_m = θ_i.
        assert 2 * np.sin(np.deg2rad(angle)) == pytest.approx(m * wavelength * 1e-3 * 0.6)
        alone = md.efficiencies(grating, angle, wavelength, material="Al")
        np.testing.assert_allclose(found.order(m)[0, w], alone.order(m)[0, 0], rtol=1e-12)
    found.save_csv(tmp_path / "table.csv")
    rows = list(csv.DictReader((tmp_path / "table.csv").read_text().splitlines()[:-1]))
    assert {row["angle_deg"] for row in rows} == {f"{angle:.9g}" for angle in found.incidence[0]}
    assert found.plot().axes[0].get_title() == "Littrow mounting"


def test_in_littrow_mounting_a_sheet_deviates_the_order_least():
    grating, wavelength = md.gratings.transmission_300(), 550.0
    found = md.efficiencies(grating, "littrow", wavelength, transmission="sheet")
    angles = found.incidence[0, 0] + np.linspace(-5, 5, 11)
    # θ_m towards −x, where light that is not deviated leaves at −θ_i.
    leaving = np.rad2deg(np.arcsin(wavelength * 1e-3 * 0.3 - np.sin(np.deg2rad(angles))))
    assert np.argmin(angles + leaving) == 5


def test_axes_describe_the_values():
    found = md.efficiencies(md.gratings.blazed(1.0, 0.1), ANGLES, WAVELENGTHS)
    assert list(found.axes) == ["order", "angle", "wavelength", "polarisation"]
    assert tuple(map(len, found.axes.values())) == found.values.shape
    np.testing.assert_array_equal(found.order(1), found.values[found.axes["order"].index(1)])
    with pytest.raises(ValueError, match=r"order: got 7, wanted one from -3 to 2"):
        found.order(7)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"angles": [0, 95]}, "angles: got 95, wanted degrees"),
        ({"angles": "littrow:0"}, "angles: got 'littrow:0', wanted degrees, 'littrow' "),
        ({"angles": "bragg"}, "angles: got 'bragg', wanted degrees, 'littrow' "),
        ({"angles": "littrow", "azimuth": 30}, "azimuth: got 30 in Littrow mounting, wanted 0"),
        ({"angles": "littrow:9"}, "wavelengths: got 400 nm, wanted below "),
        ({"angles": []}, "angles: got an array of shape"),
        ({"wavelengths": 0.5}, "wavelengths: got 0.5, wanted nm"),
        ({"wavelengths": "blue"}, "wavelengths: got 'blue', wanted nm"),
        ({"theory": "exact"}, "theory: got 'exact', wanted one of"),
        ({"material": "Al", "int_ior": 1.5}, "wanted one of the two"),
        ({"transmission": "film"}, "transmission: got 'film', wanted one of none, interface, sheet"),
        ({"transmission": "sheet", "material": "Al"}, "got 'sheet' with Al, wanted a transparent medium"),
        ({"transmission": "interface", "int_ior": 1.5 + 0.1j}, r"with n = 1.5\+0.1j, wanted a transparent"),
        ({"height_field": md.HeightField(np.eye(64), 0.5)}, "about 20106 orders of a tile of 32 × 32 µm at 400 nm"),
        ({"azimuth": float("nan")}, "azimuth: got nan"),
        ({"azimuth": "x"}, "azimuth: got 'x'"),
        ({"material": "Al", "wavelengths": 1550}, "got light of 1550 nm, and a table of 298.757 to 885.601 nm"),
        ({"height_field": np.eye(4)}, "height_field: got ndarray, wanted a HeightField"),
    ],
)
def test_a_wrong_request_is_refused(arguments, message):
    given = {"height_field": md.gratings.blazed(1.0, 0.1), "angles": 0, "wavelengths": 400, **arguments}
    with pytest.raises(ValueError, match=message):
        md.efficiencies(**given)


def test_a_table_is_printed():
    found = md.efficiencies(md.gratings.blazed(2.5, 0.25), [0, 10], np.arange(400, 701, 20), material="none")
    lines = str(found).splitlines()
    assert lines[0].startswith("blazed grating")
    head = lines[1].split()
    assert (head[:2], head[-1]) == (["angle", "λ"], "sum")
    assert {0, 1, 2} < set(map(int, head[2:-1]))
    first = dict(zip(head, lines[2].replace(" nm", "").split(), strict=True))
    assert float(first["+1"]) == pytest.approx(100 * found.unpolarised[list(found.orders).index(1), 0, 0], abs=6e-4)
    assert lines[-2:] == ["… 32 rows", f"the 8 strongest of {len(found.orders)} orders; the sum is of all"]
    one = md.rigorous.efficiencies(md.gratings.blazed(2.5, 0.25), (0, 0, 1), 0.65, int_ior=1.5)
    rows = [line.split() for line in str(one).splitlines()]
    assert [int(row[1]) for row in rows if row[0] == "reflected"] == one.orders.tolist()
    assert [float(row[4]) for row in rows if row[0] == "reflected"] == pytest.approx(100 * one.unpolarised, abs=6e-4)
    assert len(rows) == 2 + len(one.orders) + len(one.transmitted_orders)


def test_a_name_is_no_formula_of_the_plot(tmp_path):
    field = md.gratings.blazed(2.5, 0.25)
    named = md.HeightField(field.heights, field.pixel_size, r"a $\frac{$.npy")
    md.efficiencies(named, [0], [550]).plot(tmp_path / "plot.png")


@pytest.mark.parametrize(("angles", "panels", "maps"), [([0], 1, 0), ([0, 10], 2, 0), (np.linspace(0, 60, 6), 7, 6)])
def test_a_plot_has_lines_or_of_many_points_a_map_for_each_order(angles, panels, maps, tmp_path):
    found = md.efficiencies(md.gratings.blazed(2.5, 0.25), angles, [400, 450, 500, 550, 600])
    figure = found.plot(tmp_path / "plot.png")
    assert len(figure.axes) == panels  # with that of the colours
    assert sum("order" in axes.get_title() for axes in figure.axes) == maps
    if len(angles) == 2:
        lines = figure.axes[1].get_lines()
        np.testing.assert_allclose(lines[-4].get_ydata(), found.unpolarised[:, 1].sum(axis=0))
        assert figure.axes[0].get_ylim()[1] > found.unpolarised.sum(axis=0).max()
    assert (tmp_path / "plot.png").stat().st_size > 10_000


@pytest.mark.not_quick
def test_the_command_writes_numbers_and_plot(command, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    words = ("efficiency", "crossed,period=1.2,depth=0.1", "--angle", "0:20:10", "--wavelength", "500,600")
    for _ in range(2):  # what the same command wrote may be written again
        code, said, error = command(*words, "--csv", "e.csv", "--plot", "e.png")
        assert (code, error) == (0, "")
    assert "crossed grating" in said
    assert Path("e.png").is_file()
    with open("e.csv", newline="") as file:
        rows = list(csv.DictReader(line for line in file if not line.startswith("#")))
    expected = md.efficiencies(md.gratings.crossed(1.2, 0.1), [0, 10, 20], [500, 600])
    assert len(rows) == expected.unpolarised.size
    names = "order_x", "order_y", "angle_deg", "wavelength_nm"
    of_row = next(row for row in rows if [row[name] for name in names] == ["1", "0", "20", "600"])
    assert float(of_row["s"]) == pytest.approx(expected.order(1, 0)[2, 1, 0], rel=1e-8)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("efficiency blazd", "blazd: no file and no surface has this name; did you mean blazed?"),
        ("efficiency blazed,depth", "blazed,depth: got 'depth', wanted name=value"),
        ("efficiency blazed,peroid=2", "; did you mean period?"),
        ("efficiency blazed,depth=1,depth=2", "got 'depth=2', wanted name=value, each name once"),
        ("efficiency blazed,period=1e-300", "period: got 1e-300 µm, wanted at least 0.001"),
        ("efficiency blazed,depth=1e9", "depth: got 1000000000.0 µm, wanted at most 100; is it in nm"),
        ("efficiency blazed,depth=90", "heights: got a range of 89.82 µm, wanted at most 20: are these nanometres?"),
        ("efficiency blazed --angle 0:60", "--angle: got '0:60', wanted a number"),
        ("efficiency blazed --angle 0:60:-5", "--angle: got '0:60:-5', wanted a number"),
        ("efficiency blazed --wavelength 5", "error: --wavelength: got 5, wanted nm from 10 to 100000"),
        ("efficiency gone.toml", "gone.toml: no such file"),
        ("efficiency blazed --csv e.txt", "--csv: got e.txt, wanted a file name that ends in .csv"),
    ],
)
def test_a_wrong_command_is_one_line(command, line, message):
    code, _, error = command(line)
    assert code == 2
    assert message in error
    assert error.count("\n") == 1


def test_a_recipe_of_a_grating_below_a_coat_is_refused_as_orders_are_in_air(command, tmp_path):
    recipe = tmp_path / "coat.toml"
    spectrum = 'theory = "rigorous"\nmaterial = "Al"\next_ior = 1.5\n'
    recipe.write_text(f'[surface]\nprofile = "sinusoidal"\nperiod = 0.7\ndepth = 0.1\n[spectrum]\n{spectrum}')
    for line in ("efficiency SURFACE", f"export SURFACE -o {tmp_path}/orders.csv --angle 0"):
        code, said, error = command(line.replace("SURFACE", str(recipe)))
        assert (code, said) == (2, "")
        assert "ext_ior: got 1.5 of the recipe, wanted none: these orders are in air" in error
    for theory in ("", ",theory=scalar", ",theory=rigorous"):
        code, _, error = command(f"efficiency lamellar,period=2,depth=0.1,ext_ior=1.4{theory} --wavelength 550")
        assert code == 2
        assert "ext_ior: got 1.4 of the recipe, wanted none: these orders are in air" in error


def test_the_command_takes_theory_and_material_of_a_recipe(command):
    recipe = Path(__file__).parents[2] / "precompute" / "rigorous" / "foil_one_direction.toml"
    code, said, error = command("efficiency", str(recipe), "--wavelength", "600")
    assert (code, error) == (0, "")
    assert "Al, rigorous theory" in said
    code, said, error = command("efficiency", f"{recipe},depth=0,int_ior=1.5", "--wavelength", "600")
    assert (code, error) == (0, "")
    head, row = (line.split() for line in said.splitlines()[-2:])
    transmitting = recipe.with_name("transmission_600.toml")
    _, of_recipe, _ = command("efficiency", str(transmitting), "--wavelength", "600")
    assert "rigorous theory, transmitted by a sheet" in of_recipe
    _, inside, _ = command("efficiency", f"{transmitting},transmission=interface", "--wavelength", "600")
    assert "rigorous theory, transmitted orders inside" in inside
    assert row[head.index("0") + 1] == row[-1] == "4.000"  # the unit of the wavelength is a word, too


@pytest.mark.parametrize(
    ("values", "says"),
    [("transmission=interface", True), ("transmission=sheet,blaze_ior=1.5", False), ("material=Al", False)],
)
def test_what_blazes_a_ruled_grating_for_transmission_is_named(values, says, command):
    code, _, err = command(f"efficiency ruled,lines_per_mm=600,{values} --wavelength 500")
    assert code == 0
    assert ("blaze_ior=" in err) == says
