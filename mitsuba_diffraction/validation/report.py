"""The results of checks: a table on the terminal, JSON, Markdown."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from typing import Any

from rich.table import Table
from rich.text import Text

from .. import outputs

COLUMNS = ("check", "expected", "found", "difference", "bound", "")


def _number(value: float | None) -> str:
    return "—" if value is None else f"{value:.4g}"


def cells(result: dict[str, Any]) -> list[str]:
    """One line, as texts."""
    verdict = "shown" if result["bound"] is None else "ok" if result["ok"] else "MISSED"
    numbers = [_number(result[name]) for name in ("expected", "found")]
    small = [_number(result["difference"] and float(f"{result['difference']:.2g}"))]
    bound = None if result["bound"] is None else float(f"{result['bound']:.2g}")
    return [result["name"], *numbers, *small, _number(bound), verdict]


def table(results: Sequence[dict[str, Any]]) -> Table:
    """For a terminal."""
    found = Table(*COLUMNS, title=None)
    for column in found.columns[1:5]:
        column.justify = "right"
    group = None
    for result in results:
        if result["group"] != group:
            group = result["group"]
            found.add_section()
            found.add_row(Text(group, style="bold"))
        line = cells(result)
        style = {"ok": "green", "MISSED": "bold red"}.get(line[-1], "dim")
        found.add_row(*(Text(cell) for cell in line[:-1]), Text(line[-1], style=style))
    return found


def markdown(results: Sequence[dict[str, Any]]) -> str:
    """The same with notes and sources."""
    lines = ["| group | check | expected | found | difference | bound | | note | source |", "|---|" + "---|" * 8]
    for result in results:
        texts = [result["group"], *cells(result), result["note"], result["source"]]
        lines.append("| " + " | ".join(text.replace("|", "\\|") for text in texts) + " |")
    return "\n".join(lines) + "\n"


def save_markdown(results: Sequence[dict[str, Any]], path: str | os.PathLike[str]) -> None:
    outputs.save_markdown(markdown(results), path)


def save_json(results: Sequence[dict[str, Any]], path: str | os.PathLike[str]) -> None:
    """NaN and infinity, which JSON does not know, become null."""
    plain = [
        {name: None if isinstance(value, float) and not math.isfinite(value) else value for name, value in r.items()}
        for r in results
    ]
    outputs.save_json({"checks": plain}, path)
