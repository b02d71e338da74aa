"""Designs: what the BSDF and the precomputed spectrum say of them, and requests that are refused."""

import tracemalloc
import types
from pathlib import Path

import colour
import numpy as np
import pytest

import mitsuba_diffraction as md
from mitsuba_diffraction.inverse_design import Design, Verdict
from mitsuba_diffraction.inverse_design.far_field import nearest_levels
from mitsuba_diffraction.inverse_design.output import save
from mitsuba_diffraction.inverse_design.plate import Plate, depth_for_strokes
from mitsuba_diffraction.inverse_design.search import WHITE
from mitsuba_diffraction.inverse_design.target import wanted_fractions
from mitsuba_diffraction.inverse_design.verdict import COLOUR_BOUNDS, GOOD_BOUNDS, VISIBLE_BOUNDS
from mitsuba_diffraction.precomputation.recipe import Recipe

SMALL = {"texel": 1.0, "texels": 16, "starts": 6, "seen_on": "screen"}


def lopsided(size=24):
    """A heart with its left half wider, and a bar at its right: neither mirror image nor rotation is the same."""
    y, x = np.mgrid[size : -size : size * 1j, -size : size : size * 1j] / size
    a, b = (x + 0.25) / np.where(x < -0.25, 0.65, 0.5), (y - 0.05) / 0.65
    return (((a**2 + b**2 - 1) ** 3 < a**2 * b**3) | ((x > 0.55) & (x < 0.8) & (y > -0.3))).astype(float)


@pytest.fixture(scope="module")
def laser():
    return md.design(lopsided(), wavelengths=532, **SMALL)


def spectrum_of(relief, design):
    # Inside a sheet of index 1.5 wavelengths are shorter.
    range_ = (240 if design.plate.int_ior else 520, 560)
    return md.precompute(relief, coherence_length=design.plate.coherence_length, wavelengths=range_, tolerance=5e-3)


def powers(design, value, count=2):
    """The fractions of ∫ value du dv in the bins of the picture; value(x, y), (n, 2) → (n,)."""
    edge, bins = float(design.plate.edges(1)[1]), design.wanted.shape[1]
    step = 2 * edge / (bins * count)
    outside = int(np.ceil((1 - edge) / step))
    u = (np.arange(-outside, bins * count + outside) + 0.5) * step - edge
    y, x = np.meshgrid(u, u, indexing="ij")
    disc = np.hypot(x, y) < 0.999
    density = np.zeros(x.shape)
    density[disc] = value(x[disc], y[disc])
    inner = slice(outside, outside + bins * count)
    total = density.sum()
    return density[inner, inner].reshape(bins, count, bins, count).sum(axis=(1, 3)) / total


def test_a_design_for_a_laser_sends_most_light_into_the_target(laser):
    assert laser.efficiency[0] > 0.65
    assert laser.correlation[0] > 0.9
    assert laser.mirror[0] < 0.02
    flat = lopsided().mean()
    assert laser.efficiency[0] > 1.5 * flat


def test_the_prediction_is_that_of_precompute(laser):
    spectrum = spectrum_of(laser.height_field, laser)

    def density(x, y):
        z = np.sqrt(1 - x**2 - y**2)
        # K G = 1/cos θ_o near the normal, here for all directions: hardly any light is further out.
        return spectrum.evaluate(-np.stack([x, y], -1) / 0.532, 2 * np.pi * (1 + z) / 0.532) / z

    found = powers(laser, density)
    assert found[laser.inside[0]].sum() == pytest.approx(laser.efficiency[0], rel=0.02)
    assert np.abs(found - laser.predicted[0]).sum() < 0.03


