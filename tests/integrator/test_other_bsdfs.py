"""The integrator `diffraction_path` with the BSDFs of Mitsuba: it converges to the limit of `path`."""

from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from bsdf_support import WAVELENGTHS, array, bitmap, floats, random_directions, uniform
from test_diffraction_path import SKY, SUN, assert_agree, blaze, plate, region_means, scene, tilted_normals

from mitsuba_diffraction.bsdf.testing import interaction
from mitsuba_diffraction.evaluation.validation.scene_pictures import reference_integrator
from mitsuba_diffraction.integrator.paths import LightPaths


def colors():
    """A texture of saturated colors."""
    rgb = [[[0.9, 0.1, 0.1], [0.1, 0.8, 0.2]], [[0.1, 0.2, 0.9], [0.8, 0.7, 0.1]]]
    return {"type": "bitmap", "bitmap": mi.Bitmap(np.float32(rgb))}


def numbers(low, high):
    return bitmap([[low, high], [high, low]])


def rgb(*value):
    return {"type": "rgb", "value": value}


def glossy():
    return {"type": "roughconductor", "material": "Cu", "alpha_u": 0.2, "alpha_v": 0.4}


BSDFS = {
    "principled": lambda: {
        **{"type": "principled", "base_color": colors(), "roughness": numbers(0.2, 0.6), "metallic": numbers(0.1, 0.5)},
        **{"spec_tint": 1.0, "specular": 0.5, "sheen": 0.5, "sheen_tint": 1.0, "clearcoat": 0.5, "anisotropic": 0.5},
        **{"clearcoat_gloss": 0.5, "flatness": 0.5},
    },
    "principled glass": lambda: {
        **{"type": "principled", "base_color": colors(), "roughness": 0.4, "spec_trans": 0.7, "eta": 1.4},
        "spec_tint": 1.0,
    },
    "principledthin": lambda: {
        **{"type": "principledthin", "base_color": colors(), "roughness": 0.4, "spec_trans": 0.4, "diff_trans": 0.6},
        **{"spec_tint": 1.0, "sheen": 0.5, "sheen_tint": 1.0, "eta": 1.4},
    },
    "diffuse": lambda: {"type": "diffuse", "reflectance": colors()},
    "plastic": lambda: {"type": "plastic", "diffuse_reflectance": colors(), "nonlinear": True},
    "roughplastic": lambda: {
        **{"type": "roughplastic", "diffuse_reflectance": colors(), "specular_reflectance": rgb(0.9, 0.5, 0.2)},
        **{"nonlinear": True, "alpha": 0.3},
    },
    "pplastic": lambda: {"type": "pplastic", "diffuse_reflectance": colors(), "alpha": 0.3},
    "conductor": lambda: {"type": "conductor", "material": "Cu"},
    "roughconductor": glossy,
    "dielectric": lambda: {"type": "dielectric", "specular_transmittance": rgb(0.9, 0.5, 0.2)},
    "thindielectric": lambda: {"type": "thindielectric", "specular_reflectance": colors()},
    "roughdielectric": lambda: {"type": "roughdielectric", "alpha": numbers(0.2, 0.5)},
    "null": lambda: {"type": "null"},
    "polarizer": lambda: {"type": "polarizer"},
    "circular": lambda: {"type": "circular"},
    "retarder": lambda: {"type": "retarder"},
    "mask": lambda: {"type": "mask", "opacity": numbers(0.3, 0.8), "nested": glossy()},
    "blendbsdf": lambda: {
        **{"type": "blendbsdf", "weight": numbers(0.2, 0.8)},
        **{"first": glossy(), "second": {"type": "plastic", "diffuse_reflectance": colors()}},
    },
    "twosided": lambda: {"type": "twosided", "front": {"type": "diffuse", "reflectance": colors()}, "back": glossy()},
    "bumpmap": lambda: {
        **{"type": "bumpmap", "scale": 0.5, "nested": {"type": "roughplastic", "diffuse_reflectance": colors()}},
        "height": bitmap(np.random.default_rng(1).random((4, 4))),
    },
    "normalmap": lambda: {"type": "normalmap", "normalmap": tilted_normals(30), "nested": {"type": "conductor"}},
    "normalmap of glass": lambda: {
        "type": "normalmap",
        "normalmap": tilted_normals(30),
        "bsdf": {"type": "dielectric"},
    },
    "hair": lambda: {"type": "hair", "int_ior": 1.55},
}


def above(bsdf, coherence_length):
    """A grating above a floor, in the sun."""
    floor = {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(4), "bsdf": bsdf}
    return scene(plate=plate(blaze(coherence_length, material="Al"), height=0.4), floor=floor, sun=SUN, sky=SKY)


@pytest.mark.slow
@pytest.mark.parametrize("name", BSDFS)
def test_every_bsdf_of_mitsuba_converges_to_the_limit_of_path(name, llvm):
    assert_agree(above(BSDFS[name](), 1.5), 12, 1024)


