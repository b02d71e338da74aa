"""The furnace against closed forms: reflected orders one by one, and reflection and transmission of an interface."""

import functools
from dataclasses import replace

import numpy as np
import pytest
from scipy.special import jv

import mitsuba_diffraction as md
from mitsuba_diffraction.energy.furnace import MAX_E, Furnace, bounds_of, mean_cosine
from mitsuba_diffraction.energy.table import EnergyTable
from mitsuba_diffraction.optics.film_stack import Stack
from mitsuba_diffraction.optics.geometry import horizon_gain, k_g
from mitsuba_diffraction.optics.refractive_indices import constant

INDEX, SHORT, LONG = 1.5, 360.0, 830.0
GLASS, NORMAL = Stack(1.0, constant(INDEX)), ((INDEX - 1) / (INDEX + 1)) ** 2
PROFILES = {
    "sinusoid": (md.gratings.sinusoidal(2.5, 0.3), lambda m, kappa: jv(m, kappa * 0.15) ** 2),
    "sawtooth": (md.gratings.blazed(2.5, 0.25), lambda m, kappa: np.sinc(kappa * 0.25 / (2 * np.pi) - m) ** 2),
}


@functools.cache
def spectrum(name, **settings):
    return md.precompute(PROFILES[name][0], wavelengths=(SHORT / INDEX, LONG / INDEX), **settings)


def oblique(rng, count, max_angle):
    """Directions uniform in the polar angle, up to `max_angle` degrees."""
    theta, phi = np.deg2rad(rng.uniform(0, max_angle, count)), rng.uniform(0, 2 * np.pi, count)
    return np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1)


def reflectance(cosine, index):
    """F of unpolarised light, by Fresnel's formulas with a complex angle beyond the critical one."""
    inside = np.sqrt(1 - (1 - cosine**2) / index**2 + 0j)
    s = (cosine - index * inside) / (cosine + index * inside)
    p = (index * cosine - inside) / (index * cosine + inside)
    return (np.abs(s) ** 2 + np.abs(p) ** 2) / 2


def pair(wi, wo, n_i, n_o):
    """K_t G_t (1 − F) of directions (..., 3) on both sides, from vectors."""
    v = n_i * wi + n_o * wo
    h = v / np.linalg.norm(v, axis=-1, keepdims=True)
    i, o = np.abs((wi * h).sum(-1)), np.abs((wo * h).sum(-1))
    cos_i, cos_o = np.abs(wi[..., 2]), np.abs(wo[..., 2])
    k = i * o / (cos_i * cos_o * h[..., 2] ** 2)
    g = np.minimum(1, 2 * np.minimum(cos_i / i, cos_o / o)) ** 2
    return np.where((v**2).sum(-1) < abs(n_i**2 - n_o**2), k * g * (1 - reflectance(i, n_o / n_i)), 0)


def closed_form(power, period, omega, wavelength, side):
    """R and T by the orders; ω has z > 0 on its own side, λ is in µm in vacuum."""
    n_i, n_o = (1.0, INDEX) if side > 0 else (INDEX, 1.0)
    wi = omega * [1, 1, side]
    total = np.zeros(2)
    for m in range(-60, 61):
        tangent = np.array([wavelength * m / period, 0])
        for n, sign in ((n_i, side), (n_o, -side)):
            t = -(tangent + n_i * wi[:2]) / n
            if t @ t >= 1:
                continue
            wo = np.array([*t, sign * np.sqrt(1 - t @ t)])
            kappa = 2 * np.pi * (n_i * wi[2] + n * wo[2]) / wavelength
            if sign == side:
                factor = k_g(abs(wi[2]), abs(wo[2]), (tangent @ tangent) / n_i**2)
                factor *= reflectance(np.sqrt((1 + wi @ wo) / 2), n_o / n_i)
            else:
                factor = pair(wi, wo, n_i, n_o)
            total[int(sign != side)] += factor * power(m, kappa)
    return total


@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize("name", PROFILES)
def test_the_furnace_of_an_interface_agrees_with_the_closed_form(name, side):
    rng = np.random.default_rng(1)
    omega, wavelengths = oblique(rng, 40, 88), rng.uniform(SHORT, LONG, 40) * 1e-3
    wanted = np.array([closed_form(PROFILES[name][1], 2.5, *at, side) for at in zip(omega, wavelengths, strict=True)]).T
    # Lobes so narrow that none meets the horizon.
    furnace = Furnace.of(spectrum(name, coherence_length=5000), 1.0, GLASS)
    furnace = furnace if side > 0 else furnace.from_below()
    found = furnace.albedo(omega, wavelengths / (1 if side > 0 else INDEX))
    np.testing.assert_allclose(found, wanted, atol=4e-3)
    np.testing.assert_allclose((bounds_of(found, NORMAL) * found).sum(0), np.minimum(1, found.sum(0)), atol=1e-9)


