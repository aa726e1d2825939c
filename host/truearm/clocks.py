"""Relate two clocks by what is known of one clock's time at stamps of the other.

Each row has a stamp x of one clock, and the earliest and latest time of the other clock at x. An exchange of messages
gives both; a message with a stamp gives the latest alone. ``fit`` returns a ``Clock``, which converts stamps to times
with bounds.

Both clocks are crystals, so their relative rate stays within ``wander`` of its mean. A row therefore bounds the time
everywhere, more loosely the farther away. ``Band`` is what all rows together leave: running minima over the rows before
and after. ``Steady`` estimates the time from the course, the rate over a minute around.

Rows that contradict each other show a step of a clock, or a wrong stamp. FEW rows in succession that agree with each
other are a step; fewer are left out.

Derivation: docs/explanation/clocks.md#how-the-fit-works.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from truearm.types import Floats, Ints

WANDER = 30e-6  # of the rate of two crystals, about its mean: temperature and ageing
SLEWED_WANDER = 530e-6  # if the operating system slews one of the clocks, by up to 500 ppm
RATE_LIMIT = 1e-3  # beyond that it is not a clock of the same unit
FOLLOWED = 1e-6  # of the rate, from that of the course: for the estimate alone
FOLLOWED_NS, COURSE_NS = 60e9, 120e9  # over which the rate is taken: for the estimate alone, and if it bounds y too
SLOPE_NS = 10e9  # baseline of the median rate, which single steps do not spoil
ROUNDS = 6  # of the course and the range
FEW = 3  # rows that are a step and not wrong
ROUNDING_NS = 2.0  # two stamps are whole ns


@dataclass(frozen=True)
class Band:
    """Rows (k,) by ascending x [ns], low ≤ y ≤ high there [ns], and the least and greatest rate of y."""

    x: Floats
    low: Floats
    high: Floats
    slow: float
    fast: float

    @cached_property
    def _cones(self) -> tuple[Floats, ...]:
        """The bounds (k + 1,), moved to x = 0 by the greatest or least rate: the best of all rows before and after."""
        x, running_minimum = self.x, np.minimum.accumulate
        return (
            np.append(np.inf, running_minimum(self.high - self.fast * x)),
            np.append(running_minimum((self.high - self.slow * x)[::-1])[::-1], np.inf),
            -np.append(np.inf, running_minimum(self.slow * x - self.low)),
            -np.append(running_minimum((self.fast * x - self.low)[::-1])[::-1], np.inf),
        )

    def range(self, t: Floats) -> tuple[Floats, Floats]:
        """Return the least and greatest y (n,) at times t (n,)."""
        k = np.searchsorted(self.x, t, side="right")
        high_before, high_after, low_before, low_after = (cone[k] for cone in self._cones)
        low = np.maximum(low_before + self.slow * t, low_after + self.fast * t)
        return low, np.minimum(high_before + self.fast * t, high_after + self.slow * t)

    def contradicts(self, rows: Band) -> NDArray[np.bool_]:
        """Return which rows of a band contradict this one."""
        low, high = self.range(rows.x)
        return np.asarray((rows.low > high + ROUNDING_NS) | (rows.high < low - ROUNDING_NS))

    def rows(self, index: NDArray[np.intp]) -> Band:
        """Return a selection of the rows."""
        return Band(self.x[index], self.low[index], self.high[index], self.slow, self.fast)

    def with_rate(self, baseline: float, wander: float) -> Band:
        """Return the rows with their median rate over a baseline [ns], or over all if they span less, ± wander."""
        low = np.where(np.isfinite(self.low), self.low, self.high)
        last = np.searchsorted(self.x, self.x + min(baseline, self.x[-1] - self.x[0]))
        first = np.flatnonzero(last < self.x.size)
        last = last[first]
        dx = self.x[last] - self.x[first]
        if not np.all(dx > 0.0):
            return Band(self.x, self.low, self.high, -RATE_LIMIT, RATE_LIMIT)
        slow = float(np.median((low[last] - self.high[first]) / dx)) - wander
        fast = float(np.median((self.high[last] - low[first]) / dx)) + wander
        if slow > RATE_LIMIT or fast < -RATE_LIMIT:
            slow, fast = -RATE_LIMIT, RATE_LIMIT
        return Band(self.x, self.low, self.high, max(slow, -RATE_LIMIT), min(fast, RATE_LIMIT))


@dataclass(frozen=True)
class Steady:
    """The rows between two steps, and their course: the y (k,) at the rows that the rates around them add up to."""

    band: Band
    course: Floats
    end_rates: tuple[float, float]  # of the course, before the first and behind the last row
    course_wander: float | None  # of the rate, from that of the course; None: unknown

    @classmethod
    def from_rows(cls, rows: Band, wander: float, course_wander: float | None) -> Steady:
        """Bound the rate by rows far apart, unless it then contradicts the rows: it is within ``wander`` of no mean.

        The rates of the course follow from y at the rows, at first the middle of the range, then the estimate. They are
        off by no more than the ranges at both ends allow.
        """
        band = rows.with_rate(0.5 * (rows.x[-1] - rows.x[0]), wander)
        band = rows if np.any(band.contradicts(band)) else band
        x = band.x
        span = FOLLOWED_NS if course_wander is None else COURSE_NS
        begin = np.clip(x - 0.5 * span, x[0], max(x[0], x[-1] - span))
        end = np.minimum(begin + span, x[-1])
        duration = np.maximum(end - begin, 1.0)
        low, high = band.range(x)
        y = _middle(low, high)
        for _ in range(2 if course_wander is None else ROUNDS):
            rate = (np.interp(end, x, y) - np.interp(begin, x, y)) / duration
            rate = np.clip(rate, band.slow, band.fast)
            course = np.append(0.0, np.cumsum(0.5 * (rate[1:] + rate[:-1]) * np.diff(x)))
            allowed = course_wander
            if course_wander is not None:
                reach = np.maximum(high - y, y - low)
                allowed = course_wander + np.max((np.interp(begin, x, reach) + np.interp(end, x, reach)) / duration)
            steady = cls(band, course, (float(rate[0]), float(rate[-1])), allowed)
            low, high = steady.range(x)
            y = np.clip(steady.estimate(x), low, high)
        return steady

    def course_at(self, t: Floats) -> Floats:
        """Return the course (n,) at times t (n,)."""
        x, (first, last) = self.band.x, self.end_rates
        beyond = first * np.minimum(t - x[0], 0.0) + last * np.maximum(t - x[-1], 0.0)
        return np.asarray(np.interp(t, x, self.course) + beyond)

    def _relative_rows(self, wander: float) -> Band:
        """Return the rows relative to the course."""
        return Band(self.band.x, self.band.low - self.course, self.band.high - self.course, -wander, wander)

    @cached_property
    def _followed(self) -> Band:
        return self._relative_rows(FOLLOWED)

    @cached_property
    def _bounded(self) -> Band | None:
        if self.course_wander is None:
            return None
        band = self._relative_rows(self.course_wander)
        return None if np.any(band.contradicts(band)) else band

    def estimate(self, t: Floats) -> Floats:
        """Return y (n,) at times t (n,), which the range has yet to limit."""
        return self.course_at(t) + _middle(*self._followed.range(t))

    def range(self, t: Floats) -> tuple[Floats, Floats]:
        """Return the least and greatest y (n,) at times t (n,)."""
        low, high = self.band.range(t)
        if self._bounded is not None:
            course, (lowest, highest) = self.course_at(t), self._bounded.range(t)
            low, high = np.maximum(low, course + lowest), np.minimum(high, course + highest)
        return low, high


def _middle(low: Floats, high: Floats) -> Floats:
    """Return the middle of ranges (n,), or their upper end if nothing bounds them below."""
    return np.where(np.isfinite(low), 0.5 * (low + high), high)


@dataclass(frozen=True)
class Step:
    """One of the clocks stepped between two stamps [ns].

    ``by_ns``: how far the time advanced relative to the stamps.
    """

    before_ns: int
    after_ns: int
    by_ns: int


@dataclass(frozen=True)
class Clock:
    """The time of one clock at stamps of another, both in ns. ``wrong``: the stamps of rows that were left out."""

    stamp_ref: int
    time_ref: int
    steady: tuple[Steady, ...]
    wrong: Ints

    def to_time(self, stamps: Ints) -> tuple[Ints, Floats]:
        """Return the times (n,) [ns] of stamps (n,) [ns] and the bounds (n,) of their errors [ns].

        A bound is infinite if nothing was sent to the clock that stamps: the times are then late by the shortest
        latency.
        """
        stamps_ns = np.asarray(stamps, dtype=np.int64) - self.stamp_ref
        t = stamps_ns.astype(float)
        y, bound = np.empty(t.shape), np.empty(t.shape)
        piece = np.searchsorted([steady.band.x[0] for steady in self.steady[1:]], t, side="right")
        for k, steady in enumerate(self.steady):
            selected = piece == k
            x = t[selected]
            low, high = steady.range(x)
            best = steady.estimate(x)
            if k + 1 < len(self.steady):  # behind the last row before a step, the time is as before it or as after it
                undecided = x > steady.band.x[-1]
                low_after, high_after = self.steady[k + 1].range(x)
                low = np.where(undecided, np.minimum(low, low_after), low)
                high = np.where(undecided, np.maximum(high, high_after), high)
                best = np.where(undecided, _middle(low, high), best)
            y[selected] = np.clip(best, low, high)
            bound[selected] = np.maximum(high - y[selected], y[selected] - low)
        return self.time_ref + stamps_ns + np.rint(y).astype(np.int64), bound + 1.0

    def relative_to_course(self, stamps: Ints, latest: Ints, earliest: Ints) -> Band:
        """Return other rows, ascending, relative to the course of this clock, which has no step."""
        (steady,) = self.steady
        x = stamps - self.stamp_ref
        course = steady.course_at(x.astype(float))
        wander = min(steady.course_wander or RATE_LIMIT, RATE_LIMIT)
        low, high = (times - self.time_ref - x - course for times in (earliest, latest))
        return Band(x.astype(float), low, high, -wander, wander)

    def to_stamp(self, times: Ints) -> Ints:
        """Return the stamps (n,) [ns] at times (n,) [ns]."""
        stamps = np.asarray(times, dtype=np.int64) - self.time_ref + self.stamp_ref
        for _ in range(4):  # rates are below 0.1 %: each turn gains three digits
            stamps = stamps - (self.to_time(stamps)[0] - times)
        return stamps

    @property
    def steps(self) -> tuple[Step, ...]:
        """Where a clock stepped, by ascending stamp."""
        steps = []
        for earlier, later in pairwise(self.steady):
            begin, end = earlier.band.x[-1], later.band.x[0]
            middle = np.array([0.5 * (begin + end)])
            by = later.estimate(middle) - earlier.estimate(middle)
            steps.append(Step(self.stamp_ref + int(begin), self.stamp_ref + int(end), int(np.rint(by[0]))))
        return tuple(steps)

    @property
    def rate(self) -> float:
        """How much faster the time runs than the stamps: the mean, without steps."""
        ends = [steady.band.x[[0, -1]] for steady in self.steady]
        rise = sum(np.diff(steady.estimate(x))[0] for steady, x in zip(self.steady, ends, strict=True))
        return float(rise / max(sum(np.diff(x)[0] for x in ends), 1.0))


def fit(
    stamps: Ints,
    latest: Ints,
    earliest: Ints | None = None,
    *,
    wander: float = WANDER,
    course_wander: float | None = None,
) -> Clock | None:
    """Relate a clock that stamps to a clock that tells the time; None without a row.

    ``stamps`` (k,) [ns], in any order. ``latest`` (k,) [ns]: a time that had not passed at the stamp, such as that of
    the arrival of a message. ``earliest`` (k,) [ns]: a time that had passed, such as that at which a request was sent.
    Without it the times are those of the fastest messages, no bound is known and no step is seen. ``wander``: WANDER,
    or SLEWED_WANDER if the operating system slews one of the clocks. ``course_wander``: how far the rate may be from
    its mean over the two minutes around, if that is known; it narrows the bound unless rows contradict it. Raises
    TypeError if a column does not hold integers, ValueError if their lengths differ.
    """
    columns = (stamps, latest, latest if earliest is None else earliest)
    rows = np.stack(columns, dtype=np.int64, casting="same_kind")
    rows = rows[:, rows[2] <= rows[1]]
    if not rows.size:
        return None
    stamps, latest, earliest_of_row = rows[:, np.argsort(rows[0], kind="stable")]
    stamp_ref, time_ref = int(stamps[0]), int(latest[0])
    x = stamps - stamp_ref
    high = (latest - time_ref - x).astype(float)
    low = np.full(x.size, -np.inf) if earliest is None else (earliest_of_row - time_ref - x).astype(float)
    baseline = min(SLOPE_NS, 0.25 * float(x[-1]))  # a step spoils no more than a third of the rates
    band = Band(x.astype(float), low, high, 0.0, 0.0).with_rate(baseline, wander)
    pieces = _without_steps(band)
    steady = tuple(Steady.from_rows(band.rows(index), wander, course_wander) for index in pieces)
    return Clock(stamp_ref, time_ref, steady, np.delete(stamps, np.concatenate(pieces)))


def _without_steps(rows: Band) -> list[NDArray[np.intp]]:
    """Return the indices of the rows between steps; those of wrong rows are in none."""
    if not np.any(rows.contradicts(rows)):
        return [np.arange(rows.x.size)]
    pieces: list[NDArray[np.intp]] = []
    for piece in _consistent_runs(rows):
        if pieces:
            preceding = pieces[-1]
            contradicting = np.flatnonzero(rows.rows(piece).contradicts(rows.rows(preceding)))
            if contradicting.size < FEW:  # these are wrong, and the clock did not step
                pieces[-1] = np.append(np.delete(preceding, contradicting), piece)
                continue
            pieces[-1] = preceding[: contradicting[-1] + 1]  # rows behind it agree with either side
        pieces.append(piece)
    return pieces


def _consistent_runs(rows: Band) -> list[NDArray[np.intp]]:
    """Return the indices of runs of rows that agree; a run ends where FEW rows in succession contradict it."""
    runs: list[list[int]] = []
    run: list[int] = []  # and rows that contradict it, each with the range that they leave at the last one
    held: list[int] = []
    run_range = held_range = (0.0, -np.inf, np.inf)
    columns = (column.tolist() for column in (rows.x, rows.low, rows.high))
    for k, row in enumerate(zip(*columns, strict=True)):
        joined = _joined(rows, run_range, row)
        if joined is not None:
            run.append(k)
            run_range, held = joined, []
            continue
        joined = _joined(rows, held_range, row) if held else None
        held, held_range = (held, joined) if joined else ([], row)
        held.append(k)
        if len(held) == FEW or len(run) < FEW:
            runs.append(run)
            run, run_range, held = held, held_range, []
    runs.append(run)
    return [np.array(run) for run in runs if len(run) >= FEW] or [np.array(run)]


def _joined(
    rows: Band, range_before: tuple[float, float, float], row: tuple[float, float, float]
) -> tuple[float, float, float] | None:
    """Return a row's range (x, low, high) within ``range_before``, carried on to its x at the slowest and fastest rate.

    None if the two do not meet.
    """
    (x_before, lowest, highest), (x, low, high) = range_before, row
    lowest, highest = lowest + rows.slow * (x - x_before), highest + rows.fast * (x - x_before)
    is_contradiction = low > highest + ROUNDING_NS or high < lowest - ROUNDING_NS
    return None if is_contradiction else (x, max(low, lowest), min(high, highest))
