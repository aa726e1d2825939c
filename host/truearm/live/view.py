"""Show the progress of a recording to its operator and accept what they type.

A thread writes rows and messages to a descriptor of its own, so a blocked terminal (Ctrl-S, a hanging connection) holds
up nothing else. Another reads typed lines, only from a terminal in the foreground: a recording in a script must not
consume the script's input, and a background program that reads is stopped by its terminal.
"""

from __future__ import annotations

import codecs
import os
import re
import select
import signal
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext, suppress
from typing import TextIO

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.table import Table
from rich.text import Text

from truearm.live.state import CONTRADICTION, HELP, LiveState, ViewLine
from truearm.text import one_line

LONGEST = 500
_POLL_S = 0.1
_KEY = re.compile(r"\x1b(\[[0-?]*[@-~]|O.)")  # an arrow or function key (ECMA-48)
_DROP = re.compile(r"\x15|\x1b(?!\[|O)")  # Ctrl-U, or Escape alone
_ERASE = re.compile(r"[^\b\x7f]?[\b\x7f]")
PERIOD_S, PLAIN_S = 0.25, 1.0
LAST_WORDS_S = 1.0


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
    """Call ``take`` with every typed line, from a thread.

    ``one_by_one``: the terminal passes on every key without echo.

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


@contextmanager
def showing(state: LiveState, plain: bool, output: TextIO) -> Iterator[None]:
    """Show the state on ``output`` until the end of the block; it gets typed lines from a foreground terminal."""
    live, stop = not plain and output.isatty(), threading.Event()
    with ExitStack() as stack:
        typed = stack.enter_context(typed_lines(state.typed.append, one_by_one=live)) if may_ask() else None
        thread = threading.Thread(target=_show, args=(state, live, output, typed, stop), name="view", daemon=True)
        thread.start()
        try:
            yield
        finally:
            stop.set()
            thread.join(LAST_WORDS_S)


def _show(state: LiveState, with_table: bool, output: TextIO, typed: Typed | None, stop: threading.Event) -> None:
    """Write messages as they come, with the table below them, or else all rows on one line once a second."""
    try:
        with _own_file(output) as file, ExitStack() as stack:
            console = Console(file=file, force_terminal=with_table)
            live = Live(console=console, auto_refresh=False, transient=True, redirect_stdout=False)
            if with_table:
                stack.enter_context(live)
            over, due_s = False, PLAIN_S
            while not over:
                over = stop.wait(PERIOD_S)
                rows, time = state.rows, f"{state.elapsed_s:.1f} s: "
                for text in [state.messages.popleft() for _ in range(len(state.messages))]:
                    console.print(Text(time + one_line(text)), soft_wrap=True)
                    if text.startswith(CONTRADICTION):
                        console.bell()
                if with_table and rows:
                    live.update(_table(rows, typed), refresh=True)
                elif rows and state.elapsed_s >= due_s and not over:
                    due_s = int(state.elapsed_s) + PLAIN_S
                    console.print(Text(time + "; ".join(f"{row.name} {row.words}" for row in rows)), soft_wrap=True)
    except Exception as exc:
        state.failed(exc)


def _own_file(output: TextIO) -> AbstractContextManager[TextIO]:
    """Return a file with a descriptor of its own, since a blocked write holds the lock of its file."""
    try:
        return os.fdopen(os.dup(output.fileno()), "w", encoding=output.encoding, errors="backslashreplace")
    except (OSError, ValueError, AttributeError):  # a replacement stream without a descriptor
        return nullcontext(output)


def grid(rows: Iterable[tuple[str, str, bool]]) -> Table:
    """Return a table of names and texts, with those of alarms in colour."""
    table = Table.grid(padding=(0, 2))
    for name, text, is_alarm in rows:
        table.add_row(Text(name, "dim"), Text(text, "bold yellow" if is_alarm else ""))
    return table


def _table(rows: list[ViewLine], typed: Typed | None) -> RenderableType:
    table = grid((row.name, row.words, bool(row.alarms)) for row in rows)
    return table if typed is None else Group(table, Text(HELP, "dim"), Text(f"> {typed.text}"))
