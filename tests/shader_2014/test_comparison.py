"""The path tracer against the shader: measures against known numbers, pictures against Mitsuba's own integrators."""

import json
import re
from dataclasses import replace
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from bsdf_support import made_up
from PIL import Image

import mitsuba_diffraction as md
from mitsuba_diffraction.optics.color import delta_E, radiance_to_XYZ
from mitsuba_diffraction.render.scene_file import SceneFile
from mitsuba_diffraction.render.spectral_film import channel_wavelengths, channel_weights
from mitsuba_diffraction.shader_2014.comparison import ComparisonRequest, compare, figure, summary
from mitsuba_diffraction.shader_2014.comparison.difference import difference, noise, time_of_error, white_luminance
from mitsuba_diffraction.shader_2014.comparison.pictures import NO_SHADOWS, Pictures, supported_lights
from mitsuba_diffraction.shader_2014.comparison.quirk_costs import quirk_costs
from mitsuba_diffraction.shader_2014.evaluate import VARIANTS
from mitsuba_diffraction.shader_2014.quirks import Quirks

# A sphere above a plate, with a pigment; broad lobes, so that small pictures resolve them.
GRATING = """<bsdf type="diffraction_grating"><string name="profile" value="{profile}"/>
<float name="period" value="{period}"/><float name="depth" value="0.2"/><integer name="samples" value="64"/>
<float name="coherence_length" value="{coherence}"/>{base}</bsdf>"""
BASE = '<bsdf name="base" type="diffuse"><spectrum name="reflectance" value="0.05"/></bsdf>'
SUN = """<emitter type="directional"><vector name="direction" x="-0.3" y="0.2" z="-1"/>
<spectrum name="irradiance" type="d65"/></emitter>"""
MIRRORED = SUN.replace('x="-0.3" y="0.2" z="-1"', 'x="0" y="-0.77" z="-0.64"')  # by the plate into the camera
SKY = '<emitter type="constant"><spectrum name="radiance" value="0.02"/></emitter>'
PLATE = '<shape type="rectangle"><transform name="to_world"><scale x="3" y="3"/></transform>{}</shape>'
SPHERE = '<shape type="sphere"><point name="center" x="0" y="0" z="1.2"/>{}</shape>'
SCENE = """<scene version="3.0.0">{integrator}<sensor type="perspective"><float name="fov" value="35"/>
<transform name="to_world"><lookat origin="0,-6,5" target="0,0,0.7" up="0,0,1"/></transform><film type="hdrfilm">
<integer name="width" value="16"/><integer name="height" value="12"/><rfilter type="{rfilter}"/></film></sensor>
{light}{shapes}</scene>"""


def write(
    path, light=SUN, bsdf=None, shapes=SPHERE + PLATE, integrator='<integrator type="path"/>', rfilter="box", **of
):
    """A scene file; `of` are period, coherence, profile and base of its gratings."""
    of = {"profile": "blazed", "period": 2.0, "coherence": 3.0, "base": BASE, **of}
    shapes = shapes.replace("{}", bsdf or GRATING.format(**of))
    path.write_text(SCENE.format(light=light, shapes=shapes, integrator=integrator, rfilter=rfilter))
    return path


def to_xyz(tensor):
    return radiance_to_XYZ(np.array(tensor) / channel_weights(), channel_wavelengths())


# --- Differences ------------------------------------------------------------------------------------------------------


def xyz_of(lab):
    """CIELAB under D65 → XYZ, by its definition (CIE 15)."""
    f_y = (lab[0] + 16) / 116
    f = np.array([f_y + lab[1] / 500, f_y, f_y - lab[2] / 200])
    x, y = 0.3127, 0.3290
    return np.where(f > 6 / 29, f**3, 3 * (6 / 29) ** 2 * (f - 4 / 29)) * [x / y, 1, (1 - x - y) / y]


