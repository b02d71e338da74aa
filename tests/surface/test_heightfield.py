"""What a height field accepts, refuses with a reason, and derives."""

import hashlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from mitsuba_diffraction import HeightField
from mitsuba_diffraction.surface.heightfield import harmonic_fill

arrays = hnp.arrays(np.float64, hnp.array_shapes(min_dims=2, max_dims=2, max_side=9), elements=st.floats(-5, 5))


@given(heights=arrays, x=st.floats(0.001, 10), y=st.floats(0.001, 10))
def test_sizes_and_heights_follow_from_the_array(heights, x, y):
    field = HeightField(heights, (x, y))
    rows, columns = heights.shape
    assert field.shape == (rows, columns)
    assert field.tile_size == (columns * x, rows * y)
    assert field.height_range == heights.max() - heights.min()
    np.testing.assert_array_equal(field.heights, heights)
    assert np.abs(field.centred).max() <= field.half_range * (1 + 1e-12) + 1e-15
    np.testing.assert_allclose(np.diff(field.centred.ravel()), np.diff(heights.ravel()), atol=1e-14)


@given(heights=arrays, place=st.data(), bad=st.sampled_from([np.nan, np.inf, -np.inf]))
def test_missing_pixels_are_refused_with_their_number_and_the_first_position(heights, place, bad):
    flat = place.draw(st.sets(st.integers(0, heights.size - 1), min_size=1))
    heights.ravel()[list(flat)] = bad
    row, column = np.unravel_index(min(flat), heights.shape)
    with pytest.raises(ValueError, match=rf"{len(flat)} of {heights.size} .*row {row}, column {column}"):
        HeightField(heights, 0.1)


@pytest.mark.parametrize("dtype", [np.float32, np.int16, np.uint8])
def test_masked_pixels_are_refused_and_an_empty_mask_is_not(dtype):
    heights = np.ma.masked_equal(np.array([[1, 2, 3], [4, 7, 7]], dtype), 7)
    with pytest.raises(ValueError, match=r"2 of 6 .*row 1, column 1"):
        HeightField(heights, 0.1)
    whole = np.ma.masked_equal(heights.data, 100)
    np.testing.assert_array_equal(HeightField(whole, 0.1).heights, heights.data)


def test_the_refusal_of_missing_pixels_says_how_to_fill_them():
    with pytest.raises(ValueError, match="fill_missing, which interpolates them"):
        HeightField([[np.nan, 1]], 0.1)


@given(heights=arrays, place=st.data(), bad=st.sampled_from([np.nan, np.inf, -np.inf]))
def test_missing_pixels_are_filled_on_request_and_counted(heights, place, bad):
    flat = place.draw(st.sets(st.integers(0, heights.size - 1), max_size=heights.size - 1))
    heights.ravel()[list(flat)] = bad
    field = HeightField(heights, (0.1, 0.2), source="scan.npy", fill_missing=True)
    np.testing.assert_array_equal(field.heights, harmonic_fill(heights, (0.1, 0.2)))
    assert not field.heights.flags.writeable
    assert heights.flags.writeable
    assert field.filled == len(flat)
    assert field.digest == HeightField(field.heights, (0.1, 0.2)).digest
    assert (
        field.digest
        == hashlib.sha256(
            np.array(heights.shape, "<i8").tobytes() + np.array([0.1, 0.2]).tobytes() + field.heights.tobytes()
        ).hexdigest()
    )


def test_the_fill_depends_on_the_shape_of_a_pixel():
    corner = [[np.nan, 1.0], [10.0, 0.0]]
    # Weights 1/d²: (4·1 + 10)/5 where pixels are twice as long along y.
    assert HeightField(corner, (0.1, 0.2), fill_missing=True).heights[0, 0] == pytest.approx(14 / 5)
    assert HeightField(corner, 0.1, fill_missing=True).heights[0, 0] == pytest.approx(11 / 2)


