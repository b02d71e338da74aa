"""The shader for Cycles: what it holds, what it refuses, and, if Blender's Python package is there, its pictures."""

import importlib.util
import os
import re
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage
from scipy.special import jv

import mitsuba_diffraction as md
from mitsuba_diffraction.export.cycles import write_shader
from mitsuba_diffraction.export.shader_tables import ShaderTables
from mitsuba_diffraction.optics.color import SRGB_TO_XYZ, delta_E, linear_sRGB_to_XYZ
from mitsuba_diffraction.optics.media import MediumBelow


def array(text, name):
    """The numbers of an array of a shader."""
    body = re.search(rf"\b{name}\[(\d+)\] = \{{(.*?)\n    \}}", text, re.DOTALL)
    numbers = [float(x) for x in re.findall(r"-?\d[\d.]*(?:e[-+]?\d+)?", body[2])]
    assert len(numbers) == int(body[1]) * (3 if name == "Colours" else 1)
    return np.array(numbers)


def number(text, pattern):
    return float(re.search(pattern, text)[1])


@pytest.mark.not_quick
def test_a_grating_holds_its_orders_and_white_light(command, tmp_path):
    path, period, depth = tmp_path / "s.osl", 1.6, 0.15
    code, said, error = command("export", f"sinusoidal,period={period},depth={depth},material=Al", "-o", str(path))
    assert (code, error) == (0, "")
    text = path.read_text(encoding="utf-8")
    q, powers = array(text, "Frequencies").reshape(-1, 2), array(text, "Powers").reshape(-1, 65)
    assert f"{len(q)} orders, 65 values of κ" in said
    order = np.round(q[:, 0] * period)
    np.testing.assert_allclose(q, np.stack([order / period, 0 * order], axis=1), atol=1e-5)
    max_kappa = number(text, r"wavelength \* ([\d.]+)\);")
    kappa = np.linspace(0, max_kappa, powers.shape[1])
    assert max_kappa == pytest.approx(2 * 4 * np.pi / 0.39)
    np.testing.assert_allclose(powers, jv(order[:, None], kappa * depth / 2) ** 2, atol=2e-3)
    edges, colours = array(text, "Edges"), array(text, "Colours").reshape(-1, 3)
    np.testing.assert_allclose(colours.mean(axis=0), 1, atol=1e-5)
    assert (colours.min(axis=1) < 0).mean() > 0.8  # monochromatic light is outside of sRGB
    middle = (edges[1:] + edges[:-1]) / 2
    assert middle[np.argmax(colours[:, 1])] == pytest.approx(0.53, abs=0.02)
    index = [md.rigorous.refractive_index(w, material="Al") for w in middle]
    np.testing.assert_allclose(array(text, "Eta") + 1j * array(text, "Absorption"), index, rtol=1e-4)


