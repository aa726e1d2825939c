"""Joint readings, line by line → the robot's clock and short bins that dwells are found in.

A session may hold ten million readings. Each is parsed once, and of 50 ms of them only count, mean, extremes and scatter
are kept: 0.3 kB a bin for six joints, 80 MB for six hours.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from truearm.session.joint_line import MAX_JOINTS, MAX_SEQ, MAX_T_S, are_joints, parse_reading
from truearm.session.missing_numbers import MissingNumbers
from truearm.session.robot_clock import Arrivals, RobotClock, RobotClockReport, fit_robot_clock
from truearm.session.robot_inputs import InputTrack, Ints, bits_of
from truearm.types import Floats, Message

CHUNK = 2048  # lines parsed at a time: 1.3 µs a line instead of 2.8
BIN_S = 0.05
READING_GAP_S = 0.25  # without a reading for so long nobody knows whether the robot stood still
NOTED_S = 1.0  # readings that lie further apart in the middle were taken down one by one
LATE_S = 1.0  # time this little backward is a datagram overtaken by another; more is a restart
UNNUMBERED = -MAX_SEQ  # seq of a reading that has none
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


class Parsed(NamedTuple):
    """Lines that are readings: their indices (n,), controller time (n,) [s], seq (n,) and joints (n, j) [rad or m].

    ``seq`` is UNNUMBERED where a line has none, ``q_cmd`` NaN where it has no commanded joints, ``inputs`` UNKNOWN where it has none.
    """

    rows: NDArray[np.intp]
    t: Floats
    seq: NDArray[np.int64]
    q: Floats
    q_cmd: Floats
    inputs: NDArray[np.int64]


class JointReader:
    """Takes the robot's messages one by one in log order."""

    def __init__(self) -> None:
        self._lines: list[bytes] = []
        self._arrival_ns: list[int] = []
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
        if message.topic != "/robot/joints":
            return
        self._lines.append(message.data)
        self._arrival_ns.append(message.t_host_ns)
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
            bins=Bins(*(np.concatenate(column) for column in zip(*self._bins, strict=True))) if self._bins else None,
            clocks=tuple(clock for clock, _ in fits),
            reports=tuple(report for _, report in fits),
            inputs=tuple(self._inputs),
        )

    def _flush(self) -> None:
        rows, t, seq, q, q_cmd, inputs = parse_lines(self._lines, self._joints)
        arrival = np.array(self._arrival_ns, dtype=np.int64)[rows]
        self.malformed += len(self._lines) - rows.size
        self._lines, self._arrival_ns = [], []
        if not rows.size:
            return
        self._numbered &= bool(np.all(seq != UNNUMBERED))
        if self._joints is None:
            self._begin(t, q)
        for part in np.split(np.arange(t.size), restarts(t, self._latest_s)):
            self._part(t[part], seq[part], q[part], q_cmd[part], inputs[part], arrival[part])

    def _begin(self, t: Floats, q: Floats) -> None:
        self._joints = q.shape[1]
        self._step = np.full(q.shape[1], np.inf)
        self._fast_step = np.full(q.shape[1], np.inf)
        period = float(np.median(np.abs(np.diff(t)))) if t.size > 1 else 0.0
        if period >= NOTED_S:  # noted one by one: each is a bin of its own, and nothing is known between them
            period = 0.0
        self._bin_s, self._gap_s = max(BIN_S, 4.0 * period), max(READING_GAP_S, 5.0 * period)

    def _part(self, t: Floats, seq: Ints, q: Floats, q_cmd: Floats, inputs: Ints, arrival: Ints) -> None:
        """Readings of one segment."""
        if not t.size:
            return
        if self._last is None or self._returned or t[0] < self._latest_s - LATE_S:
            if self._last is not None and self._returned and t[0] > self._latest_s and seq[0] > self._last[1]:
                self._holes.skip(self._last[1], int(seq[0]))  # the robot counted on while nobody listened
            self._returned = False
            self._close_bin()
            self._arrivals.append(Arrivals(float(t[0]), int(arrival[0])))
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
            self._arrivals[-1].add(t[keep], arrival[keep])
            self._inputs[-1].add(t[keep], inputs[keep])
            self._bin(t[keep], q[keep], q_cmd[keep])

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


