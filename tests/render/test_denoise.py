"""Previews without noise, by Open Image Denoise; the spectral picture stays as it is."""

import sys
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from bsdf_support import grating, uniform, use
from PIL import Image

import mitsuba_diffraction  # noqa: F401 (settles which LLVM is used before a variant is set)
from mitsuba_diffraction.optics.color import XYZ_to_linear_sRGB, into_gamut, matching_functions
from mitsuba_diffraction.render import denoise, passes, scene_file
from mitsuba_diffraction.render.denoise import Guides, denoised, denoised_picture, guides, is_requested

SCENE = """<scene version="3.0.0"><integrator type="direct"/>
<sensor type="perspective"><transform name="to_world"><lookat origin="0,-4,2" target="0,0,0.5" up="0,0,1"/></transform>
<film type="hdrfilm"><integer name="width" value="64"/><integer name="height" value="48"/><rfilter type="gaussian"/>
</film></sensor><emitter type="constant"/>
<shape type="rectangle"><transform name="to_world"><scale value="3"/></transform>
<bsdf type="diffuse"><rgb name="reflectance" value="0.8, 0.3, 0.1"/></bsdf></shape>
<shape type="sphere"><point name="center" x="0" y="0" z="1"/><bsdf type="diffraction_grating">
<string name="profile" value="blazed"/><float name="period" value="2.5"/><float name="depth" value="0.25"/>
<float name="coherence_length" value="5"/><integer name="samples" value="64"/></bsdf></shape></scene>"""


@pytest.mark.slow
def test_guides_are_of_the_first_surface_hit(llvm):
    look = mi.ScalarTransform4f().look_at([0, 0, 5], [0, 0, 0], [0, 1, 0])
    film = {"type": "hdrfilm", "width": 30, "height": 20, "rfilter": {"type": "box"}}
    painted = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.1, 0.4, 0.8]}}
    scene = mi.load_dict(
        {
            "type": "scene",
            "sensor": {"type": "perspective", "to_world": look, "fov": 60, "film": film},
            "light": {"type": "constant", "radiance": uniform(1.0)},
            "left": {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([-1, 0, 0]), "bsdf": painted},
            "right": {
                "type": "rectangle",
                "to_world": mi.ScalarTransform4f().translate([1, 0, 0]).rotate([0, 1, 0], 30),
                "bsdf": grating("blazed"),
            },
        }
    )
    found = guides(scene)
    rows, columns = found.albedo.shape[:2]
    assert (rows, columns) == (20, 30)
    np.testing.assert_allclose(found.albedo[10, 9], [0.1, 0.4, 0.8], atol=0.12)  # upsampled, at one wavelength each
    np.testing.assert_allclose(found.normals[10, 9], [0, 0, 1], atol=1e-5)
    np.testing.assert_allclose(found.albedo[10, 20], 1)
    np.testing.assert_allclose(np.abs(found.normals[10, 20]), [0.5, 0, 0.75**0.5], atol=1e-4)
    np.testing.assert_allclose(found.albedo[0], 1)
    assert not found.normals[0].any()
    np.testing.assert_allclose(found.response, 1, atol=0.01)


@pytest.mark.parametrize("rfilter", ["box", "gaussian", "mitchell"])
def test_the_noise_of_any_reconstruction_filter_goes(rfilter, llvm):
    """White noise through the filter of a film, as a film makes it, about a grey that stays."""
    size, samples = 96, 16
    film = mi.load_dict({"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": rfilter}})
    sensor = mi.load_dict({"type": "perspective", "film": film})
    response = guides(mi.load_dict({"type": "scene", "sensor": sensor})).response
    rng = np.random.default_rng(0)
    block = mi.ImageBlock((size, size), (0, 0), 4, film.rfilter(), border=True)
    positions = mi.Point2f(rng.random((2, samples * size**2)) * size)
    values = rng.exponential(size=(3, samples * size**2))
    block.put(positions, [*(mi.Float(v) for v in values), mi.Float(np.ones(samples * size**2))])
    border = block.border_size()
    picture = np.array(block.tensor())[border : border + size, border : border + size]
    noisy = picture[..., :3] / picture[..., 3:]
    plain = np.ones((size, size, 3), np.float32)
    clean = denoised(noisy, Guides(plain, plain * np.float32([0, 0, 1]), response))
    assert np.abs(clean.mean() - 1) < 0.02
    assert (clean - 1).std() < 0.2 * (noisy - 1).std()


