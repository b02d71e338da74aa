"""The reference against the definition of S itself and against sums written out here, without FFT."""

import contextlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import jv

from mitsuba_diffraction import HeightField, gratings
from mitsuba_diffraction.coherence import lobe_width
from mitsuba_diffraction.reference import amplitudes, order_powers, power_spectrum

shapes = st.sampled_from([(1, 1), (1, 2), (2, 1), (1, 7), (6, 1), (2, 2), (3, 3), (4, 6), (5, 4), (7, 7), (8, 3)])
kappas = st.floats(0, 4 * np.pi / 0.36)


def integer_orders(count):
    """The orders of a transform over `count` samples, −count/2 … below count/2."""
    return np.arange(count) - count // 2


def direct_powers(heights, kappa):
    """|1/N Σ e^{iκh} e^{−2πi m n/N}|² by the sum, rows m_y and columns m_x as `integer_orders`."""
    rows, columns = heights.shape
    wave_y = np.exp(-2j * np.pi * np.outer(integer_orders(rows), np.arange(rows)) / rows)
    wave_x = np.exp(-2j * np.pi * np.outer(np.arange(columns), integer_orders(columns)) / columns)
    return np.abs(wave_y @ np.exp(1j * kappa * heights) @ wave_x / heights.size) ** 2


def direct_spectrum(field, q, kappa, sigma):
    """Σ_m η_m N(q − m/T; σ²), one order after the other."""
    eta = direct_powers(field.heights, kappa)
    total = 0.0
    for row, m_y in enumerate(integer_orders(field.shape[0])):
        for column, m_x in enumerate(integer_orders(field.shape[1])):
            d_x, d_y = q[0] - m_x / field.tile_size[0], q[1] - m_y / field.tile_size[1]
            total += eta[row, column] * np.exp(-(d_x**2 + d_y**2) / (2 * sigma**2)) / (2 * np.pi * sigma**2)
    return total


def sigma_of(coherence_length):
    """1/(2√2 π σ_s), σ_s = L_c/4."""
    return 1 / (2 * np.sqrt(2) * np.pi * coherence_length / 4)


# ---------------------------------------------------------------- order powers


@given(shape=shapes, depth=st.sampled_from([0, 0.1, 1, 5]), kappa=kappas, seed=st.integers(0, 2**32 - 1))
def test_order_powers_are_the_direct_sum_and_add_up_to_one(shape, depth, kappa, seed):
    heights = np.random.default_rng(seed).random(shape) * depth
    eta = order_powers(HeightField(heights, 0.1), kappa)
    np.testing.assert_allclose(np.fft.fftshift(eta), direct_powers(heights, kappa), atol=1e-13)
    assert eta.sum() == pytest.approx(1, abs=1e-12)


@given(kappa=kappas, offset=st.floats(-100, 100))
def test_a_common_offset_of_the_heights_changes_nothing(kappa, offset):
    heights = np.random.default_rng(1).random((3, 5))
    shifted = order_powers(HeightField(heights + offset, 0.1), kappa)
    np.testing.assert_allclose(shifted, order_powers(HeightField(heights, 0.1), kappa), atol=1e-11)


@given(kappa=kappas, depth=st.floats(0, 5))
def test_one_spike_on_a_flat_surface(kappa, depth):
    # 1 − (1 − e^{iκd})/N in order zero, a share of |1 − e^{iκd}|²/N² in every other one.
    heights = np.zeros((3, 5))
    heights[1, 2] = depth
    eta = order_powers(HeightField(heights, 0.1), kappa)
    step = 1 - np.exp(1j * kappa * depth)
    wanted = np.full((3, 5), abs(step / 15) ** 2)
    wanted[0, 0] = abs(1 - step / 15) ** 2
    np.testing.assert_allclose(eta, wanted, atol=1e-13)


def test_amplitudes_carry_the_phase_of_the_sign_convention():
    # A ramp that rises along +x by one wave of the phase puts everything into order +1, e^{+2πi x/T}.
    x = np.arange(8) / 8
    field = HeightField(x[None], 0.1)
    assert np.abs(amplitudes(field, 2 * np.pi)[0, 1]) == pytest.approx(1)


