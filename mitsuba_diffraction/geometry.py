"""K G in NumPy, and the normalisation of lobes at the horizon; `bsdf/geometry.py` is the same in Dr.Jit."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

SHADOWING = ("v_cavity", "none")

HORIZON_GAIN = (-0.04034151, 0.81494507, -5.03522703, 10.57318562, -9.23048089, 3.5662365)
"""Coefficients of a least-squares fit to (g(x) − 1)/t², t = 1 − x/4."""


def k_g(cos_i: ArrayLike, cos_o: ArrayLike, d: ArrayLike, shadowing: bool = True) -> NDArray[np.floating]:
    """Compute K G of pairs of directions; shapes broadcast, float32 is preserved.

    With D = 1 + ω_i·ω_o and w = cos θ_i + cos θ_o,

        K = D²/(cos θ_i cos θ_o w²)    (Stam 1999),
        G = min(1, 2w cos θ_i/D, 2w cos θ_o/D)    (Torrance and Sparrow 1967).

    Args:
        cos_i, cos_o: cos θ_i and cos θ_o, positive.
        d: D. Near grazing incidence compute it as (|ω_i,t + ω_o,t|² + w²)/2, which avoids cancellation.
        shadowing: if false, K alone.
    """
    w = np.add(cos_i, cos_o)
    k = np.square(d) / (cos_i * cos_o * w**2)
    return k * np.minimum(1, 2 * w * np.minimum(cos_i, cos_o) / d) if shadowing else k


def k_g_between(wi: ArrayLike, wo: ArrayLike, shadowing: bool = True) -> NDArray[np.float64]:
    """Compute K G of unit vectors (..., 3) in the upper hemisphere; shapes broadcast."""
    wi, wo = np.asarray(wi, np.float64), np.asarray(wo, np.float64)
    return k_g(wi[..., 2], wo[..., 2], ((wi + wo) ** 2).sum(axis=-1) / 2, shadowing)


def horizon_gain(x: ArrayLike) -> NDArray[np.float64]:
    """Return g(x), which compensates the power of a Gaussian lobe below the horizon; x ≥ 0 in standard deviations.

    Of lobes centred at x and cut off at 0, g(x) g(y) φ(x − y) is symmetric and integrates to one:

        g(x) ∫₀^∞ φ(x − y) g(y) dy = 1,    φ the standard normal density

    (Sinkhorn 1964: the symmetric scaling of a kernel). g(0) = √e, and g = 1 from 4 on. The polynomial errs by at most
    4.1e-4.
    """
    t = np.maximum(1 - np.asarray(x, np.float64) / 4, 0)
    return 1 + t**2 * np.polynomial.polynomial.polyval(t, HORIZON_GAIN)
