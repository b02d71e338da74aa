"""The albedo of a perfect mirror with random surfaces, by a sum over the nodes of the stored spectrum."""

import functools
from dataclasses import dataclass

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.stats import qmc

import mitsuba_diffraction as md
from mitsuba_diffraction.energy.furnace import Furnace
from mitsuba_diffraction.geometry import horizon_gain, k_g
from mitsuba_diffraction.spectrum.grids import SplineGrid, spline_integral

MOST = 1.002
SEEDS = range(5000, 5040)
"""Of the slow study, four minutes; any others serve."""
PIXELS = 64
"""Along a side, at most: with more, most of the time is spent on the spectrum."""
OFFSETS = np.linspace(-1.5, 1.5, 4001)
INTEGRAL = spline_integral(OFFSETS)


def random_surface(seed):
    """A random height field, what to precompute it with, and the generator to go on with.

    Heights to 10 µm, sides from 0.5 to 30 µm, coherence lengths from 0.3 to 300 µm; rough, smooth or uniform along y.
    """
    rng = np.random.default_rng(seed)
    side = np.exp(rng.uniform(np.log(0.5), np.log(30)))
    height = rng.uniform(0, 10) if rng.random() < 0.7 else 10 ** rng.uniform(-1.5, 1)
    pixel = max(rng.uniform(0.04, 0.28), side / PIXELS)
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


@functools.lru_cache(2)
def spectrum_of(seed, wavelengths=(360.0, 830.0)):
    """Of a random surface; skips the test if it is refused."""
    heights, request, rng = random_surface(seed)
    try:
        return md.precompute(heights, tolerance=1e-2, wavelengths=wavelengths, **request), rng
    except ValueError as refusal:
        pytest.skip(str(refusal))


def albedo(of, table, wi, wavelength, points, rng):
    """∫ K G S W min(e(ω_i), e(ω_o)) dq and its standard error; λ in µm; without a table, e = 1.

    The sum over all nodes, each with `points` in its lobe, four times: drawn from the lobe or, if it reaches near the
    horizon, even in the azimuth of ω_o and in log(cos θ_i + cos θ_o).
    """
    q_x, q_y = (q.ravel() for q in np.meshgrid(*of.grid.frequencies()))
    row, column = (i.ravel() for i in np.indices(of.grid.shape))
    splines = isinstance(of.grid, SplineGrid)
    radius = wavelength * (1.5 * np.hypot(*of.grid.spacing) if splines else of.cutoff_sigmas * of.lobe_width)
    distance = np.hypot(wi[0] + wavelength * q_x, wi[1] + wavelength * q_y)
    splines = isinstance(of.grid, SplineGrid)
    # Orders that are evaluated one by one propagate or not as a whole.
    by_order = not splines and (1 in of.grid.shape or all(lobe.count == 1 for lobe in of.lobes))
    lit = distance < (1 if by_order else 1 + radius)
    q_x, q_y, row, column, distance = (a[lit, None] for a in (q_x, q_y, row, column, distance))
    azimuth = np.arctan2(wi[1] + wavelength * q_y, wi[0] + wavelength * q_x)
    opening = np.where(distance > radius, np.arcsin(np.minimum(radius / np.maximum(distance, 1e-12), 1)), np.pi)
    low = wi[2] + np.sqrt(1 - np.minimum(distance + radius, 1) ** 2)
    ratio = np.log((wi[2] + np.sqrt(1 - np.maximum(distance - radius, 0) ** 2)) / low)
    near = distance + radius > 0.9
    results = []

    def from_horizon(s):
        """d(s), of (..., 2) or directions."""
        return (1 - (s[..., :2] ** 2).sum(-1)) / (2 * wavelength * of.lobe_width)

    for _ in range(4):
        x, y = np.moveaxis((qmc.Sobol(2, scramble=False).random(points) + rng.random((len(q_x), 1, 2))) % 1, -1, 0)
        cos = low * np.exp(ratio * x) - wi[2]
        sine, phi = np.sqrt(np.maximum(1 - cos**2, 0)), azimuth + opening * (2 * y - 1)
        u, v = sine * np.cos(phi) - wi[0], sine * np.sin(phi) - wi[1]
        share = 2 * opening * ratio * (cos + wi[2]) * cos / wavelength**2
        if splines:
            for q, middle, spacing in ((u, q_x, of.grid.spacing[0]), (v, q_y, of.grid.spacing[1])):
                share = share * b_spline((q / wavelength - middle) / spacing) / spacing
            drawn = [np.interp(t, INTEGRAL, OFFSETS) * d for t, d in zip((x, y), of.grid.spacing, strict=True)]
        else:
            square = ((u / wavelength - q_x) ** 2 + (v / wavelength - q_y) ** 2) / of.lobe_width**2
            cut = -np.expm1(-(of.cutoff_sigmas**2) / 2)
            share *= np.exp(-square / 2) / (2 * np.pi * of.lobe_width**2 * cut) * (square < of.cutoff_sigmas**2)
            r = of.lobe_width * np.sqrt(-2 * np.log1p(-x * cut))
            drawn = [r * np.cos(2 * np.pi * y), r * np.sin(2 * np.pi * y)]
        u, v = np.where(near, u, wavelength * (q_x + drawn[0])), np.where(near, v, wavelength * (q_y + drawn[1]))
        share = np.where(near, share, 1)
        square = 1 - (u + wi[0]) ** 2 - (v + wi[1]) ** 2
        kept = (square > 0) & (share > 0)
        if splines:
            kept &= (np.abs(u) <= wavelength * of.grid.limit[0]) & (np.abs(v) <= wavelength * of.grid.limit[1])
        node, _ = np.nonzero(kept)
        u, v, cos_o = u[kept], v[kept], np.sqrt(square[kept])
        w, out = wi[2] + cos_o, np.stack([-u - wi[0], -v - wi[1], cos_o], -1)
        t_i = wi[:2] + wavelength * np.stack([q_x[node, 0], q_y[node, 0]], -1)
        if by_order:
            t_o = out[:, :2] + t_i - wi[:2]
            reached = np.hypot(*t_o.T) < 1
            c_i, c_o = (
                np.sqrt(np.maximum((cos**2 + 1 - (t**2).sum(-1)) / 2, 1e-12)) for cos, t in ((wi[2], t_o), (cos_o, t_i))
            )
            factor = k_g(c_i, c_o, (((t_i - wi[:2]) ** 2).sum(-1) + (c_i + c_o) ** 2) / 2)
            gain = horizon_gain(np.minimum(from_horizon(wi[:2]), from_horizon(t_i)))
            factor *= gain * reached * horizon_gain(np.maximum(np.minimum(from_horizon(out), from_horizon(t_o)), 0))
        else:
            b = np.clip((25 - (u**2 + v**2) / (wavelength * of.lobe_width) ** 2) / 9, 0, 1)
            b *= np.clip(2 - 5 * np.maximum(wi[2], cos_o), 0, 1)
            factor = (1 - b) * k_g(wi[2], cos_o, (u**2 + v**2 + w**2) / 2)
            factor += b * horizon_gain(from_horizon(wi[:2])) * horizon_gain(from_horizon(out))
        kappa = np.minimum(2 * np.pi * w / wavelength, of.max_kappa)
        s = of.table.powers_at(row[node, 0], column[node, 0], kappa).astype(np.float64)
        e = 1.0 if table is None else np.minimum(table.at(wi[None], wavelength), table.at(out, wavelength))
        results.append((share[kept] * factor * s * e).sum() / points)
    return np.mean(results), np.std(results, ddof=1) / 2


