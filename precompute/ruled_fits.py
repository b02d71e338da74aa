"""Fit facet angles to measured gratings: `python precompute/ruled_fits.py [OUT.json]`; three minutes on one core.

`validation/measured_gratings.py` and `validation/transmission_grating.py` read them.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

from rich.progress import track

from mitsuba_diffraction.evaluation.validation import transmission_grating
from mitsuba_diffraction.evaluation.validation.ruled_fit import FITS, LINES_PER_MM, fit
from mitsuba_diffraction.files import whole_file


def make(path: Path) -> None:
    """Fit each grating by both theories and write the angles atomically."""
    angles = {
        name: {theory: round(fit(name, theory == "rigorous").facet_angle, 2) for theory in ("scalar", "rigorous")}
        for name in track(LINES_PER_MM, "facet angles")
    }
    transmission = {
        shape: {
            theory: transmission_grating.fit(shape, theory == "rigorous").angle for theory in ("scalar", "rigorous")
        }
        for shape in track(transmission_grating.GROOVES, "grooves of T300")
    }
    content = {
        "made by": "python precompute/ruled_fits.py",
        "unit": "degrees",
        "facet angles": angles,
        "groove angles": transmission,
    }
    with whole_file(path) as temporary:
        Path(temporary).write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    make(Path(sys.argv[1]) if len(sys.argv) > 1 else FITS)
