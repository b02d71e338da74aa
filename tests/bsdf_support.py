"""What the tests of the BSDF share: surfaces, directions, interactions."""

import functools
import itertools
import warnings

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import mitsuba_diffraction as md
from mitsuba_diffraction import testing
from mitsuba_diffraction.optics.refractive_indices import index_of
from mitsuba_diffraction.rigorous.build_table import build_rigorous
from mitsuba_diffraction.rigorous.rigorous_spectrum import Axes, RigorousSpectrum
from mitsuba_diffraction.settings import RigorousSettings

array, direction, floats, vectors = testing.array, testing.direction, testing.floats, testing.vectors
WAVELENGTHS = (400.0, 500.0, 600.0, 700.0)
PERIOD = 2.5


def corner_blaze():
    """Blazed along x and along y: its light goes to −x −y, so that a mirrored or rotated pattern differs."""
    ramp = md.gratings.blazed(PERIOD, 0.2, samples=48)
    along_x = ramp.heights[0]
    return md.HeightField(along_x[None, :] + along_x[:, None], PERIOD / 48)


SURFACES = {
    "blazed": lambda: md.gratings.blazed(PERIOD, 0.25),
    "deep blazed": lambda: md.gratings.blazed(PERIOD, 0.8),
    "sinusoidal": lambda: md.gratings.sinusoidal(PERIOD, 0.3),
    "corner": corner_blaze,
    "elaphe": lambda: md.gratings.elaphe_synthetic(8),
}


@functools.cache
def spectrum(name, coherence_length=65.0):
    return md.precompute(SURFACES[name](), coherence_length=coherence_length)