@pytest.mark.parametrize(
    ("first", "second", "expected"),
    [  # Sharma, Wu and Dalal 2005, table 1: pairs 1, 5, 17, 25
        ((50, 2.6772, -79.7751), (50, 0, -82.7485), 2.0425),
        ((50, -1.1848, -84.8006), (50, 0, -82.7485), 1.0000),
        ((50, 2.5, 0), (73, 25, -18), 27.1492),
        ((60.2574, -34.0099, 36.2677), (60.4626, -34.1751, 39.4387), 1.2644),
    ],
)
def test_ciede2000_is_that_of_the_published_pairs(first, second, expected):
    assert delta_E(xyz_of(first), xyz_of(second)) == pytest.approx(expected, abs=2e-4)


def test_exposure_is_matched_and_stated():
    random = np.random.default_rng(1)
    reference = random.uniform(0.1, 2, (6, 5, 3))
    where = random.random((6, 5)) > 0.3
    found = difference(reference, reference / 3, where, 1.5)
    assert found.exposure == pytest.approx(3)
    assert found.max == pytest.approx(0, abs=1e-9)
    assert found.luminance_error == pytest.approx(0, abs=1e-12)
    assert np.array_equal(np.isnan(found.delta_e), ~where)


def test_a_difference_has_the_known_numbers():
    grey = np.array([0.95047, 1, 1.08883]) * np.array([0.2, 0.4])[:, None, None] * np.ones((2, 50, 1))
    other = grey.copy()
    other[0], other[1] = 0.3, 0.3  # the same sum
    other *= [0.95047, 1, 1.08883]
    where = np.ones((2, 50), bool)
    found = difference(grey, other, where, 1.0)
    assert found.exposure == pytest.approx(1)
    assert found.luminance_error == pytest.approx(0.2 / 0.6)
    each = delta_E(grey[:, 0], other[:, 0])
    assert (found.mean, found.max) == pytest.approx((each.mean(), each.max()))
    assert found.percentile_95 == pytest.approx(np.percentile(np.repeat(each, 50), 95))
    # Nothing is brighter than white.
    assert difference(grey, other, where, 1e-3).max < 0.1


def test_a_black_picture_has_no_exposure():
    with pytest.raises(ValueError, match="wanted positive"):
        difference(np.ones((2, 2, 3)), np.zeros((2, 2, 3)), np.ones((2, 2), bool), 1.0)


def test_the_time_of_an_error_is_interpolated_in_logarithms():
    seconds, errors = (1.0, 4.0, 16.0), (8.0, 4.0, 2.0)
    assert time_of_error(4 / 2**0.5, seconds, errors) == pytest.approx(8)
    assert time_of_error(9.0, seconds, errors) == 1
    assert np.isnan(time_of_error(1.0, seconds, errors))
    assert np.isnan(time_of_error(1.0, (), ()))


def test_noise_is_estimated_from_two_halves():
    random = np.random.default_rng(2)
    truth = np.full((60, 60, 3), 0.4)
    halves = truth + 0.01 * random.normal(size=(2, 60, 60, 3))
    where = np.ones((60, 60), bool)
    assert noise(halves, where, 1.0) == pytest.approx(delta_E(truth, halves.mean(0)).mean(), rel=0.05)
    assert noise(None, where, 1.0) is None


# --- Quirks -----------------------------------------------------------------------------------------------------------


@pytest.mark.few(1)
@pytest.mark.parametrize(
    "kind", [pytest.param(kind, marks=[pytest.mark.slow] * (kind in ("nmm", "pq"))) for kind in VARIANTS]
)
def test_each_shader_names_the_quirks_that_change_it(kind):
    mi.set_variant("llvm_ad_spectral")
    surface = md.HeightField(np.random.default_rng(1).normal(0, 0.05, (14, 16)), 0.3)
    # PQ has no window and therefore no taper; two tiles along each axis.
    extent = {"extent": "sample"} if kind in ("flss", "nmm") else {}
    lengths = {"coherence_length": 4.0, "corrected_coherence_length": 2.0 if extent else 8.0}
    more = {} if kind == "gem" else {"terms": 5, "exact_fresnel": True, **lengths, **extent}

    def colours(quirks):
        shader = VARIANTS[kind](surface, quirks, **more)
        light = np.linspace(0.5, 1.5, 401)
        weights = shader.weights(0.1, light)
        wo = [
            mi.Vector3f(x, y, float(np.sqrt(1 - x * x - y * y)))
            for x, y in ((-0.61, 0.33), (0.42, -0.27), (0.1, 0.7), (-0.28, -0.17))
        ]
        return np.array([shader.rgb(mi.Vector3f(0.3, 0.2, float(np.sqrt(0.87))), w, weights) for w in wo]).ravel()

    plain = colours(Quirks.corrected())
    changing = [
        name
        for name in Quirks.names()
        if not np.allclose(colours(replace(Quirks.corrected(), **{name: True})), plain, rtol=1e-4, atol=1e-6)
    ]
    # The number of terms is given here.
    assert set(changing) == set(VARIANTS[kind].own_quirks) - {"fixed_terms"}


