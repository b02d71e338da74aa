"""What an interface and a sheet reflect and transmit together: against closed forms, and never more than came."""

import functools

import mitsuba as mi
import numpy as np
import pytest
from bsdf_support import floats, vectors
from scipy.special import jv
from test_energy_random import INTEGRAL, OFFSETS, anywhere, spectrum_of

import mitsuba_diffraction as md
from mitsuba_diffraction.bsdf.energy import Energy
from mitsuba_diffraction.energy.furnace import Furnace, least_kappa, small_kappa
from mitsuba_diffraction.energy.table import EnergyTable
from mitsuba_diffraction.geometry import horizon_gain, k_g
from mitsuba_diffraction.spectrum.grids import SplineGrid

INDEX, MOST = 1.5, 1.002
SHORT, LONG = 360.0, 830.0
PROFILES = {
    "sinusoid": (md.gratings.sinusoidal(2.5, 0.3), lambda m, kappa: jv(m, kappa * 0.15) ** 2),
    "sawtooth": (md.gratings.blazed(2.5, 0.25), lambda m, kappa: np.sinc(kappa * 0.25 / (2 * np.pi) - m) ** 2),
}


@functools.cache
def spectrum(name, **settings):
    return md.precompute(PROFILES[name][0], wavelengths=(SHORT / INDEX, LONG / INDEX), **settings)


def tables_of(of):
    """e of reflected and of transmitted light, of each side."""
    above, on, below, up = EnergyTable.of_interface(of, INDEX)
    return {1: (above, on), -1: (below, up)}


@functools.cache
def tables(name, **settings):
    return tables_of(spectrum(name, **settings))


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
    """R and T by the orders; ω with its z > 0 on the side it comes from, λ in µm in vacuum."""
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
                d = 1 + wi @ wo
                w = abs(wi[2]) + abs(wo[2])
                g = min(1, 2 * w * min(abs(wi[2]), abs(wo[2])) / d)
                factor = d**2 / abs(wi[2] * wo[2]) / w**2 * g * reflectance(np.sqrt(d / 2), n_o / n_i)
            else:
                factor = pair(wi, wo, n_i, n_o)
            total[int(sign != side)] += factor * power(m, kappa)
    return total


@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize("name", PROFILES)
def test_the_furnace_of_an_interface_is_the_closed_form(name, side):
    rng = np.random.default_rng(1)
    theta, phi = np.deg2rad(rng.uniform(0, 88, 40)), rng.uniform(0, 2 * np.pi, 40)
    omega = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1)
    wavelengths = rng.uniform(SHORT, LONG, 40) * 1e-3
    power = PROFILES[name][1]
    wanted = np.array([closed_form(power, 2.5, *place, side) for place in zip(omega, wavelengths, strict=True)]).T
    inside = wavelengths / (1 if side > 0 else INDEX)
    # Of lobes so narrow that none reaches the horizon.
    found = Furnace.of(spectrum(name, coherence_length=5000), 1.0, INDEX, side).albedo(omega, inside)
    np.testing.assert_allclose(found, wanted, atol=2e-3)
    e = np.stack([table.at(omega, inside) for table in tables(name, coherence_length=5000)[side]])
    total = (e * wanted).sum(0)
    assert total.max() <= 1 + 2e-3
    # Where scalar theory holds, nothing is taken away.
    near = theta < np.deg2rad(45 if side > 0 else 15)
    assert (1 - total / np.minimum(wanted.sum(0), 1))[near].mean() < 0.02
    if side > 0:
        assert total[near].mean() > 0.97


@pytest.mark.parametrize("theta", [0, 20, 40])
def test_a_deep_film_keeps_the_light_that_the_closed_form_transmits(theta):
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
    place = wi[None], np.array([wavelength])
    assert Furnace.of(of, 1.0, INDEX).albedo(*place)[1, 0] == pytest.approx(wanted, abs=5e-3)
    assert EnergyTable.of_interface(of, INDEX)[1].at(*place)[0] > 0.98


