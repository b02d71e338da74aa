"""The table of tools/manual/figures.py: all figures of the manual, by commands that exist."""

import re
from pathlib import Path

import contact_sheet
import figures
import nbformat
import pytest

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"

TABLE = list(figures.figures())


def test_every_picture_of_the_manual_stands_in_the_table_once():
    pictures = [path for path in DOCS.rglob("*") if path.suffix in (".png", ".jpg", ".svg", ".gif", ".webp")]
    files = [file for figure in TABLE for file in figure.files]
    assert sorted(files) == sorted(path.relative_to(DOCS).as_posix() for path in pictures)


def test_the_manual_shows_every_figure():
    pages = [*DOCS.glob("*.md"), ROOT / "README.md", *(ROOT / "precompute").rglob("*.md")]
    text = "".join(page.read_text(encoding="utf-8") for page in pages)
    for figure in TABLE:
        for file in figure.files:
            assert re.search(rf"\]\((?:[\w./]*/)?{re.escape(file)}\)", text), file


def test_the_catalogue_shows_every_recipe():
    recipes = {path.stem for path in (ROOT / "precompute").glob("*.toml")}
    assert {name for name in recipes if not name.endswith("_tile")} == set(contact_sheet.PANELS)


def test_what_the_commands_name_exists(command):
    named, options = set(), {}
    for figure in TABLE:
        named |= set(re.findall(r"(?:scenes|precompute|docs|notebooks)/[\w./]+\.\w+", figure.commands))
        named |= {f"precompute/{skin}.toml" for skin in re.findall(r"-D skin=(\w+)", figure.commands)}
        for name, rest in re.findall(r"mitsuba-diffraction (\w+)(.*)", figure.commands.replace("\\\n", " ")):
            options.setdefault(name, set()).update(re.findall(r" (--?[a-z][\w-]*)", rest))
    assert len(named) > 20
    for name in named:
        assert (ROOT / name).is_file(), name
    for name, used in options.items():
        code, offered, _ = command(name, "--help")
        assert code == 0
        assert used <= set(re.findall(r"--?\w[\w-]*", offered)), name


def test_a_figure_of_a_notebook_is_what_its_cell_shows():
    of_notebooks = [figure for figure in TABLE if figure.cell]
    assert of_notebooks
    for figure in of_notebooks:
        path = ROOT / re.search(r"notebooks/\w+\.ipynb", figure.commands)[0]
        assert figures.shown(path, figure.cell).startswith(b"\x89PNG")


def test_a_figure_is_renewed_whole(tmp_path, monkeypatch):
    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(id="a")])
    output = nbformat.v4.new_output("display_data", {"image/png": "iVBORw0KGgo="})
    notebook.cells[0].outputs.append(output)
    nbformat.write(notebook, tmp_path / "one.ipynb")
    monkeypatch.setenv("FOLDER", tmp_path.as_posix())
    copy = 'python -c "import shutil, sys; shutil.copy(*sys.argv[1:])" $FOLDER/one.ipynb {out}/notebook.ipynb'
    figures.renew(figures.Figure(("x.png",), copy, cell="a"), tmp_path)
    assert (tmp_path / "x.png").read_bytes() == b"\x89PNG\r\n\x1a\n"
    with pytest.raises(FileNotFoundError):
        figures.renew(figures.Figure(("x.png",), 'python -c ""'), tmp_path)
    assert (tmp_path / "x.png").is_file()


def test_an_unknown_figure_is_refused_in_one_line(capsys):
    with pytest.raises(SystemExit) as stopped:
        figures.main(["screen", "gone"])
    assert stopped.value.code == 2
    assert "got gone, wanted names among benchmark" in capsys.readouterr().err


def test_all_names_are_listed(capsys):
    figures.main([])
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines()] == [
        file.rpartition(".")[0] for figure in TABLE for file in figure.files
    ]
