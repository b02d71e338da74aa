"""Gratings that replace BSDFs in scenes exported by other programs."""

import logging
import re
from pathlib import Path
from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest
from bsdf_support import made_up

from mitsuba_diffraction.bsdf.mitsuba_internals import has_uvs
from mitsuba_diffraction.cli.arguments import replacements_of
from mitsuba_diffraction.render import render
from mitsuba_diffraction.render.scene import warn_of_gratings
from mitsuba_diffraction.render.scene_file import SceneFile

MIRROR = {"profile": "blazed", "period": 2.0, "depth": 0.2, "material": "none", "conserve_energy": False}
PLAIN = "".join(
    f'<{kind} name="{name}" value="{value}"/>'
    for kind, name, value in [
        *(("string", "profile", "blazed"), ("float", "period", "2"), ("float", "depth", "0.2")),
        *(("string", "material", "none"), ("boolean", "conserve_energy", "false")),
    ]
)
GRATING = f'<bsdf type="diffraction_grating" name="bsdf">{PLAIN}</bsdf>'
PRINCIPLED = (
    '<bsdf type="principled" name="bsdf"><rgb value="0.8 0.2 0.1" name="base_color"/>'
    '<float name="roughness" value="0.25"/></bsdf>'
)
BLEND = (
    '<bsdf type="blendbsdf"><float name="weight" value="0.5"/><bsdf type="plastic"/>'
    '<bsdf type="diffuse" id="b"/></bsdf>'
)
# As the add-on for Blender writes it.
EXPORTED = """<scene version="2.1.0">
    <default name="spp" value="4"/>
    <integrator type="moment"><integrator type="path">
        <integer name="max_depth" value="3"/><boolean name="hide_emitters" value="true"/>
    </integrator></integrator>
    <sensor type="perspective">
        <float name="fov" value="40"/>
        <transform name="to_world"><lookat origin="0, 0, 4" target="0, 0, 0" up="0, 1, 0"/></transform>
        <sampler type="independent"><integer name="sample_count" value="$spp"/></sampler>
        <film type="hdrfilm"><integer name="width" value="32"/><integer name="height" value="24"/>
            <string name="pixel_format" value="rgb"/><rfilter type="box"/></film>
    </sensor>
    <bsdf type="twosided" id="mat-Disc" name="mat-Disc">DISC</bsdf>
    <bsdf type="diffuse" id="mat-Floor" name="mat-Floor"><rgb value="0.5 0.5 0.5" name="reflectance"/></bsdf>
    <emitter type="constant" id="World" name="World"><rgb value="1 0.9 0.8" name="radiance"/></emitter>
    <shape type="ply" id="elm__1" name="elm__1">
        <string name="filename" value="meshes/Disc.ply"/><ref id="mat-Disc" name="bsdf"/>
    </shape>
    <shape type="ply" id="elm__2" name="elm__2">
        <string name="filename" value="meshes/Floor.ply"/><boolean name="face_normals" value="true"/>
        <ref id="mat-Floor" name="bsdf"/>
        <transform name="to_world"><translate x="0.5" z="-1"/></transform>
    </shape>
</scene>"""


@pytest.fixture
def exported(llvm, tmp_path):
    """exported(disc, uvs): a scene as exported, with this in the material of its disc."""

    def write(disc=PRINCIPLED, uvs=True):
        (tmp_path / "meshes").mkdir(exist_ok=True)
        for name in ("Disc", "Floor"):
            mesh = mi.Mesh(name, 4, 2, has_vertex_texcoords=uvs)
            corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float32)
            written = mi.traverse(mesh)
            written["vertex_positions"] = corners.ravel()
            written["faces"] = np.array([0, 1, 2, 0, 2, 3], np.uint32)
            if uvs:
                written["vertex_texcoords"] = (corners[:, :2] / 2 + 0.5).ravel()
            written.update()
            mesh.write_ply(str(tmp_path / "meshes" / f"{name}.ply"))
        path = tmp_path / "exported.xml"
        path.write_text(EXPORTED.replace("DISC", disc))
        return path

    return write


