"""The albedo of a perfect mirror with the relief of a surface, in a white furnace.

With R = 1 and E = 1 the BSDF reflects

    a(ω_i, λ) = ∫ K G S(q; κ) Γ dq    over the q whose ω_o is above the surface (du dv = cos θ_o dω_o = λ² dq)

with the gain Γ of lobes at the horizon. a is summed over components of S, each evaluated once:

- An order of a grating, evaluated by itself. Γ keeps its power wherever its centre propagates, so that it contributes
  K G η(κ). Where a lobe is cut by the horizon, its cosine is the mean over the lobe,

      cos θ → √(2λσ_q) m(x),    m(x) = ∫₀^∞ g(x) g(y) φ(x − y) √((x + y)/2) dy,    x = cos² θ/(2λσ_q)

  with the `horizon_gain` g; m(x) → √x away from the horizon.
- Where orders overlap, and of a sample, a cell of a lattice in which S is gathered. The part of its radial extent that
  is above the horizon gives its weight and its cosine. Near the mirror direction at grazing incidence
  (1 − b) K G + b Γ stands for K G, as in `bsdf/geometry.py`.

Of an interface between media, reflected and transmitted light from one of its sides are

    R(ω_i, λ) = ∫ F K G S(q; κ) Γ dq,    T(ω_i, λ) = ∫ (1 − F) K_t S(q; κ_t) Γ_t dq,    κ_t = 2π (cos θ_i − η cos θ_o)/λ

with λ and lengths of the medium of ω_i, `geometry.transmitted`, and S(q; −κ) = S(−q; κ). From below a surface is that
with −h. A sheet has the tables of an interface: its flat face only takes away.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cache

import numpy as np
from numpy.polynomial.legendre import leggauss
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import CubicSpline

from ..geometry import fresnel, horizon_gain, k_g, transmitted
from ..spectrum.grids import OrderGrid
from ..spectrum.power_spectrum import PowerSpectrum

Real = NDArray[np.float64]
Indices = NDArray[np.int64]

KAPPA_STEP = 0.1  # radians of the phase of the deepest point between values of κ, between which powers are linear
MAX_KAPPAS = 1000  # such values, of which eight lie below κ₁ where light is transmitted
CELL_WIDTH, MIN_CELLS = 0.12, 2000  # of gathered cells: width in direction cosines at the shortest wavelength, number
COARSER = 1.5  # times that width, of an interface, where light goes three ways
MIRROR_CELL_WIDTH = 0.5  # the maximum in the lobe of the mirror direction, in σ_q
MAX_POINTS = 6  # on each side along x and y, of a node that is wider than half a cell
LOBE_PHASE, LOBE_POINTS = 0.1, 9  # radians along the normal within σ, from which an order is so many points
STEEP = 0.25  # cos θ_o down to which cells are evaluated at one point
PAIRS_AT_ONCE = 1 << 17  # (direction, component), so that they stay in the cache


@dataclass(frozen=True, eq=False)
class Furnace:
    """S(q; κ) as a sum of components.

    Attributes:
        spectrum: S(q; κ).
        index: η = n_o/n_i, n_i that of the medium of ω; None if nothing is transmitted and F = 1.
        by_order: components are orders, each evaluated by itself: of line gratings, and if none overlap.
        q: (n, 2) cycles/µm, the centres of components.
        widths: (n,) cycles/µm, their standard deviations.
        powers: float32 (n, K), at K equidistant κ from 0 to that of the spectrum, for the heights as they are.
        height_scale: times the heights.
    """

    spectrum: PowerSpectrum = field(repr=False)
    index: float | None
    by_order: bool
    q: Real = field(repr=False)
    widths: Real = field(repr=False)
    powers: NDArray[np.float32] = field(repr=False)
    height_scale: float = 1.0

    @classmethod
    def of(
        cls, spectrum: PowerSpectrum, height_scale: float = 1.0, index: float | None = None, side: int = 1
    ) -> Furnace:
        """Return the components of `spectrum`.

        Args:
            spectrum: S(q; κ).
            height_scale: times the heights.
            index: n below relative to n above, if light is transmitted.
            side: 1, ω is above the surface; −1, below, where the surface seen has the heights −h, S that of −q.
        """
        grid, max_kappa = spectrum.grid, spectrum.max_kappa
        by_order = isinstance(grid, OrderGrid) and (1 in grid.shape or all(lobe.count == 1 for lobe in spectrum.lobes))
        count = max_kappa * spectrum.height_range / KAPPA_STEP
        if index is not None:
            # Below κ₁ powers are about parabolas, which transmitted light weighs by 1/κ².
            count = max(count, min(8 * max_kappa / min_kappa(spectrum, index), MAX_KAPPAS))
        kappas = np.linspace(0, max_kappa, int(count) + 3, dtype=np.float64)
        powers: NDArray[np.floating]
        if by_order:
            powers = np.stack([spectrum.powers(kappa).ravel() for kappa in kappas], 1)
            # A truncated lobe is divided by what is inside.
            powers /= np.prod([lobe.inside for lobe in spectrum.lobes])
            q, widths = _nodes(spectrum), np.full(len(powers), spectrum.lobe_width)
        else:
            q, widths, powers = _gathered(spectrum, kappas, 1.0 if index is None else COARSER)
        kept = powers.max(-1) > 1e-7
        powers = np.ascontiguousarray(np.maximum(powers[kept], 0), np.float32)
        seen = None if index is None else float(index) ** side
        return cls(spectrum, seen, by_order, side * q[kept], widths[kept], powers, height_scale)

    @property
    def ways(self) -> tuple[int, ...]:
        """0, light is reflected; ±1, it is transmitted with that sign of v_z, where there is a medium below."""
        return (0,) if self.index is None else (0, 1, -1)

    def albedo(self, directions: Real, wavelengths: Real) -> Real:
        """Compute a(ω, λ), of an interface R and T.

        Args:
            directions: ω, (n, 3) unit vectors, along the pattern's axes, with z > 0 on their side.
            wavelengths: λ in µm in the medium of ω, (n,).

        Returns:
            (1, n), or (2, n): R and T.
        """
        result = np.zeros((len(self.ways[:2]), len(directions)))
        # Neighbours have about the same components.
        for some in np.array_split(np.arange(len(directions)), 1 + len(directions) * len(self.q) // PAIRS_AT_ONCE):
            for way in self.ways:
                direction, _, value = self.sent(directions[some], wavelengths[some], way)
                result[abs(way), some] += np.bincount(direction, value, len(some))
        return result

    def sent(self, directions: Real, length: Real, way: int) -> tuple[Indices, Indices, Real]:
        """Compute the terms of `albedo` of light that goes one way: index of direction, of component, and value.

        Component j sends light from ω to −ω_t − λ q_j, or, with the way −1, to −ω_t + λ q_j, in units of n_i.
        """
        s, cos_i, index = directions[:, :2], np.abs(directions[:, 2]), (way and self.index) or 1.0
        q, radius = self.q * (way or 1), np.zeros(len(self.q)) if self.by_order else np.sqrt(3) * self.widths
        middle, mean = s.mean(0), (length.min() + length.max()) / 2
        cutoff = index + np.hypot(*(s - middle).T).max() + (length.max() - mean) * np.hypot(*q.T)
        near = np.flatnonzero(np.hypot(*(middle + mean * q).T) < cutoff + length.max() * radius)
        # cos² θ_o = 1 − |ω_i,t + λq|²/η²
        square = np.repeat(1 - (1 - cos_i[:, None] ** 2) / index**2, len(near), axis=1)
        for k in np.flatnonzero(q.any(0)):
            u = np.multiply.outer(length, q[near, k])
            square -= u * (u + 2 * s[:, k, None]) / index**2
        lowest = 0.0
        if not self.by_order:
            radii = np.multiply.outer(length / index, radius[near])
            lowest = -radii * (2 + radii)
        i, j = np.nonzero(square > lowest)
        square, j = square[i, j], near[j]
        if not self.by_order:
            return self._cells(i, j, np.sqrt(1 - square), cos_i, length, way)
        sigma = length[i] * self.spectrum.lobe_width
        leaves = cos_o = mean_cosine(square, sigma / index)
        weight: Real | float = 1.0
        if 2 * np.pi * self.spectrum.height_range * self.height_scale * self.spectrum.lobe_width > LOBE_PHASE:
            leaves, cos_o, weight = _over_lobe(square, sigma / index)
            i, j, sigma = np.tile(i, LOBE_POINTS), np.tile(j, LOBE_POINTS), np.tile(sigma, LOBE_POINTS)
        cos_i, length = cos_i[i], length[i]
        seen = mean_cosine(cos_i**2, sigma)
        value = weight * self._factor(seen, cos_o, length, length**2 * (q[j] ** 2).sum(-1), way)
        # κ of reflected light is that of the pair.
        kappa = self._kappa(seen, cos_o, length, way) if way else self._kappa(cos_i, leaves, length, way)
        return i, j, value * self._power(j, kappa, way)

    def _cells(
        self, i: Indices, j: Indices, rho: Real, cos_i: Real, length: Real, way: int
    ) -> tuple[Indices, Indices, Real]:
        """Compute the terms of directions i and cells j, whose centres have sin θ_o = ρ: three near the horizon.

        They are points in cos θ_o, as K G varies with that, over the radial extent ρ ± √3 σ.
        """
        index = (way and self.index) or 1.0
        sigma = length[i] * self.widths[j] / index
        steep, parts = (rho + np.sqrt(3) * sigma) ** 2 > 1 - STEEP**2, []
        for count, some in ((1, np.flatnonzero(~steep)), (3, np.flatnonzero(steep))):
            i_, j_ = np.tile(i[some], count), np.tile(j[some], count)
            cos_o, r, weight = _above_horizon(rho[some], sigma[some], count)
            length_, cos_ = length[i_], cos_i[i_]
            # |λq|² along the line from the centre of the hemisphere
            tangent, square = length_**2 * (self.q[j_] ** 2).sum(-1), 1 - cos_**2
            to = np.tile(rho[some], count)
            tangent = square + index**2 * r**2 - r / np.maximum(to, 1e-12) * (index**2 * to**2 + square - tangent)
            tangent = np.maximum(tangent, 0) + (index * np.tile(sigma[some], count)) ** 2
            value = weight * self._factor(cos_, cos_o, length_, tangent, way)
            parts.append((i_, j_, value * self._power(j_, self._kappa(cos_, cos_o, length_, way), way)))
        i, j, value = (np.concatenate(part) for part in zip(*parts, strict=True))
        return i, j, value

    def _factor(self, cos_i: Real, cos_o: Real, length: Real, tangent: Real, way: int) -> NDArray[np.floating]:
        """Return K G F and gain, or K_t (1 − F), at |λq|² = `tangent`; F = 1 without a medium below."""
        if way:
            min_v_z = self._min_kappa / max(self.height_scale, 1e-9) * length / (2 * np.pi)
            return transmitted(cos_i, cos_o, tangent, self.index or 1.0, min_v_z)
        square = tangent + (cos_i + cos_o) ** 2
        value = k_g(cos_i, cos_o, tangent)
        if not self.by_order:
            width = length * self.spectrum.lobe_width
            b = np.clip((25 - tangent / width**2) / 9, 0, 1) * np.clip(2 - 5 * np.maximum(cos_i, cos_o), 0, 1)
            some = np.flatnonzero(b)
            gain = [horizon_gain(cos[some] ** 2 / (2 * width[some])) for cos in (cos_i, cos_o)]
            value[some] += b[some] * (gain[0] * gain[1] - value[some])
        return value if self.index is None else value * fresnel(np.sqrt(square) / 2, self.index)

    def _kappa(self, cos_i: Real, cos_o: Real, length: Real, way: int) -> Real:
        """Return κ in rad/µm between two directions; zero where transmitted light has the other sign of v_z."""
        v_z = way * (cos_i - (self.index or 1.0) * cos_o) if way else cos_i + cos_o
        return 2 * np.pi / length * np.maximum(v_z, 0)

    @property
    def _min_kappa(self) -> float:
        return min_kappa(self.spectrum, self.index or 1.0, self.height_scale)

    def _power(self, component: Indices, kappa: Real, way: int) -> Real:
        """Return the powers of components, of transmitted light with the line below κ₁."""
        last = self.powers.shape[1] - 1
        flat, start = self.powers.ravel(), component * (last + 1)

        def at(kappa: Real | float) -> Real:
            x = np.minimum(kappa * (last / self.spectrum.max_kappa), last * (1 - 1e-12))
            cell = np.asarray(x, np.int64)
            below = flat[start + cell]
            return below + (x - cell) * (flat[start + cell + 1] - below)

        forward, kappa = kappa > 0, kappa * self.height_scale
        if not way:
            return at(kappa)
        first = self._min_kappa
        return small_kappa(kappa, first, at(kappa), at(first), at(2 * first)) * forward


def min_kappa(spectrum: PowerSpectrum, index: float, height_scale: float = 1.0) -> float:
    """Return κ₁, below which c_m/κ² of transmitted light is a line, in rad/µm of the heights as they are."""
    first, undiffracted = small_kappas(spectrum, index)
    return min(first, undiffracted * height_scale)


def small_kappas(spectrum: PowerSpectrum, index: float) -> tuple[float, float]:
    """Return the two numbers of which κ₁ is the smaller, in rad/µm.

    A quarter of the first interval of the table, where its error weighs as little as that of the line; and, times the
    scale of the heights, less than κ of the undiffracted order at all wavelengths, those of the spectrum being in the
    denser medium.
    """
    longest = spectrum.wavelengths[1] * 1e-3 * max(index, 1)
    return spectrum.table.first_interval / 4, 1.6 * np.pi * abs(index - 1) / longest


def small_kappa(kappa: Real, first: float, power: NDArray, at_first: NDArray, at_second: NDArray) -> Real:
    """Return κ₁²/κ² c_m(κ) below κ₁ = `first`, the line through c_m/κ² at κ₁ and 2κ₁; `power`, c_m(κ), above."""
    x = kappa / max(first, 1e-30)
    return np.where(kappa < first, (2 - x) * at_first + 0.25 * (x - 1) * at_second, power)


def mean_cosine(square: ArrayLike, sigma: ArrayLike) -> Real:
    """Return √(2σ) m(x) of cos² θ = 2σx at the centre of a lobe of width σ in direction cosines."""
    scale = np.sqrt(2 * np.asarray(sigma, np.float64))
    root = np.sqrt(square) / scale
    return scale * np.where(root < 4, np.interp(root, *_mean_roots()), root)


@cache
def _mean_roots() -> tuple[Real, Real]:
    """Return √x from 0 to 4, and m(x)."""
    root, y = np.linspace(0, 4, 101, dtype=np.float64), np.linspace(0, 24, 4801, dtype=np.float64)
    x = root[:, None] ** 2
    density = horizon_gain(x) * horizon_gain(y) * np.exp(-((x - y) ** 2) / 2) / np.sqrt(2 * np.pi)
    return root, np.trapezoid(density * np.sqrt((x + y) / 2), y, axis=1)


def _over_lobe(square: Real, sigma: Real) -> tuple[Real, Real, Real]:
    """Return cos θ_o, that of K G, and weight, (`LOBE_POINTS` · n,), of points in a lobe of width σ, from cos² θ_o."""
    x, spread = square / (2 * sigma), np.sqrt(np.maximum(1 - square, 1e-6))
    low, high = np.sqrt(np.maximum(x - 3 * spread, 0)), np.sqrt(x + 3 * spread)
    nodes, weights = leggauss(LOBE_POINTS)
    root = low + (high - low) * ((1 + nodes) / 2)[:, None]
    weight = weights[:, None] * root * np.exp(-(((root**2 - x) / spread) ** 2) / 2) * horizon_gain(root**2)
    scale = np.sqrt(2 * sigma)
    return (scale * root).ravel(), (scale * np.sqrt((x + root**2) / 2)).ravel(), (weight / weight.sum(0)).ravel()


def _above_horizon(rho: Real, sigma: Real, count: int) -> tuple[Real, Real, Real]:
    """Return cos θ_o, r and weight, (count · n,), of points of a cell of width σ whose centre is at r = ρ.

    r² + σ² + cos² θ_o = 1, with the σ² across the radius; weights sum to the fraction of ρ ± √3 σ above the horizon.
    """
    low, high = np.maximum(rho - np.sqrt(3) * sigma, 0), rho + np.sqrt(3) * sigma
    nearest, farthest = (np.sqrt(np.maximum(1 - x**2 - sigma**2, 0)) for x in (low, high))
    nodes, weights = leggauss(count)
    cos_o = np.maximum(farthest + (nearest - farthest) * ((1 + nodes) / 2)[:, None], 1e-6)
    r = np.sqrt(np.maximum(1 - cos_o**2 - sigma**2, 0))
    # dr = cos θ dcos θ/r
    weight = weights[:, None] * cos_o / np.maximum(r, 1e-9)
    above = np.clip((np.sqrt(np.maximum(1 - sigma**2, 0)) - low) / (high - low), 0, 1)
    return cos_o.ravel(), r.ravel(), (weight * above / weight.sum(0)).ravel()


def _nodes(spectrum: PowerSpectrum) -> Real:
    """Return q of all nodes, (rows · columns, 2) cycles/µm."""
    return np.stack(np.meshgrid(*spectrum.grid.frequencies()), -1).reshape(-1, 2)


def _gathered(spectrum: PowerSpectrum, kappas: Real, coarser: float) -> tuple[Real, Real, Real]:
    """Gather the nodes of overlapping orders or of a sample in the cells of a lattice, those near the mirror's apart.

    Args:
        spectrum: S(q; κ).
        kappas: rad/µm, equidistant.
        coarser: times the width of a cell.

    Returns:
        Centres of power (n, 2), standard deviations (n,), both in cycles/µm, and powers (n, K).
    """
    sigma, grid, q = spectrum.lobe_width, spectrum.grid, _nodes(spectrum)
    # The standard deviation of a node itself.
    own = sigma if isinstance(grid, OrderGrid) else max(grid.spacing) / 2
    shortest = 4 * np.pi / spectrum.max_kappa
    width = coarser * min(
        CELL_WIDTH / shortest, np.sqrt(np.prod(np.minimum(np.ptp(q, axis=0), 4 / shortest)) / MIN_CELLS)
    )
    # Smaller cells where b is not zero.
    near = np.hypot(*q.T) < 6 * sigma
    parts: list[tuple[NDArray, ...]] = []
    for some, size in ((near, min(width, MIRROR_CELL_WIDTH * sigma)), (~near, width)):
        # A node as points of a Gaussian, if it is wider than half a cell.
        count = 0 if size > 2 * own else int(min(np.ceil(3 * own / size), MAX_POINTS))
        offsets = np.linspace(-3, 3, 2 * count + 1) if count else np.zeros(1)
        density = np.exp(-(offsets**2) / 2) / np.exp(-(offsets**2) / 2).sum()
        around = own * np.stack(np.meshgrid(offsets, offsets), -1).reshape(-1, 2)
        points = (q[some][:, None] + around).reshape(-1, 2)
        node, weight = (
            np.repeat(np.flatnonzero(some), len(around)),
            np.tile(np.outer(density, density).ravel(), some.sum()),
        )
        spread = np.full(len(points), own / (2 * count + 1))
        parts.append((points, np.column_stack([np.rint(points / size), spread]), node, weight, spread))
    q, cell, node, weight, spread = (np.concatenate(of) for of in zip(*parts, strict=True))
    if not isinstance(grid, OrderGrid):
        # The Nyquist limit
        weight *= (np.abs(q) <= grid.limit).all(-1)
    _, cell = np.unique(cell, axis=0, return_inverse=True)
    cell = cell.ravel()
    # Powers are band-limited by the height range: from few κ by cubic splines.
    few = np.linspace(0, kappas[-1], len(kappas) // 4 + 6)
    powers, total = np.empty((cell.max() + 1, len(few))), np.zeros(len(q))
    for index, kappa in enumerate(few):
        power = np.maximum(spectrum.powers(kappa).ravel().astype(np.float64), 0)[node] * weight
        powers[:, index] = np.bincount(cell, power)
        total += power
    total += 1e-12
    moments = [np.bincount(cell, total * moment) for moment in (1, *q.T, *(q**2).T, spread**2)]
    centre, square = np.stack(moments[1:3], -1) / moments[0][:, None], np.stack(moments[3:5], -1) / moments[0][:, None]
    widths = np.sqrt(np.maximum(square - centre**2, 0).mean(-1) + moments[5] / moments[0])
    return centre, widths, CubicSpline(few, powers, axis=1)(kappas)
