"""The coordinate-transformation method (Chandezon et al. 1982), for steep and vertical facets too.

The profile is a curve x(t), h(t); its period is the same in t as in x. A point is given by t and by its distance u from
the curve along one direction (sin ζ, cos ζ):

    x = x(t) + u sin ζ,    z = h(t) + u cos ζ.

With ζ = 0 and t = x these are Chandezon's coordinates. A tilt ζ admits a vertical facet (Li et al. 1999). Where t grows
with the length of the curve, and is denser at edges, steep facets and edges get the harmonics that they need (Granet
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

Half of its solutions are outgoing upwards, half downwards. The eigenvectors of deep profiles are almost parallel: a
field e^{−|β|z} is e^{|β| depth} times as strong in the valleys as on the ridges. The two spaces that they span are well
separated; Schur vectors, ordered with the eigenvalues of one space first, are an orthonormal basis of it. In a medium
without loss, propagating solutions are replaced by the Rayleigh waves e^{i(α_m x + β_m z)}, which are exact.

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

from ..array_types import Complex, Real
from ..errors import RequestError
from ..surface.heightfield import HeightField

SAMPLES = 4096
_WALL_WIDTH = 1e-6  # in periods: no tilt admits vertical walls of both sides
# At an edge the angle of the curve changes by more than both: radians, and multiples of the median over nine pixels.
_MIN_EDGE_ANGLE, _MIN_EDGE_RATIO, _MAX_EDGES = 0.1, 8.0, 8
# The speed of the curve in t at an edge is 1 − _GRADING of its mean; a piece of length l takes a fraction of t that is
# proportional to l^_LENGTH_EXPONENT. Of the values 0.8 … 0.95 and 0.35 … 1, tried on blazed, ruled and lamellar
# gratings, these need the fewest harmonics.
_GRADING, _LENGTH_EXPONENT = 0.9, 0.65
# A bend of one radian counts as this fraction of the whole length. Of the values 0 … 0.32 this needs the fewest
# harmonics: for a sinusoid of silver eight times as deep as wide 56, and more than 140 without it.
_BEND_LENGTH = 0.04


@dataclass(frozen=True, eq=False)
class Curve:
    """One period of a profile at t = 0, 1/n, … 1; lengths are in periods.

    Attributes:
        x, z: (n + 1,); x increases by 1 from the first to the last.
        tilt: ζ, the angle from z to the direction of u, towards which the steepest rise and the steepest fall of the
            profile are equally steep.
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
        x, z = ((c[1:] + c[:-1]) / 2 for c in (self.x, self.z))
        return x, z


def is_profile(height_field: HeightField) -> bool:
    """Return whether the heights do not change along y."""
    return bool(np.ptp(height_field.heights, axis=0).max() == 0)


def curve_of(height_field: HeightField) -> Curve:
    """Return the curve of a surface of one row: straight lines from pixel to pixel, continued across the tile boundary.

    A step that is one pixel wide is a vertical wall (`_with_walls`). Between edges the length of the curve grows at a
    rate of 1 − η (4 cos 2πτ + cos 4πτ)/5: slowly near the edges, where fields are singular (Granet 1999), and evenly
    away from them, as waves are short where the rate is high. Smooth bends count as length (`_BEND_LENGTH`), so that
    sharp crests are resolved.
    """
    rows = height_field.centred
    if not is_profile(height_field):
        raise RequestError(
            f"height field: got {len(rows)} rows that differ, wanted a surface that does not change along y, "
            "as rigorous theory requires"
        )
    period = height_field.tile_size[0]
    n = rows.shape[1]
    x = (np.arange(n + 1) + 0.5) / n
    z = np.append(rows[0], rows[0, 0]) / period
    x, z = _with_walls(x, z)
    angles, bends, is_edge = _bends(x, z)
    bends, edges = np.abs(bends), np.flatnonzero(is_edge)
    edges = np.sort(edges[np.argsort(-bends[edges])[:_MAX_EDGES]])
    bends[edges] = 0
    steps = np.hypot(np.diff(x), np.diff(z))
    steps = steps / steps.sum() + _BEND_LENGTH / 2 * (bends + np.roll(bends, -1))
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


def _bends(x: Real, z: Real) -> tuple[Real, Real, NDArray[np.bool_]]:
    """Return the angles of the lines from each point to the next, by how much they change there, and where edges are.

    Each is (n,), of n + 1 points, of which the last is the first of the next period.
    """
    angles = np.arctan2(np.diff(z), np.diff(x))
    bends = angles - np.roll(angles, 1)
    min_angles = np.maximum(_MIN_EDGE_ANGLE, _MIN_EDGE_RATIO * median_filter(np.abs(bends), 9, mode="wrap"))
    return angles, bends, np.abs(bends) > min_angles


