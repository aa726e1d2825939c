"""Joint readings, batch by batch → the robot's clock and short bins that dwells are found in.

A session may hold ten million readings. Of 50 ms of them only count, mean, extremes and scatter are kept: 0.3 kB a bin for six joints, 80 MB
for six hours.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from truearm.session.joint_batch import COLUMNS, JOINTS, JointBatch, concatenate, parse_lines, unpack
from truearm.session.joint_line import UNNUMBERED
from truearm.session.message_columns import Messages
from truearm.session.missing_numbers import MissingNumbers
from truearm.session.robot_clock import Arrivals, RobotClock, RobotClockReport, fit_robot_clock
from truearm.session.robot_inputs import InputTrack
from truearm.types import Floats, Message

CHUNK = 2048  # readings taken at a time
BIN_S = 0.05
READING_GAP_S = 0.25  # without a reading for so long nobody knows whether the robot stood still
NOTED_S = 1.0  # readings that lie further apart in the middle were taken down one by one
LATE_S = 1.0  # time this little backward is a datagram overtaken by another; more is a restart
FINEST_STEP = 1e-9  # rad or m; smaller differences are arithmetic, not an encoder
COARSEST_STEP = 1e-3  # rad or m; no encoder worth calibrating is coarser


@dataclass(frozen=True)
class Bins:
    """Readings in bins (b,), in order; ``gap`` where readings are missing before a bin or another segment begins."""

    segment: NDArray[np.int64]
    t_first_s: Floats
    t_last_s: Floats
    n: NDArray[np.int64]
    mean: Floats  # (b, j)
    low: Floats  # (b, j)
    high: Floats  # (b, j)
    scatter: NDArray[np.float32]  # (b, j, j) sums of products of deviations from the bin's mean
    gap: NDArray[np.bool_]
    commanded: Floats  # (b, j) mean of the commanded joints, NaN where a reading has none; the rest is of the measured


@dataclass(frozen=True)
class JointStream:
    """What the robot sent. ``step``: smallest change (or change of a change) of each joint, its quantisation."""

    readings: int
    malformed: int
    duplicated: int
    late: int
    lost: int | None  # gaps of seq; None (not known) where readings have none
    gaps: int  # places where no reading came for longer than READING_GAP_S
    restarts: int
    rate_hz: float  # NaN with fewer than two readings
    step: Floats  # (j,)
    bins: Bins | None  # None without a reading
    clocks: tuple[RobotClock, ...]
    reports: tuple[RobotClockReport, ...]
    inputs: tuple[InputTrack, ...]  # of each segment


_BACK = b'"kind":"robot-back"'


class JointReader:
    """Takes the robot's messages one by one in log order."""

    def __init__(self) -> None:
        self._lines: list[bytes] = []  # behind the last batch
        self._arrival_ns: list[int] = []
        self._batches: list[JointBatch] = []
        self._waiting = 0  # readings in them
        self._arrivals: list[Arrivals] = []
        self._inputs: list[InputTrack] = []
        self._bins: list[tuple[Any, ...]] = []
        self._carried: tuple[NDArray[Any], ...] | None = None  # readings of the bin that is still open
        self._last: tuple[float, int] | None = None
        self._latest_s = -np.inf
        self._joints: int | None = None
        self._previous_bin_s = -np.inf
        self._bin_s, self._gap_s = BIN_S, READING_GAP_S
        self._step: Floats = np.empty(0)  # smallest change between readings
        self._fast_step: Floats = np.empty(0)  # smallest change of a change
        self._numbered = True
        self._returned = False  # the link was lost and is back: the next reading begins a segment
        self._holes = MissingNumbers()
        self.malformed = self.duplicated = self.late = self.gaps = 0

    def feed(self, message: Message) -> None:
        """Take one message; those of other topics are ignored."""
        if message.topic == "/events" and _BACK in message.data:
            self._flush()
            self._returned = True
        if message.topic == JOINTS:
            self._lines.append(message.data)
            self._arrival_ns.append(message.t_host_ns)
            if len(self._lines) >= CHUNK:
                self._flush()
        elif message.topic == COLUMNS:
            batch = unpack(message.data)
            if batch is not None and len(batch) == len(self._lines):
                self._lines, self._arrival_ns = [], []
                self._wait(batch)

    def take(self, messages: Messages) -> None:
        """Take a batch of messages; those of other topics are ignored."""
        lines = messages.rows(lambda topic: topic == JOINTS)
        begin = 0
        for row in messages.rows(lambda topic: topic in (COLUMNS, "/events")).tolist():
            end = int(np.searchsorted(lines, row))
            if len(self._lines) + end - begin >= CHUNK:
                self._add(messages, lines[begin:end])
                begin = end
            if messages.topics[messages.topic[row]] == COLUMNS:
                said = unpack(messages.payload(row))
                if said is not None and len(said) == len(self._lines) + end - begin:
                    self._lines, self._arrival_ns, begin = [], [], end
                    self._wait(said)
            elif _BACK in messages.payload(row):
                self._add(messages, lines[begin:end])
                self._flush()
                self._returned, begin = True, end
        self._add(messages, lines[begin:])

    def _add(self, messages: Messages, rows: NDArray[np.intp]) -> None:
        at = 0
        while at < len(rows):
            some = rows[at : at + CHUNK - len(self._lines)]
            self._lines += messages.payloads(some)
            self._arrival_ns += messages.t_host_ns[some].tolist()
            at += len(some)
            if len(self._lines) >= CHUNK:
                self._flush()

    def finish(self) -> JointStream:
        """What all messages say; the reader is of no use afterwards."""
        self._flush()
        self._close_bin()
        fits = [fit_robot_clock(k, arrivals) for k, arrivals in enumerate(self._arrivals)]
        readings = sum(arrivals.readings for arrivals in self._arrivals)
        spans = sum(arrivals.last_s - arrivals.first_s for arrivals in self._arrivals)
        return JointStream(
            readings=readings,
            malformed=self.malformed,
            duplicated=self.duplicated,
            late=self.late,
            lost=self._holes.lost if self._numbered else None,
            gaps=self.gaps,
            restarts=max(0, len(self._arrivals) - 1),
            rate_hz=(readings - len(self._arrivals)) / spans if spans > 0.0 else float("nan"),
            step=_step(self._step, self._fast_step),
            bins=self._all_bins(),
            clocks=tuple(clock for clock, _ in fits),
            reports=tuple(report for _, report in fits),
            inputs=tuple(self._inputs),
        )

    def _all_bins(self) -> Bins | None:
        """All bins, column by column, so that they are in memory hardly twice."""
        columns = [list(column) for column in zip(*self._bins, strict=True)]
        self._bins = []
        joined = []
        for column in columns:
            joined.append(np.concatenate(column))
            column.clear()
        return Bins(*joined) if joined else None

    def _wait(self, batch: JointBatch) -> None:
        """Take a batch with the next ones: the first must be long enough to show the readings' period."""
        self._joints = self._joints or batch.q.shape[1]
        if batch.q.shape[1] != self._joints:
            self.malformed += len(batch)
            return
        self._batches.append(batch)
        self._waiting += len(batch)
        if self._waiting >= CHUNK:
            self._flush()

    def _flush(self) -> None:
        if self._lines:
            batch = parse_lines(self._lines, self._arrival_ns, self._joints)
            self.malformed += len(self._lines) - len(batch)
            self._lines, self._arrival_ns = [], []
            if len(batch):
                self._batches.append(batch)
        if not self._batches:
            return
        batch = concatenate(self._batches)
        self._batches, self._waiting = [], 0
        self._joints = batch.q.shape[1]
        self._numbered &= bool(np.all(batch.seq != UNNUMBERED))
        if not self._step.size:
            self._begin(batch.t, batch.q)
        for part in np.split(np.arange(len(batch)), restarts(batch.t, self._latest_s)):
            self._part(batch[part])

    def _begin(self, t: Floats, q: Floats) -> None:
        self._step = np.full(q.shape[1], np.inf)
        self._fast_step = np.full(q.shape[1], np.inf)
        period = float(np.median(np.abs(np.diff(t)))) if t.size > 1 else 0.0
        if period >= NOTED_S:  # noted one by one: each is a bin of its own, and nothing is known between them
            period = 0.0
        self._bin_s, self._gap_s = max(BIN_S, 4.0 * period), max(READING_GAP_S, 5.0 * period)

    def _part(self, batch: JointBatch) -> None:
        """Readings of one segment."""
        if not len(batch):
            return
        t, seq = batch.t, batch.seq
        if self._last is None or self._returned or t[0] < self._latest_s - LATE_S:
            if self._last is not None and self._returned and t[0] > self._latest_s and seq[0] > self._last[1]:
                self._holes.skip(self._last[1], int(seq[0]))  # the robot counted on while nobody listened
            self._returned = False
            self._close_bin()
            self._arrivals.append(Arrivals(float(t[0]), int(batch.arrival_ns[0])))
            self._inputs.append(InputTrack())
            self._latest_s, self._previous_bin_s, self._last = -np.inf, -np.inf, None
            self._holes.forget()
        highest = np.maximum.accumulate(np.concatenate([[self._latest_s], t]))
        before = np.concatenate([[self._last[1] if self._last else int(seq[0]) - 1], seq[:-1]])
        late, doubled = t < highest[:-1], (t == highest[:-1]) & (seq == before)
        keep = ~late & ~doubled
        self.late += int(np.sum(late))
        self.duplicated += int(np.sum(doubled))
        kept = seq[keep]
        self._account(seq, np.concatenate([before[:1], kept[:-1]]), late, keep)
        self._latest_s = float(highest[-1])
        if kept.size:
            self._last = (self._latest_s, int(kept[-1]))
            self._arrivals[-1].add(t[keep], batch.arrival_ns[keep])
            self._inputs[-1].add(t[keep], batch.inputs[keep])
            self._bin(t[keep], batch.q[keep], batch.q_cmd[keep])

    def _account(
        self, seq: NDArray[np.int64], previous: NDArray[np.int64], late: NDArray[np.bool_], keep: NDArray[np.bool_]
    ) -> None:
        """Count what is missing, in order of arrival; ``previous`` (k,): the number before each kept one."""
        before = seq.copy()
        before[keep] = previous[: int(np.sum(keep))]
        for i in np.flatnonzero(late | (keep & (seq - 1 > before))):
            if late[i]:
                self._holes.fill(int(seq[i]))
            else:
                self._holes.skip(int(before[i]), int(seq[i]))

    def _bin(self, t: Floats, q: Floats, q_cmd: Floats) -> None:
        if self._carried is not None:
            t, q, q_cmd = (np.concatenate(pair) for pair in zip(self._carried, (t, q, q_cmd), strict=True))
        self._step = np.minimum(self._step, _smallest(np.diff(q, axis=0)))
        self._fast_step = np.minimum(self._fast_step, _smallest(np.diff(q, n=2, axis=0)))
        key = np.floor((t - self._arrivals[-1].t_ref_s) / self._bin_s)
        closed = int(np.searchsorted(key, key[-1]))
        self._carried = (t[closed:], q[closed:], q_cmd[closed:])
        if closed:
            self._store(t[:closed], q[:closed], q_cmd[:closed], key[:closed])

    def _close_bin(self) -> None:
        if self._carried is not None:
            t, q, q_cmd = self._carried
            self._store(t, q, q_cmd, np.zeros(t.size))
        self._carried = None

    def _store(self, t: Floats, q: Floats, q_cmd: Floats, key: Floats) -> None:
        starts = np.flatnonzero(np.concatenate([[True], np.diff(key) > 0]))
        n = np.diff(np.concatenate([starts, [t.size]]))
        mean, commanded = (np.add.reduceat(joints, starts, axis=0) / n[:, None] for joints in (q, q_cmd))
        deviation = q - np.repeat(mean, n, axis=0)
        scatter = np.add.reduceat(deviation[:, :, None] * deviation[:, None, :], starts, axis=0)
        # A gap may also lie inside a bin where bins are long; it then counts before the bin.
        silent = np.diff(np.concatenate([[self._previous_bin_s], t])) > self._gap_s
        gap = np.logical_or.reduceat(silent, starts)
        self.gaps += int(np.sum(silent)) - int(np.isinf(self._previous_bin_s))
        self._previous_bin_s = float(t[-1])
        low, high = np.minimum.reduceat(q, starts, axis=0), np.maximum.reduceat(q, starts, axis=0)
        segment = np.full(starts.size, len(self._arrivals) - 1)
        last = np.concatenate([starts[1:], [t.size]]) - 1
        bins = (segment, t[starts], t[last], n, mean, low, high, scatter.astype(np.float32), gap, commanded)
        self._bins.append(bins)


def restarts(t: Floats, latest_s: float) -> NDArray[np.intp]:
    """Where controller times (n,) [s] begin anew; ``latest_s``: the latest of the segment so far, -inf before the first."""
    starts = np.flatnonzero(np.diff(t) < -LATE_S) + 1
    return np.concatenate([[0], starts]) if t[0] < latest_s - LATE_S else starts


def _smallest(change: Floats) -> Floats:
    """Smallest change (j,) that is none of arithmetic, inf where there is none."""
    size = np.abs(change)
    return np.asarray(np.min(np.where(size > FINEST_STEP, size, np.inf), axis=0, initial=np.inf))


def _step(slow: Floats, fast: Floats) -> Floats:
    """The quantisation (j,) of the readings, 0 where nothing changes.

    A robot that comes to rest passes through single steps. Where none was seen slowly, how fast changes differ shows the step; but it
    shows the rounding of what is printed too, so that is the second choice: a reading of few digits would pass for a
    fine encoder.
    """
    step = np.where(slow <= COARSEST_STEP, slow, np.minimum(slow, fast))
    return np.asarray(np.where(np.isfinite(step), step, 0.0))