def made_up(coherence_length=65.0):
    """A table of η that no solver knows, symmetric in k_x of ω_i and −k_x of ω_o, of many orders; Σ η_m < 1."""
    axes = Axes(1.7, (0.36, 0.83), (8, 10, 4))
    values = np.empty(axes.shape, np.float32)
    a = np.sin(np.pi / 2 * np.linspace(0, 1, axes.shape[1])) ** 2 / 2
    wavelengths = np.linspace(1, 2, axes.shape[3])
    for (count, _), start in axes.blocks.items():
        n = [order // 2 if order % 2 == 0 else -(order + 1) // 2 for order in range(count)]
        for row, (come, leave) in enumerate(itertools.product(n, n)):
            eta = 1 + np.sin(0.6 * (come + a) + 1) ** 2 + np.sin(1 - 0.6 * (leave + a)) ** 2
            values[start + row] = np.multiply.outer(eta, wavelengths)[:, None] / (80 + 5 * (come - leave))
    settings = RigorousSettings(material="Al", coherence_length=coherence_length, tolerance=0.01)
    digest = index_of("material", "Al").digest
    return RigorousSpectrum(axes, values, None, settings, 0, 0, 0, 1, "made up", "", digest)


@functools.cache
def coarse_glass(transmission):
    """A coarse table of light reflected and transmitted by fine grooves in glass, with Mueller matrices."""
    settings = RigorousSettings(
        int_ior=1.5,
        wavelengths=(400.0, 500.0),
        tolerance=0.2,
        coherence_length=40.0,
        polarised=True,
        transmission=transmission,
    )
    with pytest.MonkeyPatch.context() as patch, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        patch.setattr("mitsuba_diffraction.rigorous.build_table.SOLVED_STEPS_TRANSMISSION", ((3, 4, 3),))
        patch.setattr("mitsuba_diffraction.rigorous.build_table.CHECK_COUNT", 40)
        return build_rigorous(md.gratings.blazed(0.3, 0.05, samples=64), settings)


def use(variant):
    if variant.startswith("llvm") and not dr.has_backend(dr.JitBackend.LLVM):
        pytest.skip("Dr.Jit finds no LLVM")
    mi.set_variant(variant)
    keep_samplers()


@functools.cache
def keep_samplers():
    """Make the tables that draw orders once for all tests of a process that need the same ones."""
    from mitsuba_diffraction.bsdf import shared  # which needs a variant

    kept, make = {}, shared.OrderSampler

    def sampler(spectrum, stack, *media_and_scales):
        key = mi.variant(), spectrum.digest, stack, repr(media_and_scales)
        if key not in kept:
            kept[key] = make(spectrum, stack, *media_and_scales)
        return kept[key]

    shared.OrderSampler = sampler


def uniform(value):
    return {"type": "uniform", "value": value}


def grating(name="blazed", coherence_length=65.0, **parameters):
    """The dictionary of a grating; the perfect mirror unless an index is given."""
    return of_spectrum(spectrum(name, coherence_length), **parameters)


def of_spectrum(spectrum, **parameters):
    """The dictionary of a grating with a given spectrum."""
    if "int_ior" not in parameters:
        parameters.setdefault("material", "none")
    return {"type": "diffraction_grating", "spectrum": spectrum, **parameters}


def plugin(spectrum, **parameters):
    """The BSDF with a given spectrum."""
    return mi.load_dict(of_spectrum(spectrum, **parameters))


def towards(wi, orders, wavelength, pitch=1 / PERIOD):
    """ω_o of the orders (n, 2) at one wavelength (nm); those that are evanescent are left out."""
    t = -wavelength * 1e-3 * pitch * np.asarray(orders) - wi[:2]
    t = t[(t**2).sum(-1) < 0.99]
    return np.concatenate([t, np.sqrt(1 - (t**2).sum(-1, keepdims=True))], -1)


def random_directions(rng, count, least=0.05):
    z, phi = rng.uniform(least, 1, count), rng.uniform(0, 2 * np.pi, count)
    r = np.sqrt(1 - z**2)
    return np.stack([r * np.cos(phi), r * np.sin(phi), z], -1)


def interaction(wi, wavelengths=WAVELENGTHS, count=1, uv=(0.0, 0.0)):
    return testing.interaction(np.broadcast_to(wi, (count, 3)), wavelengths, uv)


def evaluate(bsdf, wi, wo, ctx=None, wavelengths=WAVELENGTHS, uv=(0.0, 0.0)):
    """f cos θ_o (4, n) and pdf (n,)."""
    value, pdf = testing.evaluate_pdf(bsdf, wi, np.atleast_2d(wo), wavelengths, ctx, uv)
    return value.T, pdf[:, 0]


def draw(bsdf, wi, count, ctx=None, seed=1, uv=(0.0, 0.0), wavelengths=WAVELENGTHS):
    """Samples and their weights (4, n)."""
    _, weights, bs = testing.sample(bsdf, np.broadcast_to(wi, (count, 3)), wavelengths, seed, ctx, uv)
    return bs, weights.T


def six_samples(bsdf, two_directions, wavelengths=WAVELENGTHS):
    """Weights, values, directions, η and densities of three samples for each of two ω_i, (13, 6)."""
    u = np.tile([(0.05, 0.3, 0.8), (0.4, 0.2, 0.9), (0.6, 0.7, 0.1)], 2)
    si = interaction(np.repeat(two_directions, 3, axis=0), wavelengths, 6)
    bs, weight = bsdf.sample(mi.BSDFContext(), si, floats(u[0]), mi.Point2f(*map(floats, u[1:])))
    value, pdf = bsdf.eval_pdf(mi.BSDFContext(), si, bs.wo)
    parts = mi.unpolarized_spectrum(weight), mi.unpolarized_spectrum(value), bs.wo, bs.eta, pdf
    dr.eval(parts)  # in one kernel
    return np.vstack([np.array(part) + np.zeros(6) for part in parts])


def check_chi_square(bsdf, wi, wavelengths=WAVELENGTHS, ctx=None, cases=1, side=1, ires=64):
    """Mitsuba's chi² test of what is drawn, without mirrors, against the density; `cases` share the level of 0.01.

    All is drawn above the surface, or below with `side` −1.
    """
    ctx = ctx or mi.BSDFContext()

    # In the plane of direction cosines, where lobes have one width everywhere: dω = dx dy / cos θ.
    def sample(points):
        si = interaction(wi, wavelengths, dr.width(points))
        bs, _ = bsdf.sample(ctx, si, points.x, mi.Point2f(points.y, points.z))
        keep = (bs.pdf > 0) & ~mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        # The plane does not tell what is above the surface from what is below.
        assert not dr.any(keep & (bs.wo.z * side <= 0))
        return dr.select(keep, mi.Vector2f(bs.wo.x, bs.wo.y), 0), dr.select(keep, mi.Float(1), 0)

    def density(p):
        z = dr.safe_sqrt(1 - dr.squared_norm(p))
        pdf = bsdf.pdf(ctx, interaction(wi, wavelengths, dr.width(p)), mi.Vector3f(p.x, p.y, side * z))
        return dr.select(z > 0, pdf / z, 0)

    domain = mi.chi2.PlanarDomain()
    # The density of cells has steps, which the test integrates well only on a fine grid.
    test = mi.chi2.ChiSquareTest(domain, sample, density, sample_dim=3, sample_count=400_000, res=41, ires=ires)
    assert test.run(significance_level=0.01, test_count=cases, quiet=True), test.messages


def hemisphere(side=512):
    """Directions above the surface that tile the plane of direction cosines, and the du dv of each."""
    u = 2 * (np.arange(side) + 0.5) / side - 1
    x, y = (axis.ravel() for axis in np.meshgrid(u, u))
    inside = x**2 + y**2 < 1
    x, y = x[inside], y[inside]
    return np.stack([x, y, np.sqrt(1 - x**2 - y**2)], -1), (2 / side) ** 2


def albedo(bsdf, wi, side=512, **arguments):
    """∫ f cos θ_o dω_o = ∫ f du dv of what `eval` shows, (4,)."""
    wo, area = hemisphere(side)
    return (evaluate(bsdf, wi, wo, **arguments)[0] / wo[:, 2]).sum(1) * area


def through(cosine, index=1.5):
    """1 − R of a dielectric."""
    t = np.sqrt(1 - (1 - cosine**2) / index**2)
    s, p = (cosine - index * t) / (cosine + index * t), (index * cosine - t) / (index * cosine + t)
    return 1 - (s**2 + p**2) / 2


def bitmap(values, **parameters):
    """A texture with these values as they are: 32 bits, not 16, and numbers, not colours."""
    exact = {"raw": True, "format": "variant"}
    return {"type": "bitmap", "bitmap": mi.Bitmap(np.atleast_3d(np.float32(values))), **exact, **parameters}
