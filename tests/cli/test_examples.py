"""The examples that the package brings."""

import re
from pathlib import Path

import pytest


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
