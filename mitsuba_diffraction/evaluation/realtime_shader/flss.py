"""FLSS: full lambda space sampling."""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np

from .base import Gain, TextureShader

RADIUS = 1  # of the neighbourhood of 3 × 3 texels


class FLSS(TextureShader):
    """Full lambda space sampling (thesis of 2014, algorithm 4.3, after Stam 1999, "Diffraction Shaders").

    Samples 81 wavelengths, 380 to 780 nm. For each, the texels of the transform of the tile around the position
    c = (u T_x, v T_y)/λ (eq. 4.6) are weighted with a Gaussian window in amplitude (eq. 3.29, 3.30):

        P = Σ_m φ(m/T − q) F_m(κ),     φ(x) = e^{−|x|²/2σ_f²},     σ_f = 1/(2πσ_s),     σ_s = L_c/4.

    The neighbourhood truncates at most about e^{−(3/2)²/(σ_f T)²} of a line: 0.4 % for T = L_c, and a negligible part
    for much smaller tiles. For T > L_c orders overlap, and the complex sum represents a single point x₀ rather than the
    average.
    """

    own_quirks = (*TextureShader.own_quirks, "window_pi", "complex_window_sum")

    @property
    def texels_per_term(self) -> int:
        return (2 * RADIUS + 1) ** 2

    @property
    def truncated_fraction(self) -> float:
        """e^{−(3/2)²/(σ_f T)²} with the longer side T: bound of the truncated fraction of the power of a line."""
        return float(np.exp(-((1.5 / (self.sigma * max(self.tile_size))) ** 2)))

    def power(self, gain: Gain, wavelength: mi.Float, height_scale: mi.Float, active: mi.Bool) -> mi.Float:
        x, y = self.position(gain, wavelength)
        return self.windowed(gain, x, y, wavelength, height_scale, self.window(x, y), active)

    def position(self, gain: Gain, wavelength: mi.Float) -> tuple[mi.Float, mi.Float]:
        """Return c, in texels relative to frequency zero."""
        return gain.u * self.tile_size[0] / wavelength, gain.v * self.tile_size[1] / wavelength

    def window(
        self, x: mi.Float, y: mi.Float, stretch_x: mi.Float = 1.0, stretch_y: mi.Float = 1.0
    ) -> Callable[[mi.Int32, mi.Int32], mi.Float]:
        """Return φ of the texels m, with distances along x and y scaled by the given factors."""
        height = float(np.pi) if self.quirks.window_pi else 1.0
        scale = 1 / (float(np.sqrt(2)) * self.sigma)

        def phi(m_x: mi.Int32, m_y: mi.Int32) -> mi.Float:
            d_x = (mi.Float(m_x) - x) * (scale / self.tile_size[0]) * stretch_x
            d_y = (mi.Float(m_y) - y) * (scale / self.tile_size[1]) * stretch_y
            return height * dr.exp(-dr.square(d_x) - dr.square(d_y))

        return phi

    def windowed(
        self,
        gain: Gain,
        x: mi.Float,
        y: mi.Float,
        wavelength: mi.Float,
        height_scale: mi.Float,
        window: Callable[[mi.Int32, mi.Int32], mi.Float],
        active: mi.Bool,
        radius: int = RADIUS,
    ) -> mi.Float:
        """Return |Σ φ F|² or Σ φ² |F|² around the position (x, y)."""
        anchor = dr.floor if self.quirks.floor_anchor else dr.round
        # Clamping keeps the conversion in range; far outside the texture nothing is read.
        first = tuple(mi.Int32(dr.clip(anchor(c), -1e6, 1e6)) - radius for c in (x, y))
        kappa = -dr.two_pi * gain.w / wavelength * height_scale
        size = (2 * radius + 1, 2 * radius + 1)
        complex_sum, powers = self.textures.over(first, size, kappa, window, active)
        return complex_sum if self.quirks.complex_window_sum else powers
