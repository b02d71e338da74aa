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
    """A flat table of packets of four floats; one packet is one aligned read of 16 bytes."""

    def __init__(self, packets: np.ndarray) -> None:
        """Takes float32 (..., 4)."""
        flat = np.ascontiguousarray(packets, np.float32).ravel()
        # Scalar variants have no gather.
        self.values = mi.Float(flat) if dr.is_jit_v(mi.Float) else flat

    def __call__(self, index: mi.UInt32, active: mi.Bool) -> mi.Vector4f:
        """The packets at `index`; zero where not `active`."""
        if dr.is_jit_v(mi.Float):
            return dr.gather(mi.Vector4f, self.values, index, active)
        return mi.Vector4f(*map(float, self.values[4 * index : 4 * index + 4])) if active else mi.Vector4f(0.0)
