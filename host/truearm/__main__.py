"""``truearm`` and ``python -m truearm``: interrupts are handled before anything else is imported."""

from __future__ import annotations

import _thread
import os
import sys
import time

INTERRUPTED = 130  # ExitCode.INTERRUPTED, before anything can be imported
SOON_S = 0.01


def keep_interrupts() -> None:
    """Raise Ctrl-C again if it strikes in a callback whose exceptions Python ignores.

    Python calls one after each import, when it forgets the module's lock.
    """

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
    except ImportError as exc:
        if isinstance(exc.__cause__, KeyboardInterrupt):  # a compiled module
            os._exit(INTERRUPTED)
        raise


if __name__ == "__main__":
    run()
