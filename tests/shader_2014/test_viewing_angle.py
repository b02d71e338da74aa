"""Evaluation as in chapter 5 of the thesis of 2014: grating equation, analytic orders, direct sums."""

import dataclasses
import functools
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from brdf_map import MAP_METHODS, PROJECTIONS, brdf_map
from evaluation import period_rows, save_figures
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from published_surfaces import SURFACES, PublishedSurface
from viewing_angle import (
    METHODS,
    ReflectanceMap,
    fit_period,
    grating_equation,
    peak_angles,
    reflectance_map,
    relative_reflectance,
    ridges,
    viewing_angles,
    wavelengths,
)

import mitsuba_diffraction as md
from mitsuba_diffraction.settings import ScalarSettings
from mitsuba_diffraction.shader_2014.evaluate import relative_radiance
from mitsuba_diffraction.shader_2014.quirks import Quirks

ROOT = Path(__file__).parents[2]
BLAZE = SURFACES["blaze"]
COARSE = wavelengths(40.0)
SKINS = {"elaphe": (1, 1.144), "xenopeltis": (0, 1.552)}
"""Diffracting axis, period in µm."""


@functools.cache
def small_skin(name):
    axis, period = SKINS[name]
    surface = {"profile": f"{name}_synthetic", "size": 12.0, "pixel_size": 0.085, "seed": 1}
    recipe = md.Recipe(surface, ScalarSettings(coherence_length=10.0))
    return PublishedSurface(name, recipe, axis, period, (1e3 * period, 0.0))


# ---------------------------------------------------------------- the model at directions


def test_a_flat_mirror_has_the_relative_reflectance_one(llvm):
    flat = md.precompute(md.HeightField(np.zeros((8, 8)), 0.05))
    found = relative_reflectance(flat, [0, 0, 1], [[0, 0, 1]], COARSE)
    assert found.shape == (1, COARSE.size)
    np.testing.assert_allclose(found, 1, atol=2e-3)  # truncation of the lobes, and E in bytes


def test_the_published_reflectance_of_a_flat_mirror_exceeds_one(llvm):
    """docs/thesis.md: ρ of eq. 3.11 is not within [0, 1], with F as in the code, and less so with F² as in the text."""
    theta = np.deg2rad(75)
    wi, wo = (np.array([sign * np.sin(theta), 0, np.cos(theta)]) for sign in (1, -1))
    ratio = (0.04 + 0.96 * (1 - np.cos(theta)) ** 5) / 0.04  # Schlick's F of index 1.5, relative to normal incidence
    gain = (1 + wi @ wo) ** 2 / ((wi[2] + wo[2]) ** 2 * wo[2])
    flat = md.HeightField(np.zeros((8, 8)), 0.05)
    found = relative_radiance(flat, wi, wo, 550.0, variant="flss", quirks=Quirks.as_published())
    assert found == pytest.approx(ratio * gain, rel=1e-3)
    assert [round(float(ratio**power * gain), 2) for power in (1, 2)] == [1.65, 10.5]


@pytest.mark.few(1)
@pytest.mark.parametrize("order", [-1, 0, 1])
def test_orders_of_a_shallow_blaze_are_the_analytic_ones(llvm, order):
    depth, period, incidence = 0.02, 2.5, np.deg2rad(20.0)
    spectrum = md.precompute(md.gratings.blazed(period, depth), tolerance=1e-4)
    for nanometres in (400.0, 550.0, 777.0):
        # Light is incident from −x; order m of the phase has the outgoing direction −λm/T − ω_i.
        x = np.sin(incidence) - nanometres * 1e-3 * order / period
        wi, wo = np.array([-np.sin(incidence), 0, np.cos(incidence)]), np.array([x, 0, np.sqrt(1 - x**2)])
        cosines = wi[2] + wo[2]
        eta = np.sinc(order - cosines * 1e3 / nanometres * depth) ** 2
        d = 1 + wi @ wo
        k = d**2 / (wi[2] * wo[2] * cosines**2)
        g = min(1, 2 * cosines * min(wi[2], wo[2]) / d)
        expected = fresnel(np.sqrt(d / 2)) / 0.04 * k * g * wi[2] * eta
        found = relative_reflectance(spectrum, wi, wo, [nanometres])
        assert found == pytest.approx(np.array([expected]), rel=5e-3)


def fresnel(cosine, index=1.5):
    """Unpolarised power reflectance."""
    t = np.sqrt(1 - (1 - cosine**2) / index**2)
    s, p = (cosine - index * t) / (cosine + index * t), (index * cosine - t) / (index * cosine + t)
    return (s**2 + p**2) / 2


