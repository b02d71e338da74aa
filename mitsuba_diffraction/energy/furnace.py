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
from functools import partial

import numpy as np
from numpy.polynomial.legendre import leggauss
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.ndimage import maximum_filter1d
from scipy.special import ndtri

from ..geometry import fresnel, horizon_gain, k_g, transmitted
from ..spectrum.grids import OrderGrid, spline_integral
from ..spectrum.power_spectrum import PowerSpectrum

KAPPA_STEP = 0.1  # radians of the fastest oscillation over κ, between which powers are linear
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


def evaluated_by_order(spectrum: PowerSpectrum) -> bool:
    """Return whether the BSDF evaluates the orders of `spectrum` one by one: of line gratings, and if none overlap."""
    if not isinstance(spectrum.grid, OrderGrid):
        return False
    return 1 in spectrum.grid.shape or all(lobe.count == 1 for lobe in spectrum.lobes)


@dataclass(frozen=True, eq=False)
class Furnace:
    """S(q; κ) as a sum of components.

    Attributes:
        q: (n, 2) cycles/µm, their centres.
        widths: (n,) cycles/µm, their standard deviations.
        powers: p_j, float32 (n, K), at K equidistant κ from 0 to `max_kappa`.
        max_kappa: rad/µm, for the heights as they are.
        height_scale: times the heights.
        height_range: µm, times `height_scale`.
        lobe_width: σ_q in cycles/µm.
        by_order: components are orders that are evaluated one by one.
        index: η = n_o/n_i, n_i that of the medium of ω; None if nothing is transmitted and F = 1.
        side: 1, ω is above the surface; −1, below, where the surface seen has the heights −h, S that of −q.
        passed: as `powers`, with κ₁²/κ² p_j below κ₁ as `small_kappa` gives it; None if nothing is transmitted.
        least_kappa: κ₁ in rad/µm of the heights as they are.
        turning: they are, and phases turn within their lobes, so that their powers are averages over these.
        wide: lobes are wide.
    """

    q: NDArray[np.float64] = field(repr=False)
    widths: NDArray[np.float64] = field(repr=False)
    powers: NDArray[np.float32] = field(repr=False)
    max_kappa: float
    height_scale: float
    height_range: float
    lobe_width: float
    by_order: bool
    turning: bool = False
    wide: bool = False
    index: float | None = None
    side: int = 1
    passed: NDArray[np.float32] | None = field(default=None, repr=False)
    least_kappa: float = 0.0

    @classmethod
    def of(
        cls, spectrum: PowerSpectrum, height_scale: float = 1.0, index: float | None = None, side: int = 1
    ) -> Furnace:
        """Return the components of `spectrum`.

        Args:
            spectrum: S(q; κ).
            height_scale: times the heights.
            index: n of the medium below the surface relative to the one above, if light is transmitted.
            side: 1, of light from above; −1, from below.
        """
        grid, by_order = spectrum.grid, evaluated_by_order(spectrum)
        max_kappa = spectrum.max_kappa
        kappas = np.linspace(0, max_kappa, int(max_kappa * spectrum.height_range / KAPPA_STEP) + 3, dtype=np.float64)
        q_x, q_y = grid.frequencies()
        q: NDArray[np.float64]
        widths: NDArray[np.float64]
        powers: NDArray[np.floating]
        if by_order:
            powers = np.stack([spectrum.powers(kappa).ravel() for kappa in kappas], 1)
            q = np.stack(np.meshgrid(q_x, q_y), -1).reshape(-1, 2)
            # A truncated lobe is divided by what is inside.
            powers /= np.prod([lobe.inside for lobe in spectrum.lobes])
            widths = np.full(len(q), spectrum.lobe_width)
        else:
            own = spectrum.lobe_width if isinstance(grid, OrderGrid) else np.array(grid.spacing) / 2
            q, widths, powers = _gathered(spectrum, kappas, own, 1.0 if index is None else COARSER)
        kept = powers.max(-1) > 1e-7
        seen = None if index is None else float(index) ** side
        sigma, depth = spectrum.lobe_width, spectrum.height_range * height_scale
        wide = spectrum.wavelengths[1] * 1e-3 * max(seen or 1, 1) * sigma > NARROW
        passed: NDArray[np.float32] | None = None
        least = 0.0
        if index is not None:
            least = least_kappa(spectrum, index, height_scale)
            at_least = [np.array([np.interp(n * least, kappas, row) for row in powers[kept]]) for n in (1, 2)]
            small = small_kappa(kappas, least, powers[kept], *(at[:, None] for at in at_least))
            passed = np.ascontiguousarray(np.maximum(small, 0), np.float32)
        # Of the deepest surfaces phases turn faster than the slices of a table follow: where few nodes make up a
        # component, its power is the largest near. κ of transmitted light is smaller by a factor of four or so.
        if max_kappa * depth * BLUR > PHASE and 1 not in grid.shape and 16 * len(q) > np.prod(grid.shape):
            powers = maximum_filter1d(powers, 1 + int(BLUR * len(kappas)), axis=1)
            if passed is not None:
                passed = maximum_filter1d(passed, 1 + int(BLUR / 4 * len(kappas)), axis=1)
        return cls(
            side * q[kept],
            widths[kept],
            np.ascontiguousarray(np.maximum(powers[kept], 0), np.float32),
            max_kappa,
            height_scale,
            depth,
            sigma,
            by_order,
            by_order and 2 * np.pi * depth * sigma > TURN * FLAT,
            wide,
            seen,
            side,
            passed,
            least,
        )

    def power(self, component: NDArray[np.int64], kappa: NDArray[np.float64], way: int = 0) -> NDArray[np.float64]:
        """Return p_j(κ) of light that goes a way, linear between nodes; κ in rad/µm; shapes broadcast."""
        table = self.passed if way and self.passed is not None else self.powers
        last = table.shape[1] - 1
        place = np.minimum(kappa * (self.height_scale * last / self.max_kappa), last * (1 - 1e-12))
        cell = place.astype(np.int64)
        flat, index = table.ravel(), component * table.shape[1] + cell
        below = flat[index]
        return below + (place - cell) * (flat[index + 1] - below)

    def albedo(self, directions: NDArray[np.float64], wavelengths: NDArray[np.float64]) -> NDArray[np.float64]:
        """Compute a(ω, λ), of an interface R and T.

        Args:
            directions: ω, (n, 3) unit vectors, along the pattern's axes; on which side is up to the furnace.
            wavelengths: λ in µm in the medium of ω, (n,).

        Returns:
            (1, n), or (2, n): R and T.
        """
        result = np.zeros((1 if self.index is None else 2, len(directions)))
        # Neighbours reach about the same components.
        for some in np.array_split(np.arange(len(directions)), 1 + len(directions) * len(self.q) // (8 * CHUNK)):
            for way in self.ways:
                place, _, value = self.sent(directions[some], wavelengths[some], way)
                result[abs(way), some] += np.bincount(place, value, len(some))
        return result

    @property
    def work(self) -> int:
        """Return about how many components the work for one direction amounts to."""
        if self.by_order:
            return (len(self.q) + 20) * (RADIAL if self.turning else 1)
        return len(self.q) * len(self.ways) ** 2

    @property
    def ways(self) -> tuple[int, ...]:
        """0, light is reflected; ±1, it is transmitted with that sign of v_z, where there is a medium below."""
        return (0,) if self.index is None else (0, 1, -1)

    def sent(
        self, directions: NDArray[np.float64], length: NDArray[np.float64], way: int
    ) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
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
        value = value * self._power(partial(self.power, component, way=way), cos_i[at], cos_o, length[at], way)
        near = self._lobes(s, cos_i, length, i[~far], j[~far], square[~far], way)
        return np.append(at, i[~far]), np.append(component, j[~far]), np.append(value, near).astype(np.float64)

    def _far(
        self, square: NDArray[np.float64], sigma: NDArray[np.float64], length: NDArray[np.float64], way: int
    ) -> NDArray[np.bool_]:
        """Return whether a component is represented by its centre; its cos² θ_o, width in ω_o and λ."""
        # A transmitted order keeps its power at the horizon, with K_t, G_t and κ of the order.
        if self.by_order and way:
            return np.ones(square.shape, bool)
        turn = 2 * np.pi * self.height_range * sigma / (length * TURN)
        if self.by_order:
            return (square > turn**2) & (square > FAR_ORDER * sigma)
        # Or around the pole, as long as a cell is far from reaching the horizon.
        around = square > np.maximum(1 - 3 * sigma**2, 4 * sigma**2)
        return (square > turn**2) & ((square > FAR_CELL * sigma) | around)

    def _factor(
        self,
        cos_i: NDArray[np.float64],
        cos_o: NDArray[np.float64],
        length: NDArray[np.float64],
        tangent: NDArray[np.float64],
        way: int,
    ) -> NDArray[np.floating]:
        """Return K G F and gain, or K_t (1 − F), at |λq|² = `tangent`; F = 1 without a medium below."""
        if way:
            least = self.least_kappa / max(self.height_scale, 1e-9) * length / (2 * np.pi)
            return transmitted(cos_i, cos_o, tangent, self.index or 1.0, least)
        square = tangent + (cos_i + cos_o) ** 2
        value = k_g(cos_i, cos_o, square / 2)
        if not self.by_order:
            b = mirrored(tangent / (length * self.lobe_width) ** 2, cos_i, cos_o)
            if b.any():
                gain = [horizon_gain(cos**2 / (2 * length * self.lobe_width)) for cos in (cos_i, cos_o)]
                value = (1 - b) * value + b * gain[0] * gain[1]
        return value if self.index is None else value * fresnel(np.sqrt(square) / 2, self.index)

    def _power(
        self,
        power: Callable[[NDArray[np.float64]], NDArray[np.floating]],
        cos_i: NDArray[np.float64],
        cos_o: NDArray[np.float64],
        length: NDArray[np.float64],
        way: int,
    ) -> NDArray[np.floating]:
        """Return `power` at κ in rad/µm between two directions; of transmitted light with that sign of v_z only."""
        if not way:
            return power(2 * np.pi / length * (cos_i + cos_o))
        v_z = way * (cos_i - (self.index or 1.0) * cos_o)
        return power(2 * np.pi / length * np.maximum(v_z, 0)) * (v_z > 0)

    def _lobes(
        self,
        s: NDArray[np.float64],
        cos_i: NDArray[np.float64],
        length: NDArray[np.float64],
        place: NDArray[np.int64],
        component: NDArray[np.int64],
        square: NDArray[np.float64],
        way: int,
    ) -> NDArray[np.float64]:
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
        wide |= back & (
            (2 * np.pi * self.height_range * self.widths[component] / TURN) ** 2 * (1 - cos_i**2) > cos_i**2
        )
        for those, count in ((~lobe, 1), (wide, AZIMUTHAL), (lobe & ~wide, 1)):
            some = np.flatnonzero(those)
            for part in np.array_split(some, 1 + len(some) * RADIAL * count // CHUNK):
                if len(part):
                    arguments = s[part], cos_i[part], length[part], offset[part], component[part], back[part]
                    result[part] = self._lobe(*arguments, way, count, bool(lobe[part[0]]))
        return result

    def _lobe(
        self,
        s: NDArray[np.float64],
        cos_i: NDArray[np.float64],
        length: NDArray[np.float64],
        offset: NDArray[np.float64],
        component: NDArray[np.int64],
        back: NDArray[np.bool_],
        way: int,
        azimuths: int,
        lobes: bool,
    ) -> NDArray[np.float64]:
        """Integrate over lobes or cells, (n,).

        In polar coordinates of −ω_o,t = r (cos φ, sin φ), r² = 1 − cos² θ_o and r dr = −cos θ_o dcos θ_o.
        """
        s, cos_i, length, offset = s[:, None, None], cos_i[:, None, None], length[:, None, None], offset[:, None, None]
        index, component = (way and self.index) or 1.0, component[:, None, None]
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
            weight = (
                weight * np.exp(-((r - rho) ** 2) / (2 * sigma**2)) / (np.maximum(r, 1e-9) * np.sqrt(2 * np.pi) * sigma)
            )
        else:
            square = (r - rho) ** 2 + 4 * r * rho * np.sin(phi / 2) ** 2
            weight = weight * (2 / azimuths) * opening * np.exp(-square / (2 * sigma**2)) / (2 * np.pi * sigma**2)
        powers, x, y = partial(self.power, component, way=way), r * np.cos(phi), r * np.sin(phi)
        # −ω_o,t
        out_x, out_y = ahead[..., 0] * x - ahead[..., 1] * y, ahead[..., 1] * x + ahead[..., 0] * y
        if not self.by_order:
            tangent = (index * out_x - s[..., 0]) ** 2 + (index * out_y - s[..., 1]) ** 2 + index**2 * across
            power = weight * self._power(powers, cos_i, cos_o, length, way)
            return (power * self._factor(cos_i, cos_o, length, tangent, way)).sum((1, 2))
        # cos² of t_i and t_o; where ω_i changes, κ is that of the order.
        t_i, t_o = 1 - rho**2, 1 - (out_x - offset[..., 0]) ** 2 - (out_y - offset[..., 1]) ** 2
        in_, of = (np.sqrt(np.maximum(square, 1e-12) / 2) for square in (cos_i**2 + t_o, cos_o**2 + t_i))
        value = weight * (t_o > 0) * self._factor(in_, of, length, (offset**2).sum(-1), way)
        for square in (np.minimum(cos_i**2, t_i), np.minimum(cos_o**2, t_o)):
            value *= horizon_gain(np.maximum(square, 0) / (2 * sigma))
        # Of κ: where ω_i changes instead, it is the fixed one, and ω_o that which is sent on.
        back = back[:, None, None]
        cos_i, cos_o = (
            np.where(back, np.sqrt(np.maximum(square, 0)), cos) for square, cos in ((t_i, cos_i), (t_o, cos_o))
        )
        return (value * self._power(powers, cos_i, cos_o, length, way)).sum((1, 2))

    def albedo_of_nodes(
        self,
        spectrum: PowerSpectrum,
        directions: NDArray[np.float64],
        wavelengths: NDArray[np.float64],
        bounds: Sequence[Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[np.float64]]],
        seed: int = 0,
        pairs: bool = True,
    ) -> NDArray[np.float64]:
        """Compute the albedo with E from the stored spectrum, nothing gathered and lobes as wide as they are.

        By Monte Carlo: at least one point in the lobe of each node, more in strong ones. Transmitted light has E = e of
        the incident direction, which is no less than E.

        Args:
            spectrum: S(q; κ), of which the furnace is.
            directions: ω_i, (n, 3) unit vectors, along the pattern's axes.
            wavelengths: λ in µm in the medium of ω_i, (n,).
            bounds: e(ω, λ) of reflected and of transmitted light, for directions (m, 3) and wavelengths (m,) on the
                side of ω_i.
            seed: of the points.
            pairs: if not, reflected light, too, has e of the incident direction, which takes half of the time.

        Returns:
            (n,).
        """
        grid, sigma = spectrum.grid, spectrum.lobe_width
        q = np.stack(np.meshgrid(*grid.frequencies()), -1).reshape(-1, 2)
        kappas = np.array([0, 0.03, 0.1, 0.4, 0.7, 1]) * spectrum.max_kappa
        strength = np.stack([np.maximum(spectrum.powers(kappa), 0).ravel() for kappa in kappas]).sum(0)
        # Evenly along the sum of strengths, from a random start.
        rng, share = np.random.default_rng(seed), strength / strength.sum()
        node = np.searchsorted(share.cumsum(), (np.arange(POINTS) + rng.random()) / POINTS).clip(max=len(q) - 1)
        weight = 1 / (POINTS * share[node])
        # Points of one node follow each other in a sequence of low discrepancy (Roberts 2018).
        t = (rng.random(2) + np.arange(POINTS)[:, None] * ROBERTS) % 1
        # A node is a Gaussian, or a B-spline that ends at the Nyquist limit.
        if isinstance(grid, OrderGrid):
            points = q[node] + sigma * ndtri(t)
        else:
            offsets = np.linspace(-1.5, 1.5, 1025, dtype=np.float64)
            points = q[node] + np.interp(t, spline_integral(offsets), offsets) * grid.spacing
            kept = (np.abs(points) < grid.limit).all(-1)
            points, node, weight = points[kept], node[kept], weight[kept]
        (p_x, p_y), (q_x, q_y) = self.side * points.T, self.side * q.T
        result, own = np.zeros(len(directions)), [bound(directions, wavelengths) for bound in bounds]
        for place, way in np.ndindex(len(directions), len(self.ways)):
            way, (s_x, s_y, cos_i), length = self.ways[way], directions[place], wavelengths[place]
            index, sent = (way and self.index) or 1.0, length * (way or 1)
            square = 1 - ((s_x + sent * p_x) ** 2 + (s_y + sent * p_y) ** 2) / index**2
            lit = np.flatnonzero(square > 0)
            u_x, u_y, at, cos_o = sent * p_x[lit], sent * p_y[lit], node[lit], np.sqrt(square[lit])
            kappa_of = cos_i, cos_o
            if self.by_order:
                m_x, m_y = sent * q_x[at], sent * q_y[at]
                cos_i2 = 1 - (s_x + u_x - m_x) ** 2 - (s_y + u_y - m_y) ** 2
                cos_o2 = 1 - ((s_x + m_x) ** 2 + (s_y + m_y) ** 2) / index**2
                in_, out = (np.sqrt(np.maximum(x, 1e-12) / 2) for x in (cos_i**2 + cos_i2, cos_o**2 + cos_o2))
                value = self._factor(in_, out, length, m_x**2 + m_y**2, way) * ((cos_i2 > 0) & (cos_o2 > 0))
                # Transmitted light has κ of the order, with which K_t changes as fast.
                kappa_of = (in_, out) if way else kappa_of
                for x in (np.minimum(cos_i**2, index * cos_o2), np.minimum(index * cos_o**2, cos_i2)):
                    value *= horizon_gain(np.maximum(x, 0) / (2 * length * sigma))
            else:
                value = self._factor(cos_i, cos_o, length, u_x**2 + u_y**2, way)
            power = self._power(partial(self._power_of_nodes, spectrum, at, way), *kappa_of, length, way)
            e = own[abs(way)][place]
            if pairs and not way:
                out = np.stack([-s_x - u_x, -s_y - u_y, cos_o], -1)
                e = np.minimum(e, bounds[0](out, np.full(len(out), length)))
            result[place] += (value * weight[lit] * power * e).sum()
        return result

    def _power_of_nodes(
        self, spectrum: PowerSpectrum, node: NDArray[np.int64], way: int, kappa: NDArray[np.float64]
    ) -> NDArray[np.floating]:
        kappa = np.minimum(kappa * self.height_scale, spectrum.max_kappa)

        def power(kappa: NDArray[np.float64]) -> NDArray[np.float32]:
            return spectrum.table.powers_at(*np.divmod(node, spectrum.grid.shape[1]), kappa)

        if not way:
            return power(kappa)
        first, second = (power(np.full(len(node), n * self.least_kappa)) for n in (1, 2))
        return small_kappa(kappa, self.least_kappa, power(kappa), first, second)


def least_kappa(spectrum: PowerSpectrum, index: float, height_scale: float = 1.0) -> float:
    """Return κ₁, below which c_m/κ² of transmitted light is a line, in rad/µm of the heights as they are."""
    first, undiffracted = small_kappas(spectrum, index)
    return min(first, max(undiffracted * height_scale, 1e-6))


def small_kappas(spectrum: PowerSpectrum, index: float) -> tuple[float, float]:
    """Return the two numbers of which κ₁ is the smaller, in rad/µm.

    A quarter of the first interval of the table, where its error weighs as little as that of the line; and, times the
    scale of the heights, less than κ of the undiffracted order at all wavelengths, those of the spectrum being in the
    denser medium.
    """
    longest = spectrum.wavelengths[1] * 1e-3 * max(index, 1)
    return spectrum.table.first_interval / 4, 1.6 * np.pi * abs(index - 1) / longest


def small_kappa(
    kappa: NDArray[np.float64], least: float, power: NDArray, first: NDArray, second: NDArray
) -> NDArray[np.float64]:
    """Return κ₁²/κ² c_m(κ) below κ₁ = `least`, the line through c_m/κ² at κ₁ and 2κ₁; `power`, c_m(κ), above."""
    x = kappa / least
    return np.where(x < 1, (2 - x) * first + 0.25 * (x - 1) * second, power)


def mirrored(
    square: NDArray[np.float64], cos_i: NDArray[np.float64], cos_o: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return b, the share of S at |q|²/σ_q² that is taken for the mirror order's."""
    return np.clip((25 - square) / 9, 0, 1) * np.clip(2 - 5 * np.maximum(cos_i, cos_o), 0, 1)


def _gathered(
    spectrum: PowerSpectrum, kappas: NDArray[np.float64], own: NDArray[np.float64] | float, coarser: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Gather the nodes of `spectrum` in the cells of a lattice, those near the mirror direction apart.

    Args:
        spectrum: of overlapping orders or of a sample.
        kappas: rad/µm, equidistant.
        own: the standard deviation of what a node stands for, cycles/µm, along x and y.
        coarser: times the width of a cell.

    Returns:
        Centres of power (n, 2), standard deviations (n,), both in cycles/µm, and powers (n, K).
    """
    sigma = spectrum.lobe_width
    q = np.stack(np.meshgrid(*spectrum.grid.frequencies()), -1).reshape(-1, 2)
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
    widths = np.sqrt((np.maximum(square - centre**2, 0) + np.square(own)).mean(-1))
    return centre, widths, CubicSpline(few, powers, axis=1)(kappas)
