"""Read the robot's joint readings: their order, the controller's clock and inputs, and bins for finding dwells.

Readings are lines or columns (``joint_format``). The columns of ``/robot/columns`` are used if their arrival times are
those of the lines; otherwise messages were lost or doubled, and the lines are parsed. A reading that is late (its
controller time lies before that of an earlier one) is counted and not used; it counts as lost too.

A session may hold ten million readings. For each 50 ms only count, mean, extremes and scatter are kept
(``JointReader``), those of the joints on the disk.

A reading shows the controller's inputs at its own instant (``InputTrack``). An edge lies between the last reading with
the old level and the first with the new one: two controller times, one cycle apart if no reading is missing.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections import Counter
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from truearm.session.clock import Arrivals, RobotClock, RobotClockReport, fit_robot_clock
from truearm.session.joint_format import UNNUMBERED, JointBatch, concatenate, joint_batch
from truearm.session.samples import Spool
from truearm.session.session_file import Messages
from truearm.types import Floats, Ints, Mask

MOST_CHANGES = 1_000_000  # per segment; edges cannot be distinguished in a signal faster than that


@dataclass(frozen=True)
class Changes:
    """Changes (k,) of one input in order: each lies between two controller times [s]; ``level`` is the new level."""

    before_s: Floats
    after_s: Floats
    level: NDArray[np.bool_]


@dataclass
class InputTrack:
    """Collects the changes of the inputs in one segment of controller time."""

    last: tuple[float, int] | None = None  # time and inputs of the newest reading that has them
    _times: Floats = field(default_factory=lambda: np.empty((0, 2)))  # (k, 2) before and after
    _bits: Ints = field(default_factory=lambda: np.empty((0, 2), np.int64))

    def add(self, t: Floats, bits: Ints) -> None:
        """Take readings (n,) in order of controller time [s]; ``bits`` is NO_INPUTS for readings without inputs."""
        with_inputs = bits >= 0
        t, bits = t[with_inputs], bits[with_inputs]
        if not t.size:
            return
        if self.last is not None:
            t, bits = np.append(self.last[0], t), np.append(self.last[1], bits)
        self.last = (float(t[-1]), int(bits[-1]))
        changed = np.flatnonzero((bits[1:] != bits[:-1]) & (t[1:] > t[:-1]))[:, None] + [0, 1]
        self._times = np.concatenate([self._times, t[changed]])[:MOST_CHANGES]
        self._bits = np.concatenate([self._bits, bits[changed]])[:MOST_CHANGES]

    def inputs(self) -> list[int]:
        """Return the inputs that changed, ascending."""
        changed = int(np.bitwise_or.reduce(self._bits[:, 0] ^ self._bits[:, 1]))
        return [k for k in range(63) if changed >> k & 1]

    def changes(self, number: int) -> Changes:
        """Return the changes of one input."""
        level = self._bits >> number & 1 == 1
        rows = level[:, 0] != level[:, 1]
        return Changes(self._times[rows, 0], self._times[rows, 1], level[rows, 1])


CHUNK = 2048  # readings that show the period
BIN_S = 0.05
READING_GAP_S = 0.25  # after such a gap it is not known whether the robot stood still
NOTED_S = 1.0  # a larger median interval means that the readings were noted one by one
MOST_SEGMENTS = 1000  # a controller does not restart more often: its times are none, and later ones are late
LATE_S = 1.0  # a smaller step back in time is a datagram overtaken by another, a larger one a restart
FINEST_STEP = 1e-9  # rad or m; smaller differences are rounding errors, not an encoder
COARSEST_STEP = 1e-3  # rad or m; upper limit for an encoder worth calibrating
NO_SPAN = (0, 0.0, 0.0)  # the bins' joints are loaded by number, never by time


class BinJoints(NamedTuple):
    """Measured joints in bins (b, j), but for ``mean`` in single precision."""

    mean: NDArray[Any]
    below: NDArray[Any]  # mean less the least
    above: NDArray[Any]  # the greatest less the mean
    scatter: NDArray[Any]  # sums of squares of deviations from the mean


class BinTimes(NamedTuple):
    """When readings in bins (b,) were made.

    ``gap``: readings are missing before the bin, or another segment begins with it.
    """

    segment: NDArray[Any]
    t_first_s: NDArray[Any]
    t_last_s: NDArray[Any]
    n: NDArray[Any]
    gap: NDArray[Any]


class Bins:
    """Readings in bins (b,), in order: ``times`` in memory, and the joints on the disk."""

    def __init__(self) -> None:
        self._times, self._begins, self._joints = list[BinTimes](), [0], Spool()

    def append(self, times: BinTimes, joints: BinJoints) -> None:
        """Add bins, before ``times`` is read."""
        self._times.append(times)
        self._begins.append(len(self) + len(times.n))
        self._joints.append(joints, NO_SPAN)

    def __len__(self) -> int:
        return self._begins[-1]

    @cached_property
    def times(self) -> BinTimes:
        """Return the times of all bins."""
        nothing = BinTimes(*(np.empty(0, kind) for kind in (np.int32, np.float64, np.float64, np.int32, np.bool_)))
        return BinTimes(*map(np.concatenate, zip(nothing, *self._times, strict=True)))

    def joints(self, first: int, end: int) -> BinJoints:
        """Return the joints in the bins from ``first`` to before ``end``, of at least one bin."""
        batches = range(bisect_right(self._begins, first) - 1, bisect_left(self._begins, end))
        cut = (
            [c[max(0, first - self._begins[k]) : end - self._begins[k]] for c in self._joints.load(k)] for k in batches
        )
        return BinJoints(*(c[0] if len(c) == 1 else np.concatenate(c) for c in zip(*cut, strict=True)))

    def means(self) -> Floats:
        """Return the means (b, j) of the joints in all bins, of at least one."""
        return np.concatenate([self._joints.load(k)[0] for k in range(len(self._times))])

    def joint(self, joint: int) -> BinJoints:
        """Return one joint (b,) in all bins, of at least one."""
        batches = ([column[:, joint].copy() for column in self._joints.load(k)] for k in range(len(self._times)))
        return BinJoints(*map(np.concatenate, zip(*batches, strict=True)))


@dataclass(frozen=True)
class JointStream:
    """The robot's data. ``step``: smallest change (or change of a change) of each joint, its quantisation."""

    readings: int
    malformed: int
    duplicated: int
    late: int
    lost: int | None  # gaps of seq; None (unknown) if readings have none
    gaps: int  # times without a reading for longer than READING_GAP_S
    restarts: int
    rate_hz: float  # NaN with fewer than two readings
    step: Floats  # (j,)
    bins: Bins
    clocks: tuple[RobotClock, ...]
    reports: tuple[RobotClockReport, ...]
    inputs: tuple[InputTrack, ...]  # of each segment
    all_readings: Spool

    def to_host_ns(self, segment: NDArray[np.integer[Any]], t_s: Floats) -> Ints:
        """Return host times of controller times (n, …) [s] in these segments (n,)."""
        host = np.empty(t_s.shape, np.int64)
        for k in np.unique(segment).tolist():
            host[segment == k] = self.clocks[k].to_host_ns(t_s[segment == k])
        return host

    def between(self, segment: int, start_s: float, end_s: float) -> tuple[Floats, Ints, Floats]:
        """Return the readings of a segment between two controller times, of those that were kept.

        These are controller times (n,) [s], numbers (n,) and joints (n, j).
        """
        spans = enumerate(self.all_readings.spans)
        batches = [self.all_readings.load(k) for k, (s, a, b) in spans if s == segment and a <= end_s and b >= start_s]
        nothing = np.empty(0), np.empty(0, np.int64), np.empty((0, len(self.step)))
        t, seq, q = map(np.concatenate, zip(nothing, *batches, strict=True))
        inside = (t >= start_s) & (t <= end_s)
        return t[inside], seq[inside], q[inside]