def test_a_replaced_bsdf_renders_as_if_the_scene_had_the_grating(exported):
    wanted = render(exported(GRATING), spp=2).radiance
    found = render(SceneFile(path := exported(), replacements={"mat-Disc": MIRROR}), spp=2).radiance
    np.testing.assert_array_equal(found, wanted)
    before = render(path, spp=2).radiance
    assert np.abs(found - before).max() > 0.1
    assert not found[0, 0].any()  # hide_emitters
    assert not before[0, 0].any()


DISC = f'<bsdf type="twosided" id="mat-Disc" name="mat-Disc">{PRINCIPLED}</bsdf>'
DIELECTRIC = {key: value for key, value in MIRROR.items() if key != "material"}
PIGMENT = '<bsdf type="diffuse" NAME><float name="reflectance" value="0.3"/></bsdf>'
WRAPPERS = {
    "mask": '<bsdf type="mask" NAME><float name="opacity" value="0.3"/>PART</bsdf>',
    "normal map": '<bsdf type="normalmap" NAME><rgb name="normalmap" value="0.6 0.5 0.9"/>PART</bsdf>',
    "bump map": '<bsdf type="bumpmap" NAME><texture type="checkerboard" name="arbitrary"/>'
    '<float name="scale" value="0.2"/>PART</bsdf>',
    "blend": '<bsdf type="blendbsdf" NAME><float name="weight" value="0.25"/>PARTPART</bsdf>',
    "both sides": '<bsdf type="twosided" NAME>PARTPART</bsdf>',
    "mask of a normal map of both sides": '<bsdf type="mask" NAME><float name="opacity" value="0.3"/>'
    '<bsdf type="normalmap"><rgb name="normalmap" value="0.6 0.5 0.9"/><bsdf type="twosided">PART</bsdf></bsdf></bsdf>',
    "blend with nothing": '<bsdf type="blendbsdf" NAME><float name="weight" value="0.25"/>'
    '<bsdf type="null"/>PART</bsdf>',
    "blend of masks": '<bsdf type="blendbsdf" NAME><float name="weight" value="0.25"/>'
    '<bsdf type="mask"><float name="opacity" value="0.4"/>PART</bsdf>PART</bsdf>',
}


def tree(state, node):
    """The plugin of a node of a parsed scene with its parameters, nested."""
    props = mi.Properties(node.props)
    resolved = mi.Properties.Type.ResolvedReference
    values = {
        key: tree(state, state.nodes[props[key].index()]) if props.type(key) == resolved else props[key]
        for key in props.keys()  # noqa: SIM118
    }
    return props.plugin_name(), {key: str(x) if "Color" in type(x).__name__ else x for key, x in values.items()}


def parsed_disc(path, replacements=None):
    """The BSDF of the disc of an exported scene as it is parsed, see `tree`."""
    with SceneFile(path, replacements=replacements).parsed() as (config, state):
        mi.parser.transform_resolve(config, state)
        (disc,) = [node for node in state.nodes if node.props.id() == "mat-Disc"]
        return tree(state, disc)


@pytest.mark.parametrize("referenced", [False, True], ids=["nested", "by reference"])
@pytest.mark.parametrize("values", [MIRROR, DIELECTRIC], ids=["mirror", "dielectric"])
@pytest.mark.parametrize("wrapper", WRAPPERS)
def test_the_grating_is_put_inside_of_what_wraps_a_material(exported, wrapper, values, referenced):
    """As if the scene had been written with it, and materials that others share are left alone."""
    path, text = exported(), WRAPPERS[wrapper].replace("NAME", 'id="mat-Disc"')
    pigment, shared = PIGMENT.replace("NAME", ""), PIGMENT.replace("NAME", 'id="shared"')
    base = pigment.replace("<bsdf", '<bsdf name="base"') if values is DIELECTRIC else ""
    material = "" if values is DIELECTRIC else '<string name="material" value="none"/>'
    plain = PLAIN.replace('<string name="material" value="none"/>', material)
    grating = f'<bsdf type="diffraction_grating">{plain}{base}</bsdf>'
    before = path.read_text().replace(DISC, "BSDF")
    path.write_text(before.replace("BSDF", text.replace("PART", grating)))
    wanted = parsed_disc(path)
    part = '<ref id="shared"/>' if referenced else pigment
    path.write_text(before.replace("BSDF", text.replace("PART", part) + shared))
    assert parsed_disc(path, {"mat-Disc": values}) == wanted
    with SceneFile(path, replacements={"mat-Disc": values}).parsed() as (_, state):
        (kept,) = [node.props for node in state.nodes if node.props.id() == "shared"]
        assert kept.plugin_name() == "diffuse"


