"""The package below the file of a spectrum does without Mitsuba; arrows run one way."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "mitsuba_diffraction"
RUN_TIME = {
    *("benchmark", "bsdf", "cli", "comparison", "evaluation", "integrator", "render", "shader", "validation"),
    *("llvm.py", "plugin.py", "variants.py", "__init__.py"),
}
"""What may import Mitsuba; everything else is offline."""
OFFLINE_SHADER = {"shader/quirks.py", "shader/taylor_textures.py", "shader/tristimulus.py"}
OFFLINE = sorted(
    path
    for path in PACKAGE.rglob("*.py")
    if path.relative_to(PACKAGE).parts[0] not in RUN_TIME or path.relative_to(PACKAGE).as_posix() in OFFLINE_SHADER
)


def absolute(node, path):
    """The modules that an import statement in the file `path` names, e.g. mitsuba_diffraction.files."""
    if isinstance(node, ast.Import):
        return [alias.name for alias in node.names]
    if not isinstance(node, ast.ImportFrom):
        return []
    if not node.level:
        return [node.module]
    parents = ["mitsuba_diffraction", *path.relative_to(PACKAGE).parts[:-1]]
    base = parents[: len(parents) - node.level + 1]
    if node.module:
        return [".".join([*base, node.module])]
    return [".".join([*base, alias.name]) for alias in node.names]


def imports(path):
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for block in ast.walk(tree):
        # What only a type checker imports does not count.
        if isinstance(block, ast.If) and ast.unparse(block.test) == "TYPE_CHECKING":
            block.body = []
    return [name for node in ast.walk(tree) for name in absolute(node, path)]


@pytest.mark.parametrize("path", OFFLINE, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_offline_modules_import_neither_mitsuba_nor_what_does(path):
    for name in imports(path):
        top, *rest = name.split(".")
        assert top not in {"mitsuba", "drjit"}, name
        if top == "mitsuba_diffraction":
            assert rest, f"{name}: the package itself registers plugins"
            assert not {rest[0], f"{rest[0]}.py"} & RUN_TIME, name


def test_there_are_offline_modules():
    names = {str(path.relative_to(PACKAGE)) for path in OFFLINE}
    assert names >= {"heightfield.py", "reference.py", "precompute.py", "recipe.py", "expansions/taylor.py"}
    assert names >= {"spectrum/file.py", "spectrum/grating_spectrum.py", *OFFLINE_SHADER}


def test_a_spectrum_is_built_where_there_is_no_mitsuba():
    # The package without its __init__, which registers the plugins.
    program = f"""
import sys, types
sys.modules["mitsuba"] = sys.modules["drjit"] = None
package = types.ModuleType("mitsuba_diffraction")
package.__path__ = [{str(PACKAGE)!r}]
sys.modules["mitsuba_diffraction"] = package
from mitsuba_diffraction.recipe import Recipe
spectrum = Recipe({{"profile": "blazed", "period": 2.5, "depth": 0.25, "samples": 64}}).build()
print(f"{{spectrum.error < 1e-3}}")
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60)
    assert done.stdout.strip() == "True", done.stderr
