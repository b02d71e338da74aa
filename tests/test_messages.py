"""Error messages: they name what is missing or wrong, and what is available."""

import ast
import re
import shutil
from pathlib import Path

import mitsuba as mi
import pytest

import mitsuba_diffraction
from mitsuba_diffraction import progress
from mitsuba_diffraction.precomputation.recipe import Recipe
from mitsuba_diffraction.render.scene_file import SceneFile

SCENES = Path(__file__).parents[1] / "scenes"
SCENE = """<scene version="3.0.0"><default name="light" value="sun"/><include filename="lights/$light.xml"/>
<sensor type="perspective"/><shape type="sphere">%s</shape></scene>"""
GRATING = '<bsdf type="diffraction_grating">%s</bsdf>'
BLAZED = '<string name="profile" value="blazed"/><float name="period" value="2.5"/><float name="depth" value="0.25"/>'


WORDS = {
    r"light (that|which) (passes|comes|goes|is sent)": "transmitted, incident or outgoing light",
    r"pass(es|ing)? off": "an order at its Rayleigh anomaly",
    r"by as much again": "by the same factor",
    r"(a|the|its|their) share of (the )?(light|power)": "a fraction",
}
"""Patterns that are not terms of optics, and what to write."""


@pytest.mark.parametrize(
    ("body", "parameters", "words"),
    [
        ("", {"light": "moon"}, "lights holds lamp, sun"),
        ("", {}, 'the scene has no integrator, wanted one, such as <integrator type="path"/>'),
        ("", {"lamp": "moon"}, "the scene's parameters are light"),
        ('<bsdf type="difraction_grating"/>', {}, '"difraction_grating" not found!; did you mean diffraction_grating'),
        (GRATING % '<string name="filename" value="gone.exr"/>', {}, r"gone.exr: no such file; .* holds skin.exr"),
        (
            GRATING % (BLAZED + '<string name="material" value="Alu"/>'),
            {},
            r"'Alu', did you mean Al; none is the perfect mirror",
        ),
        (GRATING % (BLAZED + '<bsdf type="diffuse"/>'), {}, 'wanted <bsdf name="base"'),
        (GRATING % (BLAZED + '<string name="height_scale" value="a"/>'), {}, "height_scale: got 'a', wanted a number"),
        (GRATING % '<float name="filename" value="1"/>', {}, r"filename: got 1.0, wanted a saved spectrum"),
        (GRATING % '<string name="filename" value="$skin"/>', {}, r"undefined parameter: \$skin; set it by -D skin=…"),
        (
            GRATING % '<string name="filename" value="$skin"/>',
            {"skn": "elaphe"},
            r"undefined parameter: \$skin; set it by -D skin=… instead of skn",
        ),
        (GRATING % (BLAZED + '<string name="theory" value="exact"/>'), {}, "theory: got 'exact', wanted one of scalar"),
        (
            GRATING % '<string name="filename" value="skin.exr"/><float name="tolerance" value="0.1"/>',
            {},
            "tolerance: got 0.1.* with .*skin.exr, wanted it when the spectrum is computed",
        ),
    ],
)
def test_messages_name_what_is_available(body, parameters, words, tmp_path, llvm):
    (tmp_path / "lights").mkdir()
    for name in ("sun", "lamp"):
        (tmp_path / "lights" / f"{name}.xml").write_text('<scene version="3.0.0"><emitter type="constant"/></scene>')
    (tmp_path / "skin.exr").touch()
    (tmp_path / "scene.xml").write_text(SCENE % body)
    with pytest.raises(ValueError, match=words):
        SceneFile(tmp_path / "scene.xml", parameters).load()


@pytest.mark.parametrize(
    ("line", "message"),
    [
        (
            "compare scenes/xenopeltis_sphere.xml -D light=strip_along_x",
            "shader knows no other; choose -D light=bulb or -D light=parallel or -D light=sun",
        ),
        (
            "compare precompute/measured/scan.npz",
            "SCENE: got precompute/measured/scan.npz, wanted a file name that ends in .xml or .toml",
        ),
        (
            "compare scenes/blaze.xml -D light=bulb --shader flss --shader stam",
            "shader: got 'stam', wanted one of flss, nmm, pq, nmm_pq, gem",
        ),
        (
            "convergence scenes/blaze.xml -o out.png",
            "shader knows no other; choose -D light=bulb or -D light=parallel or -D light=sun",
        ),
        ("render scenes/blaze.blend", "got a file of Blender, wanted a scene (.xml), which Mitsuba-Blender exports"),
        ("render moved/scan.xml", "moved/scan.xml: no such file; mitsuba-diffraction examples writes it"),
        ("inspect scan.png --jason a.json", "(try mitsuba-diffraction inspect --help)"),
        (
            "render scenes/lights",
            "wanted a scene (.xml); this folder holds bulb.xml, desk_lamp.xml, lamp.xml, lamps.xml, "
            "parallel.xml, strip_along_x.xml, strip_along_y.xml, sun.xml",
        ),
        ("render scenes/scan.xml -D spectrum=compact_disk", "did you mean compact_disc?"),
        ("render scenes/blaze.xml --material surface=compact_disk", "did you mean compact_disc?"),
        *(
            (f"{name} compact_disk", "compact_disk: no file and no surface has this name; did you mean compact_disc?")
            for name in ("inspect", "precompute", "view", "efficiency", "validate")
        ),
    ],
)
def test_gaps_of_a_scene_are_reported_before_spectra_are_computed(line, message, command, tmp_path, monkeypatch, llvm):
    shutil.copytree(SCENES, tmp_path / "scenes", ignore=shutil.ignore_patterns("models", "*.npz"))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(Recipe, "cached", lambda *args: pytest.fail("a spectrum was computed"))
    code, out, err = command(line)
    assert (code, out) == (2, "")
    assert len(err.splitlines()) == 1
    assert err.endswith(f"{message}\n")


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"material": "Aluminium"}, "material: got 'Aluminium', did you mean Al; none is the perfect mirror, R = 1"),
        ({"material": "silver"}, "material: got 'silver', did you mean Ag; none is the perfect mirror, R = 1"),
        ({"material": "Nickel"}, "material: got 'Nickel', did you mean Ni_palik; none is the perfect mirror, R = 1"),
        ({"material": "Al_palik"}, "material: got 'Al_palik', did you mean Al; none is the perfect mirror, R = 1"),
        ({"material": [1.0, 2, 3]}, "material: got [1, 2, 3], wanted the name of a conductor, such as 'Al', or 'none'"),
        ({"coat_ior": [1.0, 2, 3]}, "coat_ior: got [1, 2, 3], wanted a positive index of refraction, or a name such "),
        ({"int_ior": True}, "int_ior: got True, wanted a positive index of refraction, or a name such as 'bk7'"),
        ({"int_ior": "bk8"}, "int_ior: got 'bk8', wanted a number, a file or one of BK7, fused_silica, "),
        ({"height_scale": True}, "height_scale: got True, wanted a number"),
        ({"profile": "blaze"}, "profile: got 'blaze', wanted one of blazed, sinusoidal, "),
    ],
)
def test_loaders_refuse_in_one_line(parameters, message, tmp_path, llvm):
    grating = {"type": "diffraction_grating", "profile": "blazed", "period": 2.5, "depth": 0.25, **parameters}
    with pytest.raises(RuntimeError) as caught:
        mi.load_dict({"type": "scene", "shape": {"type": "sphere", "bsdf": grating}})
    assert str(caught.value).startswith(f'diffraction_grating at dictionary node "shape.bsdf": {message}')
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 400


