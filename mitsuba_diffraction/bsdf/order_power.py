"""The power of a node of a spectrum at run time, for each way in which a spectrum stores it."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..spectrum.series_table import SeriesTable
from ..spectrum.slice_table import SliceTable
from .tables import PacketTable, opaque

# Linear interpolation of g_n(κ) errs by less than this share of its largest value.
_WEIGHT_ERROR = 1e-5


def order_power(table: SeriesTable | SliceTable, rim: int = 0) -> SeriesPower | SlicePower:
    """The evaluation that fits the table; `rim` rings of zeros are put around its nodes."""
    return SlicePower(table, rim) if isinstance(table, SliceTable) else SeriesPower(table, rim)


class _Power:
    """What both have in common.

    Attributes:
        table: packets of four floats; those of nodes beside each other along x lie beside each other.
        rows: of nodes.
        columns: of nodes.
    """

    def __init__(self, packets: np.ndarray, rim: int) -> None:
        """Takes (packets per node, rows, columns, 4)."""
        packets = np.pad(packets, ((0, 0), (rim, rim), (rim, rim), (0, 0))) if rim else packets
        self.rows, self.columns = packets.shape[1:3]
        self.table = PacketTable(packets)

    def of(self, node: mi.UInt32, at: list[tuple[mi.UInt32, mi.Vector4f]], active: mi.Bool) -> mi.Float:
        """c_m of one node (row-major); `at` is what the method `at` gave for κ."""
        return sum(dr.dot(self.table(offset + node, active), factors) for offset, factors in at)


class SlicePower(_Power):
    """c_m(κ) = a₀ + a₁t + a₂t² + a₃t³ on the interval of κ. A node is one packet of four floats."""

    def __init__(self, table: SliceTable, rim: int) -> None:
        super().__init__(table.polynomials(), rim)
        self.intervals = table.intervals
        self.per_kappa = opaque(table.intervals / table.largest_kappa)

    def at(self, kappa: mi.Float, active: mi.Bool) -> list[tuple[mi.UInt32, mi.Vector4f]]:
        """Where the packets of node 0 lie at κ (rad/µm), and the weights of their four floats."""
        x = kappa * self.per_kappa
        interval = dr.minimum(mi.UInt32(x), self.intervals - 1)
        t = x - mi.Float(interval)
        return [(interval * (self.rows * self.columns), mi.Vector4f(1, t, dr.square(t), dr.square(t) * t))]


class SeriesPower(_Power):
    """c_m(κ) = Σ_n g_n(κ) B_nm. A node is ⌈N/4⌉ packets of four floats; the g_n come from a small table over κ."""

    def __init__(self, table: SeriesTable, rim: int) -> None:
        terms, rows, columns = table.terms.shape
        self.packets = (terms + 3) // 4
        packets = np.zeros((self.packets, rows, columns, 4), np.float32)
        for n, term in enumerate(table.terms):
            packets[n // 4, :, :, n % 4] = term
        super().__init__(packets, rim)
        weights = _weights(table)
        self.steps = len(weights) - 1
        padded = np.zeros((len(weights), self.packets * 4), np.float32)
        padded[:, :terms] = weights
        self.weights = PacketTable(padded.reshape(-1, self.packets, 4))
        self.per_kappa = opaque(self.steps / table.largest_kappa)

    def at(self, kappa: mi.Float, active: mi.Bool) -> list[tuple[mi.UInt32, mi.Vector4f]]:
        """Where the packets of node 0 lie at κ (rad/µm), and the weights of their four floats."""
        x = kappa * self.per_kappa
        step = dr.minimum(mi.UInt32(x), self.steps - 1)
        t = x - mi.Float(step)
        result = []
        for packet in range(self.packets):
            low = self.weights(step * self.packets + packet, active)
            high = self.weights((step + 1) * self.packets + packet, active)
            result.append((mi.UInt32(packet * self.rows * self.columns), dr.fma(t, high - low, low)))
        return result


def _weights(table: SeriesTable) -> np.ndarray:
    """g_n at steps in κ so small that straight lines between them serve: (steps + 1, N)."""
    steps = 64
    while True:
        kappas = np.linspace(0, table.largest_kappa, 2 * steps + 1)
        weights = table.series.weights(kappas)
        error = np.abs(weights[1::2] - (weights[:-1:2] + weights[2::2]) / 2).max(axis=0)
        if (error <= _WEIGHT_ERROR * np.abs(weights).max(axis=0)).all() or steps >= 1 << 14:
            return weights[::2]
        steps *= 2
