r"""Device time ↔ host time, after the fact, from the recorded exchanges (hop 4).

An exchange says four things: the host wrote at t0, the device had received at t1, it answered at t2, the host had the
answer at t3. Nothing can arrive before it was sent, whatever the link does meanwhile, so the host's time h(d) of device
time d keeps to two hard bounds::

    h(t1 + 1 µs) ≥ t0        (device time counts whole microseconds: the true instant lies up to one after t1)
    h(t2)        ≤ t3

Within a window of 60 s the crystals are taken as steady: h is a line, h = a + (1 + r) d with |r| ≤ 1000 ppm. All lines that
keep to all bounds form a convex polygon in (a, r). The estimate is the line with the largest margin to both bounds,

    max over r of  U(r) − L(r),    U(r) = min(t3 − (1 + r) t2),    L(r) = max(t0 − (1 + r)(t1 + 1 µs)),

with a half-way between. U − L is concave and piecewise linear in r, and it bends only at the slopes of the edges of two
convex hulls: the optimum and the whole polygon follow exactly from a few dozen candidates, without an iteration.

The **bound** on the error at a time is the farthest that any line of the polygon is from the estimate there. It contains
the half-asymmetry (± half the shortest round trip) that no exchange can show: if the way there takes constantly longer
than the way back the estimate is off by half the difference, and every exchange looks the same.

Windows overlap by half. Between the centres of two neighbours their lines are blended linearly, and so are their
bounds: h has no steps. ``spread`` is the root mean square of what neighbours disagree about half-way, over √2.

An exchange that no line can keep to together with the rest is rejected: the least sum of violations (a linear program)
finds it. If more than a fifth would go, the clock was not steady; the window is halved.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linprog  # type: ignore[attr-defined]

from truearm.sync.device_clock import DeviceClock, Ints, Window
from truearm.sync.frames import Exchange
from truearm.sync.hull import lower_hull
from truearm.types import Floats

WINDOW_US = 60_000_000
SHORTEST_WINDOW_US = 4_000_000
RATE_LIMIT = 1e-3  # crystals stay within 100 ppm, a slewed host clock within 500
TICK_US = 1
ROUNDING_NS = 1.0  # stamps are whole ns, and the linear program's tolerance is far below one
MAX_REJECTED = 0.2  # share of a window's exchanges


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
    windows = [window for part in _overlapping(sane) for window in _fit_or_halve(part)]
    if not windows:
        return None
    clock = DeviceClock(segment, tuple(_distinct(windows)))
    return clock, _report(clock, every, sane)


def _distinct(windows: list[Window]) -> list[Window]:
    """By ascending centre; halves of neighbours may share one."""
    return list({window.centre_us: window for window in sorted(windows, key=lambda w: w.centre_us)}.values())


def _overlapping(sane: Ints) -> list[Ints]:
    """The exchanges of each window of 60 s; windows begin every 30 s."""
    if not len(sane):
        return []
    t1 = sane[:, 1]
    steps = max(0, -(-(int(t1[-1] - t1[0]) - WINDOW_US) // (WINDOW_US // 2))) + 1
    if steps > len(sane) + 1:  # exchanges years apart: a damaged file must not cost memory
        return [sane]
    starts = t1[0] + np.arange(steps) * (WINDOW_US // 2)
    first, last = np.searchsorted(t1, starts), np.searchsorted(t1, starts + WINDOW_US, side="right")
    return [sane[i:j] for i, j in zip(first, last, strict=True) if j > i]


def _fit_or_halve(part: Ints) -> list[Window]:
    """The windows of these exchanges: one if a line fits most of them, else those of both halves."""
    keep = np.ones(len(part), dtype=bool)
    window = _fit(part, keep)
    if window is not None:
        return [window]
    keep = _consistent(part)
    span = int(part[-1, 1] - part[0, 1])
    if np.mean(keep) < 1.0 - MAX_REJECTED and span > SHORTEST_WINDOW_US:
        middle = max(1, int(np.searchsorted(part[:, 1], part[0, 1] + span // 2)))
        return [*_fit_or_halve(part[:middle]), *_fit_or_halve(part[middle:])]
    window = _fit(part, keep)
    return [] if window is None else [window]


def _bounds(part: Ints, device_ref: int, host_ref: int) -> tuple[Floats, Floats, Floats, Floats]:
    """x and y of the points that the line must lie above, then below; y is host − device, from the references."""
    x_low, x_high = 1000 * (part[:, 1] + TICK_US - device_ref), 1000 * (part[:, 2] - device_ref)
    y_low, y_high = part[:, 0] - host_ref - x_low, part[:, 3] - host_ref - x_high
    return x_low.astype(float), y_low.astype(float), x_high.astype(float), y_high.astype(float)


def _fit(part: Ints, keep: NDArray[np.bool_]) -> Window | None:
    """The line with the largest margin; None if none keeps to the bounds of the exchanges that are kept."""
    used = part[keep]
    if not len(used):
        return None
    middle = used[len(used) // 2]
    device_ref, host_ref = int(middle[1]), int(middle[0])
    rates, low, high = _candidates(*_bounds(used, device_ref, host_ref))
    widest = float(np.max(high - low))
    if widest < -2.0 * ROUNDING_NS:
        return None
    low, high, widest = (low + 0.5 * widest, high - 0.5 * widest, 0.0) if widest < 0.0 else (low, high, widest)
    # Device stamps are whole ticks, so margins that differ by less tell nothing: the middle of all such rates.
    best = rates[high - low >= widest - 1000.0 * TICK_US]
    rate = float(0.5 * (best[0] + best[-1]))
    offset = float(np.interp(rate, rates, 0.5 * (low + high)))
    centre = int(part[0, 1] + part[-1, 1]) // 2
    lines = _corners(rates, low, high)
    return Window(device_ref, host_ref, offset, rate, lines, 0.5 * widest, centre, tuple(part[~keep, 1].tolist()))


def _candidates(x_low: Floats, y_low: Floats, x_high: Floats, y_high: Floats) -> tuple[Floats, Floats, Floats]:
    """Rates at which U − L can bend, ascending, and L and U there."""
    below, above = lower_hull(x_low, -y_low), lower_hull(x_high, y_high)
    x_low, y_low, x_high, y_high = x_low[below], y_low[below], x_high[above], y_high[above]
    edges = np.concatenate([np.diff(y_low) / np.diff(x_low), np.diff(y_high) / np.diff(x_high)])
    rates = np.unique(np.concatenate([[-RATE_LIMIT, RATE_LIMIT], edges[np.abs(edges) < RATE_LIMIT]]))
    low = np.max(y_low - rates[:, None] * x_low, axis=1)
    high = np.min(y_high - rates[:, None] * x_high, axis=1)
    return rates, low, high


def _corners(rates: Floats, low: Floats, high: Floats) -> Floats:
    """Corners (offset, rate) of the polygon L ≤ offset ≤ U: both curves where U ≥ L, and where they cross."""
    gap = high - low
    inside = np.flatnonzero(gap >= 0.0)
    crossings = []
    for i, j in ((inside[0] - 1, inside[0]), (inside[-1] + 1, inside[-1])):
        if 0 <= i < len(rates):
            share = gap[j] / (gap[j] - gap[i])
            crossings.append((high[j] + share * (high[i] - high[j]), rates[j] + share * (rates[i] - rates[j])))
    lower, upper = np.stack([low, rates], axis=1)[inside], np.stack([high, rates], axis=1)[inside]
    return np.concatenate([lower, upper, np.array(crossings).reshape(-1, 2)])


def _consistent(part: Ints) -> NDArray[np.bool_]:
    """Mask of the exchanges that the line with the least sum of violations keeps to."""
    middle = part[len(part) // 2]
    x_low, y_low, x_high, y_high = _bounds(part, int(middle[1]), int(middle[0]))
    n = len(part)
    scale = max(1.0, float(np.ptp(x_high)))  # rate · scale is of the size of an offset
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


def _report(clock: DeviceClock, every: Ints, sane: Ints) -> ClockReport:
    windows = clock.windows
    middle = int(sane[0, 1] + sane[-1, 1]) // 2
    host, _ = clock.to_host_ns(np.array([middle]))
    _, bound = clock.to_host_ns(sane[:, 1])
    rates = 1e6 * np.array([window.rate for window in windows])
    rtt = (sane[:, 3] - sane[:, 0]) - 1000 * (sane[:, 2] - sane[:, 1])
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
