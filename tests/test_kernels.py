"""The kernels that Dr.Jit traces from the plugins: their precision and number, loops, frozen functions."""

from __future__ import annotations

import collections
import contextlib
import functools
import gc
import re
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from itertools import pairwise
from multiprocessing import get_context
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from bsdf_support import WAVELENGTHS, bitmap, made_up, of_spectrum, random_directions, spectrum, uniform

import mitsuba_diffraction as md
from mitsuba_diffraction.bsdf.grating import Grating
from mitsuba_diffraction.bsdf.layers import Layers
from mitsuba_diffraction.bsdf.testing import array, direction, floats, interaction, vectors
from mitsuba_diffraction.integrator import candidates, eye_paths, paths
from mitsuba_diffraction.integrator.candidates import Candidates
from mitsuba_diffraction.integrator.paths import unpacked
from mitsuba_diffraction.render.scene_file import SceneFile
from mitsuba_diffraction.render.trace_pass import trace_pass
from mitsuba_diffraction.surface.gratings import PROFILES

pytestmark = pytest.mark.usefixtures("llvm")
WI = direction(25.0, 40.0)
BLAZE = {"type": "diffraction_grating", "profile": "blazed", "period": 2.5, "depth": 0.25}


@functools.cache
def sample() -> md.GratingSpectrum:
    return md.precompute(md.gratings.elaphe_synthetic(8), extent="sample", coherence_length=1.5)


GRATINGS = {
    "tile": lambda: {**BLAZE, "material": "Al", "coat_ior": 1.5},
    "two axes": lambda: of_spectrum(spectrum("corner"), int_ior=1.5, base={"type": "diffuse"}),
    "sample": lambda: of_spectrum(sample(), conserve_energy=False),  # its E is looked up as that of two axes
    "rigorous": lambda: of_spectrum(made_up(), material="Al"),
    "sheet": lambda: {**BLAZE, "int_ior": 1.5, "transmission": "sheet"},
    "interface": lambda: {**BLAZE, "int_ior": 1.5, "transmission": "interface"},
}


def kernels(action: Callable[[], object]) -> list[dict]:
    """The kernels that an action launches."""
    dr.kernel_history_clear()
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        action()
        return dr.kernel_history((dr.KernelType.JIT,))


def both(bsdf: mi.BSDF, count: int = 256) -> tuple[np.ndarray, ...]:
    """What is sampled; value and density of these directions."""
    si = interaction(np.tile(WI, (count, 1)), WAVELENGTHS)
    u = [floats(u) for u in np.random.default_rng(0).random((3, count))]
    sampled, weight = bsdf.sample(mi.BSDFContext(), si, u[0], mi.Point2f(u[1], u[2]))
    value, density = bsdf.eval_pdf(mi.BSDFContext(), si, sampled.wo)
    dr.eval(sampled, weight, value, density)
    return tuple(array(x) for x in (value, density, sampled.wo, sampled.pdf, weight))


def scene(bsdf: dict, integrator: str = "path", **further: dict) -> mi.Scene:
    """A grating under an even sky and beside a lamp, 8 × 8 pixels."""
    look = mi.ScalarTransform4f().look_at([0, -3, 3], [0, 0, 0], [0, 0, 1])
    lamp = {"type": "sphere", "center": [1, 1, 2], "radius": 0.3}
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": integrator, "max_depth": 3},
            "sensor": {
                "type": "perspective",
                "fov": 40,
                "to_world": look,
                "film": {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}},
            },
            "sky": {"type": "constant", "radiance": uniform(1.0)},
            "lamp": {**lamp, "emitter": {"type": "area", "radiance": uniform(5.0)}},
            "plate": {"type": "rectangle", "bsdf": {**bsdf, "id": "grating"}},
            **further,
        }
    )


def beside(**shapes: dict) -> dict:
    """A wall that a grating lights, and other shapes."""
    upright = mi.ScalarTransform4f().translate([-1.2, 0, 0]).rotate([0, 1, 0], 90).scale(2)
    return {"wall": {"type": "rectangle", "to_world": upright, "bsdf": {"type": "diffuse"}}, **shapes}


def instances() -> dict:
    """Gratings above the other one: on an instance, which counts as any surface."""
    place = mi.ScalarTransform4f().translate([0, 0, 1]).rotate([1, 0, 0], 180).scale(0.5)
    group = {"type": "shapegroup", "plate": {"type": "rectangle", "bsdf": {**BLAZE, "base": {"type": "diffuse"}}}}
    return {"group": group, "copy": {"type": "instance", "to_world": place, "group": {"type": "ref", "id": "group"}}}