@pytest.mark.parametrize("theta", [0, 20, 40])
def test_transmission_of_a_deep_film_agrees_with_the_closed_form(theta):
    period, amplitude, wavelength = 2.0, 0.2, 0.55
    of = md.precompute(
        md.gratings.crossed(period, 2 * amplitude, samples=40),
        wavelengths=(SHORT / INDEX, LONG / INDEX),
        coherence_length=2000,
    )
    theta = np.deg2rad(theta)
    wi = np.array([0.8 * np.sin(theta), 0.6 * np.sin(theta), np.cos(theta)])
    wanted = 0.0
    for m, n in np.ndindex(25, 25):
        t = -(wavelength / period * (np.array([m, n]) - 12) + wi[:2]) / INDEX
        if t @ t < 1:
            wo = np.array([*t, -np.sqrt(1 - t @ t)])
            x = 2 * np.pi * (wi[2] + INDEX * wo[2]) / wavelength * amplitude
            wanted += pair(wi, wo, 1.0, INDEX) * (jv(m - 12, x) * jv(n - 12, x)) ** 2
    albedo = Furnace.of(of, 1.0, GLASS).albedo(wi[None], np.array([wavelength]))
    assert albedo[1, 0] == pytest.approx(wanted, abs=5e-3)
    assert bounds_of(albedo, NORMAL)[1] > 0.98


def bounds_of_table(table, omega, wavelengths):
    """e of a table of lines along y, from its module's docstring; λ in µm."""
    layout, c = table.layout, np.hypot(omega[:, 0], omega[:, 2])
    e = table.values[0, 0, 0] * (MAX_E / 255)
    cells = []
    for along in (c - omega[:, 0], c + omega[:, 0]):
        u = along * layout.period / wavelengths
        square = np.minimum(u.astype(int), layout.squares - 1)
        count = np.where(square > 0, layout.cells, layout.first)
        x = np.sqrt(np.clip(u - square, 0, 1)) * count
        cell = np.minimum(x.astype(int), count - 1)
        first = np.where(square > 0, layout.first + 1 + (square - 1) * (layout.cells + 1), 0)
        cells.append((first + cell, x - cell))
    (column, x), (row, y) = cells
    low, high = (e[at, column] + x * (e[at, column + 1] - e[at, column]) for at in (row, row + 1))
    return np.minimum(low + y * (high - low), 1)


def order_albedo(of, omega, wavelength, steps=161):
    """∫ K G S W dq of orders that are evaluated one by one, each over a square lattice about it; λ in µm."""
    q_x, q_y = (q.ravel() for q in np.meshgrid(*of.grid.frequencies()))
    row, column = (i.ravel() for i in np.indices(of.grid.shape))
    x, y = np.meshgrid(*2 * [np.linspace(-4.5, 4.5, steps)])
    weight = np.exp(-(x**2 + y**2) / 2)
    weight /= weight.sum()
    total, width = 0.0, wavelength * of.lobe_width
    for m in range(len(q_x)):
        offset = wavelength * np.array([q_x[m], q_y[m]])
        t_i = omega[:2] + offset
        if np.hypot(*t_i) >= 1:
            continue
        s_o = np.stack([-t_i[0] - width * x, -t_i[1] - width * y], -1)
        t_o, square = s_o + offset, 1 - (s_o**2).sum(-1)
        kept = (square > 0) & ((t_o**2).sum(-1) < 1)
        d = [(1 - (t[..., :2] ** 2).sum(-1)) / (2 * width) for t in (omega[:2], t_i, s_o[kept], t_o[kept])]
        cos_o = np.sqrt(square[kept])
        w = omega[2] + cos_o
        gain = horizon_gain(min(d[0], d[1])) * horizon_gain(np.minimum(d[2], d[3]))
        kappa = np.minimum(2 * np.pi * w / wavelength, of.max_kappa)
        power = of.table.powers_at(np.full(w.shape, row[m]), np.full(w.shape, column[m]), kappa)
        c_i = np.sqrt((omega[2] ** 2 + 1 - (t_o[kept] ** 2).sum(-1)) / 2)
        c_o = np.sqrt((cos_o**2 + 1 - t_i @ t_i) / 2)
        total += (weight[kept] * gain * k_g(c_i, c_o, offset @ offset) * power).sum()
    return total


@pytest.mark.few(1)
@pytest.mark.parametrize("depth", [0.25, 0.8])
@pytest.mark.parametrize("coherence_length", [65.0, 20.0])
def test_the_furnace_is_the_integral_over_the_lobes_of_orders(depth, coherence_length):
    of, rng = md.precompute(md.gratings.blazed(2.5, depth), coherence_length=coherence_length), np.random.default_rng(3)
    omega, wavelengths = oblique(rng, 8, 89), rng.uniform(0.36, 0.83, 8)
    wanted = [order_albedo(of, *at) for at in zip(omega, wavelengths, strict=True)]
    np.testing.assert_allclose(Furnace.of(of).albedo(omega, wavelengths)[0], wanted, rtol=0.02)


