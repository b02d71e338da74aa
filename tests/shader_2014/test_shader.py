"""The published shader against float64, against this project's model, and one peculiarity after the other."""

import signal
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy.special import diric

import mitsuba_diffraction as md
from mitsuba_diffraction.bsdf.testing import array, vectors
from mitsuba_diffraction.errors import root_cause
from mitsuba_diffraction.shader_2014 import tristimulus
from mitsuba_diffraction.shader_2014.evaluate import VARIANTS, colour, relative_radiance, shader_for
from mitsuba_diffraction.shader_2014.nmm_pq import line_area
from mitsuba_diffraction.shader_2014.pq import tile_factor, tiling_power
from mitsuba_diffraction.shader_2014.quirks import Quirks
from mitsuba_diffraction.shader_2014.taylor_textures import series_error, taylor_transforms

PUBLISHED, CORRECTED = Quirks.as_published(), Quirks.corrected()
BLAZE = md.gratings.blazed(2.5, 0.25, samples=64)
FLAT = md.HeightField(np.zeros((1, 4)), 0.625)
ROUGH = md.HeightField(np.random.default_rng(1).normal(0, 0.03, (8, 16)), 0.1)


pytestmark = pytest.mark.usefixtures("llvm")


def only(name):
    """Corrected, but for one peculiarity."""
    return replace(CORRECTED, **{name: True})


def unit(x, y=0.0):
    """Direction cosines → unit vectors above the surface, (..., 3)."""
    x, y = np.broadcast_arrays(np.asarray(x, float), np.asarray(y, float))
    return np.stack([x, y, np.sqrt(1 - x**2 - y**2)], axis=-1)


def sines(degrees):
    return np.sin(np.deg2rad(degrees))


def gain(wi, wo, shadowing=True):
    """F/F₀ K G cos θ_i of an index of 1.5, in float64."""
    d = 1 + (wi * wo).sum(-1)
    cos_i, cos_o = wi[..., 2], wo[..., 2]
    k = d**2 / (cos_o * (cos_i + cos_o) ** 2)
    g = np.minimum(1, 2 * (cos_i + cos_o) * np.minimum(cos_i, cos_o) / d) if shadowing else 1
    return (1 + 24 * (1 - np.sqrt(d / 2)) ** 5) * k * g


def kappa_of(wi, wo, nanometres):
    return 2e3 * np.pi * (wi[..., 2] + wo[..., 2]) / nanometres


def tile_spectrum(height_field, wi, wo, nanometres, coherence_length=65.0):
    """S(q; κ)/S_flat(0) of this project's model."""
    q = -(wi + wo)[..., :2] * 1e3 / np.asarray(nanometres, float)[..., None]
    kappa = kappa_of(wi, wo, nanometres)
    s, flat = (
        md.reference.power_spectrum(surface, at, kappa, coherence_length=coherence_length)
        for surface, at in ((height_field, q), (FLAT, 0 * q))
    )
    return s / flat


D65 = np.trapezoid(tristimulus.d65_weights()[::5], dx=5.0, axis=0)


def xyz(rgb):
    """The CIE XYZ that a shader shows as this linear sRGB."""
    return rgb @ np.linalg.inv(tristimulus.rgb_matrix(cie_rgb_matrix=False)).T


def seen(shader, wi, wo, **weights):
    """CIE XYZ of a material and a light, (n, 3)."""
    return xyz(array(shader.rgb(vectors(wi), vectors(wo), shader.weights(**weights))).T)


def finely(surface, wi, wo, step, coherence_length):
    """CIE XYZ of corrected FLSS, (n, 3): the trapezoidal rule over ρ(λ) with steps that resolve its lines, nm."""
    nanometres = np.arange(380, 780 + step / 2, step)
    shader = shader_for(surface, "flss", CORRECTED, coherence_length=coherence_length)
    weights, _ = shader.weights()(mi.Float(nanometres), mi.Bool(True))
    total = []
    for omega_i, omega_o in zip(wi, wo, strict=True):
        rho = relative_radiance(
            surface, omega_i, omega_o, nanometres, quirks=CORRECTED, coherence_length=coherence_length
        )
        total.append(np.trapezoid(rho * array(weights), dx=step))
    return np.array(total)


# --- FLSS -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("quirks", [PUBLISHED, CORRECTED], ids=["published", "corrected"])
def test_flss_at_the_centre_of_an_order_is_that_texel_of_the_taylor_series(quirks):
    nanometres, orders = 500.0, np.arange(-4, 4)
    wi = unit(0.2)
    wo = unit(-0.2 - orders * 0.5 / 2.5)
    kappa = kappa_of(wi, wo, nanometres)
    factorials = np.cumprod(np.maximum(np.arange(37.0), 1))
    series = sum((1j * kappa) ** n / factorials[n] * np.fft.fft2(BLAZE.centred**n)[0, orders] / 64 for n in range(37))
    expected = gain(wi, wo) * np.abs(series) ** 2
    rho = relative_radiance(BLAZE, wi, wo, np.full(8, nanometres), quirks=quirks)
    np.testing.assert_allclose(rho, expected, rtol=1e-4, atol=1e-7 * expected.max())


@pytest.mark.parametrize("surface", [BLAZE, ROUGH], ids=["blaze", "rough"])
def test_corrected_flss_is_the_projects_model(surface):
    # Everywhere between the orders too; the 3 × 3 texels omit e^{−(3/2)²/(σ_f T)²}, nothing for T ≪ L_c.
    rng = np.random.default_rng(2)
    wi, wo = (unit(*rng.uniform(-0.6, 0.6, (2, 500))) for _ in range(2))
    near = -wi[:250, 0] - rng.integers(-2, 3, 250) * 0.2 + rng.normal(0, 0.01, 250)
    wo[:250] = unit(np.clip(near, -0.75, 0.75), -wi[:250, 1])
    nanometres = np.full(500, 500.0)
    expected = gain(wi, wo) * tile_spectrum(surface, wi, wo, nanometres)
    rho = relative_radiance(surface, wi, wo, nanometres, quirks=CORRECTED)
    assert expected.max() > 1e-3
    np.testing.assert_allclose(rho, expected, atol=3e-5 * expected.max())


