"""Long renderings: stopping by noise, kills, Ctrl-C, full disks, and animations."""

import importlib
import itertools
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pytest
from PIL import Image

from mitsuba_diffraction import progress  # settles which LLVM is used before a variant is set
from mitsuba_diffraction.errors import RequestError
from mitsuba_diffraction.files.writing import exclusive, is_intact, seal
from mitsuba_diffraction.optics.color import radiance_to_XYZ
from mitsuba_diffraction.render import SpectralImage, passes, render
from mitsuba_diffraction.render import sums as sums_of_passes
from mitsuba_diffraction.render.animation import frames_of, orbit
from mitsuba_diffraction.render.passes import Interrupted
from mitsuba_diffraction.render.scene_file import SceneFile
from mitsuba_diffraction.render.spectral_film import channel_wavelengths
from mitsuba_diffraction.render.spectral_image import save_preview, stored_digest
from mitsuba_diffraction.render.sums import Accumulation, error_of_picture, load_checkpoint, save_checkpoint

SIZE = 16
SCENE = f"""<scene version="3.0.0"><default name="red" value="0.5"/><integrator type="path"/>
<sensor type="perspective"><transform name="to_world"><lookat origin="0,-4,2" target="0,0,0.5" up="0,0,1"/></transform>
<film type="hdrfilm"><integer name="width" value="{SIZE}"/><integer name="height" value="{SIZE}"/>
<rfilter type="RFILTER"/></film></sensor><emitter type="constant"/>
<emitter type="point"><point name="position" x="2" y="-1" z="2"/></emitter>
<shape type="sphere"><point name="center" x="0.4" y="0" z="0.5"/>
<bsdf type="diffuse"><rgb name="reflectance" value="$red, 0.2, 0.1"/></bsdf></shape></scene>"""
# The command with passes of one sample per pixel, so that a small picture has many.
SMALL_PASSES = f"""import mitsuba_diffraction.cli, mitsuba_diffraction.render.passes as passes
passes.SAMPLES_PER_PASS, passes.SAMPLES_PER_PIXEL_OF_LARGE_PICTURES = {SIZE**2}, 1
mitsuba_diffraction.cli.main()"""


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch, small_passes):
    """Each test stands in a folder of its own, with a scene; passes take one sample per pixel."""
    small_passes(SIZE)
    monkeypatch.chdir(tmp_path)
    Path("scene.xml").write_text(SCENE.replace("RFILTER", "tent"))
    return tmp_path


def stop_after(count):
    """A tracer of passes that presses Ctrl-C while it traces the last of `count`."""

    def trace(job, scene, first):
        for number, traced in enumerate(passes.trace_locally(job, scene, first), 1):
            if number == count:
                signal.raise_signal(signal.SIGINT)
            yield traced

    return trace


def press_ctrl_c(monkeypatch, count, number_of_signal=signal.SIGINT):
    """Lets the command be interrupted in its pass number `count`."""
    original, number = passes.trace_pass, itertools.count(1)

    def trace_pass(*arguments):
        if next(number) == count:
            signal.raise_signal(number_of_signal)
        return original(*arguments)

    monkeypatch.setattr(passes, "trace_pass", trace_pass)


def files():
    return {path.name for path in Path().iterdir()}


def samples_in(checkpoint):
    """How far a checkpoint of passes of one sample is; its digest is checked."""
    assert is_intact(checkpoint)
    return int(Path(checkpoint).read_bytes().split(b"\n")[3])


# --- the error of the picture ---


def test_error_is_the_scatter_of_whole_pictures():
    # Luminances with a known relative scatter per sample in each pixel; passes of unequal size.
    rng = np.random.default_rng(5)
    wavelengths = channel_wavelengths()
    scatter = rng.uniform(0.2, 2.0, (40, 50))
    scatter[3:5] = 50.0  # some pixels never converge, and do not decide
    sums = Accumulation.empty(40, 50)
    assert np.isnan(error_of_picture(sums.relative_errors()))
    for number in range(400):
        samples = 2 + number % 3
        luminance = 3 * (1 + scatter * rng.normal(size=scatter.shape) / np.sqrt(samples))
        luminance[0, :] = 0.0  # black, and not counted
        traced = np.repeat(luminance[..., None], wavelengths.size + 1, axis=2)
        traced[..., -1] = 1.0
        sums.add((traced * samples).astype(np.float32), samples)
    assert (sums.passes, sums.samples) == (400, 1199)
    expected = np.percentile((scatter[1:] / np.sqrt(1199)), 90)
    assert error_of_picture(sums.relative_errors()) == pytest.approx(expected, rel=0.05)


@pytest.mark.slow
def test_black_pictures_have_no_error_and_finish(folder):
    text = SCENE.replace("RFILTER", "box")
    Path("scene.xml").write_text(text[: text.index('<emitter type="constant"')] + "</scene>")
    image = render("scene.xml", spp=6, until_error=0.01)
    assert image.attributes["spp"] == 6
    assert not image.radiance.any()


