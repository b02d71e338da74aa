"""Profiles by formula against the analytic orders; synthetic skins against the statistics they promise."""

import inspect

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from scipy.special import jv

import mitsuba_diffraction as md
from mitsuba_diffraction.errors import RequestError
from mitsuba_diffraction.surface.gratings import (
    PROFILES,
    blazed,
    crossed,
    elaphe_synthetic,
    lamellar,
    sinusoidal,
    xenopeltis_synthetic,
)

PERIOD = 2.5
BY_ANGLE = {"ruled", "transmission_300", "transmission_600"}  # without a period or a depth
"""µm"""
ORDERS = np.arange(-int(PERIOD * 2 / 0.36), int(PERIOD * 2 / 0.36) + 1)
"""Every order that propagates at 360 nm, whatever the directions."""
SKINS = {
    "elaphe_synthetic": (elaphe_synthetic, 1, 1.144, 0.375),
    "xenopeltis_synthetic": (xenopeltis_synthetic, 0, 1.552, 0.443),
}
"""Name → function, diffracting axis (0 = x, 1 = y), period µm, depth µm."""


def efficiencies(heights, kappa):
    """η_m = |F_m|² of e^{iκh} on the tile, indexed [m_y, m_x] as fft2 has them."""
    return np.abs(np.fft.fft2(np.exp(1j * kappa * heights)) / heights.size) ** 2


@pytest.fixture(scope="module", params=sorted(SKINS))
def skin(request):
    make, axis, period, depth = SKINS[request.param]
    # Twenty periods, so that the mean period is exactly the requested one.
    return make(20 * period), axis, period, depth


# ---------------------------------------------------------------- classical profiles


@given(kappa=st.floats(0.0, 35.0), depth=st.floats(0.0, 1.0))
def test_sinusoid_has_bessel_orders(kappa, depth):
    measured = efficiencies(sinusoidal(PERIOD, depth).heights, kappa)[0, ORDERS]
    np.testing.assert_allclose(measured, jv(ORDERS, kappa * depth / 2) ** 2, atol=1e-12)


@given(kappa=st.floats(0.0, 35.0), depth=st.floats(0.0, 0.5))
def test_blaze_has_sinc_orders(kappa, depth):
    measured = efficiencies(blazed(PERIOD, depth).heights, kappa)[0, ORDERS]
    np.testing.assert_allclose(measured, np.sinc(ORDERS - kappa * depth / (2 * np.pi)) ** 2, atol=1e-4)


def test_blaze_rises_along_x_and_diffracts_into_positive_orders():
    field = blazed(PERIOD, 0.25)
    slope = np.diff(field.heights[0]) / field.pixel_size[0]
    np.testing.assert_allclose(slope, 0.25 / PERIOD)
    # κ · depth = 2π: all the power in q = +1/period, so the light goes to ω_o = −λq: towards −x.
    eta = efficiencies(field.heights, 2 * np.pi / 0.25)[0]
    assert eta[1] > 0.9999
    assert eta[-1] < 1e-4


def test_lamellar_of_half_duty_and_phase_pi_has_odd_orders_only():
    measured = efficiencies(lamellar(PERIOD, 0.1).heights, np.pi / 0.1)[0, ORDERS]
    odd = ORDERS % 2 == 1
    np.testing.assert_allclose(measured[odd], (2 / (np.pi * ORDERS[odd])) ** 2, atol=1e-4)
    np.testing.assert_allclose(measured[~odd], 0, atol=1e-25)


@given(duty=st.floats(0.01, 0.99), kappa=st.floats(0.0, 35.0))
def test_the_zeroth_order_of_lamellar_gratings_of_any_duty(duty, kappa):
    field = lamellar(PERIOD, 0.2, duty=duty)
    high = np.mean(field.heights > 0)
    assert high == pytest.approx(duty, abs=0.5 / 512 + 1e-9)
    expected = abs(1 - high + high * np.exp(1j * kappa * 0.2)) ** 2
    assert efficiencies(field.heights, kappa)[0, 0] == pytest.approx(expected, abs=1e-12)


def test_crossed_orders_are_products_of_the_orders_of_its_waves():
    field = crossed(PERIOD, 0.3, period_y=1.7)
    single = jv(ORDERS, 20.0 * 0.3 / 2) ** 2
    measured = efficiencies(field.heights, 20.0)[np.ix_(ORDERS, ORDERS)]
    np.testing.assert_allclose(measured, single[:, None] * single, atol=1e-12)
    assert field.tile_size == pytest.approx((PERIOD, 1.7))
    assert field.height_range == pytest.approx(0.6, rel=1e-3)
    assert crossed(PERIOD, 0.3).tile_size == pytest.approx((PERIOD, PERIOD))


