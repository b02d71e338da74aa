"""Compares HeteroSurface (Liu et al. 2025) with this model: `python tools/data/heterosurface_2025.py heterosurface.py`.

The argument is the module of github.com/Dream4Leo/HeteroSurface, a BSDF for Mitsuba. The surface is Gaussian: heights
of standard deviation 0.2 µm, autocorrelation exp(−r²/T²) with T = 0.6 µm. Its mean BRDF without shadowing, at normal
incidence and 550 nm, is R (cos θ_i + cos θ_o)²/(4 cos θ_i cos θ_o) S(q; κ)/λ². Printed for each angle of the reflected
light: S/λ² theirs, ours (Welch's estimate from samples of 64 µm, `extent="sample"`; the mean of six and its standard
error), and the integral

    S(q; κ) = 2π ∫ exp(−κ²σ²(1 − e^{−r²/T²})) e^{−r²/4σ_s²} J_0(2πqr) r dr

in float64, with the window of our sample; theirs has a beam of 6 µm instead, which the integral shows to be the same.
"""

import importlib.util
import sys

import numpy as np
from scipy.special import j0

import mitsuba_diffraction as md

SIGMA, CORRELATION, WAVELENGTH = 0.2, 0.6, 0.55
ANGLES = np.array([5.0, 20.0, 35.0, 50.0, 65.0])
COHERENCE, PIXEL, SIDE = 26.0, 0.08, 800


def theirs(path):
    """S/λ² from their mean BRDF."""
    import drjit as dr
    import mitsuba as mi

    mi.set_variant("llvm_ad_spectral")
    spec = importlib.util.spec_from_file_location("heterosurface", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    bsdf = mi.load_dict({"type": "heterosurface", "render_speckle": False, "expand_fresnel": False})
    heights = module.Material(
        [0, 1.5, 3.9], [1e-6 * SIGMA, 1e-18, 1e-18], [0, 0, 0], [1e-6 * CORRELATION] * 3, [1, 1, 0]
    )
    bsdf.set_materials([heights])
    bsdf.beam_width = 6e-6
    si = dr.zeros(mi.SurfaceInteraction3f, len(ANGLES))
    si.wi, si.wavelengths = mi.Vector3f(0, 0, 1), mi.Spectrum(1e3 * WAVELENGTH)
    theta = np.deg2rad(ANGLES)
    outgoing = mi.Vector3f(mi.Float(np.sin(theta)), mi.Float(0), mi.Float(np.cos(theta)))
    value = np.array(bsdf.eval(mi.BSDFContext(), si, outgoing, True))[0]
    reflectance = np.abs((1 - (1.5 + 3.9j)) / (1 + 1.5 + 3.9j)) ** 2
    return value / reflectance * 4 / (1 + np.cos(theta)) ** 2


def ours(q, kappa, seed):
    """S/λ² from one sample of the surface."""
    random = np.random.default_rng(seed).standard_normal((SIDE, SIDE))
    f = np.fft.fftfreq(SIDE, PIXEL)
    # The Fourier transform of exp(−r²/T²) is Gaussian.
    spectrum = np.exp(-((np.pi * CORRELATION) ** 2) * (f[:, None] ** 2 + f**2))
    heights = np.fft.ifft2(np.fft.fft2(random) * np.sqrt(spectrum)).real
    surface = md.HeightField(SIGMA * heights / heights.std(), PIXEL)
    found = md.precompute(
        surface, extent="sample", coherence_length=COHERENCE, wavelengths=(500.0, 600.0), tolerance=0.01
    )
    # The mean over directions of q, as one sample has speckle.
    turned = np.linspace(0, 2 * np.pi, 720, endpoint=False)
    around = q[:, None, None] * np.stack([np.cos(turned), np.sin(turned)], axis=-1)
    return found.evaluate(around, np.repeat(kappa[:, None], 720, axis=1)).mean(axis=1) / WAVELENGTH**2


def exact(q, kappa, window):
    """S/λ² by the trapezoidal rule."""
    r = np.linspace(0, 8 * window, 200_001)
    rough = np.exp(-((kappa[:, None] * SIGMA) ** 2) * (1 - np.exp(-((r / CORRELATION) ** 2))))
    values = 2 * np.pi * rough * np.exp(-(r**2) / (4 * window**2)) * j0(2 * np.pi * q[:, None] * r) * r
    return np.trapezoid(values, r, axis=1) / WAVELENGTH**2


if __name__ == "__main__":
    cosine, q = 1 + np.cos(np.deg2rad(ANGLES)), np.sin(np.deg2rad(ANGLES)) / WAVELENGTH
    kappa = 2 * np.pi * cosine / WAVELENGTH
    samples = [ours(q, kappa, seed) for seed in range(6)]
    columns = theirs(sys.argv[1]), np.mean(samples, axis=0), np.std(samples, axis=0, ddof=1) / np.sqrt(6)
    for angle, *row in zip(
        ANGLES, *columns, exact(q, kappa, COHERENCE / 4), exact(q, kappa, 6 / np.sqrt(2)), strict=True
    ):
        print("{:2.0f}°: theirs {:.4f}, ours {:.4f} ± {:.4f}, exact {:.4f}; with their beam {:.4f}".format(angle, *row))
