"""Imports run one way, and nothing offline imports Mitsuba or Dr.Jit."""

import ast
import collections
import functools
import graphlib
import json
import re
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

import mitsuba_diffraction

PACKAGE = Path(mitsuba_diffraction.__file__).parent
MODULES = {
    ".".join(["mitsuba_diffraction", *path.relative_to(PACKAGE).with_suffix("").parts]).removesuffix(".__init__"): path
    for path in PACKAGE.rglob("*.py")
    if "assets" not in path.parts  # code for other programs
}


LEVELS = (
    # The lowest first: modules import from the levels above their own in this list, and from their own.
    (
        "array_types",
        "errors",
        "handed_over_spectra",
        "machine",
        "parameter_documentation",
        "progress",
        "settings",
        "variants",
    ),
    ("files",),
    ("optics",),
    ("surface",),
    ("spectrum",),
    ("energy",),
    ("rigorous",),
    ("scalar_theory",),
    ("precomputation",),
    ("inspection",),
    ("export",),
    ("inverse_design",),
    ("bsdf",),
    ("integrator",),
    ("render",),
    ("viewer",),
    ("registration",),
    ("cli", "__main__"),
    ("shader_2014",),
    ("evaluation",),
)
LEVEL_OF = {name: level for level, names in enumerate(LEVELS) for name in names}


@functools.cache
def imports(module):
    """The modules of the package that a module imports, at its head, inside a function or for its annotations."""
    return tuple(_imports(module))


def _imports(module):
    path = MODULES[module]
    package = module if path.name == "__init__.py" else module.rpartition(".")[0]
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom):
            base = package.rsplit(".", node.level - 1)[0] if node.level else ""
            source = ".".join(filter(None, [base, node.module]))
            for alias in node.names:
                found = f"{source}.{alias.name}" if f"{source}.{alias.name}" in MODULES else source
                if found in MODULES:
                    yield found


def imports_by_name(module):
    """The modules of the package whose dotted names stand in a string, as for importlib.import_module."""
    words = [
        node.value.strip(".").removeprefix("mitsuba_diffraction.")
        for node in ast.walk(ast.parse(MODULES[module].read_text(encoding="utf-8")))
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
    ]
    return {word for word in words if "." in word and f"mitsuba_diffraction.{word}" in MODULES}


FIXED = {"CHECKS", "MANUAL", "PARAMETERS", "define", "efficiencies", "main"}
"""Names that several modules have: of checks and of plugins, by which they are found; `md.efficiencies` and
`md.rigorous.efficiencies`; the entry points of the process and of the command line."""


def names_of(module):
    """The public names that a module defines at its top level."""
    for node in ast.parse(MODULES[module].read_text(encoding="utf-8")).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            yield node.name
        elif isinstance(node, ast.Assign | ast.AnnAssign) and not is_array_type(node.value):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            yield from (name.id for target in targets for name in ast.walk(target) if isinstance(name, ast.Name))


def is_array_type(value):
    """Whether a value is a type of arrays, for which several modules may have the same short name."""
    return value is not None and ast.unparse(value).startswith("NDArray[")


def is_command(module, name):
    return module.endswith(f".{name}") and any(folder in module for folder in (".cli.", ".commands.", ".command_line."))


def repeated(pairs):
    """The names of several modules, except commands and the function that each calls."""
    found = collections.defaultdict(set)
    for name, module in pairs:
        if not name.startswith("_") and not is_command(module, name):
            found[name].add(module)
    return {name: sorted(modules) for name, modules in found.items() if len(modules) > 1}


@pytest.mark.quick
def test_a_name_stands_for_one_thing():
    found = repeated((name, module) for module in MODULES for name in names_of(module))
    assert not {name: modules for name, modules in found.items() if name not in FIXED}
    assert found.keys() == FIXED