@pytest.mark.parametrize("make", [blazed, sinusoidal, lamellar])
def test_a_line_grating_is_one_row_of_one_period(make):
    field = make(PERIOD, 0.25, samples=200)
    assert field.shape == (1, 200)
    assert field.tile_size == pytest.approx((PERIOD, PERIOD))
    assert field.height_range == pytest.approx(0.25, rel=6e-3)
    assert "2.5 µm" in field.source
    assert "0.25 µm" in field.source
    assert make(PERIOD, 0.0).height_range == 0


# ---------------------------------------------------------------- synthetic skins


def test_a_skin_has_the_requested_size_and_depth(skin):
    field, _, period, depth = skin
    assert field.tile_size == pytest.approx((20 * period, 20 * period))
    assert field.shape == (round(20 * period / 0.0625),) * 2
    assert field.height_range == pytest.approx(depth)
    assert "synthetic" in field.source


@pytest.mark.parametrize("name", sorted(SKINS))
def test_a_skin_may_be_oblong_with_other_pixels_and_flat(name):
    make, axis, period, _ = SKINS[name]
    field = make((9.0, 7.0), pixel_size=0.1, depth=0.0, period=period)
    assert field.shape == (70, 90)
    # Along the diffracting axis, the whole number of periods that is nearest.
    wanted = [9.0, 7.0]
    wanted[axis] = round(wanted[axis] / period) * period
    assert field.tile_size == pytest.approx(wanted)
    assert field.height_range == 0


def test_a_skin_has_no_seams(skin):
    heights = skin[0].heights
    for axis in (0, 1):
        inside = np.sqrt(np.mean(np.diff(heights, axis=axis) ** 2, axis=1 - axis))
        edge = np.sqrt(np.mean((np.take(heights, 0, axis) - np.take(heights, -1, axis)) ** 2))
        # The step across the edge is one of the steps inside: rows of tips make some columns rougher than others.
        assert inside.min() * 0.9 < edge < inside.max() * 1.1


