"""This project's model as a relative reflectance, to stand beside the shader's."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..spectrum import GratingSpectrum

_INDEX = 1.5  # of skin; the published shader knows no other
_R_0 = ((_INDEX - 1) / (_INDEX + 1)) ** 2


def relative_reflectance(
    spectrum: GratingSpectrum, wi: ArrayLike, wo: ArrayLike, wavelengths: ArrayLike
) -> NDArray[np.float64]:
    """f cos θ_i over its value for a flat surface lit and seen at right angles, as the BSDF plugin gives it.

        ρ(λ) = f cos θ_i · 2πσ_q² λ²/R₀ = R/R₀ · K G cos θ_i · 2πσ_q² S(q; κ) · E

    The coherence length of `spectrum` gives σ_q; 1/(2πσ_q²) is S(0) of a flat surface. This is the quantity that the
    shader shows (eq. 3.11 of the thesis): 1/λ² has dropped out.

    Args:
        spectrum: of the surface; its index is 1.5.
        wi: ω_i, (3,) along the axes of the surface.
        wo: ω_o, (..., 3).
        wavelengths: (n,) nm.

    Returns:
        (n, ...).

    Raises:
        ValueError: if shapes do not match, or Mitsuba has no vectorised spectral variant set.
    """
    wi, wo = np.asarray(wi, np.float64), np.asarray(wo, np.float64)
    wavelengths = np.asarray(wavelengths, np.float64)
    if wi.shape != (3,) or wo.shape[-1:] != (3,) or wavelengths.ndim != 1:
        raise ValueError(
            f"wi, wo, wavelengths: got shapes {wi.shape}, {wo.shape}, {wavelengths.shape}, wanted (3,), (..., 3), (n,)"
        )
    if mi.variant() is None or not dr.is_jit_v(mi.Float) or not mi.is_spectral:
        raise ValueError(f"variant: Mitsuba's is {mi.variant()}, wanted a spectral one such as llvm_ad_spectral")
    bsdf = mi.load_dict({"type": "diffraction_grating", "spectrum": spectrum, "int_ior": _INDEX})
    directions = wo.reshape(-1, 3)
    channels = len(mi.UnpolarizedSpectrum(0))
    # One lane for each direction and group of wavelengths; the last group is filled up with wavelengths it repeats.
    groups = np.resize(wavelengths, (-(-wavelengths.size // channels), channels))
    si = dr.zeros(mi.SurfaceInteraction3f, len(groups) * len(directions))
    si.wi = mi.Vector3f(*map(float, wi))
    si.wavelengths = mi.UnpolarizedSpectrum(np.repeat(groups, len(directions), axis=0).T.astype(np.float32))
    lanes = mi.Vector3f(np.tile(directions, (len(groups), 1)).T.astype(np.float32))
    value = np.array(mi.unpolarized_spectrum(bsdf.eval(mi.BSDFContext(), si, lanes)), np.float64)
    value = value.reshape(channels, len(groups), -1).swapaxes(0, 1).reshape(groups.size, -1)[: wavelengths.size]
    cosine = np.where(directions[:, 2] > 0, directions[:, 2], 1)
    flat = _R_0 / (2 * np.pi * spectrum.lobe_width**2 * (wavelengths[:, None] * 1e-3) ** 2)
    return (value / cosine * wi[2] / flat).reshape(wavelengths.size, *wo.shape[:-1])
