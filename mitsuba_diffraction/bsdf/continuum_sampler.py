"""Draws q from a density that is constant on the cells of a grid: for smooth spectra and for orders that overlap.

Light that comes in from s = ω_i,t and leaves at the frequency q propagates if |λq + s| ≤ 1: q lies in a disc that holds
q = 0 and grows with 1/λ about it. So the union of the discs of a bin is that of the largest 1/λ and, as discs are
larger than bins, of the s on the border of the bin.
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
from .inversion import CELLS, KappaCells, SumTable, averages, choose, search, sums_before
from .tables import NumberTable, PacketTable, ShareTable, larger, limited, opaque

MAX_SPACING = 0.06  # of cells, in cycles/µm, to follow the horizon
CUTOFF = 4.0  # of the lobes of orders, in σ_q


@dataclass(frozen=True, eq=False)
class CellAxis:
    """The cells along one axis.

    Attributes:
        spacing: Δ in cycles/µm, a whole part of the spacing of the nodes.
        max_cell: M, |m| ≤ M.
        shares: (2 M + 1, nodes), the integral of the lobe or spline of each node over each cell.
    """

    spacing: float
    max_cell: int
    shares: NDArray[np.float64]

    @classmethod
    def of(cls, spectrum: GratingSpectrum, axis: int, widest: float) -> CellAxis:
        """Make the cells along x (0) or y (1), no wider than so many σ_q."""
        grid, sigma = spectrum.grid, spectrum.lobe_width
        nodes = grid.frequencies()[axis]
        if isinstance(grid, OrderGrid):
            between, side = 1 / grid.tile_size[axis], min(spectrum.lobes[axis].half_width, CUTOFF * sigma)
        else:
            between, side = grid.spacing[axis], 1.5 * grid.spacing[axis]
        spacing = between / np.ceil(between / min(widest * sigma, MAX_SPACING))
        max_cell = int(np.ceil((nodes[-1] + side) / spacing - 0.5))
        ends = (np.arange(-max_cell, max_cell + 2) - 0.5) * spacing
        if isinstance(grid, OrderGrid):
            below = ndtr((ends[:, None] - nodes) / sigma)
        else:
            below = spline_integral((ends[:, None] - nodes) / between)
        return cls(spacing, max_cell, np.diff(below, axis=0))


_STEP = 0.02  # between the s that stand for a border
_BEYOND = 1e-4  # for rounding at run time


@dataclass(frozen=True)
class _Resolution:
    """How many bins there are.

    They are equal in cos θ_i, so that they are finest where the horizon is near the mirror direction; in azimuth, which
    moves the horizon along itself there; and in 1/λ.
    """

    cosines: int
    azimuths: int
    frequencies: int


COARSE, FINE = _Resolution(8, 32, 4), _Resolution(32, 64, 4)
FEW = 48  # rows: regions of no more take little memory, so that there can be many


class HorizonBins:
    """The bins, and the region of each."""

    def __init__(self, wavelengths: tuple[float, float], rows: int, farthest: float = 1.0) -> None:
        """Take (shortest, longest) in nm, the number of rows of a region and the largest |s|."""
        self._farthest = farthest
        self.resolution = FINE if rows <= FEW else COARSE
        self._first, self._last = 1e3 / wavelengths[1], 1e3 / wavelengths[0]
        self.first = opaque(self._first)
        self.per_frequency = opaque(self.resolution.frequencies / (self._last - self._first))

    def bin(self, incidence: Incidence) -> mi.UInt32:
        """Return the bin of one wavelength and where it comes from; beyond the ends, the nearest."""
        tangent, bins = incidence.tangent, self.resolution
        cosine, _ = cell_of(incidence.cosine * bins.cosines, bins.cosines)
        turn, _ = cell_of((azimuth(tangent.x, tangent.y) + 2) * (bins.azimuths / 4), bins.azimuths)
        frequency, _ = cell_of((incidence.radius - self.first) * self.per_frequency, bins.frequencies)
        return (frequency * bins.cosines + cosine) * bins.azimuths + turn

    def columns(self, low: NDArray[np.float64], high: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the interval of q_x that propagates for some q_y of a row, low ≤ q_y ≤ high (rows,), all in cycles/µm.

        Returns:
            (bins, rows, 2), the first and last q_x; where there are none, the first is larger.
        """
        bins = self.resolution
        frequency = np.linspace(self._first, self._last, bins.frequencies + 1)[1:, None]
        frequency, low, high = (np.asarray(x, np.float32) for x in (frequency, low, high))
        result = np.empty((bins.frequencies, bins.cosines, bins.azimuths, len(low), 2))
        # The border is represented by points: each disc is enlarged to cover those up to half a step away.
        square = (1 + _STEP / 2 + _BEYOND) ** 2
        for cosine, azimuth in np.ndindex(bins.cosines, bins.azimuths):
            s_x, s_y = (self._farthest * s[:, None, None].astype(np.float32) for s in _border(bins, cosine, azimuth))
            y = np.clip(0, low / frequency + s_y, high / frequency + s_y)
            half = np.where(y**2 < square, np.sqrt(np.maximum(square - y**2, 0)), -np.inf)
            result[:, cosine, azimuth, :, 0] = frequency * (-s_x - half).min(axis=0)
            result[:, cosine, azimuth, :, 1] = frequency * (half - s_x).max(axis=0)
        return result.reshape(-1, len(low), 2)


