"""Reference: the power spectrum of the phase by direct summation in float64, without tables.

All other evaluations are measured against it.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import scipy.fft
from numpy.typing import ArrayLike, NDArray

from ..array_types import Real
from ..errors import RequestError
from ..settings import SUN_COHERENCE_LENGTH, ScalarSettings, lobe_width, matching
from ..spectrum.sample import UNIFORM, WindowAxis, effective_coherence_length, window_axes
from ..surface.heightfield import HeightField

_MAX_SIGMAS = 9.0  # radius of a lobe, standard deviations; e^{−9²/2} is under 3e-18
MAX_CHUNK = 2**20  # complex numbers in an intermediate array, 16 MiB


def amplitudes(height_field: HeightField, kappa: float) -> NDArray[np.complex128]:
    """Compute F_m(κ), the Fourier coefficients of e^{iκh} on the tile: fft2 / (N_x N_y), heights centred.

    Returns:
        (N_y, N_x), orders as in `scipy.fft.fftfreq`; Σ|F_m|² = 1.
    """
    return scipy.fft.fft2(np.exp(1j * kappa * height_field.centred), norm="forward")


def order_powers(height_field: HeightField, kappa: float) -> Real:
    """Compute η_m(κ) = |F_m|², the fraction of the reflected power in each order; layout as `amplitudes`."""
    return np.abs(amplitudes(height_field, kappa)) ** 2


def power_spectrum(
    height_field: HeightField,
    q: ArrayLike,
    kappa: ArrayLike,
    *,
    extent: str = "tile",
    coherence_length: float = SUN_COHERENCE_LENGTH,
) -> Real:
    """Compute S(q; κ), the power reflected by a patch per unit area of the frequency plane.

    A "tile" is periodic and has a line spectrum:

        S(q; κ) = Σ_m η_m(κ) N(q − m/T; σ_q² I),     ∫ S dq = 1.

    A "sample" of a larger, irregular surface is averaged over P positions x_p of a window a inside the scan (Welch
    1967, see `spectrum.sample`):

        S(q; κ) = (d_x d_y/P) Σ_p |Σ_n a(x_n − x_p) e^{iκh_n} e^{−2πi q·x_n}|² / Σ_n a².

    Its integral over the Nyquist rectangle |q_j| ≤ 1/2d_j is one for every κ; d is the pixel size. Along an axis of one
    pixel the surface is uniform, and S has the factor N(q_j; σ_q²) of the same coherence length.

    Outside the Nyquist limit a tile has the tails of its last orders alone, and the spectrum of a sample is zero.

    Args:
        height_field: the patch.
        q: (..., 2) cycles/µm, along x and y.
        kappa: (...) rad/µm.
        extent: "tile" or "sample".
        coherence_length: L_c in µm, of a sample limited by the size of the scan.

    Returns:
        (...) µm².

    Raises:
        ValueError: if the extent is unknown, the coherence length is not positive or, for a sample, below four pixels,
            an argument is not finite, or the shapes do not match.
    """
    ScalarSettings(extent=extent, coherence_length=coherence_length)
    q, kappa = matching(q, kappa)
    if not np.isfinite(kappa).all():
        raise RequestError("kappa: got numbers that are not finite, wanted rad/µm")
    evaluate = _tile_spectrum if extent == "tile" else _sample_spectrum
    return evaluate(height_field, q.reshape(-1, 2), kappa.ravel(), coherence_length).reshape(kappa.shape)


def _tile_spectrum(height_field: HeightField, q: Real, kappa: Real, coherence_length: float) -> Real:
    """Compute Σ_m η_m(κ) N(q − m/T; σ_q² I) for q (M, 2) and κ (M,): (M,) µm²."""
    sigma = lobe_width(coherence_length)
    result = np.zeros(kappa.shape)
    rows, columns = height_field.shape
    tile = height_field.tile_size
    orders = [np.arange(-(n // 2), n // 2 + 1) for n in (columns, rows)]
    # The Nyquist order of an even number of pixels is divided equally between both signs.
    factors = [np.where(2 * np.abs(m) == n, 0.5, 1.0) for m, n in zip(orders, (columns, rows), strict=True)]
    for value, indices in _by_kappa(kappa):
        eta = order_powers(height_field, value)[np.ix_(orders[1] % rows, orders[0] % columns)]
        eta *= np.outer(factors[1], factors[0])
        for index in indices:
            lobes, spans = [], []
            for axis in (0, 1):
                near = np.abs(q[index, axis] - orders[axis] / tile[axis]) <= _MAX_SIGMAS * sigma
                span = slice(near.argmax(), near.argmax() + near.sum())
                lobes.append(_gaussian(q[index, axis] - orders[axis][span] / tile[axis], sigma))
                spans.append(span)
            result[index] = lobes[1] @ eta[spans[1], spans[0]] @ lobes[0]
    return result


def _sample_spectrum(height_field: HeightField, q: Real, kappa: Real, coherence_length: float) -> Real:
    """Compute Welch's estimate of S for q (M, 2) and κ (M,): (M,) µm²."""
    effective = effective_coherence_length(height_field, coherence_length)
    windows = window_axes(height_field, effective)
    result = _mean_periodograms(height_field, q, kappa, *windows)
    for q_j, window, pixel in zip(q.T, windows, height_field.pixel_size, strict=True):
        if window is UNIFORM:
            result *= _gaussian(q_j, lobe_width(effective))
        else:
            # Zero outside the Nyquist limit; rounding of q must not exclude the limit itself.
            result *= np.where(np.abs(q_j) * 2 * pixel <= 1 + 1e-12, pixel, 0.0)
    return result


