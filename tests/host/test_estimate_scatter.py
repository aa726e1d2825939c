"""The arm's own scatter: what is learned of it, and standard deviations that include it."""

from dataclasses import replace

import numpy as np
import pytest
from tests.host.puma_bench import CHAIN, DESIGN, FREE, TRUTH, random_poses

from truearm.estimate.circumstances import poses
from truearm.estimate.fit import fit
from truearm.estimate.identify import identify
from truearm.estimate.information import half, spectrum
from truearm.estimate.law_fit import covariance_with, is_of_arm, learned_scatter
from truearm.estimate.problem import build_problem
from truearm.estimate.solution import Options
from truearm.estimate.uncertainty import Goodness
from truearm.kinds.table import ObservationTable
from truearm.kinds.table_file import concatenate
from truearm.model.chain import point_forward, point_jacobians
from truearm.types import BallBar, Device, Point, Rig

NOISE = 1e-4  # m
TARGETS = {"a": (0.1, 0.0, 0.05), "b": (-0.05, 0.09, 0.05), "c": (-0.05, -0.09, 0.05)}
TRACKER = Device(
    "t",
    tuple(tuple(NOISE**2 * (i == k) for k in range(3)) for i in range(3)),
    (1.5, 0.0, 0.5),
    sigma=0.0,
    turn_sigma=0.0,
)
RIG = Rig(trackers={"t": TRACKER}, targets={name: Point(name, xyz) for name, xyz in TARGETS.items()})
FREE_HERE = FREE & np.array([not name.startswith("tool") for name in CHAIN.parameter_names])


def tracked(rng, n, shared, noise=NOISE, names="abc"):
    """Return n poses, each with all targets, with noise and an error of the arm that is common to the targets of a pose."""
    q = np.repeat(random_poses(n, rng), len(names), axis=0)
    targets = np.tile(list(names), n)
    points = point_forward(CHAIN, TRUTH, q, np.array([TARGETS[name] for name in targets]))
    moved = np.repeat(shared * rng.normal(size=(n, 3)), len(names), axis=0)
    xyz = points - np.array(TRACKER.xyz) + moved + noise * rng.normal(size=(len(q), 3))
    return ObservationTable(q=q, kind="position", xyz=xyz, tracker="t", target=targets)


def fitted(table, rig):
    problem = build_problem(CHAIN, rig, table)
    columns = np.concatenate([FREE_HERE, np.ones(len(problem.names) - FREE_HERE.size, dtype=bool)])
    start = problem.start.copy()
    start[: TRUTH.size] = TRUTH
    found = fit(problem, columns, start, Options(10))
    assert found.status == "converged"
    return problem, columns, found


def scatter_of(table, rig=RIG):
    """Return fit, columns, root of its covariance, and scatter with its covariance, None where rows of a pose are not alike."""
    problem, columns, found = fitted(table, rig)
    root, pose = half(spectrum(found.information.root)), poses(table)
    scatter = learned_scatter(problem, found.x, columns, pose, Goodness(1.0, 1.0, (0.0, 2.0)))
    if scatter is None or not (scatter.n and is_of_arm(scatter)):
        return found, columns, root, None, None
    return found, columns, root, scatter, covariance_with(scatter, problem, found.x, columns, root, pose)


def test_the_error_of_points_and_the_noise_of_rows_are_learned():
    """Of 40 worlds of 40 poses: the mean square error of the end, of joints and pose together, and a row's own variance."""
    rng, jac = (
        np.random.default_rng(0),
        point_jacobians(CHAIN, TRUTH, random_poses(50, np.random.default_rng(5)), np.zeros(3))[2],
    )
    variance, row = [], []
    for _ in range(40):
        *_, scatter, _ = scatter_of(tracked(rng, 40, 3.0 * NOISE, 2.0 * NOISE))
        by_joints = ((jac * list(scatter.joint.values())) ** 2).sum(axis=(1, 2)).mean()
        variance.append((3.0 * scatter.shared**2 + by_joints) / NOISE**2)
        row.append(scatter.factor)
        assert scatter.n == 40
    assert np.mean(variance) == pytest.approx(27.0, rel=0.1)
    assert np.mean(row) == pytest.approx(4.0, abs=3.0 * np.std(row) / np.sqrt(40))


def test_an_error_of_one_joint_is_told_from_one_of_the_pose():
    rng = np.random.default_rng(6)
    jogged = []
    for _ in range(10):
        table = tracked(rng, 60, 0.0)
        moved = np.repeat(1e-3 * rng.normal(size=60), 3)[:, None] * (np.arange(6) == 4)
        points = [
            point_forward(CHAIN, TRUTH, q, np.array([TARGETS[name] for name in table.target]))
            for q in (table.q, table.q + moved)
        ]
        *_, scatter, _ = scatter_of(table.replace(xyz=table.xyz + points[1] - points[0]))
        jogged.append([*scatter.joint.values(), scatter.shared])
    rms = np.sqrt(np.square(jogged).mean(axis=0))
    assert rms[4] == pytest.approx(1e-3, rel=0.1)
    assert np.delete(rms, 4).max() < 2e-4


