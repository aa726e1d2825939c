"""``truearm`` and ``python -m truearm``: interrupts are handled before anything else is imported."""

from __future__ import annotations

import os
import sys

INTERRUPTED = 130  # ExitCode.INTERRUPTED, before anything can be imported


def run() -> None:
    """Run the command line and end the process with its exit code."""
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
