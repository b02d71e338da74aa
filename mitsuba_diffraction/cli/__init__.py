"""Command line: one file per command, which parses arguments, calls the package and prints the result.

Exit codes: 0 done; 1 the work failed; 2 the request was wrong; 130 interrupted.
"""

from __future__ import annotations

import _thread
import importlib
import logging
import signal
import sys
import threading
import traceback
import warnings
from importlib import metadata
from types import FrameType
from typing import Annotated, Any

import typer
from typer.core import TyperCommand

from ..errors import Bug, RequestError, is_bug
from ..progress import NAME, adapt_streams, say, tell
from .design import design
from .efficiency import efficiency
from .examples import examples
from .export import export
from .hologram import hologram
from .inspect import inspect
from .precompute import precompute
from .render import Stopped, render
from .view import view

# Click's class, or the class of the copy of Click which newer versions of Typer carry.
_UsageError: Any = typer.BadParameter.__base__


class _Command(TyperCommand):
    """Command that refuses an option given twice, unless it takes a list of values."""

    def parse_args(self, context: Any, arguments: list[str]) -> list[str]:
        _, _, order = self.make_parser(context).parse_args(list(arguments))
        for parameter in order:
            if order.count(parameter) > 1 and not parameter.multiple and parameter.param_type_name == "option":
                raise RequestError(f"{parameter.opts[-1]}: got it twice, wanted one value")
        return super().parse_args(context, arguments)


app = typer.Typer()
# Imported by name, as no module of the product may depend on what judges it.
_JUDGES = {"shader_2014.command_line": ("compare",), "evaluation.commands": ("convergence", "validate", "benchmark")}
_judging = (
    getattr(importlib.import_module(f"..{folder}.{n}", __name__), n) for folder, names in _JUDGES.items() for n in names
)
# In the order of use.
_commands_of_product = (examples, render, view, inspect, design, hologram, export, precompute, efficiency)
for _command in (*_commands_of_product, *_judging):
    app.command(cls=_Command)(_command)


def _print_version(requested: bool) -> None:
    if requested:
        tell(f"{NAME} {metadata.version('mitsuba_diffraction')}, Mitsuba {metadata.version('mitsuba')}")
        raise typer.Exit


@app.callback(invoke_without_command=True)
def _commands(
    context: typer.Context,
    version: Annotated[bool, typer.Option("--version", callback=_print_version, is_eager=True)] = False,
    debug: Annotated[bool, typer.Option("--debug", help="print the traceback of an error")] = False,
) -> None:
    """Diffraction gratings for Mitsuba 3.

    A first picture: mitsuba-diffraction examples && mitsuba-diffraction render scenes/xenopeltis.xml
    """
    context.obj["debug"] = debug
    if context.invoked_subcommand is None:
        tell(context.get_help())


class _CtrlC:
    """Handler of SIGINT and SIGTERM that raises KeyboardInterrupt and records it; during an import, after its end.

    The record is needed as Mitsuba converts exceptions raised in a plugin into errors of the scene. While an extension
    module is being imported, as Mitsuba, an exception is converted or aborts the process.
    """

    pressed = False
    _again: threading.Timer | None = None

    def __call__(self, number: int, frame: FrameType | None) -> None:
        self.pressed = True
        if self._again is not None:  # Ctrl-C was pressed twice
            self._again.cancel()
        while frame is not None:
            if frame.f_code.co_filename.startswith("<frozen importlib"):
                self._again = threading.Timer(0.05, _thread.interrupt_main, [number])
                self._again.start()
                return
            frame = frame.f_back
        raise KeyboardInterrupt


class _Log(logging.Handler):
    """Log handler that prints records of the package as messages of the command."""

    def emit(self, record: logging.LogRecord) -> None:
        say(record.levelname.lower(), record.getMessage())


def main() -> None:
    """Run `mitsuba-diffraction`: parse the arguments, run the command, report errors and exit."""
    adapt_streams()
    warnings.showwarning = lambda message, *args, **kwargs: say("warning", message)
    log, logger = _Log(), logging.getLogger(__package__.partition(".")[0])
    logger.addHandler(log)
    options: dict[str, bool] = {}
    ctrl_c = _CtrlC()
    # Schedulers and systems that shut down end a process by SIGTERM.
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    # If SIGINT is ignored, as in background jobs of a script, it stays ignored.
    before = {number: handler for number, handler in before.items() if handler not in (signal.SIG_IGN, None)}
    for number in before:
        signal.signal(number, ctrl_c)
    try:
        code = app(prog_name=NAME, standalone_mode=False, obj=options) or 0
        if code == 130:  # newer versions of Typer return this code on Ctrl-C
            raise KeyboardInterrupt
    except (Exception, KeyboardInterrupt) as error:
        converted = ctrl_c.pressed and not isinstance(error, Stopped)
        code = _report(KeyboardInterrupt() if converted else error, **options)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        logger.removeHandler(log)
    sys.exit(code)


def _report(error: BaseException, debug: bool = False) -> int:
    """Report an error on one line, after the traceback if `debug`; return the exit code."""
    if isinstance(error, Stopped | KeyboardInterrupt | typer.Abort):
        say("interrupted", error if isinstance(error, Stopped) else "nothing was written")
        return 130
    if isinstance(error, _UsageError):
        command = error.ctx.command_path if error.ctx else NAME
        say("error", f"{error.format_message()} (try {command} --help)")
        return 2
    if debug:
        traceback.print_exception(error)
    while error.__cause__ is not None and "(see above)" in str(error):  # Dr.Jit's message does not name the cause
        error = error.__cause__
    text = str(error)
    if isinstance(error, OSError) and error.filename and error.strerror:
        text = f"{error.filename}: {error.strerror.lower()}"
    if isinstance(error, RequestError | FileNotFoundError | IsADirectoryError | NotADirectoryError):
        say("error", text)
        return 2
    if is_bug(type(error)):
        text = str(error) if isinstance(error, Bug) else f"{type(error).__name__}: {error}"
        say("error", f"this is a bug in mitsuba_diffraction ({text}); {NAME} --debug … shows where")
    else:
        say("error", text or type(error).__name__)
    return 1
