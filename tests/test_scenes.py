"""The scenes that come with the package render, and their models are as described."""

import os
import re
import shutil
import subprocess
import sys
import warnings
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from PIL import Image
from scipy.special import j1

import mitsuba_diffraction as md
from mitsuba_diffraction.inverse_design import hologram as gratings_of
from mitsuba_diffraction.precomputation.recipe import Recipe
from mitsuba_diffraction.render import render, scene_file
from mitsuba_diffraction.render.parser_state import children_of
from mitsuba_diffraction.render.scene_file import SceneFile

ROOT = Path(__file__).parents[1]
SCENES = ROOT / "scenes"
sys.path.insert(0, str(SCENES))

import beetle  # noqa: E402
import foil  # noqa: E402
import ground  # noqa: E402
import modelling  # noqa: E402
import snake  # noqa: E402


def check(image, width, height):
    assert image.radiance.shape[:2] == (height, width)
    assert np.isfinite(image.radiance).all()
    assert image.radiance.mean() > 0


@pytest.fixture
def llvm():
    if not dr.has_backend(dr.JitBackend.LLVM):
        pytest.skip("Dr.Jit finds no LLVM")
    mi.set_variant("llvm_ad_spectral")


@pytest.mark.few(1)
@pytest.mark.parametrize("name", ["blaze", "elaphe", "projection", "screen", "xenopeltis", "xenopeltis_sphere"])
def test_scene_renders(llvm, name):
    check(render(SceneFile(SCENES / f"{name}.xml", size=(16, 16)), spp=4), 16, 16)


@pytest.mark.slow
def test_a_snake_by_taylor_terms_is_that_of_slices_with_both_integrators(llvm):
    """Means over quarters of the picture, of slices and 20 terms, by `path` and `diffraction_path`."""
    means = []
    for parameters in ({}, {"representation": "taylor", "terms": "20"}):
        parameters = {"skin": "xenopeltis_tile", "depth": "3", **parameters}
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "taylor: 20 terms", UserWarning)
            built = SceneFile(SCENES / "xenopeltis.xml", parameters, size=(48, None)).load()
        for name in ("path", "diffraction_path"):
            integrator = mi.load_dict({"type": name, "max_depth": 3})
            pictures = [mi.render(built, integrator=integrator, spp=24, seed=seed) for seed in range(8)]
            quarters = [np.array(one).sum(-1).reshape(2, 16, 2, 24).mean((1, 3)) for one in pictures]
            means.append((np.mean(quarters, 0), np.std(quarters, 0, ddof=1) / np.sqrt(8)))
    (reference, error), *others = means
    for mean, its_error in others:
        np.testing.assert_array_less(np.abs(mean - reference), 4 * np.hypot(error, its_error) + 3e-3 * reference)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "parameters"), [("spectroscope", {}), ("spectroscope", {"grating": "transmission_300"})]
)
def test_scene_of_transmitted_light_renders(llvm, name, parameters):
    check(render(SceneFile(SCENES / f"{name}.xml", parameters, size=(32, None)), spp=4), 32, 18)


ROWS = re.findall(r"^\| (`\w+\.xml`.*?) \|.*?\| (.*) \|$", (SCENES / "README.md").read_text("utf-8"), re.MULTILINE)
NAMED = {
    scene: set(re.findall(r"(?<!\w)`(\w+)`", row))
    for scenes, row in ROWS
    for scene in re.findall(r"(\w+)\.xml", scenes)
}
LIGHTS = sorted(path.stem for path in (SCENES / "lights").glob("*.xml"))


@pytest.mark.parametrize("path", sorted(SCENES.glob("*.xml")), ids=lambda path: path.stem)
def test_the_page_names_the_parameters_of_each_scene_and_every_light_goes_with_it(path, monkeypatch):
    # Regression: sun, lamp, lamps and desk_lamp had an integrator of their own, which scenes with one refused.
    monkeypatch.setattr(scene_file, "_make_models", lambda *arguments: None)
    monkeypatch.setattr(scene_file, "_refuse_missing_files", lambda *arguments: None)
    defaults = dict(re.findall(r'<default name="(\w+)" value="([^"]*)"', " ".join(path.read_text("utf-8").split())))
    defaults.pop("denoise", None)  # of the command render alone
    if path.stem == "scan":
        defaults["spectrum"] = "skin.toml"
    assert defaults.keys() <= NAMED[path.stem]
    for light in LIGHTS if "light" in NAMED[path.stem] and path.stem != "projection" else [""]:
        given = {name: light if name == "light" and light else value for name, value in defaults.items()}
        with SceneFile(path, given).parsed() as (_, state):
            kinds = [state.nodes[k].type for k in children_of(state, state.root.props).values()]
        assert kinds.count(mi.ObjectType.Integrator) == kinds.count(mi.ObjectType.Sensor) == 1, light


