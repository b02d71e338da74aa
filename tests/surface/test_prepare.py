"""Steps of preparation: what each takes away, what it leaves, and what it reports."""

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from scipy import ndimage

import mitsuba_diffraction as md
from mitsuba_diffraction.errors import RequestError
from mitsuba_diffraction.surface import prepare
from mitsuba_diffraction.surface.heightfield import HeightField
from mitsuba_diffraction.surface.periods import find_periods

PIXEL = (0.05, 0.08)
"""µm, (x, y)"""


def coordinates(shape, pixel=PIXEL):
    y, x = np.mgrid[: shape[0], : shape[1]]
    return x * pixel[0], y * pixel[1]


def rough(shape, seed=0):
    return HeightField(0.1 * np.random.default_rng(seed).standard_normal(shape), PIXEL, "rough")


def with_gaps(field, fraction=0.1, seed=1):
    heights = field.heights.copy()
    heights[np.random.default_rng(seed).random(heights.shape) < fraction] = np.nan
    heights[0, 0] = 0.1  # there is always one
    return HeightField(heights, field.pixel_size, field.source, keep_missing=True)


def grating(shape, period=0.6, direction=0.0, pixel=PIXEL):
    x, y = coordinates(shape, pixel)
    angle = np.radians(direction)
    return 0.1 * np.cos(2 * np.pi * (x * np.cos(angle) + y * np.sin(angle)) / period)


fields = npst.arrays(
    np.float64,
    npst.array_shapes(min_dims=2, max_dims=2, max_side=9),
    elements=st.one_of(st.floats(-1, 1), st.just(np.nan)),
).filter(lambda heights: np.isfinite(heights).any())
slopes = st.floats(-2, 2)


def field_of(heights):
    return HeightField(heights, PIXEL, keep_missing=True)


ALL = [
    "level_plane",
    "level_quadratic",
    "align_lines",
    "despike",
    "mask_outliers",
    {"rotate": 180},
    {"rotate": 90.0},
    "fill_missing",
]

# ---------------------------------------------------------------- every step


@pytest.mark.parametrize("step", ["level_plane", "despike", {"rotate": 20}, {"trim_edges": 0.1}, {"crop_periods": "x"}])
def test_filled_pixels_are_counted_through_all_steps(step):
    field = with_gaps(HeightField(grating((40, 60)), PIXEL))
    count = int(field.gaps.sum())
    assert prepare.apply_steps(field, ["fill_missing", step, "fill_missing"]).filled == count > 0


@given(heights=fields, step=st.sampled_from(ALL))
@example(heights=1.0 - (np.arange(63) == 0).reshape(7, 9), step="mask_outliers")  # one pit in a plane
def test_a_step_is_pure_and_keeps_missing_pixels(heights, step):
    field = field_of(heights)
    before = field.heights.tobytes()
    after = prepare.apply_steps(field, [step])
    assert field.heights.tobytes() == before
    assert after.source.startswith(f"{field.source}; ")
    if step == "fill_missing":
        assert not after.gaps.any()
    elif step == "mask_outliers":  # it makes missing pixels
        assert not (field.gaps & ~after.gaps).any()
        np.testing.assert_array_equal(after.heights[~after.gaps], field.heights[~after.gaps])
    else:
        assert after.gaps.sum() == field.gaps.sum()
        assert np.isfinite(after.heights).sum() == np.isfinite(heights).sum()


def test_steps_are_applied_in_order_and_recorded():
    x, y = coordinates((40, 60))
    field = HeightField(np.tan(np.radians(2)) * x - np.tan(np.radians(0.5)) * y, PIXEL, "skin.gwy")
    after = prepare.apply_steps(field, [{"trim_edges": 0.1}, "level_plane", {"rotate": 90}])
    assert after.source == (
        "skin.gwy; trim_edges: 2 columns and 2 rows at each edge; level_plane: tilt 2° along x, -0.5° along y; "
        "rotate: 90°"
    )
    other = prepare.apply_steps(field, [{"rotate": 90}, "level_plane"])
    assert "tilt 0.5° along x, 2° along y" in other.source


