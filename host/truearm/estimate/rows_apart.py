"""Rows that do not belong to the others: measured with another set-up, or with the reading of one joint stuck."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from truearm.estimate.better_fit import HUNDREDFOLD, MOST_ROWS, Found, explains, found_in
from truearm.estimate.label_sentences import named_row
from truearm.estimate.trial_fit import Trial, misfit, tried
from truearm.kinds.table import ObservationTable
from truearm.model.chain import Chain
from truearm.results import WrongInput
from truearm.text import counted
from truearm.types import Floats, Mask, Rigs, thinned

LEAST_ROWS = 5  # of another set-up


def stuck_joint(
    chain: Chain, rig: Rigs, table: ObservationTable, rows: NDArray[np.intp], free: Mask, before: Trial
) -> Iterator[Found]:
    """Return joints with a constant reading in a run of rows while others change, if all other rows fit."""
    n, runs = rows.size, _same_readings(table.q[rows])
    for joint, first, end in runs:
        others = rows[np.r_[:first, end:n]]
        some = table.select(others[thinned(others.size, MOST_ROWS)])
        after = tried(chain, rig, some, free, goal=HUNDREDFOLD * before.reduced) if others.size else None
        if after is None or not explains(before, after, len(runs)):
            continue
        where = f"{named_row(table, rows[first])} to {named_row(table, rows[end - 1])}"
        text = f"the reading of {chain.joints[joint].name} is stuck: it is the same in {counted(end - first, 'row')} from {where}, while others move"
        apply = f"{rows[first] + 1}:{rows[end - 1] + 1}"
        yield found_in(WrongInput.STUCK, text, others.size, before, after, len(runs), apply, n)


def _same_readings(q: Floats) -> list[tuple[int, int, int]]:
    """Return the longest run (first row, one after the last) of each joint in readings (n, j) in which it alone is constant."""
    found = []
    for joint in range(q.shape[1]):
        edges = np.r_[0, np.flatnonzero(np.diff(q[:, joint])) + 1, len(q)]
        longest = int(np.argmax(np.diff(edges)))
        first, end = int(edges[longest]), int(edges[longest + 1])
        moving = np.delete(np.ptp(q[first:end], axis=0), joint)
        if LEAST_ROWS <= end - first < len(q) and moving.any():
            found.append((joint, first, end))
    return found


def other_set_up(
    chain: Chain,
    rig: Rigs,
    table: ObservationTable,
    rows: NDArray[np.intp],
    free: Mask,
    before: Trial,
    least: float = HUNDREDFOLD,
) -> Iterator[Found]:
    """Return first or last rows that do not fit the others, which fit with at most ``least`` of the χ² of all."""
    n = rows.size
    if n < 4 * LEAST_ROWS:
        return
    for main in (np.arange(n // 2, n), np.arange(n // 2)):
        after, cut = None, 0
        for _ in range(2):  # from half of the rows, then from all on that side of the change
            some = rows[main[thinned(main.size, MOST_ROWS)]]
            after = tried(chain, rig, table.select(some), free)
            if after is None:
                break
            of_row = misfit(chain, rig, table.select(rows), after.known)
            cut = _change(of_row)
            main = np.arange(cut, n) if main[-1] == n - 1 else np.arange(cut)
            if min(main.size, n - main.size) < LEAST_ROWS:
                after = None
                break
        count = 2 * (n - 2 * LEAST_ROWS)
        if after is None or main.size < n // 2 or not explains(before, after, count, least):
            continue
        first, last = (1, cut) if main[0] else (cut + 1, n)
        where = f"{named_row(table, rows[first - 1])} to {named_row(table, rows[last - 1])}"
        text = (
            f"{counted(last - first + 1, 'row')} from {where} do not fit the other {main.size}, which fit together: "
            "something in the set-up moved in between, a joint's zero jumped, or the labels of these rows are wrong"
        )
        apply = f"{rows[first - 1] + 1}:{rows[last - 1] + 1}"
        yield found_in(WrongInput.SET_UP, text, int(main.size), before, after, count, apply, n)
        return


def _change(square: Floats) -> int:
    """Return the row from which on the variance differs (maximum likelihood)."""
    n = square.size
    k = np.arange(LEAST_ROWS, n - LEAST_ROWS + 1)
    total = np.concatenate([[0.0], np.cumsum(square)])
    left, right = total[k] / k, (total[-1] - total[k]) / (n - k)
    tiny = 1e-12 * max(float(square.max()), 1e-300)
    cost = k * np.log(np.maximum(left, tiny)) + (n - k) * np.log(np.maximum(right, tiny))
    return int(k[np.argmin(cost)])