@pytest.mark.slow
@pytest.mark.parametrize("name", ["scan", "elaphe", "xenopeltis_sphere", "screen"])
def test_scene_of_a_scan_renders(llvm, tmp_path, name):
    """By its recipe, and by a saved spectrum where the scene requests nothing of it."""
    path, recipe = tmp_path / "spectrum.exr", tmp_path / "skin.toml"
    md.precompute(md.gratings.elaphe_synthetic(8)).save(path)
    recipe.write_text('[surface]\nprofile = "elaphe_synthetic"\nsize = 8.0\n')
    for surface in (recipe, path):
        scene = SceneFile(
            SCENES / f"{name}.xml", {"spectrum" if name == "scan" else "skin": str(surface)}, size=(16, 16)
        )
        if name == "xenopeltis_sphere" and surface is path:
            with pytest.raises(ValueError, match=r"tolerance: got 0.01 with .*spectrum.exr, wanted .* or a recipe"):
                render(scene, spp=4)
        else:
            check(render(scene, spp=4), 16, 16)


ON_ONE_CORE = """
import os
os.sched_setaffinity(0, list(os.sched_getaffinity(0))[:1])
import mitsuba_diffraction
import mitsuba as mi
import numpy as np
mi.set_variant("llvm_ad_spectral")
mi.Bitmap(np.zeros((2, 4, 1), np.float16)).write("texture.exr")
print(mi.traverse(mi.load_dict({"type": "bitmap", "filename": "texture.exr"}))["data"].shape)
"""


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="the system cannot confine a process to one core")
def test_a_picture_is_a_texture_on_one_core(llvm, tmp_path):
    program = [sys.executable, "-c", ON_ONE_CORE]
    done = subprocess.run(program, cwd=tmp_path, check=True, timeout=60, capture_output=True, text=True)
    assert done.stdout.endswith("(2, 4, 1)\n")


# ---------------------------------------------------------------- scenes with models


PICTURES = [
    ("snake", {"skin": "xenopeltis", "light": "sun"}),
    ("compact_disc", {"light": "desk_lamp"}),
    ("foil", {"light": "desk_lamp"}),
    ("snake", {"skin": "elaphe", "light": "lamp"}),
    ("compact_disc", {"light": "sun"}),
    ("foil", {"light": "sun"}),
    ("hologram", {}),
    ("hologram", {"card": "clear"}),
    ("anodised", {}),
    ("beetle", {}),
    ("rainbow", {}),
    ("window", {}),
    ("glasses", {}),
]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "parameters"), PICTURES)
def test_scene_with_models_renders(llvm, small_scenes, name, parameters):
    check(render(SceneFile(small_scenes / f"{name}.xml", parameters, size=(32, None)), spp=4), 32, 18)


def hit(small_scenes, name, origins, directions):
    """Where rays meet a mesh: Mitsuba's interaction, in the scalar variant one by one."""
    mi.set_variant("scalar_spectral")
    scene = mi.load_dict({"type": "scene", "m": {"type": "ply", "filename": str(small_scenes / "models" / name)}})
    found = [scene.ray_intersect(mi.Ray3f(o, d)) for o, d in zip(origins, directions, strict=True)]
    assert all(si.is_valid() for si in found)
    return found


# ---------------------------------------------------------------- the hologram


