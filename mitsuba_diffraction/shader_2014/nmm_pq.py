"""NMM with the PQ factors: the next step that section 4.5 of the thesis names."""

from __future__ import annotations

from typing import ClassVar

import drjit as dr
import mitsuba as mi

from .nmm import main_axis, max_orders, sum_over_orders
from .pq import PQ
from .shader import Gain, SpectralWeights, trapezoid
from .tristimulus import WAVELENGTH_COUNT, WAVELENGTH_STEP


class NMMPQ(PQ):
    """Only the wavelengths that satisfy the grating equation, of P × Q tiles.

    As in `NMM`, n runs along the axis j with the larger |u_j T_j|: λ_n = |u_j| T_j/n. There the PQ factor of this axis
    has its maximum, and |P|² is the same as in `PQ`. Order zero of this axis, |u_j| T_j < λ/2, contains all
    wavelengths.

    When corrected, each wavelength represents the area of its line. With x = |u_j| T_j/λ, dλ = λ²/(|u_j| T_j) dx; the
    coordinate along the other axis is y = ρx, |ρ| ≤ 1; and about an order (n, m) the factors tend to sinc²:

        ∫ |P|² dλ = λ_n²/(|u_j| T_j) Σ_m |F_nm|² I_m,     I_m = ∫ sinc²(N t) sinc²(M (ρt + δ)) dt,     δ = ρn − m,

    for N tiles along j and M across. The Jacobian λ_n²/(|u_j| T_j) = |dλ/dn| is the same as in NMM. By Parseval's
    theorem I_m is the transform of a product of two triangles, of half widths N and M|ρ|. With r = M|ρ|/N ≤ 1

        I_m = h(r, 2πMδ)/N,     h(r, c) = ∫ (1 − |g|)(1 − r|g|) cos(cg) dg, |g| ≤ 1,
                                        = 2 [(1 + r)(1 − cos c) + 2r (cos c − sin(c)/c)]/c²,

    and I_m = h(1/r, 2πNδ/ρ)/(M|ρ|) if r > 1: for ρ = 0 sinc²(Mδ)/N, the factor of the other axis over the number of
    tiles. Sums over orders are of powers, since cross terms of different orders are small for many tiles.
    """

    own_quirks: ClassVar[tuple[str, ...]] = (*PQ.own_quirks, "no_jacobian")

    @property
    def texel_reads(self) -> int:
        per_order = max(9, self.texels_per_term)
        return self.textures.terms * (WAVELENGTH_COUNT * self.texels_per_term + max_orders(self.tile_size) * per_order)

    def integral(self, gain: Gain, weights: SpectralWeights, height_scale: mi.Float) -> mi.Color3f:
        along_x, path = main_axis(gain, self.tile_size)

        def order_zero(gain: Gain, wavelength: mi.Float, height_scale: mi.Float, active: mi.Bool) -> mi.Float:
            return self.power(gain, wavelength, height_scale, active & (path < 500 * wavelength))

        def weighted_power(n: mi.Int32) -> tuple[mi.Float, mi.Float]:
            """Return λ_n in nm, and |P|² times the width in nm that λ_n represents."""
            wavelength = path / mi.Float(n)
            if self.quirks.no_jacobian:
                return wavelength, WAVELENGTH_STEP * self.power(gain, wavelength * 1e-3, height_scale, gain.active)
            powers = self._line(gain, wavelength * 1e-3, along_x, height_scale)
            return wavelength, powers * dr.square(wavelength) / path

        zero = trapezoid(self, order_zero, gain, weights, height_scale, gain.active)
        return zero + sum_over_orders(self, path, weighted_power, gain, weights)

    def _line(self, gain: Gain, wavelength: mi.Float, along_x: mi.Bool, height_scale: mi.Float) -> mi.Float:
        """Return Σ_m |F_nm|² I_m over the three orders m about y, at a wavelength λ_n in µm."""
        x, y = self.position(gain, wavelength)
        tiles = dr.select(along_x, mi.Float(self.tiles[0]), mi.Float(self.tiles[1]))
        across = dr.select(along_x, mi.Float(self.tiles[1]), mi.Float(self.tiles[0]))
        main, other = dr.round(dr.select(along_x, x, y)), dr.select(along_x, y, x)
        rho = dr.abs(other / main)

        def weight(m_x: mi.Int32, m_y: mi.Int32) -> mi.Float:
            delta = other - mi.Float(dr.select(along_x, m_y, m_x))
            on_main = mi.Float(dr.select(along_x, m_x, m_y)) == main
            return dr.select(on_main, dr.sqrt(line_area(tiles, across, rho, delta)), 0)

        corner = tuple(mi.Int32(dr.clip(dr.round(c), -1e6, 1e6)) - 1 for c in (x, y))
        kappa = -dr.two_pi * gain.w / wavelength * height_scale
        _, powers = self.textures.over(corner, (3, 3), kappa, weight, gain.active)
        return powers


def line_area(tiles: mi.Float, across: mi.Float, rho: mi.Float, delta: mi.Float) -> mi.Float:
    """Return ∫ sinc²(N t) sinc²(M (ρt + δ)) dt, for N = `tiles`, M = `across` and ρ ≥ 0."""
    wide = across * rho <= tiles
    ratio = dr.select(wide, across * rho / tiles, tiles / dr.maximum(across * rho, 1e-6))
    c = dr.abs(dr.two_pi * delta * dr.select(wide, across, tiles / dr.maximum(rho, 1e-6)))
    width = dr.select(wide, tiles, across * rho)
    small = c < 0.1
    safe = dr.select(small, 1, c)
    square = dr.square(safe)
    first = dr.select(small, 0.5 - dr.square(c) / 24, (1 - dr.cos(safe)) / square)
    second = dr.select(small, dr.square(c) / 30 - 1 / 3, (dr.cos(safe) - dr.sin(safe) / safe) / square)
    return dr.maximum(2 * ((1 + ratio) * first + 2 * ratio * second), 0) / width
