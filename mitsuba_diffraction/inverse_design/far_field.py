"""The far field of a relief of square texels, its distance from the wanted one, and the gradient of this distance.

z = U h Uᵀ                                   heights of the pixels, from the heights of the texels, h (`blurred_texels`)
η_m = |F_m|²,  F = fft2(e^{iκz})/N           power of each order, for light along the normal
P = A_y η A_xᵀ                               power in each bin of direction cosines (`lobes_in_bins`)
L_λ = Σ (P − t)²/s                           t the wanted fraction of the light, Σ over bins
s = max Σ t²                                 over the wavelengths: unwanted light counts as much at each of them
L = (mean L_λ³)^⅓                            over the wavelengths: the larger ones count more
L_c + L/10                                   instead, if there are colours to keep (`ColourDistance`)

∂L/∂P = (L_λ/L)²/w · 2 (P − t)/s,   ∂L/∂η = g = A_yᵀ ∂L/∂P A_x,   w the number of wavelengths
∂L/∂z = 2 Re[conj(iκ e^{iκz}) · ifft2(g F)],   ∂L/∂h = Uᵀ ∂L/∂z U
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.fft
from numpy.typing import ArrayLike
from scipy.special import ndtr

from ..array_types import Real
from ..settings import lobe_width
from .colour_distance import ColourDistance

_LIGHT_BESIDE_COLOURS = 0.1  # weight of L beside L_c


def blurred_texels(texels: int, per_texel: int, blur: float) -> Real:
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


def lobes_in_bins(edges: Real, orders: ArrayLike, period: float, wavelength: float, coherence_length: float) -> Real:
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
            precision determines the precision of the FFTs.
        wanted: t, (w, bins, bins), rows ↔ +y; sums to one at most for each wavelength.
        colours: L_c, of a picture whose colours are to be kept.
    """

    texels: Real
    kappa: Real
    lobes: Real
    wanted: Real
    colours: ColourDistance | None = None

    def relief(self, heights: Real) -> Real:
        """Return z, (pixels, pixels) µm, of the heights h of the texels, rows ↔ +y."""
        return self.texels @ heights @ self.texels.T

    def loss(self, heights: Real) -> tuple[float, Real]:
        """Return L and ∂L/∂h, (texels, texels) 1/µm, at the heights h of the texels in µm."""
        dtype = self.lobes.dtype
        kappa, transposed = self.kappa[:, None, None].astype(dtype), self.lobes.swapaxes(1, 2)
        phase = kappa * self.relief(heights).astype(dtype)
        wave = np.cos(phase) + 1j * np.sin(phase)
        amplitudes = scipy.fft.fft2(wave, norm="forward")
        predicted = self.lobes @ (amplitudes.real**2 + amplitudes.imag**2) @ transposed
        difference = predicted - self.wanted
        scale = (self.wanted**2).sum(axis=(1, 2)).max()
        of_wavelengths = (difference**2).sum(axis=(1, 2)) / scale
        value = float(np.cbrt((of_wavelengths**3).mean()))
        weight = (of_wavelengths / value) ** 2 / len(of_wavelengths)
        of_predicted = weight[:, None, None] * (2 * difference / scale)
        if self.colours is not None:
            of_colours, gradient_of_colours = self.colours(predicted)
            value = of_colours + _LIGHT_BESIDE_COLOURS * value
            of_predicted = gradient_of_colours + _LIGHT_BESIDE_COLOURS * of_predicted
        g = transposed @ of_predicted.astype(dtype) @ self.lobes
        back = scipy.fft.ifft2(g * amplitudes)
        gradient = (2 * kappa * (wave.real * back.imag - wave.imag * back.real)).sum(axis=0)
        return value, self.texels.T @ gradient @ self.texels


def nearest_levels(heights: Real, height_range: float, levels: int) -> Real:
    """Return the nearest of the levels k · height_range/(levels − 1), k = 0 … levels − 1."""
    step = height_range / (levels - 1)
    return np.clip(np.rint(heights / step), 0, levels - 1) * step