@pytest.mark.parametrize(
    ("steps", "message"),
    [
        ("level_plane", "wanted a list of steps"),
        (["level"], r"got 'level', wanted one of level_plane, .*trim_edges"),
        ([3], "got 3, wanted one of"),
        ([{"rotate": 1, "despike": 2}], "wanted one of"),
        ([{"level_plane": 3}], "level_plane: got 3, wanted no argument"),
        (["rotate"], "rotate: missing its argument"),
        ([{"rotate": "left"}], "rotate: got 'left', wanted a number"),
        ([{"rotate": float("nan")}], "rotate: got nan"),
        ([{"trim_edges": True}], "trim_edges: got True"),
        ([{"mask_outliers": 0.5}], "mask_outliers: got 0.5, wanted a number of at least 1"),
        ([{"crop_periods": "z"}], "crop_periods: got 'z', wanted 'x', 'y' or 'xy'"),
        ([{"crop_periods": 2.0}], "crop_periods: got 2.0"),
    ],
)
def test_wrong_steps_are_refused_before_a_scan_is_read(steps, message):
    with pytest.raises(ValueError, match=message):
        prepare.check_steps(steps)


@pytest.mark.parametrize(
    ("text", "step"),
    [
        ("level_plane", "level_plane"),
        ("despike=4", {"despike": 4.0}),
        ("rotate=-3.5", {"rotate": -3.5}),
        ("crop_periods=x", {"crop_periods": "x"}),
    ],
)
def test_steps_are_parsed_as_they_are_typed(text, step):
    assert prepare.step_of(text) == step
    prepare.check_steps([prepare.step_of(text)])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("rotate", "prepare: got rotate, wanted rotate=…, a number of degrees"),
        ("rotate=x", "prepare: got rotate=x, wanted rotate=…, a number of degrees"),
        ("crop_periods=z", "prepare: got crop_periods=z, wanted crop_periods=…, 'x', 'y' or 'xy'"),
        ("level_plane=2", "prepare: got level_plane=2, wanted level_plane, no argument"),
        ("rotte=3", "prepare: got rotte=3, wanted one of level_plane, level_quadratic, align_lines"),
    ],
)
def test_a_wrong_step_is_quoted_as_it_was_typed(text, message):
    """Not as in a recipe, `{ rotate = … }`."""
    with pytest.raises(RequestError) as caught:
        prepare.step_of(text)
    assert str(caught.value).startswith(message)


@pytest.mark.parametrize("extent", ["tile", "sample"])
def test_a_height_field_with_missing_pixels_has_no_spectrum(extent):
    field = with_gaps(rough((20, 30)))
    assert f"{field.gaps.sum()} missing" in repr(field)
    with pytest.raises(ValueError, match="of 600 pixels are missing"):
        md.precompute(field, extent=extent, coherence_length=0.5)
    with pytest.raises(ValueError, match="all 4 pixels are missing"):
        HeightField(np.full((2, 2), np.nan), 1.0, keep_missing=True)


# ---------------------------------------------------------------- levelling


@given(heights=fields, a=slopes, b=slopes, c=slopes)
def test_level_plane_is_independent_of_an_added_plane(heights, a, b, c):
    x, y = coordinates(heights.shape)
    one = prepare.level_plane(field_of(heights)).heights
    other = prepare.level_plane(field_of(heights + a * x + b * y + c)).heights
    np.testing.assert_allclose(other, one, atol=1e-12)


@given(heights=fields, a=slopes, b=slopes, c=slopes, d=slopes)
def test_level_quadratic_is_independent_of_an_added_quadratic(heights, a, b, c, d):
    x, y = coordinates(heights.shape)
    one = prepare.level_quadratic(field_of(heights)).heights
    other = prepare.level_quadratic(field_of(heights + a * x + b * y**2 + c * x * y + d * x**2)).heights
    np.testing.assert_allclose(other, one, atol=1e-11)