@pytest.mark.quick
def test_a_module_has_its_file_name_for_itself():
    modules = MODULES.keys() - {"mitsuba_diffraction"}
    assert not repeated((module.rpartition(".")[2], module) for module in modules)
    for module in modules:
        package, _, name = module.rpartition(".")
        nodes = ast.walk(ast.parse(MODULES[package].read_text(encoding="utf-8")))
        found = [
            alias.name for node in nodes if isinstance(node, ast.ImportFrom) and node.module for alias in node.names
        ]
        assert name not in found or is_command(module, name), module


WORDS_OF_NAMES = {
    "material": "material",
    "spectrum": "_?spectrum|spectrum_of|(of|is|build|load|power|build_power|_tile|_sample|grating|rigorous)_spectrum|"
    "spectrum_error|spectrum_or_recipe(_from)?|SPECTRUM_PARAMETERS|(Power|Grating|Rigorous)?Spectrum",
    "spectra": "_?spectra|READY_SPECTRA|handed_over_spectra",
    "surface": "_?surfaces?|of_surface|_?SURFACES?|(Requested|Viewed)Surface|(requested|viewed|rough)_surface|"
    "surface_text|surface_checks|_surface_lines",
}
"""A word whose one meaning docs/architecture.md tells → all names that have it; another thing has another name."""


def defined_names(path):
    """What a module defines: functions, classes, parameters, variables and attributes, and its own name."""
    yield path.stem
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        match node:
            case ast.FunctionDef(name=name) | ast.ClassDef(name=name) | ast.arg(arg=name):
                yield name
            case ast.Name(id=name, ctx=ast.Store()) | ast.Attribute(attr=name, ctx=ast.Store()):
                yield name


@pytest.mark.quick
def test_a_word_of_names_has_one_meaning():
    names = {name for path in MODULES.values() for name in defined_names(path)}
    table = (PACKAGE.parent / "docs" / "architecture.md").read_text(encoding="utf-8").partition("## Words")[2]
    for word, known in WORDS_OF_NAMES.items():
        found = {name for name in names if re.search(rf"{word}(?!l)", name.lower())}
        assert word in found
        assert not [name for name in sorted(found) if not re.fullmatch(known, name)]
        assert f"`{word}`" in table


@pytest.mark.quick
def test_no_function_has_more_than_80_lines():
    """Without its docstring; a screen has 60."""
    for path in MODULES.values():
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.FunctionDef):
                first = node.body[0] if ast.get_docstring(node) else None
                of_docstring = first.end_lineno - first.lineno + 1 if first else 0
                assert node.end_lineno - node.lineno + 1 - of_docstring <= 80, f"{path.name}: {node.name}"


@pytest.mark.quick
def test_properties_of_mitsuba_stop_at_the_door():
    """`GratingRequest` has what a scene says of a grating; plugins have theirs, and `render` those of parsed scenes."""
    plugins = {"bsdf.diffraction_grating", "integrator.diffraction_path", "shader_2014.diffraction_shader"}
    found = set()
    for module, path in MODULES.items():
        arguments = (node for node in ast.walk(ast.parse(path.read_text("utf-8"))) if isinstance(node, ast.arg))
        if any(each.annotation and "mi.Properties" in ast.unparse(each.annotation) for each in arguments):
            found.add(module.partition(".")[2])
    assert {name for name in found if not name.startswith("render.")} == {
        "bsdf.parameters",
        "registration.plugins",
        *plugins,
    }


def changed_arguments(path):
    """Lines that change an argument by an operator such as `&=`, before the function assigns anything to its name."""
    for function in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(function, ast.FunctionDef):
            names, nodes = {argument.arg for argument in function.args.args}, list(ast.walk(function))
            stored = [each for each in nodes if isinstance(each, ast.Name) and isinstance(each.ctx, ast.Store)]
            changes = {each.target for each in nodes if isinstance(each, ast.AugAssign)}
            for name in names:
                first = min((each for each in stored if each.id == name), key=lambda each: each.lineno, default=None)
                if first in changes:
                    yield f"{path.name}:{first.lineno}"


