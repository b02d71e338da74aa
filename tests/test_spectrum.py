"""The orders that are kept, the two tables, and the evaluation of S from them."""

import contextlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import mitsuba_diffraction as md
from mitsuba_diffraction.coherence import lobe_reach
from mitsuba_diffraction.expansions.taylor import TaylorSeries
from mitsuba_diffraction.spectrum.orders import OrderGrid
from mitsuba_diffraction.spectrum.series_table import SeriesTable
from mitsuba_diffraction.spectrum.slice_table import SliceTable

LARGEST_KAPPA = 4 * np.pi / 0.36


def ignore(done, total):
    pass


# ---------------------------------------------------------------- orders


@given(
    tile=st.tuples(st.floats(0.05, 100), st.floats(0.05, 100)),
    pixels=st.tuples(st.integers(1, 300), st.integers(1, 300)),
    wavelength=st.floats(0.1, 1.0),
)
def test_the_grid_holds_every_order_that_light_reaches_and_the_pixels_resolve(tile, pixels, wavelength):
    grid = OrderGrid.reachable(tile, pixels, wavelength)
    for size, count, largest in zip(tile, pixels, grid.largest, strict=True):
        m = np.arange(300)
        reached = (m / size <= 2 / wavelength * (1 - 1e-12)) & (m < count / 2)
        assert largest >= m[reached].max()
        assert largest / size <= 2 / wavelength * (1 + 1e-12)
        assert largest < count / 2 or largest == 0
    assert grid.shape == (2 * grid.largest[1] + 1, 2 * grid.largest[0] + 1)


def test_axes_run_from_minus_to_plus_the_largest_order():
    m_x, m_y = OrderGrid((1.0, 1.0), (2, 1)).axes()
    np.testing.assert_array_equal(m_x, [-2, -1, 0, 1, 2])
    np.testing.assert_array_equal(m_y, [-1, 0, 1])


