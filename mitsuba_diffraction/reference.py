"""The power spectrum of the phase in float64, by direct evaluation: slow, exact, no tables.

Everything else in this package is measured against this file.
"""

from __future__ import annotations

import numpy as np
import scipy.fft
from numpy.typing import ArrayLike, NDArray

from .arrays import matching
from .coherence import SUN_COHERENCE_LENGTH, lobe_width
from .heightfield import HeightField

_FAR = 9.0  # standard deviations; e^{−9²/2} is under 3e-18


def amplitudes(height_field: HeightField, kappa: float) -> NDArray[np.complex128]:
    """F_m(κ): the Fourier coefficients of e^{iκh} on the tile, fft2 / (N_x N_y), heights centred.

    Args:
        height_field: the tile.
        kappa: κ in rad/µm.

    Returns:
        (N_y, N_x), orders as in `scipy.fft.fftfreq`; Σ|F_m|² = 1.
    """
    return scipy.fft.fft2(np.exp(1j * kappa * height_field.centred), norm="forward")


def order_powers(height_field: HeightField, kappa: float) -> NDArray[np.float64]:
    """η_m(κ) = |F_m|²: the share of the reflected power in each order; shape and order as `amplitudes`."""
    return np.abs(amplitudes(height_field, kappa)) ** 2


def power_spectrum(
    height_field: HeightField,
    q: ArrayLike,
    kappa: ArrayLike,
    *,
    extent: str = "tile",
    coherence_length: float = SUN_COHERENCE_LENGTH,
) -> NDArray[np.float64]:
    """S(q; κ) = Σ_m η_m(κ) N(q − m/T; σ_q² I) of a tile that repeats for ever.

    Args:
        height_field: the tile.
        q: (..., 2) cycles/µm, along x and y.
        kappa: (...) rad/µm.
        extent: "tile".
        coherence_length: L_c in µm.

    Returns:
        (...) µm².

    Raises:
        ValueError: on an unknown extent, a coherence length that is not positive, or shapes that do not match.
    """
    check_extent(extent)
    sigma = lobe_width(coherence_length)
    q, kappa = matching(q, kappa)
    shape = kappa.shape
    q, kappa = q.reshape(-1, 2), kappa.ravel()
    result = np.zeros(kappa.shape)
    rows, columns = height_field.shape
    tile = height_field.tile_size
    orders = [np.sort(np.rint(scipy.fft.fftfreq(n) * n).astype(int)) for n in (columns, rows)]
    for value in np.unique(kappa):
        eta = scipy.fft.fftshift(order_powers(height_field, value))
        for index in zip(*np.nonzero(kappa == value), strict=True):
            lobes, spans = [], []
            for axis in (0, 1):
                near = np.abs(q[index][axis] - orders[axis] / tile[axis]) <= _FAR * sigma
                span = slice(near.argmax(), near.argmax() + near.sum())
                offset = q[index][axis] - orders[axis][span] / tile[axis]
                lobes.append(np.exp(-(offset**2) / (2 * sigma**2)) / (np.sqrt(2 * np.pi) * sigma))
                spans.append(span)
            result[index] = lobes[1] @ eta[spans[1], spans[0]] @ lobes[0]
    return result.reshape(shape)


def check_extent(extent: str) -> None:
    """Raises ValueError unless `extent` names a reading of the patch."""
    if extent != "tile":
        raise ValueError(f"extent: got {extent!r}, wanted 'tile'")