# Five heights, through which more than one quadratic passes.
FEW = np.full((6, 7), np.nan)
FEW[[0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 3, 0]] = 0, 0, 0, 1, 0, 0


@example(heights=FEW, step="level_quadratic")
@given(heights=fields, step=st.sampled_from(["level_plane", "level_quadratic"]))
def test_levelling_twice_is_levelling_once(heights, step):
    once = prepare.apply_steps(field_of(heights), [step])
    np.testing.assert_allclose(prepare.apply_steps(once, [step]).heights, once.heights, atol=1e-12)
    assert np.nanmean(once.heights) == pytest.approx(0, abs=1e-12)


def test_the_plane_is_that_of_least_squares():
    field = with_gaps(rough((13, 17)))
    x, y = coordinates(field.shape)
    there = ~field.gaps
    design = np.stack([np.ones(there.sum()), x[there], y[there]], axis=1)
    solution = np.linalg.lstsq(design, field.heights[there], rcond=None)[0]
    expected = field.heights - (solution[0] + solution[1] * x + solution[2] * y)
    np.testing.assert_allclose(prepare.level_plane(field).heights, expected, atol=1e-14)


def test_the_bow_is_reported_in_nanometres():
    x, y = coordinates((31, 41))
    x, y = x / x.max() * 2 - 1, y / y.max() * 2 - 1
    after = prepare.level_quadratic(HeightField(0.012 * x**2 - 0.005 * y**2, PIXEL, "scan"))
    assert "bow 12 nm along x, -5 nm along y" in after.source
    np.testing.assert_allclose(after.heights, 0, atol=1e-15)


# ---------------------------------------------------------------- lines


@given(
    heights=npst.arrays(np.float64, (7, 9), elements=st.one_of(st.floats(-1, 1), st.just(np.nan))),
    offsets=npst.arrays(np.float64, (7, 1), elements=st.floats(-3, 3)),
)
def test_offsets_of_lines_are_removed_except_for_a_tilt(heights, offsets):
    heights[:, 4] = 0.25  # every line shares a pixel with the next
    steps = ["align_lines", "level_plane"]
    one = prepare.apply_steps(field_of(heights), steps).heights
    np.testing.assert_allclose(prepare.apply_steps(field_of(heights + offsets), steps).heights, one, atol=1e-12)


def test_lines_across_a_grating_are_restored():
    jumps = np.random.default_rng(0).standard_normal((50, 1)) * 0.05
    clean = grating((50, 60)) + 0.02 * coordinates((50, 60))[1]
    after = prepare.align_lines(HeightField(clean + jumps, PIXEL, "scan"))
    left = after.heights - clean
    assert np.ptp(left - np.polyval(np.polyfit(np.arange(50), left[:, 0], 1), np.arange(50))[:, None]) < 1e-12
    assert "align_lines: offsets" in after.source


def test_a_lost_line_does_not_separate_the_lines_about_it():
    heights = grating((20, 40))
    heights[7:] += 0.5
    heights[5] = np.nan
    after = prepare.apply_steps(field_of(heights), ["align_lines", "level_plane"]).heights
    expected = prepare.level_plane(field_of(np.where(np.isnan(heights), np.nan, grating((20, 40))))).heights
    np.testing.assert_allclose(after, expected, atol=1e-12)


# ---------------------------------------------------------------- spikes


@pytest.mark.parametrize("height", [0.5, -0.5])
def test_spikes_and_a_streak_are_replaced_and_nothing_else(height):
    clean = grating((40, 50), 0.9, 20) + rough((40, 50)).heights * 0.01
    dirty = clean.copy()
    dirty[[5, 5, 20, 39], [7, 8, 30, 20]] += height
    dirty[31, 10:40] += height
    after = prepare.despike(HeightField(dirty, PIXEL, "scan"))
    changed = after.heights != dirty
    assert changed[dirty != clean].all()
    assert not changed[dirty == clean].any()
    assert np.abs(after.heights - clean).max() < 0.05
    assert "despike: 34 of 2000 pixels" in after.source


