"""Files for makers: a mesh that is closed, layers of levels, the master of a mould, a TIFF with its scale."""

from collections import Counter

import numpy as np
import pytest
from PIL import Image

import mitsuba_diffraction as md
from mitsuba_diffraction.inverse_design import Design, makers, output
from mitsuba_diffraction.inverse_design.plate import Plate
from mitsuba_diffraction.inverse_design.target import wanted_fractions

FACE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


@pytest.fixture(scope="module")
def design():
    plate = Plate(1.0, 12, 0.6, 17.5, np.array([532.0]), None, 4, 0.1)
    heights = np.random.default_rng(0).integers(0, 4, (12, 12)) * 0.2
    return Design.of(heights, plate, wanted_fractions(np.eye(8), plate))


@pytest.mark.slow
@pytest.mark.not_quick
def test_the_mesh_is_a_closed_solid(design, tmp_path):
    makers.save_stl(design.height_field, tmp_path / "a.stl")
    data = (tmp_path / "a.stl").read_bytes()
    faces = np.frombuffer(data[84:], FACE)
    assert len(faces) == np.frombuffer(data[80:84], "<u4")[0]
    assert not data.startswith(b"solid")  # which would be a text
    corners = faces["corners"].astype(float)
    edges = Counter()
    for a, b, c in corners.round(6).tolist():
        a, b, c = tuple(a), tuple(b), tuple(c)
        edges.update([(a, b), (b, c), (c, a)])
    assert set(edges.values()) == {1}
    assert all((end, start) in edges for start, end in edges)
    # The divergence theorem: normals outwards, and the volume of the relief over its base.
    volume = np.einsum("ni,ni->n", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6
    field = design.height_field
    assert volume == pytest.approx(
        np.prod(field.tile_size) * (field.heights - field.heights.min() + 1).mean(), rel=1e-4
    )
    assert np.ptp(corners[..., 0]) == pytest.approx(field.tile_size[0])
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert faces["normal"] == pytest.approx(normals / np.linalg.norm(normals, axis=-1, keepdims=True), abs=1e-3)


def test_layers_are_those_of_the_levels(design, tmp_path):
    gdstk = pytest.importorskip("gdstk")
    makers.save_gds(design, tmp_path / "a.gds")
    library = gdstk.read_gds(str(tmp_path / "a.gds"))
    (cell,) = library.cells
    for level in range(4):
        polygons = [polygon for polygon in cell.polygons if polygon.layer == level]
        expected = np.count_nonzero(np.isclose(design.texels, 0.2 * level)) if level else 0
        assert sum(polygon.area() for polygon in polygons) == pytest.approx(expected)
        for row, column in np.argwhere(np.isclose(design.texels, 0.2 * level))[:5] if level else ():
            assert gdstk.inside([(column + 0.5, row + 0.5)], polygons) == (True,)


def test_a_copy_of_the_master_is_the_relief(design, tmp_path):
    makers.save_master(design, tmp_path / "a_master.gsf")
    master = md.read_height_field(tmp_path / "a_master.gsf")
    # Turned over, its −x is +x, and what is high is low.
    copy = -master.heights[:, ::-1]
    assert copy - copy.min() == pytest.approx(design.height_field.heights - design.height_field.heights.min(), abs=1e-6)


def test_the_tiff_has_its_scale(design, tmp_path):
    field = design.height_field
    output.save_tiff(field, 0.6, tmp_path / "a.tif")
    with Image.open(tmp_path / "a.tif") as tiff:
        tags, grey = dict(tiff.tag_v2), np.asarray(tiff, float)
    assert tags[296] == 3  # per cm
    assert [1e4 / float(tags[tag]) for tag in (282, 283)] == pytest.approx(field.pixel_size, rel=1e-6)
    # ImageJ: lines of name=value after its name; cf=0 is a straight line.
    lines = tags[270].splitlines()
    assert lines[0].startswith("ImageJ=")
    values = dict(line.split("=", 1) for line in lines)
    assert (values["unit"], values["vunit"], values["cf"]) == ("cm", "um", "0")
    heights = float(values["c0"]) + float(values["c1"]) * grey
    assert heights == pytest.approx(field.heights, abs=0.6 / 65535)
    assert tags[270].isascii()
    assert "?" not in tags[270]
    assert "12 x 12 texels of 1 um" in tags[270]
    assert tags[305] == "mitsuba_diffraction output"


def test_exports_are_refused_before_the_search(tmp_path):
    with pytest.raises(ValueError, match=r"^export: got 'obj', wanted one of stl, gds, master"):
        makers.export_paths(["stl", "obj"], tmp_path / "a.gsf")
    with pytest.raises(ValueError, match=r"^levels: got none, and gds has a layer for each"):
        makers.check_gds(None)
