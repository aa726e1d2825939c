"""``truearm identify`` on data with a fault: what it prints and stores, and that its advice helps."""

import html
import json
from dataclasses import replace

import fault_worlds as worlds
import hypothesis_worlds
import numpy as np
import pytest
from command_line import Run, told
from puma_bench import CHAIN
from result_schema import check_schema
from tests.host.findings_bench import listed, stated

import truearm
from truearm.estimate.problem import build_problem
from truearm.kinds.rig_file import write_rig
from truearm.kinds.table_file import write_table
from truearm.model.chain import point_forward
from truearm.model.robot_file import builtin_robot
from truearm.report.result_findings import fault_findings
from truearm.types import BallBar, Point, Rig

CHUCKS_MM = (500, 300, -500), (-500, 300, -400), (100, -600, -300)


@pytest.mark.parametrize("n", [None, 95])
def test_what_an_applied_cause_did_to_held_out_rows_is_said_to_be_in_their_errors(n):
    held = n and {"n": n}
    (finding,) = fault_findings({"faults": [], "applied": ["base.tilt.drift"], "held_out": held})
    assert (finding.code, finding.values["held"]) == ("faults-applied", n)
    assert ("95 held-out rows" in finding.text()) == (n == 95)


@pytest.fixture(scope="module")
def slip(tmp_path_factory):
    """Return the files of a session in which a chuck slips, its name and the row."""
    folder = tmp_path_factory.mktemp("slip")
    table, (chuck, at) = worlds.slipped(worlds.plan(), np.random.default_rng(1))
    write_table(folder / "poses.csv", table, CHAIN.joint_units)
    write_rig(folder / "rig.toml", worlds.RIG)
    return folder, chuck, at


def test_a_slip_is_named_and_the_option_that_is_named_removes_it(run: Run, slip) -> None:
    folder, chuck, at = slip
    arguments = ["identify", folder / "poses.csv", "--model", "puma560", "--rig", folder / "rig.toml", "--json"]
    first = json.loads(run(*arguments).out)
    check_schema(first)
    (fault,) = first["faults"]
    cause = fault["rivals"][0]
    assert cause["name"] == f"chuck.{chuck}.step"
    assert abs(cause["first"] - (at + 1)) <= 15
    assert cause["from"] == f"poses.csv row {cause['first'] + 1}", "the header is row 1 of the file"
    (size,) = fault["sizes"]
    assert abs(size["value"] - 0.3e-3) < 4.0 * size["sigma"]
    outcome = run(*arguments, "--apply", cause["apply"])
    assert (outcome.code, outcome.err) == (0, "")
    second = json.loads(outcome.out)
    check_schema(second)
    assert second["faults"] == []
    # First order and the refit agree to the curvature, some parts in a thousand.
    assert second["chi2_reduced"] == pytest.approx(first["claim"]["chi2_reduced"], rel=0.01)
    assert second["predicted_error"]["rms_mm"] == pytest.approx(cause["error_mm"], rel=0.05)
    moved = [p for p in second["parameters"] if p["name"].startswith(f"chuck.{chuck}")]
    assert [p["name"].rpartition("@")[2] for p in moved] == [str(cause["first"])] * 3


def test_the_mean_of_the_causes_is_applied_on_request(run: Run, tmp_path) -> None:
    """A longer bar: also a bar that sags explains the rows. Nothing is applied silently."""
    world = hypothesis_worlds.world("puma560", "bar", 2)
    write_table(tmp_path / "poses.csv", world.table, world.site.chain.joint_units)
    write_rig(tmp_path / "rig.toml", world.site.rig)
    files = [tmp_path / "poses.csv", "--model", "puma560", "--rig", tmp_path / "rig.toml", "--json"]
    plain, applied, one = (
        json.loads(run("identify", *files, *more).out) for more in ([], ["--apply", "mean"], ["--apply", "bar.sag"])
    )
    assert len(plain["faults"][0]["rivals"]) == 2
    choice = listed(plain)["fault-choice"]
    assert choice["first"] == "mean"
    errors = [
        hypothesis_worlds.tool_error(world, np.array([entry["value"] for entry in document["parameters"]]))
        for document in (plain, applied)
    ]
    predicted = [document["predicted_error"]["rms_mm"] * 1e-3 for document in (plain, applied, one)]
    assert predicted[1] == pytest.approx(plain["faults"][0]["mean"]["error_mm"] * 1e-3, rel=1e-3)
    assert predicted[1] < predicted[2] < predicted[0]
    for document, total in zip((plain, applied, one), predicted, strict=True):
        parts = [document["claim"][f"{part}_mm"] for part in ("parameters", "unnamed", "rivals", "shift")]
        assert np.linalg.norm(parts) * 1e-3 == pytest.approx(total, rel=0.02)
    assert errors[0] < 2.0 * predicted[0]
    assert errors[1] < 2.0 * predicted[1]
    assert (plain["applied"], applied["applied"], one["applied"]) == ([], ["mean"], ["bar.sag"])
    first_lines = [listed(document)["usable"] for document in (plain, applied)]
    assert first_lines[0]["expected"]["mm"] == pytest.approx(predicted[0] * 1e3)
    assert (first_lines[1]["applied"], first_lines[1]["remaining"]["mm"]) == (
        ["mean"],
        pytest.approx(predicted[1] * 1e3),
    )
    offered = ["fault-choice" in {finding["code"] for finding in each["findings"]} for each in (plain, applied, one)]
    assert offered == [True, False, False]