def parse_lines(lines: list[bytes], joints: int | None) -> Parsed:
    """What the lines say.

    A line is malformed if ``parse_reading`` says so, or if it has another number of joints than ``joints`` (None: than the
    first).
    """
    parsed = _parse_all(lines)
    if parsed is None:
        return _parse_each(lines, joints)
    t, seq, q, q_cmd, inputs = parsed
    good = np.isfinite(t) & (t >= 0.0) & (t < MAX_T_S) & np.all(np.isfinite(q), axis=1)
    good &= (q.shape[1] == (joints or q.shape[1])) & (seq >= UNNUMBERED) & (seq < MAX_SEQ)
    return Parsed(np.flatnonzero(good), t[good], seq[good], q[good], q_cmd[good], inputs[good])


def _parse_each(lines: list[bytes], joints: int | None) -> Parsed:
    rows = [(i, row, line) for i, line in enumerate(lines) if (row := parse_reading(line)) is not None]
    width = joints or (len(rows[0][1].q) if rows else 0)
    rows = [row for row in rows if len(row[1].q) == width]
    return Parsed(
        np.array([i for i, _, _ in rows], dtype=np.intp),
        np.array([row.t for _, row, _ in rows], dtype=np.float64),
        np.array([UNNUMBERED if row.seq is None else row.seq for _, row, _ in rows], dtype=np.int64),
        np.array([row.q for _, row, _ in rows], dtype=np.float64).reshape(len(rows), width),
        _commanded([json.loads(line).get("q_cmd") for _, _, line in rows], len(rows), width),
        np.array([bits_of(json.loads(line).get("inputs")) for _, _, line in rows], dtype=np.int64),
    )


def _parse_all(lines: list[bytes]) -> tuple[Floats, Ints, Floats, Floats, Ints] | None:
    """All lines in one go; None if any of them is not as expected."""
    try:
        rows = json.loads(b"[" + b",".join(lines) + b"]")
        t, q = ([row[key] for row in rows] for key in ("t", "q"))
        columns = np.array(t), np.array([row.get("seq", UNNUMBERED) for row in rows]), np.array(q)
    except (ValueError, KeyError, TypeError, RecursionError, OverflowError):
        return None
    kinds = [column.dtype.kind for column in columns]
    if len(rows) != len(lines) or kinds[0] not in "if" or kinds[1] != "i" or kinds[2] not in "if":
        return None
    if (
        columns[0].ndim != 1
        or columns[1].ndim != 1
        or columns[2].ndim != 2
        or not 1 <= columns[2].shape[1] <= MAX_JOINTS
    ):
        return None
    q_cmd = _commanded([row.get("q_cmd") for row in rows], *columns[2].shape)
    inputs = np.array([bits_of(row.get("inputs")) for row in rows], dtype=np.int64)
    return columns[0].astype(np.float64), columns[1].astype(np.int64), columns[2].astype(np.float64), q_cmd, inputs


def _commanded(values: list[Any], n: int, width: int) -> Floats:
    """Commanded joints (n, width), NaN where a reading has none that are numbers, as many as are measured."""
    try:
        joints = np.array(values)
    except ValueError:  # some have them, some have none
        joints = np.empty(0)
    if joints.shape == (n, width) and joints.dtype.kind in "if" and np.all(np.isfinite(joints)):
        return joints.astype(np.float64)
    rows = [value if are_joints(value) and len(value) == width else [np.nan] * width for value in values]
    return np.array(rows, dtype=np.float64).reshape(n, width)
