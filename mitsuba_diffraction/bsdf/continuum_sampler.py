"""A sampler of q for smooth spectra and for orders that overlap, from a table of bins.

With s = k_i,∥, light diffracted at the frequency q propagates if |λq + s| ≤ n_o: q lies in a disc of the radius n_o/λ
around −s/λ. The rows of bins that meet this disc, and in each of them the columns that do, are intervals: differences
of cumulative sums normalise a density that is restricted to them, for any medium and any incident direction. Columns
are summed in blocks of up to four, as large tables of sums are slow to read.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from ..grating_spectrum import GratingSpectrum
from ..spectrum.grids import OrderGrid, spline_integral
from .geometry import Incidence
from .inversion import KAPPA_BINS, KappaBins, choose, cumulative_sums, mean_powers, search
from .tables import PacketTable, ProbabilityTable, larger, opaque

MAX_BIN_SPACING = 0.06  # cycles/µm, to resolve the horizon
MAX_BLOCK_WIDTH = 0.07  # cycles/µm, of blocks of more than one bin
MAX_BIN_WIDTH = 2.0  # in σ_q
LOBE_CUTOFF = 4.0  # of the lobes of orders, in σ_q


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
        spacing = node_spacing / np.ceil(node_spacing / min(MAX_BIN_WIDTH * sigma, MAX_BIN_SPACING))
        max_index = int(np.ceil((nodes[-1] + half_width) / spacing - 0.5))
        ends = (np.arange(-max_index, max_index + 2) - 0.5) * spacing
        if isinstance(grid, OrderGrid):
            below = ndtr((ends[:, None] - nodes) / sigma)
        else:
            below = spline_integral((ends[:, None] - nodes) / node_spacing)
        return cls(spacing, max_index, np.diff(below, axis=0))


class BinSampler:
    """The density of q on the bin in column m and row r, |q_x − mΔ_x| ≤ Δ_x/2 and |q_y − rΔ_y| ≤ Δ_y/2:

        p(q) = Σ_j w_j A_jrm/(M_j C_jr) / (Δ_x Δ_y)

    It is a mixture over κ (`KappaBins`). A_jrm is the mean power in the bin, M_j its sum over the rows of the disc, and
    C_jr the fraction of row r in the blocks of columns that meet the disc. A bin is drawn by two binary searches, for
    its row and for its block; the density at a given q reads one word and four packets.
    """

    def __init__(self, spectrum: GratingSpectrum, typical_max_kappa: float | None = None) -> None:
        self.kappa_bins = KappaBins(spectrum.max_kappa, typical_max_kappa)
        along_x, along_y = (BinAxis.of(spectrum, axis) for axis in (0, 1))
        probabilities = along_y.integrals @ mean_powers(spectrum, self.kappa_bins) @ along_x.integrals.T
        # Coefficients of splines may be negative.
        probabilities = np.moveaxis(np.maximum(probabilities, 0), 0, -1)
        shift = max(bits for bits in range(3) if bits == 0 or along_x.spacing * 2**bits <= MAX_BLOCK_WIDTH)
        per_block = 2**shift
        probabilities = np.pad(probabilities, ((0, 0), (0, -probabilities.shape[1] % per_block), (0, 0)))
        in_blocks = probabilities.reshape(len(probabilities), -1, per_block, KAPPA_BINS)
        self.probabilities = ProbabilityTable(np.pad(in_blocks, ((0, 0), (0, 0), (0, 4 - per_block), (0, 0))))
        of_blocks = self.probabilities.values.astype(np.float64).sum(axis=2)
        of_rows = of_blocks.sum(axis=1)
        self.rows, self.blocks = of_blocks.shape[:2]
        self.cumulative_rows = PacketTable(cumulative_sums(of_rows))
        self.cumulative_blocks = PacketTable(cumulative_sums(of_blocks / np.maximum(of_rows[:, None], 1e-30)))
        self.shift, self.last_in_block = mi.Int32(shift), mi.Int32(per_block - 1)
        dr.make_opaque(self.shift, self.last_in_block)
        self.max_index_x, self.max_index_y = along_x.max_index, along_y.max_index
        self.spacing_x, self.spacing_y = opaque(along_x.spacing), opaque(along_y.spacing)
        self.per_q_x, self.per_q_y = opaque(1 / along_x.spacing), opaque(1 / along_y.spacing)

    def density(self, q: mi.Vector2f, incidence: Incidence, active: mi.Bool) -> mi.Float:
        """Return p(q) in µm² of a propagating q in cycles/µm, for one wavelength."""
        m_x, m_y = mi.Int32(dr.round(q.x * self.per_q_x)), mi.Int32(dr.round(q.y * self.per_q_y))
        active = active & (dr.abs(m_x) <= self.max_index_x) & (dr.abs(m_y) <= self.max_index_y)
        row, column = m_y + self.max_index_y, m_x + self.max_index_x
        index = 4 * (row * self.blocks + (column >> self.shift)) + (column & self.last_in_block)
        fractions = self.probabilities(mi.UInt32(index), active)
        first, end = self._rows_of_disc(incidence)
        mass = self.cumulative_rows(mi.UInt32(end), active) - self.cumulative_rows(mi.UInt32(first), active)
        first, end = (mi.UInt32(row * (self.blocks + 1) + i) for i in self._blocks_of_disc(row, incidence))
        mass *= self.cumulative_blocks(end, active) - self.cumulative_blocks(first, active)
        weights = self.kappa_bins.weights(incidence) * dr.select(mass > 1e-20, dr.rcp(mass), 0)
        return dr.dot(weights, fractions) * self.per_q_x * self.per_q_y

    def sample(self, incidence: Incidence, u: mi.Float, v: mi.Point2f, active: mi.Bool) -> mi.Point2f:
        """Draw q in cycles/µm, for one wavelength.

        `u` chooses the κ bin and the row, `v.x` the block, the column and q_x in the bin, `v.y` q_y in the bin.
        """
        kappa_bin, u = choose(self.kappa_bins.weights(incidence), u)

        def cumulative(table: PacketTable, index: mi.Int32) -> mi.Float:
            return table.component(mi.UInt32(index), kappa_bin, active)

        rows = self._rows_of_disc(incidence)
        row, _ = search(lambda i: cumulative(self.cumulative_rows, i), *rows, self.rows, u)
        start, blocks = row * (self.blocks + 1), self._blocks_of_disc(row, incidence)
        block, x = search(lambda i: cumulative(self.cumulative_blocks, start + i), *blocks, self.blocks, v.x)
        column, x = choose(self.probabilities.block(mi.UInt32(row * self.blocks + block), kappa_bin, active), x)
        m_x = mi.Float((block << self.shift) + mi.Int32(column) - self.max_index_x)
        m_y = mi.Float(row - self.max_index_y)
        return mi.Point2f((m_x + x - 0.5) * self.spacing_x, (m_y + v.y - 0.5) * self.spacing_y)

    def _rows_of_disc(self, incidence: Incidence) -> tuple[mi.Int32, mi.Int32]:
        """Return the first and the end of the rows that contain propagating q."""
        middle = -incidence.tangent.y * incidence.frequency
        return _interval(middle, incidence.radius, self.per_q_y, self.max_index_y)

    def _blocks_of_disc(self, row: mi.Int32, incidence: Incidence) -> tuple[mi.Int32, mi.Int32]:
        """Return the first and the end of the blocks of columns that contain propagating q in a row."""
        middle_x, middle_y = -incidence.tangent * incidence.frequency
        distance = dr.abs(mi.Float(row - self.max_index_y) * self.spacing_y - middle_y) - 0.5 * self.spacing_y
        half = dr.safe_sqrt(dr.square(incidence.radius) - dr.square(larger(distance, 0)))
        first, end = _interval(middle_x, half, self.per_q_x, self.max_index_x)
        return first >> self.shift, (end + self.last_in_block) >> self.shift


def _interval(middle: mi.Float, half: mi.Float, per_q: mi.Float, max_index: int) -> tuple[mi.Int32, mi.Int32]:
    """Return the first and the end of the bins that meet an interval of q, at least one bin."""
    first = mi.Int32(dr.floor(dr.fma(middle - half, per_q, 0.5))) + max_index
    end = mi.Int32(dr.ceil(dr.fma(middle + half, per_q, 0.5))) + max_index
    first = dr.clip(first, 0, 2 * max_index)
    return first, dr.clip(end, first + 1, 2 * max_index + 1)