def test_deep_lines_return_no_more_light_than_they_receive_at_grazing_incidence():
    """Regression: 1.26 to 1.5.

    Where light returns to where it came from, one cosine grows as the other falls within a lobe; and the table held e
    of one angle to the plane of incidence.
    """
    rng = np.random.default_rng(6)
    of = md.precompute(md.HeightField(1.6 * rng.random((1, 18)), 0.0425), coherence_length=6.2, tolerance=1e-2)
    theta, phi = np.deg2rad(rng.uniform(85, 89.9, 60)), np.deg2rad(rng.uniform(*np.array([[-5, 0], [5, 360]]), (30, 2)))
    omega = np.stack([np.sin(theta) * np.cos(phi.T.ravel()), np.sin(theta) * np.sin(phi.T.ravel()), np.cos(theta)], -1)
    wavelengths = rng.uniform(0.36, 0.83, 60)
    albedo = np.array([order_albedo(of, *at, steps=81) for at in zip(omega, wavelengths, strict=True)])
    assert albedo.max() > 2
    assert (np.abs(Furnace.of(of).albedo(omega, wavelengths)[0] - albedo) / np.maximum(albedo, 1)).mean() < 0.03
    assert (albedo * bounds_of_table(EnergyTable.of(of), omega, wavelengths)).max() < 1.05


@pytest.mark.parametrize(("theta", "wavelength"), [(89.6, 0.638), (80, 0.5)])
def test_light_from_the_horizon_that_deep_lines_diffract_upwards(theta, wavelength):
    """Regression: 18 and 9 % less. Both cosines vary within a wide lobe where one of them is not small, too."""
    relief = md.HeightField(5.2 * np.random.default_rng(2).random((1, 14)), 0.12)
    of = md.precompute(relief, coherence_length=3.5, wavelengths=(480, 830), tolerance=1e-2)
    theta, phi = np.deg2rad([theta, 181.3])
    omega = np.array([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)])
    wanted = order_albedo(of, omega, wavelength, steps=81)
    assert wanted > 1.4
    assert Furnace.of(of).albedo(omega[None], np.array([wavelength]))[0] == pytest.approx(wanted, rel=0.04)


def test_each_order_is_one_term_of_the_albedo():
    """Regression: where the phase varies within a lobe, the sampler of orders had one of nine points of each."""
    furnace, rng = Furnace.of(md.precompute(md.gratings.blazed(2.5, 3.0))), np.random.default_rng(6)
    omega, wavelengths = oblique(rng, 10, 89), rng.uniform(0.36, 0.83, 10)
    direction, order, power = furnace.terms(omega, wavelengths, 0)
    assert len(set(zip(direction, order, strict=True))) == len(direction) > 50
    np.testing.assert_allclose(np.bincount(direction, power), furnace.albedo(omega, wavelengths)[0], rtol=1e-6)


def test_the_mean_cosine_of_a_lobe_far_from_the_horizon_is_that_of_its_centre():
    square, sigma = np.array([0.2, 0.5, 1.0]), 0.003
    np.testing.assert_allclose(mean_cosine(square, sigma), np.sqrt(square), rtol=1e-4)
    # At the horizon: g(0) = √e, for a lobe that the horizon cuts in half.
    y = np.linspace(0, 20, 20001)
    density = np.sqrt(np.e) * horizon_gain(y) * np.exp(-(y**2) / 2) / np.sqrt(2 * np.pi)
    expected = np.trapezoid(density * np.sqrt(y / 2), y) * np.sqrt(2 * sigma)
    np.testing.assert_allclose(mean_cosine(0.0, sigma), expected, rtol=1e-3)


def test_light_that_a_bin_diffracts_along_the_normal_has_an_albedo():
    noise = np.random.default_rng(3).normal(size=(128, 128)) * 0.02
    furnace = Furnace.of(md.precompute(md.HeightField(noise, 0.08), coherence_length=4.0))
    assert not furnace.by_order
    tangent = -0.5 * furnace.q[np.hypot(*furnace.q.T) < 1.9]
    omega = np.column_stack([tangent, np.sqrt(1 - (tangent**2).sum(-1))])
    with np.errstate(all="raise", under="ignore"):
        found = furnace.albedo(omega, np.full(len(omega), 0.5))
    assert np.isfinite(found).all()


def test_bins_transmit_as_orders_into_a_medium_of_nearly_the_same_index():
    index, rng = 1.0005, np.random.default_rng(5)
    of = md.precompute(
        md.gratings.crossed(2.5, 0.8, samples=48),
        coherence_length=1e5,
        wavelengths=(SHORT / index, LONG / index),
    )
    furnace = Furnace.of(of, 1.0, Stack(1.0, constant(index)))
    assert furnace.by_order
    # Lobes so narrow that none meets the horizon.
    omega, wavelengths = oblique(rng, 60, 60), rng.uniform(SHORT, LONG, 60) * 1e-3
    found = replace(furnace, by_order=False).albedo(omega, wavelengths)
    np.testing.assert_allclose(found, furnace.albedo(omega, wavelengths), rtol=1e-5)
