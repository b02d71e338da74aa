"""Inspection: statistics and orders against closed forms, uncertainty against rebuilt surfaces, the command."""

import json
import re
from pathlib import Path

import colour
import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image
from scipy.special import jv

import mitsuba_diffraction as md
from mitsuba_diffraction import testing
from mitsuba_diffraction.inspection import inspect, picture, save_picture
from mitsuba_diffraction.inspection.picture import piece_shown, with_uncertainty
from mitsuba_diffraction.inspection.predicted_colours import (
    WAVELENGTHS,
    broadened,
    colours_at,
    illumination,
    order_angle,
    order_fraction,
    radiance,
    scanned,
)
from mitsuba_diffraction.inspection.properties import concerns, statistics
from mitsuba_diffraction.optics.color import into_gamut, radiance_to_linear_sRGB, radiance_to_XYZ
from mitsuba_diffraction.scalar_theory.validity import scalar_error

ROOT = Path(__file__).parents[2]
PERIOD, DEPTH = 2.0, 0.2
"""µm"""


def waves(count=8, pixel=0.05, tilt=0.0, noise=0.0):
    """A sample of whole waves along x, 2.0 µm apart and 0.2 µm high; tilted, by its slope along y; noisy, µm."""
    x = (np.arange(round(count * PERIOD / pixel)) + 0.5) * pixel
    heights = -DEPTH / 2 * np.cos(2 * np.pi * x / PERIOD) + tilt * x[:, None]
    return md.HeightField(heights + noise * np.random.default_rng(0).standard_normal(heights.shape), pixel, "waves.npy")


def sinusoid(**arguments):
    return md.precompute(md.gratings.sinusoidal(PERIOD, DEPTH), wavelengths=(340.0, 830.0), **arguments)


# ---------------------------------------------------------------- statistics


@pytest.mark.parametrize("tilt", [0.0, 0.03])
def test_statistics_of_a_sinusoid_agree_with_the_formula(tilt):
    numbers = statistics(waves(tilt=tilt))
    assert numbers.Sq == pytest.approx(DEPTH / np.sqrt(8), rel=0.01)
    assert numbers.Sa == pytest.approx(DEPTH / np.pi, rel=0.02)
    assert numbers.Sz == pytest.approx(DEPTH, rel=0.01)
    assert numbers.Sdq == pytest.approx(np.pi * DEPTH / PERIOD / np.sqrt(2), rel=0.01)
    assert numbers.steepest == pytest.approx(np.degrees(np.arctan(np.pi * DEPTH / PERIOD)), rel=0.03)
    assert numbers.tilt == pytest.approx(np.degrees(np.arctan(tilt)), abs=1e-6)


def test_a_plane_has_tilt_and_nothing_else():
    y, x = np.mgrid[:30, :40] * 0.1
    numbers = statistics(md.HeightField(0.2 * x - 0.1 * y, 0.1))
    assert numbers.tilt == pytest.approx(np.degrees(np.arctan(np.hypot(0.2, 0.1))))
    assert numbers.tilt_height == pytest.approx(0.2 * 3.9 + 0.1 * 2.9)
    assert numbers.Sz == pytest.approx(0, abs=1e-12)


def test_a_tile_has_a_level_reference_plane():
    numbers = statistics(md.gratings.blazed(2.5, 0.25), extent="tile")
    assert numbers.tilt == 0
    assert numbers.Sq == pytest.approx(0.25 / np.sqrt(12), rel=1e-3)


def test_levels_and_their_step_are_counted():
    counts = np.random.default_rng(0).integers(0, 200, (40, 40))
    numbers = statistics(md.HeightField(counts * 0.0015, 0.05))
    assert (numbers.levels, numbers.step) == (200, pytest.approx(0.0015))
    assert statistics(md.HeightField(np.zeros((4, 4)), 0.1)).levels == 1


# ---------------------------------------------------------------- predicted colours


