"""What tracing makes of a scene once: frames after an update are those of a scene loaded anew, and nothing holds it."""

from __future__ import annotations

import gc

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from bsdf_support import uniform

from mitsuba_diffraction.bsdf.base import living
from mitsuba_diffraction.integrator.scene_cache import SceneCache
from mitsuba_diffraction.integrator.unshadowed_light import UnshadowedLight

pytestmark = pytest.mark.usefixtures("llvm")


def at(x: float, y: float, z: float, scale: float = 0.2) -> mi.ScalarTransform4f:
    return mi.ScalarTransform4f().translate([x, y, z]).scale(scale)


def seen_from(x: float) -> mi.ScalarTransform4f:
    return mi.ScalarTransform4f().look_at([x, -3, 3], [0, 0, 0], [0, 0, 1])


def loaded(
    depth: int = 2,
    lamp: mi.ScalarTransform4f | None = None,
    radiance: float = 5.0,
    weight: float = 1.0,
    sky: float = 1e-3,
    plate: mi.ScalarTransform4f | None = None,
    height_scale: float = 1.0,
    camera: float = 0.0,
    size: int = 8,
    wall: float = 0.5,
    coherence_length: float = 65.0,
) -> mi.Scene:
    """A grating under a dim sky and a lamp, on a wall if the depth is 3."""
    emitter = {"type": "area", "radiance": uniform(radiance), "sampling_weight": weight}
    grating = {
        "type": "diffraction_grating",
        "profile": "blazed",
        "period": 2.5,
        "depth": 0.25,
        "coherence_length": 2.0,
    }
    grating |= {"conserve_energy": False, "material": "none", "height_scale": height_scale}
    grating["coherence_length"] = coherence_length
    film = {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}}
    shapes = {"plate": {"type": "rectangle", "to_world": plate or at(0, 0, 0, 1), "bsdf": grating}}
    if depth > 2:
        diffuse = {"type": "diffuse", "reflectance": uniform(wall)}
        shapes["wall"] = {"type": "rectangle", "to_world": at(0, 0, -1, 4), "bsdf": diffuse}
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "diffraction_path", "max_depth": depth},
            "sensor": {"type": "perspective", "fov": 40, "to_world": seen_from(camera), "film": film},
            "sky": {"type": "constant", "radiance": uniform(sky)},
            "lamp": {"type": "sphere", "to_world": lamp or at(1, 1, 2), "emitter": emitter},
            **shapes,
        }
    )


# Each is an update of parameters, and the same at loading.
UPDATES = {
    "lamp moved": lambda: ({"lamp.to_world": at(-1, 0, 1.5)}, {"lamp": at(-1, 0, 1.5)}),
    "lamp resized": lambda: ({"lamp.to_world": at(1, 1, 2, 0.6)}, {"lamp": at(1, 1, 2, 0.6)}),
    "lamp recoloured": lambda: ({"lamp.emitter.radiance.value": 20.0}, {"radiance": 20.0}),
    "lamp drawn more often": lambda: ({"lamp.emitter.sampling_weight": 3.0}, {"weight": 3.0}),
    "sky": lambda: ({"sky.radiance.value": 4.0}, {"sky": 4.0}),
    "shape": lambda: ({"plate.to_world": at(0.3, 0, 1.6, 0.5)}, {"plate": at(0.3, 0, 1.6, 0.5)}),
    "grating": lambda: ({"plate.bsdf.height_scale": 0.3}, {"height_scale": 0.3}),
    "sensor": lambda: ({"sensor.to_world": seen_from(1.0)}, {"camera": 1.0}),
    "film": lambda: ({"sensor.film.size": [12, 12], "sensor.film.crop_size": [12, 12]}, {"size": 12}),
    "wall": lambda: ({"wall.bsdf.reflectance.value": 0.02}, {"wall": 0.02}),
}


def update(scene: mi.Object, changes: dict) -> None:
    parameters = mi.traverse(scene)
    for name, value in changes.items():
        parameters[name] = value
    parameters.update()


