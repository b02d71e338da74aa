"""η_m(κ) at run time, for each way in which a spectrum stores it."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..spectrum.series_table import SeriesTable
from ..spectrum.slice_table import SliceTable
from .tables import PacketTable, opaque


def order_power(table: SeriesTable | SliceTable) -> SeriesPower | SlicePower:
    """The evaluation that fits the table."""
    return SlicePower(table) if isinstance(table, SliceTable) else SeriesPower(table)


class SeriesPower:
    """η_m(κ) = |Σ_n (iκH)ⁿ/n! F{(h/H)ⁿ}_m|².

    One evaluation reads 4·⌈N/2⌉ floats that lie one after the other, two terms to a packet.
    """

    def __init__(self, table: SeriesTable) -> None:
        terms, rows, columns = table.coefficients.shape
        self.pairs = (terms + 1) // 2
        packets = np.zeros((rows, columns, 2 * self.pairs, 2), np.float32)
        packets[:, :, :terms, 0] = np.moveaxis(table.coefficients.real, 0, -1)
        packets[:, :, :terms, 1] = np.moveaxis(table.coefficients.imag, 0, -1)
        self.table = PacketTable(packets)
        self.half_range = opaque(table.series.half_range)

    @dr.syntax
    def __call__(self, order: mi.UInt32, kappa: mi.Float, active: mi.Bool) -> mi.Float:
        """The power of the order with flat index `order` (row-major); κ in rad/µm."""
        # xⁿ/n! is real for even n, imaginary for odd n; two terms go into one step.
        x = kappa * self.half_range
        even, odd = mi.Float(1.0), mi.Float(x)
        real, imaginary = mi.Float(0.0), mi.Float(0.0)
        start = order * self.pairs
        pair = mi.UInt32(0)
        while pair < self.pairs:
            term = self.table(start + pair, active)
            real += even * term[0] - odd * term[3]
            imaginary += even * term[1] + odd * term[2]
            n = mi.Float(2 * pair)
            even *= -dr.square(x) / ((n + 1) * (n + 2))
            odd *= -dr.square(x) / ((n + 2) * (n + 3))
            pair += 1
        return dr.square(real) + dr.square(imaginary)


class SlicePower:
    """η_m(κ) by a cubic in κ. One evaluation reads one packet of four floats."""

    def __init__(self, table: SliceTable) -> None:
        self.table = PacketTable(table.polynomials())
        self.intervals = table.intervals
        self.per_kappa = opaque(table.intervals / table.largest_kappa)

    def __call__(self, order: mi.UInt32, kappa: mi.Float, active: mi.Bool) -> mi.Float:
        """The power of the order with flat index `order` (row-major); κ in rad/µm."""
        x = kappa * self.per_kappa
        interval = dr.minimum(mi.UInt32(x), self.intervals - 1)
        t = x - mi.Float(interval)
        a = self.table(order * self.intervals + interval, active)
        # The cubic may dip below zero by its error.
        return dr.maximum(dr.fma(dr.fma(dr.fma(a[3], t, a[2]), t, a[1]), t, a[0]), 0)