@pytest.mark.parametrize("ratio", [0.7, 1.0, 2.0])
def test_the_limit_of_the_neighbourhood_is_as_stated(ratio):
    """Against the model, for L_c/T from below to above one."""
    window = {"window": "texel"}
    size = ROUGH.tile_size[0]
    coherence = ratio * size
    surface = md.HeightField(ROUGH.heights[:1], ROUGH.pixel_size)
    wo = unit(np.linspace(-0.9, 0.9, 300))
    wi, nanometres = np.broadcast_to(unit(0.1), wo.shape), np.full(300, 500.0)
    rho = relative_radiance(surface, wi, wo, nanometres, quirks=CORRECTED, coherence_length=coherence, **window)
    expected = gain(wi, wo) * tile_spectrum(surface, wi, wo, nanometres, coherence)
    truncated_fraction = np.exp(-((1.5 / (2 / (np.pi * coherence) * size)) ** 2))
    assert np.abs(rho - expected).max() < (2 * truncated_fraction + 1e-5) * expected.max()


@pytest.mark.parametrize(("size", "radius"), [(6.0, 1), (65.0, 1), (130.0, 3), (300.0, 6)])
def test_the_window_spans_four_sigma(size, radius):
    # σ_f T = 2T/(π L_c) texels, for L_c = 65 µm.
    surface = md.HeightField(np.zeros((1, 4)), (size / 4, 1.0))
    shader = shader_for(surface, "flss", CORRECTED)
    assert shader.radius == (radius, 1)
    assert 2 * radius + 1 >= 4 * 2 / np.pi * size / 65 > 2 * radius - 1 or radius == 1
    assert shader.texels_per_term == 3 * (2 * radius + 1)
    assert shader_for(surface, "flss", PUBLISHED).texels_per_term == 9
    assert shader_for(surface, "flss", CORRECTED, window="texel").texels_per_term == 9
    assert shader_for(surface, "flss", PUBLISHED, window="4sigma").radius == (radius, 1)


def test_a_window_of_one_texel_omits_most_of_a_line_of_short_coherence():
    surface = md.HeightField(np.random.default_rng(3).normal(0, 0.03, (1, 160)), 0.1)
    wo = unit(np.linspace(-0.6, 0.6, 200))
    wi, at = np.broadcast_to(unit(0.1), wo.shape), np.full(200, 500.0)
    expected = gain(wi, wo) * tile_spectrum(surface, wi, wo, at, 4.0)
    right, wrong = (
        relative_radiance(surface, wi, wo, at, quirks=q, coherence_length=4.0) for q in (CORRECTED, only("one_texel"))
    )
    assert np.abs(right - expected).sum() < 0.02 * expected.sum()
    assert np.abs(wrong - expected).sum() > 0.3 * expected.sum()


@pytest.mark.slow
def test_a_tapered_scan_is_the_average_over_its_windows():
    """Against Welch's method in float64, on a rough scan and at a coherence of a half and a quarter of it."""
    import scipy.ndimage

    noise = scipy.ndimage.gaussian_filter(np.random.default_rng(5).normal(size=(80, 80)), 2)
    scan = md.HeightField(0.06 * noise / noise.std() + np.linspace(0, 0.2, 80), 0.1)
    rng = np.random.default_rng(6)
    wi, wo = unit(*rng.uniform(-0.3, 0.3, (2, 300))), unit(*rng.uniform(-0.6, 0.6, (2, 300)))
    at = np.full(300, 500.0)
    for length in (4.0, 2.0):
        q, kappa = -(wi + wo)[:, :2] / 0.5, kappa_of(wi, wo, at)
        expected = md.reference.power_spectrum(scan, q, kappa, extent="sample", coherence_length=length)
        expected = expected * gain(wi, wo) * 4 / (np.pi * length**2)
        settings = dict(coherence_length=length, extent="sample")
        errors = [
            np.abs(relative_radiance(scan, wi, wo, at, quirks=quirks, **settings) - expected).sum() / expected.sum()
            for quirks in (CORRECTED, only("periodic_scan"))
        ]
        assert errors[0] < 0.05
        assert errors[1] > 2 * errors[0]


def test_as_many_terms_as_the_error_requires():
    from scipy.special import gammaln

    x = 4e3 * np.pi / 380 * BLAZE.half_range
    terms = shader_for(BLAZE, "flss", CORRECTED).terms
    remainders = [np.exp(n * np.log(x) - gammaln(n + 1)) for n in (terms, terms - 1)]
    assert remainders[0] <= 1e-4 < remainders[1]
    assert {kind: shader_for(BLAZE, kind, PUBLISHED).terms for kind in ("flss", "nmm", "pq", "nmm_pq")} == {
        "flss": 37, "nmm": 31, "pq": 39, "nmm_pq": 39
    }  # fmt: skip
    assert shader_for(BLAZE, "flss", CORRECTED, max_height_scale=2.0).terms > terms
    # The loss of digits in float32 as it is.
    powers = np.cumprod(np.concatenate([[1.0], 20.0 / np.arange(1, 80)])).astype(np.float32)
    found = sum((powers * np.resize([1, 1j, -1, -1j], 80)).astype(np.complex64), np.complex64(0))
    assert abs(found - np.exp(20j)) < 3 * series_error(20.0, 80)
    assert series_error(20.0, 80) > 0.1 > 1e-3 > series_error(8.0, 40)


def test_corrected_flss_in_radiance_is_the_bsdf():
    bsdf = mi.load_dict(
        {"type": "diffraction_grating", "profile": "blazed", "period": 2.5, "depth": 0.25, "samples": 64,
         "int_ior": 1.5, "ext_ior": 1.0, "tolerance": 1e-4, "conserve_energy": False}
    )  # fmt: skip
    shader = shader_for(BLAZE, "flss", CORRECTED)
    x = np.linspace(-0.8, 0.5, 400)
    si = dr.zeros(mi.SurfaceInteraction3f)
    si.wi = mi.Vector3f(unit(x).T.astype(np.float32))
    light = mi.Vector3f(*(float(c) for c in unit(0.2)))
    si.wavelengths = mi.UnpolarizedSpectrum(550)
    expected = np.array(bsdf.eval(mi.BSDFContext(), si, light))[0]
    rho = relative_radiance(BLAZE, unit(0.2), unit(x), np.full(400, 550.0), quirks=CORRECTED, exact_fresnel=True)
    np.testing.assert_allclose(rho * 0.04 * shader.peak / 0.55**2, expected, atol=1e-3 * expected.max())


