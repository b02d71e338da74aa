"""Errors of the amplitude series against their number of terms: closed forms, bounds, and what a spectrum reports."""

import json

import numpy as np
import pytest
import scipy.special
from PIL import Image
from rich.console import Console

import mitsuba_diffraction as md
from mitsuba_diffraction import gratings
from mitsuba_diffraction.evaluation.benchmark import terms
from mitsuba_diffraction.evaluation.benchmark.cases import MEASURED, TIMED_TILES, Case, tiles
from mitsuba_diffraction.evaluation.plots import save_png

PERIOD, DEPTH = 2.5, 0.375
SINUSOID = Case("sinusoid", gratings.sinusoidal(PERIOD, DEPTH, samples=64), "tile", 65.0)
SKIN = Case("skin", gratings.elaphe_synthetic(8.0, pixel_size=0.125, seed=1), "tile", 65.0)


def errors_of(case):
    return {(e.representation, e.heights_from, e.precision): e for e in terms.series_errors(case)}


def bessel_series(m, z, count):
    """J_m(z) by its power series up to the exponent of z below `count`."""
    k = np.arange(max(0, -(-(count - m) // 2)))
    return np.sum((-1.0) ** k * (z / 2) ** (2 * k + m) / (scipy.special.factorial(k) * scipy.special.factorial(k + m)))


@pytest.mark.parametrize("count", [8, 14, 20])
def test_errors_of_taylor_terms_of_a_sinusoid_are_those_of_the_bessel_series(count):
    """η_m = J_m(κd/2)², and the terms n < N of e^{iκh} are those of the power series of J_m."""
    m = np.arange(int(PERIOD * 2 / 0.36) + 1)
    sums = []
    for z in np.array([0.25, 0.5, 0.75, 1]) * 4 * np.pi / 0.36 * DEPTH / 2:
        partial = np.array([bessel_series(order, z, count) for order in m])
        sums.append(np.sum(np.where(m == 0, 1, 2) * np.abs(partial**2 - scipy.special.jv(m, z) ** 2)))
    found = errors_of(SINUSOID)["taylor", "mean", "float64"]
    assert found.error(count) == pytest.approx(max(sums), rel=1e-6, abs=1e-13)


@pytest.mark.parametrize(("kind", "origin", "count"), [("taylor", "lowest", 33), ("chebyshev", "mean", 8)])
def test_errors_are_those_that_a_spectrum_reports(kind, origin, count):
    with pytest.warns(UserWarning, match=f"{kind}: {count} terms"):
        spectrum = md.precompute(
            SINUSOID.height_field, representation=kind, terms=count, heights_from=origin, tolerance=1e-5
        )
    # The spectrum adds the truncation of its lobes, and has other κ below the largest.
    assert errors_of(SINUSOID)[kind, origin, "float32"].error(count) == pytest.approx(spectrum.error, rel=0.05)


def test_errors_keep_the_bound_of_lagrange_until_float32_rounds():
    found = errors_of(SKIN)
    for origin in ("mean", "lowest"):
        curve = found["taylor", origin, "float64"]
        allowed = [terms.power_bound(terms.lagrange_bound(curve.phase, n)) for n in curve.terms]
        assert np.all(np.array(curve.errors) <= np.array(allowed) + 1e-10)
        assert found["taylor", origin, "float32"].error(45) > 1e3 * curve.error(45)
    assert found["taylor", "lowest", "float32"].error(45) > 30 * found["taylor", "mean", "float32"].error(45)
    assert found["taylor", "lowest", "float64"].phase == pytest.approx(4 * np.pi / 0.36 * 0.375)
    needed = [found[kind, "mean", "float32"].needed(1e-3) for kind in ("chebyshev", "taylor")]
    assert needed[0] < needed[1] < found["taylor", "lowest", "float32"].needed(1e-3)
    assert (
        found["taylor", "mean", "float32"].error(needed[1])
        <= 1e-3
        < found["taylor", "mean", "float32"].error(needed[1] - 1)
    )


def test_relative_errors_are_those_of_strong_orders():
    wanted = np.array([[1.0, 0.5], [1e-2, 1e-4]])
    off = np.sqrt(wanted * [[1.0, 1.1], [1.5, 9.0]]).astype(complex)
    one = np.zeros((45, 2, 2), complex)
    one[0] = off
    errors, relative = terms._partial_sum_errors(np.ones(45), one, wanted)
    assert errors[0] == pytest.approx(0.05 + 0.005 + 8e-4)
    assert relative[-1] == pytest.approx(0.5)


def test_bounds_of_the_thesis_are_reproduced():
    for bound in terms.bounds():
        assert bound.thesis == pytest.approx(bound.printed, rel=5e-4)
        assert 0.9 * bound.lagrange < bound.found <= bound.lagrange < 0.01 * bound.thesis


def test_tiles_are_three_synthetic_and_two_measured_skins():
    cases = tiles()
    assert {case.name for case in cases} > set(TIMED_TILES)
    assert [case.height_field.height_range for case in cases[:3]] == pytest.approx([0.15, 0.375, 0.6])
    # The centres hold most of the range of the scans.
    for case, height_range in zip(cases[3:], MEASURED.values(), strict=True):
        assert case.height_field.shape == (666, 666)
        assert case.height_field.tile_size == pytest.approx((32.5, 32.5))
        assert 0.7 * height_range < case.height_field.height_range < height_range


@pytest.mark.slow
def test_a_run_measures_errors_and_costs(llvm, tmp_path):
    steps = []
    found = terms.measure_terms(
        [SINUSOID], ["sinusoid"], lambda *step: steps.append(step), count=1 << 10, shading_points=1 << 4, repetitions=1
    )
    assert steps == [(0, 1), (1, 1)]
    assert len(found.errors) == 8
    methods = {method.label: method for method in found.methods}
    assert methods["slices"].time_ratio == 1
    for kind in ("taylor", "chebyshev"):
        few, many = methods[f"{kind}, 20 terms"], methods[f"{kind}, 37 terms"]
        assert (few.transforms, many.transforms) == (20, 37)
        assert few.words < many.words
        assert few.megabytes < many.megabytes
        assert many.delta_e[1] < 0.1
    assert methods["slices"].words < methods["taylor, 20 terms"].words
    published = methods["flss, as published, 37 terms"]
    assert published.words == 2 * 81 * 37 * 9
    assert published.time_ratio > 1
    assert published.delta_e[0] > methods["slices"].delta_e[0]
    fft = methods["FFT for each κ (reference)"]
    assert (fft.transforms, fft.delta_e) == (None, (0, 0))

    console = Console(width=200, record=True)
    console.print(*terms.terms_tables(found))
    assert "flss, as published" in console.export_text()
    save_png(terms.plot_terms(found), tmp_path / "plot.png")
    with Image.open(tmp_path / "plot.png") as picture:
        assert picture.width > 300
        assert np.ptp(np.asarray(picture)) > 100


@pytest.mark.slow
def test_the_command_writes_results_and_plot(command, llvm, tmp_path, monkeypatch):
    monkeypatch.setattr("mitsuba_diffraction.evaluation.benchmark.cases.tiles", lambda: [SINUSOID])
    monkeypatch.setattr("mitsuba_diffraction.evaluation.benchmark.cases.TIMED_TILES", ())
    code, out, error = command(f"benchmark --terms --json {tmp_path}/out.json --plot {tmp_path}/out.png")
    assert (code, error.strip()) == (0, "")
    assert "8.815e-08" in out
    written = json.loads((tmp_path / "out.json").read_text(encoding="utf-8"))
    assert len(written["errors"]) == 8
    assert written["bounds"][0]["printed"] == 2.995e-4
    assert (tmp_path / "out.png").stat().st_size > 10_000


@pytest.mark.parametrize("option", ["--tolerance 0.1", "--surface blazed"])
def test_terms_have_tiles_of_their_own(command, option):
    code, out, error = command(f"benchmark --terms {option}")
    assert (code, out) == (2, "")
    assert "got other surfaces or tolerances, too" in error
