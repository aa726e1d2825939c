"""The report of a correction compared with the true arm: expected errors, straight moves, margins, targets outside the calibrated range."""

import json
import re

import correct_bench
import numpy as np
import pytest
from puma_bench import CHAIN, DESIGN, TRUTH
from tests.host.controllers import Controller
from tests.host.findings_bench import listed
from tests.host.result_schema import signed
from tests.host.target_bench import rapid, table

from truearm.correct.correction import Configuration, ModelPair, correct, limit_margins, straight_moves
from truearm.estimate.prediction import ParametersKnown, end_sigmas
from truearm.model.chain import forward
from truearm.model.inverse import singular_value
from truearm.model.transforms import apart
from truearm.workflows.correction_findings import configuration_notes, unexplained_error

SAME = "0,0,0,0,0,0"


# what the covariance says


def test_the_sigma_of_the_end_is_that_of_parameters_drawn_from_their_covariance():
    """400 draws: a standard deviation over three axes is then known to 3 %, four of which are allowed."""
    rng = np.random.default_rng(0)
    half = rng.normal(size=(len(DESIGN), 9)) * 1e-4
    q, point = correct_bench.good_poses(5), np.tile([0.02, -0.03, 0.12], (5, 1))
    known = ParametersKnown(CHAIN, DESIGN, half @ half.T, np.zeros((len(DESIGN), 0)))
    found = end_sigmas(known, q, point)
    assert not found.relative
    poses = np.array([forward(CHAIN, DESIGN + half @ rng.normal(size=9), q) for _ in range(400)])
    at = poses[..., :3, :3] @ point[0] + poses[..., :3, 3]
    np.testing.assert_allclose(found.position, np.sqrt(((at - at.mean(0)) ** 2).sum(-1).mean(0)), rtol=0.12)
    nominal = forward(CHAIN, DESIGN, q)
    turns = np.array([apart(one, nominal)[:, 3:] for one in poses])
    np.testing.assert_allclose(found.rotation, np.sqrt((turns**2).sum(-1).mean(0)), rtol=0.12)


def test_a_base_that_nobody_saw_does_not_count():
    """A direction that moves all ends as one body leaves what is known among them; one that moves them otherwise leaves nothing to say."""
    q, point = correct_bench.good_poses(6), np.zeros((6, 3))
    names = list(CHAIN.parameter_names)
    unseen = np.zeros((len(DESIGN), 1))
    unseen[names.index("link1.x")] = 1.0
    covariance = np.zeros((len(DESIGN), len(DESIGN)))
    covariance[names.index("link1.x"), names.index("link1.x")] = 1.0
    known = ParametersKnown(CHAIN, DESIGN, covariance, unseen)
    found = end_sigmas(known, q, point)
    assert found.relative
    assert found.position.max() < 1e-9
    assert end_sigmas(known, q[:2], point[:2]) is None
    whole = known._replace(unseen=unseen[:, :0])  # every direction was seen, and the base is left out all the same
    assert end_sigmas(whole, q, point, any_base=True).position.max() < 1e-9
    other = unseen * 0.0
    other[names.index("link3.x")] = 1.0
    assert end_sigmas(known._replace(unseen=other), q, point) is None


def test_the_unexplained_part_is_a_standard_deviation():
    """The mean of |x| is √(2/π) of the standard deviation where x is normal."""
    assert unexplained_error({"unexplained": None}) == (0.0, 0.0)
    assert unexplained_error({"predicted_error": {"scatter_mm": 0.1}})[0] == pytest.approx(0.1e-3)
    assert unexplained_error({"pose_error": {"shared_mm": 0.1}})[0] == pytest.approx(np.sqrt(3) * 0.1e-3)
    drawn = np.abs(np.random.default_rng(0).normal(0.0, 0.2, 100_000)).mean()
    position, turn = unexplained_error({"unexplained": {"mean_mm": drawn, "mean_deg": 0.01}})
    assert position == pytest.approx(0.2e-3, rel=0.01)
    assert turn == pytest.approx(np.deg2rad(0.01) * np.sqrt(np.pi / 2))
    moves = {"without_bad_rows": {"tool_moves_mm": 0.7}, "unexplained": {"mean_mm": 0.1}}
    assert unexplained_error(moves)[0] == pytest.approx(0.7e-3)


