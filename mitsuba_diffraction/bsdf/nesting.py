"""Which BSDFs hold a grating: themselves, or nested at any depth."""

from __future__ import annotations

import mitsuba as mi


def is_grating(bsdf: mi.BSDF) -> bool:
    """Whether a BSDF is of the class behind `diffraction_grating`."""
    return hasattr(bsdf, "spectrum") and hasattr(bsdf, "along_pattern")


def contains_grating(bsdf: mi.BSDF) -> bool:
    """Whether a BSDF is a grating or one is nested in it."""
    return is_grating(bsdf) or any(map(contains_grating, nested(bsdf)))


def nested(bsdf: mi.BSDF) -> list[mi.BSDF]:
    """The BSDFs that a BSDF holds, such as the two sides of a `twosided`."""

    class Children(mi.TraversalCallback):
        def __init__(self) -> None:
            mi.TraversalCallback.__init__(self)
            self.found: list[mi.BSDF] = []

        def put(self, name: str, value: object, *rest: object) -> None:
            if isinstance(value, mi.BSDF):
                self.found.append(value)

    callback = Children()
    bsdf.traverse(callback)
    return callback.found