@pytest.mark.parametrize(
    "request_",
    [
        {"wavelengths": 532},
        pytest.param({"wavelengths": 532, "int_ior": 1.5, "height_range": 1.6}, marks=pytest.mark.slow),
    ],
)
def test_the_bsdf_sends_light_where_the_design_says(request_, laser, llvm):
    import mitsuba as mi

    from mitsuba_diffraction import testing

    design = md.design(lopsided(), **{**SMALL, **request_}) if "int_ior" in request_ else laser
    sheet = {"int_ior": 1.5, "transmission": "sheet"} if design.plate.int_ior else {"material": "none"}
    spectrum = spectrum_of(design.height_field, design)
    bsdf = mi.load_dict({"type": "diffraction_grating", "spectrum": spectrum, "conserve_energy": False, **sheet})

    def density(x, y):
        z = np.sqrt(1 - x**2 - y**2)
        wo = np.stack([x, y, -z if design.plate.int_ior else z], -1)
        return testing.evaluate(bsdf, [0, 0, 1], wo, [532.0])[:, 0] / z

    found = powers(design, density)
    assert found[design.inside[0]].sum() == pytest.approx(design.efficiency[0], rel=0.02)
    # Rows of the target from the top, those of the bins from the lowest y.
    correlations = {
        name: np.corrcoef(image.ravel(), design.wanted[0].ravel())[0, 1]
        for name, image in {"": found, "x": found[:, ::-1], "y": found[::-1], "turned": found[::-1, ::-1]}.items()
    }
    assert correlations.pop("") > 0.9
    assert max(correlations.values()) < 0.6


@pytest.mark.few(1)
@pytest.mark.parametrize("seen_on", ["wall", "screen"])
@pytest.mark.parametrize("int_ior", [None, 1.5])
def test_an_f_is_an_f_where_it_is_seen(seen_on, int_ior):
    """The eye is on the side of the plate and looks the way the light goes, or behind a screen and looks back."""
    f = np.zeros((24, 24))
    f[3:21, 6:9] = f[3:6, 6:18] = f[10:13, 6:15] = 1
    found = md.design(
        f, wavelengths=532, texel=1.0, texels=16, starts=2, int_ior=int_ior, height_range=1.6, seen_on=seen_on
    )
    spectrum = md.precompute(found.height_field, coherence_length=8, wavelengths=(520, 560), tolerance=0.02)
    kappa = float(found.plate.kappa[0])

    def density(x, y):
        # Where the relief itself sends the light; S(q; −κ) = S(−q; κ).
        return spectrum.evaluate(-np.sign(kappa) * np.stack([x, y], -1) / 0.532, np.full(x.shape, abs(kappa)))

    light = powers(found, density)  # columns ↔ +x of ω_o, rows ↔ +y
    outwards = np.array([0, 0, 1.0 if int_ior is None else -1.0])
    forward = outwards if seen_on == "wall" else -outwards
    right = np.cross(forward, [0, 1, 0])  # of an eye whose up is +y
    seen = light[::-1, :: int(right[0])]
    size = len(seen)
    expected = np.repeat(np.repeat(f, size, 0), size, 1).reshape(size, 24, size, 24).mean(axis=(1, 3))
    correlations = [np.corrcoef(image.ravel(), expected.ravel())[0, 1] for image in (seen, seen[:, ::-1], seen[::-1])]
    assert correlations[0] > 0.8
    assert max(correlations[1:]) < correlations[0] - 0.2
    target, predicted = found.seen
    for panel in (target, predicted):
        assert np.corrcoef(panel[::-1].mean(axis=-1).ravel(), expected.ravel())[0, 1] > 0.8


@pytest.mark.slow
@pytest.mark.not_quick
def test_a_design_depends_on_its_seed_alone(laser):
    again = md.design(lopsided(), wavelengths=532, **SMALL)
    other = md.design(lopsided(), wavelengths=532, seed=1, **SMALL)
    assert np.array_equal(again.height_field.heights, laser.height_field.heights)
    assert not np.array_equal(other.height_field.heights, laser.height_field.heights)


