"""Every block of code in the manual and the README runs, in a folder like that of the repository."""

import importlib
import importlib.util
import inspect
import logging
import pkgutil
import re
import runpy
import shlex
import shutil
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
import yaml
from markdown.extensions.toc import slugify
from mkdocs.commands.build import build
from mkdocs.config import load_config

import mitsuba_diffraction as md
from mitsuba_diffraction.energy import table
from mitsuba_diffraction.shader_2014.quirks import Quirks

ROOT = Path(__file__).parents[1]
PACKAGE = Path(md.__file__).parent
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
SLOW = {
    *("compare", "derivatives", "design", "export", "index", "long_renders", "materials", "own_grating", "own_scan"),
    *("plugin", "published", "python", "viewer"),
}
"""Pages whose code takes long."""
WAY_IN = ("index", "gallery", "blender", "viewer", "own_scan", "own_grating", "design", "plugin", "python")
"""Pages that are read; the others are for looking something up."""
BLOCK = re.compile(r"^(?P<indent> *)```(?P<language>\w+)\n(?P<body>.*?)^ *```$", re.DOTALL | re.MULTILINE)
REDUCED = {
    "design": {"--texels": "8", "--starts": "1"},
    "render": {"--width": "16", "--spp": "1"},
    "compare": {"--width": "16", "--spp": "1", "--no-costs": None},
}
"""Options that make a command quick, instead of those that it has."""
SHOWN = {"text", "bash", "math", "js"}
"""What is shown and not run: output, what needs several machines (tests/render/test_cluster.py) or a browser
(tests/export), and formulas."""
BY_OTHER_MEANS = (
    *("python3 -m venv", "python -m pytest", "pip install", "jupyter ", "mkdocs "),
    *("mitsuba-diffraction benchmark", "mitsuba-diffraction convergence", "mitsuba-diffraction validate"),
    *("python tools/", "python scenes/"),
)
"""Commands that CI runs, and the tests of notebooks, the manual, the benchmark, the validation and the gallery."""
SMALL_DISC = {"patches": 1, "tracks": 5, "length": 16.0, "tolerance": 0.05}
"""Parameters of a disc of which few pits and a rough table will do."""
NUMBER = re.compile(r"(?<![\w.])[-−]?\d+(?:\.\d*)?(?:e[-+]?\d+)?")