def test_the_number_of_wavelengths_need_not_be_a_multiple_of_four(llvm):
    wi, wo = BLAZE.direction(75.0), BLAZE.direction([-55.0, -50.0, -45.0])
    together = relative_reflectance(BLAZE.spectrum, wi, wo, COARSE[:7])
    for nanometres, row in zip(COARSE, together.T, strict=False):
        np.testing.assert_allclose(relative_reflectance(BLAZE.spectrum, wi, wo, [nanometres])[:, 0], row, rtol=1e-5)


def test_directions_below_the_surface_are_dark(llvm):
    assert relative_reflectance(BLAZE.spectrum, [0, 0, 1], [[0, 0.6, -0.8], [0, 1, 0]], [500.0]).max() == 0


# ---------------------------------------------------------------- viewing angle


def gaussian_lobes(period, incidence=75.0, step=0.25, width=0.0069):
    """A map as a grating with Gaussian lobes about orders 0, 1 and 2 would give it."""
    nanometres, angles = wavelengths(20.0), viewing_angles(step)
    sines = np.sin(np.deg2rad(incidence)) + np.sin(np.deg2rad(angles))
    q = sines / (nanometres[:, None] * 1e-3)
    lobes = sum(s * np.exp(-((q - n / period) ** 2) / (2 * width**2)) for n, s in ((0, 9.0), (1, 1.0), (2, 0.3)))
    return ReflectanceMap(BLAZE, "flss", incidence, nanometres, angles, lobes)


@given(period=st.floats(2.3, 2.7), incidence=st.floats(20.0, 80.0))
def test_the_fit_finds_the_period_of_gaussian_lobes_between_the_samples(period, incidence):
    fit = fit_period(gaussian_lobes(period, incidence))
    assert fit.mean == pytest.approx(period * 1e3, rel=1e-6)
    assert fit.variance < 1e-4


def test_the_fit_reveals_periods_that_vary_with_the_wavelength():
    found = gaussian_lobes(2.5)
    half = found.wavelengths < 580
    other = gaussian_lobes(2.45).reflectance
    mixed = ReflectanceMap(
        BLAZE, "flss", 75.0, found.wavelengths, found.angles, np.where(half[:, None], found.reflectance, other)
    )
    fit = fit_period(mixed)
    fraction = half.mean()
    assert fit.mean == pytest.approx(2450 + 50 * fraction, abs=0.01)
    assert fit.variance == pytest.approx(2500 * fraction * (1 - fraction), rel=1e-3)


def two_gratings():
    """A map of two gratings, the ridge of one half as high as that of the other."""
    first, second = gaussian_lobes(2.5, step=0.1), gaussian_lobes(1.9, step=0.1)
    both = first.reflectance + 0.5 * second.reflectance
    return ReflectanceMap(BLAZE, "flss", 75.0, first.wavelengths, first.angles, both)


def test_ridges_are_found_with_their_heights():
    first, second = ridges(two_gratings())
    assert (first.period, first.height) == (pytest.approx(2500, rel=1e-3), 1)
    assert (second.period, second.height) == (pytest.approx(1900, rel=1e-3), pytest.approx(0.5, rel=0.02))
    assert [ridge.period for ridge in ridges(gaussian_lobes(2.2))] == [pytest.approx(2200, rel=1e-3)]


def test_a_peak_outside_the_range_of_angles_gives_way_to_the_next_ridge():
    found = two_gratings()
    angles, other = (grating_equation(d, 75.0, found.wavelengths) for d in (2.5, 1.9))
    np.testing.assert_allclose(peak_angles(found, (angles[0] - 1, 90.0)), angles, atol=1e-2)
    # At the shortest wavelengths the first ridge is outside.
    peaks = peak_angles(found, ((angles[2] + angles[3]) / 2, 90.0))
    np.testing.assert_allclose(peaks, np.where(np.arange(angles.size) < 3, other, angles), atol=1e-2)
    assert np.isnan(peak_angles(gaussian_lobes(2.5, width=0.001), (85.0, 89.0))).all()


def test_the_published_fit_of_pq_is_that_of_a_ridge_that_leaves_the_range_of_angles():
    # Tile of 65 µm: orders 63 and 55. Final text, table 5.1; its "variance" is a standard deviation.
    surface, nanometres = SURFACES["elaphe_scan"], wavelengths()
    inside = grating_equation(65 / 63, 75.0, nanometres) <= surface.angles[1]
    periods = np.where(inside, 65e3 / 63, 65e3 / 55)
    mean, deviation = surface.final["pq"]
    assert periods.mean() == pytest.approx(mean, abs=2)
    assert periods.std() == pytest.approx(deviation, abs=2)


