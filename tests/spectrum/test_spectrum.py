"""The orders and nodes that are kept, the tables, and the evaluation of S from them."""

import contextlib
import dataclasses
import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import mitsuba_diffraction as md
from mitsuba_diffraction.settings import lobe_cutoff
from mitsuba_diffraction.spectrum.grids import OrderGrid, SplineGrid, spline_integral
from mitsuba_diffraction.spectrum.tables import SliceTable, halved, packed

LARGEST_KAPPA = 4 * np.pi / 0.36


def ignore(done, total):
    pass


# ---------------------------------------------------------------- orders


@given(
    tile=st.tuples(st.floats(0.05, 100), st.floats(0.05, 100)),
    pixels=st.tuples(st.integers(1, 300), st.integers(1, 300)),
    max_frequency=st.floats(1.0, 20.0),
)
def test_the_grid_holds_every_order_that_light_reaches_and_the_pixels_resolve(tile, pixels, max_frequency):
    grid = OrderGrid.reachable(tile, pixels, max_frequency)
    for size, count, max_order in zip(tile, pixels, grid.max_order, strict=True):
        m = np.arange(300)
        reached = (m / size <= max_frequency * (1 - 1e-12)) & (m <= count / 2)
        assert max_order >= m[reached].max()
        assert max_order / size <= max_frequency * (1 + 1e-12)
        assert max_order <= count / 2
    assert grid.shape == (2 * grid.max_order[1] + 1, 2 * grid.max_order[0] + 1)


def test_axes_run_from_minus_to_plus_the_largest_order():
    m_x, m_y = OrderGrid((1.0, 1.0), (2, 1)).axes()
    np.testing.assert_array_equal(m_x, [-2, -1, 0, 1, 2])
    np.testing.assert_array_equal(m_y, [-1, 0, 1])