@pytest.mark.slow
def test_a_grating_that_transmits_light_is_on_no_side_of_a_mask(exported):
    """A `twosided` cannot hold it, and the mask remains."""
    path = exported()
    text = WRAPPERS["mask of a normal map of both sides"].replace("NAME", 'id="mat-Disc"').replace("PART", PRINCIPLED)
    path.write_text(path.read_text().replace(DISC, text))
    glass = {**DIELECTRIC, "transmission": "sheet"}
    plugins = re.findall(
        r"'(mask|normalmap|twosided|diffraction_grating)'", str(parsed_disc(path, {"mat-Disc": glass}))
    )
    assert plugins.count("twosided") == 0
    assert {"mask", "normalmap", "diffraction_grating"} <= set(plugins)
    SceneFile(path, replacements={"mat-Disc": glass}).load()


def test_the_opacity_of_a_masked_material_remains(exported):
    """In front of a black floor, a mirror reflects that fraction."""
    path = exported()
    text = path.read_text().replace('value="0.5 0.5 0.5"', 'value="0 0 0"')
    means = []
    for opacity in (1, 0.3):
        mask = f'<bsdf type="mask" id="mat-Disc"><float name="opacity" value="{opacity}"/><bsdf type="diffuse"/></bsdf>'
        path.write_text(text.replace(DISC, mask))
        image = render(SceneFile(path, replacements={"mat-Disc": MIRROR}, size=(16, None)), spp=1024)
        means.append(image.radiance[4:8, 6:10].mean())
    # The standard error of 0.3 of 16384 samples is 1.2 %.
    assert means[1] == pytest.approx(0.3 * means[0], rel=0.05)


def test_the_replaced_bsdf_remains_below_a_dielectric(exported):
    below = PLAIN.replace('<string name="material" value="none"/>', PRINCIPLED.replace('bsdf"', 'base"', 1))
    wanted = render(exported(f'<bsdf type="diffraction_grating" name="bsdf">{below}</bsdf>'), spp=2).radiance
    found = render(SceneFile(path := exported(), replacements={"mat-Disc": DIELECTRIC}), spp=2).radiance
    np.testing.assert_array_equal(found, wanted)
    bare = render(SceneFile(path, replacements={"mat-Disc": {**DIELECTRIC, "base": "none"}}), spp=2).radiance
    assert found.mean() > 2 * bare.mean()


@pytest.mark.parametrize(
    ("values", "kept"),
    [
        ({"int_ior": 1.4}, True),
        ({"transmission": "none"}, True),
        ({"filename": "scalar.toml"}, True),
        ({"material": "Al"}, False),
        ({"base": "none"}, False),
        ({"transmission": "sheet"}, False),
        ({"theory": "rigorous"}, False),
        ({"filename": "rigorous.toml"}, False),
        ({"filename": "rigorous.exr"}, False),
    ],
)
def test_a_base_remains_where_light_reaches_it(exported, tmp_path, values, kept):
    path = exported()
    for theory in ("scalar", "rigorous"):
        text = f'[surface]\nprofile = "blazed"\n[spectrum]\ntheory = "{theory}"\nint_ior = 1.5\n'
        (tmp_path / f"{theory}.toml").write_text(text if theory == "rigorous" else text.replace("int_ior = 1.5\n", ""))
    made_up().save(tmp_path / "rigorous.exr")
    with SceneFile(path, replacements={"mat-Disc": {"profile": "blazed", **values}}).parsed() as (_, state):
        (grating,) = [node.props for node in state.nodes if node.props.plugin_name() == "diffraction_grating"]
        assert ("base" in grating) == kept