def test_three_orders_of_the_scan_of_elaphe_are_equally_strong():
    # Without this package: the orders of the tile along x, at the phase of order 57 at 580 nm and 75°.
    with Image.open(ROOT / "precompute" / "measured" / "elaphe_afm_65um.png") as picture:
        heights = np.asarray(picture.convert("L"), float)[::4] / 255 * 0.4347
    out = np.sqrt(1 - (0.58 * 57 / 65 - np.sin(np.deg2rad(75))) ** 2)
    field = np.exp(2j * np.pi / 0.58 * (np.cos(np.deg2rad(75)) + out) * heights).mean(axis=0)
    powers = np.abs(np.fft.fft(field))[-1:-80:-1] ** 2  # orders of light from +x: 1, 2, …
    strongest = 1 + np.argsort(powers[49:70])[::-1][:3] + 49
    assert sorted(strongest) == [55, 57, 63]
    assert powers[strongest - 1].max() < 1.3 * powers[strongest - 1].min()


@pytest.mark.parametrize(("azimuth", "expected"), [(None, (-0.5, 0)), (0.0, (0.5, 0)), (90.0, (0, 0.5))])
def test_the_azimuth_of_a_surface_is_that_of_the_light(azimuth, expected):
    surface = dataclasses.replace(BLAZE, azimuth=azimuth)
    np.testing.assert_allclose(surface.direction([30.0])[0], (*expected, np.sqrt(0.75)), atol=1e-9)


def test_the_peaks_lie_on_the_grating_equation():
    found = gaussian_lobes(2.5)
    np.testing.assert_allclose(peak_angles(found), grating_equation(2.5, 75.0, found.wavelengths), atol=1e-5)


def test_the_grating_equation_gives_the_angles_computed_by_hand():
    # sin 30° = 0.5; 0.5 µm / 2.5 µm = 0.2.
    expected = np.rad2deg(np.arcsin([-0.3, -0.1, 0.9]))
    np.testing.assert_allclose([grating_equation(2.5, 30.0, 500.0, n) for n in (1, 2, 7)], expected)
    assert np.isnan(grating_equation(2.5, 30.0, 500.0, 8))


def test_a_dark_map_has_no_peak():
    found = gaussian_lobes(2.5)
    dark = ReflectanceMap(BLAZE, "flss", 75.0, found.wavelengths, found.angles, 0 * found.reflectance)
    assert np.isnan(peak_angles(dark)).all()
    with pytest.raises(ValueError, match=r"reflectance: got none outside of the specular peak at 380 nm"):
        fit_period(dark)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("published", [True, False], ids=["published", "corrected"])
def test_the_period_of_the_blaze_is_fitted_within_a_thousandth(llvm, method, published):
    quirks = Quirks.as_published() if published else Quirks.corrected()
    fit = fit_period(reflectance_map(BLAZE, method, wavelengths=COARSE, quirks=quirks))
    assert fit.mean == pytest.approx(2500, rel=1e-3)
    assert fit.variance < 0.5


