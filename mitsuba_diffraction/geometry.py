"""K G in NumPy, and the normalisation of lobes at the horizon; `bsdf/geometry.py` is the same in Dr.Jit."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

SHADOWING = ("v_cavity", "none")

# Coefficients of a least-squares fit to (g(x) − 1)/t², t = 1 − x/4.
HORIZON_GAIN = (-0.04034151, 0.81494507, -5.03522703, 10.57318562, -9.23048089, 3.5662365)


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


def fresnel(cosine: ArrayLike, index: float) -> NDArray[np.float64]:
    """Return F, the reflectance of unpolarised light, of an interface with the relative index n_o/n_i.

    Args:
        cosine: of the angle of incidence; shapes broadcast.
        index: n_o/n_i, real. Below one, light is totally reflected beyond the critical angle.
    """
    within = np.sqrt(np.maximum(1 - (1 - np.square(cosine)) / index**2, 0))
    return _fresnel(cosine, within, index)


def _fresnel(cos_i: ArrayLike, cos_o: ArrayLike, index: float) -> NDArray[np.float64]:
    """Return F from the cosines on both sides."""
    s = (cos_i - index * cos_o) / np.maximum(cos_i + index * cos_o, 1e-12)
    p = (index * cos_i - cos_o) / np.maximum(index * cos_i + cos_o, 1e-12)
    return (s**2 + p**2) / 2


def transmitted(
    cos_i: ArrayLike, cos_o: ArrayLike, tangent: ArrayLike, index: float, least: ArrayLike = 0.0
) -> NDArray[np.float64]:
    """Return K_t G_t (1 − F) of a pair of directions on both sides of an interface; shapes broadcast.

    With v = ω_i + η ω_o, h = v/|v| and lengths in units of n_i (K_t as in Walter et al. 2007),

        K_t = |ω_i·v| |ω_o·v| / (cos θ_i cos θ_o v_z²),    G_t = min(1, 2 cos θ_i/|ω_i·h|, 2 cos θ_o/|ω_o·h|)²

    so that an order vanishes as cos θ towards the horizon, as rigorous orders do. Where |v|² > |1 − η²| no facet
    refracts ω_i into ω_o, and nothing is transmitted; at the limit F = 1.

    Args:
        cos_i, cos_o: |cos θ_i| and |cos θ_o|, positive.
        tangent: |ω_i,t + η ω_o,t|² = |λq|², λ in the medium of ω_i.
        index: η = n_o/n_i.
        least: |v_z| at least, in K_t.
    """
    v_z = np.abs(cos_i - index * cos_o)
    square = tangent + v_z**2
    # |ω_i·v| and |ω_o·v|
    i, o = np.abs(square + 1 - index**2) / 2, np.abs(square - 1 + index**2) / (2 * index)
    length = np.sqrt(square)
    g = np.minimum(1, 2 * length * np.minimum(cos_i / np.maximum(i, 1e-12), cos_o / np.maximum(o, 1e-12))) ** 2
    k = i * o / np.maximum(cos_i * cos_o * np.maximum(v_z, least) ** 2, 1e-12)
    return k * g * (square < np.abs(1 - index**2)) * (1 - _fresnel(i, o, index))


def horizon_gain(x: ArrayLike) -> NDArray[np.float64]:
    """Return g(x), which compensates the power of a Gaussian lobe below the horizon; x ≥ 0 in standard deviations.

    Of lobes centred at x and cut off at 0, g(x) g(y) φ(x − y) is symmetric and integrates to one:

        g(x) ∫₀^∞ φ(x − y) g(y) dy = 1,    φ the standard normal density

    (Sinkhorn 1964: the symmetric scaling of a kernel). g(0) = √e, and g = 1 from 4 on. The polynomial errs by at most
    4.1e-4.
    """
    t = np.maximum(1 - np.asarray(x, np.float64) / 4, 0)
    return 1 + t**2 * np.polynomial.polynomial.polyval(t, HORIZON_GAIN)