def scattered(of, tables, wi, side, wavelength, rng, points, sheet=False):
    """R + T by a sum over the nodes of the stored spectrum, of light from `side`, and its standard error.

    K, G and the gain of lobes at the horizon are those of the order where orders are evaluated one by one. With
    `sheet`, the lower medium ends in a flat face, and what comes from below has come through it.

    Args:
        of: a spectrum for wavelengths in the denser medium.
        tables: e of both sides, above and below, of reflected and of transmitted light.
        wi: ω_i with z > 0, inside the medium it is in.
        side: 1 from above, −1 from below.
        wavelength: µm in vacuum.
        rng: generator.
        points: in the lobe of each node.
        sheet: multiply by the transmittance of the flat face where light leaves below.
    """
    n_i, n_o = (1.0, INDEX) if side > 0 else (INDEX, 1.0)
    splines = isinstance(of.grid, SplineGrid)
    by_order = not splines and (1 in of.grid.shape or all(lobe.count == 1 for lobe in of.lobes))
    sigma, q = of.lobe_width, np.stack(np.meshgrid(*of.grid.frequencies()), -1).reshape(-1, 2)
    row, column = np.divmod(np.arange(len(q)), of.grid.shape[1])
    e_i = [table.at(wi[None], np.array([wavelength / n_i]))[0] for table in tables[side]]
    least = least_kappa(of, INDEX)

    def passed(row, column, kappa):
        kappa = np.minimum(kappa, of.max_kappa)
        at = [
            of.table.powers_at(row, column, k) for k in (kappa, np.full(len(row), least), np.full(len(row), 2 * least))
        ]
        return small_kappa(kappa, least, *at)

    sums = []
    for _ in range(4):
        if splines:
            spread = np.interp(rng.random((points, len(q), 2)), INTEGRAL, OFFSETS) * of.grid.spacing
        else:
            spread = rng.standard_normal((points, len(q), 2)) * sigma
        total = 0.0
        for n, up in ((n_i, 1), (n_o, -1)):
            for sign in (1, -1):
                # S(q; −κ) = S(−q; κ)
                exact = wavelength * sign * (q + spread)
                lattice = np.broadcast_to(wavelength * sign * q, exact.shape)
                square = 1 - ((exact + n_i * wi[:2]) ** 2).sum(-1) / n**2
                v_z = side * (n_i * wi[2] + up * n * np.sqrt(np.maximum(square, 0)))
                there = (square > 0) & (sign * v_z > 0)
                if splines:
                    there &= (np.abs(exact) <= wavelength * np.array(of.grid.limit)).all(-1)
                _, node = np.nonzero(there)
                u, m, cos_o = exact[there], lattice[there], np.sqrt(square[there])
                kappa = 2 * np.pi * np.abs(v_z[there]) / wavelength
                power = of.table.powers_at(row[node], column[node], np.minimum(kappa, of.max_kappa))
                cos_i, gain = np.full(len(u), wi[2]), 1.0
                if by_order:
                    back = 1 - ((u + n_i * wi[:2] - m) ** 2).sum(-1) / n_i**2
                    sent = 1 - ((m + n_i * wi[:2]) ** 2).sum(-1) / n**2
                    gain = (back > 0) & (sent > 0)
                    for x in (np.minimum(n_i * wi[2] ** 2, n * sent), np.minimum(n * cos_o**2, n_i * back)):
                        gain = gain * horizon_gain(np.maximum(x, 0) / (2 * wavelength * sigma))
                    cos_i, cos_exit = (np.sqrt(np.maximum(x, 1e-12) / 2) for x in (wi[2] ** 2 + back, cos_o**2 + sent))
                    tangent = (m**2).sum(-1)
                else:
                    cos_exit, tangent = cos_o, (u**2).sum(-1)
                if up > 0:
                    d = (tangent / n_i**2 + (cos_i + cos_exit) ** 2) / 2
                    factor = k_g(cos_i, cos_exit, d)
                    if not by_order:
                        b = np.clip((25 - tangent / (wavelength * sigma) ** 2) / 9, 0, 1)
                        b = b * np.clip(2 - 5 * np.maximum(cos_i, cos_exit), 0, 1)
                        x = [n_i * np.square(c) / (2 * wavelength * sigma) for c in (cos_i, cos_exit)]
                        factor = (1 - b) * factor + b * horizon_gain(x[0]) * horizon_gain(x[1])
                    factor = factor * reflectance(np.sqrt(d / 2), n_o / n_i)
                else:
                    # Any two directions with these cosines and this |λq|: v = (√tangent, v_z).
                    between = np.abs(n_i * cos_i - n_o * cos_exit)
                    # Of an order, κ is that of its K_t.
                    kappa = 2 * np.pi * between / wavelength
                    power = passed(row[node], column[node], kappa)
                    square_v = tangent + between**2
                    i, o = (np.abs(square_v + s * (n_i**2 - n_o**2)) / 2 / k for s, k in ((1, n_i), (-1, n_o)))
                    i, o = i / np.sqrt(square_v), o / np.sqrt(square_v)
                    g = np.minimum(1, 2 * np.minimum(cos_i / i, cos_exit / o)) ** 2
                    g = g * (square_v < abs(n_i**2 - n_o**2))
                    v_z = np.maximum(between, least * wavelength / (2 * np.pi))
                    factor = i * o * square_v / (cos_i * cos_exit * v_z**2) * g * (1 - reflectance(i, n_o / n_i))
                out = np.concatenate([-(u + n_i * wi[:2]) / n, cos_o[:, None]], -1)
                passes = int(up < 0)
                e = tables[side * up][passes].at(out, np.full(len(out), wavelength / n))
                e = np.minimum(e_i[passes], e)
                if sheet and side * up < 0:
                    e = e * (1 - reflectance(cos_o, 1 / INDEX))
                total += (factor * gain * power * e).sum() / points
        sums.append(total)
    return np.mean(sums), np.std(sums, ddof=1) / 2


