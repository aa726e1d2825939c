"""Relate robot controller time to host time from arrivals alone.

A reading stamped t by the controller arrives at h(t) + latency, and latency is never negative. The line under all
arrivals that is nearest to them on average (the lower hull's edge at their middle) follows the fastest packets; queues
and a busy host only delay arrivals. Windows of 60 s overlap by half. Between
the centres of two neighbours, their lines are blended linearly.

A line lies under all points exactly if it lies under the corners of their lower hull: a dozen of thousands.

**The shortest latency cannot be observed**: a constant latency is part of the offset. It is not removed here; the
parameter τ of the identification absorbs it. It does not matter for a robot at rest. Edges of a trigger wire
(``edges``) do reveal it.

The **bound** covers the rest: how far the line may be from that of the shortest latency. It is not a hard bound,
because a link may hold up every packet for a minute without any sign. It is twice the mean height above the line of the
fastest packet of each second. Of 60 such packets, the very fastest lies above the shortest latency by a fraction of
that height: about a sixtieth if latencies near the shortest are as likely as elsewhere, a seventh if their density
vanishes linearly there, a quarter if quadratically. At the ends of a window the line may be off by a few times as much.
Two terms are added: the deviation from a line for a rate drift of 1 ppm per minute (DRIFT), and the disagreement of
neighbouring windows.

**Where a clock steps or is slewed**, the line follows the lowest arrivals and the rest of the window lies above it. The
bound is therefore also at least 1.75 times the height above the line that all packets of any eight consecutive seconds
keep. This holds if every eight seconds contain a packet that is nearly as fast as possible, and if the clocks change in
only one direction within any eight seconds. The windows around a step are as wide as the step.

If controller time runs backward, the controller restarted: another segment with its own clock begins.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from truearm.types import Floats, Ints
from truearm.units import PPM

HALF_WINDOW_S = 30.0
BLOCK_S = 1.0  # the fastest packet of each such interval counts for the bound
RUN = 8  # seconds that contain a packet nearly as fast as possible
TILTED = 1.75  # factor on a run's height: a change tilts the line, by less than 3/7 of the height that it leaves within a run (slews and steps of 10 ms: 0.88 of this bound)
LEAST_BLOCKS = 16  # with fewer, the bound grows in proportion
ROUNDING_NS = 1000.0  # stamps are printed to the microsecond
DRIFT = 1e-6 / 60.0  # 1/s: a rate changes by no more than 1 ppm a minute
MAX_RATE = 0.01  # a controller's clock may be poor, but 1 % off means another unit of time


@dataclass(frozen=True)
class RobotClock:
    """For each of k windows: host = host_ref_ns + dt + offset_ns + rate · dt with dt = 1e9 · (t − t_ref_s)."""

    t_ref_s: float
    host_ref_ns: int
    centre_s: Floats  # (k,) ascending
    offset_ns: Floats  # (k,)
    rate: Floats  # (k,)
    bound_ns: Floats  # (k,) of the error near each centre; for "arrivals" excluding the link's shortest latency, which is unknown
    source: str = "arrivals"  # or "edges", of a trigger wire

    def bound_at(self, t_robot_s: Floats) -> Floats:
        """Return bounds (n,) [ns] at controller times: the larger one of the two windows around each."""
        right = np.clip(np.searchsorted(self.centre_s, t_robot_s), 0, len(self.centre_s) - 1)
        return np.asarray(np.maximum(self.bound_ns[np.maximum(right - 1, 0)], self.bound_ns[right]))

    def to_robot_s(self, t_host_ns: Ints) -> Floats:
        """Return controller times (n,) [s] of host times: the inverse of ``to_host_ns``, to the nanosecond."""
        host = np.asarray(t_host_ns, dtype=np.int64)
        t = self.t_ref_s + 1e-9 * (host - self.host_ref_ns).astype(np.float64)
        for _ in range(6):  # rates are below 1 %: each step gains two digits
            t = t - 1e-9 * (self.to_host_ns(t) - host).astype(np.float64)
        return np.asarray(t)

    def to_host_ns(self, t_robot_s: Floats) -> Ints:
        """Return host times [ns] of controller times (n,) [s], late by the shortest latency of the link."""
        dt = 1e9 * (np.asarray(t_robot_s, dtype=np.float64) - self.t_ref_s)
        place = np.interp(t_robot_s, self.centre_s, np.arange(len(self.centre_s)))
        left = np.minimum(place.astype(int), max(0, len(self.centre_s) - 2))
        right = np.minimum(left + 1, len(self.centre_s) - 1)
        here, there = (self.offset_ns[k] + self.rate[k] * dt for k in (left, right))
        correction = here + (place - left) * (there - here)
        return np.asarray(self.host_ref_ns + np.rint(dt).astype(np.int64) + np.rint(correction).astype(np.int64))


@dataclass(frozen=True)
class EdgeReport:
    """Results from the edges of the box's trigger output for one segment of controller time.

    ``shortest_latency_ns`` is the delay of the arrivals' clock relative to the edges' clock in the middle of the segment,
    which arrivals alone cannot show. Its error is at most the sum of ``bound_ns`` and the bound of the arrivals' clock.
    If the input's shorter delay exceeds the range of ``trigger_edges``, the excess is included.
    """

    input: int | None  # of the controller, following the output; None: no input does
    inverted: bool  # it goes low when the output goes high
    edges: int  # edges of the box's output while the controller sent readings
    used: int
    unseen: int  # edges not visible in any reading
    unclear: int  # edges and changes of the input that cannot be distinguished: bounces, missing readings
    stray: int  # changes of the input without a matching edge
    rejected: int  # edges that contradict the others
    falling_later_ns: tuple[
        float, float
    ]  # falling edges of the output are seen later than rising ones by, at least and at most; NaN if unknown
    to_box_ns: float  # bound between controller and box, which the edges alone give; median; NaN if none is used
    bound_ns: float  # largest bound between controller and host, with that of the box's clock; NaN if none is used
    shortest_latency_ns: float  # NaN if none is used
    in_use: bool  # the robot's readings are timed by the edges, not by their arrivals


@dataclass(frozen=True)
class RobotClockReport:
    """How well a segment of controller time is tied to host time. A constant latency cannot be known and is not
    included.
    """

    segment: int
    readings: int
    t_robot_s: tuple[float, float]  # first and last
    rate_ppm: float  # how much faster the host counts than the controller, mean
    rate_range_ppm: float
    spread_ns: float  # disagreement of neighbouring windows half-way, RMS over √2; NaN for one window
    jitter_ns: float  # mean height of the arrivals above the line; median over the half windows
    windows: int
    bound_ns: float  # largest of the clock in use; for arrivals excluding the shortest latency
    edges: EdgeReport | None = None  # of a trigger wire, if the box toggled one


@dataclass
class Arrivals:
    """Collects (controller time, arrival) of one segment; keeps the hull of each second instead of the readings."""

    t_ref_s: float
    host_ref_ns: int
    readings: int = 0
    first_s: float = float("inf")
    last_s: float = float("-inf")
    hulls: dict[int, Floats] = field(default_factory=dict)  # block → corners (c, 2): dt [s], latency + const [ns]
    sums: dict[int, Floats] = field(default_factory=dict)  # half window → (3,): sums of 1, dt, latency

    def add(self, t_robot_s: Floats, t_host_ns: Ints) -> None:
        """Take readings (n,) in order of arrival."""
        dt = t_robot_s - self.t_ref_s
        latency = (t_host_ns - self.host_ref_ns - np.rint(1e9 * dt).astype(np.int64)).astype(np.float64)
        block = np.floor(dt / BLOCK_S).astype(np.int64)
        starts = np.flatnonzero(np.diff(block, prepend=block[:1] - 1))
        for key, (a, b) in zip(block[starts].tolist(), pairwise([*starts.tolist(), dt.size]), strict=True):
            half = int(key * BLOCK_S // HALF_WINDOW_S)
            of_run = np.array([b - a, np.add.reduce(dt[a:b]), np.add.reduce(latency[a:b])])
            self.sums[half] = self.sums.get(half, np.zeros(3)) + of_run
        keys = np.unique(block[starts]).tolist()
        known = [self.hulls[key] for key in keys if key in self.hulls]
        x, y = (np.concatenate([*(old[:, k] for old in known), column]) for k, column in enumerate((dt, latency)))
        of = np.concatenate([np.floor(old[:, 0] / BLOCK_S) for old in known] + [block]).astype(np.int64)
        corners = lower_hulls(x, y, of)
        edges = np.searchsorted(of[corners], [*keys, keys[-1] + 1]).tolist()
        points = np.stack([x[corners], y[corners]], axis=1)
        self.hulls.update((key, points[a:b].copy()) for key, (a, b) in zip(keys, pairwise(edges), strict=True))
        self.readings += dt.size
        self.first_s = min(self.first_s, float(t_robot_s[0]))
        self.last_s = max(self.last_s, float(t_robot_s[-1]))


def fit_robot_clock(segment: int, arrivals: Arrivals) -> tuple[RobotClock, RobotClockReport]:
    """Return the clock of one segment of controller time and its report. ``arrivals`` must hold a reading."""
    keys = sorted(arrivals.sums)
    blocks: dict[int, list[Floats]] = {key: [] for key in keys}
    for block, corners in arrivals.hulls.items():
        blocks[int(block * BLOCK_S // HALF_WINDOW_S)].append(corners)
    pairs = [(a, b) for a, b in pairwise(keys) if b == a + 1] or [(keys[0], keys[0])]
    alone = [(k, k) for k in keys if not any(k in pair for pair in pairs)]
    windows = sorted(pairs + alone)
    seconds = [[second for key in sorted(set(pair)) for second in blocks[key]] for pair in windows]
    points = np.concatenate([second for each in seconds for second in each])
    sizes = [sum(map(len, each)) for each in seconds]
    window = np.repeat(np.arange(len(windows)), sizes)
    hull = lower_hulls(points[:, 0], points[:, 1], window)
    hulls = np.split(points[hull], np.searchsorted(window[hull], np.arange(1, len(windows))))
    lines = np.array([_line(arrivals, *of) for of in zip(windows, seconds, hulls, strict=True)])
    centre, offset, rate, bound = lines.T
    bound = _with_disagreement(lines)
    clock = RobotClock(arrivals.t_ref_s, arrivals.host_ref_ns, arrivals.t_ref_s + centre, offset, rate, bound)
    return clock, _report(segment, arrivals, lines, float(np.max(bound)))


def _line(
    arrivals: Arrivals, pair: tuple[int, int], each: list[Floats], hull: Floats
) -> tuple[float, float, float, float]:
    """Return centre [s], offset [ns], rate and bound [ns] of the line under two half windows.

    ``each``: the corners (c, 2) of their seconds, dt [s] and latency [ns]; ``hull``: the lower hull of all of these.
    """
    corners = np.concatenate(each)
    count, dt_sum, latency_sum = np.sum([arrivals.sums[key] for key in sorted(set(pair))], axis=0)
    dt, latency = corners[:, 0], corners[:, 1]
    offset, per_second = line_under(hull[:, 0], hull[:, 1], dt_sum / count)
    if abs(per_second) > 1e9 * MAX_RATE:
        offset, per_second = float(np.min(latency)), 0.0
    # The height of the fastest packet of each second above the line; if there are too few seconds, all packets count.
    fastest = [float(np.min(block[:, 1] - offset - per_second * block[:, 0])) for block in each]
    height = float(np.mean(fastest)) * max(1.0, LEAST_BLOCKS / len(each))
    if len(each) < 3:
        height = (latency_sum - count * offset - per_second * dt_sum) / count
    reach_ns = 0.5e9 * (dt.max() - dt.min())
    runs = np.min(sliding_window_view(np.array(fastest), min(RUN, len(fastest))), axis=1)
    bound = max(2.0 * height, TILTED * float(np.max(runs))) + 0.5e-9 * DRIFT * reach_ns**2 + ROUNDING_NS
    return float(0.5 * (dt.min() + dt.max())), offset, 1e-9 * per_second, bound


def _with_disagreement(lines: Floats) -> Floats:
    """Return the bounds (k,) of the windows, each at least the disagreement with a neighbour half-way beyond both
    bounds.
    """
    own, apart = lines[:, 3], np.abs(_steps(lines))
    torn = np.where(apart > own[1:] + own[:-1], apart, 0.0)
    return np.asarray(own + np.maximum(np.concatenate([[0.0], torn]), np.concatenate([torn, [0.0]])))


def _steps(lines: Floats) -> Floats:
    """Return the differences (k − 1,) [ns] of neighbouring windows' lines half-way between their centres."""
    centre, offset, rate, _ = lines.T
    halfway = 0.5 * (centre[1:] + centre[:-1])
    here, there = (offset[k] + 1e9 * rate[k] * halfway for k in (slice(None, -1), slice(1, None)))
    return np.asarray(there - here)


