"""The albedo of a perfect mirror with random surfaces, by quasi-Monte Carlo from the stored spectrum."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.stats import qmc

import mitsuba_diffraction as md
from mitsuba_diffraction.geometry import k_g
from mitsuba_diffraction.spectrum.furnace import Furnace, random_places
from mitsuba_diffraction.spectrum.spline_grid import spline_integral

MOST = 1.002
SEEDS = range(1000, 1030)
"""Of the slow study; any others serve."""


def random_surface(seed):
    """A random height field, what to precompute it with, and the generator to go on with.

    Heights to 10 µm, sides from 0.5 to 30 µm, coherence lengths from 0.3 to 300 µm; rough, smooth or uniform along y.
    """
    rng = np.random.default_rng(seed)
    side = np.exp(rng.uniform(np.log(0.5), np.log(30)))
    height = rng.uniform(0, 10) if rng.random() < 0.7 else 10 ** rng.uniform(-1.5, 1)
    pixel = max(rng.uniform(0.04, 0.28), side / 110)
    count = max(int(side / pixel), 4)
    shape = (count, max(int(count * rng.uniform(0.5, 1)), 4)) if rng.random() < 0.8 else (1, count)
    h = rng.random(shape)
    if rng.integers(3):
        length = np.exp(rng.uniform(0, np.log(12), 1))[0]
        h = gaussian_filter(h, [min(length, n / 4) if n > 1 else 0 for n in shape], mode="wrap")
    h = (h - h.min()) / max(np.ptp(h), 1e-12) * height
    coherence_length = np.exp(rng.uniform(np.log(0.3), np.log(300)))
    extent = "sample" if rng.random() < 0.5 and shape[0] > 1 else "tile"
    return md.HeightField(h, pixel), {"extent": extent, "coherence_length": coherence_length}, rng


def albedo(of, wi, wavelength, count, seed=0):
    """∫ K G S min(e(ω_i), e(ω_o)) dq and its standard error; λ in µm. A node by its mean power, a q in its lobe."""
    k, table = 2 * np.pi / wavelength, of.energy_table()
    kappas = np.minimum(k * (wi[2] + (np.arange(24) + 0.5) / 24), of.largest_kappa)
    powers = sum(np.abs(of.powers(kappa).astype(np.float64)) for kappa in kappas)
    powers += powers.sum() * 1e-2 / powers.size
    q_x, q_y = of.grid.frequencies()
    sample = of.extent == "sample"
    radius = 2.4 * max(of.grid.spacing) if sample else 1.5 * of.reach * of.lobe_width
    out = np.hypot(wavelength * q_x + wi[0], wavelength * q_y[:, None] + wi[1])
    powers = np.where(out < np.sqrt(1 + (radius * wavelength) ** 2) + radius * wavelength, powers, 0).ravel()
    cumulative, results = np.cumsum(powers) / powers.sum(), []
    for repetition in range(4):
        x = qmc.Sobol(3, seed=10 * seed + repetition).random(count // 4)
        node = np.minimum(np.searchsorted(cumulative, x[:, 0], side="right"), powers.size - 1)
        row, column = np.divmod(node, len(q_x))
        if sample:
            t = np.linspace(-1.5, 1.5, 4001)
            offset = np.stack([np.interp(x[:, i + 1], spline_integral(t), t) * of.grid.spacing[i] for i in (0, 1)], -1)
        else:
            r = of.lobe_width * np.sqrt(-2 * np.log(1 + x[:, 1] * np.expm1(-(of.reach**2) / 2)))
            offset = r[:, None] * np.stack([np.cos(2 * np.pi * x[:, 2]), np.sin(2 * np.pi * x[:, 2])], -1)
        q = np.stack([q_x[column], q_y[row]], -1) + offset
        t = -wavelength * q - wi[:2]
        square = 1 - (t**2).sum(-1)
        above = square > 0
        if sample:
            above &= (np.abs(q) <= np.array(of.grid.limit)).all(-1)
        cos_o = np.sqrt(np.where(above, square, 1))
        w = wi[2] + cos_o
        d = ((wavelength * q) ** 2).sum(-1) / 2 + w**2 / 2
        s = of.table.powers_at(row, column, np.minimum(k * w, of.largest_kappa)).astype(np.float64)
        wo = np.concatenate([t, cos_o[:, None]], -1)
        e = np.minimum(table.at(wi[None], wavelength)[0], table.at(wo, wavelength))
        value = k_g(wi[2], cos_o, d) * s * e * powers.sum() / powers[node]
        results.append(np.where(above, value, 0).mean())
    return np.mean(results), np.std(results) / np.sqrt(3)


def largest_albedo(seed, count=24):
    """The largest over random directions and wavelengths, less twice its error; None for a surface that is refused."""
    heights, request, rng = random_surface(seed)
    try:
        of = md.precompute(heights, tolerance=1e-2, **request)
    except ValueError:
        return None
    theta = np.deg2rad(rng.uniform(np.where(rng.random(count) < 0.5, 0, 70), 89.9))
    phi, wavelengths = rng.uniform(0, 2 * np.pi, count), rng.uniform(0.36, 0.83, count)
    omega = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1)
    found = [albedo(of, *pair, 1 << 13) for pair in zip(omega, wavelengths, strict=True)]
    worst = np.argmax([mean - 2 * error for mean, error in found])
    mean, error = albedo(of, omega[worst], wavelengths[worst], 1 << 16, seed=3)
    return mean - 2 * error


@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize(
    "seed",
    [
        pytest.param(3, id="tile of 4 × 4 pixels, 8 µm deep"),  # 1.078 where e came from the gathered spectrum alone
        pytest.param(103, id="tile of 7 pixels, 1.8 µm deep"),
        pytest.param(6, id="tile of 34 pixels, 3.7 µm deep", marks=pytest.mark.slow),
        pytest.param(102, id="wide lobes, 8.2 µm deep", marks=pytest.mark.slow),
        pytest.param(107, id="rough scan, 5 µm deep", marks=pytest.mark.slow),
        *(pytest.param(seed, marks=pytest.mark.slow) for seed in SEEDS),
    ],
)
def test_no_albedo_above_one(seed):
    found = largest_albedo(seed)
    if found is None:
        pytest.skip("refused by precompute")
    assert found <= MOST


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_the_albedo_that_the_table_was_lowered_by():
    heights, request, rng = random_surface(103)
    of = md.precompute(heights, tolerance=1e-2, **request)
    omega, wavelengths = random_places(rng, 8, of.wavelengths)
    got = Furnace(of).albedo(omega, wavelengths, of.energy_table(), 4096, rng)[0]
    wanted = [albedo(of, *pair, 1 << 14)[0] for pair in zip(omega, wavelengths, strict=True)]
    np.testing.assert_allclose(got, wanted, rtol=5e-3)
