"""Contributions of paths from the light to the film."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np


@dataclass(frozen=True, eq=False)
class Splats:
    """n contributions, n ≥ 1.

    Attributes:
        position: pixels from the corner of the crop window.
        wavelengths: four, drawn by the sensor, nm.
        value: Σ value δ(x − position) over all splats has the expectation L(x), x in pixels, in the form in which the
            sensor gives radiance to the film: divided by the density of the wavelengths and times the film's response.
    """

    position: mi.Point2f
    wavelengths: mi.Spectrum
    value: mi.Spectrum


class SplatBuffer:
    """Where paths leave their contributions, as many as they have, from inside a recorded loop.

    Threads fill it in any order; what comes out is sorted by path and vertex.

    Attributes:
        capacity: what is beyond is only counted.
    """

    def __init__(self, capacity: int) -> None:
        self.capacity = capacity
        self._scalar: list[Splats] = []
        if dr.is_jit_v(mi.Float):
            self._count = dr.zeros(mi.UInt32, 1)
            self._columns = [dr.empty(mi.Float, capacity) for _ in range(2 + 2 * dr.size_v(mi.Spectrum))]
            self._path, self._vertex = dr.empty(mi.UInt32, capacity), dr.empty(mi.UInt32, capacity)
            dr.make_opaque(self._count)

    def add(self, splats: Splats, path: mi.UInt32, vertex: mi.UInt32, active: mi.Bool) -> None:
        """Adds one contribution of a path at one of its vertices."""
        if not dr.is_jit_v(mi.Float):
            if active:
                self._scalar.append(splats)
            return
        slot = dr.scatter_inc(self._count, mi.UInt32(0), active)
        active = active & (slot < dr.opaque(mi.UInt32, self.capacity))
        values = (*splats.position, *splats.wavelengths, *splats.value)
        for column, value in zip(self._columns, values, strict=True):
            dr.scatter(column, value, slot, active)
        dr.scatter(self._path, path, slot, active)
        dr.scatter(self._vertex, vertex, slot, active)

    def count(self) -> int:
        """How many were added; runs what is recorded."""
        if not dr.is_jit_v(mi.Float):
            return len(self._scalar)
        dr.eval(self._count, self._columns, self._path, self._vertex)
        return int(self._count[0])

    def content(self) -> list[Splats]:
        """All of them, if there are no more than `capacity`."""
        count = self.count()
        if not dr.is_jit_v(mi.Float) or count == 0:
            return self._scalar
        order = np.lexsort((np.array(self._vertex)[:count], np.array(self._path)[:count]))
        columns = [dr.gather(mi.Float, column, mi.UInt32(order)) for column in self._columns]
        channels = dr.size_v(mi.Spectrum)
        position, wavelengths, value = columns[:2], columns[2 : 2 + channels], columns[2 + channels :]
        return [Splats(mi.Point2f(position), mi.Spectrum(wavelengths), mi.Spectrum(value))]