@pytest.mark.parametrize("shared", [pytest.param(0.7, marks=pytest.mark.soak), 3.0])
def test_points_of_a_pose_do_not_count_as_poses(shared):
    """k = 2 coverage of a point elsewhere on the tool, at other poses: 60 worlds of 40 poses with three targets each.

    By declared noise alone, which is right of each row's own, the points lie outside far too often.
    """
    rng = np.random.default_rng(1)
    at = random_poses(20, rng)
    point, by_robot, _ = point_jacobians(CHAIN, TRUTH, at, np.array([0.0, 0.0, 0.1]))
    inside, declared = [], []
    for _ in range(60):
        found, columns, root, _, with_scatter = scatter_of(tracked(rng, 40, shared * NOISE))
        error = point_forward(CHAIN, found.x[: DESIGN.size], at, np.array([0.0, 0.0, 0.1])) - point
        jac = by_robot.reshape(60, -1)[:, columns[: DESIGN.size]]
        for covariance, into in (
            (root @ root.T if with_scatter is None else with_scatter, inside),
            (root @ root.T, declared),
        ):
            sigma = np.sqrt(np.einsum("mi,ij,mj->m", jac, covariance[: jac.shape[1], : jac.shape[1]], jac))
            into.append(np.abs(error.ravel()) < 2.0 * sigma)
    # 0.9545 of a Gaussian; 60 worlds with some 20 independent numbers each: a standard error of 0.006.
    assert 0.93 <= np.mean(inside) <= 0.975
    assert np.mean(declared) < (0.90 if shared < 1.0 else 0.6)


def test_without_such_errors_the_covariance_is_the_declared_one():
    """In 299 of 300 clean fits."""
    rng = np.random.default_rng(2)
    by_chance = [scatter_of(tracked(rng, 30, 0.0))[3] for _ in range(40)]
    assert sum(scatter is not None for scatter in by_chance) <= 1


def test_a_bar_and_a_target_at_one_pose_share_its_error():
    """Rows of two kinds: k = 2 coverage of a point elsewhere on the tool, 40 worlds of 60 poses."""
    rng = np.random.default_rng(7)
    bars = {"b": BallBar("b", 1.0, 1.0, 2.0, NOISE)}
    rig = replace(RIG, bars=bars, chucks={"c": Point("c", (0.9, 0.1, -0.2))}, spheres={"s": Point("s", TARGETS["b"])})
    at = random_poses(20, rng)
    point, by_robot, _ = point_jacobians(CHAIN, TRUTH, at, np.array([0.0, 0.0, 0.1]))
    inside = []
    for _ in range(40):
        table = tracked(rng, 60, 0.0, names="a")
        moved = 3.0 * NOISE * rng.normal(size=(60, 3))
        ball = point_forward(CHAIN, TRUTH, table.q, np.array(TARGETS["b"])) + moved
        length = np.linalg.norm(ball - rig.chucks["c"].xyz, axis=1) + NOISE * rng.normal(size=60)
        lengths = ObservationTable(q=table.q, kind="ball_bar", value=length, bar="b", chuck="c", sphere="s")
        both = concatenate([table.replace(xyz=table.xyz + moved), lengths])
        found, columns, _, scatter, covariance = scatter_of(both, rig)
        assert scatter.n == 60
        error = point_forward(CHAIN, found.x[: DESIGN.size], at, np.array([0.0, 0.0, 0.1])) - point
        jac = by_robot.reshape(60, -1)[:, columns[: DESIGN.size]]
        sigma = np.sqrt(np.einsum("mi,ij,mj->m", jac, covariance[: jac.shape[1], : jac.shape[1]], jac))
        inside.append(np.abs(error.ravel()) < 2.0 * sigma)
    assert 0.92 <= np.mean(inside) <= 0.98  # 0.9545, and 0.43 if the two rows counted as two poses


def test_one_row_a_pose_tells_nothing_and_identify_says_shared_errors():
    table = tracked(np.random.default_rng(3), 60, 3.0 * NOISE, names="a")
    assert scatter_of(table)[3] is None
    table = tracked(np.random.default_rng(4), 40, 3.0 * NOISE)
    estimate = identify(CHAIN, RIG, table, free=FREE_HERE)
    assert estimate.scatter.shared == pytest.approx(3.0 * NOISE, rel=0.3)
    _, columns, _, _, covariance = scatter_of(table)
    np.testing.assert_allclose(estimate.covariance[np.ix_(columns, columns)], covariance, rtol=1e-3, atol=1e-14)
