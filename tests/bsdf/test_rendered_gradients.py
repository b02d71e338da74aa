"""Derivatives through mi.render of every parameter of mi.traverse, against differences of renderings.

Mitsuba differentiates with the seed `seed_grad`: differences of pictures with this seed have the same samples, and
little noise. Only the paths from the light of `diffraction_path` have others than its derivatives.
"""

import itertools

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from bsdf_support import bitmap, uniform

import mitsuba_diffraction as md

pytestmark = pytest.mark.usefixtures("llvm")
TEXELS = np.float32([[0.8, 1.1], [0.9, 1.0]])[..., None]
COPPER = {"material": "Cu"}
METAL = {"eta": uniform(0.8), "k": uniform(3.2)}  # no other object has these values: Mitsuba lists equal ones once
GLASS = {"int_ior": 1.5}
BASE = {**GLASS, "base": {"type": "diffuse", "reflectance": uniform(0.5)}}
FILM = {**GLASS, "thin_film_ior": 2.35, "thin_film_thickness": 0.1}
COATED = {"int_ior": 2.0, "coat_ior": "polycarbonate"}
STACK = {**GLASS, "thin_film_ior": "2.35, 1.38", "thin_film_thickness": "0.1, 0.15"}


def texels(value, offset=0.0):
    return bitmap(value * TEXELS + offset)


# The end of its name, step, and the parameters of the scene.
PARAMETERS = {
    "orientation": ("orientation.value", 0.2, {"orientation": 4.0}),
    "texture of orientations": ("orientation.data", 0.2, {"orientation": texels(4.0)}),
    "height": ("height_scale", 0.01, {"height_scale": 0.9}),
    "texture of heights": ("height_scale.data", 0.01, {"height_scale": texels(0.85)}),
    "lengths as they are": ("lateral_scale", 2e-3, {}),
    "lengths": ("lateral_scale", 2e-3, {"lateral_scale": 1.05}),
    "texture of lengths": ("lateral_scale.data", 2e-3, {"lateral_scale": texels(0.5, 0.5)}),
    "index": ("eta", 0.02, GLASS),
    "index of an interface": ("eta", 3e-3, {**GLASS, "transmission": "interface"}),
    "index of a sheet": ("eta", 3e-3, {**GLASS, "transmission": "sheet"}),
    "index under a coat": ("eta", 0.01, {"int_ior": 2.0, "coat_ior": 1.5}),
    "index under a coat with dispersion": ("eta", 0.01, COATED),
    "heights under a coat with dispersion": ("height_scale", 0.01, COATED),
    "film under a coat with dispersion": ("thin_film_thickness", 1e-3, {**FILM, **COATED}),
    "stack under a coat with dispersion": ("thin_film_thickness", 1e-3, {**STACK, **COATED}),
    "texture of a film on a dispersive interface": (
        "thin_film_thickness.data",
        1e-3,
        {"int_ior": "BK7", "transmission": "interface", "thin_film_ior": 2.35, "thin_film_thickness": texels(0.1)},
    ),
    "eta of metal under a coat with dispersion": ("eta.value", 0.02, {**METAL, "coat_ior": "polycarbonate"}),
    "index over a base": ("eta", 0.02, BASE),
    "index under a film": ("eta", 0.02, FILM),
    "index under a stack": ("eta", 0.02, STACK),
    "eta of copper": ("eta.values", 0.02, COPPER),
    "k of copper": ("k.values", 0.02, COPPER),
    "eta": ("eta.value", 0.02, METAL),
    "k": ("k.value", 0.02, METAL),
    "texture of eta": ("eta.data", 0.02, {**METAL, "eta": texels(0.8)}),
    "texture of k": ("k.data", 0.02, {**METAL, "k": texels(3.0)}),
    "film": ("thin_film_thickness", 1e-3, FILM),
    "texture of a film": ("thin_film_thickness.data", 1e-3, {**FILM, "thin_film_thickness": texels(0.1)}),
    "scale of a film": ("thin_film_scale", 0.01, FILM),
    "texture of scales of a film": ("thin_film_scale.data", 0.01, {**FILM, "thin_film_scale": texels(1.0)}),
    "stack": ("thin_film_thickness", 1e-3, STACK),
    "scale of a stack": ("thin_film_scale", 0.01, STACK),
    "texture of scales of a stack": ("thin_film_scale.data", 0.01, {**STACK, "thin_film_scale": texels(1.0)}),
    "base": ("base.reflectance.value", 0.05, BASE),
    "texture of a base": (
        "base.reflectance.data",
        0.05,
        {**GLASS, "base": {"type": "diffuse", "reflectance": texels(0.5)}},
    ),
}
FLAT = {"type": "bitmap", "raw": True}
WRAPPERS = {
    "bare": lambda bsdf: bsdf,
    "twosided": lambda bsdf: {"type": "twosided", "bsdf": bsdf},
    "normalmap": lambda bsdf: {
        "type": "normalmap",
        "normalmap": {**FLAT, "bitmap": mi.Bitmap(np.tile(np.float32([0.5, 0.5, 1]), (2, 2, 1)))},
        "bsdf": bsdf,
    },
    "bumpmap": lambda bsdf: {
        "type": "bumpmap",
        "height": {**FLAT, "bitmap": mi.Bitmap(np.full((2, 2, 1), 0.5, np.float32))},
        "bsdf": bsdf,
    },
    "mask": lambda bsdf: {"type": "mask", "opacity": 0.8, "bsdf": bsdf},
    "blendbsdf": lambda bsdf: {"type": "blendbsdf", "weight": 0.6, "a": {"type": "diffuse"}, "bsdf": bsdf},
}
SAMPLES = 1024