@pytest.mark.parametrize("direction", [0, 8, 45, 90])
def test_grooves_are_no_spikes(direction):
    # V-shaped, each slope 40 standard deviations of the noise from pixel to pixel.
    x, y = coordinates((60, 60), (1, 1))
    across = x * np.cos(np.radians(direction)) + y * np.sin(np.radians(direction))
    heights = 0.04 * np.abs((across + 0.3) % 11 - 5.5) + rough((60, 60)).heights * 0.01
    after = prepare.despike(HeightField(heights, 1.0))
    assert after.heights.tobytes() == heights.tobytes()


def test_the_edges_of_structures_are_no_spikes():
    x, y = coordinates((60, 60), (1, 1))
    heights = 0.5 * ((x % 12 < 6) & (y % 12 < 6)) + rough((60, 60)).heights * 0.02
    assert prepare.despike(HeightField(heights, 1.0)).heights.tobytes() == heights.tobytes()


def test_a_spike_on_a_level_surface_is_replaced_above_the_threshold():
    heights = np.zeros((20, 20))
    heights[4, 5] = 1.0
    np.testing.assert_array_equal(prepare.despike(HeightField(heights, 1.0)).heights, 0)
    noisy = rough((60, 60)).heights.copy()
    noisy[30, 31] += 3.0  # 30 standard deviations of the noise
    for threshold, spikes in ((5.0, 1), (15.0, 1), (50.0, 0)):
        assert (prepare.despike(HeightField(noisy, 1.0), threshold).heights != noisy).sum() == spikes
    with pytest.raises(ValueError, match="despike: got 0"):
        prepare.despike(rough((4, 4)), 0)


# ---------------------------------------------------------------- dust


def dusty(shape=(160, 200)):
    """Return a wavy grating, and the same with a grain, a grain on the edge, and a pit; and where these are."""
    x = coordinates(shape)[0]
    clean = grating(shape, 0.4) + 0.05 * np.sin(x / x.max() * 3) + 0.002 * rough(shape).heights
    rows, columns = np.mgrid[: shape[0], : shape[1]]
    where, heights = np.zeros(shape, bool), clean.copy()
    for row, column, height in ((40, 60, 0.5), (100, 199, 0.4), (120, 90, -0.5)):
        spot = (rows - row) ** 2 + (columns - column) ** 2 <= 36
        heights[spot] += height
        where |= spot
    return clean, heights, where


def test_grains_and_pits_become_missing_and_nothing_a_period_away():
    clean, heights, where = dusty()
    after = prepare.mask_outliers(HeightField(heights, PIXEL, "scan"))
    assert after.gaps[where].all()
    near = ndimage.binary_dilation(where, np.ones((3, 3)), 8)
    assert after.gaps.sum() < 3 * where.sum()
    assert not after.gaps[~near].any()
    np.testing.assert_array_equal(after.heights[~after.gaps], heights[~after.gaps])
    assert f"mask_outliers: {after.gaps.sum()} of 32000 pixels" in after.source
    assert not prepare.mask_outliers(HeightField(clean, PIXEL)).gaps.any()


def test_the_mask_ignores_scale_offset_and_missing_pixels():
    _, heights, _ = dusty()
    heights[10:14, 150:160] = np.nan
    one = prepare.mask_outliers(HeightField(heights, PIXEL, keep_missing=True))
    other = prepare.mask_outliers(HeightField(3 - 0.25 * heights, PIXEL, keep_missing=True))
    np.testing.assert_array_equal(one.gaps, other.gaps)
    assert one.gaps[10:14, 150:160].all()
    assert prepare.mask_outliers(HeightField(heights, PIXEL, keep_missing=True), 50).gaps.sum() == 40


