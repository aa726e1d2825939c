"""Reopen a lost link repeatedly in a thread, because an unreachable address can block the caller for seconds."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from concurrent.futures import Future

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
        self._opening: Future[Link] | None = None
        self._held_up = self._foreign = 0  # of the previous links
        self.name = self._link.name
        self.numeric = getattr(self._link, "numeric", False)

    def read(self, timeout_s: float) -> Arrivals:
        return self._opened().read(timeout_s)

    def write(self, data: bytes) -> int:
        return self._opened().write(data)

    def reopen(self, timeout_s: float) -> bool:
        """Return whether the link is back, waiting up to ``timeout_s``; attempts continue between calls."""
        if self._opening is None:
            self.close()
            self._opening = Future()
            threading.Thread(target=_open, args=(self._open, self._opening), daemon=True).start()
        try:
            link = self._opening.result(timeout_s)
        except TimeoutError:
            return False
        self._opening, self._link, self.name = None, link, link.name
        return True

    def close(self) -> None:
        if self._opening is not None:
            if not self._opening.cancel():
                self._opening.result().close()
            self._opening = None
        if self._link is not None:
            link, self._link = self._link, None
            backlog = backlog_of(link)
            self._held_up, self._foreign = self._held_up + backlog.held_up, self._foreign + backlog.foreign
            link.close()

    @property
    def backlog(self) -> Backlog:
        """Return the backlog of the open link, with the counts of all links."""
        current = Backlog() if self._link is None else backlog_of(self._link)
        return current._replace(held_up=current.held_up + self._held_up, foreign=current.foreign + self._foreign)

    def _opened(self) -> Link:
        if self._link is None:
            raise LinkError(f"{self.name}: the link is closed")
        return self._link


def _open(open_link: Callable[[], Link], opening: Future[Link]) -> None:
    """Try until a link is open; if nobody wants it any more, it is closed."""
    while not opening.cancelled():
        try:
            link = open_link()
        except (LinkError, InputError):
            time.sleep(PAUSE_S)
            continue
        if opening.set_running_or_notify_cancel():
            opening.set_result(link)
        else:
            link.close()
        return