def test_any_other_angle_gives_the_same_period(llvm):
    fit = fit_period(reflectance_map(BLAZE, incidence=30.0, wavelengths=COARSE))
    assert fit.mean == pytest.approx(2500, rel=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("name", SKINS)
def test_the_period_of_a_small_skin_is_fitted_within_a_hundredth(llvm, name):
    found = reflectance_map(small_skin(name), wavelengths=COARSE, angles=viewing_angles(0.25))
    assert fit_period(found).mean == pytest.approx(1e3 * SKINS[name][1], rel=1e-2)


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("name", SKINS)
def test_the_period_of_a_skin_is_fitted_within_a_hundredth(llvm, name, method):
    surface = SURFACES[name]
    fit = fit_period(reflectance_map(surface, method))
    assert fit.mean == pytest.approx(surface.published[0], rel=1e-2)
    if method == "model":
        assert fit.variance < 0.5


@pytest.mark.slow
def test_the_peak_on_xenopeltis_toggles_where_a_ridge_enters_the_published_range(llvm):
    # Published: 1552 nm up to 580 nm, then another ridge (final text, figure 5.8). The azimuth is not.
    surface = dataclasses.replace(SURFACES["xenopeltis_scan"], axis=0, azimuth=333.0)
    found = reflectance_map(surface, "flss", wavelengths=wavelengths(20.0))

    def periods(between):
        sines = np.sin(np.deg2rad(75.0)) + np.sin(np.deg2rad(peak_angles(found, between)))
        return found.wavelengths / sines

    within = periods(surface.angles)
    np.testing.assert_allclose(within[found.wavelengths <= 580], 1557, atol=2)
    np.testing.assert_allclose(within[found.wavelengths >= 620], 3065, atol=10)
    np.testing.assert_allclose(periods((-90, 90)), 3065, atol=15)


@pytest.mark.slow
def test_the_published_shader_has_the_published_period_on_the_scan_of_elaphe(llvm):
    surface = SURFACES["elaphe_scan"]
    fit = fit_period(reflectance_map(surface, "flss", wavelengths=wavelengths(20.0)), surface.angles)
    assert fit.mean == pytest.approx(surface.final["flss"][0], abs=1.0)


@pytest.mark.slow
def test_small_scans_need_a_coherence_length_of_a_few_periods(llvm):
    fits = {}
    for name, coherence_length in (("elaphe", 1.5), ("elaphe", 2.9), ("xenopeltis", 6.0)):
        recipe = md.Recipe.load(ROOT / "precompute" / f"{name}_afm.toml", coherence_length=coherence_length)
        surface = PublishedSurface(name, recipe, 1, SKINS[name][1], (0, 0))
        fits[name, coherence_length] = fit_period(reflectance_map(surface, wavelengths=wavelengths(20.0)))
    assert fits["elaphe", 1.5].mean == pytest.approx(2282, abs=10)  # no peak: the tail of the specular lobe
    assert fits["elaphe", 2.9].mean == pytest.approx(1015, abs=5)
    assert fits["xenopeltis", 6.0].mean == pytest.approx(1542, abs=5)


def test_model_and_corrected_shader_agree_on_the_orders(llvm):
    # Both relative to the same flat mirror; E ≤ 1 and the exact Fresnel formula are the model's own.
    angles = grating_equation(BLAZE.period, 30.0, 380.0)
    model, shader = (
        reflectance_map(BLAZE, m, incidence=30.0, wavelengths=[380.0], angles=[angles], quirks=Quirks.corrected())
        for m in ("model", "flss")
    )
    assert model.reflectance == pytest.approx(shader.reflectance, rel=0.02)


@pytest.mark.parametrize("incidence", [30.0, 75.0])
def test_nmm_sees_only_the_orders_of_the_tile(llvm, incidence):
    found = reflectance_map(BLAZE, "nmm", incidence=incidence, wavelengths=[400.0, 780.0])
    sine = np.sin(np.deg2rad(incidence))
    for row, nanometres in zip(found.angles, found.wavelengths, strict=True):
        orders = 2.5 * (sine + np.sin(np.deg2rad(row))) / (nanometres * 1e-3)
        first, last = int(2500 * (sine - 1) / nanometres), int(2500 * (sine + 1) / nanometres)
        expected = [n for n in range(first, last + 1) if n]
        np.testing.assert_allclose(orders[np.isfinite(orders)], expected, rtol=1e-9)
    np.testing.assert_array_equal(np.isnan(found.angles), np.isnan(found.reflectance))


# ---------------------------------------------------------------- maps of directions


@pytest.mark.few(1)
@pytest.mark.parametrize("projection", PROJECTIONS)
def test_positions_of_orders_are_maxima_of_the_map(llvm, projection):
    found = brdf_map(BLAZE.with_coherence_length(6.5), projection=projection, side=120, incidence=(30.0, 20.0))
    for nanometres, channel in ((450.0, 2), (650.0, 0)):
        x, y = found.position_of_order(nanometres, 1)
        column, row = np.abs(found.x - x).argmin(), np.abs(found.y - y).argmin()
        colour = found.rgb[row, column]
        assert colour.argmax() == channel
        # It is dark beside the order; an evanescent order has no position.
        assert found.rgb[(row + 30) % 120, column].max() < 1e-2 * colour.max()
    assert np.isnan(found.position_of_order(650.0, 9)).all()


def test_orders_do_not_move_in_the_plane_of_u_and_v(llvm):
    positions = [
        brdf_map(BLAZE, "gem", projection="uv", side=8, incidence=(theta, 10.0)).position_of_order(550.0, -1)
        for theta in (0.0, 20.0, 40.0)
    ]
    np.testing.assert_allclose(positions, [(-0.55 / 2.5, 0)] * 3, atol=1e-12)


@pytest.mark.parametrize("method", MAP_METHODS)
def test_a_map_is_a_picture_of_the_hemisphere(llvm, method):
    found = brdf_map(BLAZE.with_coherence_length(6.5), method, side=40)
    inside = np.hypot(*np.meshgrid(found.x, found.y)) < 90
    np.testing.assert_array_equal(np.isfinite(found.rgb).all(axis=-1), inside)
    picture = found.picture
    assert picture.min() >= 0
    assert picture.max() <= 1
    assert np.ptp(picture[inside]) > 0.5
    assert found.exposure > 0


# ---------------------------------------------------------------- figures


@pytest.mark.slow
def test_figures_and_the_table_are_written(llvm, tmp_path):
    steps = []
    folder = tmp_path / "new" / "figures"
    save_figures(
        folder, surfaces=["blaze"], step=50.0, side=24, progress=lambda done, total: steps.append((done, total))
    )
    assert steps == [(1, 2), (2, 2)]
    names = {"viewing_angle_blaze.png", "brdf_blaze.png", "periods.md"}
    assert {path.name for path in folder.iterdir()} == names
    for path in folder.glob("*.png"):
        with Image.open(path) as picture:
            picture.load()
            assert min(picture.size) > 200
    text = (folder / "periods.md").read_text(encoding="utf-8")
    table = [line.strip("| ").split(" | ") for line in text.splitlines() if line.startswith("|")]
    head, _, *rows = table
    assert [row[1] for row in rows] == [
        "this model",
        *(f"{name}, {how}" for name in ("FLSS", "NMM", "PQ") for how in ("as published", "corrected")),
    ]
    for row in rows:
        for column in ("all angles: period ± deviation / nm", "published angles"):
            assert float(row[head.index(column)].split(" ± ")[0]) == pytest.approx(2500, rel=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("name", SURFACES)
def test_the_stored_periods_are_those_of_the_code_as_it_is(name, llvm):
    """tools/thesis/periods.md, which was stale: means to 0.05 nm, and spreads to 0.1 nm."""
    surface = SURFACES[name]
    lines = (ROOT / "tools" / "thesis" / "periods.md").read_text(encoding="utf-8").splitlines()
    rows = [[cell.strip() for cell in line.strip("| ").split(" | ")] for line in lines]
    listed = {row[1]: row for row in rows if row[0] == surface.name}
    methods = METHODS if name != "blaze" else ("model", "flss")
    found = [reflectance_map(surface, method, wavelengths=wavelengths()) for method in methods]
    measured = period_rows(surface, found, 5.0)
    assert len(measured) > len(methods)
    page = (ROOT / "docs" / "published.md").read_text(encoding="utf-8").splitlines()
    assert {line for line in page if line.startswith(f"| {surface.name} |")} <= set(lines)
    for row in measured:
        page = listed[row[1]]
        for one, other in zip(row[2:4], page[2:4], strict=True):
            (mean, spread), (listed_mean, listed_spread) = (map(float, text.split(" ± ")) for text in (one, other))
            assert mean == pytest.approx(listed_mean, abs=0.05), row[1]
            assert spread == pytest.approx(listed_spread, abs=0.1), row[1]
        assert [text[:4] for text in row[5].split(", ")] == [text[:4] for text in page[5].split(", ")]


# ---------------------------------------------------------------- misuse


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: reflectance_map(BLAZE, "gem"), "variant: gem has no spectrum, only RGB"),
        (lambda: reflectance_map(BLAZE, incidence=90.0), r"incidence: got 90\.0, wanted degrees"),
        (lambda: brdf_map(BLAZE, "none"), "variant: got 'none', wanted one of flss, nmm, pq, nmm_pq, gem"),
        (lambda: brdf_map(BLAZE, projection="fisheye"), "projection: got 'fisheye'"),
        (lambda: brdf_map(BLAZE, incidence=(95.0, 0.0)), r"incidence: got \(95\.0, 0\.0\)"),
        (lambda: relative_reflectance(BLAZE.spectrum, [0, 0, 1], [[0, 1]], [500.0]), "wi, wo, wavelengths: got shapes"),
        (
            lambda: ridges(ReflectanceMap(BLAZE, "nmm", 75.0, COARSE[:1], np.zeros((1, 3)), np.ones((1, 3)))),
            "found: got a map of nmm, wanted one with all viewing angles",
        ),
    ],
)
def test_wrong_arguments_are_refused(llvm, call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_a_variant_without_wavelengths_is_refused():
    mi.set_variant("scalar_rgb")
    with pytest.raises(ValueError, match="variant: Mitsuba's is scalar_rgb, wanted a spectral one"):
        relative_reflectance(BLAZE.spectrum, [0, 0, 1], [0, 0, 1], [500.0])
