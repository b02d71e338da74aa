"""Draws q for a line grating whose lobes overlap, or are so wide that the horizon cuts through them."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..spectrum import GratingSpectrum
from .arithmetic import larger, limited
from .cell_axis import LOBE, CellAxis
from .incidence import Incidence
from .inversion import search, sums_before
from .kappa_cells import CELLS, KappaCells, averages, choose
from .order_sampler import FLOOR
from .tables import PacketTable, ShareTable, opaque

WIDEST = 0.5  # σ_q: cells are no wider
SCALE = 1.7  # τ in σ_q: ∫ N²/F′ dq is least, 1.04


class LineSampler:
    """The density of a q that propagates, here for orders along x:

        p(q) = P_m/Δ · F′(q_y)/(F(b) − F(a)),    |q_x − mΔ| ≤ Δ/2

    P_m = Σ_j w_j A_jm / Σ_j w_j M_j is a mixture over κ (`kappa_cells`), restricted to the cells in which something
    propagates, over which M_j is the sum of A_jm. Across the orders, Student's distribution with four degrees of
    freedom stands for the Gaussian, which takes longer to restrict to what propagates at q_x, a ≤ q_y ≤ b:

        F(y) = t − t³/3,    t = y/√(τ² + y²),    t = 2 sin(arcsin(3F/2)/3)

    With s the direction of incidence, the limits are

        |q_x + s_x/λ| ≤ √(1/λ² − s_⊥²),             s_⊥ = max(|s_y/λ| − 4σ_q, 0)
        |q_y + s_y/λ| ≤ √(1/λ² − (q_x + s_x/λ)²),   |q_y| ≤ 4σ_q
    """

    def __init__(self, spectrum: GratingSpectrum) -> None:
        self.along_x = spectrum.grid.shape[0] == 1
        axis = CellAxis.of(spectrum, 0 if self.along_x else 1, WIDEST)
        self.cells, self.largest, self.count = KappaCells(spectrum.largest_kappa), axis.largest, len(axis.shares)
        shares = axis.shares @ averages(spectrum, FLOOR).reshape(CELLS, -1).T
        self.shares = ShareTable(np.maximum(shares, 0))
        # The sums of A_j over the cells before each.
        self.before = PacketTable(sums_before(np.float64(self.shares.values)))
        self.spacing, self.per_q = opaque(axis.spacing), opaque(1 / axis.spacing)
        self.reach, self.limit = opaque(LOBE * spectrum.lobe_width), _cumulative(LOBE / SCALE)
        per_scale = 1 / (SCALE * spectrum.lobe_width)
        self.per_scale, self.per_area = opaque(per_scale), opaque(per_scale / axis.spacing)

    def density(self, q_x: mi.Float, q_y: mi.Float, incidence: Incidence, active: mi.Bool) -> mi.Float:
        """p(q) in µm², q in cycles/µm, for one wavelength; of a q that propagates."""
        along, across = self._axes(q_x, q_y)
        m = mi.Int32(dr.round(along * self.per_q))
        active = active & (dr.abs(m) <= self.largest) & (dr.abs(across) <= self.reach)
        cell = mi.UInt32(m + self.largest)
        weights = self.cells.weights(incidence)
        first, end = self._interval(incidence)
        total = dr.dot(weights, self._masses(first, end, active))
        low, high = self._across(along, incidence)
        # F′ = τ⁴/(τ² + y²)^(5/2)
        root = dr.rsqrt(1 + dr.square(across * self.per_scale))
        lobe = self.per_area * root * dr.square(dr.square(root))
        total = larger(total, 1e-20) * larger(high - low, 1e-6)
        return dr.dot(weights, self.shares(cell, active)) * lobe * dr.rcp(total)

    def sample(self, incidence: Incidence, u: mi.Float, v: mi.Point2f, active: mi.Bool) -> mi.Point2f:
        """Draw q in cycles/µm, for one wavelength.

        The κ cell comes from `u`, the place along the orders from `v.x` and that across from `v.y`.
        """
        first, end = self._interval(incidence)
        kappa_cell, _ = choose(self.cells.weights(incidence) * self._masses(first, end, active), u)

        def before(cell: mi.Int32) -> mi.Float:
            return self.before.entry(mi.UInt32(cell), kappa_cell, active)

        cell, place = search(before, first, end, self.count, v.x)
        along = (mi.Float(cell - self.largest) + place - 0.5) * self.spacing
        low, high = self._across(along, incidence)
        t = 2 * dr.sin(dr.asin(1.5 * dr.fma(v.y, high - low, low)) / 3)
        return mi.Point2f(*self._axes(along, t * dr.rsqrt(1 - dr.square(t)) / self.per_scale))

    def _axes(self, x: mi.Float, y: mi.Float) -> tuple[mi.Float, mi.Float]:
        """Along the orders and across from x and y, and the reverse."""
        return (x, y) if self.along_x else (y, x)

    def _interval(self, incidence: Incidence) -> tuple[mi.Int32, mi.Int32]:
        """The first cell in which something propagates, and the end of them."""
        frequency = incidence.frequency
        along, across = (s * frequency for s in self._axes(incidence.wi.x, incidence.wi.y))
        half = dr.safe_sqrt(dr.square(frequency) - dr.square(larger(dr.abs(across) - self.reach, 0)))
        first = mi.Int32(dr.floor(dr.fma(-along - half, self.per_q, 0.5)))
        end = mi.Int32(dr.ceil(dr.fma(half - along, self.per_q, 0.5)))
        # The mirror direction m = 0 is always among them.
        return dr.clip(first, -self.largest, 0) + self.largest, dr.clip(end, 1, self.largest + 1) + self.largest

    def _masses(self, first: mi.Int32, end: mi.Int32, active: mi.Bool) -> mi.Vector4f:
        """M_j."""
        return self.before(mi.UInt32(end), active) - self.before(mi.UInt32(first), active)

    def _across(self, along: mi.Float, incidence: Incidence) -> tuple[mi.Float, mi.Float]:
        """F(a) and F(b)."""
        frequency = incidence.frequency
        s_along, s_across = (s * frequency for s in self._axes(incidence.wi.x, incidence.wi.y))
        half = dr.safe_sqrt(dr.square(frequency) - dr.square(along + s_along))
        low, high = (_cumulative((end - s_across) * self.per_scale) for end in (-half, half))
        return limited(low, -self.limit, self.limit), limited(high, -self.limit, self.limit)


def _cumulative(x: mi.Float) -> mi.Float:
    """F(τx)."""
    t = x * dr.rsqrt(1 + dr.square(x))
    return t - dr.square(t) * t / 3
