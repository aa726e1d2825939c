"""``truearm`` and ``python -m truearm``: nothing is imported before an interrupt is looked after."""

from __future__ import annotations

import os
import sys


def run() -> None:
    """Run the command line and end the process with its exit code."""
    try:
        from truearm.cli.main import main

        sys.exit(main())
    except KeyboardInterrupt:  # while modules are being imported
        os._exit(130)
    except ImportError as exc:
        if isinstance(exc.__cause__, KeyboardInterrupt):  # a compiled module
            os._exit(130)
        raise


if __name__ == "__main__":
    run()
