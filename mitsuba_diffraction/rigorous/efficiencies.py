"""The efficiencies of the orders of a grating, by Maxwell's equations: how far they converged, and Mueller matrices."""

from __future__ import annotations

import dataclasses
import functools
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from threadpoolctl import ThreadpoolController

from ..errors import RequestError
from ..surface.heightfield import HeightField
from .coordinate_transformation import ABOVE, BELOW, Curve, Grating, Scattered, curve_of, half_space, scatter
from .materials import refractive_index

Real = NDArray[np.float64]
Complex = NDArray[np.complex128]

# S_i = E† σ_i E, in the order of Stokes parameters; the sign of the last is Mitsuba's, with n + ik for metals.
_PAULI = np.array([[[1, 0], [0, 1]], [[1, 0], [0, -1]], [[0, 1], [1, 0]], [[0, 1j], [-1j, 0]]])

REVERSED = np.array([1, 1, 1, -1])
"""s: light that runs through an order backwards, mirrored so that k_y has the same sign, has s_i s_j M_ji."""

ODD = np.not_equal.outer([1, 1, -1, -1], [1, 1, -1, -1])
"""Which M_ij are odd in k_y."""


_KERNEL = np.einsum("iab,jcd->bcadij", _PAULI, _PAULI).reshape(16, 16) / 2


def mueller(amplitudes: Complex, of_conjugate: Complex | None = None) -> Complex:
    """Return M_ij = Tr(σ_i J σ_j J(k_y*)†) / 2 of amplitudes J, (…, 2, 2) → (…, 4, 4).

    Polarised waves are written in (ê, k̂ × ê), as in `coordinate_transformation.Scattered`. Elements are real; where k_y
    is imaginary, with J(k_y*) as `of_conjugate`, those that are odd in k_y are imaginary.
    """
    conjugate = (amplitudes if of_conjugate is None else of_conjugate).conj()
    pairs = amplitudes[..., None, None] * conjugate[..., None, None, :, :]
    return (pairs.reshape(-1, 16) @ _KERNEL).reshape(*amplitudes.shape[:-2], 4, 4)


def matrices_of(solved: Scattered, side: int, to: int) -> Complex:
    """Return the Mueller matrices of light from a side to a side, (orders out, orders in, 4, 4)."""
    amplitudes = solved.amplitudes[side][to].transpose(0, 2, 1, 3)
    return mueller(amplitudes, solved.conjugate(amplitudes))


def unpolarised(solved: Scattered, side: int, to: int) -> NDArray[np.float64]:
    """Return η alone of `matrices_of`, (orders out, orders in, 1, 1)."""
    return solved.powers(solved.amplitudes[side][to]).sum(axis=(1, 3))[..., None, None] / 2


@functools.cache
def _controller() -> ThreadpoolController:
    return ThreadpoolController()


@contextmanager
def one_thread() -> Iterator[None]:
    """Run BLAS on one thread in the block, or in the function that this decorates.

    On matrices of some hundred rows several threads wait for each other: the spectrum of a tile of 26 × 36 pixels whose
    lobes overlap took 5 s instead of 0.7 s on two idle cores, and up to thirteen times as long on busy ones.
    """
    with _controller().limit(limits=1, user_api="blas"):
        yield


MOST_HARMONICS = 80
# A solution with as many takes half a minute.
_FOR_DEEP_PROFILES = 300


