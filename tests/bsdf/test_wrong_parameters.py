"""Numbers that a parameter cannot be, and values of other types: one line, at load and at update."""

import mitsuba as mi
import numpy as np
import pytest
from bsdf_support import of_spectrum, plugin, spectrum

GRATING = "filename profile representation theory int_ior material orientation height_scale shadowing coat_ior base"
OTHERS = {
    "color": {"type": "rgb", "value": [0.1, 0.2, 0.3]},
    "spectrum": {"type": "spectrum", "value": [(400, 1), (700, 2)]},
    "transform": lambda: mi.ScalarTransform4f(),
    "vector": lambda: mi.ScalarPoint3f(1, 2, 3),
}


@pytest.mark.parametrize("kind", OTHERS)
@pytest.mark.parametrize("name", GRATING.split())
def test_values_of_other_types_are_refused_in_one_line(llvm, name, kind):
    value = OTHERS[kind]() if callable(OTHERS[kind]) else OTHERS[kind]
    with pytest.raises(RuntimeError, match=f'^diffraction_grating at dictionary node "root": {name}: got ') as found:
        mi.load_dict(of_spectrum(spectrum("blazed"), **{name: value}))
    assert "\n" not in str(found.value)


def test_a_whole_number_is_an_index(llvm):
    assert np.array(mi.traverse(plugin(spectrum("blazed"), int_ior=2, conserve_energy=False))["eta"]) == pytest.approx(
        2 / 1.000277, rel=1e-6
    )


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"int_ior": 1e300}, r"int_ior: got 1e\+300, wanted a positive index of refraction, .* \(0\.01 to 100\)"),
        ({"orientation": 1e300}, "orientation: got 1e[+]300, wanted degrees"),
        ({"lateral_scale": 1e-9}, r"lateral_scale: got 1e-09, wanted 0\.01 to 1"),
        ({"orientation": {"type": "uniform", "value": float("nan")}}, "orientation: got"),
        (
            {"orientation": {"type": "checkerboard", "color0": float("nan")}},
            "orientation: got values that are not fini",
        ),
        (
            {"orientation": {"type": "checkerboard", "color0": {"type": "rgb", "value": [0.5, 0.5, 0.5]}}},
            "orientation: got colours, wanted numbers",
        ),
    ],
)
def test_numbers_that_cannot_be_are_refused(llvm, parameters, message):
    with pytest.raises(RuntimeError, match=message):
        plugin(spectrum("blazed"), **parameters)


@pytest.mark.parametrize(
    ("given", "name", "value", "message"),
    [
        *(
            ({"int_ior": 1.5}, "eta", eta, f"eta: got {eta:g}, wanted a positive relative index")
            for eta in (np.nan, 0.0, -1.5, np.inf)
        ),
        ({"orientation": 30.0}, "orientation.value", np.nan, "orientation: got values that are not finite"),
        ({"lateral_scale": 0.9}, "lateral_scale", 1e-9, r"lateral_scale: got 1e-09, wanted 0\.01 to 1"),
        ({}, "height_scale", np.nan, "height_scale: got values that are not finite"),
    ],
)
def test_numbers_that_cannot_be_are_refused_at_update(llvm, given, name, value, message):
    bsdf = plugin(spectrum("blazed"), conserve_energy=False, **given)
    parameters = mi.traverse(bsdf)
    parameters[name] = type(parameters[name])(np.full(np.shape(parameters[name]) or 1, value))
    with pytest.raises((RuntimeError, ValueError), match=message) as found:
        parameters.update()
    assert "\n" not in str(found.value)