def _with_walls(x: Real, z: Real) -> tuple[Real, Real]:
    """Return the points with vertical walls, half way between two pixels, in place of steps that are one pixel wide.

    A step has edges at both ends, one convex and one concave. The lines beside it are continued up to the wall.
    """
    angles, bends, is_edge = _bends(x, z)
    right = is_edge & np.roll(is_edge, -1) & (bends * np.roll(bends, -1) < 0)
    left = np.roll(right, 1)
    slopes = np.where(right, 0, np.tan(angles))
    reach = 0.5 / len(right) - _WALL_WIDTH / 2
    # A pixel between two walls becomes two points at one height.
    points = np.repeat(np.arange(len(right)), 1 + (left & right))
    shift = reach * np.where(left, -1, right)[points]
    shift[1:][np.diff(points) == 0] = reach
    z = z[points] + shift * np.where(left, slopes, np.roll(slopes, 1))[points]
    x = x[points] + shift
    return np.append(x, x[0] + 1), np.append(z, z[0])


def _graded(edges: Real, length: float) -> Real:
    """Return s at t = 0, 1/n, … 1, with a whole number of steps between edges."""
    ends = np.append(edges, length)
    weights = np.cumsum(np.diff(ends) ** _LENGTH_EXPONENT)
    steps = np.append(0, np.round(weights / weights[-1] * SAMPLES)).astype(int)
    at = [np.zeros(1)]
    for (a, b), n in zip(itertools.pairwise(ends), np.diff(steps), strict=True):
        t = np.arange(1, n + 1) / max(n, 1)
        at.append(a + (b - a) * (t - _GRADING / (20 * np.pi) * (8 * np.sin(2 * np.pi * t) + np.sin(4 * np.pi * t))))
    return np.concatenate(at)


