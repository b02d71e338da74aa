"""Polynomials in κ: how many Chebyshev nodes resolve a wave, and the bound of those on intervals."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mitsuba_diffraction.spectrum.tables import (
    SliceTable,
    chebyshev_nodes,
    chebyshev_polynomials,
    chebyshev_transform,
    nodes_for,
)

LARGEST_KAPPA = 4 * np.pi / 0.36
T = np.linspace(-1, 1, 301)


def ignore(done, total):
    pass


@given(x=st.floats(0, 90), tolerance=st.floats(1e-9, 0.1))
def test_nodes_resolve_the_wave_to_the_tolerance(x, tolerance):
    count = nodes_for(x, tolerance)
    values = np.exp(1j * x * chebyshev_nodes(count))
    got = chebyshev_polynomials(T, count) @ (chebyshev_transform(count) @ values)
    assert np.abs(got - np.exp(1j * x * T)).max() <= tolerance + 1e-12


@pytest.mark.few(1)
@pytest.mark.parametrize(("terms", "divisor"), [(3, 192), (4, 3072)])
@given(
    height=st.floats(-5, 5), intervals=st.integers(1, 400), phase=st.floats(0, 2 * np.pi), fraction=st.floats(0.0, 1.0)
)
def test_polynomials_through_chebyshev_points_keep_their_bound(terms, divisor, height, intervals, phase, fraction):
    table = SliceTable.build(
        intervals, terms, LARGEST_KAPPA, lambda kappa: np.cos(kappa * height + phase).reshape(1, 1), lambda v: v, ignore
    )
    kappas = LARGEST_KAPPA * (np.arange(0, intervals, max(1, intervals // 20)) + fraction) / intervals
    got = np.array([table.powers(kappa)[0, 0] for kappa in kappas])
    bound = (abs(height) * LARGEST_KAPPA / intervals) ** terms / divisor
    assert np.abs(got - np.cos(kappas * height + phase)).max() <= bound + 3e-6  # float32


def test_the_nodes_of_very_deep_surfaces_are_finite():
    # Beyond x = 1400 the bound exceeds every float before it falls.
    assert 0.5 * 3000 < nodes_for(3000.0, 1e-5) < 1.5 * 3000