@pytest.mark.parametrize("shape", [(3, 5), (4, 6), (7, 8)])
def test_take_selects_the_power_of_each_order(shape):
    grid = OrderGrid((1.0, 1.0), ((shape[1] - 1) // 2, (shape[0] - 1) // 2))
    y, x = np.indices(shape)
    for row, m_y in enumerate(grid.axes()[1]):
        for column, m_x in enumerate(grid.axes()[0]):
            wave = np.exp(2j * np.pi * (m_x * x / shape[1] + m_y * y / shape[0]))
            kept = grid.take(np.fft.fft2(wave, norm="forward"))
            assert kept[row, column] == pytest.approx(1)
            assert np.abs(kept).sum() == pytest.approx(1, abs=1e-10)


def test_the_nyquist_order_is_divided_equally_between_both_signs():
    grid = OrderGrid((1.0, 1.0), (2, 1))
    np.testing.assert_array_equal(grid.take(np.arange(12.0).reshape(3, 4))[1], [1.0, 3.0, 0.0, 1.0, 1.0])
    assert grid.take(np.ones((3, 4))).sum() == 12


@pytest.mark.parametrize(
    "arguments", [((0.0, 1.0), (1, 1)), ((1.0, np.nan), (1, 1)), ((1.0, np.inf), (1, 1)), ((1.0, 1.0), (1, -1))]
)
def test_wrong_grids_are_refused(arguments):
    with pytest.raises(ValueError, match=r"tile_size|max_order"):
        OrderGrid(*arguments)


@given(change=st.floats(1e-7, 0.5))
def test_truncation_at_lobe_cutoff_changes_the_lobe_by_the_given_fraction(change):
    # One axis by the trapezoidal rule; cut off outside of the square, and added again by scaling what is inside.
    rho = lobe_cutoff(change)
    x = np.linspace(-rho, rho, 40001)
    inside = np.trapezoid(np.exp(-(x**2) / 2), x) / np.sqrt(2 * np.pi)
    assert 2 * (1 - inside**2) == pytest.approx(change, rel=1e-3, abs=1e-9)


@pytest.mark.few(2)
@pytest.mark.parametrize("coherence_length", [1.0, 5.0, 20.0, 65.0])
@pytest.mark.parametrize("tolerance", [1e-2, 1e-3])
def test_truncated_lobes_keep_their_power_and_the_tolerance(coherence_length, tolerance):
    spectrum = md.precompute(random_surface(0.1, (40, 50)), coherence_length=coherence_length, tolerance=tolerance)
    grid = OrderGrid(spectrum.pixel_size, (30, 40))  # many orders, whatever the grid of the spectrum is
    grid = OrderGrid((4.0, 3.2), grid.max_order)
    sigma, cutoff = spectrum.lobe_width, spectrum.cutoff_sigmas
    for axis, lobe in enumerate(grid.lobes(sigma, cutoff)):
        q = np.zeros((20001, 2))
        end = min(lobe.half_width, 9 * sigma) * 1.5
        q[:, axis] = np.linspace(-end, end, len(q))
        held = np.zeros(len(q))
        count = np.zeros(len(q), int)
        for row, column, weight in grid.around(q, sigma, cutoff):
            of_mirror = (row == grid.max_order[1]) & (column == grid.max_order[0])
            held += np.where(of_mirror, weight, 0)
            count += weight > 0
        other = grid.lobes(sigma, cutoff)[1 - axis]
        across = 1 / (np.sqrt(2 * np.pi) * sigma * other.inside)
        assert np.trapezoid(held, q[:, axis]) / across == pytest.approx(1, abs=1e-3)
        exact = np.exp(-(q[:, axis] ** 2) / (2 * sigma**2)) / (np.sqrt(2 * np.pi) * sigma)
        assert np.trapezoid(np.abs(held / across - exact), q[:, axis]) <= 0.4 * tolerance + 1e-3 * tolerance + 1e-5


# ---------------------------------------------------------------- splines


def spline(x):
    """Three boxes, convolved: the centred quadratic B-spline."""
    x = np.abs(x)
    return np.where(x <= 0.5, 0.75 - x**2, np.where(x <= 1.5, 0.5 * (1.5 - x) ** 2, 0))


def surface_of(grid, coefficients, q):
    """Σ c_m B B/(Δ_x Δ_y), the sum over all nodes."""
    (d_x, d_y), (f_x, f_y) = grid.spacing, grid.frequencies()
    b_x, b_y = spline((q[..., :1] - f_x) / d_x), spline((q[..., 1:] - f_y) / d_y)
    return np.einsum("...y,yx,...x->...", b_y, coefficients, b_x) / (d_x * d_y)


@given(seed=st.integers(0, 2**32 - 1))
def test_only_three_by_three_nodes_contribute(seed):
    rng = np.random.default_rng(seed)
    grid = SplineGrid((0.3, 0.11), (3, 5), (np.inf, np.inf))
    coefficients = rng.normal(size=grid.shape)
    q = rng.uniform(-1, 1, (40, 2)) * (1.6, 0.9)  # … and outside the grid
    got = sum(weight * coefficients[row, column] for row, column, weight in grid.around(q))
    np.testing.assert_allclose(got, surface_of(grid, coefficients, q), atol=1e-10)


def test_a_sample_is_black_outside_the_nyquist_limit():
    grid = SplineGrid((0.3, 0.11), (4, 6), (0.7, 0.5))
    q = np.array([[0.7, 0.0], [0.70001, 0.0], [0.0, -0.5], [0.0, -0.50001], [-0.7, 0.5], [-0.71, 0.51]])
    total = sum(weight for _, _, weight in grid.around(q))
    np.testing.assert_allclose(total * 0.3 * 0.11, [1, 0, 1, 0, 1, 0], atol=1e-12)


@given(x=st.floats(-3, 3))
def test_the_integral_of_a_spline_is_that_by_quadrature(x):
    fine = np.linspace(-1.5, 1.5, 6001)
    # The rule of the middle is good to the square of the step.
    middles = (fine[1:] + fine[:-1]) / 2
    wanted = spline(middles)[middles <= x].sum() * (fine[1] - fine[0])
    assert spline_integral(np.array(x)) == pytest.approx(wanted, abs=4e-4)
    assert spline_integral(np.array(x)) + spline_integral(np.array(-x)) == pytest.approx(1, abs=1e-12)


@pytest.mark.parametrize(
    "arguments",
    [
        ((0.0, 1.0), (1, 1), (1.0, 1.0)),
        ((1.0, np.nan), (1, 1), (1.0, 1.0)),
        ((1.0, 1.0), (1, -1), (1.0, 1.0)),
        ((1.0, 1.0), (1, 1), (1.0, 0.0)),
        ((1.0, 1.0), (1, 1), (np.nan, 1.0)),
    ],
)
def test_wrong_lattices_are_refused(arguments):
    with pytest.raises(ValueError, match=r"spacing|max_order|limit"):
        SplineGrid(*arguments)


# ---------------------------------------------------------------- tables


def random_surface(depth, shape=(5, 7)):
    return md.HeightField(np.random.default_rng(3).random(shape) * depth, 0.08)


def every_order(field):
    rows, columns = field.shape
    return OrderGrid(field.tile_size, ((columns - 1) // 2, (rows - 1) // 2))


def powers_of(field):
    grid = every_order(field)
    return lambda kappa: grid.take(md.reference.order_powers(field, kappa))


def build(field):
    return SliceTable.build(40, 4, LARGEST_KAPPA, powers_of(field), ignore)


def test_tables_hold_each_order_at_its_node():
    # An asymmetric surface: rows, columns and signs cannot be exchanged unseen.
    field = random_surface(0.2)
    table = build(field)
    m_x, m_y = every_order(field).axes()
    for kappa in (0.0, 1.0, 20.0, LARGEST_KAPPA):
        phase = np.exp(1j * kappa * field.heights)
        wave_y = np.exp(-2j * np.pi * np.outer(m_y, np.arange(5)) / 5)
        wave_x = np.exp(-2j * np.pi * np.outer(np.arange(7), m_x) / 7)
        eta = np.abs(wave_y @ phase @ wave_x / 35) ** 2
        got = table.powers(kappa)
        assert got.dtype == np.float32
        np.testing.assert_allclose(got, eta, atol=4e-6)
        row, column = np.indices(eta.shape)
        one_by_one = table.powers_at(row, column, np.full(eta.shape, kappa))
        np.testing.assert_allclose(one_by_one, got, atol=2e-6)


def test_tables_cannot_be_written():
    table = build(random_surface(0.1))
    with pytest.raises(ValueError, match="read-only"):
        table.values[...] = 0
    assert table.nbytes == table.values.nbytes
    assert table.shape == (5, 7)
    assert table.words_per_node == 4


@pytest.mark.parametrize("terms", [3, 4])
def test_slices_interpolate_polynomials_of_their_degree_exactly(terms):
    def powers(kappa):
        return np.array([[(kappa / LARGEST_KAPPA) ** (terms - 1), 0.5]])

    table = SliceTable.build(3, terms, LARGEST_KAPPA, powers, ignore)
    assert (table.terms, table.intervals, table.shape) == (terms, 3, (1, 2))
    for kappa in LARGEST_KAPPA * np.array([0.0, 0.1, 1 / 3, 0.5, 0.9, 1.0]):
        np.testing.assert_allclose(table.powers(kappa), powers(kappa), atol=1e-6)


@given(seed=st.integers(0, 2**32 - 1), decades=st.integers(0, 12))
def test_rounding_errs_by_at_most_half_a_unit(seed, decades):
    values = np.random.default_rng(seed).normal(size=(2, 3, 4, 5)).astype(np.float32) * np.float32(10.0**-decades)
    values = np.clip(values, -3.9, 3.9)
    values[0, :, 0, 0] = 0
    peak = np.abs(values).max(axis=1, keepdims=True)
    error = np.abs(packed(values) - values)
    # Half a unit; with 255 or less in it, a unit is at most 1/127 of the largest, but no less than 2⁻³⁶.
    assert (error <= np.maximum(peak / 254, 2.0**-37)).all()
    error = np.abs(halved(values) - values)
    assert (error <= np.maximum(np.abs(values) * 2.0**-11, 2.0**-39)).all()
    for rounded in (packed, halved):
        np.testing.assert_array_equal(rounded(rounded(values)), rounded(values))
    # No finite error for numbers that are too large: such a table is not taken.
    values[1, 2, 3, 4] = 5
    assert np.isinf(packed(values)[1, :, 3, 4]).all()


@pytest.mark.parametrize(("terms", "rounded"), [(3, packed), (4, halved)])
def test_slices_are_rounded_except_intervals_with_too_large_values(terms, rounded):
    def powers(kappa):
        return np.array([[0.1 if kappa < LARGEST_KAPPA / 2 else 10.1]])

    table = SliceTable.build(2, terms, LARGEST_KAPPA, powers, ignore, rounded)
    np.testing.assert_array_equal(table.values[:1], rounded(table.values[:1]))
    assert table.powers(0.0) != np.float32(0.1)
    assert table.powers(0.0) == pytest.approx(0.1, rel=4e-3)
    assert table.powers(LARGEST_KAPPA) == np.float32(10.1)
    assert table.words_per_node == 4


def test_numbers_too_large_to_be_rounded_are_not_finite():
    values = np.full((1, 3, 1, 1), 5.0, np.float32)
    assert not np.isfinite(packed(values)).any()
    assert not np.isfinite(halved(values)).any()


@pytest.mark.parametrize("extent", ["tile", "sample"])
def test_no_density_is_negative(extent):
    field = random_surface(0.4, (16, 18))
    spectrum = md.precompute(field, extent=extent, tolerance=0.05, coherence_length=0.5)
    q = np.random.default_rng(0).uniform(-6, 6, (300, 2))
    minima = [spectrum.powers(kappa).min() for kappa in np.linspace(0, LARGEST_KAPPA, 30)]
    assert min(minima) < 0  # within the error
    assert spectrum.evaluate(q, np.linspace(0, LARGEST_KAPPA, 300)).min() >= 0


@pytest.mark.parametrize(
    "powers",
    [
        np.zeros((4, 3, 3), np.float32),
        np.zeros((2, 5, 3, 3), np.float32),
        np.zeros((2, 4, 3, 3)),
        np.full((1, 4, 1, 1), np.inf, np.float32),
    ],
    ids=["flat", "nodes", "type", "infinite"],
)
def test_invalid_slice_tables_are_refused(powers):
    with pytest.raises(ValueError, match="values: got"):
        SliceTable(1.0, powers)


# ---------------------------------------------------------------- evaluation


@pytest.fixture(scope="module")
def blaze():
    return md.precompute(md.gratings.blazed(period=2.5, depth=0.25), tolerance=1e-4)


def test_q_and_kappa_broadcast(blaze):
    q = np.stack([np.arange(-3, 4) / 2.5, np.zeros(7)], axis=-1)
    kappa = np.array([0.0, 10.0, 30.0])[:, None]
    got = blaze.evaluate(q, kappa)
    assert got.shape == (3, 7)
    assert np.shape(blaze.evaluate(q[5], 30.0)) == ()
    assert blaze.evaluate(q[5], 30.0) == pytest.approx(got[2, 5], rel=1e-12)


@pytest.mark.parametrize("q", [0.0, [0.0], np.zeros((2, 3))])
def test_a_q_that_is_no_pair_is_refused(blaze, q):
    with pytest.raises(ValueError, match="q: got shape"):
        blaze.evaluate(q, 1.0)


@pytest.mark.parametrize("kappa", [-1e-9, 35.0, np.inf, np.nan])
def test_kappa_outside_the_range_is_refused(blaze, kappa):
    with pytest.raises(ValueError, match=r"kappa: got .* wavelengths from 360 nm"):
        blaze.evaluate([0.0, 0.0], kappa)
    with pytest.raises(ValueError, match="kappa: got"):
        blaze.powers(kappa)


def test_the_ends_of_the_range_are_accepted(blaze):
    lobe = 2 * np.pi * blaze.lobe_width**2
    assert blaze.evaluate([0.0, 0.0], 0.0) * lobe == pytest.approx(1, abs=1e-4)
    wanted = np.sinc(1 - LARGEST_KAPPA * 0.25 / (2 * np.pi)) ** 2
    assert blaze.evaluate([1 / 2.5, 0.0], blaze.max_kappa) * lobe == pytest.approx(wanted, abs=2e-4)


def test_the_spectrum_is_zero_far_from_the_orders(blaze):
    np.testing.assert_array_equal(blaze.evaluate([[1e6, 0.0], [0.0, -1e6], [0.2, 0.0]], 20.0), 0)


@pytest.mark.few(3)
@pytest.mark.parametrize("coherence_length", [0.3, 1.0, 2.0, 5.0, 9.0])
def test_lobes_wider_than_the_grid_of_orders_keep_all_orders(coherence_length):
    # Regression: where lobes extended past the last order, the count of neighbours began outside of the grid and
    # missed the orders on the other side; a grating of one row, whose only order along y is zero, gave S = 0.
    field = md.gratings.blazed(period=2.5, depth=0.25, samples=64)
    spectrum = md.precompute(field, coherence_length=coherence_length, tolerance=1e-3)
    sigma = 1 / (2 * np.sqrt(2) * np.pi * coherence_length / 4)
    q = np.stack(np.meshgrid(np.linspace(-4, 4, 9), [-0.7 * sigma, 0, 0.3 * sigma], indexing="ij"), axis=-1)
    m = np.arange(-32, 32)
    eta = np.abs(np.exp(-2j * np.pi * np.outer(m, np.arange(64)) / 64) @ np.exp(20j * field.heights[0]) / 64) ** 2
    distance = (q[..., None, 0] - m / 2.5) ** 2 + q[..., None, 1] ** 2
    wanted = (eta * np.exp(-distance / (2 * sigma**2))).sum(axis=-1) / (2 * np.pi * sigma**2)
    np.testing.assert_allclose(spectrum.evaluate(q, 20.0), wanted, atol=2e-3 / (2 * np.pi * sigma**2))


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_frequencies_that_are_not_finite_do_not_become_numbers(blaze, bad):
    # An error, or a value that says so; no warning from inside.
    with contextlib.suppress(ValueError):
        assert np.isnan(blaze.evaluate([[bad, 0.0]], 1.0)).all() or np.isinf(bad)


@pytest.mark.parametrize(
    "wavelengths",
    [(360.0,), (830.0, 360.0), (400.0, 400.0), (0.36, 0.83), (np.nan, 830.0), (360.0, np.inf), 500.0, "ab"],
)
def test_wavelengths_that_are_no_range_are_refused(wavelengths):
    with pytest.raises(ValueError, match="wavelengths: got"):
        md.precompute(md.HeightField([[0.0]], 0.05), wavelengths=wavelengths)


def test_spectra_of_equal_tables_and_other_settings_have_other_digests():
    """BSDFs of equal digests have tables and samplers in common; separate orders have equal tables for all lobes."""
    heights = md.gratings.blazed(2.5, 0.25)

    def built(heights, coherence_length, tolerance):
        return md.precompute(heights, coherence_length=coherence_length, tolerance=tolerance)

    spectra = [built(heights, *row) for row in itertools.product((60.0, 90.0), (1e-2, 5e-3))]
    tables = {spectrum.table.values.tobytes() for spectrum in spectra}
    assert len(tables) < len(spectra) == len({spectrum.digest for spectrum in spectra})
    renamed = built(dataclasses.replace(heights, source="of another name"), 60.0, 1e-2)
    assert renamed.digest == spectra[0].digest
