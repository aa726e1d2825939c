"""Convert device time to host time, from recorded exchanges or during recording.

An exchange has four times: the host wrote at t0, the device received at t1, it answered at t2, and the host received
the answer at t3. Nothing can arrive before it was sent, whatever the link does. The host time h(d) at device time d
therefore has two hard bounds, h(t1 + 1 µs) ≥ t0 and h(t2) ≤ t3: a row of ``truearm.clocks``, which fits the clock.

The bound includes the half-asymmetry, half the shortest round trip. No exchange can show the asymmetry: if the outward
trip takes constantly longer than the return trip, the estimate is off by half the difference and every exchange looks
the same.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from truearm import clocks
from truearm.clocks import RATE_LIMIT, SLEWED_WANDER, WANDER, Clock
from truearm.session.box_frames import Exchange
from truearm.session.session_file import Session
from truearm.types import Floats, Ints
from truearm.units import PPM

TICK_NS = 1000  # device time is in whole microseconds, rounded down
WINDOW_US = 60_000_000
MOST_EXCHANGES = 480  # a window has 240 at 4 Hz; it is shorter if the probe rate is higher
LEAST_EXCHANGES = 3
LATEST = 3  # exchanges after the estimate of a running recording: they show whether a clock stepped


@dataclass(frozen=True)
class DeviceClock:
    """The clock of one segment."""

    segment: int
    clock: Clock
    least_bound_ns: float  # half the shortest round trip: a lower bound would mean that the clocks are no crystals

    def to_host_ns(self, t_us: Ints) -> tuple[Ints, Floats]:
        """Return the host times [ns] of device times (n,) [µs] and the bounds of their errors [ns]."""
        host, bound = self.clock.to_time(1000 * np.asarray(t_us, dtype=np.int64))
        return host, np.maximum(bound, self.least_bound_ns)


@dataclass(frozen=True)
class ClockChange:
    """A step of one of the clocks."""

    device_us: tuple[int, int]  # the exchanges before and after it
    by_ns: int  # how far host time advanced relative to device time


@dataclass(frozen=True)
class ClockReport:
    """How well the clock of one segment is known. Times in ns."""

    segment: int
    exchanges: int
    rejected: int
    device_us: tuple[int, int]  # first and last exchange
    offset_ns: int  # host − device at the middle of the segment
    rate_ppm: float  # how much faster the host counts than the device, mean
    bound_ns: float  # largest at any exchange
    rtt_min_ns: int
    rtt_median_ns: int
    half_asymmetry_ns: float  # rtt_min / 2: unobservable, included in the bound
    changes: tuple[ClockChange, ...]


def recorded_wander(session: Session) -> float:
    """Return how far the rate of the host's clock may wander: more if the system can slew the clock of the recording."""
    kind = session.metadata.get("session", {}).get("clock")
    return WANDER if kind in ("monotonic-raw", "virtual") else SLEWED_WANDER


def fit_clock(
    segment: int, exchanges: Sequence[Exchange] | Ints, wander: float = WANDER
) -> tuple[DeviceClock, ClockReport] | None:
    """Return the clock of one segment and its report; None if no exchange is usable."""
    every = np.array(exchanges, dtype=np.int64).reshape(-1, 4)
    sane = every[(every[:, 1] <= every[:, 2]) & (every[:, 0] <= every[:, 3])]
    # By any clock, the host measured less time than the device: a stamp is wrong.
    sane = sane[_round_trips(sane) >= -TICK_NS - RATE_LIMIT * 1000.0 * (sane[:, 2] - sane[:, 1])]
    sane = sane[np.argsort(sane[:, 1], kind="stable")]
    t0, t1, t2, t3 = sane.T
    received = 1000 * t1 + TICK_NS
    while_held = received - 1000 * t2  # the bound of the answer, moved to the receipt
    latest = t3 + while_held + np.ceil(RATE_LIMIT * np.abs(while_held)).astype(np.int64)
    clock = clocks.fit(received, latest, t0, wander=wander)
    if clock is None:
        return None
    rtt = _round_trips(sane)
    device = DeviceClock(segment, clock, max(0.0, 0.5 * int(np.min(rtt))))
    middle = np.array([int(t1[0] + t1[-1]) // 2])
    report = ClockReport(
        segment=segment,
        exchanges=len(every),
        rejected=len(every) - len(sane) + clock.wrong.size,
        device_us=(int(t1[0]), int(t1[-1])),
        offset_ns=int((device.to_host_ns(middle)[0] - 1000 * middle)[0]),
        rate_ppm=PPM.of(clock.rate),
        bound_ns=float(np.max(device.to_host_ns(t1)[1])),
        rtt_min_ns=int(np.min(rtt)),
        rtt_median_ns=int(np.median(rtt)),
        half_asymmetry_ns=0.5 * int(np.min(rtt)),
        changes=tuple(ClockChange((step.before_ns // 1000, step.after_ns // 1000), step.by_ns) for step in clock.steps),
    )
    return device, report


def _round_trips(sane: Ints) -> Ints:
    return np.asarray(sane[:, 3] - sane[:, 0] - 1000 * (sane[:, 2] - sane[:, 1]))


@dataclass(frozen=True)
class OnlineEstimate:
    """The clock at the newest exchange with LATEST exchanges after it, or at the middle one of fewer. Times in ns."""

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
        t_us = self._window[max(count - 1 - LATEST, count // 2)].t1_us
        host, bound = clock.to_host_ns(np.array([t_us]))
        return OnlineEstimate(
            device_us=t_us,
            offset_ns=int(host[0]) - 1000 * t_us,
            rate_ppm=report.rate_ppm,
            rate_bound_ppm=PPM.of(
                2.0 * float(bound[0]) / (1000.0 * max(1, self._window[-1].t1_us - self._window[0].t1_us))
            ),
            bound_ns=float(bound[0]),
            half_asymmetry_ns=report.half_asymmetry_ns,
            rtt_min_ns=report.rtt_min_ns,
            exchanges=report.exchanges,
            rejected=report.rejected,
        )
