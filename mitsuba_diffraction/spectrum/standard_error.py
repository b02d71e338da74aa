"""What one scan does not tell: the standard error of Welch's estimate of S(q; κ), from the scatter of its segments."""

from __future__ import annotations

import numpy as np
import scipy.fft
import scipy.ndimage
from numpy.typing import NDArray

from ..surface.heightfield import HeightField
from ..welch import UNIFORM, WindowAxis, mean_periodogram, window_axes

# Correlation of a surface beyond the width of a window is seen between batches of segments, not between segments.
_BATCHES = 4  # along each axis
_KAPPAS = 4


def standard_error(height_field: HeightField, *, coherence_length: float, largest_kappa: float, reach: float) -> float:
    """∫ of the standard error of S(q; κ) over q, at the worst of four κ: a share of the reflected power.

    Welch's estimate Ŝ is the mean of P periodograms S_p. Those of overlapping windows are correlated; where the
    phase is that of many independent features (Welch 1967, eq. 10 and 11; a is the window, Σ a² = 1),

        ρ_ij = (Σ_n a(x_n − x_i) a(x_n − x_j))²,     var Ŝ(q) = σ²(q)/P_eff,     1/P_eff = Σ_ij ρ_ij/P²,

    with σ² the variance of one periodogram. It follows from the scatter of the means S_b of at most four batches of
    neighbouring places along each axis, ⟨·⟩ weighted by their places, r_b the mean of ρ within batch b:

        ⟨(S_b − Ŝ)²⟩ = σ² (⟨r_b⟩ − 1/P_eff).

    The variance is averaged over three by three frequencies 1/6σ_s apart, about one lobe, before its root is taken.
    As `GratingSpectrum.error`, it is compared with ∫|ΔS| dq; of normal errors that is √(2/π) = 0.8 of it.

    Args:
        height_field: the scan.
        coherence_length: in µm, that the scan carries.
        largest_kappa: κ up to which S is wanted, rad/µm.
        reach: largest |q_x| and |q_y| that light reaches, cycles/µm.
    """
    axes = [axis or UNIFORM for axis in window_axes(height_field, coherence_length)]
    correlation, within = 1.0, 1.0
    for axis in axes:
        rho, share = _correlation(axis), _batches(axis)
        correlation *= rho.mean()
        within *= sum(rho[np.ix_(batch, batch)].sum() / len(batch) for batch in share) / len(axis.starts)
    if within - correlation < 1e-12:
        return 0.0  # a single pixel
    inside = [
        np.abs(scipy.fft.fftfreq(len(axis.window), pixel)) <= reach if len(axis.window) > 1 else np.ones(1, bool)
        for axis, pixel in zip(axes, height_field.pixel_size, strict=True)
    ]
    errors = []
    for kappa in largest_kappa * np.arange(1, _KAPPAS + 1) / _KAPPAS:
        variance = _scatter(np.exp(1j * kappa * height_field.centred), axes) * correlation / (within - correlation)
        smooth = scipy.ndimage.uniform_filter(variance, 3, mode="wrap")
        errors.append(inside[1] @ np.sqrt(np.maximum(smooth, 0)) @ inside[0])
    return float(max(errors))


def _correlation(axis: WindowAxis) -> NDArray[np.float64]:
    """ρ of the places along one axis, (P, P)."""
    width = len(axis.window)
    overlap = np.correlate(axis.window, axis.window, "full")[width - 1 :]
    apart = np.abs(axis.starts[:, None] - axis.starts)
    return np.where(apart < width, overlap[np.minimum(apart, width - 1)], 0) ** 2


def _batches(axis: WindowAxis) -> list[NDArray[np.int64]]:
    places = np.arange(len(axis.starts))
    return np.array_split(places, min(_BATCHES, len(places)))


def _scatter(wave: NDArray[np.complex128], axes: list[WindowAxis]) -> NDArray[np.float64]:
    """⟨(S_b − Ŝ)²⟩ on the frequencies of the window's own transform, shares of the power: (W_y, W_x)."""
    x, y = axes
    shape = len(y.window), len(x.window)
    means, weights = [], []
    for rows in _batches(y):
        for columns in _batches(x):
            batch = WindowAxis(x.window, x.starts[columns]), WindowAxis(y.window, y.starts[rows])
            means.append(mean_periodogram(wave, *batch, shape) / (shape[0] * shape[1]))
            weights.append(len(rows) * len(columns))
    mean = np.average(means, axis=0, weights=weights)
    return np.average((np.array(means) - mean) ** 2, axis=0, weights=weights)