def _mean_periodograms(
    height_field: HeightField, q: Real, kappa: Real, along_x: WindowAxis, along_y: WindowAxis
) -> Real:
    """Average |Σ_n a(x_n − x_p) e^{iκh_n} e^{−2πi q·x_n}|² over the positions x_p for q (M, 2) and κ (M,): (M,).

    Window and wave are separable: first the sums over y, for all columns at once, then those over x.
    """
    width, height = len(along_x.window), len(along_y.window)
    chunk = max(1, MAX_CHUNK // max(height_field.shape))
    result = np.zeros(kappa.shape)
    for value, indices in _by_kappa(kappa):
        phase = np.exp(1j * value * height_field.centred)
        for part in np.split(indices, range(chunk, len(indices), chunk)):
            # On a grid, many q have the same q_y.
            q_y, which = np.unique(q[part, 1], return_inverse=True)
            # Phases are relative to the window, whose position only changes the phase of the sum.
            wave_x = along_x.window * _waves(q[part, 0], width, height_field.pixel_size[0])
            wave_y = along_y.window * _waves(q_y, height, height_field.pixel_size[1])
            for row in along_y.starts:
                columns = wave_y @ phase[row : row + height]
                for column in along_x.starts:
                    amplitude = np.einsum("mx,mx->m", columns[which, column : column + width], wave_x)
                    result[part] += amplitude.real**2 + amplitude.imag**2
    return result / (len(along_x.starts) * len(along_y.starts))


def _waves(q: Real, count: int, pixel: float) -> NDArray[np.complex128]:
    """Return e^{−2πiqx} at x = 0, d, 2d, …: (M, count) for q (M,)."""
    return np.exp(-2j * np.pi * np.outer(q, np.arange(count) * pixel))


def _gaussian(q: Real, sigma: float) -> Real:
    """Return N(q; σ²) along one axis, µm."""
    return np.exp(-(q**2) / (2 * sigma**2)) / (np.sqrt(2 * np.pi) * sigma)


def _by_kappa(kappa: Real) -> Iterator[tuple[float, NDArray[np.int64]]]:
    """Yield each distinct value in κ (M,), with its indices."""
    for value in np.unique(kappa):
        yield value, np.flatnonzero(kappa == value)
