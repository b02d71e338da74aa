"""Commands overwrite neither inputs nor, without `--overwrite`, foreign files; remains of killed ones are removed."""

import functools
import json
import os
import subprocess
import sys
from contextlib import contextmanager, nullcontext
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import mitsuba_diffraction as md
from mitsuba_diffraction.files import outputs, writing
from mitsuba_diffraction.files.outputs import check_outputs
from mitsuba_diffraction.files.writing import is_intact, refuse_unwritable, seal, whole_file
from mitsuba_diffraction.inverse_design import Design, makers, output
from mitsuba_diffraction.inverse_design.plate import Plate
from mitsuba_diffraction.inverse_design.target import wanted_fractions
from mitsuba_diffraction.render.animation import save_animation
from mitsuba_diffraction.render.scene_file import SceneFile
from mitsuba_diffraction.render.spectral_image import SpectralImage, save_preview
from mitsuba_diffraction.spectrum import exr

BLAZE = """[surface]
profile = "blazed"
period = 2.5
depth = 0.25
samples = 64
[spectrum]
tolerance = 0.02
coherence_length = 20
"""
SCAN = '[surface]\nscan = "scan.png"\npixel_size = 0.05\nheight_range = 0.3\n[spectrum]\ntolerance = 0.02\n'
SCENE = """<scene version="3.0.0"><default name="spectrum" value="u.exr"/><default name="light" value="sky"/>
<integrator type="path"/><sensor type="perspective"><transform name="to_world">
<lookat origin="0,0,4" target="0,0,0" up="0,1,0"/></transform><film type="hdrfilm">
<integer name="width" value="4"/><integer name="height" value="4"/></film></sensor>
<include filename="lights/$light.xml"/><shape type="sphere"><bsdf type="diffraction_grating">
<string name="filename" value="$spectrum"/><bsdf type="diffuse" name="base"><texture type="bitmap" name="reflectance">
<string name='filename' value='tex.png'/></texture></bsdf></bsdf></shape></scene>"""
SKY = """<scene version="3.0.0"><emitter type="constant">
<spectrum name="radiance" filename="sky.spd"/></emitter></scene>"""


@functools.cache
def spectrum():
    """Lobes so wide that the energy table is a small one; computed once."""
    return md.precompute(md.gratings.blazed(2.5, 0.25, samples=64), tolerance=0.02, coherence_length=20)


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """A scene in a folder of its own that names a spectrum, a texture, an included light and its table."""
    monkeypatch.chdir(tmp_path)
    Path("lights").mkdir()
    Path("u.xml").write_text(SCENE)
    Path("lights/sky.xml").write_text(SKY)
    Path("sky.spd").write_text("400 1\n700 1\n")
    Path("blaze.toml").write_text(BLAZE)
    Path("scan.toml").write_text(SCAN)
    pixels = np.random.default_rng(0).integers(0, 255, (8, 8), dtype=np.uint8)
    for name in ("scan.png", "tex.png"):
        Image.fromarray(pixels).save(name)
    spectrum().save("u.exr")
    return tmp_path


def contents():
    return {path: path.read_bytes() for path in Path().rglob("*") if path.is_file()}


def refused(command, line, name):
    """The command is refused in one line that names the file, and no file changes."""
    before = contents()
    code, out, err = command(line)
    assert (code, out) == (2, "")
    assert len(err.splitlines()) == 1, err
    assert name in err
    assert contents() == before
    return err


RENDER = "render u.xml --spp 1 --width 2"


# --- what is read ---


def test_a_scene_names_files(folder):
    named = {os.path.relpath(path, folder) for path in SceneFile("u.xml").files()}
    assert named == {"u.xml", "u.exr", "tex.png", "lights/sky.xml"}
    named = {os.path.relpath(path, folder) for path in SceneFile("u.xml", {"spectrum": "scan.toml"}).files()}
    assert named == {"u.xml", "scan.toml", "scan.png", "tex.png", "lights/sky.xml"}


