"""A surface on the command line, SURFACE[,name=value…]: its source, and values by the names that recipes have."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from ..errors import RequestError, is_number
from ..surface.prepare import step_of

_LISTS = ("pixel_size", "unit", "wavelengths", "prepare")
"""Names that may be repeated, for a list."""
_MAX_PARTS = 200  # of which any successive ones may be the name of a file


def parsed(text: str) -> tuple[str, dict[str, Any]]:
    """Return the source as it is written, and values; numbers, booleans, steps and repeated names as in a recipe.

    The source is the longest beginning that is a file, as names of files may have commas; so is a value.

    Raises:
        RequestError: if a part is not name=value, or a name is repeated that has no list.
    """
    source, parts = _split_source(text)
    values = dict[str, Any]()
    for name, equals, value in (map(str.strip, item.partition("=")) for item in _items(parts)):
        if not (name and equals and value) or (name in values and name not in _LISTS):
            got = f"{text}: got {name + equals + value!r}"
            raise RequestError(f"{got}, wanted name=value, each name once{_advice(name, values)}")
        found = step_of(value) if name == "prepare" else converted(value)
        values[name] = [*values.get(name, []), found] if name in _LISTS else found
    single = {name: values[name][0] for name in _LISTS[:-1] if len(values.get(name, ())) == 1}
    return source, values | single


def _split_source(text: str) -> tuple[str, list[str]]:
    """Return the source as it is written, the longest beginning that is a file, and the parts after it."""
    parts = text.split(",")
    if len(parts) > _MAX_PARTS:
        raise RequestError(f"{text[:60]}…: got {len(parts)} parts between commas, wanted at most {_MAX_PARTS}")
    end = next((end for end in range(len(parts), 1, -1) if os.path.exists(",".join(parts[:end]))), 1)
    return ",".join(parts[:end]) if end > 1 else parts[0].strip(), parts[end:]


def _items(parts: list[str]) -> Iterator[str]:
    """Yield the parts; a value is continued by the following parts as long as it is the name of a file."""
    while parts:
        value = parts[0].partition("=")[2]
        count = next((n for n in range(len(parts), 1, -1) if os.path.isfile(",".join([value, *parts[1:n]]))), 1)
        yield ",".join(parts[:count])
        parts = parts[count:]


def _advice(part: str, values: dict[str, Any]) -> str:
    """Return what to do if a part is the end of a list or of a number with a decimal comma, or ""."""
    if not is_number(converted(part)):
        return ""
    last = next(reversed(values), "")
    if last in _LISTS:
        return f"; give a list as {last}={values[last][-1]},{last}={part}"
    return "; a number has a point, and a list of films stands in a scene"


def written(source: str, values: Mapping[str, Any]) -> str:
    """Return the text that `parsed` reads as this source and these values."""
    items = [
        f"{name}={_text(item)}"
        for name, value in values.items()
        for item in (value if isinstance(value, list | tuple) else [value])
    ]
    return ",".join([source, *items])


def _text(value: object) -> str:
    if isinstance(value, Mapping):  # a step of `prepare`
        ((name, argument),) = value.items()
        return f"{name}={argument}"
    return str(value).lower() if isinstance(value, bool) else str(value)


def converted(text: str) -> bool | int | float | str:
    """Return a number, true or false, the absolute path of a file that exists, or the text."""
    for kind in (int, float):
        with suppress(ValueError):
            return kind(text)
    return {"true": True, "false": False}.get(text.lower(), absolute(text))


def absolute(value: str) -> str:
    """Return a file name on the command line, relative to the current folder, as an absolute one; other text as it is.

    A bare word or number is not a file name, even if a file of that name exists.
    """
    is_file = os.path.isfile(value) and (os.path.dirname(value) or Path(value).suffix[1:2].isalpha())
    return str(Path(value).resolve()) if is_file else value
