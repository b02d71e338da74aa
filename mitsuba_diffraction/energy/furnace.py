"""The albedo of a perfect mirror with the relief of a surface, in a white furnace.

With R = 1 and E = 1 the BSDF reflects

    a(ω_i, λ) = ∫ K G S(q; κ) W dq    over the q whose ω_o is above the surface (du dv = cos θ_o dω_o = λ² dq)

a is summed over components of S: the orders of a grating, or, where orders overlap and of a sample, the cells of a
lattice in which S is gathered, each represented by a Gaussian as wide as the cell. An order is represented by the
centre of its lobe, which keeps its power, and so is a cell whose ω_o stays away from the horizon, as K G and κ hardly
change within it; other cells, and the lobe of the mirror direction, by points that are evenly spaced in cos θ_o.

K, G and W are those of the BSDF. With s_i = ω_i,t, s_o = ω_o,t, w = cos θ_i + cos θ_o, d(s) = (1 − |s|²)/2λσ_q and
g the `horizon_gain`, an order m that is evaluated by itself has

    t_i = s_i + λ m/T,    t_o = s_o + λ m/T,    W = g(min(d(s_i), d(t_i))) g(min(d(s_o), d(t_o)))

if |t_i| < 1 and |t_o| < 1, else W = 0, and K G of the cosines √(cos² θ_i + 1 − |t_o|²)/√2, √(cos² θ_o + 1 − |t_i|²)/√2
and of |λm/T|. Orders that overlap, and samples, have (1 − b) K G + b g(d(s_i)) g(d(s_o)) with

    b = clip((25 − |q|²/σ_q²)/9, 0, 1) clip(2 − 5 max(cos θ_i, cos θ_o), 0, 1)
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.polynomial.legendre import leggauss
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.ndimage import maximum_filter1d
from scipy.special import ndtri

from ..geometry import horizon_gain, k_g
from ..spectrum.orders import OrderGrid
from ..spectrum.power_spectrum import PowerSpectrum
from ..spectrum.spline_grid import spline_integral

KAPPA_STEP = 0.1  # radians of the fastest oscillation over κ, between which powers are linear
CELL, CELLS = 0.2, 500  # width of a gathered cell in direction cosines at the shortest wavelength; cells at least
MIRROR_CELL = 0.75  # the same in the lobe of the mirror direction, in σ_q, at most
FAR_CELL = 20  # cos² θ_o in λσ from which a cell is represented by its centre
TURN = 0.5  # radians by which the phase of the deepest point may change within such a cell
REACH = 4.2  # standard deviations to which a component is integrated
NARROW = 0.02  # λσ up to which a lobe is integrated along the radius alone
RADIAL, AZIMUTHAL = 9, 13  # points of a lobe
RADIAL_CELL = 3  # of a cell
BLUR = 0.05  # a cell of a table in three dimensions, as a share of the largest κ
POINTS = 6000  # drawn by power among the nodes of a spectrum
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
    """

    q: NDArray[np.float64] = field(repr=False)
    widths: NDArray[np.float64] = field(repr=False)
    powers: NDArray[np.float32] = field(repr=False)
    max_kappa: float
    height_scale: float
    height_range: float
    lobe_width: float
    by_order: bool

    @classmethod
    def of(cls, spectrum: PowerSpectrum, height_scale: float = 1.0) -> Furnace:
        """Return the components of `spectrum`, with its heights scaled by `height_scale`."""
        grid, by_order = spectrum.grid, evaluated_by_order(spectrum)
        max_kappa = spectrum.largest_kappa
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
            q, widths, powers = _gathered(spectrum, kappas, own)
        # In deep surfaces phases turn faster than a table in three dimensions follows: where few nodes make up a
        # component, its power is the largest near.
        deep = max_kappa * spectrum.height_range * height_scale * BLUR > 1
        if deep and 1 not in grid.shape and 16 * len(q) > np.prod(grid.shape):
            powers = maximum_filter1d(powers, 1 + int(BLUR * len(kappas)), axis=1)
        kept = powers.max(-1) > 1e-7
        return cls(
            q[kept],
            widths[kept],
            np.ascontiguousarray(np.maximum(powers[kept], 0), np.float32),
            max_kappa,
            height_scale,
            spectrum.height_range * height_scale,
            spectrum.lobe_width,
            by_order,
        )

    def power(self, component: NDArray[np.int64], kappa: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return p_j(κ), linear between nodes; κ in rad/µm of the scaled heights; shapes broadcast."""
        place = self._place(kappa)
        cell = place.astype(np.int64)
        flat, index = self.powers.ravel(), component * self.powers.shape[1] + cell
        below = flat[index]
        return below + (place - cell) * (flat[index + 1] - below)

    def _place(self, kappa: NDArray[np.float64]) -> NDArray[np.float64]:
        last = self.powers.shape[1] - 1
        return np.minimum(kappa * (self.height_scale * last / self.max_kappa), last * (1 - 1e-12))

    def albedo(self, directions: NDArray[np.float64], wavelengths: NDArray[np.float64]) -> NDArray[np.float64]:
        """Compute a(ω, λ).

        Args:
            directions: ω, (n, 3) unit vectors above the surface, along the pattern's axes.
            wavelengths: λ in µm, (n,).

        Returns:
            (n,).
        """
        result = np.zeros(len(directions))
        # Neighbours reach about the same components.
        for some in np.array_split(np.arange(len(directions)), 1 + len(directions) * len(self.q) // (8 * CHUNK)):
            s, cos_i, length = directions[some, :2], directions[some, 2], wavelengths[some]
            edge = 0.0 if self.by_order else REACH * self.widths
            middle, mean = s.mean(0), (length.min() + length.max()) / 2
            spread = np.hypot(*(s - middle).T).max()
            reach = 1 + spread + (length.max() - mean) * np.hypot(*self.q.T) + length.max() * edge
            reached = np.flatnonzero(np.hypot(*(middle + mean * self.q).T) < reach)
            square = 1 - sum((s[:, k, None] + np.multiply.outer(length, self.q[reached, k])) ** 2 for k in (0, 1))
            lowest = 0.0 if self.by_order else -2 * REACH * np.multiply.outer(length, self.widths[reached])
            place, component = np.nonzero(square > lowest)
            square, component = square[place, component], reached[component]
            far = self._far(square, length[place] * self.widths[component], length[place])
            i, j = place[far], component[far]
            result[some] += np.bincount(i, self._centre(i, j, cos_i, length, np.sqrt(square[far])), len(some))
            i, j = place[~far], component[~far]
            result[some] += np.bincount(i, self._lobes(s[i], cos_i[i], length[i], j), len(some))
        return result

    def line_albedo(self, x: NDArray[np.float64], nu: NDArray[np.float64]) -> NDArray[np.float64]:
        """Compute a of a line grating along x, which depends on x and ν alone, c = √(1 − ω_y²).

        Args:
            x: ω_x/c, (n,).
            nu: c/λ in 1/µm, (n,).

        Returns:
            (n,).
        """
        result, cos_i = np.zeros(len(x)), np.sqrt(1 - x**2)
        for some in np.array_split(np.arange(len(x)), 1 + len(x) * len(self.q) // (8 * CHUNK)):
            t = x[some, None] + np.multiply.outer(1 / nu[some], self.q[:, 0])
            place, component = np.nonzero(np.abs(t) < 1)
            cos_o = np.sqrt(1 - t[place, component] ** 2)
            result[some] = np.bincount(place, self._centre(some[place], component, cos_i, 1 / nu, cos_o), len(some))
        return result

    def _far(
        self, square: NDArray[np.float64], sigma: NDArray[np.float64], length: NDArray[np.float64]
    ) -> NDArray[np.bool_]:
        """Return whether a component is represented by its centre; cos² θ_o, λσ and λ of each."""
        if self.by_order:
            # K and G are those of the order, and its lobe keeps its power at the horizon.
            return np.ones(square.shape, bool)
        turn = 2 * np.pi * self.height_range * sigma / length / TURN
        return (square > FAR_CELL * sigma) & (square > turn**2)

    def _centre(self, i, j, cos_i, length, cos_o) -> NDArray[np.float64]:
        """Return K G W p of the centres of components j from places i."""
        cos_i, length = cos_i[i], length[i]
        w = cos_i + cos_o
        square = length**2 * (self.q[j] ** 2).sum(-1)
        value = k_g(cos_i, cos_o, (square + w**2) / 2)
        if not self.by_order:
            b = mirrored(square / (length * self.lobe_width) ** 2, cos_i, cos_o)
            value = (1 - b) * value + b
        return value * self.power(j, 2 * np.pi * w / length)

    def _lobes(
        self,
        s: NDArray[np.float64],
        cos_i: NDArray[np.float64],
        length: NDArray[np.float64],
        component: NDArray[np.int64],
    ) -> NDArray[np.float64]:
        """Integrate K G W p over cells near the horizon and the lobe of the mirror order, (n,)."""
        result = np.empty(len(s))
        mirror = (self.q[component] == 0).all(-1)
        wide = mirror & (length * self.widths[component] > NARROW)
        for those, count in ((~mirror, 1), (wide, AZIMUTHAL), (mirror & ~wide, 1)):
            some = np.flatnonzero(those)
            for part in np.array_split(some, 1 + len(some) * RADIAL * count // CHUNK):
                if len(part):
                    arguments = s[part], cos_i[part], length[part], component[part]
                    result[part] = self._lobe(*arguments, count, bool(mirror[part[0]]))
        return result

    def _lobe(
        self,
        s: NDArray[np.float64],
        cos_i: NDArray[np.float64],
        length: NDArray[np.float64],
        component: NDArray[np.int64],
        azimuths: int,
        lobes: bool,
    ) -> NDArray[np.float64]:
        """Integrate K G W p over cells, or the lobe of the mirror order, near the horizon, (n,).

        In polar coordinates of −ω_o,t = r (cos φ, sin φ), r² = 1 − cos² θ_o and r dr = −cos θ_o dcos θ_o.
        """
        s, cos_i, length = s[:, None, None], cos_i[:, None, None], length[:, None, None]
        sigma, offset = length * self.widths[component, None, None], length[..., None] * self.q[component, None, None]
        t = s + offset
        rho = np.hypot(t[..., 0], t[..., 1])
        reach = (REACH if lobes else np.sqrt(3)) * sigma
        nearest, farthest = np.maximum(rho - reach, 0), rho + reach
        highest, lowest = np.sqrt(1 - np.minimum(nearest, 1) ** 2), np.sqrt(1 - np.minimum(farthest, 1) ** 2)
        nodes, weights = leggauss(RADIAL if lobes else RADIAL_CELL)
        cos_o = np.maximum(lowest + (highest - lowest) * ((1 + nodes) / 2)[:, None], 1e-6)
        r = np.sqrt(1 - cos_o**2)
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
        ahead = t / np.maximum(rho, 1e-12)[..., None]
        cosine, sine = r * np.cos(phi), r * np.sin(phi)
        out = np.stack(
            [ahead[..., 0] * cosine - ahead[..., 1] * sine, ahead[..., 1] * cosine + ahead[..., 0] * sine], -1
        )  # −ω_o,t
        w = cos_i + cos_o
        own = length * self.lobe_width
        from_horizon = cos_i**2 / (2 * own), cos_o**2 / (2 * own)
        square = ((out - s) ** 2).sum(-1)
        value, b = k_g(cos_i, cos_o, (square + w**2) / 2), mirrored(square / own**2, cos_i, cos_o)
        if b.any():
            value = (1 - b) * value + b * horizon_gain(from_horizon[0]) * horizon_gain(from_horizon[1])
        return (weight * value * self.power(component[:, None, None], 2 * np.pi * w / length)).sum((1, 2))


def mirrored(
    square: NDArray[np.float64], cos_i: NDArray[np.float64], cos_o: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return b, the share of S at |q|²/σ_q² that is taken for the mirror order's."""
    return np.clip((25 - square) / 9, 0, 1) * np.clip(2 - 5 * np.maximum(cos_i, cos_o), 0, 1)


def _gathered(
    spectrum: PowerSpectrum, kappas: NDArray[np.float64], own: NDArray[np.float64] | float
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Gather the nodes of `spectrum` in the cells of a lattice, those near the mirror direction apart.

    Args:
        spectrum: of overlapping orders or of a sample.
        kappas: rad/µm, equidistant.
        own: the standard deviation of what a node stands for, cycles/µm, along x and y.

    Returns:
        Centres of power (n, 2), standard deviations (n,), both in cycles/µm, and powers (n, K).
    """
    sigma = spectrum.lobe_width
    q = np.stack(np.meshgrid(*spectrum.grid.frequencies()), -1).reshape(-1, 2)
    shortest = 4 * np.pi / spectrum.largest_kappa
    width = min(CELL / shortest, np.sqrt(np.prod(np.minimum(np.ptp(q, axis=0), 4 / shortest)) / CELLS))
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


def albedo_of_nodes(
    spectrum: PowerSpectrum,
    directions: NDArray[np.float64],
    wavelengths: NDArray[np.float64],
    height_scale: float,
    bound: Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[np.float64]],
    seed: int = 0,
) -> NDArray[np.float64]:
    """Compute the albedo with E from the stored spectrum, nothing gathered and lobes as wide as they are.

    By Monte Carlo: at least one point in the lobe of each node, more in strong ones.

    Args:
        spectrum: S(q; κ).
        directions: ω_i, (n, 3) unit vectors, along the pattern's axes.
        wavelengths: λ in µm, (n,).
        height_scale: times the heights.
        bound: e(ω, λ) of directions (m, 3) and wavelengths (m,).
        seed: of the points.

    Returns:
        (n,).
    """
    rng, grid, sigma = np.random.default_rng(seed), spectrum.grid, spectrum.lobe_width
    q = np.stack(np.meshgrid(*grid.frequencies()), -1).reshape(-1, 2)
    lines = isinstance(grid, OrderGrid)
    spacing: NDArray[np.float64]
    limit: NDArray[np.float64]
    # A node is a Gaussian, or a B-spline that ends at the Nyquist limit.
    if isinstance(grid, OrderGrid):
        spacing, limit, reach = np.full(2, sigma), np.full(2, np.inf), 4 * sigma
    else:
        spacing, limit = np.array(grid.spacing), np.array(grid.limit)
        reach = 1.5 * np.hypot(*spacing)
    strength = np.sum(
        [np.maximum(spectrum.powers(x * spectrum.largest_kappa), 0).ravel() for x in (0.1, 0.4, 0.7, 1.0)], axis=0
    )
    offsets = np.linspace(-1.5, 1.5, 1025, dtype=np.float64)
    integral = spline_integral(offsets)
    result = np.empty(len(directions))
    for index, (omega, length) in enumerate(zip(directions, wavelengths, strict=True)):
        s, cos_i = omega[:2], omega[2]
        reached = np.flatnonzero(np.hypot(*(s + length * q).T) < 1 + length * reach)
        count = 1 + (POINTS * strength[reached] / strength[reached].sum()).astype(np.int64)
        node, weight = np.repeat(reached, count), np.repeat(1 / count, count)
        # Points of one node follow each other in a sequence of low discrepancy (Roberts 2018).
        t = (rng.random(2) + np.arange(len(node))[:, None] * [0.7548776662466927, 0.5698402909980532]) % 1
        spread = (ndtri(t) if lines else np.interp(t, integral, offsets)) * spacing
        u = length * (q[node] + spread)
        square = 1 - ((s + u) ** 2).sum(-1)
        lit = (square > 0) & (np.abs(u) < length * limit).all(-1)
        u, node, weight, cos_o = u[lit], node[lit], weight[lit], np.sqrt(square[lit])
        w, tangent = cos_i + cos_o, (u**2).sum(-1)
        kappa = np.minimum(2 * np.pi * w * height_scale / length, spectrum.largest_kappa)
        row, column = np.divmod(node, grid.shape[1])
        power = spectrum.table.powers_at(row, column, kappa)
        out = np.concatenate([-s - u, cos_o[:, None]], -1)
        if evaluated_by_order(spectrum):
            offset = length * q[node]
            sent = 1 - ((s + offset) ** 2).sum(-1), 1 - ((out[:, :2] + offset) ** 2).sum(-1)
            in_, out_ = (np.sqrt(np.maximum(x, 1e-12) / 2) for x in (cos_i**2 + sent[1], cos_o**2 + sent[0]))
            nearest = np.minimum(cos_i**2, sent[0]), np.minimum(cos_o**2, sent[1])
            factor = k_g(in_, out_, ((offset**2).sum(-1) + (in_ + out_) ** 2) / 2) * (np.minimum(*sent) > 0)
            share: NDArray[np.float64] | float = 1.0
        else:
            nearest, share = (np.square(cos_i), cos_o**2), mirrored(tangent / (length * sigma) ** 2, cos_i, cos_o)
            factor = 1.0
        gain = [horizon_gain(np.maximum(x, 0) / (2 * length * sigma)) for x in nearest]
        value = (1 - share) * k_g(cos_i, cos_o, (tangent + w**2) / 2) + share * factor * gain[0] * gain[1]
        value *= weight * power
        e = np.minimum(bound(omega[None], length), bound(out, np.full(len(out), length)))
        result[index] = (value * e).sum()
    return result
