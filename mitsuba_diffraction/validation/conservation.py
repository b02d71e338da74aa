"""What holds of any surface: reciprocity, no more light than comes in, samples that agree with values."""

from __future__ import annotations

import functools
from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from .. import gratings
from ..heightfield import HeightField
from ..reference import power_spectrum
from ..spectrum import GratingSpectrum
from . import product
from .checks import Check, Finding

Array = NDArray[np.float64]

WAVELENGTHS = (0.42, 0.55, 0.68)  # µm
ANGLES = (0.0, 30.0, 60.0, 80.0)  # degrees
DEVIATIONS = 4.0  # of averages of random samples
SAMPLES = 1 << 17


def _near_orders(spectrum: GratingSpectrum, wavelength: float, count: int) -> tuple[Array, Array]:
    """Pairs of directions (count, 3), the second drawn by the BSDF for the first: where there is light."""
    random = np.random.default_rng(3)
    cosine, phi = random.uniform(0.1, 1, count), random.uniform(0, 2 * np.pi, count)
    sine = np.sqrt(1 - cosine**2)
    wi = np.stack([sine * np.cos(phi), sine * np.sin(phi), cosine], axis=-1)
    wo, weight = _drawn(product.bsdf(spectrum), wi, wavelength)
    kept = (weight > 0) & (wo[:, 2] > 0.1)
    return wi[kept], wo[kept]


def _drawn(bsdf: mi.BSDF, wi: Array, wavelength: float, seed: int = 1) -> tuple[Array, Array]:
    """Samples ω_o (n, 3) and their weights f cos θ_o / pdf (n,) for ω_i (n, 3)."""
    u = np.random.default_rng(seed).random((3, len(wi)))
    si = dr.zeros(mi.SurfaceInteraction3f, len(wi))
    si.wi = mi.Vector3f(wi.T)
    si.wavelengths = type(si.wavelengths)(*[wavelength * 1e3] * len(si.wavelengths))
    si.sh_frame = mi.Frame3f(mi.Normal3f(0, 0, 1))
    sample, weight = bsdf.sample(mi.BSDFContext(), si, mi.Float(u[0]), mi.Point2f(u[1:]))
    weight = np.array(weight, np.float64)
    return np.array(sample.wo, np.float64).T, weight[0, 0, 0] if weight.ndim == 4 else weight[0]


def parseval(spectrum: GratingSpectrum) -> Finding:
    """Σ over all frequencies that the spectrum holds; what it says it left out is allowed for."""
    kappas = np.linspace(0.2, 1, 9) * spectrum.largest_kappa
    found = [spectrum.powers(kappa).sum(dtype=np.float64) for kappa in kappas]
    return Finding.worst(1.0, found, spectrum.tolerance + spectrum.beyond + spectrum.dropped, "Σ_m η_m, nine κ")


def reciprocity(spectrum: GratingSpectrum) -> Finding:
    """f(ω_i, ω_o) = f(ω_o, ω_i), as a share of the larger."""
    bsdf = product.bsdf(spectrum, int_ior=1.5)
    there, back = [], []
    for wavelength in WAVELENGTHS:
        wi, wo = _near_orders(spectrum, wavelength, 4000)
        there.append(product.value(bsdf, wi, wo, wavelength))
        back.append(product.value(bsdf, wo, wi, wavelength))
    there, back = np.concatenate(there), np.concatenate(back)
    return Finding.worst(1.0, back / there, 1e-4, f"f(ω_o, ω_i)/f(ω_i, ω_o), {len(there)} pairs that the BSDF draws")


def energy(spectrum: GratingSpectrum) -> Finding:
    """Largest albedo of a perfect mirror, by the BSDF's own samples."""
    bsdf = product.bsdf(spectrum)
    found = []
    for wavelength in WAVELENGTHS:
        for angle in ANGLES:
            for phi in (0.0, 90.0):
                wi = np.broadcast_to(product.direction(angle, phi), (SAMPLES, 3))
                _, weight = _drawn(bsdf, wi, wavelength)
                found.append((weight.mean(), weight.std() / np.sqrt(SAMPLES)))
    # The first that is not a number, if one is: it counts as the largest.
    largest, error = found[int(np.argmax([mean for mean, _ in found]))]
    return Finding(
        1.0,
        float(largest),
        float(np.maximum(largest - 1, 0)),
        float(1e-3 + DEVIATIONS * error),
        "at most; 24 directions and wavelengths",
    )


def against_reference(height_field: HeightField, spectrum: GratingSpectrum) -> Finding:
    """S that the table holds against the float64 sum over the heights, ∫|ΔS| dq by points drawn from S."""
    random = np.random.default_rng(5)
    worst = 0.0
    for kappa in random.uniform(0.2, 1, 3) * spectrum.largest_kappa:
        shares = np.maximum(spectrum.powers(kappa), 0).astype(np.float64)
        q_x, q_y = spectrum.grid.frequencies()
        row, column = np.unravel_index(random.choice(shares.size, 400, p=shares.ravel() / shares.sum()), shares.shape)
        q = np.stack([q_x[column], q_y[row]], axis=-1)
        q += random.normal(0, spectrum.lobe_width, q.shape)
        # Beyond the last frequency that light reaches the table ends.
        reached = 2 * np.sin(np.deg2rad(spectrum.largest_angle)) / (spectrum.wavelengths[0] * 1e-3)
        q = q[np.hypot(*q.T) < reached - spectrum.reach * spectrum.lobe_width]
        approximate = spectrum.evaluate(q, kappa)
        exact = power_spectrum(
            height_field, q, kappa, extent=spectrum.extent, coherence_length=spectrum.coherence_length
        )
        # Where lobes are cut off the table holds nothing; what is not a number stays, and misses any bound.
        there = ~(approximate <= 0)
        worst = np.maximum(worst, (np.abs(approximate - exact)[there] / approximate[there]).mean())
    bound = spectrum.tolerance + spectrum.dropped
    return Finding(0.0, float(worst), float(worst), bound, "share of the light, 400 frequencies at each of three κ")


def _of(make: Callable[[], HeightField], check: Callable[[GratingSpectrum], Finding]) -> Callable[[], Finding]:
    return lambda: check(product.spectrum_of(make(), tolerance=1e-3))


_SURFACES: dict[str, Callable[[], HeightField]] = {
    "sinusoid": functools.cache(lambda: gratings.sinusoidal(2.5, 0.3)),
    "blaze": functools.cache(lambda: gratings.blazed(2.5, 0.25)),
    "crossed": functools.cache(lambda: gratings.crossed(2.0, 0.1, samples=32)),
}

CHECKS = tuple(
    check
    for name, make in _SURFACES.items()
    for check in (
        Check("energy", f"{name}: reciprocity", _of(make, reciprocity), "f(ω_i, ω_o) = f(ω_o, ω_i)", name != "blaze"),
        Check("energy", f"{name}: albedo of a perfect mirror", _of(make, energy), "at most one", name != "crossed"),
    )
)