def without_double(history: list[dict]) -> bool:
    code = "\n".join(kernel["ir"].getvalue() for kernel in history)
    assert "float" in code
    return not re.search(r"\bdouble\b", code)


def test_double_precision_is_found_in_a_kernel():
    x = dr.arange(mi.Float, 3)
    assert not without_double(kernels(lambda: dr.eval(mi.Float(dr.sqrt(mi.Float64(x))))))


@pytest.mark.few(1)
@pytest.mark.parametrize("name", GRATINGS)
def test_a_bsdf_computes_in_single_precision(name):
    bsdf = mi.load_dict(GRATINGS[name]())
    assert without_double(kernels(lambda: both(bsdf)))


@pytest.mark.few(1)
@pytest.mark.parametrize("integrator", ["diffraction_path", "path"])
def test_an_integrator_computes_in_single_precision(integrator):
    built = scene(BLAZE, integrator)
    assert without_double(kernels(lambda: dr.eval(mi.render(built, spp=1))))


def frames_of(load: Callable[[], mi.Scene], seeds: range, traces: Callable = mi.render) -> list[dict[str, str]]:
    """The kernels of each frame of a scene, by their names."""
    built, frames = load(), []
    for seed in seeds:
        history = kernels(lambda: dr.eval(traces(built, spp=2, seed=seed)))  # noqa: B023
        frames.append({kernel["hash"]: kernel["ir"].getvalue() for kernel in history})
    return frames


def test_later_frames_and_loads_have_the_kernels_of_the_first_frame():
    """Also in the order of their tables: none reads what NumPy or the order of loading places by chance."""
    described = md.example_scene("blazed", size=8, conserve_energy=False)
    first, *later = [frame for _ in range(3) for frame in frames_of(lambda: mi.load_dict(described), range(2))]
    assert not any(re.search(r"load <?[\w ]*(float|i32).*align 1,", text) for text in first.values())
    assert all(frame.keys() <= first.keys() for frame in later)


def arrays_kept_by(value: object) -> list:
    """The arrays of Dr.Jit that an object of the package holds, its members' included, but for those of plugins."""
    if isinstance(value, mi.DiscreteDistribution):
        return [value.pmf, value.cdf]
    if isinstance(value, dict | list | tuple):
        return [
            array for item in (value.values() if isinstance(value, dict) else value) for array in arrays_kept_by(item)
        ]
    if type(value).__module__.startswith("mitsuba_diffraction") and not isinstance(value, mi.Object):
        return arrays_kept_by(vars(value))
    return [value] if dr.is_array_v(value) else []


@pytest.mark.parametrize("sky", [{"type": "constant"}, {"type": "point", "position": [1, 0, 3]}])
def test_what_is_made_once_for_a_scene_holds_no_literals(sky):
    """Dr.Jit places a literal by the time at which it was made: in the kernel of a later frame it is elsewhere."""
    built = scene(BLAZE, "diffraction_path", sky=sky)
    eye, _ = built.integrator().parts(built, built.sensors()[0])
    found = arrays_kept_by(eye.tracer)
    assert len(found) > 10
    assert not [array for array in found if array.state == dr.VarState.Literal]


def test_bodies_of_loops_are_recorded_once(monkeypatch):
    """Recording is most of the time of a small picture, and was repeated up to eight times where loops are nested.

    Gratings are evaluated for a light that is drawn, a bulb, the candidate that is kept, and samples of the BSDF. Four
    candidates are drawn in one body.
    """
    calls = collections.Counter()

    def count(kind: type, name: str) -> None:
        method = getattr(kind, name)

        def counted(*args: object) -> object:
            # Calls are recorded for all gratings that are alive, also those of other tests.
            calls[name] += any(args[0] is one for one in own)
            return method(*args)

        monkeypatch.setattr(kind, name, counted)

    bulb = {"type": "point", "position": [1, 0, 3], "intensity": uniform(1.0)}
    sky = {"type": "constant", "radiance": uniform(1e-4)}
    built = scene(BLAZE, "diffraction_path", bulb=bulb, sky=sky, **beside())
    built.integrator().max_depth = 5
    sensor = built.sensors()[0]
    eye, light = built.integrator().parts(built, sensor)
    gratings = [shape.bsdf() for shape in built.shapes() if isinstance(getattr(shape.bsdf(), "layers", None), Layers)]
    own = [eye.candidates, *(layer for grating in gratings for layer in (grating.layers, grating.layers.grating))]
    sampler = sensor.sampler()
    sampler.seed(0, 64)
    for kind, name in (
        (Candidates, "sample"),
        (Candidates, "_kept_of"),
        (Layers, "sample"),
        (Grating, "value_and_density"),
    ):
        count(kind, name)
    ray, weight = sensor.sample_ray_differential(0, sampler.next_1d(), sampler.next_2d(), mi.Point2f(0.5))
    eye.trace(built, sampler, ray, weight)
    assert calls == {"sample": 6, "_kept_of": 1, "value_and_density": 4}
    calls.clear()
    next(light.splats(0, 4))
    assert calls == {"sample": 1, "value_and_density": 1}