@pytest.mark.parametrize("shape", [(3, 5), (4, 6), (7, 8)])
def test_take_finds_the_waves_of_each_order(shape):
    grid = OrderGrid((1.0, 1.0), ((shape[1] - 1) // 2, (shape[0] - 1) // 2))
    y, x = np.indices(shape)
    for row, m_y in enumerate(grid.axes()[1]):
        for column, m_x in enumerate(grid.axes()[0]):
            wave = np.exp(2j * np.pi * (m_x * x / shape[1] + m_y * y / shape[0]))
            kept = grid.take(np.fft.fft2(wave, norm="forward"))
            assert kept[row, column] == pytest.approx(1)
            assert np.abs(kept).sum() == pytest.approx(1, abs=1e-10)


@pytest.mark.parametrize(
    "arguments", [((0.0, 1.0), (1, 1)), ((1.0, np.nan), (1, 1)), ((1.0, np.inf), (1, 1)), ((1.0, 1.0), (1, -1))]
)
def test_grids_that_cannot_be_are_refused(arguments):
    with pytest.raises(ValueError, match=r"tile_size|largest order"):
        OrderGrid(*arguments)


@given(share=st.floats(1e-7, 0.5))
def test_the_share_that_lobe_reach_names_is_the_one_that_the_cut_moves(share):
    # In polar coordinates: outside of ρ there is e^{−ρ²/2}; cut off, and added again by scaling what is inside.
    rho = lobe_reach(share)
    radius = np.linspace(rho, rho + 12, 20001)
    outside = np.trapezoid(radius * np.exp(-(radius**2) / 2), radius)
    assert 2 * outside <= share * (1 + 1e-6)
    assert 2 * outside >= 0.2 * share


# ---------------------------------------------------------------- tables


def random_surface(depth, shape=(5, 7)):
    return md.HeightField(np.random.default_rng(3).random(shape) * depth, 0.08)


def every_order(field):
    rows, columns = field.shape
    return OrderGrid(field.tile_size, ((columns - 1) // 2, (rows - 1) // 2))


def build(kind, field):
    grid = every_order(field)
    if kind == "taylor":
        return SeriesTable.build(TaylorSeries.for_tolerance(field.half_range, LARGEST_KAPPA, 1e-5), field, grid, ignore)
    return SliceTable.build(40, LARGEST_KAPPA, field, grid, ignore)


@pytest.mark.parametrize("kind", ["taylor", "slices"])
def test_tables_hold_the_powers_of_the_orders_where_they_belong(kind):
    # An asymmetric surface: rows, columns and signs cannot be exchanged unseen.
    field = random_surface(0.2)
    table = build(kind, field)
    m_x, m_y = every_order(field).axes()
    for kappa in (0.0, 1.0, 20.0, LARGEST_KAPPA):
        phase = np.exp(1j * kappa * field.heights)
        wave_y = np.exp(-2j * np.pi * np.outer(m_y, np.arange(5)) / 5)
        wave_x = np.exp(-2j * np.pi * np.outer(np.arange(7), m_x) / 7)
        eta = np.abs(wave_y @ phase @ wave_x / 35) ** 2
        got = table.powers(kappa)
        assert got.dtype == np.float32
        np.testing.assert_allclose(got, eta, atol=2e-6)
        row, column = np.indices(eta.shape)
        one_by_one = table.powers_at(row, column, np.full(eta.shape, kappa))
        np.testing.assert_allclose(one_by_one, got, atol=1e-6)


@pytest.mark.parametrize("kind", ["taylor", "slices"])
def test_tables_cannot_be_written(kind):
    table = build(kind, random_surface(0.1))
    numbers = table.coefficients if kind == "taylor" else table.values
    with pytest.raises(ValueError, match="read-only"):
        numbers[...] = 0
    assert table.nbytes == numbers.nbytes
    assert table.shape == (5, 7)


def test_slices_are_exact_at_their_nodes_and_cubic_between():
    # η = κ³ on one interval is its own interpolation.
    nodes = LARGEST_KAPPA * (0.5 - 0.5 * np.cos(np.pi * (np.arange(4) + 0.5) / 4))
    powers = ((nodes / LARGEST_KAPPA) ** 3).astype(np.float32).reshape(1, 4, 1, 1)
    table = SliceTable(LARGEST_KAPPA, powers)
    for share in (0.0, 0.1, 0.5, 1.0):
        assert table.powers(share * LARGEST_KAPPA)[0, 0] == pytest.approx(share**3, abs=1e-6)
    np.testing.assert_allclose(table.polynomials(), [[[[0, 0, 0, 1]]]], atol=1e-5)


def test_slices_are_never_negative():
    table = build("slices", random_surface(5.0))
    lowest = min(table.powers(kappa).min() for kappa in np.linspace(0, LARGEST_KAPPA, 97))
    assert lowest >= 0


@pytest.mark.parametrize(
    "coefficients",
    [
        np.zeros((3, 2), np.complex64),
        np.zeros((2, 3, 3), np.complex64),
        np.zeros((3, 3, 3)),
        np.full((3, 1, 1), np.nan),
    ],
    ids=["flat", "terms", "type", "nan"],
)
def test_series_tables_check_their_numbers(coefficients):
    with pytest.raises(ValueError, match="coefficients: got"):
        SeriesTable(TaylorSeries(0.1, 3), coefficients)


@pytest.mark.parametrize(
    "powers",
    [
        np.zeros((4, 3, 3), np.float32),
        np.zeros((2, 3, 3, 3), np.float32),
        np.zeros((2, 4, 3, 3)),
        np.full((1, 4, 1, 1), np.inf, np.float32),
    ],
    ids=["flat", "nodes", "type", "infinite"],
)
def test_slice_tables_check_their_numbers(powers):
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
def test_kappa_beyond_the_wavelengths_is_refused(blaze, kappa):
    with pytest.raises(ValueError, match=r"kappa: got .* wavelengths from 360 nm"):
        blaze.evaluate([0.0, 0.0], kappa)
    with pytest.raises(ValueError, match="kappa: got"):
        blaze.powers(kappa)


def test_the_ends_of_the_range_are_inside(blaze):
    lobe = 2 * np.pi * blaze.lobe_width**2
    assert blaze.evaluate([0.0, 0.0], 0.0) * lobe == pytest.approx(1, abs=1e-4)
    wanted = np.sinc(1 - LARGEST_KAPPA * 0.25 / (2 * np.pi)) ** 2
    assert blaze.evaluate([1 / 2.5, 0.0], blaze.largest_kappa) * lobe == pytest.approx(wanted, abs=2e-4)


def test_nothing_lies_far_from_the_orders(blaze):
    np.testing.assert_array_equal(blaze.evaluate([[1e6, 0.0], [0.0, -1e6], [0.2, 0.0]], 20.0), 0)


@pytest.mark.parametrize("coherence_length", [0.3, 1.0, 2.0, 5.0, 9.0])
@pytest.mark.parametrize("representation", ["taylor", "slices"])
def test_lobes_wider_than_the_grid_of_orders_keep_all_orders(coherence_length, representation):
    # Regression: where lobes reached beyond the last order, the count of neighbours began outside of the grid and
    # missed the orders on the other side; a grating of one row, whose only order along y is zero, gave S = 0.
    field = md.gratings.blazed(period=2.5, depth=0.25, samples=64)
    spectrum = md.precompute(field, coherence_length=coherence_length, representation=representation)
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
