"""S(q; κ) of a tile at run time: the few orders near q, each with the Gaussian lobe of the coherence length."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..spectrum import GratingSpectrum
from .order_power import order_power
from .order_sampler import OrderSampler
from .tables import opaque


class LineSpectrum:
    """S(q; κ) = Σ_m η_m(κ) N(q − m/T; σ_q² I), and the density Σ_m P_m N(q − m/T; σ_q² I) from which q is drawn.

    N is cut off at `reach` standard deviations. Orders that stand far apart need one of them, so that one evaluation
    reads `order_power` and one packet of `OrderSampler` once; a tile as large as the coherence length needs 5 × 5.
    """

    def __init__(self, spectrum: GratingSpectrum) -> None:
        self.power = order_power(spectrum.table)
        self.sampler = OrderSampler(spectrum)
        self.largest_x, self.largest_y = spectrum.grid.largest
        self.columns = spectrum.grid.shape[1]
        self.count_x, self.count_y = spectrum.neighbours
        sigma, reach = spectrum.lobe_width, spectrum.reach
        self.lobe_width = opaque(sigma)
        self.inside = opaque(-np.expm1(-(reach**2) / 2))  # the share of the Gaussian within its reach
        self.radius = opaque(reach * sigma)
        self.tile_x, self.tile_y = (opaque(t) for t in spectrum.grid.tile_size)

    @dr.syntax
    def evaluate(
        self, q_x: mi.Float, q_y: mi.Float, kappa: mi.Float, weights: mi.Vector4f, active: mi.Bool
    ) -> tuple[mi.Float, mi.Float]:
        """S(q; κ) and the density of q, both in µm², for one wavelength.

        Args:
            q_x: cycles/µm.
            q_y: cycles/µm.
            kappa: rad/µm.
            weights: of `OrderSampler.weights`.
            active: mask.
        """
        first_x = dr.maximum(mi.Int32(dr.ceil((q_x - self.radius) * self.tile_x)), -self.largest_x)
        first_y = dr.maximum(mi.Int32(dr.ceil((q_y - self.radius) * self.tile_y)), -self.largest_y)
        if dr.hint(self.count_x * self.count_y == 1, mode="scalar"):
            power, density = self._lobe(first_x, first_y, q_x, q_y, kappa, weights, active)
        else:
            power, density = mi.Float(0.0), mi.Float(0.0)
            step = mi.UInt32(0)
            while step < self.count_x * self.count_y:
                m_x = first_x + mi.Int32(step % self.count_x)
                m_y = first_y + mi.Int32(step // self.count_x)
                more = self._lobe(m_x, m_y, q_x, q_y, kappa, weights, active)
                power += more[0]
                density += more[1]
                step += 1
        peak = dr.inv_two_pi / (dr.square(self.lobe_width) * self.inside)
        return power * peak, density * peak

    def _lobe(
        self,
        m_x: mi.Int32,
        m_y: mi.Int32,
        q_x: mi.Float,
        q_y: mi.Float,
        kappa: mi.Float,
        weights: mi.Vector4f,
        active: mi.Bool,
    ) -> tuple[mi.Float, mi.Float]:
        """η_m(κ) and P_m, times exp(−|q − m/T|²/2σ_q²)."""
        distance = dr.square(q_x - mi.Float(m_x) / self.tile_x) + dr.square(q_y - mi.Float(m_y) / self.tile_y)
        near = active & (distance <= dr.square(self.radius))
        near &= (dr.abs(m_x) <= self.largest_x) & (dr.abs(m_y) <= self.largest_y)
        order = mi.UInt32(dr.select(near, (m_y + self.largest_y) * self.columns + m_x + self.largest_x, 0))
        lobe = dr.select(near, dr.exp(-0.5 * distance / dr.square(self.lobe_width)), 0)
        return lobe * self.power(order, kappa, near), lobe * self.sampler.share(order, weights, near)

    def sample(
        self, cos_i: mi.Float, kappa_per_cosine: mi.Float, u: mi.Float, v: mi.Point2f, active: mi.Bool
    ) -> tuple[mi.Float, mi.Float]:
        """Draw q in cycles/µm, for one wavelength."""
        order, v = self.sampler.sample(cos_i, kappa_per_cosine, u, v, active)
        radius = self.lobe_width * dr.sqrt(-2 * dr.log(1 - v.x * self.inside))
        sin, cos = dr.sincos(dr.two_pi * v.y)
        m_x = mi.Int32(order % self.columns) - self.largest_x
        m_y = mi.Int32(order // self.columns) - self.largest_y
        return mi.Float(m_x) / self.tile_x + radius * cos, mi.Float(m_y) / self.tile_y + radius * sin
