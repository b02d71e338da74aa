"""The light in the peaks of irregular surfaces: sinusoids in closed form, albedo, sides, skins, command."""

import re
from pathlib import Path

import numpy as np
import pytest

import mitsuba_diffraction as md
from mitsuba_diffraction.energy.furnace import Furnace

PRECOMPUTE = Path(__file__).parents[2] / "precompute"
LOBE = 1 - np.exp(-4)  # fraction of a lobe in a peak


def as_sample(profile, direction, size=16.0, pixel=0.1, coherence_length=8.0):
    """The spectrum of a piece of a line grating, h(x cos φ + y sin φ)."""
    x = (np.arange(round(size / pixel)) + 0.5) * pixel
    phi, heights = np.deg2rad(direction), profile.heights[0]
    along = np.add.outer(x * np.sin(phi), x * np.cos(phi)) / profile.tile_size[0]
    period = np.r_[heights, heights[:1]]
    field = md.HeightField(np.interp(along % 1, np.linspace(0, 1, len(period)), period), pixel)
    return md.precompute(
        field, extent="sample", coherence_length=coherence_length, tolerance=0.02, wavelengths=(440, 660)
    )


@pytest.fixture(scope="module")
def sinusoid():
    return as_sample(md.gratings.sinusoidal(2.0, 0.15), 30)


def test_a_sinusoid_has_the_peaks_of_its_orders(sinusoid):
    found = md.peak_efficiencies(sinusoid, [0, 20], [450, 600], int_ior=1.5, azimuth=30)
    wanted = md.efficiencies(md.gratings.sinusoidal(2.0, 0.15), [0, 20], [450, 600], int_ior=1.5)
    assert found.peaks[0].period == pytest.approx(2.0, rel=0.01)
    assert found.peaks[0].direction == pytest.approx(30, abs=0.5)
    assert found.peaks[1].period == pytest.approx(1.0, rel=0.01)
    for name, order in (("mirror", 0), ("+a", 1), ("-a", -1)):
        # K, R and κ vary within a lobe.
        np.testing.assert_allclose(found.order(name), LOBE * wanted.order(order), rtol=0.03)
    # One σ of a lobe, across the wave vector
    assert np.tan(np.deg2rad(found.peaks[0].direction_uncertainty)) == pytest.approx(2 * sinusoid.lobe_width, rel=0.1)


def test_the_sum_is_the_albedo(sinusoid):
    found = md.peak_efficiencies(sinusoid, 10, [450, 600], material="none", azimuth=30)
    theta, phi = np.deg2rad((10, 30))
    omega = -np.sin(theta) * np.cos(phi), -np.sin(theta) * np.sin(phi), np.cos(theta)
    albedo = Furnace.of(sinusoid).albedo(np.array([omega, omega]), np.array([0.45, 0.6]))
    np.testing.assert_allclose(found.unpolarised.sum(axis=0)[0], np.minimum(albedo[0], 1), atol=0.01)


def test_a_blaze_prefers_one_side():
    blaze = md.gratings.blazed(2.5, 0.2)
    for direction, side in ((0, 1), (180, -1)):
        found = md.peak_efficiencies(as_sample(blaze, direction), 10, 500, int_ior=1.5)
        wanted = md.efficiencies(blaze, 10 * side, 500, int_ior=1.5)
        assert wanted.order(1)[0, 0, 0] > 5 * wanted.order(-1)[0, 0, 0]
        for name, order in (("+a", side), ("-a", -side)):
            np.testing.assert_allclose(found.order(name), LOBE * wanted.order(order), rtol=0.06, atol=3e-5)


def test_noise_has_no_peaks():
    rng = np.random.default_rng(0)
    rough = md.HeightField(0.01 * rng.standard_normal((100, 100)), 0.1)
    found = md.peak_efficiencies(
        md.precompute(rough, extent="sample", coherence_length=4, tolerance=0.02, wavelengths=(500, 600)), 0, 550
    )
    assert found.orders.tolist() == ["mirror", "rest"]
    assert "no peak stands out" in str(found)


def test_peaks_of_a_skin_are_its_periods():
    recipe = md.Recipe.load(PRECOMPUTE / "elaphe.toml")
    found = md.peak_efficiencies(recipe.cached(), 0, [450, 550, 650])
    assert found.peaks[0].period == pytest.approx(1.07, abs=0.05)  # 1.03 and 1.18 µm: one peak
    assert abs(found.peaks[0].direction) == pytest.approx(90, abs=2)
    assert found.order("+a").mean() == pytest.approx(found.order("-a").mean(), rel=0.2)


def test_orders_that_do_not_overlap_are_refused():
    spectrum = md.precompute(md.gratings.sinusoidal(2.0, 0.1))
    with pytest.raises(ValueError, match=r"spectrum: got orders of a tile that do not overlap"):
        md.peak_efficiencies(spectrum, 0, 500)
    with pytest.raises(ValueError, match=r"wavelengths: got 300, wanted nm from 360 to 830, for which"):
        md.peak_efficiencies(spectrum, 0, 300)


@pytest.fixture
def scan(tmp_path, monkeypatch):
    """A folder with a scan of a sinusoid and a recipe of it."""
    monkeypatch.chdir(tmp_path)
    x = np.arange(60) * 0.08
    np.save("scan.npy", 0.05 * np.sin(2 * np.pi * x) + 0 * x[:, None])
    recipe = '[surface]\nscan = "scan.npy"\npixel_size = 0.08\n[spectrum]\nextent = "sample"\n'
    Path("scan.toml").write_text(recipe)


@pytest.mark.slow
def test_the_command_answers_for_scan_recipe_and_spectrum(command, scan, sinusoid):
    code, of_scan, _ = command("efficiency scan.npy,pixel_size=0.08 --csv e.csv")
    assert code == 0
    assert re.search(r"peak a: period (0\.9\d|1\.0\d) ± 0\.\d+ µm along", of_scan)
    assert of_scan == command("efficiency scan.toml")[1] + "e.csv: all numbers\n"
    assert Path("e.csv").read_text().splitlines()[1].startswith("mirror,0,400,")
    sinusoid.save("saved.exr")
    code, of_spectrum, _ = command("efficiency saved.exr --wavelength 450 --azimuth 30")
    assert code == 0
    assert re.search(r"peak a: period (1.99|2.00) ± ", of_spectrum)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("saved.exr,pixel_size=1", "saved.exr: got pixel_size with a saved spectrum, wanted the recipe or the scan"),
        ("scan.toml,theory=rigorous", "extent: got 'sample' with theory 'rigorous', wanted none"),
        ("scan.npy,pixel_size=1 --wavelength 300", "--wavelength: got 300, wanted nm from 360 to 830"),
        ("scan.npy,pixel_size=1,material=Alu", "material: got 'Alu'"),
        ("scan.npy,pixel_size=1 --angle 90", "--angle: got 90, wanted degrees above −90 and below 90"),
        ("scan.npy,depth=1,pixel_size=1", "scan.npy: got depth, wanted some of pixel_size, "),
        ("blazed,pixel_size=1", "blazed: got pixel_size, wanted some of period, depth, "),
        ("blazed,dept=1", "transmission; did you mean depth?"),
    ],
)
def test_wrong_commands_are_refused(command, scan, line, message):
    code, _, error = command(f"efficiency {line}")
    assert (code, message in error) == (2, True), error
