"""Which order a ray takes: the distribution over orders from which the BSDF is sampled.

The best choice for the order m would be its own power η_m(κ_m), but κ_m = k (cos θ_i + cos θ_m) is known only when the
order is. The κ of all directions lie in k cos θ_i ≤ κ ≤ k (1 + cos θ_i); weighting cos θ_o by 2 cos θ_o, as a diffuse
surface would, gives the mixture

    P_m = Σ_j w_j A_jm,    A_jm ∝ mean of η_m over the cell κ_j ≤ κ ≤ κ_{j+1},  Σ_m A_jm = 1
    w_j = e_{j+1}² − e_j²,    e_j = clip(κ_j/k − cos θ_i, 0, 1)

The averages of a few wide cells serve: where η_m changes fast with κ, P_m must cover its range, not follow it.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..spectrum import GratingSpectrum
from .tables import BELOW_ONE, PacketTable, opaque

CELLS = 4  # one packet


class OrderSampler:
    """Draws orders in O(1) by alias tables (Walker 1977); P_m of a given order reads one packet of four floats."""

    def __init__(self, spectrum: GratingSpectrum) -> None:
        self.cell_width = opaque(spectrum.largest_kappa / CELLS)
        self.rows, self.columns = spectrum.grid.shape
        averages = np.stack([_average(spectrum, cell).ravel() for cell in range(CELLS)])
        self.shares = PacketTable(averages.T)
        self.aliases = _PairTable(np.stack([np.stack(alias_table(average), -1) for average in averages]))

    def weights(self, cos_i: mi.Float, kappa_per_cosine: mi.Float) -> mi.Vector4f:
        """w_j for one wavelength; `kappa_per_cosine` is k in rad/µm, times the scale of the heights."""
        edges = [
            dr.clip(cell * self.cell_width / kappa_per_cosine - cos_i, 0, 1) if cell else 0.0 for cell in range(CELLS)
        ]
        edges.append(1.0)  # the last cell takes what lies beyond the table
        return mi.Vector4f(*(dr.square(edges[j + 1]) - dr.square(edges[j]) for j in range(CELLS)))

    def share(self, order: mi.UInt32, weights: mi.Vector4f, active: mi.Bool) -> mi.Float:
        """P_m of the order with flat index `order`."""
        return dr.dot(self.shares(order, active), weights)

    def sample(
        self, cos_i: mi.Float, kappa_per_cosine: mi.Float, u: mi.Float, v: mi.Point2f, active: mi.Bool
    ) -> tuple[mi.UInt32, mi.Point2f]:
        """Draw an order for one wavelength.

        Row, column and alias are drawn from different numbers: one alone has too few bits for a large table.

        Returns:
            Its flat index, and what is left of `v`: two numbers uniform in [0, 1).
        """
        row, u = _pick(u, self.rows)
        column, x = _pick(v.x, self.columns)
        kappa = kappa_per_cosine * (cos_i + dr.sqrt(u))
        cell = dr.minimum(mi.UInt32(kappa / self.cell_width), CELLS - 1)
        order = row * self.columns + column
        threshold, alias = self.aliases(cell * (self.rows * self.columns) + order, active)
        keep = v.y < threshold
        y = dr.select(keep, v.y, v.y - threshold) / dr.select(keep, threshold, 1 - threshold)
        return dr.select(keep, order, mi.UInt32(alias)), mi.Point2f(x, dr.clip(y, 0, BELOW_ONE))


def _pick(u: mi.Float, count: int) -> tuple[mi.UInt32, mi.Float]:
    """One of `count` equal parts, and the place in it."""
    x = u * count
    part = dr.minimum(mi.UInt32(x), count - 1)
    return part, dr.minimum(x - mi.Float(part), BELOW_ONE)


def _average(spectrum: GratingSpectrum, cell: int) -> NDArray[np.float64]:
    """A_jm of one cell, (rows, columns): the mean of η_m over the cell, scaled to the sum one."""
    width = spectrum.largest_kappa / CELLS
    # η_m oscillates in κ with the angular frequency of the height range at most.
    points = int(np.ceil(width * spectrum.height_range)) + 2
    nodes = (cell + (np.arange(points) + 0.5) / points) * width
    total = sum(spectrum.powers(kappa).astype(np.float64) for kappa in nodes)
    return total / total.sum()


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
    last = np.searchsorted(missing, surplus[:-1], side="right")
    over = last < len(light)
    threshold[heavy[:-1][over]] = 1 - (missing[last[over]] - surplus[:-1][over])
    alias[heavy[:-1][over]] = heavy[1:][over]
    return np.clip(threshold, 0, 1), alias


class _PairTable:
    """A flat table of (threshold, alias); the alias is an integer below 2²⁴, which a float holds exactly."""

    def __init__(self, pairs: NDArray[np.float64]) -> None:
        flat = np.ascontiguousarray(pairs, np.float32).ravel()
        self.values = mi.Float(flat) if dr.is_jit_v(mi.Float) else flat

    def __call__(self, index: mi.UInt32, active: mi.Bool) -> mi.Vector2f:
        if dr.is_jit_v(mi.Float):
            return dr.gather(mi.Vector2f, self.values, index, active)
        return mi.Vector2f(*map(float, self.values[2 * index : 2 * index + 2])) if active else mi.Vector2f(0.0)
