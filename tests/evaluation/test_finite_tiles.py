"""The factor of a finite row of tiles against sums of waves and quotients in more digits."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mitsuba_diffraction.evaluation.finite_tiles import tile_factor

counts = st.integers(1, 4096)


def near_zero(phase):
    """The number from −1/2 to 1/2 with the same sin(π ·); nothing rounds on the way."""
    phase = np.fmod(phase, 2)
    if abs(phase) > 1:
        phase -= np.copysign(2, phase)
    return np.copysign(1, phase) - phase if abs(phase) > 0.5 else phase


def exact_factor(x, count):
    """sin(πNx)/sin(πx) of one float32 number, in float64.

    N times a float32 has at most 24 + 13 digits and so has its fractional part: nothing rounds before the sine does.
    """
    r = np.fmod(np.float64(x), 2)  # D repeats with the period two
    if r == np.rint(r):
        return count * (-1.0) ** (int(r) * (count - 1))
    return np.sin(np.pi * near_zero(count * r)) / np.sin(np.pi * near_zero(r))


@given(x=st.floats(-3, 3), count=st.integers(1, 40))
def test_the_factor_is_the_sum_of_the_waves(x, count):
    positions = np.arange(count) - (count - 1) / 2
    wanted = np.exp(2j * np.pi * x * positions).sum()
    assert tile_factor(x, count) == pytest.approx(wanted.real, abs=1e-12 * count)
    assert wanted.imag == pytest.approx(0, abs=1e-12 * count)


@given(
    whole=st.integers(-1000, 1000),
    offset=st.floats(2.0**-60, 0.5, width=32) | st.floats(-0.5, -(2.0**-60), width=32) | st.just(0.0),
    count=counts,
)
def test_the_factor_in_float32_is_accurate_to_the_last_digits(whole, offset, count):
    x = np.float32(whole) + np.float32(offset)
    assert x.dtype == np.float32
    got, wanted = tile_factor(x, count), exact_factor(x, count)
    assert got.dtype == np.float32
    assert abs(np.float64(got) - wanted) <= 4 * np.finfo(np.float32).eps * abs(wanted)


@pytest.mark.skipif(np.finfo(np.longdouble).eps > 1e-18, reason="long double has no more digits than float64 here")
@given(whole=st.integers(-9, 9), power=st.integers(-50, -1), mantissa=st.floats(0.5, 1), count=st.integers(1, 200))
def test_the_factor_in_float64_is_accurate_to_the_last_digits(whole, power, mantissa, count):
    x = np.float64(whole) + mantissa * 2.0**power
    r = np.longdouble(x) - np.rint(np.longdouble(x))
    if abs(r) * count < 1e-9:
        wanted = np.longdouble(count)
    else:
        pi = np.longdouble(3.141592653589793) + np.longdouble(1.2246467991473531772e-16)
        periods = r * count  # at most 53 + 8 digits: exact
        wanted = (-1) ** int(np.rint(periods)) * np.sin(pi * (periods - np.rint(periods))) / np.sin(pi * r)
    wanted = wanted * (-1) ** (int(np.rint(x)) * (count - 1))
    # Up to four units of rounding.
    assert abs(tile_factor(x, count) - wanted) <= 4 * np.finfo(np.float64).eps * abs(wanted)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("count", [1, 2, 3, 10, 101, 4096])
def test_the_factor_at_integers_is_the_number_of_tiles(dtype, count):
    whole = np.arange(-5, 6).astype(dtype)
    got = tile_factor(whole, count)
    assert got.dtype == dtype
    np.testing.assert_array_equal(got, count * (-1.0) ** (np.arange(-5, 6) * (count - 1)))
    # The neighbours in floating point, those of zero (the smallest numbers there are) among them: D falls by the share
    # (πNr)²/6, r one unit in the last digit of five.
    rtol = (np.pi * count * np.spacing(dtype(5))) ** 2 / 6 + 4 * np.finfo(dtype).eps
    for side in (-np.inf, np.inf):
        np.testing.assert_allclose(tile_factor(np.nextafter(whole, dtype(side)), count), got, rtol=rtol)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("count", [2, 7, 64])
def test_zeros_lie_between_the_orders(dtype, count):
    # At x = j/N where a binary fraction holds it; elsewhere D passes through zero close by.
    x = np.arange(1, count) / count
    below, above = tile_factor(dtype(x - 0.01 / count), count), tile_factor(dtype(x + 0.01 / count), count)
    assert (below * above < 0).all()
    if count in (2, 64):
        np.testing.assert_array_equal(tile_factor(dtype(x), count), 0)


@pytest.mark.parametrize("count", [1, 2, 5, 12])
def test_the_square_integrates_to_the_number_of_tiles(count):
    # A trigonometric polynomial of degree N − 1: the mean over more points than that is exact.
    x = (np.arange(40) + 0.3) / 40
    assert (tile_factor(x, count) ** 2).mean() == pytest.approx(count, rel=1e-13)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("power", [24, 60, 100])
def test_huge_arguments_count_as_even_integers(dtype, power):
    np.testing.assert_array_equal(tile_factor(np.array([-1, 1], dtype) * dtype(2.0**power), 6), 6)


def test_shapes_and_types_are_preserved():
    assert tile_factor(np.zeros((2, 3)), 4).shape == (2, 3)
    assert tile_factor(np.zeros((0,)), 4).shape == (0,)
    assert np.shape(tile_factor(0.25, 2)) == ()
    assert tile_factor(np.arange(3), 4).dtype == np.float64
    assert tile_factor(np.float32(0.5), np.int64(4)).dtype == np.float32


@pytest.mark.parametrize(
    ("x", "count", "message"),
    [
        (0.5, 0, "count: got 0, wanted a whole number of tiles from 1"),
        (0.5, -2, "count: got -2"),
        (0.5, 2.0, "count: got 2.0"),
        (0.5, True, "count: got True"),
        (np.float32(0.5), 2**23 + 1, "count: got 8388609, wanted a whole number of tiles from 1 to 8388608"),
        (np.nan, 2, "x: got numbers that are not finite"),
        ([0.0, np.inf], 2, "x: got numbers that are not finite"),
        (1j, 2, "x: got complex128, wanted real numbers"),
        ("a", 2, "x: got <U1"),
    ],
)
def test_wrong_requests_are_refused(x, count, message):
    with pytest.raises(ValueError, match=message):
        tile_factor(x, count)
