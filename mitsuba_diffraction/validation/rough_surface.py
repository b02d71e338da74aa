"""Random surfaces, of which scalar theory knows the mean: Gaussian heights with a Gaussian correlation.

With g = κ²σ² and the correlation of heights σ² e^{−τ²/ℓ²} (Beckmann and Spizzichino 1963; Stam 1999), for a surface
that is rough along x and uniform along y,

    S(q) = e^{−g} δ(q_x) + e^{−g} Σ_{n≥1} gⁿ/n! ℓ √(π/n) e^{−π²ℓ²q_x²/n}

the first term the mirror's own light, the second what the roughness spreads; both are seen through the Gaussian lobe of
the coherence length. For g ≫ 1 what is left is the density of slopes: Beckmann's microfacets.

One realisation differs from the mean. With length A of the profile, the mean field over all of it has the variance
V/A in its real part, V the terms of even n at q = 0, so that the mirror's share e^{−g} errs by 2 e^{−g/2} √(V/A); and a
band of width B holds A·B independent speckles, which err by 1/√(A·B). Bounds are three such standard deviations.
"""

from __future__ import annotations

import functools
import itertools

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln

from ..coherence import lobe_width
from ..heightfield import HeightField
from ..spectrum import GratingSpectrum
from . import product
from .checks import Check, Finding

Array = NDArray[np.float64]

LENGTH = 8_000.0  # µm of profile
PIXEL = 0.135  # µm: holds all frequencies that the settings below reach
SETTINGS = {"largest_angle": 41.5}
WEAK = (0.06, 0.8)  # rms height and correlation length, µm
LARGE = (0.2, 2.7)
COHERENCE = 20.0  # µm
DEVIATIONS = 3.0  # standard deviations allowed


def random_profile(rms: float, correlation: float, seed: int = 0) -> HeightField:
    """One row of Gaussian heights, correlated as σ² e^{−τ²/ℓ²}; lengths in µm."""
    count = round(LENGTH / PIXEL)
    q = np.fft.rfftfreq(count, PIXEL)
    amplitude = np.sqrt(rms**2 * correlation * np.sqrt(np.pi) / PIXEL) * np.exp(-((np.pi * q * correlation) ** 2) / 2)
    noise = np.fft.rfft(np.random.default_rng(seed).standard_normal(count))
    heights = np.fft.irfft(noise * amplitude, count)
    return HeightField(
        heights[None, :], PIXEL, f"random profile, rms {rms:g} µm, correlation length {correlation:g} µm"
    )


def spread(q: Array, g: float, correlation: float, broadened: float = 0.0, even: bool = False) -> Array:
    """The second term of S, in µm, as it is seen with a lobe of σ_q = `broadened`; q (...) in cycles/µm."""
    n = np.arange(2 if even else 1, int(g + 12 * np.sqrt(g) + 20), 2 if even else 1)
    weight = np.exp(n * np.log(g) - g - gammaln(n + 1))
    variance = n / (2 * (np.pi * correlation) ** 2) + broadened**2
    return (weight * np.exp(-(np.asarray(q)[..., None] ** 2) / (2 * variance)) / np.sqrt(2 * np.pi * variance)).sum(-1)


@functools.cache
def _spectrum(rms: float, correlation: float) -> GratingSpectrum:
    surface = random_profile(rms, correlation)
    return product.spectrum_of(surface, extent="sample", coherence_length=COHERENCE, tolerance=2e-3, **SETTINGS)


def _coherent(wavelength: float, angle: float) -> Finding:
    """Light within 5 σ_q of the mirror direction: e^{−g} and what little of the spread light lies there."""
    rms, correlation = WEAK
    spectrum = _spectrum(rms, correlation)
    wi = product.direction(angle)
    kappa = 4 * np.pi * wi[2] / wavelength
    g = (kappa * rms) ** 2
    sigma = lobe_width(COHERENCE)
    axis = np.linspace(-5, 5, 51) * sigma
    step = axis[1] - axis[0]
    q = np.stack(np.meshgrid(axis, axis), axis=-1)
    wo = product.towards(wi, q, np.full(q.shape[:-1], wavelength))
    bsdf = product.bsdf(spectrum, conserve=False)
    seen = product.value(bsdf, wi, wo, wavelength) / product.factor(wi, wo)
    found = seen.sum() * step**2 * wavelength**2
    near = spread(axis, g, correlation, sigma).sum() * step
    noise = np.hypot(
        2 * np.exp(-g / 2) * np.sqrt(spread(np.zeros(1), g, correlation, even=True)[0] / LENGTH),
        near / np.sqrt(LENGTH * 10 * sigma),
    )
    return Finding(
        float(np.exp(-g)),
        float(found - near),
        float(abs(found - near - np.exp(-g))),
        float(DEVIATIONS * noise + spectrum.tolerance),
        f"κσ = {kappa * rms:.2f}",
    )


