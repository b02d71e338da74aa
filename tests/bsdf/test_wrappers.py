"""The grating inside Mitsuba's own wrappers, and with textures of orientations."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from bsdf_support import (
    bitmap,
    direction,
    draw,
    evaluate,
    grating,
    hemisphere,
    interaction,
    random_directions,
    uniform,
    vectors,
)

DIFFUSE = {"type": "diffuse", "reflectance": uniform(0.5)}
TILT = np.array([0.25, -0.15, 1.0]) / np.linalg.norm([0.25, -0.15, 1.0])


pytestmark = pytest.mark.usefixtures("llvm")


def wide(**parameters):
    """Return a plugin with lobes wide enough for quadrature on a coarse grid; without E, which takes long."""
    return grating("corner", 3.0, conserve_energy=False, **parameters)


def slope(tangent):
    """Return a displacement that increases by `tangent` per unit of u: n' ∝ (−tangent, 0, 1) where dp_du = x."""
    values = np.tile((np.arange(64) + 0.5) / 64 * tangent, (64, 1))[..., None]
    return bitmap(values)


def constant(value):
    return bitmap(np.tile(value, (2, 2, 1)), filter_type="nearest")


UNSHADOWED = {"use_shadowing_function": False}
WRAPPERS = {
    "twosided": lambda: {"type": "twosided", "nested": wide()},
    "blendbsdf": lambda: {"type": "blendbsdf", "weight": 0.3, "first": wide(), "second": DIFFUSE},
    "mask": lambda: {"type": "mask", "opacity": 0.4, "nested": wide()},
    "bumpmap": lambda: {"type": "bumpmap", "texture": slope(0.2), "nested": wide(), **UNSHADOWED},
    "normalmap": lambda: {"type": "normalmap", "normalmap": constant(TILT / 2 + 0.5), "nested": wide(), **UNSHADOWED},
}


def tilted(normal, omega):
    """Return ω in the frame of `normal`, whose x axis is x minus its component along the normal."""
    x = np.array([1.0, 0, 0]) - normal * normal[0]
    x /= np.linalg.norm(x)
    return omega @ np.stack([x, np.cross(normal, x), normal]).T


def expected(name, wi, wo):
    """Return f cos θ_o of a wrapper from that of the grating alone."""
    plain = mi.load_dict(wide())
    if name == "twosided":
        return evaluate(plain, wi, wo)[0]
    if name == "blendbsdf":
        return 0.7 * evaluate(plain, wi, wo)[0] + 0.3 * 0.5 / np.pi * wo[:, 2]
    if name == "mask":
        return 0.4 * evaluate(plain, wi, wo)[0]
    normal = TILT if name == "normalmap" else np.array([-0.2, 0, 1]) / np.hypot(0.2, 1)
    return evaluate(plain, tilted(normal, wi), tilted(normal, wo))[0]


UV = [(0.5, 0.5)]


@pytest.mark.few(1)
@pytest.mark.parametrize("name", sorted(WRAPPERS))
def test_value_is_that_of_the_grating_inside(name):
    rng = np.random.default_rng(1)
    wi, wo = random_directions(rng, 1000, 0.4), random_directions(rng, 1000, 0.4)
    found = evaluate(mi.load_dict(WRAPPERS[name]()), wi, wo, uv=UV)[0]
    wanted = expected(name, wi, wo)
    assert np.median(wanted) > 1e-6
    np.testing.assert_allclose(found, wanted, rtol=5e-3, atol=1e-3 * np.quantile(wanted, 0.9))
    if name != "twosided":
        # The test would see it if the wrapper did nothing.
        assert np.abs(evaluate(mi.load_dict(wide()), wi, wo)[0] - wanted).max() > 0.05 * wanted.max()


@pytest.mark.few(1)
@pytest.mark.parametrize("name", sorted(WRAPPERS))
def test_weights_average_to_the_albedo(name):
    bsdf, wi, count = mi.load_dict(WRAPPERS[name]()), direction(25, 40), 1 << 17
    bs, weight = draw(bsdf, wi, count, uv=UV)
    null = np.array(mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null)) & np.ones(count, bool)
    assert np.isfinite(weight).all()
    assert (weight >= 0).all()
    if name == "mask":
        np.testing.assert_allclose(null.mean(), 0.6, atol=0.01)
        np.testing.assert_allclose(np.where(null, weight, 0).mean(1), 0.6, atol=0.01)
    else:
        assert not null.any()
    weight = np.where(null, 0, weight)
    wo, area = hemisphere()
    albedo = (evaluate(bsdf, wi, wo, uv=UV)[0] / wo[:, 2]).sum(1) * area
    error = weight.std(1) / np.sqrt(count)
    np.testing.assert_array_less(np.abs(weight.mean(1) - albedo), 4 * error + 5e-3 * albedo)
    assert albedo.min() > 0.2


@pytest.mark.slow
def test_back_of_twosided_is_the_front_with_z_reversed():
    bsdf, rng = mi.load_dict(WRAPPERS["twosided"]()), np.random.default_rng(2)
    wi, wo = random_directions(rng, 300), random_directions(rng, 300)
    back = evaluate(bsdf, wi * [1, 1, -1], wo * [1, 1, -1])
    for found, wanted in zip(back, evaluate(bsdf, wi, wo), strict=True):
        assert wanted.max() > 0
        np.testing.assert_allclose(found, wanted, rtol=1e-5)
    bs, weight = draw(bsdf, direction(30, 20) * [1, 1, -1], 1 << 12)
    assert (np.array(bs.wo)[2][np.array(bs.pdf) > 0] < 0).all()
    assert weight.mean() > 0.5


