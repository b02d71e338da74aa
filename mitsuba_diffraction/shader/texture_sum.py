"""The inner loops of the shader: Taylor series of a texel, and weighted sums over texels."""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np

from ..bsdf.tables import PacketTable, opaque
from .taylor_textures import TaylorTextures


class TextureSum:
    """Sums over Taylor textures; each term of each texel is one read of a complex number."""

    def __init__(self, textures: TaylorTextures) -> None:
        self.columns, self.rows = textures.orders
        self.terms = textures.terms
        self.height = opaque(textures.height)
        self.table = PacketTable(np.stack([textures.texels.real, textures.texels.imag], axis=-1), width=2)

    def amplitude(
        self, m_x: mi.Int32, m_y: mi.Int32, kappa: mi.Float, active: mi.Bool
    ) -> tuple[mi.Float, mi.Float, mi.Bool]:
        """Real and imaginary part of F_m(κ) = Σ_n (iκH)ⁿ/n! F{tⁿ}(m), and whether the order lies in the texture."""
        column, row = m_x + self.columns // 2, m_y + self.rows // 2
        held = active & (column >= 0) & (column < self.columns) & (row >= 0) & (row < self.rows)
        first = mi.UInt32(dr.select(held, (row * self.columns + column) * self.terms, 0))
        re, im = _taylor_series(self.table, first, kappa * self.height, self.terms, held)
        return re, im, held

    def over(
        self,
        first: tuple[mi.Int32, mi.Int32],
        size: tuple[int, int],
        kappa: mi.Float,
        weight: Callable[[mi.Int32, mi.Int32], mi.Float],
        active: mi.Bool,
    ) -> tuple[mi.Float, mi.Float]:
        """|Σ_m φ_m F_m(κ)|² and Σ_m φ_m² |F_m(κ)|² over a rectangle of texels.

        Args:
            first: the texel of lowest order along x and y.
            size: numbers of texels along x and y.
            kappa: κ in rad/µm.
            weight: φ of the orders (m_x, m_y).
            active: mask.
        """
        return _rectangle(self, mi.Int32(first[0]), mi.Int32(first[1]), size[0], size[1], kappa, weight, active)


@dr.syntax
def _taylor_series(
    table: PacketTable, first: mi.UInt32, x: mi.Float, terms: int, active: mi.Bool
) -> tuple[mi.Float, mi.Float]:
    """Σ_n (ix)ⁿ/n! B_n."""
    re, im = mi.Float(0), mi.Float(0)
    # (ix)ⁿ/n!
    c_re, c_im = mi.Float(1), mi.Float(0)
    n = mi.UInt32(0)
    while n < terms:
        term = table(first + n, active)
        re += c_re * term.x - c_im * term.y
        im += c_re * term.y + c_im * term.x
        n += 1
        step = x / mi.Float(n)
        c_re, c_im = -step * c_im, step * c_re
    return re, im


@dr.syntax
def _rectangle(
    textures: TextureSum,
    first_x: mi.Int32,
    first_y: mi.Int32,
    columns: int,
    rows: int,
    kappa: mi.Float,
    weight: Callable[[mi.Int32, mi.Int32], mi.Float],
    active: mi.Bool,
) -> tuple[mi.Float, mi.Float]:
    re, im, powers = mi.Float(0), mi.Float(0), mi.Float(0)
    index = mi.Int32(0)
    while index < columns * rows:
        m_x = first_x + index % columns
        m_y = first_y + index // columns
        part_re, part_im, _held = textures.amplitude(m_x, m_y, kappa, active)
        phi = weight(m_x, m_y)
        re += phi * part_re
        im += phi * part_im
        powers += dr.square(phi) * (dr.square(part_re) + dr.square(part_im))
        index += 1
    return dr.square(re) + dr.square(im), powers
