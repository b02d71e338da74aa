"""Designed plates by Maxwell's equations, as `tools/data/designed_plates.py` stored them."""

import json
from pathlib import Path

import designed_plates
import numpy as np
import pytest

from mitsuba_diffraction.scalar_theory.closed_form import efficiency_difference

ROOT = Path(__file__).parents[2]
CASES = json.loads(designed_plates.STORED.read_text(encoding="utf-8"))["cases"]


def named(case):
    texel, _, height_range, light = case["plate"]
    return f"{light}-{texel:g}-{height_range:g}"


# Others have more orders, of which scalar theory evaluates all pairs.
QUICK = (0.6, 8, 0.4, "reflected")


@pytest.mark.parametrize(
    "case",
    [pytest.param(case, marks=[] if tuple(case["plate"]) == QUICK else [pytest.mark.slow]) for case in CASES],
    ids=named,
)
def test_scalar_theory_predicts_the_light_in_the_picture(case):
    plate, of_wavelengths = designed_plates.compared_case(case)
    for wavelength, found in of_wavelengths.items():
        assert found["rigorous_light"] == pytest.approx(found["light"], rel=0.03), wavelength
        assert found["rigorous_correlation"] == pytest.approx(found["correlation"], abs=1e-3), wavelength
    # What `design` reports leaves out the reflectance of glass, which varies little over these angles.
    np.testing.assert_allclose(plate.efficiency, [found["light"] for found in of_wavelengths.values()], atol=0.01)


@pytest.mark.slow
def test_the_page_has_rows_of_the_table():
    page = (ROOT / "docs" / "designed_reliefs.md").read_text(encoding="utf-8").splitlines()
    table = {line for line in page if line.startswith(("| reflected |", "| transmitted |"))}
    assert len(table) == 4
    assert table <= set(designed_plates.rows())


@pytest.mark.slow
def test_a_stored_solution_is_found_with_more_voxels():
    (case,) = (case for case in CASES if tuple(case["plate"]) == QUICK)
    of = case["solved"][-1]
    found = designed_plates.solved(designed_plates.of_case(case), of["wavelength"], refined=1.5)
    assert {tuple(m) for m in found["orders"]} == {tuple(m) for m in of["orders"]}
    eta = dict(zip(map(tuple, found["orders"]), found["efficiencies"], strict=True))
    assert efficiency_difference(of["efficiencies"], [eta[tuple(m)] for m in of["orders"]]) < 0.015
