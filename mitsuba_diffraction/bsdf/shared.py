"""The tables of a surface at run time, which its BSDFs share."""

from __future__ import annotations

import threading
import weakref
from collections.abc import Callable, Hashable
from typing import Any, TypeVar, cast

import drjit as dr
import mitsuba as mi
import numpy as np

from ..energy.table import EnergyTable
from ..optics.film_stack import Stack
from ..precomputation.grating_spectrum import GratingSpectrum
from ..settings import VISIBLE
from ..spectrum.grids import OrderGrid
from .continuum import Continuum
from .energy_factor import Energy
from .order_sampler import OrderSampler
from .orders import ScalarOrders
from .varying import Scales

MAX_NODE_PHASE_STEP = 0.5  # radians at the deepest point, between nodes of the ratio of scales in a table of E
MAX_RATIOS, MAX_INTERFACE_RATIOS = 32, 16  # number of these nodes; an interface has four tables of E
SAMPLER_RATIOS = 7  # number of ratios of varying scales; `OrderSampler` has bins for each interval between two

_making = threading.Lock()
_shared: weakref.WeakValueDictionary[Hashable, Any] = weakref.WeakValueDictionary()

Tables = TypeVar("Tables")


def shared(key: Hashable, make: Callable[[], Tables]) -> Tables:
    """Return the tables of a key (variant, digest, …) that a BSDF holds, or else new ones.

    Mitsuba constructs plugins on several threads: one of them makes the tables while the others wait.
    """
    with _making:
        tables = _shared.get(key)
        if tables is None:
            tables = _shared[key] = make()
        return cast(Tables, tables)


class SharedTables:
    """The tables of one spectrum of scalar theory for all BSDFs that have it, in one variant of Mitsuba.

    Attributes:
        table: the powers and their sampler. For resolved orders there is no sampler here, as it depends on the scene.
        stack: the media and the films, if light is transmitted.
        max_scale: the maximum lateral scale for which orders are resolved; None if they overlap without scaling.
    """

    def __init__(self, spectrum: GratingSpectrum, stack: Stack | None) -> None:
        # Above κ of nearly all transmitted light: 1.5 times κ of undiffracted light along the normal, at the shortest
        # visible wavelength.
        max_kappa = None if stack is None else 3 * np.pi * abs(stack.nominal - 1) / (VISIBLE[0] * 1e-3)
        kind = ScalarOrders if isinstance(spectrum.grid, OrderGrid) else Continuum
        self.table: ScalarOrders | Continuum = kind(spectrum, max_kappa)
        self.max_scale: float | None = None
        if isinstance(self.table, ScalarOrders) and self.table.resolved:
            self.max_scale = self.table.max_scale
        self._spectrum, self.stack = spectrum, stack
        self._energy: tuple[tuple, Energy | None] | None = None
        self._drawn: tuple[tuple, ScalarOrders] | None = None
        self._lock = threading.Lock()

    @classmethod
    def of(cls, spectrum: GratingSpectrum, stack: Stack | None = None) -> SharedTables:
        """Return the tables that a BSDF with an equal spectrum holds, or else new ones.

        `stack` has the media of a grating that transmits light, with its films.
        """
        return shared((mi.variant(), spectrum.digest, stack), lambda: cls(spectrum, stack))

    def scattering(self, scales: Scales, is_sheet: bool, coat_index: float) -> ScalarOrders | Continuum:
        """Return the powers of scalar theory and their sampler, for the media and scales of a scene."""
        if not self.table.resolved:
            return self.table
        low, high = scales.ratios()
        ratios = np.linspace(low, high, 1 if low == high else SAMPLER_RATIOS)
        key = is_sheet, coat_index, ratios.tolist(), scales.laterals
        with self._lock:
            if self._drawn is None or self._drawn[0] != key:
                sampler = OrderSampler(self._spectrum, self.stack, *key)
                self._drawn = key, cast(ScalarOrders, self.table).drawn_by(sampler)
            return self._drawn[1]

    def energy(self, scales: Scales) -> Energy | None:
        """Return the factor E, or None if it is one for all directions and wavelengths.

        E is linear between nodes of the ratio of scales where that varies or has a gradient.
        """
        spectrum, (low, high) = self._spectrum, scales.ratios()
        per_step = spectrum.max_kappa * spectrum.height_range / MAX_NODE_PHASE_STEP
        max_count = MAX_RATIOS if self.stack is None else MAX_INTERFACE_RATIOS
        count = 1 if low == high else int(np.clip(np.ceil((high - low) * per_step), 1, max_count - 1)) + 1
        if low == high and any(not scale.varies and dr.grad_enabled(scale.value) for scale in scales):
            # In the middle of two nodes the slope is a central difference. Values are stored as bytes: wide enough.
            half = 1 / max(per_step, 10)
            low, high, count = max(low - half, 0.0), low + half, 2
        key = np.linspace(low, high, count).tolist(), scales.laterals
        with self._lock:
            if self._energy is None or self._energy[0] != key:
                if key == ([1.0], (1.0, 1.0)) and self.stack is None:
                    table = spectrum.energy_table()
                else:
                    table = EnergyTable.of(spectrum, key[0], self.stack, key[1])
                self._energy = key, Energy(table) if table.needed else None
            return self._energy[1]
