"""The albedo of a perfect mirror with random surfaces, by a sum over the nodes of the stored spectrum."""

import functools
from dataclasses import dataclass

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.stats import qmc

import mitsuba_diffraction as md
from mitsuba_diffraction.geometry import k_g
from mitsuba_diffraction.spectrum.furnace import ALLOWED, Furnace, random_places
from mitsuba_diffraction.spectrum.spline_grid import SplineGrid, spline_integral

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
def spectrum_of(seed):
    """Of a random surface; skips the test if it is refused."""
    heights, request, rng = random_surface(seed)
    try:
        return md.precompute(heights, tolerance=1e-2, **request), rng
    except ValueError as refusal:
        pytest.skip(str(refusal))


def albedo(of, table, wi, wavelength, points, rng):
    """∫ K G S min(e(ω_i), e(ω_o)) dq and its standard error; λ in µm.

    The sum over all nodes, each with `points` in its lobe, four times: drawn from the lobe or, if it reaches near the
    horizon, even in the azimuth of ω_o and in log(cos θ_i + cos θ_o).
    """
    q_x, q_y = (q.ravel() for q in np.meshgrid(*of.grid.frequencies()))
    row, column = (i.ravel() for i in np.indices(of.grid.shape))
    splines = isinstance(of.grid, SplineGrid)
    radius = wavelength * (1.5 * np.hypot(*of.grid.spacing) if splines else of.reach * of.lobe_width)
    distance = np.hypot(wi[0] + wavelength * q_x, wi[1] + wavelength * q_y)
    lit = distance < 1 + radius
    q_x, q_y, row, column, distance = (a[lit, None] for a in (q_x, q_y, row, column, distance))
    azimuth = np.arctan2(wi[1] + wavelength * q_y, wi[0] + wavelength * q_x)
    opening = np.where(distance > radius, np.arcsin(np.minimum(radius / np.maximum(distance, 1e-12), 1)), np.pi)
    low = wi[2] + np.sqrt(1 - np.minimum(distance + radius, 1) ** 2)
    ratio = np.log((wi[2] + np.sqrt(1 - np.maximum(distance - radius, 0) ** 2)) / low)
    near = distance + radius > 0.9
    results = []
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
            cut = -np.expm1(-(of.reach**2) / 2)
            share *= np.exp(-square / 2) / (2 * np.pi * of.lobe_width**2 * cut) * (square < of.reach**2)
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
        kappa = np.minimum(2 * np.pi * w / wavelength, of.largest_kappa)
        s = of.table.powers_at(row[node, 0], column[node, 0], kappa).astype(np.float64)
        e = np.minimum(table.at(wi[None], wavelength), table.at(out, wavelength))
        factor = k_g(wi[2], cos_o, (u**2 + v**2 + w**2) / 2, table.shadowing == "v_cavity")
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
        pytest.param(3, id="tile of 4 × 4 pixels, 8 µm deep"),  # 1.078 where e came from the gathered spectrum alone
        pytest.param(103, id="tile of 7 pixels, 1.8 µm deep"),
        pytest.param(2025, id="grating of 64 pixels, 8 µm deep"),
        # 1.046 where one set of places that found nothing ended the search.
        pytest.param(5382, id="grating of 18 pixels, 3 µm deep"),
        # 1.021 where the search did not go on about the largest albedos found.
        pytest.param(5031, id="grating of 36 pixels, 3 µm deep"),
        # 1.008 where no places were looked at where an order emerges.
        pytest.param(5216, id="tile of 7 × 4 pixels, 0.6 µm deep"),
        *(seed for seed in SEEDS if seed != 5031),
    ],
)
def test_no_albedo_above_one(seed):
    of, rng = spectrum_of(seed)
    found = worst_albedo(of, of.energy_table(), rng, *anywhere(rng, 48))
    assert found.albedo - 2 * found.error <= MOST, str(found)


def rough(shape, pixel, depth):
    h = np.random.default_rng(1).random(shape)
    return md.HeightField((h - h.min()) / np.ptp(h) * depth, pixel)


def scan(side, pixel, coherence_length=65.0):
    count = round(side / pixel)
    return md.precompute(
        rough((count, count), pixel, 1.0), extent="sample", coherence_length=coherence_length, tolerance=1e-2
    )


# What made the spectrum, the kind of shadowing and angles of incidence.
HARD = {
    "blazed": (lambda: md.precompute(md.gratings.blazed(2.5, 0.25)), "none", (85, 87, 89, 89.9)),
    "scan of 0.6 µm": (lambda: scan(0.6, 0.05, 0.28), "v_cavity", (85, 89)),
    "scan of 1.2 µm": (lambda: scan(1.2, 0.1, 0.4), "v_cavity", (87, 89.5)),
    "scan of 4.8 µm": (lambda: scan(4.8, 0.1), "v_cavity", (70, 75, 80, 85, 89)),
    "scan of 9.6 µm": (lambda: scan(9.6, 0.1), "v_cavity", (70, 75, 80, 85, 89)),
    "tile of 56 × 108": (lambda: md.precompute(rough((56, 108), 0.276, 6.3), tolerance=1e-2), "v_cavity", (10, 50, 85)),
    "crossed": (lambda: md.precompute(md.gratings.crossed(2.0, 0.1, samples=32)), "none", (85, 87, 89, 89.9)),
    "scan of 4.8 µm, no shadowing": (lambda: scan(4.8, 0.1), "none", (70, 85, 87, 89, 89.9)),
}


@pytest.mark.few(1)
@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize("name", HARD)
def test_the_reported_excess_holds(name):
    make, shadowing, angles = HARD[name]
    of, rng = make(), np.random.default_rng(7)
    table = of.energy_table(shadowing)
    assert table.excess <= ALLOWED
    theta, phi = np.deg2rad(np.repeat(angles, 12)), rng.uniform(0, 2 * np.pi, 12 * len(angles))
    omega = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1)
    found = worst_albedo(of, table, rng, omega, rng.uniform(0.36, 0.83, len(theta)))
    assert found.albedo - 2 * found.error <= 1 + max(table.excess, ALLOWED), str(found)


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_the_albedo_that_the_table_was_lowered_by():
    of, rng = spectrum_of(103)
    table = of.energy_table()
    omega, wavelengths = random_places(rng, 8, of.wavelengths)
    got = Furnace(of).albedo(omega, wavelengths, table, 4096, rng)[0]
    wanted = [albedo(of, table, *pair, 256, rng)[0] for pair in zip(omega, wavelengths, strict=True)]
    np.testing.assert_allclose(got, wanted, rtol=5e-3)