def test_a_flat_surface_mirrors_daylight():
    flat = md.precompute(md.HeightField(np.zeros((8, 8)), 0.08), coherence_length=20.0)
    light = radiance(flat, 0.0, [0.0, 40.0], [0.0, 40.0])
    XYZ = radiance_to_XYZ(light, WAVELENGTHS)
    # S(0)/λ² of one lobe is bluer than daylight by λ⁻².
    XYZ_flat = radiance_to_XYZ(light * (WAVELENGTHS * 1e-3) ** 2, WAVELENGTHS)
    np.testing.assert_allclose(XYZ_flat[:, :2] / XYZ_flat.sum(axis=1, keepdims=True), [[0.3127, 0.3290]] * 2, atol=1e-3)
    assert XYZ[0, 2] / XYZ[0, 0] > XYZ_flat[0, 2] / XYZ_flat[0, 0]


@pytest.mark.few(1)
@pytest.mark.parametrize(("theta_i", "theta_o"), [(0.0, 16.0), (20.0, 45.0), (60.0, 20.0), (30.0, -10.0), (70.0, 60.0)])
def test_radiance_agrees_with_the_bsdf(theta_i, theta_o):
    mi.set_variant("llvm_ad_spectral")
    # Broad lobes, so that something is seen at any angle; of a sample, whose K is that of the pair of directions.
    spectrum = md.precompute(waves(count=4, pixel=0.08), extent="sample", coherence_length=2.0, tolerance=0.01)
    grating = {"type": "diffraction_grating", "spectrum": spectrum, "material": "none", "conserve_energy": False}
    bsdf = mi.load_dict(grating)

    wavelengths, directions = [400.0, 500.0, 600.0, 700.0], (testing.direction(-theta_i), testing.direction(theta_o))
    f = testing.evaluate(bsdf, *directions, wavelengths) / np.cos(np.deg2rad(theta_o))
    at = np.searchsorted(WAVELENGTHS, wavelengths)
    got = (radiance(spectrum, 0.0, theta_i, theta_o) / illumination())[at]
    ratio = f * np.cos(np.deg2rad(theta_i)) / got
    np.testing.assert_allclose(ratio, 1, atol=1e-3)


def test_colours_lie_at_the_angles_of_the_grating_equation():
    spectrum = sinusoid(coherence_length=20.0)
    for wavelength, channel in ((0.62, 0), (0.54, 1), (0.45, 2)):
        angle = order_angle(1, PERIOD, wavelength)
        assert np.sin(np.deg2rad(angle)) * PERIOD == pytest.approx(wavelength)
        for theta_i, theta_o in ((0.0, angle), (0.0, -angle), (30.0, np.degrees(np.arcsin(0.5 + wavelength / PERIOD)))):
            rgb = into_gamut(radiance_to_linear_sRGB(radiance(spectrum, 0.0, theta_i, theta_o), WAVELENGTHS))
            assert rgb.argmax() == channel
    assert order_angle(4, PERIOD, 0.55) is None


@pytest.mark.few(1)
@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("extent", ["tile", "sample"])
def test_orders_have_the_power_of_bessel_functions(order, extent):
    wavelength = 0.55
    if extent == "tile":
        spectrum = sinusoid()
    else:
        spectrum = md.precompute(waves(pixel=0.08), extent="sample", coherence_length=8.0, tolerance=0.01)
    kappa = 2 * np.pi / wavelength * (1 + np.sqrt(1 - (order * wavelength / PERIOD) ** 2))
    expected = 2 * jv(order, kappa * DEPTH / 2) ** 2
    assert order_fraction(spectrum, 0.0, PERIOD, order, wavelength) == pytest.approx(expected, rel=0.01, abs=2e-3)


def test_scaling_the_spectrum_agrees_with_a_scaled_surface():
    spectrum = sinusoid(coherence_length=20.0)
    higher = md.precompute(md.gratings.sinusoidal(PERIOD, 1.05 * DEPTH), coherence_length=20.0)
    wider = md.precompute(md.gratings.sinusoidal(1.05 * PERIOD, DEPTH), coherence_length=21.0)
    angles = np.linspace(-60, 60, 101)
    for got, other in (
        (radiance(spectrum, 0.0, 10.0, angles, height_scale=1.05), higher),
        (radiance(spectrum, 0.0, 10.0, angles, lateral_scale=1.05), wider),
    ):
        wanted = radiance(other, 0.0, 10.0, angles)
        np.testing.assert_allclose(got, wanted, atol=3e-3 * wanted.max())
        assert np.abs(wanted - radiance(spectrum, 0.0, 10.0, angles)).max() > 0.03 * wanted.max()


# ---------------------------------------------------------------- the tip


