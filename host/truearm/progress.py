"""The progress of long computations: the current step and its completed share.

Code that may take seconds names its steps with ``step`` or ``steps_of``. A caller that displays them registers with
``listening``; without a listener nothing happens. The listener belongs to the context (``contextvars``): threads and
other callers do not share it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from typing import NamedTuple, Protocol, TypeVar

T = TypeVar("T")
Advance = Callable[[float], None]  # takes the completed share of a step, 0 to 1


class Running(Protocol):
    """A step in progress."""

    def advance(self, share: float) -> None:
        """Receive the completed share of the step, 0 to 1."""

    def end(self) -> None:
        """Receive the end of the step."""


class Listener(Protocol):
    """Receives steps; steps may be nested."""

    def begin(self, what: str) -> Running:
        """Receive the beginning of a step."""


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
def step(what: str) -> Iterator[Advance]:
    """Name the step inside this context; the yielded function takes its completed share."""
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
    """Yield the items one by one, and report how many are completed."""
    with step(what) as advance:
        for done, item in enumerate(items):
            advance(done / len(items))
            yield item


@contextmanager
def part_of(advance: Advance, begin: float, end: float) -> Iterator[None]:
    """Let the steps inside this context advance the step around it from share ``begin`` to ``end``.

    Steps that follow one another inside the context do not move it backwards.
    """
    listener = _LISTENER.get()
    advance(begin)
    if listener is None:
        yield
        return
    with listening(_Part(listener, lambda share: advance(begin + (end - begin) * share))):
        yield
    advance(end)


class _Part:
    """A listener that passes the largest share of its steps on."""

    def __init__(self, listener: Listener, advance: Advance) -> None:
        self._listener, self._advance, self._share = listener, advance, 0.0

    def begin(self, what: str) -> Running:
        return _Both(self._listener.begin(what), self._reached)

    def _reached(self, share: float) -> None:
        self._share = max(self._share, share)
        self._advance(self._share)


class _Both(NamedTuple):
    """A step in progress whose shares are passed on."""

    running: Running
    reached: Advance

    def advance(self, share: float) -> None:
        self.running.advance(share)
        self.reached(share)

    def end(self) -> None:
        self.running.end()
