"""Progress of steps that take longer than two seconds, on the terminal: name, percentage, elapsed and remaining time."""

from __future__ import annotations

import shutil
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from threading import Event, Lock, Thread
from typing import TextIO

from truearm.progress import listening
from truearm.text import one_line

QUIET_S = 2.0  # shorter steps are not shown
EVERY_S = 0.5
LEAST_SHARE = 0.02  # from here on the remaining time is shown
CLEAR = "\x1b[2K\r"


@dataclass(eq=False)
class RunningStep:
    """A step that is under way."""

    what: str
    begun_s: float
    ended: Callable[[RunningStep], None]
    share: float = 0.0

    def advance(self, share: float) -> None:
        """Set the share that is done, 0 to 1."""
        self.share = share

    def end(self) -> None:
        """End the step."""
        self.ended(self)


class Shown:
    """Shows the innermost step on a line of the terminal, by a thread, and clears the line at its end.

    The time left of the step around it follows, if that is known.
    """

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self._steps: list[RunningStep] = []
        self._lock = Lock()
        self._is_shown = False
        self._ended = Event()
        self._thread: Thread | None = None

    def begin(self, what: str) -> RunningStep:
        """Begin a step; the first one starts the thread."""
        with self._lock:
            self._steps.append(RunningStep(one_line(what), time.monotonic(), self._end))
            if self._thread is None:
                self._thread = Thread(target=self._run, daemon=True, name="progress")
                self._thread.start()
            return self._steps[-1]

    def _end(self, step: RunningStep) -> None:
        with self._lock:
            if step in self._steps:
                self._steps.remove(step)
            self._clear()

    def close(self) -> None:
        """Clear the line and stop."""
        self._ended.set()
        with self._lock:
            self._clear()

    def _run(self) -> None:
        while not self._ended.wait(EVERY_S):
            self.show()

    def show(self) -> None:
        """Show the innermost step that is older than two seconds, and the outermost whose share is known."""
        with self._lock:
            if self._ended.is_set():
                return
            now_s = time.monotonic()
            text = shown_text([step for step in self._steps if now_s - step.begun_s >= QUIET_S], now_s)
            if text:
                # the cursor returns to the start of the line, so that other output is not appended to it
                self._write(f"\x1b[2K{text[: shutil.get_terminal_size().columns - 1]}\r")
                self._is_shown = True

    def _clear(self) -> None:
        if self._is_shown:
            self._write(CLEAR)
            self._is_shown = False

    def _write(self, text: str) -> None:
        try:
            self._stream.write(text)
            self._stream.flush()
        except (OSError, ValueError):  # the terminal is gone; the work goes on
            self._ended.set()


def shown_text(steps: Sequence[RunningStep], now_s: float) -> str:
    """Return the text for nested steps, the outermost first; "" for none."""
    whole = next((step for step in steps if step.share >= LEAST_SHARE), None)
    texts = [said(step, now_s) for step in (steps[-1:] if whole in (None, *steps[-1:]) else [whole, steps[-1]]) if step]
    return "; ".join(texts)


def said(step: RunningStep, now_s: float) -> str:
    """``reading monday.mcap: 42 %, 12 s, about 17 s left``."""
    elapsed_s = now_s - step.begun_s
    if step.share < LEAST_SHARE:
        return f"{step.what}: {duration(elapsed_s)}"
    left_s = elapsed_s * (1.0 - step.share) / step.share
    return f"{step.what}: {100.0 * step.share:.0f} %, {duration(elapsed_s)}, about {duration(left_s)} left"


def duration(seconds: float) -> str:
    """``12 s``, ``3 min 20 s``."""
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest:02d} s" if minutes else f"{rest} s"


@contextmanager
def shown_progress() -> Iterator[None]:
    """Show the progress of steps inside this context on standard error, if it is a terminal."""
    if not sys.stderr.isatty():
        yield
        return
    shown = Shown(sys.stderr)
    try:
        with listening(shown):
            yield
    finally:
        shown.close()
