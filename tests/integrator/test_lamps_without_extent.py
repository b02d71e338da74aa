"""Light of lamps without extent at wavelengths drawn for it, compared with sums over wavelengths and with `path`."""

from functools import partial
from itertools import pairwise

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from bsdf_support import bitmap, grating, uniform
from test_candidates import assert_bins_agree

import mitsuba_diffraction  # noqa: F401 (settles which LLVM is used before a variant is set)
from mitsuba_diffraction.evaluation.benchmark import noise
from mitsuba_diffraction.integrator.lamps_without_extent import Emitters, resampled
from mitsuba_diffraction.render.scene_file import SceneFile
from mitsuba_diffraction.render.trace_pass import trace_pass

EYE = np.array([0.6, -0.9, 2.0])
EDGES = np.linspace(360, 830, 11)  # of ten bins, nm
RISING = {"type": "regular", "wavelength_min": 360, "wavelength_max": 830, "values": "0.2, 1.5, 0.7"}


def towards(position):
    return mi.ScalarTransform4f().look_at(position, [0, 0, 0], [0.3, 1, 0.2])


def camera(kind="perspective", fov=0.01, **film):
    size = {"width": 4, "height": 4, "component_format": "float32", "rfilter": {"type": "box"}}
    return {
        **{"type": kind, "fov": fov, "to_world": towards(EYE.tolist()), "sampler": {"type": "independent"}},
        **({"aperture_radius": 0.05, "focus_distance": 2.3} if kind == "thinlens" else {}),
        "film": {"type": "hdrfilm", **size, **film},
    }


def scene(bsdf, lights, **sensor):
    plate = {"type": "rectangle", "bsdf": bsdf}
    return mi.load_dict({"type": "scene", "sensor": camera(**sensor), "plate": plate, **lights})


def blaze(coherence_length=26.0, **parameters):
    return grating("blazed", coherence_length, **{"material": "Al", "conserve_energy": False, **parameters})


def on_base():
    base = {"type": "roughconductor", "alpha": 0.4}
    bsdf = grating("blazed", 26.0, int_ior=1.6, base=base)
    normals = bitmap(np.tile([[[0.55, 0.47, 0.99]]], (2, 2, 1)))
    return {"type": "normalmap", "normalmap": normals, "bsdf": bsdf}


def blend():
    paint = {"type": "roughplastic", "alpha": 0.2}
    return {"type": "twosided", "nested": {"type": "blendbsdf", "weight": 0.4, "grating": blaze(), "paint": paint}}


# Where two orders of the grating lead.
ORDERS = [-1.2, 1.0, 2.2], [0.0, 1.0, 2.3]
SUN = {"type": "directional", "direction": [1.2, -1.0, -2.2], "irradiance": RISING}


def slide():
    return {"type": "bitmap", "bitmap": mi.Bitmap(np.full((2, 2, 3), 0.7, np.float32))}


LAMPS = {
    "sun": lambda: {"sun": SUN},
    "bulb": lambda: {"bulb": {"type": "point", "position": ORDERS[1], "intensity": RISING}},
    "spot": lambda: {"spot": {"type": "spot", "to_world": towards(ORDERS[0]), "intensity": RISING}},
    "projector": lambda: {"slide": {"type": "projector", "to_world": towards(ORDERS[0]), "irradiance": slide()}},
    "three": lambda: {
        "sun": {**SUN, "sampling_weight": 3.0},
        "bulb": {"type": "point", "position": ORDERS[1], "intensity": uniform(0.5)},
        "behind": {"type": "point", "position": [0, 0, -1.5], "intensity": uniform(9.0), "sampling_weight": 0.5},
    },
}
SURFACES = {"bare": blaze, "normal map and base": on_base, "blend": blend}


def eye_paths(built, depth=2):
    eye, _ = mi.load_dict({"type": "diffraction_path", "max_depth": depth}).parts(built, built.sensors()[0])
    assert eye.lamps.any
    return eye


def rays(built, count, seed):
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed, count)
    sensor = built.sensors()[0]
    return sampler, *sensor.sample_ray_differential(0, sampler.next_1d(), mi.Point2f(0.5), mi.Point2f(0.5))


def bins(wavelengths, values):
    """Mean over rays, and its standard error, of what each of ten bins of wavelengths receives, (10,)."""
    wavelengths, values = np.array(wavelengths), np.array(values, np.float64) / 4
    of_rays = np.array([np.where((wavelengths >= a) & (wavelengths < b), values, 0).sum(0) for a, b in _pairs(EDGES)])
    return of_rays.mean(axis=1), of_rays.std(axis=1, ddof=1) / np.sqrt(values.shape[1])


def _pairs(edges):
    return list(pairwise(edges))


def by_lamps(built, count=2**16, seed=0):
    sampler, ray, weight = rays(built, count, seed)
    return bins(*received(eye_paths(built).trace(built, sampler, ray, weight)[0]))


def received(light):
    """The wavelengths and values of a ray's light and of lamps, (8, rays) each."""
    return (np.concatenate([np.array(pair[k]) for pair in light]) for k in range(2))


