"""From amplitudes to Mueller matrices."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

# S_i = E† σ_i E, in the order of Stokes parameters; the sign of the last is Mitsuba's, with n + ik for metals.
_PAULI = np.array([[[1, 0], [0, 1]], [[1, 0], [0, -1]], [[0, 1], [1, 0]], [[0, 1j], [-1j, 0]]])

REVERSED = np.array([1, 1, 1, -1])
"""s: light that runs through an order backwards, mirrored so that k_y has the same sign, has s_i s_j M_ji."""

MIRRORED = np.array([1, 1, -1, -1])
"""s: light of the opposite k_y has s_i s_j M_ij."""


def mueller(amplitudes: NDArray[np.complex128]) -> NDArray[np.float64]:
    """M_ij = Tr(σ_i J σ_j J†) / 2 of amplitudes J, (…, 2, 2) → (…, 4, 4).

    Polarised waves are written in (ê, k̂ × ê), as in `coordinate_transformation.Scattered`.
    """
    return np.einsum("iab,...bc,jcd,...ad->...ij", _PAULI, amplitudes, _PAULI, amplitudes.conj()).real / 2
