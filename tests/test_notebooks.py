"""The notebooks run, and are committed with what they showed.

A code cell may carry the metadata "reduced", Python source that the test runs in its place: the same with less work.
"""

import ast
import base64
import copy
import os
import subprocess
import sys
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

FOLDER = Path(__file__).parents[1] / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))
QUICK = "05_can_i_trust_the_picture"
LARGEST = 500_000
"""Bytes of a notebook in the repository."""


def code_cells(notebook):
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


def outputs(notebook):
    return [output for cell in code_cells(notebook) for output in cell.outputs]


def pictures(notebook):
    """The PNG files that a notebook shows."""
    return [base64.b64decode(out.data["image/png"]) for out in outputs(notebook) if "image/png" in out.get("data", {})]


def errors(notebook):
    return [out for out in outputs(notebook) if out.output_type == "error" or out.get("name") == "stderr"]


def reduced(notebook):
    """A copy without outputs, with the reduced sources in place."""
    notebook = copy.deepcopy(notebook)
    for cell in code_cells(notebook):
        cell.source = cell.metadata.get("reduced", cell.source)
        cell.outputs = []
    return notebook


def executed(notebook, folder=FOLDER):
    """Run in a folder, in a kernel of this Python."""
    client = NotebookClient(notebook, timeout=900, kernel_name="python3", resources={"metadata": {"path": str(folder)}})
    return client.execute()


def test_there_are_notebooks():
    assert {path.stem for path in NOTEBOOKS} >= {"02_brdf_and_grating_equation", "04_speed_against_error"}


@pytest.fixture(params=NOTEBOOKS, ids=lambda path: path.stem)
def path(request):
    return request.param


def test_a_notebook_is_committed_with_what_it_showed(path):
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    assert os.path.getsize(path) < LARGEST
    assert all(cell.execution_count for cell in code_cells(notebook)), "some cells were not run"
    assert not errors(notebook)
    assert any(picture.startswith(b"\x89PNG") for picture in pictures(notebook))


def test_no_notebook_names_a_folder_of_somebodys_machine(path):
    text = path.read_text(encoding="utf-8")
    for folder in ("/home/", "/tmp/", "/work/", "/Users/", "C:\\\\"):
        assert folder not in text, folder


@pytest.mark.parametrize(
    "path",
    [pytest.param(p, id=p.stem, marks=() if p.stem == QUICK else pytest.mark.slow) for p in NOTEBOOKS],
)
def test_a_notebook_runs(path, tmp_path):
    """Away from the repository, too, unless it uses scripts of tools/."""
    notebook = reduced(nbformat.read(path, as_version=4))
    uses_tools = any("../tools" in cell.source for cell in code_cells(notebook))
    executed(notebook, FOLDER if uses_tools else tmp_path)
    assert not [out for out in outputs(notebook) if out.output_type == "error"]
    assert pictures(notebook)


@pytest.mark.slow
def test_what_the_notebooks_import_exists():
    # Reduced cells leave out what takes long: functions that are gone would be missed.
    def imports(notebook):
        for statement in ast.parse("\n".join(cell.source for cell in code_cells(notebook))).body:
            text = ast.unparse(statement)
            if isinstance(statement, ast.Import | ast.ImportFrom) or text.startswith("sys.path.insert("):
                yield text

    lines = [line for path in NOTEBOOKS for line in imports(nbformat.read(path, as_version=4))]
    assert any("measured_figures" in line for line in lines)
    subprocess.run([sys.executable, "-c", "\n".join(lines)], cwd=FOLDER, check=True)


def test_the_reduced_source_of_a_cell_is_run_instead_and_an_error_is_noticed():
    cells = [nbformat.v4.new_code_cell("1 / 0", metadata=of) for of in ({"reduced": "print(6 * 7)"}, {})]
    notebook = reduced(nbformat.v4.new_notebook(cells=cells))
    with pytest.raises(Exception, match="ZeroDivisionError"):
        executed(notebook)
    assert outputs(notebook)[0].text.strip() == "42"
