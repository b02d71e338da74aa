"""SURFACE[,name=value…]: one form for all commands, and the options that stood for it until version 0.3."""

import importlib
import re
from pathlib import Path

import numpy as np
import pytest
import typer

from mitsuba_diffraction.cli import app
from mitsuba_diffraction.cli.former_options import FORMER, surface_argument
from mitsuba_diffraction.errors import RequestError
from mitsuba_diffraction.precomputation.recipe import FLAGS, Recipe
from mitsuba_diffraction.precomputation.surface_text import parsed, written

SCAN, RELIEF = "scan.npy,pixel_size=0.5,extent=tile", "lamellar,depth=0.1,theory=rigorous,int_ior=1.5"
"""Of scalar and of rigorous theory; an option is added to the part that does not have its value."""
OPTIONS = {
    "--pixel-size": ("scan.npy,extent=tile", "0.5"),
    "--height-range": ("grey.npy,pixel_size=0.5,extent=tile", "0.3"),
    "--fill-missing": (SCAN, ""),
    "--channel": (SCAN, "2"),
    "--unit": (SCAN, "nm"),
    "--prepare": (SCAN, "rotate=-3"),
    "--plane": (SCAN, ""),
    "--theory": ("lamellar,depth=0.1", "rigorous"),
    "--coherence-length": (SCAN, "12"),
    "--tolerance": (SCAN, "2e-2"),
    "--largest-height-range": (SCAN, "30"),
    "--extent": ("scan.npy,pixel_size=0.5", "sample"),
    "--largest-angle": (SCAN, "60"),
    "--representation": (SCAN, "taylor"),
    "--terms": (f"{SCAN},representation=taylor", "6"),
    "--heights-from": (f"{SCAN},representation=taylor", "lowest"),
    "--int-ior": ("lamellar,depth=0.1,theory=rigorous", "BK7"),
    "--material": ("lamellar,depth=0.1,theory=rigorous", "Al"),
    "--ext-ior": (RELIEF, "1.4"),
    "--polarised": (RELIEF, ""),
    "--transmission": (RELIEF, "sheet"),
}
LASTING = {"--representation", "--tolerance", "--coherence-length", "--terms", "--heights-from"}
COMMANDS = {"view", "inspect", "export", "precompute", "efficiency", "validate", "benchmark"}


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    np.save("scan.npy", np.random.default_rng(1).random((6, 8)) * 0.1)
    np.save("grey.npy", np.arange(48, dtype=np.uint8).reshape(6, 8))
    return tmp_path


@pytest.fixture
def computed(monkeypatch):
    """The recipes of which `precompute` would compute the spectra."""
    recipes = []
    module = importlib.import_module("mitsuba_diffraction.cli.precompute")
    monkeypatch.setattr(module, "_precompute", lambda _, recipe, *rest: recipes.append(recipe))
    return recipes


def commands():
    return typer.main.get_command(app).commands


@pytest.mark.parametrize("option", FORMER)
def test_an_option_of_version_0_3_gives_the_recipe_of_the_new_form(option, command, computed):
    surface, value = OPTIONS[option]
    key = FORMER[option]
    new = f"{surface},{key}={value or ('true' if key in FLAGS else 'level_plane')}"
    words = [option, value] if value else [option]
    for line in ([new], [surface, *words], [surface, "=".join(words)]):
        code, out, error = command("precompute", *line, "-o", "out.exr")
        assert (code, out) == (0, ""), error
        wanted = (
            []
            if line == [new] or option in LASTING
            else [f"{' '.join(line[1:])} is given as {new} from version 0.5 on"]
        )
        assert [part.partition("note: ")[2] for part in error.splitlines()] == wanted
    assert computed[0] == computed[1] == computed[2]
    assert computed[0] != Recipe.of_source(*parsed(surface), "tile")


@pytest.mark.parametrize("name", sorted(COMMANDS))
def test_every_command_with_a_surface_takes_its_options(name, command, monkeypatch):
    of_command = commands()[name]
    module = importlib.import_module(of_command.callback.__module__)
    found = []

    def refuse(text):
        found.append(text)
        raise RequestError("seen")

    monkeypatch.setattr(module, "parsed", refuse)
    output = [] if name in ("efficiency", "validate", "benchmark") else ["-o", "out.csv"]
    code, _, error = command(name, "--unit", "um", "scan.npy", "--unit=nm", *output, "--fill-missing")
    assert (code, error) == (2, "mitsuba-diffraction: error: seen\n")
    assert found == ["scan.npy,unit=um,unit=nm,fill_missing=true"]


def test_help_shows_no_option_of_a_surface(command):
    assert {name for name, found in commands().items() if surface_argument(found)} == COMMANDS
    for name in COMMANDS:
        options = {option for parameter in commands()[name].params for option in parameter.opts}
        own = {"--tolerance", "--terms"} if name == "benchmark" else set()
        assert options & FORMER.keys() == own
        code, out, _ = command(name, "--help")
        assert (code, [option for option in FORMER.keys() - own if option in out]) == (0, [])


