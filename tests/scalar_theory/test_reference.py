"""The reference against the definition of S itself, sums written out here, and the transforms of finufft and NumPy."""

import contextlib
import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import erfc, jv

from mitsuba_diffraction import HeightField, gratings
from mitsuba_diffraction.scalar_theory.reference import amplitudes, order_powers, power_spectrum
from mitsuba_diffraction.settings import lobe_width
from mitsuba_diffraction.spectrum.sample import window_axes

finufft = pytest.importorskip("finufft", reason="has no wheel for this system")

shapes = st.sampled_from([(1, 1), (1, 2), (2, 1), (1, 7), (6, 1), (2, 2), (3, 3), (4, 6), (5, 4), (7, 7), (8, 3)])
kappas = st.floats(0, 4 * np.pi / 0.36)


def integer_orders(count):
    """The orders of a transform over `count` samples, −count/2 … below count/2."""
    return np.arange(count) - count // 2


def direct_powers(heights, kappa):
    """|1/N Σ e^{iκh} e^{−2πi m n/N}|² by the sum, rows m_y and columns m_x as `integer_orders`."""
    rows, columns = heights.shape
    wave_y = np.exp(-2j * np.pi * np.outer(integer_orders(rows), np.arange(rows)) / rows)
    wave_x = np.exp(-2j * np.pi * np.outer(np.arange(columns), integer_orders(columns)) / columns)
    return np.abs(wave_y @ np.exp(1j * kappa * heights) @ wave_x / heights.size) ** 2


def direct_spectrum(field, q, kappa, sigma):
    """Σ_m η_m N(q − m/T; σ²), one order after the other; the Nyquist order half on each side."""
    eta = direct_powers(field.heights, kappa)
    total = 0.0
    for row, m_y in enumerate(integer_orders(field.shape[0])):
        for column, m_x in enumerate(integer_orders(field.shape[1])):
            sides_x, sides_y = (
                {m, -m} if 2 * abs(m) == n else {m} for m, n in zip((m_x, m_y), field.shape[::-1], strict=True)
            )
            for x, y in itertools.product(sides_x, sides_y):
                d_x, d_y = q[0] - x / field.tile_size[0], q[1] - y / field.tile_size[1]
                lobe = np.exp(-(d_x**2 + d_y**2) / (2 * sigma**2)) / (2 * np.pi * sigma**2)
                total += eta[row, column] / (len(sides_x) * len(sides_y)) * lobe
    return total


def sigma_of(coherence_length):
    """1/(2√2 π σ_s), σ_s = L_c/4."""
    return 1 / (2 * np.sqrt(2) * np.pi * coherence_length / 4)


# ---------------------------------------------------------------- order powers


@given(shape=shapes, depth=st.sampled_from([0, 0.1, 1, 5]), kappa=kappas, seed=st.integers(0, 2**32 - 1))
def test_order_powers_are_the_direct_sum_and_add_up_to_one(shape, depth, kappa, seed):
    heights = np.random.default_rng(seed).random(shape) * depth
    eta = order_powers(HeightField(heights, 0.1), kappa)
    np.testing.assert_allclose(np.fft.fftshift(eta), direct_powers(heights, kappa), atol=1e-13)
    assert eta.sum() == pytest.approx(1, abs=1e-12)


@given(kappa=kappas, offset=st.floats(-100, 100))
def test_a_common_offset_of_the_heights_changes_nothing(kappa, offset):
    heights = np.random.default_rng(1).random((3, 5))
    shifted = order_powers(HeightField(heights + offset, 0.1), kappa)
    np.testing.assert_allclose(shifted, order_powers(HeightField(heights, 0.1), kappa), atol=1e-11)


@given(kappa=kappas, depth=st.floats(0, 5))
def test_one_spike_on_a_flat_surface_has_the_orders_of_the_closed_form(kappa, depth):
    # 1 − (1 − e^{iκd})/N in order zero, |1 − e^{iκd}|²/N² in every other one.
    heights = np.zeros((3, 5))
    heights[1, 2] = depth
    eta = order_powers(HeightField(heights, 0.1), kappa)
    step = 1 - np.exp(1j * kappa * depth)
    wanted = np.full((3, 5), abs(step / 15) ** 2)
    wanted[0, 0] = abs(1 - step / 15) ** 2
    np.testing.assert_allclose(eta, wanted, atol=1e-13)