@pytest.mark.slow
def test_until_error_stops_at_the_requested_noise():
    calls = []
    image = render("scene.xml", spp=4096, until_error=0.05, progress=lambda *call: calls.append(call))
    done = image.attributes["spp"]
    assert 16 <= done < 4096
    assert image.attributes["error"] <= 0.05
    assert all(error > 0.05 or index <= 3 for index, (_, _, error) in enumerate(calls[:-1]))
    # What remains is foreseen: the error falls with the root of the samples.
    assert calls[done // 2][1] == pytest.approx(done, rel=0.4)
    # The pictures of other seeds scatter as was said.
    others = [render("scene.xml", spp=done, seed=seed) for seed in range(1, 9)]
    others = np.stack([radiance_to_XYZ(other.radiance, other.wavelengths)[..., 1] for other in others])
    lit = others.mean(axis=0) > 0
    spread = np.percentile(others.std(axis=0, ddof=1)[lit] / others.mean(axis=0)[lit], 90)
    assert spread == pytest.approx(0.05, rel=0.8)

    with pytest.raises(Interrupted):
        render("scene.xml", spp=4096, until_error=0.05, checkpoint="c", tracer=stop_after(done // 2))
    resumed = render("scene.xml", spp=4096, until_error=0.05, checkpoint="c")
    np.testing.assert_array_equal(resumed.radiance, image.radiance)
    assert resumed.attributes == image.attributes


def test_the_layout_of_a_pass_does_not_change_its_luminance():
    # Of a cluster, passes arrive with the channels of a pixel side by side; here they are those of a row.
    traced = np.random.default_rng(3).random((5, 94, 7), np.float32)
    luminances = []
    for array in (np.moveaxis(traced, 1, 2), np.ascontiguousarray(np.moveaxis(traced, 1, 2))):
        sums = Accumulation.empty(5, 7)
        sums.add(array, 1)
        luminances.append(sums.luminance)
    assert luminances[0].any()
    np.testing.assert_array_equal(*luminances)


@pytest.mark.parametrize("error", [0, -1, 1, float("nan")])
def test_errors_out_of_range_are_refused(error):
    with pytest.raises(ValueError, match="until_error: got"):
        render("scene.xml", spp=4, until_error=error)


# --- checkpoints ---


@pytest.mark.slow
def test_ctrl_c_saves_the_picture_so_far_and_resuming_gives_the_same_bits():
    whole = render("scene.xml", spp=7)
    with pytest.raises(Interrupted) as caught:
        render("scene.xml", spp=7, checkpoint="c", tracer=stop_after(3))
    partial = caught.value.image
    assert partial.attributes["spp"] == 3
    assert "digest" not in partial.attributes
    np.testing.assert_allclose(partial.radiance.mean(), whole.radiance.mean(), rtol=0.3)
    calls = []
    with pytest.raises(Interrupted):
        render("scene.xml", spp=7, checkpoint="c", tracer=stop_after(2), progress=lambda *call: calls.append(call))
    assert [call[:2] for call in calls] == [(3, 7), (4, 7), (5, 7)]
    resumed = render("scene.xml", spp=7, checkpoint="c")
    np.testing.assert_array_equal(resumed.radiance, whole.radiance)
    assert resumed.attributes == whole.attributes
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL


def test_a_second_ctrl_c_does_not_wait():
    def trace(job, scene, first):
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)
        yield pytest.fail("the first one alone was heard")

    with pytest.raises(KeyboardInterrupt) as caught:
        render("scene.xml", spp=7, checkpoint="c", tracer=trace)
    assert not isinstance(caught.value, Interrupted)
    assert files() == {"scene.xml"}


def test_ctrl_c_stays_ignored_if_it_was():
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        assert render("scene.xml", spp=3, tracer=stop_after(2)).attributes["spp"] == 3
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, before)


def as_saved(image):
    """The radiance as the command writes it."""
    return image.radiance.astype(np.float16).astype(np.float32)


@pytest.mark.slow
def test_checkpoints_are_written_every_so_often(monkeypatch):
    clock = iter(np.arange(0, 1000, 4.0))  # each look at the clock is four seconds after the one before
    monkeypatch.setattr(passes.time, "monotonic", lambda: next(clock))
    written = []
    monkeypatch.setattr(
        sums_of_passes, "save_checkpoint", lambda checkpoint, digest, sums: written.append(sums.samples)
    )
    render("scene.xml", spp=60, checkpoint="c", seconds=10)
    # After three looks; then twenty times the four seconds that one took to write, counted from its beginning.
    assert written == [3, 22, 41]


def test_a_checkpoint_that_another_process_writes_is_refused():
    with exclusive("c"), pytest.raises(ValueError, match="c: another process is writing it"):
        render("scene.xml", spp=4, checkpoint="c")
    assert not list(Path().glob(".c*"))


@pytest.mark.parametrize(
    ("scene", "change"),
    [
        ({}, {"spp": 8}),
        ({}, {"seed": 1}),
        ({"size": (12, None)}, {}),
        ({"parameters": {"red": "0.6"}}, {}),
        ({}, {"until_error": 0.1}),
        ({"motion": (1.0, 0, 0, 0.5, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1)}, {}),
    ],
)
def test_checkpoints_of_other_renderings_are_refused(scene, change):
    with pytest.raises(Interrupted):
        render("scene.xml", spp=7, checkpoint="c", tracer=stop_after(2))
    before = Path("c").read_bytes()
    with pytest.raises(ValueError, match="c: of another rendering"):
        render(SceneFile("scene.xml", **scene), **{"spp": 7, "checkpoint": "c", **change})
    assert Path("c").read_bytes() == before


def test_the_digest_depends_on_the_content_of_a_scene_and_its_files(tmp_path):
    texture = '<texture type="bitmap" name="reflectance"><string name="filename" value="grey.png"/></texture>'
    text = SCENE.replace("RFILTER", "box").replace('<rgb name="reflectance" value="$red, 0.2, 0.1"/>', texture)

    def digest(folder, grey, text=text):
        folder.mkdir(exist_ok=True)
        Image.new("L", (2, 2), grey).save(folder / "grey.png")
        (folder / "scene.xml").write_text(text)
        return SceneFile(folder / "scene.xml").digest()

    first = digest(tmp_path / "a", 100)
    assert digest(tmp_path / "b", 100) == first
    assert digest(tmp_path / "b", 101) != first
    assert digest(tmp_path / "b", 100, text.replace("0.4", "0.41")) != first

    # An included file, and a table of a spectrum.
    (tmp_path / "a" / "light.spd").write_text("400 1\n700 2\n")
    included = """<scene version="3.0.0">
        <emitter type="constant"><spectrum name="radiance" filename="light.spd"/></emitter>
        <shape type="sphere"><transform name="to_world"><translate x="0.1"/></transform><bsdf type="diffuse">
        <rgb name="reflectance" value="0.1, 0.2, 0.3"/></bsdf></shape>
        <emitter type="constant"><spectrum name="radiance" value="400:0.1, 700:0.5"/></emitter></scene>"""
    (tmp_path / "a" / "more.xml").write_text(included)
    text = SCENE.replace("RFILTER", "box").replace("</scene>", '<include filename="more.xml"/></scene>')
    (tmp_path / "a" / "scene.xml").write_text(text)
    first = SceneFile(tmp_path / "a" / "scene.xml").digest()
    for old, new in (("0.5", "0.6"), ('x="0.1"', 'x="0.1000001"'), ("0.3", "0.3000001")):
        assert old in included
        (tmp_path / "a" / "more.xml").write_text(included.replace(old, new))
        assert SceneFile(tmp_path / "a" / "scene.xml").digest() != first, new
    (tmp_path / "a" / "more.xml").write_text(included)
    assert SceneFile(tmp_path / "a" / "scene.xml").digest() == first
    (tmp_path / "a" / "light.spd").write_text("400 1\n700 3\n")
    assert SceneFile(tmp_path / "a" / "scene.xml").digest() != first

    grating = '<bsdf type="diffraction_grating"><string name="filename" value="recipe.toml"/></bsdf>'
    Path("scene.xml").write_text(SCENE.replace("RFILTER", "box").replace("</scene>", f"{grating}</scene>"))
    recipe = '[surface]\nscan = "scan.npy"\npixel_size = 0.1\n'
    Path("recipe.toml").write_text(recipe)
    np.save("scan.npy", np.zeros((4, 4)))
    first = SceneFile("scene.xml").digest()
    np.save("scan.npy", np.ones((4, 4)))
    assert SceneFile("scene.xml").digest() != first


OF_REQUEST = 64 * "d"


def stored_sums():
    """Sums of seven passes of two samples, 3 × 4 pixels, in the checkpoint `c`."""
    rng = np.random.default_rng(8)
    sums = Accumulation.empty(3, 4)
    for array in sums.arrays():
        array[...] = rng.random(array.shape)
    sums.passes, sums.samples = 7, 14
    save_checkpoint("c", OF_REQUEST, sums)
    return sums


def read_back(passes=10):
    found = Accumulation.empty(3, 4)
    load_checkpoint("c", OF_REQUEST, found, passes * (2,))
    return found


def test_a_checkpoint_holds_the_sums():
    stored = vars(stored_sums())
    for name, value in vars(read_back()).items():
        np.testing.assert_array_equal(value, stored[name])


@pytest.mark.parametrize("damage", ["cut", "longer", "changed", "text", "empty", "numpy"])
def test_damaged_checkpoints_are_refused(damage):
    stored_sums()
    whole = Path("c").read_bytes()
    if damage == "numpy":
        changed = np.frombuffer(whole[-48:], np.float64) * 2
        spoilt = whole[:-48] + changed.tobytes()
    else:
        spoilt = {"cut": whole[:-300], "longer": whole + b"0", "text": b"[surface]\n", "empty": b""}.get(damage)
    Path("c").write_bytes(whole.replace(b"0", b"1") if spoilt is None else spoilt)
    with pytest.raises(RequestError, match=r"^c: not a checkpoint, or a damaged one$"):
        read_back()


def test_every_changed_bit_of_a_checkpoint_is_refused():
    stored_sums()
    whole = Path("c").read_bytes()
    header = whole.index(b"7\n") + 2
    with open("c", "r+b", buffering=0) as stream:
        bits = np.random.default_rng(8).integers(8 * header, 8 * len(whole), 500)
        for byte, bit in (divmod(bit, 8) for bit in (*range(8 * header), *bits.tolist())):
            for value in (whole[byte] ^ 1 << bit, whole[byte]):
                stream.seek(byte)
                stream.write(bytes([value]))
                if value != whole[byte]:
                    with pytest.raises(RequestError, match=r"^c: not a checkpoint, or a damaged one$"):
                        read_back()
    read_back()


@pytest.mark.parametrize(
    ("old", "new"), [(b"      7\n", b"1000000\n"), (b"      7\n", b"     -7\n"), (b"", b"12345678")]
)
def test_sealed_sums_that_do_not_suit_the_request_are_refused(old, new):
    stored_sums()
    whole = Path("c").read_bytes()
    Path("c").write_bytes(whole.replace(old, new, 1) if old else whole + new)
    seal("c")
    with pytest.raises(RequestError, match=r"^c: sums of -?\d+ passes that do not suit the request"):
        read_back()


@pytest.mark.slow
@pytest.mark.posix("SIGKILL")
@pytest.mark.parametrize(
    ("kills", "rfilter"),
    [(2, "box"), (5, "gaussian")],
)
def test_killed_renderings_go_on_and_give_the_same_bits(command, kills, rfilter):
    Path("scene.xml").write_text(SCENE.replace("RFILTER", rfilter))
    rng = np.random.default_rng(20)
    checkpoint = Path("out.exr.checkpoint")
    spp, reached = 300, 0
    for _ in range(kills):
        words = ("render", "scene.xml", "--variant", "llvm_ad_spectral", "-o", "out.exr", "--spp", str(spp))
        process = subprocess.Popen(
            [sys.executable, "-c", SMALL_PASSES, *words, "--checkpoint", "0", "--resume"],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        )
        before = checkpoint.stat().st_mtime_ns if reached else None
        while process.poll() is None and not (checkpoint.exists() and checkpoint.stat().st_mtime_ns != before):
            time.sleep(0.001)
        time.sleep(rng.uniform(0, 0.15))
        process.kill()
        _, messages = process.communicate()
        assert process.returncode == -signal.SIGKILL, messages
        now = samples_in(checkpoint)
        assert reached < now < spp
        reached = now
    code, out, err = command(*words, "--resume")
    assert code == 0, err
    assert f"{spp} samples per pixel" in out
    assert files() == {"scene.xml", "out.exr", "out.png"}
    expected = render("scene.xml", spp=spp)
    resumed = SpectralImage.load("out.exr")
    np.testing.assert_array_equal(resumed.radiance, as_saved(expected))
    assert resumed.attributes["digest"] == expected.attributes["digest"]


# --- the command ---

RENDER = "render scene.xml --variant llvm_ad_spectral"
LINE = f"{RENDER} -o out.exr --spp 6"


@pytest.mark.slow
def test_the_command_is_interrupted_and_goes_on(command, monkeypatch):
    press_ctrl_c(monkeypatch, 2)
    code, out, err = command(LINE)
    assert (code, out) == (130, "")
    expected = (
        "mitsuba-diffraction: interrupted: out.exr holds 2 samples per pixel; the same command with --resume continues"
    )
    assert err.strip() == expected
    assert files() == {"scene.xml", "out.exr", "out.png", "out.exr.checkpoint"}
    assert SpectralImage.load("out.exr").attributes["spp"] == 2

    code, out, err = command(LINE)
    assert (code, out) == (2, "")
    assert err.startswith(
        "mitsuba-diffraction: error: out.exr.checkpoint is of an unfinished rendering: --resume continues"
    )
    code, out, err = command(f"{LINE} --resume --seed 3 --overwrite")
    assert (code, out) == (2, "")
    assert "out.exr.checkpoint: of another rendering" in err
    assert samples_in("out.exr.checkpoint") == 2

    code, out, err = command(f"{LINE} --resume")
    assert (code, err) == (0, "")
    assert re.search(r"6 samples per pixel, noise at most \d.* pixels, llvm", out)
    assert files() == {"scene.xml", "out.exr", "out.png"}
    picture = SpectralImage.load("out.exr")
    np.testing.assert_array_equal(picture.radiance, as_saved(render("scene.xml", spp=6)))
    # Done already: nothing is traced again.
    monkeypatch.setattr(passes, "trace_pass", None)
    written = Path("out.exr").stat().st_mtime_ns
    assert command(f"{LINE} --resume")[0] == 0
    assert Path("out.exr").stat().st_mtime_ns == written


@pytest.mark.parametrize(("name", "number"), [("out.png", signal.SIGINT), ("out.jpg", signal.SIGTERM)])
def test_a_picture_alone_is_interrupted_and_goes_on(command, monkeypatch, name, number):
    line = f"{RENDER} -o {name} --spp 4"
    press_ctrl_c(monkeypatch, 2, number)
    code, out, err = command(line)
    assert (code, out) == (130, "")
    assert f"interrupted: {name} holds 2 samples per pixel; the same command with --resume continues" in err
    assert files() == {"scene.xml", name, f"{name}.checkpoint"}
    assert stored_digest(name) is None
    assert f"{name}.checkpoint is of an unfinished rendering" in command(line)[2]
    code, out, err = command(f"{line} --resume")
    assert (code, err) == (0, "")
    assert files() == {"scene.xml", name}
    save_preview(render("scene.xml", spp=4), f"whole_{name}")
    assert Path(f"whole_{name}").read_bytes() == Path(name).read_bytes()
    # Done already: nothing is traced again.
    monkeypatch.setattr(passes, "trace_pass", None)
    written = Path(name).stat().st_mtime_ns
    assert command(f"{line} --resume")[:2] == (0, f"{name}: complete, nothing to do\n")
    assert Path(name).stat().st_mtime_ns == written


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_picture_that_is_being_written_is_completed(command, monkeypatch, number):
    save = SpectralImage.save

    def press_and_save(*arguments, **options):
        signal.raise_signal(number)
        save(*arguments, **options)

    monkeypatch.setattr(SpectralImage, "save", press_and_save)
    assert command(LINE)[::2] == (130, "mitsuba-diffraction: interrupted: out.exr is complete\n")
    assert files() == {"scene.xml", "out.exr", "out.png"}
    assert command(f"{LINE} --resume")[:2] == (0, "out.exr: complete, nothing to do\n")


@pytest.mark.parametrize("name", ["out.exr", "out.png"])
def test_each_checkpoint_renews_the_preview(command, monkeypatch, name):
    monkeypatch.setattr(passes, "MIN_CHECKPOINT_INTERVAL", 0)
    original, seen = passes.trace_pass, []

    def trace_pass(*arguments):
        seen.append((files() - {".out.exr.checkpoint.lock", ".out.png.checkpoint.lock"}, preview_so_far()))
        return original(*arguments)

    def preview_so_far():
        return np.array(Image.open("out.png")).astype(int) if Path("out.png").exists() else None

    monkeypatch.setattr(passes, "trace_pass", trace_pass)
    line = f"{RENDER} -o {name} --spp 3 --checkpoint 0 --exposure 0"
    assert command(line)[0] == 0
    assert [found for found, _ in seen] == [{"scene.xml"}, *2 * [{"scene.xml", "out.png", f"{name}.checkpoint"}]]
    save_preview(render("scene.xml", spp=3), "whole.png", exposure=1)
    whole = np.array(Image.open("whole.png")).astype(int)
    np.testing.assert_array_equal(preview_so_far(), whole)
    after_one, after_two = (np.abs(preview - whole).mean() for _, preview in seen[1:3])
    assert 30 > after_one > after_two > 0


def test_the_command_stops_at_an_error_and_reports_if_it_is_not_reached(command):
    code, out, err = command(f"{RENDER} -o out.exr --spp 4096 --until-error 0.2")
    assert (code, err) == (0, "")
    picture = SpectralImage.load("out.exr")
    assert picture.attributes["spp"] < 4096
    assert picture.attributes["error"] <= 0.2
    assert "increase --spp" not in out
    code, out, err = command(f"{RENDER} -o out.exr --spp 8 --until-error 0.001 --overwrite")
    assert (code, err) == (0, "")
    assert re.search(
        r"8 samples per pixel, noise at most \d.* % of the luminance in nine of ten pixels "
        r"\(above 0.1 %: increase --spp\)",
        out,
    )


def test_the_command_announces_long_renderings_and_takes_an_exposure(command, monkeypatch):
    module = importlib.import_module("mitsuba_diffraction.cli.render")
    sampler = '<sampler type="independent"><integer name="sample_count" value="3"/></sampler></sensor>'
    Path("scene.xml").write_text(SCENE.replace("RFILTER", "box").replace("</sensor>", sampler))
    code, out, err = command(f"{RENDER} -o out.exr --exposure -1.5")
    assert (code, err) == (0, "")
    assert "out.png: preview, exposed by -1.50 stops (--exposure -1.50)" in out
    monkeypatch.setattr(progress, "MIN_ANNOUNCED_SECONDS", 0)
    code, out, err = command(f"{RENDER} -o out.exr --spp 4")
    assert code == 0
    assert "16 × 16 pixels, 4 samples per pixel: about 0 s, 224 kB of memory" in err
    assert "a picture of 49 kB before compression" in err
    assert len(err.splitlines()) == 1
    assert re.search(r"exposed by \+?(-?\d+\.\d\d) stops \(--exposure \1\)", out)
    monkeypatch.setattr(module, "MIN_WARNED_SECONDS", 0)
    code, out, err = command(f"{RENDER} -o out.exr --overwrite")
    assert code == 0
    assert "the scene's own 3 samples per pixel take about" in err


def test_an_interrupt_before_the_first_pass_writes_nothing(command, monkeypatch):
    def interrupted(*arguments, **named):
        raise KeyboardInterrupt

    monkeypatch.setattr(SceneFile, "load", interrupted)
    code, out, err = command(LINE)
    assert (code, out) == (130, "")
    assert err.strip() == "mitsuba-diffraction: interrupted: nothing was written"
    assert files() == {"scene.xml"}


@pytest.mark.slow
@pytest.mark.posix("limits of a process")
def test_a_full_disk_is_one_line_and_keeps_the_last_checkpoint(command, monkeypatch, full_disk):
    def limited(line):
        with full_disk(100_000):  # a disk that is full raises another number
            return command(line)

    line = f"{LINE} --checkpoint 0"
    code, out, err = limited(line)
    assert (code, out) == (1, "")
    expected = "mitsuba-diffraction: error: out.exr.checkpoint: cannot be written (File too large); there is none yet"
    assert err.strip() == expected
    assert files() == {"scene.xml"}

    press_ctrl_c(monkeypatch, 2)
    command(line)
    code, out, err = limited(f"{line} --resume")
    assert (code, out) == (1, "")
    assert err.strip().endswith("(File too large); the last one, of 2 samples per pixel, is kept")
    assert samples_in("out.exr.checkpoint") == 2
    assert command(f"{line} --resume")[0] == 0
    np.testing.assert_array_equal(SpectralImage.load("out.exr").radiance, as_saved(render("scene.xml", spp=6)))


@pytest.fixture
def small_disk(tmp_path):
    """A disk of 150 kB."""
    place = tmp_path / "disk"
    place.mkdir()
    done = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=150k", "tmpfs", place], capture_output=True)
    if done.returncode:
        pytest.skip("nothing may be mounted here")
    yield place
    subprocess.run(["umount", place], check=True)


def test_a_disk_that_the_picture_fills_is_one_line(command, small_disk, monkeypatch):
    monkeypatch.setattr(passes, "MIN_CHECKPOINT_INTERVAL", 0)  # after each pass, however long a checkpoint takes
    # A checkpoint is 100 kB, two of them do not fit; a larger picture does not fit at all.
    code, out, err = command(f"{RENDER} --spp 6 -o disk/out.exr --checkpoint 0")
    assert (code, out) == (1, "")
    assert "disk/out.exr.checkpoint: cannot be written (No space left on device)" in err
    assert len(err.splitlines()) == 1
    assert samples_in("disk/out.exr.checkpoint") == 1
    for name in ("out.exr.checkpoint", "out.png"):
        Path("disk", name).unlink()
    code, out, err = command(f"{RENDER} -o disk/out.exr --width 80 --spp 1")
    assert (code, out) == (1, "")
    assert len(err.splitlines()) == 1, err
    assert "disk/out.exr or its preview cannot be written" in err
    assert not list(small_disk.iterdir())


@pytest.mark.posix("permissions of a folder")
def test_a_folder_that_cannot_be_written_to_is_refused_before_the_work(command, monkeypatch):
    monkeypatch.setattr(passes, "trace_pass", None)
    place = Path("closed")
    place.mkdir()
    place.chmod(0o555)
    if os.access(place, os.W_OK):  # the superuser may; the kernel's own folders are closed to all
        place = Path("/sys")
        if not place.is_dir():
            pytest.skip("there is no folder that is closed")
    code, out, err = command(f"{RENDER} --spp 6 -o {place}/out.exr")
    assert (code, out) == (2, "")
    assert len(err.splitlines()) == 1
    assert err.startswith(f"mitsuba-diffraction: error: cannot write '{place}/out.exr': ")


def test_a_checkpoint_is_the_old_one_until_the_new_one_is_whole(monkeypatch):
    sums = stored_sums()
    whole = Path("c").read_bytes()

    def fail(path):
        assert Path(path).stat().st_size == len(whole)
        assert Path("c").read_bytes() == whole
        raise ZeroDivisionError

    monkeypatch.setattr(sums_of_passes, "seal", fail)
    with pytest.raises(ZeroDivisionError):
        save_checkpoint("c", 64 * "e", sums)
    assert files() == {"scene.xml", "c"}
    assert Path("c").read_bytes() == whole


# --- animations ---


def camera(motion, scene="scene.xml"):
    sensor = SceneFile(scene, motion=motion).load().sensors()[0]
    return np.ravel(np.array(sensor.world_transform().matrix)).reshape(4, 4)


def test_the_orbit_runs_around_the_target():
    motions = orbit(SceneFile("scene.xml"), 4)
    np.testing.assert_allclose(camera(motions[0]), camera(None), atol=1e-6)
    for motion, origin in zip(motions[1:], ("4,0,2", "0,4,2", "-4,0,2"), strict=True):
        Path("moved.xml").write_text(SCENE.replace("RFILTER", "box").replace("0,-4,2", origin))
        np.testing.assert_allclose(camera(motion), camera(None, "moved.xml"), atol=1e-6)


def test_the_orbit_of_a_parsed_scene_does_not_parse_it_again(monkeypatch):
    file = SceneFile("scene.xml")
    file.files()
    monkeypatch.setattr(
        "mitsuba_diffraction.render.scene_file.check_nesting", lambda *_: pytest.fail("it was parsed again")
    )
    assert len(orbit(file, 2)) == 2
    file.viewed(size=(4, 4)).load()


def test_lamps_do_not_displace_the_orbit():
    lamp = '<shape type="sphere"><point name="center" x="3" y="9" z="7"/><emitter type="area"/></shape></scene>'
    Path("scene.xml").write_text(SCENE.replace("RFILTER", "box").replace("</scene>", lamp))
    np.testing.assert_allclose(camera(orbit(SceneFile("scene.xml"), 2)[1])[:3, 3], [0, 4, 2], atol=1e-6)


def test_parameters_and_matrices_place_the_orbit():
    text = SCENE.replace("RFILTER", "box")
    Path("scene.xml").write_text(
        text.replace('target="0,0,0.5"', 'target="$x,0,0.5"').replace(
            "<integrator", '<default name="x" value="0"/><integrator'
        )
    )
    assert orbit(SceneFile("scene.xml", {"x": "1"}), 3) != orbit(SceneFile("scene.xml"), 3)
    np.testing.assert_allclose(camera(orbit(SceneFile("scene.xml"), 2)[1])[:3, 3], [0, 4, 2], atol=1e-6)
    # Without a lookat: the same axis.
    matrix = " ".join(f"{number:.9g}" for number in camera(None).ravel())
    lookat = '<lookat origin="0,-4,2" target="0,0,0.5" up="0,0,1"/>'
    Path("scene.xml").write_text(text.replace(lookat, f'<matrix value="{matrix}"/>'))
    np.testing.assert_allclose(camera(orbit(SceneFile("scene.xml"), 2)[1])[:3, 3], [0, 4, 2], atol=1e-5)


def test_the_orbit_takes_any_xml_that_mitsuba_takes():
    strange = SCENE.replace("RFILTER", "box").replace("<integrator", "<!-- caf\xe9 --><integrator", 1)
    Path("scene.xml").write_bytes(strange.replace('type="path"', 'type="path" id="a & b"', 1).encode("latin-1"))
    assert len(orbit(SceneFile("scene.xml"), 3)) == 3


def test_a_turntable_writes_frames_and_an_animation_and_resumes(command, monkeypatch):
    line = f"{RENDER} -o out.exr --float --frames 3 --orbit --spp 2"
    press_ctrl_c(monkeypatch, 3, signal.SIGTERM)
    code, _, err = command(line)
    assert code == 130
    assert "out_001.exr holds 1 samples per pixel; the same command with --resume continues" in err
    assert "out_001.exr.checkpoint" in files()
    first = Path("out_000.exr").stat().st_mtime_ns
    code, out, err = command(f"{line} --resume")
    assert (code, err) == (0, "")
    expected = {f"out_{number:03d}.{kind}" for number in range(3) for kind in ("exr", "png")}
    assert files() == {"scene.xml", "out.webp", "out.gif", "out.mp4", *expected}
    assert Path("out_000.exr").stat().st_mtime_ns == first
    assert len({line.split("exposed by ")[1] for line in out.splitlines() if "exposure" in line}) == 1
    for number, motion in enumerate(orbit(SceneFile("scene.xml"), 3)):
        picture = SpectralImage.load(f"out_{number:03d}.exr")
        np.testing.assert_array_equal(picture.radiance, render(SceneFile("scene.xml", motion=motion), spp=2).radiance)
    stills = [np.asarray(Image.open(f"out_{number:03d}.png"), dtype=float) for number in range(3)]
    for name in ("out.webp", "out.gif"):
        with Image.open(name) as animation:
            assert (animation.n_frames, animation.size) == (3, (SIZE, SIZE))
            for number in range(3):
                animation.seek(number)
                assert np.abs(np.asarray(animation.convert("RGB"), dtype=float) - stills[number]).mean() < 25
    film = [imageio_ffmpeg.get_ffmpeg_exe(), "-i", "out.mp4", "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    found = subprocess.run(film, capture_output=True, check=True).stdout
    shown = np.frombuffer(found, np.uint8).reshape(3, SIZE, SIZE, 3).astype(float)
    for still, frame in zip(stills, shown, strict=True):
        assert np.abs(frame - still).mean() < 25


def test_a_second_ctrl_c_in_a_turntable_reports_completed_pictures(command, monkeypatch):
    original, number = passes.trace_pass, itertools.count(1)

    def trace_pass(*arguments):
        if next(number) == 3:
            raise KeyboardInterrupt
        return original(*arguments)

    monkeypatch.setattr(passes, "trace_pass", trace_pass)
    code, _, err = command(f"{RENDER} -o out.exr --frames 3 --orbit --spp 2")
    assert code == 130
    assert "interrupted: 1 of 3 pictures are complete; the same command with --resume continues" in err
    assert files() == {"scene.xml", "out_000.exr", "out_000.png"}


def test_a_turntable_of_pictures_alone(command, monkeypatch):
    monkeypatch.setattr(progress, "MIN_ANNOUNCED_SECONDS", 0)
    line = f"{RENDER} -o out.jpg --frames 2 --orbit --spp 1"
    code, _, err = command(line)
    assert code == 0
    # A time of each picture is not said again and again.
    assert re.fullmatch(r"mitsuba-diffraction: scene.xml: other pictures \(1\): about \d+ s\n", err)
    assert files() == {"scene.xml", "out.webp", "out.gif", "out.mp4", "out_000.jpg", "out_001.jpg"}
    code, out, _ = command(f"{line} --resume")
    assert (code, out.count("complete, nothing to do")) == (0, 2)


MOVING = SCENE.replace("RFILTER", "box").replace('x="2" y="-1" z="2"', 'value="$lamp"')


def test_values_run_from_the_first_to_the_last_frame():
    grating = {"profile": "sinusoidal", "period": "2:3", "depth": 0.2, "theory": "a:b"}
    scene = {"red": "1:0", "lamp": "2, -1, 2:-2,-1,4", "lines": "588:0, 589:1", "name": "C:x", "spp": "4"}
    frames = frames_of(SceneFile("scene.xml", scene, {"g": grating}), 5)
    assert [frame.parameters["red"] for frame in frames] == ["1", "0.75", "0.5", "0.25", "0"]
    assert [frame.parameters["lamp"] for frame in frames[::2]] == ["2, -1, 2", "0, -1, 3", "-2, -1, 4"]
    assert [frame.replacements["g"]["period"] for frame in frames] == [2, 2.25, 2.5, 2.75, 3]
    rest = {name: scene[name] for name in ("lines", "name", "spp")}
    for frame in frames:
        assert rest.items() <= frame.parameters.items()
        assert frame.replacements["g"] == {**grating, "period": frame.replacements["g"]["period"]}


def test_a_lamp_moves_and_an_interrupted_film_of_it_resumes(command, monkeypatch):
    Path("scene.xml").write_text(MOVING.replace("<integrator", '<default name="lamp" value="2, -1, 2"/><integrator'))
    line = f"{RENDER} -o out.exr --float --frames 3 -D lamp=2,-1,2:-2,-1,4 -D red=1:0 --spp 2"
    press_ctrl_c(monkeypatch, 3)
    code, _, err = command(line)
    assert (code, "out_001.exr.checkpoint" in files()) == (130, True), err
    code, out, err = command(f"{line} --resume")
    assert (code, err) == (0, "")
    expected = {f"out_{number:03d}.{kind}" for number in range(3) for kind in ("exr", "png")}
    assert files() == {"scene.xml", "out.webp", "out.gif", "out.mp4", *expected}
    assert len({line.split("exposed by ")[1] for line in out.splitlines() if "exposure" in line}) == 1
    for number, (lamp, red) in enumerate([("2,-1,2", "1"), ("0,-1,3", "0.5"), ("-2,-1,4", "0")]):
        still = render(SceneFile("scene.xml", {"lamp": lamp, "red": red}), spp=2).radiance
        np.testing.assert_array_equal(SpectralImage.load(f"out_{number:03d}.exr").radiance, still)


@pytest.mark.slow
def test_a_grating_and_the_camera_change_at_once(command):
    Path("scene.xml").write_text(SCENE.replace("RFILTER", "box").replace('"diffuse"', '"diffuse" id="g"'))
    grating = {
        "profile": "sinusoidal",
        "period": 2.0,
        "material": "Al",
        "coherence_length": 3.0,
        "conserve_energy": False,
    }
    text = ",".join(f"{name}={value}" for name, value in grating.items() if name != "profile")
    line = f"{RENDER} -o out.exr --float --frames 3 --orbit --spp 1"
    code, _, err = command(f"{line} --material g=sinusoidal,{text},depth=0.1:-0.3")
    assert (code, len(err.splitlines())) == (2, 1)
    assert "depth: got -0.3, wanted a number" in err
    code, _, err = command(f"{line} --material g=sinusoidal,{text},depth=0.1:0.3")
    assert code == 0, err
    motion = orbit(SceneFile("scene.xml"), 3)[1]
    still = render(SceneFile("scene.xml", replacements={"g": {**grating, "depth": 0.2}}, motion=motion), spp=1).radiance
    np.testing.assert_array_equal(SpectralImage.load("out_001.exr").radiance, still)


@pytest.mark.parametrize(
    "options",
    [
        *("--frames 3", "--orbit", "--frames 1 --orbit", "--frames 1000000 --orbit"),
        *("--frames 3 -D red=0.5", "--frames 3 -D red=1:1"),
    ],
)
def test_an_animation_needs_frames_and_something_that_changes(command, options):
    code, out, err = command(f"{LINE} {options}")
    assert (code, out) == (2, "")
    assert len(err.splitlines()) == 1
    assert "--frames" in err