def test_27000_texels_are_read_for_a_point():
    assert shader_for(BLAZE, "flss", PUBLISHED).texel_reads == 81 * 37 * 9 == 26973
    assert shader_for(BLAZE, "flss", PUBLISHED, terms=30).texel_reads == 81 * 30 * 9
    assert shader_for(BLAZE, "pq", PUBLISHED, interpolation="linear").texel_reads == 81 * 39 * 4
    # At |u| = 2 the orders 7 … 13 are in the light.
    assert shader_for(BLAZE, "nmm", PUBLISHED).texel_reads == 31 * (81 + 7 * 9)
    assert shader_for(BLAZE, "gem", PUBLISHED).texel_reads == 0


# --- NMM --------------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_nmm_with_its_jacobian_converges_to_flss():
    x = np.linspace(-0.9, 0.8, 60)
    wi, wo = np.broadcast_to(unit(0.2), (60, 3)), unit(x)
    errors = []
    for coherence, step in ((65.0, 0.5), (260.0, 0.125), (1040.0, 0.1)):
        flss = finely(BLAZE, wi, wo, step, coherence)
        nmm = xyz(colour(BLAZE, wi, wo, variant="nmm", quirks=CORRECTED, coherence_length=coherence))
        lines = np.abs(x + 0.2) > 0.1  # order zero is summed alike
        errors.append(np.abs(nmm - flss)[lines].max() / flss[lines].max())
        np.testing.assert_allclose(nmm[~lines], flss[~lines], rtol=0.05, atol=0.03 * flss.max())
    # Lines of finite width blur the colour; that goes with the square of the width.
    assert errors[0] < 0.06
    assert errors[1] < 0.15 * errors[0]
    assert errors[2] < 1.5e-3


def test_nmm_in_the_diagonal_counts_every_line_once():
    crossed = md.gratings.crossed(2.0, 0.1, samples=16)
    rng = np.random.default_rng(4)
    lines = np.array([(1, 1), (1, -1), (2, 1), (1, 2), (0, 1), (2, 0)])
    u, v = (lines[rng.integers(0, 6, 100)] * rng.uniform(0.42, 0.68, (100, 1)) / 2).T + rng.normal(0, 0.001, (2, 100))
    wi, wo = np.broadcast_to(unit(0.05, 0.02), (100, 3)), unit(-0.05 - u, -0.02 - v)
    flss = finely(crossed, wi, wo, 0.25, 130.0)
    nmm = xyz(colour(crossed, wi, wo, variant="nmm", quirks=CORRECTED, coherence_length=130.0))
    assert np.abs(nmm - flss).max() < 0.05 * flss.max()


def test_without_the_jacobian_nmm_is_purple():
    x = np.linspace(-1.0, 0.6, 300)
    x = x[np.abs(x + 0.2) > 0.1]
    total = [
        xyz(colour(BLAZE, unit(0.2), unit(x), variant="nmm", quirks=q)).sum(0) for q in (only("no_jacobian"), CORRECTED)
    ]
    wrong, right = (t / t[1] for t in total)
    assert wrong[2] > 1.1 * right[2]


# --- PQ ---------------------------------------------------------------------------------------------------------------


def test_tile_factor_is_the_kernel_of_dirichlet():
    x = np.concatenate([np.linspace(-40, 40, 4001), np.arange(-9, 10), np.arange(1, 200) / 26, 3 + 1e-6 * np.arange(9)])
    x = x.astype(np.float32)
    for count in (1, 2, 7, 26):
        expected = count * diric(2 * np.pi * x.astype(np.float64), count)
        np.testing.assert_allclose(np.array(tile_factor(mi.Float(x), count)), expected, rtol=2e-5, atol=2e-5)


def spectrum_of_tiles(surface, q, kappa, tiles):
    """S/area of P × Q tiles without a window, by direct sums over all of their pixels, zero beyond Nyquist."""
    (rows, columns), pixel = surface.shape, surface.pixel_size
    x, y = np.arange(tiles[0] * columns) * pixel[0], np.arange(tiles[1] * rows) * pixel[1]
    heights = np.tile(surface.heights, tiles[::-1])
    sums = [
        np.exp(-2j * np.pi * q_y * y) @ np.exp(1j * k * heights) @ np.exp(-2j * np.pi * q_x * x)
        for (q_x, q_y), k in zip(q, kappa, strict=True)
    ]
    inside = (np.abs(q) <= 0.5 / np.array(pixel)).all(axis=1)
    return np.where(inside, np.abs(np.array(sums) / heights.size) ** 2, 0)


@pytest.mark.few(2)
@pytest.mark.parametrize("tiles", [(1, 1), (5, 1), (26, 3)])
@pytest.mark.parametrize("surface", [BLAZE, ROUGH], ids=["blaze", "rough"])
def test_pq_of_n_tiles_is_the_transform_of_their_surface(surface, tiles):
    rng = np.random.default_rng(3)
    wi, wo = unit(*rng.uniform(-0.07, 0.07, (2, 150))), unit(*rng.uniform(-0.07, 0.07, (2, 150)))
    wo[:, 0] = rng.uniform(-0.9, 0.6, 150)
    wo[:75, 1] = -wi[:75, 1]
    wo[:, 2] = np.sqrt(1 - wo[:, 0] ** 2 - wo[:, 1] ** 2)
    nanometres = np.full(150, 600.0)
    q = -(wi + wo)[:, :2] / 0.6
    s = spectrum_of_tiles(surface, q, kappa_of(wi, wo, nanometres), tiles)
    radius = max(surface.shape)
    settings = dict(variant="pq", quirks=CORRECTED, tiles=tiles, radius=radius)
    rho = relative_radiance(surface, wi, wo, nanometres, **settings)
    np.testing.assert_allclose(rho, gain(wi, wo) * s, atol=3e-5 * (gain(wi, wo) * s).max())
    wrong = relative_radiance(surface, wi, wo, nanometres, **settings | {"quirks": only("wrong_product")})
    assert np.abs(wrong - rho).max() > 0.01 * rho.max()


def test_at_integers_the_wrong_product_is_only_a_factor():
    x = mi.Float([0.0, 1.0, 5.0, -3.0])
    np.testing.assert_allclose(np.array(tiling_power(x, x, (7, 4), False)), 1)
    np.testing.assert_allclose(np.array(tiling_power(x, x, (7, 4), True)), 2, rtol=1e-5)