def test_amplitudes_carry_the_phase_of_the_sign_convention():
    # A ramp that rises along +x by one wave of the phase puts everything into order +1, e^{+2πi x/T}.
    x = np.arange(8) / 8
    field = HeightField(x[None], 0.1)
    assert np.abs(amplitudes(field, 2 * np.pi)[0, 1]) == pytest.approx(1)


# ---------------------------------------------------------------- S(q; κ)


@given(
    shape=shapes,
    pixel=st.sampled_from([(0.1, 0.1), (0.05, 0.3), (2.0, 0.07)]),
    kappa=kappas,
    coherence_length=st.sampled_from([0.2, 1.0, 5.0, 65.0]),
    seed=st.integers(0, 2**32 - 1),
)
def test_the_spectrum_is_the_sum_of_the_lobes(shape, pixel, kappa, coherence_length, seed):
    rng = np.random.default_rng(seed)
    field = HeightField(rng.random(shape), pixel)
    sigma = sigma_of(coherence_length)
    # At random q, and near orders, where narrow lobes are.
    near = (rng.integers(-2, 3, (4, 2)) / field.tile_size) + rng.normal(0, sigma, (4, 2))
    q = np.concatenate([rng.uniform(-6, 6, (3, 2)), near, [[0, 0]]])
    wanted = [direct_spectrum(field, one, kappa, sigma) for one in q]
    got = power_spectrum(field, q, kappa, coherence_length=coherence_length)
    np.testing.assert_allclose(got, wanted, rtol=1e-9, atol=1e-12 / sigma**2)


def test_one_q_and_one_kappa_give_one_number():
    field = HeightField([[0.0, 0.1, 0.3]], 0.2)
    got = power_spectrum(field, [0.1, 0.0], 10.0)
    assert np.shape(got) == ()
    assert got == pytest.approx(direct_spectrum(field, [0.1, 0.0], 10.0, sigma_of(65)), rel=1e-9)


def test_q_and_kappa_broadcast():
    field = HeightField([[0.0, 0.1, 0.3]], 0.2)
    q, kappa = np.zeros((4, 1, 2)) + np.linspace(0, 5, 4)[:, None, None], np.array([5.0, 20.0, 5.0])
    got = power_spectrum(field, q, kappa, coherence_length=1.0)
    assert got.shape == (4, 3)
    np.testing.assert_allclose(got[2, 1], power_spectrum(field, q[2], kappa[1:2], coherence_length=1.0)[0])


def windowed_powers(heights, kappa, period, coherence_length, q):
    """|∫ a(x−x₀) e^{iκh} e^{−2πiqx} dx|² / ∫a² for x₀ at even steps over one period: (x₀, q).

    The integrands are smooth and vanish at the ends: the trapezoidal rule is exact to rounding.
    """
    sigma_s = coherence_length / 4
    x = np.arange(-9 * sigma_s, 9 * sigma_s, 0.01)
    window = np.exp(-(x**2) / (2 * sigma_s**2))
    shifts = np.arange(64) / 64 * period
    phase = np.exp(1j * kappa * heights(x + shifts[:, None]))
    return np.abs((window * phase) @ np.exp(-2j * np.pi * np.outer(x, q)) * 0.01) ** 2 / (window**2).sum() / 0.01


