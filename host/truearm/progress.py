"""Long work: the current step and its completed share, signals that end it, and a pause of the garbage collector.

Code that may take seconds names its steps with ``step`` or ``steps_of``. A caller that displays them registers with
``listening``; without a listener nothing happens. The listener belongs to the context (``contextvars``): threads and
other callers do not share it.
"""

from __future__ import annotations

import gc
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from contextvars import ContextVar
from typing import TypeVar

T = TypeVar("T")
Advance = Callable[[float], None]  # takes the completed share of a step, 0 to 1


# receives the name of a step that begins, and makes a context that ends with it; steps may be nested
Listener = Callable[[str], AbstractContextManager[Advance]]
_LISTENER: ContextVar[Listener | None] = ContextVar("listener", default=None)


@contextmanager
def listening(listener: Listener) -> Iterator[None]:
    """Make a listener receive every step inside this context."""
    token = _LISTENER.set(listener)
    try:
        yield
    finally:
        _LISTENER.reset(token)


@contextmanager
def step(name: str) -> Iterator[Advance]:
    """Name the step inside this context; the yielded function takes its completed share."""
    listener = _LISTENER.get()
    if listener is None:
        yield lambda _: None
        return
    with listener(name) as advance:
        yield advance


def steps_of(items: Sequence[T], name: str) -> Iterator[T]:
    """Yield the items one by one, and report how many are completed."""
    with step(name) as advance:
        for done, item in enumerate(items):
            advance(done / len(items))
            yield item


_NUMBERS = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]


@contextmanager
def asked_to_stop() -> Iterator[Callable[[], bool]]:
    """Make Ctrl-C, SIGTERM and a closed terminal only set a flag.

    An exception could occur in the middle of a record of the file.
    """
    flag = threading.Event()
    # nohup ignores SIGHUP
    signals = [n for n in _NUMBERS if n == signal.SIGINT or signal.getsignal(n) != signal.SIG_IGN]
    handlers = {number: signal.signal(number, lambda *_: flag.set()) for number in signals}
    try:
        yield flag.is_set
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)


@contextmanager
def uncollected() -> Iterator[None]:
    """Disable cyclic garbage collection while many objects without cycles are made.

    It would scan all of them repeatedly.

    At the end they join the objects that are scanned least often, or the first of many small allocations would scan
    them all.
    """
    was = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was:
            gc.freeze()
            gc.unfreeze()
            gc.enable()
