"""The efficiencies of the orders of a grating by Maxwell's equations, their convergence, and Mueller matrices."""

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

from ..array_types import Complex, Real
from ..errors import RequestError
from ..optics.geometry import Orders
from ..optics.refractive_indices import refractive_index
from ..surface.heightfield import HeightField
from .coordinate_transformation import ABOVE, BELOW, Curve, CurveMatrices, Scattered, curve_of, half_space, scatter

# S_i = E† σ_i E, in the order of Stokes parameters; the sign of the last is Mitsuba's, with n + ik for metals.
_PAULI = np.array([[[1, 0], [0, 1]], [[1, 0], [0, -1]], [[0, 1], [1, 0]], [[0, 1j], [-1j, 0]]])

REVERSED = np.array([1, 1, 1, -1])
"""s: light reversed through an order, mirrored so that k_y has the same sign, has the Mueller matrix s_i s_j M_ji."""

ODD = np.not_equal.outer([1, 1, -1, -1], [1, 1, -1, -1])
"""Whether M_ij is odd in k_y."""


_KERNEL = np.einsum("iab,jcd->bcadij", _PAULI, _PAULI).reshape(16, 16) / 2


def mueller(amplitudes: Complex, of_conjugate: Complex | None = None) -> Complex:
    """Return M_ij = Tr(σ_i J σ_j J(k_y*)†) / 2 of amplitudes J, (…, 2, 2) → (…, 4, 4).

    Amplitudes refer to the basis (ê, k̂ × ê), as in `coordinate_transformation.Scattered`. Elements are real. Where k_y
    is imaginary, with J(k_y*) as `of_conjugate`, elements that are odd in k_y are imaginary.
    """
    conjugate = (amplitudes if of_conjugate is None else of_conjugate).conj()
    pairs = amplitudes[..., None, None] * conjugate[..., None, None, :, :]
    return (pairs.reshape(-1, 16) @ _KERNEL).reshape(*amplitudes.shape[:-2], 4, 4)


def matrices_of(solved: Scattered, side_i: int, side_o: int) -> Complex:
    """Return the Mueller matrices of light from one side to a side, (outgoing orders, incident orders, 4, 4)."""
    amplitudes = solved.amplitudes[side_i][side_o].transpose(0, 2, 1, 3)
    return mueller(amplitudes, solved.conjugate(amplitudes))


def unpolarised(solved: Scattered, side_i: int, side_o: int) -> NDArray[np.float64]:
    """Return η, the first element of `matrices_of`, (outgoing orders, incident orders, 1, 1)."""
    return solved.powers(solved.amplitudes[side_i][side_o]).sum(axis=(1, 3))[..., None, None] / 2


@functools.cache
def _controller() -> ThreadpoolController:
    return ThreadpoolController()


@contextmanager
def one_thread() -> Iterator[None]:
    """Run BLAS on one thread in the block, or in the function that this decorates.

    With matrices of a few hundred rows, threads mostly wait for each other: up to thirteen times as long.
    """
    with _controller().limit(limits=1, user_api="blas"):
        yield


MAX_HARMONICS = 80
# One solution with this number takes half a minute.
_MAX_HARMONICS_DEEP = 300