@pytest.mark.parametrize("coherence_length", [1.5, 2.5, 6.0])
@pytest.mark.parametrize("kappa", [3.0, 17.3, 34.9])
def test_the_spectrum_is_its_definition(kappa, coherence_length):
    period, depth = 2.5, 0.3

    def heights(x):
        return depth / 2 * np.cos(2 * np.pi * x / period)

    q = np.linspace(-3, 3, 41)
    across = np.linspace(-0.1, 0.1, 5)
    # Both axes by the definition; along y the surface is flat.
    along_x = windowed_powers(heights, kappa, period, coherence_length, q)
    along_y = windowed_powers(np.zeros_like, kappa, period, coherence_length, across).mean(axis=0)
    wanted = along_x.mean(axis=0)[:, None] * along_y
    samples = np.arange(128) / 128 * period
    field = HeightField(heights(samples)[None], (period / 128, period))
    grid = np.stack(np.meshgrid(q, across, indexing="ij"), axis=-1)
    got = power_spectrum(field, grid, np.full(grid.shape[:2], kappa), coherence_length=coherence_length)
    np.testing.assert_allclose(got, wanted, rtol=1e-9, atol=1e-10 * wanted.max())
    if coherence_length < 2 and kappa > 10:
        # At a single position the orders interfere; the cross terms vanish on average.
        assert np.abs(along_x[0] - along_x.mean(axis=0)).max() > 0.05 * along_x.max()


@pytest.mark.parametrize("coherence_length", [0.3, 65.0, 1000.0])
def test_lobe_width_is_that_of_the_window(coherence_length):
    # Standard deviation over q of the power of the window's transform, by sums.
    sigma_s = coherence_length / 4
    x = np.linspace(-8, 8, 801) * sigma_s
    q = np.linspace(-1.5, 1.5, 601) / sigma_s
    power = np.abs(np.exp(-2j * np.pi * np.outer(q, x)) @ np.exp(-(x**2) / (2 * sigma_s**2))) ** 2
    assert lobe_width(coherence_length) == pytest.approx(np.sqrt((power * q**2).sum() / power.sum()), rel=1e-9)
    assert lobe_width(coherence_length) == pytest.approx(sigma_of(coherence_length), rel=1e-12)


def test_sunlight_gives_lobes_of_a_fifth_of_a_degree():
    assert lobe_width(65.0) == pytest.approx(0.0069, abs=5e-5)


@pytest.mark.few(4)
@pytest.mark.parametrize("shape", [(1, 1), (5, 4), (1, 6), (7, 1)])
@pytest.mark.parametrize("kappa", [0.0, 12.0, 34.9])
def test_the_spectrum_integrates_to_one(shape, kappa):
    field = HeightField(np.random.default_rng(2).random(shape) * 0.5, (0.4, 0.3))
    step = 0.4 * sigma_of(1.0)  # the trapezoidal rule on Gaussians: exact to 1e-13
    axes = [np.arange(-1 / (2 * p) - 6, 1 / (2 * p) + 6, step) for p in field.pixel_size]
    q = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    total = power_spectrum(field, q, np.full(q.shape[:2], kappa), coherence_length=1.0).sum() * step**2
    assert total == pytest.approx(1, abs=1e-9)


@pytest.mark.parametrize("kappa", [0.0, 4.0, 34.9])
def test_a_sinusoid_has_bessel_lobes(kappa):
    field = gratings.sinusoidal(period=2.5, depth=0.2)
    m = np.arange(-10, 11)
    q = np.stack([m / 2.5, np.zeros(21)], axis=-1)
    wanted = jv(m, kappa * 0.1) ** 2 / (2 * np.pi * sigma_of(65) ** 2)
    np.testing.assert_allclose(power_spectrum(field, q, np.full(21, kappa)), wanted, rtol=1e-9, atol=1e-9)


# ---------------------------------------------------------------- a sample


def transform(pieces, pixel, q):
    """Σ_n f_n e^{−2πi q·x_n} by finufft, for pieces (..., rows, columns) and q (M, 2): (..., M)."""
    rows, columns = pieces.shape[-2:]
    y, x = np.meshgrid(np.arange(rows) * pixel[1], np.arange(columns) * pixel[0], indexing="ij")
    flat = np.ascontiguousarray(pieces.reshape(-1, rows * columns), np.complex128)
    s, t = (np.ascontiguousarray(2 * np.pi * component) for component in q.T)
    result = finufft.nufft2d3(x.ravel(), y.ravel(), flat, s, t, isign=-1, eps=1e-13, nthreads=1)
    return result.reshape(*pieces.shape[:-2], len(q))