@pytest.mark.parametrize("width", [16.0, 6.0])
def test_stripes_of_the_hologram_diffract_their_colours_from_the_lamp_to_the_eye(width):
    """By the grating equation; as bright as they should be by J_1²."""
    light, eye = np.array(gratings_of.LIGHT), np.array(gratings_of.EYE)
    brightness = np.random.default_rng(0).random((4, 6, 3))
    lateral, heights, turn = (x.ravel() for x in gratings_of.stripes(brightness, width))
    pixel = width / 18
    y, x = np.mgrid[:4, :18]
    points = np.stack([(x + 0.5) * pixel - width / 2, (1.5 - y) * 3 * pixel, 0 * x], -1).reshape(-1, 3)
    to_light, to_eye = (gratings_of.directions(points, there) for there in (light, eye))
    turn, wavelength = np.deg2rad(turn), np.tile(gratings_of.STRIPE_WAVELENGTHS, 24)
    diffracted = (wavelength / (lateral * gratings_of.PERIOD))[:, None] * np.stack([np.cos(turn), np.sin(turn)], -1)
    np.testing.assert_allclose(-to_light[:, :2] - diffracted, to_eye[:, :2], atol=1e-12)
    kappa = 2 * np.pi * (to_light[:, 2] + to_eye[:, 2]) / wavelength
    fraction = j1(kappa * heights * gratings_of.DEPTH / 2) ** 2
    np.testing.assert_allclose(fraction / 0.3386, brightness.ravel(), atol=2e-3)


def test_a_picture_keeps_its_proportions_in_the_middle_of_the_hologram(tmp_path):
    """A portrait, its upper left quarter red and its lower right quarter transparent."""
    picture = np.full((30, 20, 4), 255, np.uint8)
    picture[:15, :10, 1:3] = 0
    picture[15:, 10:, 3] = 0
    Image.fromarray(picture).save(tmp_path / "portrait.png")
    linear = gratings_of.fitted(tmp_path / "portrait.png", 64)
    assert linear.shape == (36, 64, 3)
    left, right = 20, 44  # 24 of 64 columns, as 36 · 20/30 = 24
    assert not linear[:, :left].any()
    assert not linear[:, right:].any()
    np.testing.assert_allclose(linear[4:14, left + 2 : left + 8], np.full((10, 6, 3), [1, 0, 0]), atol=1e-9)
    np.testing.assert_allclose(linear[4:14, right - 8 : right - 2], 1)
    assert not linear[22:32, right - 8 : right - 2].any()
    lateral, heights, _ = gratings_of.write(tmp_path / "portrait.png", tmp_path, columns=64)
    assert heights.shape == (36, 192)
    assert not heights[:, : 3 * left].any()
    for path, values in zip(gratings_of.textures_in(tmp_path), (lateral, heights), strict=False):
        # Mitsuba reads the first row of the file at v = 0, the bottom of the card.
        np.testing.assert_allclose(np.squeeze(mi.Bitmap(str(path))), values[::-1], rtol=1e-3, atol=1e-4)
    with pytest.raises(ValueError, match="not a picture that can be read"):
        gratings_of.fitted(SCENES / "hologram.xml", 64)


def test_models_are_made_when_a_scene_is_first_read(tmp_path, monkeypatch):
    """By the scripts of the package, not by those beside the scene; files that exist are kept."""
    package, own = tmp_path / "package" / "scenes", tmp_path / "scenes"
    package.mkdir(parents=True)
    (package / "disc.py").write_text(
        "import random\ndef make(folder):\n    for name in 'ab':\n        (folder / f'{name}.png').write_text(name)\n"
    )
    # The modules of the folder in which the program is started are the user's.
    monkeypatch.chdir(tmp_path)
    Path("random.py").write_text("raise SystemExit('nor this')")
    Path("pathlib.py").write_text("raise SystemExit('nor this')")
    (own / "models").mkdir(parents=True)
    (own / "disc.py").write_text("raise SystemExit('this must not run')")
    (own / "models" / "b.png").write_text("mine")
    texture = '<texture type="bitmap" id="t"><string name="filename" value="models/a.png"/></texture>'
    scene = own / "scene.xml"
    scene.write_text(f'<scene version="3.0.0"><!-- made by: python scenes/disc.py -->{texture}</scene>')
    monkeypatch.setattr(scene_file, "examples_folder", lambda: package.parent)
    assert scene in SceneFile(scene).files()
    assert [(own / "models" / f"{name}.png").read_text() for name in "ab"] == ["a", "mine"]
    scene.write_text(scene.read_text().replace("a.png", "c.png"))
    with pytest.raises(ValueError, match=r"models/c.png: no such file; it is made by: python scenes/disc.py"):
        SceneFile(scene).files()


