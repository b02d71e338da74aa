"""The page in a real browser: values against the BSDF, interaction, and what leaves the page."""

import base64
import io
import json
import re
import shutil
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from PIL import Image

from mitsuba_diffraction import testing
from mitsuba_diffraction.bsdf.directions import rotated
from mitsuba_diffraction.optics.color import (
    XYZ_to_linear_sRGB,
    auto_exposure,
    delta_E,
    into_gamut,
    on_screen,
    radiance_to_linear_sRGB,
    radiance_to_XYZ,
)
from mitsuba_diffraction.render import render
from mitsuba_diffraction.shader_2014.diffraction_shader import PUBLISHED_BRIGHTNESS
from mitsuba_diffraction.shader_2014.evaluate import VARIANTS, shader_for
from mitsuba_diffraction.shader_2014.quirks import Quirks
from mitsuba_diffraction.viewer import page as pages
from mitsuba_diffraction.viewer.viewed_surface import ViewedSurface

sync_api = pytest.importorskip("playwright.sync_api", reason="the package playwright is not installed")

RECIPES = Path(__file__).parents[2] / "precompute"
CHROMIUM = shutil.which("chromium")
DISC = {"material": "Al", "coat_ior": 1.55}
OPTIONS = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox"]


@pytest.fixture(scope="module")
def browser():
    """Chromium with its software renderer."""
    if CHROMIUM is None:
        pytest.skip("chromium is not installed (apt-get install chromium)")
    with sync_api.sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=CHROMIUM, args=OPTIONS)
        yield chromium
        chromium.close()


@pytest.fixture
def opened(browser, tmp_path):
    """opened(surface, picture): its page, ready; the messages and requests of the page are collected in `messages`."""
    tabs = []

    def of(surface, *others, picture=None, fragment=""):
        path = tmp_path / f"{len(tabs)}.html"
        path.write_text(pages.page(surface, *others, picture=picture), encoding="utf-8")
        tab = browser.new_page(viewport={"width": 420, "height": 400})
        tab.messages = []
        tab.on("console", lambda message: tab.messages.append(message.text))
        tab.on("pageerror", lambda error: tab.messages.append(str(error)))
        tab.on("request", lambda request: tab.messages.append(request.url[:80]))
        tab.goto(path.as_uri() + fragment)
        tab.evaluate("viewer.ready")
        tabs.append(tab)
        return tab

    yield of
    for tab in tabs:
        tab.close()


def call(tab, function, *arguments):
    """Call a function of the page; numbers travel as JSON, six times faster than as values of Playwright."""
    called = f"async (text) => JSON.stringify(await ({function})(...JSON.parse(text)))"
    return np.array(json.loads(tab.evaluate(called, json.dumps(arguments))))