# ---------------------------------------------------------------- S(q; κ)


@settings(max_examples=40)
@given(
    shape=shapes,
    pixel=st.sampled_from([(0.1, 0.1), (0.05, 0.3), (2.0, 0.07)]),
    kappa=kappas,
    coherence_length=st.sampled_from([0.2, 1.0, 5.0, 65.0]),
    seed=st.integers(0, 2**32 - 1),
)
def test_the_spectrum_is_the_sum_of_the_lobes(shape, pixel, kappa, coherence_length, seed):
    rng = np.random.default_rng(seed)
    field = HeightField(rng.random(shape), pixel)
    sigma = sigma_of(coherence_length)
    # At random places, and near orders, where narrow lobes are.
    near = (rng.integers(-2, 3, (4, 2)) / field.tile_size) + rng.normal(0, sigma, (4, 2))
    q = np.concatenate([rng.uniform(-6, 6, (3, 2)), near, [[0, 0]]])
    wanted = [direct_spectrum(field, place, kappa, sigma) for place in q]
    got = power_spectrum(field, q, kappa, coherence_length=coherence_length)
    np.testing.assert_allclose(got, wanted, rtol=1e-9, atol=1e-12 / sigma**2)


def test_one_q_and_one_kappa_give_one_number():
    field = HeightField([[0.0, 0.1, 0.3]], 0.2)
    got = power_spectrum(field, [0.1, 0.0], 10.0)
    assert np.shape(got) == ()
    assert got == pytest.approx(direct_spectrum(field, [0.1, 0.0], 10.0, sigma_of(65)), rel=1e-9)


def test_q_and_kappa_broadcast():
    field = HeightField([[0.0, 0.1, 0.3]], 0.2)
    q, kappa = np.zeros((4, 1, 2)) + np.linspace(0, 5, 4)[:, None, None], np.array([5.0, 20.0, 5.0])
    got = power_spectrum(field, q, kappa, coherence_length=1.0)
    assert got.shape == (4, 3)
    np.testing.assert_allclose(got[2, 1], power_spectrum(field, q[2], kappa[1:2], coherence_length=1.0)[0])


def windowed_powers(heights, kappa, period, coherence_length, q):
    """|∫ a(x−x₀) e^{iκh} e^{−2πiqx} dx|² / ∫a² for x₀ at even steps over one period: (x₀, q).

    The integrands are smooth and vanish at the ends: the trapezoidal rule is exact to rounding.
    """
    sigma_s = coherence_length / 4
    x = np.arange(-9 * sigma_s, 9 * sigma_s, 0.01)
    window = np.exp(-(x**2) / (2 * sigma_s**2))
    places = np.arange(64) / 64 * period
    phase = np.exp(1j * kappa * heights(x + places[:, None]))
    return np.abs((window * phase) @ np.exp(-2j * np.pi * np.outer(x, q)) * 0.01) ** 2 / (window**2).sum() / 0.01


@pytest.mark.parametrize("coherence_length", [1.5, 2.5, 6.0])
@pytest.mark.parametrize("kappa", [3.0, 17.3, 34.9])
def test_the_spectrum_is_its_definition(kappa, coherence_length):
    period, depth = 2.5, 0.3

    def heights(x):
        return depth / 2 * np.cos(2 * np.pi * x / period)

    q = np.linspace(-3, 3, 41)
    across = np.linspace(-0.1, 0.1, 5)
    # Both axes by the definition; along y the surface is flat.
    along_x = windowed_powers(heights, kappa, period, coherence_length, q)
    along_y = windowed_powers(np.zeros_like, kappa, period, coherence_length, across).mean(axis=0)
    wanted = along_x.mean(axis=0)[:, None] * along_y
    samples = np.arange(128) / 128 * period
    field = HeightField(heights(samples)[None], (period / 128, period))
    grid = np.stack(np.meshgrid(q, across, indexing="ij"), axis=-1)
    got = power_spectrum(field, grid, np.full(grid.shape[:2], kappa), coherence_length=coherence_length)
    np.testing.assert_allclose(got, wanted, rtol=1e-9, atol=1e-10 * wanted.max())
    if coherence_length < 2 and kappa > 10:
        # At one place alone the orders do interfere: the average it is that makes the cross terms vanish.
        assert np.abs(along_x[0] - along_x.mean(axis=0)).max() > 0.05 * along_x.max()