@pytest.mark.not_quick
def test_a_continuum_holds_all_of_its_power_in_cells(tmp_path):
    smooth = ndimage.gaussian_filter(np.random.default_rng(3).standard_normal((80, 80)), 4, mode="wrap")
    surface = md.HeightField(0.1 * smooth / smooth.std(), 0.09)
    spectrum = md.precompute(surface, extent="sample", coherence_length=3.0, tolerance=0.05)
    tables = ShaderTables.of_spectrum(spectrum, MediumBelow.of("none"))
    assert "96 × 32 frequencies" in tables.held
    write_shader(tables, tmp_path / "c.osl")
    text = (tmp_path / "c.osl").read_text(encoding="utf-8")
    rows, columns = array(text, "Rows"), array(text, "Columns").reshape(32, 97)
    powers = array(text, "Powers").reshape(32 * 96, -1)
    assert (np.diff(rows) > 0).all()
    assert (np.diff(columns, axis=1) > 0).all()
    max_kappa = number(text, r"wavelength \* ([\d.]+)\);")
    for k in (powers.shape[1] // 2, powers.shape[1] - 1):
        kappa = max_kappa * k / (powers.shape[1] - 1)
        assert powers[:, k].mean() == pytest.approx(np.maximum(spectrum.powers(kappa), 0).sum(), rel=1e-3)
        # The mean of q² is that of S on a grid of our own.
        q = np.linspace(-5.5, 5.5, 401)
        density = spectrum.evaluate(np.stack(np.meshgrid(q, q), axis=-1), np.full((401, 401), kappa))
        expected = (density * q**2).sum() / density.sum()
        squares = (columns[:, 1:] ** 2 + columns[:, 1:] * columns[:, :-1] + columns[:, :-1] ** 2) / 3
        assert (powers[:, k] * squares.ravel()).mean() / powers[:, k].mean() == pytest.approx(expected, rel=0.03)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("export blazed,theory=rigorous -o s.osl", "wanted theory=scalar, or a file .csv or .json"),
        (
            "export blazed,orientation=90 -o s.osl",
            "got 90, which s.osl does not hold; set the input Orientation of the",
        ),
        ("export blazed,thin_film_thickness=0.1 -o s.osl", "scenes and `render --material` have it"),
        (
            "export blazed,transmission=sheet -o s.csv",
            "got sheet, which s.csv does not hold; it holds orders in reflection; "
            "mitsuba-diffraction efficiency blazed,transmission=sheet --csv s.csv has those in transmission",
        ),
        ("export blazed,material=Al,transmission=sheet -o s.npz", "got 'sheet' with Al, wanted a transparent medium"),
        ("export blazed,int_ior=1.5,transmission=sheet -o s.osl", "got sheet, which s.osl does not hold"),
        ("export blazed -o s.osl --angle 0,30", "--angle: s.osl holds all directions and colours, wanted it without"),
        ("export blazed,material=Unobtainium -o s.osl", "Unobtainium"),
        ("export gone.exr -o s.osl", "gone.exr"),
    ],
)
def test_what_a_shader_does_not_hold_is_one_line(command, line, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, _, error = command(line)
    assert code == 2
    assert message in error
    assert error.splitlines()[-1].startswith("mitsuba-diffraction: error:")
    assert not list(tmp_path.iterdir())


BLENDER = os.environ.get("BPY_PYTHON") or (sys.executable if importlib.util.find_spec("bpy") else None)
needs_blender = pytest.mark.skipif(
    BLENDER is None, reason="needs Blender's package bpy, here or in the Python that BPY_PYTHON names"
)
SIZE = 96


def in_cycles(shader, shape, light, samples, folder, *further):
    """Linear sRGB, or RGB of a working space, of the scene of tools/manual/cycles_picture.py."""
    script = Path(__file__).parents[2] / "tools" / "manual" / "cycles_picture.py"
    out = folder / "cycles.npy"
    words = [BLENDER, script, shader, shape, light, samples, SIZE, out, *further]
    done = subprocess.run([str(word) for word in words], capture_output=True, text=True, timeout=900)
    assert out.is_file(), done.stdout + done.stderr
    return np.load(out)


def version_of_blender():
    said = subprocess.run([BLENDER, "-c", "import bpy; print(bpy.app.version)"], capture_output=True, text=True)
    return tuple(map(int, re.findall(r"\d+", said.stdout.rpartition("(")[2])))  # after what Blender logs


@pytest.mark.slow
@needs_blender
@pytest.mark.parametrize(("space", "published"), [("Linear Rec.2020", "ITU-R BT.2020"), ("ACEScg", "ACEScg")])
def test_colours_are_the_same_in_each_working_space(space, published, command, tmp_path):
    if version_of_blender() < (5, 0):
        pytest.skip("Blender has one working space before 5.0")
    import colour

    shader = tmp_path / "grating.osl"
    code, _, error = command("export", "sinusoidal,period=1.6,depth=0.15,material=Al", "-o", str(shader))
    assert code == 0, error
    pictures = [in_cycles(shader, "plane", 0.15, 100, tmp_path, *other) for other in ((), (space,))]
    wanted, found = (picture.mean(axis=(0, 1)) for picture in pictures)
    spaces = colour.RGB_COLOURSPACES
    matrix = colour.matrix_RGB_to_RGB(spaces["sRGB"], spaces[published], "Bradford")
    np.testing.assert_allclose(found, matrix @ wanted, rtol=0.02)


def path_traced(bsdf, shape, light, spp):
    """The same by `diffraction_path`, with a lamp of this radius or a "sky"."""
    import mitsuba as mi

    to = mi.ScalarTransform4f()
    lights = {"sky": {"type": "constant", "radiance": {"type": "d65"}}}
    if light != "sky":
        above, below = to.translate([0, -1, 3]).rotate([1, 0, 0], 180), to.translate([0, -1, -3])
        lights = {
            "lamp": {
                "type": "disk",
                "to_world": (below if "pane" in shape else above).scale(light),
                "emitter": {"type": "area", "radiance": {"type": "d65", "scale": 100.0}},
            }
        }
    film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "diffraction_path", "max_depth": 2},
            "sensor": {
                "type": "perspective",
                "fov": 40,
                "to_world": to.look_at([0, 0, 4], [0, 0, 0], [0, 1, 0]),
                "film": film,
            },
            "shape": {
                "type": "sphere" if shape == "sphere" else "rectangle",
                "to_world": to.rotate([0, 1, 0], 180 if shape == "pane_from_behind" else 0),
                "bsdf": bsdf,
            },
            **lights,
        }
    )
    return np.array(mi.render(scene, spp=spp))