def gauss(x, sigma):
    return np.exp(-(x**2) / (2 * sigma**2)) / (np.sqrt(2 * np.pi) * sigma)


def averaged_periodogram(field, q, kappa, coherence_length):
    """Welch's estimate from windowed pieces, which stand where `window_axes` says: it has tests of its own."""
    starts, windows = [], []
    for count, pixel, axis in zip(
        field.shape[::-1], field.pixel_size, window_axes(field, coherence_length), strict=True
    ):
        if count == 1:
            starts.append([0])
            windows.append(np.ones(1))
            continue
        width = int(np.ceil(1.5 * coherence_length / pixel - 1e-6))
        assert axis.starts[-1] + width == count
        x = (np.arange(width) - (width - 1) / 2) * pixel
        starts.append(axis.starts)
        windows.append(np.exp(-(x**2) / (2 * (coherence_length / 4) ** 2)))
    window = np.outer(windows[1], windows[0])
    phase = np.exp(1j * kappa * field.heights)
    pieces = [
        window * phase[row : row + window.shape[0], column : column + window.shape[1]]
        for row in starts[1]
        for column in starts[0]
    ]
    power = (np.abs(transform(np.array(pieces), field.pixel_size, q)) ** 2).mean(axis=0) / (window**2).sum()
    for component, count, pixel in zip(q.T, field.shape[::-1], field.pixel_size, strict=True):
        power *= pixel if count > 1 else gauss(component, sigma_of(coherence_length))
    return power


def nyquist_grid(field, points):
    """Whole periods of q, so that the trapezoidal rule is exact for a surface of pixels: (points, points, 2), ∫dq."""
    axes = [((np.arange(points) + 0.5) / points - 0.5) / pixel for pixel in field.pixel_size]
    q = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    return q, 1 / (points**2 * np.prod(field.pixel_size))


@pytest.mark.parametrize(
    ("shape", "pixel", "coherence_length"),
    [
        ((24, 24), (0.1, 0.1), 1.2),  # even; as wide as the scan allows
        ((25, 31), (0.1, 0.1), 0.9),  # odd, not square
        ((17, 40), (0.11, 0.2), 0.93),  # pixels that are not square
        ((1, 50), (0.1, 0.7), 1.7),  # one row
        ((33, 1), (0.4, 0.05), 0.6),  # one column
        ((8, 8), (0.1, 0.1), 0.4),  # the smallest there is
    ],
)
@pytest.mark.parametrize("kappa", [0.0, 13.7, 34.9])
def test_a_sample_is_an_averaged_periodogram(shape, pixel, coherence_length, kappa):
    rng = np.random.default_rng(7)
    field = HeightField(rng.random(shape) * 0.4, pixel)
    q = rng.uniform(-0.5, 0.5, (60, 2)) / pixel
    for axis in (0, 1):
        if shape[::-1][axis] == 1:
            q[:, axis] = rng.normal(0, 2 * sigma_of(coherence_length), len(q))
    q[0] = 0
    got = power_spectrum(field, q, np.full(60, kappa), extent="sample", coherence_length=coherence_length)
    wanted = averaged_periodogram(field, q, kappa, coherence_length)
    assert wanted.max() > 0
    np.testing.assert_allclose(got, wanted, rtol=1e-9, atol=1e-11 * wanted.max())


@settings(max_examples=25)
@given(
    shape=st.sampled_from([(8, 10), (9, 12), (13, 10), (11, 15)]),
    pixel=st.sampled_from([(0.1, 0.1), (0.05, 0.06)]),
    depth=st.sampled_from([0, 0.3, 5]),
    kappa=kappas,
    seed=st.integers(0, 2**32 - 1),
)
def test_the_spectrum_of_a_sample_integrates_to_one(shape, pixel, depth, kappa, seed):
    field = HeightField(np.random.default_rng(seed).random(shape) * depth, pixel)
    q, area = nyquist_grid(field, 16)
    total = power_spectrum(field, q, kappa, extent="sample").sum() * area
    assert total == pytest.approx(1, abs=1e-12)


