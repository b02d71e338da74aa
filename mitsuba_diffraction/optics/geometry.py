"""K and G of a pair of directions or of an order, and the gain of lobes, for arrays of NumPy and of Dr.Jit.

Let n_i and n_o be the indices of the media of ω_i and ω_o, which point away from the surface, k = n ω their wave
vectors in units of 2π/λ, and v = k_i + k_o. Then q = −v_∥/λ, κ = 2π v_z/λ and

    k_i·v = (|v|² + n_i² − n_o²)/2,    k_o·v = (|v|² − n_i² + n_o²)/2,    K = |k_i·v| |k_o·v| / (|k_iz| |k_oz| v_z²)

for reflection (n_i = n_o; Stam 1999) and for transmission alike (cf. Walter et al. 2007).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

SHADOWING = ("v_cavity", "none")

# Coefficients of a least-squares fit to (g(x) − 1)/t², t = 1 − x/4.
HORIZON_GAIN = (-0.04034151, 0.81494507, -5.03522703, 10.57318562, -9.23048089, 3.5662365)

AnyArray = Any
"""A NumPy or Dr.Jit array, whichever `select` works on."""


def k_g(
    k_iz: AnyArray,
    k_oz: AnyArray,
    tangent_square: AnyArray,
    excess: AnyArray = 0.0,
    reflects: AnyArray = True,
    shadowing: bool = True,
    min_v_z: AnyArray = 0.0,
    select: Callable[..., Any] = np.where,
) -> AnyArray:
    """Return K G at given k_iz, k_oz and |v_∥|; shapes broadcast, float32 is preserved.

    With A_i = |k_i·v|/|k_iz| and A_o = |k_o·v|/|k_oz|, K = A_i A_o/v_z². For reflected light G is the shadowing of
    V-cavities (Torrance and Sparrow 1967), min(1, 2 h_z cos θ_i/|ω_i·h|, 2 h_z cos θ_o/|ω_o·h|) with h = v/|v|; for
    transmitted light

        G = min(1, 2 cos θ_i/|ω_i·h|, 2 cos θ_o/|ω_o·h|)² = min(1, 4 |v|²/max(A_i, A_o)²)

    With this G an order vanishes as cos θ towards the horizon, as in rigorous theory; a factor h_z would remove light
    where v_z is small. Where |v|² > |n_i² − n_o²| no facet refracts ω_i into ω_o, and nothing is transmitted.

    Args:
        k_iz, k_oz: |k_iz| and |k_oz|, positive.
        tangent_square: |v_∥|² = |λq|².
        excess: n_i² − n_o².
        reflects: whether both directions lie on the same side of the surface.
        shadowing: if false, K alone.
        min_v_z: lower bound of |v_z| in K of transmitted light.
        select: `numpy.where` or `drjit.select`.
    """

    def either(reflected: Callable[[], AnyArray], transmitted: Callable[[], AnyArray]) -> AnyArray:
        if isinstance(reflects, bool):
            return reflected() if reflects else transmitted()
        return select(reflects, reflected(), transmitted())

    v_z = either(lambda: k_iz + k_oz, lambda: abs(k_iz - k_oz))
    square = tangent_square + v_z * v_z
    a_i, a_o = abs(square + excess) / (2 * k_iz), abs(square - excess) / (2 * k_oz)
    per_v_z = 1 / either(lambda: v_z, lambda: select(v_z > min_v_z, v_z, min_v_z))
    k = a_i * per_v_z * (a_o * per_v_z)
    result = k
    if shadowing:
        smaller, larger = _ordered(a_i, a_o, select)
        bound = either(lambda: 2 * smaller * per_v_z, lambda: k * (4 * square / (larger * larger)))
        result = _ordered(k, bound, select)[0]
    return either(lambda: result, lambda: select(square < abs(excess), result, 0))


def _ordered(a: AnyArray, b: AnyArray, select: Callable[..., Any]) -> tuple[AnyArray, AnyArray]:
    """Return the minimum and the maximum, element by element."""
    if select is np.where:  # which is slow
        return np.minimum(a, b), np.maximum(a, b)
    return select(a < b, a, b), select(a < b, b, a)


@dataclass(frozen=True, eq=False)
class Orders:
    """Efficiencies of the propagating orders of a grating, reflected or transmitted, for light of one ω_i.

    Attributes:
        m: the orders, (n,), of a tile (n, 2).
        s, p: fraction of the incident power in each, for light polarised perpendicular and parallel to the plane of
            incidence, (n,).
    """

    m: NDArray[np.int64]
    s: NDArray[np.float64]
    p: NDArray[np.float64]

    @property
    def unpolarised(self) -> NDArray[np.float64]:
        """The mean of s and p."""
        return (self.s + self.p) / 2


@dataclass(frozen=True, eq=False)
class Diffracted:
    """The directions ω_o into which light of one ω_i is diffracted, (n,), in NumPy.

    Attributes:
        kept: mask of the frequencies q that propagate.
        tangent: k_o,∥, (n, 2).
        k_oz: |k_oz|.
        v_z: k_iz + k_oz, signed for light from above.
        k_g: K G.
        cos_half: |ω_i·h|.
    """

    kept: NDArray[np.bool_]
    tangent: NDArray[np.float64]
    k_oz: NDArray[np.float64]
    v_z: NDArray[np.float64]
    k_g: NDArray[np.float64]
    cos_half: NDArray[np.float64]


def diffracted(
    tangent: NDArray[np.float64], steps: NDArray[np.float64], n_i: float = 1.0, n_o: float | None = None
) -> Diffracted:
    """Return the directions into which light is reflected, or transmitted into a medium of index n_o.

    Args:
        tangent: k_i,∥, (2,); nothing propagates if it is evanescent.
        steps: λq, (..., 2).
        n_i: index of the medium of ω_i.
        n_o: index of the medium of transmitted light; None for reflected light.
    """
    reflects, n_o = n_o is None, n_i if n_o is None else n_o
    square_i, excess = float(n_i**2 - tangent @ tangent), n_i**2 - n_o**2
    tangent_o = -steps - tangent
    square_o = n_o**2 - (tangent_o**2).sum(axis=-1)
    kept = (square_o > 0) & (square_i > 0)
    k_iz, k_oz, change = np.sqrt(max(square_i, 0.0)), np.sqrt(square_o[kept]), (steps[kept] ** 2).sum(axis=-1)
    v_z = k_iz + k_oz if reflects else k_iz - k_oz
    square = change + v_z**2
    cos_half = np.abs(square + excess) / (2 * n_i * np.sqrt(np.maximum(square, 1e-18)))
    factor = k_g(k_iz, k_oz, change, excess, reflects, min_v_z=1e-6 * n_i)
    return Diffracted(kept, tangent_o[kept], k_oz, v_z, factor, np.minimum(cos_half, 1))


def horizon_gain(x: AnyArray, select: Callable[..., Any] = np.where) -> AnyArray:
    """Return g(x), which compensates the power of a Gaussian lobe below the horizon; x ≥ 0 in standard deviations.

    Of lobes centred at x and cut off at 0, g(x) g(y) φ(x − y) is symmetric and integrates to one:

        g(x) ∫₀^∞ φ(x − y) g(y) dy = 1,    φ the standard normal density

    (Sinkhorn 1964: the symmetric scaling of a kernel). g(0) = √e, and g = 1 from 4 on. The polynomial errs by at most
    4.1e-4.
    """
    t = 1 - 0.25 * x
    t = select(t > 0, t, 0)
    result = HORIZON_GAIN[-1]
    for coefficient in HORIZON_GAIN[-2::-1]:
        result = result * t + coefficient
    return 1 + t * t * result


def fresnel(cosine: ArrayLike, index: complex) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return (R_s, R_p), the power reflectances of a plane.

    Args:
        cosine: of the angle of incidence; shapes broadcast.
        index: n + ik of the material relative to the medium of incidence; ∞ of a perfect mirror. For a real index below
            one, light is totally reflected beyond the critical angle.
    """
    cosine = np.maximum(np.asarray(cosine, np.float64), 1e-12)
    if np.isinf(index):
        return np.ones_like(cosine), np.ones_like(cosine)
    square = index**2 - 1 + cosine**2
    root = np.sqrt(square if np.iscomplexobj(square) else np.maximum(square, 0))
    s = (cosine - root) / (cosine + root)
    p = (index**2 * cosine - root) / (index**2 * cosine + root)
    return np.abs(s) ** 2, np.abs(p) ** 2
