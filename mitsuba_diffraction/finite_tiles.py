"""A finite number of tiles: the factor that multiplies the transform of one (the "PQ" form)."""

from __future__ import annotations

from numbers import Integral

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .errors import RequestError


def tile_factor(x: ArrayLike, count: int) -> NDArray[np.floating]:
    """D(x; N) = sin(πNx)/sin(πx): the sum of N unit phasors, successively shifted by x periods, about their centre.

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
    """a·b as the rounded product and its rounding error, whose sum is exact (Dekker 1971)."""
    bits = np.finfo(b.dtype).nmant + 1

    def split(value: NDArray[np.floating]) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
        """Two numbers of half the digits each, whose products are exact."""
        scaled = value * b.dtype.type(2 ** ((bits + 1) // 2) + 1)
        high = scaled - (scaled - value)
        return high, value - high

    product = a * b
    (a_high, a_low), (b_high, b_low) = split(a), split(b)
    return product, ((a_high * b_high - product) + a_high * b_low + a_low * b_high) + a_low * b_low
