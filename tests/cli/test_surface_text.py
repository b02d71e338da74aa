"""SURFACE[,name=value…]: one form for all commands, and the options of two of them."""

import importlib
import itertools
import re
from pathlib import Path

import numpy as np
import pytest
import typer

from mitsuba_diffraction.cli import app
from mitsuba_diffraction.precomputation.recipe import SCAN_KEYS
from mitsuba_diffraction.precomputation.requested_surface import RequestedSurface
from mitsuba_diffraction.precomputation.surface_text import parsed, written
from mitsuba_diffraction.settings import SPECTRUM_PARAMETERS

SCAN = "scan.npy,pixel_size=0.5,extent=tile"
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
    monkeypatch.setattr(module, "_precompute", lambda request, *rest: recipes.append(request.recipe))
    return recipes


def commands():
    return typer.main.get_command(app).commands


@pytest.mark.parametrize(
    ("options", "values"),
    [
        (["--tolerance", "0.02"], "tolerance=0.02"),
        (["--tolerance=0.02", "--coherence-length", "12"], "tolerance=0.02,coherence_length=12"),
        (["--representation", "taylor", "--terms", "6"], "representation=taylor,terms=6"),
        (["--representation=taylor", "--heights-from=lowest"], "representation=taylor,heights_from=lowest"),
        (["--representation=taylor", "--terms=auto"], "representation=taylor,terms=auto"),
    ],
)
def test_options_of_precompute_are_values_of_each_surface(options, values, command, computed):
    for line in (["blazed", SCAN, *options], [f"blazed,{values}", f"{SCAN},{values}"]):
        code, out, error = command("precompute", *line)
        assert (code, out, error) == (0, "", "")
    assert computed[:2] == computed[2:]
    assert computed[0].settings != RequestedSurface.of("blazed").recipe.settings


@pytest.mark.slow
def test_options_of_inspect_are_values_of_its_scan(command):
    np.save("grey.npy", np.random.default_rng(3).integers(0, 255, (64, 64), np.uint8))
    numbers = []
    for line in ("grey.npy,pixel_size=0.05,height_range=0.3", "grey.npy --pixel-size 0.05 --height-range=0.3"):
        assert command(f"inspect {line} --json numbers.json --overwrite")[0] == 0
        numbers.append(Path("numbers.json").read_text(encoding="utf-8"))
    assert numbers[0] == numbers[1]
    code, _, error = command("inspect scan.npy,pixel_size=0.5 --pixel-size 0.4")
    assert (code, "pixel_size: got 0.5 and 0.4, wanted one value" in error) == (2, True)


def test_help_shows_what_a_surface_has_as_options(command):
    keys = {f"--{key.replace('_', '-')}" for key in (*SCAN_KEYS, *SPECTRUM_PARAMETERS)}
    lasting = {
        "inspect": {"--pixel-size", "--height-range"},
        "precompute": {"--representation", "--tolerance", "--coherence-length", "--terms", "--heights-from"},
        "benchmark": {"--tolerance", "--terms"},  # of its own
    }
    for name in COMMANDS:
        (surface,) = (p for p in commands()[name].params if p.param_type_name == "argument" and "SURFACE" in p.metavar)
        assert "name=value" in surface.help
        code, out, _ = command(name, "--help")
        assert code == 0
        assert {word for word in re.findall(r"--[a-z-]+", out) if word in keys} == lasting.get(name, set())
        code, _, error = command(name, *(["blazed"] if name != "benchmark" else []), "--extent", "tile")
        assert (code, "No such option: --extent" in error) == (2, True)


def test_a_scan_whose_edges_meet_is_a_tile(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    x = np.arange(64) / 64
    for name, row, extent in (("period", np.sin(2 * np.pi * x), "tile"), ("piece", np.sin(4 * x), "sample")):
        np.save(f"{name}.npy", 0.1 * np.tile(row, (64, 1)))
        assert RequestedSurface.of(f"{name}.npy,pixel_size=0.05").recipe.settings.extent == extent


@pytest.mark.slow
def test_one_rule_tells_whether_a_scan_is_a_tile(command, computed):
    """By its seam, in every command: one period of a sinusoid, and the same with an end that does not fit."""
    x = np.arange(64) / 64
    rows = {"period.npy": np.sin(2 * np.pi * x), "piece.npy": np.sin(4 * x)}
    heights = {name: np.tile(row, (64, 1)) for name, row in rows.items()}
    heights["noise.npy"] = np.random.default_rng(2).random((64, 64))
    for name, extent in {"period.npy": "tile", "piece.npy": "sample", "noise.npy": "sample"}.items():
        np.save(name, 0.1 * heights[name])
        text = f"{name},pixel_size=0.05"
        code, _, error = command("precompute", text)
        assert (code, computed[-1].settings.extent) == (0, extent)
        assert f"note: {name}: taken as extent={extent}: " in error
        code, out, error = command("inspect", text)
        assert (code, {"tile": "(periodic tile)", "sample": "(sample of a larger surface)"}[extent] in out) == (0, True)
        assert f"note: {name}: taken as extent={extent}: " in error
        code, out, _ = command("efficiency", text, "--wavelength", "500")
        assert (code, "mirror" in out) == (0, extent == "sample")
        for given in ("tile", "sample"):
            assert RequestedSurface.of(f"{text},extent={given}").recipe.settings.extent == given


@pytest.mark.parametrize(
    ("text", "source", "values"),
    [
        ("blazed", "blazed", {}),
        ("blazed,period=1.6, depth=.2", "blazed", {"period": 1.6, "depth": 0.2}),
        ("blazed , period = 1.6 , depth= .2", "blazed", {"period": 1.6, "depth": 0.2}),
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


def test_the_longest_of_several_files_is_the_source_or_the_value(tmp_path, monkeypatch):
    """Whichever of the names up to a comma exist."""
    monkeypatch.chdir(tmp_path)
    parts = ["a.npy", "b=1.npy", "c=2.npy", "d=3"]
    names = [",".join(parts[:end]) for end in (1, 2, 3)]
    for exists in itertools.product([False, True], repeat=3):
        for name, one in zip(names, exists, strict=True):
            (tmp_path / name).write_text("") if one else (tmp_path / name).unlink(missing_ok=True)
        end = max((k for k, one in enumerate(exists, 1) if one), default=1)
        source, values = parsed(",".join(parts))
        assert (source, list(values)) == (names[end - 1], [part.partition("=")[0] for part in parts[end:]])
        source, values = parsed(f"x,e={','.join(parts)}")
        assert (source, list(values)) == ("x", ["e", *(part.partition("=")[0] for part in parts[end:])])
        assert Path(values["e"]).name == names[end - 1]
