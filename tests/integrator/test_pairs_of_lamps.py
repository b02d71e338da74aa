"""Lamps beside each other, hidden ones and ones of any `sampling_weight`, compared with `path` and `volpath`."""

import mitsuba as mi
import numpy as np
import pytest
from bsdf_support import uniform
from covering import covering
from test_diffraction_path import plate, region_means
from test_diffraction_path import scene as room
from test_lamps_without_extent import (
    ORDERS,
    RISING,
    bins,
    blaze,
    by_lamps,
    by_path,
    rays,
    received,
    scene,
    slide,
    sums_over_wavelengths,
    towards,
)

import mitsuba_diffraction  # noqa: F401 (settles which LLVM is used before a variant is set)

pytestmark = pytest.mark.usefixtures("llvm")
AT = ORDERS[0], [1.4, 0.9, 1.6]  # of two lamps
BLACK = {"type": "diffuse", "reflectance": 0.0}


def area(position, kind="area", radius=0.7, **parameters):
    emitter = {"type": kind, "radiance": uniform(2.0 / radius**2), **parameters}
    return {"type": "disk", "to_world": towards(position).scale(radius), "emitter": emitter, "bsdf": BLACK}


def environment(**parameters):
    pixels = np.full((16, 32, 3), 0.1, np.float32)
    pixels[4:6, 8:11] = 3.0
    return {"type": "envmap", "bitmap": mi.Bitmap(pixels), **parameters}


# Each at a position, with `sampling_weight`.
LAMPS = {
    "sun": lambda at, **of: {"type": "directional", "direction": [-x for x in at], "irradiance": RISING, **of},
    "bulb": lambda at, **of: {"type": "point", "position": at, "intensity": RISING, **of},
    "spot": lambda at, **of: {"type": "spot", "to_world": towards(at), "intensity": RISING, **of},
    "projector": lambda at, **of: {"type": "projector", "to_world": towards(at), "irradiance": slide(), **of},
    "area": area,
    "directionalarea": lambda at, **of: area(at, "directionalarea", **of),
    "sky": lambda _, **of: {"type": "constant", "radiance": uniform(0.2), **of},
    "map": lambda _, **of: environment(**of),
}
SKIES = {"sky", "map"}


def between(at):
    """A point between the origin and a lamp."""
    return (0.35 * np.array(at)).tolist()


def ball(at, **parameters):
    return {"type": "sphere", "center": between(at), "radius": 0.25, "bsdf": BLACK, **parameters}


def instance(at):
    group = {"type": "shapegroup", "ball": {"type": "sphere", "radius": 0.25, "bsdf": BLACK}}
    to_world = mi.ScalarTransform4f().translate(between(at))
    return {
        "group": group,
        "instance": {"type": "instance", "to_world": to_world, "ball": {"type": "ref", "id": "group"}},
    }


def mesh_with_alpha(at):
    bsdf = {"type": "mask", "opacity": 0.7, "bsdf": BLACK}
    return {"type": "cube", "to_world": towards(between(at)).scale(0.2), "bsdf": bsdf}


def plate_with_screen(at):
    """A grating of two parallel squares, of which one is before the lamp."""
    square = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    screen = 0.2 * square + between(at)
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(blaze(2.0))
    mesh = mi.Mesh("plate", 8, 4, has_vertex_texcoords=True, props=properties)
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = np.concatenate([square, screen]).ravel().astype(np.float32)
    parameters["vertex_texcoords"] = np.tile(square[:, :2] / 2 + 0.5, (2, 1)).ravel().astype(np.float32)
    parameters["faces"] = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]], np.uint32).ravel()
    parameters.update()
    return mesh


# Before a lamp at a position.
OCCLUDERS = {
    "plain shape": lambda at: {"ball": ball(at)},
    "lamp": lambda at: {"ball": ball(at, emitter={"type": "area", "radiance": uniform(0.3)})},
    "grating": lambda at: {"ball": ball(at, bsdf=blaze(2.0))},
    "shape of the grating": lambda at: {"plate": plate_with_screen(at)},
    "instance": instance,
    "mesh with alpha": lambda at: {"mesh": mesh_with_alpha(at)},
}


def by_product(built, count=2**16, seed=0):
    sampler, ray, weight = rays(built, count, seed)
    eye, _ = mi.load_dict({"type": "diffraction_path", "max_depth": 2}).parts(built, built.sensors()[0])
    if hasattr(eye, "trace"):
        return bins(*received(eye.trace(built, sampler, ray, weight)[0]))
    return bins(ray.wavelengths, eye.sample(built, sampler, ray)[0] * weight)