def test_load_file_makes_models_too(tmp_path, monkeypatch, llvm):
    for folder in ("package/scenes", "scenes"):
        (tmp_path / folder).mkdir(parents=True)
    maker = "from PIL import Image\ndef make(folder):\n    Image.new('L', (2, 2)).save(folder / 'a.png')\n"
    (tmp_path / "package" / "scenes" / "disc.py").write_text(maker)
    monkeypatch.setattr(scene_file, "examples_folder", lambda: tmp_path / "package")
    texture = '<texture type="bitmap" id="t"><string name="filename" value="models/$name.png"/></texture>'
    scene = tmp_path / "scenes" / "scene.xml"
    scene.write_text(f'<scene version="3.0.0"><!-- made by: python scenes/disc.py -->{texture}</scene>')
    assert isinstance(mi.load_file(str(scene), parallel=False, name="a"), mi.Scene)
    assert (tmp_path / "scenes" / "models" / "a.png").is_file()
    with pytest.raises(RuntimeError, match=r"models/b.png: no such file; it is made by: python scenes/disc.py"):
        mi.load_file(str(scene), name="b")


@pytest.mark.posix("symbolic links without a privilege")
def test_a_scene_names_every_script_that_makes_its_files(tmp_path, monkeypatch):
    shutil.copytree(SCENES, tmp_path / "scenes", ignore=shutil.ignore_patterns("models", "out", "gallery.npz"))
    (tmp_path / "precompute").symlink_to(ROOT / "precompute")
    monkeypatch.setattr(scene_file, "examples_folder", lambda: tmp_path / "nowhere")
    found = 0
    for path in (tmp_path / "scenes").glob("*.xml"):
        text = path.read_text()
        if "made by:" not in text:
            continue
        commands = " ".join(text.partition("made by:")[2].split()).partition(" -->")[0]
        wanted = re.match(r"(?:python scenes/\w+\.py(?: && )?)+", commands)[0]
        with pytest.raises(ValueError, match="it is made by: ") as raised:
            SceneFile(path).files()
        assert str(raised.value).endswith(wanted.strip(" &"))
        found += 1
    assert found > 6


def test_a_surface_by_its_name_is_part_of_the_scenes_digest(tmp_path, monkeypatch):
    scene = tmp_path / "scene.xml"
    scene.write_text(
        '<scene version="3.0.0"><bsdf type="diffraction_grating" id="g">'
        '<string name="filename" value="elaphe_afm"/></bsdf></scene>'
    )
    names = {path.name for path in SceneFile(scene).files()}
    assert {"elaphe_afm.toml", "elaphe_afm_100x100.png"} <= names
    before = SceneFile(scene).digest()
    monkeypatch.setattr(Recipe, "digest", lambda recipe: "another")
    assert SceneFile(scene).digest() != before


# ---------------------------------------------------------------- the beetle


def test_beetle_stands_on_the_ground_with_its_elytra_apart():
    left, right = beetle.elytron(90, 1), beetle.elytron(90, -1)
    np.testing.assert_allclose(right[0][::-1] * [1, -1, 1], left[0], atol=1e-12)
    assert left[0][..., 1].min() > 0
    lowest = [points[..., 2].min() for points, _, _ in beetle.body()]
    # Six legs touch it, and nothing else does.
    assert min(lowest) > -0.01
    assert sum(z < 0.02 for z in lowest) == 6
    for points, u, v in (left, right, beetle.pronotum(90)):
        assert min(np.diff(u).min(), np.diff(v).min()) > 0
        outwards = points - [0, 0, beetle.AXIS / 2]
        outwards[..., 0] = 0
        normal = np.cross(np.gradient(points, axis=1), np.gradient(points, axis=0))
        assert np.mean((normal * outwards).sum(-1) > 0) > 0.97


def test_stripes_of_the_beetle_reflect_at_700_nm_and_the_rest_at_530_nm():
    text = (SCENES / "beetle.xml").read_text()
    for name, wanted in (("ior", (1.7, 1.6)), ("thickness", [0.53 / (4 * n) for n in (1.7, 1.6)])):
        found = re.findall(rf'thin_film_{name}" value="8 x \(([\d.]+), ([\d.]+)\)"', text)
        assert len(found) == 2
        np.testing.assert_allclose(np.array(found, float), [wanted] * 2, rtol=1e-3)
    factor = beetle.stripes(*np.meshgrid(np.linspace(0.2, 0.9, 50), np.linspace(0, 1, 501)))
    assert factor.min() == 1
    assert factor.max() == pytest.approx(0.7 / 0.53)
    assert 0.15 < np.mean(factor > 1.3) < 0.35


# ---------------------------------------------------------------- the snake


