"""What people expect of a repository: one version, workflows that run what the documentation names."""

import json
import re
import sys
from pathlib import Path

import pytest
import yaml

import mitsuba_diffraction as md

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).parents[1]


def test_the_version_is_the_same_everywhere():
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    assert md.__version__ == version
    assert re.search(r"^version: (.+)$", (ROOT / "CITATION.cff").read_text(), re.MULTILINE)[1] == version
    three = (ROOT / "mitsuba_diffraction" / "export" / "assets" / "three" / "package.json").read_text()
    assert json.loads(three)["version"] == version
    wheels = re.findall(r"mitsuba_diffraction-([\d.]+)-py3", (ROOT / "README.md").read_text())
    assert set(wheels) <= {version}


@pytest.mark.parametrize("path", sorted((ROOT / ".github" / "workflows").glob("*.yml")), ids=lambda path: path.stem)
def test_workflows_run_documented_commands(path):
    steps = [step for job in yaml.safe_load(path.read_text())["jobs"].values() for step in job["steps"]]
    contributing = (ROOT / "CONTRIBUTING.md").read_text()
    for command in (step["run"] for step in steps if "run" in step):
        if command.startswith("python -m pytest"):
            assert command in contributing
        elif command.startswith("."):
            assert (ROOT / command).is_file()
