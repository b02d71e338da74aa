"""Large pictures, which are traced in bands of rows to bound memory."""

import itertools
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from PIL import Image

import mitsuba_diffraction  # noqa: F401 (settles which LLVM is used before a variant is set)
from mitsuba_diffraction.integrator.paths import LightPaths
from mitsuba_diffraction.optics.color import radiance_to_XYZ
from mitsuba_diffraction.render import SpectralImage, passes, render
from mitsuba_diffraction.render import trace_pass as tracing
from mitsuba_diffraction.render.passes import Interrupted, trace_locally
from mitsuba_diffraction.render.scene_file import SceneFile
from mitsuba_diffraction.render.spectral_film import channel_wavelengths
from mitsuba_diffraction.render.spectral_image import save_preview
from mitsuba_diffraction.render.sums import Accumulation, BandedImage, discard_checkpoints
from mitsuba_diffraction.render.trace_pass import LightOfBands, bands_of, trace_pass

# A grating in the sun in front of a wall, and of a crop window of 12 × 10 pixels.
SCENE = """<scene version="3.0.0">
    <integrator type="INTEGRATOR"><integer name="max_depth" value="3"/></integrator>
    <sensor type="perspective"><float name="fov" value="60"/>
        <transform name="to_world"><lookat origin="0,-3.5,2.5" target="0,.5,.5" up="0,0,1"/></transform>
        <film type="hdrfilm"><integer name="width" value="16"/><integer name="height" value="12"/>
            <integer name="crop_offset_x" value="3"/><integer name="crop_width" value="12"/>
            <integer name="crop_offset_y" value="2"/><integer name="crop_height" value="10"/>
            <rfilter type="gaussian"/></film>
        <sampler type="SAMPLER"/>
    </sensor>
    <shape type="rectangle"><transform name="to_world"><scale value="4"/></transform></shape>
    <shape type="rectangle"><transform name="to_world"><rotate x="1" angle="90"/><scale value="4"/>
        <translate y="1.5"/></transform></shape>
    <shape type="rectangle"><transform name="to_world"><translate z=".1"/></transform>
        <bsdf type="diffraction_grating"><string name="profile" value="blazed"/><float name="period" value="2.5"/>
            <float name="depth" value="0.25"/><float name="coherence_length" value="6"/>
            <string name="material" value="none"/><boolean name="conserve_energy" value="false"/></bsdf></shape>
    <emitter type="directional"><vector name="direction" x="0" y=".6" z="-.8"/></emitter>
</scene>"""


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch, llvm):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def write_scene(integrator="path", sampler="independent"):
    Path("scene.xml").write_text(SCENE.replace("INTEGRATOR", integrator).replace("SAMPLER", sampler))
    return "scene.xml"


# A sphere, a grating and a half transparent rectangle, in front of nothing or of an environment.
SCENE_WITH_ALPHA = """<scene version="3.0.0">
    <integrator type="INTEGRATOR"><boolean name="hide_emitters" value="HIDDEN"/></integrator>
    <sensor type="perspective"><float name="fov" value="50"/>
        <transform name="to_world"><lookat origin="0,-4,1.5" target="0,0,0" up="0,0,1"/></transform>
        <film type="hdrfilm"><string name="pixel_format" value="rgba"/><rfilter type="gaussian"/>
            <integer name="width" value="16"/><integer name="height" value="12"/></film>
    </sensor>
    <shape type="sphere"><float name="radius" value=".5"/><point name="center" x="-.9" y="0" z="0"/></shape>
    <shape type="rectangle"><transform name="to_world"><scale value=".5"/><translate x=".1"/></transform>
        <bsdf type="diffraction_grating"><string name="profile" value="blazed"/><float name="period" value="2.5"/>
            <float name="depth" value="0.25"/><float name="coherence_length" value="6"/>
            <string name="material" value="none"/><boolean name="conserve_energy" value="false"/></bsdf></shape>
    <shape type="rectangle"><transform name="to_world"><scale value=".5"/><translate x="1.2"/></transform>
        <bsdf type="mask"><float name="opacity" value=".5"/><bsdf type="diffuse"/></bsdf></shape>
    LIGHT
</scene>"""


