"""``truearm identify`` on data that cannot determine the robot, or contradict the rig: an answer, exit code 0 or, for a fit that is not usable, 3, what is
unseen and what to measure next; never a traceback."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from puma_bench import (
    CHAIN,
    RIG,
    SIGMA,
    TRUTH,
    all_pairs,
    constant_orientation_poses,
    lengths,
    points,
    random_poses,
    random_table,
    table,
)
from tests.host.findings_bench import stated
from tests.refusals import ended

from truearm.checks import inputs
from truearm.cli import main as cli
from truearm.estimate.solvers import SOLVERS
from truearm.kinds.rig_file import write_rig
from truearm.kinds.table import ObservationTable
from truearm.kinds.table_file import write_table
from truearm.model.chain import point_forward
from truearm.types import Device, Point, Rig
from truearm.workflows.selection import check_rows

UNITS = ("rad",) * 6


@pytest.fixture
def identified(tmp_path, capsys):
    """Return the result and the printed output for rows and a rig, through files."""

    def call(rows, rig=RIG, *options):
        write_table(tmp_path / "t.csv", rows, UNITS)
        write_rig(tmp_path / "rig.toml", rig)
        arguments = ["identify", tmp_path / "t.csv", "--model", "puma560", "--rig", tmp_path / "rig.toml", *options]
        code = cli.main([str(a) for a in [*arguments, "--out", tmp_path / "r.json", "--force"]])
        out, err = capsys.readouterr()
        result = json.loads((tmp_path / "r.json").read_text(encoding="utf-8"))
        assert (code, err) == (0 if result["usable"] else 3, "")
        return result, " ".join(out.split())

    return call


def held_as_a_choice_of_frame(result, text, n_base, rank):
    """What no pose could show with these fixtures is held; everything else is seen."""
    assert result["rank"] == result["n_free"] == rank
    assert len(result["defaults"]["base"]) == n_base
    assert result["null_space"] == []
    assert stated(result)["held-frames"].values["base"] == result["defaults"]["base"]


def unseen_and_advised(result, text, rank, advice, promised=None):
    """Rank, null directions that hold every unseen parameter, and in words the proposal and how many it tells, all by default."""
    assert result["rank"] == rank
    lost = result["n_free"] - rank
    assert len(result["null_space"]) == lost
    unseen = {p["name"] for p in result["parameters"] if p["free"] and not p["seen"]}
    assert {name for direction in result["null_space"] for name in direction["names"]} == unseen
    assert all(p["sigma"] is None for p in result["parameters"] if p["name"] in unseen)
    assert all(np.isfinite(p["value"]) for p in result["parameters"])
    shown = stated(result)["identified"].values
    assert (shown["rank"], shown["n_free"], shown["unseen"]) == (rank, result["n_free"], lost)
    advised = advised_by_kind(result)[advice]
    assert (advised["n"], advised["full_rank"]) == (promised or lost, False)


def advised_by_kind(result):
    """The values of the advice what to measure, by the kind of the proposal."""
    kinds = {addition["text"].removeprefix("measure "): addition["kind"] for addition in result["additions"]}
    values = [of["values"] for of in result["findings"] if of["code"] == "measure-next"]
    return {kinds[advice["what"]]: advice for advice in values}


POSES = "poses"


def with_chucks(coordinates):
    return replace(RIG, chucks=points("c", coordinates))


@pytest.mark.soak
def test_a_contradictory_rig(identified):
    """The coordinates of two chucks are exchanged and one is off by 50 mm: no robot fits the lengths, whatever their labels."""
    (a, b, c) = (p.xyz for p in RIG.chucks.values())
    wrong = with_chucks([b, (a[0], a[1], a[2] + 0.05), c])
    result, _ = identified(random_table(100, np.random.default_rng(0), SIGMA), wrong)
    assert result["explanations"] == []
    assert result["rank"] == 36
    assert result["chi2_reduced"] > 100 * result["chi2_band"][1]
    assert stated(result)["chi2"].values["where"] == "above"
    assert "doubtful-residuals" in stated(result)


@pytest.mark.parametrize("searched", [False, pytest.param(True, marks=pytest.mark.soak)])
def test_all_chucks_at_one_place(identified, monkeypatch, searched):
    """The lengths contradict this rig, which also leaves the base free to rotate about the chucks, as one chuck does.

    The search for wrong inputs finds nothing; that of a contradictory rig is made above.
    """
    if not searched:
        monkeypatch.setattr(inputs, "explanations_of", lambda *_: ((), 1))
    result, text = identified(random_table(100, np.random.default_rng(1), SIGMA), with_chucks([(0.4, 0.0, 0.2)] * 3))
    held_as_a_choice_of_frame(result, text, 3, 33)
    assert result["explanations"] == []
    assert result["chi2_reduced"] > 100 * result["chi2_band"][1]


def test_collinear_chucks(identified):
    rig = with_chucks([(0.4, 0.0, 0.2), (0.5, 0.05, 0.25), (0.6, 0.1, 0.3)])
    q, pairs = random_poses(200, np.random.default_rng(2)), all_pairs(200)
    noise = SIGMA * np.random.default_rng(3).normal(size=200)
    result, text = identified(table(q, lengths(TRUTH, q, pairs, rig.chucks) + noise, pairs), rig)
    held_as_a_choice_of_frame(result, text, 1, 35)
    assert result["chi2_band"][0] < result["chi2_reduced"] < result["chi2_band"][1]


@pytest.mark.parametrize("solver", SOLVERS)
def test_too_few_observations(identified, solver):
    rows = random_table(12, np.random.default_rng(4), SIGMA)
    result, text = identified(rows, RIG, "--solver", solver, "--max-iterations", 20, "--prior", "none")
    unseen_and_advised(result, text, 12, POSES)
    assert result["chi2_reduced"] is None
    assert not result["usable"]
    if result["unusable_because"] != "not converged":
        assert next(iter(stated(result))) == "no-freedom"
        assert "little-freedom" not in stated(result)


def test_too_few_observations_under_a_prior_are_judged_by_what_is_left(identified):
    result, text = identified(random_table(12, np.random.default_rng(4), SIGMA), RIG, "--prior", "weak")
    unseen_and_advised(result, text, 12, POSES)
    assert 0.0 < result["chi2_freedom"] < 12.0


@pytest.mark.parametrize(("prior", "outside"), [("weak", True), ("wide", False), ("none", False)])
def test_a_robot_outside_its_prior_is_told(identified, prior, outside):
    """This PUMA differs from its design by up to 12 σ of the weak prior."""
    result, _ = identified(random_table(150, np.random.default_rng(7), SIGMA), RIG, "--prior", prior)
    found = stated(result).get("outside-prior")
    assert (found is not None) == outside
    if found:
        assert 8.0 < found.values["times"] < 13.0


@pytest.mark.parametrize("n", [200, 800])
def test_a_tool_orientation_that_a_real_arm_keeps_nearly(identified, n):
    """The rank is full by what the arm strays, millidegrees to degrees; the same three are told to be hardly seen."""
    q, pairs = constant_orientation_poses(n, np.random.default_rng(7)), all_pairs(n)
    rows = table(q, lengths(TRUTH, q, pairs) + SIGMA * np.random.default_rng(8).normal(size=n), pairs)
    result, _ = identified(rows)
    assert (result["rank"], result["null_space"]) == (36, [])
    assert len(result["hardly_seen"]) == 3
    # Where the base and where the tool is: shifts of the one undo those of the other.
    parts = {name.partition(".")[0] for direction in result["hardly_seen"] for name in direction["names"]}
    assert {"link1", "link7"} <= parts
    assert stated(result)["identified"].values["weak"] == 3
    advised = advised_by_kind(result)[POSES]
    assert (advised["n"], advised["full_rank"]) == (3, True)
    varied, _ = identified(random_table(200, np.random.default_rng(9), SIGMA))
    assert (varied["hardly_seen"], varied["additions"]) == ([], [])
    assert stated(varied)["identified"].values["unseen"] == 0


def refused(tmp_path, capsys, rows, rig, *options):
    """Return the single line on standard error."""
    write_table(tmp_path / "t.csv", rows, UNITS)
    write_rig(tmp_path / "rig.toml", rig)
    arguments = ["identify", tmp_path / "t.csv", "--model", "puma560", "--rig", tmp_path / "rig.toml", *options]
    code = cli.main([str(a) for a in arguments])
    out, err = capsys.readouterr()
    assert (code, out, err.count("\n")) == (2, "", 1)
    return err


def test_rows_without_information(tmp_path, capsys):
    """One row, or a reading that never changes: the cable was disconnected, or a cell was filled down in a spreadsheet."""
    rows = random_table(60, np.random.default_rng(11), SIGMA)
    for chosen, said in (
        (rows.select(slice(1)), "t.csv row 2: 1 row cannot identify"),
        (replace(rows, value=np.full(60, 0.46)), "same in all 60 ball_bar rows though"),
    ):
        assert said in refused(tmp_path, capsys, chosen, RIG)


def test_a_coordinate_that_never_changes(tmp_path, capsys):
    """It may while the end moves in a plane; while it moves in space, the column was filled with one value."""
    q = random_poses(60, np.random.default_rng(13))
    xyz = point_forward(CHAIN, TRUTH, q, np.array([0.05, 0.0, 0.1]))
    rows = ObservationTable(
        q=q, kind=np.full(60, "position"), xyz=xyz, tracker=np.full(60, "t"), target=np.full(60, "ball")
    )
    tracker = Device("t", tuple(map(tuple, 1e-10 * np.eye(3))))
    rig = Rig(targets={"ball": Point("ball", (0.05, 0.0, 0.1), None)}, trackers={"t": tracker})
    for at, said in (([0], "x"), ([1], "y"), ([1, 2], "y and z")):
        same = xyz.copy()
        same[:, at] = 0.25
        err = refused(tmp_path, capsys, replace(rows, xyz=same), rig)
        assert re.search(rf": {said} .* 60 position rows .* column", err)
    turned = np.zeros((60, 6))
    turned[:, 0] = q[:, 0]
    flat = replace(rows, q=turned, xyz=np.where(np.arange(3) == 2, 0.25, xyz))
    check_rows(CHAIN, flat, np.ones(60, dtype=bool))


def test_rows_that_determine_nothing(tmp_path, capsys):
    """A ball was seated once in each of six sockets at unknown positions."""
    rows = random_table(6, np.random.default_rng(13))
    names = np.array([str(i) for i in range(6)])
    seats = ObservationTable(q=rows.q, kind=np.full(6, "seat"), socket=names, place=np.full(6, "front"))
    err = refused(tmp_path, capsys, seats, replace(RIG, spheres={"s0": RIG.spheres["s0"]}))
    ended(err, "unsolvable", "sigma_mm", "unknown")
