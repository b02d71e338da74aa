"""Direct light at gratings by candidates, compared with sums over lamps and with long runs of Mitsuba's `path`."""

from functools import partial
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from bsdf_support import bitmap, grating, uniform

from mitsuba_diffraction import testing
from mitsuba_diffraction.evaluation.benchmark.noise import load_for_noise
from mitsuba_diffraction.integrator.candidates import _marks_failure
from mitsuba_diffraction.integrator.unshadowed_light import UnshadowedLight
from mitsuba_diffraction.render.trace_pass import trace_pass

SCENES = Path(__file__).parents[2] / "scenes"
WAVELENGTHS = (430.0, 500.0, 570.0, 640.0)
EYE = np.array([0.6, -0.9, 2.0])


def at(*position):
    return mi.ScalarTransform4f().translate(position)


def towards(position, target=(0, 0, 0), scale=1.0):
    return mi.ScalarTransform4f().look_at(position, target, [0.3, 1, 0.2]).scale(scale)


def lamp(kind="disk", position=(-1.2, 2.4, 2.0), scale=0.4, radiance=None, **shape):
    """A lamp that faces the origin."""
    emitter = {"type": "area", "radiance": radiance or uniform(1.0)}
    black = {"type": "diffuse", "reflectance": uniform(0.0)}
    return {"type": kind, "to_world": towards(position, scale=scale), "emitter": emitter, "bsdf": black, **shape}


def surface(name="blazed", coherence_length=13.0, **parameters):
    return grating(name, coherence_length, **{"material": "Al", "conserve_energy": False, **parameters})


def profile(**parameters):
    """A surface whose spectrum is computed for the media around it."""
    return {"type": "diffraction_grating", "profile": "blazed", "coherence_length": 13.0, **parameters}


def scene(bsdf, **lights):
    return mi.load_dict({"type": "scene", "plate": {"type": "rectangle", "bsdf": bsdf}, **lights})


def eye_paths(built, depth=2):
    """The tracer of paths from the eye; `path` draws no candidates."""
    integrator = mi.load_dict({"type": "diffraction_path", "max_depth": depth})
    camera = mi.load_dict({"type": "perspective", "to_world": towards(EYE.tolist())})
    eye, _ = integrator.parts(built, camera)
    assert eye.candidates.any
    return eye


def samples(built, integrator, count, seed=0, wavelengths=WAVELENGTHS, origin=EYE):
    """The radiance of one ray to the middle of the plate, at fixed wavelengths, (4, count)."""
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed, count)
    ray = mi.Ray3f(mi.Point3f(origin), -dr.normalize(mi.Vector3f(origin)))
    ray.wavelengths = mi.Spectrum(wavelengths)
    ray.o = ray.o + dr.zeros(mi.Float, count)
    return np.array(integrator.sample(built, sampler, mi.RayDifferential3f(ray))[0], np.float64)


def estimates(built, integrator, count, origin=EYE):
    """Mean and standard error of `samples`, (4,)."""
    found = samples(built, integrator, count, origin=origin)
    return found.mean(axis=1), found.std(axis=1, ddof=1) / np.sqrt(count)


def sum_over_lamp(built, shape, side=400, wavelengths=WAVELENGTHS):
    """∫ f cos θ_o L cos θ_l/r² dA over a disk or rectangle that nothing hides, by midpoints; all radiance is one."""
    ray = mi.Ray3f(mi.Point3f(EYE), -dr.normalize(mi.Vector3f(EYE)))
    ray.wavelengths = mi.Spectrum(wavelengths)
    si = built.ray_intersect(ray)
    u, v = dr.meshgrid(*[(dr.arange(mi.Float, side) + 0.5) / side] * 2)
    ps = shape.sample_position(0.0, mi.Point2f(u, v))
    to_lamp = ps.p - si.p
    square = dr.squared_norm(to_lamp)
    omega = to_lamp * dr.rsqrt(square)
    value = si.bsdf().eval(mi.BSDFContext(), si, si.to_local(omega))
    value *= dr.maximum(-dr.dot(omega, ps.n), 0) / (square * ps.pdf)
    return np.array(value, np.float64).mean(axis=1)


