r"""What exchanges allow of the host's time at any device time, also where a clock steps or is slewed (hop 4).

An exchange k says l_k ≤ y(x_k) ≤ u_k of y = host − device at device time x_k. Where y′ stays within a known range [lo, hi], each exchange bounds y at
any other time t as well: above by u_k + ∫hi from x_k to t for t behind it and by u_k − ∫lo from t to x_k before it, below likewise. That is sure only while
nothing steps, so never more than SPAN consecutive exchanges are asked together: a **window**. At t the answers of all windows that
touch t (they hold the exchange before t or the one after it) are united. A window allows the intersection of what its exchanges allow; where
that is empty for any two of them, the clock was not steady in it: it is refuted and not asked.

**The range of rates.** y′ lies within WANDER, 30 ppm, of the usual rate, which may change slowly or for good: the median of the slopes over 10 s
within two minutes about t, which neither steps nor slews that last for less than half of the time can move. Where it does change, the range spans the
medians of half a minute before and after. To that comes how well exchanges show a rate at all: their round trip over the time that the slopes cover.
About the first and last SPAN exchanges there are no others on one side, which would show that the rate was another there: the range also holds all
rates that the outer 10 s allow.

**What is claimed.** The bound holds at t if

1. t lies in a stretch of SPAN exchanges in which the rate is within its range: one of the united windows then lies wholly in it, whatever happened before
   and after, and whether it shows or not; or
2. both clocks depart from that only one way about t (a slew): then the windows wholly before t bound y on one side, those wholly behind it on the other; or
3. some window that touches t is refuted: then only two consecutive exchanges are asked together, and of the rate only that it is below 1000 ppm; and if two of those
   contradict each other, each by itself.

What remains is a stretch of fewer than SPAN exchanges, between two steps against each other or between a step and the first or last exchange, that contradicts no other
exchange, or holds none: nothing can show it.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from truearm.session.clock_windows import RATE_LIMIT, TICK_US, Ints
from truearm.types import Floats

WANDER = 30e-6  # a clock's rate stays within this of what it usually is
SPAN = 8  # exchanges asked together
SLOPE_NS = 10e9  # over which the usual rate is looked at
USUAL_NS = 120e9  # to both sides of the time that it is for
BLOCK_NS = 30e9  # for which one usual rate holds
LEAST_SLOPES = 8  # to both sides, where exchanges are sparse
ROUNDING_NS = 2.0  # two stamps are whole ns
AT_ONCE = 16384  # times


class Rates(NamedTuple):
    """Lowest and highest y′ from each node [ns] to the next, and their integrals up to the nodes [ns]."""

    node: Floats
    low: Floats
    high: Floats
    low_sum: Floats
    high_sum: Floats

    @classmethod
    def of(cls, node: Floats, low: Floats, high: Floats) -> Rates:
        """From rates that hold from each node (b,) on; the first also before."""
        sums = [np.concatenate([[0.0], np.cumsum(rate[:-1] * np.diff(node))]) for rate in (low, high)]
        return cls(node, low, high, *sums)

    def integrals(self, t: Floats) -> tuple[Floats, Floats]:
        """∫low and ∫high from the first node to times (n,) [ns]."""
        k = np.maximum(np.searchsorted(self.node, t, side="right") - 1, 0)
        since = t - self.node[k]
        return self.low_sum[k] + self.low[k] * since, self.high_sum[k] + self.high[k] * since


def usual_rates(x: Floats, low: Floats, high: Floats) -> Rates:
    """The range of y′ about what it usually is, of exchanges low ≤ y(x) ≤ high (n,)."""
    far = np.minimum(np.searchsorted(x, x + min(SLOPE_NS, 0.5 * (x[-1] - x[0]))), x.size - 1)
    near = np.flatnonzero(x[far] > x)
    if not near.size:
        return Rates.of(x[:1], np.full(1, -RATE_LIMIT), np.full(1, RATE_LIMIT))
    far, middle = far[near], 0.5 * (low + high)
    slope, at = (middle[far] - middle[near]) / (x[far] - x[near]), 0.5 * (x[near] + x[far])
    node = x[0] + BLOCK_NS * np.unique(np.floor((x - x[0]) / BLOCK_NS))
    centre = node + 0.5 * BLOCK_NS
    here = np.searchsorted(at, centre)
    first = np.maximum(np.minimum(np.searchsorted(at, centre - USUAL_NS), here - LEAST_SLOPES), 0)
    end = np.minimum(np.maximum(np.searchsorted(at, centre + USUAL_NS), here + LEAST_SLOPES), at.size)
    usual = np.array([np.median(slope[i:j]) for i, j in zip(first, end, strict=True)])
    unsure = np.median(high - low) / (x[far[end - 1]] - x[near[first]]) + WANDER
    lowest, highest = (np.pad(rate, 1, mode="edge") for rate in (usual - unsure, usual + unsure))
    least, most = np.min(sliding_window_view(lowest, 3), axis=1), np.max(sliding_window_view(highest, 3), axis=1)
    return _with_ends(x, low, high, Rates.of(node, least, most))


def _with_ends(x: Floats, low: Floats, high: Floats, rates: Rates) -> Rates:
    """The rates with all that the outer exchanges allow for the first and last SPAN of them."""
    few = min(SPAN, x.size)
    begin_end, end_begin = x[few - 1], x[-few]
    node = np.unique(np.concatenate([rates.node, [begin_end, end_begin]]))
    of = np.searchsorted(rates.node, node, side="right") - 1
    least, most = rates.low[of], rates.high[of]
    near_end = int(np.searchsorted(x, x[0] + SLOPE_NS, side="right"))
    far_begin = int(np.searchsorted(x, x[-1] - SLOPE_NS))
    for mine, i, j in (
        (node < begin_end, np.arange(few), np.arange(max(0, near_end - few), max(near_end, few))),
        (node >= end_begin, np.arange(min(far_begin, x.size - few), min(far_begin + few, x.size)), np.arange(-few, 0)),
    ):
        possible = _possible_rates((x[i], low[i], high[i]), (x[j], low[j], high[j]))
        least[mine], most[mine] = np.minimum(least[mine], possible[0]), np.maximum(most[mine], possible[1])
    return Rates.of(node, np.clip(least, -RATE_LIMIT, RATE_LIMIT), np.clip(most, -RATE_LIMIT, RATE_LIMIT))


def _possible_rates(first: tuple[Floats, Floats, Floats], last: tuple[Floats, Floats, Floats]) -> tuple[float, float]:
    """Least and greatest rate from some exchanges (x, low, high) to others behind them; any where they contradict each other."""
    (x, low, high), (x_last, low_last, high_last) = first, last
    apart = x_last - x[:, None]
    behind = apart > 0.0
    if behind.any():
        least = float(np.max((low_last - high[:, None])[behind] / apart[behind]))
        most = float(np.min((high_last - low[:, None])[behind] / apart[behind]))
        if least <= most:
            return least, most
    return -RATE_LIMIT, RATE_LIMIT


class Cones(NamedTuple):
    """Bounds (n,) of exchanges, less what y may have changed by since the first node, at most (high) or least (low)."""

    upper_low: Floats
    upper_high: Floats
    lower_low: Floats
    lower_high: Floats

    @classmethod
    def of(cls, x: Floats, low: Floats, answered: Floats, high: Floats, rates: Rates) -> Cones:
        """Of exchanges low ≤ y(x), y(answered) ≤ high."""
        least, most = rates.integrals(x)
        least_there, most_there = rates.integrals(answered)
        high = high + np.maximum(least - least_there, most - most_there)  # at x
        return cls(high - least, high - most, low - least, low - most)

    def of_some(self, which: NDArray[np.intp]) -> Cones:
        """Those of some exchanges."""
        return Cones(*(column[which] for column in self))

    def refuted(self) -> NDArray[np.bool_]:
        """Whether two exchanges (…, m), in order of time along the last axis, leave nothing between them."""
        risen = np.maximum.accumulate(self.lower_low, axis=-1) > self.upper_low + ROUNDING_NS
        fallen = np.minimum.accumulate(self.upper_high, axis=-1) < self.lower_high - ROUNDING_NS
        return np.asarray(np.any(risen | fallen, axis=-1))


class Level(NamedTuple):
    """What windows of m of the n exchanges allow under a range of rates, in each of the n + 1 gaps before, between and behind them.

    At t in gap g, with L and H the integrals there, y is at most the largest min(upper_before + H, upper_after + L) of the windows (g, …), and
    at least the smallest max(lower_before + L, lower_after + H).
    """

    rates: Rates
    cones: Cones
    refuted: NDArray[np.bool_]  # (n − m + 1,) windows by their first exchange
    doubtful: NDArray[np.bool_]  # (n + 1,) gaps that a refuted window touches
    upper_before: Floats  # (n + 1, m + 1)
    upper_after: Floats
    lower_before: Floats
    lower_after: Floats

    @classmethod
    def of(cls, cones: Cones, rates: Rates, m: int) -> Level:
        """The windows of m consecutive exchanges."""
        n = cones.upper_low.size
        refuted = Cones(*(sliding_window_view(column, m) for column in cones)).refuted()
        if m == 1:
            refuted[:] = False  # there is nothing to ask instead
        window = np.arange(n + 1)[:, None] + np.arange(-m, 1)
        there = (window >= 0) & (window <= n - m)
        contradicts = there & refuted[np.clip(window, 0, n - m)]
        asked = there & ~contradicts
        return cls(
            rates,
            cones,
            refuted,
            contradicts.any(axis=1),
            np.where(asked, _least_before(cones.upper_high, m), -np.inf),
            np.where(asked, _least_after(cones.upper_low, m), -np.inf),
            np.where(asked, -_least_before(-cones.lower_low, m), np.inf),
            np.where(asked, -_least_after(-cones.lower_high, m), np.inf),
        )

    def at(self, t: Floats, gap: NDArray[np.intp]) -> tuple[Floats, Floats]:
        """Lowest and highest y (k,) [ns] at times (k,) in these gaps."""
        least, most = (integral[:, None] for integral in self.rates.integrals(t))
        upper = np.minimum(self.upper_before[gap] + most, self.upper_after[gap] + least)
        lower = np.maximum(self.lower_before[gap] + least, self.lower_after[gap] + most)
        return np.min(lower, axis=1), np.max(upper, axis=1)


def _least_before(values: Floats, m: int) -> Floats:
    """Least (n + 1, m + 1) of the m, m − 1 … 0 values before each gap."""
    last = sliding_window_view(np.pad(values, m, constant_values=np.inf), m)[: values.size + 1, ::-1]
    return np.pad(np.minimum.accumulate(last, axis=1)[:, ::-1], ((0, 0), (0, 1)), constant_values=np.inf)


def _least_after(values: Floats, m: int) -> Floats:
    """Least (n + 1, m + 1) of the 0, 1 … m values behind each gap."""
    return _least_before(values[::-1], m)[::-1, ::-1]


class Change(NamedTuple):
    """A clock changed between exchanges ``before`` and ``after``; those between belong to neither side."""

    before: int
    after: int


@dataclass(frozen=True)
class ClockBounds:
    """Bounds of host time that follow from the exchanges of one segment."""

    device_ref_us: int
    host_ref_ns: int
    x: Floats  # (n,) ns since device_ref_us, ascending
    levels: tuple[Level, ...]  # the first is asked, and where it is in doubt the next

    @classmethod
    def of(cls, exchanges: Ints) -> ClockBounds:
        """Of n ≥ 1 exchanges (n, 4) in order of t1."""
        t0, t1, t2, t3 = exchanges.T
        device_ref, host_ref = int(t1[0]), int(t0[0])
        received, answered = 1000 * (t1 + TICK_US - device_ref), 1000 * (t2 - device_ref)
        low, high = (t0 - host_ref - received).astype(float), (t3 - host_ref - answered).astype(float)
        x, later = received.astype(float), answered.astype(float)
        limit = Rates.of(x[:1], np.full(1, -RATE_LIMIT), np.full(1, RATE_LIMIT))
        levels = [
            Level.of(Cones.of(x, low, later, high, rates), rates, min(m, x.size))
            for m, rates in ((SPAN, usual_rates(x, low, high)), (2, limit), (1, limit))
        ]
        return cls(device_ref, host_ref, x, tuple(levels))

    def at(self, t_us: Ints) -> tuple[Ints, Floats, Floats]:
        """Host times (n,) [ns] by the first exchange and a rate of 1, and how far [ns] the truth is behind them, at least and at most."""
        whole = 1000 * (t_us - self.device_ref_us)
        parts = [self._at(part) for part in np.split(whole.astype(float), range(AT_ONCE, t_us.size, AT_ONCE))]
        low, high = (np.concatenate(column) for column in zip(*parts, strict=True))
        return self.host_ref_ns + whole, low, high

    def _at(self, t: Floats) -> tuple[Floats, Floats]:
        gap, which = np.searchsorted(self.x, t, side="right"), np.arange(t.size)
        low, high = self.levels[0].at(t, gap)
        for doubted, level in pairwise(self.levels):
            which = which[doubted.doubtful[gap[which]]]
            low[which], high[which] = level.at(t[which], gap[which])
        return low, high

    def changes(self) -> tuple[list[Change], NDArray[np.bool_]]:
        """Where a clock changed, in order, and which exchanges (n,) are wrong: those before and after them go together, but not with them."""
        level, n = self.levels[0], self.x.size
        m = n + 1 - level.refuted.size
        at = np.flatnonzero(level.refuted)
        found, wrong = list[Change](), np.zeros(n, dtype=bool)
        for run in np.split(at, np.flatnonzero(np.diff(at) > 1) + 1) if at.size else []:
            first, last = int(run[0]), int(run[-1])
            # Something happened before the last exchange of the first window, and something after the first of the last.
            change = Change(min(last, first + m - 2), max(first + m - 1, last + 1))
            if found and change.before <= found[-1].after:
                change = Change(found.pop().before, change.after)
            found.append(change)
        changed = list[Change]()
        for change in found:
            before = np.arange(max(0, change.before + 1 - m), change.before + 1)
            after = np.arange(change.after, min(n, change.after + m))
            if level.cones.of_some(np.concatenate([before, after])).refuted():
                changed.append(change)
                continue
            for k in range(change.before + 1, change.after):
                wrong[k] = level.cones.of_some(np.concatenate([before, [k], after])).refuted()
        return changed, wrong
