"""The parameters of a plugin, from which its docstring is made and against which docs/plugin.md is tested."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable
from dataclasses import dataclass


@dataclass(frozen=True)
class Parameter:
    """One parameter, or several that share a row: their names, type and meaning, and the default where there is one."""

    name: str
    type: str
    meaning: str
    default: str = ""


def listed(parameters: Iterable[Parameter]) -> str:
    """A paragraph of a docstring for each."""
    lines = []
    for p in parameters:
        text = f"{p.name} ({p.type}): {p.meaning}{f' ({p.default})' if p.default else ''}."
        lines += textwrap.wrap(text, 116, initial_indent=" " * 4, subsequent_indent=" " * 8)
    return "\n".join(lines)
