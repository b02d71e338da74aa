"""Scalar and rigorous theory against a measured transmission grating, T300: `data/gratings/README.md`.

300 lines/mm, a replica on B270 glass, first order, at normal incidence, assumed to be lit through its plane face.
The groove angle and one factor are fitted: the factor represents losses by the glass, the replica and scattering. The
ratio of the second order to the first needs no factor; it is compared with estimates from star spectra.
"""

from __future__ import annotations

import functools

import numpy as np

from ...array_types import Real
from ...optics.geometry import fresnel
from ...rigorous.solver import efficiencies
from ...scalar_theory.closed_form import profile_powers, transmitted_orders
from ...settings import THEORIES
from ...surface.gratings import blazed, right_angled
from ...surface.heightfield import HeightField
from ..record import Check, Record
from .measured_gratings import best_factor, measured, rms_difference, stored_angles

T300_PERIOD = 1000 / 300
GROOVES = ("right-angled", "vertical wall")
MAX_T300_RMS_DIFFERENCE = 0.02
"""Of rigorous theory."""

# λ in µm → second order over first, from spectra of stars.
RATIOS = {0.45: 0.27, 0.5: 0.10, 0.55: 0.03}


def b270(wavelength: float) -> float:
    """Return the index of B270 glass at a wavelength in µm: Cauchy's formula through n_d = 1.5230 and V_d = 58.5."""
    slope = (0.5230 / 58.5) / (0.48613**-2 - 0.65627**-2)
    return 1.5230 + slope * (wavelength**-2 - 0.58756**-2)


def groove(shape: str, angle: float) -> HeightField:
    """Return one period of grooves with facets of this angle in degrees, and a wall at 90° to them or vertical."""
    if shape == "right-angled":
        return right_angled(T300_PERIOD, angle)
    return blazed(T300_PERIOD, T300_PERIOD * np.tan(np.deg2rad(angle)), samples=512)


def transmitted(height_field: HeightField, wavelength: float, rigorous: bool) -> Real:
    """Compute η of the blazed orders 1 and 2, unpolarised light at normal incidence through the plane face."""
    index = b270(wavelength)
    if rigorous:
        # Fifteen harmonics more change the efficiencies by less than 1e-3.
        harmonics = int(2 * index * T300_PERIOD / wavelength) + 15
        exact = efficiencies(height_field, (0, 0, -1), wavelength, int_ior=index, tolerance=0.02, harmonics=harmonics)
        orders = exact.transmission
    else:
        orders = transmitted_orders(profile_powers(height_field), T300_PERIOD, wavelength, 0.0, index, from_below=True)
    face = 1 - fresnel(1.0, index)[0]
    return face * np.array([orders.unpolarised[orders.m == -m][0] for m in (1, 2)])


@functools.cache
def curve(shape: str, angle: float, rigorous: bool, step: int = 1) -> Real:
    """Return η₁ at every `step`th measured wavelength."""
    height_field = groove(shape, angle)
    return np.array([transmitted(height_field, wavelength, rigorous)[0] for wavelength in measured("T300")[0][::step]])


def scaled(found: Real, step: int = 1) -> tuple[float, float]:
    """Return the factor that best fits efficiencies to the measured ones, and the remaining rms difference."""
    wanted = measured("T300")[1][::step]
    factor = best_factor(found, wanted)
    return factor, rms_difference(factor * found, wanted)


def t300_difference(shape: str, theory: str) -> Record:
    """Return the root of the mean square difference to the measured efficiencies, both scaled by the best factor."""
    angle = stored_angles()[shape][theory]
    found = curve(shape, angle, theory == "rigorous")
    factor, rms = scaled(found)
    raw = rms_difference(found, measured("T300")[1])
    note = f"rms over {len(found)} wavelengths, facets of {angle:.2f}°, all scaled by {factor:.3f}; {raw:.3f} unscaled"
    return Record(rms, 0.0, MAX_T300_RMS_DIFFERENCE if theory == "rigorous" else None, note=note)


def ratios(shape: str, theory: str) -> Record:
    """Return the second order over the first at the wavelengths of `RATIOS`; `measured` is at the first."""
    height_field = groove(shape, stored_angles()[shape][theory])
    found = []
    for wavelength in RATIOS:
        first, second = transmitted(height_field, wavelength, theory == "rigorous")
        found.append(second / first)
    values = ", ".join(f"{value:.3f}" for value in found)
    at = ", ".join(f"{1e3 * wavelength:g}" for wavelength in RATIOS)
    return Record(found[0], next(iter(RATIOS.values())), None, note=f"{values} at {at} nm")


CHECKS = tuple(
    Check(
        "literature",
        f"T300, 300 lines/mm in glass, {shape}: {what} theory {theory}",
        functools.partial(measure, shape, theory),
        source,
        slow=theory == "rigorous",
    )
    for shape in GROOVES
    for theory in THEORIES
    for what, measure, source in (
        ("order 1,", t300_difference, "data/gratings/README.md"),
        ("order 2 over 1,", ratios, "estimate from star spectra"),
    )
)