_BACK = b'"kind":"robot-back"'


class SegmentedReadings:
    """Divides the robot's readings into segments: the robot came back, or its controller restarted.

    Each call returns the batches that are due, and the number of the segment of each.
    """

    def __init__(self, joints: int | None = None) -> None:
        """``joints``: number of joints per reading; None: as in the first."""
        self.malformed = 0
        self.bin_s = self.gap_s = 0.0  # by the median interval between the first readings; 0 before
        self._joints = joints
        self._batches: list[JointBatch] = []  # too few yet
        self._returns_ns: list[int] = []  # when the link was back: the next reading begins a segment
        self._latest_s = -np.inf  # of the segment
        self._segments = 0

    def take(self, messages: Messages) -> list[tuple[int, JointBatch]]:
        """Take a batch of messages; those of other topics are ignored."""
        events = messages.rows("/events".__eq__)
        self._returns_ns += [int(messages.t_host_ns[k]) for k in events.tolist() if _BACK in messages.payload(k)]
        batch, malformed = joint_batch(messages, self._joints)
        self.malformed += malformed
        if not len(batch):
            return []
        self._joints = batch.q.shape[1]
        self._batches.append(batch)
        return self.finish() if self.bin_s or sum(map(len, self._batches)) >= CHUNK else []

    def finish(self) -> list[tuple[int, JointBatch]]:
        """Return the remaining readings at the end of the session."""
        if not self._batches:
            return []
        batch, self._batches = concatenate(self._batches), []
        if not self.bin_s:
            period_s = float(np.median(np.abs(np.diff(batch.t)))) if len(batch) > 1 else 0.0
            period_s = period_s if period_s < NOTED_S else 0.0  # noted one by one: each is a bin of its own
            self.bin_s, self.gap_s = max(BIN_S, 4.0 * period_s), max(READING_GAP_S, 5.0 * period_s)
        back = [t_ns for t_ns in self._returns_ns if t_ns <= batch.arrival_ns[-1]]
        self._returns_ns = self._returns_ns[len(back) :]
        first = [0] if self._segments == 0 else []
        restarts = np.flatnonzero(np.diff(batch.t, prepend=self._latest_s) < -LATE_S)
        rows = [*first, *np.searchsorted(batch.arrival_ns, back).tolist(), *restarts.tolist()]
        begins = sorted(set(rows))[: MOST_SEGMENTS - self._segments]
        cuts = pairwise(sorted({0, *begins, len(batch)}))
        pieces = [(self._segments - 1 + bisect_right(begins, start), batch[start:end]) for start, end in cuts]
        self._segments += len(begins)
        self._latest_s = max(float(pieces[-1][1].t.max()), -np.inf if begins else self._latest_s)
        return pieces


