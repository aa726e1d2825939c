"""Relate robot controller time to host time by the edges of a trigger wire.

The box toggles a digital input of the controller at random times and stamps each edge. An edge at host time h
changed the input between two readings, with the controller times ``before`` and ``after``. So the controller showed
``after`` at a host time from h to h + (after − before), plus the delay of the input: a row of ``truearm.clocks``.
Polarity and the delay of each direction are unknowns of the fit (docs/decisions/0016-trigger-edges.md).

**Matching edges** uses the clocks that are already known, to within TOLERANCE_S. A change of the input and an edge are
matched if neither could belong to another one and all have the same polarity, or all the opposite one. Others are
counted and not used, as are edges that contradict the others: wrong matches, or bounces between two readings.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from truearm.clocks import WANDER, Clock, fit
from truearm.session.clock import NODE_S, DeviceClock, EdgeReport, RobotClock, host_times
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


# an edge of the output, the error of its time
EDGE = np.dtype([("host_ns", "i8"), ("bound_ns", "f8"), ("rising", "?")])


class Matched(NamedTuple):
    """Index of the input change that matches each edge (n,) of the output (−1: unknown), and how many are ambiguous."""

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


def fit_edges(
    report: EdgeReport,
    arrivals: RobotClock,
    edges: NDArray[Any],
    before_s: Floats,
    after_s: Floats,
    span_s: tuple[float, float],
    wander: float = WANDER,
) -> tuple[RobotClock, EdgeReport]:
    """Return the clock from edges (n ≥ 1,) of EDGE between readings before and after (n,) [s], and the report.

    ``arrivals``, of which ``span_s`` is the time, converts the short time between these readings, and is compared with
    the result. ``wander``: of the host's clock.
    """
    course_wander = COURSE_WANDER if wander == WANDER else None
    stamps, until_ns = arrivals.stamps(after_s), arrivals.to_host_ns(after_s) - arrivals.to_host_ns(before_s)
    # No delay is negative, and the shorter one is at most SHORTEST_DELAY_NS: half of it is added, half is a bound.
    host_ns = edges["host_ns"] + round(0.5 * SHORTEST_DELAY_NS)
    rows = np.stack([stamps, host_ns + until_ns + STAMP_NS, host_ns - STAMP_NS])

    def clock_of(rows: Ints) -> Clock:
        fitted = fit(*rows, wander=wander, course_wander=course_wander)
        assert fitted is not None  # there is a row
        return fitted

    directions = [clock_of(rows[:, k]) for k in (edges["rising"], ~edges["rising"]) if k.any()]
    agreeing = ~np.isin(stamps, np.concatenate([clock.wrong for clock in directions]))
    rows, rising = rows[:, agreeing], edges["rising"][agreeing]
    widest = likely = directions[0]
    later = (np.nan, np.nan)
    for _ in range(ROUNDS if len(directions) == 2 else 0):
        if len(widest.steady) > 1:  # a clock stepped
            break
        later = _falling_later(widest, rows, rising)
        smallest, largest = sorted(later)
        middle = 0.5 * (smallest + largest)
        widest, likely = (clock_of(rows + _delayed(rising, *d)) for d in ((smallest, largest), (middle, middle)))
    nodes = np.linspace(*span_s, max(2, round((span_s[1] - span_s[0]) / NODE_S) + 1))
    (centre_ns, reach), (host_ns, _) = (fitted.to_time(arrivals.stamps(nodes)) for fitted in (widest, likely))
    to_box_ns = reach + np.abs(host_ns - centre_ns) + 0.5 * SHORTEST_DELAY_NS
    nearest = np.clip(np.searchsorted(edges["host_ns"], host_ns), 1, len(edges) - 1)
    box_ns = np.maximum(edges["bound_ns"][nearest - 1], edges["bound_ns"][nearest])
    clock = RobotClock(arrivals.t_ref_s, likely, nodes, to_box_ns + box_ns)
    rejected = len(edges) - rising.size + widest.wrong.size
    centre_s = np.array([0.5 * sum(span_s)])
    return clock, replace(
        report,
        used=len(edges) - rejected,
        rejected=rejected,
        falling_later_ns=later,
        to_box_ns=float(np.median(to_box_ns)),
        bound_ns=float(np.max(clock.bound_ns)),
        shortest_latency_ns=float((arrivals.to_host_ns(centre_s) - clock.to_host_ns(centre_s))[0]),
        in_use=float(np.median(clock.bound_ns)) <= float(np.median(arrivals.bound_ns)) + LATENCY_NS,
    )


def _delayed(rising: NDArray[np.bool_], low: float, high: float) -> Ints:
    """Return what to add to rows (3, n), so that all are of the direction with the shorter delay, whichever that is.

    Falling edges are seen later than rising ones by least to most [ns].
    """
    latest = np.where(rising, max(0.0, -low), max(0.0, high))
    earliest = np.where(rising, max(0.0, -high), max(0.0, low))
    return np.rint([np.zeros(rising.size), latest, earliest]).astype(np.int64)


def _falling_later(clock: Clock, rows: Ints, rising: NDArray[np.bool_]) -> tuple[float, float]:
    """Return how much later falling edges are seen than rising ones, at least and at most.

    The difference is constant, so each edge limits it by all edges of the other direction, which the rates of a clock
    move to it.
    """
    early, late = (clock.relative_to_course(*rows[:, k]) for k in (rising, ~rising))
    x = np.concatenate([early.x, late.x])
    (lowest, highest), (lowest_falling, highest_falling) = early.range(x), late.range(x)
    return float(np.max(lowest - highest_falling)), float(np.min(highest - lowest_falling))


def with_edges(
    joints: JointStream,
    output: Sequence[tuple[int, int, int]],
    clocks: Mapping[int, DeviceClock],
    wander: float = WANDER,
) -> JointStream:
    """Return the readings, with clocks from edges wherever these are more accurate than arrivals.

    ``output``: edges of the box's trigger output: segment of the box, device time [µs] and level. ``clocks``: of these
    segments. ``wander``: of the host's clock.
    """
    segment, t_us, level = np.array(output, np.int64).reshape(-1, 3).T
    edges = np.zeros(len(level), EDGE)
    edges["host_ns"], edges["bound_ns"] = host_times(clocks, segment, t_us)
    edges["rising"] = level
    edges = edges[np.isfinite(edges["bound_ns"])]
    if not len(edges):
        return joints
    clocks_in_use, reports = [], []
    for k, report in enumerate(joints.reports):
        clock, edge_report = _of_segment(k, joints, edges, wander)
        clocks_in_use.append(clock)
        reports.append(replace(report, edges=edge_report, bound_ns=float(np.max(clock.bound_ns))))
    return replace(joints, clocks=tuple(clocks_in_use), reports=tuple(reports))


def _of_segment(
    k: int, joints: JointStream, edges: NDArray[Any], wander: float
) -> tuple[RobotClock, EdgeReport | None]:
    """Return the clock of one segment of controller time and the report on its edges."""
    arrivals, track, span_s = joints.clocks[k], joints.inputs[k], joints.reports[k].t_robot_s
    expected_s = arrivals.to_robot_s(edges["host_ns"])
    sent = (expected_s >= span_s[0]) & (expected_s <= span_s[1])  # while the controller sent readings
    edges, expected_s = edges[sent], expected_s[sent]
    if not len(edges) or track.last is None:
        return arrivals, None
    number, inverted, matched = _followed(track, expected_s, edges["rising"])
    report = EdgeReport(number, inverted, len(edges), *matched[1:])
    if number is None:
        return arrivals, report
    changes, paired = track.changes(number), matched.change >= 0
    change = matched.change[paired]
    readings_s = changes.before_s[change], changes.after_s[change]
    clock, report = fit_edges(report, arrivals, edges[paired], *readings_s, span_s, wander)
    return (clock if report.in_use else arrivals), report


def _followed(track: InputTrack, expected_s: Floats, rising: NDArray[np.bool_]) -> tuple[int | None, bool, Matched]:
    """Return the input that follows the output, None if none does, whether it is inverted, and its matches.

    It is the input, of the polarity, with the most unambiguous matches.
    """
    n = len(expected_s)
    candidates = (
        (number, inverted, match(expected_s, rising ^ inverted, track.changes(number)))
        for number in track.inputs()
        for inverted in (False, True)
    )
    none = None, False, Matched(np.full(n, -1, dtype=np.intp), n, 0, 0)
    best = max(candidates, key=lambda candidate: candidate[2].paired, default=none)
    return best if best[2].paired >= max(LEAST_USED, LEAST_SHARE * n) else none
