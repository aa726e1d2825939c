"""Rows that a table has twice are no measurements; equal readings of a coarse device are (seeds as given)."""

from dataclasses import replace

import numpy as np
import pytest
from puma_bench import CHAIN, RIG, SIGMA, random_table

import truearm
from truearm.estimate.copied_rows import copied_rows
from truearm.kinds.table import ObservationTable
from truearm.types import Point, Rig

PUMA = truearm.load_robot("puma560")


def session(digits=12, seed=41):
    """120 lengths, with some digits of a metre."""
    one = random_table(120, np.random.default_rng(seed), SIGMA)
    return replace(one, value=np.round(one.value, digits))


def with_copies(table, rows):
    whole = ObservationTable.joined([table, table.select(rows)])
    return replace(whole, source=np.array([f"poses.csv row {i + 2}" for i in range(len(whole))]))


def identified(table, hold_out=()):
    return truearm.identify(PUMA, table, RIG, hold_out=hold_out, options=truearm.IdentifyOptions(joint_laws="none"))


def test_copies_are_named_and_measurements_that_are_read_alike_are_none():
    once, twice = identified(session()), identified(with_copies(session(), slice(None)))
    assert (once.document["copies"], len(twice.document["copies"])) == ([], 120)
    np.testing.assert_allclose(twice.estimate.value, once.estimate.value, rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(twice.estimate.sigma, once.estimate.sigma, rtol=1e-6)
    found = identified(with_copies(session(), slice(20, 40)), hold_out=["0.2"])
    assert found.document["copies"][0] == {"source": "poses.csv row 122", "of": "poses.csv row 22"}
    assert found.estimate.n_observations + found.estimate.held_out.n == 120
    judged = truearm.validate(found, with_copies(session(seed=42), slice(20, 40)), RIG)
    assert judged.n == 120
    (values,) = [finding.values for finding in judged.findings if finding.code == "copies"]
    assert (values["n"], values["rows"][0]) == (20, "poses.csv row 122 of poses.csv row 22")
    # A resolution of 10 µm at a noise of 84 µm: 10 of 120 repetitions read the same.
    first = session(5)
    second = replace(first, value=np.round(first.value + 1.4 * SIGMA * np.random.default_rng(43).normal(size=120), 5))
    both = ObservationTable.joined([first, second])
    assert (first.value == second.value).sum() == 10
    assert (copied_rows(CHAIN, RIG, both) < 0).all()
    assert (copied_rows(CHAIN, RIG, with_copies(first, slice(100))) >= 0).sum() == 100


@pytest.mark.parametrize("field", ["chuck", "time", "value", "q"])
def test_rows_that_differ_in_anything_are_no_copies(field):
    one = session()
    other = {
        "chuck": np.full(len(one), "another"),
        "time": np.full(len(one), 7.0),
        "value": one.value + 1e-9,
        "q": one.q + 1e-9,
    }
    both = ObservationTable.joined([one, replace(one, **{field: other[field]})])
    assert (copied_rows(CHAIN, RIG, both) < 0).all()


def test_seats_and_points_of_a_tracker_are_one_reading():
    q = np.random.default_rng(3).uniform(-1.0, 1.0, (6, 6))
    rows = np.array([0, 1, 2, 1, 3, 1])
    table = ObservationTable(
        q=q[rows],
        kind=np.full(6, "seat"),
        place=np.full(6, "front"),
        socket=np.array(list("aabaab")),
        source=np.array(list("123456")),
    )
    assert copied_rows(CHAIN, Rig(), table).tolist() == [-1, -1, -1, 1, -1, -1]
    rng = np.random.default_rng(4)
    q = rng.uniform(-1.0, 1.0, (8, 6))
    xyz = np.round(rng.normal(size=(8, 3)), 5)
    rig = Rig(
        targets={"t": Point("t", (0.0, 0.0, 0.1))},
        trackers={"k": truearm.Device("k", ((1e-10, 0.0, 0.0), (0.0, 1e-10, 0.0), (0.0, 0.0, 1e-10)))},
    )
    rows = np.append(np.arange(8), 3)
    table = ObservationTable(
        q=q[rows],
        kind=np.full(9, "position"),
        xyz=xyz[rows],
        target=np.full(9, "t"),
        tracker=np.full(9, "k"),
        source=rows.astype(str),
    )
    found = copied_rows(CHAIN, rig, table)
    assert found.tolist() == [-1] * 9, "a resolution of 10 µm at 10 µm of noise"
    fine = replace(table, xyz=table.xyz + 1e-6 * rng.normal(size=(8, 3))[rows])
    assert copied_rows(CHAIN, rig, fine).tolist() == [-1] * 8 + [3]
