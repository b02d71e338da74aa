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

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lu_factor, lu_solve, schur, toeplitz
from scipy.linalg.lapack import ztrsen

from .curve import Curve

Real = NDArray[np.float64]
Complex = NDArray[np.complex128]


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
        """∫₀¹ f e^{−2πi n t} dt of values (…, samples) between the points of the curve, n as in `fft`."""
        shift = np.exp(-1j * np.pi * np.fft.fftfreq(len(self.t)))
        return np.fft.fft(values) * shift / len(self.t)

    def _toeplitz(self, values: Real) -> Complex:
        n, c = 2 * self.harmonics + 1, self._coefficients(values)
        return toeplitz(c[:n], c[-np.arange(n)])

    def bounded(self, alpha: Real, gamma2: complex, upwards: bool, count: int) -> tuple[Complex, Complex]:
        """ψ and −iG along the curve, (n, count) each, of fields that span those decaying fastest in one direction."""
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

    def rayleigh(self, alpha: Real, orders: NDArray[np.int64], beta: Complex) -> tuple[Complex, Complex]:
        """ψ and −iG of the plane waves e^{i(α_m x + β z)} along the curve as columns, (n, orders) each."""
        alpha_m = alpha[orders + self.harmonics][:, None]
        # Without e^{iα_0 t}, which all harmonics share.
        phase = alpha_m * self.x + beta[:, None] * self.z - alpha[self.harmonics] * self.t
        psi = self._coefficients(np.exp(1j * phase))[:, self.n].T
        cos, sin = np.cos(self.tilt), np.sin(self.tilt)
        along, across = alpha_m[:, 0] * sin + beta * cos, alpha_m[:, 0] * cos - beta * sin
        return psi, self.j @ (psi * along) - self.m @ (psi * across)


@dataclass(frozen=True, eq=False)
class HalfSpace:
    """Bounded and outgoing fields on one side of a curve.

    Attributes:
        orders: that propagate, (p,); none in an absorbing medium.
        beta: β_m of these, positive, (p,).
        factors: LU of the matrix whose columns are ψ of the outgoing fields, (n, n); the first p are Rayleigh waves.
        admittance: Y, −iG = Yψ for each sum ψ of outgoing fields, (n, n).
    """

    orders: NDArray[np.int64]
    beta: Real
    factors: tuple[Complex, NDArray[np.int32]]
    admittance: Complex

    def amplitudes(self, psi: Complex) -> Complex:
        """Of the Rayleigh waves in a sum of outgoing fields ψ (n, …), (p, …)."""
        return lu_solve(self.factors, psi, check_finite=False)[: len(self.orders)]


def half_space(grating: Grating, alpha: Real, gamma2: complex, upwards: bool) -> HalfSpace:
    """The fields with ∇²ψ + γ²ψ = 0 above a curve, or below it.

    Args:
        alpha: α_m of all harmonics, (n,).
        gamma2: γ², of positive imaginary part or real.
        upwards: whether outgoing is up.
    """
    square = gamma2 - alpha**2
    propagates = (square.real > 0) & (np.imag(gamma2) == 0)
    orders, beta = grating.n[propagates], np.sqrt(square[propagates].real)
    # Of the solutions without loss, 2p travel; the others are pairs, one of which is bounded on this side.
    modes = grating.bounded(alpha, gamma2, upwards, len(alpha) - len(orders))
    waves = grating.rayleigh(alpha, orders, (beta if upwards else -beta).astype(complex))
    psi, flux = (np.hstack(both) for both in zip(waves, modes, strict=True))
    factors = lu_factor(psi, check_finite=False)
    admittance = lu_solve(factors, flux.T.conj(), trans=2, check_finite=False).conj().T
    return HalfSpace(orders, beta, factors, admittance)