@pytest.mark.slow
def test_snake_lies_on_the_ground_and_not_in_itself():
    nodes = snake.centre_line()
    s = np.linspace(0, snake.LENGTH, len(nodes))
    width, height = snake.half_axes(s)
    assert (nodes[:, 2] - height).min() > -0.05
    # It does lie: a good part touches the ground.
    assert np.mean(nodes[:, 2] - height < 0.1) > 0.2
    distance = np.linalg.norm(nodes[:, None] - nodes, axis=-1)
    apart = width[:, None] + width
    far = np.abs(s[:, None] - s) > 2.5 * apart
    assert (apart - distance)[far].max() < 0.05
    # A coil turns by more than two turns in all.
    tangent = np.diff(nodes[:, :2], axis=0)
    turned = np.unwrap(np.arctan2(tangent[:, 1], tangent[:, 0]))
    assert abs(turned[-1] - turned[0]) > 4 * np.pi


def test_snake_tapers():
    s = np.linspace(0, snake.LENGTH, 400)
    width, height = snake.half_axes(s)
    assert width.max() == pytest.approx(1.04 * snake.RADIUS, rel=0.03)
    assert width[0] < 0.05
    assert width[-1] < 0.1 * snake.RADIUS
    assert np.all(np.diff(width[s < 0.4 * snake.LENGTH]) > 0)
    assert np.all((width >= 0.9 * height) & (height >= 0.3 * width))


def test_snake_has_coordinates_along_the_body(small_scenes):
    nodes = snake.centre_line()
    # From above onto the top coil and the outer one, away from tail and head.
    places = [60, 120, 200, 230]
    for index, si in zip(
        places,
        hit(small_scenes, "snake.ply", [nodes[i] + [0, 0, 1.2 * snake.RADIUS] for i in places], [[0, 0, -1]] * 4),
        strict=True,
    ):
        tangent = nodes[index + 1] - nodes[index - 1]
        tangent /= np.linalg.norm(tangent)
        along, around = (np.array(v) / np.linalg.norm(v) for v in (si.dp_du, si.dp_dv))
        assert along @ tangent > 0.97
        assert abs(si.uv[1] - 0.5) < 0.06
        normal = np.array(si.sh_frame.n)
        assert normal[2] > 0.85
        assert np.cross(along, around) @ normal > 0.95


@pytest.fixture(scope="module")
def scales():
    sweep = snake.Sweep.along(2000)
    return {name: snake.texels(sweep, skin, 1280) for name, skin in snake.SKINS.items()}


@pytest.mark.parametrize("name", sorted(snake.SKINS))
def test_snake_wears_scales(scales, name):
    skin, texels = snake.SKINS[name], scales[name]
    body = (texels.s[0] > 40) & (texels.s[0] < 100)
    # Every texel belongs to a scale: nothing shows between them.
    assert texels.edge[:, body].max() <= 1
    assert np.mean(texels.edge[:, body] < 0.8) > 0.4
    column = texels.number[:, np.flatnonzero(body)[0]]
    rows = 1 + np.count_nonzero(np.diff(column))
    # A line round the body crosses every second row of the staggered hexagons, and some of those between.
    assert 0.4 * skin.rows < rows < skin.rows
    # The back's scales rise towards their tips, and both sides of the back are alike.
    assert np.abs(texels.slope_v[:, body].mean()) < 0.02
    normals = 2 * snake.normals_from_slopes(texels.slope_u, texels.slope_v) - 1
    np.testing.assert_allclose(np.linalg.norm(normals, axis=-1), 1, rtol=1e-5)
    assert np.rad2deg(np.arccos(normals[..., 2].min())) < 60


def test_microstructure_turns_from_scale_to_scale(scales):
    texels = scales["xenopeltis"]
    turn = snake.per_scale(texels, 3)
    first = np.unique(texels.number, return_index=True)[1]
    values = turn.ravel()[first]
    assert values.size > 1000
    assert values.std() == pytest.approx(1, rel=0.1)
    for number in texels.number.ravel()[first][::300]:
        assert np.ptp(turn[texels.number == number]) == 0


def test_snakes_have_their_colours(scales):
    for name, texels in scales.items():
        colour = snake.pigment(name, texels)
        back, belly = colour[np.abs(texels.v[:, 0] - 0.5) < 0.1], colour[texels.v[:, 0] < 0.05]
        assert back.mean((0, 1)).sum() < belly.mean((0, 1)).sum()
        if name == "elaphe":
            assert back[..., 0].mean() > 2 * back[..., 2].mean()
        else:
            assert back.mean() < 0.25