@pytest.mark.parametrize("shape", [(1, 1), (1, 60), (60, 1), (2, 3)])
def test_a_mask_of_a_profile_or_of_few_pixels_is_no_error(shape):
    masked = prepare.mask_outliers(HeightField(np.zeros(shape), PIXEL))
    assert masked.shape == shape
    assert not masked.gaps.any()


# ---------------------------------------------------------------- rotation


@given(heights=fields)
def test_a_whole_turn_changes_nothing(heights):
    field = field_of(heights)
    for degrees in (0, 360, -720.0):
        np.testing.assert_array_equal(prepare.rotate(field, degrees).heights, heights)


def test_a_quarter_turn_maps_x_to_y():
    field = HeightField([[0.0, 1.0, 2.0], [3.0, 4.0, 5.0]], PIXEL)
    turned = prepare.rotate(field, 90)
    assert turned.shape == (3, 2)
    assert turned.pixel_size == PIXEL[::-1]
    # (column, row) → (−row, column)
    np.testing.assert_array_equal(turned.heights, [[3, 0], [4, 1], [5, 2]])
    np.testing.assert_array_equal(prepare.rotate(turned, -90).heights, field.heights)


@pytest.mark.parametrize("degrees", [3.0, -20.0, 45.0, 70.0, 133.0, 200.0])
@pytest.mark.parametrize("shape", [(60, 50), (30, 90), (90, 30)])
def test_a_smooth_surface_is_rotated_about_its_centre(degrees, shape):
    def surface(x, y):
        return np.sin(1.1 * x + 0.3) * np.cos(0.7 * y) + 0.2 * x * y

    def middled(shape):
        x, y = coordinates(shape)
        return x - x.mean(), y - y.mean()

    after = prepare.rotate(HeightField(surface(*middled(shape)), PIXEL), degrees)
    assert not after.gaps.any()
    x, y = middled(after.shape)
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    expected = surface(c * x + s * y, c * y - s * x)
    np.testing.assert_allclose(after.heights, expected, atol=5e-6)


@given(width=st.floats(1, 30), height=st.floats(1, 30), degrees=st.floats(0.1, 89.9))
def test_the_rectangle_fits_and_is_the_largest(width, height, degrees):
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    w, h = prepare.largest_rectangle(width, height, c, s)

    def fits(w, h):
        return w * c + h * s <= width * (1 + 1e-9) and w * s + h * c <= height * (1 + 1e-9)

    assert w > 0
    assert h > 0
    assert fits(w, h)
    # By brute force over the shape: for each ratio the greatest rectangle has a known area.
    angle = np.linspace(0.001, np.pi / 2 - 0.001, 2001)
    scale = np.minimum(
        width / (np.cos(angle) * c + np.sin(angle) * s), height / (np.cos(angle) * s + np.sin(angle) * c)
    )
    best = (scale**2 * np.cos(angle) * np.sin(angle)).max()
    assert w * h >= best * (1 - 1e-9)


def test_rotation_changes_the_direction_of_a_grating():
    field = HeightField(grating((90, 120), 0.45, 20), PIXEL)
    (found,) = find_periods(prepare.rotate(field, -50))
    assert found.direction == pytest.approx(-30, abs=0.05)
    assert found.period == pytest.approx(0.45, rel=1e-3)


def test_missing_pixels_are_rotated_and_none_is_extrapolated():
    heights = grating((60, 60), 0.9)
    heights[30, 20] = np.nan
    after = prepare.rotate(field_of(heights), 10)
    assert 1 <= after.gaps.sum() <= 9
    with pytest.raises(ValueError, match="no pixels fit"):
        prepare.rotate(HeightField(np.zeros((1, 30)), 1.0), 20)


# ---------------------------------------------------------------- cropping