@dataclass(frozen=True)
class Beside:
    """A surface in Cycles beside the path tracer: `regions` bright ones, their luminance and ΔE00."""

    suffix: str
    shape: str
    surface: str
    samples: int
    regions: int
    luminance: tuple[float, float]
    max_delta_E: float
    coat: float = 1.0

    def __str__(self):
        behind = "-from-behind" * (self.shape == "pane_from_behind")
        return f"{self.surface.partition(',')[0]}{'-coated' * (self.coat > 1)}{behind}{self.suffix}"


SINUSOID = "sinusoidal,period=1.6,depth=0.15,coherence_length=30,material=Al"
BLAZE = "blazed,period=1.9,depth=0.2,coherence_length=30,material=Al"
DISC = "compact_disc,coherence_length=30,material=Al"
FOIL = "foil,coherence_length=12,material=Al"
BLAZED_SHEET = "transmission_300,int_ior=1.52,transmission=sheet"
# Nodes have no negative light, and so no colours outside of sRGB, which orders of both line gratings have: 3.9 and 7.6
# from the nearest. In the other regions non-negative colours fitted to them alone still leave a ΔE00 of up to 4.4, and
# those of the nodes are the same for all surfaces. Faint regions of foil and skin are a tenth darker by OSL as well.
BESIDE = (
    Beside(".osl", "plane", SINUSOID, 1200, 2, (0.93, 1.07), 5),
    Beside(".osl", "disc", BLAZE, 1200, 2, (0.93, 1.07), 5),
    Beside(".osl", "sphere", FOIL, 9000, 1, (0.9, 1.1), 5),
    Beside(".npz", "plane", SINUSOID, 1200, 2, (0.96, 1.06), 6.5),
    Beside(".npz", "disc", BLAZE, 4000, 3, (0.96, 1.12), 9),
    Beside(".npz", "disc", DISC, 6000, 1, (0.95, 1.05), 3),
    Beside(".npz", "disc", DISC, 6000, 1, (0.95, 1.05), 3, coat=1.55),
    Beside(".npz", "sphere", FOIL, 20000, 2, (0.87, 1.07), 5.5),
    Beside(".npz", "sphere", "xenopeltis_synthetic", 6000, 2, (0.84, 1.07), 7.5),
    Beside(".npz", "pane", "film,int_ior=1.5,transmission=sheet", 16000, 5, (0.9, 1.1), 9),
    Beside(".npz", "pane", BLAZED_SHEET, 400, 1, (0.95, 1.05), 6),
    Beside(".npz", "pane_from_behind", BLAZED_SHEET, 400, 1, (0.95, 1.05), 6),
)