def blocks(page):
    for match in BLOCK.finditer(page.read_text(encoding="utf-8")):
        indent = match["indent"]
        lines = match["body"].splitlines()
        yield match["language"], "\n".join(line.removeprefix(indent) for line in lines)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Recipes, scans and scenes as in the repository, and the scan of a grating that the pages speak of."""
    for name in ("precompute", "scenes", "docs"):
        shutil.copytree(ROOT / name, tmp_path / name)
    monkeypatch.chdir(tmp_path)
    (package,) = importlib.util.find_spec("NSFopen").submodule_search_locations
    shutil.copy(Path(package) / "example" / "Plane_Removal" / "grid.nid", "grid.nid")
    return tmp_path


def same(printed, shown):
    """Whether two outputs have the same words, and numbers that agree to a thousandth."""
    (words, values), (others, wanted) = (
        (
            NUMBER.sub("#", re.sub(r"\[\s+", "[", " ".join(text.split()))),
            [float(n.replace("−", "-")) for n in NUMBER.findall(text)],
        )
        for text in (printed, shown)
    )
    assert words == others
    np.testing.assert_allclose(values, wanted, rtol=1e-3, atol=1e-12)


def run_python(text, names, shown, capfd):
    """A block, and what it prints: after it as text, or behind each `print` as a comment that begins with a number."""
    capfd.readouterr()
    exec(compile(text, "block", "exec"), names)
    comments = [match[1] for match in re.finditer(r"^print\(.*\)  # ([(\[\d].*)$", text, re.MULTILINE)]
    expected = shown if shown is not None else "\n".join(comments)
    if expected:
        same(capfd.readouterr().out, expected)


def run_shell(text, command, wanted=0, reduced=True):
    """Runs the lines; gives what the last command printed."""
    said = ""
    for line in text.replace("\\\n", " ").splitlines():
        words = shlex.split(line, comments=True)
        if not words or line.startswith(BY_OTHER_MEANS):
            continue
        name, *words = words
        assert name == "mitsuba-diffraction", line
        options = dict(REDUCED.get(words[0], {}) if reduced and "--width 64" not in line else {})
        if "--frames" in words:
            options["--frames"] = "2"
        if reduced and words[0] == "precompute":
            words[1] = re.sub(",tolerance=[^,]*", "", words[1]) + ",tolerance=0.05"
        code, said, error = command(*with_options(words, options))
        assert code == wanted, f"{line}: {error}"
        said = said or error
    return said


def with_options(words, options):
    """A command with other values of options, (name → value, None of a flag)."""
    kept, rest = [], iter(words)
    for word in rest:
        if word not in options:
            kept.append(word)
        elif options[word] is not None:
            next(rest)
    return kept + [word for option in options.items() for word in option if word is not None]


def run_console(text, command):
    """A command after $ and what it printed, which may be an error."""
    for part in text.split("$ ")[1:]:
        line, _, output = part.partition("\n")
        printed = run_shell(line, command, 2 if "error: " in output else 0, reduced=False)
        # On a slow machine, or with nothing cached, a command says what its time was spent on.
        same(re.sub(r"^took .*\n", "", printed, flags=re.MULTILINE), output)


def run_toml(text):
    Path("block.toml").write_text(text)
    recipe = md.Recipe.load("block.toml")
    assert recipe.height_field().heights.size
    if "scan" in recipe.surface:
        shutil.copy("block.toml", "skin.toml")  # as the pages call it


def run_xml(text):
    # Instead of the mean over many patches a small one will do, and a rough table.
    disc = '<string name="profile" value="compact_disc"/>'
    kinds = {int: "integer", float: "float"}
    of_disc = (f'<{kinds[type(v)]} name="{k}" value="{v}"/>' for k, v in SMALL_DISC.items())
    text = text.replace(disc, "".join([disc, *of_disc]))
    Path("block.xml").write_text(f'<scene version="3.0.0">{text}</scene>')
    mi.load_file("block.xml")


def small_example_scene(surface="compact_disc", example_scene=md.example_scene, **parameters):
    """The scene that `md.example_scene` returns, of few pixels."""
    return example_scene(surface, **{"size": 16, **(SMALL_DISC if surface == "compact_disc" else {}), **parameters})


@pytest.mark.parametrize(
    "page",
    [pytest.param(page, marks=pytest.mark.slow if page.stem in SLOW else ()) for page in PAGES],
    ids=[page.stem for page in PAGES],
)
def test_the_code_of_a_page_runs(page, folder, command, llvm, capfd, monkeypatch):
    monkeypatch.setattr(md, "example_scene", small_example_scene)
    if page.stem == "README":
        # Tables of E of few nodes, for this test alone.
        monkeypatch.setattr(table, "MAX_NODE_COMPONENT_PAIRS", 3e5)
        monkeypatch.setattr(table, "_kept", {})
        monkeypatch.setenv("MITSUBA_DIFFRACTION_CACHE", str(folder / "cache"))
    names = {}
    parts = list(blocks(page))
    for (language, text), (following, shown) in zip(parts, [*parts, ("", "")][1:], strict=True):
        if language == "python":
            run_python(text, names, shown if following == "text" else None, capfd)
        elif language == "sh":
            printed = run_shell(text, command)
            if following == "text" and shown.endswith("\n…"):  # the beginning of a table
                rows = shown.removesuffix("…").splitlines()
                lines = printed.splitlines()
                first = [line.split() for line in lines].index(rows[0].split())
                same("\n".join(lines[first : first + len(rows)]), "\n".join(rows))
        elif language == "console":
            run_console(text, command)
        elif language == "toml":
            run_toml(text)
        elif language == "xml":
            run_xml(text)
        else:
            assert language in SHOWN, f"{page.name}: a block of {language!r}, which nothing runs"


def test_a_wrong_block_of_code_is_found(folder, command, llvm, capfd):
    with pytest.raises(AssertionError):
        run_python("print(93, 365.0)  # 93 360.", {}, None, capfd)
    with pytest.raises(AssertionError):
        same("4.05 nm along x", "4.05 nm along y")
    with pytest.raises(AssertionError):
        run_shell("mitsuba-diffraction precompute gone.toml", command)
    with pytest.raises(RuntimeError):
        run_xml('<bsdf type="diffraction_grating"><string name="profile" value="blaze"/></bsdf>')
    with pytest.raises(ValueError, match="unknown name"):
        run_toml("[surfaces]")


def test_the_tables_of_the_manual_are_those_of_the_plugins(llvm):
    """If they are not: python tools/manual/parameter_tables.py."""
    tables = runpy.run_path(str(ROOT / "tools" / "manual" / "parameter_tables.py"))
    for name in tables["PAGES"]:
        text = (ROOT / "docs" / name).read_text(encoding="utf-8")
        assert tables["with_tables"](name, text) == text
    text = (ROOT / "docs" / "plugin.md").read_text(encoding="utf-8")
    with pytest.raises(KeyError, match="'material_'"):
        tables["with_tables"]("plugin.md", text.replace("| `material` |", "| `material_` |"))
    with pytest.raises(ValueError, match="no row for material"):
        tables["with_tables"]("plugin.md", re.sub(r"^\| `material` \|.*\n", "", text, flags=re.MULTILINE))


def test_the_manual_lists_what_rigorous_theory_refuses():
    from mitsuba_diffraction.bsdf.parameters import _SCALAR_ONLY

    text = (ROOT / "docs" / "plugin.md").read_text()
    (sentence,) = re.findall(r"rigorous-orders\)\)\. ([^.]*) are refused\.", text)
    assert set(re.findall(r"`(\w+)`", sentence)) == set(_SCALAR_ONLY)


def test_the_page_on_python_names_the_public_interface():
    page = (ROOT / "docs" / "python.md").read_text().replace("`md.", "`mitsuba_diffraction.")
    named = set(re.findall(r"mitsuba_diffraction\.[\w.]+\w", page))
    assert len(named) > 15
    for name in named:
        pkgutil.resolve_name(name)
    for summary in re.findall(r"^\| `(mitsuba_diffraction\.[\w.]+)\((.*?)\)`", page, re.MULTILINE):
        parameters = inspect.signature(pkgutil.resolve_name(summary[0])).parameters
        for argument in summary[1].split(", "):
            assert argument.split("=")[0] == "…" or argument.split("=")[0] in parameters, summary


def test_the_reference_has_all_public_names():
    page = "".join(path.read_text() for path in (ROOT / "docs" / "reference").glob("*.md"))
    named = re.findall(r"^::: (mitsuba_diffraction\.[\w.]+)$", page, re.MULTILINE)
    objects = [pkgutil.resolve_name(name) for name in named]
    for name in md.__all__:
        found = getattr(md, name)
        inside = [
            object for object in objects if getattr(object, "__module__", "").startswith(f"{md.__name__}.{name}.")
        ]
        assert inside or any(found is object for object in objects), name


def test_ruff_of_pre_commit_is_that_of_ci():
    hooks = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text())["repos"][0]["hooks"]
    assert [hook["entry"].split()[:2] for hook in hooks] == [["ruff", "check"], ["ruff", "format"]]
    rule = re.search(r'"(ruff[^"]*)"', (ROOT / "pyproject.toml").read_text())[1]
    assert all(hook["additional_dependencies"] == [rule] for hook in hooks)


def test_the_workflow_runs_ci_on_the_oldest_python_and_the_newest_that_is_named():
    jobs = yaml.safe_load((ROOT / ".github" / "workflows" / "ci.yml").read_text())["jobs"]
    assert jobs.keys() == {"ci", "oldest", "elsewhere"}
    job = jobs["ci"]
    project = (ROOT / "pyproject.toml").read_text()
    named = re.findall(r'"Programming Language :: Python :: (3\.\d+)"', project)
    assert f'requires-python = ">={named[0]}"' in project
    assert job["strategy"]["matrix"]["python"] == [named[0], named[-1]]
    assert job["steps"][-1]["run"] == ".ci/run"


def test_the_manual_is_built_strictly_on_read_the_docs():
    assert load_config(str(ROOT / "mkdocs.yml")).strict
    settings = yaml.safe_load((ROOT / ".readthedocs.yaml").read_text())
    assert settings["mkdocs"] == {"configuration": "mkdocs.yml", "fail_on_warning": True}
    assert settings["python"]["install"] == [{"method": "pip", "path": ".", "extra_requirements": ["docs"]}]


def test_the_files_that_the_readme_names_exist():
    named = re.findall(
        r"(?:scenes|docs|precompute|notebooks)/[\w./]+\.(?:xml|png|jpg|toml|ipynb|md)", PAGES[0].read_text()
    )
    assert len(named) >= 5
    for name in named:
        assert (ROOT / name).is_file(), name


def test_the_manual_begins_with_the_pages_of_the_readme():
    (table,) = re.findall(r"^\| you have \|.*?\n\n", PAGES[0].read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
    pages = set(re.findall(r"\]\(docs/([\w.#-]+)\)", table))
    assert len(pages) >= 8
    assert pages <= set(re.findall(r"\]\(([\w.#-]+)\)", (ROOT / "docs" / "index.md").read_text(encoding="utf-8")))


def test_the_readme_is_short():
    assert len(PAGES[0].read_text(encoding="utf-8").splitlines()) <= 140


def words(page):
    """As `wc -w` counts them, with marks of tables and addresses of links, without blocks of code."""
    text = BLOCK.sub("", (ROOT / "docs" / f"{page}.md").read_text(encoding="utf-8"))
    return len(re.sub(r"^    mitsuba-diffraction .*$", "", text, flags=re.MULTILINE).split())


def test_the_way_into_the_manual_has_at_most_12_000_words():
    counts = {page: words(page) for page in WAY_IN}
    assert sum(counts.values()) <= 12_000, counts


def test_the_page_of_doubts_has_at_most_900_words():
    assert words("trust") <= 900


def test_what_the_page_on_the_thesis_names_exists(command):
    text = (ROOT / "docs" / "thesis.md").read_text(encoding="utf-8")
    named = re.findall(r"`([\w./]+\.(?:py|md|toml|xml|ipynb|png))`", text)
    assert len(named) > 40
    for name in named:
        assert (ROOT / name).is_file() or (PACKAGE / name).is_file(), name
    for name, member in re.findall(r"`([\w/]+\.py)` \(`(\w+)`\)", text):
        path = PACKAGE / name if (PACKAGE / name).is_file() else ROOT / name
        assert re.search(rf"^ *(?:def|class) {member}\b", path.read_text(), re.MULTILINE), (name, member)
    for page, anchor in re.findall(r"\]\(((?:[\w./]*\.md)?)#?([\w-]*)\)", text):
        headings = re.findall(r"^#+ (.*)$", (ROOT / "docs" / (page or "thesis.md")).read_text(), re.MULTILINE)
        assert not anchor or anchor in {slugify(heading.replace("`", ""), "-") for heading in headings}, (page, anchor)
    for name, *words in map(str.split, re.findall(r"`mitsuba-diffraction ([^`]*)`", text)):
        code, offered, _ = command(name, "--help")
        assert code == 0
        assert all(word in offered for word in words if word.startswith("--")), (name, words)
        assert all((ROOT / word).is_file() for word in words if word.startswith("scenes/")), (name, words)


def test_the_page_on_the_thesis_describes_all_quirks():
    table = (ROOT / "docs" / "thesis.md").read_text(encoding="utf-8").partition("## Quirks")[2]
    named = re.findall(r"`(\w+)`", " ".join(line.split(" | ")[0] for line in table.splitlines() if line[:3] == "| `"))
    assert sorted(named) == sorted(Quirks.names())


@pytest.mark.slow
def test_the_manual_is_built_without_warnings(tmp_path, caplog):
    with caplog.at_level(logging.WARNING):
        build(load_config(str(ROOT / "mkdocs.yml"), site_dir=str(tmp_path / "site")))
    assert not [record for record in caplog.records if record.levelno >= logging.WARNING]
    for page in PAGES[1:]:
        place = "" if page.stem == "index" else page.stem
        assert (tmp_path / "site" / place / "index.html").is_file()
    theory = (tmp_path / "site" / "theory" / "index.html").read_text(encoding="utf-8")
    assert theory.count("<math") == (ROOT / "docs" / "theory.md").read_text(encoding="utf-8").count("```math")
    live = (tmp_path / "site" / "live" / "surfaces.html").read_text(encoding="utf-8")
    assert "<canvas" in live
    assert live.count('type="application/json"') == 10  # shaders, names, and eight surfaces
    turning = (tmp_path / "site" / "live" / "turning.html").read_text(encoding="utf-8")
    assert turning.count('type="application/json"') == 5
    assert 'src="live/turning.html#turn"' in (tmp_path / "site" / "index.html").read_text(encoding="utf-8")
