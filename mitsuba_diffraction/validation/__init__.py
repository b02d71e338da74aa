"""Checks of the product against what is known: one list, run by `mitsuba-diffraction validate` and by the tests."""

from __future__ import annotations

from .checks import Check, Finding

_GROUPS = ("analytic", "literature", "statistical", "energy", "rigorous")


def checks() -> tuple[Check, ...]:
    """All of them, group by group."""
    from . import analytic, bumps, conservation, periods, rigorous, rough_surface

    modules = (analytic, bumps, periods, rough_surface, conservation, rigorous)
    every = [check for module in modules for check in module.CHECKS]
    return tuple(sorted(every, key=lambda check: _GROUPS.index(check.group)))


__all__ = ["Check", "Finding", "checks"]