@pytest.mark.parametrize("wavelength", [405.0, 435.8, 460.0, 660.0])
def test_the_light_of_a_line_keeps_its_luminance(wavelength):
    """Bright lines on a dim screen, in samples that are exponentially distributed, as of a lamp seen by few paths."""
    size, samples, width = 96, 16, 8
    rng = np.random.default_rng(1)
    in_line = np.arange(size) // width % 3 == 0
    line, grey = matching_functions([wavelength])[0], 1e-3 * np.ones(3)
    brightness = np.where(in_line, rng.exponential(size=(samples, size, size)).mean(0), 0)[..., None]
    noisy = brightness * line + rng.exponential(size=(samples, size, size)).mean(0)[..., None] * grey
    plain = np.ones((size, size, 3), np.float32)
    clean = denoised(noisy, Guides(plain, plain * np.float32([0, 0, 1]), np.ones((size, size, 1))))
    shown = into_gamut(XYZ_to_linear_sRGB(clean)) @ [0.2126, 0.7152, 0.0722]
    inside = np.roll(in_line, 2) & np.roll(in_line, -2)
    expected = line[1] + grey[1]
    assert shown[:, inside].min() > 0.5 * expected
    assert shown[:, inside].mean() == pytest.approx(expected, rel=0.05)


@pytest.mark.slow
def test_the_preview_loses_its_noise_and_the_spectral_picture_stays(command, tmp_path, monkeypatch):
    use("llvm_ad_spectral")
    monkeypatch.chdir(tmp_path)
    Path("scene.xml").write_text(SCENE)
    for line in ("--spp 256 -o long.exr", "--spp 4 -o plain.exr", "--spp 4 --denoise -o clean.exr"):
        code, _, err = command(f"render scene.xml --variant llvm_ad_spectral {line}")
        assert code == 0, err
    long, plain, clean = (np.array(Image.open(f"{name}.png"), float) for name in ("long", "plain", "clean"))
    assert ((clean - long) ** 2).mean() < 0.3 * ((plain - long) ** 2).mean()
    plain, clean = (np.array(mi.Bitmap(f"{name}.exr")) for name in ("plain", "clean"))
    np.testing.assert_array_equal(plain, clean)


