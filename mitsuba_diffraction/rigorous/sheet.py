"""A sheet: a dielectric between a grating and a plane, with air on both sides."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .coordinate_transformation import ABOVE, BELOW, Scattered
from .efficiencies import frames, matrices_of, mueller

Real = NDArray[np.float64]

# What a bounce inside loses: light that a shallow grating keeps in the sheet would never end.
_LOSS = 1e-9


def through_sheet(solved: Scattered, index: float) -> dict[tuple[int, int], Real]:
    """Compute what a sheet does to light, all bounces inside summed incoherently.

    The plane is far from the grating: powers add up, order by order, as Stokes vectors. With the Mueller matrices of
    all orders together, G those of the grating and F, T those of the plane, each order by itself, light inside that
    travels downwards is D = (1 − G F)⁻¹ G × what enters, through the grating or, T, through the plane, and

        above → above: G + G F D,    below → below: F + T D T,    above → below: T D,    below → above: G (1 + F D) T.

    Args:
        solved: of the grating, air above and the dielectric below.
        index: of the dielectric.

    Returns:
        (from, to) → matrices, (orders out, orders in, 4, 4), orders those above.
    """
    outside, inside = solved.orders
    grating = [[_as_matrix(matrices_of(solved, i, o)) for o in (ABOVE, BELOW)] for i in (ABOVE, BELOW)]
    k_y, k_0, k = solved.k_y, solved.k_0, index * solved.k_0
    into, plane = _plane(solved.alpha[ABOVE], k_y, k_0, k, upwards=True)
    out_of, mirror = _plane(solved.alpha[BELOW], k_y, k, k_0, upwards=False)
    # Orders that propagate on both sides of the plane.
    travel = np.equal.outer(inside, outside)
    into = _as_matrix(travel[..., None, None] * into[None])
    out_of = _as_matrix(travel.T[..., None, None] * out_of[None])
    mirror = _as_matrix(np.eye(len(inside))[..., None, None] * mirror[:, None])
    plane = _as_matrix(np.eye(len(outside))[..., None, None] * plane[:, None])
    sources = np.hstack([grating[ABOVE][BELOW], grating[BELOW][BELOW] @ into])
    bounce = (1 - _LOSS) * grating[BELOW][BELOW] @ mirror
    down = np.linalg.solve(np.eye(len(bounce)) - bounce, sources)
    from_above, from_below = down[:, : 4 * len(outside)], down[:, 4 * len(outside) :]
    found = {
        (ABOVE, ABOVE): grating[ABOVE][ABOVE] + grating[BELOW][ABOVE] @ mirror @ from_above,
        (BELOW, BELOW): plane + out_of @ from_below,
        (ABOVE, BELOW): out_of @ from_above,
        (BELOW, ABOVE): grating[BELOW][ABOVE] @ (into + mirror @ from_below),
    }
    return {way: _as_blocks(matrix) for way, matrix in found.items()}


def _plane(alpha: Real, k_y: float, k: float, other: float, upwards: bool) -> tuple[Real, Real]:
    """Mueller matrices of light that meets a plane, transmitted and reflected, (n, 4, 4) each.

    Args:
        alpha, k_y: along the plane.
        k, other: wave numbers of the medium in which the light is, and beyond the plane.
        upwards: whether the light goes up.
    """
    beta, beta_other = (np.sqrt(w**2 - k_y**2 - alpha**2 + 0j) for w in (k, other))
    square = (k / other) ** 2
    r_s, r_p = (beta - beta_other) / (beta + beta_other), (beta - square * beta_other) / (beta + square * beta_other)
    root = 2 * np.sqrt(beta * beta_other)
    t_s, t_p = root / (beta + beta_other), root * (k / other) / (beta + square * beta_other)
    sign = 1 if upwards else -1

    def basis(height: Real, w: float) -> Real:
        return frames(np.stack([alpha, np.full_like(alpha, k_y), height], axis=1) / w)

    def matrices(to: Real, s: Real, p: Real) -> Real:
        from_ = basis(sign * beta.real, k).transpose(0, 2, 1)
        return mueller(to @ (np.stack([s, p], axis=1)[..., None] * from_))

    travels = beta_other.imag == 0
    height = np.where(travels, beta_other.real, 0.0)
    transmitted = matrices(basis(sign * height, other), t_s, t_p)
    return np.where(travels[:, None, None], transmitted, 0), matrices(basis(-sign * beta.real, k), r_s, r_p)


def _as_matrix(matrices: Real) -> Real:
    """Return (n, k, 4, 4) as one matrix, (4n, 4k)."""
    n, k = matrices.shape[:2]
    return matrices.transpose(0, 2, 1, 3).reshape(4 * n, 4 * k)


def _as_blocks(matrix: Real) -> Real:
    """Return (4n, 4k) as (n, k, 4, 4)."""
    n, k = (size // 4 for size in matrix.shape)
    return matrix.reshape(n, 4, k, 4).transpose(0, 2, 1, 3)