@pytest.mark.parametrize(
    "glass",
    [
        '<bsdf type="thindielectric"/>',
        PRINCIPLED.replace("roughness", "spec_trans"),
        '<bsdf type="mask"><float name="opacity" value="0.5"/><bsdf type="thindielectric"/></bsdf>',
    ],
)
def test_a_dielectric_in_the_place_of_glass_is_refused(exported, glass):
    path = exported()
    path.write_text(path.read_text().replace("</scene>", glass.replace("<bsdf ", '<bsdf id="glass" ', 1) + "</scene>"))
    with pytest.raises(ValueError, match=r"material glass: got a dielectric .* wanted transmission=sheet or interface"):
        SceneFile(path, replacements={"glass": {"profile": "blazed"}}).load()
    for values in ({"transmission": "sheet"}, {"material": "Al"}, {"base": "none"}):
        with SceneFile(path, replacements={"glass": {"profile": "blazed", **values}}).parsed():
            pass


@pytest.mark.parametrize(
    ("parameter", "border", "wanted"),
    [
        ("", "", "DiffractionPath"),
        ('<boolean name="hide_emitters" value="false"/>', "", "DiffractionPath"),
        ('<boolean name="hide_emitters" value="true"/>', "", "PathIntegrator"),
        ("", '<boolean name="sample_border" value="true"/>', "PathIntegrator"),
    ],
)
def test_diffraction_path_replaces_path_where_it_can(exported, parameter, border, wanted):
    path, film = exported(), '<film type="hdrfilm">'
    text = path.read_text().replace('<boolean name="hide_emitters" value="true"/>', parameter)
    path.write_text(text.replace(film, film + border))

    def integrator(**replacements):
        found = SceneFile(path, **replacements).load().integrator()
        return f"{type(found).__name__} {found}"

    assert wanted in integrator()
    assert wanted in integrator(replacements={"mat-Disc": MIRROR})


@pytest.mark.parametrize(
    ("disc", "name", "kept"),
    [
        (PRINCIPLED, "mat-Disc", "TwoSided["),
        (PRINCIPLED.replace("<bsdf ", '<bsdf id="inner" '), "inner", "TwoSided["),
        (BLEND, "b", "BlendBSDF["),
    ],
    ids=["twosided", "in a twosided", "in a blend"],
)
def test_a_bsdf_is_replaced_wherever_it_is(exported, disc, name, kept):
    shapes = SceneFile(exported(disc), replacements={name: MIRROR}).load().shapes()
    (grating,) = [text for text in (str(shape.bsdf()) for shape in shapes) if "DiffractionGrating[" in text]
    assert kept in grating


def test_a_transmitting_grating_replaces_a_twosided(exported):
    glass = {**MIRROR, "transmission": "interface", "int_ior": 1.5}
    del glass["material"]
    scene = SceneFile(exported(), replacements={"mat-Disc": glass}).load()
    assert any(str(shape.bsdf()).startswith("DiffractionGrating[") for shape in scene.shapes())


def test_an_unknown_id_is_refused_with_the_known_ids(exported):
    with pytest.raises(ValueError, match=r"got the id 'Disc', the ids of BSDFs in the scene are mat-Disc, mat-Floor"):
        SceneFile(exported(), replacements={"Disc": MIRROR}).load()


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ({"profile": "blazd", "period": 2.0}, r"profile: got 'blazd', wanted one of blazed"),
        ({"profile": "blazed", "depht": 0.2}, r"depht: unknown, wanted one of .*depth.*period.*shadowing"),
        ({"profile": "blazed", "depth": -0.2}, r"depth: got -0\.2"),
        ({"profile": "sinusoidal"}, "period"),
        ({"profile": "blazed", "material": "aluminium"}, r"material: got 'aluminium', did you mean Al"),
        ({"profile": "blazed", "shadowing": "smith"}, "shadowing: got 'smith'"),
        ({"profile": "blazed", "conserve_energy": 1}, "conserve_energy: got 1"),
        ({"profile": "blazed", "int_ior": "glas"}, "int_ior: got 'glas'"),
        ({"profile": "blazed", "transmission": "shet"}, "transmission: got 'shet'"),
        ({"filename": "missing.toml"}, "no such file"),
    ],
)
def test_wrong_parameters_are_refused_before_a_spectrum_is_computed(exported, monkeypatch, values, text):
    monkeypatch.setattr(
        "mitsuba_diffraction.precomputation.recipe.Recipe.cached", lambda *_: pytest.fail("a spectrum was computed")
    )
    with pytest.raises((ValueError, FileNotFoundError), match=text):
        SceneFile(exported(), replacements={"mat-Floor": MIRROR, "mat-Disc": values}).load()