def test_pq_interpolations_agree_at_the_orders_and_differ_between():
    nanometres, orders = 500.0, np.arange(-3, 3)
    wi, wo = unit(0.2), unit(-0.2 - orders * 0.2)
    rho = [
        relative_radiance(BLAZE, wi, wo, np.full(6, nanometres), variant="pq", quirks=CORRECTED, **s)
        for s in ({}, {"interpolation": "linear"}, {"radius": 8})
    ]
    np.testing.assert_allclose(rho[1], rho[0], rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(rho[2], rho[0], rtol=1e-4, atol=1e-6)
    between = unit(-0.2 - (orders + 0.5) * 0.2)
    one = dict(variant="pq", quirks=CORRECTED, tiles=(1, 1))
    linear = relative_radiance(BLAZE, wi, between, np.full(6, nanometres), interpolation="linear", **one)
    exact = relative_radiance(BLAZE, wi, between, np.full(6, nanometres), radius=32, **one)
    near = relative_radiance(BLAZE, wi, between, np.full(6, nanometres), **one)
    assert np.abs(near - exact).max() < np.abs(linear - exact).max()


@pytest.mark.parametrize(("tiles", "across", "rho", "delta"), [
    (26, 26, 1.0, 0.0), (26, 5, 0.3, 0.1), (3, 20, 0.9, 0.02), (7, 7, 0.0, 0.05), (9, 1, 0.5, 0.4), (26, 26, 0.5, 0.004)
])  # fmt: skip
def test_the_area_of_a_line_of_pq_is_its_integral(tiles, across, rho, delta):
    t = np.linspace(-40, 40, 400_001)
    expected = np.trapezoid(np.sinc(tiles * t) ** 2 * np.sinc(across * (rho * t + delta)) ** 2, t)
    found = line_area(mi.Float(tiles), mi.Float(across), mi.Float(rho), mi.Float(delta))
    np.testing.assert_allclose(np.array(found), expected, rtol=1e-3, atol=1e-5 / tiles)


def test_nmm_of_tiles_with_its_jacobian_converges_to_pq():
    x = np.linspace(-0.9, 0.8, 40)
    x = x[np.abs(x + 0.2) > 0.1]
    wi, wo = np.broadcast_to(unit(0.2), (*x.shape, 3)), unit(x)
    nanometres, errors = np.arange(380, 780.1, 0.5), []
    everywhere = [np.broadcast_to(omega[:, None], (x.size, nanometres.size, 3)) for omega in (wi, wo)]
    for tiles in (10, 40):
        settings = dict(quirks=CORRECTED, tiles=(tiles, 1))
        weights = array(shader_for(BLAZE, "pq", **settings).weights()(mi.Float(nanometres), mi.Bool(True))[0]).T
        at = np.broadcast_to(nanometres, (x.size, nanometres.size))
        pq = 0.5 * relative_radiance(BLAZE, *everywhere, at, variant="pq", **settings) @ weights
        nmm = xyz(colour(BLAZE, wi, wo, variant="nmm_pq", **settings))
        errors.append(np.abs(nmm - pq).sum() / pq.sum())
        wrong = xyz(colour(BLAZE, wi, wo, variant="nmm_pq", **settings | {"quirks": only("no_jacobian")}))
        total = [colours.sum(0) / colours[:, 1].sum() for colours in (pq, nmm, wrong)]
    assert abs(total[1][2] - total[0][2]) < 0.05 * total[0][2]
    assert total[2][2] > 1.1 * total[0][2]  # purple
    # Side lobes of order zero, and of lines at the ends of the visible range, fall off with the number of tiles.
    assert errors[1] < 0.3 * errors[0] < 0.1


# --- GEM --------------------------------------------------------------------------------------------------------------


def test_gem_puts_its_rainbow_on_the_wavelengths_of_the_grating_equation():
    # First order of d = 1 µm alone: λ = |u| µm.
    red, green, blue = 0.68, 0.58, 0.48
    wo = unit(-np.array([red, green, blue]))
    settings = dict(variant="gem", spacing=1.0, roughness=50.0)
    rgb = colour(BLAZE, unit(0.0), wo, quirks=CORRECTED, **settings)
    np.testing.assert_allclose(rgb, np.eye(3), atol=0.01)
    assert shader_for(BLAZE, "gem", PUBLISHED).spacing == pytest.approx(2.5)
    three = md.HeightField(np.tile(BLAZE.heights, 3), BLAZE.pixel_size)
    assert shader_for(three, "gem", PUBLISHED).spacing == pytest.approx(2.5)


# --- The peculiarities, one by one ------------------------------------------------------------------------------------


def test_schlicks_value_is_a_power_already():
    """On a flat surface ρ in the mirror direction is R(θ)/R₀ cos θ_i, since K = G = 1."""
    theta = np.array([10.0, 60, 70, 80])
    wi, wo, at = unit(sines(theta)), unit(-sines(theta)), np.full(4, 550.0)
    exact = np.array(mi.fresnel(mi.Float(np.cos(np.deg2rad(theta))), 1.5)[0]) / 0.04 * wi[:, 2]
    for quirks in (PUBLISHED, CORRECTED):
        np.testing.assert_allclose(relative_radiance(FLAT, wi, wo, at, quirks=quirks), exact, rtol=0.25)


def test_the_index_of_the_material_scales_the_colour():
    """A flat mirror under D65 shows white times F(θ)/F(0) cos θ_i."""
    wi, wo = unit(sines([75])), unit(-sines([75]))
    relative = replace(CORRECTED, relative=True)
    right = seen(shader_for(FLAT, "flss", relative), wi, wo, r_0=0.9) / D65
    away = (1 - np.cos(np.deg2rad(75))) ** 5
    np.testing.assert_allclose(right, np.full((1, 3), (0.9 + 0.1 * away) / 0.9 * wi[0, 2]), rtol=1e-5)
    fixed = seen(shader_for(FLAT, "flss", replace(relative, fixed_index=True)), wi, wo, r_0=0.9)
    fixed /= D65
    np.testing.assert_allclose(fixed, np.full((1, 3), (0.04 + 0.96 * away) / 0.04 * wi[0, 2]), rtol=1e-5)


@pytest.mark.parametrize("quirks", [PUBLISHED, CORRECTED], ids=["published", "corrected"])
def test_a_flat_mirror_gives_one(quirks):
    up = unit([0.0])
    assert relative_radiance(FLAT, up, up, [550.0], quirks=quirks) == pytest.approx(1, rel=1e-6)


def test_the_average_over_positions_is_the_sum_of_powers():
    """Rolling the tile moves x₀; the mean of |Σ φ F|² over all positions is Σ φ² |F|²."""
    heights = ROUGH.heights[:1]
    wo = unit(np.linspace(-0.5, 0.5, 40))
    settings = dict(wavelengths=np.full(40, 500.0), coherence_length=1.0)
    powers = [
        relative_radiance(md.HeightField(np.roll(heights, n), 0.1), unit(0.0), wo, quirks=only("complex_window_sum"),
                          **settings)
        for n in range(16)
    ]  # fmt: skip
    right = relative_radiance(md.HeightField(heights, 0.1), unit(0.0), wo, quirks=CORRECTED, **settings)
    np.testing.assert_allclose(np.mean(powers, axis=0), right, rtol=1e-4, atol=1e-6)
    assert np.abs(np.array(powers) - right).max() > 0.1 * right.max()


def test_the_floor_omits_a_neighbour():
    surface = md.HeightField(ROUGH.heights[:1], 0.1)
    wo = unit(np.linspace(-0.6, 0.6, 200))
    wi, at = np.broadcast_to(unit(0.1), wo.shape), np.full(200, 500.0)
    expected = gain(wi, wo) * tile_spectrum(surface, wi, wo, at, 1.6)
    right, wrong = (
        relative_radiance(surface, wi, wo, at, quirks=replace(q, one_texel=True), coherence_length=1.6)
        for q in (CORRECTED, only("floor_anchor"))
    )
    assert np.abs(right - expected).max() < 0.01 * expected.max()
    assert np.abs(wrong - expected).max() > 0.04 * expected.max()


def test_the_31_terms_of_nmm_are_too_few_for_a_deep_surface():
    deep = md.gratings.blazed(2.5, 0.85, samples=64)
    orders = np.arange(-4, 4)
    wi, wo, at = unit(0.0), unit(-orders * 0.16), np.full(8, 400.0)
    expected = gain(wi, wo) * np.diagonal([md.reference.order_powers(deep, k)[0, orders] for k in kappa_of(wi, wo, at)])
    right, wrong = (
        relative_radiance(deep, wi, wo, at, variant="nmm", quirks=q) for q in (CORRECTED, only("fixed_terms"))
    )
    np.testing.assert_allclose(right, expected, atol=0.02 * expected.max())
    assert not np.allclose(wrong, expected, atol=0.1 * expected.max())


def test_a_flat_mirror_under_d65_is_white():
    up = unit([0.0])
    np.testing.assert_allclose(
        colour(FLAT, up, up, quirks=replace(CORRECTED, relative=True)), np.ones((1, 3)), atol=1e-3
    )
    rgb = colour(FLAT, up, up, quirks=replace(CORRECTED, relative=True, cie_rgb_matrix=True))[0]
    # The matrix keeps the white of equal energy, not that of D65.
    np.testing.assert_allclose(rgb, tristimulus.CIE_RGB @ D65, rtol=1e-4)
    np.testing.assert_allclose(tristimulus.CIE_RGB.sum(axis=1), 1, atol=1e-3)


def test_the_light_has_its_own_spectrum():
    up, light = unit([0.0]), np.full(401, 2.0)
    relative = replace(CORRECTED, relative=True)
    right = seen(shader_for(FLAT, "flss", relative), up, up, light=light)
    np.testing.assert_allclose(right, np.full((1, 3), 2.0), rtol=2e-3)
    fixed = seen(shader_for(FLAT, "flss", replace(relative, d65_light=True)), up, up, light=light)
    np.testing.assert_allclose(fixed[0], 2 * D65, rtol=2e-3)


def test_a_relative_radiance_lacks_the_wavelength():
    """The colour of a flat mirror: ∫ D65 (x̄, ȳ, z̄) R₀ S(0)/λ² dλ."""
    up = unit([0.0])
    nodes = tristimulus.wavelengths()[::5]
    weights = (
        tristimulus.d65_weights()[::5] * (0.04 * shader_for(FLAT, "flss", CORRECTED).peak * 1e6 / nodes**2)[:, None]
    )
    right = xyz(colour(FLAT, up, up, quirks=CORRECTED))[0]
    np.testing.assert_allclose(right, np.trapezoid(weights, dx=5.0, axis=0), rtol=1e-4)
    relative = xyz(colour(FLAT, up, up, quirks=only("relative")))[0]
    np.testing.assert_allclose(relative, D65, rtol=1e-4)


def test_quirks_are_switches():
    with pytest.raises(ValueError, match="relative: got 1, wanted True or False"):
        replace(PUBLISHED, relative=1)
    assert all(getattr(PUBLISHED, name) and not getattr(CORRECTED, name) for name in Quirks.names())


# --- Textures and colour tables ---------------------------------------------------------------------------------------


def test_texels_are_the_transforms_of_the_powers_of_the_heights():
    texels, height = taylor_transforms(ROUGH, 3, origin_at_centre=False)
    assert texels.shape == (8, 16, 3)
    assert height == ROUGH.half_range
    t = ROUGH.centred / ROUGH.half_range
    for n in range(3):
        expected = np.fft.fft2(t**n) / t.size
        assert texels[4, 8, n] == pytest.approx(expected[0, 0], abs=1e-6)
        assert texels[4 - 2, 8 + 3, n] == pytest.approx(expected[-2, 3], abs=1e-6)


def test_spectra_of_the_primaries_have_their_colours():
    from mitsuba_diffraction.optics.color import radiance_to_linear_sRGB

    spectra = tristimulus.emission_of_primaries()
    assert spectra.min() > -1e-6
    np.testing.assert_allclose(radiance_to_linear_sRGB(spectra.T, tristimulus.EMISSION), np.eye(3), atol=6e-3)
    wavelengths = mi.UnpolarizedSpectrum(360, 452.5, 700, 830)
    light = np.array(tristimulus.Emission()(mi.Color3f(0.5, 1, 2), wavelengths, mi.Bool(True))).ravel()
    expected = [np.interp(w, tristimulus.EMISSION, spectra @ [0.5, 1, 2]) for w in (360, 452.5, 700, 830)]
    np.testing.assert_allclose(light, expected, rtol=1e-4, atol=1e-6)


# --- Arguments --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"variant": "flsss"}, "variant: got 'flsss', wanted one of flss, nmm, pq, nmm_pq, gem"),
        ({"terms": 0}, "terms: got 0"),
        ({"coherence_length": 0}, "coherence_length"),
        ({"variant": "pq", "interpolation": "cubic"}, "interpolation: got 'cubic', wanted one of sinc, linear"),
        ({"variant": "gem", "spacing": -1.0}, "spacing"),
    ],
)
def test_wrong_arguments_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        colour(BLAZE, unit([0.1]), unit([0.2]), **settings)


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("quirks", [PUBLISHED, CORRECTED], ids=["published", "corrected"])
def test_values_are_finite_at_hard_directions(variant, quirks):
    grazing = [0.0, 1e-4, 0.5, 0.99999, 1.0]
    x_i, x_o = np.meshgrid(grazing, np.concatenate([grazing, -np.array(grazing)]))
    for surface in (FLAT, BLAZE, ROUGH):
        rgb = colour(surface, unit(x_i), unit(x_o), variant=variant, quirks=quirks, terms=20) if (
            variant != "gem"
        ) else colour(surface, unit(x_i), unit(x_o), variant=variant, quirks=quirks)  # fmt: skip
        assert rgb.shape == (*x_i.shape, 3)
        assert np.isfinite(rgb).all()
    below = unit(0.3) * [1, 1, -1]
    more = {"terms": 20} if variant != "gem" else {}
    assert not colour(BLAZE, below, unit(0.3), variant=variant, quirks=quirks, **more).any()


