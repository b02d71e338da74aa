"""The examples that the package brings."""

import importlib
import re
from pathlib import Path

import pytest
from PIL import Image

hologram = importlib.import_module("mitsuba_diffraction.cli.hologram")  # the package has the command by this name


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
    monkeypatch.setattr(hologram, "render", lambda scene, preview, **options: rendered.append((scene, preview)))
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
    assert (code, error.count("\n"), "got no picture" in error) == (2, 1, True)
