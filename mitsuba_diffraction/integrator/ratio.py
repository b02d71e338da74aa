"""A quotient that is defined everywhere."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi


def ratio(a: mi.Float, b: mi.Float) -> mi.Float:
    """a/b, and zero where b is: scalar variants raise there."""
    divides = b != 0
    return dr.select(divides, a / dr.select(divides, b, 1), 0)
