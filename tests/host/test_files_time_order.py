"""Rows of a file in the order of their times, whatever the file is sorted by."""

import numpy as np
import pytest

from truearm.kinds.table import ObservationTable
from truearm.kinds.table_file import in_order_of_time

SESSION = 5.0 + 12.0 * np.arange(60)


def rows(time):
    return ObservationTable(q=np.arange(float(len(time)))[:, None], kind=np.full(len(time), "seat"), time=time)


@pytest.mark.parametrize("seed", range(4))
def test_shuffled_or_sorted_rows_come_in_the_order_of_their_times(seed):
    rng = np.random.default_rng(seed)
    time = 1.7e9 * (seed % 2) + np.cumsum(rng.uniform(8.0, 20.0, 120))
    by_joint = np.argsort(rng.integers(0, 9, 120), kind="stable")  # nine readings, each in the order of time
    for order in (rng.permutation(120), by_joint):
        found = in_order_of_time(rows(time[order]))
        assert found.time.tolist() == time.tolist()
        assert found.q[:, 0].tolist() == np.argsort(order).tolist()


@pytest.mark.parametrize(
    "time",
    [
        SESSION,
        np.concatenate([SESSION, SESSION + 3.0]),  # two sessions, each with times from its own start
        np.append(SESSION[::-1], np.nan),
        np.repeat(SESSION, 3),  # three targets a pose
        np.zeros(0),
    ],
)
def test_rows_in_order_and_sessions_one_after_the_other_stay_as_they_are(time):
    table = rows(time)
    assert in_order_of_time(table) is table
