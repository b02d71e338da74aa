"""Mitsuba merges shapes of equal BSDFs to a mesh without a bounding box, past which light leaks."""

import mitsuba as mi
import pytest

import mitsuba_diffraction  # noqa: F401 (settles which LLVM is used before a variant is set)
from mitsuba_diffraction.render.scene_file import SceneFile

SCENE = """<scene version="3.0.0"><integrator type="path"/>
<sensor type="perspective"><float name="fov" value="1"/><film type="hdrfilm"><integer name="width" value="8"/>
    <integer name="height" value="8"/></film>
    <transform name="to_world"><lookat origin="0,0,1" target="0,0,0" up="0,1,0"/></transform></sensor>
<bsdf type="diffuse" id="both"/>
<shape type="rectangle"><ref id="both"/></shape>
<shape type="rectangle"><transform name="to_world"><scale value="1000"/><rotate x="1" angle="90"/><translate y="2"/>
    </transform><ref id="both"/></shape>
<shape type="sphere"><point name="center" x="0" y="-2" z="0.1"/><float name="radius" value="0.1"/>
    <bsdf type="diffraction_grating"><string name="profile" value="blazed"/>
    <boolean name="conserve_energy" value="false"/><float name="coherence_length" value="2"/></bsdf></shape>
<emitter type="{light}"/></scene>"""


def _by_string(text, **options):
    return mi.load_string(text, **options)  # found when it is called, as it is replaced


def _by_file(text, **options):
    with open("scene.xml", "w") as stream:
        stream.write(text)
    return mi.load_file("scene.xml", **options)


@pytest.mark.parametrize("load", [_by_string, _by_file])
@pytest.mark.parametrize("light", ["constant", "directional", "point"])
def test_light_that_may_leak_past_a_merged_mesh_is_named_once(llvm, caplog, tmp_path, monkeypatch, light, load):
    monkeypatch.chdir(tmp_path)
    load(SCENE.format(light=light))
    messages = [record.getMessage() for record in caplog.records]
    assert ["optimize=False" in message for message in messages] == [True] * (light != "point")
    caplog.clear()
    load(SCENE.format(light=light), optimize=False)
    assert not caplog.records


def test_a_command_loads_shapes_as_they_are(llvm, tmp_path, caplog):
    path = tmp_path / "scene.xml"
    path.write_text(SCENE.format(light="constant"))
    built = SceneFile(path).load()
    assert len(built.shapes()) == 3
    assert all(shape.bbox().valid() for shape in built.shapes())
    assert not caplog.records