def by_path(built, depth=2, count=2**18, seed=1, integrator="path"):
    sampler, ray, weight = rays(built, count, seed)
    path = mi.load_dict({"type": integrator, "max_depth": depth})
    return bins(ray.wavelengths, path.sample(built, sampler, ray)[0] * weight)


def sums_over_wavelengths(built, number=9400):
    """∫ f |cos θ| E dλ over each bin, by midpoints, of lamps that are drawn one by one."""
    _, ray, _ = rays(built, 1, 0)
    si = built.ray_intersect(ray)
    total = np.zeros(10)
    for emitter in built.emitters():
        grid = 360 + (np.arange(number) + 0.5) * 470 / number
        at = mi.SurfaceInteraction3f(si)
        at.wavelengths = type(si.wavelengths)(mi.Float(grid.astype(np.float32)))
        ds, light = emitter.sample_direction(at, mi.Point2f(0.5))
        value = light * si.bsdf().eval(mi.BSDFContext(), at, si.to_local(ds.d))
        total += np.array(value[0], np.float64).reshape(10, -1).mean(axis=1) * 47
    return total


@pytest.mark.few(1)
@pytest.mark.parametrize("surface", SURFACES)
@pytest.mark.parametrize("lamps", LAMPS)
def test_light_of_lamps_is_the_sum_over_wavelengths(lamps, surface, llvm):
    built = scene(SURFACES[surface](), LAMPS[lamps]())
    wanted = sums_over_wavelengths(built)
    found, error = by_lamps(built)
    assert (error < 0.01 * wanted.max()).all()
    np.testing.assert_array_less(np.abs(found - wanted), 4 * error + 1e-3 * wanted.max())


@pytest.mark.slow
def test_a_lobe_has_a_small_part_of_the_noise_of_path(llvm):
    """One ray and one direction to the sun: the noise of `path` is that of wavelengths."""
    built = scene(blaze(), LAMPS["sun"]())
    count = 2**15
    sampler, ray, weight = rays(built, count, 0)
    _, values = received(eye_paths(built).trace(built, sampler, ray, weight)[0])
    path = mi.load_dict({"type": "path", "max_depth": 2})
    of_path = np.array(path.sample(built, sampler, ray)[0] * weight).mean(axis=0)
    assert of_path.var() > 8 * (values.sum(axis=0) / 4).var()


def with_sky():
    return {"sun": {**SUN, "sampling_weight": 3.0}, "sky": {"type": "constant", "radiance": uniform(0.3)}}


def with_lamp_and_sky():
    """The lamp draws candidates. It is so small that its light samples count as much as they, where lobes are wide."""
    lamp = {"type": "disk", "to_world": towards(ORDERS[1]) @ mi.ScalarTransform4f().scale(0.1)}
    lamp.update(emitter={"type": "area", "radiance": uniform(50.0)}, bsdf={"type": "diffuse", "reflectance": 0.0})
    return {**with_sky(), "sky": {"type": "constant", "radiance": uniform(0.02)}, "lamp": lamp, **LAMPS["bulb"]()}


@pytest.mark.slow
def test_instances_have_wavelengths_of_their_own(llvm):
    plate = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([3, 0, 0]), "bsdf": blaze()}
    to_world = mi.ScalarTransform4f().translate([-3, 0, 0])
    instance = {"type": "instance", "to_world": to_world, "group": {"type": "ref", "id": "group"}}
    group = {"type": "shapegroup", "plate": plate}
    built = mi.load_dict(
        {"type": "scene", "sensor": camera(), "group": group, "instance": instance, **with_lamp_and_sky()}
    )
    (wanted, its_error), (found, error) = by_path(built), by_lamps(built)
    assert (error < 0.03 * wanted.max()).all()
    assert error.sum() < its_error.sum()  # of four times the rays
    np.testing.assert_array_less(np.abs(found - wanted), 4 * np.hypot(error, its_error))


@pytest.mark.slow
@pytest.mark.parametrize("surface", ["wide", "blend"])
@pytest.mark.parametrize("lights", [with_sky, with_lamp_and_sky])
def test_other_lights_are_drawn_beside_the_lamps(lights, surface, llvm):
    built = scene({"wide": partial(blaze, 2.0), "blend": blend}[surface](), lights())
    assert eye_paths(built).candidates.any == (lights is with_lamp_and_sky)
    (wanted, its_error), (found, error) = by_path(built), by_lamps(built)
    assert (error < 0.02 * wanted.max()).all()
    np.testing.assert_array_less(np.abs(found - wanted), 4 * np.hypot(error, its_error))


def test_emitters_are_drawn_with_the_probabilities_of_the_scene(llvm):
    weights = [3.0, 0.5, 1.0, 2.0]
    lights = {f"bulb{k}": {**LAMPS["bulb"]()["bulb"], "sampling_weight": weight} for k, weight in enumerate(weights)}
    built = scene(blaze(), lights)
    some = Emitters(built, np.array([False, True, False, True]))
    u = (dr.arange(mi.Float, 10000) + 0.5) / 10000
    drawn, _, _ = built.sample_emitter(some.of(mi.Point2f(u, 0.25), True).x)
    shares = np.bincount(np.array(drawn), minlength=4) / 10000
    np.testing.assert_allclose(shares, [0, 0.2, 0, 0.8], atol=2e-4)
    assert float(some.probability[0]) == pytest.approx(2.5 / 6.5)


