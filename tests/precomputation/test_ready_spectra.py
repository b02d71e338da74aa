"""The spectra that the package brings are those that their recipes give, and scenes take them."""

import functools
from pathlib import Path

import numpy as np
import pytest
import ready_spectra

from mitsuba_diffraction.energy.table import EnergyTable
from mitsuba_diffraction.precomputation.recipe import READY_SPECTRA, Recipe
from mitsuba_diffraction.precomputation.spectra import load_spectrum
from mitsuba_diffraction.render.scene_file import SceneFile

ROOT = Path(__file__).parents[2]


@functools.cache
def recipe_of(name):
    return Recipe.load(ROOT / "precompute" / f"{name}.toml")


@functools.cache
def built(name):
    return recipe_of(name).build()


def kept(name):
    digest = recipe_of(name).digest()
    return load_spectrum(READY_SPECTRA / f"{digest}.exr", recipe=digest)


@pytest.mark.not_quick
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=() if name == "elaphe_afm" else pytest.mark.slow) for name in ready_spectra.NAMES]
)
def test_a_spectrum_of_the_package_is_that_of_its_recipe(name):
    ready, new = kept(name), built(name)
    assert (ready.source, ready.warning) == (new.source, new.warning)
    assert ready.error == pytest.approx(new.error, rel=1e-3)
    q = np.random.default_rng(0).uniform(-1.5, 1.5, (4000, 2))
    for kappa in (8.0, 15.0, 22.0):
        found, expected = (spectrum.evaluate(q, kappa) for spectrum in (ready, new))
        assert np.abs(found - expected).sum() < 1e-4 * expected.sum()


@pytest.mark.slow
@pytest.mark.parametrize("name", ready_spectra.NAMES)
def test_e_of_a_spectrum_of_the_package_is_that_of_its_recipe(name):
    assert np.abs(kept(name).energy.values.astype(int) - built(name).energy_table().values).max() <= 1


@pytest.mark.slow
@pytest.mark.parametrize("name", ["elaphe", "xenopeltis"])
def test_a_spectrum_of_a_skin_keeps_its_tolerance_in_ten_megabytes(name):
    assert built(name).error <= built(name).tolerance == 0.01
    assert built(name).megabytes < 10


def test_no_other_spectrum_is_in_the_package():
    digests = {recipe_of(name).digest() for name in ready_spectra.NAMES}
    assert {path.stem for path in READY_SPECTRA.iterdir()} == digests


@pytest.mark.parametrize("scene", ["elaphe", "xenopeltis"])
def test_first_pictures_compute_no_spectrum(scene, tmp_path, monkeypatch, llvm):
    monkeypatch.setenv("MITSUBA_DIFFRACTION_CACHE", str(tmp_path))
    monkeypatch.setattr(Recipe, "build", lambda *_: pytest.fail("a spectrum was computed"))
    monkeypatch.setattr(EnergyTable, "of", lambda *_: pytest.fail("a table of E was computed"))
    SceneFile(ROOT / "scenes" / f"{scene}.xml", size=(4, 4)).load()
    assert not list(tmp_path.iterdir())
