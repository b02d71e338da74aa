"""The larger and the smaller of two floats, in one instruction each.

`dr.maximum` and its kin follow IEEE 754 for NaN and signed zeros, for which LLVM needs several instructions where a
processor has one for a comparison and a choice. Here a comparison with NaN is false.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi


def larger(a: mi.Float, b: mi.Float) -> mi.Float:
    """`a` where it is more than `b`, else `b`."""
    return dr.select(a > b, a, b)


def smaller(a: mi.Float, b: mi.Float) -> mi.Float:
    """`a` where it is less than `b`, else `b`."""
    return dr.select(a < b, a, b)


def limited(x: mi.Float, low: float, high: float) -> mi.Float:
    """`x`, or the nearest number from `low` to `high`."""
    return smaller(larger(x, low), high)