@pytest.mark.quick
def test_no_function_changes_an_array_of_its_caller():
    """An array of Dr.Jit is changed itself by `&=`."""
    online = [path for path in MODULES.values() if re.search(r"^import (drjit|mitsuba)", path.read_text(), re.M)]
    assert online
    assert [line for path in online for line in changed_arguments(path)] == []


def in_a_fresh_process(program):
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return done.stdout.split()


@pytest.mark.quick
def test_no_module_imports_itself_by_way_of_others():
    graph = {module: set(imports(module)) - {module} for module in MODULES}
    assert sum(map(len, graph.values())) > 200
    graphlib.TopologicalSorter(graph).prepare()


@pytest.mark.quick
def test_no_module_imports_from_a_higher_level():
    def level(module):
        return LEVEL_OF[module.split(".")[1]]

    wrong = [
        f"{module} imports {found}"
        for module in MODULES.keys() - {"mitsuba_diffraction"}
        for found in imports(module)
        if found != "mitsuba_diffraction" and level(found) > level(module)
    ]
    assert not wrong, wrong


@pytest.mark.quick
def test_the_figure_of_the_manual_shows_the_levels_in_their_order():
    """By the first column of its lines."""
    manual = (Path(__file__).parents[1] / "docs" / "architecture.md").read_text(encoding="utf-8")
    figure = manual.partition("## Levels of the package")[2].split("```")[1]
    names = LEVEL_OF.keys() - {"__main__"}
    lines = [(line, line.lstrip()) for line in figure.splitlines()]
    columns = [re.split(r"\s{3,}", text)[0] for line, text in lines if len(line) - len(text) < 10]
    shown = [word for column in columns for word in re.findall(r"\w+", column) if word in names]
    order = [LEVEL_OF[word] for word in dict.fromkeys(shown)]
    assert set(shown) == names
    assert order == sorted(order)
    found = re.split(r"^ (\w+)/ ", figure, flags=re.MULTILINE)
    for folder, text in zip(found[1::2], found[2::2], strict=True):
        files = {module.split(".")[2] for module in MODULES if module.startswith(f"mitsuba_diffraction.{folder}.")}
        assert files <= set(re.findall(r"\w+", text)), folder


@pytest.mark.quick
def test_the_manual_names_files_and_code_that_exist():
    root = PACKAGE.parent
    code = [
        path for folder in (PACKAGE, *map(root.joinpath, ("scenes", "tests", "tools"))) for path in folder.rglob("*.py")
    ]
    files = [f"/{path.relative_to(root)}" for path in code] + ["/setup.py"]
    pages = [*root.glob("*.md"), *(root / "docs").rglob("*.md"), *root.glob("[pst]*/README.md")]
    pages.remove(root / "CHANGELOG.md")  # of earlier versions
    for page in pages:
        for name in re.findall(r"`(?:\.\./)?([\w/]+\.py)\b", page.read_text(encoding="utf-8")):
            assert any(file.endswith(f"/{name}") for file in files), f"{page.name}: {name}"
    words = set(re.findall(r"\w+", "\n".join(path.read_text(encoding="utf-8") for path in code)))
    for page in (root / "docs" / "architecture.md", root / "CONTRIBUTING.md"):
        for name in re.findall(r"`([A-Za-z_][\w.]*)`", page.read_text(encoding="utf-8")):
            if not re.search(r"\.\w{1,5}$", name) and "_" in name:
                assert name.rpartition(".")[2] in words, f"{page.name}: {name}"


_OF_PYTHON = {"item", "tobytes", "tolist"}  # methods whose results are no arrays


def arrays_mapped_from_numpy(program):
    """The calls that make an array of Dr.Jit of one of NumPy, as far as each function shows what is one."""
    for function in ast.walk(ast.parse(program)):
        if isinstance(function, ast.FunctionDef):
            names = names_of_numpy_arrays(function)
            for node in ast.walk(function):
                if makes_array(node) and any(is_numpy_array(argument, names) for argument in node.args):
                    yield ast.unparse(node)


