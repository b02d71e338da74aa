"""Periods found from the spectrum: sinusoids within their stated uncertainty, gratings, noise."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

import mitsuba_diffraction as md
from mitsuba_diffraction.surface.heightfield import HeightField
from mitsuba_diffraction.surface.periods import Period, find_periods, repeated

ROOT = Path(__file__).parents[2]
PIXEL = (0.05, 0.07)
"""µm, (x, y)"""


def coordinates(shape, pixel=PIXEL):
    """x and y of each pixel, µm."""
    y, x = np.mgrid[: shape[0], : shape[1]]
    return x * pixel[0], y * pixel[1]


def wave(shape, period, direction, phase=0.0, pixel=PIXEL):
    x, y = coordinates(shape, pixel)
    angle = np.radians(direction)
    return np.cos(2 * np.pi * (x * np.cos(angle) + y * np.sin(angle)) / period + phase)


def turned(one, other):
    """The angle between two lines, degrees."""
    return (one - other + 90) % 180 - 90


def resolved(shape, period, direction, waves=3.0):
    """Whether a patch holds enough waves, and its pixels resolve them."""
    angle = np.radians(direction)
    q = np.abs([np.cos(angle), np.sin(angle)]) / period
    size = np.array([shape[1] * PIXEL[0], shape[0] * PIXEL[1]])
    return np.hypot(*(q * size)) > waves and (q * PIXEL < 0.45).all()


# ---------------------------------------------------------------- one sinusoid

shapes = st.tuples(st.integers(40, 70), st.integers(40, 70))


@settings(max_examples=30)
@given(
    shape=shapes,
    period=st.floats(0.25, 1.2),
    direction=st.floats(-90, 90, exclude_min=True),
    phase=st.floats(0, 6.3),
    tilt=st.floats(-1, 1),
    bow=st.floats(-0.1, 0.1),
)
# Rounding as a second wave, and a direction of 90° and a little.
@example(shape=(45, 40), period=0.5, direction=90.0, phase=0.0, tilt=0.0, bow=0.0)
@example(shape=(43, 40), period=1.0, direction=90.0, phase=0.0, tilt=0.0, bow=0.0)
# Found in windows of half the size, as the power between two bins is not significant in one window.
@example(shape=(40, 68), period=0.625, direction=0.0, phase=2.0, tilt=0.0, bow=0.0)
def test_a_sinusoid_on_a_bowed_plane_is_exact(shape, period, direction, phase, tilt, bow):
    assume(resolved(shape, period, direction))
    x, y = coordinates(shape)
    heights = 0.1 * wave(shape, period, direction, phase) + tilt * x - 2 * y + bow * x * y + bow * y**2
    (found,) = find_periods(HeightField(heights, PIXEL))
    # The peak of −q is six bins away or more, where a Hann window has some thousandths of its amplitude: 0.03 bins, of
    # windows of half the size.
    angle = np.radians(direction)
    error = found.q - np.copysign(1, np.cos(np.radians(found.direction) - angle)) / period * np.array(
        [np.cos(angle), np.sin(angle)]
    )
    assert np.abs(error * np.array(shape[::-1]) * PIXEL).max() < 0.06  # bins
    assert -90 < found.direction <= 90
    # Over a broken number n of waves, the mean square of a cosine is 1/2 within 1/(2πn); n > 3 here.
    assert found.strength == pytest.approx(1, abs=1 / (6 * np.pi))


@pytest.mark.few(1)
@pytest.mark.parametrize("noise", [0.03, 0.3, 1.0])
def test_the_error_of_a_sinusoid_in_noise_is_below_the_stated_uncertainty(noise):
    generator = np.random.default_rng(5)
    errors = []
    for _ in range(30):
        shape = tuple(generator.integers(40, 70, 2))
        period, direction = generator.uniform(0.3, 0.9), generator.uniform(-90, 90)
        if not resolved(shape, period, direction):
            continue
        heights = wave(shape, period, direction, generator.uniform(0, 6)) + noise * generator.standard_normal(shape)
        found = find_periods(HeightField(heights, PIXEL))[0]
        errors.append((found.period - period) / found.period_uncertainty)
        errors.append(turned(found.direction, direction) / found.direction_uncertainty)
        # The period of a wave in noise is not known better than the bound, nor much less well than a bin.
        assert found.period_uncertainty < period**2 / min(shape[1] * PIXEL[0], shape[0] * PIXEL[1])
    # A quarter, half as long and wide, has four times the standard error of the whole.
    assert len(errors) > 40
    assert 0.1 < np.sqrt(np.mean(np.square(errors))) < 1
    assert np.abs(errors).max() < 4


def test_the_uncertainty_of_a_line_is_the_bound_of_cramer_and_rao_for_its_half():
    # Rife and Boorstyn 1974: var f = 6 σ²/(π² A² N T²) for a real sinusoid; Hann's window loses the outer samples.
    count, noise = 400, 0.1
    generator = np.random.default_rng(0)
    heights = wave((1, count), 1.0, 0.0, pixel=(0.05, 1)) + noise * generator.standard_normal((1, count))
    (found,) = find_periods(HeightField(heights, (0.05, 1)))
    bound = np.sqrt(6 * noise**2 / (np.pi**2 * count / 2)) / (count / 2 * 0.05)
    assert bound < found.period_uncertainty < 4 * bound


@pytest.mark.parametrize("direction", [-90, 90, 270])
def test_waves_along_y_have_the_direction_90(direction):
    (found,) = find_periods(HeightField(wave((60, 50), 0.6, direction), PIXEL))
    assert found.direction == pytest.approx(90)


def test_the_direction_has_the_sign_of_the_wave():
    # The crests of cos(x + y) fall towards +x: their wave vector points at 45°.
    assert find_periods(HeightField(wave((60, 60), 0.5, 45), PIXEL))[0].direction == pytest.approx(45, abs=0.02)
    assert find_periods(HeightField(wave((60, 60), 0.5, 45)[::-1], PIXEL))[0].direction == pytest.approx(-45, abs=0.02)


# ---------------------------------------------------------------- gratings


@pytest.mark.parametrize(
    ("name", "strength"),
    [("sinusoidal", 1.0), ("lamellar", 8 / np.pi**2), ("blazed", 6 / np.pi**2)],  # Fourier series of the profiles
)
@pytest.mark.parametrize("rows", [1, 24])
def test_gratings_by_formula_have_their_periods(name, strength, rows):
    grating = md.gratings.PROFILES[name](period=2.5, depth=0.25)
    pixel = 8 * grating.pixel_size[0]
    heights = np.tile(grating.heights[:, ::8], (rows, 5))
    (found,) = find_periods(HeightField(heights, pixel))
    assert found.period == pytest.approx(2.5, rel=1e-3)
    assert found.direction == pytest.approx(0, abs=1e-6)
    assert found.strength == pytest.approx(strength, abs=0.01)


@pytest.mark.parametrize(
    ("name", "periods"),
    [
        ("film", [1.8868, 1.8868]),
        *(
            pytest.param(name, periods, marks=pytest.mark.slow)
            for name, periods in (
                ("compact_disc", [1.6]),
                ("dvd", [0.74]),
                ("foil", [1.0, 1.0]),
                ("ruled", [1.6667]),
            )
        ),
    ],
)
def test_built_in_profiles_have_their_periods(name, periods):
    found = find_periods(md.gratings.PROFILES[name](), extent="tile")
    assert [period.period for period in found] == pytest.approx(periods, abs=1e-4)


def test_the_stronger_of_two_waves_is_first():
    shape = (80, 70)
    heights = wave(shape, 0.61, 20) + 2 * wave(shape, 0.43, -75)
    first, second = find_periods(HeightField(heights, PIXEL))
    assert (first.period, second.period) == pytest.approx((0.43, 0.61), rel=1e-3)
    assert (first.direction, second.direction) == pytest.approx((-75, 20), abs=0.05)
    assert first.strength / second.strength == pytest.approx(4, rel=0.01)
    assert find_periods(HeightField(heights, PIXEL), count=1)[0].period == pytest.approx(0.43, rel=1e-3)
    assert len(find_periods(HeightField(heights, PIXEL), count=5)) == 2


@pytest.mark.parametrize("order", [2, 3])
def test_a_strong_harmonic_is_not_the_period(order):
    shape = (64, 64)
    heights = wave(shape, 1.1, 30) + 1.5 * wave(shape, 1.1 / order, 30, phase=1)
    (found,) = find_periods(HeightField(heights, PIXEL))
    assert found.period == pytest.approx(1.1, rel=0.01)


def test_missing_pixels_do_not_hide_a_period():
    generator = np.random.default_rng(2)
    heights = wave((60, 60), 0.6, 30)
    heights[generator.random(heights.shape) < 0.1] = np.nan
    (found,) = find_periods(HeightField(heights, PIXEL, keep_missing=True))
    assert found.period == pytest.approx(0.6, abs=4 * found.period_uncertainty)


def test_a_grating_on_a_part_of_the_patch_is_found():
    heights = wave((64, 64), 0.4, 30)
    heights[:, :32] = 0
    found = find_periods(HeightField(heights, PIXEL))[0]
    assert found.period == pytest.approx(0.4, abs=4 * found.period_uncertainty)
    assert find_periods(HeightField(np.zeros((64, 64)), PIXEL)) == ()


@pytest.mark.few(1)
@pytest.mark.parametrize(("name", "directions"), [("elaphe", (90, 0)), ("xenopeltis", (0, 90))])
def test_the_rows_of_a_synthetic_skin_are_a_period(name, directions):
    # Its fingers wander, which the uncertainty shows.
    skin = md.gratings.PROFILES[f"{name}_synthetic"](size=32.0, depth=0.375, seed=1)
    skin = HeightField(skin.heights[::2, ::2], 2 * skin.pixel_size[0])
    period = {"elaphe": 32 / 28, "xenopeltis": 32 / 21}[name]
    found = find_periods(skin)[0]
    assert found.period == pytest.approx(period, abs=4 * found.period_uncertainty)
    assert found.period == pytest.approx(period, rel=0.03)
    assert abs(turned(found.direction, directions[0])) < 4 * found.direction_uncertainty


# ---------------------------------------------------------------- nothing to find


@pytest.mark.parametrize("shape", [(1, 1), (1, 2), (2, 1), (3, 3), (1, 300), (300, 1), (40, 57)])
def test_a_flat_or_tilted_surface_has_no_period(shape):
    x, y = coordinates(shape)
    assert find_periods(HeightField(np.full(shape, 0.3), PIXEL)) == ()
    assert find_periods(HeightField(0.3 + 0.1 * x - 0.02 * y, PIXEL)) == ()


def test_noise_has_no_period():
    generator = np.random.default_rng(3)
    fields = [generator.standard_normal(generator.integers(1, 80, 2)) for _ in range(60)]
    assert sum(len(find_periods(HeightField(field, PIXEL))) for field in fields) <= 1


def test_a_rough_surface_has_no_period():
    generator = np.random.default_rng(4)
    q = np.hypot(*np.meshgrid(np.fft.fftfreq(128), np.fft.fftfreq(128)))
    q[0, 0] = 1
    found = 0
    for _ in range(20):
        heights = np.fft.ifft2(np.fft.fft2(generator.standard_normal(q.shape)) * q**-1.8).real
        found += len(find_periods(HeightField(heights[:100, :90], PIXEL)))
    assert found <= 1


def test_no_summit_is_sought_of_the_many_weak_orders_of_a_random_tile(monkeypatch):
    # Regression: a designed plate has hundreds of them, for which `inspect` took minutes.
    order = np.fft.fftfreq(160, 1 / 160)
    inside = np.hypot(order, order[:, None]) < 75
    noise = np.random.default_rng(5).standard_normal((160, 160))
    tile = HeightField(np.fft.ifft2(np.fft.fft2(noise) * inside).real, 0.1)
    monkeypatch.setattr("mitsuba_diffraction.surface.periods._Periodogram.summit", lambda *_: pytest.fail("sought"))
    assert find_periods(repeated(tile, 2)) == ()


def test_jumps_between_the_lines_of_a_scan_are_no_period():
    generator = np.random.default_rng(6)
    heights = 0.01 * generator.standard_normal((80, 90)) + generator.standard_normal((80, 1))
    assert find_periods(HeightField(heights, PIXEL)) == ()
    with_wave = find_periods(HeightField(heights + 0.3 * wave((80, 90), 0.5, 20), PIXEL))
    assert [round(found.period, 2) for found in with_wave] == [0.5]


@pytest.mark.parametrize("count", [0, -1, 1.5, True, "two"])
def test_the_count_is_a_positive_integer(count):
    with pytest.raises(ValueError, match="count: got"):
        find_periods(HeightField(wave((20, 20), 0.3, 0), PIXEL), count)


def test_the_extent_is_known():
    with pytest.raises(ValueError, match="extent: got 'ribbon', wanted one of tile, sample"):
        find_periods(HeightField(wave((20, 20), 0.3, 0), PIXEL), extent="ribbon")


@pytest.mark.parametrize("periods", [1, 5])
def test_the_period_of_a_tile_is_an_order_of_its_lattice(periods):
    x = (np.arange(50) + 0.5) / 50 * periods
    tile = HeightField(0.02 * np.sin(2 * np.pi * x) + np.zeros((30, 1)), PIXEL)
    (found,) = find_periods(tile, extent="tile")
    assert (found.period, found.direction) == (pytest.approx(tile.tile_size[0] / periods, rel=1e-12), 0)
    assert found.period_uncertainty == found.direction_uncertainty == 0
    # As a sample, a single wave is not significant, and several have an uncertainty.
    assert [round(one.period, 2) for one in find_periods(tile)] == [round(found.period, 2)] * (periods > 1)


def test_a_period_is_plain_numbers():
    (found,) = find_periods(HeightField(wave((40, 40), 0.5, 10), PIXEL))
    assert isinstance(found, Period)
    assert {type(value) for value in vars(found).values()} == {float}


# ---------------------------------------------------------------- bands


def fingers(seed, width=0.2, shape=(160, 160), pixel=0.06, q=1.8):
    """Noise with a Gaussian band about q cycles/µm along x (σ: `width` along ρ, 8° in φ) on a white floor."""
    q_x, q_y = np.meshgrid(np.fft.fftfreq(shape[1], pixel), np.fft.fftfreq(shape[0], pixel))
    rho, phi = np.hypot(q_x, q_y), np.arctan2(q_y, np.abs(q_x)) * np.sign(q_x + 1e-9)
    power = np.exp(-(((rho - q) / width) ** 2) / 2 - (phi / np.radians(8)) ** 2 / 2) + 1e-4
    white = np.fft.fft2(np.random.default_rng(seed).standard_normal(shape))
    return HeightField(np.fft.ifft2(white * np.sqrt(power)).real, pixel)


@pytest.mark.parametrize("count", [4, pytest.param(8, marks=pytest.mark.slow)])
def test_the_centre_of_a_band_is_found_within_its_uncertainty(count):
    errors = []
    for seed in range(count):
        (band,) = find_periods(fingers(seed), 1)
        assert band.strength > 0.1
        errors.append((1 / band.period - 1.8) / (band.period_uncertainty * 1.8**2))
        errors.append(band.direction / band.direction_uncertainty)
    assert np.abs(errors).max() < 3.5
    assert np.sqrt(np.mean(np.square(errors))) < 1.6


def test_a_band_without_power_is_not_listed():
    # As of the instrument, 0.03 % of the variance, at right angles to the fingers.
    main, weak = (fingers(seed, q=q).heights for seed, q in ((3, 1.8), (4, 5.5)))
    heights = main / main.std() + np.sqrt(3e-4) * weak.T / weak.std()
    (band,) = find_periods(HeightField(heights, 0.06))
    assert band.period == pytest.approx(1 / 1.8, rel=0.1)


def drifting(seed, low, high, width, shape=(250, 250), pixel=0.044):
    """Rows of fingers along x whose pitch along y goes over from `low` to `high` µm, side to side, on 1/q² noise."""
    generator = np.random.default_rng(seed)
    q_x, q_y = np.meshgrid(*(np.fft.fftfreq(n, pixel) for n in shape[::-1]))
    rho, phi = np.hypot(q_x, q_y), np.arctan2(q_x, np.abs(q_y))
    sides = []
    for pitch in (low, high):
        band = np.exp(-(((rho - 1 / pitch) / width) ** 2) / 2 - (phi / np.radians(5)) ** 2 / 2)
        power = band + 3e-4 / np.maximum(rho, 0.3) ** 2
        sides.append(np.fft.ifft2(np.fft.fft2(generator.standard_normal(shape)) * np.sqrt(power)).real)
    place = np.pi / 2 * np.linspace(0, 1, shape[1])
    return HeightField(np.cos(place) * sides[0] + np.sin(place) * sides[1], pixel)


@pytest.mark.few(2)
@pytest.mark.parametrize(
    ("seed", "low", "high", "width"),
    [(9, 0.89, 0.975, 0.06), (11, 0.89, 0.975, 0.06), (2, 0.8, 1.0, 0.16)],  # found twice by direction, and by width
)
def test_one_pitch_is_listed_once(seed, low, high, width):
    (found,) = find_periods(drifting(seed, low, high, width))
    assert found.period == pytest.approx((low + high) / 2, rel=0.1)


def test_uncertainty_is_the_spread_between_parts():
    """Pitches of other parts of the same skin: synthetic replicas, and a pitch that varies from side to side."""
    found = [find_periods(drifting(seed, 0.89, 0.975, 0.06), 1)[0] for seed in range(8)]
    apart = [
        (one.period - other.period) / np.hypot(one.period_uncertainty, other.period_uncertainty)
        for number, one in enumerate(found)
        for other in found[:number]
    ]
    assert 0.4 < np.sqrt(np.mean(np.square(apart))) < 1.3


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "shortest", "longest"), [("elaphe_synthetic", 1.0, 1.3), ("xenopeltis_synthetic", 0.45, 0.7)]
)
def test_crops_of_a_synthetic_skin_agree_within_their_uncertainties(name, shortest, longest):
    apart = []
    for seed in (1, 2, 3):
        skin = md.gratings.PROFILES[name](size=32.0, seed=seed)
        found = []
        for i, j in ((0, 0), (256, 256), (0, 256), (256, 0)):
            crop = HeightField(skin.heights[i : i + 176, j : j + 176], skin.pixel_size)
            found.append(next(one for one in find_periods(crop) if shortest < one.period < longest))
        for number, one in enumerate(found):
            apart += [
                (one.period - other.period) / np.hypot(one.period_uncertainty, other.period_uncertainty)
                for other in found[:number]
            ]
    assert 0.2 < np.sqrt(np.mean(np.square(apart))) < 1.3
    assert np.abs(apart).max() < 3


@pytest.mark.slow
def test_crops_confirm_the_uncertainty_of_the_fingers(panel):
    whole = find_periods(panel)
    rows, across = whole
    assert rows.period == pytest.approx(1.55, abs=rows.period_uncertainty)  # quarters have 1.48 to 1.55 µm
    assert abs(turned(rows.direction, -89.6)) < rows.direction_uncertainty
    assert rows.period_uncertainty < 0.1
    assert 0.5 < across.period < 0.58
    for i, j in ((0, 0), (0, 93), (93, 93)):
        crop = find_periods(HeightField(panel.heights[i : i + 277, j : j + 277], panel.pixel_size))
        for one, other in zip(whole, sorted(crop, key=lambda period: -period.period), strict=True):
            assert abs(one.period - other.period) < 2.5 * np.hypot(one.period_uncertainty, other.period_uncertainty)


@pytest.mark.slow
@pytest.mark.not_quick
@pytest.mark.few(1)
@pytest.mark.parametrize(
    ("name", "height_range", "periods", "direction"),
    # The highest peaks of the plain periodogram of Elaphe; rows and fingers of Xenopeltis, by eye and periodogram.
    [("elaphe", 0.4347, (1.18, 1.03), 0.0), ("xenopeltis", 0.4435, (1.5, 0.55), -87.0)],
)
def test_scans_of_65_um_have_their_periods(name, height_range, periods, direction):
    path = ROOT / "precompute" / "measured" / f"{name}_afm_65um.png"
    found = find_periods(md.read_height_field(path, pixel_size=65 / 1332, height_range=height_range))
    assert [one.period for one in found] == pytest.approx(periods, rel=0.04)
    for one, period in zip(found, periods, strict=True):
        assert one.period == pytest.approx(period, abs=1.5 * one.period_uncertainty)
        assert one.period_uncertainty < 0.04
    assert turned(found[0].direction, direction) == pytest.approx(0, abs=2)


def test_half_a_wave_is_no_period():
    # |sin| over one period is exactly half a wave of twice the period.
    ridge = np.abs(np.sin(np.pi * np.arange(256) / 256))[None]
    assert find_periods(HeightField(0.1 * ridge, (1.3 / 256, 1.3))) == ()