@pytest.mark.slow
@pytest.mark.not_quick
def test_a_search_among_levels_beats_rounding(laser):
    stepped = md.design(lopsided(), wavelengths=532, levels=8, tool_blur=0, **SMALL)
    assert len(np.unique(stepped.height_field.heights.round(9))) <= 8
    # The blur of the tool does not reach the middle of a texel.
    per_texel = len(laser.height_field.heights) // 16
    heights = laser.height_field.heights[per_texel // 2 :: per_texel, per_texel // 2 :: per_texel]
    rounded = Design.of(nearest_levels(heights, 0.8, 8), stepped.plate, stepped.wanted)
    assert stepped.efficiency[0] > 1.1 * rounded.efficiency[0]


@pytest.mark.slow
@pytest.mark.not_quick
def test_the_time_and_the_memory_of_a_design_are_told_before_it(monkeypatch):
    told = []
    monkeypatch.setattr("mitsuba_diffraction.inverse_design.search._seconds", lambda *_: 0.01)

    def stop(done, total):
        assert len(told) == 1
        raise KeyboardInterrupt

    def expect(seconds, memory):
        told.append((seconds, memory))

    tracemalloc.start()
    found = md.design(lopsided(), wavelengths=532, texel=1.0, texels=48, starts=4, progress=stop, expect=expect)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    ((seconds, memory),) = told
    assert seconds == pytest.approx(0.011 * (4 * 150 + 400))
    assert memory == 620 * found.height_field.heights.size
    assert 0.3 * memory < peak < 1.5 * memory


@pytest.mark.slow
@pytest.mark.not_quick
def test_a_prediction_has_no_lobe_of_every_order_in_memory():
    """16,000 orders over 801 bins would take 0.3 GB."""
    plate = Plate(
        **{"texel": 0.8, "texels": 48, "height_range": 0.8, "angle": 17.5, "wavelengths": np.array([532.0])},
        **{"int_ior": None, "levels": None, "tool_blur": 0.13, "seen_on": "wall", "unused": "outside"},
    )
    heights = np.random.default_rng(0).random((48, 48))
    tracemalloc.start()
    Design.of(heights, plate, np.full((1, 801, 801), 801**-2))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 0.2e9


def test_an_interrupted_design_is_the_best_so_far(laser):
    def stop(done, total):
        assert total == 1300
        if done == 100:
            raise KeyboardInterrupt

    found = md.design(lopsided(), wavelengths=532, progress=stop, **SMALL)
    assert found.interrupted
    assert not laser.interrupted
    assert 0.5 < found.efficiency[0] < laser.efficiency[0]


@pytest.mark.slow
@pytest.mark.not_quick
def test_errors_of_making_are_those_of_another_relief(laser):
    deeper = md.HeightField(1.05 * laser.height_field.heights, laser.height_field.pixel_size)
    spectrum = spectrum_of(deeper, laser)

    def density(x, y):
        z = np.sqrt(1 - x**2 - y**2)
        return spectrum.evaluate(-np.stack([x, y], -1) / 0.532, 2 * np.pi * (1 + z) / 0.532) / z

    found = powers(laser, density)[laser.inside[0]].sum()
    assert laser.changed["depth +5 %"][0] == pytest.approx(found, rel=0.02)
    assert abs(found - laser.efficiency[0]) > 0.005


@pytest.mark.slow
@pytest.mark.not_quick
def test_white_light_is_directed_at_all_wavelengths():
    found = md.design(lopsided(), texel=1.0, texels=16, starts=3)
    between = found.efficiencies(np.array([440.0, 500.0, 560.0, 620.0]))
    assert found.efficiency.min() > 0.5
    assert between.min() > 0.95 * found.efficiency.min()


def unsearched(wavelengths, target=None, **options):
    """A design of random heights."""
    plate = Plate(
        **{"texel": 1.0, "texels": 12, "height_range": 0.8, "angle": 17.5, "tool_blur": 0.13, **options},
        wavelengths=np.atleast_1d(np.asarray(wavelengths, float)),
        **{"int_ior": None, "levels": None},
    )
    heights = np.random.default_rng(0).uniform(0, plate.height_range, 2 * (plate.texels,))
    wanted = wanted_fractions(lopsided() if target is None else target, plate)
    return Design.of(heights, plate, wanted[..., ::-1] if plate.mirrored else wanted)


@pytest.mark.slow
def test_strokes_far_from_the_mirror_direction_are_sharp_in_white_light():
    """The first letter of WAVE was a #: facets of a relief of 0.8 µm are too short to tell its strokes apart."""
    strokes = np.zeros((30, 100))
    for left in range(2, 100, 8):
        strokes[5:25, left : left + 4] = 1
    outer = {}
    for depth in (0.8, depth_for_strokes(25, WHITE)):
        found = md.design(strokes, texels=72, starts=2, height_range=depth)
        wanted, predicted = (light.sum(axis=1) for light in (found.wanted, found.predicted))
        lit = wanted[0] > 0.5 * wanted[0].max()
        at_edge = np.abs(np.linspace(-1, 1, lit.size)) > 0.6
        bright, dark = (predicted[:, at_edge & side].mean(axis=1) for side in (lit, ~lit))
        outer[depth] = float(np.mean((bright - dark) / (bright + dark)))
    shallow, deep = outer.values()
    assert deep > 0.15
    assert shallow < 0.05


def test_a_design_in_infrared_is_that_of_shorter_light_in_larger_lengths():
    """Scalar theory has no length of its own."""
    near = unsearched(1060, texel=1.6, height_range=1.6)
    far = unsearched(10600, texel=16, height_range=16, tool_blur=1.3)
    assert far.height_field.shape == near.height_field.shape
    assert far.height_field.heights == pytest.approx(10 * near.height_field.heights)
    assert far.predicted == pytest.approx(near.predicted, abs=1e-12)
    assert far.height_field.pixel_size[0] > 10.6 / 6
    assert "deeper than two wavelengths" not in far.warning


def test_the_recipe_of_a_deep_relief_for_infrared_light_is_accepted(tmp_path):
    design = unsearched(10600, texel=8, texels=10, height_range=25)
    save(design, tmp_path / "plate.gsf")
    recipe = Recipe.load(tmp_path / "plate.toml")
    assert recipe.settings.wavelengths[0] < 10600 < recipe.settings.wavelengths[1]
    assert recipe.settings.largest_height_range > np.ptp(design.height_field.heights) > 20


@pytest.mark.few(1)
@pytest.mark.parametrize("unused", ["outside", "mirror"])
def test_the_target_has_the_colours_of_the_picture_and_the_prediction_those_of_its_light(unused):
    encoded = np.zeros((24, 24, 3))
    encoded[4:20, 3:11], encoded[4:20, 13:21] = (1, 0, 0), (0, 80 / 255, 1)
    picture = colour.cctf_decoding(encoded, function="sRGB")
    design = unsearched(WHITE, picture, texels=20, unused=unused)
    target, predicted = (image[::-1] for image in design.seen)  # rows from the top
    size = len(target)
    red, blue = (target[size // 2, int(size * x)] for x in (7 / 24, 17 / 24))
    for found, wanted in ((red, picture[12, 7]), (blue, picture[12, 17])):
        pair = [colour.XYZ_to_Lab(colour.RGB_to_XYZ(np.clip(rgb, 0, None), "sRGB")) for rgb in (found, wanted)]
        assert colour.delta_E(*pair, method="CIE 2000") < 3
    # Its own light, integrated by colour-science in the light of D65, which is white.
    shape = colour.SpectralShape(430, 670, 1)
    daylight = colour.SDS_ILLUMINANTS["D65"].copy().align(shape)
    row, column = size // 3, size // 3
    light = design.predicted[:, ::-1, ::-1][:, row, column]
    spectrum = np.interp(shape.range(), np.sort(WHITE), light[np.argsort(WHITE)]) * daylight.values
    cmfs = colour.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"].copy().align(shape)
    rgb, lamp = (
        colour.XYZ_to_RGB(values @ cmfs.values, "sRGB", apply_cctf_encoding=False)
        for values in (spectrum, daylight.values)
    )
    ratio = predicted[row, column] / (rgb / lamp)
    assert ratio == pytest.approx(ratio.mean(), rel=0.02)
    assert design.colour_difference > 5


@pytest.mark.slow
def test_the_search_keeps_hues():
    """Where the light of each wavelength counts alike, red is beige, 1.5 times as bright in red as in blue light."""
    picture = np.full((24, 24, 3), (0.8, 0.1, 0.05))
    picture[:, 12:] = 0.05, 0.15, 0.8
    design = md.design(picture, texels=12, starts=2, height_range=3.2)
    _, predicted = design.seen
    left, right = (half.mean(axis=(0, 1)) for half in np.array_split(predicted, 2, axis=1))
    assert left[0] > 3.5 * left[2]
    assert right[2] > 5 * right[0]
    assert design.colour_difference < 22


@pytest.mark.few(2)
@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"levels": 2}, ["the picture fails: ", "raise levels to 4 or more, with height_range 0.2"]),
        ({"levels": 3}, ["the picture fails: ", "raise levels to 8 or more, or lower height_range to 0.18"]),
        ({"height_range": 0.02}, ["the picture fails: ", "the relief is too shallow: raise height_range to 0.8"]),
        ({"int_ior": 1.0001}, ["the picture fails: ", "raise height_range to "]),
        ({"tool_blur": 1.8}, ["the picture can be seen, but is pale or uneven: ", "the tool is too blunt"]),
    ],
)
def test_a_plate_that_fails_is_named_with_its_remedy(options, words):
    found = md.design(lopsided(), wavelengths=532, texel=1.0, texels=16, starts=1, **options)
    verdict = Verdict.of(found)
    # What the measures are, from the light itself.
    predicted, inside = found.predicted[0], found.wanted[0] > 0.1 * found.wanted[0].max()
    bright, dark = predicted[inside].mean(), predicted[~inside].mean()
    assert verdict.light == pytest.approx(predicted[inside].sum())
    assert verdict.contrast == pytest.approx((bright - dark) / (bright + dark))
    assert verdict.correlation == pytest.approx(np.corrcoef(predicted.ravel(), found.wanted.ravel())[0, 1])
    for text in words:
        assert text in str(verdict)


