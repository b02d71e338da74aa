"""Draws q from a density that is constant on the cells of a grid: for smooth spectra and for orders that overlap."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from .incidence import Incidence
from .kappa_cells import KappaCells, choose, pick
from .tables import BELOW_ONE, PacketTable, opaque


class CellSampler:
    """The density p(q) = P_m/(Δ_x Δ_y) on the cell m, |q_x − m_x Δ_x| ≤ Δ_x/2 and |q_y − m_y Δ_y| ≤ Δ_y/2.

    P_m = Σ_j w_j A_jm, a mixture over κ (`kappa_cells`). A cell is drawn in O(1) by alias tables (Walker 1977); the
    density at a given q reads one packet of four floats.
    """

    def __init__(
        self, shares: NDArray[np.float64], spacing: tuple[float, float], largest: tuple[int, int], largest_kappa: float
    ) -> None:
        """Build the tables.

        Args:
            shares: A_jm, (κ cells, 2 M_y + 1, 2 M_x + 1), nonnegative; each κ cell is scaled to the sum one.
            spacing: (Δ_x, Δ_y) in cycles/µm.
            largest: (M_x, M_y), |m_x| ≤ M_x, |m_y| ≤ M_y.
            largest_kappa: where the κ cells end, rad/µm.
        """
        shares = shares / shares.sum(axis=(1, 2), keepdims=True)
        self.cells = KappaCells(largest_kappa)
        self.rows, self.columns = shares.shape[1:]
        self.largest_x, self.largest_y = largest
        self.spacing_x, self.spacing_y = (opaque(s) for s in spacing)
        flat = shares.reshape(len(shares), -1)
        self.densities = PacketTable(flat.T / (spacing[0] * spacing[1]))
        self.aliases = PacketTable(np.stack([np.stack(alias_table(share), -1) for share in flat]), width=2)

    def weights(self, incidence: Incidence) -> mi.Vector4f:
        """w_j for one wavelength."""
        return self.cells.weights(incidence)

    def density(self, q_x: mi.Float, q_y: mi.Float, weights: mi.Vector4f, active: mi.Bool) -> mi.Float:
        """p(q) in µm², q in cycles/µm."""
        m_x = mi.Int32(dr.floor(q_x / self.spacing_x + 0.5))
        m_y = mi.Int32(dr.floor(q_y / self.spacing_y + 0.5))
        active = active & (dr.abs(m_x) <= self.largest_x) & (dr.abs(m_y) <= self.largest_y)
        cell = (m_y + self.largest_y) * self.columns + m_x + self.largest_x
        return dr.dot(self.densities(mi.UInt32(dr.select(active, cell, 0)), active), weights)

    def sample(self, weights: mi.Vector4f, u: mi.Float, v: mi.Point2f, active: mi.Bool) -> tuple[mi.Float, mi.Float]:
        """Draw q in cycles/µm, for one wavelength.

        κ cell and row, column, and alias are drawn from different numbers: one alone has too few bits.
        """
        chosen, u = choose(weights, u)
        row, _ = pick(u, self.rows)
        column, x = pick(v.x, self.columns)
        cell = row * self.columns + column
        threshold, alias = self.aliases(chosen * (self.rows * self.columns) + cell, active)
        keep = v.y < threshold
        # What is left of v.y after the choice is uniform again.
        y = dr.select(keep, v.y, v.y - threshold) / dr.select(keep, threshold, 1 - threshold)
        cell = dr.select(keep, cell, mi.UInt32(alias))
        m_x = mi.Float(cell % self.columns) - self.largest_x
        m_y = mi.Float(cell // self.columns) - self.largest_y
        return (m_x + x - 0.5) * self.spacing_x, (m_y + dr.clip(y, 0, BELOW_ONE) - 0.5) * self.spacing_y


def alias_table(probabilities: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Thresholds and aliases for drawing index i with probability p_i: take i uniformly, keep it if u < threshold_i.

    Entries below the mean are filled up by those above, in order; the running sums of what is missing and of what is
    left over say who fills whom, so that no loop is needed.

    Args:
        probabilities: (n,), sum one.

    Returns:
        (n,) thresholds in [0, 1] and (n,) indices.
    """
    count = len(probabilities)
    scaled = np.asarray(probabilities, np.float64) * count
    threshold, alias = np.ones(count), np.arange(count)
    light, heavy = np.flatnonzero(scaled < 1), np.flatnonzero(scaled >= 1)
    if len(light) == 0:
        return threshold, alias
    missing, surplus = np.cumsum(1 - scaled[light]), np.cumsum(scaled[heavy] - 1)
    # A light entry is filled by the first heavy one that has something left when its turn comes.
    giver = np.minimum(np.searchsorted(surplus, np.concatenate([[0.0], missing[:-1]]), side="right"), len(heavy) - 1)
    threshold[light], alias[light] = scaled[light], heavy[giver]
    # A heavy entry that has given more than it had is filled by the next heavy one.
    last = np.searchsorted(missing, surplus[:-1], side="left")
    over = last < len(light)
    threshold[heavy[:-1][over]] = 1 - (missing[last[over]] - surplus[:-1][over])
    alias[heavy[:-1][over]] = heavy[1:][over]
    return np.clip(threshold, 0, 1), alias
