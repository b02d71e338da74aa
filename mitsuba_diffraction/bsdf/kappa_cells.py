"""The distribution over κ from which the BSDF is sampled: a mixture of a few wide cells.

The best choice of a frequency q would follow S(q; κ), but κ = k (cos θ_i + cos θ_o) is known only when q is. The κ of
all directions lie in k cos θ_i ≤ κ ≤ k (1 + cos θ_i); weighting cos θ_o by 2 cos θ_o, as a diffuse surface would, gives
the cell κ_j ≤ κ ≤ κ_{j+1} the weight

    w_j = e_{j+1}² − e_j²,    e_j = clip(κ_j/k − cos θ_i, 0, 1),    Σ_j w_j = 1

The averages of a few wide cells serve: where S changes fast with κ, the mixture must cover its range, not follow it.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..spectrum import GratingSpectrum
from .arithmetic import larger, limited
from .incidence import Incidence
from .tables import BELOW_ONE, opaque

CELLS = 4  # one packet


class KappaCells:
    """Equal cells of 0 ≤ κ ≤ `largest_kappa` (rad/µm); the last one takes what lies beyond, too."""

    def __init__(self, largest_kappa: float) -> None:
        self.width = opaque(largest_kappa / CELLS)

    def weights(self, incidence: Incidence) -> mi.Vector4f:
        """w_j for one wavelength."""
        first, step = incidence.least_kappa / incidence.kappa_span, self.width / incidence.kappa_span
        inner = [limited(dr.fma(cell, step, -first), 0, 1) for cell in range(1, CELLS)]
        squares = [0.0, *map(dr.square, inner), 1.0]
        return mi.Vector4f(*(squares[cell + 1] - squares[cell] for cell in range(CELLS)))


def averages(spectrum: GratingSpectrum, floor: float = 0.0) -> NDArray[np.float64]:
    """A_jm, (CELLS, rows, columns): the mean of the powers over each cell, scaled to the sum one.

    Of each, all orders have the share `floor` alike, for those that are strong at some κ only.
    """
    means = np.stack([_average(spectrum, cell) for cell in range(CELLS)])
    return (1 - floor) * means + floor / means[0].size


def _average(spectrum: GratingSpectrum, cell: int) -> NDArray[np.float64]:
    width = spectrum.largest_kappa / CELLS
    # The powers oscillate in κ with the angular frequency of the height range at most.
    points = int(np.ceil(width * spectrum.height_range)) + 2
    nodes = (cell + (np.arange(points) + 0.5) / points) * width
    total = sum(spectrum.powers(kappa).astype(np.float64) for kappa in nodes)
    return total / total.sum()


def choose(shares: mi.Vector4f, u: mi.Float) -> tuple[mi.UInt32, mi.Float]:
    """A cell with probability proportional to its share.

    Returns:
        Its index, and what is left of `u`: a number uniform in [0, 1).
    """
    ends = [shares[0]]
    for cell in range(1, CELLS):
        ends.append(ends[-1] + shares[cell])
    x = u * ends[-1]
    chosen, start, end = mi.UInt32(0), mi.Float(0.0), ends[0]
    for cell in range(1, CELLS):
        past = x >= ends[cell - 1]
        chosen = dr.select(past, mi.UInt32(cell), chosen)
        start, end = dr.select(past, ends[cell - 1], start), dr.select(past, ends[cell], end)
    # Where nothing is drawn, in a masked lane, all shares are zero.
    return chosen, limited((x - start) / larger(end - start, 1e-30), 0, BELOW_ONE)
