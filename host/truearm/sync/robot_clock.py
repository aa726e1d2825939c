"""Robot controller time ↔ host time from arrivals alone (hop 4).

A reading stamped t by the controller arrives at h(t) + latency, and no latency is negative. The line under all arrivals that
is nearest to them on average (the lower hull's edge at their middle) follows the fastest packets; queues and a busy host only
push arrivals up. Windows of 60 s overlap by half and are blended as in ``clock``.

**The shortest latency itself cannot be seen**: a constant one is part of the offset. Here it is left in; what remains is the
parameter τ of the identification. A robot at rest does not care.

Controller time that runs backward is a restart of the controller: another segment, with a clock of its own.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from truearm.sync.hull import line_under, lower_hull
from truearm.types import Floats

Ints = NDArray[np.int64]

HALF_WINDOW_S = 30.0
MAX_RATE = 0.01  # a controller's clock may be poor, but 1 % off it is another unit of time


@dataclass(frozen=True)
class RobotClock:
    """host = host_ref_ns + dt + offset_ns + rate · dt with dt = 1e9 · (t − t_ref_s), for each window; k windows."""

    t_ref_s: float
    host_ref_ns: int
    centre_s: Floats  # (k,) ascending
    offset_ns: Floats  # (k,)
    rate: Floats  # (k,)

    def to_host_ns(self, t_robot_s: Floats) -> Ints:
        """Host times [ns] of controller times (n,) [s], late by the shortest latency of the link."""
        dt = 1e9 * (np.asarray(t_robot_s, dtype=np.float64) - self.t_ref_s)
        lines = self.offset_ns[:, None] + self.rate[:, None] * dt
        place = np.interp(t_robot_s, self.centre_s, np.arange(len(self.centre_s)))
        left = np.minimum(place.astype(int), max(0, len(self.centre_s) - 2))
        right, column = np.minimum(left + 1, len(self.centre_s) - 1), np.arange(dt.size)
        correction = lines[left, column] + (place - left) * (lines[right, column] - lines[left, column])
        return np.asarray(self.host_ref_ns + np.rint(dt).astype(np.int64) + np.rint(correction).astype(np.int64))


@dataclass(frozen=True)
class RobotClockReport:
    """How well a segment of controller time is tied to host time. A constant latency is unknowable and not in here."""

    segment: int
    readings: int
    t_robot_s: tuple[float, float]  # first and last
    rate_ppm: float  # how much faster the host counts than the controller, mean
    rate_range_ppm: float
    spread_ns: float  # disagreement of neighbouring windows half-way, RMS over √2; NaN for one window
    jitter_ns: float  # mean of the arrivals above the line; median of the half windows
    windows: int


@dataclass
class Arrivals:
    """Gathers (controller time, arrival) of one segment; keeps the hull of each half window, not the readings."""

    t_ref_s: float
    host_ref_ns: int
    readings: int = 0
    first_s: float = float("inf")
    last_s: float = float("-inf")
    hulls: dict[int, Floats] = field(default_factory=dict)  # half window → corners (c, 2): dt [s], latency + const [ns]
    sums: dict[int, Floats] = field(default_factory=dict)  # half window → (3,): sums of 1, dt, latency

    def add(self, t_robot_s: Floats, t_host_ns: Ints) -> None:
        """Take readings (n,) in order of arrival."""
        dt = t_robot_s - self.t_ref_s
        latency = (t_host_ns - self.host_ref_ns - np.rint(1e9 * dt).astype(np.int64)).astype(np.float64)
        half = np.floor(dt / HALF_WINDOW_S).astype(np.int64)
        for key in np.unique(half):
            self._add_half(int(key), dt[half == key], latency[half == key])
        self.readings += dt.size
        self.first_s = min(self.first_s, float(t_robot_s[0]))
        self.last_s = max(self.last_s, float(t_robot_s[-1]))

    def _add_half(self, key: int, dt: Floats, latency: Floats) -> None:
        old = self.hulls.get(key, np.empty((0, 2)))
        x, y = np.concatenate([old[:, 0], dt]), np.concatenate([old[:, 1], latency])
        corners = lower_hull(x, y)
        self.hulls[key] = np.stack([x[corners], y[corners]], axis=1)
        self.sums[key] = self.sums.get(key, np.zeros(3)) + np.array([dt.size, np.sum(dt), np.sum(latency)])


def fit_robot_clock(segment: int, arrivals: Arrivals) -> tuple[RobotClock, RobotClockReport]:
    """The clock of one segment of controller time and its report. ``arrivals`` must hold a reading."""
    keys = sorted(arrivals.hulls)
    pairs = [(a, b) for a, b in pairwise(keys) if b == a + 1] or [(keys[0], keys[0])]
    alone = [(k, k) for k in keys if not any(k in pair for pair in pairs)]
    windows = sorted(pairs + alone)
    lines = np.array([_line(arrivals, pair) for pair in windows])
    clock = RobotClock(arrivals.t_ref_s, arrivals.host_ref_ns, arrivals.t_ref_s + lines[:, 0], lines[:, 1], lines[:, 2])
    return clock, _report(segment, arrivals, lines)


def _line(arrivals: Arrivals, pair: tuple[int, int]) -> tuple[float, float, float]:
    """Centre [s], offset [ns] and rate of the line under two half windows."""
    keys = sorted(set(pair))
    corners = np.concatenate([arrivals.hulls[key] for key in keys])
    count, dt_sum, _ = np.sum([arrivals.sums[key] for key in keys], axis=0)
    dt, latency = corners[:, 0], corners[:, 1]
    offset, per_second = line_under(dt, latency, dt_sum / count)
    if abs(per_second) > 1e9 * MAX_RATE:
        offset, per_second = float(np.min(latency)), 0.0
    return float(0.5 * (dt.min() + dt.max())), offset, 1e-9 * per_second


def _report(segment: int, arrivals: Arrivals, lines: Floats) -> RobotClockReport:
    centre, offset, rate = lines.T
    halfway = 0.5 * (centre[1:] + centre[:-1])
    here, there = (offset[k] + 1e9 * rate[k] * halfway for k in (slice(None, -1), slice(1, None)))
    spread = float(np.sqrt(np.mean(np.square(there - here)) / 2.0)) if len(lines) > 1 else float("nan")
    return RobotClockReport(
        segment=segment,
        readings=arrivals.readings,
        t_robot_s=(arrivals.first_s, arrivals.last_s),
        rate_ppm=float(1e6 * np.mean(rate)),
        rate_range_ppm=float(1e6 * np.ptp(rate)),
        spread_ns=spread,
        jitter_ns=float(np.median(_mean_heights(arrivals, lines))),
        windows=len(lines),
    )


def _mean_heights(arrivals: Arrivals, lines: Floats) -> Floats:
    """Mean latency [ns] above the nearest window's line, of each half window."""
    count, dt, latency = np.array(list(arrivals.sums.values())).T
    nearest = lines[np.argmin(np.abs(lines[:, :1] - dt / count), axis=0)]
    return np.asarray(latency / count - nearest[:, 1] - 1e9 * nearest[:, 2] * dt / count)
