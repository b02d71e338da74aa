"""The console: output streams, tables, messages."""

from __future__ import annotations

import logging

from rich.console import Console, RenderableType

from ..progress import NAME, progress_bar, say

__all__ = ["NAME", "Log", "Stopped", "out", "progress_bar", "say", "show", "tell"]

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