@dataclass(frozen=True, eq=False)
class Efficiencies:
    """What a grating reflects of light from one direction.

    The polarisation of a wave that travels along k̂ is given in the basis ŝ = ẑ × k̂ / |ẑ × k̂| (ŷ along the
    normal) and p̂ = k̂ × ŝ; k̂ = −ω_i of the incident light, and k̂ = ω_o of an order.

    Attributes:
        orders: m of the orders that propagate on the side of the light, ascending, (n,); q_x = m / period; on either
            side n_o ω_o,x = −λ m / period − n_i ω_i,x, with the indices of the media of ω_o and ω_i.
        amplitudes: (n, 2, 2), [order, polarisation of the order, of the incident light], s before p; |·|² is a share of
            the incident power.
        transmitted_orders: m of the orders that propagate on the other side, ascending, (k,); none if the material
            absorbs, or beyond the critical angle.
        transmitted_amplitudes: (k, 2, 2), as `amplitudes`, k̂ along the transmitted wave.
        transmitted: the share of the incident power that is transmitted, (2,), of s and p light; NaN if the material
            absorbs.
        harmonics: N; fields are sums of 2N + 1 waves.
        error: the largest, of s and of p light, of three numbers: by how much the efficiencies of the reflected orders
            changed at the last raise of N, as a share of the reflected light, Σ|Δη_m| / Σ η_m; the same of those
            transmitted; and `imbalance`. If N was given it is `imbalance` alone.
    """

    orders: NDArray[np.int64]
    amplitudes: Complex
    transmitted_orders: NDArray[np.int64]
    transmitted_amplitudes: Complex
    transmitted: Real
    harmonics: int
    error: float

    @property
    def s(self) -> Real:
        """η_m of s-polarised incident light, (n,)."""
        return _powers(self.amplitudes)[:, 0]

    @property
    def p(self) -> Real:
        """η_m of p-polarised incident light, (n,)."""
        return _powers(self.amplitudes)[:, 1]

    @property
    def unpolarised(self) -> Real:
        """η_m of unpolarised light, the mean of both, (n,)."""
        return (self.s + self.p) / 2

    @property
    def transmitted_unpolarised(self) -> Real:
        """The efficiencies of `transmitted_orders` for unpolarised light, (k,)."""
        return _powers(self.transmitted_amplitudes).mean(axis=1)

    @property
    def imbalance(self) -> float:
        """|R + T − 1|, of s or p light, the larger; if the material absorbs, the excess of R over one."""
        reflected = _powers(self.amplitudes).sum(axis=0)
        if np.isnan(self.transmitted).any():
            return float(np.maximum(reflected - 1, 0).max())
        return float(np.abs(reflected + self.transmitted - 1).max())

    def __str__(self) -> str:
        """Return a table of all orders."""
        lines = [f"{'order':>17}{'s':>9}{'p':>9}{'unpolarised':>14}    % of the incident light"]
        sides = (
            ("reflected", self.orders, self.amplitudes),
            ("transmitted", self.transmitted_orders, self.transmitted_amplitudes),
        )
        for name, orders, amplitudes in sides:
            for m, (s, p) in zip(orders, 100 * _powers(amplitudes), strict=True):
                lines.append(f"{name:<11}{m:>6d}{s:>9.3f}{p:>9.3f}{(s + p) / 2:>14.3f}")
        return "\n".join([*lines, f"error {self.error:.1e}, {self.harmonics} harmonics"])

    __repr__ = __str__


def efficiencies(
    height_field: HeightField,
    direction: ArrayLike,
    wavelength: float,
    *,
    int_ior: complex | None = None,
    material: str | None = None,
    tolerance: float = 1e-3,
    harmonics: int | None = None,
) -> Efficiencies:
    """Compute the rigorous efficiencies of a surface of one row, h(x), in air; conical incidence included.

    Args:
        height_field: one period (rows that differ are refused); straight lines join the pixels (`curve_of`).
        direction: ω_i, (3,), to the light, in the local frame; it is normalised. ω_i,z < 0: the light comes from below,
            ω_i is its direction inside of the dielectric.
        wavelength: µm, in vacuum.
        int_ior: index of refraction of a dielectric, or n + ik.
        material: or a conductor by Mitsuba's name, "Al".
        tolerance: harmonics are raised until `Efficiencies.error` is below, or until their number reaches the largest
            of 80, twice the largest order, and one and a half times the waves that the profile is long (at most 300).
        harmonics: N, to take this number as it is; at least the largest |m| that propagates, above or below.

    Raises:
        ValueError: if an argument is out of range, or if more light leaves than came, by more than the tolerance: the
            profile is too deep for the wavelength.

    Warns:
        UserWarning: if `Efficiencies.error` is above the tolerance.
    """
    if not (np.isfinite(wavelength) and 0.01 <= wavelength <= 100):
        raise RequestError(f"wavelength: got {wavelength!r}, wanted µm, from 0.01 to 100")
    index = refractive_index(wavelength, int_ior=int_ior, material=material, known=True)
    omega = np.asarray(direction, np.float64)
    length = np.linalg.norm(omega)
    if omega.shape != (3,) or not (np.isfinite(length) and length > 0 and omega[2] != 0):
        raise RequestError(f"direction: got {direction!r}, wanted three numbers, to the light, the third not zero")
    if omega[2] < 0 and index.imag:
        raise RequestError(f"direction: got {direction!r}, light from inside of an absorbing material, wanted it above")
    omega = omega / length
    if not 0 < tolerance < 1:
        raise RequestError(f"tolerance: got {tolerance!r}, wanted a share of the reflected light between 0 and 1")
    curve, k_0 = curve_of(height_field), height_field.tile_size[0] / wavelength
    if harmonics is None:
        found = converge(curve, omega, k_0, index, tolerance)
    else:
        fewest, _ = wave_numbers(curve, k_0, index, omega)
        if not fewest <= harmonics <= 500:
            raise RequestError(f"harmonics: got {harmonics!r}, wanted a number from {fewest} to 500")
        found = solve(curve, omega, k_0, index, harmonics)
        found = dataclasses.replace(found, error=found.imbalance)
    exceeding = max(found.s.sum(), found.p.sum(), *np.nan_to_num(found.transmitted))
    if not exceeding <= 1 + tolerance:
        raise RequestError(
            f"height field: got orders with {exceeding:.3g} of the incident light, with {found.harmonics} harmonics, "
            f"wanted at most 1; {np.ptp(height_field.heights):.3g} µm are too deep for a period of "
            f"{height_field.tile_size[0]:.3g} µm and a wavelength of {wavelength:.3g} µm"
        )
    if found.error > tolerance:
        warnings.warn(
            f"rigorous efficiencies: got an error of {found.error:.2g} with {found.harmonics} harmonics, "
            f"wanted at most {tolerance:.2g}",
            stacklevel=2,
        )
    return found


