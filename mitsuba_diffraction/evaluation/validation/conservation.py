"""Properties of any surface: reciprocity, energy conservation, samples that agree with values."""

from __future__ import annotations

import functools
from collections.abc import Callable

import mitsuba as mi
import numpy as np

from ...array_types import Real
from ...bsdf import testing
from ...precomputation.grating_spectrum import GratingSpectrum
from ...surface import gratings
from ...surface.heightfield import HeightField
from ..record import Check, Record
from .lobes import brdf, grating, spectrum_of

_WAVELENGTHS = (0.42, 0.55, 0.68)  # µm
_ANGLES = (0.0, 30.0, 60.0, 80.0)  # degrees
_MAX_DEVIATIONS = 4.0  # of averages of random samples
_SAMPLES = 1 << 17


def _drawn(bsdf: mi.BSDF, wi: Real, wavelength: float) -> tuple[Real, Real]:
    """Draw ω_o (n, 3) for ω_i (n, 3); return them and their weights f cos θ_o / pdf (n,)."""
    wo, weights, _ = testing.sample(bsdf, wi, [1e3 * wavelength] * len(mi.UnpolarizedSpectrum(0)))
    return wo, weights[:, 0]


def _near_orders(spectrum: GratingSpectrum, wavelength: float, count: int) -> tuple[Real, Real]:
    """Return pairs of directions (count, 3), the second sampled by the BSDF for the first: near orders."""
    random = np.random.default_rng(3)
    cosine, phi = random.uniform(0.1, 1, count), random.uniform(0, 360, count)
    wi = testing.direction(np.rad2deg(np.arccos(cosine)), phi)
    wo, weight = _drawn(grating(spectrum), wi, wavelength)
    kept = (weight > 0) & (wo[:, 2] > 0.1)
    return wi[kept], wo[kept]


def parseval(spectrum: GratingSpectrum) -> Record:
    """Check the sum over all frequencies of the spectrum, with an allowance for its stated truncated power."""
    kappas = np.linspace(0.2, 1, 9) * spectrum.max_kappa
    found = [spectrum.powers(kappa).sum(dtype=np.float64) for kappa in kappas]
    return Record.at_max_error(
        1.0, found, spectrum.tolerance + spectrum.unresolved_power + spectrum.truncated_power, "Σ_m η_m, nine κ"
    )


def reciprocity(spectrum: GratingSpectrum) -> Record:
    """Check f(ω_i, ω_o) = f(ω_o, ω_i), as the ratio of both."""
    bsdf = grating(spectrum, int_ior=1.5)
    forward, reverse = [], []
    for wavelength in _WAVELENGTHS:
        wi, wo = _near_orders(spectrum, wavelength, 4000)
        forward.append(brdf(bsdf, wi, wo, wavelength))
        reverse.append(brdf(bsdf, wo, wi, wavelength))
    ratio = np.concatenate(reverse) / np.concatenate(forward)
    return Record.at_max_error(1.0, ratio, 1e-4, f"f(ω_o, ω_i)/f(ω_i, ω_o), {len(ratio)} pairs that the BSDF draws")


def energy(spectrum: GratingSpectrum) -> Record:
    """Return the excess over one of the maximum albedo of a perfect mirror, from samples of the BSDF."""
    return excess(grating(spectrum))


def excess(bsdf: mi.BSDF) -> Record:
    """Return the excess over one of the maximum albedo of any BSDF."""
    found = []
    for wavelength in _WAVELENGTHS:
        for angle in _ANGLES:
            for phi in (0.0, 90.0):
                wi = np.broadcast_to(testing.direction(angle, phi), (_SAMPLES, 3))
                _, weight = _drawn(bsdf, wi, wavelength)
                found.append((weight.mean(), weight.std() / np.sqrt(_SAMPLES)))
    # argmax returns the first NaN, if there is one.
    max_albedo, error = found[int(np.argmax([mean for mean, _ in found]))]
    note = f"above one; maximum albedo {max_albedo:.5f} of 24 directions and wavelengths"
    return Record(np.maximum(max_albedo - 1, 0), 0.0, 1e-3 + _MAX_DEVIATIONS * error, note=note)


_HEIGHT_FIELDS = {
    "sinusoid": gratings.sinusoidal(2.5, 0.3),
    "blaze": gratings.blazed(2.5, 0.25),
    "crossed": gratings.crossed(2.0, 0.1, samples=32),
}


def _measured(measure: Callable[[GratingSpectrum], Record], height_field: HeightField) -> Record:
    return measure(spectrum_of(height_field, tolerance=1e-3))


CHECKS = tuple(
    Check("energy", f"{name}: {what}", functools.partial(_measured, measure, height_field), source, slow=True)
    for name, height_field in _HEIGHT_FIELDS.items()
    for what, measure, source in (
        ("reciprocity", reciprocity, "f(ω_i, ω_o) = f(ω_o, ω_i)"),
        ("albedo of a perfect mirror", energy, "at most one"),
    )
)
