"""Polynomials in κ on intervals, and the bound of their error by the moments of the heights."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mitsuba_diffraction.spectrum.tables import (
    SliceTable,
    derivative_bound,
    intervals_for,
)

LARGEST_KAPPA = 4 * np.pi / 0.36


def ignore(done, total):
    pass


@pytest.mark.not_quick
@pytest.mark.few(1)
@pytest.mark.parametrize(("terms", "divisor"), [(3, 192), (4, 3072)])
@given(
    height=st.floats(-5, 5), intervals=st.integers(1, 400), phase=st.floats(0, 2 * np.pi), fraction=st.floats(0.0, 1.0)
)
def test_polynomials_through_chebyshev_points_keep_their_bound(terms, divisor, height, intervals, phase, fraction):
    table = SliceTable.build(
        intervals, terms, LARGEST_KAPPA, lambda kappa: np.cos(kappa * height + phase).reshape(1, 1), ignore
    )
    kappas = LARGEST_KAPPA * (np.arange(0, intervals, max(1, intervals // 20)) + fraction) / intervals
    got = np.array([table.powers(kappa)[0, 0] for kappa in kappas])
    bound = (abs(height) * LARGEST_KAPPA / intervals) ** terms / divisor
    assert np.abs(got - np.cos(kappas * height + phase)).max() <= bound + 3e-6  # float32


@given(seed=st.integers(0, 2**32 - 1), n=st.integers(1, 4), depth=st.floats(0.01, 3.0))
def test_derivatives_of_powers_are_within_their_bound(seed, n, depth):
    rng = np.random.default_rng(seed)
    heights = depth * rng.random(24) + rng.normal()
    window = np.exp(-((np.arange(24) - 11.5) ** 2) / 60)
    window /= np.linalg.norm(window)
    kappa = rng.uniform(0, LARGEST_KAPPA)
    # |F|² is a sum of e^{iκ(h_j − h_l)}, whose derivatives are factors (i(h_j − h_l))ⁿ; 64 frequencies resolve it.
    waves = np.exp(-2j * np.pi * np.outer(np.arange(64), np.arange(24)) / 64) * window * np.exp(1j * kappa * heights)
    factors = (1j * (heights[:, None] - heights)) ** n
    derivative = np.einsum("qj,jl,ql->q", waves, factors, waves.conj()).real / 64
    assert np.abs(derivative).sum() <= derivative_bound(heights, window**2, n) * (1 + 1e-9)


def test_two_levels_reach_the_bound():
    # η of the even orders is cos²(κd/2), that of the odd ones sin²: the derivatives are largest where one is zero.
    heights = np.repeat([0.0, 0.3], 8)
    assert derivative_bound(heights, 1 / 16, 4) == pytest.approx(0.3**4, rel=1e-12)
    assert derivative_bound(heights, 1 / 16, 3) == pytest.approx(0.3**3, rel=1e-12)


@pytest.mark.parametrize(("terms", "divisor"), [(3, 192), (4, 3072)])
def test_the_number_of_intervals_keeps_the_bound(terms, divisor):
    for allowed in (1e-2, 1e-3, 1e-4):
        count = intervals_for(2.0, terms, LARGEST_KAPPA, allowed)
        assert 2 * (LARGEST_KAPPA / count) ** terms / divisor <= allowed
        assert 2 * (LARGEST_KAPPA / (count - 1)) ** terms / divisor > allowed
    assert intervals_for(0.0, terms, LARGEST_KAPPA, 1e-3) == 1
