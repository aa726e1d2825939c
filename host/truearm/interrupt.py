"""Signals that end what a command does, in order."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

_NUMBERS = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]


@contextmanager
def asked_to_stop() -> Iterator[Callable[[], bool]]:
    """Ctrl-C, SIGTERM and a terminal that was closed only raise a flag: an exception could strike in the middle of a record of the file."""
    asked = threading.Event()
    wanted = [
        n for n in _NUMBERS if n == signal.SIGINT or signal.getsignal(n) != signal.SIG_IGN
    ]  # nohup ignores SIGHUP
    before = {number: signal.signal(number, lambda *_: asked.set()) for number in wanted}
    try:
        yield asked.is_set
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
