"""Printing, and progress: a bar in a terminal, a line in a notebook, occasional lines in a log."""

from __future__ import annotations

import codecs
import io
import math
import re
import sys
import threading
import time
import unicodedata
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager

from rich.console import Console, RenderableType
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    ProgressColumn,
    Task,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.progress import Progress as Bars
from rich.table import Table
from rich.text import Text

NAME = "mitsuba-diffraction"

Progress = Callable[[int, int], None]  # called with the part done and the total

out = Console(highlight=False, soft_wrap=True)
err = Console(stderr=True, highlight=False, soft_wrap=True)

MIN_REPORTED_SECONDS = 2.0  # of work before a log or a notebook shows progress
_MIN_REPORTED_DURATION = 10.0  # s, of a command
MIN_ANNOUNCED_SECONDS = 15.0  # that remain, for a line to say how many
_UNITS_OF_BYTES = ("GB", 1e9), ("MB", 1e6), ("kB", 1e3)
_IN_ASCII = {"−": "-", "–": "-", "→": "->", "≤": "<=", "≥": ">=", "±": "+-", "×": "x", "·": "*"}
_IN_ASCII |= {"µ": "u", "°": " deg", "²": "^2", "…": "...", "∫": "integral of "}
_IN_ASCII |= {"λ": "lambda"}  # Unicode names it a lamda
_CONTROL = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f]")  # all but tabs and ends of lines
_MAX_MESSAGE = 4000  # characters
_lock = threading.Lock()
_stages: list[str] = []  # nested blocks of code, the innermost last
_durations: dict[str, float] = {}  # s, by the name of a stage
_since = 0.0  # time at which the innermost stage began or went on
_bars: list[Bars] = []  # the display common to all bars, as rich shows one at a time


def silent(done: int, total: int) -> None:
    """Show no progress."""


@contextmanager
def no_progress(label: str) -> Iterator[Progress]:
    """Yield a function that shows no progress, instead of `progress_bar`."""
    yield silent


def part(whole: Progress, begin: float, end: float) -> Progress:
    """Return a function that reports progress of a part of the whole, from `begin` to `end` in per cent."""
    return lambda done, total: whole(round(100 * (begin + (end - begin) * done / total)), 100)


def _switch(change: Callable[[], None]) -> None:
    """Count the time since the last call for the innermost stage; then `change` the stages."""
    global _since
    with _lock:
        now = time.perf_counter()
        if _stages:
            _durations[_stages[-1]] = _durations.get(_stages[-1], 0.0) + now - _since
        _since = now
        change()


@contextmanager
def stage(name: str) -> Iterator[None]:
    """Name what a block of code does, for `durations` and the bars.

    The time of an inner stage does not count for the outer one. Stages of several threads count as nested.
    """
    _switch(lambda: _stages.append(name))
    try:
        yield
    finally:
        _switch(lambda: _stages.remove(name))


@contextmanager
def durations() -> Iterator[None]:
    """Print at the end of a command that took more than ten seconds how long its stages took."""
    _durations.clear()
    start = time.perf_counter()
    yield
    if (total := time.perf_counter() - start) > _MIN_REPORTED_DURATION:
        parts = {**_durations, "other": total - sum(_durations.values())}
        text = ", ".join(f"{name} {seconds:.1f}" for name, seconds in parts.items() if seconds >= 0.05)
        tell(f"took {total:.1f} s: {text}")


def _after(unit: str, depth: int) -> str:
    """Return the unit and the stage, if one began inside the `depth` stages around a bar."""
    doing = _stages[depth:]
    return ", ".join([*([unit] if unit else []), *doing[-1:]])


def adapt_streams() -> None:
    """Print in words or escapes what the encoding of stdout and stderr lacks, as that of a pipe on Windows."""
    codecs.register_error("in_words", _in_words)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="in_words")


