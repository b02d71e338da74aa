"""A finite number of tiles, which multiplies the transform of one by a factor (the "PQ" form), in float64."""

from __future__ import annotations

from numbers import Integral

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import RequestError
from ..reference import checked, mean_periodograms, nyquist_density
from ..spectrum.sample import WindowAxis
from ..surface.heightfield import HeightField


def tile_factor(x: ArrayLike, count: int) -> NDArray[np.floating]:
    """Compute D(x; N) = sin(πNx)/sin(πx), the sum of N unit phasors x periods apart, about their centre.

    N tiles of period T multiply the transform of one tile by D(qT; N), up to a phase. |D| ≤ N, and D² integrates to N
    over one period. The quotient is 0/0 at integers; with k the integer nearest to x and r = x − k, exact in floating
    point,

        D(x; N) = (−1)^{k(N−1)} sin(πNr)/sin(πr) → (−1)^{k(N−1)} N   as r → 0.

    The product Nr is represented by two numbers before its integer part is removed, which makes D accurate to a few
    units in the last place everywhere, also near its zeros.

    Args:
        x: (...) real; float32 is preserved, all other types become float64.
        count: N, from 1 to 1/ε of the floating-point type (2²³ in float32).

    Returns:
        (...) in the type of x.

    Raises:
        ValueError: if x is not real and finite, or count is not an integer in this range.
    """
    x = np.asarray(x)
    if x.dtype.kind not in "fiu":
        raise RequestError(f"x: got {x.dtype}, wanted real numbers")
    x = x.astype(np.float32 if x.dtype == np.float32 else np.float64)
    if not np.isfinite(x).all():
        raise RequestError("x: got numbers that are not finite")
    epsilon = np.finfo(x.dtype).eps
    if isinstance(count, bool) or not isinstance(count, Integral) or not 1 <= count <= 1 / epsilon:
        raise RequestError(f"count: got {count!r}, wanted a whole number of tiles from 1 to {int(1 / epsilon)}")
    number, pi = x.dtype.type(count), x.dtype.type(np.pi)

    nearest = np.rint(x)
    r = x - nearest
    product, rest = _exact_product(number, r)
    whole = np.rint(product)
    fraction = (product - whole) + rest
    # Here D differs from N by N(πNr)²/6, less than the rounding error.
    at_integer = np.abs(product) < np.sqrt(epsilon) / 4
    quotient = np.sin(pi * fraction) / np.where(at_integer, x.dtype.type(1), np.sin(pi * r))
    odd = np.fmod(np.abs(nearest) * x.dtype.type((count - 1) % 2) + np.abs(whole), 2)
    return np.where(at_integer, number, quotient) * (1 - 2 * odd)


def _exact_product(a: np.floating, b: NDArray[np.floating]) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
    """Return a·b as the rounded product and its rounding error, whose sum is exact (Dekker 1971)."""
    bits = np.finfo(b.dtype).nmant + 1

    def split(value: NDArray[np.floating]) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
        """Split a number into two of half the digits each, whose products are exact."""
        scaled = value * b.dtype.type(2 ** ((bits + 1) // 2) + 1)
        high = scaled - (scaled - value)
        return high, value - high

    product = a * b
    (a_high, a_low), (b_high, b_low) = split(np.asarray(a)), split(b)
    return product, ((a_high * b_high - product) + a_high * b_low + a_low * b_high) + a_low * b_low


def finite_tiles_spectrum(
    height_field: HeightField, q: ArrayLike, kappa: ArrayLike, *, tiles: tuple[int, int]
) -> NDArray[np.float64]:
    """Compute S(q; κ) of P × Q tiles without a window (the "PQ" form).

    With A the transform of one tile of N_x × N_y pixels, and D the factor of a row of tiles (`tile_factor`),

        A(q; κ) = Σ_n e^{iκh_n} e^{−2πi q·x_n}
        S(q; κ) = d_x d_y |A(q; κ)|² D(q_x T_x; P)² D(q_y T_y; Q)² / (N_x N_y P Q).

    A is summed directly at q, which equals the sinc interpolation of the FFT of the tile. It has the period 1/d_j; by
    Parseval's theorem S integrates to one over one such period, the Nyquist rectangle |q_j| ≤ 1/2d_j, into which higher
    frequencies are aliased. Outside the rectangle S is zero, as for a sample in `power_spectrum`, also along an axis of
    one pixel.

    Args:
        height_field: the tile.
        q: (..., 2) cycles/µm, along x and y.
        kappa: (...) rad/µm.
        tiles: (P, Q), numbers of tiles along x and y.

    Returns:
        (...) µm².

    Raises:
        ValueError: if `tiles` is not two integers ≥ 1, an argument is not finite, or the shapes do not match.
    """
    tiles = _checked_tiles(tiles)
    q, kappa = checked(q, kappa)
    shape = kappa.shape
    q, kappa = q.reshape(-1, 2), kappa.ravel()
    # A single uniform window over the whole tile.
    axes = tuple(WindowAxis(np.full(n, n**-0.5), np.zeros(1, np.int64)) for n in height_field.shape[::-1])
    result = mean_periodograms(height_field, q, kappa, axes)
    for axis in (0, 1):
        factor = tile_factor(q[:, axis] * height_field.tile_size[axis], tiles[axis])
        result *= factor**2 / tiles[axis] * nyquist_density(q[:, axis], height_field.pixel_size[axis])
    return result.reshape(shape)


def _checked_tiles(tiles: tuple[int, int]) -> tuple[int, int]:
    """Return two integers ≥ 1; raise ValueError for anything else."""
    pair = tuple(tiles) if isinstance(tiles, (tuple, list, np.ndarray)) else ()
    if len(pair) != 2 or not all(isinstance(n, Integral) and not isinstance(n, bool) and n >= 1 for n in pair):
        raise RequestError(f"tiles: got {tiles!r}, wanted two whole numbers ≥ 1, along x and y")
    return int(pair[0]), int(pair[1])
