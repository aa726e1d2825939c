r"""Relate robot controller time to device time by the edges of a trigger wire.

The box toggles a digital input of the controller at random times (SPEC §6). Its hardware stamps each edge; the
controller's readings show between which two of them the input changed. An input is delayed differently in each
direction: an optocoupler switches on faster than off, and a filter adds to both. So the controller time c(d) at device
time d has two bounds, one cycle apart if no reading is missing::

    last reading with the old level  <  c(edge) + delay of that direction  ≤  first reading with the new level

These are rows of ``truearm.clocks``, which fits the clock. Edges occur anywhere within a cycle, so n of them narrow the
uncertainty to a few nths of a cycle. Latency plays no role.

**Unknown** are the two delays, and whether the input is inverted. The controller sees falling edges later than rising
ones by a constant difference D, which may be negative. Edges of one direction, moved by the rates of the clock to those
of the other, limit D from both sides. With D, both directions bound one clock, that of the direction with the shorter
delay. Each narrows the other, so this is repeated.

**No edge shows a delay itself**, only the difference of the two: a delay common to both looks like an earlier clock. No
delay is negative, and the shorter one is assumed to be at most SHORTEST_DELAY_NS, as for an input without a filter. The
controller's clock therefore lies between the clock of the edges minus SHORTEST_DELAY_NS and that clock. That is the
**bound**. It holds if the shorter delay is within that range and the rate of the two clocks stays within COURSE_WANDER of
its mean over two minutes (both are crystals that nothing slews). Any excess of a filter's delay over the range is
constant and becomes part of the delay τ. So does any difference between the sampling instants of a reading's joints and
its inputs.

**Matching edges** uses the clocks that are already known (arrivals and exchanges), to within TOLERANCE_S. A change of
the input and an edge are matched if neither could belong to another one and all have the same polarity, or all the
opposite one. A bouncing contact or a gap in the readings makes several matches possible: these are left out and
counted. An edge that contradicts the others is left out: it was matched incorrectly or bounced between two readings.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from truearm.clocks import Clock, fit
from truearm.session.clock import NODE_S, DeviceClock, EdgeReport, RobotClock
from truearm.session.joint_readings import Changes, InputTrack, JointStream
from truearm.types import Floats, Ints

SHORTEST_DELAY_NS = 15_000.0  # upper limit for the shorter delay of an input: an optocoupler without a filter
TOLERANCE_S = 0.1  # possible delay of arrivals; less than half the time between edges
LEAST_USED = 3
LEAST_SHARE = 0.5  # of the edges: an input that matches fewer serves another purpose
COURSE_WANDER = 1e-6  # of the rate, from its mean over two minutes: two crystals that drift by less than 1 ppm a minute
ROUNDS = 4  # of the difference of the delays and the clock, each of which narrows the other
STAMP_NS = 1000  # edge stamps are at most 0.3 µs late; readings are printed to the microsecond
LATENCY_NS = 1e6  # shortest latency of a fast link: if the bounds are wider, arrivals are more accurate


Output = Sequence[tuple[int, bool]]  # edges of the box's trigger output in one segment: device time [µs], level


class TimedEdges(NamedTuple):
    """Edges (n,) of the output by ascending device time, each with the controller times [s] between which the input
    changed.
    """

    t_us: Ints
    level: NDArray[np.bool_]
    before_s: Floats
    after_s: Floats


class Matched(NamedTuple):
    """Index of the input change that matches each edge (n,) of the output, −1 if unknown, and the number of ambiguous
    ones.
    """

    change: NDArray[np.intp]
    unseen: int
    unclear: int
    stray: int

    @property
    def paired(self) -> int:
        """Number of matched edges."""
        return int(np.sum(self.change >= 0))


def match(expected_s: Floats, level: NDArray[np.bool_], changes: Changes) -> Matched:
    """Match edges expected at ascending controller times (n,) [s] with the changes of an input.

    ``level`` (n,): the new level of the input.
    """
    n = expected_s.size
    if not n:
        return Matched(np.empty(0, np.intp), 0, 0, changes.level.size)
    tolerance = min(TOLERANCE_S, 0.4 * float(np.min(np.diff(expected_s), initial=np.inf)))
    earliest, latest = changes.before_s - tolerance, changes.after_s + tolerance
    first, end = np.searchsorted(latest, expected_s), np.searchsorted(earliest, expected_s, side="right")
    of_edge = end - first
    of_change = np.searchsorted(expected_s, latest, side="right") - np.searchsorted(expected_s, earliest)
    alone = np.flatnonzero(of_edge == 1)
    alone = alone[of_change[first[alone]] == 1]
    alone = alone[level[alone] == changes.level[first[alone]]]
    change = np.full(n, -1, dtype=np.intp)
    change[alone] = first[alone]
    unseen, stray = int(np.sum(of_edge == 0)), int(np.sum(of_change == 0))
    return Matched(change, unseen, n - alone.size - unseen + changes.level.size - alone.size - stray, stray)


@dataclass(frozen=True)
class EdgeClock:
    """Device time → controller time within one segment, like ``DeviceClock`` for the host's; ns from ``t_ref_s``."""

    t_ref_s: float
    clock: Clock  # of the direction with the shorter delay
    best: Clock  # the same by the most likely difference of the delays

    def to_robot_s(self, t_us: Ints) -> tuple[Floats, Floats]:
        """Return controller times (n,) [s] of device times (n,) and the bounds (n,) [ns] of their errors."""
        stamps = 1000 * np.asarray(t_us, dtype=np.int64)
        middle, reach = self.clock.to_time(stamps)
        aside = np.clip(self.best.to_time(stamps)[0] - middle, -reach, reach)
        # No delay is negative, and the shorter one is at most SHORTEST_DELAY_NS.
        seen, bound = middle + aside - 0.5 * SHORTEST_DELAY_NS, reach + np.abs(aside) + 0.5 * SHORTEST_DELAY_NS
        return np.asarray(self.t_ref_s + 1e-9 * seen), bound