def sagging(n, sag, noise):
    """Return lengths of a bar that sags [m], in random poses, their rig, the true arm and the sphere."""
    robot, rng, sphere = builtin_robot("puma560"), np.random.default_rng(1), np.array([0.02, 0.03, 0.12])
    q, chuck = rng.uniform(-2.0, 2.0, (2 * n, 6)), np.arange(2 * n) % 3
    truth = robot.parameter_sets["optimised"]
    way = point_forward(robot.chain, truth, q, sphere) - 1e-3 * np.array(CHUCKS_MM)[chuck]
    length = np.linalg.norm(way, axis=1)
    rows = np.flatnonzero(length >= 0.3)[:n]
    read = length + sag * np.square(way[:, :2] / length[:, None]).sum(axis=1) + noise * rng.normal(size=2 * n)
    table = truearm.ObservationTable(
        q=q[rows],
        kind=np.full(n, "ball_bar"),
        value=read[rows],
        bar=np.full(n, "b"),
        chuck=np.array([f"c{i}" for i in chuck[rows]]),
        sphere=np.full(n, "s"),
    )
    chucks = {f"c{i}": Point(f"c{i}", tuple(1e-3 * k for k in xyz), 1e-5) for i, xyz in enumerate(CHUCKS_MM)}
    bar = BallBar("b", 1.501, 1.0, 3.0, noise, 5e-5)
    return robot, table, Rig(chucks, {"s": Point("s", tuple(sphere.tolist()), 1e-5)}, {"b": bar}), truth, sphere


def fit_with_sag(robot, table, rig, estimate):
    """Return x (P,) of a fit of all rows with the sag as a parameter, by Gauss and Newton, and its σ (P,)."""
    problem = build_problem(robot.chain, rig, table)
    (group,), free = problem.groups, np.append(estimate.free, True)
    prior = np.diag(1.0 / np.append(problem.prior_sigma, np.inf))
    x = np.append(estimate.value, 0.0)
    at = {name: number for number, name in enumerate(problem.names)}
    for _ in range(8):
        ball, chucks = (
            x[[[at[f"{name}.{k}"] for k in "xyz"] for name in names]]
            for names in (["sphere.s"], np.strings.add("chuck.", table.chuck))
        )
        way = point_forward(robot.chain, x[: len(robot.chain.parameters)], table.q, ball[0]) - chucks
        sag = 1.0 - np.square(way[:, 2]) / np.square(way).sum(axis=1)
        lin, sigma = group.evaluate(robot.chain, x[:-1]), np.sqrt(group.sensor_cov)
        rows = np.column_stack([lin.jac_params, sag, lin.residual - x[-1] * sag]) / sigma
        rows = np.concatenate([rows, np.column_stack([prior, prior @ np.append(problem.start, 0.0) - prior @ x])])
        scale = np.linalg.norm(rows[:, :-1][:, free], axis=0)
        inverse = np.linalg.pinv(rows[:, :-1][:, free] / scale, rcond=1e-10)
        x[free] += inverse @ rows[:, -1] / scale
    sigma = np.zeros(x.size)
    sigma[free] = np.linalg.norm(inverse, axis=1) / scale
    return x[:-1], sigma[:-1]


