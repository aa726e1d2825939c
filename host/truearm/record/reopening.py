"""Reopen a lost link repeatedly in a thread, because an unreachable address can block the caller for seconds."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable

from truearm.errors import InputError, LinkError
from truearm.record.links import Arrivals, Backlog, Link, backlog_of

PAUSE_S = 0.25  # between attempts; a newly connected box takes about one second to show its port


class Reopening:
    """Opens a link with ``open_link`` now, and again with ``reopen`` after it was lost. Raises what ``open_link``
    raises now.
    """

    def __init__(self, open_link: Callable[[], Link]) -> None:
        self._open = open_link
        self._link: Link | None = open_link()
        self._opener: _Opener | None = None
        self._held_up = self._foreign = 0  # of the previous links
        self.name = self._link.name
        self.numeric = getattr(self._link, "numeric", False)

    def read(self, timeout_s: float) -> Arrivals:
        return self._opened().read(timeout_s)

    def write(self, data: bytes) -> int:
        return self._opened().write(data)

    def reopen(self, timeout_s: float) -> bool:
        """Return whether the link is back, waiting up to ``timeout_s``; attempts continue between calls."""
        if self._opener is None:
            self.close()
            self._opener = _Opener(self._open)
        link = self._opener.opened(timeout_s)
        if link is None:
            return False
        self._opener, self._link, self.name = None, link, link.name
        return True

    def close(self) -> None:
        if self._opener is not None:
            self._opener.stop()
            self._opener = None
        if self._link is not None:
            link, self._link = self._link, None
            before = backlog_of(link)
            self._held_up, self._foreign = self._held_up + before.held_up, self._foreign + before.foreign
            link.close()

    @property
    def backlog(self) -> Backlog:
        """Return the backlog of the open link, with the counts of all links."""
        now = Backlog() if self._link is None else backlog_of(self._link)
        return now._replace(held_up=now.held_up + self._held_up, foreign=now.foreign + self._foreign)

    def _opened(self) -> Link:
        if self._link is None:
            raise LinkError(f"{self.name}: the link is closed")
        return self._link


class _Opener:
    """A thread that tries until it has opened a link."""

    def __init__(self, open_link: Callable[[], Link]) -> None:
        self._open = open_link
        self._links: queue.SimpleQueue[Link] = queue.SimpleQueue()
        self._stopping = threading.Event()
        threading.Thread(target=self._run, daemon=True).start()

    def opened(self, timeout_s: float) -> Link | None:
        try:
            return self._links.get(timeout=timeout_s)
        except queue.Empty:
            return None

    def stop(self) -> None:
        """Stop without waiting for a pending attempt: what it opens is closed."""
        self._stopping.set()
        if (link := self.opened(0.0)) is not None:
            link.close()

    def _run(self) -> None:
        while not self._stopping.is_set():
            try:
                self._links.put(self._open())
            except (LinkError, InputError):
                self._stopping.wait(PAUSE_S)
                continue
            if self._stopping.is_set():
                self.stop()
            return