def test_a_scanned_spike_has_the_shape_of_the_tip():
    heights = np.zeros((41, 41))
    heights[20, 20] = 0.3
    pixel, radius = 0.02, 0.05
    got = scanned(md.HeightField(heights, pixel), radius).heights
    y, x = (np.mgrid[:41, :41] - 20) * pixel
    np.testing.assert_allclose(got, np.maximum(0.3 - (x**2 + y**2) / (2 * radius), 0), atol=1e-12)


def test_erosion_restores_points_that_the_tip_touched():
    surface = waves(count=4)
    once = scanned(surface, 0.1)
    back = scanned(once, -0.1)
    # The valleys are wider than the tip: curvature 2π²·0.1/… under 1/r.
    assert np.pi**2 * 2 * DEPTH / PERIOD**2 < 1 / 0.1
    np.testing.assert_allclose(back.heights[:, 5:-5], surface.heights[:, 5:-5], atol=1.5e-3)
    assert (once.heights >= surface.heights - 1e-12).all()


def test_a_tile_is_continued_periodically_under_the_tip():
    tile = md.gratings.crossed(PERIOD, DEPTH, samples=40)
    rolled = md.HeightField(np.roll(tile.heights, (7, 11), (0, 1)), tile.pixel_size)
    np.testing.assert_allclose(
        np.roll(scanned(tile, 0.2, extent="tile").heights, (7, 11), (0, 1)), scanned(rolled, 0.2, extent="tile").heights
    )


@pytest.mark.parametrize("fraction", [0.05, -0.05])
def test_a_tip_is_found_that_broadens_ridges_by_a_fraction(fraction):
    surface = md.gratings.crossed(PERIOD, DEPTH, samples=128)
    other, radius = broadened(surface, fraction, extent="tile")
    assert np.sign(radius) == np.sign(fraction)
    assert np.mean(other.heights > 0) / np.mean(surface.heights > 0) - 1 == pytest.approx(fraction, abs=0.01)


def test_both_tips_have_equal_effects_on_a_sawtooth_but_not_on_round_ridges():
    """−h(−x) is the same sawtooth: what dilation does to one, erosion does to the other, and |F{e^iκh}| is equal."""
    x = (np.arange(256) + 0.5) / 256
    ridges = md.HeightField(DEPTH * np.abs(np.sin(np.pi * x))[None], (PERIOD / 256, PERIOD))
    differ = []
    for surface in (md.gratings.blazed(PERIOD, DEPTH, samples=256), ridges):
        powers = []
        for radius in (0.02, -0.02):
            heights = scanned(surface, radius, extent="tile").heights[0]
            powers.append(np.abs(np.fft.fft(np.exp(4j * np.pi / 0.55 * heights)) / 256) ** 2)
        differ.append(np.abs(powers[0] - powers[1]).sum())
    assert differ[0] < 1e-10
    assert differ[1] > 1e-3


def test_a_profile_by_formula_has_no_tip_broadening():
    seen = inspect(md.gratings.sinusoidal(PERIOD, DEPTH, samples=64), extent="tile", measured=False)
    assert {change.what for change in seen.changes} == {"height scale", "pixel size"}


def test_slopes_of_a_binary_grating_are_its_walls():
    numbers = statistics(md.gratings.lamellar(PERIOD, DEPTH, samples=400), extent="tile")
    # The gradient of a pixel is over two of 5 nm.
    assert numbers.steepest == pytest.approx(np.degrees(np.arctan(DEPTH / 0.01)))
    assert statistics(md.HeightField(np.zeros((4, 4)), 0.1)).steepest == 0


def test_a_flat_surface_has_no_ridges_to_broaden():
    with pytest.raises(ValueError, match="flat surface"):
        broadened(md.HeightField(np.ones((8, 8)), 0.1), 0.05)


# ---------------------------------------------------------------- uncertainty


@pytest.fixture(scope="module")
def grating():
    return inspect(md.gratings.sinusoidal(PERIOD, DEPTH, samples=128), extent="tile")


