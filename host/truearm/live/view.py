"""Display for the operator of a recording, and input: live on a terminal, otherwise one line per event and per second.

The recorder passes everything on through queues and never waits. A separate thread builds the view and writes it to a
descriptor of its own. A blocked terminal (Ctrl-S, a hanging connection), an error in the view or a slow view stops only
the view.
"""

from __future__ import annotations

import io
import os
import threading
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from datetime import date
from typing import TYPE_CHECKING, Any, TextIO

from truearm.box.readiness import LVDT, Purpose, check_box, far_from_calibration
from truearm.errors import Argument, InputError
from truearm.live.keyboard import Typed, may_ask, typed_lines
from truearm.live.state import CONTRADICTION, HELP, MOUNT_NEXT, LiveState, ViewLine
from truearm.record.joint_lines import SILENCE_S
from truearm.record.operator import Operator, OperatorEvent
from truearm.text import counted, one_line

if TYPE_CHECKING:
    from truearm.record.status import Status
    from truearm.session.box_frames import Data
    from truearm.session.box_ident import Ident
    from truearm.session.device_clock import OnlineClock, OnlineEstimate
    from truearm.session.joint_format import JointLine

LIVE_S, PLAIN_S = 0.25, 1.0
LOOK_S = 0.2  # interval for events, without a terminal
CLOCK_S = 2.0  # a fit takes a few ms
WAITING = 50_000  # pieces; what a stalled view misses is counted
LAST_WORDS_S = 1.0


class View(Operator):
    """The live view. ``unchecked``: reasons to refuse the box are only displayed."""

    def __init__(self, state: LiveState, purpose: Purpose, unchecked: bool = False) -> None:
        self._failure = ""
        self._missed = 0
        self._state, self._purpose, self._unchecked = state, purpose, unchecked
        self._queue: deque[tuple[Any, ...]] = deque()
        self._wishes: deque[OperatorEvent] = deque()
        self._clock: OnlineClock | None = None
        self._estimate: OnlineEstimate | None = None
        self._estimated_s = -CLOCK_S
        self._status: Status | None = None
        self._watch = _Watch()
        self._ident: Ident | None = None
        self._warned_of_temperature = False
        self.wake = threading.Event()  # the view has work before its next interval
        self._over = threading.Event()

    # --- the recorder's side

    def approve(self, ident: Ident) -> None:
        verdict = check_box(ident, self._purpose, date.today())
        if verdict.refused and not self._unchecked:
            raise InputError(
                f"{'; '.join(one_line(text) for text in verdict.refused)}. Nothing was started; ",
                *(Argument("unchecked"), " records anyway"),
            )
        self._ident = ident
        self._put("ident", ident)
        for text in (*verdict.refused, *verdict.warned):
            self._put("say", f"warning: {one_line(text)}")

    def block(self, t_host_ns: int, data: Data) -> None:
        self._put("block", t_host_ns, data)

    def reading(self, t_host_ns: int, reading: JointLine) -> None:
        self._put("reading", t_host_ns, reading)

    def exchange(self, t0_ns: int, t1_us: int, t2_us: int, t3_ns: int) -> None:
        self._put("exchange", t0_ns, t1_us, t2_us, t3_ns)

    def box_temperature(self, degc: float) -> None:
        if self._ident is None or not self._purpose.ball_bar or self._warned_of_temperature:
            return
        if text := far_from_calibration(self._ident, LVDT, degc):
            self._warned_of_temperature = True
            self._put("say", f"warning: {one_line(text)}")

    def status(self, status: Status) -> None:
        self._put("status", status)

    def wishes(self) -> list[OperatorEvent]:
        return [self._wishes.popleft() for _ in range(len(self._wishes))]

    def last_wishes(self) -> list[OperatorEvent]:
        self._put("over")
        self.wake.set()
        self._over.wait(LAST_WORDS_S / 2)
        return [wish for wish in self.wishes() if wish.kind != "end"]

    def typed(self, text: str) -> None:
        """Take a line typed by the operator."""
        self._put("typed", text)
        self.wake.set()

    def _put(self, *item: Any) -> None:
        if len(self._queue) < WAITING:
            self._queue.append(item)
        else:
            self._missed += 1

    # --- the view's side

    def failed(self, text: str) -> None:
        """Note that the view has stopped."""
        self._failure = text

    @property
    def trouble(self) -> str:
        """Return what the view missed, "" if nothing. Missed dwells are not in the file's events either."""
        if self._failure:
            return f"the live view failed ({self._failure}); the recording was not affected"
        return (
            f"the live view stalled and missed {self._missed} updates; the recording was not affected"
            if self._missed
            else ""
        )

    def take(self) -> tuple[list[str], Status | None]:
        """Process what waits; return the lines to print now, and the newest status."""
        messages: list[str] = []
        for _ in range(len(self._queue)):
            kind, *values = self._queue.popleft()
            if kind == "say":
                messages.append(*values)
            elif kind == "status":
                self._status = values[0]
                messages += self._watch.events(self._status, self._state.session_progress.complete)
                self._state.look()
            elif kind == "exchange":
                self._exchanges().add(*values)
            elif kind == "typed":
                self._state.command(*values)
            elif kind == "over":
                self._state.close()
                messages += self._heard()
                self._over.set()
            else:
                getattr(self._state, kind)(*values)
            messages += self._heard()
        return messages, self._status

    def rows(self, status: Status) -> list[ViewLine]:
        """Return the view."""
        return self._state.rows(status, self._clock_now(status))

    def line(self, status: Status) -> str:
        """Return the view on one line."""
        return self._state.line(status, self._clock_now(status))

    def _clock_now(self, status: Status) -> OnlineEstimate | None:
        if status.elapsed_s - self._estimated_s >= CLOCK_S:
            self._estimated_s, self._estimate = status.elapsed_s, self._exchanges().estimate()
        return self._estimate

    def _exchanges(self) -> OnlineClock:
        from truearm.session.device_clock import OnlineClock  # imports numpy while the recording is already running

        self._clock = self._clock or OnlineClock()
        return self._clock

    def _heard(self) -> list[str]:
        self._wishes.extend(self._state.wishes)
        self._state.wishes.clear()
        messages = list(self._state.said)
        self._state.said.clear()
        return messages


