"""Extreme surfaces and directions: tables and BSDF are right to the tolerance, compared with `md.reference`."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from bsdf_support import floats
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.special import jv
from test_bsdf import evaluate, k_g, random_directions, raw_plugin, towards

import mitsuba_diffraction as md
from mitsuba_diffraction.bsdf.indices import Dispersion
from mitsuba_diffraction.optics.geometry import horizon_gain
from mitsuba_diffraction.optics.refractive_indices import index_of
from mitsuba_diffraction.settings import lobe_width
from mitsuba_diffraction.spectrum.grids import OrderGrid

LARGEST_KAPPA = 4 * np.pi / 0.36
REACHED = 2 / 0.36


def noise(shape, depth):
    return np.random.default_rng(11).random(shape) * depth


def spike(shape, height):
    heights = np.full(shape, 0.7)
    heights[shape[0] // 2, shape[1] // 3] += height
    return heights


def field_of(heights, pixel=0.085):
    return md.HeightField(heights, pixel)


# Name: surface, extent, coherence length in µm.
SHALLOW = {
    "flat tile": (field_of(np.zeros((4, 6))), "tile", 65.0),
    "flat sample": (field_of(np.full((12, 14), 5.0)), "sample", 0.5),
    "spike on a tile": (field_of(spike((5, 8), 0.3)), "tile", 65.0),
    "spike on a sample": (field_of(spike((14, 12), 0.3)), "sample", 0.5),
    "odd tile": (field_of(noise((5, 7), 0.2)), "tile", 65.0),
    "even tile": (field_of(noise((4, 6), 0.2)), "tile", 65.0),
    "odd sample": (field_of(noise((13, 15), 0.2)), "sample", 0.5),
    "even sample": (field_of(noise((12, 20), 0.2)), "sample", 0.5),
    "row tile": (field_of(noise((1, 31), 0.3)), "tile", 65.0),
    "column tile": (field_of(noise((30, 1), 0.3)), "tile", 65.0),
    "row sample": (field_of(noise((1, 31), 0.3), (0.085, 3.0)), "sample", 1.2),
    "column sample": (field_of(noise((30, 1), 0.3), (0.01, 0.085)), "sample", 1.2),
    "rectangular pixels of a tile": (field_of(noise((7, 6), 0.2), (0.08, 0.05)), "tile", 65.0),
    "rectangular pixels of a sample": (field_of(noise((20, 14), 0.2), (0.08, 0.05)), "sample", 0.45),
    "coherent over less than a period": (field_of(noise((1, 31), 0.2)), "tile", 0.6),
    "coherent over one wavelength": (field_of(noise((5, 5), 0.2)), "tile", 0.38),
    "coherent over far more than the tile": (field_of(noise((5, 7), 0.2)), "tile", 1000.0),
    "one order": (field_of(noise((3, 2), 0.2), (0.04, 0.05)), "tile", 65.0),
    "one pixel": (field_of([[3.0]]), "tile", 65.0),
    "one pixel, a sample": (field_of([[3.0]]), "sample", 2.0),
}
FIVE_MICROMETRES = {
    "deep noise": (field_of(noise((4, 5), 5.0)), "tile", 65.0),
    "deep row": (md.gratings.sinusoidal(1.5, 5.0, samples=64), "tile", 65.0),
    "deep spike": (field_of(spike((5, 6), 5.0)), "tile", 65.0),
    "deep spike, a sample": (field_of(spike((10, 9), 5.0)), "sample", 0.38),
    "deep noise, a sample": (field_of(noise((9, 10), 5.0)), "sample", 0.38),
}


def axis_of(count, pixel, extent, sigma, reach=REACHED):
    """Return frequencies along one axis and their quadrature weights."""
    if extent == "sample":
        end = 7 * sigma if count == 1 else 1 / (2 * pixel) + 2 * sigma
        step = sigma / 2
        return (np.arange(-np.ceil(end / step), np.ceil(end / step) + 1) + 0.37) * step, step
    orders = np.arange(-(count // 2), count // 2 + 1) / (count * pixel)
    orders = orders[np.abs(orders) <= reach + 5 * sigma]
    if count == 1 or 1 / (count * pixel) > 10 * sigma:
        offsets = np.arange(-4.37, 5) * sigma  # lobes that stand apart
        return (orders[:, None] + offsets).ravel(), sigma
    step = sigma / 2
    return np.arange(orders[0] - 5 * sigma, orders[-1] + 5 * sigma, step), step


def error(spectrum, field, extent, coherence_length, kappa):
    """Return ∫|S_approx − S_exact| dq over |q| ≤ 2/λ_min, and ∫ S_exact dq, by the rectangle rule."""
    sigma = lobe_width(coherence_length)
    (q_x, d_x), (q_y, d_y) = (
        axis_of(n, d, extent, sigma) for n, d in zip(field.shape[::-1], field.pixel_size, strict=True)
    )
    q = np.stack(np.meshgrid(q_x, q_y), axis=-1).reshape(-1, 2)
    q = q[np.hypot(*q.T) <= REACHED]
    exact = md.reference.power_spectrum(field, q, kappa, extent=extent, coherence_length=coherence_length)
    return np.abs(spectrum.evaluate(q, kappa) - exact).sum() * d_x * d_y, exact.sum() * d_x * d_y


def case(name):
    return {**SHALLOW, **FIVE_MICROMETRES}[name]


@pytest.mark.few(7)
@pytest.mark.parametrize("name", [*SHALLOW, *FIVE_MICROMETRES])
def test_hard_surfaces_are_right_to_the_tolerance(name):
    field, extent, coherence_length = case(name)
    spectrum = md.precompute(field, extent=extent, coherence_length=coherence_length, tolerance=1e-3)
    assert spectrum.error <= 1e-3
    for kappa in (19.3, LARGEST_KAPPA):
        difference, power = error(spectrum, field, extent, coherence_length, kappa)
        assert difference <= 1.05e-3  # the rule of rectangles has an error, too
        assert power > 5e-3  # there is something to compare


@pytest.mark.few(18)
@pytest.mark.parametrize("name", SHALLOW)
def test_at_q_zero_and_small_kappa_every_surface_is_a_mirror(name):
    field, extent, coherence_length = SHALLOW[name]
    spectrum = md.precompute(field, extent=extent, coherence_length=coherence_length, tolerance=1e-3)
    exact = md.reference.power_spectrum(field, [0.0, 0.0], 0.0, extent=extent, coherence_length=coherence_length)
    for kappa in (0.0, 1e-30, 1e-6, 1e-3):
        assert spectrum.evaluate([0.0, 0.0], kappa) == pytest.approx(exact, rel=5e-3)
    if extent == "tile" and coherence_length > 10:
        assert exact == pytest.approx(1 / (2 * np.pi * lobe_width(coherence_length) ** 2), rel=1e-9)


@pytest.mark.slow
@settings(max_examples=25)
@given(
    depth=st.sampled_from([0.0, 1e-9, 0.05, 0.3, 2.0, 5.0]),
    shape=st.sampled_from([(1, 13), (11, 1), (9, 9), (9, 13)]),
    extent=st.sampled_from(["tile", "sample"]),
    share=st.floats(0, 1),
    seed=st.integers(0, 2**32 - 1),
)
@example(depth=5.0, shape=(9, 9), extent="sample", share=1.0, seed=0)
# Regression: the splines of nodes outside of the Nyquist limit were missing.
@example(depth=0.3, shape=(1, 13), extent="sample", share=0.9, seed=0)
def test_any_surface_is_right_at_any_kappa(depth, shape, extent, share, seed):
    field = field_of(np.random.default_rng(seed).random(shape) * depth)
    coherence_length = 0.38
    spectrum = md.precompute(field, extent=extent, coherence_length=coherence_length, tolerance=1e-2)
    assert spectrum.error <= 1e-2
    assert error(spectrum, field, extent, coherence_length, share * LARGEST_KAPPA)[0] <= 1.05e-2


def test_heights_far_from_zero_lose_no_digits():
    # The mean level of a scan is no part of its shape.
    near, far = (field_of(noise((6, 7), 0.3) + level) for level in (0.0, 1e4))
    one, other = md.precompute(near), md.precompute(far)
    q = np.random.default_rng(1).integers(-3, 4, (50, 2)) / np.array(near.tile_size)
    np.testing.assert_allclose(
        one.evaluate(q, 30.0), other.evaluate(q, 30.0), atol=1e-4 / (2 * np.pi * one.lobe_width**2)
    )


# ---------------------------------------------------------------- as rendered


def seen(spectrum, wi, wo, wavelengths):
    """Return K G S of the BSDF in single precision for each direction and wavelength, (n, 4) µm²."""
    value = evaluate(raw_plugin(spectrum), wi, wo, wavelengths)[0]
    return value * (np.asarray(wavelengths) * 1e-3) ** 2 / wo[:, 2, None]


def factor_of_order(wi, wo, tangent, width):
    """Return K G Γ(x_i) Γ(x_o) of an order at λq (n, 4, 2), lobe width λσ_q; zero where it does not propagate."""
    squares = [omega[:, None, 2] ** 2 for omega in (wi, wo)]
    of_order = [1 - ((omega[:, None, :2] + tangent) ** 2).sum(-1) for omega in (wi, wo)]
    x = [np.minimum(s, c) / (2 * width) for s, c in zip(of_order, squares, strict=True)]
    c_i, c_o = (np.sqrt(np.maximum(c + s, 1e-12) / 2) for c, s in zip(squares, of_order[::-1], strict=True))
    w = c_i + c_o
    d = ((tangent**2).sum(-1) + w**2) / 2
    k_g = d**2 / (c_i * c_o * w**2) * np.minimum(1, 2 * w * np.minimum(c_i, c_o) / d)
    return np.where(np.minimum(*of_order) > 0, k_g * horizon_gain(x[0]) * horizon_gain(x[1]), 0)


def expected(field, power_spectrum, wi, wo, wavelengths, sigma, line):
    """Return K G S (n, 4), from S or, for a line grating, by orders from the Fourier transform of e^{iκh}."""
    q, kappa = q_and_kappa(wi, wo, wavelengths)
    um = np.asarray(wavelengths) * 1e-3
    if not line:
        square = ((um[:, None] * q) ** 2).sum(-1)
        mirror = np.clip((25 - square / (um * sigma) ** 2) / 9, 0, 1)
        mirror *= np.clip(2 - 5 * np.maximum(wi[:, None, 2], wo[:, None, 2]), 0, 1)
        factor = (1 - mirror) * k_g(wi, wo)[:, None] + mirror * factor_of_order(wi, wo, 0 * q, um * sigma)
        return factor * power_spectrum
    along = int(field.heights.shape[1] == 1)
    h, period = field.heights.ravel(), field.tile_size[along]
    amplitudes = np.fft.fft(np.exp(1j * kappa[..., None] * (h - h.mean()))) / h.size
    total = np.zeros(kappa.shape)
    for m in range(-(h.size // 2), h.size // 2 + 1):
        order = np.zeros(2)
        order[along] = m / period
        lobe = np.exp(-((q - order) ** 2).sum(-1) / (2 * sigma**2)) / (2 * np.pi * sigma**2)
        power = np.abs(amplitudes[..., m % h.size]) ** 2 * (0.5 if 2 * abs(m) == h.size else 1)
        tangent = um[:, None] * order
        total += power * lobe * factor_of_order(wi, wo, tangent, um * sigma)
    return total


def q_and_kappa(wi, wo, wavelengths):
    """Return q (n, 4, 2) and κ (n, 4) of directions."""
    um = np.asarray(wavelengths)[:, None] * 1e-3
    both = wi[:, None] + wo[:, None]
    return -both[..., :2] / um, 2 * np.pi * both[..., 2] / um[:, 0]


def directions(field, extent, sigma, wavelengths, count=200):
    """Return pairs of directions with nonzero values; of a tile, in the lobe of an order at some wavelength."""
    rng = np.random.default_rng(6)
    count = 80 if extent == "sample" else count
    wi = random_directions(rng, count, 0.3)
    if extent == "sample":
        wo = random_directions(rng, count, 0.05)
    else:
        limit = [int(REACHED * t) for t in field.tile_size]
        orders = np.stack([rng.integers(-m, m + 1, count) for m in limit], axis=-1) / np.array(field.tile_size)
        orders[: count // 4] = 0  # the mirror direction, and about it
        q = orders + min(sigma, 1.0) * rng.normal(size=(count, 2))
        q[0] = 0
        wo = np.stack([towards(a, b, wavelengths[i % 4]) for i, (a, b) in enumerate(zip(wi, q, strict=True))])
    # At grazing incidence single precision has few digits left for cos θ, which is no matter of the spectrum.
    keep = wo[:, 2] > 0.05
    return wi[keep], wo[keep]


@pytest.mark.few(6)
@pytest.mark.parametrize("name", [*SHALLOW, "deep noise", "deep spike, a sample"])
@pytest.mark.usefixtures("llvm")
def test_hard_surfaces_are_rendered_right(name):
    field, extent, coherence_length = case(name)
    spectrum = md.precompute(field, extent=extent, coherence_length=coherence_length, tolerance=1e-3)
    sigma, wavelengths = lobe_width(coherence_length), [360.0, 500.0, 620.0, 830.0]
    wi, wo = directions(field, extent, sigma, wavelengths)
    q, kappa = q_and_kappa(wi, wo, wavelengths)
    got = seen(spectrum, wi, wo, wavelengths)
    exact = md.reference.power_spectrum(field, q, kappa, extent=extent, coherence_length=coherence_length)
    line = isinstance(spectrum.grid, OrderGrid) and 1 in field.heights.shape
    assert np.isfinite(got).all()
    assert (exact > 1e-3 * exact.max()).sum() >= 30
    # The table, to single precision in q; and the exact S, to the tolerance of a whole lobe.
    sigma = spectrum.lobe_width
    peak = 1 / (2 * np.pi * sigma**2)
    digits = 1e-4 + 2e-6 / sigma
    largest = np.maximum(expected(field, np.ones(kappa.shape), wi, wo, wavelengths, sigma, line), 1) if not line else 4
    there = 1.0
    if isinstance(spectrum.grid, OrderGrid) and all(lobe.count == 1 for lobe in spectrum.lobes):
        # Of an order that does not propagate there is no light, though part of its lobe is above the horizon.
        tangent = np.asarray(wavelengths)[:, None] * 1e-3 * np.rint(q * field.tile_size) / field.tile_size
        there = np.prod([((omega[:, None, :2] + tangent) ** 2).sum(-1) < 1 for omega in (wi, wo)], axis=0)
    if not line:
        table = there * expected(field, spectrum.evaluate(q, kappa), wi, wo, wavelengths, sigma, line)
        assert (np.abs(got - table) <= largest * digits * peak + digits * table).all()
    wanted = there * expected(field, exact, wi, wo, wavelengths, sigma, line)
    assert (np.abs(got - wanted) <= largest * (1.5e-3 + digits) * peak).all()


@pytest.mark.usefixtures("llvm")
def test_a_sample_is_rendered_right_up_to_its_nyquist_limit_and_black_outside():
    field = field_of(noise((12, 20), 0.2), 0.16)
    limit = 1 / (2 * 0.16)
    with pytest.warns(UserWarning, match="pixels of 160 nm"):
        spectrum = md.precompute(field, extent="sample", coherence_length=0.9, tolerance=1e-3)
    wavelengths = [400.0] * 4
    q_x = limit * np.array([0.9, 0.97, 0.99, 0.999, 0.9999, 1.0001, 1.001, 1.01, 1.05, 1.2])
    for axis in ([1, 0], [0, 1], [-1, 0], [0, -1]):
        q = q_x[:, None] * np.array(axis) + 0.3 * np.array(axis)[::-1]
        wi = np.stack([0.2 * q[:, 0], 0.2 * q[:, 1], 0 * q_x], axis=-1) * -1
        wi[:, 2] = np.sqrt(1 - (wi**2).sum(axis=-1))
        wo = towards(wi, q, 400)
        got = seen(spectrum, wi, wo, wavelengths)[:, 0]
        got = got / k_g(wi, wo)
        q, kappa = (a[:, 0] for a in q_and_kappa(wi, wo, wavelengths))
        exact = md.reference.power_spectrum(field, q, kappa, extent="sample", coherence_length=0.9)
        assert (exact[:5] > 0).all()
        assert (got[5:] == 0).all()
        assert (exact[5:] == 0).all()
        peak = 1 / (2 * np.pi * lobe_width(0.9) ** 2)
        np.testing.assert_allclose(got, exact, atol=1e-3 * peak)
        np.testing.assert_allclose(got, spectrum.evaluate(q, kappa), atol=1e-5 * peak)


@pytest.mark.few(1)
@pytest.mark.parametrize("extent", ["tile", "sample"])
@pytest.mark.usefixtures("llvm")
def test_extreme_wavelengths_are_right_and_others_are_black(extent):
    field = field_of(noise((12, 20), 0.2))
    coherence_length = {"tile": 2.0, "sample": 0.5}[extent]
    spectrum = md.precompute(field, extent=extent, coherence_length=coherence_length, tolerance=1e-3)
    wi = random_directions(np.random.default_rng(1), 300, 0.2)
    wo = random_directions(np.random.default_rng(2), 300, 0.2)
    wavelengths = np.array([360.0, 830.0, 359.0, 831.0])
    got = seen(spectrum, wi, wo, wavelengths)
    q, kappa = q_and_kappa(wi, wo, wavelengths)
    exact = md.reference.power_spectrum(field, q[:, :2], kappa[:, :2], extent=extent, coherence_length=coherence_length)
    sigma = spectrum.lobe_width
    peak = 1 / (2 * np.pi * sigma**2)
    wanted, largest = (expected(field, s, wi, wo, wavelengths[:2], sigma, False) for s in (exact, np.ones(exact.shape)))
    assert (np.abs(got[:, :2] - wanted) <= np.maximum(largest, 1) * 1.5e-3 * peak).all()
    assert exact.max() > 0.01 * peak
    assert (got[:, 2:] == 0).all()


@pytest.mark.slow
@pytest.mark.usefixtures("llvm")
def test_five_micrometres_are_rendered_with_bessel_orders():
    spectrum = md.precompute(md.gratings.sinusoidal(2.5, 5.0))
    wavelengths = [450.0] * 4
    for theta in (0.0, 0.6):
        orders = np.arange(-9, 10)
        wi = np.broadcast_to([np.sin(theta), 0, np.cos(theta)], (len(orders), 3))
        wo = towards(wi, np.stack([orders / 2.5, 0 * orders], axis=-1), 450)
        keep = wo[:, 2] > 0.05
        wi, wo, orders = wi[keep], wo[keep], orders[keep]
        kappa = q_and_kappa(wi, wo, wavelengths)[1][:, 0]
        got = seen(spectrum, wi, wo, wavelengths)[:, 0] / k_g(wi, wo) * 2 * np.pi * spectrum.lobe_width**2
        # κ in single precision, times 2.5 µm.
        np.testing.assert_allclose(got, jv(orders, kappa * 2.5) ** 2, atol=1e-3)
        assert got.max() > 8e-3


@pytest.mark.parametrize("media", [["BK7"], ["water", "BK7"]])
def test_indices_are_read_within_their_table_at_and_beyond_its_ends(llvm, capfd, media):
    indices = [index_of("int_ior", name) for name in media]
    table = Dispersion(indices, 1.0)
    nm = [0.0, 1e-3, float(table.first[0]), 550.0, max(1e3 * index.wavelengths[-1] for index in indices), 1e9]
    for number, index in enumerate(indices):
        with dr.scoped_set_flag(dr.JitFlag.Debug, True):
            found = table.index_at(table.position(floats(nm)), mi.UInt32(number))
            dr.eval(found)
        np.testing.assert_allclose(np.array(found), index(1e-3 * np.array(nm)), rtol=1e-5)
    assert "out-of-bounds" not in capfd.readouterr().err
