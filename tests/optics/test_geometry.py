"""Geometry in NumPy: the normalisation of lobes at the horizon."""

import numpy as np
from scipy.special import ndtr

from mitsuba_diffraction.optics.geometry import horizon_gain


def test_lobes_truncated_by_the_horizon_keep_their_power():
    """g(x) ∫₀^∞ φ(x − y) g(y) dy = 1."""
    y, weights = np.polynomial.legendre.leggauss(200)
    y, weights = 5 * (y + 1), 5 * weights
    x = np.linspace(0, 8, 81)
    kernel = np.exp(-((x[:, None] - y) ** 2) / 2) / np.sqrt(2 * np.pi)
    power = horizon_gain(x) * (kernel @ (weights * horizon_gain(y)) + ndtr(x - 10))
    np.testing.assert_allclose(power, 1, atol=1e-3)


def test_gain_at_the_horizon_and_far_from_it():
    np.testing.assert_allclose(horizon_gain(np.array([0.0, 4.0, 100.0])), [np.sqrt(np.e), 1, 1], atol=4.1e-4)