@pytest.fixture
def three_bands(monkeypatch):
    monkeypatch.setattr(tracing, "BAND_PIXELS", 40)


def test_bands_cover_the_film(monkeypatch):
    built = SceneFile(write_scene()).load()
    assert bands_of(built) == ((0, 10),)
    for pixels, count in ((119, 2), (40, 3), (12, 10), (1, 10)):
        monkeypatch.setattr(tracing, "BAND_PIXELS", pixels)
        bands = bands_of(built)
        assert len(bands) == count
        assert [row for first, end in bands for row in range(first, end)] == list(range(10))
    # Mitsuba's own film takes whole pictures only.
    assert bands_of(SceneFile(write_scene("prb")).load()) == ((0, 10),)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("integrator", "sampler"),
    [("path", "multijitter"), pytest.param("diffraction_path", "independent", marks=pytest.mark.slow)],
)
def test_a_picture_in_bands_has_the_expectation_of_one_in_a_single_piece(integrator, sampler, three_bands):
    built = SceneFile(write_scene(integrator, sampler)).load()
    bands = bands_of(built)
    light = LightOfBands(bands)

    def rows(sums):
        """Return luminance and mean filter weight per sample of each row."""
        luminance = radiance_to_XYZ(sums[..., :-1], channel_wavelengths())[..., 1]
        return np.stack([luminance.mean(1), sums[..., -1].mean(1)]) / 36

    whole = np.array([rows(trace_pass(built, 36, seed)) for seed in range(8)])
    parts = [[trace_pass(built, 36, 100 + seed, None, band, light) for band in bands] for seed in range(8)]
    banded = np.array([rows(np.concatenate(part)) for part in parts])
    error = np.sqrt((whole.var(0, ddof=1) + banded.var(0, ddof=1)) / 8)
    assert (error < 0.1 * whole.mean(0)).all()
    np.testing.assert_array_less(np.abs(banded.mean(0) - whole.mean(0)), 4 * error)


def test_passes_prepare_the_light_once(llvm, monkeypatch):
    built = SceneFile(write_scene("diffraction_path")).load()
    bands, prepared = bands_of(built), []
    original = LightPaths._number_per_sample
    monkeypatch.setattr(LightPaths, "_number_per_sample", lambda self: prepared.append(self) or original(self))
    light = LightOfBands(bands)
    for seed in range(3):
        trace_pass(built, 1, seed, None, bands[0], light)
    assert len(prepared) == 1


def test_light_of_bands_is_that_of_the_whole_bit_for_bit(three_bands):
    built = SceneFile(write_scene("diffraction_path")).load()
    integrator, bands = built.integrator(), bands_of(built)

    class LightAlone(mi.SamplingIntegrator):
        def parts(self, scene, sensor):
            return self, integrator.parts(scene, sensor)[1]

        def sample(self, scene, sampler, ray, medium=None, active=True):
            return mi.Spectrum(dr.select(dr.squared_norm(ray.d) < 2, 0.0, 1.0)), active, []

    alone, light = LightAlone(mi.Properties()), LightOfBands(bands)
    for seed in (1, 2):
        whole = trace_pass(built, 256, seed, alone)[..., :-1]
        assert (whole.sum((1, 2)) > 0).sum() > 5
        banded = np.concatenate([trace_pass(built, 256, seed, alone, band, light) for band in bands])
        np.testing.assert_array_equal(banded[..., :-1], whole)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("integrator", "light", "hidden"),
    [
        ("diffraction_path", "directional", False),
        pytest.param("path", "constant", True, marks=pytest.mark.slow),
        pytest.param("diffraction_path", "constant", False, marks=pytest.mark.slow),
        pytest.param("path", "directional", False, marks=pytest.mark.slow),
    ],
)
def test_alpha_is_that_of_mitsubas_own_film(integrator, light, hidden, three_bands):
    emitter = {"constant": "", "directional": '<vector name="direction" x="0" y=".6" z="-.8"/>'}[light]
    text = SCENE_WITH_ALPHA.replace("LIGHT", f'<emitter type="{light}">{emitter}</emitter>')
    text = text.replace("HIDDEN", str(hidden).lower())
    Path("scene.xml").write_text(text.replace("INTEGRATOR", integrator))
    Path("wanted.xml").write_text(text.replace("INTEGRATOR", "path"))
    alpha = render("scene.xml", spp=1024).alpha
    wanted = np.array(mi.render(mi.load_file("wanted.xml"), spp=1024, seed=1))[..., 3]
    np.testing.assert_allclose(alpha, wanted, atol=0.08)  # five standard errors of the half transparent rectangle
    np.testing.assert_allclose(alpha.mean(), wanted.mean(), atol=0.004)
    assert alpha.min() == (1 if light == "constant" and not hidden else 0)
    assert alpha.max() > 0.99
    assert render(write_scene(), spp=1).alpha is None


