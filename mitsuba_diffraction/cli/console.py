"""The console: output streams, tables, messages."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence

from rich.console import Console, RenderableType
from rich.table import Table

from ..progress import NAME, progress_bar, say

__all__ = ["NAME", "Log", "Stopped", "out", "progress_bar", "say", "show", "table", "tell"]

out = Console(highlight=False, soft_wrap=True)


class Stopped(Exception):
    """Ctrl-C after something has been saved; the text says what."""


def tell(text: str) -> None:
    # File names are not markup.
    out.print(text, markup=False, emoji=False)


def show(*tables: RenderableType, width: int) -> None:
    """Print tables with a line between them, on `width` characters or more, so that no column is ever cut."""
    console = Console(highlight=False, width=max(out.width, width))
    for index, table in enumerate(tables):
        if index:
            console.print()
        console.print(table)


class Log(logging.Handler):
    """Shows what the package logs as the command's own messages."""

    def emit(self, record: logging.LogRecord) -> None:
        say(record.levelname.lower(), record.getMessage())


def table(columns: Iterable[str], rows: Iterable[Sequence[str]], texts: int = 1) -> Table:
    """Return a table for a terminal; the first `texts` columns hold texts, the others numbers."""
    shown = Table(box=None, pad_edge=False)
    for index, column in enumerate(columns):
        shown.add_column(column, justify="left" if index < texts else "right", no_wrap=True)
    for row in rows:
        shown.add_row(*row)
    return shown