def azimuth(x: mi.Float, y: mi.Float) -> mi.Float:
    """Return −2 to 2, instead of −π to π: the place on a square |x| + |y| = 1, which needs no arc tangent."""
    along = x / larger(dr.abs(x) + dr.abs(y), 1e-12)
    return dr.select(y >= 0, 1 - along, along - 1)


def of_azimuth(place: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the angle whose `azimuth` it is."""
    along = 1 - np.abs(place)
    return np.arctan2(np.sign(place) * (1 - np.abs(along)), along)


def _border(bins: _Resolution, cosine: int, azimuth: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return s_x and s_y (n,) of the border of a bin, at most `_STEP` apart."""
    radius = np.sqrt(1 - (np.array([cosine + 1, cosine]) / bins.cosines) ** 2)
    # No arc is longer than twice its part of the square.
    ends = (azimuth + np.linspace(0, 1, int(np.ceil(8 / bins.azimuths / _STEP)) + 1)) / (bins.azimuths / 4) - 2
    angle = of_azimuth(ends)
    sides = np.linspace(*radius, int(np.ceil((radius[1] - radius[0]) / _STEP)) + 1)
    r = np.concatenate([np.repeat(radius, len(angle)), sides, sides])
    a = np.concatenate([angle, angle, np.repeat(angle[[0, -1]], len(sides))])
    return r * np.cos(a), r * np.sin(a)


MAX_WIDTH = 2.0  # of cells, in σ_q
BLOCK = 0.05  # cycles/µm: cells are taken together in blocks of about this width


class CellSampler:
    """The density p(q) = P_m/(Δ_x Δ_y) on the cell m, |q_x − m_x Δ_x| ≤ Δ_x/2 and |q_y − m_y Δ_y| ≤ Δ_y/2.

    P_m = Σ_j w_j A_jm / Σ_j w_j M_j, a mixture over κ (`KappaCells`), restricted to a region that holds all that
    propagates (`horizon`); M_j is the sum of A_jm over it. A region is made of blocks of cells, an interval of them in
    each row. A cell is drawn by binary searches: the row of blocks, the block, the cell in it. The density at a given q
    reads one word for the cell and one packet for M_j.
    """

    def __init__(self, spectrum: GratingSpectrum, most: float | None = None, farthest: float = 1.0) -> None:
        self.cells = KappaCells(spectrum.max_kappa, most)
        along_x, along_y = (CellAxis.of(spectrum, axis, MAX_WIDTH) for axis in (0, 1))
        shares = np.moveaxis(along_y.shares @ averages(spectrum, self.cells) @ along_x.shares.T, 0, -1)
        # Coefficients of splines may be below zero.
        shares = np.maximum(shares, 0)
        spacing, max_cell = (along_x.spacing, along_y.spacing), (along_x.max_cell, along_y.max_cell)
        self.spacing_x, self.spacing_y = (opaque(s) for s in spacing)
        self.per_q_x, self.per_q_y = (opaque(1 / s) for s in spacing)
        self.edge_x, self.edge_y = (
            int(np.clip(round(BLOCK / s), 1, count)) for s, count in zip(spacing, shares.shape[1::-1], strict=True)
        )
        pad = ((0, -shares.shape[0] % self.edge_y), (0, -shares.shape[1] % self.edge_x), (0, 0))
        self.shares = ShareTable(np.pad(shares, pad))
        shares = np.float64(self.shares.values)
        self.rows, self.columns = shares.shape[:2]
        self.max_cell_x, self.max_cell_y = max_cell
        self.area = opaque(spacing[0] * spacing[1])
        blocks = shares.reshape(self.rows // self.edge_y, self.edge_y, self.columns // self.edge_x, self.edge_x, CELLS)
        blocks = blocks.swapaxes(1, 2).reshape(*blocks.shape[:3:2], -1, CELLS)
        self.blocks_y, self.blocks_x, self.in_block, _ = blocks.shape
        before_x = sums_before(blocks.sum(axis=2))
        self.before_cell = SumTable(sums_before(blocks)) if self.in_block > 1 else None
        self.before_x = SumTable(before_x)

        self.horizon = HorizonBins(spectrum.wavelengths, self.blocks_y, farthest)
        edge = (np.arange(self.blocks_y + 1) * self.edge_y - max_cell[1] - 0.5) * spacing[1]
        ends = self.horizon.columns(edge[:-1], edge[1:])
        ends = ends / (spacing[0] * self.edge_x) + (max_cell[0] + 0.5) / self.edge_x
        first = np.clip(np.floor(ends[..., 0]), 0, self.blocks_x).astype(np.int64)
        end = np.maximum(np.clip(np.ceil(ends[..., 1]), 0, self.blocks_x).astype(np.int64), first)
        row = np.arange(self.blocks_y)
        # As they are read: differences of float32.
        before_y = sums_before(np.float64(before_x[row, end]) - before_x[row, first])
        self.before_y = SumTable(before_y)
        self.masses = PacketTable(before_y[:, -1])
        self.ends = NumberTable((first | end << 16).astype(np.uint32))

    def density(self, q: mi.Vector2f, incidence: Incidence, active: mi.Bool) -> mi.Float:
        """Return p(q) in µm², q in cycles/µm, for one wavelength; of a q that propagates."""
        m_x, m_y = mi.Int32(dr.round(q.x * self.per_q_x)), mi.Int32(dr.round(q.y * self.per_q_y))
        active = active & (dr.abs(m_x) <= self.max_cell_x) & (dr.abs(m_y) <= self.max_cell_y)
        cell = mi.UInt32((m_y + self.max_cell_y) * self.columns + m_x + self.max_cell_x)
        weights = self.cells.weights(incidence)
        total = self.area * dr.dot(weights, self.masses(self.horizon.bin(incidence), active))
        return dr.dot(self.shares(cell, active), weights) * dr.rcp(larger(total, 1e-20))

    def sample(self, incidence: Incidence, u: mi.Float, v: mi.Point2f, active: mi.Bool) -> mi.Point2f:
        """Draw q in cycles/µm, for one wavelength.

        κ cell, row of blocks and cell come from `u`, the block and q_x from `v.x`: one number alone has too few bits.
        """
        chosen_bin = self.horizon.bin(incidence)
        masses = self.masses(chosen_bin, active)
        kappa_cell, u = choose(self.cells.weights(incidence) * masses, u)

        none, mass = mi.Float(0.0), self.masses.entry(chosen_bin, kappa_cell, active)
        row, u = self.before_y.search(chosen_bin, kappa_cell, none, mass, u, active)
        line, cell = mi.UInt32(row), mi.Int32(0)
        ends = self.ends(chosen_bin * self.blocks_y + line)
        ends = mi.Int32(ends & 0xFFFF), mi.Int32(ends >> 16)
        low, high = (self.before_x.before(line, kappa_cell, end, active) for end in ends)
        column, x = self.before_x.search(line, kappa_cell, low, high, v.x, active)
        if self.before_cell is not None:
            block = mi.UInt32(row * self.blocks_x + column)
            mass = self.before_cell.before(block, kappa_cell, mi.Int32(self.in_block), active)
            cell, _ = self.before_cell.search(block, kappa_cell, none, mass, u, active)
        m_x = mi.Float(column * self.edge_x + cell % self.edge_x - self.max_cell_x)
        m_y = mi.Float(row * self.edge_y + cell // self.edge_x - self.max_cell_y)
        return mi.Point2f((m_x + x - 0.5) * self.spacing_x, (m_y + v.y - 0.5) * self.spacing_y)


UNIFORM_FRACTION = 0.05  # of each κ cell of a line grating, that all orders have alike
MAX_WIDTH_OF_LINES = 0.5  # of cells of a line grating, in σ_q
STUDENT_SCALE = 1.7  # τ in σ_q: ∫ N²/F′ dq is least, 1.04


class LineSampler:
    """The density of a q that propagates, here for orders along x:

        p(q) = P_m/Δ · F′(q_y)/(F(b) − F(a)),    |q_x − mΔ| ≤ Δ/2

    P_m = Σ_j w_j A_jm / Σ_j w_j M_j is a mixture over κ (`KappaCells`), restricted to the cells in which something
    propagates, over which M_j is the sum of A_jm. Across the orders, Student's distribution with four degrees of
    freedom stands for the Gaussian, which takes longer to restrict to what propagates at q_x, a ≤ q_y ≤ b:

        F(y) = t − t³/3,    t = y/√(τ² + y²),    t = 2 sin(arcsin(3F/2)/3)

    With s the direction of incidence, the limits are

        |q_x + s_x/λ| ≤ √(1/λ² − s_⊥²),             s_⊥ = max(|s_y/λ| − 4σ_q, 0)
        |q_y + s_y/λ| ≤ √(1/λ² − (q_x + s_x/λ)²),   |q_y| ≤ 4σ_q
    """

    def __init__(self, spectrum: GratingSpectrum, most: float | None = None) -> None:
        self.along_x = spectrum.grid.shape[0] == 1
        axis = CellAxis.of(spectrum, 0 if self.along_x else 1, MAX_WIDTH_OF_LINES)
        self.cells, self.max_cell, self.count = (
            KappaCells(spectrum.max_kappa, most),
            axis.max_cell,
            len(axis.shares),
        )
        shares = axis.shares @ averages(spectrum, self.cells, UNIFORM_FRACTION).reshape(CELLS, -1).T
        self.shares = ShareTable(np.maximum(shares, 0))
        # The sums of A_j over the cells before each.
        self.before = PacketTable(sums_before(np.float64(self.shares.values)))
        self.spacing, self.per_q = opaque(axis.spacing), opaque(1 / axis.spacing)
        self.half_width, self.limit = opaque(CUTOFF * spectrum.lobe_width), _cumulative(CUTOFF / STUDENT_SCALE)
        per_scale = 1 / (STUDENT_SCALE * spectrum.lobe_width)
        self.per_scale, self.per_area = opaque(per_scale), opaque(per_scale / axis.spacing)

    def density(self, q: mi.Vector2f, incidence: Incidence, active: mi.Bool) -> mi.Float:
        """Return p(q) in µm², q in cycles/µm, for one wavelength; of a q that propagates."""
        along, across = self._axes(q.x, q.y)
        m = mi.Int32(dr.round(along * self.per_q))
        active = active & (dr.abs(m) <= self.max_cell) & (dr.abs(across) <= self.half_width)
        cell = mi.UInt32(m + self.max_cell)
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
        along = (mi.Float(cell - self.max_cell) + place - 0.5) * self.spacing
        low, high = self._across(along, incidence)
        t = 2 * dr.sin(dr.asin(1.5 * dr.fma(v.y, high - low, low)) / 3)
        return mi.Point2f(*self._axes(along, t * dr.rsqrt(1 - dr.square(t)) / self.per_scale))

    def _axes(self, x: mi.Float, y: mi.Float) -> tuple[mi.Float, mi.Float]:
        """Along the orders and across from x and y, and the reverse."""
        return (x, y) if self.along_x else (y, x)

    def _interval(self, incidence: Incidence) -> tuple[mi.Int32, mi.Int32]:
        """Return the first cell in which something propagates, and the end of them."""
        frequency = incidence.frequency
        along, across = (s * frequency for s in self._axes(*incidence.tangent))
        half = dr.safe_sqrt(dr.square(incidence.radius) - dr.square(larger(dr.abs(across) - self.half_width, 0)))
        first = mi.Int32(dr.floor(dr.fma(-along - half, self.per_q, 0.5)))
        end = mi.Int32(dr.ceil(dr.fma(half - along, self.per_q, 0.5)))
        # The mirror direction m = 0 is always among them.
        return dr.clip(first, -self.max_cell, 0) + self.max_cell, dr.clip(end, 1, self.max_cell + 1) + self.max_cell

    def _masses(self, first: mi.Int32, end: mi.Int32, active: mi.Bool) -> mi.Vector4f:
        """Return M_j."""
        return self.before(mi.UInt32(end), active) - self.before(mi.UInt32(first), active)

    def _across(self, along: mi.Float, incidence: Incidence) -> tuple[mi.Float, mi.Float]:
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