def test_edges_are_trimmed_by_at_least_their_width():
    field = HeightField(np.arange(20 * 30.0).reshape(20, 30), PIXEL)
    after = prepare.trim_edges(field, 0.16)
    np.testing.assert_array_equal(after.heights, field.heights[2:-2, 4:-4])
    profile = prepare.trim_edges(HeightField(field.heights[:1], PIXEL), 0.16)
    np.testing.assert_array_equal(profile.heights, field.heights[:1, 4:-4])
    for width in (0.8, 1e308, -1.0, 0.0):
        with pytest.raises(ValueError, match="trim_edges: got"):
            prepare.trim_edges(field, width)


@pytest.mark.few(3)
@pytest.mark.parametrize("noise", [0.0, 0.01])
@pytest.mark.parametrize(("period", "direction"), [(0.613, 0), (0.613, 30), (0.47, -62)])
def test_a_grating_is_cropped_to_a_tile_without_a_seam(noise, period, direction):
    shape = (80, 110)
    heights = grating(shape, period, direction) + noise * rough(shape).heights
    after = prepare.crop_periods(HeightField(heights, PIXEL, "scan"))
    q = np.abs([np.cos(np.radians(direction)), np.sin(np.radians(direction))]) / period
    waves = q * after.tile_size
    across = q > 1e-9
    np.testing.assert_allclose(waves[across], np.rint(waves[across]), atol=0.01)
    assert (waves[across] > 0.5).all()
    assert ("no period along y" in after.source) == (not across[1])
    # All the light of a tile is in orders of the grating: none in those between, which a seam would fill.
    power = np.abs(np.fft.fft2(after.heights)) ** 2
    order = tuple(np.rint(waves).astype(int)[::-1] * [1 if direction >= 0 else -1, 1])
    power[0, 0] = 0
    strong = power[order] + power[-order[0], -order[1]]
    assert strong / power.sum() > 0.9995 - 20 * noise**2


def test_pixels_are_kept_if_the_period_is_a_whole_number_of_them():
    heights = grating((1, 100), 12 * 0.05)
    after = prepare.crop_periods(HeightField(heights, PIXEL), "x")
    assert after.pixel_size == PIXEL
    assert after.shape == (1, 96)
    np.testing.assert_array_equal(after.heights, heights[:, 2:98])
    assert "8 × 600 nm along x (96 of 100 pixels" in after.source


def test_a_crossed_grating_is_cropped_along_both():
    heights = grating((100, 120), 0.61) + grating((100, 120), 0.83, 90)
    after = prepare.crop_periods(HeightField(heights, PIXEL))
    np.testing.assert_allclose(np.array(after.tile_size) / [0.61, 0.83], [9, 9], rtol=1e-3)


def test_a_surface_that_cannot_be_cropped_is_refused():
    with pytest.raises(ValueError, match="no period stands out"):
        prepare.crop_periods(rough((40, 40)))
    with pytest.raises(ValueError, match="1 pixels are missing, wanted fill_missing"):
        prepare.crop_periods(HeightField([[0, 1, np.nan]], PIXEL, keep_missing=True))
    with pytest.raises(ValueError, match="no period along y"):
        prepare.crop_periods(HeightField(grating((40, 60)), PIXEL), "y")
    with pytest.raises(ValueError, match="crop_periods: got 'z'"):
        prepare.crop_periods(rough((40, 40)), "z")


def test_a_seamless_tile_has_no_light_between_its_orders():
    # The end that cropping is for: through precompute, against the same scan with its seam.
    field = HeightField(grating((1, 100), 0.613), (0.05, 0.613))
    seamless = prepare.crop_periods(field)
    assert seamless.tile_size[0] == pytest.approx(8 * 0.613, rel=1e-3)

    def in_orders(field):
        powers = np.abs(np.fft.fft2(np.exp(12j * field.heights), norm="forward")) ** 2
        return powers[0, 8 * np.arange(-5, 6)].sum()

    assert in_orders(seamless) > 0.9999
    assert in_orders(field) < 0.95
    assert md.precompute(seamless, tolerance=0.01).source.startswith("array; crop_periods: 8 × 613 nm along x")
