"""The order in which the rows of a table were measured, by their times: a table may be sorted by something else."""

from __future__ import annotations

import numpy as np

from truearm.types import ObservationTable

AT_ONCE = 2.0  # usual times between rows: a time so close to the first one begins another session


def in_order_of_time(table: ObservationTable) -> ObservationTable:
    """Return the rows of one file in the order of their times; the table itself if they are in it.

    Also if a row has no time, or if the times begin again: several sessions, one after the other, each with its own zero.
    """
    time = table.time
    if len(table) < 2 or not np.isfinite(time).all():
        return table
    back = np.flatnonzero(np.diff(time) < 0.0) + 1
    order = np.argsort(time, kind="stable")
    usual = float(np.median(np.diff(time[order])))
    begins_again = back.size > 0 and bool((time[back] <= time[order[0]] + AT_ONCE * usual).all())
    return table if begins_again else table.select(order)
