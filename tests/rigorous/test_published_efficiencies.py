"""Solvers against the efficiencies that the demos of GD-Calc print (K. C. Johnson 2005, public domain).

They are coupled-wave solutions of cases in the literature, with few harmonics and with slopes as staircases, which the
bounds allow for. GD-Calc counts orders the other way, k_o = k_i + m λ/T.
"""

import numpy as np
import pytest
from volume_integral import extrapolated

from mitsuba_diffraction import gratings, rigorous
from mitsuba_diffraction.scalar_theory.closed_form import incident_direction

# Order, s and p. Sinusoid of period 1 and depth 0.3, n = 2, λ = 0.5; 50 strata (Li 1993, J. Opt. Soc. Am. A 10, 2581,
# table 2): the wave vector is at 75° to the grooves, and its projection normal to them at 60° to the normal.
REFLECTED = {-3: (0.011769, 0.020237), -2: (0.039664, 0.033315), -1: (0.040045, 0.0054773), 0: (0.10368, 0.010056)}
TRANSMITTED = {
    **{-5: (0.00018774, 0.00044337), -4: (5.1896e-5, 0.00054232), -3: (0.0073647, 0.016271)},
    **{-2: (0.049306, 0.097487), -1: (0.099548, 0.17061), 0: (0.070222, 0.048023), 1: (0.51523, 0.55687)},
    2: (0.06294, 0.040671),
}


def test_a_sinusoid_under_conical_light_has_published_orders():
    across, around = np.deg2rad((75, 60))
    light = np.array([-np.sin(across) * np.sin(around), -np.cos(across), np.sin(across) * np.cos(around)])
    found = rigorous.efficiencies(gratings.sinusoidal(1.0, 0.3, samples=256), light, 0.5, int_ior=2.0, tolerance=1e-4)
    for orders, published in ((found.reflection, REFLECTED), (found.transmission, TRANSMITTED)):
        assert sorted(-orders.m) == sorted(published)
        s, p = np.transpose([published[-m] for m in orders.m])
        np.testing.assert_allclose(orders.s, s, atol=5e-4)
        # Their p converges slowly with the number of strata, whose walls are vertical.
        np.testing.assert_allclose(orders.p, p, atol=6e-3)


@pytest.mark.slow
def test_pyramids_have_published_orders():
    # Derrick, McPhedran, Maystre and Nevière 1979, Appl. Phys. 18, 39; p-polarised light, 16 strata.
    y, x = (np.indices((96, 96)) + 0.5) / 96 - 0.5
    heights = 0.25 * (1 - 2 * np.maximum(np.abs(x), np.abs(y)))
    light = incident_direction(30, 45)
    found = extrapolated(heights, (1.5, 1.0), light, 1.533, 1.5, (32, 32), 16, dtype=np.complex128)
    reflected = {(-1, 0): 0.0024859, (0, 0): 0.019436}
    transmitted = {(-1, -1): 0.00085096, (0, -1): 0.0067344, (-1, 0): 0.0029004, (0, 0): 0.96485, (1, 0): 0.0027419}
    for m, eta, published in (
        (found.reflected, found.eta[1], reflected),
        (found.transmitted, found.eta_transmitted[1], transmitted),
    ):
        found_of = {tuple(order): value for order, value in zip((-m).tolist(), eta, strict=True)}
        assert found_of == pytest.approx(published, abs=2.5e-4)


@pytest.mark.slow
def test_a_checkerboard_has_published_orders():
    # Li 1997, J. Opt. Soc. Am. A 14, 2758, example 1, at normal incidence; orders (i, j) are those of the smaller cell,
    # turned by 45°. The two numbers are of light polarised along x and y.
    found = extrapolated(np.eye(2), (2.5, 2.5), np.array([0.0, 0.0, 1.0]), 1.0, 1.5, (40, 40), 24, stepped=True)
    reflected = {(0, 0): (0.011109, 0.011111), (0, 1): (0.0016871, 0.0016883), (1, 1): (0.0012662, 0.0005683)}
    transmitted = {
        **{(0, 0): (0.17532, 0.17565), (0, 1): (0.13067, 0.1306), (1, 1): (0.040219, 0.054862)},
        **{(0, 2): (0.0067862, 0.0067372), (1, 2): (0.0096013, 0.0061868)},
    }
    for m, eta, published in (
        (found.reflected, found.eta, reflected),
        (found.transmitted, found.eta_transmitted, transmitted),
    ):
        found_of = dict(zip(map(tuple, m.tolist()), eta.mean(axis=0), strict=True))
        for (i, j), pair in published.items():
            assert found_of[i - j, i + j] == pytest.approx(np.mean(pair), abs=2.5e-4)