@pytest.mark.posix("symbolic links without a privilege")
@pytest.mark.parametrize(
    ("line", "name"),
    [
        (f"{RENDER} -o u.exr", "u.exr"),
        (f"{RENDER} -o tex.exr", "tex.png"),  # the preview
        (f"{RENDER} -o tex.png", "tex.png"),
        (f"{RENDER} -o hard.exr", "u.exr"),
        (f"{RENDER} -o soft.exr", "u.exr"),
        (f"{RENDER} -o there/u.exr", "u.exr"),
        (f"{RENDER} -o lights/../u.exr", "u.exr"),
        (f"{RENDER} -D spectrum=scan.toml -o scan.exr", "scan.png"),
        (f"{RENDER} -D spectrum=u_001.exr -o u.exr --frames 2 --orbit", "u_001.exr"),
        ("compare u.xml --json lights/sky.xml -o a", "lights/sky.xml"),
        ("precompute scan.toml -o scan.EXR", ""),
        ("inspect scan.toml -o scan.png", "scan.png"),
        ("inspect scan.toml --json scan.toml", "scan.toml"),
        ("validate scan.toml --json scan.toml", "scan.toml"),
        ("validate scan.toml --markdown scan.png", "scan.png"),
        ("benchmark scan.png,pixel_size=0.05,height_range=0.3 --plot scan.png", "scan.png"),
        ("benchmark scan.toml --plot scan.png", "scan.png"),
    ],
)
def test_inputs_are_not_overwritten(command, line, name):
    # Regression: the README's own way put the picture over the spectrum, and the preview over the scan.
    os.link("u.exr", "hard.exr")
    Path("soft.exr").symlink_to("u.exr")
    Path("there").symlink_to(".")
    Path("u_001.exr").write_bytes(Path("u.exr").read_bytes())
    if not name:
        os.link("scan.png", "scan.EXR")
    assert "is read" in refused(command, f"{line} --overwrite", name)


@pytest.mark.slow
def test_default_names_differ_from_inputs(command):
    before = contents()
    line = RENDER.replace("u.xml", "u.xml -D spectrum=u.exr")
    for _ in range(2):  # the second time over its own files
        code, out, _ = command(line)
        assert code == 0
        assert out.startswith("u_2.exr: ")
    after = contents()
    assert {path: after[path] for path in before} == before
    assert {str(path) for path in after.keys() - before.keys()} == {"u_2.exr", "u_2.png"}


# --- one over another ---


@pytest.mark.parametrize(
    ("line", "name"),
    [
        ("inspect scan.toml -o q.png --json q.png", "q.png"),
        ("inspect scan.toml -o q.png --json Q.png", "Q.png"),
        ("validate scan.toml --json r --markdown ./r", "r"),
        ("benchmark --json b.png --plot b.png", "b.png"),
        ("compare u.xml -o c --json c.png", "c.png"),
        ("compare u.xml -o c --json c-path.exr", "c-path.exr"),
        ("precompute blaze.toml lights/../blaze.toml", "blaze.exr"),
    ],
)
def test_two_outputs_of_one_name_are_refused(command, line, name):
    assert "twice" in refused(command, f"{line} --overwrite", name)


# --- existing files ---


@pytest.mark.few(1)
@pytest.mark.parametrize(
    ("line", "other", "name"),
    [
        (f"{RENDER} -o a.exr", "--seed 1", "a.exr"),
        ("precompute blaze.toml -o a.exr", ",tolerance=0.05", "a.exr"),
        ("inspect blaze.toml -o a.png --json a.json", ",coherence_length=5", "a.png"),
    ],
)
def test_own_files_are_overwritten_and_foreign_files_only_with_the_option(command, line, other, name):
    assert command(line)[0] == 0
    before = Path(name).read_bytes()
    changed = line.replace(".toml", f".toml{other}") if other.startswith(",") else f"{line} {other}"
    assert command(changed)[0] == 0
    assert Path(name).read_bytes() != before
    Path(name).write_text("a year's work")
    assert "--overwrite" in refused(command, line, name)
    assert command(f"{line} --overwrite")[0] == 0
    assert command(line)[0] == 0


@pytest.mark.parametrize(
    ("line", "name"),
    [
        (f"{RENDER} -o a.exr", "a.png"),
        (f"{RENDER} -o a.png", "a.png"),
        ("compare u.xml --json sky.spd -o b", "sky.spd"),
    ],
)
def test_foreign_files_are_not_replaced(command, line, name):
    Path("a.png").write_text("a year's work")
    refused(command, line, name)


@pytest.mark.parametrize("text", ["", "mitsuba_diffraction", "made with the command mitsuba-diffraction render u.xml"])
def test_a_file_that_names_the_package_is_foreign(command, text):
    Path("a.png").write_text(text)
    refused(command, "inspect blaze.toml -o a.png", "a.png")


