"""The progress of long computations: the current step and its completed share.

Code that may take seconds names its steps with ``step`` or ``steps_of``. A caller that displays them registers with
``listening``; without a listener nothing happens. The listener belongs to the context (``contextvars``): threads and
other callers do not share it.
"""

from __future__ import annotations

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