def makes_array(node):
    """Whether a node is `mi.Float(…)`, `mi.Point2f(…)` and the like, `type(x)(…)` or `kind(…)`."""
    match node:
        case ast.Call(func=ast.Attribute(value=ast.Name("mi"), attr=name)):
            return name[0].isupper() and not name.startswith(("Bitmap", "Scalar", "Struct"))
        case ast.Call(func=ast.Call(func=ast.Name("type")) | ast.Name("kind")):
            return True
    return False


def names_of_numpy_arrays(function):
    """The names of arrays of NumPy in a function, and of what it unpacks from them."""
    arguments = [node for node in ast.walk(function.args) if isinstance(node, ast.arg) and node.annotation]
    names = {node.arg for node in arguments if re.search("NDArray|ndarray|ArrayLike", ast.unparse(node.annotation))}
    bindings = []
    for node in ast.walk(function):
        if isinstance(node, ast.Assign):
            bindings += [(target, node.value) for target in node.targets]
        elif isinstance(node, ast.For | ast.comprehension):
            bindings.append((node.target, node.iter))
    for _ in range(3):
        for target, value in bindings:
            pairs = [(target, value)]
            if isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple):
                pairs = zip(target.elts, value.elts, strict=False)
            for one, of_one in pairs:
                if is_numpy_array(of_one, names):
                    names |= {name.id for name in ast.walk(one) if isinstance(name, ast.Name)}
    return names


def is_numpy_array(node, names):
    match node:
        case ast.Name():
            return node.id in names
        case ast.Call(func=ast.Attribute(value=owner, attr=method)):
            of_numpy = isinstance(owner, ast.Name) and owner.id == "np"
            return of_numpy or (method not in _OF_PYTHON and is_numpy_array(owner, names))
        case ast.Attribute(value=owner, attr=part):
            return part in ("T", "real", "imag") and is_numpy_array(owner, names)
        case ast.Subscript(value=owner) | ast.Starred(value=owner):
            return is_numpy_array(owner, names)
        case ast.BinOp() | ast.UnaryOp() | ast.IfExp() | ast.GeneratorExp() | ast.ListComp():
            return any(is_numpy_array(child, names) for child in ast.iter_child_nodes(node))
    return False


@pytest.mark.quick
def test_arrays_mapped_from_numpy_are_found():
    for lines in (
        "mi.Float(np.array([1.0]))",
        "table = np.zeros(3)\ntable[1] = 2\nself.table = mi.UInt32(table.ravel())",
        "x, y = (values / 2), 1\nmi.Point2f(x.astype(np.float32), y)",
        "mi.Vector3f(values.T)",
        "x, *rgb = (mi.Float(column) for column in values.T)",
        "si.wavelengths = type(si.wavelengths)(2 * values)",
    ):
        body = textwrap.indent(f"{lines}\nx = mi.Float(float(np.sqrt(2)), values.tolist(), on_device(values))", "    ")
        assert len(list(arrays_mapped_from_numpy(f"def f(values: NDArray):\n{body}"))) == 1, lines


@pytest.mark.quick
def test_one_function_makes_arrays_of_dr_jit_from_those_of_numpy():
    """Kernels that read the memory of NumPy differ by its address, and are compiled again by other processes."""
    texts = {module: path.read_text(encoding="utf-8") for module, path in MODULES.items()}
    texts = {module: text for module, text in texts.items() if "import mitsuba as mi" in text}
    found = {f"{module}: {call}" for module, text in texts.items() for call in arrays_mapped_from_numpy(text)}
    assert found == {"mitsuba_diffraction.bsdf.device_tables: kind(memory)"}
    # Of a list with one number, Mitsuba makes a literal: later passes, and other scenes, have kernels of their own.
    for module, text in texts.items():
        assert not re.search(r"DiscreteDistribution\((?!on_device\()", text), module


def test_nothing_depends_on_what_judges_the_product():
    judges = "mitsuba_diffraction.evaluation", "mitsuba_diffraction.shader_2014"
    for module in MODULES:
        if not module.startswith(judges):
            assert not any(found.startswith(judges) for found in imports(module)), module