def test_changes_agree_with_the_closed_form(grating):
    kappa = 2 * np.pi / 0.55 * (1 + np.cos(np.deg2rad(order_angle(1, PERIOD, 0.55))))
    by = {(change.what, round(change.by, 2)): change for change in grating.changes}
    assert set(by) == {(w, s) for w in ("height scale", "pixel size", "tip broadening") for s in (0.05, -0.05)}
    for sign in (0.05, -0.05):
        height, pixel, tip = (by[w, sign] for w in ("height scale", "pixel size", "tip broadening"))
        assert height.period == 0
        assert pixel.period == pytest.approx(sign)
        assert tip.period == 0
        powers = [2 * jv(1, scale * kappa * DEPTH / 2) ** 2 for scale in (1, 1 + sign)]
        # The spectra of an inspection have a tolerance of 0.02.
        assert height.before[1] == pytest.approx(powers[0], abs=5e-3)
        assert height.after[1] == pytest.approx(powers[1], abs=5e-3)
        # A wider grating sends 550 nm elsewhere: what is seen there is another colour; higher waves change the light.
        assert pixel.colour[1] > 10
        assert height.colour[1] < 5
        assert np.isnan(height.tip_radius)
        assert np.sign(tip.tip_radius) == np.sign(sign)


def test_the_period_of_a_tile_is_exact(grating):
    (period,) = grating.periods
    assert (period.period, period.period_uncertainty) == (pytest.approx(PERIOD, rel=1e-12), 0.0)
    assert period.direction == 0


# ---------------------------------------------------------------- concerns


def about(field, measured=True):
    extent = "sample" if measured else "tile"
    scalar = scalar_error(field, extent)
    return concerns(field, statistics(field), 4.0, extent=extent, measured=measured, scalar=scalar)


@pytest.mark.parametrize(
    ("field", "words"),
    [
        (waves(pixel=0.125), "Pixels of 125 nm are too coarse"),
        (waves(tilt=0.2), "tilted by 11°"),
        (waves(tilt=0.01), "tilted by 0.57°"),
        (waves(noise=0.02), "detail of less than 2.5 pixels"),
        (
            md.HeightField(np.round(waves().heights * 200) / 200, 0.05),
            "levels, 5 nm apart (8 bit?): rounding scatters 0.2%",
        ),
        (
            md.HeightField(np.where(waves().heights > 0.095, np.nan, waves().heights), 0.05, fill_missing=True),
            "filled",
        ),
        (md.HeightField(waves().heights * 12, 0.05), "steeper than 7"),
    ],
)
def test_problems_of_a_scan_are_reported(field, words):
    said = about(field)
    assert any(words in sentence for sentence in said), said


def test_a_grating_too_fine_for_scalar_theory_is_a_concern():
    (said,) = about(md.gratings.sinusoidal(0.8, 0.3), measured=False)
    assert said.startswith("Scalar theory: errs by ")
    assert said.endswith("; theory=rigorous has it right.")


@pytest.mark.parametrize(("width", "warns"), [(0.33, True), (2.5, True), (3.0, False)])
def test_a_scan_of_a_few_wavelengths_is_a_concern(width, warns):
    """An order is as wide as the scan allows."""
    said = about(md.HeightField(0.05 * np.sin(np.arange(128) * 0.2) * np.ones((128, 1)), width / 128))
    assert [text for text in said if "wavelengths of green light" in text] == ([said[0]] if warns else [])


@pytest.mark.parametrize(("depth", "warns"), [(0.0, True), (2.0, True), (10.0, False)])
def test_heights_hardly_above_their_noise_are_a_concern(depth, warns):
    x = np.arange(256) * 0.02
    noise = np.random.default_rng(3).normal(size=(256, 256))
    said = about(md.HeightField(1e-3 * (depth / 2 * np.sin(2 * np.pi * x) + noise), 0.02))
    assert any("of the roughness Sq" in text for text in said) == warns
    assert not warns or any("Noise of 1 nm" in text for text in said)


@pytest.mark.slow
def test_a_good_scan_has_no_concerns():
    assert about(waves()) == ()
    assert about(md.gratings.lamellar(2.5, 0.2), measured=False) == ()


# ---------------------------------------------------------------- the whole


@pytest.fixture(scope="module")
def sample():
    return inspect(waves(count=4, pixel=0.08, noise=0.001))


