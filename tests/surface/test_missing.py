"""Filling of missing pixels: harmonic between the known ones, which it leaves alone."""

import numpy as np
import pytest
from covering import covering
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from mitsuba_diffraction.surface.heightfield import harmonic_fill

Y, X = np.mgrid[:20, :30].astype(float)
HARMONIC = {
    "plane": lambda x, y: 0.3 * x - 0.7 * y + 5,
    "x² − y²": lambda x, y: x**2 - y**2,
    "xy": lambda x, y: x * y - 3 * x,
    "x³ − 3xy²": lambda x, y: x**3 - 3 * x * y**2,
}
"""Functions whose second differences add up to zero exactly, as their derivatives do."""
INTERIOR = {
    "pixel": (slice(7, 8), slice(9, 10)),
    "block": (slice(3, 15), slice(5, 22)),
    "all but the frame": (slice(1, -1), slice(1, -1)),
    "every other pixel": np.nonzero(((X + Y) % 2 == 0) & (X > 0) & (X < 29) & (Y > 0) & (Y < 19)),
}


def without(heights, hole, value=np.nan):
    """A copy of the heights with a hole."""
    heights = np.array(heights, float)
    heights[hole] = value
    return heights


def by_relaxation(heights, weight_x, weight_y, sweeps=4000):
    """The same fill by another way: Jacobi's iteration of the mean of the neighbours that there are."""
    missing = np.isnan(heights)
    filled = np.where(missing, np.nanmean(heights), heights)
    weight = np.array([[0, weight_y, 0], [weight_x, 0, weight_x], [0, weight_y, 0]])
    inside = np.pad(np.ones(heights.shape), 1)
    rows, columns = heights.shape
    for _ in range(sweeps):
        padded = np.pad(filled, 1)
        total, weights = np.zeros(heights.shape), np.zeros(heights.shape)
        for row, column in ((0, 1), (1, 0), (1, 2), (2, 1)):
            total += weight[row, column] * padded[row : row + rows, column : column + columns]
            weights += weight[row, column] * inside[row : row + rows, column : column + columns]
        filled = np.where(missing, total / weights, filled)
    return filled


# ---------------------------------------------------------------- harmonic functions


@pytest.mark.parametrize(
    ("hole", "function", "pixel_size"), covering([*INTERIOR], [*HARMONIC], [(1.0, 1.0), (0.05, 0.2), (3.0, 0.1)])
)
def test_harmonic_functions_with_interior_holes_are_restored(function, hole, pixel_size):
    function, hole = HARMONIC[function], INTERIOR[hole]
    heights = function(X * pixel_size[0], Y * pixel_size[1])
    np.testing.assert_allclose(harmonic_fill(without(heights, hole), pixel_size), heights, rtol=1e-9, atol=1e-9)


def test_only_the_ratio_of_the_pixel_sizes_matters():
    heights = without(np.random.default_rng(0).random(X.shape), INTERIOR["block"])
    one = harmonic_fill(heights, (0.1, 0.3))
    np.testing.assert_allclose(harmonic_fill(heights, (1e-9, 3e-9)), one, rtol=1e-12)
    assert np.abs(harmonic_fill(heights) - one).max() > 0.01


def test_a_great_offset_costs_no_digits():
    y, x = np.mgrid[:100, :100] / 128  # every height is a number that float64 holds exactly
    offset = 2.0**20
    heights = x - 2 * y + offset
    filled = harmonic_fill(without(heights, INTERIOR["all but the frame"]))
    np.testing.assert_allclose(filled, heights, rtol=0, atol=2 * np.spacing(offset))


@pytest.mark.few(1)
@pytest.mark.parametrize("pixel_size", [(1.0, 1.0), (1.0, 2.0)])
def test_the_fill_is_that_of_a_relaxation(pixel_size):
    generator = np.random.default_rng(1)
    heights = generator.random((9, 11))
    heights[generator.random((9, 11)) < 0.6] = np.nan
    heights[:4, :5] = np.nan  # a hole at a corner
    weights = 1 / np.square(pixel_size)
    np.testing.assert_allclose(harmonic_fill(heights, pixel_size), by_relaxation(heights, *weights), atol=1e-12)


# ---------------------------------------------------------------- the edge of the array: no slope across it


@pytest.mark.parametrize(
    ("plane", "hole"),
    [
        (0.4 * Y + 2, (slice(5, 15), slice(0, 6))),
        (0.4 * Y + 2, (slice(5, 15), slice(-1, None))),
        (0.4 * X + 2, (slice(0, 8), slice(3, 9))),
        (0.4 * X + 2, (slice(-3, None), slice(3, 9))),
    ],
    ids=["left", "right", "top", "bottom"],
)
def test_a_plane_that_slopes_along_the_edge_is_restored(plane, hole):
    np.testing.assert_allclose(harmonic_fill(without(plane, hole)), plane, atol=1e-9)


def test_a_slope_across_the_edge_ends_at_the_hole():
    plane = 0.4 * X + 0.1 * Y
    filled = harmonic_fill(without(plane, (slice(None), slice(0, 4))))
    slope_along_the_edge_only = harmonic_fill(without(0.1 * Y, (slice(None), slice(0, 4))))
    np.testing.assert_allclose(filled, np.maximum(X, 4) * 0.4 + slope_along_the_edge_only, atol=1e-9)
    assert np.abs(filled - plane)[:, 0].min() > 1