@pytest.mark.quick
def test_only_the_doors_import_by_name():
    """Registration makes a plugin when a scene first has one, and the command line knows what judges the product."""
    found = {module.partition(".")[2]: names for module in MODULES if (names := imports_by_name(module))}
    home = found.pop("")
    assert not any(name.startswith(("evaluation", "shader_2014")) for name in home)
    assert found == {
        "registration.plugins": {
            "bsdf.diffraction_grating",
            "shader_2014.diffraction_shader",
            "integrator.diffraction_path",
        },
        "cli": {"evaluation.commands", "shader_2014.command_line"},
    }


def test_only_the_command_depends_on_the_viewer():
    viewer = "mitsuba_diffraction.viewer"
    for module in MODULES:
        if module != "mitsuba_diffraction" and not module.startswith((viewer, "mitsuba_diffraction.cli")):
            assert not any(found.startswith(viewer) for found in imports(module)), module


def test_what_is_offline_does_not_import_mitsuba(tmp_path):
    program = f"""
import sys
import mitsuba_diffraction as md
loaded = {{"mitsuba", "drjit", "numpy"}} & set(sys.modules)
assert not loaded, loaded
field = md.gratings.blazed(period=1.0, depth=0.02, samples=32)
md.precompute(field, coherence_length=2).save({str(tmp_path / "blazed.exr")!r})
md.reference.power_spectrum(field, [0.4, 0.0], 20.0)
md.view("blazed", depth=0.02, samples=32, coherence_length=2.0)
np = sys.modules["numpy"]
np.save({str(tmp_path / "scan.npy")!r}, np.random.default_rng(0).random((40, 40)))
from mitsuba_diffraction.cli import main
sys.argv = ["", "inspect", {str(tmp_path / "scan.npy") + ",pixel_size=0.1"!r}, "-o", {str(tmp_path / "s.png")!r}]
try:
    main()
except SystemExit as exit:
    assert not exit.code, exit.code
print(*({{"mitsuba", "drjit"}} & set(sys.modules)))
"""
    words = in_a_fresh_process(program)
    assert not {"mitsuba", "drjit"} & set(words)
    assert (tmp_path / "blazed.exr").is_file()
    assert (tmp_path / "s.png").is_file()


@pytest.mark.few(1)
@pytest.mark.parametrize(
    "lines",
    [
        ("import mitsuba", "mitsuba.set_variant('llvm_ad_spectral')", "import mitsuba_diffraction"),
        ("import mitsuba_diffraction", "import mitsuba", "mitsuba.set_variant('llvm_ad_spectral')"),
        ("import mitsuba", "import mitsuba_diffraction", "mitsuba.set_variant('llvm_ad_spectral')"),
        (
            "import importlib.util, mitsuba_diffraction",
            "importlib.util.find_spec('mitsuba')",
            "import mitsuba",
            "mitsuba.set_variant('llvm_ad_spectral')",
        ),
    ],
    ids=["last", "first", "between", "after it was looked for"],
)
def test_plugins_are_registered_whenever_the_package_is_imported(lines):
    blaze = "{'type': 'diffraction_grating', 'profile': 'blazed', 'depth': 0.05, 'conserve_energy': False}"
    printed = in_a_fresh_process("\n".join([*lines, f"print(type(mitsuba.load_dict({blaze})).__name__)"]))
    assert printed == ["DiffractionGrating"]


def test_recipes_and_the_error_of_their_surfaces_need_no_interpolation_of_scipy():
    """Which takes longer to import than most other modules together, and few surfaces need it."""
    program = """
import sys
import mitsuba_diffraction.precomputation.recipe
from mitsuba_diffraction.scalar_theory.validity import expected_error

expected_error(2.0, 0.1, 0.5)
print("scipy.interpolate" in sys.modules)
"""
    assert in_a_fresh_process(program) == ["False"]


def test_the_command_line_is_read_without_solvers():
    """Those of SciPy took a third of the imports before a picture, and few commands use them."""
    program = "import sys\nimport mitsuba_diffraction.cli\nprint(*sys.modules)"
    assert not {"scipy.optimize", "scipy.sparse.linalg", "scipy.interpolate"} & set(in_a_fresh_process(program))


