"""Exceptions: mistakes of the caller, failures of the environment, bugs of this package; what their messages quote."""

from __future__ import annotations

import builtins
import os
import re
import shlex
import sys
from collections.abc import Iterable
from difflib import get_close_matches
from numbers import Integral, Real
from typing import Any

# Mitsuba reports an exception of a Python plugin as text: the location of the plugin in the scene, indented lines of
# the traceback, then the class of the exception and its message.
_OF_PLUGIN = re.compile(
    r'(?:At (?P<location>.+): failed to instantiate .+ plugin of type "(?P<plugin>\w+)": )?'
    r"Traceback \(most recent call last\):\n(?:\s+.*\n)*(?:\w+\.)*(?P<kind>\w+)(?:: )?"
)


class RequestError(ValueError):
    """An argument, a file or a scene is wrong; the message quotes the value given and what was wanted."""


class Bug(Exception):
    """A bug of this package inside a plugin. Mitsuba keeps only its text: its class, then its message."""


def is_bug(kind: type[BaseException]) -> bool:
    """Return whether exceptions of this class are bugs: neither a wrong request nor a failure of the environment."""
    expected = RequestError, RuntimeError, OSError, MemoryError, ImportError
    return not issubclass(kind, expected) or issubclass(kind, NotImplementedError | RecursionError)


def is_number(value: object) -> bool:
    """Return whether a parameter is a number that a float can hold.

    Booleans, infinity and NaN do not count as numbers.
    """
    if not isinstance(value, Real) or isinstance(value, bool):
        return False
    size: Any = abs(value)  # numbers of any kind can be compared
    return bool(size <= sys.float_info.max)


def check_whole(name: str, value: Any, minimum: int, maximum: int | None = None) -> None:
    """Raise RequestError unless a parameter is a whole number in a range."""
    whole = isinstance(value, Integral) and not isinstance(value, bool)
    if not (whole and value >= minimum and (maximum is None or value <= maximum)):
        wanted = f"of at least {minimum}" if maximum is None else f"from {minimum} to {maximum}"
        raise RequestError(f"{name}: got {value!r}, wanted a whole number {wanted}")


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Return the known name most similar to a wrong one, as the end of a message, or "" if none is similar."""
    similar = get_close_matches(name.lower(), known, n=1)
    return f"; did you mean {similar[0]}?" if similar else ""


def shell_command(*words: str) -> str:
    """Return a command that a message proposes, quoted for the shell of the system.

    On Windows, for cmd, which takes ' as a character, as well as for PowerShell, to which a comma ends a word.
    """
    if os.name != "nt":
        return shlex.join(words)
    return " ".join(word if re.fullmatch(r"[\w.:=/\\\[\]+-]+", word) else f'"{word}"' for word in words)


def operand(name: str) -> str:
    """Return the name of a file as a word that no command takes for an option."""
    return f"./{name}" if name.startswith("-") else name


def pip_install(extra: str) -> str:
    """Return the command that installs an extra of this package."""
    return shell_command("pip", "install", f"mitsuba_diffraction[{extra}]")


def root_cause(error: BaseException) -> str:
    """Return the message of the innermost exception in Mitsuba's chain, as one line.

    Mitsuba raises "Error while ..." with the actual error as `__cause__`; its messages span several lines and begin
    with the location in its C++ sources.

    Raises:
        KeyboardInterrupt: if that is the cause.
        Bug: if the cause is a mistake of the code.
    """
    while error.__cause__ is not None:
        error = error.__cause__
    if isinstance(error, KeyboardInterrupt):
        raise error
    kind: Any = type(error)
    text = re.sub(r"\[\w+\.(cpp|h):\d+\] ?", "", str(error))
    if (match := _OF_PLUGIN.search(text)) is not None:
        kind = {"RequestError": RequestError}.get(match["kind"]) or getattr(builtins, match["kind"], Exception)
        location = f"{match['plugin']} at {match['location']}: " if match["plugin"] else ""
        text = text[: match.start()] + location + text[match.end() :]
    if kind is KeyboardInterrupt:
        raise KeyboardInterrupt from error
    text = " ".join(text.split()) or kind.__name__
    if is_bug(kind):
        raise Bug(f"{kind.__name__}: {text}") from error
    return text
