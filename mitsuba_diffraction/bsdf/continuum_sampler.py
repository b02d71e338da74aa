"""Samplers of q by tables of bins, for smooth spectra and for orders that overlap.

With s = ω_i,∥, light diffracted at the frequency q propagates if |λq + s| ≤ 1: q lies in a disc that contains q = 0 and
grows with 1/λ. Incident light is divided into bins, too, of direction and 1/λ. The q that propagate for any light of
such a bin fill the union of its discs, which is that of the discs at the maximum of 1/λ; as discs are larger than bins,
those of the s on the border of the bin suffice.
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
from .geometry import Incidence, cell_of
from .inversion import (
    KAPPA_BINS,
    KappaBins,
    choose,
    cumulative_sums,
    direction_bin,
    direction_borders,
    mean_powers,
    search,
)
from .tables import NumberTable, PacketTable, ProbabilityTable, larger, limited, opaque

MAX_BIN_SPACING = 0.06  # cycles/µm, to resolve the horizon
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
    def of(cls, spectrum: GratingSpectrum, axis: int, max_width: float) -> BinAxis:
        """Return the bins along x (0) or y (1), at most `max_width` σ_q wide."""
        grid, sigma = spectrum.grid, spectrum.lobe_width
        nodes = grid.frequencies()[axis]
        if isinstance(grid, OrderGrid):
            node_spacing = 1 / grid.tile_size[axis]
            half_width = min(spectrum.lobes[axis].half_width, LOBE_CUTOFF * sigma)
        else:
            node_spacing, half_width = grid.spacing[axis], 1.5 * grid.spacing[axis]
        spacing = node_spacing / np.ceil(node_spacing / min(max_width * sigma, MAX_BIN_SPACING))
        max_index = int(np.ceil((nodes[-1] + half_width) / spacing - 0.5))
        ends = (np.arange(-max_index, max_index + 2) - 0.5) * spacing
        if isinstance(grid, OrderGrid):
            below = ndtr((ends[:, None] - nodes) / sigma)
        else:
            below = spline_integral((ends[:, None] - nodes) / node_spacing)
        return cls(spacing, max_index, np.diff(below, axis=0))


COARSE, FINE = 16, 45  # bins along a side of the square of directions
FREQUENCY_BINS = 4
MAX_ROWS_OF_FINE = 48  # of blocks in a region; with more, the regions of so many bins would take much memory
_MAX_BORDER_STEP = 0.02  # between the points that represent the border of a bin of s
_BORDER_MARGIN = 1e-4  # for rounding at run time


class IncidenceBins:
    """Bins of direction and 1/λ of incident light, and the region of q that propagates for each.

    Directions are mapped to the square of `energy/table.py`.
    """

    def __init__(self, wavelengths: tuple[float, float], rows: int, max_tangent: float = 1.0) -> None:
        """Make the bins.

        Args:
            wavelengths: shortest and longest, nm.
            rows: of blocks in a region.
            max_tangent: the maximum of |k_i,∥|/n_o.
        """
        self._max_tangent = max_tangent
        self.side = FINE if rows <= MAX_ROWS_OF_FINE else COARSE
        self._first, self._last = 1e3 / wavelengths[1], 1e3 / wavelengths[0]
        self.first = opaque(self._first)
        self.per_frequency = opaque(FREQUENCY_BINS / (self._last - self._first))

    def bin(self, incidence: Incidence) -> mi.UInt32:
        """Return the index of the bin of incident light; that of the nearest bin if it lies outside all of them."""
        column, row = direction_bin(mi.Vector3f(*incidence.tangent, incidence.cosine), self.side)
        frequency, _ = cell_of((incidence.radius - self.first) * self.per_frequency, FREQUENCY_BINS)
        return (frequency * self.side + row) * self.side + column

    def columns(self, low: NDArray[np.float64], high: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the interval of q_x that propagates for some q_y of a row, low ≤ q_y ≤ high (rows,), all in cycles/µm.

        Returns:
            (bins, rows, 2), the minimum and maximum of q_x; where nothing propagates, the minimum is larger.
        """
        frequency = np.linspace(self._first, self._last, FREQUENCY_BINS + 1)[1:, None]
        frequency, low, high = (np.asarray(x, np.float32) for x in (frequency, low, high))
        result = np.empty((FREQUENCY_BINS, self.side**2, len(low), 2))
        # The discs of points on the border are enlarged to cover those of points up to half a step away.
        square = (1 + _MAX_BORDER_STEP / 2 + _BORDER_MARGIN) ** 2
        # Near the normal a side of a bin is about 2√2 · 2/`side` long, elsewhere shorter.
        borders = self._max_tangent * direction_borders(self.side, int(np.ceil(5.7 / self.side / _MAX_BORDER_STEP)))
        for bin_, border in enumerate(borders.astype(np.float32)):
            s_x, s_y = border.T[:, :, None, None]
            y = np.clip(0, low / frequency + s_y, high / frequency + s_y)
            half = np.where(y**2 < square, np.sqrt(np.maximum(square - y**2, 0)), -np.inf)
            result[:, bin_, :, 0] = frequency * (-s_x - half).min(axis=0)
            result[:, bin_, :, 1] = frequency * (half - s_x).max(axis=0)
        return result.reshape(-1, len(low), 2)


