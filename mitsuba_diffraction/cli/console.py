"""What all commands share: the two streams, the progress bar, and how a line is said."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

NAME = "mitsuba-diffraction"

out = Console(highlight=False, soft_wrap=True)
err = Console(stderr=True, highlight=False, soft_wrap=True)


class Stopped(Exception):
    """Ctrl-C where something is kept; the text says what."""


@contextmanager
def progress_bar(label: str) -> Iterator[Callable[[int, int], None]]:
    columns = (TextColumn("{task.description}", markup=False), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, TimeRemainingColumn(), console=err, transient=True, disable=not err.is_terminal) as bars:
        task = bars.add_task(label, total=None)
        yield lambda done, total: bars.update(task, completed=done, total=total)


def tell(text: str) -> None:
    # File names are no markup.
    out.print(text, markup=False, emoji=False)


def say(kind: str, message: object) -> None:
    err.print(f"{NAME}: {kind}: {' '.join(str(message).split())}", markup=False, emoji=False)
