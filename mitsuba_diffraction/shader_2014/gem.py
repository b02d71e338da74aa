"""GEM: a rainbow per order, independent of the height field."""

from __future__ import annotations

from numbers import Real

import drjit as dr
import mitsuba as mi
import numpy as np
import scipy.fft

from ..errors import RequestError
from ..surface.heightfield import HeightField
from .quirks import Quirks
from .shader import Shader, SpectralWeights

GEM_ORDERS = 7
_RAINBOW = (0.75, 0.5, 0.25)  # peaks of red, green and blue


class GEM(Shader):
    """The shader of GPU Gems 1, chapter 8, "Simulating Diffraction" (Stam, in Fernando 2004).

    A lattice of period d along x diffracts the wavelengths λ_n = d |u|/n into a direction. Each of the first seven
    orders adds a rainbow of three parabolas; order zero is a highlight:

        c = Σ_{n=1}^{7} max(0, 1 − 16 (y_n − y_c)²) + e^{−(r d u/w)²},     y_c = 3/4, 1/2, 1/4 for red, green, blue,

    with y = (λ − 0.38 µm)/0.4 µm; GPU Gems maps 0.5 to 1 µm to the rainbow. The profile of the surface is ignored.

    Attributes:
        spacing: d in µm.
        roughness: r in 1/µm.
    """

    own_quirks = ()
    brightness_unit = 1 / 4000
    peak = 1.0  # unused: the shader computes colours, not a relative radiance
    texel_reads = 0

    def __init__(
        self,
        height_field: HeightField,
        quirks: Quirks,
        *,
        spacing: float | None = None,
        roughness: float = 5.0,
        shadowing: bool = True,
    ) -> None:
        """Set up the shader; d defaults to the period of the strongest component of the heights along x."""
        super().__init__(height_field, quirks, shadowing)
        self.spacing = strongest_period(height_field) if spacing is None else spacing
        self.roughness = roughness
        if not all(isinstance(number, Real) and number > 0 for number in (self.spacing, self.roughness)):
            raise RequestError(f"spacing, roughness: got {spacing!r}, {roughness!r}, wanted positive numbers")

    def rgb(
        self,
        wi: mi.Vector3f,
        wo: mi.Vector3f,
        weights: SpectralWeights,
        active: mi.Bool = True,
        height_scale: mi.Float = 1.0,
    ) -> mi.Color3f:
        """Return linear RGB, before gamma; for arguments see `TextureShader.rgb`. Heights have no effect."""
        active = mi.Bool(active) & (wi.z > 0) & (wo.z > 0)
        path = dr.abs(wi.x + wo.x) * self.spacing
        highlight = dr.exp(-dr.square(self.roughness * path / dr.maximum(wi.z + wo.z, 1e-6)))
        result = mi.Color3f(highlight)
        for n in range(1, GEM_ORDERS + 1):
            y = (path / n - 0.38) / 0.4  # µm
            result += mi.Color3f(*(dr.maximum(1 - dr.square(4 * (y - peak)), 0) for peak in _RAINBOW))
        return dr.select(active, weights.luminance * result, 0)


def strongest_period(height_field: HeightField) -> float:
    """Return the period along x (µm) of the strongest Fourier component of the heights; the tile's period if flat."""
    power = np.abs(scipy.fft.rfft(height_field.centred - height_field.centred.mean(), axis=1)) ** 2
    orders = power.sum(axis=0)[1:]
    if orders.size == 0 or orders.max() == 0:
        return height_field.tile_size[0]
    return height_field.tile_size[0] / (1 + int(orders.argmax()))
