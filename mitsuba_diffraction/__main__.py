"""Entry point of the command `mitsuba-diffraction`: ends on Ctrl-C also while the package is imported."""

from __future__ import annotations

import os
import signal


def main() -> None:
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        # An exception inside an extension module that is being imported becomes another one, or a crash.
        signal.signal(signal.SIGINT, _stop)
    from .cli import main

    main()


def _stop(number: int, frame: object) -> None:
    os.write(2, b"mitsuba-diffraction: interrupted: nothing was written\n")
    os._exit(130)


if __name__ == "__main__":
    main()