# Pairs of a grating and of further shapes.
LEFT_OUT = {
    "alone": lambda: (BLAZE, beside()),
    "with a base": lambda: ({**BLAZE, "base": {"type": "diffuse"}}, beside()),
    "with instances": lambda: (BLAZE, beside(**instances())),
}


@pytest.mark.few(1)
@pytest.mark.parametrize("name", LEFT_OUT)
def test_gratings_that_are_not_recorded_change_no_pixel(name, monkeypatch):
    """Where they are evaluated as black, their values are not used."""
    bsdf, shapes = LEFT_OUT[name]()
    sky = {"type": "constant", "radiance": uniform(1e-4)}
    built = scene(bsdf, "diffraction_path", sky=sky, **shapes)
    built.integrator().max_depth = 5
    found = np.array(mi.render(built, spp=64))
    for module in (candidates, eye_paths, paths):
        monkeypatch.setattr(module, "gratings_left_out", lambda applies: contextlib.nullcontext())
    np.testing.assert_allclose(found, np.array(mi.render(built, spp=64)), rtol=1e-5)
    assert (found[..., 1] > 0).mean() > 0.9


@pytest.mark.parametrize("count", [0, 1])
def test_few_contributions_from_the_light_have_the_kernels_of_many(count):
    found, expected = (
        kernels(lambda: dr.eval(unpacked(np.ones((n, 2 + 2 * dr.size_v(mi.Spectrum)), np.float32))[0] + 1))  # noqa: B023
        for n in (count, 5)
    )
    assert [kernel["hash"] for kernel in found] == [kernel["hash"] for kernel in expected]


def load_named(folder: Path, name: str) -> mi.Scene:
    """A small scene: one of the folder with its parameters, a profile or a kind of grating."""
    mi.set_variant("llvm_ad_spectral")
    if name in (kinds := {**GRATINGS, **FURTHER_KINDS}):
        return scene(kinds[name](), "diffraction_path")
    if name in PROFILES:
        return mi.load_dict(md.example_scene(name, size=16))
    words = name.split()
    return SceneFile(folder / f"{words[0]}.xml", dict(word.split("=") for word in words[1:]), size=(16, None)).load()


def kernels_of_two_ways(folder: Path, name: str) -> list[set[str]]:
    """The names of the kernels of five frames by `mi.render`, and of five passes of `render`."""
    ways = (mi.render,) if name in (*GRATINGS, *FURTHER_KINDS, *PROFILES) else (mi.render, trace_pass)
    return [set(frame) for way in ways for frame in frames_of(lambda: load_named(folder, name), range(5), way)]


FURTHER_KINDS = {
    "patches": lambda: {"type": "diffraction_grating", "profile": "elaphe_synthetic", "material": "Al"},
    "films": lambda: {**BLAZE, "material": "Ti", "thin_film_thickness": "0.08, 0.05", "thin_film_ior": "2.4, 1.5"},
    "textures": lambda: {
        **BLAZE,
        "height_scale": bitmap([[0.5, 1.0], [0.8, 0.6]], raw=True),
        "orientation": bitmap([[0.0, 90.0]], raw=True),
    },
}
NAMED = ["blaze", "elaphe", "screen", "xenopeltis_sphere", "spectrometer", "spectroscope"]
NAMED += [f"snake skin=xenopeltis light={light}" for light in ("sun", "lamps")] + ["snake skin=elaphe light=sun"]
NAMED += [f"{name} light={light}" for name in ("compact_disc", "foil") for light in ("sun", "desk_lamp")]
NAMED += ["hologram", "hologram card=clear", "anodised", "beetle", "rainbow", "window", "glasses", "projection"]
NAMED += [*GRATINGS, *FURTHER_KINDS, "compact_disc", "dvd", "blazed", "xenopeltis_synthetic"]


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMED)
def test_another_process_has_the_kernels_of_the_first_frame(name, small_scenes):
    """So that it finds them compiled."""
    found = []
    for _ in range(2):
        with ProcessPoolExecutor(1, get_context("spawn")) as process:
            found.append(process.submit(kernels_of_two_ways, small_scenes, name).result())
    for way in range(0, len(found[0]), 5):
        assert all(frame <= found[0][way] for process in found for frame in process[way : way + 5])