def test_textures_lie_as_their_arrays_say(tmp_path, llvm):
    """Numbers from v = 0, colours from the top, as Mitsuba reads their files."""
    numbers = np.array([[0.1, 0.2], [0.3, 0.4], [0.5, 0.6]])
    modelling.write_numbers(tmp_path / "numbers.exr", numbers)
    modelling.write_colours(tmp_path / "colours.png", np.tile(numbers[..., None], 3))
    for name, rows in (("numbers.exr", [0, 1, 2]), ("colours.png", [2, 1, 0])):
        file = {"type": "bitmap", "filename": str(tmp_path / name), "raw": True, "filter_type": "nearest"}
        si = dr.zeros(mi.SurfaceInteraction3f, 3)
        si.uv = mi.Point2f(0.25, mi.Float([0.5 / 3, 1.5 / 3, 2.5 / 3]))
        np.testing.assert_allclose(mi.load_dict(file).eval_1(si), numbers[rows, 0], atol=2e-3)


@pytest.mark.parametrize("name", sorted(snake.SKINS))
def test_scales_are_domes(name, llvm):
    """On both sides of the middle of a scale at the back, normals point outwards, and those of its rim the most."""
    texture = {"type": "bitmap", "filename": str(SCENES / f"coil/{name}_normals.exr"), "raw": True}
    texels = snake.texels(snake.Sweep.along(800), snake.SKINS[name], 1280)
    middle = (texels.edge < 0.1) & (np.abs(texels.v - 0.5) < 0.2) & (texels.s > 40) & (texels.s < 100)
    row, column = np.nonzero(middle)
    assert len(row) > 200
    si = dr.zeros(mi.SurfaceInteraction3f, len(row))
    towards = []
    for of_scale in (-0.8, -0.3, 0.3, 0.8):
        v = texels.v[row, 0] + of_scale / snake.SKINS[name].rows
        si.uv = mi.Point2f((column + 0.5) / 1280, v)
        towards.append(np.mean(2 * np.array(mi.load_dict(texture).eval_3(si))[1] - 1))
    assert towards[0] < towards[1] < -0.01
    assert 0.01 < towards[2] < towards[3]


@pytest.mark.slow
def test_models_are_the_same_each_time(tmp_path):
    files = []
    for folder in (tmp_path / "a", tmp_path / "b"):
        folder.mkdir()
        snake.centre_line.cache_clear()
        snake.make(folder, columns=160)
        files.append({path.name: path.read_bytes() for path in folder.iterdir()})
    assert files[0] == files[1]
    assert len(files[0]) == 8


@pytest.mark.slow
def test_the_small_models_are_those_of_the_script(tmp_path):
    snake.small(tmp_path)
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == sorted(path.name for path in (SCENES / "coil").iterdir())
    mi.set_variant("scalar_rgb")
    for name in names:
        folders = SCENES / "coil", tmp_path
        if name.endswith(".ply"):
            meshes = [mi.load_dict({"type": "ply", "filename": str(folder / name)}) for folder in folders]
            kept, made = (np.array(mesh.vertex_positions_buffer()) for mesh in meshes)
            np.testing.assert_allclose(kept, made, atol=1e-3)
        else:
            kept, made = (np.array(mi.Bitmap(str(folder / name))) for folder in folders)
            # The edge of a scale may round to the next texel.
            assert np.mean(np.abs(kept.astype(float) - made) > 1e-3) < 1e-3


# ---------------------------------------------------------------- disc and foil


def test_tracks_run_round_the_disc(small_scenes):
    angles = np.linspace(0.1, 6.2, 9)
    places = 4.0 * np.stack([np.cos(angles), np.sin(angles), 0 * angles], -1)
    for place, si in zip(
        places, hit(small_scenes, "disc_metal.ply", places + np.array([0, 0, 1]), [[0, 0, -1]] * 9), strict=True
    ):
        outwards = np.array(si.dp_du) / np.linalg.norm(si.dp_du)
        # Corners of a circle of 64 are 5.6° apart.
        assert outwards @ (place / 4) > np.cos(np.deg2rad(6))
        assert si.n[2] > 0.99
    mi.set_variant("scalar_spectral")
    scene = mi.load_dict(
        {"type": "scene", "m": {"type": "ply", "filename": str(small_scenes / "models" / "disc_metal.ply")}}
    )
    for radius in (1.0, 2.2, 5.95):
        assert not scene.ray_intersect(mi.Ray3f([radius, 0.01, 1], [0, 0, -1])).is_valid()