def _in_words(error: UnicodeError) -> tuple[str | bytes, int]:
    """Return lambda for λ, ^6 for ⁶, - for −, and so on; an escape for other characters, such as in file names."""
    assert isinstance(error, UnicodeEncodeError)
    character = error.object[error.start]
    if unicodedata.name(character, "").startswith("SUPERSCRIPT"):
        text = "^" + unicodedata.normalize("NFKC", character).replace("−", "-")
    elif (text := _IN_ASCII.get(character, "")) == "":
        kind, _, letter = unicodedata.name(character, "").partition(" LETTER ")
        if kind not in ("GREEK SMALL", "GREEK CAPITAL") or " " in letter:
            return codecs.backslashreplace_errors(error)
        text = letter.lower() if kind == "GREEK SMALL" else letter.capitalize()
    return text, error.start + 1


def printable(text: str) -> str:
    """Return a text with escapes in the place of control characters, by which a file could command the terminal."""
    return _CONTROL.sub(lambda found: f"\\x{ord(found[0]):02x}", text)


def say(kind: str, message: object) -> None:
    """Print a message on stderr, in one line."""
    text = " ".join(str(message).split())
    if len(text) > _MAX_MESSAGE:
        text = f"{text[:_MAX_MESSAGE]} … ({len(text)} characters)"
    err.print(printable(f"{NAME}: {kind}: {text}"), markup=False, emoji=False)


def tell(text: str) -> None:
    """Print the result of a command."""
    # File names are not markup.
    out.print(printable(text), markup=False, emoji=False)


def show(*tables: RenderableType, width: int) -> None:
    """Print tables with a line between them, on `width` characters or more, so that no column is ever cut."""
    console = Console(highlight=False, width=max(out.width, width))
    for index, table in enumerate(tables):
        if index:
            console.print()
        console.print(table)


def cells(columns: Mapping[str, str], row: object) -> list[str]:
    """Format a row as texts; `columns` are titles and format strings such as "{.error:.1e}"."""
    return [text.format(row) for text in columns.values()]


def table(columns: Iterable[str], rows: Iterable[Sequence[str]], texts: int = 1) -> Table:
    """Return a table for a terminal; the first `texts` columns hold texts, the others numbers."""
    shown = Table(box=None, pad_edge=False)
    for index, column in enumerate(columns):
        shown.add_column(column, justify="left" if index < texts else "right", no_wrap=True)
    for row in rows:
        shown.add_row(*(Text(printable(cell)) for cell in row))
    return shown


def bytes_text(count: float) -> str:
    """Format a number of bytes, such as 100 MB."""
    unit, scale = next(((unit, scale) for unit, scale in _UNITS_OF_BYTES if count >= scale), _UNITS_OF_BYTES[-1])
    return f"{count / scale:.{0 if count >= 10 * scale else 1}f} {unit}"


def takes_long(seconds: float) -> bool:
    """Return whether a message says how long work takes that takes so long."""
    return seconds >= MIN_ANNOUNCED_SECONDS


