"""Read lines typed by the operator in the background. Only a terminal in the foreground is read.

A recording in a script must not consume the script's input, and a background program that reads is stopped by its
terminal.
"""

from __future__ import annotations

import codecs
import os
import re
import select
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

LONGEST = 500
_POLL_S = 0.1
_KEY = re.compile(r"\x1b(\[[0-?]*[@-~]|O.)")  # an arrow or function key (ECMA-48)
_DROP = re.compile(r"\x15|\x1b(?!\[|O)")  # Ctrl-U, or Escape alone
_ERASE = re.compile(r"[^\b\x7f]?[\b\x7f]")


class Typed:
    """The line being typed. Backspace, Ctrl-U and Escape work; other control characters and keys are ignored."""

    def __init__(self) -> None:
        self._keys = ""

    @property
    def text(self) -> str:
        return _edited(self._keys)

    def push(self, characters: str) -> list[str]:
        """Return the lines completed by these characters."""
        *lines, self._keys = re.split("[\r\n]", self._keys + characters)
        self._keys = self._keys[-8 * LONGEST :]
        return [_edited(line) for line in lines]


def _edited(keys: str) -> str:
    text = _DROP.split(_KEY.sub("", keys))[-1].partition("\x1b")[0]
    while _ERASE.search(text):
        text = _ERASE.sub("", text, count=1)
    return "".join(filter(str.isprintable, text))[:LONGEST]


def may_ask() -> bool:
    """Return whether an operator can be asked."""
    try:
        return os.name == "posix" and sys.stdin.isatty() and _in_foreground(sys.stdin.fileno())
    except (AttributeError, OSError, ValueError):  # no standard input
        return False


@contextmanager
def typed_lines(take: Callable[[str], None], one_by_one: bool) -> Iterator[Typed]:
    """Call ``take`` with every typed line, from a thread. ``one_by_one``: the terminal passes on every key without
    echo.

    Ctrl-Z is disabled meanwhile: a suspended recorder loses what the box sends.
    """
    import termios
    import tty

    typed, stop = Typed(), threading.Event()
    fd = sys.stdin.fileno()
    terminal_settings = termios.tcgetattr(fd)
    # A handler is used instead of SIG_IGN, which child processes would inherit.
    stopping = signal.signal(signal.SIGTSTP, lambda number, frame: None)
    if one_by_one:
        tty.setcbreak(fd, termios.TCSANOW)
    thread = threading.Thread(target=_read, args=(fd, typed, take, stop), daemon=True)
    thread.start()
    try:
        yield typed
    finally:
        stop.set()
        thread.join(1.0)
        signal.signal(signal.SIGTSTP, stopping)
        with suppress(OSError, termios.error):  # the terminal is gone
            if _in_foreground(fd):
                termios.tcsetattr(fd, termios.TCSANOW, terminal_settings)


def _read(fd: int, typed: Typed, take: Callable[[str], None], stop: threading.Event) -> None:
    decoder = codecs.getincrementaldecoder("utf-8")("ignore")  # a read may end inside a character
    with suppress(OSError, ValueError):
        while not stop.is_set():
            if not select.select([fd], [], [], _POLL_S)[0]:
                continue
            if not _in_foreground(fd):
                stop.wait(_POLL_S)
                continue
            data = os.read(fd, 1024)
            if not data:  # end of file; the terminal may be gone
                return
            for line in typed.push(decoder.decode(data)):
                take(line)


def _in_foreground(fd: int) -> bool:
    return os.tcgetpgrp(fd) == os.getpgrp()