@pytest.mark.parametrize("kind", VARIANTS)
def test_a_shader_with_changed_quirks_is_that_made_anew(kind):
    mi.set_variant("llvm_ad_spectral")
    surface = md.HeightField(np.random.default_rng(1).normal(0, 0.05, (4, 6)), 0.3)
    more = {} if kind == "gem" else {"terms": 4}
    wi, wo = mi.Vector3f(0.3, 0.2, 0.933), mi.Vector3f(-0.2, 0.1, 0.975)
    for first, second in ((True, False), (False, True)):
        quirks = [Quirks.as_published() if published else Quirks.corrected() for published in (first, second)]
        fresh = VARIANTS[kind](surface, quirks[1], **more)
        changed = VARIANTS[kind](surface, quirks[0], **more).with_quirks(quirks[1])
        np.testing.assert_array_equal(*(np.array(s.rgb(wi, wo, s.weights())) for s in (fresh, changed)))


# --- Pictures ---------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("rfilter", ["gaussian", "box"])
def test_the_integrator_converges_to_the_shader(llvm, tmp_path, rfilter):
    pictures = Pictures(write(tmp_path / "scene.xml", rfilter=rfilter), "gem", brightness=3000)
    for quirks in (("constant_blend", NO_SHADOWS), ()):
        found = pictures.shaded(quirks, 64, 256)
        switches = {name: name in quirks for name in Quirks.names()}
        parameters = {"type": "diffraction_shader", "variant": "gem", "shadows": NO_SHADOWS not in quirks, **switches}
        parameters["brightness"] = found.brightness
        expected = to_xyz(mi.render(pictures.scene, integrator=mi.load_dict(parameters), spp=1024, seed=3))
        assert np.abs(found.xyz - expected).sum() < 0.03 * expected.sum()
        np.testing.assert_allclose(found.xyz.sum((0, 1)), expected.sum((0, 1)), rtol=0.01)
        assert found.samples == 64
        assert found.seconds > 0


@pytest.mark.slow
def test_the_same_light_is_direct_light(llvm, tmp_path):
    pictures = Pictures(write(tmp_path / "scene.xml"), "gem")
    found = pictures.same_light(256, 1024)
    direct = mi.load_dict({"type": "direct", "emitter_samples": 1, "bsdf_samples": 0})
    expected = to_xyz(mi.render(pictures.scene, integrator=direct, spp=1024, seed=5))
    np.testing.assert_allclose(found.xyz.sum((0, 1)), expected.sum((0, 1)), rtol=0.02)
    assert np.abs(found.xyz - expected).sum() < 0.1 * expected.sum()
    # Of the sky it sees nothing, the path tracer does.
    under_sky = Pictures(write(tmp_path / "sky.xml", SUN + SKY), "gem")
    np.testing.assert_allclose(under_sky.same_light(16, 64).xyz, pictures.same_light(16, 64).xyz, rtol=1e-5, atol=1e-9)
    assert under_sky.path_traced(64).xyz.sum() > 1.3 * expected.sum()
    # Two halves make the whole.
    np.testing.assert_allclose(found.halves.mean(0), found.xyz, rtol=1e-4, atol=1e-7)
    assert not np.array_equal(*found.halves)