def spots():
    """A radiance that is dark but for a corner."""
    pixels = np.pad([[[5.0, 2.0, 0.5]]], ((0, 7), (0, 7), (0, 0)), constant_values=0.1)
    return {"type": "bitmap", "bitmap": mi.Bitmap(pixels.astype(np.float32))}


def environment(**parameters):
    pixels = np.full((64, 128, 3), 0.05, np.float32)
    pixels[20:22, 40:42] = [300.0, 250.0, 100.0]
    return {"type": "envmap", "bitmap": mi.Bitmap(pixels), **parameters}


def many_lamps():
    rng = np.random.default_rng(4)
    positions = rng.uniform([-3, -3, 2], [3, 3, 4], (60, 3)).tolist()
    lamps = {f"lamp{k}": lamp("disk", position, 0.05, uniform(10.0 ** (k % 3))) for k, position in enumerate(positions)}
    return {**lamps, "sky": {"type": "constant", "radiance": uniform(0.02)}}


LIGHTS = {
    "disk": lambda: {"lamp": lamp()},
    "rectangle": lambda: {"lamp": lamp("rectangle")},
    "sphere": lambda: {"lamp": lamp("sphere")},
    "cube": lambda: {"lamp": lamp("cube")},
    "cylinder": lambda: {"lamp": lamp("cylinder", p0=[-1, 0, 0], p1=[1, 1, 0], radius=0.3)},
    "stretched disk": lambda: {
        "lamp": {**lamp(), "to_world": towards((-1, 2, 2)) @ mi.ScalarTransform4f().scale([0.9, 0.1, 1])}
    },
    "texture": lambda: {"lamp": lamp("rectangle", scale=0.8, radiance=spots())},
    "faint beside bright": lambda: {"lamp": lamp(), "faint": lamp(position=(2, -1, 2), radiance=uniform(1e-4))},
    "touches": lambda: {"lamp": {**lamp("sphere"), "to_world": at(0.5, 0.5, 0.2).scale(0.25)}},
    "environment map": lambda: {"sky": environment()},
    "turned environment map": lambda: {"sky": environment(to_world=mi.ScalarTransform4f().rotate([1, 2, 0.5], 70))},
    "sun and sky": lambda: {"sky": {"type": "sunsky", "sun_direction": [-0.4, 0.5, 0.7]}},
    "constant and lamp": lambda: {"sky": {"type": "constant", "radiance": uniform(0.01)}, "lamp": lamp()},
    "sixty lamps": many_lamps,
}


@pytest.mark.parametrize("name", LIGHTS)
def test_the_guess_is_nowhere_below_the_radiance(name, llvm):
    """Along directions to lamps, and in all directions, from points around the origin."""
    built = scene({"type": "diffuse"}, **LIGHTS[name]())
    guess = UnshadowedLight(built)
    rng = mi.PCG32(size=2**15)

    def number():
        return mi.Float(rng.next_float32())

    point = mi.Point3f(0.8 * number() - 0.4, 0.8 * number() - 0.4, 0.01 + 0.1 * number())
    si = dr.zeros(mi.SurfaceInteraction3f, 2**15)
    si.p, si.wavelengths = point, mi.Spectrum(550.0)
    ds, _ = built.sample_emitter_direction(si, mi.Point2f(number(), number()), False)
    for omega in (ds.d, mi.warp.square_to_uniform_sphere(mi.Point2f(number(), number()))):
        ray = mi.Ray3f(point, omega)
        ray.wavelengths = mi.Spectrum(450.0, 530.0, 590.0, 650.0)
        found = built.ray_intersect(ray)
        found.wavelengths = ray.wavelengths
        radiance = np.array(dr.mean(found.emitter(built).eval(found)))
        expected = np.array(guess(point, omega, mi.Bool(True)))
        assert radiance.max() > 0
        assert (expected > 0).all()
        # A texture is evaluated on a grid; an environment varies within the neighbours of a cell.
        assert (expected >= 0.8 * radiance).all(), (expected / radiance).min()


def test_sixty_lamps_have_twelve_outlines(llvm):
    assert len(UnshadowedLight(scene({"type": "diffuse"}, **many_lamps()))._outlines) == 12


def two_lamps(side=1):
    """Where the orders 1 and −1 of `surface` lead for the ray of `estimates`, above or below the plate."""
    return {"rectangle": lamp("rectangle", (-1.2, 1, 2.2 * side), 0.3), "disk": lamp("disk", (0, 1, 2.3 * side), 0.25)}


