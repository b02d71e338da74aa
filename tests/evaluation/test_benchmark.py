"""The benchmark measures known errors, and reports the requested cases."""

import dataclasses
import json

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from PIL import Image
from rich.console import Console
from theories import COLUMNS, compare_theories

import mitsuba_diffraction as md
from mitsuba_diffraction import gratings
from mitsuba_diffraction.evaluation.benchmark import study
from mitsuba_diffraction.evaluation.benchmark.accuracy import Exact
from mitsuba_diffraction.evaluation.benchmark.cases import Case, bundled_cases, scan_case
from mitsuba_diffraction.evaluation.benchmark.measured import measured_bsdf
from mitsuba_diffraction.evaluation.benchmark.sampling import measure
from mitsuba_diffraction.evaluation.benchmark.speed import Rays
from mitsuba_diffraction.precomputation.requested_surface import RequestedSurface
from mitsuba_diffraction.progress import cells
from mitsuba_diffraction.settings import VISIBLE
from mitsuba_diffraction.spectrum.tables import SliceTable

BLAZE = Case("blaze", gratings.blazed(2.5, 0.25), "tile", 65.0)
SKIN = Case("skin", gratings.elaphe_synthetic(8.0, pixel_size=0.08), "sample", 2.0)


@pytest.mark.few(1)
@pytest.mark.parametrize("case", [BLAZE, SKIN], ids=lambda case: case.name)
def test_accuracy_is_within_the_tolerance_and_follows_it(case):
    exact = Exact(case, VISIBLE, kappas=2, points=400)
    coarse, fine = (exact.accuracy(case.spectrum(tolerance)) for tolerance in (1e-2, 1e-3))
    assert 0 < fine.l1 <= 1e-3 * 1.1  # a sum over 400 random frequencies
    assert fine.l1 < coarse.l1 <= 1e-2
    assert 0 < fine.delta_e[0] <= fine.delta_e[1] < coarse.delta_e[1] < 1


@pytest.mark.few(1)
@pytest.mark.parametrize("case", [BLAZE, SKIN], ids=lambda case: case.name)
def test_accuracy_sees_an_error_that_is_put_in(case):
    exact, spectrum = Exact(case, VISIBLE, kappas=2, points=400), case.spectrum()
    weaker = SliceTable(spectrum.table.max_kappa, spectrum.table.values * np.float32(0.8))
    found = exact.accuracy(dataclasses.replace(spectrum, table=weaker))
    assert found.l1 == pytest.approx(0.2, abs=0.02)
    assert found.delta_e[1] > 1


def test_the_material_of_measured_reflects_and_is_sampled(llvm):
    bsdf, rays = measured_bsdf(), Rays(1 << 16)
    _, weight = bsdf.sample(mi.BSDFContext(), rays.si, rays.sample1, rays.sample2)
    value, pdf = bsdf.eval_pdf(mi.BSDFContext(), rays.si, rays.wo)
    # Means over uniform directions, times 2π. Those of the value and of the weights are both the albedo.
    albedo, drawn = dr.mean(value[0])[0] * 2 * np.pi, dr.mean(pdf)[0] * 2 * np.pi
    assert 0.1 < albedo == pytest.approx(dr.mean(weight[0])[0], rel=0.1)
    assert 0.5 < drawn < 1.02