def rows():
    """A covering array: each parameter by `prb` or `diffraction_path`, each of them with each wrapper.

    `path` is traced in few rows: it evaluates the same BSDF as `prb`, and is recorded in far longer kernels.
    """
    yield "lengths", "bare", "prb"
    nested = itertools.cycle(itertools.product(WRAPPERS, ("diffraction_path", "prb")))
    for name, (_, _, given) in PARAMETERS.items():
        wrapper, integrator = next(nested)
        if wrapper == "twosided" and "transmission" in given:  # refused by Mitsuba
            wrapper = "mask"
        yield name, wrapper, integrator
    for name, wrapper in zip(list(PARAMETERS)[::6], WRAPPERS, strict=True):
        yield name, wrapper, "path"


def scene(bsdf, integrator):
    """A plate and a wall under the sun; the camera sees the slopes of lobes of the first order, near 550 nm."""
    film = {"type": "specfilm", "width": 4, "height": 4, "rfilter": {"type": "box"}, "component_format": "float32"}
    film["band"] = {"type": "regular", "wavelength_min": 450, "wavelength_max": 650, "values": "1, 1"}
    at = mi.ScalarTransform4f()
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": integrator, "max_depth": 3},
            "sky": {"type": "constant", "radiance": uniform(0.01)},
            "sun": {"type": "directional", "direction": [-0.25, 0.012, -1], "irradiance": uniform(3.0)},
            "sensor": {
                "type": "orthographic",
                "to_world": at.look_at([0, 0.03, 2], [0, 0, 0], [0, 1, 0]),
                "film": film,
            },
            "plate": {"type": "rectangle", "bsdf": bsdf},
            "wall": {
                "type": "rectangle",
                "to_world": at.translate([-1.2, 0, 0.5]).rotate([0, 1, 0], 90),
                "bsdf": {"type": "twosided", "bsdf": {"type": "diffuse"}},
            },
        }
    )


@pytest.fixture(scope="module")
def relief():
    """A spectrum for indices up to 2 and scales up to 1.1, whose orders do not overlap."""
    surface = md.gratings.sinusoidal(2.5, 0.25)
    return md.precompute(surface, coherence_length=20.0, wavelengths=(160.0, 830.0), tolerance=1e-3)


@pytest.mark.few(1)
@pytest.mark.parametrize(("name", "wrapper", "integrator"), list(rows()))
def test_the_derivative_of_a_rendering_is_that_of_differences(relief, name, wrapper, integrator):
    end, step, given = PARAMETERS[name]
    of = {"type": "diffraction_grating", "spectrum": relief, "material": "none", **given}
    if "int_ior" in given or "eta" in given:
        del of["material"]
    world = scene(WRAPPERS[wrapper](of), integrator)
    parameters = mi.traverse(world)
    (key,) = (key for key in parameters.keys() if key.endswith(f".{end}") and not key.startswith("wall"))  # noqa: SIM118
    start, kind = np.array(parameters[key], np.float32), type(parameters[key])
    weights = mi.TensorXf(np.random.default_rng(0).uniform(0.5, 1.5, (4, 4, 1)).astype(np.float32))

    def brightness(value, seed):
        parameters[key] = value
        parameters.update()
        image = mi.render(world, parameters, spp=SAMPLES, seed=0, seed_grad=seed)
        return dr.sum(image * weights, axis=None)

    def number(change):
        parameters[key] = kind(start + np.float32(change))
        parameters.update()
        return (np.array(mi.render(world, spp=SAMPLES, seed=1), float) * np.array(weights)).sum()

    x = kind(start)
    dr.enable_grad(x)
    dr.backward(brightness(x, 1))
    found = np.array(dr.grad(x), float).sum()
    wanted = (number(step) - number(-step)) / (2 * step)
    assert abs(wanted) > 0
    np.testing.assert_allclose(found, wanted, rtol=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("start", [0.9, 1.1])
def test_a_search_for_a_period_runs_from_both_sides(start):
    """Of the surface that a scene computes by itself."""
    scene = mi.load_dict(md.example_scene("blazed", size=24, period=1.6, depth=0.2))
    wanted = mi.render(scene, spp=1024, seed=77)
    parameters, key = mi.traverse(scene), "grating.bsdf.lateral_scale"
    search = mi.ad.Adam(lr=0.02, params={"scale": mi.Float(start)})
    for step in range(30):
        search.set_learning_rate(0.02 if step < 15 else 0.005)
        parameters[key] = search["scale"]
        parameters.update()
        dr.backward(dr.mean(dr.square(mi.render(scene, parameters, spp=64, seed=step) - wanted), axis=None))
        search.step()
    assert float(search["scale"][0]) == pytest.approx(1, abs=0.02)
