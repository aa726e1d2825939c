"""The order of visits: an open tour through points that minimises the sum of its move costs approximately."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from truearm.types import Floats


def short_tour(from_start: Floats, cost: Floats) -> NDArray[np.int64]:
    """Return an order of n points with a small sum of move ``cost`` (n, n); ``from_start`` (n,) selects the first."""
    order = [int(np.argmin(from_start))]
    unvisited = np.ones(len(cost), dtype=bool)
    for _ in range(len(cost) - 1):
        unvisited[order[-1]] = False
        order.append(int(np.argmin(np.where(unvisited, cost[order[-1]], np.inf))))
    return untangled(np.array(order), cost)


def untangled(order: NDArray[np.int64], cost: Floats) -> NDArray[np.int64]:
    """Return the tour after reversing sections of it as long as this reduces the cost (2-opt).

    Going always to the nearest remaining point ends with long moves back to skipped points; this corrects them.
    """
    order = order.copy()
    improved = True
    while improved:
        improved = False
        for i in range(len(order) - 2):
            # Reverse order[i+1 .. k]: the moves i→i+1 and k→k+1 become i→k and i+1→k+1; the last k has no k+1.
            start, next_point, k = order[i], order[i + 1], order[i + 2 :]
            gain = cost[start, next_point] - cost[start, k]
            gain[:-1] += cost[k[:-1], k[1:]] - cost[next_point, k[1:]]
            if gain.max() > 1e-12:
                end = i + 3 + int(np.argmax(gain))
                order[i + 1 : end] = order[i + 1 : end][::-1]
                improved = True
    return order
