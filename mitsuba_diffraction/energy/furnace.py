"""The albedo of a perfect mirror with the relief of a surface, in a white furnace.

With R = 1 and E = 1 the BSDF reflects

    a(ω_i, λ) = ∫ K G S(q; κ) W dq    over the q whose ω_o is above the surface (du dv = cos θ_o dω_o = λ² dq)

a is summed over components of S: the orders of a grating, or, where orders overlap and of a sample, the cells of a
lattice in which S is gathered, each represented by a Gaussian as wide as the cell. An order both of whose directions
stay away from the horizon is represented by the centre of its lobe, as K G and κ hardly change within it, and so is a
cell whose ω_o does; the others, and the lobe of the mirror direction, by points that are evenly spaced in cos θ_o, or,
of an order, in the cosine of the direction that is nearer to the horizon.

K, G and W are those of the BSDF. With s_i = ω_i,t, s_o = ω_o,t, w = cos θ_i + cos θ_o, d(s) = (1 − |s|²)/2λσ_q and
g the `horizon_gain`, an order m that is evaluated by itself has

    t_i = s_i + λ m/T,    t_o = s_o + λ m/T,    W = g(min(d(s_i), d(t_i))) g(min(d(s_o), d(t_o)))

if |t_i| < 1 and |t_o| < 1, else W = 0, and K G of the cosines √(cos² θ_i + 1 − |t_o|²)/√2, √(cos² θ_o + 1 − |t_i|²)/√2
and of |λm/T|. Orders that overlap, and samples, have (1 − b) K G + b g(d(s_i)) g(d(s_o)) with

    b = clip((25 − |q|²/σ_q²)/9, 0, 1) clip(2 − 5 max(cos θ_i, cos θ_o), 0, 1)

Of an interface between media, reflected and transmitted light from one of its sides are

    R(ω_i, λ) = ∫ F K G S(q; κ) W dq,    T(ω_i, λ) = ∫ (1 − F) K_t S(q; κ_t) W_t dq,    κ_t = 2π (cos θ_i − η cos θ_o)/λ

with λ and lengths of the medium of ω_i, `geometry.transmitted`, and S(q; −κ) = S(−q; κ). A transmitted order has the
same cosines as above with |t_i| and |t_o| in units of their media, K_t and κ_t of these cosines, and in W_t each d in
its medium; where orders overlap, W_t = 1. From below a surface is that with −h. A sheet has the tables of an interface:
its flat face only takes away.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.polynomial.legendre import leggauss
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.ndimage import maximum_filter1d
from scipy.special import ndtri

from ..geometry import fresnel, horizon_gain, k_g, transmitted
from ..spectrum.grids import OrderGrid, spline_integral
from ..spectrum.power_spectrum import PowerSpectrum

Real = NDArray[np.float64]
Indices = NDArray[np.int64]

KAPPA_STEP = 0.1  # radians of the fastest oscillation over κ, between which powers are linear
BELOW_LEAST, MOST_KAPPAS = 8, 1000  # such values of κ up to κ₁, where light passes; so many at most for their sake
COARSER = 1.6  # cells, where there are three ways for light to go
CELL, CELLS = 0.2, 500  # width of a gathered cell in direction cosines at the shortest wavelength; cells at least
MIRROR_CELL = 0.75  # the same in the lobe of the mirror direction, in σ_q, at most
FAR_CELL = 20  # cos² θ_o in λσ from which a cell is represented by its centre
FAR_ORDER = 6  # cos² of either direction in λσ from which an order is; there the gain is one
TURN = 0.5  # radians by which the phase of the deepest point may change within such a cell
REACH = 4.2  # standard deviations to which a component is integrated
FLAT = 0.5  # cos θ_o down to which no phase of a narrow order may turn so far
NARROW = 0.02  # λσ up to which a lobe is integrated along the radius alone
RADIAL, AZIMUTHAL = 9, 13  # points of a lobe
RADIAL_POINTS, RADIAL_POINTS_OF_CELL = leggauss(RADIAL), leggauss(3)
BLUR = 0.05  # what a cell of a table in three dimensions may span, as a share of the largest κ
PHASE = 4  # radians by which the phase of the deepest point changes from slice to slice, if 16 are enough
ROBERTS = np.array([0.7548776662466927, 0.5698402909980532])  # steps of a sequence of low discrepancy in the plane
POINTS = 12000  # drawn by power among the nodes of a spectrum
CHUNK = 1 << 16  # pairs (direction, component) at once, so that they stay in the cache


@dataclass(frozen=True, eq=False)
class Furnace:
    """S(q; κ) as a sum of components.

    Attributes:
        spectrum: S(q; κ).
        height_scale: times the heights.
        index: η = n_o/n_i, n_i that of the medium of ω; None if nothing is transmitted and F = 1.
        side: 1, ω is above the surface; −1, below, where the surface seen has the heights −h, S that of −q.
        by_order: components are orders, each evaluated by itself: of line gratings, and if none overlap.
        q: (n, 2) cycles/µm, the centres of components.
        widths: (n,) cycles/µm, their standard deviations.
        powers: p_j of reflected and, if there is any, of transmitted light, float32 (n, K) each, at K equidistant κ
            from 0 to that of the spectrum, for the heights as they are.
        least_kappa: κ₁ in rad/µm of the heights as they are.
        at_least: p_j of transmitted light at κ₁ and 2κ₁, (n,) each.
    """

    spectrum: PowerSpectrum = field(repr=False)
    height_scale: float
    index: float | None
    side: int
    by_order: bool
    q: Real = field(repr=False)
    widths: Real = field(repr=False)
    powers: list[NDArray[np.float32]] = field(repr=False)
    least_kappa: float
    at_least: list[Real] = field(repr=False)

    @classmethod
    def of(
        cls, spectrum: PowerSpectrum, height_scale: float = 1.0, index: float | None = None, side: int = 1
    ) -> Furnace:
        """Return the components of `spectrum`; `index` is n below relative to n above, if light is transmitted."""
        grid, max_kappa = spectrum.grid, spectrum.max_kappa
        by_order = isinstance(grid, OrderGrid) and (1 in grid.shape or all(lobe.count == 1 for lobe in spectrum.lobes))
        count = max_kappa * spectrum.height_range / KAPPA_STEP
        if index is not None:
            # Below κ₁ p_j is about a parabola, which transmitted light weighs by 1/κ².
            count = max(count, min(BELOW_LEAST * max_kappa / least_kappa(spectrum, index), MOST_KAPPAS))
        kappas = np.linspace(0, max_kappa, int(count) + 3, dtype=np.float64)
        powers: NDArray[np.floating]
        if by_order:
            powers = np.stack([spectrum.powers(kappa).ravel() for kappa in kappas], 1)
            # A truncated lobe is divided by what is inside.
            powers /= np.prod([lobe.inside for lobe in spectrum.lobes])
            q = _nodes(spectrum)
            widths = np.full(len(q), spectrum.lobe_width)
        else:
            q, widths, powers = _gathered(spectrum, kappas, 1.0 if index is None else COARSER)
        # Of the deepest surfaces phases turn faster than the slices of a table follow: where few nodes make up a
        # component, its power is the largest near. κ of transmitted light is smaller by a factor of four or so.
        deep = max_kappa * spectrum.height_range * height_scale * BLUR > PHASE
        blurred = deep and 1 not in grid.shape and 16 * len(q) > np.prod(grid.shape)
        kept = powers.max(-1) > 1e-7
        powers = np.ascontiguousarray(np.maximum(powers[kept], 0), np.float32)
        tables, least, at_least = [powers], 0.0, []
        if index is not None:
            tables, least = [powers, powers], least_kappa(spectrum, index, height_scale)
            at_least = [np.array([np.interp(n * least, kappas, row) for row in powers]) for n in (1, 2)]
        if blurred:
            tables = [
                maximum_filter1d(table, 1 + int(share * len(kappas)), axis=1)
                for table, share in zip(tables, (BLUR, BLUR / 4), strict=False)
            ]
        seen = None if index is None else float(index) ** side
        return cls(spectrum, height_scale, seen, side, by_order, side * q[kept], widths[kept], tables, least, at_least)

    @property
    def depth(self) -> float:
        """The range of the scaled heights in µm."""
        return self.spectrum.height_range * self.height_scale

    @property
    def turning(self) -> bool:
        """Whether components are orders within whose lobes phases turn, so that powers are averages over these."""
        return self.by_order and 2 * np.pi * self.depth * self.spectrum.lobe_width > TURN * FLAT

    @property
    def wide(self) -> bool:
        """Whether lobes are wide."""
        return self.spectrum.wavelengths[1] * 1e-3 * max(self.index or 1, 1) * self.spectrum.lobe_width > NARROW

    @property
    def work(self) -> int:
        """About how many components the work for one direction amounts to."""
        if self.by_order:
            return (len(self.q) + 20) * (RADIAL if self.turning else 1)
        return len(self.q) * len(self.ways) ** 2

    @property
    def ways(self) -> tuple[int, ...]:
        """0, light is reflected; ±1, it is transmitted with that sign of v_z, where there is a medium below."""
        return (0,) if self.index is None else (0, 1, -1)

    def albedo(self, directions: Real, wavelengths: Real) -> Real:
        """Compute a(ω, λ), of an interface R and T.

        Args:
            directions: ω, (n, 3) unit vectors, along the pattern's axes; on which side is up to the furnace.
            wavelengths: λ in µm in the medium of ω, (n,).

        Returns:
            (1, n), or (2, n): R and T.
        """
        result = np.zeros((len(self.powers), len(directions)))
        # Neighbours reach about the same components.
        for some in np.array_split(np.arange(len(directions)), 1 + len(directions) * len(self.q) // (8 * CHUNK)):
            for way in self.ways:
                place, _, value = self.sent(directions[some], wavelengths[some], way)
                result[abs(way), some] += np.bincount(place, value, len(some))
        return result

    def sent(self, directions: Real, length: Real, way: int) -> tuple[Indices, Indices, Real]:
        """Compute what components add to `albedo` where light goes one way: place, component and value of each.

        Component j sends light from ω to −ω_t − λ q_j, or, with the way −1, to −ω_t + λ q_j, in units of n_i.
        """
        s, cos_i = directions[:, :2], np.abs(directions[:, 2])
        q, index = self.q * (way or 1), (way and self.index) or 1.0
        edge = 0.0 if self.by_order else REACH * self.widths
        middle, mean = s.mean(0), (length.min() + length.max()) / 2
        reach = index + np.hypot(*(s - middle).T).max() + (length.max() - mean) * np.hypot(*q.T) + length.max() * edge
        reached = np.flatnonzero(np.hypot(*(middle + mean * q).T) < reach)
        # cos² θ_o = 1 − |ω_i,t + λq|²/η²
        square = np.repeat(1 - (1 - cos_i[:, None] ** 2) / index**2, len(reached), axis=1)
        for k in np.flatnonzero(q.any(0)):
            u = np.multiply.outer(length, q[reached, k])
            square -= u * (u + 2 * s[:, k, None]) / index**2
        lowest = 0.0 if self.by_order else -2 * REACH / index * np.multiply.outer(length, self.widths[reached])
        i, j = np.nonzero(square > lowest)
        square, j = square[i, j], reached[j]
        # Of an order the direction that is nearer to the horizon counts.
        nearest = np.minimum(square, cos_i[i] ** 2) if self.by_order else square
        far = self._far(nearest, length[i] * self.widths[j] / index, length[i], way)
        if way:
            # What goes the other way at its centre does so.
            kept = ~far | (way * (cos_i[i] - index * np.sqrt(np.maximum(square, 0))) > 0)
            i, j, square, far = i[kept], j[kept], square[kept], far[kept]
        at, component = i[far], j[far]
        # Of a cell the means of cos² θ_o and |λq|².
        spread = 0.0 if self.by_order else 2 * (length[at] * self.widths[component]) ** 2
        cos_o = np.sqrt(square[far] - spread / index**2)
        tangent = length[at] ** 2 * (q**2).sum(-1)[component] + spread
        value = self._factor(cos_i[at], cos_o, length[at], tangent, way)
        value = value * self._power(component, cos_i[at], cos_o, length[at], way)
        near = self._lobes(s, cos_i, length, i[~far], j[~far], square[~far], way)
        return np.append(at, i[~far]), np.append(component, j[~far]), np.append(value, near).astype(np.float64)

    def _far(self, square: Real, sigma: Real, length: Real, way: int) -> NDArray[np.bool_]:
        """Return whether a component is represented by its centre; its cos² θ_o, width in ω_o and λ."""
        # A transmitted order keeps its power at the horizon, with K_t, G_t and κ of the order.
        if self.by_order and way:
            return np.ones(square.shape, bool)
        turn = 2 * np.pi * self.depth * sigma / (length * TURN)
        if self.by_order:
            return (square > turn**2) & (square > FAR_ORDER * sigma)
        # Or around the pole, as long as a cell is far from reaching the horizon.
        around = square > np.maximum(1 - 3 * sigma**2, 4 * sigma**2)
        return (square > turn**2) & ((square > FAR_CELL * sigma) | around)

    def _factor(self, cos_i: Real, cos_o: Real, length: Real, tangent: Real, way: int) -> NDArray[np.floating]:
        """Return K G F and gain, or K_t (1 − F), at |λq|² = `tangent`; F = 1 without a medium below."""
        if way:
            least = self.least_kappa / max(self.height_scale, 1e-9) * length / (2 * np.pi)
            return transmitted(cos_i, cos_o, tangent, self.index or 1.0, least)
        square = tangent + (cos_i + cos_o) ** 2
        value = k_g(cos_i, cos_o, tangent)
        if not self.by_order:
            width = length * self.spectrum.lobe_width
            b = mirrored(tangent / width**2, cos_i, cos_o)
            if b.any():
                gain = [horizon_gain(cos**2 / (2 * width)) for cos in (cos_i, cos_o)]
                value = (1 - b) * value + b * gain[0] * gain[1]
        return value if self.index is None else value * fresnel(np.sqrt(square) / 2, self.index)

    def _kappa(self, cos_i: Real, cos_o: Real, length: Real, way: int) -> Real:
        """Return κ in rad/µm between two directions; zero where transmitted light has the other sign of v_z."""
        v_z = way * (cos_i - (self.index or 1.0) * cos_o) if way else cos_i + cos_o
        return 2 * np.pi / length * np.maximum(v_z, 0)

    def _power(self, component: Indices, cos_i: Real, cos_o: Real, length: Real, way: int) -> Real:
        """Return p_j, linear between its nodes, of light that goes a way; shapes broadcast."""
        table, kappa = self.powers[abs(way)], self._kappa(cos_i, cos_o, length, way)
        last = table.shape[1] - 1
        place = np.minimum(kappa * (self.height_scale * last / self.spectrum.max_kappa), last * (1 - 1e-12))
        cell = place.astype(np.int64)
        flat, index = table.ravel(), component * table.shape[1] + cell
        below = flat[index]
        power = below + (place - cell) * (flat[index + 1] - below)
        if not way:
            return power
        at_least = (of[component] for of in self.at_least)
        return small_kappa(kappa * self.height_scale, self.least_kappa, power, *at_least) * (kappa > 0)

    def _lobes(
        self, s: Real, cos_i: Real, length: Real, place: Indices, component: Indices, square: Real, way: int
    ) -> Real:
        """Integrate over lobes and cells in which K, G or κ change, (n,), of pairs (place, component)."""
        s, cos_i, length = s[place], cos_i[place], length[place]
        offset, back = length[:, None] * self.q[component] * (way or 1), np.zeros(len(place), bool)
        if self.by_order:
            # What changes is the direction that is nearer to the horizon: of a pair either may be ω_i.
            back = cos_i**2 < square
            s[back], cos_i[back] = (s + offset)[back], np.sqrt(square[back])
            offset[back] *= -1
        result = np.empty(len(s))
        narrow = length * self.widths[component] < NARROW
        # Of the cells those of wide lobes, most of whose power may be near the mirror direction.
        lobe = (self.q[component] == 0).all(-1) | (narrow & self.wide) | self.by_order
        wide = lobe & ~narrow
        # Where ω_i changes, phases turn in another direction than the cosine that is integrated over.
        wide |= back & ((2 * np.pi * self.depth * self.widths[component] / TURN) ** 2 * (1 - cos_i**2) > cos_i**2)
        pairs: tuple[NDArray, ...] = s, cos_i, length, offset, component, back
        for those, azimuths, lobes in ((~lobe, 1, False), (wide, AZIMUTHAL, True), (lobe & ~wide, 1, True)):
            some = np.flatnonzero(those)
            for part in np.array_split(some, 1 + len(some) * RADIAL * azimuths // CHUNK):
                result[part] = self._lobe(way, azimuths, lobes, *(of[part] for of in pairs))
        return result

    def _lobe(
        self,
        way: int,
        azimuths: int,
        lobes: bool,
        s: Real,
        cos_i: Real,
        length: Real,
        offset: Real,
        component: Indices,
        back: NDArray[np.bool_],
    ) -> Real:
        """Integrate over lobes or cells, (n,).

        In polar coordinates of −ω_o,t = r (cos φ, sin φ), r² = 1 − cos² θ_o and r dr = −cos θ_o dcos θ_o.
        """
        s, cos_i, length, offset = s[:, None, None], cos_i[:, None, None], length[:, None, None], offset[:, None, None]
        index, component, back = (way and self.index) or 1.0, component[:, None, None], back[:, None, None]
        sigma, t = length * self.widths[component] / index, (s + offset) / index
        rho = np.hypot(t[..., 0], t[..., 1])
        ahead = t / np.maximum(rho, 1e-12)[..., None]
        reach = (REACH if lobes else np.sqrt(3)) * sigma
        nearest, farthest = np.maximum(rho - reach, 0), rho + reach
        # The variance of a cell across the radius.
        across = 0.0 if lobes else sigma**2
        highest, lowest = (np.sqrt(np.maximum(1 - x**2 - across, 0)) for x in (nearest, farthest))
        nodes, weights = RADIAL_POINTS if lobes else RADIAL_POINTS_OF_CELL
        cos_o = np.maximum(lowest + (highest - lowest) * ((1 + nodes) / 2)[:, None], 1e-6)
        r = np.sqrt(np.maximum(1 - cos_o**2 - across, 0))
        weight = (highest - lowest) * (weights / 2)[:, None] * cos_o
        opening = np.where(rho > reach, np.arcsin(np.minimum(reach / np.maximum(rho, 1e-12), 1)), np.pi)
        phi = opening * ((np.arange(azimuths) + 0.5) * (2 / azimuths) - 1)
        if not lobes:
            # As good as a box.
            weight = weight / (np.maximum(r, 1e-9) * (farthest - nearest))
        elif azimuths == 1:
            # Integrated across the radius.
            share = np.exp(-((r - rho) ** 2) / (2 * sigma**2))
            weight = weight * share / (np.maximum(r, 1e-9) * np.sqrt(2 * np.pi) * sigma)
        else:
            square = (r - rho) ** 2 + 4 * r * rho * np.sin(phi / 2) ** 2
            weight = weight * (2 / azimuths) * opening * np.exp(-square / (2 * sigma**2)) / (2 * np.pi * sigma**2)
        x, y = r * np.cos(phi), r * np.sin(phi)
        # −ω_o,t
        out_x, out_y = ahead[..., 0] * x - ahead[..., 1] * y, ahead[..., 1] * x + ahead[..., 0] * y
        if not self.by_order:
            tangent = (index * out_x - s[..., 0]) ** 2 + (index * out_y - s[..., 1]) ** 2 + index**2 * across
            power = weight * self._power(component, cos_i, cos_o, length, way)
            return (power * self._factor(cos_i, cos_o, length, tangent, way)).sum((1, 2))
        t_i, t_o = 1 - rho**2, 1 - (out_x - offset[..., 0]) ** 2 - (out_y - offset[..., 1]) ** 2
        value, _ = self._of_order(weight, cos_i, cos_o, t_i, t_o, length, (offset**2).sum(-1), way)
        # Of κ: where ω_i changes instead, it is the fixed one, and ω_o that which is sent on.
        cos_i, cos_o = (
            np.where(back, np.sqrt(np.maximum(square, 0)), cos) for square, cos in ((t_i, cos_i), (t_o, cos_o))
        )
        return (value * self._power(component, cos_i, cos_o, length, way)).sum((1, 2))

    def _of_order(
        self, weight: Real, cos_i: Real, cos_o: Real, t_i: Real, t_o: Real, length: Real, tangent: Real, way: int
    ) -> tuple[Real, tuple[Real, Real]]:
        """Return `weight`, `_factor` and W of an order, from cos² θ of t_i and t_o, and the two cosines of its K G."""
        index = (way and self.index) or 1.0
        of_i, of_o = (np.sqrt(np.maximum(x, 1e-12) / 2) for x in (cos_i**2 + t_o, cos_o**2 + t_i))
        value = weight * ((t_i > 0) & (t_o > 0)) * self._factor(of_i, of_o, length, tangent, way)
        for x in (np.minimum(cos_i**2, index * t_i), np.minimum(index * cos_o**2, t_o)):
            value *= horizon_gain(np.maximum(x, 0) / (2 * length * self.spectrum.lobe_width))
        return value, (of_i, of_o)

    def albedo_of_nodes(
        self,
        directions: Real,
        wavelengths: Real,
        bounds: Sequence[Callable[[Real, Real], Real]],
        seed: int = 0,
        pairs: bool = True,
    ) -> Real:
        """Compute the albedo with E from the stored spectrum, nothing gathered and lobes as wide as they are.

        By Monte Carlo: at least one point in the lobe of each node, more in strong ones. Transmitted light has E = e of
        the incident direction, which is no less than E.

        Args:
            directions: ω_i, (n, 3) unit vectors, along the pattern's axes.
            wavelengths: λ in µm in the medium of ω_i, (n,).
            bounds: e(ω, λ) of reflected and of transmitted light, for directions (m, 3) and wavelengths (m,) on the
                side of ω_i.
            seed: of the points.
            pairs: if not, reflected light, too, has e of the incident direction, which takes half of the time.

        Returns:
            (n,).
        """
        spectrum, grid, q = self.spectrum, self.spectrum.grid, _nodes(self.spectrum)
        kappas = np.array([0, 0.03, 0.1, 0.4, 0.7, 1]) * spectrum.max_kappa
        powers = [np.maximum(spectrum.powers(kappa).ravel(), 0) for kappa in kappas]
        strength = np.sum(powers, 0, np.float64)
        # Evenly along the sum of strengths, from a random start.
        rng, share = np.random.default_rng(seed), strength / strength.sum()
        node = np.searchsorted(share.cumsum(), (np.arange(POINTS) + rng.random()) / POINTS).clip(max=len(q) - 1)
        weight = 1 / (POINTS * share[node])
        # Points of one node follow each other in a sequence of low discrepancy (Roberts 2018).
        t = (rng.random(2) + np.arange(POINTS)[:, None] * ROBERTS) % 1
        # A node is a Gaussian, or a B-spline that ends at the Nyquist limit.
        if isinstance(grid, OrderGrid):
            points = q[node] + spectrum.lobe_width * ndtri(t)
        else:
            offsets = np.linspace(-1.5, 1.5, 1025, dtype=np.float64)
            points = q[node] + np.interp(t, spline_integral(offsets), offsets) * grid.spacing
            kept = (np.abs(points) < grid.limit).all(-1)
            points, node, weight = points[kept], node[kept], weight[kept]
        points, q = self.side * points, self.side * q[node]
        result, own = np.zeros(len(directions)), [bound(directions, wavelengths) for bound in bounds]
        for place, way in np.ndindex(len(directions), len(self.ways)):
            way, s, cos_i, length = self.ways[way], directions[place, :2], directions[place, 2], wavelengths[place]
            index, u = (way and self.index) or 1.0, length * (way or 1) * points
            square = 1 - _square(s + u) / index**2
            lit = np.flatnonzero(square > 0)
            u, m, cos_o = u[lit], length * (way or 1) * q[lit], np.sqrt(square[lit])
            kappa_of = cos_i, cos_o
            if self.by_order:
                t_i, t_o = 1 - _square(s + m) / index**2, 1 - _square(s + u - m)
                value, of_order = self._of_order(weight[lit], cos_i, cos_o, t_i, t_o, length, _square(m), way)
                # Transmitted light has κ of the order, with which K_t changes as fast.
                kappa_of = of_order if way else kappa_of
            else:
                value = weight[lit] * self._factor(cos_i, cos_o, length, _square(u), way)
            e = own[abs(way)][place]
            if pairs and not way:
                e = np.minimum(e, bounds[0](np.column_stack([-s - u, cos_o]), np.full(len(lit), length)))
            power = self._power_of_nodes(node[lit], self._kappa(*kappa_of, length, way), way)
            result[place] += (value * power * e).sum()
        return result

    def _power_of_nodes(self, node: Indices, kappa: Real, way: int) -> NDArray[np.floating]:
        def power(kappa: Real) -> NDArray[np.float32]:
            return self.spectrum.table.powers_at(*np.divmod(node, self.spectrum.grid.shape[1]), kappa)

        there, kappa = kappa > 0, np.minimum(kappa * self.height_scale, self.spectrum.max_kappa)
        if not way:
            return power(kappa)
        first, second = (power(np.full(len(node), n * self.least_kappa)) for n in (1, 2))
        return small_kappa(kappa, self.least_kappa, power(kappa), first, second) * there


def least_kappa(spectrum: PowerSpectrum, index: float, height_scale: float = 1.0) -> float:
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


def small_kappa(kappa: Real, least: float, power: NDArray, first: NDArray, second: NDArray) -> Real:
    """Return κ₁²/κ² c_m(κ) below κ₁ = `least`, the line through c_m/κ² at κ₁ and 2κ₁; `power`, c_m(κ), above."""
    x = kappa / max(least, 1e-30)
    return np.where(kappa < least, (2 - x) * first + 0.25 * (x - 1) * second, power)


def mirrored(square: Real, cos_i: Real, cos_o: Real) -> Real:
    """Return b, the share of S at |q|²/σ_q² that is taken for the mirror order's."""
    return np.clip((25 - square) / 9, 0, 1) * np.clip(2 - 5 * np.maximum(cos_i, cos_o), 0, 1)


