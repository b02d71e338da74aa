"""Shapes are listed in the order of the file, so that the same command gives the same picture in any process."""

import itertools
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import mitsuba_diffraction  # noqa: F401 (settles which LLVM is used before a variant is set)
from mitsuba_diffraction.render import SceneFile
from mitsuba_diffraction.render.passes import content_of

HEAD = """<scene version="3.0.0"><integrator type="INTEGRATOR"/>
<sensor type="perspective"><float name="fov" value="60"/>
<transform name="to_world"><lookat origin="0,-4,2" target="0,0,0.5" up="0,0,1"/></transform>
<film type="hdrfilm"><integer name="width" value="24"/><integer name="height" value="24"/></film></sensor>
<bsdf type="diffraction_grating" id="grating"><string name="profile" value="blazed"/><float name="period" value="2.5"/>
<float name="depth" value="0.25"/></bsdf>"""


def scene_of(lamps, integrator="diffraction_path", kind="rectangle"):
    """A floor, a wall, two gratings and some lamps of different brightness."""
    shapes = [
        f"""<shape type="{kind}" id="lamp{k}"><transform name="to_world"><scale value=".2"/><rotate x="1" angle="180"/>
        <translate x="{k - 2}" y="{k % 2}" z="3"/></transform>
        <emitter type="area"><spectrum name="radiance" value="{1 + k}"/></emitter></shape>"""
        for k in range(lamps)
    ]
    for name, place, grating in (
        ("floor", '<scale value="2"/>', False),
        ("wall", '<rotate x="1" angle="90"/><scale value="2"/><translate y="2"/>', False),
        ("left", '<scale value=".5"/><translate z=".3"/>', True),
        ("right", '<scale value=".3"/><translate x="1" z=".5"/>', True),
    ):
        bsdf = '<ref id="grating"/>' if grating else ""
        shapes.append(
            f'<shape type="rectangle" id="{name}"><transform name="to_world">{place}</transform>{bsdf}</shape>'
        )
    return HEAD.replace("INTEGRATOR", integrator) + "".join(shapes) + "</scene>"


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch, llvm):
    monkeypatch.chdir(tmp_path)


def test_shapes_are_in_the_order_of_the_file():
    text = scene_of(6)
    Path("scene.xml").write_text(text)
    expected = re.findall('shape type="rectangle" id="([a-z0-9]+)"', text)
    for _ in range(4):
        scene = SceneFile("scene.xml").load()
        assert [shape.id() for shape in scene.shapes()] == expected
        assert [emitter.get_shape().id() for emitter in scene.emitters()] == expected[:6]


def test_another_order_of_shapes_is_another_request():
    file = SceneFile("scene.xml")
    Path("scene.xml").write_text(scene_of(2))
    scene = file.load()
    swapped = re.sub(r"(<shape.*?</shape>)(<shape.*?</shape>)", r"\2\1", scene_of(2), count=1, flags=re.S)
    Path("other.xml").write_text(swapped)
    other = SceneFile("other.xml").load()
    assert [shape.id() for shape in other.shapes()][:2] == ["lamp1", "lamp0"]
    assert content_of(file, scene) == content_of(file, file.load())
    assert content_of(file, scene) != content_of(file, other)


RENDER = """import hashlib, sys
import mitsuba_diffraction, mitsuba as mi
from mitsuba_diffraction.render import render
mi.set_variant("llvm_ad_spectral")
grating = {"type": "diffraction_grating", "profile": "sinusoidal", "period": 2.0, "depth": 0.2}
beside = [mi.load_dict({"type": "scene", "ball": {"type": "sphere", "bsdf": grating}, "sky": {"type": "constant"},
    "lamp": {"type": "rectangle", "emitter": {"type": "area"}}}) for _ in range(int(sys.argv[1]))]
for name in sys.argv[2:]:
    print(name, hashlib.sha256(render(name, spp=16).radiance.tobytes()).hexdigest())"""


@pytest.mark.slow
def test_eight_processes_give_one_picture():
    names = []
    for integrator, kind, lamps in itertools.product(
        ("diffraction_path", "volpath"), ("rectangle", "sphere"), (1, 2, 6)
    ):
        names.append(f"{integrator}_{kind}_{lamps}.xml")
        Path(names[-1]).write_text(scene_of(lamps, integrator, kind))
    answers = set()
    for number in range(8):
        # Of other addresses, and alone or beside other scenes.
        environment = {**os.environ, "PYTHONHASHSEED": str(number)}
        call = [sys.executable, "-c", RENDER, str(number % 3), *names]
        answers.add(subprocess.run(call, capture_output=True, text=True, check=True, env=environment).stdout)
    assert len(answers) == 1
