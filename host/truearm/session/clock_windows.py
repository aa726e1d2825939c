"""Fit lines between two-sided bounds on one clock's time as a function of another's, in overlapping windows.

A row (t0, t1, t2, t3) bounds the host time h(d) at device time d: h(t1 + 1 µs) ≥ t0 and h(t2) ≤ t3. Device time counts
whole microseconds, so the true instant lies up to one microsecond after t1. Within a window of 60 s the estimate of h
is a line, a + (1 + r) d with |r| ≤ 1000 ppm. It is the line with the largest margin to both bounds,

    max over r of  U(r) − L(r),    U(r) = min(t3 − (1 + r) t2),    L(r) = max(t0 − (1 + r)(t1 + 1 µs)),

with a half-way between. U − L is concave and piecewise linear in r, and it bends only at the slopes of the edges of two
convex hulls. The optimum therefore follows exactly from a few dozen candidates, without iteration.

The rate h′ is assumed to change by no more than DRIFT, 1 ppm per minute. Then, at a distance x from the window's
centre, h stays within ½ · DRIFT · x² of its tangent at the centre: 7.5 µs at the ends of 60 s. The tangent is therefore
among the lines that satisfy all bounds once these are widened by that amount. Such lines form a convex polygon in (a,
r). A window's bound is the largest distance of any of them from the estimate, plus ½ · DRIFT · x².

Windows overlap by half. Between the centres of two neighbours, their lines are blended linearly, and so are their
bounds. Thus h has no steps.

A row is rejected if no line can satisfy its widened bounds together with those of the other rows. A linear program
finds such rows by minimising the sum of violations. If two neighbours or more than a fifth of the rows would be
rejected, the clock was not steady and the window is halved. A row that remains rejected may still be right, so the
window's bound is extended to the farthest point that the row allows.

**Hulls.** A line y = offset + rate · x lies under all points exactly if it lies under the corners of their lower hull.
Thousands of points have about a dozen corners, so each further question can be answered exactly by checking all
corners.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from truearm.types import Floats, Ints


def lower_hull(x: Floats, y: Floats) -> NDArray[np.intp]:
    """Return the indices, by ascending x, of the corners of the lower hull of n ≥ 1 points."""
    return lower_hulls(x, y, np.zeros(x.size, dtype=np.intp))


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


# -------------------------------------------------------------------------------------------------------------- windows

WINDOW_US = 60_000_000
SHORTEST_WINDOW_US = 4_000_000
MAX_REJECTED = 0.2  # share of a window's rows
RATE_LIMIT = 1e-3  # crystals stay within 100 ppm, a slewed host clock within 500
TICK_US = 1
ROUNDING_NS = 1.0  # stamps are whole ns, and the linear program's tolerance is far below one


DRIFT = 1e-6 / 60.0  # 1/s: a rate changes by no more than 1 ppm a minute


def slack_ns(from_centre_ns: Floats) -> Floats:
    """Return how far [ns] a clock that satisfies DRIFT may be from its tangent in a window's centre."""
    return 0.5e-9 * DRIFT * np.square(from_centre_ns)