# straight moves


def test_a_straight_move_bends_as_the_controller_drives_it():
    """Against an interpreter's own path of 55 places; the nine of ours miss at most 2 % of a smooth curve's largest deviation."""
    q = correct_bench.good_poses(8)
    targets = correct_bench.nominal_poses(q)
    done = correct(ModelPair(CHAIN, DESIGN, TRUTH), targets, configuration=Configuration(q))
    tool = np.eye(4)
    tool[:3, 3] = 0.02, -0.03, 0.1
    found = straight_moves(ModelPair(CHAIN, DESIGN, TRUTH), done.q[:-1], done.commanded[1:], np.tile(tool, (7, 1, 1)))
    machine = Controller(CHAIN, DESIGN, done.q[0], tcp=tool)
    for k in range(7):
        machine.q = done.q[k]
        machine.move_line(done.commanded[k + 1] @ tool, 0.1)
        path = machine.moves[-1].path
        places = (forward(CHAIN, TRUTH, path) @ tool)[:, :3, 3]
        chord = (places[-1] - places[0]) / np.linalg.norm(places[-1] - places[0])
        beside = places - places[0] - np.outer((places - places[0]) @ chord, chord)
        largest = np.linalg.norm(beside, axis=1).max()
        assert found.deviation[k] == pytest.approx(largest, rel=0.02, abs=1e-6)
        # the interpreter ends to 1e-10
        assert found.singular_value[k] <= singular_value(CHAIN, DESIGN, path[[0, -1]]).min() + 1e-9
        assert found.limits[k].min() <= limit_margins(CHAIN, path[[0, -1]]).min() + 1e-9


def test_a_line_that_cannot_be_followed_has_no_figures(bench, tmp_path, printed):
    """From the other side of the base straight through it: nothing is stated from the part within reach."""
    there = correct_bench.good_poses(3)[2]
    behind = there - np.pi * np.sign(there[0]) * np.eye(6)[0]
    q = np.array([there, behind])
    program = rapid(correct_bench.nominal_poses(q), q)
    (tmp_path / "a.mod").write_bytes(re.sub(rb"MoveL [^!\r]*,v100", b"MoveL p0,v100", program))
    frames = ("--work", SAME, "--flange", SAME)
    given = ("correct", bench[0] / "result.json", tmp_path / "a.mod", "--out", tmp_path / "b.mod", *frames)
    said = printed(*given, "--report", tmp_path / "page.html", "--json")
    (move,) = json.loads(said)["moves"]
    assert (move["deviation_mm"], move["singular_value"], move["drivable"]) == (None, None, False)
    bent = listed(json.loads(said))["moves-bent"]
    assert (bent["n"], "worst" in bent) == (1, False)
    assert "cannot be followed" in (tmp_path / "page.html").read_text("utf-8")


# what is said


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    folder = tmp_path_factory.mktemp("findings")
    estimate = correct_bench.identified()
    correct_bench.write(folder / "result.json", estimate)
    return folder, estimate


def test_targets_outside_what_was_calibrated_are_named(bench, tmp_path, printed):
    """Joint 2 was seen from −60 to 0 deg only: the rows beyond are named, a joint a whole turn away is the same place."""
    folder, _ = bench
    document = json.loads((folder / "result.json").read_text())
    q = correct_bench.good_poses(12)
    (tmp_path / "t.csv").write_text(table(correct_bench.nominal_poses(q), q))
    document["joint_range"]["upper"] = [v + 2 * np.pi for v in document["joint_range"]["upper"]]
    document["joint_range"]["lower"] = [v + 2 * np.pi for v in document["joint_range"]["lower"]]
    said = printed("correct", _written(tmp_path, document), tmp_path / "t.csv", "--out", tmp_path / "a.csv")
    assert "outside the joint" not in " ".join(said.split())
    document["joint_range"]["lower"][1], document["joint_range"]["upper"][1] = np.deg2rad([-60.0, -20.0])
    given = ("correct", _written(tmp_path, document), tmp_path / "t.csv", "--out", tmp_path / "b.csv", "--json")
    found = json.loads(printed(*given))
    outside = [one["place"] for one in found["targets"] if one["outside"]]
    joint2 = np.array([one["after"]["q2_deg"] for one in found["targets"]])
    slack = np.rad2deg(0.05)
    beyond = (joint2 < -60.0 - slack) | (joint2 > -20.0 + slack)
    assert 0 < beyond.sum() < 12
    assert outside == [f"row {k + 2}" for k in np.flatnonzero(beyond)]
    assert listed(found)["targets-outside"]["n"] == beyond.sum()
    del document["joint_range"]
    given = ("correct", _written(tmp_path, document), tmp_path / "t.csv", "--out", tmp_path / "c.csv", "--json")
    assert "range-unknown" in listed(json.loads(printed(*given)))


