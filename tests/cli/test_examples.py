"""The examples that the package brings."""

import importlib
import re
import shutil
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from PIL import Image

import mitsuba_diffraction.inverse_design.hologram as of_picture

render = importlib.import_module("mitsuba_diffraction.cli.render")  # the package has the command by this name


def test_examples_are_copied_with_the_files_they_reference(command, tmp_path):
    code, said, error = command("examples", str(tmp_path / "new" / "folder"))
    assert (code, error) == (0, "")
    copied = [path for path in (tmp_path / "new" / "folder").rglob("*") if path.is_file()]
    assert said.startswith(f"{tmp_path / 'new' / 'folder'}: {len(copied)} files")
    names = {path.relative_to(tmp_path / "new" / "folder").as_posix() for path in copied}
    assert {"scenes/xenopeltis.xml", "precompute/elaphe.toml", "precompute/measured/LICENSE.txt"} <= names
    assert not [name for name in names if "models" in name or "__pycache__" in name]
    assert {Path(name).parent.as_posix() for name in names if name.endswith(".exr")} == {"scenes/coil"}
    for scene in (path for path in copied if path.suffix == ".xml"):
        for recipe in re.findall(r'value="((?!models)[^"$]+\.(?:toml|ply|exr))"', scene.read_text()):
            assert (scene.parent / recipe).is_file(), scene
    for recipe in (path for path in copied if path.suffix == ".toml"):
        for scan in re.findall(r'^scan = "(.+)"', recipe.read_text(), re.MULTILINE):
            assert (recipe.parent / scan).is_file(), recipe


@pytest.mark.not_quick
def test_a_changed_example_is_not_written_over(command, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert command("examples")[0] == 0
    blaze, elaphe = Path("scenes/blaze.xml"), Path("scenes/elaphe.xml")
    before = blaze.read_bytes()
    assert command("examples")[0] == 0
    blaze.write_bytes(before + b"<!-- mine -->")
    elaphe.unlink()
    code, _, error = command("examples")
    assert (code, error.count("\n")) == (2, 1)
    assert "scenes/blaze.xml exists and is another file" in error
    assert not elaphe.exists()
    assert command("examples", "--overwrite")[0] == 0
    assert blaze.read_bytes() == before
    assert elaphe.exists()


@pytest.mark.parametrize("where", ["file", "file/deeper"])
def test_a_file_instead_of_the_folder_is_one_line(command, where, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("file").touch()
    code, _, error = command("examples", where)
    assert code == 2
    assert error.count("\n") == 1


def test_a_hologram_is_a_scene_with_its_textures(command, tmp_path, monkeypatch):
    rendered = []
    monkeypatch.setattr(render, "_render_all", lambda _, scenes, target: rendered.append((scenes[0].path, target)))
    monkeypatch.chdir(tmp_path)
    Image.new("RGB", (30, 20), "red").save("me.png")
    for _ in range(2):  # a second time, as the files are its own
        code, said, error = command("hologram me.png")
        assert code == 0, error
    assert said.startswith("me_hologram/hologram.xml: a hologram of 16 × 9 cm, periods 0.7")
    folder = Path("me_hologram")
    assert rendered == 2 * [(folder / "hologram.xml", folder / "hologram.png")]
    textures = {
        f"models/{name}" for name in re.findall(r"models/(hologram_\w+\.exr)", (folder / "hologram.xml").read_text())
    }
    assert {path.relative_to(folder).as_posix() for path in folder.rglob("*.*")} == {"hologram.xml", *textures}
    Path("other").mkdir()
    Path("other/hologram.xml").write_text("<scene/>")
    assert command("hologram me.png -o other")[0] == 2
    assert Path("other/hologram.xml").read_text() == "<scene/>"
    code, _, error = command("hologram other/hologram.xml")
    assert (code, error.count("\n"), "not a picture that can be read" in error) == (2, 1, True)
    assert command("hologram me.png -o pre")[0] == 0
    shutil.rmtree("pre/models")
    Path("pre/hologram.xml").write_text("<scene/>")
    assert command("hologram me.png -o pre")[0] == 2
    assert not Path("pre/models").exists()


def test_options_of_a_hologram_are_in_its_scene(command, tmp_path, monkeypatch):
    """The camera sees a smaller hologram as large; its textures are computed for its size."""
    monkeypatch.setattr(render, "_render_all", lambda *_: None)
    monkeypatch.chdir(tmp_path)
    Image.new("RGB", (32, 18), "red").save("me.png")
    for name, options in (("a", ""), ("b", "--size 8 --tilt=-5 --material clear --lamp 1.5")):
        assert command(f"hologram me.png -o {name} {options}")[0] == 0
    one, other = (
        dict(re.findall(r'<default name="(\w+)" value="(.*?)"', Path(x, "hologram.xml").read_text())) for x in "ab"
    )
    assert {name: float(one[name]) for name in ("size", "tilt", "lamp")} == {"size": 16, "tilt": 0, "lamp": 0.8}
    assert (one["card"], other["card"]) == ("foil", "clear")
    assert {name: float(other[name]) for name in ("size", "tilt", "lamp")} == {"size": 8, "tilt": -5, "lamp": 1.5}
    seen = [np.tan(np.deg2rad(float(found["fov"]) / 2)) / float(found["size"]) for found in (one, other)]
    assert seen[0] == pytest.approx(seen[1], rel=1e-3)
    periods = [OpenEXR.File(str(of_picture.textures_in(Path(x, "models"))[0])).channels()["Y"].pixels for x in "ab"]
    assert np.ptp(periods[1]) < 0.7 * np.ptp(periods[0])
    assert command("hologram me.png -o c --size 100")[0] == 2


def test_a_hologram_reads_pictures_as_design_does(tmp_path):
    """Grey of 16 bits, and the orientation of a telephone's photograph; black pictures are refused."""
    grey = np.full((36, 64), 32768, np.uint16)
    Image.fromarray(grey).save(tmp_path / "grey.png")
    assert of_picture.fitted(tmp_path / "grey.png", 64).mean() == pytest.approx(0.214, abs=0.01)
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.new("RGB", (90, 30), "white").save(tmp_path / "phone.jpg", exif=exif)
    upright = of_picture.fitted(tmp_path / "phone.jpg", 64)[..., 0] > 0.5
    assert upright.any(1).sum() > 2 * upright.any(0).sum()
    Image.new("L", (64, 36)).save(tmp_path / "black.png")
    with pytest.raises(ValueError, match="got a black picture"):
        of_picture.fitted(tmp_path / "black.png", 64)
