"""A transmission grating as it was measured."""

import numpy as np
import pytest

from mitsuba_diffraction.evaluation.validation import transmission_grating as t300
from mitsuba_diffraction.settings import THEORIES


def test_b270_has_its_index_and_abbe_number():
    assert t300.b270(0.58756) == pytest.approx(1.5230)
    assert 0.5230 / (t300.b270(0.48613) - t300.b270(0.65627)) == pytest.approx(58.5)


@pytest.mark.parametrize("theory", THEORIES)
def test_grooves_of_glass_are_those_that_were_measured(theory):
    """The nominal angle is 17.5°."""
    angle = t300.stored_angles()["right-angled"][theory]
    assert angle == pytest.approx(17.5, abs=0.4)
    factor, rms = t300.scaled(t300.curve("right-angled", angle, theory == "rigorous", step=9), step=9)
    assert factor == pytest.approx(0.88, abs=0.015)
    assert rms < 0.01


@pytest.mark.parametrize("shape", t300.GROOVES)
def test_the_stored_angle_fits_best(shape):
    angle = t300.stored_angles()[shape]["scalar"]
    best, *others = (t300.scaled(t300.curve(shape, a, False))[1] for a in (angle, angle - 0.5, angle + 0.5))
    assert best < min(others)


def test_harmonics_of_the_fit_suffice():
    surface = t300.groove("right-angled", 17.5)
    exact = t300.efficiencies(surface, (0, 0, -1), 0.45, int_ior=t300.b270(0.45))
    powers = (np.abs(exact.transmitted_amplitudes) ** 2).sum(axis=(1, 2)) / 2
    first = t300.transmitted(surface, 0.45, True)[0] / (1 - t300.fresnel(1.0, t300.b270(0.45))[0])
    assert first == pytest.approx(powers[exact.transmitted_orders == -1][0], abs=1e-3)