def b_spline(t):
    """The centred quadratic one."""
    t = np.abs(t)
    return np.where(t < 0.5, 0.75 - t**2, 0.5 * np.maximum(1.5 - t, 0) ** 2)


@dataclass
class Worst:
    """The largest albedo found: its estimate and standard error, and where."""

    albedo: float
    error: float
    wi: np.ndarray
    wavelength: float

    def __str__(self):
        theta, phi = np.rad2deg([np.arccos(self.wi[2]), np.arctan2(self.wi[1], self.wi[0])])
        return f"{self.albedo:.5f} ± {self.error:.5f} at {theta:.2f}°, {phi:.0f}°, {1e3 * self.wavelength:.0f} nm"


def worst_albedo(of, table, rng, directions, wavelengths, pairs=1 << 14):
    """The largest at these places: the three largest by few points, again by more where they seem to exceed one."""
    nodes = np.prod(of.grid.shape)
    few = int(2 ** np.clip(np.round(np.log2(pairs / nodes)), 1, 8))
    found = np.array([albedo(of, table, *place, few, rng) for place in zip(directions, wavelengths, strict=True)])
    results = []
    for i in np.argsort(-found.sum(-1))[:3]:
        (mean, error), points = found[i], few
        while mean + 2 * error > 1.001 and error > 2e-4 and points * nodes < 1 << 21:
            points *= 4
            mean, error = albedo(of, table, directions[i], wavelengths[i], points, rng)
        results.append(Worst(mean, error, directions[i], wavelengths[i]))
    return max(results, key=lambda worst: worst.albedo)


def anywhere(rng, count):
    """Directions to 89.9°, half of them beyond 70°, and λ in µm."""
    theta = np.deg2rad(rng.uniform(np.where(rng.random(count) < 0.5, 0, 70), 89.9))
    phi = rng.uniform(0, 2 * np.pi, count)
    omega = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1)
    return omega, rng.uniform(0.36, 0.83, count)


@pytest.mark.few(1)
@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize(
    "seed",
    [
        pytest.param(3, id="tile of 4 × 4 pixels, 8 µm deep"),
        pytest.param(103, id="tile of 7 pixels, 1.8 µm deep"),
        pytest.param(2025, id="grating of 64 pixels, 8 µm deep"),
        pytest.param(5382, id="grating of 18 pixels, 3 µm deep"),
        pytest.param(5489, id="crossed grating of 13 × 11 orders, 3.5 µm deep"),
        pytest.param(5150, id="23 × 25 nodes with wide lobes"),
        pytest.param(5216, id="tile of 7 × 4 pixels, 0.6 µm deep"),
        pytest.param(5221, id="grating of 4 pixels, 6.4 µm deep"),
        pytest.param(5448, id="grating of 14 pixels, 1.7 µm deep, with wide lobes"),
        *SEEDS,
    ],
)
def test_no_albedo_above_one(seed):
    of, rng = spectrum_of(seed)
    found = worst_albedo(of, of.energy_table(), rng, *anywhere(rng, 48))
    assert found.albedo - 2 * found.error <= MOST, str(found)


@pytest.mark.few(1)
@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize("seed", [5002, 5012, 5382, 103])
def test_the_furnace_is_the_sum_over_the_nodes(seed):
    of, rng = spectrum_of(seed)
    omega, wavelengths = anywhere(rng, 8)
    got = Furnace.of(of).albedo(omega, wavelengths)[0]
    wanted = np.array([albedo(of, None, *pair, 64, rng) for pair in zip(omega, wavelengths, strict=True)])
    np.testing.assert_array_less(np.abs(got - wanted[:, 0]), 3 * wanted[:, 1] + 0.03 * wanted[:, 0])
