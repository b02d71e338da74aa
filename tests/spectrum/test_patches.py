"""The mean over several seeds of a surface that is drawn at random, against float64 and against other seeds."""

import mitsuba as mi
import numpy as np
import pytest

import mitsuba_diffraction as md
from mitsuba_diffraction import Recipe
from mitsuba_diffraction.precomputation.grating_spectrum import GratingSpectrum
from mitsuba_diffraction.scalar_theory.reference import order_powers, power_spectrum
from mitsuba_diffraction.settings import ScalarSettings, lobe_width
from mitsuba_diffraction.surface.gratings import COHERENCE_LENGTHS, PATCHES, PROFILES

SURFACE = {"profile": "elaphe_synthetic", "size": 7.0, "seed": 3}
GREEN = 4 * np.pi / 0.55
"""κ of 550 nm at normal incidence, rad/µm."""


@pytest.fixture(scope="module")
def recipe():
    return Recipe({**SURFACE, "patches": 3}, ScalarSettings(coherence_length=5.6, tolerance=1e-3))


@pytest.fixture(scope="module")
def spectrum(recipe):
    return recipe.build()


def test_patches_have_consecutive_seeds(recipe):
    wanted = [PROFILES["elaphe_synthetic"](7.0, seed=seed).digest for seed in (3, 4, 5)]
    assert [field.digest for field in recipe.height_fields()] == wanted
    assert recipe.height_field().digest == wanted[0]


def test_the_spectrum_is_the_mean_over_patches(recipe):
    fields = recipe.height_fields()
    # Lobes so narrow that the orders are not gathered on a lattice.
    spectrum = Recipe(recipe.surface, ScalarSettings(coherence_length=60, tolerance=1e-3)).build()
    m_x, m_y = spectrum.grid.axes()
    for kappa in np.array([0.0, 0.21, 0.47, 0.83, 1.0]) * spectrum.max_kappa:
        wanted = np.mean([order_powers(field, kappa)[np.ix_(m_y, m_x)] for field in fields], axis=0)
        assert np.abs(spectrum.powers(kappa) - wanted).sum() < spectrum.error < 1e-3
        # It is none of them, nor the spectrum of their mean height.
        assert kappa == 0 or np.abs(order_powers(fields[0], kappa)[np.ix_(m_y, m_x)] - wanted).sum() > 0.03


def test_the_spectrum_between_orders_is_the_mean_over_patches(recipe, spectrum):
    rng = np.random.default_rng(0)
    q, kappa = rng.uniform(-1.5, 1.5, (300, 2)), np.full(300, GREEN)
    of_each = [power_spectrum(field, q, kappa, coherence_length=5.6) for field in recipe.height_fields()]
    wanted = np.mean(of_each, axis=0)
    np.testing.assert_allclose(spectrum.evaluate(q, kappa), wanted, atol=2e-3 * wanted.max())


@pytest.mark.slow
def test_a_saved_spectrum_records_the_number_of_patches(spectrum, tmp_path):
    spectrum.save(tmp_path / "mean.exr")
    again = GratingSpectrum.load(tmp_path / "mean.exr")
    assert again.patches == spectrum.patches == 3
    assert again.source.startswith("mean of 3 patches: synthetic Elaphe skin")


def test_another_number_of_patches_is_another_spectrum(recipe):
    digests = {Recipe({**SURFACE, "patches": n}, recipe.settings).digest() for n in (1, 2, PATCHES["elaphe_synthetic"])}
    assert len(digests) == 3
    assert Recipe(SURFACE).patches == PATCHES["elaphe_synthetic"]
    assert Recipe(SURFACE, ScalarSettings(extent="sample")).patches == 1
    assert Recipe({"profile": "blazed"}).patches == Recipe({"scan": "a.png"}).patches == 1
    assert Recipe({**SURFACE, "patches": 1}).height_fields()[0].digest == Recipe(SURFACE).height_field().digest


@pytest.mark.parametrize(
    ("surface", "message"),
    [
        ({**SURFACE, "patches": 0}, "patches: got 0, wanted a whole number from 1 to 1000"),
        ({**SURFACE, "patches": 1000000}, "patches: got 1000000, wanted a whole number from 1 to 1000"),
        ({**SURFACE, "patches": -3}, "patches: got -3"),
        ({**SURFACE, "patches": 2.5}, "patches: got 2.5"),
        ({**SURFACE, "patches": "many"}, "patches: got 'many'"),
        ({"profile": "blazed", "patches": 2}, "patches: got 2 of the profile 'blazed', wanted a profile with a seed"),
        ({"scan": "a.png", "patches": 2}, "unknown name patches"),
    ],
)
def test_wrong_numbers_of_patches_are_refused(surface, message):
    with pytest.raises(ValueError, match=message):
        Recipe(surface)


def test_patches_repeat_and_are_of_one_size(recipe):
    fields = recipe.height_fields()
    with pytest.raises(ValueError, match="patches: got 3 with extent 'sample', wanted 1"):
        md.precompute(fields, extent="sample", coherence_length=2.0)
    with pytest.raises(ValueError, match="wanted patches of one size"):
        md.precompute([fields[0], md.gratings.elaphe_synthetic(9.0)])
    with pytest.raises(ValueError, match="patches: got none"):
        md.precompute([])


@pytest.mark.slow
def test_a_scene_sets_the_number_of_patches(llvm):
    surface = {"type": "diffraction_grating", **{**SURFACE, "coherence_length": 5.6, "patches": 2}}
    assert mi.load_dict(surface).spectrum.patches == 2
    with pytest.raises(Exception, match="patches: got 0, wanted a whole number"):
        mi.load_dict({**surface, "patches": 0})
    with pytest.raises(Exception, match="wanted a profile with a seed"):
        mi.load_dict({"type": "diffraction_grating", "profile": "blazed", "patches": 2})


# ---------------------------------------------------------------- enough of them


def seen(fields, sigma):
    """The mean S·dq over patches on a lattice of about a lobe's width, Σ_m η_m N(q − m/T; σ²) dq, for all q at once."""
    axis = np.arange(-4.5, 4.5, 1.2 * sigma)
    total = 0.0
    for field in fields:
        along_x, along_y = (
            1.2 / np.sqrt(2 * np.pi) * np.exp(-0.5 * np.square((axis[:, None] - np.fft.fftfreq(n, d)) / sigma))
            for n, d in zip(field.shape[::-1], field.pixel_size, strict=True)
        )
        total += along_y @ order_powers(field, GREEN) @ along_x.T
    return total / len(fields)


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(PATCHES))
def test_default_patches_agree_for_other_seeds_to_eight_per_cent(name):
    sigma = lobe_width(COHERENCE_LENGTHS[name])
    default = seen(Recipe({"profile": name}).height_fields(), sigma)
    others = seen([PROFILES[name](seed=1000 + k) for k in range(63)], sigma)
    assert np.abs(default - others).sum() < 0.08
    # One of them differs by more.
    assert np.abs(seen([PROFILES[name](seed=0)], sigma) - others).sum() > 0.08