def stop_after(count):
    """A tracer that presses Ctrl-C while it traces the last of `count` bands."""

    def trace(job, scene, first):
        for number, traced in enumerate(trace_locally(job, scene, first), 1):
            if number == count:
                signal.raise_signal(signal.SIGINT)
            yield traced

    return trace


@pytest.mark.parametrize("integrator", ["path", pytest.param("diffraction_path", marks=pytest.mark.slow)])
def test_bands_are_interrupted_resumed_and_saved(integrator, three_bands, small_passes):
    small_passes(11)  # one sample per pixel
    write_scene(integrator)
    whole = render("scene.xml", spp=6)
    assert isinstance(whole, BandedImage)
    assert whole.shape == whole.radiance.shape == (10, 12, channel_wavelengths().size)
    calls = []
    request = {"spp": 6, "checkpoint": "c", "progress": lambda *call: calls.append(call[:2])}
    with pytest.raises(KeyboardInterrupt) as caught:  # in the second band, before there is a whole picture
        render("scene.xml", tracer=stop_after(2), **request)
    assert not isinstance(caught.value, Interrupted)
    with pytest.raises(Interrupted) as caught:
        render("scene.xml", tracer=stop_after(8), **request)
    assert caught.value.image.attributes["spp"] == 3
    assert calls == [
        (0, 6),
        (0.33, 6),
        (0.67, 6),
        (0.67, 6),
        *((x, 6) for x in (1, 1.33, 1.67, 2, 2.33, 2.67, 3, 3.33)),
    ]
    np.testing.assert_allclose(caught.value.image.radiance.mean(), whole.radiance.mean(), rtol=0.5)
    resumed = render("scene.xml", **request)
    assert resumed.attributes == whole.attributes
    assert resumed.attributes["error"] > 0
    resumed.save("a.exr")
    np.testing.assert_array_equal(SpectralImage.load("a.exr").radiance, whole.radiance)

    assert {path.name for path in Path().iterdir()} == {"scene.xml", "a.exr", "c", "c.1", "c.2"}
    Path("c.1").unlink()
    with pytest.raises(ValueError, match="c: a checkpoint of another band is missing"):
        render("scene.xml", **request)
    resumed.save("c.1")
    with pytest.raises(ValueError, match=r"c\.1: not a checkpoint"):
        render("scene.xml", **request)
    discard_checkpoints("c")
    assert {path.name for path in Path().iterdir()} == {"scene.xml", "a.exr"}


@pytest.mark.slow
def test_previews_of_bands_hold_one_band_in_memory(three_bands, small_passes, monkeypatch):
    small_passes(11)
    monkeypatch.setattr(passes, "MIN_CHECKPOINT_INTERVAL", 0)
    whole = render(write_scene(), spp=2)
    rows, previews = [], []
    radiance = Accumulation.radiance

    def of_rows(sums, *blocks):
        rows.append(len(sums.luminance))
        return radiance(sums, *blocks)

    def look(image):
        save_preview(image, "a.png")
        assert "radiance" not in vars(image)  # read as a whole
        previews.append(np.array(Image.open("a.png")))

    with monkeypatch.context() as patch:
        patch.setattr(Accumulation, "radiance", of_rows)
        resumed = render("scene.xml", spp=2, checkpoint="c", seconds=0, on_checkpoint=look)
    np.testing.assert_array_equal(resumed.radiance, whole.radiance)
    assert len(previews) == 5  # after all bands but the last
    assert rows == 5 * [3, 3, 4]
    # Bands that were not traced yet are black.
    assert [preview[:3].any() for preview in previews] == 5 * [True]
    assert [preview[6:].any() for preview in previews] == 2 * [False] + 3 * [True]


