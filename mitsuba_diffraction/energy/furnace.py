"""The albedo of a surface in a white furnace: of a perfect mirror with its relief, or R and T of an interface.

With R = 1 and E = 1 the BSDF reflects

    a(ω_i, λ) = ∫ K G Γ S(q; κ) dq    over the q whose ω_o is above the surface (du dv = cos θ_o dω_o = λ² dq)

with the gain Γ of lobes at the horizon. a is summed over components of S, each evaluated once:

- An order that is evaluated by itself. With Γ it keeps its power wherever its centre propagates, so that it contributes
  K G η_m(κ). Where the horizon truncates its lobe, cosines are replaced by their mean over the lobe,

      cos θ → √(2λσ_q) m(x),    m(x) = ∫₀^∞ g(x) g(y) φ(x − y) √((x + y)/2) dy,    x = cos² θ/(2λσ_q)

  with the `horizon_gain` g; m(x) → √x away from the horizon. Where ω and the order are near the horizon (x < 4, of one
  of them x < 8), and the relief is deeper than λ, K G Γ η_m is integrated over the lobe, in which the two cosines vary
  together.
- Where orders overlap, and for a sample, a bin of the frequency plane, in which S is accumulated. The part of its
  radial extent that is above the horizon determines its weight and its cosine. Near the mirror direction at grazing
  incidence (1 − b) K G + b Γ replaces K G, as in `Geometry.continuum_factor` of `bsdf/directions.py`.

For an interface between media, the reflected and the transmitted fraction of light from one side are

    R(ω_i, λ) = ∫ F K G S(q; κ) Γ dq,    T(ω_i, λ) = ∫ F_t K_t G_t S(q; κ_t) Γ_t dq,    κ_t = 2π (cos θ_i − η cos θ_o)/λ

with λ in the medium of ω_i, wave vectors in units of n_i, and S(q; −κ) = S(−q; κ). F and F_t are R and T of a plane at
the half vector, of the films on the relief, if there are any (`optics/film_stack.py`); F_t = 1 − F without them. Seen
from below, the surface has the heights −h. A sheet uses the tables of an interface, as its flat face only removes
light.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.polynomial.legendre import leggauss
from numpy.typing import ArrayLike, NDArray

from ..array_types import Real
from ..optics.film_stack import Plane, Stack
from ..optics.geometry import AnyArray, fresnel, horizon_gain, k_g
from ..spectrum.grids import OrderGrid
from ..spectrum.power_spectrum import PowerSpectrum

Indices = NDArray[np.int64]

MAX_E = 1.05
"""Maximum stored 1/a; e is one where the interpolated value exceeds one, so that its kink lies at a = 1."""
KAPPA_STEP = 0.1  # radians of the phase of the deepest point between nodes in κ; powers are linear between nodes
MAX_KAPPAS = 1000  # nodes in κ of an interface, eight of which lie below κ₁
MAX_BIN_WIDTH = 0.12  # direction cosines at the shortest wavelength
MIN_BINS = 2000
INTERFACE_BIN_FACTOR = 1.5  # bins of an interface, which has three branches of light, are wider by this factor
MAX_MIRROR_BIN_WIDTH = 0.5  # within the lobe of the mirror direction, in σ_q
MAX_NODE_POINTS = 6  # on each side along x and y, for a node of S wider than half a bin
MAX_LOBE_PHASE = 0.1  # radians within one σ of the lobe of an order, above which it is evaluated at several points
LOBE_POINTS = 9
MAX_GRAZING, MAX_OTHER = 4.0, 8.0  # x of one and of the other of ω and an order, below which both cosines vary
MIN_POINTS, MAX_POINTS = 7, 24  # in √cos θ_o of such a lobe; one more for each four radians of phase
MAX_SIGMAS = 3.0
ACROSS, MAX_ACROSS = 3, 2.2  # points and their cutoff, σ, of the cosine of ω at a given cos θ_o
MIN_SINGLE_CONTRAST = 0.01  # |η − 1| below which v_z of transmitted light cancels too much for single precision
MIN_COS_ONE_POINT = 0.25  # cos θ_o below which a bin is evaluated at three points
MAX_PAIRS = 1 << 17  # (direction, component) evaluated at once, so that they fit into the cache


class _Terms(NamedTuple):
    """Terms of the albedo of components without their powers, n, or one for each pair of (directions, components).

    Indices are of shape (n,) each, or (directions, 1) and (components,).
    """

    direction: Indices
    component: Indices
    factor: Real  # K G Γ
    cosine: Real  # |ω_i·h|
    kappa: Real  # for unscaled heights, rad/µm


@dataclass(frozen=True, eq=False)
class Furnace:
    """S(q; κ) as a sum of components.

    Attributes:
        spectrum: S(q; κ).
        index: η = n_o/n_i, n_i being the index of the medium of ω; None if nothing is transmitted and F = 1.
        by_order: whether components are orders, each evaluated by itself: for line gratings, and if no orders overlap.
        q: (n, 2) cycles/µm, the centres of components.
        widths: (n,) cycles/µm, their standard deviations.
        powers: float32 (n, K), at K equidistant κ from 0 to κ_max of the spectrum, for unscaled heights.
        height_scale: the factor of the heights, the maximum if there are several.
        lobe_scale: the factor of the widths of lobes of orders.
        stack: the dielectric with its films, if light is transmitted.
        side: 1 if ω is above the surface, −1 if below.
        planes: R and T of its plane for each thickness, from `at_wavelength`. If empty, the surface is bare.
    """

    spectrum: PowerSpectrum = field(repr=False)
    index: float | None
    by_order: bool
    q: Real = field(repr=False)
    widths: Real = field(repr=False)
    powers: NDArray[np.float32] = field(repr=False)
    height_scale: float = 1.0
    lobe_scale: float = 1.0
    stack: Stack | None = None
    side: int = 1
    planes: tuple[Plane, ...] = ()

    @classmethod
    def of(
        cls,
        spectrum: PowerSpectrum,
        height_scale: float = 1.0,
        stack: Stack | None = None,
        lobe_scale: float = 1.0,
    ) -> Furnace:
        """Return the components of `spectrum` for light from above.

        Args:
            spectrum: S(q; κ).
            height_scale: the factor of the heights, the maximum if there are several.
            stack: the dielectric with its films, if light is transmitted.
            lobe_scale: the factor of the widths of lobes of orders.
        """
        grid, max_kappa = spectrum.grid, spectrum.max_kappa
        index = None if stack is None else stack.nominal
        by_order = isinstance(grid, OrderGrid) and (1 in grid.shape or all(lobe.count == 1 for lobe in spectrum.lobes))
        count = max_kappa * spectrum.height_range / KAPPA_STEP
        if index is not None:
            # Below κ₁ powers are nearly parabolas in κ; K_t multiplies them by about 1/κ².
            count = max(count, min(8 * max_kappa / min_kappa(spectrum, index), MAX_KAPPAS))
        kappas = np.linspace(0, max_kappa, int(count) + 3, dtype=np.float64)
        powers: NDArray[np.floating]
        if by_order:
            powers = np.stack([spectrum.powers(kappa).ravel() for kappa in kappas], 1)
            # Truncated lobes are renormalised.
            powers /= np.prod([lobe.inside for lobe in spectrum.lobes])
            q, widths = _nodes(spectrum), np.full(len(powers), spectrum.lobe_width)
        else:
            q, widths, powers = _binned(spectrum, kappas, 1.0 if index is None else INTERFACE_BIN_FACTOR)
        kept = powers.max(-1) > 1e-7
        powers = np.ascontiguousarray(np.maximum(powers[kept], 0), np.float32)
        return cls(spectrum, index, by_order, q[kept], widths[kept], powers, height_scale, lobe_scale, stack)

    def from_below(self) -> Furnace:
        """Return the components for light from below, where the surface has the heights −h and S(−q; κ)."""
        return replace(self, index=None if self.index is None else 1 / self.index, q=-self.q, side=-self.side)

    def at_wavelength(
        self, wavelength: float, laterals: tuple[float, float] = (1.0, 1.0), step: float = 0.0
    ) -> Furnace:
        """Return the components with the index and R and T of a plane at one wavelength, µm in the medium above.

        `laterals` are the bounds of the scale of lengths s, by which the wavelength is divided; for `step` see
        `Stack.planes`.
        """
        if self.stack is None or self.stack.is_plain:
            return self
        mean = (laterals[0] + laterals[1]) / 2
        vacuum = wavelength * mean * self.stack.outside
        index = self.stack.index(vacuum) ** self.side
        return replace(self, index=index, planes=tuple(self.stack.planes(vacuum, self.side, laterals, step)))

    @property
    def branches(self) -> tuple[int, ...]:
        """0 for reflected light; for an interface also ±1, for transmitted light whose v_z has this sign."""
        return (0,) if self.index is None else (0, 1, -1)

    @property
    def _planes(self) -> tuple[Plane, ...]:
        index = self.index
        if self.planes or index is None:
            return self.planes or (lambda cosine: (np.ones_like(cosine), np.zeros_like(cosine)),)

        def bare(cosine: Real) -> tuple[Real, Real]:
            reflected = np.mean(fresnel(cosine, index), axis=0)
            return reflected, 1 - reflected

        return (bare,)

    def bounds(self, directions: Real, wavelengths: Real, scales: Sequence[float]) -> Real:
        """Return e of E (`bounds_of`) for the same directions and wavelengths as `albedo`.

        Where the thickness of films varies, e = 1/max(1, R + T) at the worst thickness, for both R and T.

        Args:
            directions, wavelengths: see `albedo`.
            scales: factors of the heights, up to `height_scale`.

        Returns:
            (scales, 1 or 2, n).
        """
        albedos = self._albedos(directions, wavelengths, scales)
        if albedos.shape[1] > 1:
            return 1 / np.maximum(albedos.sum(axis=2).max(axis=1), 1)[:, None] * np.ones((2, 1))
        normal = None if self.index is None else float(self._planes[0](np.ones(1))[0][0])
        return np.stack([bounds_of(albedo, normal) for albedo in albedos[:, 0]])

    def albedo(self, directions: Real, wavelengths: Real) -> Real:
        """Compute a(ω, λ), or R and T of an interface, of films of their mean thickness.

        Args:
            directions: ω, (n, 3) unit vectors along the axes of the pattern, with z > 0 away from the surface.
            wavelengths: λ in µm in the medium of ω, (n,).

        Returns:
            (1, n), or (2, n): R and T.
        """
        return self._albedos(directions, wavelengths, [self.height_scale])[0, len(self._planes) // 2]

    def _albedos(self, directions: Real, wavelengths: Real, scales: Sequence[float]) -> Real:
        """Return `albedo` for each factor of the heights and each thickness, (scales, planes, 1 or 2, n)."""
        planes = self._planes
        result = np.zeros((len(scales), len(planes), len(self.branches[:2]), len(directions)))
        # Adjacent directions share most of their components.
        for batch in np.array_split(np.arange(len(directions)), 1 + len(directions) * len(self.q) // MAX_PAIRS):
            for branch in self.branches:
                for term in self._terms(directions[batch], wavelengths[batch], branch):
                    factors = [term.factor * plane(term.cosine)[abs(branch)] for plane in planes]
                    for of_scale, scale in zip(result, scales, strict=True):
                        powers = self._power(term.component, term.kappa, branch, scale)
                        for of_plane, factor in zip(of_scale, factors, strict=True):
                            if factor.ndim == 1:
                                total = np.bincount(term.direction, factor * powers, len(batch))
                            else:
                                total = (factor * powers).sum(-1, np.float64)
                            of_plane[abs(branch), batch] += total
        return result

    def terms(self, directions: Real, length: Real, branch: int) -> tuple[Indices, Indices, Real]:
        """Compute the terms of `albedo` for one branch of light: index of direction, of order, and value.

        Order j diffracts light from ω to k_o,∥ = −ω_∥ − λ q_j, or −ω_∥ + λ q_j in branch −1, in units of n_i.
        """
        plane, count = self._planes[len(self._planes) // 2], len(self.q)
        totals = np.zeros(len(directions) * count)
        for term in self._terms(directions, length, branch):
            value = term.factor * plane(term.cosine)[abs(branch)] * self._power(term.component, term.kappa, branch)
            totals += np.bincount(term.direction * count + term.component, value, len(totals))
        found = np.flatnonzero(totals)
        return found // count, found % count, totals[found]

    def _terms(self, directions: Real, length: Real, branch: int) -> list[_Terms]:
        """Return the `terms` without R or T and powers, in parts."""
        index = (branch and self.index) or 1.0
        if not self.by_order and (not branch or abs(index - 1) >= MIN_SINGLE_CONTRAST):
            # Bins are wide; but an order is above the horizon or not.
            directions, length = directions.astype(np.float32), length.astype(np.float32)
        s, cos_i = directions[:, :2], np.abs(directions[:, 2])
        q = (self.q * (branch or 1)).astype(length.dtype)
        radius = np.zeros_like(q[:, 0]) if self.by_order else (np.sqrt(3) * self.widths).astype(length.dtype)
        middle, mean = s.mean(0), (length.min() + length.max()) / 2
        cutoff = index + np.hypot(*(s - middle).T).max() + (length.max() - mean) * np.hypot(*q.T)
        near = np.flatnonzero(np.hypot(*(middle + mean * q).T) < cutoff + length.max() * radius)
        # cos² θ_o = 1 − |ω_∥ + λq|²/η²
        square = np.repeat(1 - (1 - cos_i[:, None] ** 2) / index**2, len(near), axis=1)
        for k in np.flatnonzero(q.any(0)):
            u = np.multiply.outer(length, q[near, k])
            square -= u * (u + 2 * s[:, k, None]) / index**2
        if not self.by_order:
            return self._bin_terms(cos_i, length, near, np.sqrt(np.maximum(1 - square, 0)), branch)
        i, j = np.nonzero(square > 0)
        square, j = square[i, j], near[j]
        sigma = length[i] * (self.lobe_scale * self.spectrum.lobe_width)
        # In shallow reliefs the mean of each cosine suffices: K G is large where κ, and with it η, is small.
        grazing = self.spectrum.height_range * self.height_scale > length[i]
        lower, higher = np.sort([cos_i[i] ** 2, index * square], axis=0) / (2 * sigma)
        grazing &= (lower < MAX_GRAZING) & (higher < MAX_OTHER)
        parts = [(part, both) for part, both in ((~grazing, False), (grazing, True)) if part.any()]
        return [self._order_terms(s, length, i[part], j[part], square[part], branch, both) for part, both in parts]

    def _order_terms(
        self, s: Real, length: Real, i: Indices, j: Indices, square: Real, branch: int, grazing: bool
    ) -> _Terms:
        """Compute the `_terms` of orders j of directions i, whose centres have cos² θ_o = `square` > 0, (n,) each.

        Args:
            s, length: ω_∥ and λ of all directions.
            i, j, square: of the pairs.
            branch: see `branches`.
            grazing: whether both directions are near the horizon, so that their cosines vary together within a lobe.
        """
        index, width = (branch and self.index) or 1.0, self.lobe_scale * self.spectrum.lobe_width
        cos_i, sigma = np.sqrt(1 - (s**2).sum(-1))[i], length[i] * width
        phase, weight = 2 * np.pi * self.spectrum.height_range * self.height_scale, np.ones(1)
        if grazing:
            highest = np.sqrt(2 * (MAX_OTHER + MAX_SIGMAS) * width / (index * length.min()))
            points = int(min(MIN_POINTS + phase * highest / 4, MAX_POINTS))
            tangent = s[i] + length[i, None] * (branch or 1) * self.q[j]
            mean_cos_i, cos_exit, cos_o, weight = _over_grazing_lobe(s[i], tangent, sigma, index, points)
        else:
            mean_cos_i, cos_exit = mean_cosine(cos_i**2, sigma), mean_cosine(square, sigma / index)
            cos_o = cos_exit
            if phase * width > MAX_LOBE_PHASE:
                cos_exit, cos_o, weight = _over_lobe(square, sigma / index)
        if (count := len(weight) // len(i)) > 1:
            i, j, cos_i = (np.tile(x, count) for x in (i, j, cos_i))
            mean_cos_i = np.resize(mean_cos_i, len(i))
        length = length[i]
        value, cosine = self._factor(mean_cos_i, cos_o, length, length**2 * (self.q**2).sum(-1)[j], branch)
        # Reflected light uses κ of the two directions; transmitted light uses κ of the order's exact direction.
        kappa = self._kappa(mean_cos_i if branch else cos_i, cos_o if branch else cos_exit, length, branch)
        return _Terms(i, j, weight * value, cosine, kappa)

    def _bin_terms(self, cos_i: Real, length: Real, bins: Indices, rho: Real, branch: int) -> list[_Terms]:
        """Compute the `_terms` of directions (n,) and `bins` (m,), whose centres have sin θ_o = ρ, (n, m).

        Near the horizon a bin has three terms, at points in cos θ_o, as K G varies with that, over the radial extent
        ρ ± √3 σ.
        """
        index = (branch and self.index) or 1.0
        sigma = np.multiply.outer(length / index, self.widths.astype(length.dtype)[bins])
        tangent = np.multiply.outer(length**2, (self.q**2).sum(-1).astype(length.dtype)[bins])
        radius = float(np.sqrt(3)) * sigma
        far = (rho + radius) ** 2 <= 1 - np.maximum(sigma, MIN_COS_ONE_POINT) ** 2
        i, j = np.nonzero(~far & (rho - radius < 1))
        cos_o, r, _ = _above_horizon(rho, sigma, 1)
        all_i = np.arange(len(cos_i))[:, None]
        value, *others = self._at_points(cos_i[:, None], length[:, None], rho, sigma, tangent, cos_o, r, branch)
        of_far = _Terms(all_i, bins, value * far, *others)
        rho, sigma, tangent = (x[i, j] for x in (rho, sigma, tangent))
        cos_o, r, weight = _above_horizon(rho, sigma, 3)
        value, cosine, kappa = self._at_points(cos_i[i], length[i], rho, sigma, tangent, cos_o, r, branch)
        near = np.tile(i, 3), np.tile(bins[j], 3), (value * weight).ravel(), cosine.ravel(), kappa.ravel()
        return [of_far, _Terms(*near)]

    def _at_points(
        self,
        cos_i: Real,
        length: Real,
        rho: Real,
        sigma: Real,
        tangent: Real,
        cos_o: Real,
        r: Real,
        branch: int,
    ) -> tuple[Real, Real, Real]:
        """Return `_factor` and κ at points r of bins of width σ about ρ and |λq|² = `tangent`."""
        index, square = (branch and self.index) or 1.0, np.maximum(1 - cos_i**2, 0)
        # |λq|² along the line from the centre of the hemisphere; the component of ω_∥ along it is at most sin θ_i.
        max_along = 2 * index * np.sqrt(square)
        along = np.clip((index**2 * rho**2 + square - tangent) / np.maximum(rho, 1e-12), -max_along, max_along)
        tangent = np.maximum(square + index**2 * r**2 - r * along, 0) + (index * sigma) ** 2
        return *self._factor(cos_i, cos_o, length, tangent, branch), self._kappa(cos_i, cos_o, length, branch)

    def _factor(self, cos_i: Real, cos_o: Real, length: Real, tangent: Real, branch: int) -> tuple[Real, Real]:
        """Return K G with the gain, or K_t G_t, at |λq|² = `tangent`, and |ω_i·h|, (..., n); λ is (n,)."""
        if branch:
            index = self.index or 1.0
            min_v_z = self._min_kappa(self.height_scale) / max(self.height_scale, 1e-9) * length / (2 * np.pi)
            k_oz = index * np.asarray(cos_o)
            square = tangent + (cos_i - k_oz) ** 2
            cosine = np.abs(square + 1 - index**2) / (2 * np.sqrt(square))
            value = k_g(cos_i, k_oz, tangent, 1 - index**2, False, min_v_z=np.maximum(min_v_z, 1e-6))
            return value, np.minimum(cosine, 1)
        square = tangent + (cos_i + cos_o) ** 2
        value = k_g(cos_i, cos_o, tangent)
        if not self.by_order:
            # Few bins are so near the mirror direction that b is not zero.
            width = length * self.spectrum.lobe_width
            mirror = np.nonzero((tangent < 25 * width**2) & (np.maximum(cos_i, cos_o) < 0.4))
            c_i, c_o, width, distance = (
                np.broadcast_to(x, value.shape)[mirror] for x in (cos_i, cos_o, width, tangent)
            )
            b = np.clip((25 - distance / width**2) / 9, 0, 1) * np.clip(2 - 5 * np.maximum(c_i, c_o), 0, 1)
            gain = horizon_gain(c_i**2 / (2 * width)) * horizon_gain(c_o**2 / (2 * width))
            value[mirror] += b * (gain - value[mirror])
        return value, np.sqrt(square) / 2

    def _kappa(self, cos_i: Real, cos_o: Real, length: Real, branch: int) -> Real:
        """Return κ in rad/µm of two directions; zero if v_z of transmitted light lacks the sign of the branch."""
        v_z = branch * (cos_i - (self.index or 1.0) * cos_o) if branch else cos_i + cos_o
        return 2 * np.pi / length * np.maximum(v_z, 0)

    def _min_kappa(self, scale: float) -> float:
        nominal = 1.0 if self.stack is None else self.stack.nominal**self.side
        return min_kappa(self.spectrum, nominal, scale, self.lobe_scale)

    def _power(self, component: Indices, kappa: Real, branch: int, scale: float | None = None) -> Real:
        """Return the powers of components at κ, for heights times `scale`, by default `height_scale`.

        For transmitted light below κ₁ see `small_kappa`. The terms have K_t with the κ₁ of `height_scale`; it is
        corrected for that of `scale`.
        """
        last, scale = self.powers.shape[1] - 1, self.height_scale if scale is None else scale
        flat, start = self.powers.ravel(), component * (last + 1)

        def power_at(kappa: Real | float) -> Real:
            x = np.minimum(kappa * (last / self.spectrum.max_kappa), last)
            interval = np.minimum(np.floor(x), last - 1)
            index = start + interval.astype(np.int64)
            below = flat.take(index)
            return below + (x - interval) * (flat[1:].take(index) - below)

        scaled = kappa * scale
        if not branch:
            return power_at(scaled)
        first = self._min_kappa(scale)
        power = small_kappa(scaled, first, power_at(scaled), power_at(first), power_at(2 * first)) * (kappa > 0)
        if scale != self.height_scale:
            of_terms, of_scale = (self._min_kappa(x) / max(x, 1e-9) for x in (self.height_scale, scale))
            power = power * (np.maximum(kappa, of_terms) / np.maximum(kappa, of_scale)) ** 2
        return power


def min_kappa(spectrum: PowerSpectrum, index: float, height_scale: float = 1.0, lateral_scale: float = 1.0) -> float:
    """Return κ₁ in rad/µm, below which c_m/κ² of transmitted light is extrapolated linearly; scales h/s and s."""
    first, undiffracted = small_kappas(spectrum, index, lateral_scale)
    return min(first, undiffracted * height_scale)


def small_kappas(spectrum: PowerSpectrum, index: float, lateral_scale: float = 1.0) -> tuple[float, float]:
    """Return the two bounds whose minimum is κ₁, in rad/µm.

    The first is a quarter of the first interval of the table, where its error is as small as the error of the linear
    extrapolation. The second, to be multiplied by the ratio h/s of the scales of heights and lengths, is 0.8 of the
    minimum κ of undiffracted light at normal incidence; the longest wavelength is λ/s, with the minimum s. Wavelengths
    of the spectrum are measured in the denser medium.
    """
    max_wavelength = spectrum.wavelengths[1] * 1e-3 * max(index, 1) / lateral_scale
    return spectrum.table.first_interval / 4, 1.6 * np.pi * abs(index - 1) / max_wavelength


def small_kappa(
    kappa: AnyArray,
    first: AnyArray,
    power: AnyArray,
    at_first: AnyArray,
    at_second: AnyArray,
    where: AnyArray = True,
    select: Callable[..., Any] = np.where,
) -> AnyArray:
    """Return c_m(κ), and κ₁²/κ² c_m(κ) where κ < κ₁ = `first`.

    c_m of m ≠ 0 falls as κ² towards zero, below the absolute error of the table; therefore c_m/κ² is extrapolated
    linearly from its values at κ₁ and 2κ₁.

    Args:
        kappa: κ in rad/µm.
        first: κ₁ in rad/µm.
        power, at_first, at_second: c_m, or the factors of c_m, at κ, κ₁ and 2κ₁.
        where: the pairs of directions to which this applies.
        select: `numpy.where` or `drjit.select`.
    """
    x = kappa / select(first > 1e-30, first, 1e-30)
    return select(where & (kappa < first), (2 - x) * at_first + 0.25 * (x - 1) * at_second, power)


def mean_cosine(square: ArrayLike, sigma: ArrayLike) -> Real:
    """Return √(2σ) m(x) for cos² θ = 2σx at the centre of a lobe of width σ in direction cosines."""
    scale = np.sqrt(2 * np.asarray(sigma, np.float64))
    root = np.asarray(np.sqrt(square) / scale)
    near = root < 4
    root[near] = np.interp(root[near], *_mean_roots())
    return scale * root


@cache
def _mean_roots() -> tuple[Real, Real]:
    """Return √x from 0 to 4 and m(x)."""
    root, y = np.linspace(0, 4, 101, dtype=np.float64), np.linspace(0, 24, 4801, dtype=np.float64)
    x = root[:, None] ** 2
    density = horizon_gain(x) * horizon_gain(y) * np.exp(-((x - y) ** 2) / 2) / np.sqrt(2 * np.pi)
    return root, np.trapezoid(density * np.sqrt((x + y) / 2), y, axis=1)


def _over_lobe(square: Real, sigma: Real) -> tuple[Real, Real, Real]:
    """Return points in a lobe of width σ about cos² θ_o: cos θ_o, the cosine in K G, and weight, (LOBE_POINTS · n,)."""
    x, spread = square / (2 * sigma), np.sqrt(np.maximum(1 - square, 1e-6))
    low, high = np.sqrt(np.maximum(x - 3 * spread, 0)), np.sqrt(x + 3 * spread)
    nodes, weights = leggauss(LOBE_POINTS)
    root = low + (high - low) * ((1 + nodes) / 2)[:, None]
    weight = weights[:, None] * root * np.exp(-(((root**2 - x) / spread) ** 2) / 2) * horizon_gain(root**2)
    scale = np.sqrt(2 * sigma)
    return (scale * root).ravel(), (scale * np.sqrt((x + root**2) / 2)).ravel(), (weight / weight.sum(0)).ravel()


def _over_grazing_lobe(s: Real, tangent: Real, sigma: Real, index: float, count: int) -> tuple[Real, Real, Real, Real]:
    """Return points in lobes of orders near the horizon, of ω near the horizon.

    The lobe has cos² θ_o = 2σy_o, and diffracts ω_o back into a direction of cos² θ = 2σy_i, with

        y_o = x_o + n_o sin θ_o,    y_i = x_i + n_i sin θ_i

    and standard normal n_i and n_o of correlation −k_i,∥·k_o,∥/|k_i,∥||k_o,∥|: in retroreflection
    one cosine grows as the other falls, and K G is large. Points are at `count` √y_o, each with `ACROSS` n_i.

    Args:
        s, tangent: ω_∥ and −k_o,∥ of the centre, in units of n_i, (n, 2).
        sigma: λσ_q, (n,).
        index: n_o/n_i.
        count: number of points in √y_o.

    Returns:
        cos θ of ω in K G, cos θ_o, cos θ_o in K G, and Γ times the density: (ACROSS · count · n,) each.
    """
    from scipy.special import ndtr

    sin_i, k_o = (np.maximum(np.hypot(*x.T), 1e-6) for x in (s, tangent))
    correlation, sin_o = (s * tangent).sum(-1) / (sin_i * k_o), k_o / index
    x_i, x_o = (1 - sin_i**2) / (2 * sigma), index * (1 - sin_o**2) / (2 * sigma)
    across = np.maximum(sin_i * np.sqrt(np.maximum(1 - correlation**2, 0)), 1e-9)
    # Where y_o > 0, and y_i > 0 for some n_i.
    bound = (x_i + MAX_SIGMAS * across) / np.maximum(sin_i * np.abs(correlation), 1e-6)
    high = np.minimum(MAX_SIGMAS, np.where(correlation < 0, bound, np.inf))
    low = np.maximum(np.maximum(-x_o / sin_o, -MAX_SIGMAS), np.where(correlation > 0, -bound, -np.inf))
    first, last = (np.sqrt(np.maximum(x_o + sin_o * n, 0)) for n in (np.minimum(low, high), high))
    nodes, weights = (x[:, None] for x in leggauss(count))
    root = first + (last - first) * ((1 + nodes) / 2)
    n_o = (root**2 - x_o) / sin_o
    weight = weights * (last - first) * root / sin_o * np.exp(-(n_o**2) / 2) / np.sqrt(2 * np.pi)
    mean = x_i + sin_i * correlation * n_o
    low = np.clip(-mean / across, -MAX_ACROSS, MAX_ACROSS)
    nodes, weights = (x[:, None, None] for x in leggauss(ACROSS))
    n_i = low + (MAX_ACROSS - low) * ((1 + nodes) / 2)
    density = weights * np.exp(-(n_i**2) / 2)
    above = (ndtr(MAX_ACROSS) - ndtr(low)) / (ndtr(MAX_ACROSS) - ndtr(-MAX_ACROSS))
    y_i, y_o = np.maximum(mean + across * n_i, 0), np.broadcast_to(root**2, n_i.shape)
    weight = weight * above * density / density.sum(0)
    weight *= horizon_gain(np.minimum(x_i, x_o)) * horizon_gain(np.minimum(y_i, y_o))
    squares = sigma * (x_i + y_i), 2 * sigma / index * y_o, sigma / index * (x_o + y_o)
    cos_i, cos_exit, cos_o = (np.sqrt(square).ravel() for square in squares)
    return cos_i, cos_exit, cos_o, weight.ravel()


def _above_horizon(rho: Real, sigma: Real, count: int) -> tuple[Real, Real, Real]:
    """Return cos θ_o, r and weight, (count, ...), of points in a bin of width σ whose centre is at r = ρ.

    r² + σ² + cos² θ_o = 1, where σ² is the variance across the radius; weights sum to the fraction of ρ ± √3 σ above
    the horizon. A single point, without a first axis, is for bins that are far above it and has the weight one.
    """
    radius, square = float(np.sqrt(3)) * sigma, 1 - sigma**2
    low, high = np.maximum(rho - radius, 0), rho + radius
    nearest, farthest = (np.sqrt(np.maximum(square - x**2, 0)) for x in (low, high))
    if count == 1:
        cos_o = np.maximum((nearest + farthest) / 2, 1e-6)
        return cos_o, np.sqrt(np.maximum(square - cos_o**2, 0)), np.ones_like(cos_o[:0])
    nodes, weights = (x.reshape(-1, *np.ones(rho.ndim, int)).astype(rho.dtype) for x in leggauss(count))
    cos_o = np.maximum(farthest + (nearest - farthest) * ((1 + nodes) / 2), 1e-6)
    r = np.sqrt(np.maximum(square - cos_o**2, 0))
    # dr = cos θ dcos θ/r
    weight = weights * cos_o / np.maximum(r, 1e-9)
    above = np.clip((np.sqrt(np.maximum(square, 0)) - low) / (high - low), 0, 1)
    return cos_o, r, weight * (above / weight.sum(0))


def _nodes(spectrum: PowerSpectrum) -> Real:
    """Return q of all nodes of S, (rows · columns, 2) cycles/µm."""
    return np.stack(np.meshgrid(*spectrum.grid.frequencies()), -1).reshape(-1, 2)


def _binned(spectrum: PowerSpectrum, kappas: Real, width_factor: float) -> tuple[Real, Real, Real]:
    """Accumulate the nodes of overlapping orders or of a sample in the bins of a lattice, finer near q = 0.

    Args:
        spectrum: S(q; κ).
        kappas: rad/µm, equidistant.
        width_factor: the factor of the width of a bin.

    Returns:
        Centres of power (n, 2), standard deviations (n,), both in cycles/µm, and powers (n, K).
    """
    from scipy.interpolate import CubicSpline

    sigma, grid, q = spectrum.lobe_width, spectrum.grid, _nodes(spectrum)
    # The standard deviation of one node.
    own = sigma if isinstance(grid, OrderGrid) else max(grid.spacing) / 2
    shortest = 4 * np.pi / spectrum.max_kappa
    width = width_factor * min(
        MAX_BIN_WIDTH / shortest, np.sqrt(np.prod(np.minimum(np.ptp(q, axis=0), 4 / shortest)) / MIN_BINS)
    )
    # Bins are finer where b is not zero.
    near = np.hypot(*q.T) < 6 * sigma
    parts: list[tuple[NDArray, ...]] = []
    for chosen, size in ((near, min(width, MAX_MIRROR_BIN_WIDTH * sigma)), (~near, width)):
        # A node wider than half a bin is replaced by points of a Gaussian.
        count = 0 if size > 2 * own else int(min(np.ceil(3 * own / size), MAX_NODE_POINTS))
        offsets = np.linspace(-3, 3, 2 * count + 1) if count else np.zeros(1)
        density = np.exp(-(offsets**2) / 2) / np.exp(-(offsets**2) / 2).sum()
        around = own * np.stack(np.meshgrid(offsets, offsets), -1).reshape(-1, 2)
        points = (q[chosen][:, None] + around).reshape(-1, 2)
        node, weight = (
            np.repeat(np.flatnonzero(chosen), len(around)),
            np.tile(np.outer(density, density).ravel(), chosen.sum()),
        )
        spread = np.full(len(points), own / (2 * count + 1))
        parts.append((points, np.column_stack([np.rint(points / size), spread]), node, weight, spread))
    q, bins, node, weight, spread = (np.concatenate(part) for part in zip(*parts, strict=True))
    if not isinstance(grid, OrderGrid):
        # S is zero outside the Nyquist limit.
        weight *= (np.abs(q) <= grid.limit).all(-1)
    _, bins = np.unique(bins, axis=0, return_inverse=True)
    bins = bins.ravel()
    # Powers are band-limited in κ by the height range: cubic splines interpolate from fewer κ.
    knots = np.linspace(0, kappas[-1], len(kappas) // 4 + 6)
    powers, total = np.empty((bins.max() + 1, len(knots))), np.zeros(len(q))
    for index, kappa in enumerate(knots):
        power = np.maximum(spectrum.powers(kappa).ravel().astype(np.float64), 0)[node] * weight
        powers[:, index] = np.bincount(bins, power)
        total += power
    total += 1e-12
    moments = [np.bincount(bins, total * moment) for moment in (1, *q.T, *(q**2).T, spread**2)]
    centre, square = np.stack(moments[1:3], -1) / moments[0][:, None], np.stack(moments[3:5], -1) / moments[0][:, None]
    widths = np.sqrt(np.maximum(square - centre**2, 0).mean(-1) + moments[5] / moments[0])
    return centre, widths, CubicSpline(knots, powers, axis=1)(kappas)


def bounds_of(albedo: Real, normal: float | None) -> Real:
    """Return e from the albedo of the furnace.

    For reflected light alone e = 1/max(1, a). For an interface, transmitted light has priority over all reflected light
    except F₀, the reflectance of a plane at normal incidence, since scalar theory transmits even light that steep
    facets reflect totally:

        e_T = min(1, (1 − min(R, F₀))/T),    e_R = min(1, (1 − e_T T)/R),    e_R R + e_T T = min(1, R + T)

    Args:
        albedo: (1, n), or R and T (2, n).
        normal: F₀; None for reflected light alone.

    Returns:
        Shape of `albedo`; for reflected light alone up to `MAX_E`.
    """
    if normal is None:
        return np.minimum(1 / np.maximum(albedo, 1e-9), MAX_E)
    r, t = albedo
    # At most one: e_R is so steep at its kink that larger values would err by more between nodes.
    e_t = np.minimum(1, (1 - np.minimum(r, normal)) / np.maximum(t, 1e-9))
    return np.stack([np.minimum(1, (1 - e_t * t) / np.maximum(r, 1e-9)), e_t])