def wait_for_frames(tab):
    """Wait until all frames of the present state are drawn; a change is seen in the next animation frame."""
    tab.evaluate("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
    drawn = "viewer.renderer.colours.isReady && viewer.renderer.sides.every((s) => s.frame >= viewer.state.maxFrames)"
    while not tab.evaluate(drawn):
        tab.wait_for_timeout(50)


def pairs_of(spectrum, count=10_000, seed=1):
    """ω_i, ω_o and λ: for half of the pairs q lies near a strong order or node, for the others it is random."""
    random = np.random.default_rng(seed)
    wi = testing.direction(np.rad2deg(np.arccos(random.random(count))), 360 * random.random(count))
    wavelength = random.uniform(380, 780, count)
    powers = np.abs(spectrum.powers(20.0)).ravel()
    node = random.choice(powers.size, count, p=powers / powers.sum())
    x, y = spectrum.grid.frequencies()
    centre = np.stack([x[node % len(x)], y[node // len(x)]], -1)
    q = centre + random.normal(0, spectrum.lobe_width, (count, 2))
    wo = testing.towards(wi, q, wavelength)
    anywhere = testing.direction(np.rad2deg(np.arccos(random.random(count))), 360 * random.random(count))
    wo = np.where((np.isnan(wo[:, 2]) | (random.random(count) < 0.2))[:, None], anywhere, wo)
    return np.concatenate([wi, wo, wavelength[:, None]], -1).astype(np.float32)


@pytest.mark.parametrize(
    ("source", "parameters", "changes"),
    [
        pytest.param("blaze.toml", {}, {}, marks=pytest.mark.slow),
        pytest.param("blaze.toml", {"material": "Au", "height_scale": 0.7}, {}, marks=pytest.mark.slow),
        ("blaze.toml", {"material": "Au", "coat_ior": 1.6}, {}),
        pytest.param("blaze.toml", {"coat_ior": 1.35}, {"hasBase": True, "pigment": "#7c3f95"}, marks=pytest.mark.slow),
        pytest.param("foil_crossed.toml", {"material": "Al", "coat_ior": 1.5}, {}, marks=pytest.mark.slow),
        pytest.param("elaphe_afm.toml", {"material": "Ag", "coat_ior": 1.5}, {}, marks=pytest.mark.slow),
        pytest.param("compact_disc.toml", {}, {}, marks=pytest.mark.slow),
        pytest.param("foil_crossed.toml", {"material": "none"}, {}, marks=pytest.mark.slow),
        pytest.param(
            "elaphe_afm.toml", {"int_ior": 1.5}, {"hasBase": True, "pigment": "#7c3f95"}, marks=pytest.mark.slow
        ),
        pytest.param("elaphe.toml", {"int_ior": 1.7}, {}, marks=pytest.mark.slow),
        pytest.param("xenopeltis.toml", {}, {}, marks=pytest.mark.slow),
    ],
)
def test_values_are_those_of_the_bsdf(source, parameters, changes, opened, llvm):
    """10,000 pairs of directions and wavelengths, to 1e-3 of the largest value."""
    surface = ViewedSurface.named(RECIPES / source, parameters)
    pairs = pairs_of(surface.spectrum)
    tab = opened(surface)
    tab.evaluate("(changes) => viewer.set(changes)", {"maxFrames": 1, "hasBase": False, **changes})
    values = call(tab, "viewer.evaluate", pairs.ravel().tolist())
    base = {}
    if changes:
        pigment = [int(changes["pigment"][i : i + 2], 16) / 255 for i in (1, 3, 5)]
        linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in pigment]
        base = {"base": {"type": "diffuse", "reflectance": {"type": "rgb", "value": linear}}}
    bsdf = mi.load_dict(
        {
            **{"type": "diffraction_grating", "filename": str(RECIPES / source), "conserve_energy": False},
            **{**parameters, **base, **(DISC if source == "compact_disc.toml" else {})},
        }
    )
    wanted = testing.evaluate(bsdf, pairs[:, :3], pairs[:, 3:6], pairs[:, 6:])[:, 0]
    assert (wanted > 1e-3 * wanted.max()).mean() > 0.1
    np.testing.assert_allclose(values, wanted, rtol=0, atol=1e-3 * wanted.max())


@pytest.mark.parametrize(
    ("source", "changes", "mean", "percentile_95"),
    [
        pytest.param("blaze.toml", {}, 0.5, 1.5, marks=pytest.mark.slow),
        *(
            # Steps at Rayleigh anomalies err most in the widest lobes.
            pytest.param("blaze.toml", {"coherenceLength": length, "material": "Au"}, 0.5, 2.5, marks=pytest.mark.slow)
            for length in (3, 6, 9, 14, 25, 40)
        ),
        pytest.param("foil_crossed.toml", {"hasBase": True}, 0.5, 1.5, marks=pytest.mark.slow),
        pytest.param("foil_crossed.toml", {"coherenceLength": 7, "material": "none"}, 0.5, 1.5, marks=pytest.mark.slow),
        ("elaphe_afm.toml", {"material": "Cu"}, 0.5, 1.5),
    ],
)
def test_colours_are_integrals_over_the_wavelength(source, changes, mean, percentile_95, opened):
    """Look-ups against f cos θ_i of the BSDF at each half nm: CIEDE2000 and the flux."""
    surface = ViewedSurface.named(RECIPES / source, {})
    tab = opened(surface)
    tab.evaluate("(changes) => viewer.set(changes)", {"maxFrames": 1, **changes})
    pairs = pairs_of(surface.spectrum, 400)
    pairs = pairs[pairs[:, [2, 5]].min(axis=1) > 0.1]
    found = call(tab, "viewer.evaluateColours", pairs.ravel().tolist()).reshape(-1, 4)[:, :3]
    wavelengths = np.arange(380.0, 740.1, 0.5)
    # Arranged in the browser, as a list of all pairs at all wavelengths takes long to get there.
    of_all = "(p, of) => viewer.evaluate(of.flatMap((w) => p.map((x, k) => (k % 7 === 6 ? w : x))))"
    values = call(tab, of_all, pairs.ravel().tolist(), wavelengths.tolist()).reshape(len(wavelengths), len(pairs))
    table = pages._light().astype(np.float64)
    weights = [np.interp(wavelengths, np.arange(360, 831), table[:, k] * table[:, 3]) for k in range(3)]
    wanted = np.trapezoid(values[..., None] * np.transpose(weights)[:, None], wavelengths, axis=0)
    wanted *= (pairs[:, 2] / pairs[:, 5])[:, None]
    assert (wanted.max(axis=1) > 1e-3 * wanted.max()).mean() > 0.1
    exposure = auto_exposure(into_gamut(XYZ_to_linear_sRGB(wanted)))
    error = delta_E(exposure * found, exposure * wanted)
    assert error.mean() < mean
    assert np.percentile(error, 95) < percentile_95
    assert found.sum() == pytest.approx(wanted.sum(), rel=0.03)


@pytest.mark.slow
@pytest.mark.parametrize("published", [True, False], ids=["published", "corrected"])
@pytest.mark.parametrize("source", ["blaze.toml", "elaphe_afm.toml"])
def test_colours_are_those_of_the_shader_of_2014(source, published, opened, llvm):
    """All variants in linear RGB, to 1e-3 of the largest value; the blend is not part of it."""
    surface = ViewedSurface.named(RECIPES / source, {})
    pairs = pairs_of(surface.spectrum, 1000)
    tab = opened(surface)
    tab.evaluate("viewer.set({ maxFrames: 1 })")
    quirks = Quirks.as_published() if published else Quirks.corrected()
    field, light = surface.recipe.height_field(), pages._light()[20:421, 3]
    # The page has no other light than D65.
    assert {*tab.evaluate("viewer.state.quirks"), "d65_light", "fixed_terms"} == set(Quirks.names())
    assert tab.evaluate("viewer.state.brightness") == PUBLISHED_BRIGHTNESS
    for variant in VARIANTS:
        # Fewer terms, whose differences in the order of summation do not grow.
        settings = {"corrected_coherence_length": surface.spectrum.coherence_length, "exact_fresnel": True, "terms": 25}
        settings["extent"] = surface.recipe.settings.extent
        shader = shader_for(field, variant, quirks, **({} if variant == "gem" else settings))
        wi, wo = testing.vectors(pairs[:, :3]), testing.vectors(pairs[:, 3:6])
        wanted = testing.array(shader.rgb(wi, wo, shader.weights(light=light)), np.float64).T
        if shader.has_free_scale:
            wanted *= 300 * shader.brightness_unit
        state = f"right: '{variant}', terms: 25, brightness: 300, quirks: {str(vars(quirks)).lower()}"
        tab.evaluate(f"viewer.set({{ {state} }})")
        found = call(tab, "viewer.evaluateShader", pairs.ravel().tolist()).reshape(-1, 4)[:, :3]
        assert (np.abs(wanted).max(axis=1) > 1e-3 * wanted.max()).mean() > 0.05, variant
        np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-3 * np.abs(wanted).max(), err_msg=variant)


def test_a_drag_changes_the_picture_and_nothing_leaves_the_page(opened):
    tab = opened(ViewedSurface.named("blazed", {"depth": 0.1, "samples": 64, "coherence_length": 3.0}))
    tab.evaluate("viewer.set({ maxFrames: 1, lightWidth: 0, lightLength: 0 })")
    wait_for_frames(tab)
    before = tab.evaluate("viewer.state")
    box = tab.locator("#canvas").bounding_box()
    pictures = [tab.screenshot()]
    for modifier, name in ((None, "azimuth"), ("Shift", "lightAzimuth")):
        if modifier:
            tab.keyboard.down(modifier)
        tab.mouse.move(box["x"] + 100, box["y"] + 80)
        tab.mouse.down()
        tab.mouse.move(box["x"] + 160, box["y"] + 90, steps=2)
        tab.mouse.up()
        after = tab.evaluate("viewer.state")
        assert after[name] != before[name]
        wait_for_frames(tab)
        pictures.append(tab.screenshot())
    tab.keyboard.up("Shift")
    assert len(set(pictures)) == 3
    before = tab.evaluate("viewer.state")
    lamp = tab.locator("#lamp").bounding_box()
    tab.mouse.move(lamp["x"] + 13, lamp["y"] + 13)
    tab.mouse.down()
    tab.mouse.move(lamp["x"] + 43, lamp["y"] + 13, steps=2)
    tab.mouse.up()
    after = tab.evaluate("viewer.state")
    assert after["lightAzimuth"] > before["lightAzimuth"]
    assert after["azimuth"] == before["azimuth"]
    tab.locator("#reset").click()
    assert tab.evaluate("viewer.state.azimuth") == -90
    with tab.expect_download() as saved:
        tab.locator("#save").click()
    assert saved.value.suggested_filename == "blazed.png"


@pytest.mark.slow
def test_the_scene_of_a_view_has_file_names_without_folders(opened):
    surface = ViewedSurface.named(RECIPES / "blaze.toml", {"material": "Al"})
    tab = opened(surface)
    tab.evaluate("viewer.set({ maxFrames: 1 })")
    with tab.expect_download() as saved:
        tab.locator("#copy").click()
    scene = saved.value.path().read_text()
    assert 'name="filename" value="blaze"' in scene
    assert scene == tab.evaluate("viewer.scene()")
    assert tab.evaluate("viewer.command()") == "mitsuba-diffraction render view.xml --spp 64\n"
    assert str(RECIPES.parent) not in tab.content()
    assert tab.locator("#summary").inner_text() == "Period 2.5 µm, 0.246 µm deep."
    assert tab.messages == [tab.url[:80]]


@pytest.mark.slow
def test_a_slider_sets_the_brightness_of_the_shader(opened):
    tab = opened(ViewedSurface.named("blazed", {"depth": 0.1, "samples": 64, "coherence_length": 3.0}))
    tab.evaluate("viewer.set({ maxFrames: 1, right: 'flss' })")
    slider = tab.locator("#brightness")
    assert np.exp(float(slider.input_value())) == pytest.approx(PUBLISHED_BRIGHTNESS, rel=1e-3)
    slider.evaluate("(input) => { input.value = Math.log(50); input.dispatchEvent(new Event('input')); }")
    assert tab.evaluate("viewer.state.brightness") == pytest.approx(50, rel=1e-3)
    assert tab.locator("#brightness-shown").inner_text() == "50.0"
    # Radiance in the scene's units has no free scale.
    tab.evaluate("viewer.set({ quirks: { ...viewer.state.quirks, relative: false } })")
    assert slider.is_disabled()


@pytest.mark.slow
def test_a_pixel_has_the_orders_of_the_grating_equation(opened):
    tab = opened(ViewedSurface.named("blazed", {"period": 2.5, "depth": 0.25, "material": "none"}))
    # The light is 24 degrees from the axis of the camera, in the plane across the grooves.
    tab.evaluate(
        "viewer.set({ maxFrames: 1, shape: 'plate', azimuth: -90, elevation: 89, lightAzimuth: 0, lightElevation: 66, "
        "lightWidth: 0, lightLength: 0, sky: 0 })"
    )
    # Orders are seen by eyes whose q_y is nearly zero; a column of the picture has some.
    picked = tab.evaluate(
        "(() => { const { width, height } = document.getElementById('canvas');"
        " for (let y = 0; y < height; y += 2) { const found = viewer.picker.pick(0.55 * width, y);"
        " if (found && found.orders.length) return found; } })()"
    )
    u = -(picked["wi"][0] + picked["wo"][0])
    orders = {tuple(found["order"]): found["nanometres"] for found in picked["orders"]}
    wanted = {(m, 0): 1e3 * u * 2.5 / m for m in range(-14, 15) if m and 380 <= 1e3 * u * 2.5 / m <= 740}
    assert orders.keys() == wanted.keys()
    for order, wavelength in wanted.items():
        assert orders[order] == pytest.approx(wavelength, rel=1e-2)
    peak = max(picked["values"], key=lambda pair: pair[1])[0]
    assert min(abs(peak - wavelength) for wavelength in orders.values()) <= 4
    assert "Orders, by the grating equation" in tab.locator("#picked-text").inner_text()
    # The colour is that of the curve.
    nm, values = np.array(picked["values"]).T
    table = pages._light().astype(np.float64)
    weights = table[:, :3] * table[:, 3:]
    xyz = 2 * values @ np.stack([np.interp(nm, np.arange(360, 831), column) for column in weights.T], axis=-1)
    np.testing.assert_allclose(picked["xyz"], xyz, rtol=1e-3)
    rgb = XYZ_to_linear_sRGB(xyz)
    wanted = on_screen(into_gamut(0.8 * rgb / rgb.max())[None, None])[0, 0]
    np.testing.assert_allclose([int(picked["hex"][i : i + 2], 16) for i in (1, 3, 5)], wanted, atol=1)
    labels = tab.locator("#plot text").all_text_contents()
    assert labels[-1] == "wavelength in nm"
    assert re.fullmatch(r"f cos θ up to [\d.e+]+ sr⁻¹", labels[-2])


@pytest.mark.slow
def test_a_colour_is_not_said_to_be_nothing(opened):
    """At a pixel that only the sky lights, and at one that is black."""
    tab = opened(ViewedSurface.named("blazed", {"period": 2.5, "depth": 0.25, "material": "none"}))
    remarks = []
    for sky in (0.5, 0):
        state = f"lightAzimuth: 40, lightElevation: 20, lightWidth: 0, lightLength: 0, sky: {sky}"
        tab.evaluate(f"viewer.set({{ maxFrames: 1, shape: 'plate', azimuth: -90, elevation: 60, {state} }})")
        wait_for_frames(tab)
        width, height = tab.evaluate("[viewer.renderer.width, viewer.renderer.height]")
        picked = tab.evaluate("([x, y]) => viewer.picker.pick(x, y)", [width / 2, height / 2])
        assert max(value for _, value in picked["values"]) < 1e-6
        assert (picked["luminance"] > 0) == (sky > 0)
        remarks.append(tab.locator("#picked-text").inner_text())
    assert "From the middle of the lamp nothing is diffracted to the eye; the colour is from the sky." in remarks[0]
    assert "Nothing is diffracted from this light to the eye." in remarks[1]


@pytest.mark.slow
def test_what_is_shown_first_is_complete(opened):
    """The bands of a slow first frame are not shown: a smaller picture stands there until the frame is complete."""
    tab = opened(ViewedSurface.named("blazed", {"depth": 0.1, "samples": 64, "coherence_length": 3.0}))
    tab.evaluate("viewer.set({ maxFrames: 4, sky: 1, shape: 'plate', azimuth: -90, elevation: 89, distance: 3 })")
    # As of a device that draws one band in each turn.
    tab.evaluate("viewer.renderer.model.milliseconds = 1e4")
    seen = tab.evaluate(
        """new Promise((done) => {
          const { renderer } = viewer, canvas = document.getElementById('canvas'), seen = [];
          const draw = renderer.draw.bind(renderer);
          renderer.draw = (side, state, columns, budget) => {
            side.band = 8;
            draw(side, state, columns, Math.min(budget, budget === Infinity ? Infinity : 1e-3));
          };
          viewer.set({ exposure: 0.25 });
          const look = () => {
            const gl = canvas.getContext('webgl2'), found = new Uint8Array(4 * canvas.width * canvas.height);
            gl.bindFramebuffer(gl.FRAMEBUFFER, null);
            gl.readPixels(0, 0, canvas.width, canvas.height, gl.RGBA, gl.UNSIGNED_BYTE, found);
            const at = (y) => found[4 * (Math.floor(y * canvas.height) * canvas.width + canvas.width / 2)];
            seen.push([renderer.model.frame, renderer.model.row, at(0.3), at(0.7)]);
            if (renderer.model.frame > 0 || seen.length > 400) done(seen);
            else requestAnimationFrame(look);
          };
          requestAnimationFrame(() => requestAnimationFrame(look));
        })"""
    )
    assert any(row > 0 for _, row, _, _ in seen)
    # Nowhere the background, 22 in red.
    assert all(min(low, high) > 40 for *_, low, high in seen)


@pytest.mark.slow
@pytest.mark.parametrize(
    "orientation",
    [pytest.param(30, marks=pytest.mark.slow), "radial", pytest.param("tangential", marks=pytest.mark.slow)],
)
def test_the_axes_of_the_pattern_are_those_of_the_plugin(orientation, opened, llvm):
    """ω_i along the pattern's axes at pixels of a sphere, a plate and a disc, as the scene of the view has it."""
    parameters = {"depth": 0.1, "samples": 64, "coherence_length": 3.0}
    tab = opened(ViewedSurface.named("blazed", {**parameters, "orientation": orientation}))
    grating = {"type": "diffraction_grating", "profile": "blazed", **parameters, "orientation": orientation}
    for name, kind in (("sphere", "sphere"), ("plate", "rectangle"), ("disc", "disk")):
        tab.evaluate("(shape) => viewer.set({ shape, maxFrames: 1, azimuth: -60, elevation: 50 })", name)
        scene = tab.evaluate("viewer.scene()")
        assert f'name="orientation" value="{orientation}"' in scene
        width, height = tab.evaluate("[viewer.renderer.width, viewer.renderer.height]")
        azimuth, elevation = tab.evaluate("[viewer.state.lightAzimuth, viewer.state.lightElevation]")
        light = testing.direction(90 - elevation, azimuth)
        sensor = mi.load_string(
            re.search("<sensor.*?</sensor>", scene, re.DOTALL)[0].replace("<sensor", '<sensor version="3.0.0"', 1)
        )
        shape = mi.load_dict({"type": kind, "bsdf": grating})
        scene = mi.load_dict({"type": "scene", "shape": shape})
        for x, y in ((0.5, 0.5), (0.42, 0.47), (0.55, 0.53), (0.51, 0.4)):
            x, y = int(x * width), int(y * height)
            at = mi.Point2f((x + 0.5) / width, (y + 0.5) / height)
            ray, _ = sensor.sample_ray(0.0, 0.5, at, mi.Point2f(0.5))
            si = scene.ray_intersect(ray)
            frame = shape.bsdf().layers.grating.frame(si, mi.Bool(True))
            wanted = np.array(rotated(si.to_local(mi.Vector3f(light)), *frame)).ravel()
            found = tab.evaluate("([x, y]) => viewer.picker.directionsAt(x, y)", [x, y])
            np.testing.assert_allclose(found["wi"], wanted, atol=2e-3, err_msg=f"{name} {x} {y}")
            if name == "disc" and orientation != 30:
                # Regression: the tangent followed the centre of UV space, and the tracks were spirals.
                radius = np.array(si.p).ravel()
                radius /= np.linalg.norm(radius)
                along = found["wi"][0] if orientation == "radial" else -found["wi"][1]
                assert along == pytest.approx(light @ radius, abs=2e-3)


@pytest.fixture(scope="module")
def blaze():
    return ViewedSurface.named("blazed", {"depth": 0.1, "samples": 64, "coherence_length": 3.0})


@pytest.mark.slow
@pytest.mark.parametrize("skin", ["xenopeltis", pytest.param("elaphe", marks=pytest.mark.slow)])
def test_the_coil_has_the_scales_of_the_scene(skin, blaze, opened, llvm):
    """Normals and tangents at each pixel of the coil against the textures of the scene of the view."""
    tab = opened(blaze)
    tab.evaluate("(scales) => viewer.set({ shape: 'coil', scales, maxFrames: 1, azimuth: -60, elevation: 50 })", skin)
    assert tab.locator("#of-coil").is_visible()
    content = tab.evaluate("viewer.scene()")
    assert content.count(f'"scenes/coil/{skin}_') == 2
    scene = mi.load_string(content.replace('"scenes/', f'"{RECIPES.parent / "scenes"}/'))
    found = call(
        tab,
        """() => { const { renderer, picker } = viewer, { gl, geometry } = renderer, [width, height] = renderer.drawn;
        picker.directionsAt(0, 0);
        gl.bindFramebuffer(gl.FRAMEBUFFER, geometry.framebuffer);
        return geometry.textures.map((_, i) => {
          const values = new Float32Array(4 * width * height);
          gl.readBuffer(gl.COLOR_ATTACHMENT0 + i);
          gl.readPixels(0, 0, width, height, gl.RGBA, gl.FLOAT, values);
          return Array.from(values);
        }); }""",
    )
    width, height = tab.evaluate("viewer.renderer.drawn")
    position, normal, tangent = found.reshape(3, height, width, 4)[:, ::-1].reshape(3, -1, 4)
    y, x = np.divmod(np.arange(width * height), width)
    at = mi.Point2f((x + 0.5) / width, (y + 0.5) / height)
    si = scene.ray_intersect(scene.sensors()[0].sample_ray(0.0, 0.5, at, mi.Point2f(0.5))[0])
    seen = np.array(si.is_valid()) & (position[:, 3] > 0)
    seen &= np.linalg.norm(np.array(si.p).T - position[:, :3], axis=1) < 0.01
    assert seen.sum() > 4000

    def texture(kind, filter_type):
        path = str(RECIPES.parent / f"scenes/coil/{skin}_{kind}.exr")
        return mi.load_dict({"type": "bitmap", "filename": path, "raw": True, "filter_type": filter_type})

    mapped = mi.Normal3f(2 * texture("normals", "bilinear").eval_3(si) - 1)
    frame = mi.Frame3f(si.sh_frame.n)
    frame.s = dr.normalize(si.dp_du - frame.n * dr.dot(frame.n, si.dp_du))
    frame.t = dr.cross(frame.n, frame.s)
    n = dr.normalize(frame.to_world(mapped))
    s = dr.normalize(si.dp_du - n * dr.dot(n, si.dp_du))
    n, s, t, smooth = (np.array(v).T[seen] for v in (n, s, dr.cross(n, s), frame.n))
    normal, tangent = normal[seen, :3], tangent[seen, :3]

    def angle(a, b):
        return np.rad2deg(np.arccos(np.clip((a * b).sum(1), -1, 1)))

    # The slopes of whole scales are random numbers, and the texture blurs the outlines of scales.
    assert np.median(angle(normal, smooth)) > 3
    assert np.quantile(angle(normal, smooth), 0.9) > 15
    assert np.median(angle(normal, n)) < 3.3
    assert np.quantile(angle(normal, n), 0.9) < 9
    # The directions of scales are random, too, with the same standard deviation.
    turned = np.rad2deg(np.arctan2((tangent * t).sum(1), (tangent * s).sum(1)))
    wanted = np.array(texture("turn", "nearest").eval_1(si))[seen]
    assert np.median(np.abs(turned)) == pytest.approx(np.median(np.abs(wanted)), rel=0.15)


@pytest.mark.slow
def test_scales_take_as_much_light_as_a_normal_map(blaze, opened, llvm):
    """The shadows of a relief, against a white surface under Mitsuba's normal map."""
    tab = opened(blaze)
    normal = np.array([-0.4, 0.25, 1.0])
    normal /= np.linalg.norm(normal)
    wi = testing.direction(np.tile([5.0, 45.0, 80.0, 88.0, 95.0], 12), np.repeat(np.arange(12) * 30.0, 5))
    # The axes of the relief: its normal is the third.
    s = np.cross([0.0, 1.0, 0.0], normal)
    axes = np.stack([s / np.linalg.norm(s), np.cross(normal, s / np.linalg.norm(s)), normal])
    pairs = np.concatenate([wi @ axes.T, np.tile(axes[:, 2], (len(wi), 1)), np.full((len(wi), 1), 500.0)], -1)
    text = """
      uniform highp sampler2D uIncident, uOutgoing;
      out vec4 oValue;
      void main() {
        ivec2 at = ivec2(gl_FragCoord.xy);
        facet = texelFetch(uOutgoing, at, 0).xyz;
        oValue = vec4(facing(texelFetch(uIncident, at, 0).xyz));
      }"""
    found = call(
        tab,
        """(pairs, text) => { const { renderer, state } = viewer;
        const program = renderer.programOf(state, text);
        return Array.from(renderer.evaluate(program, renderer.modelUniforms(state, 0), Float32Array.from(pairs))); }""",
        pairs.ravel().tolist(),
        text,
    )[::4]
    bitmap = mi.Bitmap(np.tile((normal + 1) / 2, (2, 2, 1)).astype(np.float32))
    white = {"type": "diffuse", "reflectance": {"type": "uniform", "value": 1.0}}
    bsdf = mi.load_dict(
        {"type": "normalmap", "normalmap": {"type": "bitmap", "bitmap": bitmap, "raw": True}, "nested": white}
    )
    value = testing.evaluate(bsdf, np.tile([0.0, 0.0, 1.0], (len(wi), 1)), wi, np.full((len(wi), 1), 500.0))[:, 0]
    np.testing.assert_allclose(found * np.maximum(wi @ normal, 0) / np.pi, value, atol=1e-5)
    assert found.min() == 0
    assert 0.5 < np.median(found) < 1


@pytest.mark.slow
def test_the_copied_scene_renders_the_same_picture(opened, tmp_path, llvm):
    """A sphere under parallel light: the mean of CIEDE2000 over its pixels, at the exposure of the page."""
    surface = ViewedSurface.named(RECIPES / "elaphe_afm.toml", {})
    tab = opened(surface)
    size = {"width": 64, "height": 64}
    tab.evaluate(
        "(size) => { const canvas = document.getElementById('canvas');"
        " Object.assign(canvas.style, { width: `${size.width}px`, height: `${size.height}px`, inset: 'auto' });"
        " viewer.set({ maxFrames: 32, lightWidth: 0, lightLength: 0, sky: 0, shape: 'sphere', hasBase: false }); }",
        size,
    )
    while tab.evaluate("viewer.renderer.width !== 64"):
        tab.wait_for_timeout(50)
    wait_for_frames(tab)
    scene = tab.evaluate("viewer.scene()")
    (tmp_path / "view.xml").write_text(scene.replace("elaphe_afm.toml", str(RECIPES / "elaphe_afm.toml")))
    image = render(tmp_path / "view.xml", spp=256)
    wanted = radiance_to_XYZ(image.radiance, image.wavelengths)
    found = np.array(tab.evaluate("Array.from(viewer.renderer.readMean().values)")).reshape(64, 64, 4)[::-1]
    inside = found[..., 3] == 1
    exposure = tab.evaluate("viewer.renderer.normal")
    difference = delta_E(*(np.clip(exposure * XYZ[inside], 0, 1) for XYZ in (found[..., :3], wanted)))
    assert inside.sum() > 800
    assert difference.mean() <= 1
    assert delta_E(np.zeros(3), np.clip(exposure * wanted[inside], 0, 1)).mean() > 3


def alpha_at(tab, x, y):
    """The coverage of the mean at coordinates of the plane of a plate, seen from above."""
    half = tab.evaluate("Math.tan((viewer.renderer.drawn[1] ? 14 : 0) * Math.PI / 180) * viewer.state.distance")
    width, height = tab.evaluate("viewer.renderer.drawn")
    scale = min(width, height) / (2 * half)
    column, row = int(width / 2 + scale * x), int(height / 2 + scale * y)
    values = tab.evaluate("([x, y]) => Array.from(viewer.renderer.model.mean.read(x, y, 1, 1))", [column, row])
    return values[3], values[1]


@pytest.fixture(scope="module")
def disc():
    """A compact disc of few pits."""
    small = {"tracks": 2, "length": 12.5, "patches": 2, "coherence_length": 4.0}
    return ViewedSurface.named("compact_disc", small)


@pytest.mark.slow
def test_the_first_frame_has_no_visible_noise(disc, opened):
    """Differences of neighbouring pixels on the tracks, after one frame and after many."""
    tab = opened(disc)
    assert "This browser has no GPU" in tab.locator("#times").inner_text()
    steps = []
    for frames in (1, 48):
        tab.evaluate(f"viewer.set({{ maxFrames: {frames}, azimuth: -90, elevation: 89 }})")
        wait_for_frames(tab)
        tab.evaluate("new Promise((done) => requestAnimationFrame(done))")
        data = tab.evaluate("document.getElementById('canvas').toDataURL()").partition(",")[2]
        shown = np.asarray(Image.open(io.BytesIO(base64.b64decode(data))).convert("RGB"), float)
        y, x = (n // 2 for n in shown.shape[:2])
        tracks = shown[y - 8 : y + 8, x - 75 : x - 45]  # left of the hole
        steps.append(np.abs(np.diff(tracks, axis=1)).mean())
    assert steps[0] < 1.5 * steps[1] + 1


def shown_at(tab, point, back, distance):
    """The largest channel of what is shown where a point is seen by a camera towards `back`, 0 to 255."""
    right = np.cross([0, 0, 1], back) / np.hypot(back[0], back[1])
    up = np.cross(back, right)
    # A field of view of 28° along the shorter side.
    tangent = np.array([right @ point, up @ point]) / (distance - back @ point) / np.tan(np.radians(14))
    return tab.evaluate(
        """(tangent) => {
          viewer.renderer.drawScreen(viewer.state, [0, 0, 0]);
          const gl = document.getElementById('canvas').getContext('webgl2');
          const size = [gl.drawingBufferWidth, gl.drawingBufferHeight];
          const at = size.map((n, i) => Math.floor(0.5 * (n + tangent[i] * Math.min(...size))));
          const found = new Uint8Array(4);
          gl.bindFramebuffer(gl.FRAMEBUFFER, null);
          gl.readPixels(at[0], at[1], 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, found);
          return Math.max(...found.slice(0, 3));
        }""",
        tangent.tolist(),
    )


@pytest.mark.slow
def test_a_sphere_casts_a_shadow_on_the_ground_and_mirrors_the_lamp(opened):
    parameters = {"depth": 0.1, "samples": 64, "coherence_length": 3.0, "material": "Al"}
    tab = opened(ViewedSurface.named("blazed", parameters))
    elevation, distance = np.radians(40), 8
    back = np.array([0, -np.cos(elevation), np.sin(elevation)])
    # The light is 45° high, towards +x and then -x: the shadow of the centre of the sphere falls on the other side.
    for azimuth, side in ((0, 1), (180, -1)):
        tab.evaluate(
            "(lightAzimuth) => viewer.set({ maxFrames: 1, shape: 'sphere', azimuth: -90, elevation: 40, distance: 8, "
            "lightAzimuth, lightElevation: 45, lightWidth: 6, lightLength: 0, sky: 0.05 })",
            azimuth,
        )
        wait_for_frames(tab)
        lit, dark = (shown_at(tab, np.array([x * side, 0, -1]), back, distance) for x in (1.4, -1.4))
        assert lit > 1.3 * dark > 0
    # The normal halfway between light and eye mirrors the lamp.
    light = np.array([-1, 0, 1]) / 2**0.5
    normal = light + back
    for _ in range(20):
        normal /= np.linalg.norm(normal)
        towards_eye = distance * back - normal
        normal = light + towards_eye / np.linalg.norm(towards_eye)
    normal /= np.linalg.norm(normal)
    assert shown_at(tab, normal, back, distance) > 240


@pytest.mark.slow
def test_a_disc_has_a_hole_and_clear_rings(disc, opened):
    tab = opened(disc)
    assert tab.evaluate("[viewer.state.shape, viewer.state.material, viewer.state.coat]") == ["disc", "Al", 1.55]
    tab.evaluate("viewer.set({ maxFrames: 1, azimuth: -90, elevation: 89, sky: 1 })")
    wait_for_frames(tab)
    covers = [alpha_at(tab, radius, 0)[0] for radius in (0.05, 0.25, 0.6, 0.988, 1.1)]
    assert covers == [0, 0.25, 1, 0.25, 0]
    assert tab.messages == [tab.url[:80]]


@pytest.mark.slow
def test_the_scene_of_a_disc_has_its_rings(disc, opened, tmp_path, llvm):
    """The picture of `view.xml` under the sky alone: its lower half through the hole, and through the plastic."""
    tab = opened(disc)
    tab.evaluate(
        "viewer.set({ maxFrames: 1, azimuth: -90, elevation: 89, sky: 1, lightElevation: -80, lightLength: 0 })"
    )
    scene = re.sub(r'"(width|height)" value="\d+"', r'"\1" value="64"', tab.evaluate("viewer.scene()"))
    (tmp_path / "view.xml").write_text(scene)
    image = render(tmp_path / "view.xml", spp=4096)
    half = np.tan(np.deg2rad(14)) * tab.evaluate("viewer.state.distance")
    luminance = np.pi * radiance_to_XYZ(image.radiance, image.wavelengths)[32, :, 1]
    hole, plastic, metal, beside = (luminance[int(32 + 32 * radius / half)] for radius in (0.05, 0.25, 0.6, 1.05))
    ground, zenith = 0.5, 4.63  # of the disc of the sky that is at the zenith
    assert hole == pytest.approx(ground, rel=0.01)
    assert beside == pytest.approx(ground, rel=0.01)
    of_face = (0.55 / 2.55) ** 2
    reflected = 2 * of_face / (1 + of_face)
    assert plastic == pytest.approx((1 - reflected) * ground + reflected * zenith, rel=0.1)
    assert 0.6 < metal / zenith < 0.95


@pytest.mark.slow
@pytest.mark.parametrize(
    ("source", "parameters", "changes"),
    [
        ("blazed", {"depth": 0.25, "samples": 64, "coherence_length": 20.0, "material": "Au"}, {}),
        ("blazed", {"depth": 0.25, "samples": 64, "coherence_length": 3.0, "material": "Au", "coat_ior": 1.5}, {}),
        (RECIPES / "foil_crossed.toml", {"material": "Al"}, {}),
        (RECIPES / "elaphe_afm.toml", {"material": "Cu"}, {}),
        (RECIPES / "elaphe_afm.toml", {}, {"hasBase": True, "pigment": "#7c3f95"}),
    ],
)
def test_the_sky_is_that_of_a_path_tracer(source, parameters, changes, opened, tmp_path, llvm):
    """The picture of `view.xml` without a lamp: the mean XYZ of a plate, whose orders see other parts of the sky."""
    tab = opened(ViewedSurface.named(source, parameters))
    view = {"shape": "plate", "azimuth": -70, "elevation": 35, "distance": 2, "lightElevation": -80}
    tab.evaluate("(changes) => viewer.set(changes)", {"maxFrames": 64, "sky": 0.5, "hasBase": False, **view, **changes})
    wait_for_frames(tab)
    width, height = tab.evaluate("viewer.renderer.drawn")
    mean = np.array(tab.evaluate("Array.from(viewer.renderer.readMean().values)")).reshape(height, width, 4)
    half = round(np.tan(np.deg2rad(2.5)) / np.tan(np.deg2rad(14)) * min(width, height) / 2)
    middle = mean[height // 2 - half : height // 2 + half, width // 2 - half : width // 2 + half]
    assert (middle[..., 3] == 1).all()
    scene = re.sub(r'"(width|height)" value="\d+"', r'"\1" value="20"', tab.evaluate("viewer.scene()"))
    scene = scene.replace(f'"{Path(source).name}"', f'"{source}"') if isinstance(source, Path) else scene
    (tmp_path / "view.xml").write_text(re.sub(r'"fov" value="\d+"', '"fov" value="5"', scene))
    image = render(tmp_path / "view.xml", spp=512)
    wanted = radiance_to_XYZ(image.radiance, image.wavelengths).mean(axis=(0, 1))
    np.testing.assert_allclose(middle[..., :3].mean(axis=(0, 1)), wanted, rtol=0.03)


@pytest.fixture(scope="module")
def cat():
    return ViewedSurface.named(RECIPES / "designed" / "cat.toml", {"material": "Al"})


@pytest.mark.slow
def test_a_designed_plate_opens_with_its_picture_on_a_wall(cat, opened, tmp_path, llvm):
    """The wall of the page against that of `view.xml`, whose plate Mitsuba places: correlation of the luminance."""
    tab = opened(cat)
    assert tab.evaluate("viewer.state.shape") == "wall"
    tab.evaluate("viewer.set({ maxFrames: 4, azimuth: -90, elevation: 89, distance: 3.2 })")
    wait_for_frames(tab)
    width, height = tab.evaluate("viewer.renderer.drawn")
    found = np.array(tab.evaluate("Array.from(viewer.renderer.readMean().values)")).reshape(height, width, 4)[
        ::-1, :, 1
    ]
    scene = tab.evaluate("viewer.scene()").replace('"cat.toml"', f'"{RECIPES / "designed" / "cat.toml"}"')
    (tmp_path / "view.xml").write_text(scene)
    image = render(tmp_path / "view.xml", spp=64)
    wanted = radiance_to_XYZ(image.radiance, image.wavelengths)[..., 1]
    assert wanted.shape == found.shape
    # The noise of single pixels aside.
    blocks = [
        one[: height // 6 * 6, : width // 6 * 6].reshape(height // 6, 6, width // 6, 6) for one in (found, wanted)
    ]
    found, wanted = (one.mean(axis=(1, 3)) for one in blocks)
    shown = wanted < np.quantile(wanted, 0.999)
    correlation = np.corrcoef(found[shown], wanted[shown])[0, 1]
    # The torch is near the plate, whose size blurs the picture.
    assert correlation > 0.9
    # The cat winks with one eye, so that a mirrored picture would have the opposite difference of its halves.
    halves = [(one - one[:, ::-1])[shown & shown[:, ::-1]] for one in (found, wanted)]
    assert np.corrcoef(*halves)[0, 1] > 0.3


@pytest.mark.slow
def test_a_reference_picture_is_compared(opened):
    surface = ViewedSurface.named("blazed", {"depth": 0.1, "samples": 64, "coherence_length": 3.0})
    grey = np.full((40, 40, 3), 0.5, np.float16)
    tab = opened(surface, picture=grey)
    tab.evaluate("viewer.set({ maxFrames: 1, right: 'picture', exposure: 0 })")
    wait_for_frames(tab)
    shown = tab.locator("#right-name").inner_text()
    tab.evaluate("viewer.set({ difference: true })")
    assert shown == "reference"
    assert tab.locator("#legend").is_visible()
    assert tab.messages == [tab.url[:80]]


def test_colours_are_shown_as_in_previews(opened):
    """Lines of a spectrum beside a grey, from dark to bright, against the preview of the same picture."""
    lines = radiance_to_linear_sRGB(np.eye(81)[10:70:6], np.arange(380.0, 781.0, 5.0))
    light = np.concatenate([factor * lines / lines.max() for factor in (0.1, 1.0, 8.0)] + [np.full((1, 3), 0.5)])
    picture = np.tile(np.repeat(light, 4, 0), (200, 1, 1))
    blaze = ViewedSurface.named("blazed", {"depth": 0.1, "samples": 64, "coherence_length": 3.0})
    tab = opened(blaze, picture=picture.astype(np.float16))
    tab.evaluate("viewer.set({ maxFrames: 1, right: 'picture', divider: 0, exposure: 0 })")
    wait_for_frames(tab)
    row = tab.evaluate(
        """(() => {
          const { gl } = viewer.renderer, [width, height] = [gl.drawingBufferWidth, gl.drawingBufferHeight];
          const values = new Uint8Array(4 * width);
          gl.bindFramebuffer(gl.FRAMEBUFFER, null);
          gl.readPixels(0, height >> 1, width, 1, gl.RGBA, gl.UNSIGNED_BYTE, values);
          return Array.from(values);
        })()"""
    )
    row = np.array(row, int).reshape(-1, 4)[1:, :3]  # the first is the divider
    found = row[np.concatenate([[True], np.any(np.diff(row, axis=0), axis=1)])]
    found = found[found.any(axis=1)]
    wanted = on_screen(into_gamut(light.astype(np.float16)) * tab.evaluate("viewer.renderer.normal"))
    assert len(found) == len(wanted)
    np.testing.assert_allclose(found, wanted, atol=1)


@pytest.mark.slow
def test_a_page_that_turns_has_no_controls(disc, opened):
    tab = opened(disc, fragment="#turn")
    azimuths = []
    for _ in range(2):
        tab.wait_for_timeout(1000)
        azimuths.append(tab.evaluate("viewer.state.azimuth"))
    assert azimuths[1] > azimuths[0]
    assert not tab.locator("#panel").is_visible()


@pytest.mark.slow
def test_new_heights_have_other_colours(opened):
    """Look-ups after a slider has moved, against those of a page that opens with these heights."""
    surface = ViewedSurface.named(RECIPES / "elaphe_afm.toml", {})
    pairs = pairs_of(surface.spectrum, 200).ravel().tolist()
    found = []
    for height, changes in ((1.0, [0.6]), (1.0, []), (0.6, [])):
        tab = opened(ViewedSurface.named(RECIPES / "elaphe_afm.toml", {"height_scale": height}))
        for change in changes:
            tab.evaluate("(heightScale) => viewer.set({ heightScale, maxFrames: 1 })", change)
            wait_for_frames(tab)
        found.append(call(tab, "viewer.evaluateColours", pairs).reshape(-1, 4)[:, :3])
    np.testing.assert_allclose(found[0], found[2], rtol=1e-3, atol=1e-6)
    assert np.abs(found[0] - found[1]).max() > 0.1 * found[1].max()


@pytest.mark.slow
def test_a_list_of_surfaces_shows_each(disc, opened):
    blaze = ViewedSurface.named("blazed", {"depth": 0.1, "samples": 64, "coherence_length": 3.0, "material": "Au"})
    tab = opened(disc, blaze)
    names = ["compact_disc", "blazed"]
    assert tab.locator("#surface option").all_inner_texts() == names
    pictures = []
    # To and fro, and twice at once, of which the last counts.
    for number in (0, 1, 0, [0, 1]):
        for one in number if isinstance(number, list) else [number]:
            tab.locator("#surface").select_option(str(one))
        tab.evaluate("viewer.ready")
        tab.evaluate("viewer.set({ maxFrames: 1 })")
        wait_for_frames(tab)
        assert tab.locator("#title").inner_text() == names[one]
        assert tab.evaluate("[viewer.data.name, viewer.state.shape]") == [names[one], ("disc", "sphere")[one]]
        pictures.append(tab.screenshot())
    assert pictures[0] == pictures[2] != pictures[1] == pictures[3]
    assert tab.messages == [tab.url[:80]]


def test_a_browser_without_webgl2_is_told_in_one_line(browser, tmp_path):
    path = tmp_path / "page.html"
    path.write_text(pages.page(ViewedSurface.named("blazed", {"depth": 0.1, "samples": 64})), encoding="utf-8")
    tab = browser.new_page()
    tab.add_init_script("HTMLCanvasElement.prototype.getContext = () => null")
    tab.goto(path.as_uri())
    tab.evaluate("viewer.ready")
    assert tab.locator("main").inner_text().strip() == "This page needs WebGL2, which this browser does not offer."
    tab.close()
