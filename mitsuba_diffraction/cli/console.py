"""The console: output streams, progress bar, messages."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console, RenderableType
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

NAME = "mitsuba-diffraction"

out = Console(highlight=False, soft_wrap=True)
err = Console(stderr=True, highlight=False, soft_wrap=True)


class Stopped(Exception):
    """Ctrl-C after something has been saved; the text says what."""


def log_lines(label: str, seconds: float = 30.0) -> Callable[..., None]:
    """Progress without a terminal: a line on stderr at this interval, none for short tasks."""
    start = last = time.monotonic()

    def show(done: int, total: int, error: float = math.nan) -> None:
        nonlocal last
        if (now := time.monotonic()) - last >= seconds:
            last = now
            say(label, f"{done} of {total}, {now - start:.0f} s")

    return show


@contextmanager
def progress_bar(label: str, unit: str = "") -> Iterator[Callable[..., None]]:
    """What shows how much is done: called with that, the total, and the relative error so far where there is one."""
    if not err.is_terminal:
        yield log_lines(label)
        return
    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[after]}"),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    # Passes of a large picture take longer than the usual half minute.
    with Progress(*columns, console=err, transient=True, speed_estimate_period=600) as bars:
        task = bars.add_task(label, total=None, after=unit)

        def show(done: int, total: int, error: float = math.nan) -> None:
            after = unit if math.isnan(error) else f"{unit}, error {error:.2g}"
            bars.update(task, completed=done, total=total, after=after)

        yield show


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


def say(kind: str, message: object) -> None:
    err.print(f"{NAME}: {kind}: {' '.join(str(message).split())}", markup=False, emoji=False)


class Log(logging.Handler):
    """Shows what the package logs as the command's own messages."""

    def emit(self, record: logging.LogRecord) -> None:
        say(record.levelname.lower(), record.getMessage())
