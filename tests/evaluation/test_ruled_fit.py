"""Ruled gratings as their maker measured them."""

import numpy as np
import pytest

from mitsuba_diffraction import rigorous
from mitsuba_diffraction.evaluation.validation import ruled_fit


@pytest.mark.parametrize("wavelength", [0.4, 0.5, 0.6, 0.7, 0.8])
def test_aluminium_is_that_of_the_table(wavelength):
    model, table = ruled_fit.aluminium(wavelength), rigorous.refractive_index(wavelength, material="Al")
    assert abs(model - table) < 0.05 * abs(table)


def test_every_grating_has_its_measurements():
    for name in ruled_fit.LINES_PER_MM:
        wavelengths, found = ruled_fit.measured(name)
        assert len(wavelengths) > 25
        assert 0.3 < wavelengths[0] < wavelengths[-1] < 1.2
        assert 0.7 < found.max() < 0.9
    with pytest.raises(ValueError, match="grating: got 'R1200', wanted one of R150"):
        ruled_fit.measured("R1200")


def test_efficiencies_bend_at_rayleigh_anomalies():
    # Orders −1 and 2 in Littrow: at λ/d = 2/3.
    period = 1000 / 831
    ratios = np.arange(0.6, 0.74, 0.01)
    curve = [ruled_fit.littrow(period, 21.0, ratio * period, rigorous=True) for ratio in ratios]
    kink = ratios[1 + np.argmax(np.abs(np.diff(curve, 2)))]
    assert abs(kink - 2 / 3) < 0.015


@pytest.mark.parametrize("theory", ["scalar", "rigorous"])
def test_the_stored_angles_fit_best(theory):
    """R831: half a degree more or less is worse."""
    wavelengths, wanted = ruled_fit.measured("R831")
    angle = ruled_fit.stored_angles()["R831"][theory]
    best, *others = (
        ((ruled_fit.littrow_curve("R831", a, wavelengths[::2], theory == "rigorous") - wanted[::2]) ** 2).mean()
        for a in (angle, angle - 0.5, angle + 0.5)
    )
    assert best < min(others)


@pytest.mark.slow
def test_measured_gratings_are_plotted_with_both_theories(llvm):
    from mitsuba_diffraction.evaluation.validation import measured_gratings

    figure = measured_gratings.plot(step=300)
    assert len(figure.axes) == 4
    labels = figure.axes[3].get_legend_handles_labels()[1]
    assert labels == [
        "rigorous theory, facets of 21.1°: rms 0.017",
        "scalar theory, facets of 20.3°: rms 0.076",
        "measured",
    ]


@pytest.mark.slow
def test_rigorous_theory_fits_measurements_that_scalar_theory_does_not():
    exact, scalar = (ruled_fit.fit("R831", theory) for theory in (True, False))
    assert exact.rms < 0.02
    assert scalar.rms > 0.06
    for found, theory in ((exact, "rigorous"), (scalar, "scalar")):
        assert found.facet_angle == pytest.approx(ruled_fit.stored_angles()["R831"][theory], abs=0.03)
