"""The power of a node of a spectrum at run time, for each way in which a spectrum stores it."""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
import numpy as np

from ..spectrum.series_table import SeriesTable
from ..spectrum.slice_table import HALF_SCALE, SliceTable, shared_exponents
from .tables import HalfTable, PacketTable, SharedExponentTable, opaque

# Linear interpolation of g_n(κ) errs by less than this share of its largest value.
_WEIGHT_ERROR = 1e-5


# Nodes lie in squares of 4 × 4, so that those of a window lie in few lines of the cache: one word each, in one to four.
_SQUARE = 4


def order_power(
    table: SeriesTable | SliceTable, rim: tuple[int, int] = (0, 0), windows: bool = True
) -> SeriesPower | SlicePower:
    """The evaluation that fits the table.

    Args:
        table: of a spectrum.
        rim: nodes of zero that are put on each side, (x, y).
        windows: whether several nodes are read at a time.
    """
    return (SlicePower if isinstance(table, SliceTable) else SeriesPower)(table, rim, _SQUARE if windows else 1)


class _Power:
    """What both have in common.

    Attributes:
        table: packets of numbers, square after square of nodes.
        rows: of nodes, with the rim.
        columns: of nodes, with the rim.
        square: nodes along the side of a square.
        nodes: those of all squares.
    """

    def __init__(self, rows: int, columns: int, square: int) -> None:
        self.rows, self.columns, self.square = rows, columns, square
        self.row = -(-columns // square) * square**2  # nodes of a row of squares
        self.nodes = -(-rows // square) * self.row

    def _arranged(self, packets: np.ndarray) -> np.ndarray:
        """(..., rows, columns) → (..., nodes)."""
        square, (rows, columns) = self.square, packets.shape[-2:]
        pad = [(0, 0)] * (packets.ndim - 2) + [(0, -rows % square), (0, -columns % square)]
        padded = np.pad(packets, pad)
        rows, columns = (n // square for n in padded.shape[-2:])
        squares = padded.reshape(*packets.shape[:-2], rows, square, columns, square)
        return squares.swapaxes(-2, -3).reshape(*packets.shape[:-2], -1)

    def _places(self, first: mi.Int32, count: int, before: int, beside: int) -> list[mi.UInt32]:
        """What each of `count` rows or columns adds to the index: `before` for a square, `beside` for a node in it."""
        places = [mi.UInt32(first + step) for step in range(count)]
        if self.square == 1:
            return [place * before for place in places]
        return [place // self.square * before + place % self.square * beside for place in places]

    def window(
        self,
        row: mi.Int32,
        column: mi.Int32,
        weights_x: Sequence[mi.Float],
        weights_y: Sequence[mi.Float],
        at: list[tuple[mi.UInt32, mi.Vector4f]],
        active: mi.Bool,
    ) -> mi.Float:
        """Σ_ij w_x,i w_y,j c of the nodes from (row, column) on.

        Args:
            row: of the first node, the rim included; beyond the table, where a window holds zeros only, the nearest.
            column: likewise.
            weights_x: w_x,i.
            weights_y: w_y,j.
            at: what the method `at` gave for κ.
            active: mask.
        """
        row = dr.clip(row, 0, self.rows - len(weights_y))
        column = dr.clip(column, 0, self.columns - len(weights_x))
        rows = self._places(row, len(weights_y), self.row, self.square)
        columns = self._places(column, len(weights_x), self.square**2, 1)
        weights_x = [weight * self.unit for weight in weights_x]
        total = mi.Float(0.0)
        for offset, factors in at:
            packet = type(factors)(0.0)
            for weight, r in zip(weights_y, rows, strict=True):
                line = type(factors)(0.0)
                for w, c in zip(weights_x, columns, strict=True):
                    line = self.table.add(line, w, offset + r + c, active)
                packet = dr.fma(weight, line, packet)
            total += dr.dot(packet, factors)
        return total


class SlicePower(_Power):
    """c_m(κ) = Σ_p a_p t^p, −1 ≤ t ≤ 1 on the interval of κ. A node is one packet of one, two or four words."""

    def __init__(self, table: SliceTable, rim: tuple[int, int], square: int) -> None:
        values = _rimmed(table.values, rim)
        super().__init__(*values.shape[2:], square)
        values = self._arranged(values)
        words = table.words_per_node if dr.is_jit_v(mi.Float) else 4
        scale = 1.0
        if words == 1:
            mantissas, exponents = shared_exponents(values)
            packets = SharedExponentTable(np.moveaxis(mantissas, 1, -1), exponents)
        elif words == 2:
            scale = HALF_SCALE
            packets = HalfTable(np.moveaxis(values, 1, -1) * np.float32(scale))
        else:
            padded = np.pad(values, ((0, 0), (0, 4 - table.terms), (0, 0)))
            packets = PacketTable(np.moveaxis(padded, 1, -1))
        self.table, self.unit = packets, packets.unit / scale
        self.packet = mi.Vector3f if words == 1 else mi.Vector4f
        self.intervals = table.intervals
        self.per_kappa = opaque(table.intervals / table.largest_kappa)

    def at(self, kappa: mi.Float, active: mi.Bool) -> list[tuple[mi.UInt32, mi.Vector3f | mi.Vector4f]]:
        """Where the packets of node 0 lie at κ (rad/µm), and the factors of their numbers."""
        x = kappa * self.per_kappa
        interval = dr.minimum(mi.UInt32(x), self.intervals - 1)
        t = 2 * (x - mi.Float(interval)) - 1
        factors = [1, t, dr.square(t), dr.square(t) * t]
        return [(interval * self.nodes, self.packet(factors[: len(self.packet(0))]))]


class SeriesPower(_Power):
    """c_m(κ) = Σ_n g_n(κ) B_nm. A node is ⌈N/4⌉ packets of four floats; the g_n come from a small table over κ."""

    unit = 1.0

    def __init__(self, table: SeriesTable, rim: tuple[int, int], square: int) -> None:
        terms, rows, columns = table.terms.shape
        self.packets = (terms + 3) // 4
        packets = np.zeros((self.packets, 4, rows, columns), np.float32)
        packets.reshape(-1, rows, columns)[:terms] = table.terms
        packets = _rimmed(packets, rim)
        super().__init__(*packets.shape[2:], square)
        self.table = PacketTable(np.moveaxis(self._arranged(packets), 1, -1))
        weights = _weights(table)
        self.steps = len(weights) - 1
        padded = np.zeros((len(weights), self.packets * 4), np.float32)
        padded[:, :terms] = weights
        self.weights = PacketTable(padded.reshape(-1, self.packets, 4))
        self.per_kappa = opaque(self.steps / table.largest_kappa)

    def at(self, kappa: mi.Float, active: mi.Bool) -> list[tuple[mi.UInt32, mi.Vector4f]]:
        """Where the packets of node 0 lie at κ (rad/µm), and the factors of their four floats."""
        x = kappa * self.per_kappa
        step = dr.minimum(mi.UInt32(x), self.steps - 1)
        t = x - mi.Float(step)
        result = []
        for packet in range(self.packets):
            low = self.weights(step * self.packets + packet, active)
            high = self.weights((step + 1) * self.packets + packet, active)
            result.append((mi.UInt32(packet * self.nodes), dr.fma(t, high - low, low)))
        return result


def _rimmed(values: np.ndarray, rim: tuple[int, int]) -> np.ndarray:
    """(..., rows, columns) with nodes of zero around them."""
    return np.pad(values, ((0, 0), (0, 0), (rim[1], rim[1]), (rim[0], rim[0])))


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
