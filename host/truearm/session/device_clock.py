"""Convert device time to host time by clock exchanges.

An exchange has four times: the host wrote at t0, the device received at t1, it answered at t2, and the host received
the answer at t3. Nothing can arrive before it was sent, whatever the link does. The host time h(d) at device time d
therefore has two hard bounds, h(t1 + 1 µs) ≥ t0 and h(t2) ≤ t3: a row of ``truearm.clocks``, which fits the clock.

The bound includes the half-asymmetry, half the shortest round trip. No exchange can show the asymmetry: if the outward
trip takes constantly longer than the return trip, the estimate is off by half the difference and every exchange looks
the same.
"""

from __future__ import annotations

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
