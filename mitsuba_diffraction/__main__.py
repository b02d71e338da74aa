"""Entry point of `mitsuba-diffraction`; handles Ctrl-C during imports as well."""

from __future__ import annotations

import os
import signal


def main() -> None:
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        # An exception raised while an extension module is being imported is converted, or crashes.
        signal.signal(signal.SIGINT, _stop)
    from .cli import main

    main()


def _stop(number: int, frame: object) -> None:
    os.write(2, b"mitsuba-diffraction: interrupted: nothing was written\n")
    os._exit(130)


if __name__ == "__main__":
    main()