def test_a_replacement_that_no_shape_has_is_logged(exported, caplog):
    path = exported()
    path.write_text(path.read_text().replace("</scene>", '<bsdf type="diffuse" id="mat-Spare"/></scene>'))
    with caplog.at_level(logging.WARNING, "mitsuba_diffraction"):
        SceneFile(path, replacements={"mat-Disc": MIRROR, "mat-Spare": MIRROR}).load()
    messages = [record.getMessage() for record in caplog.records if "no shape" in record.getMessage()]
    assert messages == ["material mat-Spare: no shape uses the BSDF with that id, so the picture is unaffected"]


def test_a_misspelt_parameter_is_refused_with_a_material_too(exported):
    path = exported()
    path.write_text(
        path.read_text().replace("</scene>", '<shape type="sphere"><float name="radiu" value="1"/></shape></scene>')
    )
    with pytest.raises(ValueError, match="radiu"):
        SceneFile(path, replacements={"mat-Disc": MIRROR}).load()


@pytest.mark.parametrize("uvs", [True, False])
def test_a_grating_on_a_mesh_without_uvs_is_logged(exported, uvs, caplog):
    with caplog.at_level(logging.WARNING, "mitsuba_diffraction"):
        warn_of_gratings(SceneFile(exported(uvs=uvs), replacements={"mat-Disc": MIRROR}).load())
    messages = [record.getMessage() for record in caplog.records if "UVs" in record.getMessage()]
    assert len(messages) == (0 if uvs else 1)
    assert all(line.startswith("mat-Disc: on a mesh without UVs") for line in messages)


@pytest.mark.few(2)
@pytest.mark.parametrize("kind", ["linearcurve", "sdfgrid", "ellipsoids", "bsplinecurve", "sphere"])
def test_a_grating_on_a_shape_without_uvs_is_logged(kind, llvm, tmp_path, caplog):
    filename = tmp_path / "shape"
    shape = {"type": kind, "bsdf": {"type": "diffraction_grating", "profile": "blazed", "period": 2.5, "depth": 0.25}}
    shape["bsdf"]["conserve_energy"] = False
    if kind.endswith("curve"):
        filename.write_text("-1 0 0 1\n0 0 0 1\n1 0 0 1\n2 0 0 1\n")
        shape["filename"] = str(filename)
    elif kind == "ellipsoids":
        shape |= {"centers": mi.TensorXf(np.zeros((1, 3))), "scales": mi.TensorXf(np.ones((1, 3)))}
        shape |= {"quaternions": mi.TensorXf(np.array([[0.0, 0, 0, 1]]))}
    elif kind == "sdfgrid":
        at = np.mgrid[:8, :8, :8] / 7 - 0.5
        shape["grid"] = mi.TensorXf(np.sqrt((at**2).sum(0))[..., None] - 0.4)
    warn_of_gratings(mi.load_dict({"type": "scene", "shape": shape}))
    wanted = f"on {kind}, which has no UVs" if kind in ("linearcurve", "sdfgrid", "ellipsoids") else ""
    messages = [record.getMessage() for record in caplog.records if "UVs" in record.getMessage()]
    assert len(messages) == bool(wanted)
    assert all(wanted in message for message in messages)