@pytest.mark.parametrize("shape", [(1, 20), (20, 1), (1, 1)])
def test_the_spectrum_of_one_row_or_column_integrates_to_one(shape):
    field = HeightField(np.random.default_rng(3).random(shape), (0.3, 0.2))
    axes = []
    for count, pixel in zip(shape[::-1], field.pixel_size, strict=True):
        # The trapezoidal rule is exact for a periodic function, and to 1e-13 for a Gaussian.
        axes.append(((np.arange(64) + 0.5) / 64 - 0.5) * (1 / pixel if count > 1 else 20 * sigma_of(2.0)))
    q = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    area = np.prod([axis[1] - axis[0] for axis in axes])
    total = power_spectrum(field, q, 9.0, extent="sample", coherence_length=2.0).sum() * area
    assert total == pytest.approx(1, abs=1e-12)


@pytest.mark.parametrize("pixel", [0.02, 0.05])
def test_a_flat_sample_reflects_a_gaussian_lobe(pixel):
    # The window ends at 3σ_s. It lacks t = erfc(3/√2) of its integral and e = erfc(3) of its power, so that along each
    # axis its lobe is off by at most (1 + t)²/(1 − e) − 1 of the peak.
    field = HeightField(np.zeros((60, 60)), pixel)
    coherence_length = 60 * pixel / 2
    sigma = sigma_of(coherence_length)
    off = (1 + erfc(3 / np.sqrt(2))) ** 2 / (1 - erfc(3)) - 1
    assert off < 0.006
    q = np.stack(np.meshgrid(*[np.linspace(-5, 5, 41) * sigma] * 2, indexing="ij"), axis=-1)
    got = power_spectrum(field, q, 20.0, extent="sample", coherence_length=coherence_length)
    wanted = gauss(q[..., 0], sigma) * gauss(q[..., 1], sigma)
    np.testing.assert_allclose(got, wanted, rtol=0, atol=((1 + off) ** 2 - 1) * wanted.max())


@pytest.mark.parametrize("slope", [(0.2, 0.0), (0.0, -0.3), (0.15, 0.1)])
def test_a_slope_shifts_the_lobe(slope):
    # h = s·x turns e^{−2πi q·x} into that of q − κs/2π. Nothing else happens: the scan is not taken to be periodic.
    kappa = 25.0
    y, x = np.mgrid[:40, :50] * 0.1
    q = np.random.default_rng(5).uniform(-2, 2, (200, 2))
    shift = kappa * np.array(slope) / (2 * np.pi)
    ramp = power_spectrum(HeightField(slope[0] * x + slope[1] * y, 0.1), q + shift, kappa, extent="sample")
    flat = power_spectrum(HeightField(np.zeros((40, 50)), 0.1), q, kappa, extent="sample")
    inside = (np.abs(q + shift) <= 5).all(axis=-1)
    assert inside.all()
    np.testing.assert_allclose(ramp, flat, rtol=1e-8, atol=1e-12 * flat.max())
    at_shift = power_spectrum(HeightField(slope[0] * x + slope[1] * y, 0.1), shift, kappa, extent="sample")
    assert at_shift > 0.9 * gauss(0, sigma_of(2.0)) ** 2


def test_the_seam_of_a_sample_has_no_effect():
    # A ramp that repeats has a step where it is wrapped around, and a streak of orders along x; a scan of it has not.
    kappa, slope = 25.0, 0.13
    field = HeightField(np.tile(slope * np.arange(64) * 0.1, (64, 1)), 0.1)
    mirror = kappa * slope / (2 * np.pi)
    orders = np.arange(-31, 32) / 6.4
    far = orders[np.abs(orders - mirror) > 6 * sigma_of(3.2)]
    q = np.stack([far, np.zeros_like(far)], axis=-1)
    as_tile, as_sample = (
        power_spectrum(field, q, kappa, extent=extent, coherence_length=3.2) for extent in ("tile", "sample")
    )
    peak = gauss(0, sigma_of(3.2)) ** 2
    # The power of a lobe outside 6σ_q, with a window truncated at 3σ_s: under 1e-5.
    assert as_sample.max() < 1e-5 * peak
    assert as_tile.min() > 1e-4 * peak