class JointReader:
    """Processes the robot's messages batch by batch in log order."""

    def __init__(self) -> None:
        self.keeps = False  # keep all readings from now on, and not only bins of them
        self._all_readings = Spool()
        self._order = SegmentedReadings()
        self._arrivals: list[Arrivals] = []
        self._inputs: list[InputTrack] = []
        self._bins = Bins()
        self._carried: tuple[NDArray[Any], ...] | None = None  # readings of the open bin
        self._last_seq: int | None = None  # of the segment
        self._previous_bin_s = -np.inf
        self._step: Floats = np.empty(0)  # smallest change between readings
        self._fast_step: Floats = np.empty(0)  # smallest change of a change
        self._numbered = True
        self._count: Counter[str] = Counter()

    def take(self, messages: Messages) -> None:
        """Take a batch of messages; those of other topics are ignored."""
        for segment, batch in self._order.take(messages):
            self._take(segment, batch)

    def finish(self) -> JointStream:
        """Return the data of all messages; the reader cannot be used afterwards."""
        for segment, batch in self._order.finish():
            self._take(segment, batch)
        self._close_bin()
        fits = [fit_robot_clock(k, arrivals) for k, arrivals in enumerate(self._arrivals)]
        readings = sum(report.readings for _, report in fits)
        spans = sum(report.t_robot_s[1] - report.t_robot_s[0] for _, report in fits)
        return JointStream(
            readings=readings,
            malformed=self._order.malformed,
            **{name: self._count[name] for name in ("duplicated", "late", "gaps")},
            lost=self._count["lost"] if self._numbered else None,
            restarts=max(0, len(self._arrivals) - 1),
            rate_hz=(readings - len(self._arrivals)) / spans if spans > 0.0 else float("nan"),
            step=_step(self._step, self._fast_step),
            bins=self._bins,
            clocks=tuple(clock for clock, _ in fits),
            reports=tuple(report for _, report in fits),
            inputs=tuple(self._inputs),
            all_readings=self._all_readings,
        )

    def _take(self, segment: int, batch: JointBatch) -> None:
        """Take readings of one segment."""
        if not self._step.size:
            self._step = self._fast_step = np.full(batch.q.shape[1], np.inf)
        self._numbered &= bool(np.all(batch.seq != UNNUMBERED))
        t, seq = batch.t, batch.seq
        if segment == len(self._arrivals):
            if self._last_seq is not None and t[0] > self._arrivals[-1].last_s and seq[0] > self._last_seq:
                # the robot continued counting while nobody listened
                self._count["lost"] += int(seq[0]) - self._last_seq - 1
            self._close_bin()
            self._arrivals.append(Arrivals(float(t[0]), int(batch.arrival_ns[0])))
            self._inputs.append(InputTrack())
            self._previous_bin_s, self._last_seq = -np.inf, None
        arrivals = self._arrivals[-1]
        highest = np.maximum.accumulate(np.append(arrivals.last_s, t))
        number_before = np.append(seq[0] - 1 if self._last_seq is None else self._last_seq, seq[:-1])
        late, doubled = t < highest[:-1], (t == highest[:-1]) & (seq == number_before)
        keep = ~late & ~doubled
        self._count["late"] += int(np.sum(late))
        self._count["duplicated"] += int(np.sum(doubled))
        batch = batch[keep]
        t, seq = batch.t, batch.seq
        self._count["lost"] += int(np.maximum(np.diff(seq, prepend=number_before[0]) - 1, 0).sum())
        if not len(batch):
            return
        self._last_seq = int(seq[-1])
        arrivals.add(t, batch.arrival_ns)
        if "inputs" in batch.columns:
            self._inputs[-1].add(t, batch.columns["inputs"])
        self._bin(t, batch.q)
        if self.keeps:
            self._all_readings.append((t, seq, batch.q), (segment, float(t[0]), arrivals.last_s))

    def _bin(self, t: Floats, q: Floats) -> None:
        if self._carried is not None:
            t, q = (np.concatenate(pair) for pair in zip(self._carried, (t, q), strict=True))
        self._step = np.minimum(self._step, _smallest(np.diff(q, axis=0)))
        self._fast_step = np.minimum(self._fast_step, _smallest(np.diff(q, n=2, axis=0)))
        key = np.floor((t - self._arrivals[-1].t_ref_s) / self._order.bin_s)
        closed = int(np.searchsorted(key, key[-1]))
        self._carried = (t[closed:], q[closed:])
        if closed:
            self._store(t[:closed], q[:closed], key[:closed])

    def _close_bin(self) -> None:
        if self._carried is not None:
            t, q = self._carried
            self._store(t, q, np.zeros(t.size))
        self._carried = None

    def _store(self, t: Floats, q: Floats, key: Floats) -> None:
        silent = np.diff(t, prepend=self._previous_bin_s) > self._order.gap_s
        self._count["gaps"] += int(np.sum(silent)) - int(np.isinf(self._previous_bin_s))
        self._previous_bin_s = float(t[-1])
        self._bins.append(*binned(len(self._arrivals) - 1, t, q, key, silent))


