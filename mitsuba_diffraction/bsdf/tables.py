"""The tables of a spectrum at run time: what Dr.Jit gathers from."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np


def opaque(value: float) -> mi.Float:
    """A number held as an array, not as a literal, so that one kernel serves every surface."""
    result = mi.Float(value)
    dr.make_opaque(result)
    return result


BELOW_ONE = 1 - 2.0**-24  # the largest float32 under one, in every variant


class PacketTable:
    """A flat table of packets of two or four numbers; one packet is one aligned read of 8 or 16 bytes."""

    def __init__(self, packets: np.ndarray, width: int = 4) -> None:
        """Takes the packets one after the other, of any shape; uint32 stays so, all else becomes float32."""
        self.width = width
        whole = packets.dtype == np.uint32
        self.number, one = (int, mi.UInt32) if whole else (float, mi.Float)
        self.packet = mi.Vector4u if whole else {2: mi.Vector2f, 4: mi.Vector4f}[width]
        flat = np.ascontiguousarray(packets, np.uint32 if whole else np.float32).ravel()
        # Scalar variants have no gather.
        self.values = one(flat) if dr.is_jit_v(mi.Float) else flat

    def __call__(self, index: mi.UInt32, active: mi.Bool) -> mi.Vector2f | mi.Vector4f | mi.Vector4u:
        """The packets at `index`; zero where not `active`."""
        if dr.is_jit_v(mi.Float):
            return dr.gather(self.packet, self.values, index, active)
        if not active:
            return self.packet(0)
        return self.packet(*map(self.number, self.values[self.width * index : self.width * (index + 1)]))

    def entry(self, index: mi.UInt32, place: mi.UInt32, active: mi.Bool) -> mi.Float:
        """One float of the packets at `index`; zero where not `active`."""
        index = self.width * index + place
        if dr.is_jit_v(mi.Float):
            return dr.gather(mi.Float, self.values, index, active)
        return float(self.values[index]) if active else 0.0
