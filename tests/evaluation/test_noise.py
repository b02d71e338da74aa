"""The noise of pictures at equal time."""

from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_diffraction.bsdf.base import gratings_in
from mitsuba_diffraction.bsdf.testing import evaluate_pdf, sample
from mitsuba_diffraction.evaluation.benchmark.noise import (
    _averaging,
    _radiance,
    load_for_noise,
    measure_noise,
    relative_noise,
)
from mitsuba_diffraction.evaluation.benchmark.perfect_sampling import sample_perfectly
from mitsuba_diffraction.evaluation.benchmark.speed import machine

BLAZE = Path(__file__).parents[2] / "scenes" / "blaze.xml"


def test_relative_noise_is_the_variance_over_the_square_of_the_mean():
    rng = np.random.default_rng(1)
    where = np.arange(40 * 50).reshape(40, 50) % 3 > 0
    pictures = np.where(where[..., None], 5 + 0.5 * rng.normal(size=(6, 40, 50, 3)), 100 * rng.normal(size=(40, 50, 3)))
    assert relative_noise(pictures, where) == pytest.approx(0.01, rel=0.03)


@pytest.mark.slow
def test_the_gratings_of_a_scene_are_replaced(llvm):
    for gratings in (True, False):
        partner = None if gratings else {"type": "roughconductor", "material": "Al"}
        scene = load_for_noise(BLAZE, 32, partner, max_depth=3)
        assert any(gratings_in(shape.bsdf()) for shape in scene.shapes()) == gratings
        assert "IndependentSampler" in str(scene.sensors()[0].sampler())
        assert "max_depth = 3" in str(scene.integrator())
        assert ("RoughConductor" in str(scene)) != gratings


@pytest.mark.slow
def test_a_picture_is_measured_beside_roughconductor(llvm):
    steps = []
    (found,), (bounds,) = measure_noise(
        [BLAZE], depths=[2], width=24, samples=8, pictures=2, progress=lambda *step: steps.append(step)
    )
    assert (found.scene, found.beside, found.depth, steps) == ("blaze", "roughconductor", 2, [(1, 2), (2, 2)])
    assert min(found.seconds, found.time, found.on_gratings, found.of_picture, found.of_one_wavelength) > 0
    assert found.on_gratings_at_equal_time == found.on_gratings * found.time
    # More samples at a point take more time, and cannot remove the noise of the points and wavelengths.
    assert bounds.time_of_four > 1
    assert 0 <= bounds.all < 1
    assert bounds.perfect > 0
    assert bounds.four_at_equal_time == bounds.four * bounds.time_of_four


@pytest.mark.slow
@pytest.mark.parametrize(
    "surface",
    [
        {"profile": "blazed", "period": 2.5, "depth": 0.25},
        {"profile": "crossed", "period": 2.5, "depth": 0.2, "material": "Al", "coat_ior": 1.5},
    ],
)
def test_perfect_sampling_has_the_density_of_f_cos(surface, llvm):
    """Its weights are the reflectance, and it keeps the mean of the grating's own weights."""
    plate = {"type": "rectangle", "bsdf": {"type": "diffraction_grating", "coherence_length": 6.0, **surface}}
    scene = mi.load_dict({"type": "scene", "plate": plate})
    (bsdf,) = gratings_in(scene.shapes()[0].bsdf())
    wi, wavelengths = np.broadcast_to([0.6, 0, 0.8], (20000, 3)), [550.0] * 4
    wo, own, _ = sample(bsdf, wi, wavelengths)
    sample_perfectly(scene)
    drawn, perfect, _ = sample(bsdf, wi, wavelengths)
    assert perfect[:, 0].mean() == pytest.approx(own[:, 0].mean(), rel=0.02)
    assert perfect[:, 0].std() < own[:, 0].std() / 2
    # ∫ f cos x² dω: the directions are drawn as their weights say.
    moments = [np.mean(weight[:, 0] * omega[:, 0] ** 2) for omega, weight in ((wo, own), (drawn, perfect))]
    assert moments[1] == pytest.approx(moments[0], rel=0.03)
    value, pdf = evaluate_pdf(bsdf, wi, wo, wavelengths)
    rough = value[:, 0] > 0  # not the mirror image in the coat
    # R is estimated anew for each direction.
    assert np.abs(pdf[rough, 0] / value[rough, 0] * own[:, 0].mean() - 1).mean() < 0.2


@pytest.mark.slow
def test_a_skin_is_measured_beside_the_data_driven_bsdf_too(llvm):
    scene = BLAZE.with_name("xenopeltis.xml")
    found, _ = measure_noise([scene], depths=[2], width=16, samples=4, pictures=2)
    assert [one.beside for one in found] == ["roughconductor", "measured"]


@pytest.mark.slow
def test_many_samples_along_a_ray_have_the_light_of_one(llvm):
    """In the sun, which `direct` would add once for each of many samples of the lights."""
    scene = load_for_noise(BLAZE.with_name("foil.xml"), 48, None, type="direct")
    one, many = (
        _radiance(scene, integrator, 64, 1)
        for integrator in (scene.integrator(), _averaging(mi.variant())(scene.integrator()))
    )
    assert many.mean() == pytest.approx(one.mean(), rel=0.03)


def test_the_machine_is_named(llvm):
    named = machine()
    assert named["cores"] >= 1
    assert named["processor"]
    assert named["variant"] == "llvm_ad_spectral"


@pytest.mark.parametrize("other", ["--terms", "--surface blazed", "--plot a.png"])
def test_pictures_take_no_other_option(command, other):
    code, out, error = command(f"benchmark --pictures {other}")
    assert (code, out) == (2, "")
    assert "--pictures: got another option than --variant and --json" in error