def converge(curve: Curve, omega: Real, k_0: float, index: complex, tolerance: float) -> Efficiencies:
    """Raise the harmonics as `efficiencies` says, whatever error is reached; k_0 = period / wavelength."""
    fewest, waves = wave_numbers(curve, k_0, index, omega)
    most = max(MOST_HARMONICS, 2 * fewest, min(int(1.5 * waves), _FOR_DEEP_PROFILES))
    count = min(max(fewest + 6, waves), int(0.8 * most))
    found = solve(curve, omega, k_0, index, count)
    while found.error > tolerance and found.harmonics < most:
        count = min(int(np.ceil(1.25 * count)) + 1, most)
        before, found = found, solve(curve, omega, k_0, index, count)
        found = dataclasses.replace(found, error=max(_change(before, found), found.imbalance))
    return found


def wave_numbers(curve: Curve, k_0: float, index: complex, omega: Real) -> tuple[int, int]:
    """Return the largest order that propagates, above or below, and the waves that a profile is long.

    Light that travels along the curve has, where t runs fastest, as many waves to a unit of t as the second number
    says: below it, the efficiencies of deep profiles have nothing to do with their limit; above it, they converge
    exponentially.
    """
    max_wave_number = k_0 * np.sqrt(max(1.0, (index**2).real))
    k_x = k_0 * abs(omega[0]) * (1 if omega[2] >= 0 else index.real)
    return int(np.ceil(max_wave_number + k_x)), int(np.ceil(max_wave_number * np.hypot(*curve.tangent).max()))


def solve(curve: Curve, omega: Real, k_0: float, index: complex, harmonics: int) -> Efficiencies:
    """Solve with this number of harmonics; the error is unknown, ∞."""
    side = ABOVE if omega[2] > 0 else BELOW
    k = k_0, k_0 * index.real
    alpha, k_y = -omega[:2] * k[side]
    solved = scattered(curve, omega, k_0, index, harmonics)
    light = frames(-omega[None])

    def inframes(orders: NDArray[np.int64], amplitudes: Complex, to: int) -> Complex:
        alphas = alpha + orders
        heights = (1, -1)[to] * np.sqrt(k[to] ** 2 - k_y**2 - alphas**2)
        of_orders = frames(np.stack([alphas, np.full_like(alphas, k_y), heights], axis=1) / k[to])
        # Orders count along the change of k_x there, and along q = −(ω_i + ω_o)_∥/λ here.
        return (of_orders.transpose(0, 2, 1) @ amplitudes @ light)[::-1]

    order_0 = solved.orders[side].tolist().index(0)
    amplitudes, transmitted = (
        inframes(solved.orders[to], solved.amplitudes[side][to][:, :, order_0], to) for to in (side, 1 - side)
    )
    return Efficiencies(
        orders=-solved.orders[side][::-1],
        amplitudes=amplitudes,
        transmitted_orders=-solved.orders[1 - side][::-1],
        transmitted_amplitudes=transmitted,
        transmitted=_powers(transmitted).sum(axis=0) if index.imag == 0 else np.full(2, np.nan),
        harmonics=harmonics,
        error=float("inf"),
    )


@one_thread()
def scattered(curve: Curve, omega: Real, k_0: float, index: complex, harmonics: int) -> Scattered:
    """Solve for light from ω_i and of all orders that it is diffracted into."""
    grating = Grating(curve, harmonics)
    alpha, k_y = -omega[:2] * k_0 * (1 if omega[2] > 0 else index.real)
    above = half_space(grating, alpha, k_0**2 - k_y**2, True)
    square = k_0**2 * (index.real**2 if index.imag == 0 else index**2) - k_y**2
    return scatter(alpha + grating.n, above, half_space(grating, alpha, square, False), k_y, index)


def sheet_orders(curve: Curve, omega: Real, k_0: float, index: float, harmonics: int) -> tuple[NDArray[np.int64], Real]:
    """Return the orders that leave the flat face of a sheet, ascending, and η_m of s and of p light, (n, 2).

    Arguments are those of `solve`, of light from above.
    """
    solved = scattered(curve, omega, k_0, index, harmonics)
    matrices = through_sheet(solved, index)[ABOVE, BELOW][:, list(solved.orders[ABOVE]).index(0), 0].real
    light = frames(-omega[None])[0]
    stokes = np.einsum("as,iab,bs->is", light, _PAULI, light).real
    return -solved.orders[ABOVE][::-1], (matrices @ stokes)[::-1]