@pytest.mark.parametrize("name", ["has_texcoords", "has_vertex_texcoords"])
def test_uvs_are_found_by_the_name_of_either_mitsuba(name):
    assert not has_uvs(SimpleNamespace(**{name: lambda: False}))
    assert has_uvs(SimpleNamespace(**{name: lambda: True}))


def test_the_digest_of_a_scene_is_that_of_its_replacements(exported):
    path = exported()
    other = {**MIRROR, "depth": 0.3}
    digests = [SceneFile(path, replacements=m).digest() for m in (None, {"mat-Disc": MIRROR}, {"mat-Disc": other})]
    assert len(set(digests)) == 3


def test_the_command_replaces_several_bsdfs(exported, command, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    exported()
    Path("wall.toml").write_text('[surface]\nprofile = "sinusoidal"\nperiod = 2.0\ndepth = 0.1\n')
    words = ("--material", "mat-Floor=wall.toml,int_ior=1.4,conserve_energy=false", "--material")
    words += ("mat-Disc=blazed,depth=0.2,material=Al,conserve_energy=false",)
    code, _, error = command("render", "exported.xml", *words, "--spp", "1", "--width", "8")
    assert code == 0, error
    code, _, error = command("render", "exported.xml", "--material", "Disc=blazed", "--overwrite")
    assert code == 2
    assert "mat-Disc, mat-Floor" in error
    assert error.count("\n") == 1


def test_replacements_are_read_from_the_command_line(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("a.toml").write_text('[surface]\nprofile = "blazed"\n')
    Path("turn.png").touch()
    Path("Al").touch()
    found = replacements_of(["mat-A=a.toml,int_ior=1.5", "B=blazed,period=2,material=Al,conserve_energy=false"])
    assert found == {
        "mat-A": {"filename": str(tmp_path / "a.toml"), "int_ior": 1.5},
        "B": {"profile": "blazed", "period": 2, "material": "Al", "conserve_energy": False},
    }
    assert replacements_of(["A=foil,orientation=turn.png"])["A"]["orientation"] == str(tmp_path / "turn.png")
    for texts, message in (
        (["mat-A"], "got 'mat-A', wanted ID="),
        (["mat-A="], "got 'mat-A=', wanted ID="),
        (["mat-A=b.toml"], "b.toml: no such file"),
        (["A=blazed", "A=blazed"], "A: got it twice"),
        (["A=blazed,depth"], "got 'depth', wanted name=value"),
    ):
        with pytest.raises((ValueError, FileNotFoundError), match=message):
            replacements_of(texts)


@pytest.mark.parametrize(
    ("text", "transmission"),
    [
        ("film", "sheet"),
        ("transmission_300,theory=rigorous", "sheet"),
        ("film.toml", "sheet"),
        ("film,transmission=interface", "interface"),
        ("film,transmission=none", "none"),
        ("film,material=Al", None),
        ("film,base=0.5", None),
        ("foil", None),
    ],
)
def test_films_transmit_unless_told_otherwise(text, transmission, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    Path("film.toml").write_text('[surface]\nprofile = "film"\n')
    assert replacements_of([f"pane={text}"])["pane"].get("transmission") == transmission
    noted = "material pane: " in capfd.readouterr().err
    assert noted == (transmission == "sheet")


def test_the_file_of_a_texture_belongs_to_the_scene(exported, tmp_path):
    """It is never written over, and a change of it makes another scene."""
    picture, path = tmp_path / "depth.png", exported()
    replacements = {"mat-Disc": {**MIRROR, "height_scale": str(picture)}}
    digests = set()
    for value in (50, 100):
        mi.Bitmap(np.full((4, 4), value, np.uint8)).write(str(picture))
        digests.add(SceneFile(path, replacements=replacements).digest())
    assert len(digests) == 2
    assert picture in SceneFile(path, replacements=replacements).files()
    shapes = SceneFile(path, replacements=replacements).load().shapes()
    (shape,) = [s for s in shapes if "DiffractionG" in str(s.bsdf())]
    assert "height_scale = 0.392157 to 0.392157" in str(shape.bsdf())
