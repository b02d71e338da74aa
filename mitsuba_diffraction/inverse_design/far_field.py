"""The far field of a relief of square texels, its distance from the wanted one, and the gradient of that.

    z = U h Uᵀ                                   heights of the pixels, from those of the texels, h (`blurred_texels`)
    η_m = |F_m|²,  F = fft2(e^{iκz})/N           power of each order, for light along the normal
    P = A_y η A_xᵀ                               power in each bin of direction cosines (`lobes_in_bins`)
    L_λ = Σ (P − t)²/Σ t²                        t the wanted fraction of the light, Σ over bins (`relative_difference`)
    L = (mean L_λ³)^⅓                            over the wavelengths: the larger ones count more (`cubic_mean`)

    ∂L/∂P = ∂L/∂L_λ ∂L_λ/∂P,   ∂L/∂z (`phase_gradient`) with g = A_yᵀ ∂L/∂P A_x,   ∂L/∂h = Uᵀ ∂L/∂z U

The constraints are `bounds` of the heights and `nearest_levels`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.fft
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import Bounds
from scipy.special import ndtr

from ..settings import lobe_width

Array = NDArray[np.float64]


def blurred_texels(texels: int, per_texel: int, blur: float) -> Array:
    """Return U, (texels · per_texel, texels): squares convolved with a Gaussian, at the pixels of one period.

    Args:
        texels: along one period.
        per_texel: pixels along a texel.
        blur: standard deviation of the Gaussian in texels; 0 for none.
    """
    offset = (np.arange(texels * per_texel)[:, None] + 0.5) / per_texel - (np.arange(texels) + 0.5)
    offset = (offset + texels / 2) % texels - texels / 2
    width = max(blur, 1e-9)
    return sum(
        ndtr((offset + period + 0.5) / width) - ndtr((offset + period - 0.5) / width) for period in (-texels, 0, texels)
    )


def lobes_in_bins(edges: Array, orders: ArrayLike, period: float, wavelength: float, coherence_length: float) -> Array:
    """Return A, (bins, orders): the integrals of the lobes of orders over bins along one axis.

    With light along the normal, the lobe of the order m is a Gaussian about ω_o = −λ m/T of standard deviation λ σ_q.

    Args:
        edges: of the bins, ascending direction cosines, (bins + 1,).
        orders: m, (orders,).
        period: T, µm.
        wavelength: λ, µm.
        coherence_length: µm.
    """
    offset = edges[:, None] + wavelength * np.asarray(orders) / period
    return np.diff(ndtr(offset / (wavelength * lobe_width(coherence_length))), axis=0)


@dataclass(frozen=True, eq=False)
class FarField:
    """The map from heights of texels to the light in the bins of a picture, and what is wanted of it.

    Attributes:
        texels: U, (pixels, texels).
        kappa: κ of each wavelength, (w,) rad/µm.
        lobes: A of each wavelength, (w, bins, pixels), orders as in `scipy.fft.fftfreq`, the same along x and y. Its
            precision is that of the FFTs.
        wanted: t, (w, bins, bins), rows ↔ +y; sums to one for each wavelength.
    """

    texels: Array
    kappa: Array
    lobes: Array
    wanted: Array

    def relief(self, heights: Array) -> Array:
        """Return z, (pixels, pixels) µm, of the heights h of the texels, rows ↔ +y."""
        return self.texels @ heights @ self.texels.T

    def loss(self, heights: Array) -> tuple[float, Array]:
        """Return L and ∂L/∂h, (texels, texels) 1/µm, at the heights h of the texels in µm."""
        dtype = self.lobes.dtype
        kappa, transposed = self.kappa[:, None, None].astype(dtype), self.lobes.swapaxes(1, 2)
        phase = kappa * self.relief(heights).astype(dtype)
        wave = np.cos(phase) + 1j * np.sin(phase)
        amplitudes = scipy.fft.fft2(wave, norm="forward")
        predicted = self.lobes @ (amplitudes.real**2 + amplitudes.imag**2) @ transposed
        differences, of_predicted = relative_difference(predicted, self.wanted)
        value, of_differences = cubic_mean(differences)
        g = transposed @ (of_differences[:, None, None] * of_predicted).astype(dtype) @ self.lobes
        gradient = phase_gradient(wave, amplitudes, kappa, g).sum(axis=0)
        return value, self.texels.T @ gradient @ self.texels


def relative_difference(predicted: Array, wanted: Array) -> tuple[Array, Array]:
    """Return L_λ, (w,), and ∂L_λ/∂P = 2 (P − t)/Σ t², (w, bins, bins)."""
    difference, scale = predicted - wanted, (wanted**2).sum(axis=(1, 2))
    return (difference**2).sum(axis=(1, 2)) / scale, 2 * difference / scale[:, None, None]


def cubic_mean(values: Array) -> tuple[float, Array]:
    """Return L = (mean v³)^⅓ of values v > 0, (w,), and its gradient, (v/L)²/w."""
    mean = float(np.cbrt((values**3).mean()))
    return mean, (values / mean) ** 2 / len(values)


def phase_gradient(
    wave: NDArray[np.complexfloating], amplitudes: NDArray[np.complexfloating], kappa: Array, g: Array
) -> Array:
    """Return ∂L/∂z = 2 Re[conj(iκ e^{iκz}) · ifft2(g F)] from e^{iκz}, F and g = ∂L/∂η, all of one shape."""
    back = scipy.fft.ifft2(g * amplitudes)
    return 2 * kappa * (wave.real * back.imag - wave.imag * back.real)


def nearest_levels(heights: Array, height_range: float, levels: int) -> Array:
    """Return the nearest of the levels k · height_range/(levels − 1), k = 0 … levels − 1."""
    step = height_range / (levels - 1)
    return np.clip(np.rint(heights / step), 0, levels - 1) * step


def bounds(heights: Array, height_range: float, fixed: NDArray[np.bool_] | None = None) -> Bounds:
    """Return 0 ≤ h ≤ height_range, and h as it is where `fixed`."""
    low, high = np.zeros(heights.shape), np.full(heights.shape, height_range)
    if fixed is not None:
        low[fixed] = high[fixed] = heights[fixed]
    return Bounds(low.ravel(), high.ravel())
