"""Arguments that several commands take."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path


def scene_parameters(define: Sequence[str] | None) -> dict[str, str]:
    """The scene's parameters from the -D NAME=VALUE of a command line.

    Raises:
        ValueError: if one is not of that form.
    """
    parameters = {}
    for item in define or []:
        name, equals, value = item.partition("=")
        if not (name and equals):
            raise ValueError(f"-D: got {item!r}, wanted NAME=VALUE")
        # A file named on the command line is relative to where the command is given. A bare word or number is no file,
        # whatever lies there under that name.
        named = os.path.isfile(value) and (os.path.dirname(value) or Path(value).suffix[1:2].isalpha())
        parameters[name] = str(Path(value).resolve()) if named else value
    return parameters
