"""The periods of the thesis (table 5.1), fitted to the peaks of this model as they were there to the shader's."""

from __future__ import annotations

import functools

import numpy as np

from .checks import Check, Finding

_STEP = 20.0  # nm


def _period(name: str) -> Finding:
    from ..evaluation.surfaces import SURFACES
    from ..evaluation.viewing_angle import fit_period, reflectance_map

    surface = SURFACES[name]
    found = fit_period(reflectance_map(surface, wavelengths=np.arange(380.0, 781.0, _STEP))).mean
    published = surface.published[0]
    # Peaks are read on a grid of 0.1°, which moves a period of 2.5 µm by 7 nm at one wavelength, by 1.6 nm in the mean.
    return Finding(published, found, abs(found - published), 2.0, f"nm; {surface.name}, light at 75°")


CHECKS = (
    Check("literature", "period of the blaze", functools.partial(_period, "blaze"), "thesis, table 5.1"),
    Check("literature", "period of Elaphe", functools.partial(_period, "elaphe"), "thesis, table 5.1", slow=True),
    Check(
        "literature", "period of Xenopeltis", functools.partial(_period, "xenopeltis"), "thesis, table 5.1", slow=True
    ),
)