@pytest.mark.parametrize("kappa", [0.0, 5.0, 20.0, 34.9])
def test_a_sampled_sinusoid_has_bessel_lobes(kappa):
    # A scan of 12.3 periods of 1 µm, 6 of them in the coherence length; where it begins does not matter.
    x = np.arange(492) * 0.025
    field = HeightField(0.1 * np.sin(2 * np.pi * x + 0.7)[None], (0.025, 1.0))
    sigma = sigma_of(6.0)
    offsets = (np.arange(32) + 0.5) / 32 - 0.5  # of the spacing of the lobes, all of it
    m = np.arange(-8, 9)
    q = np.stack(np.broadcast_arrays(m[:, None] + offsets, 0.0), axis=-1)
    got = power_spectrum(field, q, kappa, extent="sample", coherence_length=6.0)
    # The lobe across is divided out, the one along x integrated over. As the window ends at 3σ_s, a share of about 1e-5
    # of a lobe lies nearer to its neighbours, and its peak is off by 0.0055 of itself (as for the flat sample).
    powers = got.sum(axis=1) / 32 / gauss(0, sigma)
    np.testing.assert_allclose(powers, jv(m, kappa * 0.1) ** 2, atol=2e-5)
    np.testing.assert_allclose(
        power_spectrum(field, np.stack([m, 0 * m], axis=-1), kappa, extent="sample", coherence_length=6.0),
        jv(m, kappa * 0.1) ** 2 * gauss(0, sigma) ** 2,
        atol=0.006 * gauss(0, sigma) ** 2,
    )


def test_white_noise_has_a_white_spectrum():
    # Phases of all sizes alike, independent from pixel to pixel: the expectation is d_x d_y at every q. Periodograms of
    # positions δ apart correlate as |∫ a(x) a(x − δ)|²/(∫ a²)² = exp(−δ²/2σ_s²); three positions σ_s apart along each
    # axis leave fluctuations of (3 + 4 exp(−1/2) + 2 exp(−2))/9 = 0.633 of the expectation, where one position has 1.
    rng = np.random.default_rng(11)
    q = rng.uniform(-0.5, 0.5, (40, 2)) / (0.1, 0.2)
    scans = [HeightField(rng.random((24, 48)) * 2 * np.pi, (0.1, 0.2)) for _ in range(300)]
    spectra = np.array([power_spectrum(scan, q, 1.0, extent="sample") for scan in scans]) / (0.1 * 0.2)
    np.testing.assert_allclose(spectra.mean(axis=0), 1, atol=5 * 0.633 / np.sqrt(300))
    assert spectra.mean() == pytest.approx(1, abs=0.02)
    assert spectra.std() == pytest.approx(0.633, rel=0.1)


def test_a_scan_supports_a_coherence_length_of_half_its_size():
    field = HeightField(np.random.default_rng(6).random((30, 50)) * 0.3, 0.1)
    q = np.random.default_rng(7).uniform(-2, 2, (20, 2))
    q[0] = 0
    carried = power_spectrum(field, q, 15.0, extent="sample", coherence_length=1.5)
    np.testing.assert_array_equal(power_spectrum(field, q, 15.0, extent="sample", coherence_length=65.0), carried)
    less = power_spectrum(field, q, 15.0, extent="sample", coherence_length=1.4)
    assert np.abs(less - carried).max() > 0.01 * carried.max()


def test_a_uniform_axis_has_the_lobe_of_the_other_axis():
    # Along y 65 µm would be had for the asking, but both axes are seen through one window.
    field = HeightField(np.random.default_rng(8).random((1, 60)), (0.1, 5.0))
    across = np.array([0.0, 0.1, 0.3, 0.9])  # the last one beyond 1/2d_y, which is no limit here
    q = np.stack([np.full(4, 0.2), across], axis=-1)
    got = power_spectrum(field, q, 15.0, extent="sample")
    np.testing.assert_allclose(got / got[0], gauss(across, sigma_of(3.0)) / gauss(0, sigma_of(3.0)), rtol=1e-12)


