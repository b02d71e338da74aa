"""Samples of `blendbsdf` that fail in one part: the light of a grating beside it counts once."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from test_diffraction_path import plate, scene

import mitsuba_diffraction as md
from mitsuba_diffraction.integrator.paths import LightPaths

COUNT = 1 << 18
WAVELENGTHS = (430.0, 500.0, 570.0, 640.0)
PARTS = {
    "diffuse": {"type": "diffuse"},
    "roughconductor": {"type": "roughconductor", "alpha": 0.4},
    "twosided": {"type": "twosided", "bsdf": {"type": "diffuse"}},
}


def blend(part, transmission):
    """A continuum of transmitted light, as wide as that of a diffuser."""
    heights, k = np.random.default_rng(1).normal(size=(128, 128)), np.fft.fftfreq(128)
    heights = np.fft.ifft2(np.fft.fft2(heights) * np.exp(-300 * np.add.outer(k**2, k**2))).real
    heights = md.HeightField(0.3 * heights / heights.std(), 0.05)
    spectrum = md.precompute(heights, coherence_length=1.5, extent="sample", tolerance=0.02, wavelengths=(230, 830))
    grating = {"type": "diffraction_grating", "spectrum": spectrum, "int_ior": 1.5, "transmission": transmission}
    return {"type": "blendbsdf", "weight": 0.5, "grating": {**grating, "conserve_energy": False}, "part": PARTS[part]}


def interactions(built, height, wi):
    """At a point of the plate, with directions drawn uniformly."""
    ray = mi.Ray3f(mi.Point3f(0.1, 0.2, height - 0.1), mi.Vector3f(0, 0, 1))
    ray.wavelengths = mi.Spectrum(WAVELENGTHS)
    si = dr.gather(mi.SurfaceInteraction3f, built.ray_intersect(ray), dr.zeros(mi.UInt32, COUNT))
    si.wi = si.to_local(mi.Vector3f(wi))
    rng = mi.PCG32(size=COUNT, initseq=7)
    return si, mi.warp.square_to_uniform_sphere(mi.Point2f(rng.next_float32(), rng.next_float32())), rng


def mean_and_error(value):
    value = np.array(mi.Float(dr.mean(value)))
    return value.mean(), value.std() / np.sqrt(COUNT)


@pytest.mark.slow
@pytest.mark.parametrize("below", [True, False])
@pytest.mark.parametrize("transmission", ["interface", "sheet"])
@pytest.mark.parametrize("part", PARTS)
def test_scattered_power_is_the_integral_over_directions(part, transmission, below, llvm):
    built = scene(plate=plate(blend(part, transmission), height=0.5), sky={"type": "constant"})
    light = mi.load_dict({"type": "diffraction_path"}).parts(built, built.sensors()[0])[1]
    assert isinstance(light, LightPaths)
    si, wo, rng = interactions(built, 0.5, [0.5, 0.2, -0.8 if below else 0.8])
    bsdf = si.bsdf()
    u, v = mi.Float(rng.next_float32()), mi.Point2f(rng.next_float32(), rng.next_float32())
    _, weight, specular = light._scatter(si, bsdf, mi.Spectrum(1), mi.Bool(False), u, v, mi.Bool(True))
    found, error = mean_and_error(dr.select(specular, 0, weight))
    back = mi.SurfaceInteraction3f(si)
    back.wi = wo
    power = bsdf.eval(mi.BSDFContext(), back, si.wi) * dr.abs(wo.z / si.wi.z) * 4 * np.pi
    wanted, its_error = mean_and_error(power)
    assert abs(found - wanted) < 4 * np.hypot(error, its_error)
    assert its_error < 0.01 * wanted


@pytest.mark.slow
@pytest.mark.parametrize("part", PARTS)
def test_radiance_from_the_eye_is_the_integral_over_directions(part, llvm):
    """In a furnace, seen from below; `path` is 28 % too bright where a part fails."""
    sky = {"type": "constant", "radiance": {"type": "uniform", "value": 1.0}}
    built = mi.load_dict({"type": "scene", "plate": plate(blend(part, "interface"), height=0.5), "sky": sky})
    sensor = mi.load_dict({"type": "perspective"})
    eye, _ = mi.load_dict({"type": "diffraction_path", "max_depth": 3}).parts(built, sensor)
    si, wo, _ = interactions(built, 0.5, [0.5, 0.2, -0.8])
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(3, COUNT)
    direction = -mi.Vector3f(si.to_world(si.wi))
    ray = mi.RayDifferential3f(mi.Ray3f(si.p - direction, direction, 0.0, mi.Spectrum(WAVELENGTHS)))
    found, error = mean_and_error(eye.sample(built, sampler, ray)[0])
    wanted, its_error = mean_and_error(si.bsdf().eval(mi.BSDFContext(), si, wo) * 4 * np.pi)
    assert abs(found - wanted) < 4 * np.hypot(error, its_error)
    assert np.hypot(error, its_error) < 0.01 * wanted
