"""Where the windows of a sample stand, and how wide the scan lets them be."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mitsuba_diffraction import HeightField
from mitsuba_diffraction.spectrum.sample import (
    UNIFORM,
    WindowAxis,
    effective_coherence_length,
    mean_periodogram,
    window_axes,
)


def flat(rows, columns, pixel):
    return HeightField(np.zeros((rows, columns)), pixel)


@pytest.mark.parametrize(
    ("rows", "columns", "pixel", "requested", "wanted"),
    [
        (100, 100, 0.0586, 65.0, 2.93),  # half of the scan
        (100, 60, 0.1, 65.0, 3.0),  # the shorter side, along x
        (60, 100, 0.1, 65.0, 3.0),  # and along y
        (100, 100, (0.1, 0.3), 65.0, 5.0),  # in micrometres, not in pixels
        (100, 100, 0.1, 2.0, 2.0),  # the requested length, if the scan supports it
        (1, 100, 0.1, 65.0, 5.0),  # an axis of one pixel sets no limit
        (100, 1, 0.1, 65.0, 5.0),
        (1, 1, 0.1, 65.0, 65.0),
        (8, 8, 0.25, 65.0, 1.0),  # four pixels are just enough
    ],
)
def test_a_scan_supports_half_of_its_shorter_side(rows, columns, pixel, requested, wanted):
    assert effective_coherence_length(flat(rows, columns, pixel), requested) == pytest.approx(wanted, rel=1e-12)


@pytest.mark.parametrize(
    ("rows", "columns", "requested", "message"),
    [
        (
            100,
            7,
            65.0,
            "coherence_length: got 65 µm, of which the scan of 0.7 × 10 µm supports 0.35; wanted at least 4",
        ),
        (7, 100, 65.0, "supports 0.35"),
        (100, 100, 0.3, r"got 0.3 µm.* wanted at least 4 pixels of 0.1 µm"),
        (2, 100, 65.0, "supports 0.1"),
        (1, 1, 0.0, "coherence_length: got 0.0"),
        (100, 100, np.nan, "coherence_length: got nan"),
    ],
)
def test_too_few_pixels_for_a_window_are_refused(rows, columns, requested, message):
    with pytest.raises(ValueError, match=message):
        effective_coherence_length(flat(rows, columns, 0.1), requested)


@given(
    count=st.integers(8, 300),
    pixel=st.sampled_from([0.0586, 0.1, 0.07, 1 / 3, 0.013, 2.0]),
    fraction=st.floats(0.0, 1.0),
)
def test_windows_are_gaussian_and_cover_the_scan(count, pixel, fraction):
    # From four pixels to half of the scan.
    coherence_length = (4 + fraction * (count / 2 - 4)) * pixel
    sigma = coherence_length / 4 / pixel  # pixels
    axis, across = window_axes(flat(1, count, (pixel, 1.0)), coherence_length)
    assert across is UNIFORM
    width = len(axis.window)
    assert 0 <= width - 6 * sigma + 1e-6 <= 1 + 2e-6  # three σ_s to each side, in whole pixels
    # ln a is the parabola −x²/2σ_s² about the middle, up to its height, and Σ a² = 1.
    x = np.arange(width) - (width - 1) / 2
    parabola = np.log(axis.window) + x**2 / (2 * sigma**2)
    np.testing.assert_allclose(parabola, parabola[0], atol=1e-9)
    assert (axis.window**2).sum() == pytest.approx(1)
    # Places run from edge to edge, evenly but for whole pixels, and no two are much more than σ_s apart.
    assert axis.starts[0] == 0
    assert axis.starts[-1] == count - width
    hops = np.diff(axis.starts)
    assert hops.min() >= 1
    assert hops.max() - hops.min() <= 2
    assert hops.max() < sigma * (1 + 1e-6) + 1
    # No more of them than that takes.
    assert (len(axis.starts) - 2) * sigma < (count - width) * (1 + 1e-6)


@given(count=st.integers(8, 400), pixel=st.sampled_from([0.0586, 0.1, 0.07, 1 / 3, 0.013, 0.3]))
def test_the_widest_windows_have_three_positions(count, pixel):
    # Whatever rounding makes of sizes that divide evenly.
    field = flat(count, count, pixel)
    for axis in window_axes(field, effective_coherence_length(field, 65 * count)):
        assert len(axis.starts) == 3


def test_each_axis_has_windows_of_its_own():
    along_x, along_y = window_axes(flat(40, 100, (0.1, 0.2)), 4.0)
    assert len(along_x.window) == 60
    assert len(along_y.window) == 30
    assert along_x.starts[-1] == 40
    assert along_y.starts[-1] == 10
    assert window_axes(flat(1, 1, 0.1), 4.0) == [UNIFORM, UNIFORM]
    assert window_axes(flat(40, 1, 0.1), 1.0)[0] is UNIFORM


@pytest.mark.parametrize("shape", [(4, 5), (7, 12)])
def test_periodograms_are_those_of_direct_sums(shape, monkeypatch):
    rng = np.random.default_rng(0)
    wave = np.exp(1j * rng.random((9, 11)))
    x, y = WindowAxis(rng.random(5), np.array([0, 2, 6])), WindowAxis(rng.random(4), np.array([0, 5]))
    # In batches of one, and of all segments at once.
    several = [mean_periodogram(wave, x, y, shape)]
    monkeypatch.setattr("mitsuba_diffraction.spectrum.sample.MAX_BATCH_SIZE", 1)
    several.append(mean_periodogram(wave, x, y, shape))
    rows, columns = np.arange(shape[0]), np.arange(shape[1])
    wanted = np.zeros(shape)
    for j in y.starts:
        for i in x.starts:
            segment = np.outer(y.window, x.window) * wave[j : j + 4, i : i + 5]
            along_x = np.exp(-2j * np.pi * np.outer(np.arange(5), columns) / shape[1])
            along_y = np.exp(-2j * np.pi * np.outer(rows, np.arange(4)) / shape[0])
            wanted += np.abs(along_y @ segment @ along_x) ** 2 / 6
    # Transforms are in single precision.
    np.testing.assert_allclose(several, [wanted, wanted], atol=1e-7 * wanted.sum(), rtol=0)
