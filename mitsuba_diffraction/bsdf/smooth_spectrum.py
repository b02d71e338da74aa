"""S(q; κ) of a sample at run time: a lattice of quadratic B-splines, without sharp lines."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import scipy.ndimage

from ..spectrum import GratingSpectrum
from ..spectrum.spline_grid import spline_weights
from .cell_sampler import CellSampler
from .incidence import Incidence
from .kappa_cells import averages
from .order_power import order_power
from .tables import opaque

RIM = 2  # rings of zeros: the splines of the last nodes reach 3/2 Δ, and there three nodes are read


class SmoothSpectrum:
    """S(q; κ) = Σ_m c_m(κ) B(q/Δ − m)/(Δ_x Δ_y) (`SplineGrid`), and the density from which q is drawn.

    One evaluation reads three by three nodes, three of them side by side in memory, and one packet for the density:
    with slices 9 × 4 + 4 floats.
    """

    def __init__(self, spectrum: GratingSpectrum) -> None:
        grid = spectrum.grid
        self.power = order_power(spectrum.table, RIM)
        self.largest_x, self.largest_y = grid.largest
        self.spacing_x, self.spacing_y = (opaque(d) for d in grid.spacing)
        self.limit_x, self.limit_y = (opaque(limit) for limit in grid.limit)
        shares = averages(spectrum)
        for axis in (1, 2):
            # The integral of a B-spline over a cell: 1/6, 2/3, 1/6.
            shares = scipy.ndimage.correlate1d(shares, np.array([1, 4, 1]) / 6, axis=axis, mode="constant")
        self.cells = CellSampler(np.maximum(shares, 0), grid.spacing, grid.largest, spectrum.largest_kappa)

    def evaluate(
        self,
        q_x: mi.Float,
        q_y: mi.Float,
        kappa: mi.Float,
        incidence: Incidence,
        active: mi.Bool,
    ) -> tuple[mi.Float, mi.Float]:
        """S(q; κ) and the density of q, both in µm², for one wavelength.

        Args:
            q_x: cycles/µm.
            q_y: cycles/µm.
            kappa: rad/µm.
            incidence: the wavelength and where it comes from.
            active: mask.
        """
        x, y = q_x / self.spacing_x, q_y / self.spacing_y
        m_x, m_y = mi.Int32(dr.round(x)), mi.Int32(dr.round(y))
        weights_x, weights_y = spline_weights(x - mi.Float(m_x)), spline_weights(y - mi.Float(m_y))
        inside = active & (dr.abs(m_x) <= self.largest_x + 1) & (dr.abs(m_y) <= self.largest_y + 1)
        inside &= (dr.abs(q_x) <= self.limit_x) & (dr.abs(q_y) <= self.limit_y)
        row, column = m_y - 1 + self.largest_y + RIM, m_x - 1 + self.largest_x + RIM
        first = mi.UInt32(dr.select(inside, row * self.power.columns + column, 0))
        power = mi.Float(0.0)
        for offset, factors in self.power.at(kappa, inside):
            packet = mi.Vector4f(0.0)
            for j in range(3):
                node = offset + first + j * self.power.columns
                packet += weights_y[j] * sum(weights_x[i] * self.power.table(node + i, inside) for i in range(3))
            power += dr.dot(packet, factors)
        # Interpolation may dip below zero by its error.
        power = dr.maximum(power, 0) / (self.spacing_x * self.spacing_y)
        weights = self.cells.weights(incidence)
        return dr.select(inside, power, 0), self.cells.density(q_x, q_y, weights, active)

    def sample(
        self,
        incidence: Incidence,
        u: mi.Float,
        v: mi.Point2f,
        active: mi.Bool,
    ) -> tuple[mi.Float, mi.Float]:
        """Draw q in cycles/µm, for one wavelength; `incidence` as in `evaluate`."""
        return self.cells.sample(self.cells.weights(incidence), u, v, active)