def on_base():
    """Under a normal map, of two gratings of which samples may fail."""
    base = {"type": "roughconductor", "alpha": 0.4}
    bsdf = grating(coherence_length=13.0, int_ior=1.6, base=base)
    return {"type": "normalmap", "normalmap": bitmap(np.tile([[[0.6, 0.45, 0.98]]], (2, 2, 1))), "bsdf": bsdf}


def blend():
    """A grating partly covered by paint, with holes."""
    paint = {"type": "roughplastic", "alpha": 0.2}
    return {
        **{"type": "mask", "opacity": 0.7},
        "nested": {"type": "blendbsdf", "weight": 0.4, "grating": surface(coherence_length=26.0), "paint": paint},
    }


SURFACES = {
    "bare": surface,
    "continuum": partial(surface, "elaphe", 26.0),
    "coat": lambda: {"type": "twosided", "bsdf": profile(material="Al", coat_ior=1.5)},
    "sheet": lambda: profile(transmission="sheet"),
    "normal map and base": on_base,
    "blend and mask": blend,
}


def assert_sum_over_lamps(built, count=2**17, limit=0.02, depth=2):
    """Return the standard error, (4,)."""
    lamps = [shape for shape in built.shapes() if shape.is_emitter()]
    wanted = np.sum([sum_over_lamp(built, shape) for shape in lamps], axis=0)
    found, error = estimates(built, eye_paths(built, depth), count)
    assert (error < limit * wanted.max()).all()
    np.testing.assert_array_less(np.abs(found - wanted), 4 * error + 1e-3 * wanted.max())
    return error


@pytest.mark.few(1)
@pytest.mark.parametrize("name", SURFACES)
def test_light_of_lamps_is_the_sum_over_their_points(name, llvm):
    assert_sum_over_lamps(scene(SURFACES[name](), **two_lamps(-1 if name == "sheet" else 1)))


@pytest.mark.slow
def test_later_vertices_have_the_limit_of_path(llvm):
    """A lamp below the plate, seen by a second one above: light samples count as much as candidates."""
    bsdf = surface(coherence_length=1.0)
    above = {"type": "rectangle", "to_world": at(0, 0, 1.2).rotate([1, 0, 0], 180).scale(1.5), "bsdf": bsdf}
    built = scene(bsdf, above=above, lamp=lamp("sphere", (2.3, 0.5, -0.6), 0.4, uniform(50.0)))
    ray, path = {"origin": np.array([1.6, -1.9, 0.9])}, mi.load_dict({"type": "path", "max_depth": 4})
    assert not samples(built, mi.load_dict({"type": "path", "max_depth": 2}), 2**14, **ray).any()
    wanted, its_error = estimates(built, path, 2**21, **ray)
    found, error = estimates(built, eye_paths(built, 4), 2**21, **ray)
    assert (np.hypot(error, its_error) < 0.03 * wanted).all()
    np.testing.assert_array_less(np.abs(found - wanted), 4 * np.hypot(error, its_error))


@pytest.mark.slow
def test_instances_draw_candidates(llvm):
    """A plate of a group, which an instance moves to the origin, beside a group without gratings."""
    groups = {"plate": surface(), "paint": {"type": "diffuse"}}
    parts = {}
    for k, (name, bsdf) in enumerate(groups.items()):
        member = {"type": "rectangle", "to_world": at(3, 0, 0), "bsdf": bsdf}
        parts[name] = {"type": "shapegroup", "member": member}
        to_world = at(-3, 2.5 * k, 0)
        parts[f"{name} moved"] = {"type": "instance", "to_world": to_world, "group": {"type": "ref", "id": name}}
    built = mi.load_dict({"type": "scene", **parts, **two_lamps()})
    # Paths that go on do not count the lamps again.
    error, _ = assert_sum_over_lamps(built), assert_sum_over_lamps(built, depth=4)
    _, of_path = estimates(built, mi.load_dict({"type": "path", "max_depth": 2}), 2**17)
    assert error.sum() < 0.5 * of_path.sum()