def test_missing_requirements_are_reported_before_the_work(command, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("scene.xml").write_text(SCENE)
    monkeypatch.setitem(sys.modules, "pyoidn", None)
    code, _, err = command("render scene.xml --denoise --variant llvm_ad_spectral")
    assert (code, err.count("\n")) == (2, 1)
    assert "pip install 'mitsuba_diffraction[denoise]'" in err
    assert sorted(p.name for p in tmp_path.iterdir()) == ["scene.xml"]


def test_a_scene_is_parsed_and_loaded_once_and_its_guides_are_tried_before_the_first_pass(
    command, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    Path("scene.xml").write_text(SCENE)
    line = "render scene.xml --denoise --variant llvm_ad_spectral --spp 1 --width 16"
    events = []
    for module, name in (
        (mi.parser, "parse_file"),
        (scene_file, "instantiated"),
        (denoise, "guides"),
        (passes, "trace_pass"),
    ):
        call = getattr(module, name)
        monkeypatch.setattr(module, name, lambda *a, name=name, call=call, **k: (events.append(name), call(*a, **k))[1])
    code, _, err = command(line)
    assert code == 0, err
    assert events == ["parse_file", "instantiated", "guides", "trace_pass", "guides"]


ASKS = SCENE.replace('<integrator type="direct"/>', '<default name="denoise" value="true"/><integrator type="direct"/>')


@pytest.mark.slow
def test_a_scene_asks_for_a_denoised_preview(command, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("plain.xml").write_text(SCENE)
    Path("asks.xml").write_text(ASKS)
    pictures = {}
    for line in ("plain.xml", "plain.xml --denoise", "asks.xml", "asks.xml --no-denoise"):
        code, _, err = command(f"render {line} --variant llvm_ad_spectral --spp 4 -o picture.exr --overwrite")
        assert code == 0, err
        pictures[line] = np.array(Image.open("picture.png"), int)
    np.testing.assert_array_equal(pictures["asks.xml"], pictures["plain.xml --denoise"])
    np.testing.assert_array_equal(pictures["asks.xml --no-denoise"], pictures["plain.xml"])
    assert np.abs(pictures["asks.xml"] - pictures["plain.xml"]).max() > 5


@pytest.mark.slow
def test_a_scene_that_asks_for_it_renders_without_the_denoiser(command, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("scene.xml").write_text(ASKS)
    monkeypatch.setitem(sys.modules, "pyoidn", None)
    code, _, err = command("render scene.xml --variant llvm_ad_spectral --spp 1 -o picture.exr")
    assert code == 0
    assert "denoise" not in err
    assert Path("picture.png").is_file()


def test_a_value_other_than_true_or_false_is_refused(command, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("scene.xml").write_text(ASKS.replace('value="true"', 'value="yes"'))
    code, _, err = command("render scene.xml --variant llvm_ad_spectral")
    assert (code, err.count("\n")) == (2, 1)
    assert "denoise: got 'yes', wanted true or false" in err


@pytest.mark.parametrize(("given", "code"), [("false", 0), ("yes", 2)])
def test_a_value_given_for_the_default_of_denoise_is_taken(given, code, command, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("mitsuba_diffraction.render.denoise.denoised_picture", lambda *_: pytest.fail("not requested"))
    Path("scene.xml").write_text(ASKS)
    found, _, err = command(f"render scene.xml --spp 1 -D denoise={given} --variant llvm_ad_spectral")
    assert found == code, err
    assert ("denoise: got 'yes', wanted true or false" in err) == bool(code)
    Path("scene.xml").write_text(SCENE)  # without this default
    found, _, err = command("render scene.xml --spp 1 -D denoise=false --variant llvm_ad_spectral")
    assert found == 2
    assert "denoise" in err


def test_a_requested_denoiser_is_read_as_leniently_as_mitsuba_reads_scenes(tmp_path, llvm):
    path = tmp_path / "scene.xml"
    comment = '<!-- python x.py --small; <default name="denoise" value="false"/> -->'
    path.write_text(ASKS.replace("<integrator", comment + "<integrator"))
    mi.load_file(str(path))
    assert is_requested(path)
    path.write_text(SCENE.replace("<integrator", comment.replace("false", "true") + "<integrator"))
    assert not is_requested(path)


def test_the_documentation_names_the_scenes_that_request_denoising():
    scenes = Path(__file__).parents[2] / "scenes"
    requesting = {path.name for path in scenes.glob("*.xml") if is_requested(path)}
    assert requesting == {
        f"{name}.xml"
        for name in (
            "glasses",
            "window",
            "rainbow",
            "compact_disc",
            "hologram",
            "anodised",
            "beetle",
            "blaze",
            "scan",
            "xenopeltis",
            "projection",
        )
    }


def test_a_picture_denoised_in_bands_is_that_denoised_as_a_whole(llvm, tmp_path, monkeypatch):
    """Noise about a grey that rises from 1 to 4, through a tent, on a wall that fills the picture."""
    film = {"type": "hdrfilm", "width": 64, "height": 160, "rfilter": {"type": "box"}}
    wall = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, 3]).scale(9)}
    scene = mi.load_dict({"type": "scene", "sensor": {"type": "perspective", "film": film}, "wall": wall})
    rng = np.random.default_rng(2)
    wanted = np.linspace(1, 4, 160)[:, None, None] * np.ones((160, 64, 3))
    noisy = (wanted * rng.exponential(size=(8, 160, 64, 3)).mean(0)).astype(np.float32)
    whole = denoised_picture(scene, noisy)
    np.testing.assert_allclose(whole, denoised(noisy, guides(scene)), rtol=1e-5)
    monkeypatch.setattr(denoise, "DENOISED_PIXELS", 86 * 64)
    monkeypatch.setattr(denoise, "BLENDED_ROWS", 32)
    banded = denoised_picture(scene, noisy)
    assert (noisy / wanted).std() > 0.3
    assert (banded / wanted).std() < 0.05
    # No seams: where bands meet, rows differ from their neighbours as little as in the whole picture.
    steps = [np.abs(np.diff((picture / wanted).mean((1, 2))))[30:130].max() for picture in (banded, whole)]
    assert steps[0] < 2 * steps[1]


def test_guides_of_bands_are_those_of_the_whole_picture(llvm):
    film = {"type": "hdrfilm", "width": 32, "height": 24, "rfilter": {"type": "box"}}
    ball = {"type": "sphere", "center": [0, 0, 4], "bsdf": {"type": "diffuse"}}
    scene = mi.load_dict({"type": "scene", "sensor": {"type": "perspective", "film": film}, "ball": ball})
    whole, bands = guides(scene), [guides(scene, rows) for rows in ((0, 9), (9, 24))]
    for name in ("albedo", "normals"):
        banded = np.concatenate([getattr(band, name) for band in bands])
        np.testing.assert_allclose(banded, getattr(whole, name), atol=0.5)
        np.testing.assert_allclose(banded.mean((1, 2)), getattr(whole, name).mean((1, 2)), atol=0.02)
