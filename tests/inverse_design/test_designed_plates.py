"""Designed plates by Maxwell's equations, as `tools/data/designed_plates.py` stored them."""

import json
from pathlib import Path

import numpy as np
import pytest

from mitsuba_diffraction.scalar_theory import difference

ROOT = Path(__file__).parents[2]
import designed_plates

CASES = json.loads(designed_plates.STORED.read_text(encoding="utf-8"))["cases"]


@pytest.fixture(scope="module")
def stored():
    return designed_plates.stored()


def test_scalar_theory_predicts_the_light_in_the_picture(stored):
    for plate, of_wavelengths in stored:
        for wavelength, found in of_wavelengths.items():
            case = plate.plate.texel, plate.plate.height_range, wavelength
            assert found["rigorous_light"] == pytest.approx(found["light"], rel=0.03), case
            assert found["rigorous_correlation"] == pytest.approx(found["correlation"], abs=0.01), case


def test_the_report_of_a_design_has_the_scalar_light(stored):
    # The report leaves out the reflectance of glass, which varies little over these angles.
    for plate, of_wavelengths in stored:
        found = [of["light"] for of in of_wavelengths.values()]
        np.testing.assert_allclose(plate.efficiency, found, atol=0.01)


def test_the_page_has_the_table(stored):
    page = (ROOT / "docs" / "design.md").read_text(encoding="utf-8")
    for row in designed_plates.rows():
        assert row in page


@pytest.mark.slow
def test_a_stored_solution_is_found_with_more_voxels():
    case = CASES[0]
    of = case["solved"][-1]
    found = designed_plates.solved(designed_plates.of_case(case), of["wavelength"], refined=1.5)
    assert {tuple(m) for m in found["orders"]} == {tuple(m) for m in of["orders"]}
    eta = dict(zip(map(tuple, found["orders"]), found["efficiencies"], strict=True))
    assert difference(of["efficiencies"], [eta[tuple(m)] for m in of["orders"]]) < 0.015
