"""Tables for the terminal, Markdown and JSON of records and of other rows of numbers."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence

from rich.table import Table
from rich.text import Text

from ..files.outputs import MARK
from ..files.writing import whole_file
from .record import Record

RECORD_COLUMNS = ("check", "expected", "found", "difference", "bound", "")


def markdown(columns: Sequence[str], rows: Iterable[Sequence[str]], texts: int = 1) -> str:
    """Format a table in Markdown."""
    ruler = ["---" if index < texts else "---:" for index in range(len(columns))]
    lines = ([cell.replace("|", "\\|") for cell in line] for line in (columns, ruler, *rows))
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def save_markdown(text: str, path: str | os.PathLike[str]) -> None:
    """Write a Markdown file atomically."""
    with whole_file(path) as temporary:
        temporary.write_text(f"{text}\n<!-- {MARK} -->\n", encoding="utf-8")


def record_cells(record: Record) -> list[str]:
    """Format a record as the texts of `RECORD_COLUMNS`."""
    numbers = [f"{value:.4g}" for value in (record.expected, record.measured)]
    small = ["—" if value is None else f"{float(f'{value:.2g}'):.4g}" for value in (record.error, record.bound)]
    verdict = "shown" if record.bound is None else "ok" if record.ok else "MISSED"
    return [record.name, *numbers, *small, verdict]


def record_table(records: Sequence[Record]) -> Table:
    """Format records for a terminal, group by group."""
    result = Table(*RECORD_COLUMNS)
    for column in result.columns[1:5]:
        column.justify = "right"
    group = None
    for record in records:
        if record.group != group:
            group = record.group
            result.add_section()
            result.add_row(Text(group, style="bold"))
        *line, verdict = record_cells(record)
        style = {"ok": "green", "MISSED": "bold red"}.get(verdict, "dim")
        result.add_row(*map(Text, line), Text(verdict, style=style))
    return result


def record_markdown(records: Iterable[Record]) -> str:
    """Format records, with notes and sources, in Markdown."""
    rows = [[record.group, *record_cells(record), record.note, record.source] for record in records]
    return markdown(("group", *RECORD_COLUMNS, "note", "source"), rows, texts=9)


def record_dicts(records: Iterable[Record]) -> list[dict[str, object]]:
    """Return records as dictionaries for JSON."""
    return [
        {
            "group": record.group,
            "name": record.name,
            "expected": record.expected,
            "found": record.measured,
            "difference": record.error,
            "relative": record.relative,
            "bound": record.bound,
            "ok": record.ok,
            "note": record.note,
            "source": record.source,
        }
        for record in records
    ]
