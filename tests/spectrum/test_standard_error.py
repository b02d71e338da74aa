"""The standard error of one scan against the scatter of many, whose truth is known."""

from pathlib import Path

import numpy as np
import pytest

import mitsuba_diffraction as md
from mitsuba_diffraction.precomputation.grating_spectrum import GratingSpectrum
from mitsuba_diffraction.scalar_theory.reference import power_spectrum
from mitsuba_diffraction.spectrum.sample import standard_error

KAPPA, REACH = 34.9, 5.56
"""rad/µm and cycles/µm: what light of 360 nm reaches."""


def speckle(seed, count=160, pixel=0.05):
    """Independent heights of far more than a wavelength: a fully developed speckle, of which all is known."""
    rng = np.random.default_rng(seed)
    return md.HeightField(rng.uniform(0, 2 * np.pi / KAPPA * 40, (count, count)), pixel)


def spread(fields, coherence_length, kappa):
    """∫ of the standard deviation of S over q, from draws of the same surface, by the float64 reference."""
    step = 1 / (2 * np.pi * coherence_length)  # half of a lobe's width
    axis = np.arange(-REACH, REACH, 5 * step)
    q = np.stack(np.meshgrid(axis, axis), axis=-1)
    draws = [
        power_spectrum(field, q, np.full(q.shape[:-1], kappa), extent="sample", coherence_length=coherence_length)
        for field in fields
    ]
    return np.std(draws, axis=0, ddof=1).sum() * (5 * step) ** 2


@pytest.mark.parametrize("coherence_length", [1.0, 4.0])
def test_the_standard_error_of_speckle_is_that_of_independent_windows(coherence_length):
    # The relative standard error is 1/√P_eff at every q, and Gaussian windows σ_s apart have P_eff = P/Σ_j e^{−j²/2}²…
    found = np.mean(
        [
            standard_error(speckle(s), coherence_length=coherence_length, max_kappa=KAPPA, max_frequency=np.inf)
            for s in range(4)
        ]
    )
    sigma = coherence_length / 4
    count = int(np.ceil((8 - 6 * sigma) / sigma * (1 - 1e-9))) + 1
    along = np.linspace(0, 8 - 6 * sigma, count)
    correlation = np.exp(-((along[:, None] - along) ** 2) / (2 * sigma**2))
    # … which both axes share.
    assert found == pytest.approx(correlation.mean(), rel=0.12)


def test_a_flat_scan_has_no_standard_error():
    flat = md.HeightField(np.zeros((60, 50)), 0.05)
    found = standard_error(flat, coherence_length=1.0, max_kappa=KAPPA, max_frequency=REACH)
    assert found == pytest.approx(0, abs=1e-12)


def test_a_uniform_axis_adds_no_standard_error():
    # A row of pixels scatters more than a square, which has more positions of the window.
    rng = np.random.default_rng(1)
    heights = rng.uniform(0, 7, (120, 120))
    row, square = (
        standard_error(md.HeightField(h, 0.05), coherence_length=1.0, max_kappa=KAPPA, max_frequency=np.inf)
        for h in (heights[:1], heights)
    )
    assert row == pytest.approx(np.sqrt(square), rel=0.25)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["elaphe", "xenopeltis"])
@pytest.mark.parametrize(("size", "coherence_length"), [(20.0, 5.0), (20.0, 10.0), (6.0, 1.5), (6.0, 3.0)])
def test_the_standard_error_of_a_skin_is_right_within_a_factor_of_1_3(name, size, coherence_length):
    fields = []
    for seed in range(12):
        skin = md.gratings.PROFILES[f"{name}_synthetic"](32.0, seed=seed)
        columns, rows = (int(size / p) for p in skin.pixel_size)
        fields.append(md.HeightField(skin.heights[:rows, :columns], skin.pixel_size))
    truth = spread(fields, coherence_length, KAPPA)
    found = [
        standard_error(field, coherence_length=coherence_length, max_kappa=KAPPA, max_frequency=REACH)
        for field in fields
    ]
    assert truth / 1.3 < np.mean(found) < 1.3 * truth


# ---------------------------------------------------------------- in a spectrum


@pytest.fixture(scope="module")
def rough():
    return md.HeightField(np.random.default_rng(0).uniform(0, 0.06, (60, 60)), 0.08, "noise")


def test_a_sample_records_its_standard_error(rough):
    spectrum = md.precompute(rough, extent="sample", coherence_length=1.0)
    at = {"coherence_length": 1.0, "max_kappa": spectrum.max_kappa, "max_frequency": 2 / 0.36}
    assert spectrum.standard_error == pytest.approx(standard_error(rough, **at), rel=1e-6)
    assert md.precompute(rough, extent="sample", coherence_length=1.0, tolerance=0.03).tolerance == 0.03


def test_a_tile_has_no_standard_error():
    spectrum = md.precompute(md.gratings.blazed(samples=64))
    assert spectrum.standard_error is None


@pytest.mark.slow
def test_the_standard_error_is_printed_and_stored(rough, tmp_path, command, monkeypatch):
    monkeypatch.chdir(tmp_path)
    recipe = Path("noise.toml")
    np.save("noise.npy", rough.heights)
    recipe.write_text(
        '[surface]\nscan = "noise.npy"\npixel_size = 0.08\n[spectrum]\nextent = "sample"\ncoherence_length = 1.0\n'
    )
    code, out, err = command("precompute noise.toml")
    assert code == 0, err
    at = {"coherence_length": 1.0, "max_kappa": 4 * np.pi / 0.36, "max_frequency": 2 / 0.36}
    found = GratingSpectrum.load("noise.exr").standard_error
    assert found == pytest.approx(standard_error(rough, **at), rel=1e-6)
    wanted = f"standard error of one scan {found:.2g}"
    assert wanted in " ".join((out + err).split())
