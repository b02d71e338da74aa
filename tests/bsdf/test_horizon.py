"""Lobes at the horizon: the albedo, and the weights of samples."""

import mitsuba as mi
import numpy as np
import pytest
from bsdf_support import direction, draw, plugin

import mitsuba_diffraction as md

pytestmark = pytest.mark.usefixtures("llvm")
COUNT = 1 << 17


def flat(coherence_length):
    return md.precompute(md.HeightField(np.zeros((1, 64)), 0.05), coherence_length=coherence_length)


@pytest.mark.few(5)
@pytest.mark.parametrize("coherence_length", [5.0, 30.0, 65.0])
@pytest.mark.parametrize(("theta", "least"), [(85, 0.98), (89, 0.9), (89.9, 0.9)])
def test_flat_mirror_has_albedo_one_at_grazing_incidence(coherence_length, theta, least):
    _, weight = draw(plugin(flat(coherence_length)), direction(theta, 30), COUNT)
    albedo, error = weight.mean(1), weight.std(1) / np.sqrt(COUNT)
    assert (albedo > least - 3 * error).all()
    assert (albedo < 1.002 + 3 * error).all()


@pytest.mark.few(4)
@pytest.mark.parametrize("theta", [80, 88, 89.5, 89.9])
@pytest.mark.parametrize("phi", [0, 37, 90, 200])
def test_weights_at_grazing_incidence_are_bounded(theta, phi):
    """Regression: with a cosine lobe the maximum weight was 221 at 89.5°."""
    spectrum = md.precompute(md.gratings.blazed(2.5, 0.25), coherence_length=5.0)
    _, weight = draw(plugin(spectrum), direction(theta, phi), COUNT)
    assert weight.max() < 40
    assert ((weight**2).mean(1) < 2.6 * weight.mean(1) ** 2).all()


@pytest.mark.slow
@pytest.mark.parametrize("theta", [88, 25, 60, 85])
def test_rigorous_grating_has_the_albedo_of_the_solver(theta):
    profile, wi = md.gratings.sinusoidal(0.3, 0.1), direction(theta, 0)
    settings = {"theory": "rigorous", "material": "Al", "wavelengths": (540.0, 560.0), "tolerance": 0.02}
    spectrum = md.precompute(profile, coherence_length=30.0, **settings)
    _, weight = draw(
        mi.load_dict({"type": "diffraction_grating", "spectrum": spectrum}), wi, COUNT, wavelengths=[550.0] * 4
    )
    solved = md.rigorous.efficiencies(profile, wi, 0.55, material="Al")
    wanted = (solved.s.sum() + solved.p.sum()) / 2
    error = weight[0].std() / np.sqrt(COUNT)
    assert weight[0].mean() == pytest.approx(wanted, abs=0.02 * wanted + 3 * error)