@dataclass(frozen=True)
class Window:
    """host = host_ref_ns + dx + offset_ns + rate · dx, dx = 1000 · (device − device_ref_us)."""

    device_ref_us: int
    host_ref_ns: int
    offset_ns: float
    rate: float
    margin_ns: float  # to the bounds without slack; negative where the clock bends
    centre_us: int
    rejected_us: tuple[int, ...]  # t1 of the rejected exchanges
    reach_ns: float  # the farthest that these allow; 0 if there are none
    kept: Ints  # (n, 4) the rows

    @cached_property
    def lines(self) -> Floats:
        """Return offset_ns and rate (v, 2) of the corners of the set of lines that may be the tangent in the centre."""
        rates, low, high = _widened_candidates(self.kept, self.device_ref_us, self.host_ref_ns, self.centre_us)
        short = min(0.0, 0.5 * float(np.max(high - low)))  # at most rounding, otherwise there would be no window
        return _corners(rates, low + short, high - short)

    def to_host_ns(self, t_us: Ints) -> tuple[Ints, Floats]:
        """Return the host times [ns] of device times (n,) and the bounds of their errors [ns]."""
        whole = 1000 * (t_us - self.device_ref_us)  # exact; only small values become floats
        dx = whole.astype(np.float64)
        correction = self.offset_ns + self.rate * dx
        others = self.lines[:, :1] + self.lines[:, 1:] * dx
        bend = slack_ns((1000 * (t_us - self.centre_us)).astype(np.float64))
        bound = np.max(np.abs(others - correction), axis=0) + bend + self.reach_ns
        return self.host_ref_ns + whole + np.rint(correction).astype(np.int64), bound


def windows_of(sane: Ints, window_us: int = WINDOW_US) -> tuple[Window, ...]:
    """Return the lines, in overlapping windows, that exchanges (n, 4) in order of t1 allow, by ascending centre."""
    return tuple(_distinct([window for part in _overlapping(sane, window_us) for window in _fit_or_halve(part)]))


def _distinct(windows: list[Window]) -> list[Window]:
    """Return the windows by ascending centre without duplicates; halves of neighbours may coincide."""
    return list({window.centre_us: window for window in sorted(windows, key=lambda w: w.centre_us)}.values())


