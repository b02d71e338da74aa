"""Scenes of strangers: what is nested too deeply for Mitsuba's parser and objects is refused."""

from pathlib import Path

import pytest

from mitsuba_diffraction.errors import RequestError
from mitsuba_diffraction.render.scene_file import SceneFile

NESTED = 40 * '<bsdf type="mask">' + '<bsdf type="diffuse"/>' + 40 * "</bsdf>"
INCLUDE = '<scene version="3.0.0">{}<include filename="{}"/></scene>'


def parse(text, **parameters):
    Path("scene.xml").write_text(text)
    with SceneFile("scene.xml", parameters=parameters).parsed():
        pass


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("deep").mkdir()
    Path("deep/b.xml").write_text(f'<scene version="3.0.0">{NESTED}</scene>')


DEEP = {
    "elements": f'<scene version="3.0.0">{NESTED}</scene>',
    "after_invalid_xml": f'<scene version="3.0.0"><!-- a -- " b --><default name="a" value="&x;/>"/>{NESTED}</scene>',
    "included": INCLUDE.format("", "deep/b.xml"),
    "included_by_path": INCLUDE.format('<path value="deep"/>', "b.xml"),
    "included_by_parameter": INCLUDE.format('<default name="d" value="deep"/>', "$d/&#98;.xml"),
    "included_by_a_longer_name": INCLUDE.format(
        "<default name='d' value='x'/><default name='dd' value='b'/>", "deep/$dd.xml"
    ),
    "references": '<scene version="3.0.0"><bsdf type="diffuse" id="b0"/>'
    + "".join(f'<bsdf type="mask" id="b{k}"><ref id="b{k - 1}"/></bsdf>' for k in range(1, 40))
    + "</scene>",
    "without_end": '<scene version="3.0.0">' + 50_000 * "<a",
}


@pytest.mark.parametrize("name", DEEP)
def test_deep_nesting_is_refused(name):
    with pytest.raises(RequestError, match=r"scene.xml: ") as caught:
        parse(DEEP[name])
    wanted = "Error parsing start element tag" if name == "without_end" else "got more than 32 levels of"
    assert caught.match(wanted)
    assert "\n" not in str(caught.value)


def test_twenty_thousand_levels_are_one_line(command):
    Path("scene.xml").write_text('<scene version="3.0.0">' + 20_000 * '<bsdf type="mask">')
    code, out, err = command("render scene.xml -o out.exr --variant llvm_ad_spectral")
    assert (code, out) == (2, "")
    expected = "error: scene.xml: got more than 32 levels of nested elements, wanted fewer"
    assert err.splitlines()[-1] == f"mitsuba-diffraction: {expected}"


def test_a_document_type_is_refused():
    with pytest.raises(RequestError, match=r"got XML with <!DOCTYPE, wanted elements and comments"):
        parse('<!DOCTYPE scene [ <![IGNORE[ " ]]> ]><scene version="3.0.0"/>')


def test_includes_that_multiply_are_refused():
    for k in range(6):
        Path(f"{k}.xml").write_text('<scene version="3.0.0">' + 10 * f'<include filename="{k + 1}.xml"/>' + "</scene>")
    Path("6.xml").write_text('<scene version="3.0.0"/>')
    with pytest.raises(RequestError, match="got more than 1000 includes"):
        parse(INCLUDE.format("", "0.xml"))


def test_parameters_that_multiply_are_refused():
    values = "".join(f'<default name="p{k + 1}" value="{10 * f"$p{k}"}"/>' for k in range(9))
    with pytest.raises(RequestError, match="got a value of more than 65536 characters"):
        parse(f'<scene version="3.0.0"><default name="p0" value="0123456789"/>{values}</scene>')


def test_other_scenes_are_read():
    few = NESTED.replace(40 * '<bsdf type="mask">', 20 * '<bsdf type="mask">').replace(40 * "</bsdf>", 20 * "</bsdf>")
    parse(f'<?xml version="1.0"?><!-- -- {NESTED} --><scene version="3.0.0">{few}{few}{few}</scene>')
    Path("deep/b.xml").write_text(f'<scene version="3.0.0">{few}</scene>')
    parse(INCLUDE.format('<default name="d" value="none"/>', "$d/b.xml"), d="deep")
