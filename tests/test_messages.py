"""What a wrong scene is told: not only what is missing, but what there is."""

import ast
from pathlib import Path

import mitsuba as mi
import pytest

import mitsuba_diffraction
from mitsuba_diffraction.render.scene import load_spectral_scene

pytestmark = pytest.mark.usefixtures("no_energy_tables")

SCENE = """<scene version="3.0.0"><default name="light" value="sun"/><include filename="lights/$light.xml"/>
<sensor type="perspective"/><shape type="sphere">%s</shape></scene>"""
GRATING = '<bsdf type="diffraction_grating">%s</bsdf>'
BLAZED = '<string name="profile" value="blazed"/><float name="period" value="2.5"/><float name="depth" value="0.25"/>'


@pytest.mark.parametrize(
    ("body", "parameters", "words"),
    [
        ("", {"light": "moon"}, "lights holds lamp, sun"),
        ("", {"lamp": "moon"}, "the scene's parameters are light"),
        (GRATING % '<string name="filename" value="gone.exr"/>', {}, r"gone.exr: no such file; .* holds skin.exr"),
        (
            GRATING % (BLAZED + '<string name="material" value="Alu"/>'),
            {},
            r"'Alu', did you mean Al or .*of Ag, Al, ",
        ),
        (GRATING % (BLAZED + '<bsdf type="diffuse"/>'), {}, 'wanted <bsdf name="base"'),
        (GRATING % (BLAZED + '<string name="height_scale" value="a"/>'), {}, "height_scale: got 'a', wanted a number"),
        (GRATING % '<float name="filename" value="1"/>', {}, r"filename: got 1.0, wanted a saved spectrum"),
        (GRATING % '<string name="filename" value="$skin"/>', {}, r"undefined parameter: \$skin; set it by -D skin=…"),
        (GRATING % (BLAZED + '<string name="theory" value="exact"/>'), {}, "theory: got 'exact', wanted one of scalar"),
        (
            GRATING % '<string name="filename" value="skin.exr"/><float name="tolerance" value="0.1"/>',
            {},
            "tolerance: got 0.1.* with .*skin.exr, wanted it when the spectrum is computed",
        ),
    ],
)
def test_what_there_is_is_said(body, parameters, words, tmp_path, llvm):
    (tmp_path / "lights").mkdir()
    for name in ("sun", "lamp"):
        (tmp_path / "lights" / f"{name}.xml").write_text('<scene version="3.0.0"><emitter type="constant"/></scene>')
    (tmp_path / "skin.exr").touch()
    (tmp_path / "scene.xml").write_text(SCENE % body)
    with pytest.raises(ValueError, match=words):
        load_spectral_scene(tmp_path / "scene.xml", parameters=parameters)


def test_wrong_requests_have_a_class_of_their_own():
    """A plain ValueError is told as a bug."""
    for path in Path(mitsuba_diffraction.__file__).parent.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call):
                assert ast.unparse(node.exc.func) != "ValueError", f"{path.name}:{node.lineno}"


def test_a_scene_sets_the_tolerance_of_a_recipe(tmp_path, llvm):
    recipe = tmp_path / "blaze.toml"
    recipe.write_text('[surface]\nprofile = "blazed"\nperiod = 2.5\ndepth = 0.25\n')
    grating = {"type": "diffraction_grating", "filename": str(recipe), "material": "Al"}
    assert mi.load_dict(grating).spectrum.tolerance == 1e-3
    assert mi.load_dict({**grating, "tolerance": 0.05}).spectrum.tolerance == pytest.approx(0.05)


@pytest.mark.slow
def test_every_material_of_mitsuba_is_known(llvm):
    for material in ("Al", "Au", "none", "Cr", "a-C", "TiO2_palik"):
        mi.load_dict({"type": "diffraction_grating", "profile": "blazed", "period": 2.5, "depth": 0.25,
                      "tolerance": 0.05, "coherence_length": 5.0, "material": material})  # fmt: skip
