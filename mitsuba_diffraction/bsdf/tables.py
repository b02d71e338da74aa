"""The tables of a spectrum at run time, what Dr.Jit gathers from, and comparisons in one instruction.

`dr.maximum` and its kin follow IEEE 754 for NaN and signed zeros, for which LLVM needs several instructions where a
processor has one for a comparison and a choice. Here a comparison with NaN is false.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..spectrum.tables import LEAST_EXPONENT


def larger(a: mi.Float, b: mi.Float) -> mi.Float:
    """Return `a` where it is more than `b`, else `b`."""
    return dr.select(a > b, a, b)


def smaller(a: mi.Float, b: mi.Float) -> mi.Float:
    """Return `a` where it is less than `b`, else `b`."""
    return dr.select(a < b, a, b)


def limited(x: mi.Float, low: float, high: float) -> mi.Float:
    """Return `x`, or the nearest number from `low` to `high`."""
    return smaller(larger(x, low), high)


def opaque(value: float) -> mi.Float:
    """Return a number held as an array, not as a literal, so that one kernel serves every surface."""
    result = mi.Float(value)
    dr.make_opaque(result)
    return result


BELOW_ONE = 1 - 2.0**-24  # the largest float32 under one, in every variant


class NumberTable:
    """A flat table of numbers."""

    def __init__(self, numbers: np.ndarray) -> None:
        """Take an array of any shape; uint32 stays so, all else becomes float32."""
        whole = numbers.dtype == np.uint32
        self.number = mi.UInt32 if whole else mi.Float
        self.values = self.number(aligned(numbers.ravel() if whole else np.asarray(numbers, np.float32).ravel()))

    def __call__(self, index: mi.UInt32, active: mi.Bool = True) -> mi.Float | mi.UInt32:
        """Return the numbers at `index`; zero where not `active`."""
        return dr.gather(self.number, self.values, index, active)


class PacketTable(NumberTable):
    """A flat table of packets of two or four floats, or four uint32; one packet is one read of 8 or 16 bytes."""

    unit = 1.0

    def __init__(self, packets: np.ndarray, width: int = 4) -> None:
        """Take the packets one after the other, of any shape."""
        super().__init__(packets)
        self.width = width
        floats = {2: mi.Vector2f, 4: mi.Vector4f}[width]
        self.packet = mi.Vector4u if packets.dtype == np.uint32 else floats

    def __call__(self, index: mi.UInt32, active: mi.Bool) -> mi.Vector2f | mi.Vector4f | mi.Vector4u:
        """Return the packets at `index`; zero where not `active`."""
        return dr.gather(self.packet, self.values, index, active)

    def add(self, packet: mi.Vector4f, weight: mi.Float, index: mi.UInt32, active: mi.Bool) -> mi.Vector4f:
        """Return `packet` + `weight` times what is at `index`."""
        return dr.fma(weight, self(index, active), packet)

    def entry(self, index: mi.UInt32, place: mi.UInt32, active: mi.Bool) -> mi.Float:
        """One float of the packets at `index`; zero where not `active`."""
        return super().__call__(self.width * index + place, active)


def aligned(values: np.ndarray) -> np.ndarray:
    """Return flat float32 or uint32 at an address that is a multiple of 64 bytes.

    Dr.Jit uses the memory of NumPy's arrays as it is, and reads a packet at once only where it is aligned so: else the
    kernel would be slower, and another one from one allocation to the next.
    """
    memory = np.empty(4 * values.size + 64, np.uint8)
    start = -memory.ctypes.data % 64
    result = memory[start : start + 4 * values.size].view(values.dtype)
    result[:] = values
    return result


class HalfTable:
    """A flat table of packets of four numbers in half precision, two in a word of 32 bits.

    A read costs two gathers of a word. Whole packets would have to be transposed: measured, that takes longer than the
    memory. The bits of a half, moved to where a float32 has them, are its number times `1/unit`; what is read is left
    so, for the caller to multiply sums by `unit`.
    """

    unit = 2.0**112  # the exponents of the two formats are 15 and 127 for the same number

    def __init__(self, packets: np.ndarray) -> None:
        """Take numbers of half precision in packets of four, in an array of any shape."""
        self.words = mi.UInt32(aligned(np.ascontiguousarray(packets, np.float16).view(np.uint32).ravel()))

    def add(self, packet: mi.Vector4f, weight: mi.Float, index: mi.UInt32, active: mi.Bool) -> mi.Vector4f:
        """Return `packet` + `weight` times what is at `index`."""
        numbers = []
        for half in (0, 1):
            word = dr.gather(mi.UInt32, self.words, 2 * index + half, active)
            numbers.append(dr.reinterpret_array(mi.Float, ((word & 0x7FFF) << 13) | ((word & 0x8000) << 16)))
            numbers.append(dr.reinterpret_array(mi.Float, ((word & 0x7FFF0000) >> 3) | (word & 0x80000000)))
        return dr.fma(weight, mi.Vector4f(numbers), packet)


class SharedExponentTable:
    """A flat table of packets of three numbers in a word of 32 bits: nine bits for each and five for one exponent.

    As the pixels of RGB9E5 pictures, but with signs. What is read is left times `1/unit`.
    """

    unit = 2.0 ** (126 + LEAST_EXPONENT)  # the exponent 1 is 2⁻¹²⁶ in a float32

    def __init__(self, mantissas: np.ndarray, exponents: np.ndarray) -> None:
        """Take m (..., 3) and e (...), the numbers being m 2^e."""
        m = mantissas.astype(np.int64) & 511
        words = (m[..., 0] << 23) | (m[..., 1] << 14) | (m[..., 2] << 5) | (exponents - LEAST_EXPONENT + 1)
        self.words = mi.UInt32(aligned(words.astype(np.uint32).ravel()))

    def add(self, packet: mi.Vector3f, weight: mi.Float, index: mi.UInt32, active: mi.Bool) -> mi.Vector3f:
        """Return `packet` + `weight` times what is at `index`."""
        word = dr.gather(mi.UInt32, self.words, index, active)
        signed = mi.Int32(word)
        numbers = mi.Vector3f(mi.Float(signed >> 23), mi.Float((signed << 9) >> 23), mi.Float((signed << 18) >> 23))
        return dr.fma(weight * dr.reinterpret_array(mi.Float, (word & 31) << 23), numbers, packet)


class ShareTable:
    """A flat table of packets of four nonnegative numbers in a word of 32 bits: six bits for each and one exponent.

    Numbers are rounded up, so that none becomes zero: exact enough for a density from which samples are drawn.

    Attributes:
        values: what is read, float32 (..., 4).
    """

    def __init__(self, packets: np.ndarray) -> None:
        """Take packets (..., 4)."""
        exponents = np.frexp(packets.max(axis=-1).astype(np.float32) / np.float32(63))[1]
        # Smaller ones are zero: nothing in a float32.
        exponents = np.maximum(exponents, -100)
        mantissas = np.ceil(np.ldexp(packets, -exponents[..., None])) * (packets > 1e-30)
        self.values = np.ldexp(mantissas, exponents[..., None]).astype(np.float32)
        m = mantissas.astype(np.int64)
        words = (m[..., 0] << 26) | (m[..., 1] << 20) | (m[..., 2] << 14) | (m[..., 3] << 8) | (exponents + 127)
        self.words = mi.UInt32(words.astype(np.uint32).ravel())

    def __call__(self, index: mi.UInt32, active: mi.Bool) -> mi.Vector4f:
        """Return the packets at `index`; zero where not `active`."""
        word = dr.gather(mi.UInt32, self.words, index, active)
        exponent = dr.reinterpret_array(mi.Float, (word & 255) << 23)
        return exponent * mi.Vector4f(*(mi.Float((word >> shift) & 63) for shift in (26, 20, 14, 8)))
