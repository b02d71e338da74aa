"""What a spectrum is made for: the visible range, the coherence length and its lobe, arguments q and κ."""

from __future__ import annotations

import math

import numpy as np
import scipy.special
from numpy.typing import ArrayLike, NDArray

from .errors import RequestError

VISIBLE = (360.0, 830.0)
"""nm: the range of the CIE 1931 observer, from which Mitsuba draws wavelengths."""


# Angular diameter 0.53°.
SUN_COHERENCE_LENGTH = 65.0

# 1 nm to 1 m, beyond which the lobes under- or overflow in floating point.
SHORTEST, LONGEST = 1e-3, 1e6


def lobe_width(coherence_length: float) -> float:
    """σ_q in cycles/µm for the coherence length L_c in µm.

    The window is Gaussian in amplitude, a(x) = exp(−|x|²/2σ_s²) with σ_s = L_c/4; the power of its transform is a
    Gaussian of standard deviation σ_q = 1/(2√2 π σ_s).

    Raises:
        ValueError: if the coherence length is not 1 nm to 1 m.
    """
    if not SHORTEST <= coherence_length <= LONGEST:
        raise RequestError(
            f"coherence_length: got {coherence_length!r}, wanted a positive number of µm, {SHORTEST:g} to {LONGEST:g}"
        )
    return 1 / (2 * math.sqrt(2) * math.pi * (coherence_length / 4))


def lobe_reach(share: float) -> float:
    """Half the side ρ of the square at which a lobe is truncated, in standard deviations; the rest is renormalised.

    A two-dimensional Gaussian has the fraction 1 − erf(ρ/√2)² outside that square. Truncation and renormalisation
    change it by twice that in the L1 norm, which is set equal to `share`.
    """
    # 1 − √(1 − s/2) without cancellation.
    return float(-scipy.special.ndtri(-np.expm1(0.5 * np.log1p(-share / 2)) / 2))


def matching(q: ArrayLike, kappa: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """q (..., 2) and κ (...) as float64 arrays, broadcast against each other.

    Raises:
        ValueError: if q does not end in a pair or is not finite, or the shapes do not broadcast.
    """
    q = np.asarray(q, np.float64)
    kappa = np.asarray(kappa, np.float64)
    if q.ndim == 0 or q.shape[-1] != 2:
        raise RequestError(f"q: got shape {q.shape}, wanted (..., 2) in cycles/µm")
    if not np.isfinite(q).all():
        raise RequestError("q: got numbers that are not finite, wanted cycles/µm")
    try:
        shape = np.broadcast_shapes(q.shape[:-1], kappa.shape)
    except ValueError:
        raise RequestError(
            f"kappa: got shape {kappa.shape}, which does not broadcast with q of shape {q.shape}"
        ) from None
    return np.broadcast_to(q, (*shape, 2)), np.broadcast_to(kappa, shape)
