"""Spectra handed over in the dictionary of a scene."""

from __future__ import annotations

import weakref
from typing import Any

handed_over: weakref.WeakValueDictionary[str, Any] = weakref.WeakValueDictionary()
"""Handle → spectrum, as long as the dictionary of the scene refers to it."""


def hand_over(value: object) -> object:
    """Return a scene dictionary in which each spectrum is replaced by a handle.

    mi.load_dict accepts only types bound in C++, therefore spectra are passed by name. Their classes, which need not be
    imported for this, are those that have a theory.
    """
    if hasattr(type(value), "theory"):
        handle = f"handed over: {id(value)}"
        handed_over[handle] = value
        return handle
    if isinstance(value, dict):
        return {key: hand_over(item) for key, item in value.items()}
    return value