@pytest.mark.slow
@pytest.mark.parametrize(("name", "expected"), [("blazed", True), ("skin", False)])
def test_candidates_reduce_the_noise_below_a_sky_where_lobes_are_narrow(name, expected, llvm):
    bsdf = {"blazed": surface(), "skin": surface("elaphe", 2.0)}[name]
    built = scene(bsdf, sky={"type": "constant", "radiance": uniform(1.0)})
    path, ours = (mi.load_dict({"type": kind, "max_depth": 2}) for kind in ("path", "diffraction_path"))
    eye, _ = ours.parts(built, mi.load_dict({"type": "perspective", "to_world": towards(EYE.tolist())}))
    (wanted, its_error), (found, error) = (estimates(built, tracer, 2**14) for tracer in (path, eye))
    np.testing.assert_array_less(np.abs(found - wanted), 4 * np.hypot(its_error, error))
    ratio = np.mean(error**2) / np.mean(its_error**2)
    assert (ratio < 0.5) == expected, ratio


@pytest.mark.slow
def test_each_of_several_gratings_draws_its_own_candidates(llvm):
    """Three plates with a BSDF each and two with the same, of which each stands at the origin once."""
    bsdfs = [surface("elaphe", 26.0), surface(), profile(material="Al", coat_ior=1.5), surface("sinusoidal")]
    for middle in range(len(bsdfs)):
        plates = {
            f"plate{k}": {"type": "rectangle", "to_world": at(4 * (k - middle), 0, 0), "bsdf": bsdf}
            for k, bsdf in enumerate(bsdfs)
        }
        built = mi.load_dict({"type": "scene", **plates, **two_lamps()})
        assert_sum_over_lamps(built, 2**16, 0.03)


def obstacle():
    """A screen before the lamps; the sky remains."""
    black = {"type": "diffuse", "reflectance": uniform(0.0)}
    return {
        **two_lamps(),
        "screen": {"type": "rectangle", "to_world": at(-0.5, 0.75, 1.6).scale(0.5), "bsdf": black},
        "sky": {"type": "constant", "radiance": uniform(0.002)},
    }


def lamp_in(bsdf):
    """A lamp behind a pane, or opposite to a mirror, that is met by the orders of `two_lamps`."""
    pane = {"type": "rectangle", "to_world": towards((-0.6, 0.9, 2.0), scale=1.2), "bsdf": bsdf}
    return {**two_lamps(), "far": lamp(position=(-2.5, 3, 6), scale=2.0), "pane": pane}


FIREFLIES = {
    "lamps behind an obstacle": obstacle,
    "lamps of 1:1e4": lambda: {
        "bright": lamp("disk", (2.0, -0.5, 2.0), 0.1, uniform(1e4)),
        "rectangle": lamp("rectangle", (-1.2, 1, 2.2), 0.3),
    },
    "lamp that touches": lambda: {"lamp": {**lamp("sphere"), "to_world": at(-0.3, 0.3, 0.1).scale(0.3)}},
    "lamp behind glass": lambda: lamp_in({"type": "thindielectric"}),
    "lamp in a mirror": lambda: {
        "lamp": lamp("disk", (1.5, 1.0, 1.5), 0.4),
        "mirror": {
            **{"type": "rectangle", "to_world": at(-2.0, 0, 0).rotate([0, 1, 0], 90).scale(3)},
            "bsdf": {"type": "twosided", "bsdf": {"type": "conductor", "material": "none"}},
        },
    },
    "lamp of many triangles": lambda: {"lamp": lamp("cube", (-1.2, 1, 2.2), 0.2)},
    "sixty lamps": many_lamps,
    "environment map": lambda: {"sky": environment()},
}


@pytest.mark.slow
@pytest.mark.parametrize("name", FIREFLIES)
def test_no_pixel_stands_out_more_than_with_path(name, llvm):
    """One ray: the mean is that of `path`, and the largest of many pixels of 16 samples is not further above it."""
    depth, ratios = 4, []
    built = scene(surface(), **FIREFLIES[name]())
    path = mi.load_dict({"type": "path", "max_depth": depth})
    # The largest of one seed varies by a third.
    for seed in range(4):
        wanted, found = (samples(built, of, 2**19, seed) for of in (path, eye_paths(built, depth)))
        errors = [each.std(axis=1, ddof=1) / np.sqrt(each.shape[1]) for each in (wanted, found)]
        np.testing.assert_array_less(np.abs(found.mean(axis=1) - wanted.mean(axis=1)), 4 * np.hypot(*errors) + 1e-9)
        pixels = [each.mean(axis=0).reshape(-1, 16).mean(axis=1) for each in (wanted, found)]
        ratios.append([(each.max() / each.mean(), each.var()) for each in pixels])
    (largest, variance), (largest_found, variance_found) = np.mean(ratios, axis=0)
    assert largest_found < 1.1 * largest, ratios
    assert variance_found < 1.1 * variance, ratios