def assert_bins_agree(built, judge="path", count=2**19):
    (wanted, its_error), (found, error) = by_path(built, count=count, integrator=judge), by_product(built)
    assert (np.hypot(error, its_error) <= 0.03 * wanted.max()).all()
    np.testing.assert_array_less(np.abs(found - wanted), 4 * np.hypot(error, its_error) + 1e-6)
    return wanted


@pytest.mark.slow
def test_a_hidden_lamp_is_dark_beside_another():
    """Two suns, one of them hidden: the sum over wavelengths of the other."""
    other = {"other": LAMPS["sun"](ORDERS[1])}
    hidden = {"hidden": LAMPS["sun"](AT[0]), "ball": ball(AT[0])}
    wanted = sums_over_wavelengths(scene(blaze(), other))
    found, error = by_lamps(scene(blaze(), {**other, **hidden}), 2**15)
    assert (error < 0.02 * wanted.max()).all()
    np.testing.assert_array_less(np.abs(found - wanted), 4 * error + 1e-3 * wanted.max())


@pytest.mark.few(1)
@pytest.mark.parametrize(("weight", "radius"), [(0.0, 0.7), (1.0, 0.1)])
def test_an_area_lamp_keeps_its_light_beside_lamps_without_extent(weight, radius):
    """Beside a bulb, and a lamp whose direction no sample finds; as often found by candidates, if small, as drawn."""
    lamps = {"area": LAMPS["area"](AT[0], radius=radius, sampling_weight=weight), "bulb": LAMPS["bulb"](AT[1])}
    lamps["directed"] = LAMPS["directionalarea"](ORDERS[1])
    assert_bins_agree(scene(blaze(2.0), lamps), count=2**17)


def test_a_sky_beside_a_bulb_is_weighted_by_the_probability_that_it_is_drawn():
    """On lobes so wide that the BSDF and the sky find each other's directions."""
    lamps = {"sky": {"type": "constant", "radiance": uniform(0.5)}, "bulb": LAMPS["bulb"](AT[1])}
    assert_bins_agree(scene(blaze(1.0), lamps), count=2**18)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("hidden", "other", "occluder"),
    [
        (*pair, occluder)
        for pair in (("sun", "sun"), ("bulb", "bulb"), ("spot", "sun"), ("projector", "bulb"))
        for occluder in OCCLUDERS
    ],
)
def test_shadows_beside_another_lamp_are_those_of_volpath(hidden, other, occluder):
    lamps = {"hidden": LAMPS[hidden](AT[0]), "other": LAMPS[other](AT[1])}
    # In `volpath` light samples pass through alpha; in `path` they do not.
    judge = "path" if occluder == "mesh with alpha" else "volpath"
    wanted = assert_bins_agree(scene(blaze(2.0), {**lamps, **OCCLUDERS[occluder](AT[0])}), judge)
    # Without the shadow the check would fail.
    lit, _ = by_path(scene(blaze(2.0), lamps), count=2**14)
    assert (np.abs(lit - wanted) > 0.2 * wanted.max()).any()


def pairs(others):
    """Each kind of lamp beside others and alone, and each of them with each `sampling_weight`."""
    for one, other, weight in covering([*LAMPS], [None, *others], [1.0, 0.3, 4.0, 0.0]):
        # A scene has one environment, and draws at least one lamp.
        if not {one, other} <= SKIES:
            yield one, other, 1.0 if other is None else weight


def two_lamps(one, other, weight):
    lamps = {"one": LAMPS[one](AT[0], sampling_weight=weight)}
    return lamps if other is None else {**lamps, "other": LAMPS[other](AT[1])}


@pytest.mark.slow
@pytest.mark.parametrize(("one", "other", "weight"), list(pairs(LAMPS)))
def test_pairs_of_lamps_at_a_grating_have_the_bins_of_path(one, other, weight):
    assert_bins_agree(scene(blaze(2.0), two_lamps(one, other, weight)))


@pytest.mark.slow
@pytest.mark.parametrize(("one", "other", "weight"), list(pairs(["bulb", "area"])))
def test_pairs_of_lamps_at_a_wall_have_the_means_of_path(one, other, weight):
    """With the light that a grating casts onto it."""
    built = room(plate=plate(blaze(1.5), height=0.4), **two_lamps(one, other, weight))
    integrators = [mi.load_dict({"type": name, "max_depth": 3}) for name in ("path", "diffraction_path")]
    (wanted, its_error), (found, error) = (region_means(built, each, 1024) for each in integrators)
    np.testing.assert_array_less(np.abs(found - wanted), 4 * np.hypot(its_error, error) + 1e-6)