@pytest.mark.slow
@pytest.mark.parametrize(("ratio", "agrees"), [(0.45, False), (1.5, True)])
def test_corrected_the_shader_converges_to_the_model_within_the_limit(llvm, tmp_path, ratio, agrees):
    # Coherence length over tile. Without E, which the shader lacks. K and G are those of an order in the BSDF and those
    # of the pair in the shader: within a lobe they differ by a few per cent if the period is 3 µm, and less if longer.
    without = '<boolean name="conserve_energy" value="false"/>'
    of = {"base": without, "profile": "sinusoidal", "period": 5.0, "coherence": 5.0 * ratio}
    scene = write(tmp_path / "scene.xml", MIRRORED, shapes=PLATE, **of)
    pictures = Pictures(scene, "flss", width=8, settings={"window": "texel"})
    model, shader = pictures.same_light(64, 1), pictures.shaded((), 64, 1)
    # Of the corrected shader, shaded last.
    assert pictures.truncated_fraction == pytest.approx(np.exp(-((1.5 * np.pi * ratio / 2) ** 2)))
    white = model.xyz[pictures.mask][:, 1].max()
    found = difference(model.xyz, shader.xyz, pictures.mask, white)
    if agrees:
        assert found.mean < 0.3
        assert found.exposure == pytest.approx(1, abs=0.01)
    else:
        assert found.mean > 2
        assert 0.02 < abs(found.exposure - 1) < 4 * pictures.truncated_fraction
    published = difference(model.xyz, pictures.shaded(pictures.quirks, 64, 1).xyz, pictures.mask, white)
    assert published.mean > 10 * found.mean


@pytest.mark.slow
@pytest.mark.parametrize("snake", ["elaphe", "xenopeltis"])
def test_corrected_the_shader_agrees_with_the_model_on_a_snake(llvm, snake):
    scene = Path(__file__).parents[2] / "scenes" / f"{snake}.xml"
    pictures = Pictures(scene, "flss", width=48, parameters={"light": "sun"})
    model = pictures.same_light(4, 16)
    white = white_luminance(model.xyz, pictures.mask)
    corrected, published = (
        difference(model.xyz, pictures.shaded(quirks, 4, 16).xyz, pictures.mask, white).mean
        for quirks in ((), pictures.quirks)
    )
    # The shader has one transform of the tapered scan, and no E.
    assert corrected < 0.5
    assert published > 10 * corrected


@pytest.mark.slow
def test_only_pixels_covered_by_gratings_are_compared(llvm, tmp_path):
    plate = PLATE.replace("{}", '<bsdf type="diffuse"/>')
    pictures = Pictures(write(tmp_path / "scene.xml", shapes=SPHERE + plate), "gem", width=64)
    rows, columns = pictures.mask.shape
    assert (rows, columns) == (48, 64)
    # The disc of a sphere at the distance √(6² + 3.8²), seen through 35° over 64 pixels, less its rim.
    radius = np.tan(np.arcsin(1 / np.hypot(6, 3.8))) / np.tan(np.deg2rad(17.5)) * 32
    disc = np.pi * radius**2
    assert disc - 2 * np.pi * radius < pictures.mask.sum() < disc


@pytest.mark.slow
@pytest.mark.parametrize("pigment", [True, False])
def test_brightness_is_fitted_to_the_diffraction_of_this_model(llvm, tmp_path, pigment):
    pictures = Pictures(write(tmp_path / "scene.xml"), "gem", width=8, pigment=pigment)
    assert pictures.has_base == pigment
    found, model = pictures.shaded((NO_SHADOWS,), 16, 64), pictures.same_light(16, 64)
    assert model.brightness is None

    def diffraction(picture):
        # The base of the same scene, without noise of its own: the light of BSDFs other than gratings is the same.
        below = Pictures(tmp_path / "scene.xml", "gem", width=8, pigment=pigment, brightness=1e-9)
        rest = below.shaded(((NO_SHADOWS,) if picture is found else ()), 16, 64)
        return (picture.xyz - rest.xyz)[pictures.mask][:, 1].mean()

    assert diffraction(found) == pytest.approx(diffraction(model), rel=1e-3)
    if not pigment:
        assert diffraction(found) == pytest.approx(found.xyz[pictures.mask][:, 1].mean(), rel=1e-5)
    # The number is that of the integrator, and a given one is kept.
    given = Pictures(tmp_path / "scene.xml", "gem", width=8, pigment=pigment, brightness=found.brightness)
    again = given.shaded((NO_SHADOWS,), 16, 64)
    assert again.brightness == found.brightness
    np.testing.assert_allclose(again.xyz, found.xyz, rtol=1e-4, atol=1e-6 * found.xyz.max())