@pytest.mark.slow
def test_a_sample_is_reported_in_numbers(sample):
    (period, *_) = sample.periods
    assert period.period == pytest.approx(PERIOD, abs=4 * period.period_uncertainty + 0.01)
    assert abs(period.direction) < 1
    assert sample.max_coherence_length == pytest.approx(4.0)
    numbers = json.loads(json.dumps(sample.as_json()))
    assert numbers["pixels"] == [100, 100]
    assert numbers["statistics"]["Sq"] == pytest.approx(DEPTH / np.sqrt(8), rel=0.03)
    assert numbers["periods"][0]["period"] == period.period
    assert numbers["changes"][0]["tip_radius"] is None
    assert numbers["changes"][2]["period"] == pytest.approx(0.05)


def test_a_surface_without_a_period_is_reported(tmp_path):
    noise = md.HeightField(np.random.default_rng(0).standard_normal((40, 40)) * 0.01, 0.08)
    seen = inspect(noise)
    assert (seen.periods, seen.changes) == ((), ())
    save_picture(seen, tmp_path / "noise.png")
    with Image.open(tmp_path / "noise.png") as picture:
        assert picture.size == (1920, 1080)


def test_a_flat_surface_is_inspected(tmp_path):
    flat = inspect(md.HeightField(np.zeros((40, 40)), 0.08))
    assert flat.periods == ()
    save_picture(flat, tmp_path / "flat.png")


def test_a_name_is_no_formula_of_the_slide(tmp_path):
    # Regression: matplotlib takes what stands between dollar signs as mathematics, and raises for this.
    flat = inspect(md.HeightField(np.zeros((40, 40)), 0.08, r"a $\frac{$.npy"))
    save_picture(flat, tmp_path / "flat.png", title=r"$\frac{$")


@pytest.mark.slow
def test_the_picture_is_a_slide(sample, tmp_path):
    path = tmp_path / "slide.png"
    save_picture(sample, path, title="waves")
    with Image.open(path) as picture:
        pixels = np.asarray(picture.convert("RGB")).astype(int)
    assert pixels.shape == (1080, 1920, 3)
    # There are colours in the strips at the bottom, and the frame is white.
    strips = pixels[780:960, 250:1880]
    assert (np.ptp(strips, axis=2) > 60).mean() > 0.02
    assert (pixels[:, :20] == 255).all()
    with pytest.raises(ValueError, match=r"picture: got .*slide\.exr"):
        save_picture(sample, tmp_path / "slide.exr")


@pytest.mark.parametrize(
    ("value", "uncertainty", "text"),
    [
        (1.1437, 0.0123, "1.144 ± 0.012"),
        (-1.858, 1.19, "−1.9 ± 1.2"),
        (2.5, 0.0, "2.5"),
        (-0.0004, 0.05, "0.000 ± 0.050"),
        (88.1, 0.333, "88.10 ± 0.33"),
    ],
)
def test_an_uncertainty_has_two_digits(value, uncertainty, text):
    assert with_uncertainty(value, uncertainty) == text


# ---------------------------------------------------------------- the command


def test_colours_in_numbers_agree_with_colour_science():
    spectrum = sinusoid(coherence_length=2.5)
    (found,) = colours_at(spectrum, 0.0, 20.0, [30.0])
    assert (found.angle, found.view) == (20, 30)
    # The reflectance factor: of a white sheet it is one.
    factor = radiance(spectrum, 0.0, 20.0, 30.0) / illumination() * np.pi / np.cos(np.deg2rad(20))
    observer, daylight = colour.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"], colour.SDS_ILLUMINANTS["D65"]
    light = np.interp(observer.wavelengths, daylight.wavelengths, daylight.values)
    XYZ = np.interp(observer.wavelengths, WAVELENGTHS, factor) * light @ observer.values
    XYZ /= light @ observer.values[:, 1]
    np.testing.assert_allclose(found.XYZ, XYZ, rtol=5e-3)
    rgb = colour.XYZ_to_RGB(XYZ, "sRGB")
    assert rgb.min() > 0
    wanted = np.round(255 * colour.cctf_encoding(rgb / rgb.max()))
    np.testing.assert_allclose([int(found.sRGB[i : i + 2], 16) for i in (1, 3, 5)], wanted, atol=1)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    np.save("waves.npy", waves(count=4, pixel=0.08).heights)
    Image.fromarray(np.zeros((4, 4), np.uint8)).save("grey.png")
    Path("foil.toml").write_text('[surface]\nprofile = "foil"\nsamples = 32\n')
    return tmp_path


