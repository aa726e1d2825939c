r"""Device time ↔ host time, after the fact, from the recorded exchanges (hop 4).

An exchange says four things: the host wrote at t0, the device had received at t1, it answered at t2, the host had the
answer at t3. Nothing can arrive before it was sent, whatever the link does meanwhile, so the host's time h(d) of device
time d keeps to two hard bounds::

    h(t1 + 1 µs) ≥ t0        (device time counts whole microseconds: the true instant lies up to one after t1)
    h(t2)        ≤ t3

Within a window of 60 s the estimate of h is a line, a + (1 + r) d with |r| ≤ 1000 ppm, the one with the largest margin to
both bounds,

    max over r of  U(r) − L(r),    U(r) = min(t3 − (1 + r) t2),    L(r) = max(t0 − (1 + r)(t1 + 1 µs)),

with a half-way between. U − L is concave and piecewise linear in r, and it bends only at the slopes of the edges of two
convex hulls: the optimum follows exactly from a few dozen candidates, without an iteration.

The **bound** on the error holds if either of two assumptions does, as it is the larger of what they give:

1. The rate h′ changes by no more than DRIFT, 1 ppm a minute. Then h keeps within ½ · DRIFT · x² of its tangent in the
   window's centre, x away from it: 7.5 µs at the ends of 60 s. The tangent therefore is among the lines that keep to
   all bounds when these are widened by as much. Such lines form a convex polygon in (a, r); the bound is the farthest
   that any of them is from the estimate, and ½ · DRIFT · x².
2. The rate stays within WANDER, 30 ppm, of the estimate's, and may change within that as it likes. Then each exchange
   bounds h at any time, WANDER · (time between) more loosely. Exchanges before and after are asked apart and the looser
   answer counts, so h may also have one step (or a steep slope one way: a host clock that is slewed) between them, if
   that tilts the estimate by less than WANDER. Within a second of the first and last exchange there are too few on one
   side; there the tighter answer counts.

A clock that breaks both, and still keeps every exchange possible, cannot be told from one that does not.
The bound contains the half-asymmetry (± half the shortest round trip, and it is never less) that no exchange can show:
if the way there takes constantly longer than the way back the estimate is off by half the difference, and every
exchange looks the same.

Windows overlap by half. Between the centres of two neighbours their lines are blended linearly, and so are their
bounds: h has no steps. ``spread`` is the root mean square of what neighbours disagree about half-way, over √2.

An exchange that no line can keep to together with the rest, by the widened bounds, is rejected: the least sum of
violations (a linear program) finds it. If two neighbours or more than a fifth would go, the clock was not steady; the
window is halved. What stays rejected widens its window's bound by the farthest that it allows, for it may be right.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from truearm.session.box_messages import Exchange
from truearm.session.clock_windows import TICK_US, WINDOW_US, Ints, Window, blended, windows_of
from truearm.types import Floats
from truearm.units import PPM

WANDER = 30e-6  # stays within this of the estimate's
EDGE_NS = 1e9  # nearer to the first or last exchange than this one side alone is too few
HOST_ROUNDING_NS = 1.0  # host times are whole
MOST_EXCHANGES = 480  # at 4 Hz a window has 240; somebody who probes faster gets a shorter one
LEAST_EXCHANGES = 3


@dataclass(frozen=True)
class Ceiling:
    """The highest that a curve may be which is below y + WANDER · |x − t| of the exchanges near t, one side at a time.

    The nearest low points before t bound it, and those after t; the higher of both holds even where the curve rises or
    falls by any amount between them.
    """

    x: Floats  # (n,) ns, ascending
    before: Floats  # (n,) least y − WANDER · x up to here
    after: Floats  # (n,) least y + WANDER · x from here on

    @classmethod
    def of(cls, x: Floats, y: Floats) -> Ceiling:
        """From points (n,) in any order."""
        order = np.argsort(x, kind="stable")
        x, y = x[order], y[order]
        after = np.minimum.accumulate((y + WANDER * x)[::-1])[::-1]
        return cls(x, np.minimum.accumulate(y - WANDER * x), after)

    def at(self, t: Floats) -> Floats:
        """Its height at times (m,); 0 without a point."""
        if not self.x.size:
            return np.zeros(t.shape)
        last = self.x.size - 1
        i, j = np.searchsorted(self.x, t, side="right") - 1, np.searchsorted(self.x, t)
        before = np.where(i >= 0, self.before[np.maximum(i, 0)] + WANDER * t, np.inf)
        after = np.where(j <= last, self.after[np.minimum(j, last)] - WANDER * t, np.inf)
        inner = (t >= self.x[0] + EDGE_NS) & (t <= self.x[-1] - EDGE_NS)
        return np.where(inner, np.maximum(before, after), np.minimum(before, after))


@dataclass(frozen=True)
class DeviceClock:
    """The clock of one segment: windows by ascending centre, and how far above and below them the exchanges allow."""

    segment: int
    windows: tuple[Window, ...]
    origin_us: int  # of the ceilings' x
    above: Ceiling  # of truth − estimate
    below: Ceiling  # of estimate − truth
    least_bound_ns: float  # half the shortest round trip

    def to_host_ns(self, t_us: Ints) -> tuple[Ints, Floats]:
        """Host times [ns] of device times (n,) [µs] and the bound of each one's error [ns].

        Beyond the exchanges the outer windows are continued; the bound grows as it must.
        """
        t_us = np.asarray(t_us, dtype=np.int64)
        host, bound = blended(self.windows, t_us)
        x = (1000 * (t_us - self.origin_us)).astype(np.float64)
        allowed = np.maximum(self.above.at(x), self.below.at(x))
        return host, np.maximum(np.maximum(bound, allowed), self.least_bound_ns) + HOST_ROUNDING_NS


@dataclass(frozen=True)
class ClockReport:
    """How well the clock of one segment is known. Times in ns; those of a single window have no spread (NaN)."""

    segment: int
    exchanges: int
    rejected: int
    windows: int
    device_us: tuple[int, int]  # first and last exchange
    offset_ns: int  # host − device in the middle of the segment
    rate_ppm: float  # how much faster the host counts than the device, mean
    rate_range_ppm: float  # largest less smallest of the windows
    spread_ns: float
    margin_ns: float  # smallest of the windows
    bound_ns: float  # largest at any exchange
    rtt_min_ns: int
    rtt_median_ns: int
    half_asymmetry_ns: float  # rtt_min / 2: unobservable, contained in the bound


def fit_clock(segment: int, exchanges: Sequence[Exchange]) -> tuple[DeviceClock, ClockReport] | None:
    """The clock of one segment and its report; None where no exchange is usable."""
    every = np.array(exchanges, dtype=np.int64).reshape(-1, 4)
    sane = every[(every[:, 1] <= every[:, 2]) & (every[:, 0] <= every[:, 3])]
    sane = sane[np.argsort(sane[:, 1], kind="stable")]
    windows = windows_of(sane)
    if not windows:
        return None
    clock = _clock(segment, windows, sane)
    return clock, _report(clock, every, sane)


def _clock(segment: int, windows: tuple[Window, ...], sane: Ints) -> DeviceClock:
    """The windows with what the exchanges that none of them rejected allow."""
    t0, t1, t2, t3 = sane[~np.isin(sane[:, 1], [t1 for window in windows for t1 in window.rejected_us])].T
    origin = int(sane[0, 1])
    return DeviceClock(
        segment,
        windows,
        origin,
        above=Ceiling.of(1e3 * (t2 - origin), (t3 - blended(windows, t2)[0]).astype(float)),
        below=Ceiling.of(1e3 * (t1 + TICK_US - origin), (blended(windows, t1 + TICK_US)[0] - t0).astype(float)),
        least_bound_ns=0.5 * int(np.min(_round_trips(sane))),
    )


def _round_trips(sane: Ints) -> Ints:
    return np.asarray(sane[:, 3] - sane[:, 0] - 1000 * (sane[:, 2] - sane[:, 1]))


def _report(clock: DeviceClock, every: Ints, sane: Ints) -> ClockReport:
    windows = clock.windows
    middle = int(sane[0, 1] + sane[-1, 1]) // 2
    host, _ = clock.to_host_ns(np.array([middle]))
    _, bound = clock.to_host_ns(sane[:, 1])
    rates = PPM.of(np.array([window.rate for window in windows]))
    rtt = _round_trips(sane)
    left_out = {t1 for window in windows for t1 in window.rejected_us}  # windows overlap
    return ClockReport(
        segment=clock.segment,
        exchanges=len(every),
        rejected=len(every) - len(sane) + len(left_out),
        windows=len(windows),
        device_us=(int(sane[0, 1]), int(sane[-1, 1])),
        offset_ns=int(host[0]) - 1000 * middle,
        rate_ppm=float(np.mean(rates)),
        rate_range_ppm=float(np.ptp(rates)),
        spread_ns=_spread(windows),
        margin_ns=min(window.margin_ns for window in windows),
        bound_ns=float(np.max(bound)),
        rtt_min_ns=int(np.min(rtt)),
        rtt_median_ns=int(np.median(rtt)),
        half_asymmetry_ns=0.5 * int(np.min(rtt)),
    )


def _spread(windows: Sequence[Window]) -> float:
    """Disagreement [ns] of neighbouring windows half-way between their centres, RMS over √2; NaN for one window."""
    if len(windows) < 2:
        return float("nan")
    apart = []
    for a, b in pairwise(windows):
        halfway = np.array([(a.centre_us + b.centre_us) // 2])
        apart.append(float((a.to_host_ns(halfway)[0] - b.to_host_ns(halfway)[0])[0]))
    return float(np.sqrt(np.mean(np.square(apart)) / 2.0))


@dataclass(frozen=True)
class OnlineEstimate:
    """The clock at the newest exchange. Times in ns."""

    device_us: int
    offset_ns: int  # host − device there
    rate_ppm: float  # how much faster the host counts than the device
    bound_ns: float  # of the offset's error
    half_asymmetry_ns: float  # half the shortest round trip: no exchange can show it, the bound contains it
    rtt_min_ns: int
    exchanges: int
    rejected: int


class OnlineClock:
    """Takes the exchanges as they come. Device time that steps back is a box that restarted: what was before it is forgotten."""

    def __init__(self) -> None:
        self._window: deque[Exchange] = deque(maxlen=MOST_EXCHANGES)

    def add(self, t0_ns: int, t1_us: int, t2_us: int, t3_ns: int) -> None:
        """One answered exchange: host before writing, device received, device sent, host arrival."""
        window = self._window
        if window and t1_us < window[-1].t1_us:
            window.clear()
        window.append(Exchange(t0_ns, t1_us, t2_us, t3_ns))
        while window[0].t1_us < t1_us - WINDOW_US:
            window.popleft()

    def estimate(self) -> OnlineEstimate | None:
        """What is known at the newest exchange; None before the third one, or where none of them can be used."""
        if len(self._window) < LEAST_EXCHANGES:
            return None
        fitted = fit_clock(0, self._window)
        if fitted is None:
            return None
        clock, report = fitted
        newest_us = self._window[-1].t1_us
        host, bound = clock.to_host_ns(np.array([newest_us]))
        return OnlineEstimate(
            device_us=newest_us,
            offset_ns=int(host[0]) - 1000 * newest_us,
            rate_ppm=PPM.of(clock.windows[-1].rate),
            bound_ns=float(bound[0]),
            half_asymmetry_ns=report.half_asymmetry_ns,
            rtt_min_ns=report.rtt_min_ns,
            exchanges=report.exchanges,
            rejected=report.rejected,
        )
