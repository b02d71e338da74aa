"""S(q; κ) on a lattice of quadratic B-splines at run time, for samples and for tiles whose orders overlap."""

from __future__ import annotations

from typing import cast

import drjit as dr
import mitsuba as mi

from ..precomputation.grating_spectrum import GratingSpectrum
from ..spectrum.grids import SplineGrid, spline_weights
from ..spectrum.tables import SliceTable
from .continuum_sampler import BinSampler
from .device_tables import larger, opaque
from .directions import Geometry, Incidence
from .orders import SlicePower

RIM = 3  # nodes of zero around the table, as many as a spline covers


class Continuum:
    """S(q; κ) = Σ_m c_m(κ) B(q/Δ − m)/(Δ_x Δ_y) (`SplineGrid`), and the density from which q is drawn.

    An evaluation reads three by three nodes, and one word and one packet for the density.
    """

    resolved = False

    def __init__(self, spectrum: GratingSpectrum, typical_max_kappa: float | None) -> None:
        grid = cast(SplineGrid, spectrum.grid)
        self.power = SlicePower(cast(SliceTable, spectrum.table), (RIM, RIM))
        self.max_node_x, self.max_node_y = grid.max_order
        self.per_q_x, self.per_q_y = (opaque(1 / d) for d in grid.spacing)
        self.per_area = opaque(1 / (grid.spacing[0] * grid.spacing[1]))
        self.limit_x, self.limit_y = (opaque(limit) for limit in grid.limit)
        self.per_width = opaque(1 / spectrum.lobe_width)
        self.sampler = BinSampler(spectrum, typical_max_kappa)

    def meets(self, q_x: mi.Float, q_y: mi.Float, scale: mi.Float | float) -> mi.Bool:
        """As `Scattering.meets`: a continuum has no gaps."""
        return mi.Bool(True)

    def power_and_density(self, geometry: Geometry, incidence: Incidence, active: mi.Bool) -> tuple[mi.Float, mi.Float]:
        """As `Scattering.power_and_density`, with K and G of the pair of directions (`Geometry.continuum_factor`)."""
        q = geometry.tangent * incidence.frequency
        x, y = q.x * self.per_q_x, q.y * self.per_q_y
        m_x, m_y = mi.Int32(dr.round(x)), mi.Int32(dr.round(y))
        power = self.power.window(
            m_y + (self.max_node_y + RIM - 1),
            m_x + (self.max_node_x + RIM - 1),
            spline_weights(x - mi.Float(m_x)),
            spline_weights(y - mi.Float(m_y)),
            self.power.at_kappa(geometry.kappa(incidence.frequency), geometry.small()),
            active,
        )
        inside = active & (dr.abs(q.x) <= self.limit_x) & (dr.abs(q.y) <= self.limit_y)
        # Interpolated powers may be slightly negative.
        power = (
            larger(power, 0)
            * self.per_area
            * geometry.continuum_factor(incidence, incidence.frequency * self.per_width)
        )
        return dr.select(inside, power, 0), self.sampler.density(incidence.q_sign * q, incidence, active)

    def sample(self, incidence: Incidence, u: mi.Float, v: mi.Point2f, active: mi.Bool) -> tuple[mi.Point2f, mi.Bool]:
        """As `Scattering.sample`; as no order is chosen, none is evanescent."""
        return self.sampler.sample(incidence, u, v, active)