@pytest.mark.slow
def test_inspect_prints_numbers_and_draws_a_slide(folder, command):
    code, out, err = command("inspect waves.npy,pixel_size=0.08,extent=sample --json numbers.json")
    assert (code, err) == (0, "")
    for words in (
        "8 × 8 µm, 100 × 100 pixels",
        "80 × 80 nm",
        "Sq 70.7 nm",
        "2.00",
        "largest for this scan: 4; sunlight: 65",
        "errs by about",
        "ΔE00",
    ):
        assert words in out, words
    assert "\x1b" not in out
    assert "pixel size +5%" in out
    assert "…" not in out.partition("5 % more or less of")[2]  # no column is cut
    assert json.loads(Path("numbers.json").read_text())["carried_coherence_length"] == pytest.approx(4.0)
    assert {path.name for path in folder.iterdir()} == {
        *("waves.npy", "grey.png", "foil.toml", "numbers.json", "waves_inspect.png")
    }


def test_a_file_name_is_shown_as_it_is(folder, command):
    np.save("[red]:smile:.npy", np.random.default_rng(0).standard_normal((40, 40)) * 0.01)
    code, out, err = command("inspect [red]:smile:.npy,pixel_size=0.08 -o picture.png")
    assert (code, "[red]:smile:.npy: taken as extent=sample: neighbouring pixels" in err) == (0, True)
    assert "surface           [red]:smile:.npy" in out


@pytest.mark.slow
def test_a_profile_of_one_period_is_inspected(folder, command):
    np.save("ridges.npy", 0.1 * np.abs(np.sin(np.pi * np.arange(256) / 256))[None])
    code, out, err = command("inspect ridges.npy,pixel_size=0.005078125,extent=sample")
    assert (code, err) == (0, "")
    assert "none stands out (for a single period of a grating: extent=tile)" in out
    code, out, err = command("inspect ridges.npy,pixel_size=0.005078125 --overwrite")
    assert (code, "ridges.npy: taken as extent=tile: its edges meet" in err) == (0, True)
    assert "period            1.3 µm along 0°" in out
    tips = re.findall(r"tip broadening.*?\)\s+(\S+)", out)
    assert tips == ["+0.0%", "+0.0%"]
    for panel in (slice(80, 420), slice(820, 1270)):  # the surface, its spectrum
        pixels = np.asarray(Image.open("ridges_inspect.png").convert("L"))[200:630, panel].astype(int)
        assert (np.ptp(pixels, axis=0) > 0).any()
        assert pixels.std() > 20


@pytest.mark.slow
def test_inspect_takes_the_options_of_precompute(folder, command):
    heights = np.load("waves.npy")
    np.save("waves.npy", heights + 0.01 * np.arange(100))
    code, out, _ = command("inspect waves.npy,pixel_size=0.08")
    assert "Level it" in out
    code, out, err = command(
        "inspect waves.npy,prepare=level_plane,pixel_size=0.08,coherence_length=3,extent=sample --overwrite"
    )
    assert (code, err) == (0, "")
    assert "Level it" not in out
    assert "coherence length  3 µm" in out


def test_inspect_precompute_and_the_log_agree_on_the_error_of_scalar_theory(folder, command, llvm, caplog):
    Path("lamellar.toml").write_text('[surface]\nprofile = "lamellar"\nperiod = 1.6\ndepth = 0.2\nsamples = 64\n')
    said = [command("inspect lamellar.toml --json n.json")[1], command("precompute lamellar.toml")[1]]
    grating = {"type": "diffraction_grating", "filename": "lamellar.toml"}
    shapes = {
        "light": {"type": "constant"},
        "sensor": {"type": "perspective"},
        "plate": {"type": "rectangle", "bsdf": grating},
    }
    mi.load_dict({"type": "scene", **shapes})
    said.append("\n".join(record.getMessage() for record in caplog.records))
    warned = [re.findall(r"[Ss]calar theory: (errs by .*right)", text) for text in said]
    assert warned[0] == warned[1] == warned[2]
    assert len(warned[0]) == 1
    (printed,) = re.findall(r"^scalar theory +(errs by .*\))", said[0], re.MULTILINE)
    assert warned[0] == [f"{printed}; theory=rigorous has it right"]
    error = json.loads(Path("n.json").read_text())["scalar_error"]["reflected"]
    assert printed.startswith(f"errs by {100 * error:.0f}% ")