def _spread_light() -> Finding:
    """The light outside of the mirror direction, by bands of q as wide as 1/ℓ, against the series."""
    rms, correlation = WEAK
    spectrum = _spectrum(rms, correlation)
    wi, wavelength = product.direction(0), 0.5
    g = (4 * np.pi / wavelength * rms) ** 2
    sigma = lobe_width(COHERENCE)
    y = np.linspace(-5, 5, 41) * sigma
    edges = np.arange(0.15, 1.01, 0.17)
    bsdf = product.bsdf(spectrum, conserve=False)
    expected, found, bounds = [], [], []
    for low, high in itertools.pairwise(edges):
        x = (np.arange(40) + 0.5) / 40 * (high - low) + low
        q = np.stack(np.meshgrid(np.concatenate([-x, x]), y), axis=-1)
        wo = product.towards(wi, q, np.full(q.shape[:-1], wavelength))
        kappa = 2 * np.pi * (1 + wo[..., 2]) / wavelength
        # κ falls with the angle; the series takes it at every point.
        density = np.vectorize(lambda a, k: spread(np.array([a]), (k * rms) ** 2, correlation, sigma)[0])
        area = (x[1] - x[0]) * (y[1] - y[0])
        expected.append((density(q[..., 0], kappa) * np.exp(-((q[..., 1] / sigma) ** 2) / 2)).sum() * area)
        expected[-1] /= np.sqrt(2 * np.pi) * sigma
        seen = product.value(bsdf, wi, wo, wavelength) / product.factor(wi, wo)
        found.append(seen.sum() * area * wavelength**2)
        bounds.append(DEVIATIONS * expected[-1] / np.sqrt(LENGTH * 2 * (high - low)) + spectrum.tolerance)
    excess = np.abs(np.subtract(found, expected)) / bounds
    worst = int(np.argmax(excess))
    difference = abs(found[worst] - expected[worst])
    note = f"worst of {len(found)} bands, g = {g:.2f}"
    return Finding(float(expected[worst]), float(found[worst]), float(difference), float(bounds[worst]), note)


def _microfacets(angle: float) -> Finding:
    """Against `roughconductor`, Beckmann distribution, of a rough profile; K S/λ² is D/(4 cos θ_i cos θ_o) there.

    In the plane of incidence, bands of the half vector's slope out to one and a half rms slopes, on both sides of the
    mirror direction. Both are perfect mirrors. No facet hides another there: G is one in both models; E is left out.
    `roughconductor` gets along y the width that the coherence length gives the lobe.
    """
    rms, correlation = LARGE
    spectrum = _spectrum(rms, correlation)
    wi, wavelength = product.direction(angle), 0.42
    slope = np.sqrt(2) * rms / correlation
    sigma = lobe_width(COHERENCE)
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
    bsdf = product.bsdf(spectrum, conserve=False, shadowing="none")
    edges = np.linspace(-1.5, 1.5, 7) * broadened
    expected, found, bounds = [], [], []
    for low, high in itertools.pairwise(edges):
        s = (np.arange(64) + 0.5) / 64 * (high - low) + low
        half = np.stack([-s, 0 * s, np.ones_like(s)], axis=-1) / np.sqrt(1 + s**2)[:, None]
        wo = 2 * (half @ wi)[:, None] * half - wi
        expected.append(product.value(facets, wi, wo, wavelength).mean())
        found.append(product.value(bsdf, wi, wo, wavelength).mean())
        # Facets of about a correlation length are bright or dark as a whole.
        share = np.diff(_normal([low / broadened, high / broadened]))[0]
        speckles = LENGTH * (high - low) * w / wavelength
        noise = np.hypot(np.sqrt((1 - share) / share * correlation / LENGTH), 1 / np.sqrt(speckles))
        bounds.append(DEVIATIONS * noise)
    relative = np.abs(np.divide(found, expected) - 1)
    worst = int(np.argmax(relative / bounds))
    note = f"f [1/sr]; relative; κσ = {2 * np.pi * w / wavelength * rms:.0f}; worst of {len(found)} bands of slope"
    return Finding(expected[worst], found[worst], float(relative[worst]), float(bounds[worst]), note)


def _normal(x: list[float]) -> Array:
    from scipy.stats import norm

    return norm.cdf(x)


CHECKS = (
    Check("statistical", "roughness, mirror's share e^{−κ²σ²}, weak", lambda: _coherent(0.82, 33.0), "Beckmann 1963"),
    Check("statistical", "roughness, mirror's share e^{−κ²σ²}, medium", lambda: _coherent(0.8, 0.0), "Beckmann 1963"),
    Check("statistical", "roughness, mirror's share e^{−κ²σ²}, strong", lambda: _coherent(0.5, 0.0), "Beckmann 1963"),
    Check("statistical", "roughness, spread light in bands", _spread_light, "Beckmann's series"),
    Check(
        "statistical", "large roughness: roughconductor, 0°", lambda: _microfacets(0.0), "Mitsuba, Beckmann", slow=True
    ),
    Check(
        "statistical",
        "large roughness: roughconductor, 20°",
        lambda: _microfacets(20.0),
        "Mitsuba, Beckmann",
        slow=True,
    ),
)
