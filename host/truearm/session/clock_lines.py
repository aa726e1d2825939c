"""The lines that exchanges of one window allow: the one with the largest margin, and the corners of all (see ``clock``)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linprog  # type: ignore[attr-defined]

from truearm.session.device_clock import Ints, Window, slack_ns
from truearm.session.hull import lower_hull
from truearm.types import Floats

RATE_LIMIT = 1e-3  # crystals stay within 100 ppm, a slewed host clock within 500
TICK_US = 1
ROUNDING_NS = 1.0  # stamps are whole ns, and the linear program's tolerance is far below one


class Points(NamedTuple):
    """What a line must lie above (low) and below (high); y is host − device, both from references."""

    x_low: Floats
    y_low: Floats
    x_high: Floats
    y_high: Floats

    def widened(self, centre: float) -> Points:
        """The same with what a clock that keeps to DRIFT may be from its tangent at x = centre."""
        low, high = slack_ns(self.x_low - centre), slack_ns(self.x_high - centre)
        return Points(self.x_low, self.y_low - low, self.x_high, self.y_high + high)


def _points(part: Ints, device_ref: int, host_ref: int) -> Points:
    x_low, x_high = 1000 * (part[:, 1] + TICK_US - device_ref), 1000 * (part[:, 2] - device_ref)
    y_low, y_high = part[:, 0] - host_ref - x_low, part[:, 3] - host_ref - x_high
    return Points(x_low.astype(float), y_low.astype(float), x_high.astype(float), y_high.astype(float))


def _centre(part: Ints) -> int:
    return int(part[0, 1] + part[-1, 1]) // 2


def fit_line(part: Ints, keep: NDArray[np.bool_]) -> Window | None:
    """The line with the largest margin; None if none keeps to the widened bounds of the exchanges that are kept."""
    if not np.any(keep):
        return None
    used, centre = part[keep], _centre(part)
    device_ref, host_ref = int(used[len(used) // 2, 1]), int(used[len(used) // 2, 0])
    points = _points(used, device_ref, host_ref)
    rates, low, high = _candidates(points.widened(1e3 * (centre - device_ref)))
    widest = float(np.max(high - low))
    if widest < -2.0 * ROUNDING_NS:
        return None
    lines = _corners(rates, low + min(0.0, 0.5 * widest), high - min(0.0, 0.5 * widest))
    offset, rate, margin = _middle(*_candidates(points))
    reach = _reach(_points(part[~keep], device_ref, host_ref), offset, rate)
    rejected = tuple(part[~keep, 1].tolist())
    return Window(device_ref, host_ref, offset, rate, lines, margin, centre, rejected, reach)


def _middle(rates: Floats, low: Floats, high: Floats) -> tuple[float, float, float]:
    """Offset, rate and margin of the line that is farthest from both bounds."""
    widest = float(np.max(high - low))
    # Device stamps are whole ticks, so margins that differ by less tell nothing: the middle of all such rates.
    best = rates[high - low >= widest - 1000.0 * TICK_US]
    rate = float(0.5 * (best[0] + best[-1]))
    return float(np.interp(rate, rates, 0.5 * (low + high))), rate, 0.5 * widest


def _reach(rejected: Points, offset: float, rate: float) -> float:
    """The farthest from the line that exchanges allow."""
    low = rejected.y_low - offset - rate * rejected.x_low
    high = rejected.y_high - offset - rate * rejected.x_high
    return float(np.max(np.abs([low, high]), initial=0.0))


def _candidates(points: Points) -> tuple[Floats, Floats, Floats]:
    """Rates at which U − L can bend, ascending, and L and U there."""
    x_low, y_low, x_high, y_high = points
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


def consistent(part: Ints) -> NDArray[np.bool_]:
    """Mask of the exchanges whose widened bounds the line with the least sum of violations keeps to."""
    middle = part[len(part) // 2]
    points = _points(part, int(middle[1]), int(middle[0]))
    x_low, y_low, x_high, y_high = points.widened(1e3 * (_centre(part) - int(middle[1])))
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
