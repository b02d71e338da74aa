"""`testing` evaluates a BSDF for arrays of directions and wavelengths; K G against its published forms."""

import mitsuba as mi
import numpy as np
import pytest
from bsdf_support import floats, random_directions, use, vectors

from mitsuba_diffraction import testing
from mitsuba_diffraction.evaluation.validation.lobes import k_g_between

COPPER = {"type": "roughconductor", "material": "Cu", "alpha": 0.3}
WAVELENGTHS = np.array([400.0, 450.0, 500.0, 550.0, 600.0, 650.0])
DIRECTIONS = random_directions(np.random.default_rng(1), 5, 0.2)


@pytest.mark.parametrize("variant", ["llvm_ad_spectral", "llvm_ad_spectral_polarized"])
def test_values_are_those_of_single_calls(variant):
    use(variant)
    bsdf, wi = mi.load_dict(COPPER), testing.direction(30, 20)
    value, pdf = testing.evaluate_pdf(bsdf, wi, DIRECTIONS, WAVELENGTHS)
    assert (value.shape, pdf.shape) == ((5, 6), (5, 2))
    si = mi.SurfaceInteraction3f()
    si.wi, si.sh_frame = vectors(wi), mi.Frame3f(mi.Normal3f(0, 0, 1))
    for row, density, wo in zip(value, pdf, DIRECTIONS, strict=True):
        for found, nanometres in zip(row, WAVELENGTHS, strict=True):
            si.wavelengths = mi.UnpolarizedSpectrum(floats(nanometres))
            one, its_pdf = bsdf.eval_pdf(mi.BSDFContext(), si, vectors(wo))
            assert found == pytest.approx(np.array(mi.unpolarized_spectrum(one)).ravel()[0], rel=1e-5)
            np.testing.assert_allclose(density, np.array(its_pdf).item(), rtol=1e-5)
    assert np.ptp(value) > 0.1 * value.max()


def test_every_direction_may_have_wavelengths_of_its_own(llvm):
    bsdf, wi = mi.load_dict(COPPER), testing.direction(30)
    together = testing.evaluate(bsdf, wi, DIRECTIONS, WAVELENGTHS)
    each = testing.evaluate(bsdf, DIRECTIONS[:, None], wi, WAVELENGTHS[:, None])  # reciprocal, but for the cosine
    np.testing.assert_allclose(each[..., 0] * DIRECTIONS[:, 2:], together * wi[2], rtol=1e-4)


def test_samples_agree_with_values(llvm):
    bsdf = mi.load_dict(COPPER)
    wi = np.broadcast_to(testing.direction(30), (64, 3))
    wo, weights, found = testing.sample(bsdf, wi, WAVELENGTHS[:4])
    value, pdf = testing.evaluate_pdf(bsdf, wi, wo, WAVELENGTHS[:4])
    np.testing.assert_allclose(weights * pdf, value, rtol=1e-3, atol=1e-6)
    np.testing.assert_allclose(np.array(found.pdf), pdf[:, 0], rtol=1e-3)


def test_shapes_that_do_not_fit_are_refused(llvm):
    with pytest.raises(ValueError, match="wi, wo, wavelengths: got shapes"):
        testing.evaluate(mi.load_dict(COPPER), [0, 0, 1], [0, 1], [500.0])


@pytest.mark.parametrize("shadowing", [True, False])
def test_k_g_is_that_of_stam_and_of_torrance_and_sparrow(shadowing):
    wi, wo = (random_directions(np.random.default_rng(seed), 200, 0.01) for seed in (1, 2))
    d, w = 1 + (wi * wo).sum(-1), wi[:, 2] + wo[:, 2]
    k = d**2 / (wi[:, 2] * wo[:, 2] * w**2)
    g = np.minimum(1, 2 * w * np.minimum(wi[:, 2], wo[:, 2]) / d) if shadowing else 1
    np.testing.assert_allclose(k_g_between(wi, wo, shadowing), k * g, rtol=1e-9)
