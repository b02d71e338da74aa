"""The estimated error of scalar theory in two dimensions, against `tools/data/scalar_theory_2d.py`."""

import itertools
import json
from pathlib import Path

import numpy as np
import pytest
import scalar_theory_2d

from mitsuba_diffraction.scalar_theory.validity import ESTIMATE_FACTOR, scalar_error

CASES = json.loads(scalar_theory_2d.STORED.read_text(encoding="utf-8"))["cases"]


@pytest.mark.parametrize("part", [0, 1])
def test_the_estimate_is_within_its_factor(part):
    assert scalar_theory_2d.rms_factor(CASES, part) < ESTIMATE_FACTOR
    for kind in ("smooth", "checkerboard", "measured"):
        chosen = [case for case in CASES if scalar_theory_2d.kind_of(case) == kind]
        assert len(chosen) >= 8
        assert scalar_theory_2d.rms_factor(chosen, part) < 1.5


def test_the_page_has_rows_of_the_table():
    page = (Path(__file__).parents[2] / "docs" / "validation.md").read_text(encoding="utf-8")
    table = page.partition("| surface, period × depth |")[2].partition("\n\n")[0].splitlines()[2:]
    assert len(table) == 5
    assert set(table) <= set(scalar_theory_2d.rows())


@pytest.mark.parametrize("count", [5, pytest.param(None, marks=pytest.mark.slow)])
def test_the_stored_estimates_are_those_of_the_package(count):
    stored = {case["surface"]: case["estimated"] for case in CASES}
    for surface, *_ in itertools.islice(scalar_theory_2d.surfaces(), count):
        error = scalar_error(surface)
        np.testing.assert_allclose([error.reflected, error.transmitted], stored[surface.source], rtol=1e-3)


@pytest.mark.slow
def test_a_stored_error_is_found_with_more_voxels():
    surface, points, layers, stepped = next(scalar_theory_2d.surfaces())
    found = scalar_theory_2d.solved(surface, 1.5 * points, 1.5 * layers, stepped)
    np.testing.assert_allclose(found["error"], CASES[0]["error"], rtol=0.02)
