"""The lower convex hull of points in the plane, and the best line under or between points.

A line y = offset + rate · x lies under all points exactly if it lies under the corners of their lower hull, of which there
are a dozen where there are thousands of points. Each further question is then answered exactly by looking at all corners.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from truearm.types import Floats


def lower_hull(x: Floats, y: Floats) -> NDArray[np.intp]:
    """Indices, by ascending x, of the corners of the lower hull of n ≥ 1 points.

    Quickhull on points sorted by x: below a chord the lowest point is a corner and splits the rest in two slices
    (Barber, Dobkin, Huhdanpaa, "The quickhull algorithm", 1996).
    """
    order = np.lexsort((y, x))
    first = np.concatenate([[True], np.diff(x[order]) > 0])  # of equal x the lowest y
    order = order[first]
    xs, ys = x[order], y[order]
    corners = [0] if xs.size == 1 else [0, xs.size - 1]
    pending = [(0, xs.size - 1)]
    while pending:
        left, right = pending.pop()
        if right - left < 2:
            continue
        inner = slice(left + 1, right)
        slope = (ys[right] - ys[left]) / (xs[right] - xs[left])
        below = ys[inner] - ys[left] - slope * (xs[inner] - xs[left])
        lowest = int(np.argmin(below))
        if below[lowest] < 0.0:
            corner = left + 1 + lowest
            corners.append(corner)
            pending += [(left, corner), (corner, right)]
    return np.asarray(order[np.sort(corners)])


def line_under(x: Floats, y: Floats, middle: float) -> tuple[float, float]:
    """(offset, rate) of the line under all points that is nearest to them on average, where their mean x is ``middle``.

    The mean distance of a line under the points is its distance at their mean x: the best one is the hull's edge there.
    One point: rate 0.
    """
    corners = lower_hull(x, y)
    if corners.size == 1:
        return float(y[corners[0]]), 0.0
    edge = int(np.clip(np.searchsorted(x[corners], middle) - 1, 0, corners.size - 2))
    (x0, x1), (y0, y1) = x[corners[edge : edge + 2]], y[corners[edge : edge + 2]]
    with np.errstate(
        over="ignore", invalid="ignore"
    ):  # times may differ by next to nothing; the rate is then no number
        rate = float((y1 - y0) / (x1 - x0))
        return float(y0 - rate * x0), rate