class CurveMatrices:
    """Matrices common to all eigenproblems of a curve. Lengths are in units of period / 2π.

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

    def _coefficients(self, values: Real | Complex) -> Complex:
        """Return ∫₀¹ f e^{−2πi n t} dt of values (…, samples) between the points of the curve, n as in `fft`."""
        shift = np.exp(-1j * np.pi * np.fft.fftfreq(len(self.t)))
        return np.fft.fft(values) * shift / len(self.t)

    def _toeplitz(self, values: Real) -> Complex:
        n, c = 2 * self.harmonics + 1, self._coefficients(values)
        return toeplitz(c[:n], c[-np.arange(n)])

    def bounded(
        self, alpha: NDArray[np.floating], gamma2: complex, upwards: bool, count: int
    ) -> tuple[Complex, Complex]:
        """Return ψ and −iG along the curve, (n, count) each, of a basis of the fields that decay fastest up or down.

        Args:
            alpha: α_m, (n,).
            gamma2: γ².
            upwards: whether fields decay upwards.
            count: dimension of the space.
        """
        n = len(alpha)
        # −iG is divided by this unit, so that both halves of a vector have similar magnitude.
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
        """Return ψ and −iG of the plane waves e^{i(α_m x ± β z)} along the curve, (n, orders) each, for + and for −."""
        # Without the factor e^{iα_0 t}, which is common to all harmonics.
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
    """Bounded and outgoing fields on one side of a curve, and the waves incident from that side.

    Attributes:
        square: γ².
        orders: the propagating orders, (p,); none in an absorbing medium.
        beta: β_m of these, positive, (p,).
        waves: (p, n); waves @ ψ are the amplitudes of the outgoing Rayleigh waves in a sum ψ of outgoing fields.
        admittance: Y, (n, n), with −iG = Yψ for each sum ψ of outgoing fields.
        psi: ψ of the incident Rayleigh wave of each order, along the curve, (n, p).
        source: −iG − Yψ of these, (n, p).
    """

    square: complex
    orders: NDArray[np.int64]
    beta: Real
    waves: Complex
    admittance: Complex
    psi: Complex
    source: Complex


def half_space(grating: CurveMatrices, alpha_0: float, gamma2: complex, upwards: bool) -> HalfSpace:
    """Compute the fields with ∇²ψ + γ²ψ = 0 above a curve, or below it.

    Args:
        grating: the curve.
        alpha_0: α of order 0.
        gamma2: γ², of positive imaginary part or real.
        upwards: whether outgoing fields propagate upwards, that is, the half-space is above.
    """
    alpha = alpha_0 + grating.n
    # At exactly grazing exit both Rayleigh waves of an order coincide.
    if np.abs(gamma2 - alpha**2).min() < 1e-14 * abs(gamma2):
        gamma2 *= 1 - 1e-12
    square = gamma2 - alpha**2
    propagates = (square.real > 0) & (np.imag(gamma2) == 0)
    orders, beta = grating.n[propagates], np.sqrt(square[propagates].real)
    # Without loss, 2p solutions propagate; the others form pairs, one of each being bounded on this side.
    modes = grating.bounded(alpha, gamma2, upwards, len(alpha) - len(orders))
    up, down = grating.rayleigh(alpha_0, orders, beta)
    outgoing, incident = (up, down) if upwards else (down, up)
    psi, flux = (np.hstack(both) for both in zip(outgoing, modes, strict=True))
    factors = lu_factor(psi, check_finite=False)
    # Y and the rows of ψ⁻¹ that belong to Rayleigh waves: [flux; 1] ψ⁻¹.
    rows = np.vstack([flux, np.eye(len(orders), len(alpha))]).T.conj()
    admittance, waves = np.split(lu_solve(factors, rows, trans=2, check_finite=False).conj().T, [len(alpha)])
    psi, flux = incident
    return HalfSpace(gamma2, orders, beta, waves, admittance, psi, flux - admittance @ psi)


ABOVE, BELOW = 0, 1
_PARITY = np.array([[1.0, -1.0], [-1.0, 1.0]])  # of amplitudes in k_y, [E_y or H_y, E_y or H_y]


@dataclass(frozen=True, eq=False)
class Scattered:
    """Amplitudes of all orders for incident light of any order, from above and from below.

    The polarisation of a wave that travels along k̂ is given in the basis (ê, k̂ × ê), with ê the direction of
    ŷ − (ŷ·k̂)k̂: the first component has its electric field as nearly along the grooves as possible.

    Attributes:
        orders: n of the propagating orders above, (p,), and below, (r,).
        amplitudes: amplitudes[i][o] of light incident from side i and outgoing on side o, (orders of o, 2, orders of i,
            2), [order, polarisation, incident order, its polarisation]; |·|² is a fraction of the incident power.
        alpha: α of the orders above, (p,), and below, (r,).
        k_y, k_0: common to all of these waves, k_0 in the medium above, times period / 2π; k_y may be imaginary.
    """

    orders: tuple[NDArray[np.int64], NDArray[np.int64]]
    amplitudes: tuple[tuple[Complex, Complex], tuple[Complex, Complex]]
    alpha: tuple[NDArray[np.floating], NDArray[np.floating]]
    k_y: complex
    k_0: float

    def conjugate(self, amplitudes: Complex) -> Complex:
        """Return J(k_y*), (…, 2, 2), from J(k_y): amplitudes between E_y and H_y are odd in k_y, the others even.

        J(k_y) J(k_y*)*, which is |J|² for real k_y, is analytic in k_y², so that a table up to k_y = 0 can be solved
        beyond it, too.
        """
        return amplitudes * _PARITY if np.imag(self.k_y) else amplitudes

    def powers(self, amplitudes: Complex) -> Real:
        """Return |·|² of amplitudes [order, polarisation, …, polarisation]; negative where odd if k_y is imaginary."""
        powers = np.abs(amplitudes) ** 2
        return powers * _PARITY[:, None] if np.imag(self.k_y) else powers


def scatter(alpha: NDArray[np.floating], above: HalfSpace, below: HalfSpace, k_y: complex, index: complex) -> Scattered:
    """Solve for the amplitudes of all orders, with air above and a medium of index n + ik below.

    Args:
        alpha: α_m of all harmonics, (n,), common to both half-spaces.
        above, below: the half-spaces.
        k_y: times period / 2π.
        index: n + ik below.
    """
    k_0 = np.sqrt((above.square + k_y**2).real)
    # Continuity of E_t and H_t gives ψ_E and ψ_H on the curve, with −iG = Yψ + source on both sides.
    #   k_y α ψ_E (1/γ₁² − 1/γ₂²) − k_0 (Y₁/γ₁² − Y₂/γ₂²) ψ_H = k_0 (source_H1/γ₁² − source_H2/γ₂²)
    #   k_y α ψ_H (1/γ₁² − 1/γ₂²) + k_0 (Y₁/γ₁² − n² Y₂/γ₂²) ψ_E = −k_0 (source_E1/γ₁² − n² source_E2/γ₂²)
    coupling = np.diag(k_y * alpha * (1 / above.square - 1 / below.square))
    upper, lower = k_0 / above.square * above.admittance, k_0 / below.square * below.admittance
    matrix = np.block([[coupling, lower - upper], [upper - index**2 * lower, coupling]])
    factors = lu_factor(matrix, check_finite=False)
    # A wave of unit amplitude has E_y = γ/k and H_y = −n γ/k; its power is proportional to β.
    units = [
        np.sqrt(half.beta) * (k_0 / np.sqrt(np.abs(half.square))) * np.array([[n], [-1]])
        for half, n in ((above, 1.0), (below, index))
    ]
    blocks = []
    for side, (half, n) in enumerate(((above, 1.0), (below, index))):
        sign, zero = (1, -1)[side], np.zeros_like(half.source)
        source = sign * k_0 / half.square * half.source
        right = np.block([[zero, source], [-(n**2) * source, zero]])
        # [ψ_E or ψ_H, harmonic, incident E_y or H_y, incident order].
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
    alphas = alpha[above.orders + middle], alpha[below.orders + middle]
    return Scattered(orders, (blocks[0], blocks[1]), alphas, k_y, k_0)
