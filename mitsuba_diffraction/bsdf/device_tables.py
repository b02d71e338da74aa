"""Arrays of Dr.Jit from numbers, tables that it gathers from, and minimum, maximum and integer part.

Every array that a kernel reads is made by `on_device` or `opaque`: Dr.Jit maps the memory of a NumPy array, and its
address enters the text of the kernel, which is then compiled again in another process.

`dr.maximum` and `dr.minimum` follow IEEE 754 for NaN and signed zeros, which takes LLVM several instructions; a
comparison and a selection take one each. Here a comparison with NaN is false.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike

from ..spectrum.tables import MIN_EXPONENT


def larger(a: mi.Float, b: mi.Float) -> mi.Float:
    """Return the maximum; `b` where one of them is NaN."""
    return dr.select(a > b, a, b)


def smaller(a: mi.Float, b: mi.Float) -> mi.Float:
    """Return the minimum; `b` where one of them is NaN."""
    return dr.select(a < b, a, b)


def limited(x: mi.Float, low: float, high: float) -> mi.Float:
    """Return `x`, clipped to the interval from `low` to `high`."""
    return smaller(larger(x, low), high)


def integer_part(x: mi.Float) -> mi.UInt32:
    """Return the integer part of x, 0 ≤ x < 2³¹.

    LLVM converts between float32 and int32 in one instruction. For uint32 it needs several without AVX-512.
    """
    return mi.UInt32(mi.Int32(x))


def opaque(value: float) -> mi.Float:
    """Return a number as an opaque array instead of a literal, so that all surfaces have the same kernel."""
    return dr.opaque(mi.Float, float(value))


def on_device(values: ArrayLike, kind: type | None = None) -> Any:
    """Return a flat array of Dr.Jit, in aligned memory of its own, with the numbers of any array.

    Args:
        values: of any shape.
        kind: of Dr.Jit; default: `mi.Float`.
    """
    kind, numbers = kind or mi.Float, np.ravel(values)
    result = dr.empty(kind, numbers.size)
    memory = np.asarray(result)  # that of Dr.Jit on processors; of arrays on a GPU a copy
    memory[...] = numbers
    return result if dr.backend_v(kind) == dr.JitBackend.LLVM else kind(memory)


BELOW_ONE = 1 - 2.0**-24  # the largest float32 under one, in every variant


class NumberTable:
    """A flat table of numbers."""

    def __init__(self, numbers: np.ndarray) -> None:
        """Flatten an array; numbers other than uint32 and float16 are converted to float32."""
        self.number = {np.uint32: mi.UInt32, np.float16: mi.Float16}.get(numbers.dtype.type, mi.Float)
        self.values = on_device(numbers, self.number)

    def __call__(self, index: mi.UInt32, active: mi.Bool = True) -> mi.Float | mi.UInt32:
        """Return the numbers at `index`; zero where not `active`."""
        return dr.gather(self.number, self.values, index, active)


class PacketTable(NumberTable):
    """A flat table of packets of four numbers, or two floats; one packet is one read of 8 or 16 bytes."""

    unit = 1.0

    def __init__(self, packets: np.ndarray, width: int = 4) -> None:
        """Flatten an array whose last axis is within the packets."""
        super().__init__(packets)
        self.width = width
        floats = {2: mi.Vector2f, 4: mi.Vector4f}[width]
        self.packet = {mi.UInt32: mi.Vector4u, mi.Float16: mi.Array4f16}.get(self.number, floats)

    def __call__(self, index: mi.UInt32, active: mi.Bool | bool = True) -> Any:
        """Return the packets at `index`; zero where not `active`."""
        return dr.gather(self.packet, self.values, index, active)

    def add(self, packet: mi.Vector4f, weight: mi.Float, index: mi.UInt32, active: mi.Bool) -> mi.Vector4f:
        """Return `packet` plus `weight` times the packet at `index`."""
        return dr.fma(weight, mi.Vector4f(self(index, active)), packet)

    def component(self, index: mi.UInt32, component: mi.UInt32, active: mi.Bool) -> mi.Float:
        """Return one component of the packet at `index`; zero where not `active`."""
        return super().__call__(self.width * index + component, active)


class SharedExponentTable:
    """A flat table of packets of three numbers in a word of 32 bits: nine bits for each and five for one exponent.

    The format is RGB9E5 with signs. Multiply what is read by `unit`.
    """

    unit = 2.0 ** (126 + MIN_EXPONENT)  # the exponent 1 is 2⁻¹²⁶ in a float32

    def __init__(self, mantissas: np.ndarray, exponents: np.ndarray) -> None:
        """Pack the numbers m 2^e, m (..., 3) and e (...)."""
        m = mantissas.astype(np.int64) & 511
        words = (m[..., 0] << 23) | (m[..., 1] << 14) | (m[..., 2] << 5) | (exponents - MIN_EXPONENT + 1)
        self.words = on_device(words, mi.UInt32)

    def add(self, packet: mi.Vector3f, weight: mi.Float, index: mi.UInt32, active: mi.Bool) -> mi.Vector3f:
        """Return `packet` plus `weight` times the packet at `index`."""
        word = dr.gather(mi.UInt32, self.words, index, active)
        signed = mi.Int32(word)
        numbers = mi.Vector3f(mi.Float(signed >> 23), mi.Float((signed << 9) >> 23), mi.Float((signed << 18) >> 23))
        return dr.fma(weight * dr.reinterpret_array(mi.Float, (word & 31) << 23), numbers, packet)


class ProbabilityTable:
    """A flat table of packets of four nonnegative numbers in a word of 32 bits: six bits for each and one exponent.

    Numbers are rounded up, so that none becomes zero, which is accurate enough for a sampling density.

    Attributes:
        values: the rounded numbers, float32 (..., 4).
    """

    def __init__(self, packets: np.ndarray) -> None:
        """Pack numbers, (..., 4)."""
        exponents = np.frexp(packets.max(axis=-1).astype(np.float32) / np.float32(63))[1]
        # Numbers up to 1e-30 become zero.
        exponents = np.maximum(exponents, -100)
        mantissas = np.ceil(np.ldexp(packets, -exponents[..., None])) * (packets > 1e-30)
        self.values = np.ldexp(mantissas, exponents[..., None]).astype(np.float32)
        m = mantissas.astype(np.int64)
        words = (m[..., 0] << 26) | (m[..., 1] << 20) | (m[..., 2] << 14) | (m[..., 3] << 8) | (exponents + 127)
        self.words = on_device(words, mi.UInt32)

    def block(self, index: mi.UInt32, component: mi.UInt32, active: mi.Bool) -> mi.Vector4f:
        """Return one component of the four packets from 4 · `index`; zero where not `active`."""
        words = dr.gather(mi.Vector4u, self.words, index, active)
        exponents = dr.reinterpret_array(mi.Vector4f, (words & 255) << 23)
        return exponents * mi.Vector4f(mi.Vector4i((words >> (26 - 6 * component)) & 63))

    def __call__(self, index: mi.UInt32, active: mi.Bool) -> mi.Vector4f:
        """Return the packets at `index`; zero where not `active`."""
        word = dr.gather(mi.UInt32, self.words, index, active)
        exponent = dr.reinterpret_array(mi.Float, (word & 255) << 23)
        return exponent * mi.Vector4f(*(mi.Float(mi.Int32((word >> shift) & 63)) for shift in (26, 20, 14, 8)))
