"""The console: output streams, progress bar, messages."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

NAME = "mitsuba-diffraction"

out = Console(highlight=False, soft_wrap=True)
err = Console(stderr=True, highlight=False, soft_wrap=True)


class Stopped(Exception):
    """Ctrl-C after something has been saved; the text says what."""


def log_lines(label: str, seconds: float = 30.0) -> Callable[[int, int], None]:
    """Progress without a terminal: a line on stderr at this interval, none for short tasks."""
    start = last = time.monotonic()

    def show(done: int, total: int) -> None:
        nonlocal last
        if (now := time.monotonic()) - last >= seconds:
            last = now
            say(label, f"{done} of {total}, {now - start:.0f} s")

    return show


@contextmanager
def progress_bar(label: str) -> Iterator[Callable[[int, int], None]]:
    if not err.is_terminal:
        yield log_lines(label)
        return
    columns = (TextColumn("{task.description}", markup=False), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, TimeRemainingColumn(), console=err, transient=True) as bars:
        task = bars.add_task(label, total=None)
        yield lambda done, total: bars.update(task, completed=done, total=total)


def tell(text: str) -> None:
    # File names are not markup.
    out.print(text, markup=False, emoji=False)


def say(kind: str, message: object) -> None:
    err.print(f"{NAME}: {kind}: {' '.join(str(message).split())}", markup=False, emoji=False)