@pytest.mark.slow
def test_a_crop_window_is_compared_alone(llvm, tmp_path):
    scene = write(tmp_path / "scene.xml")
    whole = Pictures(scene, "gem", brightness=1000)  # not the one found from the pixels
    window = '<integer name="crop_offset_x" value="4"/><integer name="crop_width" value="8"/>'
    scene.write_text(scene.read_text().replace('<integer name="width"', window + '<integer name="width"'))
    cropped = Pictures(scene, "gem", brightness=1000)
    assert cropped.film_size == (16, 12)
    np.testing.assert_array_equal(cropped.mask, whole.mask[:, 4:12])
    pair = [pictures.shaded((), 256, 64).xyz for pictures in (cropped, whole)]
    pair[1] = pair[1][:, 4:12]
    assert np.abs(pair[0] - pair[1]).sum() < 0.05 * pair[1].sum()


@pytest.mark.slow
def test_the_cost_of_a_quirk_is_that_of_renderings_without_it(llvm, tmp_path):
    pictures = Pictures(write(tmp_path / "scene.xml", SUN + SKY), "gem", width=8)
    names = ("constant_blend", NO_SHADOWS)
    assert sorted(pictures.quirks) == sorted(names)
    steps = []
    found = quirk_costs(pictures, 16, 4, lambda done, total: steps.append((done, total)))
    assert steps == [(i + 1, 7) for i in range(7)]
    assert found.size == (8, 6)
    reference = pictures.same_light(4, 16)
    white = white_luminance(reference.xyz, pictures.mask)

    def mean(*quirks):
        return difference(reference.xyz, pictures.shaded(quirks, 4, 16).xyz, pictures.mask, white).mean

    assert found.published == pytest.approx(mean(*names))
    assert found.corrected == pytest.approx(mean())
    one = found.quirks["constant_blend"]
    assert one.drop == pytest.approx(mean(*names) - mean(NO_SHADOWS))
    assert one.rise == pytest.approx(mean("constant_blend") - mean())
    assert one.fraction == pytest.approx((one.drop + one.rise) / 2 / mean(*names))
    # The sphere casts a shadow on the plate.
    shadow = found.quirks[NO_SHADOWS]
    assert shadow.rise == pytest.approx(mean(NO_SHADOWS) - mean())
    assert shadow.rise > 0


def test_the_reads_per_point_are_those_of_the_tables(llvm, tmp_path):
    pictures = Pictures(write(tmp_path / "scene.xml", base=""), "flss", width=4)
    assert pictures.shader_reads == 81 * 37 * 9
    spectrum = pictures.spectra[0]
    assert pictures.model_reads == 4 * np.prod(spectrum.neighbours)  # slices: a packet a node, four wavelengths
    assert "constant_blend" not in pictures.quirks


# --- The command ------------------------------------------------------------------------------------------------------


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def names():
    return {path.name for path in Path().iterdir()}


