"""Parameters of a plugin: its docstring is made from them, and docs/plugin.md is tested against them."""

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
    """Format the parameters as paragraphs of a docstring."""
    lines = []
    for p in parameters:
        text = f"{p.name} ({p.type}): {p.meaning}{f' ({p.default})' if p.default else ''}."
        lines += textwrap.wrap(text, 116, initial_indent=" " * 4, subsequent_indent=" " * 8)
    return "\n".join(lines)
