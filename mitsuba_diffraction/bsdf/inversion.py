"""What samplers share: a mixture of a few cells of κ, and inversion of cumulative sums.

The best choice of a frequency q would follow S(q; κ), but κ = k (cos θ_i + cos θ_o) is known only when q is. The κ of
all directions lie in k cos θ_i ≤ κ ≤ k (1 + cos θ_i); weighting cos θ_o by 2 cos θ_o, as a diffuse surface would, gives
the cell κ_j ≤ κ ≤ κ_{j+1} the weight

    w_j = e_{j+1}² − e_j²,    e_j = clip(κ_j/k − cos θ_i, 0, 1),    Σ_j w_j = 1

The averages of a few wide cells serve: where S changes fast with κ, the mixture must cover its range, not follow it.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..grating_spectrum import GratingSpectrum
from .geometry import Incidence
from .tables import BELOW_ONE, NumberTable, larger, limited, opaque

CELLS = 4  # one packet


class KappaCells:
    """Cells of 0 ≤ κ ≤ `max_kappa` (rad/µm); the last one takes what lies beyond, too.

    They are equal, or three equal ones up to `most` and one beyond, where most light has less than `most`.
    """

    def __init__(self, max_kappa: float, most: float | None = None) -> None:
        if most is None:
            ends = np.linspace(0, max_kappa, CELLS + 1)
        else:
            ends = np.append(np.linspace(0, min(most, 0.75 * max_kappa), CELLS), max_kappa)
        self.ends = ends
        self.inner = [opaque(end) for end in ends[1:-1]]

    def weights(self, incidence: Incidence) -> mi.Vector4f:
        """Return w_j for one wavelength."""
        below = [0.0, *map(incidence.below, self.inner), 1.0]
        return mi.Vector4f(*(below[cell + 1] - below[cell] for cell in range(CELLS)))


def averages(spectrum: GratingSpectrum, cells: KappaCells, floor: float = 0.0) -> NDArray[np.float64]:
    """Return A_jm, (CELLS, rows, columns): the mean of the powers over each cell, scaled to the sum one.

    Of each, all orders have the share `floor` alike, for those that are strong at some κ only.
    """
    means = np.stack([_average(spectrum, *ends) for ends in itertools.pairwise(cells.ends)])
    return (1 - floor) * means + floor / means[0].size


def _average(spectrum: GratingSpectrum, first: float, end: float) -> NDArray[np.float64]:
    # The powers oscillate in κ with the angular frequency of the height range at most.
    points = int(np.ceil((end - first) * spectrum.height_range)) + 2
    nodes = first + (np.arange(points) + 0.5) / points * (end - first)
    total = sum(spectrum.powers(kappa).astype(np.float64) for kappa in nodes)
    return total / total.sum()


def choose(shares: mi.Vector4f, u: mi.Float) -> tuple[mi.UInt32, mi.Float]:
    """Choose a cell with probability proportional to its share.

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


def search(
    before: Callable[[mi.Int32], mi.Float], first: mi.Int32, end: mi.Int32, count: int, u: mi.Float
) -> tuple[mi.Int32, mi.Float]:
    """Find the index i with F(i) ≤ F(first) + u (F(end) − F(first)) < F(i + 1), first ≤ i < end.

    Args:
        before: F, which does not fall.
        first: where the search begins.
        end: where it ends.
        count: end − first at most.
        u: in [0, 1).

    Returns:
        i, and the place between F(i) and F(i + 1), in [0, 1).
    """
    low, high = before(first), before(end)
    target = _between(low, high, u)
    index, low, high = _locate(before, first, end, count, target, low, high)
    return index, _place(target, low, high)


