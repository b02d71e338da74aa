"""The Gaussian lobe of an order due to a finite coherence length."""

from __future__ import annotations

import math

import numpy as np
import scipy.special

from .errors import RequestError

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
