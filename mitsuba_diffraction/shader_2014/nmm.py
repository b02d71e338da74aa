"""NMM: only the wavelengths that satisfy the grating equation."""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar

import drjit as dr
import mitsuba as mi
import numpy as np

from .flss import FLSS
from .shader import Gain, SpectralWeights, TextureShader, trapezoid
from .tristimulus import FIRST_WAVELENGTH, LAST_WAVELENGTH, WAVELENGTH_COUNT, WAVELENGTH_STEP

_MAX_DISTANCE = 4.0  # from the centre of a line, in σ_f: its power is e^{−4²} = 1e-7 of the maximum there


class NMM(FLSS):
    """The (N_min, N_max) approach (thesis of 2014, section 4.5).

    A grating of period d diffracts only the wavelengths λ_n = d u/n into a direction, n = N_min … N_max with
    N_min = d u/λ_max and N_max = d u/λ_min. The thesis enumerates them along u and along v without specifying how to
    combine the two. Here n runs along the axis with the larger |d_j u_j|, where d is the period of the tile, and the
    window covers the orders of the other axis. Order zero, (u, v) = (0, 0), contains all wavelengths: it is summed as
    in FLSS, with the texel of order zero only.

    When corrected, each wavelength represents the area of its line. Along λ the power of the window is a Gaussian in
    s = 1/λ about the point s* closest to the order, at the distance p:

        ∫ φ² dλ = e^{−p²/σ_f²} √π σ_f λ_n²/|(u, v)|

    where λ_n²/|u| = d · dλ/dn is the Jacobian that the thesis omits, which makes violet too strong. With different σ
    along x and y, frequencies are in units of σ.
    """

    own_quirks: ClassVar[tuple[str, ...]] = (*FLSS.own_quirks, "no_jacobian")
    published_terms = 31

    @property
    def texel_reads(self) -> int:
        """Maximum number of texels read for one shading point, at |u| = 2."""
        return round(self.textures.terms * (WAVELENGTH_COUNT + max_orders(self.tile_size) * self.texels_per_term))

    def integral(self, gain: Gain, weights: SpectralWeights, height_scale: mi.Float) -> mi.Color3f:
        # In units of σ, in which the window is round.
        u, v = gain.u / self.sigmas[0], gain.v / self.sigmas[1]
        slope = dr.sqrt(dr.square(u) + dr.square(v))
        near = slope * (1e3 / LAST_WAVELENGTH) < _MAX_DISTANCE
        zero = trapezoid(self, self._order_zero, gain, weights, height_scale, gain.active & near)

        along_x, path = main_axis(gain, self.tile_size)

        def weighted_power(n: mi.Int32) -> tuple[mi.Float, mi.Float]:
            """Return λ_n in nm, and |P|² times the width in nm that λ_n represents."""
            wavelength = path / mi.Float(n)
            x, y = self.position(gain, wavelength * 1e-3)
            if self.quirks.no_jacobian:
                window, width = self.window(x, y), mi.Float(WAVELENGTH_STEP)
            else:
                # p is the distance perpendicular to (u, v). Other orders of the main axis have their own wavelengths
                # and must not be counted twice.
                window = self._line_window(x, y, along_x, dr.abs(dr.select(along_x, u, v)) / slope)
                width = float(np.sqrt(np.pi)) * dr.square(wavelength) * 1e-3 / slope
            power = self.windowed(gain, x, y, wavelength * 1e-3, height_scale, window, gain.active)
            return wavelength, power * width

        return zero + sum_over_orders(self, path, weighted_power, gain, weights)

    def _line_window(
        self, x: mi.Float, y: mi.Float, along_x: mi.Bool, tilt: mi.Float
    ) -> Callable[[mi.Int32, mi.Int32], mi.Float]:
        """Return φ at the distance p, for the texels whose order along the main axis is the closest."""
        phi = self.window(x, y, dr.select(along_x, 0, tilt), dr.select(along_x, tilt, 0))
        main = dr.round(dr.select(along_x, x, y))

        def line_window(m_x: mi.Int32, m_y: mi.Int32) -> mi.Float:
            return dr.select(mi.Float(dr.select(along_x, m_x, m_y)) == main, phi(m_x, m_y), 0)

        return line_window

    def _order_zero(self, gain: Gain, wavelength: mi.Float, height_scale: mi.Float, active: mi.Bool) -> mi.Float:
        """Return φ² |F_0|²."""
        x, y = self.position(gain, wavelength)
        zero = mi.Float(0)
        return self.windowed(gain, zero, zero, wavelength, height_scale, self.window(x, y), active, radius=(0, 0))


def max_orders(tile_size: tuple[float, float]) -> int:
    """Return the number of λ_n between 380 and 780 nm at |u| = 2."""
    path = 2e3 * max(tile_size)  # nm
    return int(np.floor(path / FIRST_WAVELENGTH) - np.ceil(path / LAST_WAVELENGTH) + 1)


def main_axis(gain: Gain, tile_size: tuple[float, float]) -> tuple[mi.Bool, mi.Float]:
    """Return whether |u| T_x ≥ |v| T_y, and the larger of both, d |u| in nm."""
    paths = dr.abs(gain.u) * tile_size[0], dr.abs(gain.v) * tile_size[1]
    along_x = paths[0] >= paths[1]
    return along_x, dr.select(along_x, *paths) * 1e3


@dr.syntax
def sum_over_orders(
    shader: TextureShader,
    path: mi.Float,
    weighted_power: Callable[[mi.Int32], tuple[mi.Float, mi.Float]],
    gain: Gain,
    weights: SpectralWeights,
) -> mi.Color3f:
    """Return Σ_n F/F₀ weighted_power(n) S (x̄, ȳ, z̄)(λ_n), λ_n = path/n in nm, over the visible wavelengths."""
    result = mi.Color3f(0)
    n = dr.maximum(mi.Int32(dr.ceil(path / LAST_WAVELENGTH)), 1)
    last = mi.Int32(dr.floor(path / FIRST_WAVELENGTH))
    while gain.active & (n <= last):
        wavelength, power = weighted_power(n)
        weight, r_0 = weights(wavelength, gain.active)
        result += weight * (power * shader.fresnel(r_0, gain))
        n += 1
    return result