class SumTable:
    """F for lines of n numbers, and for each κ cell.

    A search takes two steps, in every sixteenth sum and in those between. Either are sixteen floats, one line of the
    cache: what a search costs is the lines that it reads.
    """

    GROUP = 16

    def __init__(self, sums: NDArray[np.float32]) -> None:
        """Take F (..., n + 1, κ cells)."""
        lines = sums.swapaxes(-1, -2)
        self.count = lines.shape[-1] - 1
        self.groups = 1
        if self.count > self.GROUP:
            lines = _in_groups(lines, self.GROUP)
            self.groups = lines.shape[-1] // self.GROUP
            coarse = _in_groups(lines[..., :: self.GROUP], self.GROUP)
            self.coarse_stride, self.coarse = coarse.shape[-1], NumberTable(coarse)
        self.stride, self.fine = lines.shape[-1], NumberTable(lines)

    def before(self, line: mi.UInt32, kappa_cell: mi.UInt32, i: mi.Int32, active: mi.Bool) -> mi.Float:
        """Return F(i), 0 ≤ i ≤ n."""
        return self.fine((line * CELLS + kappa_cell) * self.stride + mi.UInt32(i), active)

    def search(
        self, line: mi.UInt32, kappa_cell: mi.UInt32, low: mi.Float, high: mi.Float, u: mi.Float, active: mi.Bool
    ) -> tuple[mi.Int32, mi.Float]:
        """Return the index i with F(i) ≤ low + u (high − low) < F(i + 1), and the place between, as `search` has them.

        Args:
            line: which of the lines.
            kappa_cell: which κ cell.
            low: one of the F.
            high: a later one of them.
            u: in [0, 1).
            active: mask.
        """
        line = line * CELLS + kappa_cell

        def fine(i: mi.Int32) -> mi.Float:
            return self.fine(line * self.stride + mi.UInt32(i), active)

        def coarse(i: mi.Int32) -> mi.Float:
            return self.coarse(line * self.coarse_stride + mi.UInt32(i), active)

        target = _between(low, high, u)
        first, low = mi.Int32(0), mi.Float(0.0)
        if self.groups > 1:
            group, low, high = _locate(coarse, first, mi.Int32(self.groups - 1), self.groups, target, low, high)
            first = self.GROUP * group
        size = min(self.GROUP, self.count)
        index, low, high = _locate(fine, first, first + size, size, target, low, high)
        # Where nothing is drawn, in a masked lane, all are zero.
        return dr.minimum(index, self.count - 1), _place(target, low, high)


def truncated_gaussian(u: mi.Float, inside: mi.Float, spread: mi.Float) -> mi.Float:
    """Return √2 σ erf⁻¹(I (2u − 1)), a Gaussian truncated alike on both sides, as lobes are.

    Args:
        u: in [0, 1).
        inside: I, the share of the Gaussian that is left.
        spread: √2 σ.
    """
    return spread * dr.erfinv(inside * (2 * u - 1))


def sums_before(shares: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return (..., n, κ cells) → (..., n + 1, κ cells): the sums of those before each, as they are read."""
    result = np.zeros((*shares.shape[:-2], shares.shape[-2] + 1, shares.shape[-1]), np.float32)
    result[..., 1:, :] = shares.cumsum(axis=-2)
    return result


def _in_groups(lines: NDArray[np.float32], group: int) -> NDArray[np.float32]:
    """Return (..., n) → (..., whole groups), continued with the last number of each line."""
    pad = [(0, 0)] * (lines.ndim - 1) + [(0, -lines.shape[-1] % group)]
    return np.pad(lines, pad, mode="edge")


def _between(low: mi.Float, high: mi.Float, u: mi.Float) -> mi.Float:
    """Return low + u (high − low), less than high."""
    target = dr.fma(u, high - low, low)
    # The sum may round up to the end.
    return dr.select(target < high, target, low)


def _locate(
    before: Callable[[mi.Int32], mi.Float],
    first: mi.Int32,
    end: mi.Int32,
    count: int,
    target: mi.Float,
    low: mi.Float,
    high: mi.Float,
) -> tuple[mi.Int32, mi.Float, mi.Float]:
    """Return the index i with F(i) ≤ `target` < F(i + 1), F(i), F(i + 1).

    `low` is F(first) and `high` what F(i + 1) is if it was not met on the way.
    """
    index = first
    for bit in reversed(range((count - 1).bit_length())):
        trial = dr.minimum(index + (1 << bit), end)
        value = before(trial)
        further = value <= target
        index = dr.select(further, trial, index)
        low, high = dr.select(further, value, low), dr.select(further, high, value)
    return index, low, high


def _place(target: mi.Float, low: mi.Float, high: mi.Float) -> mi.Float:
    return limited((target - low) / larger(high - low, 1e-30), 0, BELOW_ONE)