class EdgeFit(NamedTuple):
    """A clock from edges, the number of contradicting edges, and how much later falling output edges are than rising
    ones.
    """

    clock: EdgeClock
    rejected: int
    falling_later_ns: tuple[float, float]  # at least and at most; NaN if only one direction is usable


def fit_edges(t_ref_s: float, edges: TimedEdges) -> EdgeFit | None:
    """Fit the clock to edges (n,) of one segment; None if no edge is usable."""
    before, after = (np.rint(1e9 * (t - t_ref_s)).astype(np.int64) for t in (edges.before_s, edges.after_s))
    rows, rising = np.stack([1000 * edges.t_us, after + STAMP_NS, before - STAMP_NS]), edges.level
    alone = [clock for k in (rising, ~rising) if (clock := _fit(rows[:, k])) is not None]
    if not alone:
        return None
    right = ~np.isin(rows[0], np.concatenate([clock.wrong for clock in alone]))
    rows, rising = rows[:, right], rising[right]
    clock = best = alone[0]
    later = (np.nan, np.nan)
    for _ in range(ROUNDS if len(alone) == 2 else 0):
        if len(clock.steady) > 1:  # a clock stepped
            break
        later = _falling_later(clock, rows, rising)
        least, most = sorted(later)
        clock = _fit(_earlier_direction(rows, rising, least, most)) or clock
        best = _fit(_earlier_direction(rows, rising, 0.5 * (least + most), 0.5 * (least + most))) or clock
    rejected = len(right) - rising.size + clock.wrong.size
    return EdgeFit(EdgeClock(t_ref_s, clock, best), rejected, later)


def _earlier_direction(rows: Ints, rising: NDArray[np.bool_], least: float, most: float) -> Ints:
    """Return the rows of the earlier direction's clock, whichever that is: falling edges are later by least to most."""
    earliest, latest = (
        np.where(rising, min(0.0, least), min(0.0, -most)),
        np.where(rising, min(0.0, most), min(0.0, -least)),
    )
    return rows + np.rint([np.zeros(rising.size), latest, earliest]).astype(np.int64)


