"""Find the range of the controller's clock that all edges of a trigger wire together allow.

Edges of both directions are used.

Let y(d) be controller time minus device time d at which the input shows a rising edge, and y(d) + D the same for a
falling edge. D is the difference between the input's two delays and is constant. An edge bounds y or y + D on both
sides. A rate changes by no more than DRIFT, so y at nodes STEP apart satisfies

    |y(k−1) − 2 y(k) + y(k+1)| ≤ DRIFT · STEP²,

and between two nodes y is within DRIFT · STEP² / 8 of their chord. All this is linear in the y(k) and D, so the range
of each follows from a linear program, exact except for those 0.8 µs. ``clock_windows`` uses less information, a
straight line in each window for each direction separately, and its bounds are half as wide again.

A long session is processed in blocks of nodes. Edges more than MARGIN nodes away from a block are not used. D is the
same in all blocks.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from truearm.session.clock_windows import DRIFT, TICK_US, lower_hulls
from truearm.types import Floats, Ints

STEP_NS = 20e9
MARGIN, BLOCK = 4, 6  # nodes: on both sides of a block, and in it
BEND_NS = 1e-9 * DRIFT * STEP_NS**2  # across three nodes


@dataclass(frozen=True)
class EdgeRanges:
    """Lowest and highest y of the earlier direction at nodes (m,) ``x`` ns from ``ref_us``, in ns from ``ref_ns``."""

    ref_us: int
    ref_ns: int
    x: Floats
    low: Floats
    high: Floats
    rates: Floats  # (2, 2) least and greatest y′ around the first node and around the last
    falling_later_ns: tuple[float, float]

    def at(self, t_us: Ints) -> tuple[Ints, Floats, Floats]:
        """Return the controller times (n,) [ns] by a rate of 1, and the range of the true minus these [ns]."""
        whole = 1000 * (t_us - self.ref_us)
        x = whole.astype(np.float64)
        before, behind = np.minimum(x - self.x[0], 0.0), np.maximum(x - self.x[-1], 0.0)
        bend = BEND_NS / 8.0 + 0.5e-9 * DRIFT * (np.square(before) + np.square(behind))
        low = np.interp(x, self.x, self.low) + self.rates[0, 1] * before + self.rates[1, 0] * behind - bend
        high = np.interp(x, self.x, self.high) + self.rates[0, 0] * before + self.rates[1, 1] * behind + bend
        return self.ref_ns + whole, low, high


def edge_ranges(rows: Ints, level: NDArray[np.bool_]) -> EdgeRanges | None:
    """Return the ranges that edges (n, 4) allow, given as rows of ``clock_windows`` in order.

    ``level`` (n,): which edges rise. None if the edges contradict each other or all have the same direction.
    """
    if not 0 < np.count_nonzero(level) < level.size:
        return None
    ref_ns, ref_us = int(rows[0, 0]), int(rows[0, 1])
    bounds = _Bounds.of(rows, level, ref_us, ref_ns)
    count = max(2, int(np.ceil(bounds.x.max() / STEP_NS)) + 1)
    blocks = [_Block.of(bounds, first, count) for first in range(0, count, BLOCK)]
    least, most = -np.inf, np.inf
    for block in blocks:
        later = block.spans([block.later], (-np.inf, np.inf))
        if later is None:
            return None
        least, most = max(least, later[0, 0]), min(most, later[0, 1])
    if least > most:
        return None
    return _together(blocks, ref_us, ref_ns, (least, most))


def _together(blocks: Sequence[_Block], ref_us: int, ref_ns: int, later_ns: tuple[float, float]) -> EdgeRanges | None:
    """Return what all blocks together allow if the difference D of the delays is within ``later_ns``."""
    # Of the earlier direction: y if D ≥ 0, y + D if D ≤ 0; both if the sign of D is not known.
    cases = [(0.0, (max(later_ns[0], 0.0), later_ns[1])), (1.0, (later_ns[0], min(later_ns[1], 0.0)))]
    found = []
    for share, within in cases:
        if within[0] > within[1]:
            continue
        spans = [block.spans(block.objectives(share), within) for block in blocks]
        if all(span is not None for span in spans):
            found.append(np.concatenate([span for span in spans if span is not None]))
    if not found:
        return None
    low: Floats = np.min([spans[:, 0] for spans in found], axis=0)
    high: Floats = np.max([spans[:, 1] for spans in found], axis=0)
    nodes = np.concatenate([block.is_node for block in blocks])
    # The rate at the middle of two nodes. At the outer node and beyond, it may differ by its change over half a step.
    rates: Floats = np.stack([low, high], axis=1)[~nodes] / STEP_NS + 0.5e-9 * DRIFT * STEP_NS * np.array([-1.0, 1.0])
    x = STEP_NS * np.arange(np.count_nonzero(nodes), dtype=np.float64)
    return EdgeRanges(ref_us, ref_ns, x, low[nodes], high[nodes], rates, later_ns)


class _Bounds(NamedTuple):
    """The relevant ones of all bounds (n,): side · (y + falling · D) ≤ side · y there."""

    x: Floats
    y: Floats
    side: Floats  # 1: upper bound of y, −1: lower bound
    falling: Floats

    @classmethod
    def of(cls, rows: Ints, level: NDArray[np.bool_], ref_us: int, ref_ns: int) -> _Bounds:
        """Build from edges (n, 4). Between two nodes only the corners of the hulls are relevant."""
        n = len(rows)
        t_us = np.concatenate([rows[:, 1] + TICK_US, rows[:, 2]]) - ref_us
        whole = 1000 * t_us
        y = (np.concatenate([rows[:, 0], rows[:, 3]]) - ref_ns - whole).astype(np.float64)
        x, side = whole.astype(np.float64), np.repeat([-1.0, 1.0], n)
        falling = np.tile(~level, 2)
        group = 4 * np.floor(x / STEP_NS).astype(np.intp) + 2 * falling + (side > 0.0)
        corners = lower_hulls(x, side * y, group)
        return cls(x[corners], y[corners], side[corners], falling[corners].astype(np.float64))


@dataclass(frozen=True)
class _Block:
    """A block of nodes and the linear constraints A z ≤ b, where z = (y at these and the surrounding nodes, D)."""

    matrix: Floats
    limit: Floats
    inner: range  # the block's own nodes among those of z
    first: bool
    last: bool

    @classmethod
    def of(cls, bounds: _Bounds, first: int, count: int) -> _Block:
        """Build the block of nodes that begins at ``first``, out of ``count`` nodes."""
        begin, end = max(0, first - MARGIN), min(count, first + BLOCK + MARGIN)
        m = end - begin
        at = bounds.x / STEP_NS - begin
        here = (at >= 0.0) & (at <= m - 1)
        x, y, side, falling = at[here], *(column[here] for column in bounds[1:])
        k = np.minimum(x.astype(np.intp), m - 2)
        row = np.arange(x.size)
        edges = np.zeros((x.size, m + 1))
        edges[row, k], edges[row, k + 1], edges[:, m] = side * (1.0 - x + k), side * (x - k), side * falling
        bends = np.zeros((max(0, m - 2), m + 1))
        for j, weight in enumerate((1.0, -2.0, 1.0)):
            bends[np.arange(len(bends)), np.arange(len(bends)) + j] = weight
        return cls(
            np.concatenate([edges, bends, -bends]),
            np.concatenate([side * y + BEND_NS / 8.0, np.full(2 * len(bends), BEND_NS)]),
            range(first - begin, min(first + BLOCK, count) - begin),
            first == 0,
            first + BLOCK >= count,
        )

    @property
    def later(self) -> Floats:
        """Return the row that gives D when multiplied by z."""
        return np.asarray(np.eye(self.matrix.shape[1])[-1])

    def objectives(self, share: float) -> list[Floats]:
        """Return rows to be multiplied by z: y + share · D at the block's nodes, and the step of y at the first and
        last node.
        """
        unit = np.eye(self.matrix.shape[1])
        nodes = [unit[k] + share * unit[-1] for k in self.inner]
        return [*([unit[1] - unit[0]] * self.first), *nodes, *([unit[-2] - unit[-3]] * self.last)]

    @property
    def is_node(self) -> NDArray[np.bool_]:
        """Return which of ``objectives`` are nodes."""
        return np.array([*([False] * self.first), *([True] * len(self.inner)), *([False] * self.last)])

    def spans(self, objectives: Sequence[Floats], later_ns: tuple[float, float]) -> Floats | None:
        """Return the least and greatest value (k, 2) of each objective, with D within ``later_ns``.

        None if the constraints are infeasible or no edge bounds the objectives.
        """
        found = np.array(list(self._ends(objectives, later_ns)))
        return found if np.isfinite(found).all() else None

    def _ends(self, objectives: Sequence[Floats], later_ns: tuple[float, float]) -> Iterator[tuple[float, float]]:
        from scipy.optimize import linprog  # type: ignore[attr-defined]  # takes 0.1 s, and sessions without a trigger wire do without

        limits = [(None, None)] * (self.matrix.shape[1] - 1) + [later_ns]
        for objective in objectives:
            low, high = (
                linprog(sign * objective, A_ub=self.matrix, b_ub=self.limit, bounds=limits, method="highs")
                for sign in (1.0, -1.0)
            )
            yield (low.fun, -high.fun) if low.status == high.status == 0 else (np.nan, np.nan)