@pytest.mark.parametrize(
    ("line", "name", "text"),
    [
        (RENDER, "u.xml", SCENE.replace("</shape>", "")),
        (RENDER, "u.exr", "no spectrum"),
        (RENDER, "tex.png", "no picture"),
        ("precompute blaze.toml", "blaze.toml", BLAZE.replace("period", "perod")),
        ("inspect scan.toml", "scan.png", "no picture"),
    ],
)
def test_bad_input_leaves_own_files_as_they_are(command, line, name, text):
    suffix = "png" if line.startswith("inspect") else "exr"
    spectrum().save("a.exr")
    Image.new("L", (2, 2)).save("a.png", pnginfo=outputs.png_text())
    Path(name).write_text(text)
    before = contents()
    code, _, err = command(f"{line} -o a.{suffix}")
    assert code == 2, err
    assert contents() == before


@pytest.mark.parametrize(
    "name",
    ["a.json", "a.md", "a.csv", "a.png", "a.jpg", "a.pdf", "a.svg", "a.webp", "a.gif", "a.mp4", "a.exr", "u.exr"],
)
def test_every_format_carries_the_mark(name):
    if name == "a.json":
        outputs.save_json({"a": 1}, name)
        assert json.loads(Path(name).read_text())["a"] == 1
    elif name == "a.md":
        from mitsuba_diffraction.evaluation.report import save_markdown

        save_markdown("# a\n", name)
    elif name == "a.csv":
        md.efficiencies(md.gratings.blazed(2.5, 0.25), [0], [500]).save_csv(name)
    elif name in ("a.webp", "a.gif", "a.mp4"):
        save_animation([Path("tex.png"), Path("tex.png")], Path(name))
    elif name in ("a.exr", "a.jpg"):
        from mitsuba_diffraction.render.spectral_image import SpectralImage, save_preview

        image = SpectralImage([500.0, 600.0], np.zeros((2, 2, 2), np.float32))
        image.save(name) if name == "a.exr" else save_preview(image, name)
    elif name != "u.exr":
        from matplotlib.figure import Figure

        Figure(figsize=(1, 1)).savefig(name, metadata=outputs.METADATA)
    check_outputs([], [("-o", name)])
    Path(name).write_bytes(Path(name).read_bytes().replace(outputs.MARK.encode(), b""))
    with pytest.raises(ValueError, match="--overwrite"):
        check_outputs([], [("-o", name)])
    check_outputs([], [("-o", name)], overwrite=True)


# --- several at once, and kills ---

WRITER = """import sys
from mitsuba_diffraction.files.writing import whole_file
with whole_file("target.bin") as temporary:
    for _ in range(50):
        temporary.write_bytes(sys.argv[1].encode() * 100_000)
    print("ready", flush=True)
    sys.stdin.readline()"""


@contextmanager
def write_elsewhere(letter):
    """A process that has written a temporary file, and waits for an end of line."""
    words = [sys.executable, "-c", WRITER, letter]
    with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        process.stdout.readline()
        yield process


def temporaries():
    return [path for path in Path().iterdir() if path.name.startswith(".target-") and path.suffix != ".lock"]


def locks():
    return list(Path().glob(".*.lock"))


def test_two_processes_can_write_one_file():
    with write_elsewhere("a") as a, write_elsewhere("b") as b:
        assert len(temporaries()) == 2
        with whole_file("target.bin") as temporary:  # files that are being written are kept
            temporary.write_bytes(b"c")
        assert Path("target.bin").read_bytes() == b"c"
        for writer, letter in ((a, b"a"), (b, b"b")):
            writer.communicate("\n")
            assert writer.returncode == 0
            assert Path("target.bin").read_bytes() == letter * 100_000
    assert not temporaries() + locks()


def test_temporary_files_of_a_killed_process_are_removed():
    with write_elsewhere("a") as process:
        process.kill()
    Path(".target-of-mine.bin").write_text("mine")
    left = f".target-{16 * 'a'}.bin.lock"  # killed before it wrote, or after the rename
    Path(left).touch()
    assert len(temporaries()) == 2
    assert len(locks()) == 2
    refuse_unwritable("target.bin")
    assert [path.name for path in temporaries()] == [".target-of-mine.bin"]
    assert not locks()