@pytest.mark.slow
@needs_blender
@pytest.mark.parametrize("case", BESIDE, ids=str)
def test_orders_in_cycles_are_those_of_the_path_tracer(case, command, tmp_path, llvm):
    shader = tmp_path / f"grating{case.suffix}"
    code, _, error = command("export", case.surface, "-o", str(shader))
    assert code == 0, error
    if case.coat > 1:
        np.savez(shader, **np.load(shader), coat=case.coat)
    name, *values = case.surface.split(",")
    parameters = dict(value.split("=") for value in values)
    names = ("material", "transmission")
    bsdf = {key: value if key in names else float(value) for key, value in parameters.items()}
    bsdf |= {"type": "diffraction_grating", "profile": name}
    if case.coat > 1:
        bsdf["coat_ior"] = case.coat
    if case.shape == "disc":
        bsdf["orientation"] = "radial"
    ours = path_traced(bsdf, case.shape, 0.15, 1024)
    luminance = ours @ SRGB_TO_XYZ[1]
    labels, count = ndimage.label(ndimage.maximum_filter(luminance > 0.02 * luminance.max(), 3))
    rows, columns = (np.flatnonzero(labels.any(axis=axis)) for axis in (1, 0))
    border = np.array([columns[0], columns[-1] + 1, SIZE - rows[-1] - 1, SIZE - rows[0]]) / SIZE
    cycles = in_cycles(shader, case.shape, 0.15, case.samples, tmp_path, ",".join(map(str, border)))
    found = cycles @ SRGB_TO_XYZ[1]
    light = ndimage.sum(luminance, labels, range(1, count + 1))
    bright = np.flatnonzero(light > 0.03 * light.sum()) + 1
    assert len(bright) >= case.regions
    low, high = case.luminance
    for k in bright:
        region = labels == k
        at = np.argwhere(region)
        colours = [picture[region].mean(axis=0) for picture in (ours, cycles)]
        scaled = [linear_sRGB_to_XYZ(0.4 * colour / (colour @ SRGB_TO_XYZ[1])) for colour in colours]
        ratio, error = found[region].sum() / luminance[region].sum(), delta_E(*scaled)
        print(f"{case}: {light[k - 1] / light.sum():.2f} of the light: {ratio:.3f}, {error:.1f}")
        assert low < ratio < high
        assert error < case.max_delta_E
        centres = [np.average(at, axis=0, weights=np.maximum(picture[region], 0)) for picture in (luminance, found)]
        width = np.sqrt(np.average(((at - centres[0]) ** 2).sum(axis=1), weights=np.maximum(luminance[region], 0)))
        assert np.hypot(*(centres[1] - centres[0])) < width / 2


@pytest.mark.slow
@needs_blender
@pytest.mark.parametrize(("shape", "material"), [("plane", "Al"), ("sphere", "Au"), ("disc", "Cu")])
def test_a_metal_under_a_sky_is_as_bright_as_by_the_path_tracer(shape, material, command, tmp_path, llvm):
    shader = tmp_path / "grating.osl"
    code, _, error = command("export", f"sinusoidal,period=1.6,depth=0.15,material={material}", "-o", str(shader))
    assert code == 0, error
    bsdf = {"type": "diffraction_grating", "profile": "sinusoidal", "period": 1.6, "depth": 0.15, "material": material}
    if shape == "disc":
        bsdf["orientation"] = "radial"
    middle = np.s_[SIZE // 2 - 12 : SIZE // 2 + 12, SIZE // 2 - 12 : SIZE // 2 + 12]
    ours = path_traced(bsdf, shape, "sky", 256)[middle].mean(axis=(0, 1))
    cycles = in_cycles(shader, shape, "sky", 400, tmp_path)[middle].mean(axis=(0, 1))
    assert cycles @ SRGB_TO_XYZ[1] == pytest.approx(ours @ SRGB_TO_XYZ[1], rel=0.1)
    assert delta_E(linear_sRGB_to_XYZ(ours), linear_sRGB_to_XYZ(cycles)) < 5


@pytest.mark.slow
@needs_blender
@pytest.mark.parametrize("shape", ["plane", "sphere"])
@pytest.mark.parametrize("profile", ["sinusoidal,period=1.6,depth=0.15", "blazed,period=2.5,depth=0.25"])
def test_a_mirror_under_a_white_sky_is_no_brighter_than_the_sky(profile, shape, command, tmp_path):
    shader = tmp_path / "grating.osl"
    code, _, error = command("export", f"{profile},material=none", "-o", str(shader))
    assert code == 0, error
    picture = in_cycles(shader, shape, "sky", 400, tmp_path)
    blocks = picture.reshape(8, SIZE // 8, 8, SIZE // 8, 3).mean(axis=(1, 3))
    assert blocks.max() < 1.02 + 0.01  # and noise
    assert blocks[3:5, 3:5].mean() > 0.97
