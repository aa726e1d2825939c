"""Record everything that a box and a robot send to a session file.

A single loop (``_pump``) reads both links and stores what arrived. Waiting for an answer uses the same loop, so nothing
is missed while a command is pending. Time comes from the clock and passes only in ``Link.read``: with the simulator's
clock and links this module runs in virtual time.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

from truearm.errors import LinkError, ProtocolError, RefusedError, TruearmError
from truearm.record.intake import EXPECTED, BoxStorage, RobotIntake
from truearm.record.links import Clock, Link, Reopenable, backlog_of
from truearm.record.operator import Counters, Operator, RecordSummary, Status
from truearm.record.requests import SECOND, Requests
from truearm.record.session_writer import SessionWriter
from truearm.schema import quoted
from truearm_wire.messages import CONFIGURE, IDENTIFY, START, STOP, SYNC_REQUEST

CHORES_NS = SECOND // 20  # interval for clock exchanges, chunks and progress
PROBE_NS = SECOND // 10
PROGRESS_NS = SECOND // 4
STOP_RETRIES = 4  # the operator who pressed Ctrl-C waits for this
SILENCE_NS = 3 * SECOND  # for a box that sends a heartbeat every second
ROBOT_NS = 5 * SECOND  # a robot with a running stream has sent hundreds of readings by then
REOPEN_S = CHORES_NS / SECOND
PATIENCE_S = 600.0  # for a lost box or robot; a cable is reconnected sooner
SHORTEST_NS = 10_000
ROBOT_SHARE_NS = SECOND // 50  # at a time, so that a flood of readings delays neither clock exchanges nor the end
DRAIN_NS = SECOND // 5
WAITING_NS = 5 * SECOND  # for readings that were received and not stored yet; usually there are none
USUAL_WAITING = 128  # pieces that have just arrived when a recording ends


class _Ended(Exception):
    """The recording has ended for ``reason`` (see RecordSummary)."""

    def __init__(self, reason: str, text: str = "") -> None:
        self.reason = reason
        self.text = text


@dataclass(frozen=True)
class RecordOptions:
    """What to record, and for how long.

    ``plan``: one mapping per pose, as in ``/plan``. ``osr`` is set on every stream that has one; None leaves them
    unchanged. ``head``: metadata to write first, name and entries. ``patience_s``: how long to wait for a lost link.
    """

    plan: Iterable[Mapping[str, Any]] = ()
    rig_toml: bytes | None = None
    mounted: Mapping[str, str] | None = None
    osr: int | None = None
    duration_s: float | None = None
    patience_s: float = PATIENCE_S
    head: Iterable[tuple[str, Mapping[str, Any]]] = ()


EVERYTHING = RecordOptions()


def record(
    link: Link,
    writer: SessionWriter,
    clock: Clock,
    *,
    robot: Link | None = None,
    options: RecordOptions = EVERYTHING,
    operator: Operator | None = None,
    interrupted: Callable[[], bool] = lambda: False,
) -> RecordSummary:
    """Identify, configure and start the box, then record until the end; completes and closes the session file.

    The recording ends ``duration_s`` after the start, when the robot announces its end or sends no reading for 5 s,
    when ``interrupted()`` becomes true (it is called at least every 50 ms), on KeyboardInterrupt or at the operator's
    request. It also ends if a lost or closed link cannot be opened again, or not within ``patience_s``. A writer that
    is held is kept once the box has started. The links stay open.

    Raises LinkError if the box does not answer, RefusedError if it refuses a command, ProtocolError if it speaks
    another protocol or has been replaced by another one, TruearmError if the file cannot be written, and whatever
    ``operator`` raises to refuse the box. Data received until then is kept in the file.
    """
    return _Recorder(link, writer, clock, robot, options, operator or Operator(), interrupted).run()


@dataclass
class _Recorder:
    _link: Link
    _writer: SessionWriter
    _clock: Clock
    _robot_link: Link | None
    _options: RecordOptions
    _operator: Operator
    _interrupted: Callable[[], bool]
    _counters: Counters = field(default_factory=Counters)
    _state: str = "identifying"
    _to_set_up: bool = True
    _started_ns: int | None = None
    _silent: bool = False
    _box_gone: str = ""
    _robot_gone: str = ""
    _file_losses: int = 0  # reported in an event so far

    def __post_init__(self) -> None:
        self._patience_ns = int(self._options.patience_s * SECOND)
        shared = self._writer, self._counters
        self._requests = Requests(self._link, self._clock, self._await)
        self._box = BoxStorage(*shared, self._requests, self._operator)
        robot = self._robot_link
        self._robot = None if robot is None else RobotIntake(robot, self._clock, *shared, self._operator)
        self._next_chores_ns = self._next_probe_ns = self._next_progress_ns = self._clock.now_ns()

    # --- the course of a recording

    def run(self) -> RecordSummary:
        end = _Ended("failed")
        try:
            self._write_head()
            self._record()
        except _Ended as exc:
            end = exc
        except KeyboardInterrupt:
            end = _Ended("interrupted")
        except TruearmError as exc:
            end = _Ended("failed", str(exc))
            raise
        finally:
            end_ns, duration_s = self._clock.now_ns(), self._elapsed_s()
            self._finish(end)
        silent_s = min((end_ns - (self._box.spoke_ns or 0)) / SECOND, duration_s)
        return RecordSummary(
            end.reason,
            end.text,
            duration_s,
            self._counters,
            self._box.faults,
            tuple(self._writer.losses),
            self._box_gone and f"silent for the last {max(silent_s, 0.0):.1f} s ({self._box_gone})",
            self._robot_gone,
        )

    def _write_head(self) -> None:
        now_ns, options = self._clock.now_ns(), self._options
        for name, entries in options.head:
            self._writer.metadata(name, entries)
        if options.rig_toml is not None:
            self._writer.attach("rig.toml", options.rig_toml)
        for pose in options.plan:
            self._writer.add_json("/plan", now_ns, pose)
        if options.mounted:
            self._writer.event("mounted", now_ns, **options.mounted)

    def _record(self) -> None:
        while True:
            try:
                self._check_end()
                if self._to_set_up or self._box.restarted or self._box.idle > 1:  # one heartbeat may be late
                    self._set_up()
                elif self._box.suspect:
                    self._requests.ask(IDENTIFY)
                    if not self._box.restarted:
                        self._box.cleared()
                self._pump(CHORES_NS)
            except (ProtocolError, RefusedError):
                raise
            except LinkError as exc:
                self._reconnect(exc)

    def _set_up(self) -> None:
        self._state = "identifying"
        if self._box.idle > 1 and not (self._to_set_up or self._box.restarted):
            self._writer.event("box-stopped", self._clock.now_ns())
        self._box.restarted, self._to_set_up = False, True  # also if the link is lost before it has started
        self._requests.ask(IDENTIFY)
        with suppress(RefusedError):
            self._requests.ask(STOP)  # a killed recorder left it streaming
        self._configure()
        self._operator.approve(self._requests.identified())
        self._requests.ask(START)
        self._box.idle = 0
        now_ns = self._clock.now_ns()
        self._writer.event("start", now_ns)
        if self._started_ns is None:
            self._started_ns = now_ns
            self._writer.keep()
        self._to_set_up = False
        self._state = "recording"

    def _configure(self) -> None:
        osr, streams = self._options.osr, self._requests.identified().streams.values()
        differing = [stream for stream in streams if osr is not None and stream.osr not in (0, osr)]
        for stream in differing:
            self._requests.ask(CONFIGURE, stream.id, osr)
        if differing:
            self._requests.ask(IDENTIFY)  # period and group delay depend on the osr
        self._writer.metadata("box", {"ident": json.dumps(self._requests.identified().document)})

    def _check_end(self) -> None:
        if self._state == "stopping":
            return
        if self._interrupted():
            raise _Ended("interrupted")
        if self._take_wishes():
            raise _Ended("operator")
        if self._robot is not None:
            self._check_robot(self._robot)
        duration_s = self._options.duration_s
        if self._started_ns is not None and duration_s is not None and self._elapsed_s() >= duration_s:
            raise _Ended("duration")

    def _take_wishes(self) -> bool:
        """Write the operator's events; return whether the recording is to end."""
        wishes = self._operator.wishes()
        for wish in wishes:
            if wish.kind != "end":
                self._writer.event(wish.kind, self._clock.now_ns(), **wish.fields)
        return any(wish.kind == "end" for wish in wishes)

    def _check_robot(self, robot: RobotIntake) -> None:
        away_ns = self._clock.now_ns() - robot.lost_ns
        if robot.lost is not None and (robot.ended or away_ns > self._patience_ns):
            text = "" if robot.ended else f"; it did not come back within {self._patience_ns / SECOND:g} s"
            raise _Ended("robot closed" if robot.closed else "robot lost", f"{robot.lost}{text}")
        if self._elapsed_s() >= ROBOT_NS / SECOND and not self._counters.robot_lines and robot.lost is None:
            sent = f"; it sent {quoted(robot.unread.decode(errors='replace'))}" if robot.unread else ""
            raise _Ended(
                "no readings", f"no joint reading from the robot within {ROBOT_NS / SECOND:g} s{sent}; {EXPECTED}"
            )

    def _reconnect(self, error: LinkError) -> None:
        now_ns = self._clock.now_ns()
        self._box.flush()
        if self._box.ident is None:
            raise error  # it never answered: do not wait for it
        self._state = "link lost"
        self._counters.link_losses += 1
        self._writer.event("link-lost", now_ns, text=str(error))
        self._box_gone = str(error)
        if not isinstance(self._link, Reopenable):
            raise _Ended("link lost", str(error))
        while not self._link.reopen(REOPEN_S):
            if self._clock.now_ns() - now_ns > self._patience_ns:
                raise _Ended("link lost", f"{error}; it did not come back within {self._patience_ns / SECOND:g} s")
            if self._robot is not None:
                self._robot.take_until(self._clock.now_ns() + ROBOT_SHARE_NS)
            self._chores(self._clock.now_ns())
            self._check_end()
        self._box.heard_ns = self._clock.now_ns()
        self._writer.event("link-back", self._box.heard_ns, device=self._link.name)
        self._box_gone = ""
        self._box.suspect = True  # it may have restarted, or be another one
        self._state = "recording"

    def _finish(self, end: _Ended) -> None:
        """Stop the box, store what waits, and complete the file, whatever else fails."""
        try:
            self._stop()
            end_ns = self._clock.now_ns() + WAITING_NS  # of a robot that never ceases, not everything can be stored
            while self._robot is not None and self._clock.now_ns() < end_ns and self._robot.take_until(end_ns):
                pass
        except KeyboardInterrupt:
            pass
        finally:
            now_ns = self._clock.now_ns()
            self._box.flush()
            if self._robot is not None:
                self._robot.flush(now_ns)
                self._robot_gone = self._robot.absence(now_ns)
                waiting = self._robot.backlog.waiting
                self._counters.robot_unstored = waiting if waiting > USUAL_WAITING else 0
            self._box.expire(now_ns, 0)
            self._count_backlogs()
            self._take_wishes()
            self._writer.event("stop", now_ns, reason=end.reason, text=end.text)
            counters = {name: str(value) for name, value in vars(self._counters).items()}
            self._writer.close({"reason": end.reason, **counters})

    def _stop(self) -> None:
        if self._box.ident is None or self._state == "link lost":
            return
        self._state = "stopping"
        try:
            with suppress(RefusedError):
                self._requests.ask(STOP, retries=STOP_RETRIES)
            deadline_ns = self._clock.now_ns() + DRAIN_NS
            while (left_ns := deadline_ns - self._clock.now_ns()) > 0:
                self._pump(left_ns)
        except LinkError as exc:  # received data is kept; the next recorder stops the box first
            if not self._box_gone:
                self._box_gone = str(exc)
                self._writer.event("box-gone", self._clock.now_ns(), text=self._box_gone, heard_ns=self._box.spoke_ns)

    # --- the loop

    def _await(self, timeout_s: float) -> None:
        self._check_end()
        self._pump(round(timeout_s * SECOND))

    def _pump(self, timeout_ns: int) -> None:
        now_ns = self._clock.now_ns()
        if now_ns >= self._next_chores_ns:
            self._chores(now_ns)
        # Never so short that a clock with whole units would not advance.
        timeout_s = max(min(timeout_ns, CHORES_NS), SHORTEST_NS) / SECOND
        robot = self._robot
        arrivals = self._link.read(0.0 if robot is not None and robot.backlog.waiting else timeout_s)
        end_ns = self._clock.now_ns() + ROBOT_SHARE_NS
        for t_host_ns, data in arrivals:
            if robot is not None:
                robot.take_until(end_ns, t_host_ns)
            self._box.take(t_host_ns, data)
        if robot is not None:
            robot.take_until(end_ns)

    def _chores(self, now_ns: int) -> None:
        self._next_chores_ns = now_ns + CHORES_NS
        self._writer.tick(now_ns)
        for text in self._writer.losses[self._file_losses :]:
            self._file_losses += 1
            self._writer.event("file-lost", now_ns, text=text)
        self._box.expire(now_ns)
        if self._robot is not None:
            self._robot.watch(now_ns)
        if self._state == "recording":
            self._watch_silence(now_ns)
            if now_ns >= self._next_probe_ns:
                self._probe(now_ns)
        if now_ns >= self._next_progress_ns:
            self._next_progress_ns = now_ns + PROGRESS_NS
            self._count_backlogs()
            self._operator.status(self._status(now_ns))

    def _probe(self, now_ns: int) -> None:
        self._next_probe_ns = max(self._next_probe_ns + PROBE_NS, now_ns)
        probe, data = self._requests.make(SYNC_REQUEST)
        self._box.asked(probe, self._link.write(data))

    def _watch_silence(self, now_ns: int) -> None:
        heard_ns = self._box.heard_ns
        silent = heard_ns is not None and now_ns - heard_ns > SILENCE_NS
        if silent != self._silent:
            self._silent = silent
            self._writer.event("box-silent" if silent else "box-heard", now_ns, heard_ns=heard_ns)

    def _elapsed_s(self) -> float:
        return 0.0 if self._started_ns is None else (self._clock.now_ns() - self._started_ns) / SECOND

    def _count_backlogs(self) -> None:
        self._counters.held_up = backlog_of(self._link).held_up
        self._counters.robot_held_up = 0 if self._robot is None else self._robot.backlog.held_up

    def _status(self, now_ns: int) -> Status:
        robot = self._robot
        return Status(
            self._elapsed_s(),
            self._state,
            self._box.rtt_us,
            None if robot is None else robot.lost is None,
            Counters(**vars(self._counters)),  # a copy: it may be displayed later, next to the state of this moment
            self._box.faults,
            self._state != "link lost" and not self._silent,
            None if robot is None else robot.age_s(now_ns),
            tuple(self._writer.losses),
            robot is not None and robot.backlog.waiting > 0,
            robot is not None and robot.closed,
        )