@pytest.mark.parametrize(("tries", "written"), [(3, "new"), (1000, "old")])
def test_a_file_that_a_program_of_windows_has_open_is_tried_for_a_second(monkeypatch, tries, written):
    failures, rename, slept = iter(range(tries)), os.replace, []

    def replace(source, target):
        if next(failures, None) is not None:
            error = PermissionError(13, "Access is denied", source)
            error.winerror = 5
            raise error
        rename(source, target)

    Path("a.txt").write_text("old")
    monkeypatch.setattr(os, "replace", replace)
    monkeypatch.setattr(writing.time, "sleep", slept.append)
    told = pytest.raises(PermissionError, match=r"another program has it open.*a\.txt") if tries > 3 else nullcontext()
    with told, whole_file("a.txt") as temporary:
        temporary.write_text("new")
    assert Path("a.txt").read_text() == written
    assert sum(slept) <= 1
    assert not list(Path().glob(".a*"))


def test_a_temporary_path_may_be_handed_on():
    with whole_file("a.txt") as outer, whole_file(outer) as inner:
        assert inner == outer
        inner.write_text("a")
    assert Path("a.txt").read_text() == "a"


def test_a_seal_covers_every_byte():
    with pytest.raises(ValueError, match="no place"):
        seal("scan.png")
    assert is_intact("scan.png") is None
    assert is_intact("u.exr")
    with Path("u.exr").open("ab") as stream:
        stream.write(b"\0")
    assert is_intact("u.exr") is False


# --- files that are none, and names that are no text ---


@pytest.mark.posix("named pipes and devices")
@pytest.mark.parametrize("line", ["precompute NAME.npy,pixel_size=1", "inspect NAME.npy", "precompute NAME.toml"])
@pytest.mark.parametrize("kind", ["pipe", "device"])
def test_pipes_and_devices_are_refused(command, line, kind):
    # Regression: the command waited for ever, or filled the memory.
    for name in ("a.npy", "a.toml"):
        if kind == "pipe":
            os.mkfifo(name)
        else:
            Path(name).symlink_to("/dev/zero")
    code, _, err = command(line.replace("NAME", "a"))
    assert (code, len(err.splitlines())) == (2, 1)
    assert "a pipe or a device" in err


@pytest.mark.posix("named pipes")
def test_a_recipe_whose_scan_is_a_pipe_is_refused():
    os.mkfifo("pipe.png")
    Path("scan.toml").write_text(SCAN.replace("scan.png", "pipe.png"))
    with pytest.raises(ValueError, match="a pipe or a device"):
        md.Recipe.load("scan.toml").cached()


@pytest.mark.parametrize(
    "words", [("precompute", "\udcff.npy"), ("render", "u.xml", "-o", "\udcff.exr"), ("render", "u.xml", "-Da=\udcff")]
)
def test_names_that_are_not_utf8_are_one_line(command, words):
    Path("\udcff.npy").write_bytes(b"")
    code, out, err = command(*words)
    assert (code, out) == (2, "")
    assert len(err.splitlines()) == 1
    assert "UTF-8" in err


def noise(*shape):
    return np.random.default_rng(0).random(shape, np.float32)


def levels():
    plate = Plate(1.0, 16, 0.6, 17.5, np.array([532.0]), None, 4, 0.1)
    return Design.of(np.floor(4 * noise(16, 16)) * 0.2, plate, wanted_fractions(np.eye(8), plate))


def picture():
    return SpectralImage(np.linspace(400, 700, 8), noise(20, 20, 8))


WRITERS = {
    "table.exr": lambda path: exr.write_channels(path, "table", 1, {}, {"a": noise(4, 4)}, ""),
    "picture.exr": lambda path: picture().save(path),
    **{f"preview{suffix}": lambda path: save_preview(picture(), path) for suffix in (".png", ".jpg", ".tif", ".webp")},
    **{f"turn{suffix}": lambda path: save_animation(["frame.png"] * 2, path) for suffix in (".webp", ".gif", ".mp4")},
    "levels.gds": lambda path: makers.save_gds(levels(), path),
    "relief.tif": lambda path: output.save_tiff(md.gratings.foil(1.5, 0.2, samples=64), 0.2, path),
}


@pytest.mark.posix("limits of a process")
@pytest.mark.parametrize("name", WRITERS)
def test_a_full_disk_leaves_no_part_of_a_file(name, full_disk):
    """The limit is the size of the file; at a limit below it, libraries may lose the end of a file in silence."""
    Image.fromarray((255 * noise(40, 40, 3)).astype(np.uint8)).save("frame.png")
    whole = Path("whole") / name
    whole.parent.mkdir()
    WRITERS[name](whole)
    size = whole.stat().st_size
    Path("part").mkdir()
    for limit in (size - 1, size - 100, size // 2, 10):
        with full_disk(limit), pytest.raises((OSError, RuntimeError)):
            WRITERS[name](Path("part") / name)
        assert list(Path("part").iterdir()) == []
