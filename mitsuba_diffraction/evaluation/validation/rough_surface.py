"""Random surfaces for which scalar theory has a closed-form mean: Gaussian heights with a Gaussian correlation.

With g = κ²σ² and the correlation of heights σ² e^{−τ²/ℓ²} (Beckmann and Spizzichino 1963; Stam 1999), for a surface
that is rough along x and uniform along y,

    S(q) = e^{−g} δ(q_x) + e^{−g} Σ_{n≥1} gⁿ/n! ℓ √(π/n) e^{−π²ℓ²q_x²/n}

the specular and the diffuse component, both convolved with the Gaussian lobe of the coherence length. For g ≫ 1 the
density of slopes remains: Beckmann's microfacets.

One realisation differs from the mean. With A the length of the profile and V the terms of even n at q = 0, the real
part of the mean field over the profile has the variance V/A, so that the specular fraction e^{−g} has the standard
deviation 2 e^{−g/2} √(V/A). A band of width B has A·B independent speckles and the relative standard deviation
1/√(A·B). Bounds are three standard deviations.
"""

from __future__ import annotations

import functools
import itertools

import mitsuba as mi
import numpy as np
from scipy.special import gammaln, ndtr

from ...array_types import Real
from ...bsdf.testing import direction, towards
from ...precomputation.grating_spectrum import GratingSpectrum
from ...settings import lobe_width
from ...surface.heightfield import HeightField
from ..record import Check, Record
from .lobes import brdf, density, grating, spectrum_of

PROFILE_LENGTH = 8_000.0  # µm of profile
PIXEL = 0.135  # µm: resolves all frequencies at the angles of SETTINGS
SETTINGS = {"largest_angle": 41.5}
SMALL_ROUGHNESS = (0.06, 0.8)  # rms height and correlation length, µm
LARGE_ROUGHNESS = (0.2, 2.7)
COHERENCE_LENGTH = 20.0  # µm
_MAX_DEVIATIONS = 3.0  # standard deviations allowed


def random_profile(rms: float, correlation: float) -> HeightField:
    """Draw one row of Gaussian heights, correlated as σ² e^{−τ²/ℓ²}; lengths in µm."""
    count = round(PROFILE_LENGTH / PIXEL)
    q = np.fft.rfftfreq(count, PIXEL)
    amplitude = np.sqrt(rms**2 * correlation * np.sqrt(np.pi) / PIXEL) * np.exp(-((np.pi * q * correlation) ** 2) / 2)
    noise = np.fft.rfft(np.random.default_rng(0).standard_normal(count))
    heights = np.fft.irfft(noise * amplitude, count)
    return HeightField(
        heights[None, :], PIXEL, f"random profile, rms {rms:g} µm, correlation length {correlation:g} µm"
    )


def diffuse(q: Real, g: float, correlation: float, broadened: float = 0.0, even: bool = False) -> Real:
    """Compute the diffuse component of S in µm, convolved with a lobe of σ_q = `broadened`; q (...) in cycles/µm."""
    n = np.arange(2 if even else 1, int(g + 12 * np.sqrt(g) + 20), 2 if even else 1)
    weight = np.exp(n * np.log(g) - g - gammaln(n + 1))
    variance = n / (2 * (np.pi * correlation) ** 2) + broadened**2
    return (weight * np.exp(-(np.asarray(q)[..., None] ** 2) / (2 * variance)) / np.sqrt(2 * np.pi * variance)).sum(-1)


@functools.cache
def _spectrum(rms: float, correlation: float) -> GratingSpectrum:
    height_field = random_profile(rms, correlation)
    return spectrum_of(height_field, extent="sample", coherence_length=COHERENCE_LENGTH, tolerance=2e-3, **SETTINGS)


def _coherent(wavelength: float, angle: float) -> Record:
    """Compare the power within 5 σ_q of the specular direction: e^{−g}, and a small part of the diffuse component."""
    rms, correlation = SMALL_ROUGHNESS
    spectrum = _spectrum(rms, correlation)
    wi = direction(angle)
    kappa = 4 * np.pi * wi[2] / wavelength
    g = (kappa * rms) ** 2
    sigma = lobe_width(COHERENCE_LENGTH)
    axis = np.linspace(-5, 5, 51) * sigma
    step = axis[1] - axis[0]
    q = np.stack(np.meshgrid(axis, axis), axis=-1)
    found = density(grating(spectrum, conserve=False), wi, towards(wi, q, 1e3 * wavelength), wavelength).sum() * step**2
    near = diffuse(axis, g, correlation, sigma).sum() * step
    noise = np.hypot(
        2 * np.exp(-g / 2) * np.sqrt(diffuse(np.zeros(1), g, correlation, even=True)[0] / PROFILE_LENGTH),
        near / np.sqrt(PROFILE_LENGTH * 10 * sigma),
    )
    return Record(
        found - near, np.exp(-g), _MAX_DEVIATIONS * noise + spectrum.tolerance, note=f"κσ = {kappa * rms:.2f}"
    )


