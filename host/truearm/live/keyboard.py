"""Read lines typed by the operator in the background. Only a terminal in the foreground is read.

A recording in a script must not consume the script's input, and a background program that reads is stopped by its
terminal.
"""

from __future__ import annotations

import codecs
import os
import select
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

LONGEST = 500
_POLL_S = 0.1
_BACKSPACE, _ESCAPE, _CTRL_U = ("\x7f", "\b"), "\x1b", "\x15"
_INTRODUCERS = "[O"  # after Escape: an arrow or function key, up to a character from "@" to "~" (ECMA-48)


class Typed:
    """The line being typed."""

    def __init__(self) -> None:
        self.text = ""
        self._key = ""  # what has come of an arrow or function key
        self._dropped = ""  # by its Escape

    def push(self, characters: str) -> list[str]:
        """Return the lines completed by these characters.

        Backspace, Ctrl-U and Escape are handled; other control characters, arrow and function keys are ignored.
        """
        lines = []
        for character in characters:
            if self._belongs_to_key(character):
                continue
            if character in "\r\n":
                lines.append(self.text)
                self.text = ""
            elif character in _BACKSPACE:
                self.text = self.text[:-1]
            elif character == _CTRL_U:
                self.text = ""
            elif character.isprintable() and len(self.text) < LONGEST:
                self.text += character
        return lines

    def _belongs_to_key(self, character: str) -> bool:
        """Return whether a character is Escape or continues it to the sequence of a key. Escape alone drops the line."""
        before, self._key = self._key, ""
        if character == _ESCAPE:
            self._key, self._dropped, self.text = character, self.text, ""
        elif before == _ESCAPE and character in _INTRODUCERS:
            self._key, self.text = before + character, self._dropped
        elif len(before) > 1:
            self._key = "" if "@" <= character <= "~" else before
        else:
            return False
        return True


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
    before = termios.tcgetattr(fd)
    stopping = signal.signal(signal.SIGTSTP, _ignore)
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
        _restore(fd, before)


def _read(fd: int, typed: Typed, take: Callable[[str], None], stop: threading.Event) -> None:
    decoder = codecs.getincrementaldecoder("utf-8")("ignore")  # a read may end inside a character
    while not stop.is_set():
        try:
            ready, _, _ = select.select([fd], [], [], _POLL_S)
            if not ready or not _in_foreground(fd):
                stop.wait(_POLL_S if ready else 0.0)
                continue
            data = os.read(fd, 1024)
        except (OSError, ValueError):
            return
        if not data:  # end of file; the terminal may be gone
            return
        for line in typed.push(decoder.decode(data)):
            take(line)


def _in_foreground(fd: int) -> bool:
    return os.tcgetpgrp(fd) == os.getpgrp()


def _restore(fd: int, attributes: list[object]) -> None:
    import termios

    try:
        if _in_foreground(fd):
            termios.tcsetattr(fd, termios.TCSANOW, attributes)  # type: ignore[arg-type]
    except (OSError, termios.error):  # the terminal is gone
        return


def _ignore(number: int, frame: FrameType | None) -> None:
    """Do nothing. A handler is used instead of SIG_IGN, which child processes would inherit."""