def test_of_a_negative_the_option_that_was_given_is_no_remedy():
    plate = Plate(1.0, 12, 0.6, 17.5, np.array([532.0]), None, None, 0.1)
    picture = np.ones((8, 8))
    picture[:2, :2] = 0
    found = Design.of(0.6 * np.random.default_rng(0).random((12, 12)), plate, wanted_fractions(picture, plate))
    assert Verdict.of(found).remedy == "most of the picture is light: its negative casts its dark parts instead"
    remedy = Verdict.of(found, inverted=True, names={"negative": "--invert"}).remedy
    assert remedy == "most of the picture is light: without --invert, its other parts are cast"


def test_a_remedy_names_arguments_of_python_or_options_of_the_command():
    plate = Plate(1.0, 12, 0.6, 17.5, np.array([532.0]), None, None, 0.1)
    picture = np.zeros((8, 8))
    picture[:2, :2] = 1
    found = Design.of(0.6 * np.random.default_rng(0).random((12, 12)), plate, wanted_fractions(picture, plate))
    finer = "its finest strokes are 1/8 of it, and the plate resolves 1/5: "
    assert Verdict.of(found, 8.0).remedy == finer + "texels 22"
    assert Verdict.of(found, 8.0, names={"detail": "--detail"}).remedy == finer + "--detail 8"


