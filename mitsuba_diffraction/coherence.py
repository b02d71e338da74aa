"""The Gaussian lobe that a finite coherence length gives to every order."""

from __future__ import annotations

import numpy as np

from .errors import RequestError

# The sun's disc is 0.53° wide: its light is coherent over about 65 µm.
SUN_COHERENCE_LENGTH = 65.0

# A nanometre to a metre: beyond, lobes have no width or no end in floats.
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
    """The radius ρ, in standard deviations, at which a lobe is cut off; what is inside is scaled up to the whole.

    A two-dimensional Gaussian has e^{−ρ²/2} outside of the radius ρ. Cutting it off and scaling the rest changes the
    lobe by twice that in the L1 norm, which is to be `share`.
    """
    return float(np.sqrt(-2 * np.log(share / 2)))