class _Watch:
    """Reports each fault of the box once, and every loss or return of box or robot, and other losses."""

    def __init__(self) -> None:
        self._said: set[str] = set()
        self._box_ok = True
        self._link_losses = 0
        self._robot_ok: bool | None = None
        self._robot_silent = self._robot_floods = self._robot_junk = self._robot_foreign = False
        self._lost = 0

    def events(self, status: Status, complete: bool) -> list[str]:
        """Return what is new. A robot that ends its program, or sends nothing more once the plan is ``complete``, is usual."""
        messages = [
            f"warning: {fault}; its samples are recorded anyway" for fault in status.faults if fault not in self._said
        ]
        messages += [f"warning: {loss}" for loss in status.file_losses if loss not in self._said]
        self._said.update(status.faults, status.file_losses)
        losses = status.counters.link_losses
        if status.box_ok != self._box_ok:
            self._box_ok = status.box_ok
            messages.append(_box_words(status))
        elif status.box_ok and losses > self._link_losses:
            messages.append("warning: the link to the box was lost for a moment")
        self._link_losses = losses
        if self._robot_ok is not None and status.robot_ok != self._robot_ok:
            messages.append("the robot is back" if status.robot_ok else _robot_words(status, complete))
        self._robot_ok = status.robot_ok
        silent = bool(status.robot_ok) and (status.robot_age_s or 0.0) > SILENCE_S and not status.robot_waits
        if silent != self._robot_silent and status.robot_ok:
            warning = "" if complete else "warning: "
            messages.append(
                f"{warning}the robot has been silent for {SILENCE_S:g} s" if silent else "the robot sends again"
            )
        self._robot_silent = silent
        if status.counters.robot_held_up and not self._robot_floods:
            self._robot_floods = True
            messages.append("warning: the robot sends more than can be stored; its readings come late")
        if status.counters.robot_unstored_bytes and not self._robot_junk:
            self._robot_junk = True
            messages.append(
                "warning: the robot sends much data other than joint readings; only joint readings are stored from here on"
            )
        if status.counters.robot_foreign and not self._robot_foreign:
            self._robot_foreign = True
            messages.append("warning: another address sends datagrams to the robot's port; they are not stored")
        lost = status.counters.lost_frames + status.counters.overruns_in_box
        if lost > self._lost:
            messages.append(
                f"warning: {counted(status.counters.lost_frames, 'frame')} lost on the link, {counted(status.counters.overruns_in_box, 'sample')} in the box"
            )
        self._lost = lost
        return messages


def _robot_words(status: Status, complete: bool) -> str:
    if status.robot_closed:
        return "the robot closed its stream, as a program that ends does"
    if complete:
        return "the robot's connection has ended; the plan is complete"
    return "warning: the robot was lost; trying to reach it again"