SEEDS = range(6000, 6200)


@pytest.mark.few(1)
@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize("seed", SEEDS)
def test_no_interface_and_no_sheet_sends_out_more_than_came(seed):
    of, rng = spectrum_of(seed, (SHORT / INDEX, LONG / INDEX))
    tables = tables_of(of)
    nodes = np.prod(of.grid.shape)
    for side in (1, -1):
        omega, wavelengths = anywhere(rng, 24)
        few = int(np.clip(2**13 / nodes, 1, 128))
        found = [
            scattered(of, tables, wi, side, length, rng, few) for wi, length in zip(omega, wavelengths, strict=True)
        ]
        worst = np.argsort([-mean - error for mean, error in found])[:2]
        for k in worst:
            mean, error = found[k]
            if mean + 2 * error > 1.001:
                mean, error = scattered(of, tables, omega[k], side, wavelengths[k], rng, 16 * few)
            assert mean - 2 * error <= MOST, (side, mean, error, omega[k], wavelengths[k])
        # A sheet: from its flat face with what that reflects, and what it transmits.
        mean, error = scattered(of, tables, omega[k], side, wavelengths[k], rng, few, sheet=True)
        flat = reflectance(omega[k][2], 1 / INDEX) if side < 0 else 0.0
        assert flat + (1 - flat) * (mean - 2 * error) <= MOST


@pytest.mark.usefixtures("llvm")
def test_the_renderer_reads_the_table_of_each_side():
    of = tables("sawtooth")
    energy = Energy([*of[1], *of[-1]])
    omega, wavelengths = anywhere(np.random.default_rng(3), 400)
    for side, n in ((1, 1), (-1, INDEX)):
        for passes in (False, True):
            place = energy.place(vectors(omega * [1, 1, side]))
            found = np.array(energy.bound(place, floats(1 / wavelengths), mi.Bool(passes)))
            np.testing.assert_allclose(found, of[side][passes].at(omega, wavelengths / n), atol=5e-4)
    e = [of[side][1].at(omega[:1], wavelengths[:1] / n)[0] for side, n in ((1, 1), (-1, INDEX))]
    there, back = vectors(omega[:1]), vectors(omega[:1] * [1, 1, -1])
    for wi, wo in ((there, back), (back, there)):
        found = energy.factor(energy.places(wi, wo, mi.Float(1.0), 1.0), mi.Float(1 / float(wavelengths[0])))
        np.testing.assert_allclose(np.array(found).ravel(), min(e), atol=5e-4)