@pytest.mark.slow
def test_the_slide_of_a_large_tile_shows_a_dozen_periods():
    tile = md.HeightField(np.tile(md.gratings.sinusoidal(PERIOD, DEPTH, samples=16).heights, (32, 8)), PERIOD / 16)
    piece = piece_shown(inspect(tile, extent="tile", coherence_length=5.0))
    assert piece.tile_size == pytest.approx((24.0, 24.0))


@pytest.mark.slow
def test_the_slide_of_one_row_shows_whole_periods():
    """Whose pixels are square, so that the tile is much longer than wide."""
    row = md.HeightField(md.gratings.sinusoidal(PERIOD, DEPTH, samples=64).heights, PERIOD / 64)
    piece = piece_shown(inspect(row, extent="tile", coherence_length=5.0))
    assert min(piece.tile_size) >= 4 * PERIOD - 1e-6
    assert np.ptp(piece.heights) == pytest.approx(DEPTH, rel=0.01)


@pytest.mark.slow
def test_inspect_takes_a_recipe(folder, command):
    code, out, err = command("inspect foil.toml -o slide.pdf --angle 0 --view=-20,30 --json n.json")
    assert (code, err) == (0, "")
    first, second = json.loads(Path("n.json").read_text())["colours"]
    assert (first["view"], second["view"]) == (-20, 30)
    assert re.search(rf"^0° +30° +{second['XYZ'][0]:.4g} .*{second['sRGB']}$", out, re.MULTILINE)
    assert "periodic tile" in out
    assert "another period" in out
    assert Path("slide.pdf").read_bytes().startswith(b"%PDF")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("inspect", "Missing argument"),
        ("inspect gone.npy,pixel_size=0.1", "gone.npy"),
        ("inspect gone.toml", "gone.toml"),
        ("inspect waves.npy", "pixel_size"),
        ("inspect waves.npy,pixel_size=0.08 -o picture.exr", "-o: got picture.exr"),
        ("inspect waves.npy,pixel_size=0.08 -o nowhere/picture.png", "nowhere"),
        ("inspect waves.npy,pixel_size=0.08 --json nowhere/n.json", "--json: got nowhere/n.json"),
        ("inspect foil.toml,unit=nm", "foil.toml: got unit, wanted some of "),
        ("inspect grey.png,pixel_size=0.1 -o ./grey.png", "which is read"),
        ("inspect foil.toml --angle 30", "--angle: got 30 without --view"),
        ("inspect foil.toml --view 30:", "--view: got '30:', wanted a number"),
        ("inspect foil.toml,material=Al", "material: got 'Al' with theory 'scalar', wanted none"),
        ("inspect foil.toml --view 10,95", "--view: got 95, wanted degrees above −90 and below 90"),
    ],
)
def test_a_mistake_is_one_line_and_exit_code_2(folder, command, arguments, words):
    before = sorted(folder.iterdir())
    code, out, err = command(arguments)
    assert (code, out) == (2, "")
    assert len(err.splitlines()) == 1, err
    assert words in err
    assert sorted(folder.iterdir()) == before


@pytest.mark.slow
def test_a_measured_skin_has_its_period_and_no_concerns(scan):
    seen = inspect(scan("elaphe"))
    assert seen.periods[0].period == pytest.approx(1.0, abs=0.05)
    assert abs(abs(seen.periods[0].direction) - 90) < 5
    assert seen.concerns == ()


def test_colours_of_a_large_scan_are_those_of_its_middle_and_progress_moves():
    x = 0.1 * (np.arange(300) + 0.5)
    field = md.HeightField(0.05 * np.sin(2 * np.pi * x / 1.5) + np.zeros((300, 1)), 0.1)
    shown = []
    seen = inspect(field, measured=False, progress=lambda done, total: shown.append(done / total))
    assert seen.coherence_length == pytest.approx(15)
    assert (seen.piece.tile_size, seen.spectrum.coherence_length) == (pytest.approx((20, 20)), pytest.approx(10))
    np.testing.assert_array_equal(seen.piece.heights, field.heights[50:250, 50:250])
    assert seen.periods[0].period == pytest.approx(1.5, rel=1e-3)
    assert shown == sorted(shown)
    assert len(set(shown)) > 10
    assert shown[-1] == 1