def _overlapping(sane: Ints, window_us: int) -> list[Ints]:
    """Yield the exchanges of each window; windows overlap by half."""
    if not len(sane):
        return []
    t1 = sane[:, 1]
    steps = max(0, -(-(int(t1[-1] - t1[0]) - window_us) // (window_us // 2))) + 1
    if steps > len(sane) + 1:  # exchanges years apart: a damaged file must not cost memory
        return [sane]
    starts = t1[0] + np.arange(steps) * (window_us // 2)
    first, last = np.searchsorted(t1, starts), np.searchsorted(t1, starts + window_us, side="right")
    return [sane[i:j] for i, j in zip(first, last, strict=True) if j > i]


def _fit_or_halve(part: Ints) -> list[Window]:
    """Return one window if a line fits all but isolated exchanges, else the windows of both halves."""
    keep = np.ones(len(part), dtype=bool)
    window = fit_line(part, keep)
    if window is not None:
        return [window]
    keep = consistent(part)
    span = int(part[-1, 1] - part[0, 1])
    unsteady = np.mean(keep) < 1.0 - MAX_REJECTED or bool(np.any(~keep[1:] & ~keep[:-1]))
    if unsteady and span > SHORTEST_WINDOW_US:
        middle = max(1, int(np.searchsorted(part[:, 1], part[0, 1] + span // 2)))
        return [*_fit_or_halve(part[:middle]), *_fit_or_halve(part[middle:])]
    window = fit_line(part, keep)
    return [] if window is None else [window]


class Points(NamedTuple):
    """Points that a line must lie above (low) and below (high); y is host − device, both relative to references."""

    x_low: Floats
    y_low: Floats
    x_high: Floats
    y_high: Floats

    def widened(self, centre: float) -> Points:
        """Return the points widened by how far a clock that satisfies DRIFT may be from its tangent at x = centre."""
        low, high = slack_ns(self.x_low - centre), slack_ns(self.x_high - centre)
        return Points(self.x_low, self.y_low - low, self.x_high, self.y_high + high)


def _points(part: Ints, device_ref: int, host_ref: int) -> Points:
    x_low, x_high = 1000 * (part[:, 1] + TICK_US - device_ref), 1000 * (part[:, 2] - device_ref)
    y_low, y_high = part[:, 0] - host_ref - x_low, part[:, 3] - host_ref - x_high
    return Points(x_low.astype(float), y_low.astype(float), x_high.astype(float), y_high.astype(float))


def _centre(part: Ints) -> int:
    return int(part[0, 1] + part[-1, 1]) // 2


def fit_line(part: Ints, keep: NDArray[np.bool_]) -> Window | None:
    """Return the line with the largest margin; None if no line satisfies the widened bounds of the exchanges kept."""
    if not np.any(keep):
        return None
    used, centre = part if np.all(keep) else part[keep], _centre(part)
    device_ref, host_ref = int(used[len(used) // 2, 1]), int(used[len(used) // 2, 0])
    offset, rate, margin = _middle(*_candidates(_points(used, device_ref, host_ref)))
    if margin < -ROUNDING_NS:
        _, low, high = _widened_candidates(used, device_ref, host_ref, centre)
        if float(np.max(high - low)) < -2.0 * ROUNDING_NS:
            return None
    reach = _reach(_points(part[~keep], device_ref, host_ref), offset, rate)
    rejected = tuple(part[~keep, 1].tolist())
    return Window(device_ref, host_ref, offset, rate, margin, centre, rejected, reach, used)


def _widened_candidates(used: Ints, device_ref: int, host_ref: int, centre: int) -> tuple[Floats, Floats, Floats]:
    return _candidates(_points(used, device_ref, host_ref).widened(1e3 * (centre - device_ref)))


def _middle(rates: Floats, low: Floats, high: Floats) -> tuple[float, float, float]:
    """Return offset, rate and margin of the line that is farthest from both bounds."""
    widest = float(np.max(high - low))
    # Device stamps are whole ticks, so margins that differ by less carry no information: take the middle of all such
    # rates.
    best = rates[high - low >= widest - 1000.0 * TICK_US]
    rate = float(0.5 * (best[0] + best[-1]))
    return float(np.interp(rate, rates, 0.5 * (low + high))), rate, 0.5 * widest


def _reach(rejected: Points, offset: float, rate: float) -> float:
    """Return the largest distance from the line that exchanges allow."""
    low = rejected.y_low - offset - rate * rejected.x_low
    high = rejected.y_high - offset - rate * rejected.x_high
    return float(np.max(np.abs([low, high]), initial=0.0))


def _candidates(points: Points) -> tuple[Floats, Floats, Floats]:
    """Return the rates at which U − L can bend, ascending, and L and U there."""
    x_low, y_low, x_high, y_high = points
    below, above = lower_hull(x_low, -y_low), lower_hull(x_high, y_high)
    x_low, y_low, x_high, y_high = x_low[below], y_low[below], x_high[above], y_high[above]
    edges = np.concatenate([np.diff(y_low) / np.diff(x_low), np.diff(y_high) / np.diff(x_high)])
    rates = np.unique(np.concatenate([[-RATE_LIMIT, RATE_LIMIT], edges[np.abs(edges) < RATE_LIMIT]]))
    low = np.max(y_low - rates[:, None] * x_low, axis=1)
    high = np.min(y_high - rates[:, None] * x_high, axis=1)
    return rates, low, high


def _corners(rates: Floats, low: Floats, high: Floats) -> Floats:
    """Return the corners (offset, rate) of the polygon L ≤ offset ≤ U: both curves where U ≥ L, and where they cross."""
    gap = high - low
    inside = np.flatnonzero(gap >= 0.0)
    crossings = []
    for i, j in ((inside[0] - 1, inside[0]), (inside[-1] + 1, inside[-1])):
        if 0 <= i < len(rates):
            share = gap[j] / (gap[j] - gap[i])
            crossings.append((high[j] + share * (high[i] - high[j]), rates[j] + share * (rates[i] - rates[j])))
    lower, upper = np.stack([low, rates], axis=1)[inside], np.stack([high, rates], axis=1)[inside]
    return np.concatenate([lower, upper, np.array(crossings).reshape(-1, 2)])


def consistent(part: Ints) -> NDArray[np.bool_]:
    """Return a mask of the exchanges satisfied, after widening, by the line with the least sum of violations."""
    from scipy.optimize import linprog  # type: ignore[attr-defined]  # takes 0.1 s, and steady clocks do without

    middle = part[len(part) // 2]
    points = _points(part, int(middle[1]), int(middle[0]))
    x_low, y_low, x_high, y_high = points.widened(1e3 * (_centre(part) - int(middle[1])))
    n = len(part)
    scale = max(1.0, float(np.ptp(x_high)))  # rate · scale has the magnitude of an offset
    slack = np.tile(-np.eye(n), (2, 1))
    line = np.concatenate([np.stack([-np.ones(n), -x_low / scale], 1), np.stack([np.ones(n), x_high / scale], 1)])
    solution = linprog(
        np.concatenate([[0.0, 0.0], np.ones(n)]),
        A_ub=np.concatenate([line, slack], axis=1),
        b_ub=np.concatenate([-y_low, y_high]),
        bounds=[(None, None), (-RATE_LIMIT * scale, RATE_LIMIT * scale), *[(0.0, None)] * n],
        method="highs",
    )
    if solution.x is None:
        return np.zeros(n, dtype=bool)
    return np.asarray(solution.x[2:] <= ROUNDING_NS)


class _Lines(NamedTuple):
    """The lines of k windows."""

    centre_us: Ints
    device_ref_us: Ints
    host_ref_ns: Ints
    offset_ns: Floats
    rate: Floats

    @classmethod
    def of(cls, windows: Sequence[Window]) -> _Lines:
        whole = np.array([(w.centre_us, w.device_ref_us, w.host_ref_ns) for w in windows], dtype=np.int64)
        return cls(*whole.T, *np.array([(w.offset_ns, w.rate) for w in windows]).T)

    def host_ns(self, k: NDArray[np.intp], t_us: Ints) -> Ints:
        """Return the host times (n,) of device times by the lines k (n,)."""
        whole = 1000 * (t_us - self.device_ref_us[k])  # exact; only small values become floats
        return np.asarray(
            self.host_ref_ns[k] + whole + np.rint(self.offset_ns[k] + self.rate[k] * whole).astype(np.int64)
        )


def host_by_lines(windows: Sequence[Window], t_us: Ints) -> Ints:
    """Return the host times [ns] by the lines of the two windows around each device time (n,)."""
    lines = _Lines.of(windows)
    centre, last = lines.centre_us, len(windows) - 1
    left = np.clip(np.searchsorted(centre, t_us, side="right") - 1, 0, last)
    right = np.minimum(left + 1, last)
    weight = np.clip((t_us - centre[left]) / np.maximum(centre[right] - centre[left], 1), 0.0, 1.0)
    host = lines.host_ns(left, t_us)
    return np.asarray(host + np.rint(weight * (lines.host_ns(right, t_us) - host)).astype(np.int64))


def disagreements(windows: Sequence[Window]) -> Ints:
    """Return the differences (k − 1,) [ns] between neighbouring lines half-way between their centres."""
    lines, k = _Lines.of(windows), np.arange(len(windows) - 1)
    halfway = (lines.centre_us[:-1] + lines.centre_us[1:]) // 2
    return lines.host_ns(k, halfway) - lines.host_ns(k + 1, halfway)


def blended(windows: Sequence[Window], t_us: Ints) -> tuple[Ints, Floats]:
    """Return the host times [ns] by the two windows around each device time (n,), and the bound [ns] from their lines."""
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
    # These windows contradict each other or their exchanges. One of them is right, but it is not known which.
    torn = np.maximum(bound + weight * np.abs(apart), next_bound + (1.0 - weight) * np.abs(apart))
    doubtful = (np.abs(apart) > bound + next_bound) | bool(windows[k].rejected_us or windows[k + 1].rejected_us)
    mixed = np.where(doubtful & (weight > 0.0) & (weight < 1.0), torn, mixed)
    return host + np.rint(weight * apart).astype(np.int64), mixed
