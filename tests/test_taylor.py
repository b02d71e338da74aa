"""The Taylor series against the exponential itself, to many digits, and its bounds against what is left out."""

from fractions import Fraction
from math import factorial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mitsuba_diffraction.expansions.taylor import TaylorSeries

LARGEST_KAPPA = 4 * np.pi / 0.36


def partial_sum(x, terms):
    """Σ_{n<N} (ix)ⁿ/n!, without rounding, for a float x."""
    x = Fraction(x)
    parts = [Fraction(0), Fraction(0)]
    for n in range(terms):
        parts[n % 2] += (-1) ** (n // 2) * x**n / factorial(n)
    return complex(float(parts[0]), float(parts[1]))


def evaluate(series, kappa, heights):
    return sum(c * phi for c, phi in zip(series.weights(kappa), series.basis(heights), strict=True))


@given(half_range=st.floats(0, 0.15), kappa=st.floats(0, 35), terms=st.integers(1, 40), place=st.floats(-1, 1))
def test_remainder_bounds_what_is_left_out(half_range, kappa, terms, place):
    series = TaylorSeries(half_range, terms)
    x = kappa * half_range * place
    assert abs(np.exp(1j * x) - partial_sum(x, terms)) <= series.remainder(kappa) * (1 + 1e-9) + 1e-15


@given(half_range=st.floats(0, 0.15), kappa=st.floats(0, 35), terms=st.integers(1, 40), place=st.floats(-1, 1))
def test_weights_times_basis_is_the_partial_sum(half_range, kappa, terms, place):
    got = evaluate(TaylorSeries(half_range, terms), kappa, np.array([[place * half_range]]))
    assert got.shape == (1, 1)
    assert got[0, 0] == pytest.approx(partial_sum(kappa * half_range * place, terms), abs=1e-12)


@given(kappa=st.floats(0, 35), half_range=st.floats(0, 0.5), terms=st.integers(1, 40))
def test_weights_are_powers_over_factorials(kappa, half_range, terms):
    x = kappa * half_range
    wanted = [(1j) ** n * float(Fraction(x) ** n / factorial(n)) for n in range(terms)]
    np.testing.assert_allclose(TaylorSeries(half_range, terms).weights(kappa), wanted, rtol=1e-12, atol=1e-300)


def test_weights_of_many_kappas():
    series = TaylorSeries(0.1, 5)
    kappas = np.linspace(0, 30, 6).reshape(2, 3)
    assert series.weights(kappas).shape == (2, 3, 5)
    np.testing.assert_array_equal(series.weights(kappas)[1, 2], series.weights(30.0))


@given(
    half_range=st.floats(0, 0.25),
    tolerance=st.floats(1e-5, 0.5),
    seed=st.integers(0, 2**32 - 1),
    share=st.floats(0, 1),
)
def test_terms_for_a_tolerance_keep_the_order_powers_to_it(half_range, tolerance, seed, share):
    series = TaylorSeries.for_tolerance(half_range, LARGEST_KAPPA, tolerance)
    heights = np.random.default_rng(seed).uniform(-half_range, half_range, (1, 16))
    heights[0, :2] = -half_range, half_range
    kappa = share * LARGEST_KAPPA
    transform = np.exp(-2j * np.pi * np.outer(np.arange(16), np.arange(16)) / 16) / 16
    exact = np.abs(transform @ np.exp(1j * kappa * heights[0])) ** 2
    approximate = np.abs(transform @ evaluate(series, kappa, heights)[0]) ** 2
    assert np.abs(exact - approximate).sum() <= tolerance + 1e-10


@given(half_range=st.floats(1e-3, 0.25), tolerance=st.floats(1e-5, 0.5))
def test_no_fewer_terms_would_keep_the_bound(half_range, tolerance):
    terms = TaylorSeries.for_tolerance(half_range, LARGEST_KAPPA, tolerance).terms
    if terms > 1:
        delta = (LARGEST_KAPPA * half_range) ** (terms - 1) / factorial(terms - 1)
        assert 2 * delta + delta**2 > tolerance


def test_the_bound_is_not_the_pessimistic_one():
    # e^x x^N / N!, as is sometimes written, would ask for 26 terms here.
    assert TaylorSeries.for_tolerance(0.15, LARGEST_KAPPA, 1e-3).terms <= 20


def test_a_flat_surface_takes_one_term():
    series = TaylorSeries.for_tolerance(0.0, LARGEST_KAPPA, 1e-5)
    assert series.terms == 1
    np.testing.assert_array_equal(evaluate(series, 20.0, np.zeros((2, 3))), np.ones((2, 3)))


@pytest.mark.parametrize("half_range", [-0.1, np.nan, np.inf])
def test_half_ranges_that_are_no_length_are_refused(half_range):
    with pytest.raises(ValueError, match="half_range: got"):
        TaylorSeries(half_range, 3)


def test_a_series_without_terms_is_refused():
    with pytest.raises(ValueError, match="terms: got 0"):
        TaylorSeries(0.1, 0)
