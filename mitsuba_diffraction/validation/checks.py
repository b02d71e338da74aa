"""What a check is, and what it finds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike


@dataclass(frozen=True)
class Finding:
    """What a check expected and what it found.

    Attributes:
        expected, found: of the quantity that the check is about; of many, where they differ most.
        difference: what is held against the bound: |found − expected| unless the check's name says otherwise.
        bound: None where nothing is promised and the difference is only shown.
        note: what else a reader needs.
    """

    expected: float
    found: float
    difference: float
    bound: float | None
    note: str = ""

    @property
    def ok(self) -> bool:
        """Within the bound; a difference that is not a number is not."""
        return self.bound is None or bool(self.difference <= self.bound)

    @classmethod
    def worst(cls, expected: ArrayLike, found: ArrayLike, bound: float | None, note: str = "") -> Finding:
        """Of many numbers those that differ most."""
        expected, found = (np.ravel(x) for x in np.broadcast_arrays(expected, found))
        difference = np.abs(found - expected)
        place = int(np.argmax(np.where(np.isnan(difference), np.inf, difference)))
        return cls(float(expected[place]), float(found[place]), float(difference[place]), bound, note)


@dataclass(frozen=True)
class Check:
    """One line of the table, and one test.

    Attributes:
        group: "analytic", "literature", "statistical", "energy", "rigorous" or "surface".
        name: what is checked, in words.
        run: finds out, under the variant of Mitsuba in force.
        source: where the expected value comes from.
        slow: takes more than three seconds.
    """

    group: str
    name: str
    run: Callable[[], Finding]
    source: str
    slow: bool = False

    def result(self) -> dict[str, Any]:
        """The check, run: as JSON holds it."""
        finding = self.run()
        return {
            "group": self.group,
            "name": self.name,
            "expected": finding.expected,
            "found": finding.found,
            "difference": finding.difference,
            "bound": finding.bound,
            "ok": finding.ok,
            "note": finding.note,
            "source": self.source,
        }
