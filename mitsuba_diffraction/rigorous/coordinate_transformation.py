"""The coordinate-transformation method (Chandezon et al. 1982), for steep and vertical facets too.

The profile is a curve x(t), h(t); its period is the same in t as in x. A point is given by t and by its distance u from
the curve along one direction (sin ζ, cos ζ):

    x = x(t) + u sin ζ,    z = h(t) + u cos ζ.

With ζ = 0 and t = x these are Chandezon's coordinates. A tilt ζ admits a vertical facet (Li et al. 1999); t in step
with the length of the curve, and dense at edges, gives steep facets and edges the harmonics that they need (Granet
1999). With J = ẋ cos ζ − ḣ sin ζ > 0 and M = ẋ sin ζ + ḣ cos ζ, the tangent in the tilted frame, and w, v the
derivatives of ψ across and along the direction of u, the equation ∇²ψ + γ²ψ = 0 becomes

    ∂_t ψ = J w + M v,    ∂_u ψ = v,    ∂_t w + ∂_u G + γ² J ψ = 0,    G = J v − M w.

G is the derivative along the normal times the length of the curve per t. ψ, w and v are continuous where the curve has
an edge; J and M therefore act on them as Toeplitz matrices (Li and Chandezon 1996), and ψ = e^{iρu} Σ_m F_m e^{iα_m t}
obeys

    [(α − ρM) J⁻¹ (α − ρM) + ρ²J] F = γ² J F,

one eigenproblem of twice the harmonics for each medium, which with S = (J + M J⁻¹ M)⁻¹ and C = M J⁻¹ α is

    ρ ⎡ ψ  ⎤ = ⎡ SC          S   ⎤ ⎡ ψ  ⎤
      ⎣ −iG⎦   ⎣ γ²J − αSα   C†S ⎦ ⎣ −iG⎦.

Half of its solutions are outgoing upwards, half downwards. The eigenvectors of deep profiles are all but parallel: of
the fields e^{−|β|z} one is e^{|β| depth} times as strong in the valleys as on the ridges. The spaces that they span are
well separated; Schur vectors, the eigenvalues of one space first, are an orthonormal basis of it. Where a medium has no
loss, solutions that travel are replaced by the Rayleigh waves e^{i(α_m x + β_m z)}, which are exact.

Conical incidence (Plumey et al. 1995): with e^{i k_y y}, both E_y and H_y (H in units of E) obey the equation above
with γ² = k² − k_y², and along the curve

    E_t = i/γ² (k_y ∂_t E_y − k_0 G[H_y]),    H_t = i/γ² (k_y ∂_t H_y + k_0 n² G[E_y]).
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lu_factor, lu_solve, schur, toeplitz
from scipy.linalg.lapack import ztrsen
from scipy.ndimage import median_filter

from ..errors import RequestError
from ..surface.heightfield import HeightField

Real = NDArray[np.float64]
Complex = NDArray[np.complex128]

SAMPLES = 4096
# An edge turns the curve by more than this (rad) and by more than so many times the median turn of nine pixels.
_EDGE, _OF_MEDIAN, _MOST_EDGES = 0.1, 8.0, 8
# At an edge the curve runs as slowly in t as 1 − this of its mean; a piece of the length l has a share l^_SHARE of t.
# Of those tried, 0.8 … 0.95 and 0.35 … 1 on blazes, ruled and lamellar gratings, these need the fewest harmonics.
_GRADING, _SHARE = 0.9, 0.65
# A bend of one radian takes as much of t as this share of the whole length. Of 0 … 0.32, this needs the fewest
# harmonics: a sinusoid of silver eight times as deep as wide 56, without it more than 140.
_BEND = 0.04


@dataclass(frozen=True, eq=False)
class Curve:
    """One period of a profile, lengths in periods, at t = 0, 1/n, … 1.

    Attributes:
        x, z: (n + 1,), x rising by 1 from the first to the last.
        tilt: ζ, the angle from z to the direction in which the curve is moved: half way between those to which the
            steepest rise and the steepest fall are equally steep.
    """

    x: Real
    z: Real
    tilt: float

    @property
    def tangent(self) -> tuple[Real, Real]:
        """J = ẋ cos ζ − ḣ sin ζ and M = ẋ sin ζ + ḣ cos ζ between the points, (n,) each."""
        x, z = (np.diff(c) * len(self.x[1:]) for c in (self.x, self.z))
        cos, sin = np.cos(self.tilt), np.sin(self.tilt)
        return x * cos - z * sin, x * sin + z * cos

    @property
    def middle(self) -> tuple[Real, Real]:
        """x and z half way between the points, (n,) each."""
        return tuple((c[1:] + c[:-1]) / 2 for c in (self.x, self.z))


def is_profile(height_field: HeightField) -> bool:
    """Return whether the heights do not change along y."""
    return bool(np.ptp(height_field.heights, axis=0).max() == 0)


def curve_of(height_field: HeightField) -> Curve:
    """Return the curve of a surface of one row: straight lines from pixel to pixel, round the end of the tile.

    The facet that leads back in a sawtooth is thus one pixel wide, and so is the wall of a lamellar grating. Between
    edges the length of the curve grows at a rate of 1 − η (4 cos 2πτ + cos 4πτ)/5: slowly near the edges, where fields
    are singular (Granet 1999), and evenly away from them, where a fast run makes for short waves. Smooth bends count as
    length (`_BEND`), so that sharp crests are resolved.
    """
    rows = height_field.centred
    if not is_profile(height_field):
        raise RequestError(
            f"height field: got {len(rows)} rows that differ, wanted a surface that does not change along y; "
            "rigorous theory is offered for such only"
        )
    period = height_field.tile_size[0]
    n = rows.shape[1]
    x = (np.arange(n + 1) + 0.5) / n
    z = np.append(rows[0], rows[0, 0]) / period
    angles = np.arctan2(np.diff(z), np.diff(x))
    turns = np.abs(angles - np.roll(angles, 1))
    edges = np.flatnonzero(turns > np.maximum(_EDGE, _OF_MEDIAN * median_filter(turns, 9, mode="wrap")))
    edges = np.sort(edges[np.argsort(-turns[edges])[:_MOST_EDGES]])
    turns[edges] = 0
    steps = np.hypot(np.diff(x), np.diff(z))
    steps = steps / steps.sum() + _BEND / 2 * (turns + np.roll(turns, -1))
    if len(edges):
        # Begin at an edge.
        x, z = (np.append(np.roll(c[:-1], -edges[0]), 0) for c in (x, z))
        x[:-1] += x[:-1] < x[0]
        x[-1], z[-1] = x[0] + 1, z[0]
        steps = np.roll(steps, -edges[0])
        edges = edges - edges[0]
    s = np.concatenate([[0.0], np.cumsum(steps)])
    at = _graded(s[edges], s[-1]) if len(edges) else np.linspace(0, s[-1], SAMPLES + 1)
    return Curve(np.interp(at, s, x), np.interp(at, s, z), -(angles.min() + angles.max()) / 2)


def _graded(edges: Real, length: float) -> Real:
    """Return s at t = 0, 1/n, … 1, with a whole number of steps between edges."""
    ends = np.append(edges, length)
    shares = np.cumsum(np.diff(ends) ** _SHARE)
    steps = np.append(0, np.round(shares / shares[-1] * SAMPLES)).astype(int)
    at = [np.zeros(1)]
    for (a, b), n in zip(itertools.pairwise(ends), np.diff(steps), strict=True):
        t = np.arange(1, n + 1) / max(n, 1)
        at.append(a + (b - a) * (t - _GRADING / (20 * np.pi) * (8 * np.sin(2 * np.pi * t) + np.sin(4 * np.pi * t))))
    return np.concatenate(at)


class Grating:
    """What the eigenproblems of a curve share. Lengths are in units of period / 2π.

    Attributes:
        n: the harmonics −N … N.
        j, m: J and M as Toeplitz matrices, (2N + 1, 2N + 1).
        s: S, and `sm`: S M J⁻¹, (2N + 1, 2N + 1).
    """

    def __init__(self, curve: Curve, harmonics: int) -> None:
        self.harmonics = harmonics
        self.n = np.arange(-harmonics, harmonics + 1)
        self.tilt = curve.tilt
        self.x, self.z = (2 * np.pi * c for c in curve.middle)
        self.t = 2 * np.pi * (np.arange(len(self.x)) + 0.5) / len(self.x)
        self.j, self.m = (self._toeplitz(values) for values in curve.tangent)
        left = np.linalg.solve(self.j, self.m).conj().T  # M J⁻¹
        self.s = np.linalg.inv(left @ self.m + self.j)
        self.sm = self.s @ left

    def _coefficients(self, values: Complex) -> Complex:
        """Return ∫₀¹ f e^{−2πi n t} dt of values (…, samples) between the points of the curve, n as in `fft`."""
        shift = np.exp(-1j * np.pi * np.fft.fftfreq(len(self.t)))
        return np.fft.fft(values) * shift / len(self.t)

    def _toeplitz(self, values: Real) -> Complex:
        n, c = 2 * self.harmonics + 1, self._coefficients(values)
        return toeplitz(c[:n], c[-np.arange(n)])

    def bounded(self, alpha: Real, gamma2: complex, upwards: bool, count: int) -> tuple[Complex, Complex]:
        """Return ψ and −iG along the curve, (n, count) each, of fields that span those decaying fastest one way."""
        n = len(alpha)
        # −iG is stored in this unit, so that both halves of a vector weigh the same.
        unit = np.sqrt(np.abs(gamma2) + n**2)
        matrix = np.empty((2 * n, 2 * n), complex)
        matrix[:n, :n] = self.sm * alpha[None, :]
        matrix[:n, n:] = self.s * unit
        matrix[n:, :n] = (gamma2 * self.j - alpha[:, None] * self.s * alpha[None, :]) / unit
        matrix[n:, n:] = matrix[:n, :n].conj().T
        triangle, basis = schur(matrix, output="complex", overwrite_a=True, check_finite=False)
        decay = np.diag(triangle).imag * (1 if upwards else -1)
        first = np.zeros(2 * n, np.int32)
        first[np.argsort(-decay)[:count]] = 1
        basis = ztrsen(first, triangle, basis, job="N", lwork=1)[1][:, :count]
        return basis[:n], basis[n:] * unit

    def rayleigh(self, alpha_0: float, orders: NDArray[np.int64], beta: Real) -> tuple[tuple[Complex, Complex], ...]:
        """Return ψ and −iG of the plane waves e^{i(α_m x ± β z)} along the curve, (n, orders) each; + and −."""
        # Without e^{iα_0 t}, which all harmonics share.
        along_x = np.exp(1j * (alpha_0 * (self.x - self.t) + orders[:, None] * self.x))
        along_z = np.exp(1j * beta[:, None] * self.z)
        cos, sin = np.cos(self.tilt), np.sin(self.tilt)
        found = []
        for waves, k_z in ((along_z, beta), (along_z.conj(), -beta)):
            psi = self._coefficients(along_x * waves)[:, self.n].T
            k_x = alpha_0 + orders
            along, across = k_x * sin + k_z * cos, k_x * cos - k_z * sin
            found.append((psi, self.j @ (psi * along) - self.m @ (psi * across)))
        return tuple(found)


@dataclass(frozen=True, eq=False)
class HalfSpace:
    """Bounded and outgoing fields on one side of a curve, and the light that may come in there.

    Attributes:
        square: γ².
        orders: that propagate, (p,); none in an absorbing medium.
        beta: β_m of these, positive, (p,).
        waves: amplitudes of the outgoing Rayleigh waves in a sum of outgoing fields, waves @ ψ, (p, n).
        admittance: Y, −iG = Yψ for each sum ψ of outgoing fields, (n, n).
        psi: ψ of the incoming Rayleigh wave of each order, along the curve, (n, p).
        rise: −iG of these less Yψ, (n, p).
    """

    square: complex
    orders: NDArray[np.int64]
    beta: Real
    waves: Complex
    admittance: Complex
    psi: Complex
    rise: Complex


def half_space(grating: Grating, alpha_0: float, gamma2: complex, upwards: bool) -> HalfSpace:
    """Return the fields with ∇²ψ + γ²ψ = 0 above a curve, or below it.

    Args:
        alpha_0: α of order 0.
        gamma2: γ², of positive imaginary part or real.
        upwards: whether outgoing is up.
    """
    alpha = alpha_0 + grating.n
    # Exactly along the horizon both Rayleigh waves of an order are the same.
    if np.abs(gamma2 - alpha**2).min() < 1e-14 * abs(gamma2):
        gamma2 *= 1 - 1e-12
    square = gamma2 - alpha**2
    propagates = (square.real > 0) & (np.imag(gamma2) == 0)
    orders, beta = grating.n[propagates], np.sqrt(square[propagates].real)
    # Of the solutions without loss, 2p travel; the others are pairs, one of which is bounded on this side.
    modes = grating.bounded(alpha, gamma2, upwards, len(alpha) - len(orders))
    up, down = grating.rayleigh(alpha_0, orders, beta)
    outgoing, incoming = (up, down) if upwards else (down, up)
    psi, flux = (np.hstack(both) for both in zip(outgoing, modes, strict=True))
    factors = lu_factor(psi, check_finite=False)
    # Y and, of ψ⁻¹, the rows of Rayleigh waves: those of [flux; 1] ψ⁻¹.
    rows = np.vstack([flux, np.eye(len(orders), len(alpha))]).T.conj()
    admittance, waves = np.split(lu_solve(factors, rows, trans=2, check_finite=False).conj().T, [len(alpha)])
    psi, flux = incoming
    return HalfSpace(gamma2, orders, beta, waves, admittance, psi, flux - admittance @ psi)


ABOVE, BELOW = 0, 1
_EVEN = np.array([[1.0, -1.0], [-1.0, 1.0]])  # in k_y, E_y and H_y


@dataclass(frozen=True, eq=False)
class Scattered:
    """What becomes of light of any order from either side.

    A wave that travels along k̂ is polarised as (ê, k̂ × ê), ê the direction of ŷ − (ŷ·k̂)k̂: "y" light, whose electric
    field lies along the grooves as far as it can, comes before its orthogonal.

    Attributes:
        orders: n of the orders that propagate above, (p,), and below, (r,).
        amplitudes: amplitudes[i][o] of light that comes in on side i and leaves on side o, (orders of o, 2, orders of
            i, 2), [order, polarisation, incident order, its polarisation], so scaled that |·|² is a share of the
            incident power.
        alpha: α of the orders above, (p,), and below, (r,).
        k_y, k_0: of all of this light, k_0 in the medium above, times period / 2π; k_y may be imaginary.
    """

    orders: tuple[NDArray[np.int64], NDArray[np.int64]]
    amplitudes: tuple[tuple[Complex, Complex], tuple[Complex, Complex]]
    alpha: tuple[Real, Real]
    k_y: complex
    k_0: float

    def conjugate(self, amplitudes: Complex) -> Complex:
        """Return J(k_y*), (…, 2, 2) like J(k_y): amplitudes between E_y and H_y are odd in k_y, the others even.

        With it |J|², as J J(k_y*)*, is analytic in k_y²: a table that ends at k_y = 0 can be solved on both sides.
        """
        return amplitudes * _EVEN if np.imag(self.k_y) else amplitudes

    def powers(self, amplitudes: Complex) -> Real:
        """Return |·|² of amplitudes [order, polarisation, …, its polarisation]; negative where odd, k_y imaginary."""
        powers = np.abs(amplitudes) ** 2
        return powers * _EVEN[:, None] if np.imag(self.k_y) else powers


def scatter(alpha: Real, above: HalfSpace, below: HalfSpace, k_y: complex, index: complex) -> Scattered:
    """Solve for light of this k_y (times period / 2π), with air above and a medium of the index n + ik below.

    α_m of all harmonics, (n,), are those of both half-spaces.
    """
    k_0 = np.sqrt((above.square + k_y**2).real)
    # ψ_E and ψ_H on the curve, from E_t and H_t, which are continuous. −iG = Yψ + rise on either side.
    #   k_y α ψ_E (1/γ₁² − 1/γ₂²) − k_0 (Y₁/γ₁² − Y₂/γ₂²) ψ_H = k_0 (rise_H1/γ₁² − rise_H2/γ₂²)
    #   k_y α ψ_H (1/γ₁² − 1/γ₂²) + k_0 (Y₁/γ₁² − n² Y₂/γ₂²) ψ_E = −k_0 (rise_E1/γ₁² − n² rise_E2/γ₂²)
    coupling = np.diag(k_y * alpha * (1 / above.square - 1 / below.square))
    upper, lower = k_0 / above.square * above.admittance, k_0 / below.square * below.admittance
    matrix = np.block([[coupling, lower - upper], [upper - index**2 * lower, coupling]])
    factors = lu_factor(matrix, check_finite=False)
    # Of unit waves, E_y = γ/k and H_y = −n γ/k, and the power is as β.
    units = [
        np.sqrt(half.beta) * (k_0 / np.sqrt(np.abs(half.square))) * np.array([[n], [-1]])
        for half, n in ((above, 1.0), (below, index))
    ]
    blocks = []
    for side, (half, n) in enumerate(((above, 1.0), (below, index))):
        sign, zero = (1, -1)[side], np.zeros_like(half.rise)
        rise = sign * k_0 / half.square * half.rise
        right = np.block([[zero, rise], [-(n**2) * rise, zero]])
        # [ψ_E or ψ_H, harmonic, light in E_y or in H_y, its order].
        total = lu_solve(factors, right, check_finite=False).reshape(2, len(alpha), 2, -1)
        scattered = total - np.eye(2)[:, None, :, None] * half.psi[:, None]
        of_side = []
        for other, to in enumerate((above, below)):
            found = np.stack(
                [to.waves @ field.reshape(len(alpha), -1) for field in (total if other != side else scattered)]
            )
            found = found.reshape(2, len(to.orders), 2, len(half.orders)).transpose(1, 0, 2, 3)
            found = units[other].T[:, :, None, None] * found / units[side]
            of_side.append(found.transpose(0, 1, 3, 2))
        blocks.append(tuple(of_side))
    orders = above.orders, below.orders
    middle = len(alpha) // 2
    return Scattered(orders, tuple(blocks), tuple(alpha[n + middle] for n in orders), k_y, k_0)
