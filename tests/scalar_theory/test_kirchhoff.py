"""From Kirchhoff's integral over a relief to Stam's BRDF (1999), step by step, against S(q; κ) of the package.

The equations are those of the thesis (docs/thesis.md). Kirchhoff's integral is taken over facets with the normals of
the facets, so that neither the slopes nor the transform of the phase enter it.
"""

import numpy as np
import pytest

from mitsuba_diffraction import gratings, reference
from mitsuba_diffraction.optics.geometry import k_g

PERIOD, PERIOD_Y, DEPTH = 4.0, 3.0, 0.3
WAVELENGTH = 0.55
WAVENUMBER = 2 * np.pi / WAVELENGTH
INCIDENT = np.array([0.3, -0.2, np.sqrt(1 - 0.13)])
ORDERS = [(0, 0), (1, 0), (0, 1), (-1, 1), (2, -1), (-3, -2)]


def outgoing(order):
    """ω_r of an order by the grating equation, q = −(ω_i + ω_r)_∥/λ."""
    tangent = -WAVELENGTH * np.array(order) / (PERIOD, PERIOD_Y) - INCIDENT[:2]
    return np.array([*tangent, np.sqrt(1 - tangent @ tangent)])


def corners(count=512):
    """The corners (count + 1, count + 1, 3) of a grid over one period of the crossed relief."""
    x, y = np.meshgrid(np.linspace(0, PERIOD, count + 1), np.linspace(0, PERIOD_Y, count + 1))
    height = DEPTH / 2 * (np.sin(2 * np.pi * x / PERIOD) + np.sin(2 * np.pi * y / PERIOD_Y))
    return np.stack([x, y, height], -1)


def kirchhoff(vector, count):
    """I = ∫_S n̂ e^{ik (u, v, w)·s} ds (eq. 2.6 and 2.10) over two triangles in each cell of the grid.

    A triangle takes the mean of e^{…} at the midpoints of its sides, which is exact for polynomials of degree two.
    """
    grid = corners(count)
    a, b, c, d = grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:], grid[1:, :-1]
    total = np.zeros(3, complex)
    for p, q, r in ((a, b, c), (a, c, d)):
        midpoints = np.stack([p + q, q + r, r + p]) / 2
        wave = np.exp(1j * WAVENUMBER * midpoints @ vector).mean(axis=0)
        total += (np.cross(q - p, r - p) / 2 * wave[..., None]).sum(axis=(0, 1))  # area times normal
    return total


def transform(order):
    """P = ∫∫ e^{ikwh} e^{ik(ux + vy)} dx dy over one period (eq. 2.12 to 2.14), from the amplitudes of the package."""
    relief = gratings.crossed(PERIOD, DEPTH, period_y=PERIOD_Y)
    kappa = WAVENUMBER * (INCIDENT + outgoing(order))[2]
    # κ = −kw and q = (u, v)/λ: the conjugate.
    return PERIOD * PERIOD_Y * np.conj(reference.amplitudes(relief, kappa)[order[1], order[0]])


def phase_of_first_pixel(vector, relief):
    """e^{ik (u, v)·x} at the centre of the first pixel, from which `amplitudes` counts."""
    return np.exp(1j * WAVENUMBER * np.dot(vector[:2], relief.pixel_size) / 2)


@pytest.mark.few(3)
@pytest.mark.parametrize("order", ORDERS)
def test_the_integral_over_the_surface_is_along_u_v_w(order):
    """I = (u, v, w) P/w (eq. 2.14): by parts, the integral over the normals is that of the phase alone."""
    vector = -INCIDENT - outgoing(order)
    found = kirchhoff(vector, 512)
    relief = gratings.crossed(PERIOD, DEPTH, period_y=PERIOD_Y)
    wanted = vector / vector[2] * transform(order) * phase_of_first_pixel(vector, relief)
    np.testing.assert_allclose(found, wanted, rtol=0, atol=2e-5 * PERIOD * PERIOD_Y)
    # Twice as fine, the facets are four times as near.
    coarse, fine = (np.abs(kirchhoff(vector, count) - wanted).max() for count in (128, 256))
    assert coarse / fine == pytest.approx(4, rel=0.05)


@pytest.mark.parametrize("order", ORDERS)
def test_the_scattered_field_has_the_brdf_of_the_model(order):
    """From ψ₂ (eq. 2.5) by σ⁰ and the BRDF (eq. 2.7, 2.8) to K S/λ², of a perfect mirror, without shadowing."""
    outward = outgoing(order)
    vector = -INCIDENT - outward
    # R ψ₂/ψ₁ with F = 1, and over one period of area A.
    field = WAVENUMBER / (4 * np.pi) * (vector - (outward - INCIDENT)) @ kirchhoff(vector, 512)
    area = PERIOD * PERIOD_Y
    cross_section = 4 * np.pi * abs(field) ** 2
    brdf = cross_section / (4 * np.pi * area * INCIDENT[2] * outward[2])
    # Of one period, S at the orders is T_x T_y η_m.
    relief = gratings.crossed(PERIOD, DEPTH, period_y=PERIOD_Y)
    eta = reference.order_powers(relief, -WAVENUMBER * vector[2])[order[1], order[0]]
    factor = k_g(INCIDENT[2], outward[2], vector[:2] @ vector[:2], shadowing=False)
    wanted = float(factor) * area * eta / WAVELENGTH**2
    assert brdf == pytest.approx(wanted, abs=1e-4 * area / WAVELENGTH**2)
    assert brdf == pytest.approx(wanted, rel=2e-3)