@pytest.mark.parametrize("coherence_length", [0.3, 65.0, 1000.0])
def test_lobe_width_is_that_of_the_window(coherence_length):
    # Standard deviation over q of the power of the window's transform, by sums.
    sigma_s = coherence_length / 4
    x = np.linspace(-8, 8, 801) * sigma_s
    q = np.linspace(-1.5, 1.5, 601) / sigma_s
    power = np.abs(np.exp(-2j * np.pi * np.outer(q, x)) @ np.exp(-(x**2) / (2 * sigma_s**2))) ** 2
    assert lobe_width(coherence_length) == pytest.approx(np.sqrt((power * q**2).sum() / power.sum()), rel=1e-9)
    assert lobe_width(coherence_length) == pytest.approx(sigma_of(coherence_length), rel=1e-12)


def test_sunlight_gives_lobes_of_a_fifth_of_a_degree():
    assert lobe_width(65.0) == pytest.approx(0.0069, abs=5e-5)


@pytest.mark.parametrize("shape", [(1, 1), (5, 4), (1, 6), (7, 1)])
@pytest.mark.parametrize("kappa", [0.0, 12.0, 34.9])
def test_the_spectrum_integrates_to_one(shape, kappa):
    field = HeightField(np.random.default_rng(2).random(shape) * 0.5, (0.4, 0.3))
    step = 0.4 * sigma_of(1.0)  # the trapezoidal rule on Gaussians: exact to 1e-13
    axes = [np.arange(-1 / (2 * p) - 6, 1 / (2 * p) + 6, step) for p in field.pixel_size]
    q = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    total = power_spectrum(field, q, np.full(q.shape[:2], kappa), coherence_length=1.0).sum() * step**2
    assert total == pytest.approx(1, abs=1e-9)


@pytest.mark.parametrize("kappa", [0.0, 4.0, 34.9])
def test_a_sinusoid_has_bessel_lobes(kappa):
    field = gratings.sinusoidal(period=2.5, depth=0.2)
    m = np.arange(-10, 11)
    q = np.stack([m / 2.5, np.zeros(21)], axis=-1)
    wanted = jv(m, kappa * 0.1) ** 2 / (2 * np.pi * sigma_of(65) ** 2)
    np.testing.assert_allclose(power_spectrum(field, q, np.full(21, kappa)), wanted, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("q", [(np.nan, 0.0), (0.0, np.nan)])
def test_what_is_not_a_number_does_not_become_one(q):
    field = HeightField([[0.0, 0.1]], 0.2)
    with contextlib.suppress(ValueError):
        assert np.isnan(power_spectrum(field, [q], [1.0])).all()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"extent": "ribbon"}, "extent: got 'ribbon'"),
        ({"coherence_length": 0.0}, "coherence_length: got"),
        ({"coherence_length": -1.0}, "coherence_length: got"),
        ({"coherence_length": np.nan}, "coherence_length: got"),
        ({"coherence_length": np.inf}, "coherence_length: got"),
        ({"q": np.zeros(3)}, "q: got shape"),
        ({"q": 0.0}, "q: got shape"),
        ({"q": np.zeros((2, 2)), "kappa": np.zeros(3)}, "kappa: got shape"),
    ],
)
def test_wrong_requests_are_refused(arguments, message):
    arguments = {"q": np.zeros((1, 2)), "kappa": np.zeros(1), **arguments}
    with pytest.raises(ValueError, match=message):
        power_spectrum(HeightField([[0.0]], 1.0), **arguments)