def _nodes(spectrum: PowerSpectrum) -> Real:
    """Return q of all nodes, (rows · columns, 2) cycles/µm."""
    return np.stack(np.meshgrid(*spectrum.grid.frequencies()), -1).reshape(-1, 2)


def _square(vector: Real) -> Real:
    """Return |v|² of (n, 2)."""
    return vector[:, 0] ** 2 + vector[:, 1] ** 2


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
    shortest = 4 * np.pi / spectrum.max_kappa
    width = coarser * min(CELL / shortest, np.sqrt(np.prod(np.minimum(np.ptp(q, axis=0), 4 / shortest)) / CELLS))
    # Smaller ones where b is not zero.
    near = np.hypot(*q.T) < 6 * sigma
    place = np.rint(q / np.where(near, min(width, MIRROR_CELL * sigma), width)[:, None])
    place[near] += 1e6
    _, cell = np.unique(place, axis=0, return_inverse=True)
    cell = cell.ravel()
    # Powers are band-limited by the height range: from few κ by cubic splines.
    few = np.linspace(0, kappas[-1], len(kappas) // 4 + 6)
    powers, total = np.empty((cell.max() + 1, len(few))), np.zeros(len(q))
    for index, kappa in enumerate(few):
        power = np.maximum(spectrum.powers(kappa).ravel().astype(np.float64), 0)
        powers[:, index] = np.bincount(cell, power)
        total += power
    total += 1e-12
    moments = [np.bincount(cell, total * moment) for moment in (1, *q.T, *(q**2).T)]
    centre, square = np.stack(moments[1:3], -1) / moments[0][:, None], np.stack(moments[3:], -1) / moments[0][:, None]
    # What a node itself stands for.
    own = sigma if isinstance(grid, OrderGrid) else np.array(grid.spacing) / 2
    widths = np.sqrt((np.maximum(square - centre**2, 0) + np.square(own)).mean(-1))
    return centre, widths, CubicSpline(few, powers, axis=1)(kappas)