@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize(
    "bsdf",
    [
        {"type": "dielectric", "int_ior": 1.5},
        {"type": "dielectric", "int_ior": 0.8},
        {"type": "thindielectric", "int_ior": 1.5},
        {"type": "twosided", "bsdf": {"type": "conductor", "material": "none"}},
        {"type": "null"},
    ],
)
def test_a_path_from_the_light_keeps_its_power_at_a_surface_that_absorbs_nothing(llvm, bsdf, side):
    """Whether it is reflected or refracted, from either medium; a scene in which the eye is outside hides a factor."""
    rng = np.random.default_rng(8)
    wi = random_directions(rng, 256)
    u = floats(rng.random(256))
    si = interaction(wi * [1, 1, side], WAVELENGTHS)
    tracer = SimpleNamespace(gratings=SimpleNamespace(only=True, is_mixture=lambda si, active: mi.Bool(False)))
    ray, power, specular = LightPaths._scatter(
        tracer, si, mi.load_dict(bsdf), mi.Spectrum(1), mi.Bool(False), u, mi.Point2f(0.5), mi.Bool(True)
    )
    dr.eval(ray, power, specular)
    assert np.array(specular).all()
    np.testing.assert_allclose(array(power), 1, rtol=1e-4)


@pytest.mark.slow
def test_a_tinted_bsdf_is_no_noisier_than_with_path(llvm):
    """Its color is a quotient by the mean over the four wavelengths, which are not replaced there."""
    tinted = {"type": "principled", "base_color": rgb(0.8, 0.05, 0.02), "specular": 0.5, "spec_tint": 1.0}
    built = above(tinted, 26.0)
    integrators = [mi.load_dict({"type": name, "max_depth": 12}) for name in ("path", "diffraction_path")]
    (wanted, its_error), (found, error) = (region_means(built, each, 256, 48) for each in integrators)
    np.testing.assert_array_less(np.abs(found - wanted), 4 * np.hypot(its_error, error))
    assert error.max() < its_error.max()


@pytest.mark.slow
def test_the_opacity_of_a_mask_counts_once(llvm):
    """`path` of Mitsuba 3.9.1 returns no light where a ray leaves the scene after null interactions alone."""
    masked = {"type": "mask", "opacity": 0.7, "nested": {"type": "diffuse", "reflectance": rgb(0.5, 0.5, 0.5)}}
    floor = {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(40), "bsdf": masked}
    sensor = {"to_world": mi.ScalarTransform4f().look_at([9, 9, 4], [9, 9, 0], [0, 1, 0])}
    # The grating, which is not in the picture, casts no light as far as that.
    built = scene(sensor, floor=floor, wall=plate(blaze(), 0.01, height=30), sun=SUN)
    means = {
        name: np.array(mi.render(built, integrator=mi.load_dict({"type": name}), spp=1024)).mean()
        for name in ("volpath", "prb", "path", "diffraction_path")
    }
    assert reference_integrator(built) == "prb"
    assert means["diffraction_path"] == pytest.approx(means["volpath"], rel=0.01)
    assert means["prb"] == pytest.approx(means["volpath"], rel=0.01)
    assert means["path"] == pytest.approx(0.7 * means["volpath"], rel=0.01)


@pytest.mark.few(1)
@pytest.mark.parametrize("kind", ["ellipsoids", "ellipsoidsmesh"])
def test_rays_meet_ellipsoids_from_outside_only(llvm, tmp_path, kind):
    """In Mitsuba 3.9.1; `diffraction_path` is then `path`, and random scenes have none."""
    names = "x y z nx ny nz scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3"
    header = ["ply", "format ascii 1.0", "element vertex 1", *(f"property float {name}" for name in names.split())]
    path = tmp_path / "one.ply"
    path.write_text("\n".join([*header, "end_header", "0 0 0 0 0 0 0.1 0.1 0.1 0 0 0 1", ""]))
    built = mi.load_dict({"type": "scene", "shape": {"type": kind, "filename": str(path)}})
    found = {z: bool(built.ray_test(mi.Ray3f(mi.Point3f(0.01, 0.02, z), mi.Vector3f(0, 0, 1)))[0]) for z in (-20, 0)}
    assert found == {-20: True, 0: False}
    lit = scene(shape={"type": kind, "filename": str(path)}, wall=plate(blaze(), 0.5), sun=SUN)
    integrator = mi.load_dict({"type": "diffraction_path"})
    assert integrator.parts(lit, lit.sensors()[0]) == (integrator.path, None)


@pytest.mark.parametrize("bsdf", ["roughdielectric", "hair", "instance of roughdielectric"])
def test_a_grating_is_seen_through_a_curve_that_transmits_light(llvm, tmp_path, bsdf):
    """Regression: a quarter of its light was lost, as light from below meets the side that rays from the eye miss."""
    path = tmp_path / "curve.txt"
    path.write_text("".join(f"{x} 0 0.5 0.4\n" for x in range(-3, 4)))
    look = mi.ScalarTransform4f().look_at([0, -2, 4], [0, 0, 0], [0, 0, 1])
    film = {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}}
    sensor = {"type": "perspective", "fov": 4, "to_world": look, "film": film}
    curve = {"type": "linearcurve", "filename": str(path), "bsdf": {"type": bsdf.split()[-1]}}
    parts = {"curve": curve}
    if bsdf.startswith("instance"):
        group = {"type": "shapegroup", "curve": curve}
        parts = {"group": group, "copy": {"type": "instance", "group": {"type": "ref", "id": "group"}}}
    lamp = {"type": "point", "position": [-1, -1, 2.7], "intensity": uniform(4.0)}
    built = scene(sensor, **parts, plate=plate(blaze(), 3), lamp=lamp)
    found, expected = (
        np.array(mi.render(built, integrator=mi.load_dict({"type": name, "max_depth": 4}), spp=512)).mean()
        for name in ("diffraction_path", "path")
    )
    assert found == pytest.approx(expected, rel=0.01)
