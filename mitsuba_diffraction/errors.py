"""Whose mistake an exception is: the caller's, the circumstances', or this package's."""

from __future__ import annotations


class RequestError(ValueError):
    """An argument, a file or a scene is wrong; the text quotes what came and says what was wanted."""


class Bug(Exception):
    """A mistake of this package inside a plugin, of which Mitsuba keeps only the text: its class, then its message."""


def is_bug(kind: type[BaseException]) -> bool:
    """Whether an exception of this class is a mistake of the code: neither a wrong request nor a failure around it."""
    foreseen = RequestError, RuntimeError, OSError, MemoryError, ImportError
    return not issubclass(kind, foreseen) or issubclass(kind, NotImplementedError | RecursionError)
