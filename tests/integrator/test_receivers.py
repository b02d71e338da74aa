"""Light that gratings cast onto each kind of surface, the only one beside gratings and lamps, alone: depth 3 less 2."""

import mitsuba as mi
import numpy as np
import pytest
from bsdf_support import bitmap, of_spectrum, uniform
from covering import covering
from test_diffraction_path import blaze, plate, scene, tilted_normals

import mitsuba_diffraction as md
from mitsuba_diffraction.evaluation.validation.scene_pictures import PICTURES, PictureDifference, reference_integrator


def rgb(*value):
    return {"type": "rgb", "value": value}


def diffuse(reflectance):
    return {"type": "diffuse", "reflectance": reflectance}


def spectrum():
    return {"type": "spectrum", "value": [(360.0, 0.2), (500.0, 0.8), (600.0, 0.3), (830.0, 0.6)]}


RECEIVERS = {
    "default": lambda: None,
    **{f"rgb {grey:g}": lambda grey=grey: diffuse(rgb(grey, grey, grey)) for grey in (0.0, 0.2, 0.5, 1.0)},
    "spectrum": lambda: diffuse(spectrum()),
    "uniform": lambda: diffuse(uniform(0.4)),
    "bitmap": lambda: diffuse(
        {"type": "bitmap", "bitmap": mi.Bitmap(np.float32([[[0.8, 0.2, 0.1], [0.1, 0.3, 0.9]]]))}
    ),
    "checkerboard": lambda: diffuse(
        {"type": "checkerboard", "color0": rgb(0.5, 0.5, 0.5), "color1": rgb(0.1, 0.7, 0.2)}
    ),
    "twosided": lambda: {"type": "twosided", "bsdf": diffuse(rgb(0.5, 0.5, 0.5))},
    "blendbsdf": lambda: {
        **{"type": "blendbsdf", "weight": 0.4, "first": diffuse(rgb(0.5, 0.5, 0.5))},
        "second": {"type": "roughconductor", "alpha": 0.4},
    },
    "bumpmap": lambda: {
        **{"type": "bumpmap", "scale": 0.3, "nested": diffuse(rgb(0.5, 0.5, 0.5))},
        "height": bitmap(np.random.default_rng(1).random((4, 4))),
    },
    "normalmap": lambda: {"type": "normalmap", "normalmap": tilted_normals(20), "bsdf": diffuse(rgb(0.5, 0.5, 0.5))},
    "roughplastic": lambda: {"type": "roughplastic", "alpha": 0.3, "diffuse_reflectance": rgb(0.5, 0.5, 0.5)},
    "principled": lambda: {"type": "principled", "base_color": rgb(0.5, 0.5, 0.5), "roughness": 0.5, "metallic": 0.5},
}


def film():
    height_field = md.gratings.blazed(2.5, 0.5)
    spectrum = md.precompute(height_field, coherence_length=1.5, wavelengths=(230, 830))
    return of_spectrum(spectrum, int_ior=1.5, transmission="sheet", conserve_energy=False)


GRATINGS = {
    "reflection": lambda: {"type": "sphere", "center": [0, 0, 0.8], "radius": 0.8, "bsdf": blaze(material="Al")},
    "mirror": lambda: {"type": "sphere", "center": [0, 0, 0.8], "radius": 0.8, "bsdf": blaze(material="none")},
    "transmission": lambda: plate(film(), 1.2, 1.0),
}
LAMPS = {
    "lamp": lambda: {
        **{"type": "sphere", "center": [0.4, -1.5, 3.5], "radius": 0.6},
        "emitter": {"type": "area", "radiance": uniform(3.0)},
    },
    "sky": lambda: {"type": "constant", "radiance": uniform(0.5)},
    # As wide as Mitsuba's integrators find it by a grating.
    "sun": lambda: {
        **{"type": "sunsky", "sun_aperture": 8.0, "sun_scale": 0.05, "sky_scale": 0.0},
        "sun_direction": [0.3, -0.4, 0.85],
    },
}


def cast_light(receiver, grating, lamp):
    """Pictures at depths 3 and 2, by both integrators."""
    floor = {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(4)}
    if (bsdf := RECEIVERS[receiver]()) is not None:
        floor["bsdf"] = bsdf
    # In the place of the wall.
    built = scene(floor=floor, wall=GRATINGS[grating](), lamp=LAMPS[lamp]())
    found, seed = {}, 0
    for name in ("diffraction_path", reference_integrator(built)):
        traced = [mi.load_dict({"type": name, "max_depth": depth}) for depth in (3, 2)]
        found[name] = []
        for _ in range(PICTURES):
            # With equal random numbers, direct light cancels.
            deep, shallow = (np.array(mi.render(built, integrator=each, spp=1024, seed=seed)) for each in traced)
            found[name].append(deep - shallow)
            seed += 1
    return list(found.values())


@pytest.mark.slow
@pytest.mark.parametrize(("receiver", "grating", "lamp"), covering(list(RECEIVERS), list(GRATINGS), list(LAMPS)))
def test_cast_light_is_that_of_mitsubas_integrator(receiver, grating, lamp, llvm):
    found, wanted = cast_light(receiver, grating, lamp)
    # Where little light is cast, a few bright paths decide.
    difference = PictureDifference.of(found, wanted, blocks=1)
    assert difference.is_noise, (difference.deviation, difference.at, difference.ratio)
    # What is cast stands out of the noise.
    if receiver != "rgb 0":
        assert 20 * difference.error < 1