@pytest.mark.parametrize("given", ["dictionary", "text", "file"])
def test_the_bsdfs_of_a_scene_have_the_numbers_of_its_order(given, tmp_path):
    """Not of the threads that construct them: kernels follow these numbers (a diffuse shape is done first)."""
    numbers = "".join(f'<float name="{name}" value="{BLAZE[name]}"/>' for name in ("period", "depth"))
    bsdf = f'<bsdf type="diffraction_grating"><string name="profile" value="blazed"/>{numbers}</bsdf>'
    plate, ball = f'<shape type="rectangle" id="plate">{bsdf}</shape>', '<shape type="sphere" id="ball"/>'
    text = f'<scene version="3.0.0">{plate}{ball}</scene>'
    (tmp_path / "scene.xml").write_text(text)
    built = {
        "dictionary": lambda: mi.load_dict(
            {"type": "scene", "plate": {"type": "rectangle", "bsdf": BLAZE}, "ball": {"type": "sphere"}}
        ),
        "text": lambda: mi.load_string(text),
        "file": lambda: mi.load_file(str(tmp_path / "scene.xml")),
    }[given]()
    number = {x.id(): dr.reinterpret_array(mi.UInt32, mi.BSDFPtr(x.bsdf()))[0] for x in built.shapes()}
    assert number["plate"] < number["ball"]


def test_loading_a_scene_again_compiles_nothing():
    """Nor does it add kernels, although each instance of a BSDF is another target of virtual calls."""
    launched, compiled = [], []
    for orientation in range(20):
        built = scene({**BLAZE, "orientation": float(orientation), "conserve_energy": False})
        history = kernels(lambda: dr.eval(mi.render(built, spp=1)))  # noqa: B023
        launched.append(len(history))
        compiled.append(sum(not kernel["cache_hit"] for kernel in history))
    assert len(set(launched[10:])) == 1, launched
    assert not any(compiled[2:]), compiled


@pytest.mark.few(2)
@pytest.mark.parametrize("name", GRATINGS)
def test_symbolic_and_evaluated_loops_give_the_same(name):
    bsdf = mi.load_dict(GRATINGS[name]())
    symbolic = both(bsdf)
    with dr.scoped_set_flag(dr.JitFlag.SymbolicLoops, False):
        evaluated = both(bsdf)
    assert (symbolic[0].max(axis=0) > 0).mean() > 0.9
    for found, expected in zip(evaluated, symbolic, strict=True):
        np.testing.assert_allclose(found, expected, rtol=2e-5, atol=1e-6 * np.abs(expected).max())


def state_of(value: object) -> list:
    """The arrays of Dr.Jit and the plugins that an object holds, its members' included.

    `dr.freeze` looks for them in data classes and collections only, and refuses what it has not found.
    """
    if isinstance(value, type):
        return []
    if isinstance(value, dict | list | tuple):
        return [found for item in (value.values() if isinstance(value, dict) else value) for found in state_of(item)]
    if type(value).__module__.startswith("mitsuba_diffraction"):
        return state_of(list(vars(value).values()) if hasattr(value, "__dict__") else [])
    return [value] if dr.is_array_v(value) or isinstance(value, mi.Object) else []


@pytest.mark.few(1)
@pytest.mark.parametrize("name", ["interface", "two axes", "tile", "sample"])
def test_a_frozen_evaluation_follows_the_parameters(name):
    """The kernels that `dr.freeze` records have tables and numbers of the plugin among their inputs."""
    bsdf = mi.load_dict(GRATINGS[name]())
    parameters = mi.traverse(bsdf)
    wo = random_directions(np.random.default_rng(2), 2000)
    si, wo = interaction(np.tile(WI, (2000, 1)), WAVELENGTHS), vectors(wo)

    @dr.freeze(state_fn=lambda bsdf, si, wo: state_of(bsdf))
    def frozen(bsdf: mi.BSDF, si: mi.SurfaceInteraction3f, wo: mi.Vector3f) -> tuple:
        return bsdf.eval_pdf(mi.BSDFContext(), si, wo)

    # Dr.Jit aborts where garbage of earlier tests is collected while it records.
    gc.collect()
    values = []
    for key, value in (("height_scale", 1.0), ("height_scale", 0.8), ("orientation.value", 90.0)):
        parameters[key] = value
        parameters.update()
        found, expected = frozen(bsdf, si, wo), bsdf.eval_pdf(mi.BSDFContext(), si, wo)
        for a, b in zip(found, expected, strict=True):
            np.testing.assert_allclose(np.array(a), np.array(b), rtol=1e-5, atol=1e-7)
        values.append(np.array(found[0]))
    assert frozen.n_recordings <= 2
    for before, after in pairwise(values):
        assert np.abs(after - before).max() > 0.01 * before.max()
