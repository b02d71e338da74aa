"""The Gaussian lobe of an order due to a finite coherence length."""

from __future__ import annotations

import numpy as np

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
    return 1 / (2 * np.sqrt(2) * np.pi * (coherence_length / 4))


def lobe_reach(share: float) -> float:
    """The truncation radius ρ of a lobe, in standard deviations; the truncated lobe is renormalised.

    A two-dimensional Gaussian has the fraction e^{−ρ²/2} outside the radius ρ. Truncation and renormalisation change it
    by twice that in the L1 norm, which is set equal to `share`.
    """
    return float(np.sqrt(-2 * np.log(share / 2)))
