"""What BSDFs of one surface share: its tables at run time."""

from __future__ import annotations

import dataclasses
import threading
import weakref
from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..energy.furnace import Furnace
from ..energy.table import EnergyTable, Layout, Stretched, between, corners, frequencies_of
from ..precomputation import Spectrum
from ..rigorous.spectrum import RigorousSpectrum
from ..settings import VISIBLE
from ..spectrum.grids import OrderGrid
from .energy import Energy
from .order_table import OrderTable
from .orders import OrderSpectrum
from .rigorous_orders import RigorousOrders
from .scales import Scales
from .spline_spectrum import SplineSpectrum

STEP = 1e-3  # of height_scale, for the derivative of the energy table
TURN = 0.25  # radians between tables over the ratio of scales
RATIOS = 7  # of scales that vary, between which there are cells of orders
PARTS = 16  # of an interval of ratios, at most

_making = threading.Lock()
_shared: weakref.WeakValueDictionary[tuple[str, str, float | None], SharedTables] = weakref.WeakValueDictionary()


class SharedTables:
    """The tables of one spectrum for every BSDF that shows it, in one variant of Mitsuba.

    Attributes:
        scattering: S(q; κ) and its sampler.
    """

    def __init__(self, spectrum: Spectrum, eta: float | None) -> None:
        if isinstance(spectrum, RigorousSpectrum):
            self.scattering = RigorousOrders(spectrum)
        else:
            represented = OrderSpectrum if isinstance(spectrum.grid, OrderGrid) else SplineSpectrum
            self.scattering = represented(spectrum, *([] if eta is None else passing(eta)))
        self._spectrum, self._eta = spectrum, eta
        self._last: tuple[float, Energy | None] | None = None
        self._orders: tuple[tuple, OrderTable] | None = None
        self._lock = threading.Lock()

    @classmethod
    def of(cls, spectrum: Spectrum, eta: float | None = None) -> SharedTables:
        """Return those of an equal spectrum, while some BSDF has them; else new ones.

        `eta` is the relative index where light passes the grating, too.

        Mitsuba constructs plugins on several threads: one of them makes the tables, the others wait.
        """
        key = mi.variant(), spectrum.digest, eta
        with _making:
            tables = _shared.get(key)
            if tables is None:
                tables = _shared[key] = cls(spectrum, eta)
            return tables

    def order_table(self, is_sheet: bool, scales: Scales) -> OrderTable | None:
        """Return the table from which orders are drawn where light passes; None where they overlap."""
        if not self.scattering.resolved:
            return None
        ratios, laterals, complete = scales.ratios()
        if not complete:
            ratios = np.linspace(*ratios, RATIOS)
        key = is_sheet, ratios.tolist(), float(laterals.min())
        with self._lock:
            if self._orders is None or self._orders[0] != key:
                self._orders = key, OrderTable(self._spectrum, self._eta, *key)
            return self._orders[1]

    def energy(self, height_scale: mi.Float) -> Energy | None:
        """Return the factor E, or None if it is one for all directions and wavelengths.

        Where a gradient is tracked through `height_scale`, the entries of the table carry theirs, from a central
        difference; not those of an interface, whose steps from cell to cell would be in the difference.
        """
        scale = float(np.max(height_scale))
        if dr.grad_enabled(height_scale) and self._eta is None:
            tables, lower, upper = self.energy_tables(scale), max(scale - STEP, 0.0), scale + STEP
            above, below = (self.corners(tables[0], s) for s in (upper, lower))
            slopes = (above - below) / (upper - lower)
            return Energy(tables, slopes, height_scale - dr.detach(height_scale))
        with self._lock:
            if self._last is None or self._last[0] != scale:
                tables = self.energy_tables(scale)
                needed = any(table.needed for table in tables)
                self._last = scale, Energy(tables) if needed else None
            return self._last[1]

    def scaled_energy(
        self, ratios: NDArray[np.float64], laterals: NDArray[np.float64], complete: bool
    ) -> Energy | None:
        """Return the factor E where scales vary, or None if it is one for all; `Scales.ratios` has the arguments.

        Each ratio has its tables if there are no others; else there are bounds for the parts of their interval, from
        its ends and its middle, between which phases turn by `TURN` unless there would be more than `PARTS`.
        """
        spectrum = self._spectrum
        if not complete:
            low, high = ratios
            turn = 0.5 * spectrum.max_kappa * spectrum.height_range * (high - low)
            ratios = np.linspace(low, high, 2 * int(np.clip(turn / (2 * TURN), 1, PARTS)) + 1)
            laterals = np.repeat(laterals[:1], len(ratios))
        found, most = [], float(np.max(ratios))
        shape = Layout.of(Furnace.of(spectrum, most, self._eta))
        indices = [None] if self._eta is None else [self._eta, 1 / self._eta]
        for ratio, lateral in zip(ratios, laterals, strict=True):
            stretched = Stretched(spectrum, float(lateral))
            # Tables of all ratios are read alike, but for their wavelengths.
            layouts = [dataclasses.replace(shape, frequencies=frequencies_of(stretched, index)) for index in indices]
            found.append(self.energy_tables(float(ratio), stretched, layouts))
        edges = (ratios[1:] + ratios[:-1]) / 2
        if not complete:
            found = [[between(*of) for of in zip(*found[k : k + 3], strict=True)] for k in range(0, len(ratios) - 2, 2)]
            edges = ratios[2:-1:2]
        tables = [table for of_ratio in found for table in of_ratio]
        needed = any(table.needed for table in tables)
        return Energy(tables, edges=edges.tolist()) if needed else None

    def energy_tables(
        self, height_scale: float, stretched: Stretched | None = None, layouts: Sequence[Layout] | None = None
    ) -> list[EnergyTable]:
        """Return the spectrum's own, or those made for other heights, or for both sides where light passes.

        With a lateral scale they are of the stretched spectrum, and have the layouts that are given.
        """
        spectrum = stretched or self._spectrum
        if self._eta is not None:
            return EnergyTable.of_interface(spectrum, self._eta, height_scale, layouts)
        own = height_scale == 1 and stretched is None
        return [self._spectrum.energy_table() if own else EnergyTable.of(spectrum, height_scale, layouts)]

    def corners(self, table: EnergyTable, height_scale: float) -> np.ndarray:
        """Return e at the corners of the cells of `table`, not rounded, for other heights."""
        return corners(Furnace.of(self._spectrum, height_scale), table.layout)[0]


def passing(eta: float) -> tuple[float, float]:
    """Return what samplers need for light that passes: κ below which nearly all of it lies, and the largest |k_∥|/n_o.

    Undiffracted light along the normal has κ = 2π |η − 1|/λ.
    """
    return 3 * np.pi * abs(eta - 1) / (VISIBLE[0] * 1e-3), max(eta, 1 / eta)