@pytest.mark.slow
def test_a_run_reports_every_combination(llvm, tmp_path):
    deep = Case("deep", gratings.sinusoidal(2.5, 2.0), "tile", 65.0)
    steps = []
    results = study.run_benchmark(
        [BLAZE, deep],
        tolerances=(1e-2,),
        count=1 << 12,
        repetitions=1,
        progress=lambda done, total: steps.append((done, total)),
    )
    assert [(r.surface, r.tolerance) for r in results] == [("blaze", 1e-2), ("deep", 1e-2)]
    assert steps[-1] == (2, 2)
    for result in results:
        assert (result.words, result.intervals > 1) == (4, True)
        assert min(result.evaluations, result.evaluate_ratio, result.sample_ratio) > 0
        assert min(result.beside_measured) > 0
        assert result.accuracy.l1 <= 1e-2
    console = Console(width=200, record=True)
    console.print(*study.benchmark_tables(results, []))
    assert "blaze" in console.export_text()
    study.save_speed_plot(results, tmp_path / "plot.png")
    with Image.open(tmp_path / "plot.png") as picture:
        assert picture.width > 600
        assert np.ptp(np.asarray(picture)) > 100


@pytest.mark.slow
def test_sampling_is_measured(llvm):
    (found,) = measure([BLAZE], 1e-2, count=1 << 12, size=16, spp=4, repetitions=1)
    assert min(found.fractions[:4]) >= 0.5
    assert found.fractions[4] >= 0.25
    assert 1 < found.largest_weight < 100
    assert found.variance_ratio > 1
    assert found.picture_ratio > 0
    console = Console(width=200, record=True)
    console.print(*study.benchmark_tables([], [found]))
    assert "blaze" in console.export_text()


@pytest.mark.slow
def test_theories_are_compared_on_one_grating(llvm):
    """A grating of 0.3 µm, on a table as coarse as it may be: rigorous theory is right, scalar theory is not."""
    fine = gratings.sinusoidal(0.3, 0.1, samples=64)
    scalar, rigorous = compare_theories(fine, tolerance=0.5, count=1 << 10, repetitions=1)
    assert (scalar.theory, rigorous.theory) == ("scalar", "rigorous")
    assert rigorous.error < 0.05 < 0.2 < scalar.error
    assert rigorous.max_error >= rigorous.error
    for cost in (scalar, rigorous):
        assert min(cost.build_seconds, cost.megabytes, cost.evaluate_ratio, cost.lobe_ratio, cost.sample_ratio) > 0
    assert cells(COLUMNS, rigorous)[0] == "rigorous"


@pytest.mark.slow
def test_the_bundled_surfaces_are_those_of_the_recipes():
    cases = {case.name: case for case in bundled_cases()}
    for name in ("elaphe_synthetic", "xenopeltis_synthetic"):
        recipe = md.Recipe.load(f"precompute/{name}.toml")
        assert cases[name].coherence_length == recipe.settings.coherence_length
        assert cases[name].height_field.digest == recipe.height_field().digest


def test_a_scan_has_the_extent_and_the_coherence_length_of_its_request(scan_file):
    text = f"{scan_file('elaphe')},pixel_size=0.0586,height_range=0.375"
    cases = [
        scan_case(RequestedSurface.of(text + given).recipe) for given in ("", ",coherence_length=2", ",extent=tile")
    ]
    assert [case.extent for case in cases] == ["sample", "sample", "tile"]
    assert [case.coherence_length for case in cases] == pytest.approx([2.93, 2, 65])


@pytest.mark.slow
def test_the_command_writes_its_results_and_its_plot(command, llvm, tmp_path):
    options = f"--surface blazed --tolerance 0.01 --json {tmp_path}/out.json --plot {tmp_path}/out.png"
    code, out, error = command(f"benchmark {options}")
    assert (code, error.strip()) == (0, "")
    assert out.count("blazed") == 1 + 4 + 1  # a table each of speed, of shaders and of sampling
    written = json.loads((tmp_path / "out.json").read_text())
    assert 0 < written["speed and error"][0]["accuracy"]["l1"] <= 0.01
    assert written["machine"]["cores"] >= 1
    assert len(written["real-time shader"]) == 4
    assert written["sampling"][0]["surface"] == "blazed"
    assert (tmp_path / "out.png").stat().st_size > 10_000
    code, _, error = command("benchmark --surface glass")
    assert code == 2
    assert "--surface: got glass, wanted among blazed" in error
