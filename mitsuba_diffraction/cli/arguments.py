"""Arguments that several commands take."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path


def scene_parameters(define: Sequence[str] | None) -> dict[str, str]:
    """The scene's parameters from the -D NAME=VALUE of a command line.

    Raises:
        ValueError: if one is not of that form, or given twice.
    """
    parameters = {}
    for item in define or []:
        name, equals, value = item.partition("=")
        if not (name and equals):
            raise ValueError(f"-D: got {item!r}, wanted NAME=VALUE")
        if name in parameters:
            raise ValueError(f"-D {name}: got it twice, wanted one value")
        # A file named on the command line is relative to where the command is given.
        parameters[name] = str(Path(value).resolve()) if os.path.isfile(value) else value
    return parameters
