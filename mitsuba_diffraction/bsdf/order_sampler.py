"""Which order a ray takes: the distribution over orders from which the BSDF is sampled.

P_m = Σ_j w_j A_jm / Σ_j w_j M_j is a mixture over κ (`kappa_cells`), restricted to the rectangle of orders around those
that propagate: light on other orders goes nowhere, and at grazing incidence most of the mixture would lie there. M_j is
the sum of A_jm over the rectangle. A one-row grating has the exact interval: with s the direction of incidence,

    |m_x/T_x + s_x/λ| ≤ √(1/λ² − s_y²/λ²)
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..spectrum import GratingSpectrum
from .arithmetic import larger
from .incidence import Incidence
from .inversion import search
from .kappa_cells import CELLS, KappaCells, averages, choose
from .tables import PacketTable, opaque

FLOOR = 0.05  # the share of each κ cell that all orders have alike
WHOLE = 2**24  # a float32 holds whole numbers up to here
LARGEST_TABLE = 2**19  # packets (8 MB); where the sums over rectangles take more, all orders can be drawn


class OrderSampler:
    """Draws orders by two binary searches; P_m of a given order reads one packet of four floats.

    The A_jm are whole numbers of units 2⁻²⁴, so that sums over rectangles are exact: the probability of what is drawn
    is the probability that is reported.
    """

    def __init__(self, spectrum: GratingSpectrum) -> None:
        self.cells = KappaCells(spectrum.largest_kappa)
        self.rows, self.columns = spectrum.grid.shape
        self.largest_x, self.largest_y = spectrum.grid.largest
        self.tile_x, self.tile_y = (opaque(t) for t in spectrum.grid.tile_size)
        self.restricted = (self.largest_x + 1) ** 2 * (self.rows + 1) <= LARGEST_TABLE
        units = np.stack([_units(average) for average in averages(spectrum, FLOOR)], axis=-1)
        self.shares = PacketTable(units)
        # The sums of A_j over the columns before x, for each row.
        before_x = np.zeros((self.rows, self.columns + 1, CELLS), np.int64)
        before_x[:, 1:] = units.cumsum(axis=1)
        self.before_x = PacketTable(before_x)
        # The sums of A_j over the rows before y, for each first column and each end of the columns.
        first, end = np.arange(self.largest_x + 1), np.arange(self.largest_x + 1, self.columns + 1)
        if not self.restricted:
            first, end = first[:1], end[-1:]
        before_y = np.zeros((len(first), len(end), self.rows + 1, CELLS), np.int64)
        for index, column in enumerate(first):
            before_y[index, :, 1:] = np.moveaxis((before_x[:, end] - before_x[:, [column]]).cumsum(axis=0), 1, 0)
        self.before_y = PacketTable(before_y)

    def rectangle(self, incidence: Incidence) -> tuple[mi.Int32, mi.Int32, mi.Int32, mi.Int32]:
        """The first row, the end of the rows, the first column, the end of the columns."""
        if not self.restricted:
            return mi.Int32(0), mi.Int32(self.rows), mi.Int32(0), mi.Int32(self.columns)
        frequency = incidence.frequency
        s_x, s_y = incidence.wi.x * frequency, incidence.wi.y * frequency
        rows = self._interval(s_y, s_x, self.columns, frequency, self.tile_y, self.largest_y)
        columns = self._interval(s_x, s_y, self.rows, frequency, self.tile_x, self.largest_x)
        return *rows, *columns

    def _interval(
        self, along: mi.Float, across: mi.Float, lines: int, frequency: mi.Float, tile: mi.Float, largest: int
    ) -> tuple[mi.Int32, mi.Int32]:
        """The orders |m/T + s/λ| ≤ ρ along one axis, of which there are `lines` side by side: first and end."""
        if largest == 0:
            return mi.Int32(0), mi.Int32(1)
        half = frequency
        if lines == 1:
            half = dr.safe_sqrt(dr.square(frequency) - dr.square(across))
        first = mi.Int32(dr.ceil((-along - half) * tile))
        last = mi.Int32(dr.floor((half - along) * tile))
        # The mirror order m = 0 is always among them.
        return dr.clip(first, -largest, 0) + largest, dr.clip(last, 0, largest) + (largest + 1)

    def weights(self, incidence: Incidence, active: mi.Bool) -> mi.Vector4f:
        """w_j / Σ_j w_j M_j for one wavelength.

        Args:
            incidence: the wavelength and where it comes from.
            active: mask.
        """
        weights = self.cells.weights(incidence)
        bottom, top, left, right = self.rectangle(incidence)
        total = dr.dot(weights, self._masses(bottom, top, self._start(left, right), active))
        return weights * dr.rcp(larger(total, 1))

    def _start(self, left: mi.Int32, right: mi.Int32) -> mi.Int32:
        """Where the sums over the rows begin in their table."""
        if not self.restricted:
            return mi.Int32(0)
        return (left * (self.largest_x + 1) + right - (self.largest_x + 1)) * (self.rows + 1)

    def _masses(self, bottom: mi.Int32, top: mi.Int32, start: mi.Int32, active: mi.Bool) -> mi.Vector4f:
        """M_j in units."""
        masses = self.before_y(mi.UInt32(start + top), active)
        return masses - self.before_y(mi.UInt32(start + bottom), active) if self.rows > 1 else masses

    def share(self, order: mi.UInt32, weights: mi.Vector4f, active: mi.Bool) -> mi.Float:
        """P_m of the order with flat index `order`, which is among those of the rectangle."""
        return dr.dot(self.shares(order, active), weights)

    def sample(
        self,
        incidence: Incidence,
        u: mi.Float,
        v: mi.Point2f,
        active: mi.Bool,
    ) -> tuple[mi.Int32, mi.Int32, mi.Point2f]:
        """Draw an order for one wavelength; the arguments are those of `weights`.

        κ cell and row come from `u`, the column from `v` where there are several rows.

        Returns:
            Its row and column, and what is left of `v`: two numbers uniform in [0, 1).
        """
        bottom, top, left, right = self.rectangle(incidence)
        start = self._start(left, right)
        masses = self._masses(bottom, top, start, active)
        cell, u = choose(self.cells.weights(incidence) * masses, u)

        def before_y(y: mi.Int32) -> mi.Float:
            return self.before_y.entry(mi.UInt32(start + y), cell, active)

        def before_x(x: mi.Int32) -> mi.Float:
            return self.before_x.entry(mi.UInt32(row * (self.columns + 1) + x), cell, active)

        if self.rows == 1:
            row = mi.Int32(0)
            column, _ = search(before_x, left, right, self.columns, u)
            return row, column, v
        row, _ = search(before_y, bottom, top, self.rows, u)
        column, rest = search(before_x, left, right, self.columns, v.x)
        return row, column, mi.Point2f(rest, v.y)


def _units(average: NDArray[np.float64]) -> NDArray[np.int64]:
    """A_jm of one κ cell in units of 2⁻²⁴: at least one, no more than 2²⁴ together."""
    return 1 + np.floor(average * (WHOLE - average.size)).astype(np.int64)