def test_a_flag_of_version_0_3_may_be_false(command, computed):
    assert command(f"precompute {SCAN} --fill-missing=false")[0] == 0
    assert computed[0].surface["fill_missing"] is False


def test_an_option_that_never_was_one_is_corrected(command):
    code, _, error = command("efficiency blazed --wavelengths 500")
    assert code == 2
    assert "No such option: --wavelengths" in error


def test_several_options_are_one_line(command, computed):
    code, _, error = command("precompute blazed --extent tile --coherence-length=20 --largest-angle 60")
    new = "blazed,extent=tile,coherence_length=20,largest_angle=60"
    assert code == 0
    assert error.partition("note: ")[2] == f"--extent tile --largest-angle 60 are given as {new} from version 0.5 on\n"
    assert computed == [Recipe.of_source(*parsed(new))]


def test_options_beside_a_scan_are_those_of_the_scan(command, computed):
    code, _, error = command("precompute blazed scan.npy --extent tile --pixel-size 1 --tolerance 0.1")
    assert code == 0
    assert error.endswith(
        "--extent tile --pixel-size 1 are given as blazed,extent=tile,tolerance=0.1 "
        "scan.npy,extent=tile,pixel_size=1,tolerance=0.1 from version 0.5 on\n"
    )
    assert ["pixel_size" in recipe.surface for recipe in computed] == [False, True]


def test_options_beside_a_scan_whose_name_has_commas_are_those_of_the_scan(command, computed):
    Path("scan.npy").rename("blazed,depth=1.npy")
    code, _, error = command("precompute blazed blazed,depth=1.npy,tolerance=0.1 --pixel-size 1")
    assert code == 0
    assert "given as blazed blazed,depth=1.npy,tolerance=0.1,pixel_size=1 from version 0.5 on" in error


@pytest.mark.parametrize(
    ("text", "source", "values"),
    [
        ("blazed", "blazed", {}),
        ("blazed,period=1.6, depth=.2", "blazed", {"period": 1.6, "depth": 0.2}),
        ("scan.npy,fill_missing=True,channel=2", "scan.npy", {"fill_missing": True, "channel": 2}),
        ("scan.npy,unit=nm", "scan.npy", {"unit": "nm"}),
        ("scan.npy,unit=um,unit=nm", "scan.npy", {"unit": ["um", "nm"]}),
        ("scan.npy,pixel_size=1,pixel_size=2", "scan.npy", {"pixel_size": [1, 2]}),
        ("blazed,wavelengths=400,wavelengths=700", "blazed", {"wavelengths": [400, 700]}),
        ("scan.npy,prepare=level_plane", "scan.npy", {"prepare": ["level_plane"]}),
        (
            "scan.npy,prepare=rotate=-3,prepare=crop_periods=x",
            "scan.npy",
            {"prepare": [{"rotate": -3.0}, {"crop_periods": "x"}]},
        ),
    ],
)
def test_values_are_those_of_a_recipe(text, source, values):
    assert parsed(text) == (source, values)
    assert parsed(written(source, values)) == (source, values)


@pytest.mark.parametrize("name", ["a,b.npy", "a=b.npy", "blazed,depth=0.2.npy", "x,y=1,z.npy", "é, ü.toml"])
def test_a_file_may_have_commas_and_equals_signs_in_its_name(name, folder):
    Path(name).touch()
    for path in (name, str(folder / name)):
        assert parsed(path) == (path, {})
        assert parsed(f"{path},pixel_size=0.5") == (path, {"pixel_size": 0.5})
        values = {"material": str(folder / name), "depth": 0.2}
        assert parsed(f"blazed,material={path},depth=0.2") == ("blazed", values)
        assert parsed(written("blazed", values)) == ("blazed", values)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "scan.npy,pixel_sise=1",
            r"scan.npy: got pixel_sise, wanted some of pixel_size, .*; did you mean pixel_size\?",
        ),
        ("blazed,colour=red", "blazed: got colour, wanted some of period, depth, "),
        ("blazed,depth=1,depth=2", "got 'depth=2', wanted name=value, each name once"),
        ("blazed,depth=1,5", "got '5', wanted name=value, each name once; a number has a point"),
        ("blazed,wavelengths=400,700", "got '700', .*; give a list as wavelengths=400,wavelengths=700"),
        ("scan.npy,unit=", "got 'unit=', wanted name=value"),
        ("scan.npy,pixel_size=small", "pixel_size: got 'small'"),
    ],
)
def test_a_wrong_value_is_one_line(text, message, command):
    code, out, error = command("precompute", text)
    assert (code, out, error.count("\n")) == (2, "", 1)
    assert re.search(message, error), error