# --- The integrator ---------------------------------------------------------------------------------------------------

GRATING = {"type": "diffraction_grating", "profile": "blazed", "period": 2.5, "depth": 0.25, "samples": 64,
           "coherence_length": 5.0}  # fmt: skip
SUN = {"type": "directional", "direction": [0, 0, -1], "irradiance": {"type": "d65"}}
DIRECT = {"type": "direct", "emitter_samples": 1, "bsdf_samples": 0}


def scene(integrator, bsdf=GRATING, light=SUN, **more):
    camera = mi.ScalarTransform4f().look_at([0, 0, 1], [0, 0, 0], [0, 1, 0])
    film = {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}, "pixel_format": "xyz",
            "component_format": "float32"}  # fmt: skip
    return mi.load_dict(
        {"type": "scene", "integrator": integrator, "plate": {"type": "rectangle", "bsdf": bsdf}, "light": light,
         "sensor": {"type": "perspective", "to_world": camera, "fov": 80, "film": film}, **more}
    )  # fmt: skip


def picture(integrator, spp=16, **of):
    return np.array(mi.render(scene(integrator, **of), spp=spp, seed=1))


def shader(variant="flss", **parameters):
    return {"type": "diffraction_shader", "variant": variant, **parameters}


def viewing_cosines(built):
    """(u, v) = −ω_o at the middles of the pixels, for light along the normal: (2, 16, 16)."""
    y, x = np.mgrid[:16, :16].reshape(2, -1) + 0.5
    position = mi.Point2f(*(c.astype(np.float32) / 16 for c in (x, y)))
    ray, _ = built.sensors()[0].sample_ray(0, 0.5, position, mi.Point2f(0.5))
    return np.array(ray.d)[:2].reshape(2, 16, 16)


