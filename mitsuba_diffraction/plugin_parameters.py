"""Parameters of a plugin, from which its docstring and docs/plugin.md are made, and spectra handed over as such."""

from __future__ import annotations

import re
import textwrap
import weakref
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

handed_over: weakref.WeakValueDictionary[str, Any] = weakref.WeakValueDictionary()
"""Handle → spectrum, as long as the dictionary of the scene refers to it."""


@dataclass(frozen=True)
class Parameter:
    """One parameter, or several that share a row: their names, type and meaning, and the default where there is one.

    The meaning is Markdown of one line, with links as from a page in docs/.
    """

    name: str
    type: str
    meaning: str
    default: str = ""


def listed(parameters: Iterable[Parameter]) -> str:
    """Format the parameters as paragraphs of a docstring."""
    lines = []
    for p in parameters:
        meaning = re.sub(r"\[([^]]*)\]\([^)]*\)", r"\1", p.meaning)  # links of the manual
        text = f"{p.name} ({p.type}): {meaning}{f' ({p.default})' if p.default else ''}."
        lines += textwrap.wrap(text, 116, initial_indent=" " * 4, subsequent_indent=" " * 8)
    return "\n".join(lines)


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