def test_a_plate_that_does_not_fit_into_the_memory_is_refused(monkeypatch):
    """A picture of half a degree, in texels of 20 µm, took 32 GB."""
    monkeypatch.setattr("mitsuba_diffraction.inverse_design.search.available_memory", lambda: 10**9)
    monkeypatch.setattr("mitsuba_diffraction.inverse_design.search._Search", None)
    message = r"^texel: got 32 of 20 µm, a period of 640 µm, whose prediction takes 32 GB of memory"
    with pytest.raises(ValueError, match=message):
        md.design(np.eye(8), texel=20.0, angle=0.5)


def test_depth_is_no_remedy_in_light_of_one_wavelength():
    picture = np.zeros((8, 8))
    picture[:2, :2] = 1
    heights = 0.5 * np.random.default_rng(0).random((12, 12))
    for wavelengths, is_remedy in (([532.0], False), ([430.0, 670.0], True)):
        plate = Plate(1.0, 12, 0.5, 17.5, np.array(wavelengths), None, None, 0.1)
        found = Design.of(heights, plate, wanted_fractions(picture, plate))
        assert ("height_range" in Verdict.of(found, 4.0).remedy) == is_remedy


@pytest.mark.few(1)
@pytest.mark.parametrize("options", [{"levels": 4, "height_range": 0.2}, {"levels": 3, "height_range": 0.18}])
def test_the_remedy_of_few_levels_works(options):
    found = md.design(lopsided(), wavelengths=532, texel=1.0, texels=16, starts=3, **options)
    assert Verdict.of(found).grade != "bad"