@pytest.mark.few(1)
@pytest.mark.parametrize("as_published", [True, False])
@pytest.mark.parametrize("variant", ["flss", "nmm", "pq"])
def test_bright_pixels_are_where_the_grating_equation_predicts(variant, as_published):
    # u = mλ/T: order 1 of T = 1 µm lies at 0.38 < u < 0.78; the second is out of sight.
    bsdf = dict(GRATING, period=1.0, depth=0.25, coherence_length=20.0)
    built = scene(shader(variant, as_published=as_published, terms=28, fixed_coherence=False), bsdf)
    image = np.array(mi.render(built, spp=128, seed=1))
    assert image.shape == (16, 16, 3)
    assert np.isfinite(image).all()
    u, v = viewing_cosines(built)
    luminance = np.abs(image[..., 1])
    # Half a pixel is 0.05 wide, and three σ_q λ of a lobe 0.04 more.
    zero, one = np.abs(u) < 0.1, (np.abs(u) > 0.29) & (np.abs(u) < 0.87)
    on = (np.abs(v) < 0.1) & (zero | one)
    # A finite number of tiles has side lobes, 1/x².
    assert luminance[~on].max() < (0.2 if variant == "pq" else 2e-3) * luminance.max()
    # The facets mirror 2 depth/λ = 1, and mostly green to the eye.
    row = image[7:9].mean(0)[:, 1]
    u = u[7:9].mean(0)
    assert (row[(u > 0.45) & (u < 0.64)] > 0.05 * row.max()).all()
    assert row[(u > 0.3)].sum() > 10 * np.abs(row[u < -0.3].sum())
    assert u[(row * (np.abs(u) > 0.1)).argmax()] == pytest.approx(0.55, abs=0.08)


@pytest.mark.slow
def test_the_corrected_integrator_agrees_with_the_path_tracer():
    # A rougher lobe, so that 16 × 16 pixels resolve it.
    base = {"type": "diffuse", "reflectance": {"type": "uniform", "value": 0.4}}
    bsdf = dict(GRATING, conserve_energy=False, base=base)
    for light in (SUN, {"type": "point", "position": [0.5, 0.3, 1.5], "intensity": {"type": "uniform", "value": 2.0}}):
        for grating in (bsdf, {"type": "diffuse"}):
            expected = picture(DIRECT, 4096, bsdf=grating, light=light)
            image = picture(shader(as_published=False, terms=16), 64, bsdf=grating, light=light)
            np.testing.assert_allclose(image.sum((0, 1)), expected.sum((0, 1)), rtol=0.03)
            assert np.abs(image - expected).sum() < 0.06 * expected.sum()


