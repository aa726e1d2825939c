"""Proposed hold-outs that leave rows of every label in the fit, and what a hold-out removes."""

import numpy as np
import pytest

from truearm.kinds.table import ObservationTable
from truearm.workflows.selection import all_held_out, held_out_rows, proposed_hold_out


def bars(*pairings):
    """Return a table with this number of rows for each (bar, chuck, sphere, rows)."""
    names = [np.repeat([p[k] for p in pairings], [p[3] for p in pairings]) for k in range(3)]
    n = len(names[0])
    q = np.arange(6.0 * n).reshape(n, 6)
    columns = dict(zip(("bar", "chuck", "sphere"), names, strict=True))
    return ObservationTable(q=q, kind=np.full(n, "ball_bar"), value=np.full(n, 0.4), shell=names[1], **columns)


# 20 minutes with the second bar on one pairing alone, the only one of sphere s1; 18 pairings of two and three poses
ONE_LONG_BAR = bars(("b46", "c1", "s2", 30), ("b46", "c2", "s3", 20), ("b61", "c1", "s1", 12))
MANY = bars(*((f"b{i % 2}", f"c{i % 3}", f"s{i % 9}", 2 + i % 2) for i in range(18)))


@pytest.mark.parametrize(("table", "pairings"), [(ONE_LONG_BAR, 3), (MANY, 18)], ids=["three", "eighteen"])
def test_the_proposal_leaves_every_pairing_in_the_fit(table, pairings):
    proposed = proposed_hold_out(table)
    assert proposed.combinations == pairings
    held = held_out_rows(table, [str(proposed.fraction)], proposed.seed)
    assert held.sum() == proposed.rows == round(proposed.fraction * len(table))
    names = np.stack([table.bar, table.chuck, table.sphere], axis=1)
    for pairing in np.unique(names, axis=0):
        mine = np.all(names == pairing, axis=1)
        assert 2 * (mine & ~held).sum() >= mine.sum()
    assert all_held_out(table, held) == []


def test_rows_that_are_too_few_to_spare_any():
    assert proposed_hold_out(bars(*((f"b{i}", "c", "s", 1) for i in range(10)))) is None
    assert proposed_hold_out(bars(("b", "c", "s", 2))) is None


def test_what_goes_with_a_bar():
    assert all_held_out(ONE_LONG_BAR, ONE_LONG_BAR.bar == "b61") == ["bar=b61", "sphere=s1"]
