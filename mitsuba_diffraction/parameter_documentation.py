"""Parameters of a plugin, from which its docstring and its page of the manual are made."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterable
from dataclasses import dataclass


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
