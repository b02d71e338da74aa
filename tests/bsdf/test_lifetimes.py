"""Gratings are freed by reference counting alone, and scenes can be loaded and rendered in a loop."""

import ast
import functools
import gc
import os
import subprocess
import sys
import weakref
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from bsdf_support import bitmap, made_up

import mitsuba_diffraction as md
from mitsuba_diffraction.bsdf.base import gratings_in
from mitsuba_diffraction.shader_2014.comparison.pictures import same_light

PACKAGE = Path(md.__file__).parent


@functools.cache
def sinusoidal():
    return md.precompute(md.gratings.sinusoidal(2.0, 0.15), wavelengths=(240.0, 830.0))


@functools.cache
def continuum():
    return md.precompute(md.gratings.elaphe_synthetic(8.0), coherence_length=5.0)


def number(value):
    return bitmap(np.full((2, 2, 1), value))


FILM = {"thin_film_ior": 1.38, "thin_film_thickness": 0.1}
MODES = {
    "reflection": lambda: {"material": "Al"},
    "coat": lambda: {"material": "Al", "coat_ior": 1.5},
    "film": lambda: {"material": "Al", **FILM},
    "base": lambda: {"int_ior": 1.5, "base": {"type": "diffuse"}},
    "interface": lambda: {"int_ior": 1.5, "transmission": "interface"},
    "sheet": lambda: {"int_ior": 1.5, "transmission": "sheet"},
    "textures": lambda: {
        "material": "Al",
        "orientation": number(20),
        "height_scale": number(0.5),
        "lateral_scale": number(0.5),
        **FILM,
        "thin_film_thickness": number(0.1),
    },
    "continuum": lambda: {"material": "Al", "spectrum": continuum()},
    "rigorous": lambda: {"material": "Al", "spectrum": made_up(8.0)},
}
FLAT = {"type": "normalmap", "normalmap": lambda: bitmap(np.tile([0.5, 0.5, 1.0], (2, 2, 1)))}
WRAPPERS = {
    "none": lambda nested: nested,
    "twosided": lambda nested: {"type": "twosided", "nested": nested},
    "mask": lambda nested: {"type": "mask", "opacity": 0.5, "nested": nested},
    "blendbsdf": lambda nested: {"type": "blendbsdf", "weight": 0.5, "first": nested, "second": {"type": "diffuse"}},
    "bumpmap": lambda nested: {"type": "bumpmap", "texture": number(0.1), "nested": nested},
    "normalmap": lambda nested: {**FLAT, "normalmap": FLAT["normalmap"](), "nested": nested},
}
PAIRS = [(mode, wrapper) for mode in MODES for wrapper in WRAPPERS]
# Mitsuba's `twosided` takes no BSDF that transmits.
PAIRS = [(mode, wrapper) for mode, wrapper in PAIRS if wrapper != "twosided" or "transmission" not in MODES[mode]()]


def nested(mode, wrapper="none"):
    grating = {"type": "diffraction_grating", "spectrum": sinusoidal(), **MODES[mode]()}
    if mode != "rigorous":
        grating["conserve_energy"] = False
    return WRAPPERS[wrapper](grating)


def scene_of(bsdf, integrator="path", instanced=False):
    shape = {"type": "rectangle", "bsdf": bsdf}
    shapes = {"shape": shape}
    if instanced:
        shapes = {
            "group": {"type": "shapegroup", "shape": shape},
            "instance": {"type": "instance", "group": {"type": "ref", "id": "group"}},
        }
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": integrator},
            "sensor": {
                "type": "perspective",
                "film": {"type": "hdrfilm", "width": 4, "height": 4},
                "to_world": mi.ScalarTransform4f().look_at([0, 0, 5], [0, 0, 0], [0, 1, 0]),
            },
            **shapes,
            "floor": {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, -1])},
            "light": {"type": "directional", "direction": [0, 0.1, -1]},
        }
    )


def freed(act, *arguments, **parameters):
    """Return whether all gratings of a scene are dead once it is deleted, after `act`; garbage is not collected."""
    assert not gc.isenabled()
    scene = scene_of(*arguments, **parameters)
    alive = [
        weakref.ref(part)
        for shape in scene.shapes()
        for bsdf in gratings_in(shape.bsdf())
        for part in (bsdf, bsdf.layers, bsdf.layers.grating, bsdf.layers.grating.theory)
    ]
    assert alive
    act(scene)
    del scene
    return not [part() for part in alive if part() is not None]


def render(scene):
    mi.render(scene, spp=1)


@pytest.mark.few(6)
@pytest.mark.parametrize(("mode", "wrapper"), PAIRS)
def test_a_grating_dies_with_its_scene(llvm, mode, wrapper):
    assert freed(lambda scene: None, nested(mode, wrapper))