@pytest.mark.slow
def test_compare_writes_pictures_numbers_and_a_figure(command, llvm, folder):
    write(Path("scene.xml"), SUN + SKY)
    code, out, err = command(
        "compare scene.xml --shader gem --spp 8 --width 12 --json numbers.json -o . --variant llvm_ad_spectral"
    )
    assert (code, err) == (0, "")
    files = {"scene-gem-path.exr", "scene-gem-published.exr", "scene-gem-corrected.exr", "scene-gem.png"}
    assert names() == {"scene.xml", "numbers.json", *files}
    numbers = json.loads(Path("numbers.json").read_text(encoding="utf-8"))
    found = numbers["to_path_traced"]["published"]
    assert f"{found['mean']:.2f}" in out
    assert f"{found['exposure']:.3g}" in out
    assert 0 < found["mean"] <= found["percentile_95"] <= found["max"]
    assert numbers["costs"]["size"] == [12, 9]
    assert {*numbers["costs"]["quirks"][NO_SHADOWS]} == {"drop", "rise", "fraction"}
    assert NO_SHADOWS in out
    assert "constant_blend" not in out  # nothing is blended without pigment
    brightness = numbers["pictures"]["published"]["brightness"]
    assert f" {brightness:.3g} " in out
    assert numbers["published_brightness"] == 1000
    assert numbers["pictures"]["same_light"]["brightness"] is None
    few = numbers["few_samples"]
    assert [samples for samples, _, _ in few] == [1, 4]
    assert few[0][2] > few[1][2]
    assert "seconds of path tracer: " in out
    assert re.search(r"\n\s*\nquirk +cause", out)  # a line between the tables
    # The pictures are those of the numbers.
    path, published = (md.render.SpectralImage.load(f"scene-gem-{name}.exr") for name in ("path", "published"))
    xyz = [radiance_to_XYZ(image.radiance, image.wavelengths) for image in (path, published)]
    mask = Pictures("scene.xml", "gem", width=12, pigment=False).mask
    again = difference(*xyz, mask, numbers["white"])
    assert again.mean == pytest.approx(found["mean"], rel=1e-3)
    with Image.open("scene-gem.png") as picture:
        assert picture.width > 1000
        assert np.ptp(np.asarray(picture.convert("L"))) > 100


@pytest.mark.slow
def test_a_coat_is_noted(llvm, folder):
    write(Path("scene.xml"), base=BASE + '<float name="coat_ior" value="1.5"/>')
    small = {"width": 4, "spp": 1, "shading_points": 1}
    request = ComparisonRequest("scene.xml", "flss", **small, costs=False, brightness=1000, pigment=True)
    found = compare(request)
    assert found.coated
    for coated in (True, False):
        heads = [line.split(":")[0] for line in summary.notes(replace(found, coated=coated))]
        assert (heads.count("coat"), heads.count("limit")) == (coated, not coated)
    write(Path("bare.xml"))
    assert not Pictures("bare.xml", width=4).has_coat


@pytest.mark.slow
def test_several_shaders_are_compared_with_their_options(llvm, folder):
    write(Path("scene.xml"))
    settings = {"terms": 6, "window": "texel", "width": 16, "spp": 2, "shading_points": 2}
    found = compare(ComparisonRequest("scene.xml", "gem", ("flss",), **settings, costs=False))
    assert [*found.pictures] == [
        *("path_traced", "same_light", "published", "corrected", "flss_published", "flss_corrected"),
    ]
    assert found.shader_reads == {
        "published": 0, "corrected": 0, "flss_published": 81 * 6 * 9, "flss_corrected": 81 * 6 * 9
    }  # fmt: skip
    assert {*found.to_path_traced} == {*found.pictures} - {"path_traced"}
    assert found.noise["flss_corrected"] > 0
    [(count, seconds, _)] = found.few_samples
    assert count == 1
    assert seconds > 0
    assert {*summary.titles(found).values()} >= {"GEM as published", "FLSS corrected"}
    for is_others in (False, True):
        figure.save_figure(found, "figure.png", others=is_others)
        with Image.open("figure.png") as picture:
            assert picture.width == 1600
    assert summary.as_dict(found)["settings"] == {"terms": 6, "window": "texel"}


@pytest.mark.slow
def test_the_same_seed_gives_the_same_numbers(llvm, folder):
    write(Path("scene.xml"), rfilter="gaussian")
    request = ComparisonRequest("scene.xml", "gem", spp=16, seed=1, costs=False)
    found = [compare(request) for _ in range(2)]
    for first, second in zip(*(one.pictures.values() for one in found), strict=True):
        np.testing.assert_array_equal(first.image.radiance, second.image.radiance)
    numbers = [summary.as_dict(one) for one in found]
    assert numbers[0]["costs"] is None
    for one in numbers:
        del one["pictures"], one["few_samples"]  # seconds
    assert numbers[0] == numbers[1]
    # There is a figure without the costs, too.
    figure.save_figure(found[0], "figure.png")
    with Image.open("figure.png") as picture:
        assert picture.width == 1600