def _powers(amplitudes: Complex) -> Real:
    """Return η of each order, of s and of p light, (n, 2)."""
    return (np.abs(amplitudes) ** 2).sum(axis=1)


def _change(before: Efficiencies, after: Efficiencies) -> float:
    """Return Σ|Δη_m| / Σ η_m, of reflected or transmitted orders, of s or p light, the largest."""
    pairs = (
        (before.amplitudes, after.amplitudes),
        (before.transmitted_amplitudes, after.transmitted_amplitudes),
    )
    changes = [np.abs(a - b).sum(axis=0) / b.sum(axis=0) for a, b in (map(_powers, pair) for pair in pairs) if len(b)]
    return float(np.max(changes))


def frames(k: Real) -> Real:
    """Return ŝ and p̂ (columns) of waves along k (n, 3) in terms of ê and k̂ × ê (rows) of `Scattered`, (n, 2, 2).

    k_y may be imaginary: the matrix is orthogonal, not unitary.
    """
    # ê·ŝ = s_y/√(1 − k_y²), and (k̂ × ê)·ŝ = −ê·(k̂ × ŝ) = −ê·p̂, with ŝ = (−k_y, k_x, 0)/√(k_x² + k_y²).
    k_x, k_y, k_z = k.T
    across = np.emath.sqrt((k_x**2 + k_y**2).real)
    scale = np.sqrt(np.maximum((1 - k_y**2).real, 1e-30))
    along_normal = np.abs(across) < 1e-12
    across = np.where(along_normal, 1, across)
    cos, sin = np.where(along_normal, 1, k_x / across) / scale, -k_y * k_z / (across * scale)
    return np.array([[cos, sin], [-sin, cos]]).transpose(2, 0, 1)


# What a bounce inside loses: light that a shallow grating keeps in the sheet would never end.
_LOSS = 1e-9


def through_sheet(solved: Scattered, index: float) -> dict[tuple[int, int], Complex]:
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
    k_0, k = solved.k_0, index * solved.k_0
    into, plane = _plane(solved, solved.alpha[ABOVE], k_0, k, upwards=True)
    out_of, mirror = _plane(solved, solved.alpha[BELOW], k, k_0, upwards=False)
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


def _plane(solved: Scattered, alpha: Real, k: float, other: float, upwards: bool) -> tuple[Complex, Complex]:
    """Return the Mueller matrices of light that meets a plane, transmitted and reflected, (n, 4, 4) each.

    Args:
        solved: of the grating, for k_y.
        alpha: along the plane.
        k, other: wave numbers of the medium in which the light is, and beyond the plane.
        upwards: whether the light goes up.
    """
    k_y = solved.k_y
    beta, beta_other = (np.sqrt((w**2 - k_y**2 - alpha**2).real + 0j) for w in (k, other))
    square = (k / other) ** 2
    r_s, r_p = (beta - beta_other) / (beta + beta_other), (beta - square * beta_other) / (beta + square * beta_other)
    root = 2 * np.sqrt(beta * beta_other)
    t_s, t_p = root / (beta + beta_other), root * (k / other) / (beta + square * beta_other)
    sign = 1 if upwards else -1

    def basis(height: Real, w: float) -> Real:
        return frames(np.stack(np.broadcast_arrays(alpha, k_y, height), axis=1) / w)

    def matrices(to: Real, s: Complex, p: Complex) -> Complex:
        from_ = basis(sign * beta.real, k).transpose(0, 2, 1)
        amplitudes = to @ (np.stack([s, p], axis=1)[..., None] * from_)
        return mueller(amplitudes, solved.conjugate(amplitudes))

    travels = beta_other.imag == 0
    height = np.where(travels, beta_other.real, 0.0)
    transmitted = matrices(basis(sign * height, other), t_s, t_p)
    return np.where(travels[:, None, None], transmitted, 0), matrices(basis(-sign * beta.real, k), r_s, r_p)


def _as_matrix(matrices: Complex) -> Complex:
    """Return (n, k, 4, 4) as one matrix, (4n, 4k)."""
    n, k = matrices.shape[:2]
    return matrices.transpose(0, 2, 1, 3).reshape(4 * n, 4 * k)


def _as_blocks(matrix: Complex) -> Complex:
    """Return (4n, 4k) as (n, k, 4, 4)."""
    n, k = (size // 4 for size in matrix.shape)
    return matrix.reshape(n, 4, k, 4).transpose(0, 2, 1, 3)
