"""Device time → host time by lines in overlapping windows, and how far the truth may be from them (see ``clock``)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from truearm.types import Floats

Ints = NDArray[np.int64]

DRIFT = 1e-6 / 60.0  # 1/s: a rate changes by no more than 1 ppm a minute, or else
WANDER = 30e-6  # stays within this of the estimate's
EDGE_NS = 1e9  # nearer to the first or last exchange than this one side alone is too few
HOST_ROUNDING_NS = 1.0  # host times are whole


def slack_ns(from_centre_ns: Floats) -> Floats:
    """How far [ns] a clock that keeps to DRIFT may be from its tangent in a window's centre."""
    return 0.5e-9 * DRIFT * np.square(from_centre_ns)


@dataclass(frozen=True)
class Window:
    """host = host_ref_ns + dx + offset_ns + rate · dx, dx = 1000 · (device − device_ref_us)."""

    device_ref_us: int
    host_ref_ns: int
    offset_ns: float
    rate: float
    lines: Floats  # (v, 2) offset_ns and rate of the corners of all lines that may be the tangent in the centre
    margin_ns: float  # to the bounds without slack; negative where the clock bends
    centre_us: int
    rejected_us: tuple[int, ...]  # t1 of the exchanges that were left out
    reach_ns: float  # the farthest that these allow; 0 without any

    def to_host_ns(self, t_us: Ints) -> tuple[Ints, Floats]:
        """Host times [ns] of device times (n,) and how far they may be off [ns]."""
        whole = 1000 * (t_us - self.device_ref_us)  # exact; only what is small becomes a float
        dx = whole.astype(np.float64)
        correction = self.offset_ns + self.rate * dx
        others = self.lines[:, :1] + self.lines[:, 1:] * dx
        bend = slack_ns((1000 * (t_us - self.centre_us)).astype(np.float64))
        bound = np.max(np.abs(others - correction), axis=0) + bend + self.reach_ns
        return self.host_ref_ns + whole + np.rint(correction).astype(np.int64), bound


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


def blended(windows: Sequence[Window], t_us: Ints) -> tuple[Ints, Floats]:
    """Host times [ns] by the two windows about each device time (n,), and the bound [ns] that their lines give."""
    centres = np.array([window.centre_us for window in windows])
    left = np.clip(np.searchsorted(centres, t_us, side="right") - 1, 0, len(centres) - 1)
    host, bound = np.empty(t_us.shape, np.int64), np.empty(t_us.shape)
    order = np.argsort(left, kind="stable")
    edges = np.flatnonzero(np.diff(left[order])) + 1
    for at in np.split(order, edges):
        if at.size:
            host[at], bound[at] = _between(windows, int(left[at[0]]), t_us[at])
    return host, bound


def _between(windows: Sequence[Window], k: int, t_us: Ints) -> tuple[Ints, Floats]:
    host, bound = windows[k].to_host_ns(t_us)
    if k + 1 == len(windows):
        return host, bound
    start, end = windows[k].centre_us, windows[k + 1].centre_us
    weight = np.clip((t_us - start) / (end - start), 0.0, 1.0)
    next_host, next_bound = windows[k + 1].to_host_ns(t_us)
    apart = (next_host - host).astype(np.float64)
    mixed = bound + weight * (next_bound - bound)
    # Windows that contradict each other or their exchanges: one of them is right, which one is not known.
    torn = np.maximum(bound + weight * np.abs(apart), next_bound + (1.0 - weight) * np.abs(apart))
    doubtful = (np.abs(apart) > bound + next_bound) | bool(windows[k].rejected_us or windows[k + 1].rejected_us)
    mixed = np.where(doubtful & (weight > 0.0) & (weight < 1.0), torn, mixed)
    return host + np.rint(weight * apart).astype(np.int64), mixed
