"""``truearm`` and ``python -m truearm``: interrupts are handled before anything else is imported."""

from __future__ import annotations

import _thread
import os
import signal
import sys
import time
from types import FrameType

INTERRUPTED = 130  # ExitCode.INTERRUPTED, before anything can be imported
SOON_S = 0.01


_struck: list[int] = []  # interrupts so far


def _interrupt(number: int, frame: FrameType | None) -> None:
    _struck.append(number)
    signal.default_int_handler(number, frame)


def keep_interrupts() -> None:
    """Count interrupts, and raise Ctrl-C again if it strikes in a callback whose exceptions Python ignores.

    Python calls one after each import, when it forgets the module's lock.
    """
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # else a shell started the process without it
        signal.signal(signal.SIGINT, _interrupt)

    def again() -> None:
        time.sleep(SOON_S)  # until the callback has ended
        _thread.interrupt_main()

    def hook(ignored: sys.UnraisableHookArgs) -> None:
        if issubclass(ignored.exc_type, KeyboardInterrupt):
            _thread.start_new_thread(again, ())
        else:
            sys.__unraisablehook__(ignored)

    sys.unraisablehook = hook


def run() -> None:
    """Run the command line and end the process with its exit code."""
    keep_interrupts()
    try:
        from truearm.cli.main import main

        sys.exit(main())
    except KeyboardInterrupt:  # while modules are being imported
        os._exit(INTERRUPTED)
    except ImportError:
        if _struck:  # while a compiled module was imported, which may say only that it failed
            os._exit(INTERRUPTED)
        raise


if __name__ == "__main__":
    run()
