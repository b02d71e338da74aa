"""Samples of every kind of surface in every mode: their density, their weights, their pdf. Modes multiply."""

import dataclasses
import functools

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from bsdf_support import WAVELENGTHS, array, coarse_glass, direction, hemisphere, made_up, vectors

import mitsuba_diffraction as md
from mitsuba_diffraction import testing

INDEX = 1.5
DENSE = (240.0, 830.0)  # nm, the wavelengths in a medium of this index


def scalar(heights, **settings):
    return lambda: md.precompute(heights(), wavelengths=DENSE, tolerance=1e-2, **settings)


SURFACES = {
    "resolved": scalar(lambda: md.gratings.blazed(2.5, 0.25), coherence_length=16.0),
    "overlapping": scalar(lambda: md.gratings.crossed(2.5, 0.25), coherence_length=4.0),
    "spline": scalar(lambda: md.gratings.xenopeltis((9.0, 8.0)), extent="sample", coherence_length=4.0),
    "line": scalar(
        lambda: md.HeightField(md.gratings.blazed(2.5, 0.25).heights.T, (2.5, 2.5 / 512)), coherence_length=5.0
    ),
    "patches": scalar(lambda: [md.gratings.elaphe(8.0, seed=seed) for seed in (1, 2)], coherence_length=5.0),
}
MODES = {
    "mirror": {"material": "none"},
    "coat": {"material": "none", "coat_ior": INDEX, "ext_ior": 1.0},
    "base": {"int_ior": INDEX, "ext_ior": 1.0, "base": {"type": "diffuse", "reflectance": 0.5}},
    "interface": {"int_ior": INDEX, "ext_ior": 1.0, "transmission": "interface"},
    "sheet": {"int_ior": INDEX, "ext_ior": 1.0, "transmission": "sheet"},
}
PAIRS = [(surface, mode) for surface in (*SURFACES, "rigorous") for mode in MODES]
PAIRS.remove(("rigorous", "base"))  # the base needs R of a plane
spectrum = functools.cache(lambda surface: SURFACES[surface]())


def grating(surface, mode):
    """Return the BSDF, and the wavelengths at which its table is read."""
    parameters = MODES[mode]
    if surface != "rigorous":
        # E, one table for each of these, is a factor of value and weight alike.
        parameters = {**parameters, "spectrum": spectrum(surface), "conserve_energy": False}
        return mi.load_dict({"type": "diffraction_grating", **parameters}), WAVELENGTHS
    if "transmission" in parameters:
        table = dataclasses.replace(coarse_glass(mode), coherence_length=12.0)
        parameters = {**parameters, "spectrum": table}
        return mi.load_dict({"type": "diffraction_grating", **parameters}), (405.0, 440.0, 470.0, 498.0)
    table = dataclasses.replace(made_up(8.0), ext_ior=INDEX if mode == "coat" else 1.0)
    parameters = {key: value for key, value in parameters.items() if key != "material"}
    wavelengths = (600.0, 700.0, 800.0, 900.0) if mode == "coat" else WAVELENGTHS
    return mi.load_dict({"type": "diffraction_grating", "spectrum": table, **parameters}), wavelengths


def incidences(mode):
    """Return ω_i from above and, with transmission, from below: inside of a medium beyond the critical angle, too."""
    above = direction([20, 60, 80], [10, 130, 250])
    return np.concatenate([above, above * [1, 1, -1]]) if "transmission" in MODES[mode] else above


@pytest.mark.filterwarnings("ignore:pixels of")
@pytest.mark.few(14)
@pytest.mark.parametrize(("surface", "mode"), PAIRS)
def test_samples_have_their_density_and_average_to_the_albedo(llvm, surface, mode):
    bsdf, wavelengths = grating(surface, mode)
    wi, count, ctx = incidences(mode), 1 << 16, mi.BSDFContext()
    of_wi = np.repeat(wi, count, axis=0)
    omega, weight, bs = testing.sample(bsdf, of_wi, wavelengths)
    again = np.array(bsdf.pdf(ctx, testing.interaction(of_wi, wavelengths), bs.wo), np.float64)
    pdf, is_delta = np.array(bs.pdf, np.float64), np.array(mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta))
    assert np.isfinite(pdf).all()
    assert np.isfinite(weight).all()
    assert (weight >= 0).all()
    drawn = (pdf > 0) & ~is_delta
    np.testing.assert_allclose(again[drawn], pdf[drawn], rtol=2e-3)

    # The integrals by another sampling: uniform in the plane of direction cosines, dω = du dv / cos θ_o.
    wo, area = hemisphere(256)
    per_cosine = area / wo[:, 2]
    for side in (1, -1) if "transmission" in MODES[mode] else (1,):
        si = testing.interaction(np.repeat(wi, len(wo), axis=0), wavelengths)
        value, density = bsdf.eval_pdf(ctx, si, vectors(np.tile(wo * [1, 1, side], (len(wi), 1))))
        dr.eval(value, density)
        value = (array(value, np.float64).reshape(-1, len(wi), len(wo)) * per_cosine).sum(-1).T
        density = (np.array(density, np.float64).reshape(len(wi), -1) * per_cosine).sum(-1)
        is_here = (drawn & (omega[:, 2] * side > 0)).reshape(len(wi), count)
        np.testing.assert_allclose(density, is_here.mean(1), rtol=0.03, atol=4 * 0.5 / np.sqrt(count))
        weights = np.where(is_here[..., None], weight.reshape(len(wi), count, -1), 0)
        error = weights.std(1) / np.sqrt(count)
        np.testing.assert_array_less(np.abs(weights.mean(1) - value), 4 * error + 0.02 * value + 1e-9)
