"""Ruled gratings as their maker measured them."""

import importlib

import measured_figures
import numpy as np
import pytest

from mitsuba_diffraction import rigorous
from mitsuba_diffraction.evaluation.validation import measured_gratings
from mitsuba_diffraction.settings import THEORIES


@pytest.mark.parametrize("wavelength", [0.4, 0.5, 0.6, 0.7, 0.8])
def test_aluminium_is_that_of_the_table(wavelength):
    model, table = measured_gratings.aluminium(wavelength), rigorous.refractive_index(wavelength, material="Al")
    assert abs(model - table) < 0.05 * abs(table)


def test_every_grating_has_its_measurements():
    for name in measured_gratings.LINES_PER_MM:
        wavelengths, found = measured_gratings.measured(name)
        assert len(wavelengths) > 25
        assert 0.3 < wavelengths[0] < wavelengths[-1] < 1.2
        assert 0.7 < found.max() < 0.9


def test_efficiencies_bend_at_rayleigh_anomalies():
    # Orders −1 and 2 in Littrow: at λ/d = 2/3.
    period = 1000 / 831
    ratios = np.arange(0.6, 0.74, 0.01)
    curve = measured_gratings.littrow("R831", 21.0, ratios * period, rigorous=True)
    kink = ratios[1 + np.argmax(np.abs(np.diff(curve, 2)))]
    assert abs(kink - 2 / 3) < 0.015


@pytest.mark.parametrize("theory", ["scalar", "rigorous"])
def test_the_stored_angles_fit_best(theory):
    """R831: half a degree more or less is worse."""
    wavelengths, wanted = measured_gratings.measured("R831")
    angle = measured_gratings.stored_angles()["R831"][theory]
    best, *others = (
        ((measured_gratings.littrow("R831", a, wavelengths[::2], theory == "rigorous") - wanted[::2]) ** 2).mean()
        for a in (angle, angle - 0.5, angle + 0.5)
    )
    assert best < min(others)


@pytest.mark.slow
def test_measured_gratings_are_plotted_with_both_theories(llvm):
    figure = measured_figures.plot_ruled(step=300)
    assert len(figure.axes) == 4
    labels = figure.axes[3].get_legend_handles_labels()[1]
    assert labels == [
        "rigorous theory, facets of 21.1°: rms 0.017",
        "scalar theory, facets of 20.3°: rms 0.076",
        "measured",
    ]


@pytest.mark.slow
def test_rigorous_theory_fits_measurements_that_scalar_theory_does_not(monkeypatch):
    ruled_fits = importlib.import_module("ruled_fits")
    for theory in THEORIES:
        stored = measured_gratings.stored_angles()["R831"][theory]
        assert ruled_fits.facet_angle("R831", theory) == pytest.approx(stored, abs=0.03)
    exact, scalar = (measured_gratings.rms_from_measured("R831", theory).measured for theory in ("rigorous", "scalar"))
    assert exact < 0.02
    assert scalar > 0.06
