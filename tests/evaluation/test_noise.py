"""The noise of pictures at equal time."""

from pathlib import Path

import numpy as np
import pytest

from mitsuba_diffraction.bsdf.base import gratings_in
from mitsuba_diffraction.evaluation.benchmark.noise import load_for_noise, measure_noise, relative_noise
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
    beside_path, beside_rough = measure_noise(
        [BLAZE], depths=[2], width=24, samples=8, pictures=2, progress=lambda *step: steps.append(step)
    )
    assert (beside_path.scene, beside_path.beside, beside_path.depth) == ("blaze", "path", 2)
    assert (beside_rough.beside, steps) == ("roughconductor", [(1, 1)])
    for found in (beside_path, beside_rough):
        assert min(found.seconds, found.time, found.on_gratings, found.of_picture) > 0
        assert found.on_gratings_at_equal_time == found.on_gratings * found.time


@pytest.mark.slow
def test_a_skin_is_measured_beside_the_data_driven_bsdf_too(llvm):
    scene = BLAZE.with_name("xenopeltis.xml")
    found = measure_noise([scene], depths=[2], width=16, samples=4, pictures=2)
    assert [one.beside for one in found] == ["path", "roughconductor", "measured"]


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