def test_the_spectrum_is_zero_outside_the_nyquist_limit():
    field = HeightField(np.random.default_rng(9).random((20, 24)), (0.1, 0.2))
    limit = np.array([5.0, 2.5])
    assert (power_spectrum(field, limit * [[1, 1], [-1, 1], [0.999, -1]], 15.0, extent="sample") > 0).all()
    outside = limit * [[1.001, 0], [0, -1.001], [-2, 0.1], [3, 3]]
    np.testing.assert_array_equal(power_spectrum(field, outside, 15.0, extent="sample"), 0)


def test_rounding_does_not_exclude_the_nyquist_limit():
    limit = np.fft.fftfreq(26, 0.3).min()
    assert limit < -1 / 0.6  # by one unit in the last place
    field = HeightField(np.random.default_rng(9).random((26, 26)), 0.3)
    assert power_spectrum(field, [limit, 0.0], 15.0, extent="sample") > 0


@pytest.mark.parametrize("max_count", [1, 100, 2**20])
def test_the_size_of_chunks_does_not_matter(max_count, monkeypatch):
    field = HeightField(np.random.default_rng(10).random((12, 9)), 0.1)
    q = np.random.default_rng(11).uniform(-5, 5, (5, 3, 2))
    q[1] = q[0]  # the same q again
    kappa = np.array([4.0, 20.0, 4.0])
    wanted = [[power_spectrum(field, q[i, j], kappa[j], extent="sample") for j in range(3)] for i in range(5)]
    monkeypatch.setattr("mitsuba_diffraction.scalar_theory.reference.MAX_CHUNK", max_count)
    np.testing.assert_allclose(power_spectrum(field, q, kappa, extent="sample"), wanted, rtol=1e-10)


@pytest.mark.parametrize("extent", ["tile", "sample"])
def test_an_empty_q_gives_an_empty_result(extent):
    field = HeightField(np.zeros((8, 8)), 0.1)
    assert power_spectrum(field, np.zeros((0, 2)), 1.0, extent=extent).shape == (0,)


# ---------------------------------------------------------------- wrong requests


@pytest.mark.parametrize("kappa", [np.nan, np.inf])
def test_kappa_must_be_finite(kappa):
    field, q = HeightField(np.zeros((8, 8)), 0.1), np.zeros((2, 2))
    for evaluate in (
        lambda: power_spectrum(field, q, [1.0, kappa]),
        lambda: power_spectrum(field, q, [1.0, kappa], extent="sample"),
    ):
        with pytest.raises(ValueError, match="kappa: got numbers that are not finite"):
            evaluate()


def test_a_sample_of_too_few_pixels_is_refused():
    with pytest.raises(ValueError, match="coherence_length: got 65 µm"):
        power_spectrum(HeightField(np.zeros((8, 7)), 0.1), [0.0, 0.0], 1.0, extent="sample")


@pytest.mark.parametrize("q", [(np.nan, 0.0), (0.0, np.nan)])
def test_nan_does_not_become_a_number(q):
    field = HeightField([[0.0, 0.1]], 0.2)
    with contextlib.suppress(ValueError):
        assert np.isnan(power_spectrum(field, [q], [1.0])).all()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"extent": "ribbon"}, "extent: got 'ribbon', wanted one of tile, sample"),
        ({"extent": "sample", "coherence_length": 0.0}, "coherence_length: got"),
        ({"coherence_length": 0.0}, "coherence_length: got"),
        ({"coherence_length": -1.0}, "coherence_length: got"),
        ({"coherence_length": np.nan}, "coherence_length: got"),
        ({"coherence_length": np.inf}, "coherence_length: got"),
        ({"q": np.zeros(3)}, "q: got shape"),
        ({"q": 0.0}, "q: got shape"),
        ({"q": np.zeros((2, 2)), "kappa": np.zeros(3)}, "kappa: got shape"),
    ],
)
def test_wrong_requests_are_refused(arguments, message):
    arguments = {"q": np.zeros((1, 2)), "kappa": np.zeros(1), **arguments}
    with pytest.raises(ValueError, match=message):
        power_spectrum(HeightField([[0.0]], 1.0), **arguments)
