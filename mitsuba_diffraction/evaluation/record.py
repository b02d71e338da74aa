"""Results of checks and measurements."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

GROUPS = ("analytic", "literature", "statistical", "energy", "rigorous", "surface", "scene")


@dataclass(frozen=True)
class Record:
    """A measured number and the expected one.

    Attributes:
        measured, expected: of several pairs, the pair with the maximum error relative to its bound.
        bound: on the error; None where none is claimed.
        relative: whether the error is relative to `expected`.
        note: further information for the reader.
        group: one of `GROUPS`.
        name: what was measured, in words.
        source: origin of `expected`.
    """

    measured: float
    expected: float
    bound: float | None
    relative: bool = False
    note: str = ""
    group: str = ""
    name: str = ""
    source: str = ""

    def __post_init__(self) -> None:
        for name in ("measured", "expected"):
            object.__setattr__(self, name, float(getattr(self, name)))
        if self.bound is not None:
            object.__setattr__(self, "bound", float(self.bound))

    @classmethod
    def at_max_error(
        cls,
        expected: ArrayLike,
        measured: ArrayLike,
        bound: ArrayLike,
        note: str = "",
        *,
        relative: bool = False,
    ) -> Record:
        """Return the record of the pair with the maximum error relative to its bound; NaN counts as the maximum."""
        expected, measured, bound = (np.ravel(x) for x in np.broadcast_arrays(expected, measured, bound))
        error = np.abs(measured - expected) / (np.abs(expected) if relative else 1) / bound
        index = int(np.argmax(np.where(np.isnan(error), np.inf, error)))
        return cls(measured[index], expected[index], bound[index], relative, note)

    @property
    def error(self) -> float:
        """|measured − expected|, over |expected| if relative."""
        error = abs(self.measured - self.expected)
        return error / abs(self.expected) if self.relative else error

    @property
    def ok(self) -> bool:
        """Whether the error is within the bound; NaN is not."""
        return self.bound is None or self.error <= self.bound


@dataclass(frozen=True)
class Check:
    """A function that returns a record: one row of the table, and one test.

    Attributes:
        group, name, source: see `Record`.
        measure: measures under the current variant of Mitsuba; its record lacks these three.
        slow: takes more than three seconds.
    """

    group: str
    name: str
    measure: Callable[[], Record]
    source: str
    slow: bool = False

    def run(self) -> Record:
        """Return the record of the check."""
        return dataclasses.replace(self.measure(), group=self.group, name=self.name, source=self.source)
