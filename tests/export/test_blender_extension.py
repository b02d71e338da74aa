"""The extension of Blender: its line gratings, and, if Blender's Python package is there, its installation."""

import importlib.metadata
import importlib.util
import json
import os
import subprocess
import sys
import zipfile
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.special import jv

from mitsuba_diffraction.export import blender_extension
from mitsuba_diffraction.export.node_tables import write_node_tables
from mitsuba_diffraction.export.shader_tables import ShaderTables
from mitsuba_diffraction.optics.color import SRGB_TO_XYZ
from mitsuba_diffraction.precomputation.requested_surface import RequestedSurface

ASSETS = Path(blender_extension.__file__).parent / "assets" / "blender"
BLENDER = os.environ.get("BPY_PYTHON") or (sys.executable if importlib.util.find_spec("bpy") else None)
needs_blender = pytest.mark.skipif(
    BLENDER is None, reason="needs Blender's package bpy, here or in the Python that BPY_PYTHON names"
)
OTHER = os.environ.get("OTHER_BPY_PYTHON")
BASE = {"edges": np.linspace(0.39, 0.72, 49), "colours": np.ones((1, 48, 3)), "spaces": ["-"], "index": np.zeros(48)}


def module_of_extension(name):
    """A module of the extension, which Blender imports as one of its own."""
    spec = importlib.util.spec_from_file_location(f"{name}_of_extension", ASSETS / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def line_grating(*arguments):
    return module_of_extension("line_gratings").line_grating(*arguments, BASE)


def test_line_gratings_have_their_closed_forms():
    period, depth = 1.6, 0.2
    for profile, duty in (("sinusoidal", 0.5), ("blazed", 0.5), ("lamellar", 0.25)):
        tables = line_grating(profile, period, depth, duty)
        order = np.round(tables["frequencies"][:, 0] * period)[:, None]
        kappa = np.linspace(0, float(tables["max_kappa"]), tables["powers"].shape[1])
        expected = {
            "sinusoidal": jv(order, kappa * depth / 2) ** 2,
            "blazed": np.sinc(kappa * depth / (2 * np.pi) - order) ** 2,
            "lamellar": np.where(
                order == 0,
                1 - 4 * duty * (1 - duty) * np.sin(kappa * depth / 2) ** 2,
                (2 * duty * np.sinc(order * duty) * np.sin(kappa * depth / 2)) ** 2,
            ),
        }[profile]
        np.testing.assert_allclose(tables["powers"], expected, atol=2e-3)


@pytest.fixture
def nodes(monkeypatch):
    """The module of the node group, of which some functions do without Blender."""
    monkeypatch.setitem(sys.modules, "bpy", SimpleNamespace())
    return module_of_extension("nodes")


def test_orders_are_drawn_about_as_often_as_they_are_bright(nodes):
    period, depth, generator = 1.6, 0.15, np.random.default_rng(1)
    tables = line_grating("sinusoidal", period, depth, 0.5)
    rows = nodes._orders(tables).reshape(4, 4, 16, -1, 4)
    cosine, azimuth, wavelength = generator.uniform([[0.3], [0], [0.42]], [[1], [1], [0.68]], (3, 200))
    height = 16 / wavelength / (float(tables["max_kappa"]) / (4 * np.pi))
    excess = []
    for c_o, phi, light, k in zip(cosine, azimuth, wavelength, height.astype(int), strict=True):
        slots = rows[int(4 * c_o), int(4 * phi), k]
        order, numbers = np.unique(np.round(slots[:, 0] * period), return_counts=True)
        chance = numbers / len(slots)
        np.testing.assert_allclose(np.sort(1 / slots[:, 3]), np.sort(np.repeat(chance, numbers)))
        u_o, v_o = np.sqrt(1 - c_o**2) * np.array([-np.cos(2 * np.pi * phi), -np.sin(2 * np.pi * phi)])
        square = 1 - (u_o + light * order / period) ** 2 - v_o**2
        c_i = np.sqrt(np.maximum(square, 1e-6))
        w, v_2 = c_i + c_o, (light * order / period) ** 2 + (c_i + c_o) ** 2
        k_g = v_2**2 / (4 * c_i * c_o * w**2) * np.minimum(1, 4 * w * np.minimum(c_i, c_o) / v_2)
        power = np.where(square > 1e-6, jv(order, np.pi * w / light * depth) ** 2 * k_g, 0)
        excess.append((power**2 / chance).sum() / power.sum() ** 2)
    assert np.mean(excess) < 1.2  # of noise², beside the order being drawn by its power


def test_wavelengths_that_are_drawn_have_the_light_of_their_bins(nodes):
    edges, colours = np.linspace(0.39, 0.72, 49), np.random.default_rng(2).uniform(0, 3, (1, 48, 3)) ** 2
    lights = nodes._lights({"edges": edges, "colours": colours}, 0)
    of_bin = np.digitize(lights[:, 3], edges) - 1
    summed = np.stack([lights[of_bin == k, :3].sum(axis=0) for k in range(48)])
    np.testing.assert_allclose(summed / len(lights), colours[0] / 48)
    luminance = lights[:, :3] @ SRGB_TO_XYZ[1]
    assert luminance.max() < 1.7 * luminance.mean()  # of the bins, 2.3 times: the brighter, the more often


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("export -o s.osl", "SURFACE: got none for s.osl, wanted a surface, or -o with a file .zip"),
        ("export foil -o s.zip", "-o"),
    ],
)
def test_an_extension_is_of_no_surface(line, message, command, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, _, error = command(line)
    assert code == 2
    assert message in error
    assert not list(tmp_path.iterdir())


@pytest.fixture(scope="session")
def extension(tmp_path_factory):
    path = tmp_path_factory.mktemp("extension") / "diffraction_gratings.zip"
    blender_extension.write_extension(path)
    return path


@pytest.mark.slow
def test_the_extension_holds_its_licences_and_version(extension):
    with zipfile.ZipFile(extension) as archive:
        version = importlib.metadata.version("mitsuba_diffraction")
        assert f'version = "{version}"' in archive.read("blender_manifest.toml").decode()
        assert b"BSD 3-Clause" in archive.read("LICENSE")
        assert b"MIT" in archive.read("tables/LICENSE-of-skins.txt")
    assert extension.stat().st_size < 1.5e6


@pytest.fixture(scope="session")
def installed(extension, tmp_path_factory):
    """What extension_in_blender.py found, and the folder with the files that it saved."""
    folder = tmp_path_factory.mktemp("installed")
    path = folder / "mine.npz"
    requested = RequestedSurface.of("sinusoidal,period=1.6,depth=0.15,material=Al", aside=("material",))
    write_node_tables(ShaderTables.of_spectrum(requested.spectrum(), requested.below), path)
    words = [BLENDER, Path(__file__).with_name("extension_in_blender.py"), extension, path, folder / "saved.blend"]
    return marked(words, "FOUND ", folder), folder


def marked(words, mark, folder):
    """The JSON after a mark in what a program prints, with a new folder for the settings of Blender."""
    user = folder / f"user-{mark.strip()}"
    user.mkdir()
    where = {**os.environ, "BLENDER_USER_RESOURCES": str(user)}
    here = Path(__file__).parent
    done = subprocess.run(list(map(str, words)), cwd=here, capture_output=True, text=True, timeout=600, env=where)
    line = next((each for each in done.stdout.splitlines() if each.startswith(mark)), None)
    assert line, done.stdout + done.stderr
    return json.loads(line.removeprefix(mark))


@pytest.mark.slow
@needs_blender
def test_the_extension_is_installed_and_makes_each_material(installed):
    found, _ = installed
    assert found["valid"]
    surfaces = found["surfaces"]
    assert {name for name, of in surfaces.items() if of["radial"]} == {"compact_disc", "dvd"}
    assert all(of["tangent"] for of in surfaces.values())
    assert surfaces["file"]["name"] == "mine"
    assert [message.count("\n") for message in found["messages"]] == [1, 1, 1]
    assert "/gone.npz: No such file" in found["messages"][0]
    assert "not tables of mitsuba-diffraction export -o NAME.npz" in found["messages"][1]
    assert "got a coat of index 1.55; these tables are for one of up to 1.08" in found["coated"]
    assert found["transparent"]
    assert found["exact"]["node"] == "ShaderNodeScript"
    assert found["exact"]["radial"] == 1
    # Files that were opened again and rendered without the extension; without the code and its hash, OSL is black.
    assert min(found["means"].values()) > 0.02


@pytest.mark.slow
@needs_blender
@pytest.mark.skipif(OTHER is None, reason="needs another version of bpy, in the Python that OTHER_BPY_PYTHON names")
@pytest.mark.parametrize(("kind", "file"), [("coated", "saved_coated.blend"), ("exact", "saved.blend")])
def test_a_saved_file_has_the_same_picture_in_another_version(kind, file, installed, tmp_path):
    found, folder = installed
    code = (
        "import bpy, extension_in_blender as test, importlib.util, json, os, sys\n"
        "assert importlib.util.find_spec('mitsuba_diffraction') is None\n"
        f"bpy.ops.wm.open_mainfile(filepath={str(folder / file)!r})\n"
        "assert not hasattr(bpy.context.scene, 'diffraction')\n"
        f"mean = test.mean_of_picture({str(tmp_path / 'picture.exr')!r})\n"
        "print('MEAN', json.dumps([bpy.app.version[:2], mean]))\n"
        "sys.stdout.flush(); os._exit(0)"
    )
    version, mean = marked([OTHER, "-c", code], "MEAN ", tmp_path)
    assert version != found["version"]
    assert mean == pytest.approx(found["means"][kind], rel=0.05)