def _report(segment: int, arrivals: Arrivals, lines: Floats, bound_ns: float) -> RobotClockReport:
    rate = lines[:, 2]
    spread = float(np.sqrt(np.mean(np.square(_steps(lines))) / 2.0)) if len(lines) > 1 else float("nan")
    return RobotClockReport(
        segment=segment,
        readings=arrivals.readings,
        t_robot_s=(arrivals.first_s, arrivals.last_s),
        rate_ppm=float(PPM.of(np.mean(rate))),
        rate_range_ppm=float(PPM.of(np.ptp(rate))),
        spread_ns=spread,
        jitter_ns=float(np.median(_mean_heights(arrivals, lines))),
        windows=len(lines),
        bound_ns=bound_ns,
    )


def _mean_heights(arrivals: Arrivals, lines: Floats) -> Floats:
    """Return the mean latency [ns] above the nearest window's line, for each half window."""
    count, dt, latency = np.array(list(arrivals.sums.values())).T
    nearest = lines[np.argmin(np.abs(lines[:, :1] - dt / count), axis=0)]
    return np.asarray(latency / count - nearest[:, 1] - 1e9 * nearest[:, 2] * dt / count)


def lower_hulls(x: Floats, y: Floats, group: NDArray[np.integer[Any]]) -> NDArray[np.intp]:
    """Return the indices, by ascending group and x, of the corners of the lower hull of each group of n ≥ 1 points.

    Quickhull on points sorted by x: the lowest point below a chord is a corner and splits the rest into two slices
    (Barber, Dobkin, Huhdanpaa, "The quickhull algorithm", 1996). All chords of one level are processed together.
    """
    order = np.lexsort((y, x, group))
    xs, groups = x[order], group[order]
    other = np.flatnonzero((np.diff(groups) != 0) | (np.diff(xs) > 0)) + 1  # for equal x, the lowest y
    order = order[np.concatenate([[0], other])]
    xs, ys, groups = x[order], y[order], group[order]
    begins = np.concatenate([[0], np.flatnonzero(np.diff(groups)) + 1])
    left, right = begins, np.append(begins[1:], len(order)) - 1
    is_corner = np.zeros(len(order), dtype=bool)
    is_corner[left] = is_corner[right] = True
    while True:
        long = right - left > 1
        left, right = left[long], right[long]
        if not left.size:
            return np.asarray(order[is_corner])
        slope = (ys[right] - ys[left]) / (xs[right] - xs[left])
        inner = right - left - 1
        first = np.cumsum(inner) - inner
        chord = np.repeat(np.arange(left.size), inner)
        point = np.arange(chord.size) - first[chord] + left[chord] + 1
        below = ys[point] - ys[left][chord] - slope[chord] * (xs[point] - xs[left][chord])
        least = np.minimum.reduceat(below, first)
        lowest = np.flatnonzero(below == least[chord])
        split = np.flatnonzero(least < 0.0)
        corner = point[lowest[np.searchsorted(chord[lowest], split)]]
        is_corner[corner] = True
        left, right = np.concatenate([left[split], corner]), np.concatenate([corner, right[split]])


def line_under(x: Floats, y: Floats, middle: float) -> tuple[float, float]:
    """Return (offset, rate) of the line under all points that is nearest to them on average.

    ``x``, ``y`` (c,): the corners of the points' lower hull by ascending x. ``middle``: the mean x of the points. The
    mean distance of a line under the points is its distance there, so the best line is the edge of the hull there. The
    rate is 0 for a single point.
    """
    if x.size == 1:
        return float(y[0]), 0.0
    edge = int(np.clip(np.searchsorted(x, middle) - 1, 0, x.size - 2))
    (x0, x1), (y0, y1) = x[edge : edge + 2], y[edge : edge + 2]
    with np.errstate(
        over="ignore", invalid="ignore"
    ):  # times may differ by almost nothing; the rate is then not finite
        rate = float((y1 - y0) / (x1 - x0))
        return float(y0 - rate * x0), rate