@pytest.mark.parametrize("name", sorted(SKINS))
def test_a_seed_determines_a_skin(name):
    make = SKINS[name][0]
    first, again, other = (make(10.0, seed=seed).heights for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert abs(np.corrcoef(first.ravel(), other.ravel())[0, 1]) < 0.5


@pytest.mark.few(1)
@pytest.mark.parametrize("name", sorted(SKINS))
@pytest.mark.parametrize("seed", [0, 7])
def test_a_skin_has_the_requested_mean_period(name, seed):
    make, axis, period, _ = SKINS[name]
    field = make(40 * period, pixel_size=0.1, seed=seed)
    heights = field.heights if axis == 0 else field.heights.T
    # The centroid of the lobe about 1 / period; across it, only frequencies near the diffracting axis.
    q = np.fft.fftfreq(heights.shape[1], 40 * period / heights.shape[1])
    power = np.abs(np.fft.fft2(heights)) ** 2
    lobe = np.abs(q * period - 1) < 0.3
    near = np.abs(q) < 0.15
    weight = power[np.ix_(near, lobe)].sum(axis=0)
    assert period * np.average(q[lobe], weights=weight) == pytest.approx(1, abs=0.01)


def test_a_skin_is_irregular(skin):
    field = skin[0]
    eta = np.abs(np.fft.fft2(field.centred)) ** 2
    eta[0, 0] = 0
    # A perfect lattice would have nearly all of its power in a few orders.
    strongest = np.sort(eta.ravel())[::-1]
    assert strongest[:20].sum() < 0.75 * eta.sum()


@pytest.mark.few(3)
@pytest.mark.parametrize("name", sorted(SKINS))
@pytest.mark.parametrize("size", [8.0, 10.0, 32.0])
def test_the_period_is_kept_whatever_the_size(name, size):
    make, axis, period, _ = SKINS[name]
    field = make(size)
    assert field.tile_size[axis] / period == pytest.approx(round(size / period), rel=1e-12)
    assert f"{round(size / period)} {('rows', 'fingers')[axis]} of {period:.4g} µm" in field.source
    assert field.shape == (round(size / 0.0625),) * 2


def standardised(heights, pixel_size):
    """Skewness, kurtosis and the r.m.s. slopes along x and y divided by the r.m.s. height, 1/µm."""
    z = (heights - heights.mean()) / heights.std()
    slopes = np.gradient(z, pixel_size)
    return np.mean(z**3), np.mean(z**4), slopes[1].std(), slopes[0].std()


@pytest.mark.parametrize(("name", "period"), [("elaphe_synthetic", 1.0), ("xenopeltis_synthetic", 1.40)])
def test_a_skin_resembles_the_scan(name, period, scan_file):
    make, _, _, depth = SKINS[name]
    measured = np.asarray(Image.open(scan_file(name.removesuffix("_synthetic"))).convert("L")) / 255 * depth
    synthetic = make(300 * 0.0586, pixel_size=0.0586, period=period).heights
    assert synthetic.std() == pytest.approx(measured.std(), rel=0.3)
    skewness, kurtosis, slope_x, slope_y = standardised(synthetic, 0.0586)
    expected = standardised(measured, 0.0586)
    assert skewness == pytest.approx(expected[0], abs=0.4)
    assert kurtosis == pytest.approx(expected[1], abs=0.8)
    assert slope_x == pytest.approx(expected[2], rel=0.25)
    assert slope_y == pytest.approx(expected[3], rel=0.25)


# ---------------------------------------------------------------- misuse


@pytest.mark.parametrize("name", sorted(set(PROFILES) - BY_ANGLE))
@pytest.mark.parametrize("period", [0, -1.0, np.nan, np.inf, "2"])
def test_a_period_must_be_positive(name, period):
    with pytest.raises(ValueError, match=r"period: got .* wanted a positive number"):
        PROFILES[name](period=period, depth=0.1)


@pytest.mark.parametrize("name", ["sinusoidal", "foil", "compact_disc", "elaphe_synthetic"])
def test_a_period_that_looks_like_nm_is_refused_with_a_question(name):
    given = {"depth": 0.1} if name == "sinusoidal" else {}
    with pytest.raises(ValueError, match=r"period: got 2000 µm, wanted at most 100; is it in nm \(2 µm\)\?"):
        PROFILES[name](period=2000, **given)
    with pytest.raises(ValueError, match="period_y: got 1500"):
        PROFILES["crossed"](period=2.0, depth=0.1, period_y=1500)


@pytest.mark.parametrize("name", sorted(set(PROFILES) - BY_ANGLE))
def test_a_depth_that_looks_like_nm_is_refused_with_a_question(name):
    with pytest.raises(RequestError, match=r"depth: got 250 µm, wanted at most 100; is it in nm \(0.25 µm\)\?"):
        PROFILES[name](period=2.0, depth=250)


@pytest.mark.parametrize("value", [1e-300, 1e-12, 1e5, 1e300])
def test_no_number_is_too_large_or_small_for_a_refusal_or_for_finite_efficiencies(value):
    required = {"period": 1.0, "depth": 0.1}
    for profile in ("blazed", "sinusoidal", "lamellar", "ruled"):
        parameters = inspect.signature(PROFILES[profile]).parameters.values()
        base = {one.name: required[one.name] for one in parameters if one.default is one.empty}
        for one in parameters:
            try:
                field = PROFILES[profile](**{**base, one.name: value})
            except RequestError:
                continue
            assert np.isfinite(md.efficiencies(field, [20.0], [500.0]).values).all()


@pytest.mark.parametrize("name", sorted(set(PROFILES) - BY_ANGLE))
@pytest.mark.parametrize("depth", [-0.1, np.nan, None])
def test_a_depth_must_not_be_negative(name, depth):
    with pytest.raises(ValueError, match=r"depth: got .* zero or more"):
        PROFILES[name](period=2.0, depth=depth)


@pytest.mark.parametrize("make", [blazed, sinusoidal, lamellar, crossed])
@pytest.mark.parametrize("samples", [1, 0, -3, 64.0])
def test_samples_are_a_whole_number_of_two_or_more(make, samples):
    with pytest.raises(ValueError, match=r"samples: got .* at least 2"):
        make(PERIOD, 0.1, samples=samples)


@pytest.mark.parametrize("duty", [0, 1, -0.2, 1.5, np.nan, "half", 1e-4, 0.9999])
def test_a_duty_without_ridge_or_groove_is_refused(duty):
    with pytest.raises(ValueError, match=r"duty: got .*, wanted"):
        lamellar(PERIOD, 0.1, duty=duty)


@pytest.mark.parametrize("period_y", [0.0, -2.0, np.inf])
def test_the_other_period_must_be_positive(period_y):
    with pytest.raises(ValueError, match="period_y: got"):
        crossed(PERIOD, 0.1, period_y=period_y)


@pytest.mark.parametrize("make", [elaphe_synthetic, xenopeltis_synthetic])
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"size": 1.0}, "size: got 1.0 µm, wanted at least "),
        ({"size": (32.0, 1.0)}, "size: got"),
        ({"size": -3.0}, "size: got -3.0, wanted a positive number"),
        ({"size": (1, 2, 3)}, "size: got"),
        ({"pixel_size": 0.0}, "pixel_size: got 0.0"),
        ({"pixel_size": 0.5}, "pixel_size: got 0.5 µm, wanted at most"),
        ({"seed": -1}, "seed: got -1"),
        ({"seed": 0.5}, "seed: got 0.5"),
    ],
)
def test_wrong_arguments_of_a_skin_are_refused(make, arguments, message):
    with pytest.raises(ValueError, match=message):
        make(**arguments)


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 2**63), size=st.floats(8.0, 12.0))
def test_every_seed_and_size_gives_finite_heights(seed, size):
    for make, axis, period, depth in SKINS.values():
        field = make(size, pixel_size=0.125, seed=seed)
        assert field.height_range == pytest.approx(depth)
        assert field.tile_size[1 - axis] == pytest.approx(size)
        assert field.tile_size[axis] == pytest.approx(size, abs=period / 2)
