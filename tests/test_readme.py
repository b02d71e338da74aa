"""The README's Python runs, and the files that it names are there."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
TEXT = (ROOT / "README.md").read_text(encoding="utf-8")


def test_the_python_block_runs():
    (block,) = re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL)
    names = {}
    exec(block, names)
    assert names["spectrum"].error <= 1e-3
    assert "Al" in str(names["bsdf"])


def test_the_files_that_are_named_are_there():
    named = re.findall(r"(?:scenes|docs|precompute)/[\w.]+\.(?:xml|png|toml)", TEXT)
    assert len(named) >= 5
    for name in named:
        assert (ROOT / name).is_file(), name
