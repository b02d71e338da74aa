"""Files of colours for the material for three.js: what they hold, and which surfaces they cannot hold."""

import json
from dataclasses import fields

import numpy as np
import pytest

import mitsuba_diffraction as md
from mitsuba_diffraction.export import colour_file
from mitsuba_diffraction.export.colour_file import write_colours
from mitsuba_diffraction.export.colour_table import ColourError, ColourTable, OrderColours, Viewed
from mitsuba_diffraction.optics.media import MediumBelow


def read(path):
    """The header and the arrays of a file."""
    content = path.read_bytes()
    assert content[:4] == b"MDCF"
    start = 8 + int.from_bytes(content[4:8], "little")
    assert start % 4 == 0
    header, arrays = json.loads(content[8:start]), {}
    for array in header["arrays"]:
        values = np.frombuffer(content, f"<{array['type'][0]}4", int(np.prod(array["shape"])), start)
        arrays[array["name"]], start = values.reshape(array["shape"]), start + values.nbytes
    assert start == len(content)
    return header, arrays


@pytest.mark.parametrize("kind", ["table", "orders"])
def test_a_file_holds_the_colours(kind, tmp_path, monkeypatch):
    random, error = np.random.default_rng(1), ColourError(0.1, 0.2, 3.0, 0.01)
    if kind == "table":
        values = random.integers(0, 2**32, (2, 4, 4), dtype=np.uint32)
        colours = ColourTable(values, 0.15, (0.3, 3.1), error)
    else:
        shapes = ((3, 2), (3, 5), (2, 6, 3), (4, 4))
        q, powers, light, reflectance = (random.random(shape) for shape in shapes)
        colours = OrderColours(q, (2.5, 1.0), powers, 60.0, 0.003, light, reflectance, 1.55, error)
    monkeypatch.setattr(colour_file, "colours_of", lambda viewed: colours)
    spectrum = md.precompute(md.gratings.blazed(5.0, 0.25))
    write_colours(Viewed(spectrum, MediumBelow.of(None, 1.5), 1.55), tmp_path / "a.bin", "radial", "#a0522d")
    header, arrays = read(tmp_path / "a.bin")
    assert (header["version"], header["kind"], header["source"]) == (3, kind, spectrum.source)
    assert header["error"] == {"mean": 0.1, "percentile_95": 0.2, "maximum": 3.0, "flux": 0.01}
    assert (header["orientation"], header["base"], header["coat"]) == ("radial", "#a0522d", 1.55)
    assert header["index"] == pytest.approx(1.5 / 1.55)
    for field in fields(colours):
        value = getattr(colours, field.name)
        if isinstance(value, np.ndarray):
            np.testing.assert_allclose(arrays[field.name], value, rtol=1e-7)
        elif field.name != "error":
            assert header[field.name] == (list(value) if isinstance(value, tuple) else value)


@pytest.mark.parametrize(
    ("line", "problem"),
    [
        ("blazed,theory=rigorous,int_ior=1.5", "wanted theory=scalar, or a file .csv or .json"),
        ("blazed,int_ior=1.5,transmission=interface", "got interface, which a.bin does not hold; wanted it without"),
        ("blazed,thin_film_thickness=0.1", "scenes and `render --material` have it"),
        ("blazed,material=Al,base=#a0522d", "base: got #a0522d below Al, wanted a dielectric, such as int_ior=1.5"),
        ("blazed,base=brown", "base: got brown, wanted a colour such as #a0522d"),
        ("blazed,height_scale=-1", "height_scale: got -1, wanted a number ≥ 0"),
        ("blazed,orientation=up", "orientation: got 'up', wanted degrees, radial or tangential"),
    ],
)
def test_what_a_file_cannot_hold_is_refused(line, problem, command, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, _, error = command(f"export {line} -o a.bin")
    assert code == 2
    assert error.splitlines()[-1].startswith("mitsuba-diffraction: error: ")
    assert problem in error
    assert not (tmp_path / "a.bin").exists()