def test_a_corner_is_the_mean_of_its_two_neighbours():
    heights = without(X + 10 * Y, (0, 0))
    assert harmonic_fill(heights)[0, 0] == pytest.approx((1 + 10) / 2, abs=1e-12)
    # Weights 1/d²: the neighbour in the row counts four times as much as that in the column.
    assert harmonic_fill(heights, (1.0, 2.0))[0, 0] == pytest.approx((4 * 1 + 10) / 5, abs=1e-12)


def test_lines_are_interpolated_and_end_level():
    line = [np.nan, np.nan, 1.0, np.nan, np.nan, 4.0, 2.0, np.nan, 3.0, np.nan]
    wanted = [1.0, 1.0, 1.0, 2.0, 3.0, 4.0, 2.0, 2.5, 3.0, 3.0]
    np.testing.assert_allclose(harmonic_fill([line]), [wanted], atol=1e-14)
    np.testing.assert_allclose(harmonic_fill(np.array([line]).T), np.array([wanted]).T, atol=1e-14)


# ---------------------------------------------------------------- every array

holed = hnp.arrays(
    np.float64,
    hnp.array_shapes(min_dims=2, max_dims=2, max_side=8),
    elements=st.one_of(st.floats(-5, 5), st.sampled_from([np.nan, np.inf, -np.inf])),
).filter(lambda heights: np.isfinite(heights).any())


@given(heights=holed, d_x=st.floats(0.01, 10), d_y=st.floats(0.01, 10))
def test_nothing_rises_above_or_falls_below_the_known_pixels(heights, d_x, d_y):
    known = np.isfinite(heights)
    before = heights.tobytes()
    filled = harmonic_fill(heights, (d_x, d_y))
    assert filled.shape == heights.shape
    assert filled.min() >= heights[known].min()
    assert filled.max() <= heights[known].max()
    assert filled[known].tobytes() == heights[known].tobytes()  # to the bit, the sign of zero too
    assert heights.tobytes() == before


@given(heights=holed)
def test_a_filled_pixel_is_the_mean_of_its_neighbours(heights):
    filled = harmonic_fill(heights)
    for row, column in np.argwhere(~np.isfinite(heights)):
        around = [(row - 1, column), (row + 1, column), (row, column - 1), (row, column + 1)]
        there = [filled[p] for p in around if 0 <= p[0] < heights.shape[0] and 0 <= p[1] < heights.shape[1]]
        assert filled[row, column] == pytest.approx(np.mean(there), abs=1e-12)


@pytest.mark.parametrize("place", [(0, 0), (3, 4), (6, 2)])
@pytest.mark.parametrize("height", [0.1, -3e5, 0.0])
def test_one_known_pixel_gives_its_height_to_all(place, height):
    heights = np.full((7, 5), np.nan)
    heights[place] = height
    np.testing.assert_array_equal(harmonic_fill(heights), np.full((7, 5), height))


def test_holes_in_a_level_surface_are_level_to_the_bit():
    level = np.full((20, 30), 0.1)
    np.testing.assert_array_equal(harmonic_fill(without(level, INTERIOR["every other pixel"])), level)


# ---------------------------------------------------------------- what counts as missing


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_pixels_that_are_not_finite_are_missing(value):
    np.testing.assert_allclose(harmonic_fill([[1, value, 2]]), [[1, 1.5, 2]], rtol=1e-15)


@pytest.mark.parametrize("dtype", [np.float32, np.int16, np.uint8])
def test_masked_pixels_are_missing_whatever_lies_under_the_mask(dtype):
    heights = np.ma.masked_equal(np.array([[1, 100, 2]], dtype), 100)
    filled = harmonic_fill(heights)
    assert not np.ma.isMaskedArray(filled)
    assert filled.dtype == np.float64
    np.testing.assert_allclose(filled, [[1, 1.5, 2]], rtol=1e-15)


def test_without_missing_pixels_the_heights_are_returned():
    heights = np.random.default_rng(2).random((3, 4))
    assert harmonic_fill(heights) is heights
    np.testing.assert_array_equal(harmonic_fill([[1, 2]]), [[1.0, 2.0]])


@pytest.mark.parametrize("heights", [np.full((2, 3), np.nan), [[np.inf]], np.ma.masked_all((4, 5))])
def test_heights_without_any_known_pixel_are_refused(heights):
    with pytest.raises(ValueError, match=f"all {np.size(heights)} pixels are missing"):
        harmonic_fill(heights)


@pytest.mark.parametrize(
    "heights", [[1.0, np.nan], np.zeros((0, 3)), [[1j, np.nan]], [["high"]], np.ma.masked_all((2, 2), complex)]
)
def test_arrays_that_are_not_two_dimensional_heights_are_refused(heights):
    with pytest.raises(ValueError, match="heights: got"):
        harmonic_fill(heights)


# ---------------------------------------------------------------- size


@pytest.mark.few(1)
@pytest.mark.parametrize("shape", ["scattered", "one hole"])
def test_a_hundred_thousand_pixels_are_filled(shape):
    y, x = np.mgrid[:512, :512] / 512
    heights = x**2 - y**2
    hole = np.zeros(heights.shape, bool)
    if shape == "one hole":
        hole[100:416, 100:417] = True
    else:
        # The frame stays.
        inner = np.random.default_rng(3).permutation(510 * 510)[:100_000]
        hole[1 + inner // 510, 1 + inner % 510] = True
    assert hole.sum() >= 100_000
    filled = harmonic_fill(without(heights, hole))
    np.testing.assert_allclose(filled, heights, atol=1e-9)