@pytest.mark.slow
def test_each_quirk_of_the_scene_is_a_parameter():
    # With a coherence length of 65 µm orders would not overlap, and have no sum to differ by.
    published = picture(shader(terms=16, fixed_coherence=False), 4)
    for name in ("complex_window_sum", "cie_rgb_matrix", "relative"):
        changed = picture(shader(terms=16, fixed_coherence=False, **{name: False}), 4)
        assert np.abs(changed - published).max() > 0.003 * published.max(), name


@pytest.mark.slow
@pytest.mark.parametrize(("variant", "unit_of_brightness"), [("flss", 1.0), ("pq", 0.5), ("gem", 1 / 4000)])
def test_brightness_is_a_factor_of_the_diffraction_before_the_blend(variant, unit_of_brightness):
    """In the published program 1000 is the default, which 0 selects."""
    base = {"type": "diffuse", "reflectance": {"type": "uniform", "value": 0.5}}
    ray = mi.RayDifferential3f(mi.Ray3f(mi.Point3f(0.01, 0, 1), mi.Vector3f(0, 0, -1), 0.0, [500, 550, 600, 650]))

    def straight_down(bsdf, **parameters):
        built = scene(shader(variant, **parameters), bsdf)
        rgb, below, _ = built.integrator().scene_shader.shade(built, ray)
        return array(rgb).ravel(), array(below).ravel(), built.integrator().scene_shader.shaded[0].weights[0].luminance

    found, _, light = straight_down(GRATING)
    alone = colour(BLAZE, unit(0.0), unit([0.0]), variant=variant)[0] * light
    np.testing.assert_allclose(found, 1000 * unit_of_brightness * alone, rtol=1e-3)
    blended, below, _ = straight_down(dict(GRATING, base=base), brightness=200.0, diffuse_weight=0.25)
    np.testing.assert_allclose(blended, 0.75 * 200 * unit_of_brightness * alone, rtol=1e-3)
    np.testing.assert_allclose(straight_down(dict(GRATING, base=base), diffuse_weight=0.25)[1], below, rtol=1e-5)
    np.testing.assert_allclose(straight_down(GRATING, brightness=0.0)[0], found, rtol=1e-5)
    if variant != "gem":  # radiance in the scene's units has no free scale
        pair = [straight_down(GRATING, as_published=False, brightness=b)[0] for b in (1.0, 1000.0)]
        np.testing.assert_array_equal(*pair)


@pytest.mark.slow
def test_the_base_receives_the_transmitted_light():
    bsdf = dict(GRATING, depth=0.0, base={"type": "diffuse", "reflectance": {"type": "uniform", "value": 1.0}})
    side = (slice(None), slice(0, 4))  # far from the mirror direction
    expected = picture(DIRECT, 256, bsdf=bsdf)[side].mean()
    right = picture(shader(as_published=False, terms=2), 256, bsdf=bsdf)[side].mean()
    assert right == pytest.approx(expected, rel=0.02)
    wrong = picture(shader(as_published=False, constant_blend=True, diffuse_weight=0.5, terms=2), 256, bsdf=bsdf)
    plain = picture(DIRECT, 256, bsdf={"type": "diffuse", "reflectance": {"type": "uniform", "value": 1.0}})
    assert wrong[side].mean() == pytest.approx(0.5 * plain[side].mean(), rel=0.02)


def test_shadows_are_cast_only_on_request():
    cover = {"type": "rectangle", "bsdf": {"type": "conductor"},
             "to_world": mi.ScalarTransform4f().translate([0, 0, 5]).rotate([1, 0, 0], 180).scale(4)}  # fmt: skip
    bsdf = {"type": "diffuse"}
    lit = picture(shader(), bsdf=bsdf, cover=cover)
    dark = picture(shader(shadows=True), bsdf=bsdf, cover=cover)
    np.testing.assert_allclose(lit.mean(), picture(shader(), bsdf=bsdf).mean(), rtol=0.03)
    assert not dark.any()


def test_twosided_shades_both_sides():
    both = {"type": "twosided", "inner": GRATING}
    settings = shader(as_published=False, terms=16)
    front = picture(settings, bsdf=both)
    np.testing.assert_allclose(front, picture(settings), atol=1e-3 * front.max())
    turned = mi.ScalarTransform4f().rotate([0, 1, 0], 180)
    plate = {"type": "rectangle", "bsdf": both, "to_world": turned}
    back = picture(settings, plate=plate)
    assert back.sum() == pytest.approx(front.sum(), rel=0.05)
    assert not picture(settings, plate=dict(plate, bsdf=GRATING)).any()


BUMPS = np.random.default_rng(7).random((8, 8, 1)).astype(np.float32)


def luminance(built):
    """Y of the gratings of a scene, (16, 16), without the noise of sampled wavelengths."""
    jitter = np.random.default_rng(1).random((2, 256 * 64))
    y, x = (np.mgrid[: 16 * 8, : 16 * 8].reshape(2, -1) + jitter) / (16 * 8)
    ray, _ = built.sensors()[0].sample_ray(0, 0.5, mi.Point2f(x.astype(np.float32), y.astype(np.float32)), 0.5)
    rgb, _, _ = built.integrator().scene_shader.shade(built, mi.RayDifferential3f(ray))
    return xyz(np.array(rgb).T)[:, 1].reshape(16, 8, 16, 8).mean((1, 3))


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["normalmap", "bumpmap", "mask", "blendbsdf", "twosided"])
def test_gratings_are_shaded_inside_other_bsdfs(kind):
    """A wrapper that changes nothing, exactly; and one that does, against this model in the same light."""
    from mitsuba_diffraction.shader_2014.comparison.pictures import same_light

    def constant(value):
        return {"type": "bitmap", "raw": True, "bitmap": mi.Bitmap(np.full((2, 2, 3), value, np.float32))}

    inner = dict(GRATING, conserve_energy=False)
    nothing = {
        "normalmap": {"normalmap": constant([0.5, 0.5, 1.0])},
        "bumpmap": {"scale": 0.0, "map": {"type": "bitmap", "raw": True, "bitmap": mi.Bitmap(BUMPS)}},
        "mask": {"opacity": 1.0},
        "blendbsdf": {"weight": 1.0, "other": {"type": "diffuse"}},
        "twosided": {},
    }[kind]
    something = {
        "normalmap": {"normalmap": constant([0.55, 0.47, 0.98])},
        "bumpmap": dict(nothing, scale=0.02),
        "mask": {"opacity": 0.3},
        "blendbsdf": dict(nothing, weight=0.4),
        "twosided": {},
    }[kind]
    settings = shader(as_published=False, shadows=True)
    plain = picture(settings, bsdf=inner)
    np.testing.assert_allclose(
        picture(settings, bsdf={"type": kind, **nothing, "zz": inner}), plain, rtol=1e-3, atol=1e-4 * plain.max()
    )
    built = scene(settings, bsdf={"type": kind, **something, "zz": inner})
    expected = np.array(mi.render(built, integrator=same_light(built), spp=1024, seed=2))[..., 1].sum()
    found = luminance(built) if kind != "blendbsdf" else np.array(mi.render(built, spp=64, seed=2))[..., 1]
    assert found.sum() == pytest.approx(expected, rel=0.03)
    if kind != "twosided":
        assert np.abs(found - plain[..., 1]).sum() > 0.2 * plain[..., 1].sum()