def _written(folder, document):
    path = folder / "result.json"
    path.write_text(signed(document))
    return path


def test_what_only_places_base_and_tool_leaves_the_expected_error_relative_to_them(bench, tmp_path, run):
    """For two targets too; what moves the end otherwise leaves nothing to expect."""
    document = json.loads((bench[0] / "result.json").read_text())
    q = correct_bench.good_poses(2)
    (tmp_path / "t.csv").write_text(table(correct_bench.nominal_poses(q), q))
    for number, (names, frames) in enumerate(((("link1.x", "link7.z"), ["base", "tool"]), (("link3.x",), []))):
        document["null_space"] = [{"names": [name], "weights": [1.0]} for name in names]
        out = tmp_path / f"{number}.csv"
        _, said, _ = run("correct", _written(tmp_path, document), tmp_path / "t.csv", "--out", out, "--json")
        found = json.loads(said)
        assert found["expected_relative_to"] == frames
        assert all((target["expected_mm"] is None) == (not frames) for target in found["targets"])


def test_a_page_is_whole_and_holds_strangers_names(bench, tmp_path, run, printed):
    folder, _ = bench
    q = correct_bench.good_poses(6)
    name = "a<script>&.mod"
    (tmp_path / name).write_bytes(rapid(correct_bench.nominal_poses(q), q))
    given = ("correct", folder / "result.json", tmp_path / name, "--work", SAME, "--flange", SAME)
    said = printed(*given, "--out", tmp_path / "b.mod", "--report", tmp_path / "page.html")
    assert "page.html" in said
    page = (tmp_path / "page.html").read_text()
    assert "a<script>" not in page
    assert "a&lt;script&gt;" in page
    assert page.count("<svg") == 3
    assert "Straight moves" in page
    code, _, err = run(*given, "--out", tmp_path / "c.mod", "--report", tmp_path / "b.mod")
    assert code == 2
    assert "b.mod" in err
    assert not (tmp_path / "c.mod").exists()


def test_an_axis_just_beyond_a_quarter_turn_is_shown_on_its_side():
    q = np.radians([[-0.031, 0.0, 0.0, 89.9999, 0.0, -95.2]])
    quarters = np.array([[0.0, np.nan, np.nan, 1.0, np.nan, 0.0]])
    (note,) = configuration_notes(q, quarters, np.array([True]), [7])
    assert note.code == "configuration-data"
    # line, cf of an axis and its value, the axis and its angle, the value needed
    details = [
        ["7", "1", "0", "1", "-0.03", "-1"],
        ["7", "4", "1", "4", "89.9999", "0"],
        ["7", "6", "0", "6", "-95", "-2"],
    ]
    assert [re.findall(r"-?\d[\d.]*", detail) for detail in note.values["details"].split("; ")] == details


def test_an_axis_at_a_quarter_turn_within_rounding_contradicts_no_data():
    q = np.radians([[-9.48e-15, 0.0, 0.0, 90.0, 0.0, -90.0]])
    for quarters in ([0.0, np.nan, np.nan, 0.0, np.nan, -1.0], [-1.0, np.nan, np.nan, 1.0, np.nan, -2.0]):
        assert not list(configuration_notes(q, np.array([quarters]), np.array([True]), [7]))
