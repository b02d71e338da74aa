"""Checks of the arguments of all profiles."""

from __future__ import annotations

from numbers import Integral, Real

import numpy as np

from ...errors import RequestError

MOST_PIXELS = 2**26
"""Largest profile: half a gigabyte of heights."""

LONGEST_PERIOD = 100.0
"""µm. Orders of visible light are then 0.3° apart, about the width of the sun, and any period in nm is above it."""


def check_pixels(columns: float, rows: float) -> None:
    """Refuses a patch before its memory is allocated."""
    if not columns * rows <= MOST_PIXELS:
        raise RequestError(f"got a patch of {columns:.4g} × {rows:.4g} pixels, wanted at most {MOST_PIXELS} in all")


def check_positive(name: str, value: float) -> None:
    if not (isinstance(value, Real) and np.isfinite(value) and value > 0):
        raise RequestError(f"{name}: got {value!r}, wanted a positive number in µm")


def check_period(name: str, value: float) -> None:
    check_positive(name, value)
    if value > LONGEST_PERIOD:
        raise RequestError(
            f"{name}: got {value!r} µm, wanted at most {LONGEST_PERIOD:g}; is it in nm ({value / 1e3:g} µm)? A grating "
            "that is really that coarse may be given as an array of heights"
        )


def check_profile(period: float, depth: float, samples: int = 2) -> None:
    check_period("period", period)
    if not (isinstance(depth, Real) and np.isfinite(depth) and depth >= 0):
        raise RequestError(f"depth: got {depth!r}, wanted a number in µm, zero or more")
    if not (isinstance(samples, Integral) and samples >= 2):
        raise RequestError(f"samples: got {samples!r}, wanted a whole number of at least 2")
    check_pixels(samples, 1)


def generator(seed: int) -> np.random.Generator:
    if not (isinstance(seed, Integral) and seed >= 0):
        raise RequestError(f"seed: got {seed!r}, wanted a whole number, zero or more")
    return np.random.default_rng(int(seed))