@pytest.mark.parametrize(("n", "sag", "noise"), [(1800, 3e-3, 2e-5), (20_000, 3e-4, 1e-4)])
def test_what_is_applied_to_many_rows_is_the_fit_of_all_with_it_as_a_parameter(n, sag, noise) -> None:
    """More rows than an examination takes; a sag of millimetres is not of first order."""
    robot, table, rig, truth, sphere = sagging(n, sag, noise)
    calibration = truearm.identify(robot, table, rig, options=truearm.IdentifyOptions(apply=("bar.sag",)))
    estimate, p = calibration.estimate, truth.size
    x, sigma = fit_with_sag(robot, table, rig, estimate)
    assert (np.abs(estimate.value - x) <= 1e-3 * sigma).all()
    assert (estimate.sigma >= 0.99 * sigma)[np.isfinite(estimate.sigma)].all()
    q = np.random.default_rng(2).uniform(-2.0, 2.0, (500, 6))
    error = point_forward(robot.chain, estimate.value[:p], q, sphere) - point_forward(robot.chain, truth, q, sphere)
    assert np.sqrt(np.square(error).sum(axis=1).mean()) < 2.0 * calibration.predicted.rms
    findings = {finding.code: finding.values for finding in calibration.findings}
    assert findings["usable"]["remaining"]["mm"] == pytest.approx(1e3 * calibration.predicted.rms)
    assert "tool-error" in findings
    assert not {"doubtful-residuals", "too-many-outliers", "tool-error-shown"} & findings.keys()


def test_a_large_step_is_applied_to_the_rows_behind_it_alone() -> None:
    """Rows between two examined ones of the item are not used: rows of other items do not tell where its step is."""
    robot, table, rig, truth, sphere = sagging(2900, 0.0, 1e-4)
    table, of, row = table.select(np.random.default_rng(4).permutation(len(table))), 1, 1400
    end = point_forward(robot.chain, truth, table.q, sphere)
    here, there = (
        np.linalg.norm(end - 1e-3 * np.array(CHUCKS_MM[of]) - by, axis=1) for by in (0.0, [6e-3, -3e-3, 5e-3])
    )
    moved = (table.chuck == f"c{of}") & (np.arange(len(table)) >= row)
    table = table.replace(value=table.value + moved * (there - here))
    calibration = truearm.identify(robot, table, rig, options=truearm.IdentifyOptions(apply=("mean",)))
    assert calibration.estimate.applied == ("mean",)
    assert 0.9 < calibration.estimate.claim.chi2_reduced < 1.1
    assert calibration.predicted is not None
    (fault,) = calibration.estimate.faults
    first, _ = fault.rivals[0].rows
    assert row <= first < row + 20


@pytest.mark.parametrize("n", [900, 2400])
def test_hysteresis_follows_the_row_before_in_the_table(n) -> None:
    """Even if that is neither examined nor fitted."""
    robot, table, rig, truth, sphere = sagging(n, 0.0, 1e-4)
    chuck = 1e-3 * np.array(CHUCKS_MM)[[int(name[1]) for name in table.chuck]]
    length = np.linalg.norm(point_forward(robot.chain, truth, table.q, sphere) - chuck, axis=1)
    table = table.replace(value=table.value + 3e-4 * np.sign(np.diff(length, prepend=length[:1])))
    held, options = np.arange(n) % 10 == 3, truearm.IdentifyOptions(apply=("bar.hysteresis",))
    estimate = truearm.identify(robot, table, rig, hold_out=held, options=options).estimate
    assert estimate.applied == ("bar.hysteresis",)
    assert 0.85 < estimate.claim.chi2_reduced < 1.15


def test_noise_of_another_size_than_declared_has_the_error_that_all_rows_leave() -> None:
    robot, table, rig, *_ = sagging(4000, 0.0, 1e-4)
    too_small = replace(rig, bars={"b": replace(rig.bars["b"], sigma=5e-5)})
    right, learned = (truearm.identify(robot, table, of).estimate.claim for of in (rig, too_small))
    assert (right.noise, learned.noise) == ("declared", "white")
    assert learned.parameters == pytest.approx(right.parameters, rel=0.05)


def test_a_person_reads_what_is_off_and_what_to_do(run: Run, slip, tmp_path) -> None:
    folder, chuck, _ = slip
    page = tmp_path / "page.html"
    files = [folder / "poses.csv", "--model", "puma560", "--rig", folder / "rig.toml", "--report", page]
    outcome = run("identify", *files, "--json")
    document = json.loads(outcome.out)
    findings = stated(document)
    assert findings["fault"].values["what"] == f"chuck.{chuck} has moved"
    assert findings["fault-choice"].values["first"].startswith("chuck.")
    # The error to expect is that of a fit without the slip, which displaces base and tool.
    assert "tool-error" not in findings
    expected = findings["tool-error-by-sigmas"].values
    assert expected["tool"]["mm"] > expected["error"]["mm"] > 0.0
    assert expected["faults"]["mm"] > expected["parameters"]["mm"]
    assert findings["usable"].values["expected"] == expected["tool"]
    text = html.unescape(page.read_text())
    assert findings["tool-error-by-sigmas"].text() in text
    assert findings["fault"].text() in text


