"""A pose counts once for joint laws, however many rows it has: the reduction of its rows is exact, and repeats decide nothing."""

from dataclasses import replace

import numpy as np
import pytest
from ur10_bench import RIG, ROBOT

from truearm.estimate import law_fit
from truearm.estimate.circumstances import poses
from truearm.estimate.law_candidates import candidates, gravity_of, law_priors
from truearm.estimate.law_choice import GATE
from truearm.estimate.law_fit import law_problem, learn, posterior
from truearm.estimate.pose_noise import PoseNoise, RowsByPose
from truearm.estimate.problem import build_problem
from truearm.estimate.row_errors import row_errors
from truearm.estimate.solvers import LawMode
from truearm.estimate.uncertainty import covariance_root
from truearm.kinds.table import ObservationTable
from truearm.model.chain import point_forward
from truearm.model.law_chain import with_laws
from truearm.types import Point, Rig

NOISE = 5e-5  # m
JOINT_ERROR = 2e-4  # rad, of each joint at a pose: the arm's own, which no repeat averages
POINTS = {"a": (0.0, 0.02, 0.109), "b": (0.05, 0.0, 0.15), "c": (-0.04, 0.03, 0.2)}
TARGETS = Rig(targets={name: Point(name, xyz, None) for name, xyz in POINTS.items()}, trackers=RIG.trackers)
CHAIN = ROBOT.chain


def repeated(repeats, n_poses=18, joint_error=JOINT_ERROR):
    """Three targets of a UR10 at each pose, again and again; nothing but noise and the joints' errors."""
    rng = np.random.default_rng(0)
    q = rng.uniform(-1.5, 1.5, (n_poses, 6)) + np.array([0.0, -1.5, 1.5, 0.0, 1.5, 0.0])
    true_q = q + joint_error * rng.normal(size=q.shape)
    pose = np.repeat(np.arange(n_poses), len(POINTS) * repeats)
    target = np.resize(list(POINTS), pose.size)
    xyz = point_forward(CHAIN, CHAIN.params_nominal, true_q[pose], np.array([POINTS[name] for name in target]))
    return ObservationTable(
        q=q[pose],
        kind=np.full(pose.size, "position"),
        xyz=xyz + NOISE * rng.normal(size=xyz.shape),
        tracker=np.full(pose.size, "tracker"),
        target=target,
        source=np.array([f"world row {i + 1}" for i in range(pose.size)]),
    )


def curves_of(table, rig=TARGETS):
    """The problem of the first and the third joint's error curves, with the nominal geometry free."""
    laws = candidates(CHAIN, table.q, LawMode.CURVE, gravity_of(table, None), [])[0]
    laws = [law for law in laws if law.joint in (0, 2)]
    problem = build_problem(with_laws(CHAIN, laws), rig, table)
    columns = np.ones(len(problem.names), dtype=bool)
    columns[: CHAIN.params_nominal.size] = ROBOT.free
    return law_problem(problem, columns, problem.start, poses(table), law_priors(CHAIN, laws, table.q))


def judged_rows(of, learned):
    fitted = posterior(of, learned)
    root = covariance_root(fitted.covariance)
    return row_errors(of.problem, fitted.x, of.columns, root, np.ones(of.pose.size), of.pose, learned.noise)


def test_the_reduction_of_a_pose_is_exact(monkeypatch):
    of = curves_of(repeated(repeats=8, n_poses=8))
    results = []
    for _ in range(2):
        learned = learn(of, PoseNoise.of(1.0, 6, 1e-4))
        results.append((learned, judged_rows(of, learned)))
        monkeypatch.setattr(RowsByPose, "projected", lambda poses, columns: poses)
        monkeypatch.setattr(law_fit, "independent", lambda rows: rows)
    (learned, rows), (dense, dense_rows) = results
    assert learned.evidence == pytest.approx(dense.evidence, rel=1e-7)
    assert learned.noise[:3] == pytest.approx(dense.noise[:3], rel=1e-4)
    np.testing.assert_allclose(np.sqrt(learned.noise.joint), np.sqrt(dense.noise.joint), rtol=1e-4, atol=1e-8)
    assert list(learned.nats.values()) == pytest.approx(list(dense.nats.values()), rel=1e-3, abs=1e-3)
    np.testing.assert_allclose(rows.left_out["m"], dense_rows.left_out["m"], rtol=1e-3, atol=1e-9)
    np.testing.assert_allclose(rows.distance, dense_rows.distance, rtol=1e-3, atol=1e-6)
    assert rows.parts["m"] == pytest.approx(dense_rows.parts["m"], rel=1e-3)


def test_coefficients_that_act_at_no_reading_are_left_out_of_learning(monkeypatch):
    of = curves_of(repeated(repeats=2))
    (part, _), learned = of.some(), learn(of, PoseNoise.of(1.0, 6, 1e-4))
    assert part.is_law.sum() < 0.7 * of.is_law.sum()
    monkeypatch.setattr(law_fit, "acting", lambda law: np.ones(law.size, dtype=bool))
    every = learn(of, PoseNoise.of(1.0, 6, 1e-4))
    assert learned.evidence == pytest.approx(every.evidence, abs=1e-6)
    assert list(learned.nats.values()) == pytest.approx(list(every.nats.values()), abs=1e-6)
    covariance = posterior(of, every).covariance
    sigma = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(
        posterior(of, learned).covariance / sigma / sigma[:, None], covariance / sigma / sigma[:, None], atol=1e-6
    )


def test_nothing_contradicts_the_only_row_of_a_target():
    """Its distance was rounding over rounding, 33 σ, and a row that is left out takes its unknown target with it."""
    table = repeated(repeats=2)
    target = table.target.astype("U8")
    target[7] = "once"
    rig = replace(TARGETS, targets={**TARGETS.targets, "once": Point("once", (0.1, 0.0, 0.1), None)})
    of = curves_of(table.replace(target=target), rig)
    learned = learn(of, PoseNoise.of(1.0, 6, 1e-4))
    rows = judged_rows(of, learned)
    assert rows.distance[7] < 1e-3
    assert not rows.beyond.any()


@pytest.mark.parametrize("repeats", [2, 10, 60])
def test_repeats_of_few_poses_are_no_evidence_of_curves(repeats):
    """When 24 rows counted as a pose of their own, ten repeats made curves of the errors that the joints have at 18 poses."""
    learned = learn(curves_of(repeated(repeats)), PoseNoise.of(1.0, 6, 1e-4))
    assert max(learned.nats.values()) < GATE
    assert 0.3 < np.sqrt(learned.noise.joint.mean()) / JOINT_ERROR < 1.3
    assert learned.noise.sensor == pytest.approx(1.0, abs=0.25)  # its standard deviation is 0.1 with two repeats


def test_each_joint_has_the_error_that_it_has():
    """Three targets apart see a wrist that errs; one variance for all joints would put its error into all of them."""
    error = np.array([0.05, 0.1, 0.2, 0.1, 0.3, 0.4]) * 1e-3
    noise = learn(curves_of(repeated(1, n_poses=300, joint_error=error)), PoseNoise.of(1.0, 6, 1e-4)).noise
    np.testing.assert_allclose(np.sqrt(noise.joint), error, rtol=0.2, atol=3e-5)
    assert np.sqrt(noise.shared) < 2e-5  # of 5e-5 m of a row
    assert np.sqrt(noise.turned) < 3e-5
