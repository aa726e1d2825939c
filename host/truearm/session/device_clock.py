"""Convert device time to host time, from recorded exchanges or during recording.

An exchange has four times: the host wrote at t0, the device received at t1, it answered at t2, and the host received
the answer at t3. Nothing can arrive before it was sent, whatever the link does. The host time h(d) at device time d
therefore has two hard bounds, h(t1 + 1 µs) ≥ t0 and h(t2) ≤ t3.

The **estimate** is the line with the largest margin to all bounds, in windows (``clock_windows``). The **bound** on its
error is the distance from the estimate to the farthest value on either side that nearby exchanges allow
(``ClockBounds``). It depends neither on the lines nor on the detection of clock steps; ``clock_bounds`` lists its
assumptions.

A clock that steps or is slewed begins a new **stretch** with windows of its own. Between two stretches, and wherever a
line leaves the range that the exchanges allow, the estimate is the middle of that range and the bound covers it.

The bound includes the half-asymmetry, ± half the shortest round trip, and is never less. No exchange can show the
asymmetry: if the outward trip takes constantly longer than the return trip, the estimate is off by half the difference
and every exchange looks the same.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from truearm.session.box_frames import Exchange
from truearm.session.clock_bounds import SPAN, ClockBounds, ExchangeChange
from truearm.session.clock_windows import (
    RATE_LIMIT,
    TICK_US,
    WINDOW_US,
    Window,
    disagreements,
    host_by_lines,
    windows_of,
)
from truearm.types import Floats, Ints
from truearm.units import PPM

HOST_ROUNDING_NS = 1.0  # host times are whole
MOST_EXCHANGES = 480  # a window has 240 at 4 Hz; it is shorter if the probe rate is higher
LEAST_EXCHANGES = 3


class Stretch(NamedTuple):
    """Device times [µs] of the first and last exchange between two clock changes, and the lines between, by ascending
    centre.
    """

    begin_us: int
    end_us: int
    windows: tuple[Window, ...]


@dataclass(frozen=True)
class DeviceClock:
    """The clock of one segment: its steady stretches in order, and the range that the exchanges allow at any time."""

    segment: int
    stretches: tuple[Stretch, ...]
    bounds: ClockBounds
    least_bound_ns: float  # half the shortest round trip

    @property
    def windows(self) -> tuple[Window, ...]:
        """Return the windows of all stretches, by ascending centre."""
        return tuple(window for stretch in self.stretches for window in stretch.windows)

    def to_host_ns(self, t_us: Ints) -> tuple[Ints, Floats]:
        """Return the host times [ns] of device times (n,) [µs] and the bounds of their errors [ns].

        Beyond the exchanges, the outer windows are extrapolated and the bound grows accordingly. Between two stretches,
        and where the exchanges exclude the windows' lines, the host time is the middle of the allowed range.
        """
        t_us = np.asarray(t_us, dtype=np.int64)
        reference, low, high = self.bounds.at(t_us)
        best = np.full(t_us.shape, np.nan)
        begins = np.array([stretch.begin_us for stretch in self.stretches[1:]], dtype=np.int64)
        of_stretch = np.searchsorted(begins, t_us, side="right")
        for k, stretch in enumerate(self.stretches):
            inner = (of_stretch == k) & ((t_us <= stretch.end_us) | (k + 1 == len(self.stretches)))
            best[inner] = host_by_lines(stretch.windows, t_us[inner]) - reference[inner]
        best = np.where((best >= low) & (best <= high), best, 0.5 * (low + high))
        bound = np.maximum(np.maximum(high - best, best - low), self.least_bound_ns) + HOST_ROUNDING_NS
        return reference + np.rint(best).astype(np.int64), bound


@dataclass(frozen=True)
class ClockChange:
    """A step or slew of one of the clocks."""

    device_us: tuple[int, int]  # the exchanges before and after it
    by_ns: int  # how far host time advanced relative to device time


@dataclass(frozen=True)
class ClockReport:
    """How well the clock of one segment is known. Times in ns; the spread of a single window is NaN."""

    segment: int
    exchanges: int
    rejected: int
    windows: int
    device_us: tuple[int, int]  # first and last exchange
    offset_ns: int  # host − device at the middle of the segment
    rate_ppm: float  # how much faster the host counts than the device, mean
    rate_range_ppm: float  # largest minus smallest of the windows
    spread_ns: float  # disagreement of neighbouring windows half-way between their centres, RMS divided by √2
    margin_ns: float  # smallest of the windows
    bound_ns: float  # largest at any exchange
    rtt_min_ns: int
    rtt_median_ns: int
    half_asymmetry_ns: float  # rtt_min / 2: unobservable, included in the bound
    changes: tuple[ClockChange, ...]


def fit_clock(segment: int, exchanges: Sequence[Exchange] | Ints) -> tuple[DeviceClock, ClockReport] | None:
    """Return the clock of one segment and its report; None if no exchange is usable."""
    every = np.array(exchanges, dtype=np.int64).reshape(-1, 4)
    sane = every[(every[:, 1] <= every[:, 2]) & (every[:, 0] <= every[:, 3])]
    # By any clock, the host measured less time than the device: a stamp is wrong.
    sane = sane[_round_trips(sane) >= -1000.0 * TICK_US - RATE_LIMIT * 1000.0 * (sane[:, 2] - sane[:, 1])]
    sane = sane[np.argsort(sane[:, 1], kind="stable")]
    if not len(sane):
        return None
    bounds = ClockBounds.of(sane)
    changes, wrong = bounds.changes()
    stretches = _stretches(sane, changes, wrong)
    if not stretches:
        return None
    clock = DeviceClock(segment, stretches, bounds, max(0.0, 0.5 * int(np.min(_round_trips(sane)))))
    return clock, _report(clock, every, sane, wrong)


def _stretches(sane: Ints, changes: Sequence[ExchangeChange], wrong: NDArray[np.bool_]) -> tuple[Stretch, ...]:
    """Return the windows between the changes, from the exchanges that are not wrong."""
    firsts = [0, *(change.after for change in changes)]
    ends = [*(change.before + 1 for change in changes), len(sane)]
    found = []
    for first, end in zip(firsts, ends, strict=True):
        windows = windows_of(sane[first:end][~wrong[first:end]])
        if windows:
            found.append(Stretch(int(sane[first, 1]), int(sane[end - 1, 1]), windows))
    return tuple(found)


def _round_trips(sane: Ints) -> Ints:
    return np.asarray(sane[:, 3] - sane[:, 0] - 1000 * (sane[:, 2] - sane[:, 1]))


def _report(clock: DeviceClock, every: Ints, sane: Ints, wrong: NDArray[np.bool_]) -> ClockReport:
    windows, stretches, t_us = clock.windows, clock.stretches, sane[:, 1]
    middle = int(t_us[0] + t_us[-1]) // 2
    host, _ = clock.to_host_ns(np.array([middle]))
    _, bound = clock.to_host_ns(t_us)
    rates = PPM.of(np.array([window.rate for window in windows]))
    rtt = _round_trips(sane)
    left_out = wrong | np.isin(t_us, [t1 for window in windows for t1 in window.rejected_us])
    of_stretch = np.searchsorted([stretch.begin_us for stretch in stretches[1:]], t_us, side="right")
    left_out |= (t_us < stretches[0].begin_us) | (
        t_us > np.array([stretch.end_us for stretch in stretches])[of_stretch]
    )
    apart = np.concatenate([disagreements(stretch.windows) for stretch in stretches])
    return ClockReport(
        segment=clock.segment,
        exchanges=len(every),
        rejected=len(every) - len(sane) + int(np.sum(left_out)),
        windows=len(windows),
        device_us=(int(t_us[0]), int(t_us[-1])),
        offset_ns=int(host[0]) - 1000 * middle,
        rate_ppm=float(np.mean(rates)),
        rate_range_ppm=float(np.ptp(rates)),
        spread_ns=float(np.sqrt(np.mean(np.square(apart.astype(float))) / 2.0)) if apart.size else float("nan"),
        margin_ns=min(window.margin_ns for window in windows),
        bound_ns=float(np.max(bound)),
        rtt_min_ns=int(np.min(rtt)),
        rtt_median_ns=int(np.median(rtt)),
        half_asymmetry_ns=0.5 * int(np.min(rtt)),
        changes=tuple(_change(before, after) for before, after in pairwise(stretches)),
    )


def _change(before: Stretch, after: Stretch) -> ClockChange:
    """Return the difference between the lines before and after the change, half-way between them."""
    middle = np.array([(before.end_us + after.begin_us) // 2])
    (from_ns,), (to_ns,) = (host_by_lines(stretch.windows, middle) for stretch in (before, after))
    return ClockChange((before.end_us, after.begin_us), int(to_ns - from_ns))


@dataclass(frozen=True)
class OnlineEstimate:
    """The clock at the newest exchange with SPAN exchanges after it, or at the middle one of fewer. Times in ns."""

    device_us: int
    offset_ns: int  # host − device there
    rate_ppm: float  # how much faster the host counts than the device
    rate_bound_ppm: float  # of the rate's error: lines within the bound at both ends of the exchanges
    bound_ns: float  # of the offset's error
    half_asymmetry_ns: float  # half the shortest round trip: no exchange can show it; included in the bound
    rtt_min_ns: int
    exchanges: int
    rejected: int


class OnlineClock:
    """Processes exchanges as they arrive. If device time steps back, the box restarted and earlier exchanges are
    dropped.
    """

    def __init__(self) -> None:
        self._window: deque[Exchange] = deque(maxlen=MOST_EXCHANGES)

    def add(self, t0_ns: int, t1_us: int, t2_us: int, t3_ns: int) -> None:
        """Add an answered exchange: times of host write, device receive, device send and host arrival."""
        window = self._window
        if window and t1_us < window[-1].t1_us:
            window.clear()
        window.append(Exchange(t0_ns, t1_us, t2_us, t3_ns))
        while window[0].t1_us < t1_us - WINDOW_US:
            window.popleft()

    def estimate(self) -> OnlineEstimate | None:
        """Return the estimate as of a few exchanges ago; None before the third exchange or if none is usable.

        For the newest exchanges it is not yet known whether a clock stepped.
        """
        if len(self._window) < LEAST_EXCHANGES:
            return None
        fitted = fit_clock(0, self._window)
        if fitted is None:
            return None
        clock, report = fitted
        count = len(self._window)
        t_us = self._window[max(count - 1 - SPAN, count // 2)].t1_us
        host, bound = clock.to_host_ns(np.array([t_us]))
        return OnlineEstimate(
            device_us=t_us,
            offset_ns=int(host[0]) - 1000 * t_us,
            rate_ppm=PPM.of(clock.windows[-1].rate),
            rate_bound_ppm=PPM.of(
                2.0 * float(bound[0]) / (1000.0 * max(1, self._window[-1].t1_us - self._window[0].t1_us))
            ),
            bound_ns=float(bound[0]),
            half_asymmetry_ns=report.half_asymmetry_ns,
            rtt_min_ns=report.rtt_min_ns,
            exchanges=report.exchanges,
            rejected=report.rejected,
        )