def test_a_plate_that_works_is_good(laser):
    verdict = Verdict.of(laser)
    assert verdict.grade == "good"
    assert str(verdict).startswith(f"good: {laser.efficiency[0]:.0%} of the light in the picture, contrast 0.")


@pytest.mark.parametrize(
    ("difference", "coloured", "grade", "words"),
    [
        (8.0, True, "good", "colours good (ΔE00 8)"),
        (12.0, True, "good", "colours fair (ΔE00 12)"),
        (24.0, True, "visible", "in other colours: 84% of the light in the picture, contrast 0.90, correlation 0.95, "),
        (24.0, False, "good", "correlation 0.95"),
    ],
)
def test_colours_are_in_the_verdict(difference, coloured, grade, words):
    """A sunset of ΔE00 24 came out teal, and was called good."""
    found = types.SimpleNamespace(
        light=0.84, contrast=0.9, correlation=[0.95], colour_difference=difference, coloured=coloured
    )
    verdict = Verdict.of(found)
    assert verdict.grade == grade
    assert words in str(verdict)
    assert ("one relief has no three pigments" in str(verdict)) == (grade == "visible")


def test_the_light_in_the_picture_is_of_what_its_colours_can_use():
    red = np.zeros((16, 16, 3))
    red[4:12, 9:15, 0] = 1
    found = md.design(red, wavelengths=[450, 550, 650], texel=1.0, texels=12, starts=1)
    fractions = found.in_picture(found.efficiency)
    assert found.coloured
    np.testing.assert_allclose(fractions * found.wanted.sum(axis=(1, 2)), np.minimum(found.efficiency, found.usable))
    assert (fractions[:2] > 2 * found.efficiency[:2]).all()  # of blue and green it can use little
    np.testing.assert_allclose(found.in_picture(found.efficiency, found.wavelengths + 1), fractions)


def test_the_page_states_the_thresholds():
    page = (Path(__file__).parents[2] / "docs" / "design.md").read_text()
    assert "ΔE00 of at most {good:.0f} is good, of at most {fair:.0f} fair".format(**COLOUR_BOUNDS) in page
    for name, (light, contrast, correlation) in (("good", GOOD_BOUNDS), ("the picture can be seen, ", VISIBLE_BOUNDS)):
        (row,) = [line for line in page.splitlines() if line.startswith(f"| {name}")]
        assert row.endswith(f"| ≥ {light:.0%} | ≥ {contrast:g} | ≥ {correlation:g} |".replace("%", " %"))


def test_a_relief_too_fine_for_infrared_light_is_warned_of():
    """Texels of 0.52 λ."""
    assert "(mean over 1550 nm and 0–20°, n = 1.5)" in unsearched(1550, texel=0.8, texels=16).warning


@pytest.mark.slow
@pytest.mark.parametrize("size", [0.4, 0.75])
def test_the_default_plate_casts_compact_pictures(size):
    """In white light 70 % of the light is inside, with a correlation of 0.9."""
    y, x = np.mgrid[1:-1:48j, -1:1:48j]
    target = (np.hypot(x, y) < size) if size < 0.5 else (np.abs(x) + np.abs(y - 0.1) < size * 1.25)
    assert 0.1 < target.mean() < 0.5
    found = md.design(target)
    assert found.efficiency.min() > 0.7
    assert found.correlation.min() > 0.9


CENTRE = np.zeros((65, 65))
CENTRE[31:34, 31:34] = 1


