"""Proposed hold-outs that leave rows of every label in the fit, and what a hold-out removes."""

import json
from pathlib import Path

import numpy as np
import pytest
from tests.refusals import refused

from truearm.errors import InputError
from truearm.kinds.table import ObservationTable
from truearm.workflows.selection import all_held_out, folds_of, held_out_rows, proposed_hold_out


def bars(*pairings):
    """Return a table with this number of rows for each (bar, chuck, sphere, rows)."""
    names = [np.repeat([p[k] for p in pairings], [p[3] for p in pairings]) for k in range(3)]
    n = len(names[0])
    q = np.arange(6.0 * n).reshape(n, 6)
    columns = dict(zip(("bar", "chuck", "sphere"), names, strict=True))
    return ObservationTable(q=q, kind=np.full(n, "ball_bar"), value=np.full(n, 0.4), shell=names[1], **columns)


DATA = Path(__file__).parents[1] / "data"
# 20 minutes with the second bar on one pairing alone, the only one of sphere s1; 18 pairings of two and three poses
ONE_LONG_BAR = bars(("b46", "c1", "s2", 30), ("b46", "c2", "s3", 20), ("b61", "c1", "s1", 12))
MANY = bars(*((f"b{i % 2}", f"c{i % 3}", f"s{i % 9}", 2 + i % 2) for i in range(18)))


@pytest.mark.parametrize(("table", "pairings"), [(ONE_LONG_BAR, 3), (MANY, 18)], ids=["three", "eighteen"])
def test_the_proposal_leaves_every_pairing_in_the_fit(table, pairings):
    proposed = proposed_hold_out(table)
    assert proposed["combinations"] == pairings
    held = held_out_rows(table, [str(proposed["fraction"])], proposed["seed"])
    assert held.sum() == proposed["rows"] == round(proposed["fraction"] * len(table))
    names = np.stack([table.bar, table.chuck, table.sphere], axis=1)
    for pairing in np.unique(names, axis=0):
        mine = np.all(names == pairing, axis=1)
        assert 2 * (mine & ~held).sum() >= mine.sum()
    assert all_held_out(table, held) == []


def test_rows_that_go_together_or_are_too_few():
    assert proposed_hold_out(bars(*((f"b{i}", "c", "s", 1) for i in range(10)))) is None
    assert proposed_hold_out(bars(("b", "c", "s", 2))) is None
    assert all_held_out(ONE_LONG_BAR, ONE_LONG_BAR.bar == "b61") == ["bar=b61", "sphere=s1"]


def test_rows_are_held_out_by_any_column_of_numbers():
    table = ONE_LONG_BAR.replace(payload=np.where(ONE_LONG_BAR.bar == "b61", 2.5, np.nan))
    np.testing.assert_array_equal(held_out_rows(table, ["payload_kg=2.5"], 0), table.bar == "b61")
    np.testing.assert_array_equal(held_out_rows(table, ["q1_deg=0:700"], 0), np.degrees(table.q[:, 0]) <= 700.0)
    table = table.replace(x_day=np.where(table.q[:, 0] > 9.0, "tue", "mon"), x_run=np.arange(len(table)).astype(str))
    np.testing.assert_array_equal(held_out_rows(table, ["x_day=tue"], 0), table.x_day == "tue")
    np.testing.assert_array_equal(held_out_rows(table, ["x_run=9:12"], 0), np.isin(np.arange(len(table)), range(9, 13)))
    assert [name for name, _ in folds_of(table, ["x_day=*"], 0)] == ["x_day=mon", "x_day=tue"]
    for group, complaint in (
        ("x_day=fri", "mon, tue"),
        ("x_night=tue", "no x_night column"),
        ("payload_kg=3", "no row"),
        ("q1_deg=a:b", "LOW:HIGH"),
        ("temperature_degc=1", "'temperature_degc'"),
    ):
        with refused("invalid-input", complaint, place="hold_out", reason=group):
            held_out_rows(table, [group], 0)


def test_folds_are_whole_poses_and_every_row_is_in_one():
    twice = ObservationTable.joined([ONE_LONG_BAR, ONE_LONG_BAR])  # two rows of each pose
    folds = folds_of(twice, ["folds=5"], 3)
    masks = np.array([mask for _, mask in folds])
    assert np.array_equal(masks.sum(axis=0), np.ones(len(twice)))
    np.testing.assert_array_equal(masks[:, : len(ONE_LONG_BAR)], masks[:, len(ONE_LONG_BAR) :])
    assert np.ptp(masks.sum(axis=1)) <= 2
    assert [name for name, _ in folds_of(twice, ["chuck=*"], 0)] == ["chuck=c1", "chuck=c2"]
    assert folds_of(twice, ["0.2"], 0) == []
    for wanted in (["folds=1"], ["folds=x"], ["socket=*"], ["folds=3", "bar=b61"]):
        with pytest.raises(InputError, match="folds"):
            folds_of(twice, wanted, 0)
    many = ObservationTable.joined([twice] * 4)
    many = many.replace(q=np.random.default_rng(0).normal(size=many.q.shape))
    with refused(
        "invalid-input", f" {min(len(many), 1000)} folds", "2 to 100", place="hold_out", reason="folds=1000: "
    ):
        folds_of(many, ["folds=1000"], 0)


def test_each_fold_has_a_fit_of_its_own(tmp_path, run, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert run("init", ".", "--method", "sockets", "--model", "ur5e").code == 0
    Path("seats.csv").write_bytes((DATA / "sockets" / "seats.csv").read_bytes())
    options = ["--joint-laws", "none", "--json"]
    document = json.loads(run("identify", "--hold-out", "place=*", *options).out)
    *folds, together = document["folds"]
    assert [fold["held_out_by"] for fold in folds] == [f"place=p{number}" for number in range(1, 7)]
    alone = json.loads(run("identify", "--hold-out", "place=p6", *options).out)["held_out"]
    assert folds[5]["rms_mm"] == pytest.approx(alone["rms_mm"], rel=1e-9)
    assert together["rms_mm"] ** 2 == pytest.approx(np.mean([fold["rms_mm"] ** 2 for fold in folds]))
    assert (document["held_out"], together["n_mm"]) == (None, 72)