@dataclass(frozen=True, eq=False)
class Efficiencies:
    """Efficiencies and amplitudes of the orders of a grating for light from one direction.

    The polarisation of a wave that travels along k̂ is given in the basis ŝ = ẑ × k̂ / |ẑ × k̂| (ŷ along the
    normal) and p̂ = k̂ × ŝ; k̂ = −ω_i of the incident light, and k̂ = ω_o of an order.

    Attributes:
        orders: m of the propagating reflected orders, ascending, (n,); q_x = m / period. For reflected and transmitted
            orders n_o ω_o,x = −λ m / period − n_i ω_i,x, with the indices of the media of ω_o and ω_i.
        amplitudes: (n, 2, 2), [order, polarisation of the order, of the incident light], s before p; |·|² is a fraction
            of the incident power.
        transmitted_orders: m of the propagating transmitted orders, ascending, (k,); none if the material absorbs, or
            beyond the critical angle.
        transmitted_amplitudes: (k, 2, 2), as `amplitudes`, k̂ along the transmitted wave.
        transmitted: the transmitted fraction of incident s and p light, (2,); NaN if the material absorbs.
        harmonics: N; fields are sums of 2N + 1 waves.
        error: the largest, over s and p light, of three numbers: the change Σ|Δη_m| / Σ η_m of the reflected orders,
            summed over the last two increases of N; the same of the transmitted orders; and `imbalance`. If N was
            given, `imbalance` alone.
    """

    orders: NDArray[np.int64]
    amplitudes: Complex
    transmitted_orders: NDArray[np.int64]
    transmitted_amplitudes: Complex
    transmitted: Real
    harmonics: int
    error: float

    @property
    def reflection(self) -> Orders:
        """η_m of `orders`."""
        return Orders(self.orders, *_powers(self.amplitudes).T)

    @property
    def transmission(self) -> Orders:
        """The efficiencies of `transmitted_orders`."""
        return Orders(self.transmitted_orders, *_powers(self.transmitted_amplitudes).T)

    @property
    def s(self) -> Real:
        """η_m of s-polarised incident light, (n,)."""
        return self.reflection.s

    @property
    def p(self) -> Real:
        """η_m of p-polarised incident light, (n,)."""
        return self.reflection.p

    @property
    def unpolarised(self) -> Real:
        """η_m of unpolarised light, the mean of both, (n,)."""
        return self.reflection.unpolarised

    @property
    def imbalance(self) -> float:
        """The larger |R + T − 1| of s and p light; if the material absorbs, the excess of R over one."""
        reflected = _powers(self.amplitudes).sum(axis=0)
        if np.isnan(self.transmitted).any():
            return float(np.maximum(reflected - 1, 0).max())
        return float(np.abs(reflected + self.transmitted - 1).max())

    def __str__(self) -> str:
        """Return a table of all orders."""
        lines = [f"{'order':>17}{'s':>9}{'p':>9}{'unpolarised':>14}    % of the incident light"]
        for name, orders in (("reflected", self.reflection), ("transmitted", self.transmission)):
            for m, s, p in zip(orders.m, 100 * orders.s, 100 * orders.p, strict=True):
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
        height_field: one period (rows that differ are refused); straight lines or vertical walls join the pixels
            (`curve_of`).
        direction: ω_i, (3,), to the light, in the local frame; it is normalised. If ω_i,z < 0, light is incident from
            below, and ω_i is the direction inside the dielectric.
        wavelength: µm, in vacuum.
        int_ior: index of refraction of a dielectric, or n + ik.
        material: or a conductor by Mitsuba's name, "Al".
        tolerance: bound of `Efficiencies.error`, to which harmonics are added; their number is at most the maximum of
            80, twice the largest order, and 1.5 times the length of the profile in waves (the last at most 300).
        harmonics: N, instead of a tolerance; at least the largest |m| that propagates, above or below.

    Raises:
        ValueError: if an argument is out of range, or if the outgoing power exceeds the incident power by more than the
            tolerance, as the profile is too deep for the wavelength.

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
        raise RequestError(f"tolerance: got {tolerance!r}, wanted a fraction of the reflected light between 0 and 1")
    curve, k_0 = curve_of(height_field), height_field.tile_size[0] / wavelength
    if harmonics is None:
        found = converge(curve, omega, k_0, index, tolerance)
    else:
        max_order, _ = wave_numbers(curve, k_0, index, omega)
        if not max_order <= harmonics <= 500:
            raise RequestError(f"harmonics: got {harmonics!r}, wanted a number from {max_order} to 500")
        found = solve(curve, omega, k_0, index, harmonics)
        found = dataclasses.replace(found, error=found.imbalance)
    max_power = max(found.s.sum(), found.p.sum(), *np.nan_to_num(found.transmitted))
    if not max_power <= 1 + tolerance:
        raise RequestError(
            f"height field: got orders with {max_power:.3g} of the incident light, with {found.harmonics} harmonics, "
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
    """Add harmonics as described for `efficiencies`, whatever error is reached; k_0 = period / wavelength."""
    max_order, waves = wave_numbers(curve, k_0, index, omega)
    max_count = max(MAX_HARMONICS, 2 * max_order, min(int(1.5 * waves), _MAX_HARMONICS_DEEP))
    # The limit is reached after two increases at the earliest.
    count = min(max(max_order + 6, waves), int(0.64 * max_count))
    found, change = solve(curve, omega, k_0, index, count), np.inf
    while found.error > tolerance and found.harmonics < max_count:
        count = min(int(np.ceil(1.25 * count)) + 1, max_count)
        previous, found = found, solve(curve, omega, k_0, index, count)
        # With p light, blazed metals converge as slowly as 1/N, and one change may be small by chance.
        before, change = change, _change(previous, found)
        found = dataclasses.replace(found, error=max(before + change, found.imbalance))
        # A dielectric whose R + T is not one is far from the limit: the change from there is no error of what follows.
        if previous.imbalance > tolerance and index.imag == 0:
            change = 0.0
    return found


def wave_numbers(curve: Curve, k_0: float, index: complex, omega: Real) -> tuple[int, int]:
    """Return the largest propagating order, above or below, and the length of a profile in waves.

    The latter is the number of waves per unit of t of light that propagates along the curve, where t varies fastest.
    With fewer harmonics, the efficiencies of deep profiles are far from their limit; with more, they converge
    exponentially.
    """
    max_wave_number = k_0 * np.sqrt(max(1.0, (index**2).real))
    k_x = k_0 * abs(omega[0]) * (1 if omega[2] >= 0 else index.real)
    return int(np.ceil(max_wave_number + k_x)), int(np.ceil(max_wave_number * np.hypot(*curve.tangent).max()))


def solve(curve: Curve, omega: Real, k_0: float, index: complex, harmonics: int) -> Efficiencies:
    """Solve with a number of harmonics; `error`, which is unknown, is ∞."""
    side = ABOVE if omega[2] > 0 else BELOW
    k = k_0, k_0 * index.real
    alpha, k_y = -omega[:2] * k[side]
    solved = scattered(curve, omega, k_0, index, harmonics)
    incident_frame = frames(-omega[None])

    def in_s_and_p(orders: NDArray[np.int64], amplitudes: Complex, to: int) -> Complex:
        alphas = alpha + orders
        k_z = (1, -1)[to] * np.sqrt(k[to] ** 2 - k_y**2 - alphas**2)
        outgoing_frames = frames(np.stack([alphas, np.full_like(alphas, k_y), k_z], axis=1) / k[to])
        # `Scattered` numbers orders by the change of k_x, `Efficiencies` by q = −(ω_i + ω_o)_∥/λ.
        return (outgoing_frames.transpose(0, 2, 1) @ amplitudes @ incident_frame)[::-1]

    order_0 = solved.orders[side].tolist().index(0)
    amplitudes, transmitted = (
        in_s_and_p(solved.orders[to], solved.amplitudes[side][to][:, :, order_0], to) for to in (side, 1 - side)
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
    """Solve for light of the tangential wave vector of ω_i and of all orders that it is diffracted into."""
    grating = CurveMatrices(curve, harmonics)
    alpha, k_y = -omega[:2] * k_0 * (1 if omega[2] > 0 else index.real)
    above = half_space(grating, alpha, k_0**2 - k_y**2, True)
    square = k_0**2 * (index.real**2 if index.imag == 0 else index**2) - k_y**2
    return scatter(alpha + grating.n, above, half_space(grating, alpha, square, False), k_y, index)


def sheet_orders(curve: Curve, omega: Real, k_0: float, index: float, harmonics: int) -> Orders:
    """Return the orders transmitted by a sheet, ascending.

    For arguments see `solve`; light is incident from above.
    """
    solved = scattered(curve, omega, k_0, index, harmonics)
    matrices = through_sheet(solved, index)[ABOVE, BELOW][:, list(solved.orders[ABOVE]).index(0), 0].real
    frame = frames(-omega[None])[0]
    stokes = np.einsum("as,iab,bs->is", frame, _PAULI, frame).real
    return Orders(-solved.orders[ABOVE][::-1], *(matrices @ stokes)[::-1].T)


def _powers(amplitudes: Complex) -> Real:
    """Return η of each order, of s and of p light, (n, 2)."""
    return (np.abs(amplitudes) ** 2).sum(axis=1)


def _change(previous: Efficiencies, current: Efficiencies) -> float:
    """Return the largest Σ|Δη_m| / Σ η_m of reflected or transmitted orders, for s or p light."""
    pairs = (
        (previous.amplitudes, current.amplitudes),
        (previous.transmitted_amplitudes, current.transmitted_amplitudes),
    )
    changes = [np.abs(a - b).sum(axis=0) / b.sum(axis=0) for a, b in (map(_powers, pair) for pair in pairs) if len(b)]
    return float(np.max(changes))


def frames(k: Real) -> Real:
    """Return ŝ and p̂ (columns) of waves along k (n, 3) in terms of ê and k̂ × ê (rows) of `Scattered`, (n, 2, 2).

    k_y may be imaginary: the matrix is orthogonal, not unitary.
    """
    # ê·ŝ = s_y/√(1 − k_y²), and (k̂ × ê)·ŝ = −ê·(k̂ × ŝ) = −ê·p̂, with ŝ = (−k_y, k_x, 0)/√(k_x² + k_y²).
    k_x, k_y, k_z = k.T
    tangential = np.emath.sqrt((k_x**2 + k_y**2).real)
    scale = np.sqrt(np.maximum((1 - k_y**2).real, 1e-30))
    along_normal = np.abs(tangential) < 1e-12
    tangential = np.where(along_normal, 1, tangential)
    cos, sin = np.where(along_normal, 1, k_x / tangential) / scale, -k_y * k_z / (tangential * scale)
    return np.array([[cos, sin], [-sin, cos]]).transpose(2, 0, 1)


# Loss at each internal reflection, for convergence: light trapped in a sheet with a shallow grating would never leave.
_BOUNCE_LOSS = 1e-9


def through_sheet(solved: Scattered, index: float) -> dict[tuple[int, int], Complex]:
    """Compute the Mueller matrices of a sheet, with all internal reflections summed incoherently.

    The plane is far from the grating, so that the Stokes vectors of each order add up. Let G be the Mueller matrices of
    the grating for all orders together. F and T are the matrices of reflection and refraction at the plane, diagonal in
    the orders. Light enters through the grating or, by T, through the plane. The light that travels downwards inside is
    D = (1 − G F)⁻¹ G times the incident light, and

        above → above: G + G F D,    below → below: F + T D T,    above → below: T D,    below → above: G (1 + F D) T.

    Args:
        solved: of the grating, air above and the dielectric below.
        index: of the dielectric.

    Returns: (side of incidence, side of exit) → matrices, (outgoing, incident, 4, 4), with the orders above.
    """
    outside, inside = solved.orders
    grating = [[_as_matrix(matrices_of(solved, i, o)) for o in (ABOVE, BELOW)] for i in (ABOVE, BELOW)]
    k_0, k = solved.k_0, index * solved.k_0
    enter, plane = _plane(solved, solved.alpha[ABOVE], k_0, k, upwards=True)
    leave, mirror = _plane(solved, solved.alpha[BELOW], k, k_0, upwards=False)
    # Only orders that propagate on both sides of the plane cross it.
    crosses = np.equal.outer(inside, outside)
    enter = _as_matrix(crosses[..., None, None] * enter[None])
    leave = _as_matrix(crosses.T[..., None, None] * leave[None])
    mirror = _as_matrix(np.eye(len(inside))[..., None, None] * mirror[:, None])
    plane = _as_matrix(np.eye(len(outside))[..., None, None] * plane[:, None])
    sources = np.hstack([grating[ABOVE][BELOW], grating[BELOW][BELOW] @ enter])
    bounce = (1 - _BOUNCE_LOSS) * grating[BELOW][BELOW] @ mirror
    down = np.linalg.solve(np.eye(len(bounce)) - bounce, sources)
    from_above, from_below = down[:, : 4 * len(outside)], down[:, 4 * len(outside) :]
    found = {
        (ABOVE, ABOVE): grating[ABOVE][ABOVE] + grating[BELOW][ABOVE] @ mirror @ from_above,
        (BELOW, BELOW): plane + leave @ from_below,
        (ABOVE, BELOW): leave @ from_above,
        (BELOW, ABOVE): grating[BELOW][ABOVE] @ (enter + mirror @ from_below),
    }
    return {sides: _as_blocks(matrix) for sides, matrix in found.items()}


def _plane(
    solved: Scattered, alpha: NDArray[np.floating], k: float, other: float, upwards: bool
) -> tuple[Complex, Complex]:
    """Return the Mueller matrices of refraction and of reflection at a plane, (n, 4, 4) each.

    Args:
        solved: of the grating, for k_y.
        alpha: α of the incident waves, (n,).
        k, other: wave numbers in the medium of the incident light, and on the other side of the plane.
        upwards: whether the incident light travels upwards.
    """
    k_y = solved.k_y
    beta, beta_other = (np.sqrt((w**2 - k_y**2 - alpha**2).real + 0j) for w in (k, other))
    square = (k / other) ** 2
    r_s, r_p = (beta - beta_other) / (beta + beta_other), (beta - square * beta_other) / (beta + square * beta_other)
    root = 2 * np.sqrt(beta * beta_other)
    t_s, t_p = root / (beta + beta_other), root * (k / other) / (beta + square * beta_other)
    sign = 1 if upwards else -1

    def basis(k_z: Real, w: float) -> Real:
        return frames(np.stack(np.broadcast_arrays(alpha, k_y, k_z), axis=1) / w)

    def matrices(outgoing: Real, s: Complex, p: Complex) -> Complex:
        incident = basis(sign * beta.real, k).transpose(0, 2, 1)
        amplitudes = outgoing @ (np.stack([s, p], axis=1)[..., None] * incident)
        return mueller(amplitudes, solved.conjugate(amplitudes))

    propagates = beta_other.imag == 0
    k_z = np.where(propagates, beta_other.real, 0.0)
    transmitted = matrices(basis(sign * k_z, other), t_s, t_p)
    return np.where(propagates[:, None, None], transmitted, 0), matrices(basis(-sign * beta.real, k), r_s, r_p)


def _as_matrix(matrices: Complex) -> Complex:
    """Return (n, k, 4, 4) as one matrix, (4n, 4k)."""
    n, k = matrices.shape[:2]
    return matrices.transpose(0, 2, 1, 3).reshape(4 * n, 4 * k)


def _as_blocks(matrix: Complex) -> Complex:
    """Return (4n, 4k) as (n, k, 4, 4)."""
    n, k = (size // 4 for size in matrix.shape)
    return matrix.reshape(n, 4, k, 4).transpose(0, 2, 1, 3)