def time_text(seconds: float) -> str:
    """Format a time that is known roughly, such as 40 s, 3 min or 2.5 h."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


def _count(done: float, total: int, unit: str) -> str:
    """Format the part done."""
    return f"{done} {unit}" if unit.startswith("%") else f"{done:.10g} of {total} {unit}".rstrip()


def _time_left() -> Callable[[float, float], str]:
    """Return a function of the part done and the total that says how long the rest takes; "" while it is not known.

    The rate is that since the first part: work that is resumed does not begin at zero, and kernels are compiled once.
    """
    first: tuple[float, float] | None = None

    def text(done: float, total: float) -> str:
        nonlocal first
        now = time.monotonic()
        first = first or ((now, done) if done else None)
        begin, before = first or (now, done)
        if now - begin < MIN_REPORTED_SECONDS or not before < done < total:
            return ""
        left = (now - begin) / (done - before) * (total - done)
        return f", about {time_text(left)} left" if takes_long(left) else ""

    return text


def log_lines(
    label: str, unit: str = "", begin: str = "", seconds: float = 30.0, first: float = MIN_REPORTED_SECONDS
) -> Callable[..., None]:
    """Report progress without a terminal: the message `begin`, a line after `first` seconds, then every `seconds`.

    One more as soon as it is known how long the rest takes.
    """
    if begin:
        say(label, begin)
    start, depth, left = time.monotonic(), len(_stages), _time_left()
    due, estimated = start + first, False

    def show(done: int, total: int, error: float = math.nan) -> None:
        nonlocal due, estimated
        now, rest = time.monotonic(), left(done, total)
        if now >= due or (rest and not estimated):
            due, estimated = now + seconds, estimated or rest != ""
            say(label, f"{_count(done, total, _after(unit, depth))}, {now - start:.0f} s{rest}")

    return show


def _say_stage(label: str, depth: int, counted: threading.Event) -> None:
    """Say in a log what is being done, unless something has been counted."""
    if not counted.is_set():
        say(label, _after("", depth) or "computing")


class _Doing(ProgressColumn):
    """Column of a bar that shows what is being done, also while nothing is counted."""

    def render(self, task: Task) -> Text:
        return Text(task.fields["doing"](task))


@contextmanager
def progress_bar(label: str, unit: str = "", begin: str = "") -> Iterator[Callable[..., None]]:
    """Yield a function that shows progress: it takes the part done, the total, and the relative error if there is one.

    Bars may be opened inside of others, and on other threads: a terminal then shows one below the other.

    Args:
        label: name of the computation.
        unit: of the count.
        begin: message until something can be counted.
    """
    if err.is_jupyter:
        with _notebook_line(label, unit) as shown:
            yield shown
        return
    if not err.is_terminal:
        show_line, counted = log_lines(label, unit, begin), threading.Event()

        def show_in_log(*numbers: float) -> None:
            counted.set()
            show_line(*numbers)

        waiting = threading.Timer(MIN_REPORTED_SECONDS, _say_stage, (label, len(_stages), counted))
        waiting.daemon = True
        if not begin:
            waiting.start()
        try:
            yield show_in_log
        finally:
            waiting.cancel()
        return
    with _lock:
        if outermost := not _bars:
            columns = (
                TextColumn("{task.description}", markup=False),
                BarColumn(),
                MofNCompleteColumn(),
                _Doing(),
                TimeElapsedColumn(),
                TimeRemainingColumn(),
            )
            # Passes of a large picture take longer than the default period of half a minute.
            _bars.append(Bars(*columns, console=err, transient=True, speed_estimate_period=600))
            _bars[0].start()
        bars = _bars[0]
    depth = len(_stages)

    def doing(task: Task) -> str:
        error = task.fields["error"]
        after = _after("" if task.total is None else unit, depth) + (
            "" if math.isnan(error) else f", error {error:.2g}"
        )
        return after if task.completed or not begin else ", ".join([begin, *_stages[depth:][-1:]])

    task = bars.add_task(label, total=None, doing=doing, error=math.nan)

    def show(done: int, total: int, error: float = math.nan) -> None:
        bars.update(task, completed=done, total=total, error=error)

    try:
        yield show
    finally:
        bars.remove_task(task)
        if outermost:
            with _lock:
                _bars.clear()
            bars.stop()


@contextmanager
def _notebook_line(label: str, unit: str) -> Iterator[Callable[..., None]]:
    """Display a line in the cell's output that shows progress and, at the end, the time."""
    from IPython.display import display

    start, depth, left, handle = time.monotonic(), len(_stages), _time_left(), None

    def show(done: int, total: int, error: float = math.nan) -> None:
        nonlocal handle
        seconds = time.monotonic() - start
        shown = f"{_count(done, total, _after(unit, depth))}, {seconds:.0f} s{left(done, total)}"
        line = {"text/plain": f"{label}: {shown}"}
        if handle is not None:
            handle.update(line, raw=True)
        elif seconds >= MIN_REPORTED_SECONDS:
            handle = display(line, raw=True, display_id=True)

    yield show
    if handle is not None:
        handle.update({"text/plain": f"{label}: {time.monotonic() - start:.0f} s"}, raw=True)