def test_a_variant_is_set_without_the_modules_of_the_plugins():
    """They are imported when a scene first has a plugin, whose class is made once."""
    printed = in_a_fresh_process(
        """
import sys
import mitsuba_diffraction, mitsuba as mi

def ours():
    return [name for name in sys.modules if name.startswith("mitsuba_diffraction")]

mi.set_variant("llvm_ad_spectral")
mi.load_dict({"type": "scene", "ball": {"type": "sphere"}})
print(len(ours()), "scipy" in sys.modules)
path = {"type": "diffraction_path"}
first = type(mi.load_dict(path))
mi.set_variant("scalar_rgb")
mi.set_variant("llvm_ad_spectral")
print(type(mi.load_dict(path)) is first, any("evaluation" in name for name in ours()))
"""
    )
    assert int(printed[0]) <= 9
    assert printed[1:] == ["False", "True", "False"]


REPOSITORY = PACKAGE.parent
SCRIPTS = sorted(path for folder in ("tools", "scenes") for path in (REPOSITORY / folder).rglob("*.py"))
PAGES = [REPOSITORY / "README.md", *sorted((REPOSITORY / "docs").rglob("*.md")), *REPOSITORY.glob("notebooks/*.ipynb")]


def program_of(path):
    """The Python of a script, of all cells of a notebook or of all blocks of code of a page."""
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".ipynb":
        cells = ["".join(cell["source"]) for cell in json.loads(text)["cells"] if cell["cell_type"] == "code"]
        return "\n".join(line for cell in cells for line in cell.splitlines() if not line.startswith(("%", "!")))
    if path.suffix == ".md":
        return "\n".join(map(textwrap.dedent, re.findall(r"^ *```python\n(.*?)^ *```", text, re.MULTILINE | re.DOTALL)))
    return text


def imported_in_order(program, folder, outer=()):
    """The top-level packages that a program imports, in the order of execution; its functions run last.

    Modules beside the program are followed.
    """
    statements, later = list(ast.parse(program).body), []
    while statements or later:
        node = (statements or later).pop(0)
        names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
        if isinstance(node, ast.ImportFrom):
            names = [node.module]
        for name in names:
            beside = folder / f"{name}.py"
            if beside.is_file() and beside not in outer:
                yield from imported_in_order(beside.read_text(encoding="utf-8"), folder, (*outer, beside))
            yield name.partition(".")[0]
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            continue
        inner = [child for child in ast.iter_child_nodes(node) if isinstance(child, ast.stmt | ast.excepthandler)]
        if isinstance(node, ast.FunctionDef):
            later += inner
        else:
            statements[:0] = inner


@pytest.mark.quick
@pytest.mark.parametrize("path", [*SCRIPTS, *PAGES], ids=lambda path: str(path.relative_to(REPOSITORY)))
def test_the_package_is_imported_before_mitsuba(path):
    """Otherwise Dr.Jit has loaded the system's LLVM, which may be too old, before the package can choose another."""
    found = list(imported_in_order(program_of(path), path.parent))
    mitsuba = min((found.index(name) for name in ("mitsuba", "drjit") if name in found), default=len(found))
    assert "mitsuba_diffraction" not in found[mitsuba:] or "mitsuba_diffraction" in found[:mitsuba]


@pytest.mark.quick
def test_an_import_of_mitsuba_first_is_found(tmp_path):
    (tmp_path / "helper.py").write_text("import mitsuba.python as mi\n")
    for program, wanted in (
        ("import helper\nimport mitsuba_diffraction as md", "mitsuba"),
        ("import mitsuba_diffraction\nimport helper", "mitsuba_diffraction"),
        ("def f():\n    import drjit\nfrom mitsuba_diffraction.render import render", "mitsuba_diffraction"),
        ("try:\n    import drjit\nfinally:\n    import mitsuba_diffraction", "drjit"),
    ):
        assert next(imported_in_order(program, tmp_path)) == wanted
