"""Scalar theory beside Maxwell's equations for published splitters, as `tools/data/splitters.py` stores its orders."""

import json

import numpy as np
import pytest
import splitters

CASES = json.loads(splitters.STORED.read_text(encoding="utf-8"))["cases"]
# fmmax 1.7.1, formulation JONES_DIRECT_FOURIER, 300 terms, mean of TE and TM; m_y and m_x from −3 to 0, the others are
# equal by symmetry.
FMMAX = [
    [0.0121, 0.01585, 0.01042, 0.01543],
    [0.01584, 0.0174, 0.01355, 0.01313],
    [0.01042, 0.01354, 0.01941, 0.01659],
    [0.01543, 0.01313, 0.01659, 0.02769],
]


def orders(case, name="orders"):
    return np.reshape(case[name], (7, 7))


def test_scalar_theory_has_less_light_in_the_target():
    """By the amounts that docs/validation.md states."""
    for case, less, median in zip(CASES, (0.13, 0.29, 0.18), (0.13, 0.28, 0.17), strict=True):
        found = splitters.scalar(splitters.stored_pillars(case), case["height"])
        assert found.sum() / orders(case).sum() == pytest.approx(1 - less, abs=0.01)
        assert np.median(np.abs(found - orders(case)) / orders(case)) == pytest.approx(median, abs=0.01)


def test_the_stored_orders_are_those_of_coupled_waves():
    # 300 terms are too few for order 0, which has 0.050 with 120 terms.
    found, wanted = (np.ravel(values)[:-1] for values in (orders(CASES[0])[:4, :4], FMMAX))
    np.testing.assert_allclose(found, wanted, rtol=0.14)
    assert np.abs(found - wanted).sum() < 0.06 * wanted.sum()


def test_a_weak_order_needs_extrapolation():
    # Of 12 and 18 layers; with 8 and 12 layers, order 0 has 0.069 and 0.038, and 0.0180 is extrapolated from all three.
    coarse, fine, found = (orders(CASES[0], name)[3, 3] for name in ("coarse", "fine", "orders"))
    assert coarse > 1.4 * fine > 1.4 * 1.4 * found
    assert found == pytest.approx(0.018, rel=0.06)


@pytest.mark.slow
def test_the_stored_orders_are_found_again():
    case = CASES[0]
    found = splitters.rigorous(splitters.stored_pillars(case), case["height"], case["layers"])
    np.testing.assert_allclose(found, orders(case, "coarse"), rtol=1e-3, atol=1e-6)