def _fit(rows: Ints) -> Clock | None:
    return fit(*rows, course_wander=COURSE_WANDER)


def _falling_later(clock: Clock, rows: Ints, rising: NDArray[np.bool_]) -> tuple[float, float]:
    """Return how much later falling edges are seen than rising ones, at least and at most.

    The difference of the delays is constant, so each edge limits it by all edges of the other direction, which the rates
    of a clock move to it.
    """
    early, late = (clock.relative_to_course(*rows[:, k]) for k in (rising, ~rising))
    x = np.concatenate([early.x, late.x])
    (least, most), (least_later, most_later) = early.range(x), late.range(x)
    return float(np.max(least_later - most)), float(np.min(most_later - least))


def with_edges(joints: JointStream, outputs: Mapping[int, Output], clocks: Mapping[int, DeviceClock]) -> JointStream:
    """Return the readings, with clocks from edges wherever these are more accurate than arrivals.

    ``outputs`` and ``clocks``: of the box's segments.
    """
    if not any(segment in clocks for segment in outputs):
        return joints
    fits = [_of_segment(k, joints, outputs, clocks) for k in range(len(joints.clocks))]
    return replace(
        joints,
        clocks=tuple(clock for clock, _ in fits),
        reports=tuple(
            replace(report, edges=edges, bound_ns=float(np.max(clock.bound_ns)))
            for report, (clock, edges) in zip(joints.reports, fits, strict=True)
        ),
    )


def _of_segment(
    k: int, joints: JointStream, outputs: Mapping[int, Output], clocks: Mapping[int, DeviceClock]
) -> tuple[RobotClock, EdgeReport | None]:
    """Return the clock of one segment of controller time and the report on its edges."""
    arrivals, track, span_s = joints.clocks[k], joints.inputs[k], joints.reports[k].t_robot_s
    edges = _expected(arrivals, outputs, clocks, span_s)
    if not len(edges) or not track.readings:
        return arrivals, None
    number, inverted, matched = _followed(track, edges)
    fits = {} if number is None else _fits(arrivals, track.changes(number), edges, matched)
    none = EdgeReport(
        number, inverted, len(edges), 0, *matched[1:], 0, (np.nan, np.nan), np.nan, np.nan, np.nan, in_use=False
    )
    if not fits:
        return arrivals, none
    clock, to_box_ns = _through_nodes(arrivals, fits, clocks, span_s)
    middle = np.array([0.5 * sum(span_s)])
    in_use = float(np.median(clock.bound_ns)) <= float(np.median(arrivals.bound_ns)) + LATENCY_NS
    rejected = sum(fitted.rejected for fitted in fits.values())
    report = replace(
        none,
        used=int(np.isin(edges["segment"][matched.change >= 0], list(fits)).sum()) - rejected,
        rejected=rejected,
        falling_later_ns=_common([fitted.falling_later_ns for fitted in fits.values()]),
        to_box_ns=float(np.median(to_box_ns)),
        bound_ns=float(np.max(clock.bound_ns)),
        shortest_latency_ns=float((arrivals.to_host_ns(middle) - clock.to_host_ns(middle))[0]),
        in_use=in_use,
    )
    return (clock if in_use else arrivals), report


def _common(ranges: Sequence[tuple[float, float]]) -> tuple[float, float]:
    """Return the intersection of all known ranges; NaN if none is known."""
    known = np.array([one for one in ranges if np.isfinite(one).all()]).reshape(-1, 2)
    return (float(np.max(known[:, 0])), float(np.min(known[:, 1]))) if len(known) else (np.nan, np.nan)


_EDGE = np.dtype([("expected_s", "f8"), ("t_us", "i8"), ("level", "?"), ("segment", "i8")])