def test_resampling_keeps_each_wavelength_in_proportion_to_its_value(llvm):
    wavelengths, values = (410.0, 450, 500, 540, 590, 630, 680, 720), (0.0, 1.0, 3.0, 0.0, 0.5, 0.25, 0.0, 6.0)
    number = (dr.arange(mi.Float, 4000) + 0.5) / 4000
    of_each = zip(map(mi.Float, wavelengths), map(mi.Float, values), strict=True)
    kept, value = (np.broadcast_to(np.array(x), (4, 4000)) for x in resampled(list(of_each), number))
    for wavelength, wanted in zip(wavelengths, values, strict=True):
        assert value[kept == wavelength].sum() / 4000 == pytest.approx(wanted, abs=3e-3)


@pytest.mark.slow
def test_without_lamps_the_samples_are_the_same(llvm):
    lamp = with_lamp_and_sky()["lamp"]
    built = scene(blaze(), {"lamp": lamp})
    eye, _ = mi.load_dict({"type": "diffraction_path", "max_depth": 2}).parts(built, built.sensors()[0])
    assert not eye.lamps.any
    found = []
    for traces in (True, False):
        sampler, ray, weight = rays(built, 256, 0)
        if traces:
            ((wavelengths, value),), _ = eye.trace(built, sampler, ray, weight)
            np.testing.assert_array_equal(np.array(wavelengths), np.array(ray.wavelengths))
        else:
            value = eye.sample(built, sampler, ray)[0] * weight
        found.append(np.array(value))
    np.testing.assert_array_equal(*found)


FILMS = {
    "colours": {"type": "hdrfilm", "pixel_format": "rgba"},
    "bands": {
        "type": "specfilm",
        **{
            f"band{k}": {**RISING, "wavelength_min": a, "wavelength_max": b}
            for k, (a, b) in enumerate(_pairs(EDGES[::5]))
        },
    },
}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("film", "sensor"),
    [
        pytest.param("colours", {"kind": "perspective"}, marks=pytest.mark.slow),
        pytest.param("bands", {"kind": "thinlens"}),
        pytest.param("colours", {"kind": "thinlens", "fov": 30.0}, marks=pytest.mark.slow),
    ],
)
def test_pictures_have_the_means_of_path(film, sensor, llvm):
    crop = {"crop_offset_x": 1, "crop_width": 3, "crop_offset_y": 2, "crop_height": 2, "rfilter": {"type": "gaussian"}}
    built = scene(blend(), with_sky(), **{"fov": 8.0, **sensor}, **FILMS[film], **crop)
    means, errors = [], []
    for name, spp in (("path", 512), ("diffraction_path", 128)):
        integrator = mi.load_dict({"type": name, "max_depth": 2})
        pictures = [np.array(mi.render(built, integrator=integrator, spp=spp, seed=k)) for k in range(8)]
        means.append(np.mean(pictures, axis=0))
        errors.append(np.std(pictures, axis=0, ddof=1) / np.sqrt(8))
    assert means[0].shape == means[1].shape == (2, 3, 4 if film == "colours" else 2)
    # A standard error of eight pictures is itself known to a quarter.
    np.testing.assert_array_less(np.abs(means[1] - means[0]), 6 * np.hypot(*errors) + 1e-6)


@pytest.mark.slow
def test_sums_of_pixels_contain_the_light_of_lamps(llvm):
    """As `render` takes them, under a filter wider than a pixel."""
    built = scene(blend(), with_sky(), fov=8.0, **FILMS["bands"], rfilter={"type": "gaussian"})
    means, errors = [], []
    for name, spp in (("path", 1024), ("diffraction_path", 256)):
        integrator = mi.load_dict({"type": name, "max_depth": 2})
        sums = [trace_pass(built, spp, seed, integrator).sum((0, 1)) for seed in range(8)]
        radiance = [of_picture[:-1] / of_picture[-1] for of_picture in np.array(sums, np.float64)]
        of_bins = [of_picture[:90].reshape(10, 9).sum(1) for of_picture in radiance]
        means.append(np.mean(of_bins, axis=0))
        errors.append(np.std(of_bins, axis=0, ddof=1) / np.sqrt(8))
    assert (errors[1] < 0.05 * means[0].max()).all()
    np.testing.assert_array_less(np.abs(means[1] - means[0]), 6 * np.hypot(*errors) + 1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "depth", "parameters"),
    [
        ("compact_disc", 2, {"light": "sun"}),
        ("compact_disc", 6, {"light": "sun"}),
        ("foil", 6, {}),
        # Deeper, the light that it casts onto the wall is fireflies in `path`.
        ("rainbow", 2, {}),
    ],
)
def test_every_bin_of_a_scene_agrees_with_path(name, depth, parameters, llvm, monkeypatch):
    monkeypatch.setattr(noise, "SceneFile", partial(SceneFile, parameters=parameters))
    assert_bins_agree(name, depth)