def test_xml_is_refused_in_one_line_too(tmp_path, llvm):
    text = f'<scene version="3.0.0">{GRATING}</scene>' % '<string name="profile" value="blaze"/>'
    (tmp_path / "scene.xml").write_text(text)
    for load, source in ((mi.load_string, text), (mi.load_file, str(tmp_path / "scene.xml"))):
        with pytest.raises(RuntimeError, match=r"^diffraction_grating at [^\n]*: profile: got 'blaze', wanted [^\n]*$"):
            load(source)


def test_a_bug_keeps_its_traceback(monkeypatch, llvm):
    monkeypatch.setattr("mitsuba_diffraction.bsdf.parameters.Recipe.of_profile", None)
    with pytest.raises(RuntimeError, match=r"Traceback(.|\n)*TypeError: 'NoneType' object is not callable"):
        mi.load_dict({"type": "diffraction_grating", "profile": "blazed", "period": 2.5, "depth": 0.25})


@pytest.mark.slow
def test_the_log_is_plain_text(caplog, capfd, llvm, command, monkeypatch, tmp_path):
    """One line each, without colours and places in the code; Mitsuba's own log has both, in files too."""
    monkeypatch.setattr(progress, "MIN_REPORTED_SECONDS", 1e6)  # a slow machine says how far it is
    monkeypatch.setattr(progress, "log_lines", lambda *label: lambda *done: None)
    start = "diffraction_grating, blazed grating, period 0.8 µm, depth 0.4"
    bsdf = {"type": "diffraction_grating", "profile": "blazed", "period": 0.8, "depth": 0.4}
    mi.load_dict({"type": "scene", "sensor": {"type": "perspective"}, "plate": {"type": "rectangle", "bsdf": bsdf}})
    assert [record.getMessage().startswith(start) for record in caplog.records] == [True]
    assert "".join(capfd.readouterr()) == ""
    # Of each surface there is one warning.
    body = BLAZED.replace("2.5", "0.8").replace("0.25", "0.45")
    (tmp_path / "lights").mkdir()
    (tmp_path / "lights" / "sun.xml").write_text('<scene version="3.0.0"><emitter type="constant"/></scene>')
    scene = (SCENE % GRATING % body).replace("<sensor", '<integrator type="path"/><sensor')
    (tmp_path / "scene.xml").write_text(scene)
    output = tmp_path / "scene.exr"
    code, _, err = command("render", str(tmp_path / "scene.xml"), "-o", str(output), "--width", "4", "--spp", "1")
    assert code == 0, err
    assert f"mitsuba-diffraction: warning: {start}5" in err
    assert "\x1b" not in err


def test_wrong_requests_have_a_class_of_their_own():
    """A plain ValueError is reported as a bug."""
    for path in Path(mitsuba_diffraction.__file__).parent.rglob("*.py"):
        if "assets" in path.parts:  # code for other programs
            continue
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
        bsdf = mi.load_dict({"type": "diffraction_grating", "profile": "blazed", "period": 2.5, "depth": 0.25,
                             "tolerance": 0.05, "coherence_length": 5.0, "material": material})  # fmt: skip
        assert f"reflectance = {'none (R = 1)' if material == 'none' else f'conductor, {material}'}" in str(bsdf)


def test_texts_have_the_terms_of_optics():
    root = Path(mitsuba_diffraction.__file__).parent
    paths = [path for path in root.rglob("*.py") if "assets" not in path.parts]
    for folder in ("", "docs", "precompute", "scenes", "notebooks"):
        paths += (SCENES.parent / folder).glob("*.md")
    assert len(paths) > 200
    for path in paths:
        text = " ".join(path.read_text(encoding="utf-8").split())
        for pattern, better in WORDS.items():
            assert not (found := re.search(rf"\b{pattern}\b", text)), f"{path.name}: {found[0]!r}, wanted {better}"