def _box_words(status: Status) -> str:
    if status.box_ok:
        return "the box is back"
    if status.state == "link lost":
        return "warning: the link to the box was lost; trying to open it again"
    return "warning: the box has been silent for 3 s; is it stuck?"


@contextmanager
def showing(view: View, plain: bool, output: TextIO) -> Iterator[None]:
    """Show the view on ``output`` until the end of the block; it receives typed lines if there is a foreground
    terminal.
    """
    live = not plain and output.isatty()
    with ExitStack() as stack:
        typed = stack.enter_context(typed_lines(view.typed, one_by_one=live)) if may_ask() else None
        write, close = _descriptor(output)
        show = _Live(write, typed) if live else _Plain(write)
        stop = threading.Event()
        thread = threading.Thread(
            target=_run, args=(view, show, stop, LIVE_S if live else LOOK_S), name="view", daemon=True
        )
        thread.start()
        try:
            yield
        finally:
            stop.set()
            view.wake.set()
            thread.join(LAST_WORDS_S)
            if not thread.is_alive():
                close()


def _run(view: View, show: _Live | _Plain, stop: threading.Event, period_s: float) -> None:
    try:
        over = False
        while not over:
            view.wake.wait(period_s)
            view.wake.clear()
            over = stop.is_set()
            messages, status = view.take()
            show.show(messages, status, view, over)
    except Exception as exc:  # whatever it is, the recording matters more than its view
        view.failed(f"{type(exc).__name__}: {exc}")


class _Plain:
    """One line per event, and one per second."""

    def __init__(self, write: Callable[[str], None]) -> None:
        self._write = write
        self._due_s = PLAIN_S

    def show(self, messages: list[str], status: Status | None, view: View, over: bool) -> None:
        at = "" if status is None else f"{status.elapsed_s:.1f} s: "
        lines = [at + one_line(text) for text in messages]
        if status is not None and not over and status.elapsed_s >= self._due_s:
            self._due_s = int(status.elapsed_s) + PLAIN_S
            lines.append(at + view.line(status))
        if lines:
            self._write("".join(line + "\n" for line in lines))


class _Live:
    """A table at a fixed position; events scroll by above it."""

    def __init__(self, write: Callable[[str], None], typed: Typed | None) -> None:
        from rich.console import Console
        from rich.live import Live

        self._typed = typed
        # rich writes to memory; its output is then written in one piece
        self._text, self._write = io.StringIO(), write
        console = Console(file=self._text, force_terminal=True, legacy_windows=False)
        self._live = Live(console=console, auto_refresh=False, transient=True)
        self._live.start()

    def show(self, messages: list[str], status: Status | None, view: View, over: bool) -> None:
        from rich.text import Text

        at = "" if status is None else f"{status.elapsed_s:.1f} s: "
        for text in messages:
            style = "yellow" if text.startswith(("warning", MOUNT_NEXT)) else ""
            if text.startswith(CONTRADICTION):
                style = "bold red"
                self._text.write("\a")
            self._live.console.print(Text(at + one_line(text), style))
        if status is not None:
            self._live.update(self._table(view.rows(status)), refresh=True)
        if over:
            self._live.stop()
        self._write(self._text.getvalue())
        self._text.seek(0)
        self._text.truncate()

    def _table(self, rows: list[ViewLine]) -> Any:
        from rich.console import Group
        from rich.table import Table
        from rich.text import Text

        table = Table.grid(padding=(0, 2))
        for row in rows:
            table.add_row(Text(row.name, "dim"), Text(row.text, "bold yellow" if row.alarm else ""))
        if self._typed is None:
            return table
        return Group(table, Text(HELP.removeprefix(" · "), "dim"), Text(f"> {self._typed.text}"))


def _descriptor(output: TextIO) -> tuple[Callable[[str], None], Callable[[], None]]:
    """Return functions that write to the output by a separate descriptor and close it.

    No Python lock is held while a terminal accepts nothing.
    """
    try:
        fd = os.dup(output.fileno())
    except (OSError, ValueError, AttributeError):  # a replacement stream without a descriptor

        def say(text: str) -> None:
            output.write(text)

        return say, lambda: None

    def write(text: str) -> None:
        data = text.encode(output.encoding or "utf-8", "backslashreplace")
        while data:
            data = data[os.write(fd, data) :]

    return write, lambda: os.close(fd)
