"""Signals that end a command cleanly."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

_NUMBERS = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]


@contextmanager
def asked_to_stop() -> Iterator[Callable[[], bool]]:
    """Make Ctrl-C, SIGTERM and a closed terminal only set a flag.

    An exception could occur in the middle of a record of the file.
    """
    flag = threading.Event()
    signals = [
        n for n in _NUMBERS if n == signal.SIGINT or signal.getsignal(n) != signal.SIG_IGN
    ]  # nohup ignores SIGHUP
    handlers = {number: signal.signal(number, lambda *_: flag.set()) for number in signals}
    try:
        yield flag.is_set
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
