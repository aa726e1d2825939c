"""The range of host times that recorded exchanges allow at any device time, and where they show a change of a clock.

**What exchanges allow.** The exchanges limit the host time at any device time, even where a clock steps or is slewed.
Exchange k states that l_k ≤ y(x_k) ≤ u_k, where y = host − device at device time x_k. If y′ stays within a known range
[lo, hi], each exchange also bounds y at any other time t. The upper bound is u_k + ∫hi from x_k to t for later t, and
u_k − ∫lo from t to x_k for earlier t; the lower bound is analogous. This is valid only while nothing steps, so at most
SPAN consecutive exchanges, a **window**, are used together. At time t, the ranges of all windows that touch t (they
contain the exchange before t or the one after it) are united. A window allows the intersection of the ranges of its
exchanges. If that intersection is empty for any two of them, the clock was not steady in the window: the window is
refuted and not used.

**The range of rates.** y′ lies within WANDER, 30 ppm, of the usual rate, which may change slowly or permanently. The
usual rate is the median of the slopes over 10 s within two minutes on each side of t. Steps and slews that last for
less than half of that time cannot shift it. Where it does change, the range spans the medians of half a minute before
and after. The range is widened by the uncertainty with which exchanges show a rate: their round trip divided by the
time that the slopes cover. The first and last SPAN exchanges have neighbours on one side only, so a different rate
there would go unnoticed. For them the range also includes all rates that the outer 10 s allow.

**Conditions.** The bound holds at t if one of these is true:

1. t lies in a stretch of SPAN exchanges in which the rate is within its range. One of the united windows then lies
   completely within the stretch, whatever happened before and after, detected or not.
2. Both clocks depart from that in only one direction around t (a slew). The windows completely before t then bound y on
   one side, and those completely after t bound it on the other.
3. Some window that touches t is refuted. Then only two consecutive exchanges are used together, and the rate is only
   assumed to be below 1000 ppm. If two of those contradict each other, each is used by itself.

The remaining case is a stretch of fewer than SPAN exchanges that contradicts no other exchange, or contains none. It
lies between two opposite steps, or between a step and the first or last exchange. Nothing can reveal it.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from truearm.session.clock_windows import RATE_LIMIT, TICK_US
from truearm.types import Floats, Ints

WANDER = 30e-6  # a clock's rate stays within this of its usual rate
SPAN = 8  # exchanges used together
SLOPE_NS = 10e9  # baseline of the slopes for the usual rate
USUAL_NS = 120e9  # on each side of the time concerned
BLOCK_NS = 30e9  # interval with one usual rate
LEAST_SLOPES = 8  # on each side, where exchanges are sparse
ROUNDING_NS = 2.0  # two stamps are whole ns
AT_ONCE = 2048  # times or windows processed together


class Rates(NamedTuple):
    """Lowest and highest y′ from each node [ns] to the next, and their integrals up to the nodes."""

    node: Floats
    low: Floats
    high: Floats
    low_sum: Floats
    high_sum: Floats

    @classmethod
    def of(cls, node: Floats, low: Floats, high: Floats) -> Rates:
        """Build from rates (b,) that hold from each node on; the first also holds before its node."""
        sums = [np.concatenate([[0.0], np.cumsum(rate[:-1] * np.diff(node))]) for rate in (low, high)]
        return cls(node, low, high, *sums)

    def integrals(self, t: Floats) -> tuple[Floats, Floats]:
        """Return ∫low and ∫high from the first node to times (n,) [ns]."""
        k = np.maximum(np.searchsorted(self.node, t, side="right") - 1, 0)
        since = t - self.node[k]
        return self.low_sum[k] + self.low[k] * since, self.high_sum[k] + self.high[k] * since


def usual_rates(x: Floats, low: Floats, high: Floats) -> Rates:
    """Return the range of y′ around its usual value, from exchanges low ≤ y(x) ≤ high (n,)."""
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
    """Return the rates, extended by all rates that the outer exchanges allow, for the first and last SPAN exchanges."""
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
    """Return the least and greatest rate from some exchanges (x, low, high) to later ones; any rate if they contradict."""
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
    """Bounds (n,) of exchanges, minus the largest (high) or smallest (low) possible change of y since the first node."""

    upper_low: Floats
    upper_high: Floats
    lower_low: Floats
    lower_high: Floats

    @classmethod
    def of(cls, x: Floats, low: Floats, answered: Floats, high: Floats, rates: Rates) -> Cones:
        """Build from exchanges low ≤ y(x), y(answered) ≤ high."""
        least, most = rates.integrals(x)
        least_there, most_there = rates.integrals(answered)
        high = high + np.maximum(least - least_there, most - most_there)  # at x
        return cls(high - least, high - most, low - least, low - most)

    def of_some(self, which: NDArray[np.intp] | slice) -> Cones:
        """Return the bounds of some exchanges."""
        return Cones(*(column[which] for column in self))

    def refuted(self) -> NDArray[np.bool_]:
        """Return whether two of the exchanges (…, m), in order of time along the last axis, contradict each other."""
        risen = np.maximum.accumulate(self.lower_low, axis=-1) > self.upper_low + ROUNDING_NS
        fallen = np.minimum.accumulate(self.upper_high, axis=-1) < self.lower_high - ROUNDING_NS
        return np.asarray(np.any(risen | fallen, axis=-1))


class WindowLimits(NamedTuple):
    """What windows of m of the n exchanges allow under a range of rates, for each of the n + 1 gaps around the
    exchanges.
    """

    rates: Rates
    cones: Cones
    m: int
    refuted: NDArray[np.bool_]  # (n − m + 1,) windows, indexed by their first exchange
    doubtful: NDArray[np.bool_]  # (n + 1,) gaps that a refuted window touches

    @classmethod
    def of(cls, cones: Cones, rates: Rates, m: int) -> WindowLimits:
        """Build from the windows of m consecutive exchanges."""
        windows = Cones(*(sliding_window_view(column, m) for column in cones))
        refuted = np.zeros(len(windows.upper_low), dtype=bool)
        if m > 1:  # else there is no narrower level to fall back to
            for first in range(0, len(refuted), AT_ONCE):
                some = slice(first, first + AT_ONCE)
                refuted[some] = windows.of_some(some).refuted()
        doubtful = np.zeros(cones.upper_low.size + 1, dtype=bool)
        at = np.flatnonzero(refuted)
        doubtful[np.add.outer(at, np.arange(m + 1))] = True
        return cls(rates, cones, m, refuted, doubtful)

    def at(self, t: Floats, gap: NDArray[np.intp]) -> tuple[Floats, Floats]:
        """Return the lowest and highest y (k,) [ns] at times (k,) in these gaps.

        With L and H the integrals at t, y is at most the largest min(upper_before + H, upper_after + L) of the windows
        that touch the gap, and at least the smallest max(lower_before + L, lower_after + H).
        """
        least, most = (integral[:, None] for integral in self.rates.integrals(t))
        gaps, of = np.unique(gap, return_inverse=True)
        n, m = self.cones.upper_low.size, self.m
        window = gaps[:, None] + np.arange(-m, 1)
        asked = (window >= 0) & (window <= n - m)
        asked &= ~self.refuted[np.clip(window, 0, n - m)]
        first = max(0, int(gaps[0]) - m)  # exchanges farther away are not used
        cones, gaps = self.cones.of_some(slice(first, int(gaps[-1]) + m)), gaps - first
        upper_before = np.where(asked, _least_before(cones.upper_high, m, gaps), -np.inf)
        upper_after = np.where(asked, _least_after(cones.upper_low, m, gaps), -np.inf)
        lower_before = np.where(asked, -_least_before(-cones.lower_low, m, gaps), np.inf)
        lower_after = np.where(asked, -_least_after(-cones.lower_high, m, gaps), np.inf)
        upper = np.minimum(upper_before[of] + most, upper_after[of] + least)
        lower = np.maximum(lower_before[of] + least, lower_after[of] + most)
        return np.min(lower, axis=1), np.max(upper, axis=1)


def _least_before(values: Floats, m: int, gaps: NDArray[np.intp]) -> Floats:
    """Return the least (g, m + 1) of the m, m − 1 … 0 values before some gaps (g,)."""
    last = sliding_window_view(np.pad(values, m, constant_values=np.inf), m)[gaps, ::-1]
    return np.pad(np.minimum.accumulate(last, axis=1)[:, ::-1], ((0, 0), (0, 1)), constant_values=np.inf)


def _least_after(values: Floats, m: int, gaps: NDArray[np.intp]) -> Floats:
    """Return the least (g, m + 1) of the 0, 1 … m values after some gaps (g,)."""
    return _least_before(values[::-1], m, values.size - gaps)[:, ::-1]


class ExchangeChange(NamedTuple):
    """A clock changed between exchanges ``before`` and ``after``; those between belong to neither side."""

    before: int
    after: int


@dataclass(frozen=True)
class ClockBounds:
    """Bounds of host time from the exchanges of one segment."""

    device_ref_us: int
    host_ref_ns: int
    x: Floats  # (n,) ns since device_ref_us, ascending
    levels: tuple[WindowLimits, ...]  # the first is used; where it is in doubt, the next

    @classmethod
    def of(cls, exchanges: Ints) -> ClockBounds:
        """Build from n ≥ 1 exchanges (n, 4) in order of t1."""
        t0, t1, t2, t3 = exchanges.T
        device_ref, host_ref = int(t1[0]), int(t0[0])
        received, answered = 1000 * (t1 + TICK_US - device_ref), 1000 * (t2 - device_ref)
        low, high = (t0 - host_ref - received).astype(float), (t3 - host_ref - answered).astype(float)
        x, later = received.astype(float), answered.astype(float)
        limit = Rates.of(x[:1], np.full(1, -RATE_LIMIT), np.full(1, RATE_LIMIT))
        usual = usual_rates(x, low, high)
        cones, widest = (Cones.of(x, low, later, high, rates) for rates in (usual, limit))
        levels = (
            WindowLimits.of(cones, usual, min(SPAN, x.size)),
            WindowLimits.of(widest, limit, min(2, x.size)),
            WindowLimits.of(widest, limit, 1),
        )
        return cls(device_ref, host_ref, x, levels)

    def at(self, t_us: Ints) -> tuple[Ints, Floats, Floats]:
        """Return the host times (n,) [ns] by the first exchange and a rate of 1, and the range of the true minus these
        [ns].
        """
        whole = 1000 * (t_us - self.device_ref_us)
        parts = [self._at(part) for part in np.split(whole.astype(float), range(AT_ONCE, t_us.size, AT_ONCE))]
        low, high = (np.concatenate(column) for column in zip(*parts, strict=True))
        return self.host_ref_ns + whole, low, high

    def _at(self, t: Floats) -> tuple[Floats, Floats]:
        gap, which = np.searchsorted(self.x, t, side="right"), np.arange(t.size)
        if not t.size:
            return t, t
        low, high = self.levels[0].at(t, gap)
        for doubted, level in pairwise(self.levels):
            which = which[doubted.doubtful[gap[which]]]
            if not which.size:
                break
            low[which], high[which] = level.at(t[which], gap[which])
        return low, high

    def changes(self) -> tuple[list[ExchangeChange], NDArray[np.bool_]]:
        """Return where a clock changed, in order, and which exchanges (n,) are wrong.

        A wrong exchange contradicts those before and after it, which agree with each other.
        """
        level, n, m = self.levels[0], self.x.size, self.levels[0].m
        at = np.flatnonzero(level.refuted)
        found, wrong = list[ExchangeChange](), np.zeros(n, dtype=bool)
        for run in np.split(at, np.flatnonzero(np.diff(at) > 1) + 1) if at.size else []:
            first, last = int(run[0]), int(run[-1])
            # One change lies before the last exchange of the first window, another after the first exchange of the last
            # window.
            change = ExchangeChange(min(last, first + m - 2), max(first + m - 1, last + 1))
            if found and change.before <= found[-1].after:
                change = ExchangeChange(found.pop().before, change.after)
            found.append(change)
        changed = list[ExchangeChange]()
        for change in found:
            before = np.arange(max(0, change.before + 1 - m), change.before + 1)
            after = np.arange(change.after, min(n, change.after + m))
            if level.cones.of_some(np.concatenate([before, after])).refuted():
                changed.append(change)
                continue
            for k in range(change.before + 1, change.after):
                wrong[k] = level.cones.of_some(np.concatenate([before, [k], after])).refuted()
        return changed, wrong