def _expected(
    arrivals: RobotClock,
    outputs: Mapping[int, Output],
    clocks: Mapping[int, DeviceClock],
    span_s: tuple[float, float],
) -> NDArray[Any]:
    """Return the edges (n,) of _EDGE of all segments of the box, by ascending controller time expected from arrivals.

    They occurred while the controller sent readings.
    """
    tables = [np.empty(0, _EDGE)]
    for segment, output in outputs.items():
        if segment in clocks:
            table = np.array([(0.0, *edge, segment) for edge in output], _EDGE)
            table["expected_s"] = arrivals.to_robot_s(clocks[segment].to_host_ns(table["t_us"])[0])
            tables.append(table[(table["expected_s"] >= span_s[0]) & (table["expected_s"] <= span_s[1])])
    return np.sort(np.concatenate(tables), order="expected_s", kind="stable")


def _followed(track: InputTrack, edges: NDArray[Any]) -> tuple[int | None, bool, Matched]:
    """Return the input that follows the output, None if none does, whether it is inverted, and its matches.

    It is the input, of the polarity, with the most unambiguous matches.
    """
    n = len(edges)
    candidates = (
        (number, inverted, match(edges["expected_s"], edges["level"] ^ inverted, track.changes(number)))
        for number in track.inputs()
        for inverted in (False, True)
    )
    none = None, False, Matched(np.full(n, -1, dtype=np.intp), n, 0, 0)
    best = max(candidates, key=lambda candidate: candidate[2].paired, default=none)
    return best if best[2].paired >= max(LEAST_USED, LEAST_SHARE * n) else none


def _fits(arrivals: RobotClock, changes: Changes, edges: NDArray[Any], matched: Matched) -> dict[int, EdgeFit]:
    """Return the clock of each segment of the box with enough matched edges."""
    fits = {}
    for segment in np.unique(edges["segment"]).tolist():
        paired = (matched.change >= 0) & (edges["segment"] == segment)
        change = matched.change[paired]
        timed = TimedEdges(
            edges["t_us"][paired], edges["level"][paired], changes.before_s[change], changes.after_s[change]
        )
        fitted = fit_edges(arrivals.t_ref_s, timed) if len(change) >= LEAST_USED else None
        if fitted is not None:
            fits[segment] = fitted
    return fits


def _through_nodes(
    arrivals: RobotClock, fits: Mapping[int, EdgeFit], clocks: Mapping[int, DeviceClock], span_s: tuple[float, float]
) -> tuple[RobotClock, Floats]:
    """Convert controller time to host time via device time, computed every NODE_S.

    Also return, for each node, the part of the bound that is between controller and box [ns]: it is that of the edges
    alone, without the box's clock against the host's. Between nodes both clocks are practically straight: a drift of
    1 ppm a minute bends them by less than 1 µs in 10 s.
    """
    nodes = np.linspace(*span_s, max(2, round((span_s[1] - span_s[0]) / NODE_S) + 1))
    dt = np.rint(1e9 * (nodes - arrivals.t_ref_s)).astype(np.int64)
    best, to_box_ns = np.full(nodes.size, np.inf), np.full(nodes.size, np.nan)
    host = np.empty(nodes.size, np.int64)
    for segment, fitted in fits.items():
        d_us = fitted.clock.clock.to_stamp(dt) // 1000
        robot_s, of_robot = fitted.clock.to_robot_s(d_us)
        device_ns, of_device = clocks[segment].to_host_ns(d_us)
        here = of_robot + of_device < best
        best[here], to_box_ns[here] = (of_robot + of_device)[here], of_robot[here]
        # Device time is whole microseconds, and that of the estimate; the remainder is less than a cycle.
        host[here] = (device_ns + np.rint(1e9 * (nodes - robot_s)).astype(np.int64))[here]
    correction = (host - arrivals.host_ref_ns - dt).astype(np.float64)
    clock = RobotClock(arrivals.t_ref_s, arrivals.host_ref_ns, nodes, correction, best, source="edges")
    return clock, to_box_ns