MAX_BIN_WIDTH = 2.0  # in σ_q
BLOCK_WIDTH = 0.05  # cycles/µm, about, of blocks of bins


class BinSampler:
    """The density p(q) = P_m/(Δ_x Δ_y) on the bin m, |q_x − m_x Δ_x| ≤ Δ_x/2 and |q_y − m_y Δ_y| ≤ Δ_y/2.

    P_m = Σ_j w_j A_jm / Σ_j w_j M_j is a mixture over κ (`KappaBins`), restricted to a region that contains all q that
    propagate (`IncidenceBins`); M_j is the sum of A_jm over it. A region consists of blocks of bins, an interval of
    blocks in each row. A bin is drawn by three binary searches: for the row of blocks, for the block, and for the bin
    in the block. The density at a given q reads one word for the bin and one packet for M_j.
    """

    def __init__(
        self, spectrum: GratingSpectrum, typical_max_kappa: float | None = None, max_tangent: float = 1.0
    ) -> None:
        self.kappa_bins = KappaBins(spectrum.max_kappa, typical_max_kappa)
        along_x, along_y = (BinAxis.of(spectrum, axis, MAX_BIN_WIDTH) for axis in (0, 1))
        probabilities = np.moveaxis(
            along_y.integrals @ mean_powers(spectrum, self.kappa_bins) @ along_x.integrals.T, 0, -1
        )
        # Coefficients of splines may be negative.
        probabilities = np.maximum(probabilities, 0)
        spacing, max_index = (along_x.spacing, along_y.spacing), (along_x.max_index, along_y.max_index)
        self.spacing_x, self.spacing_y = (opaque(s) for s in spacing)
        self.per_q_x, self.per_q_y = (opaque(1 / s) for s in spacing)
        self.block_width, self.block_height = (
            int(np.clip(round(BLOCK_WIDTH / s), 1, count))
            for s, count in zip(spacing, probabilities.shape[1::-1], strict=True)
        )
        pad_y, pad_x = -probabilities.shape[0] % self.block_height, -probabilities.shape[1] % self.block_width
        self.probabilities = ProbabilityTable(np.pad(probabilities, ((0, pad_y), (0, pad_x), (0, 0))))
        probabilities = np.float64(self.probabilities.values)
        self.rows, self.columns = probabilities.shape[:2]
        self.max_index_x, self.max_index_y = max_index
        self.area = opaque(spacing[0] * spacing[1])
        blocks = probabilities.reshape(
            self.rows // self.block_height,
            self.block_height,
            self.columns // self.block_width,
            self.block_width,
            KAPPA_BINS,
        )
        blocks = blocks.swapaxes(1, 2).reshape(*blocks.shape[:3:2], -1, KAPPA_BINS)
        self.blocks_y, self.blocks_x, self.in_block, _ = blocks.shape
        cumulative_x = cumulative_sums(blocks.sum(axis=2))

        self.incidence_bins = IncidenceBins(spectrum.wavelengths, self.blocks_y, max_tangent)
        row_edges = (np.arange(self.blocks_y + 1) * self.block_height - max_index[1] - 0.5) * spacing[1]
        ends = self.incidence_bins.columns(row_edges[:-1], row_edges[1:])
        ends = ends / (spacing[0] * self.block_width) + (max_index[0] + 0.5) / self.block_width
        first = np.clip(np.floor(ends[..., 0]), 0, self.blocks_x).astype(np.int64)
        end = np.maximum(np.clip(np.ceil(ends[..., 1]), 0, self.blocks_x).astype(np.int64), first)
        row = np.arange(self.blocks_y)
        # In float32, as `sample` computes them.
        cumulative_y = cumulative_sums(np.float64(cumulative_x[row, end]) - cumulative_x[row, first])
        # Sums of one bin of κ lie next to each other.
        self.cumulative_y, self.cumulative_x, self.cumulative_in_block = (
            NumberTable(sums.swapaxes(-1, -2)) for sums in (cumulative_y, cumulative_x, cumulative_sums(blocks))
        )
        self.masses = PacketTable(cumulative_y[:, -1])
        self.ends = NumberTable((first | end << 16).astype(np.uint32))

    def density(self, q: mi.Vector2f, incidence: Incidence, active: mi.Bool) -> mi.Float:
        """Return p(q) in µm² of a propagating q in cycles/µm, for one wavelength."""
        m_x, m_y = mi.Int32(dr.round(q.x * self.per_q_x)), mi.Int32(dr.round(q.y * self.per_q_y))
        active = active & (dr.abs(m_x) <= self.max_index_x) & (dr.abs(m_y) <= self.max_index_y)
        index = mi.UInt32((m_y + self.max_index_y) * self.columns + m_x + self.max_index_x)
        weights = self.kappa_bins.weights(incidence)
        total = self.area * dr.dot(weights, self.masses(self.incidence_bins.bin(incidence), active))
        return dr.dot(self.probabilities(index, active), weights) * dr.rcp(larger(total, 1e-20))

    def sample(self, incidence: Incidence, u: mi.Float, v: mi.Point2f, active: mi.Bool) -> mi.Point2f:
        """Draw q in cycles/µm, for one wavelength.

        `u` chooses the κ bin, the row of blocks and the bin in its block, `v.x` the block and q_x in the bin, `v.y` q_y
        in the bin: one number alone has too few bits.
        """
        incidence_bin = self.incidence_bins.bin(incidence)
        masses = self.masses(incidence_bin, active)
        kappa_bin, u = choose(self.kappa_bins.weights(incidence) * masses, u)

        def bin_of(
            sums: NumberTable, line: mi.UInt32, count: int, ends: tuple[mi.Int32, mi.Int32], u: mi.Float
        ) -> tuple[mi.Int32, mi.Float]:
            start = (line * KAPPA_BINS + kappa_bin) * (count + 1)
            return search(lambda i: sums(start + mi.UInt32(i), active), *ends, count, u)

        zero = mi.Int32(0)
        row, u = bin_of(self.cumulative_y, incidence_bin, self.blocks_y, (zero, mi.Int32(self.blocks_y)), u)
        line = mi.UInt32(row)
        ends = self.ends(incidence_bin * self.blocks_y + line, active)
        ends = mi.Int32(ends & 0xFFFF), mi.Int32(ends >> 16)
        column, x = bin_of(self.cumulative_x, line, self.blocks_x, ends, v.x)
        block, ends = mi.UInt32(row * self.blocks_x + column), (zero, mi.Int32(self.in_block))
        index_in_block, _ = bin_of(self.cumulative_in_block, block, self.in_block, ends, u)
        m_x = mi.Float(column * self.block_width + index_in_block % self.block_width - self.max_index_x)
        m_y = mi.Float(row * self.block_height + index_in_block // self.block_width - self.max_index_y)
        return mi.Point2f((m_x + x - 0.5) * self.spacing_x, (m_y + v.y - 0.5) * self.spacing_y)


UNIFORM_LINE_FRACTION = 0.05  # of the probability in a κ bin of a line grating, divided equally among the orders
MAX_LINE_BIN_WIDTH = 0.5  # of line gratings, in σ_q
STUDENT_SCALE = 1.7  # τ in σ_q, which minimises ∫ N²/F′ dq (1.04)


class LineSampler:
    """The density of a q that propagates, here for orders along x:

        p(q) = P_m/Δ · F′(q_y)/(F(b) − F(a)),    |q_x − mΔ| ≤ Δ/2

    P_m = Σ_j w_j A_jm / Σ_j w_j M_j is a mixture over κ (`KappaBins`), restricted to the bins that contain propagating
    q, over which M_j is the sum of A_jm. In the perpendicular direction q is truncated to the interval that propagates
    at q_x, a ≤ q_y ≤ b. There Student's t distribution with four degrees of freedom replaces the Gaussian, as its
    distribution function F is faster to evaluate and to invert:

        F(y) = t − t³/3,    t = y/√(τ² + y²),    t = 2 sin(arcsin(3F/2)/3)

    With s = ω_i,∥ the limits are

        |q_x + s_x/λ| ≤ √(1/λ² − s_⊥²),             s_⊥ = max(|s_y/λ| − 4σ_q, 0)
        |q_y + s_y/λ| ≤ √(1/λ² − (q_x + s_x/λ)²),   |q_y| ≤ 4σ_q
    """

    def __init__(self, spectrum: GratingSpectrum, typical_max_kappa: float | None = None) -> None:
        self.along_x = spectrum.grid.shape[0] == 1
        axis = BinAxis.of(spectrum, 0 if self.along_x else 1, MAX_LINE_BIN_WIDTH)
        self.kappa_bins = KappaBins(spectrum.max_kappa, typical_max_kappa)
        self.max_index, self.count = axis.max_index, len(axis.integrals)
        powers = mean_powers(spectrum, self.kappa_bins, UNIFORM_LINE_FRACTION).reshape(KAPPA_BINS, -1)
        self.probabilities = ProbabilityTable(np.maximum(axis.integrals @ powers.T, 0))
        # Cumulative sums of A_j.
        self.cumulative = PacketTable(cumulative_sums(np.float64(self.probabilities.values)))
        self.spacing, self.per_q = opaque(axis.spacing), opaque(1 / axis.spacing)
        self.half_width = opaque(LOBE_CUTOFF * spectrum.lobe_width)
        self.limit = _cumulative(LOBE_CUTOFF / STUDENT_SCALE)
        per_scale = 1 / (STUDENT_SCALE * spectrum.lobe_width)
        self.per_scale, self.per_area = opaque(per_scale), opaque(per_scale / axis.spacing)

    def density(self, q: mi.Vector2f, incidence: Incidence, active: mi.Bool) -> mi.Float:
        """Return p(q) in µm² of a propagating q in cycles/µm, for one wavelength."""
        along, across = self._axes(q.x, q.y)
        m = mi.Int32(dr.round(along * self.per_q))
        active = active & (dr.abs(m) <= self.max_index) & (dr.abs(across) <= self.half_width)
        index = mi.UInt32(m + self.max_index)
        weights = self.kappa_bins.weights(incidence)
        first, end = self._interval(incidence)
        total = dr.dot(weights, self._masses(first, end, active))
        low, high = self._limits_across(along, incidence)
        # F′ = τ⁴/(τ² + y²)^(5/2)
        root = dr.rsqrt(1 + dr.square(across * self.per_scale))
        lobe = self.per_area * root * dr.square(dr.square(root))
        total = larger(total, 1e-20) * larger(high - low, 1e-6)
        return dr.dot(weights, self.probabilities(index, active)) * lobe * dr.rcp(total)

    def sample(self, incidence: Incidence, u: mi.Float, v: mi.Point2f, active: mi.Bool) -> mi.Point2f:
        """Draw q in cycles/µm, for one wavelength.

        `u` chooses the κ bin, `v.x` the position along the row of orders, `v.y` that across.
        """
        first, end = self._interval(incidence)
        kappa_bin, _ = choose(self.kappa_bins.weights(incidence) * self._masses(first, end, active), u)

        def cumulative(index: mi.Int32) -> mi.Float:
            return self.cumulative.component(mi.UInt32(index), kappa_bin, active)

        index, position = search(cumulative, first, end, self.count, v.x)
        along = (mi.Float(index - self.max_index) + position - 0.5) * self.spacing
        low, high = self._limits_across(along, incidence)
        t = 2 * dr.sin(dr.asin(1.5 * dr.fma(v.y, high - low, low)) / 3)
        return mi.Point2f(*self._axes(along, t * dr.rsqrt(1 - dr.square(t)) / self.per_scale))

    def _axes(self, x: mi.Float, y: mi.Float) -> tuple[mi.Float, mi.Float]:
        """Return the components along and across the row of orders from x and y, or the reverse."""
        return (x, y) if self.along_x else (y, x)

    def _interval(self, incidence: Incidence) -> tuple[mi.Int32, mi.Int32]:
        """Return the first and the end of the bins that contain propagating q."""
        frequency = incidence.frequency
        along, across = (s * frequency for s in self._axes(*incidence.tangent))
        half = dr.safe_sqrt(dr.square(incidence.radius) - dr.square(larger(dr.abs(across) - self.half_width, 0)))
        first = mi.Int32(dr.floor(dr.fma(-along - half, self.per_q, 0.5)))
        end = mi.Int32(dr.ceil(dr.fma(half - along, self.per_q, 0.5)))
        # m = 0 always propagates.
        return dr.clip(first, -self.max_index, 0) + self.max_index, dr.clip(end, 1, self.max_index + 1) + self.max_index

    def _masses(self, first: mi.Int32, end: mi.Int32, active: mi.Bool) -> mi.Vector4f:
        """Return M_j."""
        return self.cumulative(mi.UInt32(end), active) - self.cumulative(mi.UInt32(first), active)

    def _limits_across(self, along: mi.Float, incidence: Incidence) -> tuple[mi.Float, mi.Float]:
        """Return F(a) and F(b)."""
        frequency = incidence.frequency
        s_along, s_across = (s * frequency for s in self._axes(*incidence.tangent))
        half = dr.safe_sqrt(dr.square(incidence.radius) - dr.square(along + s_along))
        low, high = (_cumulative((end - s_across) * self.per_scale) for end in (-half, half))
        return limited(low, -self.limit, self.limit), limited(high, -self.limit, self.limit)


def _cumulative(x: mi.Float) -> mi.Float:
    """Return F(τx)."""
    t = x * dr.rsqrt(1 + dr.square(x))
    return t - dr.square(t) * t / 3
