"""The solver of `tools/data/volume_integral.py` against other methods."""

import numpy as np
import pytest
from volume_integral import extrapolated, solve

from mitsuba_diffraction import gratings, rigorous
from mitsuba_diffraction.scalar_theory.closed_form import efficiency_difference, incident_direction

WAVELENGTH, INDEX = 0.55, 1.5


def of(found, m, eta):
    """The efficiencies of orders (m_x, m_y), (2, n)."""
    where = {tuple(pair): n for n, pair in enumerate(found.tolist())}
    return eta[:, [where[tuple(pair)] for pair in np.asarray(m).tolist()]]


@pytest.mark.few(3)
@pytest.mark.parametrize("side", [1, -1], ids=["above", "below"])
@pytest.mark.parametrize("direction", [(0, 0), (20, 0), (20, 90), (40, 45)])
def test_a_profile_has_the_orders_of_the_coordinate_transformation_method(direction, side):
    surface, light = gratings.sinusoidal(2.5, 0.5, samples=512), incident_direction(*direction) * (1, 1, side)
    exact = rigorous.efficiencies(surface, light, WAVELENGTH, int_ior=INDEX, tolerance=1e-4)
    found = extrapolated(surface.heights, (2.5, 2.5), light, WAVELENGTH, INDEX, (1, 64), 32, dtype=np.complex128)
    reflected, transmitted = (np.stack([m, 0 * m], axis=1) for m in (exact.orders, exact.transmitted_orders))
    eta = of(found.reflected, reflected, found.eta).mean(axis=0)
    assert efficiency_difference(eta, exact.unpolarised) < 3e-3
    eta = of(found.transmitted, transmitted, found.eta_transmitted).mean(axis=0)
    assert efficiency_difference(eta, exact.transmission.unpolarised) < 5e-4


def test_the_error_decreases_with_the_square_of_the_voxels():
    surface, light = gratings.sinusoidal(2.5, 0.5, samples=512), incident_direction(20, 0)
    exact = rigorous.efficiencies(surface, light, WAVELENGTH, int_ior=INDEX, tolerance=1e-4)
    errors = []
    for points, layers in ((64, 16), (128, 32)):
        found = solve(surface.heights, (2.5, 2.5), light, WAVELENGTH, INDEX, (1, points), layers)
        eta = of(found.reflected, np.stack([exact.orders, 0 * exact.orders], axis=1), found.eta).mean(axis=0)
        errors.append(efficiency_difference(eta, exact.unpolarised))
    assert errors[0] / errors[1] == pytest.approx(4, rel=0.1)


def bumps(period, depth, pixels=32):
    """Two sinusoids at right angles, and a third wave that breaks their symmetry."""
    y, x = 2 * np.pi * (np.indices((pixels, pixels)) + 0.5) / pixels
    heights = np.sin(x) + 0.7 * np.sin(y) + 0.4 * np.sin(x + y + 1)
    return heights * depth / np.ptp(heights)


def test_energy_is_conserved_in_two_dimensions():
    found = solve(bumps(2, 0.2), (2.0, 1.6), incident_direction(20, 30), WAVELENGTH, INDEX, (20, 24), 8)
    assert found.lost < 2e-5
    assert (found.eta >= 0).all()


def test_reciprocity_in_two_dimensions():
    # Exact for the discretised equations too, up to the residual.
    heights, period, light = bumps(2, 0.2), (2.0, 1.6), incident_direction(20, 30)
    there = solve(heights, period, light, WAVELENGTH, INDEX, (20, 24), 8, tolerance=1e-6, dtype=np.complex128)
    m = (1, -1)
    tangent = -light[:2] - WAVELENGTH * np.divide(m, period)
    back = np.append(tangent, np.sqrt(1 - tangent @ tangent))
    again = solve(heights, period, back, WAVELENGTH, INDEX, (20, 24), 8, tolerance=1e-6, dtype=np.complex128)
    one, other = (of(found.reflected, [m], found.eta).mean() for found in (there, again))
    assert one == pytest.approx(other, rel=1e-4)


@pytest.mark.slow
def test_a_checkerboard_has_the_orders_of_coupled_waves():
    # One layer with vertical walls, for which the package meent is exact but for the number of its harmonics.
    from meent.on_numpy.emsolver.rcwa import RCWANumpy

    period, depth, harmonics = 1.2, 0.2, 8
    squares = np.kron(np.eye(2), np.ones((16, 16)))
    loss = 1e-8
    index = np.where(squares > 0, INDEX, 1.0) - 1j * loss
    meent = RCWANumpy(
        n_top=1.0,
        n_bot=INDEX,
        theta=0.0,
        phi=0.0,
        pol=0.0,
        period=(period, period),
        wavelength=WAVELENGTH,
        ucell=index[None],
        thickness=(depth,),
        fto=(harmonics, harmonics),
    ).conv_solve()
    exact = (meent.res_te_inc.de_ri + meent.res_tm_inc.de_ri) / 2
    found = extrapolated(
        depth * np.eye(2), (period, period), np.array([0.0, 0.0, 1.0]), WAVELENGTH, INDEX, (40, 40), 24, stepped=True
    )
    m = found.reflected
    assert efficiency_difference(found.eta.mean(axis=0), exact[harmonics + m[:, 1], harmonics + m[:, 0]]) < 1e-2