@pytest.mark.parametrize(
    ("target", "options", "message"),
    [
        (np.zeros((8, 8)), {}, "target: got black everywhere, wanted light somewhere"),
        (np.zeros((0, 8)), {}, r"target: got shape \(0, 8\), wanted"),
        (np.ones(8), {}, r"target: got shape \(8,\), wanted \(rows, columns\)"),
        (np.full((8, 8), np.nan), {}, "target: got 64 values that are negative or not finite"),
        (-np.eye(8), {}, "target: got 8 values that are negative"),
        (np.ones((8, 8, 4)), {}, r"target: got shape \(8, 8, 4\), with alpha"),
        ("heart.png", {}, "target: got str, wanted an array of numbers"),
        (CENTRE, {}, "target: it is the mirror direction only"),
        (np.eye(8), {"seen_on": "floor"}, "seen_on: got 'floor', wanted wall or screen"),
        (np.eye(8), {"unused": "nowhere"}, "unused: got 'nowhere', wanted outside or mirror"),
        (np.eye(8), {"texel": 0.3}, "texel: got 0.3 µm, wanted more than half the wavelength, 0.335 µm"),
        (np.eye(8), {"texel": 3}, "texel: got 3 µm with an angle of 17.5°, wanted less than 2.23 µm"),
        (
            np.eye(8),
            {"texels": 5},
            "texels: got 5 of 0.8 µm with an angle of 17.5°, wanted a period of at least 4.46 µm",
        ),
        (np.eye(8), {"texels": 32.5}, "texels: got 32.5, wanted a whole number"),
        (np.eye(8), {"height_range": 0}, "height_range: got 0, wanted a positive number of µm"),
        (np.eye(8), {"height_range": 800}, "height_range: got 800 µm, .* wanted at most 3.46 µm, 16 wavelengths"),
        (np.eye(8), {"tool_blur": 100}, "tool_blur: got 100 µm, wanted at most an eighth of the period, 3.2 µm"),
        (np.eye(8), {"tool_blur": -1}, "tool_blur: got -1, wanted 0 µm or more"),
        (np.eye(8), {"angle": 50}, "angle: got 50, wanted degrees above 0 and below 45"),
        (np.eye(8), {"wavelengths": 0.532}, "wavelengths: got 0.532, wanted one or several in nm"),
        (np.eye(8), {"wavelengths": []}, r"wavelengths: got \[\], wanted one or several"),
        (np.eye(8), {"int_ior": 1}, "int_ior: got 1, wanted an index above 1"),
        (
            *(np.eye(8), {"int_ior": "keratin", "wavelengths": 900}),
            r"int_ior: got light of 900 nm, and a table of 360 to 830 nm \(keratin\)",
        ),
        (np.eye(8), {"levels": 1}, "levels: got 1, wanted a whole number of at least 2"),
        (np.eye(8), {"starts": 0}, "starts: got 0, wanted a whole number of at least 1"),
        (np.eye(8), {"seed": -1}, "seed: got -1, wanted a whole number of at least 0"),
    ],
)
def test_mistakes_are_refused(target, options, message):
    with pytest.raises(ValueError, match=message):
        md.design(target, **options)


def test_a_sheet_with_dispersion_has_the_phase_of_each_wavelength():
    """κ of undiffracted light is 2π (1 − n)/λ, with n of the medium at λ."""
    common = {"texel": 1.0, "texels": 8, "height_range": 1.0, "wavelengths": (450.0, 650.0), "starts": 1}
    plate = md.design(np.eye(4), int_ior="PMMA", angle=20, **common).plate
    for wavelength, kappa in zip((0.45, 0.65), plate.kappa, strict=True):
        square = 1 + 1.1819 * wavelength**2 / (wavelength**2 - 0.011313)  # Sultanova et al. 2009
        sine = np.sin(np.radians(20)) / 2
        assert kappa == pytest.approx(2 * np.pi * (1 - np.sqrt(square - sine**2)) / wavelength, rel=1e-4)
    with pytest.raises(ValueError, match="int_ior: got 'glass', wanted a number, a file or one of BK7"):
        md.design(np.eye(4), int_ior="glass", angle=20, **common)