def test_foil_keeps_its_size():
    places, _, _ = foil.sheet(200)
    # Crumpling and curling bend the sheet, but stretch it little.
    length = np.linalg.norm(np.diff(places, axis=1), axis=-1).sum(1)
    assert np.all(np.abs(length / foil.WIDTH - 1) < 0.03)
    assert places[..., 2].min() == 0
    assert places[..., 2].max() > 2


def test_foil_is_embossed_with_shards():
    turn, pitch = foil.shards(np.random.default_rng(6), 300)
    assert set(np.unique(pitch)) == set(foil.PITCHES)
    values, counts = np.unique(turn, return_counts=True)
    assert 0.9 * foil.SHARDS < values.size <= foil.SHARDS
    assert values.min() >= 0
    assert values.max() <= 180
    assert counts.max() < 0.02 * turn.size


def test_the_ground_texture_tiles():
    colour = ground.stone(np.random.default_rng(1), 128)
    inside = np.abs(np.diff(colour, axis=1)).mean()
    assert np.abs(colour[:, 0] - colour[:, -1]).mean() < 2 * inside


# ---------------------------------------------------------------- the spectrometer and the spectroscope


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "screen", "lines_per_mm", "offset", "lines", "parameters"),
    [
        ("spectrometer", 50, 1200, 0.5, (404.66, 435.83, 546.07), {"daylight": "1e-12"}),
        (
            "spectrometer",
            50,
            1200,
            0.5,
            (589.3,),
            {"lines": "587.99:0, 588.99:2, 589.29:1.9, 589.59:1, 590.59:0", "daylight": "1e-12"},
        ),
        ("spectroscope", 40, 600, 0, (404.66, 435.83, 546.07), {}),
    ],
    ids=["mercury", "sodium", "transmission"],
)
def test_lines_are_where_the_grating_equation_has_them(llvm, name, screen, lines_per_mm, offset, lines, parameters):
    path, size = SCENES / f"{name}.xml", (320, 180)
    parameters = {"room": "1e-12", **parameters}
    image = render(SceneFile(path, parameters, size=(size[0], size[1])), spp=16)
    built = SceneFile(path, parameters, size=(size[0], size[1])).load()
    pixel = dr.arange(mi.UInt32, size[0] * size[1])
    at = mi.Point2f(pixel % size[0], pixel // size[0]) + 0.5
    ray, _ = built.sensors()[0].sample_ray(0, 0.5, at / mi.Point2f(size), mi.Point2f(0.5))
    si = built.ray_intersect(ray)
    x, y = (np.array(axis).reshape(size[::-1]) for axis in (si.p.x, si.p.y))
    on_screen = np.abs(y - screen) < 1e-3
    period = 1e6 / lines_per_mm  # nm
    for line in lines:
        in_line = np.abs(image.wavelengths - line) < 5
        light = np.where(on_screen, image.radiance[..., in_line].sum(-1), 0)
        expected = screen * np.tan(np.arcsin(line / period - offset))
        light[np.abs(x - expected) > 1.5] = 0  # what the screen and the table scatter
        mean = (x * light).sum() / light.sum()
        measured = period * (np.sin(np.arctan(mean / screen)) + offset)
        assert measured == pytest.approx(line, rel=0.005), line


@pytest.mark.parametrize(("work", "code"), [("print", 0), ("int", 1)])
def test_the_script_of_blender_does_not_wait_for_exit_handlers(tmp_path, work, code):
    """Those of Blender 4.5 as a module do not return once Mitsuba is imported; here modules take the place of both."""
    (tmp_path / "bpy.py").write_text("import atexit, time; atexit.register(time.sleep, 1000)")
    (tmp_path / "mitsuba.py").touch()
    (tmp_path / "mathutils.py").write_text("Euler = Vector = None")
    program = f"import blender; blender.main = {work}; blender.run('of the scene', 'exported')"
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), str(SCENES)])}
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, env=environment, timeout=60)
    assert done.returncode == code
    assert done.stdout == ("" if code else "of the scene exported\n")  # in a pipe, so that it has to be flushed
    assert ("Traceback" in done.stderr) == bool(code)
