"""Common parts of the samplers: a mixture over a few bins of κ, bins of directions, inversion of cumulative sums.

The optimal density of q is proportional to S(q; κ), but κ = 2π (cos θ_i + cos θ_o)/λ is known only once q is. For all
outgoing directions cos θ_i ≤ κλ/2π ≤ 1 + cos θ_i. If cos θ_o has the density 2 cos θ_o, as for a diffuse surface, the
bin κ_j ≤ κ ≤ κ_{j+1} has the weight

    w_j = e_{j+1}² − e_j²,    e_j = clip(κ_j λ/2π − cos θ_i, 0, 1),    Σ_j w_j = 1

A few wide bins suffice: where S varies fast with κ, the mixture must cover the range of S, not follow it.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..energy.table import Layout
from ..precomputation.grating_spectrum import GratingSpectrum
from .device_tables import BELOW_ONE, NumberTable, integer_part, larger, limited, opaque, smaller
from .directions import Incidence, cell_of, on_square

KAPPA_BINS = 4  # the components of a packet


class KappaBins:
    """Bins of 0 ≤ κ ≤ `max_kappa` (rad/µm); the last one includes larger κ.

    The bins are equally wide. With `typical_max_kappa`, below which κ of nearly all light lies, three equally wide ones
    end there.
    """

    def __init__(self, max_kappa: float, typical_max_kappa: float | None = None) -> None:
        if typical_max_kappa is None:
            ends = np.linspace(0, max_kappa, KAPPA_BINS + 1)
        else:
            ends = np.append(np.linspace(0, min(typical_max_kappa, 0.75 * max_kappa), KAPPA_BINS), max_kappa)
        self.ends = ends
        self.inner = [opaque(end) for end in ends[1:-1]]

    def weights(self, incidence: Incidence) -> mi.Vector4f:
        """Return w_j for one wavelength."""
        fractions = [0.0, *map(incidence.fraction_below, self.inner), 1.0]
        return mi.Vector4f(*(fractions[bin_ + 1] - fractions[bin_] for bin_ in range(KAPPA_BINS)))


def mean_powers(spectrum: GratingSpectrum, kappa_bins: KappaBins) -> NDArray[np.float64]:
    """Return the powers averaged over each bin of κ and normalised to the sum one: (KAPPA_BINS, rows, columns)."""
    means = []
    for first, end in itertools.pairwise(kappa_bins.ends):
        # As a function of κ the powers have angular frequencies up to the height range.
        points = int(np.ceil((end - first) * spectrum.height_range)) + 2
        nodes = first + (np.arange(points) + 0.5) / points * (end - first)
        total = functools.reduce(np.add, (spectrum.powers(kappa).astype(np.float64) for kappa in nodes))
        means.append(total / total.sum())
    return np.stack(means)


def choose_bin(weights: mi.Vector4f, u: mi.Float) -> tuple[mi.UInt32, mi.Float]:
    """Choose a bin with probability proportional to its weight.

    Returns:
        Its index, and `u` rescaled to a number uniform in [0, 1).
    """
    ends = [weights[0]]
    for bin_ in range(1, KAPPA_BINS):
        ends.append(ends[-1] + weights[bin_])
    x = u * ends[-1]
    chosen, start, end = mi.UInt32(0), mi.Float(0.0), ends[0]
    for bin_ in range(1, KAPPA_BINS):
        past = x >= ends[bin_ - 1]
        chosen = dr.select(past, mi.UInt32(bin_), chosen)
        start, end = dr.select(past, ends[bin_ - 1], start), dr.select(past, ends[bin_], end)
    # In a masked lane all weights are zero.
    return chosen, limited((x - start) / larger(end - start, 1e-30), 0, BELOW_ONE)


def direction_bin(omega: mi.Vector3f, side: mi.Float | int) -> list[mi.UInt32]:
    """Return the column and row of ω in bins on the square of `energy/table.py`, `side` along each side."""
    return [cell_of(side * coordinate, side)[0] for coordinate in on_square(omega)]


def direction_borders(side: int, steps: int) -> NDArray[np.float64]:
    """Return ω_∥ of points on the borders of these bins, each of its sides divided in `steps`: (bins, points, 2)."""
    along = np.linspace(0, 1, steps + 1)
    points = [point for t in along for point in ((0, 0, t), (0, 1, t), (0, t, 0), (0, t, 1))]
    corners = np.indices((1, side, side)).reshape(3, -1).T
    omega, _ = Layout(0.0, 1, side, 1, 2, (1.0, 2.0)).directions((corners[:, None] + points).reshape(-1, 3))
    return omega[:, :2].reshape(len(corners), -1, 2)


def search(
    cumulative: Callable[[mi.Int32], mi.Float], first: mi.Int32, end: mi.Int32, count: int, u: mi.Float
) -> tuple[mi.Int32, mi.Float]:
    """Find the index i with F(i) ≤ F(first) + u (F(end) − F(first)) < F(i + 1), first ≤ i < end.

    Args:
        cumulative: F, which does not decrease.
        first, end: the range of the search.
        count: upper bound of end − first.
        u: in [0, 1).

    Returns:
        i, and the position of the number between F(i) and F(i + 1), in [0, 1).
    """
    index, low, high = first, cumulative(first), cumulative(end)
    target = dr.fma(u, high - low, low)
    # Rounding may give `high`.
    target = dr.select(target < high, target, low)
    for bit in reversed(range((count - 1).bit_length())):
        trial = dr.minimum(index + (1 << bit), end)
        value = cumulative(trial)
        is_past = value <= target
        index = dr.select(is_past, trial, index)
        low, high = dr.select(is_past, value, low), dr.select(is_past, high, value)
    return index, limited((target - low) / larger(high - low, 1e-30), 0, BELOW_ONE)


class AliasTable:
    """Draws from discrete distributions in constant time (Walker 1977).

    With n p_i the probabilities times their number, each i has the number t_i ≤ 1 and an alias a_i, so that

        n p_i = t_i + Σ_j [a_j = i] (1 − t_j)

    i is drawn uniformly; it is replaced by a_i with the probability 1 − t_i. Both are packed into a word of 32 bits, in
    which a_i leaves 20 bits or more for t_i if n ≤ 4096.
    """

    def __init__(self, weights: NDArray[np.float64]) -> None:
        """Make the tables of all distributions, (..., n); one whose weights are all zero becomes uniform."""
        self.count = weights.shape[-1]
        p = np.asarray(weights, np.float64).reshape(-1, self.count)
        p = np.where(p.any(axis=1, keepdims=True), p, 1)
        p *= self.count / p.sum(axis=1, keepdims=True)
        of_each = np.arange(len(p))
        # Those with n p ≤ 1, then the others. The first are filled up by the others, in their order: neighbouring
        # numbers mostly draw neighbours (sweep of Hübschle-Schneider and Sanders 2022).
        order = np.argsort(p > 1, axis=1, kind="stable")
        low, high = np.zeros(len(p), np.int64), (p <= 1).sum(axis=1)
        lows, last = high.copy(), self.count - 1

        def entry(position: NDArray[np.int64]) -> NDArray[np.int64]:
            return np.asarray(order[of_each, np.minimum(position, last)])

        rest = p[of_each, entry(high)]  # what is left of the one that fills up others
        threshold, alias = np.ones_like(p), np.tile(np.arange(self.count), (len(p), 1))
        for _ in range(self.count):
            fills = (rest > 1) & (low < lows)
            ends = ~fills & (high < last)
            full, used, following = (
                (of_each[fills], entry(low)[fills]),
                (of_each[ends], entry(high)[ends]),
                entry(high + 1)[ends],
            )
            threshold[full], alias[full] = p[full], entry(high)[fills]
            threshold[used], alias[used] = rest[ends], following
            rest[fills] += p[full] - 1
            rest[ends] += p[of_each[ends], following] - 1
            low += fills
            high += ends
        self._bits = max(1, (self.count - 1).bit_length())
        self._unit = 0.5 ** (32 - self._bits)
        # Rounded up, so that each i with a probability is drawn.
        units = np.minimum(np.ceil(threshold.clip(0, 1) / self._unit), 1 / self._unit - 1).astype(np.uint32)
        self._words = NumberTable(units << np.uint32(self._bits) | alias.astype(np.uint32))

    def draw(self, distribution: mi.UInt32, u: mi.Float, active: mi.Bool) -> tuple[mi.Int32, mi.Float]:
        """Draw an index from one of the distributions; return it, and `u` rescaled to a number uniform in [0, 1)."""
        scaled = u * self.count
        index = integer_part(smaller(scaled, self.count - 1))
        scaled = limited(scaled - mi.Float(index), 0, BELOW_ONE)
        word = self._words(distribution * self.count + index, active)
        threshold, alias = self._unit * mi.Float(mi.Int32(word >> self._bits)), word & ((1 << self._bits) - 1)
        is_own = scaled < threshold
        rest = dr.select(is_own, scaled, scaled - threshold) / larger(
            dr.select(is_own, threshold, 1 - threshold), 1e-30
        )
        return dr.select(is_own, mi.Int32(index), mi.Int32(alias)), limited(rest, 0, BELOW_ONE)


def truncated_gaussian(u: mi.Float, inside: mi.Float, spread: mi.Float) -> mi.Float:
    """Return √2 σ erf⁻¹(I (2u − 1)), a sample of a symmetrically truncated Gaussian, as lobes are.

    Args:
        u: in [0, 1).
        inside: I, the fraction of the Gaussian inside of the cutoff.
        spread: √2 σ.
    """
    return spread * dr.erfinv(inside * (2 * u - 1))


def cumulative_sums(weights: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return cumulative sums in float32, beginning with zero: (..., n, κ bins) → (..., n + 1, κ bins)."""
    result = np.zeros((*weights.shape[:-2], weights.shape[-2] + 1, weights.shape[-1]), np.float32)
    result[..., 1:, :] = weights.cumsum(axis=-2)
    return result