@pytest.mark.slow
def test_twosided_takes_another_grating_for_its_back():
    bsdf = mi.load_dict({"type": "twosided", "front": wide(), "back": wide(orientation=90.0)})
    wi, wo = direction(20, 10), random_directions(np.random.default_rng(3), 100)
    for turn, sign in ((0.0, 1), (90.0, -1)):
        wanted = evaluate(mi.load_dict(wide(orientation=turn)), wi, wo)[0]
        found = evaluate(bsdf, wi * [1, 1, sign], wo * [1, 1, sign])[0]
        np.testing.assert_allclose(found, wanted, rtol=1e-4, atol=1e-6)


@pytest.mark.slow
def test_a_blend_follows_its_texture():
    weights = bitmap([[[0.1], [0.8]], [[0.1], [0.8]]], filter_type="nearest")
    bsdf = mi.load_dict({"type": "blendbsdf", "weight": weights, "first": wide(), "second": DIFFUSE})
    wi, wo = direction(20, 10), random_directions(np.random.default_rng(4), 100)
    plain, diffuse = (evaluate(mi.load_dict(x), wi, wo)[0] for x in (wide(), DIFFUSE))
    for u, weight in ((0.25, 0.1), (0.75, 0.8)):
        found = evaluate(bsdf, wi, wo, uv=[(u, 0.5)])[0]
        np.testing.assert_allclose(found, (1 - weight) * plain + weight * diffuse, rtol=1e-4)


TURNS = {
    # texture, and the angle at u = 1/4 and u = 3/4
    "bitmap": (lambda: bitmap([[[20.0], [110.0]], [[20.0], [110.0]]], filter_type="nearest"), (20.0, 110.0)),
    "checkerboard": (
        lambda: {"type": "checkerboard", "color0": uniform(10.0), "color1": uniform(40.0)},
        (40.0, 10.0),
    ),
}


@pytest.mark.few(1)
@pytest.mark.parametrize("name", sorted(TURNS))
def test_a_texture_rotates_the_pattern(name):
    texture, angles = TURNS[name]
    bsdf = mi.load_dict(wide(orientation=texture()))
    assert bsdf.flags() & +mi.BSDFFlags.SpatiallyVarying
    rng, count = np.random.default_rng(5), 400
    wi, wo = random_directions(rng, count), random_directions(rng, count)
    left = rng.random(count) < 0.5
    uv = np.stack([np.where(left, 0.25, 0.75), np.full(count, 0.25)], -1)
    one, other = (evaluate(mi.load_dict(wide(orientation=angle)), wi, wo) for angle in angles)
    for found, a, b in zip(evaluate(bsdf, wi, wo, uv=uv), one, other, strict=True):
        assert np.abs(a - b).max() > 0.1 * a.max()
        np.testing.assert_allclose(found, np.where(left, a, b), rtol=1e-3, atol=1e-4 * a.max())
    for u, angle in zip((0.25, 0.75), angles, strict=True):
        found, wanted = (
            draw(bsdf, wi[0], 4096, uv=[(u, 0.25)]),
            draw(mi.load_dict(wide(orientation=angle)), wi[0], 4096),
        )
        np.testing.assert_allclose(np.array(found[0].wo), np.array(wanted[0].wo), atol=1e-4)
        np.testing.assert_allclose(found[1], wanted[1], rtol=1e-3, atol=1e-4)


def test_number_as_orientation_does_not_vary():
    assert not mi.load_dict(wide(orientation=30.0)).flags() & +mi.BSDFFlags.SpatiallyVarying


def picture(bsdf, integrator="path"):
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": integrator, "max_depth": 4},
            "sky": {"type": "constant", "radiance": uniform(1.0)},
            "sun": {"type": "directional", "direction": [0.3, 0.5, -1], "irradiance": uniform(2.0)},
            "sensor": {
                "type": "perspective",
                "fov": 40,
                "to_world": mi.ScalarTransform4f().look_at([0, -3, 2], [0, 0, 0], [0, 0, 1]),
                "film": {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}},
            },
            "sphere": {"type": "sphere", "bsdf": bsdf},
            "floor": {
                "type": "rectangle",
                "to_world": mi.ScalarTransform4f().translate([0, 0, -1]).scale([4, 4, 1]),
                "bsdf": bsdf,
            },
        }
    )
    return np.array(mi.render(scene, spp=16))


@pytest.mark.few(1)
@pytest.mark.parametrize("name", sorted(WRAPPERS))
def test_picture_has_no_nan(name):
    image = picture(WRAPPERS[name]())
    assert np.isfinite(image).all()
    assert image.mean() > 0.1


@pytest.mark.slow
def test_wrappers_can_be_nested():
    inner = {**WRAPPERS["normalmap"](), "nested": grating("elaphe", 26.0, int_ior=1.5, base=DIFFUSE)}
    bsdf = mi.load_dict({"type": "twosided", "nested": {"type": "mask", "opacity": 1.0, "nested": inner}}["nested"])
    si = interaction(direction(20), uv=UV)
    value = bsdf.eval(mi.BSDFContext(), si, vectors(direction(30, 180)))
    assert dr.all(value > 0, axis=None)
    assert np.isfinite(picture({"type": "twosided", "nested": inner})).all()