@pytest.mark.parametrize("pixel", [8.0, 0.001, 5.0, 16.2, 1e-4, 0.02, 0.4, 1.3])
def test_pixels_of_any_size_are_inspected(pixel):
    x = np.arange(32)
    field = md.HeightField(0.2 * np.sin(2 * np.pi * x / 4.3) + np.zeros((32, 1)), pixel)
    seen = inspect(field, measured=False)
    assert seen.periods[0].period == pytest.approx(4.3 * pixel, rel=0.01)
    assert 4 * seen.piece.pixel_size[0] <= seen.spectrum.coherence_length <= seen.piece.tile_size[0] / 2 * (1 + 1e-9)
    assert seen.piece.tile_size[0] >= min(20, 32 * pixel) * (1 - 1e-9)


def test_pixels_too_coarse_for_the_coherence_length_are_named():
    with pytest.raises(ValueError, match=r"got 65 µm; wanted at least 4 pixels of 50 µm"):
        inspect(md.HeightField(np.eye(64), 50.0))


def test_fine_pixels_of_a_scan_are_averaged_for_its_colours():
    x = 0.01 * (np.arange(600) + 0.5)
    field = md.HeightField(0.05 * np.sin(2 * np.pi * x / 1.5) + np.zeros((600, 1)), 0.01)
    piece = inspect(field, measured=False).piece
    assert piece.pixel_size == pytest.approx((0.04, 0.04))
    assert piece.tile_size == pytest.approx(field.tile_size)
    assert piece.heights.mean() == pytest.approx(field.heights.mean(), abs=1e-12)


# ---------------------------------------------------------------- what people read


@pytest.mark.slow
@pytest.mark.parametrize("whole", [False, True])
def test_the_notebook_runs_and_prints_what_it_shows(monkeypatch, capsys, whole):
    if not dr.has_backend(dr.JitBackend.LLVM):
        pytest.skip("Dr.Jit finds no LLVM")
    plt = pytest.importorskip("matplotlib.pyplot")
    plt.switch_backend("agg")
    monkeypatch.setattr(plt, "show", lambda: plt.close("all"))
    monkeypatch.chdir(ROOT / "notebooks")
    notebook = json.loads((ROOT / "notebooks" / "01_from_scan_to_picture.ipynb").read_text(encoding="utf-8"))
    cells = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    names = {}
    for cell in cells:
        source = "".join(cell["source"])
        if not whole:
            for large, small in ((":112", ":64"), ("160", "24"), ("spp=64", "spp=4")):
                source = source.replace(large, small)
        exec(source, names)
        shown = "".join("".join(o["text"]) for o in cell["outputs"] if o["output_type"] == "stream")
        said = capsys.readouterr().out
        assert said == shown if whole else bool(said) == bool(shown)
    assert sum("image/png" in output.get("data", {}) for cell in cells for output in cell["outputs"]) == 3
    # Colours, not greys.
    assert np.ptp(names["picture"], axis=2).max() > 0.1 * names["picture"].max()


def test_figures_show_y_upwards():
    """Row 0, at the lowest y, is at the bottom."""
    heights = np.zeros((32, 32))
    heights[0] = 0.1
    axes = Figure().add_subplot()
    picture._height_map(axes, md.HeightField(heights, 0.1), "tile")
    (image,) = axes.images
    assert image.get_array()[0].min() > image.get_array()[1:].max()
    assert image.origin == "lower"
    bottom, top = axes.get_ylim()
    assert bottom < top


@pytest.mark.few(1)
@pytest.mark.parametrize(
    ("period", "said"),
    [
        (1.0, "33.4° (orders 1, 2, … at normal incidence)"),
        # sin θ_m = 0.55/T − sin θ_i is −1 from here on.
        (0.5, "no angle at normal incidence; order 1 back towards the light, from 6° incidence on"),
        (0.27, "no angle: the period is shorter than half the wavelength"),
    ],
)
def test_a_report_states_where_green_light_goes(period, said, command, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, out, _ = command("inspect", f"sinusoidal,period={period},depth=0.05,samples=32", "-o", "p.png")
    assert code == 0
    assert re.search(rf"^550 nm goes to +{re.escape(said)} *$", out, re.MULTILINE)
