"""Draws q from a density that is constant on the cells of a grid: for smooth spectra and for orders that overlap."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..spectrum import GratingSpectrum
from .arithmetic import larger
from .cell_axis import CellAxis
from .horizon import HorizonBins
from .incidence import Incidence
from .inversion import SumTable, sums_before
from .kappa_cells import CELLS, KappaCells, averages, choose
from .tables import NumberTable, PacketTable, ShareTable, opaque

WIDEST = 2.0  # σ_q: cells are no wider
BLOCK = 0.05  # cycles/µm: cells are taken together in blocks of about this width


class CellSampler:
    """The density p(q) = P_m/(Δ_x Δ_y) on the cell m, |q_x − m_x Δ_x| ≤ Δ_x/2 and |q_y − m_y Δ_y| ≤ Δ_y/2.

    P_m = Σ_j w_j A_jm / Σ_j w_j M_j, a mixture over κ (`kappa_cells`), restricted to a region that holds all that
    propagates (`horizon`); M_j is the sum of A_jm over it. A region is made of blocks of cells, an interval of them in
    each row. A cell is drawn by binary searches: the row of blocks, the block, the cell in it. The density at a given q
    reads one word for the cell and one packet for M_j.
    """

    def __init__(self, spectrum: GratingSpectrum) -> None:
        along_x, along_y = (CellAxis.of(spectrum, axis, WIDEST) for axis in (0, 1))
        shares = np.moveaxis(along_y.shares @ averages(spectrum) @ along_x.shares.T, 0, -1)
        # Coefficients of splines may be below zero.
        shares = np.maximum(shares, 0)
        spacing, largest = (along_x.spacing, along_y.spacing), (along_x.largest, along_y.largest)
        self.cells = KappaCells(spectrum.largest_kappa)
        self.spacing_x, self.spacing_y = (opaque(s) for s in spacing)
        self.per_q_x, self.per_q_y = (opaque(1 / s) for s in spacing)
        self.edge_x, self.edge_y = (
            int(np.clip(round(BLOCK / s), 1, count)) for s, count in zip(spacing, shares.shape[1::-1], strict=True)
        )
        pad = ((0, -shares.shape[0] % self.edge_y), (0, -shares.shape[1] % self.edge_x), (0, 0))
        self.shares = ShareTable(np.pad(shares, pad))
        shares = np.float64(self.shares.values)
        self.rows, self.columns = shares.shape[:2]
        self.largest_x, self.largest_y = largest
        self.area = opaque(spacing[0] * spacing[1])
        blocks = shares.reshape(self.rows // self.edge_y, self.edge_y, self.columns // self.edge_x, self.edge_x, CELLS)
        blocks = blocks.swapaxes(1, 2).reshape(*blocks.shape[:3:2], -1, CELLS)
        self.blocks_y, self.blocks_x, self.in_block, _ = blocks.shape
        before_x = sums_before(blocks.sum(axis=2))
        self.before_cell = SumTable(sums_before(blocks)) if self.in_block > 1 else None
        self.before_x = SumTable(before_x)

        self.horizon = HorizonBins(spectrum.wavelengths, self.blocks_y)
        edge = (np.arange(self.blocks_y + 1) * self.edge_y - largest[1] - 0.5) * spacing[1]
        ends = self.horizon.columns(edge[:-1], edge[1:])
        ends = ends / (spacing[0] * self.edge_x) + (largest[0] + 0.5) / self.edge_x
        first = np.clip(np.floor(ends[..., 0]), 0, self.blocks_x).astype(np.int64)
        end = np.maximum(np.clip(np.ceil(ends[..., 1]), 0, self.blocks_x).astype(np.int64), first)
        row = np.arange(self.blocks_y)
        # As they are read: differences of float32.
        before_y = sums_before(np.float64(before_x[row, end]) - before_x[row, first])
        self.before_y = SumTable(before_y)
        self.masses = PacketTable(before_y[:, -1])
        self.ends = NumberTable(first | end << 16)

    def density(self, q_x: mi.Float, q_y: mi.Float, incidence: Incidence, active: mi.Bool) -> mi.Float:
        """p(q) in µm², q in cycles/µm, for one wavelength; of a q that propagates."""
        m_x, m_y = mi.Int32(dr.round(q_x * self.per_q_x)), mi.Int32(dr.round(q_y * self.per_q_y))
        active = active & (dr.abs(m_x) <= self.largest_x) & (dr.abs(m_y) <= self.largest_y)
        cell = mi.UInt32((m_y + self.largest_y) * self.columns + m_x + self.largest_x)
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
        m_x = mi.Float(column * self.edge_x + cell % self.edge_x - self.largest_x)
        m_y = mi.Float(row * self.edge_y + cell // self.edge_x - self.largest_y)
        return mi.Point2f((m_x + x - 0.5) * self.spacing_x, (m_y + v.y - 0.5) * self.spacing_y)