@pytest.mark.few(3)
@pytest.mark.parametrize(("mode", "wrapper"), PAIRS)
def test_a_grating_dies_with_its_scene_after_a_picture(llvm, mode, wrapper):
    assert freed(render, nested(mode, wrapper))


@pytest.mark.slow
@pytest.mark.parametrize("integrator", ["prb", "diffraction_path", "diffraction_shader"])
@pytest.mark.parametrize("wrapper", sorted(WRAPPERS))
def test_integrators_do_not_keep_a_grating(llvm, integrator, wrapper):
    grating = {"type": "diffraction_grating", "profile": "sinusoidal", "period": 2.0, "depth": 0.15, "material": "Al"}
    bsdf = WRAPPERS[wrapper](grating)
    freed(render, bsdf, integrator)  # modules that are imported for the first picture may keep its frames
    assert freed(render, bsdf, integrator)


@pytest.mark.slow
def test_an_instanced_grating_dies_with_its_scene(llvm):
    before = list(md.bsdf.base.living)
    scene = scene_of(nested("reflection", "twosided"), instanced=True)
    render(scene)
    (alive,) = (weakref.ref(one) for one in md.bsdf.base.living if not any(one is other for other in before))
    del scene
    assert alive() is None


def change(scene):
    parameters = mi.traverse(scene)
    (key,) = (key for key in parameters.keys() if key.endswith("height_scale"))  # noqa: SIM118
    height = mi.Float(0.5)
    dr.enable_grad(height)
    parameters[key] = height
    parameters.update()
    dr.backward(dr.sum(mi.render(scene, parameters, spp=1), axis=None))
    dr.set_grad_enabled(height, False)
    parameters[key] = mi.Float(100.0)
    with pytest.raises(ValueError, match="height_scale: got 100"):
        parameters.update()


@pytest.mark.slow
def test_changes_and_gradients_do_not_keep_a_grating(llvm):
    assert freed(change, nested("reflection", "twosided"))


def test_a_grating_that_is_refused_for_the_light_dies(llvm):
    """It is registered with Dr.Jit by then, and the error, which a user may keep, must not refer to its scene."""
    short = md.precompute(md.gratings.sinusoidal(2.0, 0.15), wavelengths=(500.0, 830.0))
    living = set(map(id, md.bsdf.base.living))
    with pytest.raises(RuntimeError, match="build it from") as kept:
        scene_of({"type": "diffraction_grating", "spectrum": short, "material": "Al"})
    assert set(map(id, md.bsdf.base.living)) <= living, kept


def test_integrators_of_a_comparison_die_with_what_they_refer_to(llvm):
    integrator = same_light(scene_of(nested("reflection")))
    alive = weakref.ref(integrator.radiance)
    del integrator
    assert alive() is None


def test_no_class_is_defined_at_each_call():
    """Each class is a reference cycle, and what its methods refer to lives until the garbage collector finds it."""
    found = []
    for path in PACKAGE.rglob("*.py"):
        for function in ast.walk(ast.parse(path.read_text())):
            if isinstance(function, ast.FunctionDef) and any(isinstance(part, ast.ClassDef) for part in function.body):
                once = any("cache" in ast.unparse(decorator) for decorator in function.decorator_list)
                if not once and not function.name.startswith("define"):
                    found.append(f"{path.name}: {function.name}")
    assert not found


LOOP = """
import sys
import mitsuba_diffraction as md
import mitsuba as mi
mi.set_variant("llvm_ad_spectral")
from test_lifetimes import PAIRS, nested, scene_of

wrappers, count, kind = sys.argv[1:]
pairs = [pair for pair in PAIRS if pair[1] in wrappers.split()]

class Cycle:
    def __init__(self, scene):
        self.scene, self.itself = scene, self

for i in range(int(count)):
    scene = scene_of(nested(*pairs[i % len(pairs)]), instanced=kind == "instanced")
    mi.render(scene, spp=1, seed=i)
    if kind == "cycle":
        Cycle(scene)
print("done", len(md.bsdf.base.living))
"""


def loop(wrappers, count, kind="plain"):
    """Load and render scenes in a process of its own, in which garbage is collected."""
    paths = os.pathsep.join(map(str, (Path(__file__).parent, Path(__file__).parents[1], PACKAGE.parent)))
    words = [sys.executable, "-c", LOOP, " ".join(wrappers), str(count), kind]
    done = subprocess.run(words, capture_output=True, text=True, env={**os.environ, "PYTHONPATH": paths})
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout.splitlines()[-1]


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["plain", "instanced"])
def test_100_scenes_in_a_loop(kind):
    assert loop(WRAPPERS, 100, kind) == "done 1"


@pytest.mark.slow
def test_scenes_in_reference_cycles_of_a_user_are_freed_between_pictures():
    _, living = loop(["none", "mask", "blendbsdf"], 40, "cycle").split()
    assert int(living) <= 2