def assert_bins_agree(name, depth):
    """Each bin of the mean of a picture, and that of all, is that of `path` within errors."""
    found = {}
    for integrator in ("path", "diffraction_path"):
        built = load_for_noise(SCENES / f"{name}.xml", 64, None, type=integrator, max_depth=depth)
        passes = [trace_pass(built, 64, seed).sum(axis=(0, 1)) for seed in range(16)]
        bins = np.array([each[:-1] / each[-1] for each in passes])
        found[integrator] = np.column_stack([bins, bins.mean(axis=1)])
    means, errors = ([f(found[k]) for k in found] for f in (lambda x: x.mean(0), lambda x: x.std(0, ddof=1) / 4))
    scores = (means[1] - means[0]) / np.hypot(*errors)
    assert np.abs(scores).max() < 4
    assert np.sqrt(np.mean(scores**2)) < 1.6  # bins are not independent of each other


@pytest.mark.slow
@pytest.mark.parametrize("depth", [2, 6])
@pytest.mark.parametrize("name", ["compact_disc", "hologram", "elaphe", "xenopeltis"])
def test_every_bin_of_a_scene_agrees_with_path(name, depth, llvm):
    assert_bins_agree(name, depth)


def blend(*bsdfs):
    return {"type": "blendbsdf", "weight": 0.35, **{f"bsdf{k}": bsdf for k, bsdf in enumerate(bsdfs)}}


@pytest.mark.few(1)
@pytest.mark.parametrize("other", ["film", "glass", "plastic"])
def test_failures_in_a_blend_are_told_by_densities(other, llvm):
    """Where a part transmits light, or is of another class, directions of failed samples may have a value."""
    others = {
        "film": profile(int_ior=1.5, transmission="sheet"),
        "glass": {"type": "roughdielectric"},
        "plastic": {"type": "roughplastic"},
    }
    assert not _marks_failure(mi.load_dict(blend(surface("blazed", 1.5), others[other])))


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["grating", "twosided", "normalmap", "bumpmap", "metal", "paint"])
def test_a_sample_that_fails_lies_in_the_surface_or_has_no_value(kind, llvm):
    """The names of these classes of Mitsuba stand for it where candidates are drawn without their densities."""
    nested = surface("blazed", 1.5)
    tilted = bitmap(np.tile((np.array([0.5, 0, 0.75**0.5]) + 1) / 2, (2, 2, 1)))
    bsdf = {
        "grating": nested,
        "twosided": {"type": "twosided", "bsdf": nested},
        "normalmap": {"type": "normalmap", "normalmap": tilted, "bsdf": nested},
        "bumpmap": {"type": "bumpmap", "texture": bitmap(np.arange(64.0).reshape(8, 8) / 64), "bsdf": nested},
        "metal": blend(nested, {"type": "roughconductor", "material": "Al", "alpha": 0.7}),
        "paint": blend(nested, {"type": "diffuse"}),
    }[kind]
    count, rng = 1 << 16, np.random.default_rng(1)
    wi = rng.normal(size=(count, 3))
    built = mi.load_dict(bsdf)
    assert _marks_failure(built)
    wi /= np.linalg.norm(wi, axis=1, keepdims=True)
    uv = rng.random((count, 2))
    wo, _, bs = testing.sample(built, wi, WAVELENGTHS, 1, None, uv)
    failed = np.array(bs.pdf) == 0
    assert kind == "twosided" or failed.sum() > 100
    assert failed[wo[:, 2] == 0].all()
    # Such as those of light from below.
    value = testing.evaluate_pdf(built, wi, wo, WAVELENGTHS, None, uv)[0]
    assert not value[failed & (wo[:, 2] != 0)].any()