@dataclass(frozen=True, eq=False)
class Light:
    """A plane wave from above, of unit amplitude, and what is above.

    Attributes:
        alpha: α_m of all harmonics, (n,); that of the light is in the middle.
        square: γ² above.
        beta: β of the light, positive; it travels downwards.
        above: the outgoing fields above.
        psi: ψ of the light along the curve, (n, 1).
        rise: −iG of the light less Yψ, (n, 1).
    """

    alpha: Real
    square: float
    beta: float
    above: HalfSpace
    psi: Complex
    rise: Complex


def light_from(grating: Grating, alpha_0: float, square: float) -> Light:
    """The light whose wave vector has x component α_0, with γ² = k² − k_y² (times period / 2π, and its square)."""
    alpha = alpha_0 + grating.n
    above = half_space(grating, alpha, square, True)
    beta = float(np.sqrt(square - alpha_0**2))
    psi, flux = grating.rayleigh(alpha, np.array([0]), np.array([-beta]))
    return Light(alpha, square, beta, above, psi, flux - above.admittance @ psi)


@dataclass(frozen=True, eq=False)
class Scattered:
    """What became of light from above.

    A wave that travels along k̂ is polarised as (ê, k̂ × ê), ê the direction of ŷ − (ŷ·k̂)k̂: "y" light, whose electric
    field lies along the grooves as far as it can, comes before its orthogonal.

    Attributes:
        orders: n of the reflected orders, whose α is α_0 + n, (p,).
        reflected: (p, 2, 2), [order, polarisation of the order, of the incident light], so scaled that |·|² is a share
            of the incident power.
        orders_below: n of the orders that propagate below, (r,).
        transmitted: the same of these, (r, 2, 2).
    """

    orders: NDArray[np.int64]
    reflected: Complex
    orders_below: NDArray[np.int64]
    transmitted: Complex


def scatter(grating: Grating, light: Light, k_y: float, index: complex) -> Scattered:
    """Solve for light of this k_y (times period / 2π) in air above a medium of the index n + ik."""
    k_0 = np.sqrt(light.square + k_y**2)
    square = k_0**2 * (index.real**2 if index.imag == 0 else index**2) - k_y**2
    above, below = light.above, half_space(grating, light.alpha, square, False)
    # ψ_E and ψ_H on the curve, from E_t and H_t, which are continuous. Above, −iG = Yψ + rise.
    #   k_y α ψ_E (1/γ₁² − 1/γ₂²) − k_0 (Y₁/γ₁² − Y₂/γ₂²) ψ_H = k_0/γ₁² rise_H
    #   k_y α ψ_H (1/γ₁² − 1/γ₂²) + k_0 (Y₁/γ₁² − n² Y₂/γ₂²) ψ_E = −k_0/γ₁² rise_E
    coupling = np.diag(k_y * light.alpha * (1 / light.square - 1 / square))
    upper, lower = k_0 / light.square * above.admittance, k_0 / square * below.admittance
    matrix = np.block([[coupling, lower - upper], [upper - index**2 * lower, coupling]])
    zero = np.zeros_like(light.rise)
    right = k_0 / light.square * np.block([[zero, light.rise], [-light.rise, zero]])
    # [ψ_E or ψ_H, harmonic, light in E_y or in H_y].
    total = np.linalg.solve(matrix, right).reshape(2, -1, 2)
    scattered = total - np.stack([np.hstack([light.psi, zero]), np.hstack([zero, light.psi])])
    # Of unit waves, E_y = γ/k and H_y = −n γ/k.
    up = np.stack([above.amplitudes(field) for field in scattered], axis=1) * [[1, -1], [-1, 1]]
    reflected = np.sqrt(above.beta / light.beta)[:, None, None] * up
    down = np.zeros((len(below.orders), 2, 2), complex)
    if len(below.orders):
        down = np.stack([below.amplitudes(field) for field in total], axis=1) * [[1, -1], [-1, 1]]
        down *= np.sqrt(below.beta / light.beta * light.square / square)[:, None, None] * [[index.real], [1]]
    return Scattered(above.orders, reflected, below.orders, down)
