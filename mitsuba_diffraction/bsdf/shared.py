"""What BSDFs of one surface share: its tables at run time."""

from __future__ import annotations

import threading
import weakref

import drjit as dr
import mitsuba as mi
import numpy as np

from ..rigorous.spectrum import RigorousSpectrum
from ..spectrum.albedo import GatheredSpectrum, energy_table
from ..spectrum.energy_table import EnergyTable
from ..spectrum.furnace import conserving
from ..spectrum.load import Spectrum
from ..spectrum.orders import OrderGrid
from .energy import Energy
from .order_spectrum import OrderSpectrum
from .rigorous_orders import RigorousOrders
from .spline_spectrum import SplineSpectrum

STEP = 1e-3  # of height_scale, for the derivative of the energy table

_making = threading.Lock()
_shared: weakref.WeakValueDictionary[tuple[str, str], SharedTables] = weakref.WeakValueDictionary()


class SharedTables:
    """The tables of one spectrum for every BSDF that shows it, in one variant of Mitsuba.

    Attributes:
        scattering: S(q; κ) and its sampler.
    """

    KEPT = 8  # energy tables of other heights

    def __init__(self, spectrum: Spectrum) -> None:
        if isinstance(spectrum, RigorousSpectrum):
            self.scattering = RigorousOrders(spectrum)
        else:
            self.scattering = (OrderSpectrum if isinstance(spectrum.grid, OrderGrid) else SplineSpectrum)(spectrum)
        self._spectrum = spectrum
        self._gathered: GatheredSpectrum | None = None
        self._tables: dict[tuple[str, float], EnergyTable] = {}
        self._energies: dict[tuple[str, float], Energy] = {}
        self._lock = threading.RLock()

    @classmethod
    def of(cls, spectrum: Spectrum) -> SharedTables:
        """Those of an equal spectrum, while some BSDF has them; else new ones.

        Mitsuba constructs plugins on several threads: one of them makes the tables, the others wait.
        """
        key = mi.variant(), spectrum.digest
        with _making:
            tables = _shared.get(key)
            if tables is None:
                tables = _shared[key] = cls(spectrum)
            return tables

    def energy_table(self, shadowing: str, height_scale: float) -> EnergyTable:
        """The spectrum's own, or computed for another height."""
        if height_scale == 1:
            return self._spectrum.energy_table(shadowing)
        key = shadowing, height_scale
        with self._lock:
            if key not in self._tables:
                table = conserving(self._spectrum, self.gathered_table(shadowing, height_scale), height_scale)
                self._keep(self._tables, key, table)
            return self._tables[key]

    def gathered_table(self, shadowing: str, height_scale: float) -> EnergyTable:
        with self._lock:
            if self._gathered is None:
                self._gathered = GatheredSpectrum.of(self._spectrum)
            return energy_table(self._gathered, shadowing, height_scale)

    def energy(self, shadowing: str, height_scale: mi.Float) -> Energy | None:
        """The factor E, or None if it is one for all directions and wavelengths.

        Where a gradient is tracked through `height_scale`, the entries of the table carry theirs, from a central
        difference.
        """
        scale = float(np.max(height_scale))
        table = self.energy_table(shadowing, scale)
        if dr.grad_enabled(height_scale):
            lower, upper = max(scale - STEP, 0.0), scale + STEP
            above, below = (self.gathered_table(shadowing, s).values for s in (upper, lower))
            return Energy(table, (above - below) / (upper - lower), height_scale - dr.detach(height_scale))
        if not table.needed:
            return None
        key = shadowing, scale
        with self._lock:
            if key not in self._energies:
                self._keep(self._energies, key, Energy(table))
            return self._energies[key]

    def _keep(self, tables: dict, key: tuple[str, float], table: object) -> None:
        while len(tables) >= self.KEPT:
            del tables[next(iter(tables))]
        tables[key] = table