def test_rows_left_out_and_fits_that_did_not_converge(run, slip):
    folder, *_ = slip
    arguments = ["identify", folder / "poses.csv", "--model", "puma560", "--rig", folder / "rig.toml", "--json"]
    result = json.loads(
        run(*arguments, "--hold-out", "0.2", "--leave-out", "poses.csv row 12:31", "--leave-out", "40").out
    )
    (rows,) = result["observations"]
    assert rows["fitted"] + rows["held_out"] == 360 - 21
    assert result["held_out"]["n"] == rows["held_out"]
    folder, *_ = slip
    files = [folder / "poses.csv", "--model", "puma560", "--rig", folder / "rig.toml"]
    outcome = run("identify", *files, "--max-iterations", "1", "--json")
    assert outcome.code == 3
    assert json.loads(outcome.out)["faults"] == []


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--apply", "chuck.c9"], "chuck.c9"),
        (["--apply", "chuck.c1@0"], "--apply 'chuck.c1@0'"),
        (["--apply", "chuck.c1@9:3"], "--apply 'chuck.c1@9:3': row 9 comes after row 3"),
        (["--apply", "chuck.c1@1:0"], "--apply 'chuck.c1@1:0'"),
        (["--apply", "chuck.c1@361"], "rows 1 to 360"),
        (["--apply", "arm.growth"], "chuck.c"),
        (["--leave-out", "x"], "--leave-out 'x'"),
        (["--leave-out", "5:2"], "--leave-out '5:2': row 5 comes after row 2"),
        (["--leave-out", "poses.csv row 1"], "poses.csv row 2"),
        (["--leave-out", "300:361"], "rows 300 to 361 cannot be left out:"),
        (["--leave-out", "1:360"], "nothing-left"),
    ],
)
def test_what_is_not_there_cannot_be_applied_or_left_out(run: Run, slip, options, message) -> None:
    folder, *_ = slip
    told(run("identify", folder / "poses.csv", "--model", "puma560", "--rig", folder / "rig.toml", *options), message)


def test_a_validation_names_what_is_off_and_no_option_that_it_does_not_have(run: Run, slip, tmp_path) -> None:
    folder, chuck, _ = slip
    write_table(tmp_path / "clean.csv", worlds.clean(worlds.plan(), np.random.default_rng(2)), CHAIN.joint_units)
    files = ["--rig", folder / "rig.toml"]
    run("identify", tmp_path / "clean.csv", "--model", "puma560", *files, "--out", tmp_path / "result.json")
    given = ("validate", tmp_path / "result.json", folder / "poses.csv", *files)
    findings = listed(json.loads(run(*given, "--json").out))
    assert findings["fault"]["what"] == f"chuck.{chuck} has moved"
    assert "faults-here" in findings
    assert "apply" not in run(*given).out


def test_a_slip_in_a_table_that_is_sorted_by_a_joint_is_named_by_its_times(run: Run, tmp_path) -> None:
    """In the order of joint 2, no row is the one from which the chuck was off. Seed 940010."""
    table, (chuck, at) = worlds.slipped(worlds.plan(), np.random.default_rng(940010))
    table = replace(table, time=100.0 + 12.0 * np.arange(len(table)))
    write_table(tmp_path / "sorted.csv", table.select(np.argsort(table.q[:, 1])), CHAIN.joint_units)
    write_rig(tmp_path / "rig.toml", worlds.RIG)
    outcome = run("identify", tmp_path / "sorted.csv", "--model", "puma560", "--rig", tmp_path / "rig.toml", "--json")
    result = json.loads(outcome.out)
    assert stated(result)["rows-reordered"].values == {"place": str(tmp_path / "sorted.csv")}
    (fault,) = result["faults"]
    found = fault["rivals"][0]
    assert found["name"] == f"chuck.{chuck}.step"
    assert abs(found["first"] - (at + 1)) <= 15
    row = int(np.flatnonzero(np.argsort(table.q[:, 1]) == found["first"] - 1)[0])
    assert found["from"] == f"sorted.csv row {row + 2}", "the row of the file"