def test_lights_that_the_shader_supports_are_found():
    scene = Path(__file__).parents[2] / "scenes" / "xenopeltis_sphere.xml"
    assert supported_lights(SceneFile(scene)) == ("bulb", "parallel", "sun")
    assert supported_lights(SceneFile(scene, {"light": "bulb"})) is None


@pytest.mark.slow
def test_a_recipe_is_compared_on_the_objects_of_a_scene(command, llvm, folder):
    recipe = '[surface]\nprofile = "blazed"\nperiod = 2.5\ndepth = 0.2\n[spectrum]\ncoherence_length = 3\n'
    Path("skin.toml").write_text(recipe)
    code, _, err = command("compare skin.toml --shader gem --spp 2 --width 12 --no-costs")
    assert code == 0, err
    assert "note: the shader does not know the lights of scan.xml: light=parallel, of bulb, parallel, sun" in err
    assert names() == {"skin.toml", "skin-gem.png", *(f"skin-gem-{p}.exr" for p in ("path", "published", "corrected"))}


@pytest.mark.few(2)
@pytest.mark.parametrize(
    ("arguments", "of", "words"),
    [
        ("gone.xml", {}, "gone.xml"),
        ("scene.xml --shader flsss", {}, "shader: got 'flsss', wanted one of flss, nmm, pq, nmm_pq, gem"),
        ("scene.xml --interpolation linear", {}, "interpolation: got 'linear', which flss cannot use"),
        ("scene.xml --brightness -1", {}, "brightness: got -1.0, wanted a finite number that is not negative"),
        ("scene.xml --brightness nan", {}, "brightness: got nan, wanted a finite number that is not negative"),
        ("scene.xml --brightness bright", {}, "--brightness: got 'bright', wanted auto or a number"),
        ("scene.xml --window wide", {}, "window: got 'wide', wanted one of texel, 4sigma"),
        ("scene.xml -o nowhere/out", {}, "the folder nowhere is not there"),
        ("scene.xml --json nowhere/out.json", {}, "the folder nowhere is not there"),
        ("scene.xml --spp 0", {}, "--spp"),
        ("scene.xml -D colour", {}, "-D: got 'colour', wanted NAME=VALUE"),
        ("scene.xml --variant scalar_spectral", {}, "is scalar; use one of"),
        ("scene.xml", {"light": SKY}, "no directional or point light"),
        ("scene.xml", {"bsdf": '<bsdf type="diffuse"/>'}, "no shape has a diffraction_grating"),
        ("scene.xml", {"integrator": '<integrator type="diffraction_shader"/>'}, "its integrator is the shader itself"),
        (
            "scene.xml",
            {"bsdf": '<bsdf type="diffraction_grating"><string name="filename" value="blaze.exr"/></bsdf>'},
            "a saved spectrum does not contain",
        ),
        (
            "scene.xml",
            {"bsdf": '<bsdf type="diffraction_grating"><string name="filename" value="ruled.exr"/></bsdf>'},
            "got a grating with theory=rigorous, wanted one of scalar theory",
        ),
    ],
)
def test_a_mistake_is_one_line_and_exit_code_2(command, llvm, folder, arguments, of, words):
    write(Path("scene.xml"), **of)
    md.precompute(md.gratings.blazed(2.5, 0.25, samples=64), coherence_length=20).save("blaze.exr")
    made_up().save("ruled.exr")
    before = names()
    code, out, err = command(f"compare {arguments}")
    assert (code, out) == (2, "")
    assert len(err.splitlines()) == 1, err
    assert words in err
    assert names() == before


@pytest.mark.slow
@pytest.mark.parametrize("error", [KeyboardInterrupt(), OSError("disk full")])
def test_a_failed_comparison_leaves_no_files(command, monkeypatch, llvm, folder, error):
    write(Path("scene.xml"))

    def fail(*args, **kwargs):
        raise error

    monkeypatch.setattr(figure, "save_figure", fail)
    code, out, err = command("compare scene.xml --shader gem --spp 1 --width 4 --no-costs")
    assert (code, out) == (130 if isinstance(error, KeyboardInterrupt) else 1, "")
    assert len(err.splitlines()) == 1
    assert names() == {"scene.xml"}
