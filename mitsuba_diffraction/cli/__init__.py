"""The commands, thin: they read arguments, call the package, and say what came of it. One file a command.

Exit codes: 0 done; 1 the work failed or was interrupted; 2 the request was wrong.
"""

from __future__ import annotations

import sys
import warnings
from importlib import metadata
from typing import Annotated

import typer

from .benchmark import benchmark
from .compare import compare
from .console import NAME, say, tell
from .inspect import inspect
from .precompute import precompute
from .render import render
from .validate import validate

# Click's, or that of the copy of Click which newer versions of Typer carry.
_UsageError = typer.BadParameter.__base__

app = typer.Typer(add_completion=False, no_args_is_help=False, help="Diffraction gratings for Mitsuba 3.")
for _command in (inspect, precompute, render, compare, validate, benchmark):
    app.command()(_command)


def _say_version(wanted: bool) -> None:
    if wanted:
        tell(f"{NAME} {metadata.version('mitsuba_diffraction')}, Mitsuba {metadata.version('mitsuba')}")
        raise typer.Exit


@app.callback()
def _commands(
    version: Annotated[bool, typer.Option("--version", callback=_say_version, is_eager=True)] = False,
) -> None:
    """Diffraction gratings for Mitsuba 3."""


def main() -> None:
    """Entry point of the command `mitsuba-diffraction`."""
    warnings.showwarning = lambda message, *args, **kwargs: say("warning", message)
    try:
        code = app(prog_name=NAME, standalone_mode=False) or 0
        if code == 130:  # newer versions of Typer turn Ctrl-C into this code
            raise KeyboardInterrupt
    except _UsageError as error:
        say("error", f"{error.format_message()} (try {NAME} --help)")
        code = 2
    except (ValueError, FileNotFoundError, IsADirectoryError, NotADirectoryError) as error:
        named = isinstance(error, OSError) and error.filename and error.strerror
        say("error", f"{error.filename}: {error.strerror.lower()}" if named else error)
        code = 2
    except (KeyboardInterrupt, typer.Abort):
        say("interrupted", "nothing was written")
        code = 1
    except (RuntimeError, OSError, MemoryError) as error:
        say("error", str(error) or type(error).__name__)
        code = 1
    sys.exit(code)