@pytest.mark.slow
def test_the_error_of_bands_is_that_of_the_whole_picture(three_bands, small_passes, monkeypatch):
    small_passes(11)
    banded = render(write_scene(), spp=64, until_error=0.2)
    monkeypatch.setattr(tracing, "BAND_PIXELS", 1000)
    whole = render("scene.xml", spp=64, until_error=0.2)
    assert banded.attributes["error"] <= 0.2
    assert banded.attributes["spp"] < 64
    assert banded.attributes["spp"] == pytest.approx(whole.attributes["spp"], rel=0.4)


def test_checkpoints_that_do_not_fit_on_the_disk_are_refused(three_bands, monkeypatch):
    monkeypatch.setattr(passes, "trace_pass", None)
    usage = passes.shutil.disk_usage(".")
    monkeypatch.setattr(passes.shutil, "disk_usage", lambda folder: usage._replace(free=10**4))
    words = r"12 × 10 pixels, whose checkpoints take 67 kB of the disk, wanted at most the 10 kB"
    with pytest.raises(ValueError, match=words):
        render(write_scene(), spp=4, checkpoint="c")


@pytest.mark.slow
def test_what_a_rendering_needs_is_announced_after_two_bands(three_bands, small_passes, monkeypatch):
    small_passes(11)
    clock = itertools.count(0, 10)  # each look at the clock is ten seconds after the one before
    # The clock of this module alone: Python's own is looked at by others, too.
    monkeypatch.setattr(passes, "time", SimpleNamespace(perf_counter=lambda: next(clock), monotonic=time.monotonic))
    estimates = []
    render(write_scene(), spp=6, announce=estimates.append)
    (estimate,) = estimates
    assert (estimate.columns, estimate.rows, estimate.spp) == (12, 10, 6)
    assert estimate.memory == 12 * (4 * (8 * 93 + 84 + 40) + 80)
    assert estimate.disk == 12 * 14 * (93 + 6) * 4  # one of four rows is written anew while the old one is there
    assert estimate.seconds == 160  # for 16 more


@pytest.mark.slow
def test_an_estimate_is_corrected_after_a_tenth_of_the_work(small_passes, monkeypatch):
    """The second pass takes 10 s, all later ones 30 s: a sky above a snake."""
    small_passes(11)
    clock = itertools.accumulate(itertools.chain([0, 10], itertools.repeat(30)))
    monkeypatch.setattr(passes, "time", SimpleNamespace(perf_counter=lambda: next(clock), monotonic=time.monotonic))
    estimates = []
    render(write_scene(), spp=60, announce=lambda estimate: estimates.append(estimate.seconds))
    first, second = estimates
    count = round(first / 10) + 2  # passes
    done = -(-count // 10)
    assert second == pytest.approx((10 + 30 * (done - 2)) / (done - 1) * (count - done))
    assert 1 / 1.5 < second / (30 * (count - done)) < 1.5


@pytest.mark.slow
def test_large_pictures_need_at_most_two_gigabytes():
    write_scene("diffraction_path")
    # Started by a small process: Linux counts the memory of the process that starts another one as that of the latter.
    program = """
import os, sys
words = ("render", "scene.xml", "--width", "2560", "--spp", "1", "--checkpoint", "0", "-o", "out.exr")
process = os.posix_spawn(sys.executable, [sys.executable, "-m", "mitsuba_diffraction", *words], os.environ)
_, status, usage = os.wait4(process, 0)
print(status, usage.ru_maxrss)
"""
    output = subprocess.run([sys.executable, "-c", program], check=True, capture_output=True, text=True).stdout
    status, kilobytes = map(int, output.split()[-2:])
    assert status == 0
    assert SpectralImage.load("out.exr").shape[:2] == (1600, 1920)
    assert 1024 * kilobytes < 2e9