@pytest.mark.parametrize(
    ("heights", "text"),
    [
        ([[1, 2, 3]], "source='scan.npy')"),
        ([[1, np.nan, 3]], "source='scan.npy (1 missing pixel filled)')"),
        ([[1, np.nan, np.inf]], "source='scan.npy (2 missing pixels filled)')"),
        (np.ma.masked_equal([[1, 7, 7, 7]], 7), "source='scan.npy (3 missing pixels filled)')"),
    ],
)
def test_the_source_and_repr_state_the_number_of_filled_pixels(heights, text):
    assert text in repr(HeightField(heights, 0.1, source="scan.npy", fill_missing=True))


def test_nothing_is_filled_where_nothing_is_missing():
    field = HeightField([[1, 2]], 0.1)
    assert field.filled == 0
    assert (field.source, field.digest) == ("array", HeightField([[1, 2]], 0.1, fill_missing=True).digest)


@pytest.mark.parametrize("heights", [np.full((2, 3), np.nan), np.ma.masked_all((3, 2))])
def test_there_is_nothing_to_fill_from_where_all_is_missing(heights):
    with pytest.raises(ValueError, match="all 6 pixels are missing"):
        HeightField(heights, 0.1, fill_missing=True)


@pytest.mark.parametrize("answer", ["no", 1, None])
def test_fill_missing_is_true_or_false(answer):
    with pytest.raises(ValueError, match=r"fill_missing: got .* wanted True or False"):
        HeightField([[1, 2]], 0.1, fill_missing=answer)


@pytest.mark.parametrize(
    "heights",
    [
        1.0,
        [1.0, 2.0],
        np.zeros((2, 2, 2)),
        np.zeros((0, 3)),
        np.zeros((3, 0)),
        [[1j]],
        [["1"]],
        [[True]],
        [[1, 2], [3]],
        None,
    ],
    ids=["number", "row", "cube", "no rows", "no columns", "complex", "text", "truth", "ragged", "nothing"],
)
def test_arrays_that_are_not_two_dimensional_heights_are_refused(heights):
    with pytest.raises(ValueError, match="heights: got"):
        HeightField(heights, 0.1)


@pytest.mark.parametrize("size", [0, -1, np.nan, np.inf, (0.1, 0), (0.1, -0.1), (0.1,), (1, 2, 3), "0.1", "12", None])
def test_wrong_pixel_sizes_are_refused(size):
    with pytest.raises(ValueError, match="pixel_size: got"):
        HeightField(np.zeros((2, 2)), size)


def test_one_number_stands_for_square_pixels():
    assert HeightField([[1, 2]], 0.5).pixel_size == (0.5, 0.5)
    assert HeightField([[1, 2]], np.array([0.5, 0.25])).pixel_size == (0.5, 0.25)


def test_heights_are_a_copy_that_cannot_be_written():
    heights = np.zeros((2, 3))
    field = HeightField(heights, 0.1)
    heights[0, 0] = 1
    assert field.heights[0, 0] == 0
    with pytest.raises(ValueError, match="read-only"):
        field.heights[0, 0] = 1


def test_digest_is_the_hash_of_shape_pixel_size_and_heights():
    heights = np.arange(6.0).reshape(2, 3)
    content = np.array([2, 3], "<i8").tobytes() + np.array([0.1, 0.2], "<f8").tobytes() + heights.tobytes()
    field = HeightField(heights, (0.1, 0.2), source="here")
    assert field.digest == hashlib.sha256(content).hexdigest()
    assert HeightField(np.asfortranarray(heights), (0.1, 0.2), source="there").digest == field.digest
    others = [(heights.reshape(3, 2), (0.1, 0.2)), (heights, (0.2, 0.1)), (heights + 1e-15, (0.1, 0.2))]
    assert field.digest not in {HeightField(*other).digest for other in others}


def test_repr_names_the_size_and_the_source():
    text = repr(HeightField(np.eye(2, 3), (0.5, 0.25), source="scan.png"))
    for part in ("3 × 2 pixels", "1.5 × 0.5 µm", "height range 1 µm", "scan.png"):
        assert part in text
