"""Lamps beside each other, hidden ones and ones of any `sampling_weight`, compared with `path` and `volpath`."""

import mitsuba as mi
import numpy as np
import pytest
from bsdf_support import uniform
from test_lamps_without_extent import (
    ORDERS,
    RISING,
    blaze,
    by_lamps,
    by_path,
    scene,
    slide,
    sums_over_wavelengths,
    towards,
)

import mitsuba_diffraction  # noqa: F401 (settles which LLVM is used before a variant is set)

pytestmark = pytest.mark.usefixtures("llvm")
AT = ORDERS[0], [1.4, 0.9, 1.6]  # of two lamps


def black():
    return {"type": "diffuse", "reflectance": 0.0}


def area(position, kind="area", **parameters):
    emitter = {"type": kind, "radiance": uniform(4.0), **parameters}
    return {"type": "disk", "to_world": towards(position).scale(0.7), "emitter": emitter, "bsdf": black()}


def bright_spot():
    pixels = np.full((16, 32, 3), 0.1, np.float32)
    pixels[4:6, 8:11] = 3.0
    return mi.Bitmap(pixels)


# Each at a position, with the sampling weight and other parameters.
WITHOUT_EXTENT = {
    "sun": lambda at, **of: {"type": "directional", "direction": [-x for x in at], "irradiance": RISING, **of},
    "bulb": lambda at, **of: {"type": "point", "position": at, "intensity": RISING, **of},
    "spot": lambda at, **of: {"type": "spot", "to_world": towards(at), "intensity": RISING, **of},
    "projector": lambda at, **of: {"type": "projector", "to_world": towards(at), "irradiance": slide(), **of},
}
WITH_EXTENT = {
    "area": area,
    "directionalarea": lambda at, **of: area(at, "directionalarea", **of),
    "sky": lambda _, **of: {"type": "constant", "radiance": uniform(0.2), **of},
    "map": lambda _, **of: {"type": "envmap", "bitmap": bright_spot(), **of},
}
LAMPS = WITHOUT_EXTENT | WITH_EXTENT


def ball(at, **parameters):
    """A ball between the origin and a lamp."""
    return {"type": "sphere", "center": (0.35 * np.array(at)).tolist(), "radius": 0.25, **parameters}


def test_a_hidden_lamp_is_dark_beside_another():
    """Two suns, one of them hidden: the sum over wavelengths of the other."""
    other = {"other": LAMPS["sun"](ORDERS[1])}
    hidden = {"hidden": LAMPS["sun"](AT[0]), "ball": ball(AT[0], bsdf=black())}
    wanted = sums_over_wavelengths(scene(blaze(), other))
    found, error = by_lamps(scene(blaze(), {**other, **hidden}), 2**15)
    assert (error < 0.02 * wanted.max()).all()
    np.testing.assert_array_less(np.abs(found - wanted), 4 * error + 1e-3 * wanted.max())


def test_an_area_lamp_that_is_never_drawn_keeps_its_light():
    """Beside a bulb, and a lamp whose direction no sample finds."""
    lamps = {"area": LAMPS["area"](AT[0], sampling_weight=0.0), "bulb": LAMPS["bulb"](AT[1])}
    lamps["directed"] = LAMPS["directionalarea"](ORDERS[1])
    (wanted, its_error), (found, error) = (of(scene(blaze(2.0), lamps), count=2**16) for of in (by_path, by_lamps))
    assert (np.hypot(error, its_error) < 0.03 * wanted.max()).all()
    np.testing.assert_array_less(np.abs(found - wanted), 4 * np.hypot(error, its_error))