@pytest.mark.slow
def test_through_a_mask_one_sees_what_is_behind():
    behind = {"type": "rectangle", "bsdf": {"type": "diffuse"},
              "to_world": mi.ScalarTransform4f().translate([0, 0, -0.5]).scale(3)}  # fmt: skip
    settings = shader(as_published=False)
    grating = picture(settings)
    masked = picture(settings, bsdf={"type": "mask", "opacity": 0.3, "inner": GRATING}, behind=behind)
    alone = picture(settings, bsdf={"type": "mask", "opacity": 0.0, "inner": GRATING}, behind=behind)
    assert alone.min() > 0
    np.testing.assert_allclose(masked, 0.3 * grating + 0.7 * alone, rtol=0.02, atol=0.02 * alone.max())


def test_a_recipe_gives_the_heights(tmp_path):
    recipe = tmp_path / "blaze.toml"
    recipe.write_text(
        '[surface]\nprofile = "blazed"\nperiod = 2.5\ndepth = 0.25\nsamples = 64\n[spectrum]\ncoherence_length = 5.0\n'
    )
    image = picture(shader(terms=8), bsdf={"type": "diffraction_grating", "filename": str(recipe)})
    np.testing.assert_allclose(image, picture(shader(terms=8)), rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize(
    ("parameters", "of", "message"),
    [
        ({"variant": "flsss"}, {}, "variant: got 'flsss', wanted one of flss, nmm, pq, nmm_pq, gem"),
        ({"varriant": "flss"}, {}, "varriant"),
        ({"variant": "gem", "terms": 3}, {}, "terms"),
        ({"diffuse_weight": 2.0}, {}, "diffuse_weight: got 2.0, wanted 0 to 1"),
        ({"as_published": "false"}, {}, "as_published: got 'false', wanted true or false"),
        ({"shadows": "false"}, {}, "shadows: got 'false', wanted true or false"),
        ({"relative": "false"}, {}, "relative: got 'false', wanted True or False"),
        ({"brightness": -1.0}, {}, "brightness: got -1.0, wanted a finite number that is not negative"),
        ({"brightness": float("nan")}, {}, "brightness: got nan, wanted a finite number"),
        ({"brightness": "auto"}, {}, "brightness: got 'auto', wanted a finite number"),
        ({}, {"light": {"type": "constant"}}, "no directional or point light"),
        ({}, {"bsdf": dict(GRATING, lateral_scale=2.0, coherence_length=20.0)}, "got a grating with a lateral_scale"),
        ({"window": "8sigma"}, {}, "window: got '8sigma', wanted one of texel, 4sigma"),
        ({"variant": "pq", "window": "texel"}, {}, "window"),
    ],
)
def test_unsupported_scenes_are_refused_in_one_line(parameters, of, message):
    with pytest.raises(Exception) as caught:  # noqa: PT011 (Mitsuba's own types, by where it happens)
        picture({"type": "diffraction_shader", **parameters}, **of)
    line = root_cause(caught.value)
    assert message in line
    assert "\n" not in line


def test_a_saved_spectrum_holds_no_heights(tmp_path):
    path = tmp_path / "blaze.exr"
    md.precompute(BLAZE).save(path)
    with pytest.raises(Exception) as caught:  # noqa: PT011
        picture(shader(), bsdf={"type": "diffraction_grating", "filename": str(path)})
    assert "needs heights, which a saved spectrum does not contain" in root_cause(caught.value)


def test_the_polarised_variant_shows_the_same():
    settings = dict(height_field=BLAZE, quirks=CORRECTED, terms=4)
    wi, wo = ([float(x) for x in unit(s)] for s in (0.2, -0.42))
    values = []
    for name in ("llvm_ad_spectral", "llvm_ad_spectral_polarized"):
        mi.set_variant(name)
        for kind in ("flss", "nmm", "pq"):
            built = VARIANTS[kind](**settings)
            values.append(np.array(built.rgb(mi.Vector3f(*wi), mi.Vector3f(*wo), built.weights())).ravel())
    values = np.array(values).reshape(2, 3, 3)
    assert values[0].any()
    np.testing.assert_allclose(values[1], values[0], rtol=1e-5)
    image = picture(shader(terms=4))
    assert np.isfinite(image).all()
    assert image.any()


def test_variants_without_wavelengths_are_refused():
    mi.set_variant("llvm_ad_rgb")
    with pytest.raises(Exception, match="needs the wavelength of light"):
        mi.load_dict({"type": "diffraction_shader"})
    with pytest.raises(ValueError, match="wanted a spectral one"):
        colour(BLAZE, unit(0.1), unit(0.1))


def test_a_picture_follows_its_light_and_the_handler_of_ctrl_c_is_kept():
    light = {"type": "directional", "direction": [0, 0, -1], "irradiance": {"type": "uniform", "value": 1.0}}
    built = scene({"type": "diffraction_shader"}, light=light)
    handler = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        before = np.array(mi.render(built, spp=1, seed=1))
        parameters = mi.traverse(built)
        names = list(parameters.keys())
        (name,) = (name for name in names if name.endswith("irradiance.value"))
        parameters[name] = 2 * parameters[name]
        parameters.update()
        after = np.array(mi.render(built, spp=1, seed=1))
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    finally:
        signal.signal(signal.SIGINT, handler)
    assert before.max() > 0
    assert after.sum() > 1.1 * before.sum()