def binned(segment: int, t: Floats, q: Floats, key: Floats, silent: Mask) -> tuple[BinTimes, BinJoints]:
    """Return readings q (n, j) at times t (n,) [s] in bins, one for each value of ``key`` (n,), which rises.

    ``silent`` (n,): readings are missing before this one. Inside a bin, that counts as before it.
    """
    starts = np.flatnonzero(np.diff(key, prepend=-np.inf))
    n = np.diff(starts, append=t.size)
    mean = np.add.reduceat(q, starts, axis=0) / n[:, None]
    low, high = np.minimum.reduceat(q, starts, axis=0), np.maximum.reduceat(q, starts, axis=0)
    squares = np.add.reduceat((q - np.repeat(mean, n, axis=0)) ** 2, starts, axis=0)
    below, above, scatter = (column.astype(np.float32) for column in (mean - low, high - mean, squares))
    numbers = np.full(n.size, segment, np.int32)
    gap = np.logical_or.reduceat(silent, starts)
    times = BinTimes(numbers, t[starts], t[starts + n - 1], n.astype(np.int32), gap)
    return times, BinJoints(mean, below, above, scatter)


def _smallest(change: Floats) -> Floats:
    """Return the smallest change (j,) that is not a rounding error, inf if there is none."""
    size = np.abs(change)
    return np.asarray(np.min(np.where(size > FINEST_STEP, size, np.inf), axis=0, initial=np.inf))


def _step(slow: Floats, fast: Floats) -> Floats:
    """Return the quantisation (j,) of the readings, 0 if nothing changes.

    A robot that comes to rest passes through single steps. If no slow motion was seen, the differences between fast
    changes show the step. They also show the rounding of the printed numbers, so this is only the fallback: otherwise a
    reading with few digits would pass for a fine encoder.
    """
    step = np.where(slow <= COARSEST_STEP, slow, np.minimum(slow, fast))
    return np.asarray(np.where(np.isfinite(step), step, 0.0))