def _diffuse_bands() -> Record:
    """Compare the diffuse component in bands of q of width 1/ℓ with the series."""
    rms, correlation = SMALL_ROUGHNESS
    spectrum = _spectrum(rms, correlation)
    wi, wavelength = direction(0), 0.5
    g = (4 * np.pi / wavelength * rms) ** 2
    sigma = lobe_width(COHERENCE_LENGTH)
    y = np.linspace(-5, 5, 41) * sigma
    edges = np.arange(0.15, 1.01, 0.17)
    bsdf = grating(spectrum, conserve=False)
    expected, found, bounds = [], [], []
    for low, high in itertools.pairwise(edges):
        x = (np.arange(40) + 0.5) / 40 * (high - low) + low
        q = np.stack(np.meshgrid(np.concatenate([-x, x]), y), axis=-1)
        wo = towards(wi, q, 1e3 * wavelength)
        kappa = 2 * np.pi * (1 + wo[..., 2]) / wavelength
        # κ decreases with the angle: the series is evaluated with κ of each point.
        series = np.vectorize(lambda a, k: diffuse(a, (k * rms) ** 2, correlation, sigma))
        area = (x[1] - x[0]) * (y[1] - y[0])
        expected.append((series(q[..., 0], kappa) * np.exp(-((q[..., 1] / sigma) ** 2) / 2)).sum() * area)
        expected[-1] /= np.sqrt(2 * np.pi) * sigma
        found.append(density(bsdf, wi, wo, wavelength).sum() * area)
        bounds.append(_MAX_DEVIATIONS * expected[-1] / np.sqrt(PROFILE_LENGTH * 2 * (high - low)) + spectrum.tolerance)
    return Record.at_max_error(expected, found, bounds, f"maximum of {len(found)} bands, g = {g:.2f}")


def _microfacets(angle: float) -> Record:
    """Compare a rough profile with `roughconductor`, Beckmann distribution; K S/λ² is D/(4 cos θ_i cos θ_o) there.

    In the plane of incidence, over bands of the half vector's slope up to one and a half rms slopes on either side of
    the specular direction. Both are perfect mirrors. Facets do not mask each other there: G is one in both models; E is
    omitted.
    Along y, `roughconductor` has the width of the lobe of the coherence length.
    """
    rms, correlation = LARGE_ROUGHNESS
    spectrum = _spectrum(rms, correlation)
    wi, wavelength = direction(angle), 0.42
    slope = np.sqrt(2) * rms / correlation
    sigma = lobe_width(COHERENCE_LENGTH)
    w = 2 * wi[2]
    broadened = np.hypot(slope, sigma * wavelength / w)
    facets = mi.load_dict(
        {
            "type": "roughconductor",
            "material": "none",
            "distribution": "beckmann",
            "alpha_u": float(np.sqrt(2) * broadened),
            "alpha_v": float(np.sqrt(2) * sigma * wavelength / w),
        }
    )
    bsdf = grating(spectrum, conserve=False, shadowing="none")
    edges = np.linspace(-1.5, 1.5, 7) * broadened
    expected, found, bounds = [], [], []
    for low, high in itertools.pairwise(edges):
        s = (np.arange(64) + 0.5) / 64 * (high - low) + low
        half = np.stack([-s, 0 * s, np.ones_like(s)], axis=-1) / np.sqrt(1 + s**2)[:, None]
        wo = 2 * (half @ wi)[:, None] * half - wi
        expected.append(brdf(facets, wi, wo, wavelength).mean())
        found.append(brdf(bsdf, wi, wo, wavelength).mean())
        # Facets of about a correlation length are bright or dark as a whole.
        probability = ndtr(high / broadened) - ndtr(low / broadened)
        speckles = PROFILE_LENGTH * (high - low) * w / wavelength
        noise = np.hypot(np.sqrt((1 - probability) / probability * correlation / PROFILE_LENGTH), 1 / np.sqrt(speckles))
        bounds.append(_MAX_DEVIATIONS * noise)
    note = f"f [1/sr]; relative; κσ = {2 * np.pi * w / wavelength * rms:.0f}; maximum of {len(found)} bands of slope"
    return Record.at_max_error(expected, found, bounds, note, relative=True)


CHECKS = (
    *(
        Check(
            "statistical",
            f"roughness: specular fraction e^{{−κ²σ²}}, {name}",
            functools.partial(_coherent, wavelength, angle),
            "Beckmann 1963",
            slow=True,
        )
        for name, wavelength, angle in (("weak", 0.82, 33.0), ("medium", 0.8, 0.0), ("strong", 0.5, 0.0))
    ),
    Check("statistical", "roughness: diffuse component in bands", _diffuse_bands, "Beckmann's series", slow=True),
    *(
        Check(
            "statistical",
            f"large roughness: roughconductor, {angle:g}°",
            functools.partial(_microfacets, angle),
            "Mitsuba, Beckmann",
            slow=True,
        )
        for angle in (0.0, 20.0)
    ),
)
