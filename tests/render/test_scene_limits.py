"""Scenes of strangers: what is too deep for Mitsuba's parser and objects, and too large pictures, are refused."""

import struct
import zlib
from pathlib import Path

import numpy as np
import OpenEXR
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


def png(width, height):
    """A picture of 8 bits and four channels, without its pixels."""
    header = b"IHDR" + struct.pack(">2I5B", width, height, 8, 6, 0, 0, 0)
    header = struct.pack(">I", 13) + header + struct.pack(">I", zlib.crc32(header))
    return b"\x89PNG\r\n\x1a\n" + header + struct.pack(">I", 0) + b"IDAT" + struct.pack(">I", zlib.crc32(b"IDAT"))


def hdr(width, height, start=b""):
    return b"#?RADIANCE\n" + start + b"FORMAT=32-bit_rle_rgbe\n\n-Y %d +X %d\n" % (height, width)


def exr(width, height):
    OpenEXR.File(
        {"compression": OpenEXR.ZIP_COMPRESSION}, {c: np.zeros((height, width), np.float16) for c in "RGB"}
    ).write("made.exr")
    return Path("made.exr").read_bytes()


def of_picture(element, name):
    named = f'<string name="filename" value="{name}"/>'
    return f'<scene version="3.0.0">{element.format(named)}</scene>'


TEXTURE = (
    '<shape type="sphere"><bsdf type="diffuse"><texture type="bitmap" name="reflectance">{}</texture></bsdf></shape>'
)
SKY = '<emitter type="envmap">{}</emitter>'
PICTURES = {
    "texture.png": (TEXTURE, lambda: png(8192, 8192), 268435456),
    "bomb.png": (TEXTURE, lambda: png(60000, 60000), 2147483648),
    "sky.png": (SKY, lambda: png(4096, 4096), 67108864),
    "sky.hdr": (SKY, lambda: hdr(6000, 3000), 54000000),
    "two_sizes.hdr": (SKY, lambda: hdr(6000, 3000, b"# -Y 1 +X 1\n"), 54000000),
    "without_size.hdr": (SKY, lambda: b"#?RADIANCE\n" + bytes(2**16), "got a picture of Radiance without its size"),
    "unknown_size.png": (SKY, lambda: png(4096, 4096)[:12], "not a picture that can be read"),
    "sky.exr": (SKY, lambda: exr(6000, 3000), 54000000),
}


@pytest.mark.parametrize("name", PICTURES)
def test_pictures_that_fill_the_memory_are_refused_before_mitsuba_loads_them(name):
    element, make, numbers = PICTURES[name]
    Path(name).write_bytes(make())
    message = numbers if isinstance(numbers, str) else f"got a picture of {numbers} numbers in .*B, wanted at most"
    with pytest.raises(RequestError, match=f"scene.xml: .*{name}: {message}"):
        parse(of_picture(element, name))


@pytest.mark.parametrize(
    ("element", "content"),
    [(TEXTURE, png(4096, 4096)), (SKY, hdr(4096, 2048)), (SKY, b"none")],
    ids=["texture", "sky", "none"],
)
def test_pictures_of_usual_size_are_left_to_mitsuba(element, content):
    Path("a.bin").write_bytes(content)
    parse(of_picture(element, "a.bin"))


def test_other_scenes_are_read():
    few = NESTED.replace(40 * '<bsdf type="mask">', 20 * '<bsdf type="mask">').replace(40 * "</bsdf>", 20 * "</bsdf>")
    parse(f'<?xml version="1.0"?><!-- -- {NESTED} --><scene version="3.0.0">{few}{few}{few}</scene>')
    Path("deep/b.xml").write_text(f'<scene version="3.0.0">{few}</scene>')
    parse(INCLUDE.format('<default name="d" value="none"/>', "$d/b.xml"), d="deep")
