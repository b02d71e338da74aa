"""Fit facet angles to measured gratings: `python tools/data/ruled_fits.py [OUT.json]`; three minutes on one core.

`validation/measured_gratings.py` and `validation/transmission_grating.py` read them.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
from rich.progress import track
from scipy.optimize import minimize_scalar

from mitsuba_diffraction.evaluation.validation import transmission_grating
from mitsuba_diffraction.evaluation.validation.measured_gratings import (
    FITS,
    LINES_PER_MM,
    littrow,
    measured,
    rms_difference,
)
from mitsuba_diffraction.files.writing import whole_file
from mitsuba_diffraction.settings import THEORIES


def _fit(difference: Callable[[float], float], low: float, high: float, accuracy: float) -> float:
    """Return the angle between `low` and `high` with the least difference, degrees."""
    return float(minimize_scalar(difference, bounds=(low, high), method="bounded", options={"xatol": accuracy}).x)


def facet_angle(name: str, theory: str) -> float:
    """Fit the facet angle to a ruled grating in the mean square; by rigorous theory in up to a minute."""
    wavelengths, wanted = measured(name)
    blaze = np.rad2deg(np.arcsin(wavelengths[np.argmax(wanted)] / (2000 / LINES_PER_MM[name])))

    def difference(angle: float) -> float:
        return rms_difference(littrow(name, angle, wavelengths, theory == "rigorous"), wanted)

    return round(_fit(difference, 0.8 * blaze, 1.25 * blaze, 0.02), 2)


def groove_angle(shape: str, theory: str) -> float:
    """Fit the groove angle of T300, together with a factor, to every third wavelength in the mean square."""

    def difference(angle: float) -> float:
        curve = transmission_grating.curve(shape, round(float(angle), 3), theory == "rigorous", step=3)
        return transmission_grating.scaled(curve, step=3)[1]

    return round(_fit(difference, 14.0, 22.0, 0.05), 2)


def make(path: Path) -> None:
    """Fit each grating by both theories and write the angles atomically."""
    ruled, grooves = track(LINES_PER_MM, "facet angles"), track(transmission_grating.GROOVES, "grooves of T300")
    content = {
        "made by": "python tools/data/ruled_fits.py",
        "unit": "degrees",
        "facet angles": {name: {theory: facet_angle(name, theory) for theory in THEORIES} for name in ruled},
        "groove angles": {shape: {theory: groove_angle(shape, theory) for theory in THEORIES} for shape in grooves},
    }
    with whole_file(path) as temporary:
        Path(temporary).write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    make(Path(sys.argv[1]) if len(sys.argv) > 1 else FITS)
