"""The sum over a finite number of tiles, in Dr.Jit."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

_AT_INTEGER = 2.0**-13.5  # a quarter of √ε in float32


def tile_factor(x: mi.Float, count: int) -> mi.Float:
    """Compute D(x; N) = sin(πNx)/sin(πx), as derived in `finite_tiles.tile_factor`.

    With k the integer nearest to x and r = x − k,

        D(x; N) = (−1)^{k(N−1)} sin(πNr)/sin(πr) → (−1)^{k(N−1)} N   as r → 0.
    """
    k = dr.round(x)
    r = x - k
    product = count * r
    rest = dr.fma(mi.Float(count), r, -product)  # rounding error of the product
    whole = dr.round(product)
    fraction = (product - whole) + rest
    at_integer = dr.abs(product) < _AT_INTEGER
    quotient = dr.sin(dr.pi * fraction) / dr.select(at_integer, 1, dr.sin(dr.pi * r))
    parity = mi.Int32(dr.abs(k)) * ((count - 1) % 2) + mi.Int32(dr.abs(whole))
    return dr.select(at_integer, mi.Float(count), quotient) * dr.select((parity & 1) == 0, mi.Float(1), mi.Float(-1))


def tile_sum(x: mi.Float, count: int) -> tuple[mi.Float, mi.Float]:
    """Return p + iq = Σ_{n<N} e^{−2πinx} = e^{−πi(N−1)x} D(x; N) (eq. 3.36, 3.45), stable where the thesis has 0/0."""
    k = dr.round(x)
    r = x - k
    # e^{−πi(N−1)k} = (−1)^{k(N−1)} cancels the same sign in D.
    parity = mi.Int32(dr.abs(k)) * ((count - 1) % 2)
    size = tile_factor(x, count) * dr.select((parity & 1) == 0, mi.Float(1), mi.Float(-1))
    sin, cos = dr.sincos(dr.pi * (count - 1) * r)
    return size * cos, -size * sin


def tiling_power(x: mi.Float, y: mi.Float, counts: tuple[int, int], wrong_product: bool) -> mi.Float:
    """Return p² + q² of (p₁ + iq₁)(p₂ + iq₂) over the squared number of tiles: one at integer x and y.

    Args:
        x: q_x T_x.
        y: q_y T_y.
        counts: numbers of tiles along x and y.
        wrong_product: q = p₁p₂ + q₁q₂, as in eq. 3.48, instead of p₁q₂ + q₁p₂.
    """
    if wrong_product:
        (p_1, q_1), (p_2, q_2) = tile_sum(x, counts[0]), tile_sum(y, counts[1])
        power = dr.square(p_1 * p_2 - q_1 * q_2) + dr.square(p_1 * p_2 + q_1 * q_2)
    else:
        power = dr.square(tile_factor(x, counts[0]) * tile_factor(y, counts[1]))
    return power / float(counts[0] * counts[1]) ** 2