def guide_and_slots(scene: mi.Scene) -> list[np.ndarray]:
    """h in directions from a few points, and J of the grating."""
    eye, _ = scene.integrator().parts(scene, scene.sensors()[0])
    rng = np.random.default_rng(0)
    points, omega = (mi.Vector3f(*map(mi.Float, rng.normal(size=(3, 4000)))) for _ in range(2))
    if not hasattr(eye, "candidates"):
        return []
    si = dr.zeros(mi.SurfaceInteraction3f)
    si.shape = mi.ShapePtr(next(shape for shape in scene.shapes() if not shape.is_emitter()))
    slots = eye.candidates.numbers(si, mi.Bool(False), mi.Bool(True))[0]
    return [np.array(eye.candidates.light(points, dr.normalize(omega), mi.Bool(True))), np.array(slots)]


@pytest.mark.parametrize("name", [name for name in UPDATES if name != "wall"])
def test_an_updated_scene_has_the_guide_and_candidates_of_one_loaded_anew(name):
    changes, again = UPDATES[name]()
    # Wide lobes have no candidates under a sky that is as bright as the lamp.
    again |= {"coherence_length": 2.0} if name == "sky" else {}
    scene = loaded(coherence_length=again.get("coherence_length", 65.0))
    before = guide_and_slots(scene)
    update(scene, changes)
    found, expected = guide_and_slots(scene), guide_and_slots(loaded(**again))
    assert len(found) == len(expected)
    for a, b in zip(found, expected, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-5)
    if name in ("lamp moved", "lamp resized", "lamp recoloured"):
        assert np.mean(found[0] != before[0]) > 1e-3
    if name == "sky":
        assert not found


def test_numbers_written_through_numpy_are_noticed():
    scene = loaded()
    guide_and_slots(scene)
    parameters = mi.traverse(scene)
    parameters["lamp.emitter.radiance.value"].numpy()[:] = 20.0
    parameters.update()
    for a, b in zip(guide_and_slots(scene), guide_and_slots(loaded(radiance=20.0)), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("name", UPDATES)
def test_a_frame_after_an_update_is_that_of_a_scene_loaded_anew(name):
    changes, again = UPDATES[name]()
    scene = loaded(3)
    before = np.array(mi.render(scene, spp=16, seed=1))
    update(scene, changes)
    fresh = loaded(3, **again)
    found, expected = (np.array(mi.render(built, spp=16, seed=1)) for built in (scene, fresh))
    assert found.shape == expected.shape
    # Positions differ by rounding, by which a few paths meet another surface.
    same = np.isclose(found, expected, rtol=1e-3, atol=1e-4 * expected.max())
    assert same.mean() > 0.97
    of_light = [built.integrator().parts(built, built.sensors()[0])[1].per_sample for built in (scene, fresh)]
    assert of_light[0] == of_light[1]
    if name != "film":
        assert np.isclose(found, before, rtol=1e-3).mean() < 0.9


def test_what_a_scene_needs_is_made_once(monkeypatch):
    made, make = [], UnshadowedLight.__init__
    monkeypatch.setattr(UnshadowedLight, "__init__", lambda self, scene: made.append(0) or make(self, scene))
    scene = loaded()
    for frame in range(3):
        guide_and_slots(scene)
        mi.render(scene, spp=1, seed=frame)
    assert len(made) == 1


def test_parameters_without_a_value_are_left_out():
    # `hair` lists `sigma_a`, though it has pigments instead.
    cache = SceneCache()
    scene = mi.load_dict({"type": "scene", "wig": {"type": "sphere", "bsdf": {"type": "hair"}}})
    cache.follow(scene, mi.load_dict({"type": "perspective"}))
    assert cache.once("number", lambda: 1) == cache.once("number", lambda: 2) == 1


def test_a_change_of_any_number_of_the_scene_or_of_a_sensor_beside_it_is_noticed():
    scene, cache, made = loaded(), SceneCache(), []
    apart = mi.load_dict({"type": "perspective", "fov": 40, "to_world": seen_from(1.0)})

    def count() -> int:
        cache.follow(scene, apart)
        cache.once("number", lambda: made.append(0))
        return len(made)

    changed = 0
    for of in (scene, apart):
        for name, value in mi.traverse(of).items():
            if isinstance(value, mi.Float) and dr.width(value) == 1:
                before = count()
                assert count() == before
                update(of, {name: 0.9 * value})
                assert count() == before + 1, name
                changed += of is apart
    assert changed


def test_a_scene_is_freed_by_its_last_reference():
    scene, count = loaded(), len(living)
    mi.render(scene, spp=1)
    assert not gc.isenabled()
    del scene
    assert len(living) == count - 1
