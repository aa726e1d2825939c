"""What long work tells of itself while it runs: which step it is at, and which share of it is done.

Work that may take seconds names its steps by ``step`` or ``steps_of``. Who wants to show them listens by ``listening``; where nobody
listens, nothing happens. The listener belongs to the context (``contextvars``): threads and other callers do not share it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Protocol, TypeVar

T = TypeVar("T")
Advance = Callable[[float], None]  # takes the share of a step that is done, 0 to 1


class Running(Protocol):
    """A step that is under way."""

    def advance(self, share: float) -> None:
        """Hear which share of it is done, 0 to 1."""

    def end(self) -> None:
        """Hear that it ends."""


class Listener(Protocol):
    """Hears of steps; steps may lie within others."""

    def begin(self, what: str) -> Running:
        """Hear that a step begins."""


_LISTENER: ContextVar[Listener | None] = ContextVar("listener", default=None)


@contextmanager
def listening(listener: Listener) -> Iterator[None]:
    """Have a listener hear of every step within."""
    token = _LISTENER.set(listener)
    try:
        yield
    finally:
        _LISTENER.reset(token)


@contextmanager
def step(what: str) -> Iterator[Advance]:
    """Name what is done within; the function that comes back takes the share that is done."""
    listener = _LISTENER.get()
    if listener is None:
        yield lambda _: None
        return
    running = listener.begin(what)
    try:
        yield running.advance
    finally:
        running.end()


def steps_of(items: Sequence[T], what: str) -> Iterator[T]:
    """Return the items one by one, and tell how many of them were done."""
    with step(what) as advance:
        for done, item in enumerate(items):
            advance(done / len(items))
            yield item
