"""A sampler of q for smooth spectra and for orders that overlap, from a table of bins.

With s = k_i,∥, light diffracted at the frequency q propagates if |λq + s| ≤ n_o: q lies in the disc of the radius
n_o/λ around c = −s/λ. A q that is drawn outside of it is replaced by its inversion in the circle of the horizon, c +
(n_o/λ)² (q − c)/|q − c|². Every sample then propagates, for any medium and any incident direction, and no sum over the
disc is needed.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from ..precomputation.grating_spectrum import GratingSpectrum
from ..spectrum.grids import OrderGrid, spline_integral
from .device_tables import PacketTable, ProbabilityTable, larger, opaque
from .directions import Incidence
from .inversion import KAPPA_BINS, AliasTable, KappaBins, choose_bin, cumulative_sums, mean_powers, search

MAX_SAMPLER_BIN_WIDTH = 2.0  # in σ_q
MAX_BIN_SPACING = 0.06  # cycles/µm, where lobes are wide
BLOCK = 4  # columns of bins; tables of the sums of all columns would be slow to search
MAX_LINE_WIDTH = 0.25  # standard deviation of q across lines and ridges, relative to that along the axis
MAX_RATIO = 1e6  # (n_o/λ)²/|q − c|², above which the inversion of q lies outside of all tables
LOBE_CUTOFF = 4.0  # of the lobes of orders, in σ_q
MIN_MASS = 1e-5  # of the rows that meet the disc; the rounding error of the sums of rows is 1e-7


@dataclass(frozen=True, eq=False)
class BinAxis:
    """The bins of q along one axis.

    Attributes:
        spacing: Δ in cycles/µm; the spacing of the nodes is a multiple of it.
        max_index: M, |m| ≤ M.
        integrals: (2 M + 1, nodes), the integral of the lobe or spline of each node over each bin.
    """

    spacing: float
    max_index: int
    integrals: NDArray[np.float64]

    @classmethod
    def of(cls, spectrum: GratingSpectrum, axis: int) -> BinAxis:
        """Return the bins along x (0) or y (1)."""
        grid, sigma = spectrum.grid, spectrum.lobe_width
        nodes = grid.frequencies()[axis]
        if isinstance(grid, OrderGrid):
            node_spacing = 1 / grid.tile_size[axis]
            half_width = min(spectrum.lobes[axis].half_width, LOBE_CUTOFF * sigma)
        else:
            node_spacing, half_width = grid.spacing[axis], 1.5 * grid.spacing[axis]
        spacing = node_spacing / np.ceil(node_spacing / min(MAX_SAMPLER_BIN_WIDTH * sigma, MAX_BIN_SPACING))
        max_index = int(np.ceil((nodes[-1] + half_width) / spacing - 0.5))
        ends = (np.arange(-max_index, max_index + 2) - 0.5) * spacing
        if isinstance(grid, OrderGrid):
            below = ndtr((ends[:, None] - nodes) / sigma)
        else:
            below = spline_integral((ends[:, None] - nodes) / node_spacing)
        return cls(spacing, max_index, np.diff(below, axis=0))


class BinSampler:
    """The density of q in the disc of propagating light: f at q, and f at q′, the inversion of q in the circle:

        p(q) = f(q) + f(q′) (n_o/λ)⁴/|q − c|⁴,    f(q) = Σ_j w_j A_jnm/M_j / (Δ_x Δ_y)

    with A_jnm the mean power, in a bin of κ (`KappaBins`), of the bin in row n and column m, |q_x − mΔ_x| ≤ Δ_x/2 and
    |q_y − nΔ_y| ≤ Δ_y/2. M_j is their sum. Of lines and ridges, whose q is spread along one axis, much light may be
    evanescent: only the rows that meet the disc are drawn and summed. Rows lie across this axis. Where they have nearly
    no power, no q is drawn, and the density is zero.

    A bin is drawn by two alias tables, for its row and for its block of columns; rows that meet the disc are searched.
    The density at a given q reads two words, of lines and ridges two packets more.
    """

    def __init__(self, spectrum: GratingSpectrum, typical_max_kappa: float | None = None) -> None:
        self.kappa_bins = KappaBins(spectrum.max_kappa, typical_max_kappa)
        along_x, along_y = (BinAxis.of(spectrum, axis) for axis in (0, 1))
        powers = along_y.integrals @ mean_powers(spectrum, self.kappa_bins) @ along_x.integrals.T
        # Coefficients of splines may be negative.
        powers = np.moveaxis(np.maximum(powers, 0), 0, -1)
        spread_x, spread_y = (
            axis.spacing * np.sqrt(np.average(np.arange(-axis.max_index, axis.max_index + 1) ** 2, weights=weights))
            for axis, weights in ((along_x, powers.sum((0, 2))), (along_y, powers.sum((1, 2))))
        )
        self.is_line = bool(min(spread_x, spread_y) < MAX_LINE_WIDTH * max(spread_x, spread_y))
        # All other surfaces have the same kernel.
        self.transposed = self.is_line and bool(spread_x > spread_y)
        if self.transposed:
            powers, along_x, along_y = powers.swapaxes(0, 1), along_y, along_x
        powers = np.pad(powers, ((0, 0), (0, -powers.shape[1] % BLOCK), (0, 0)))
        self.powers = ProbabilityTable(powers)
        of_blocks = self.powers.values.astype(np.float64).reshape(len(powers), -1, BLOCK, KAPPA_BINS).sum(axis=2)
        of_rows = of_blocks.sum(axis=1)
        self.rows, self.blocks = of_blocks.shape[:2]
        if self.is_line:
            self.cumulative_rows = PacketTable(cumulative_sums(of_rows))
        else:
            self.row_choice = AliasTable(of_rows.T)
        self.block_choice = AliasTable(np.moveaxis(of_blocks, 1, 2))
        self.total = mi.Vector4f(*map(opaque, of_rows.sum(axis=0)))
        self.max_index = along_x.max_index, along_y.max_index
        self.spacing = opaque(along_x.spacing), opaque(along_y.spacing)
        self.per_q = opaque(1 / along_x.spacing), opaque(1 / along_y.spacing)

    def density(self, q: mi.Vector2f, incidence: Incidence, active: mi.Bool) -> mi.Float:
        """Return p(q) in µm² of a propagating q in cycles/µm, for one wavelength."""
        centre, q = self._axes(-incidence.tangent * incidence.frequency), self._axes(q)
        rows, mass = self._rows(centre, incidence), self.total
        if self.is_line:
            first, end = (self.cumulative_rows(mi.UInt32(row), active) for row in rows)
            mass = end - first
        inverse, ratio = _inverted(q, centre, incidence.radius)
        of_inverse = self._powers(inverse, rows, active & (ratio < MAX_RATIO))
        powers = dr.fma(dr.square(ratio), of_inverse, self._powers(q, rows, active))
        weights = self.kappa_bins.weights(incidence) * dr.select(mass > MIN_MASS, dr.rcp(mass), 0)
        return dr.dot(weights, powers) * self.per_q[0] * self.per_q[1]

    def _powers(self, q: mi.Vector2f, rows: tuple[mi.Int32, mi.Int32], active: mi.Bool) -> mi.Vector4f:
        """Return the powers of the bin that contains q."""
        column, row = (
            mi.Int32(dr.round(of * per_q)) + max_index
            for of, per_q, max_index in zip(q, self.per_q, self.max_index, strict=True)
        )
        active = active & (row >= rows[0]) & (row < rows[1]) & (column >= 0) & (column < BLOCK * self.blocks)
        return self.powers(mi.UInt32(row * (BLOCK * self.blocks) + column), active)

    def sample(self, incidence: Incidence, u: mi.Float, v: mi.Point2f, active: mi.Bool) -> tuple[mi.Point2f, mi.Bool]:
        """Draw q in cycles/µm, for one wavelength, and return where one was drawn.

        `u` chooses the κ bin and the row, `v.x` the block, the column and the position in the column, `v.y` the
        position in the row.
        """
        centre = self._axes(-incidence.tangent * incidence.frequency)
        kappa_bin, u = choose_bin(self.kappa_bins.weights(incidence), u)

        if self.is_line:

            def cumulative(index: mi.Int32) -> mi.Float:
                return self.cumulative_rows.component(mi.UInt32(index), kappa_bin, active)

            first, end = self._rows(centre, incidence)
            active = active & (cumulative(end) - cumulative(first) > MIN_MASS)
            row, _ = search(cumulative, first, end, self.rows, u)
        else:
            row, _ = self.row_choice.draw(kappa_bin, u, active)
        block, x = self.block_choice.draw(mi.UInt32(row) * KAPPA_BINS + kappa_bin, v.x, active)
        column, x = choose_bin(self.powers.block(mi.UInt32(row * self.blocks + block), kappa_bin, active), x)
        bins = mi.Point2f(BLOCK * block + mi.Int32(column) - self.max_index[0], row - self.max_index[1])
        q = mi.Point2f((bins.x + x - 0.5) * self.spacing[0], (bins.y + v.y - 0.5) * self.spacing[1])
        inverse, ratio = _inverted(q, centre, incidence.radius)
        return self._axes(dr.select(ratio < 1, inverse, q)), active

    def _axes(self, q: mi.Vector2f) -> mi.Vector2f:
        """Return components along columns and along rows from those along x and y, or vice versa."""
        return type(q)(q.y, q.x) if self.transposed else q

    def _rows(self, centre: mi.Vector2f, incidence: Incidence) -> tuple[mi.Int32, mi.Int32]:
        """Return the first and the end of the rows to draw from, at least one."""
        if not self.is_line:
            return mi.Int32(0), mi.Int32(self.rows)
        distance = larger(dr.abs(centre.x) - (self.max_index[0] + 0.5) * self.spacing[0], 0)
        half = dr.safe_sqrt(dr.square(incidence.radius) - dr.square(distance))
        first = mi.Int32(dr.floor(dr.fma(centre.y - half, self.per_q[1], 0.5))) + self.max_index[1]
        end = mi.Int32(dr.ceil(dr.fma(centre.y + half, self.per_q[1], 0.5))) + self.max_index[1]
        first = dr.clip(first, 0, self.rows - 1)
        return first, dr.clip(end, first + 1, self.rows)


def _inverted(q: mi.Vector2f, centre: mi.Vector2f, radius: mi.Float) -> tuple[mi.Vector2f, mi.Float]:
    """Return the inversion of q in a circle of radius ρ around c, c + (q − c) ρ²/|q − c|², and ρ²/|q − c|²."""
    from_centre = q - centre
    ratio = dr.square(radius) / larger(dr.squared_norm(from_centre), 1e-12)
    return dr.fma(ratio, from_centre, centre), ratio
