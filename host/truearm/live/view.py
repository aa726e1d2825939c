"""Show the progress of a recording to its operator and accept what they type.

A thread writes rows and messages to a descriptor of its own, so a blocked terminal (Ctrl-S, a hanging connection) holds
up nothing else.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from typing import TextIO

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.table import Table
from rich.text import Text

from truearm.live.keyboard import Typed, may_ask, typed_lines
from truearm.live.state import CONTRADICTION, HELP, LiveState, ViewLine
from truearm.text import one_line

PERIOD_S, PLAIN_S = 0.25, 1.0
LAST_WORDS_S = 1.0


@contextmanager
def showing(state: LiveState, plain: bool, output: TextIO) -> Iterator[None]:
    """Show the state on ``output`` until the end of the block; it receives typed lines if there is a foreground
    terminal.
    """
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
