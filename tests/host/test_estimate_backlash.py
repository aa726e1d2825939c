"""Backlash with known and unknown approach directions, and declarations that do not fit."""

from dataclasses import replace

import numpy as np
import pytest
from puma_bench import CHAIN, FREE, RIG, SIGMA, random_table

from truearm.errors import ProblemError
from truearm.estimate.identify import identify
from truearm.estimate.problem import build_problem
from truearm.estimate.residual_noise import residual_cov
from truearm.types import Device, Point

B = np.array([4e-4, 2e-4, 3e-4, 5e-4, 2e-4, 8e-4])
B_SIGMA = 0.1 * B
READING = 2e-5
COV = np.diag(READING**2 + 0.25 * B**2)
WORN = replace(
    RIG, joint_cov=tuple(map(tuple, COV.tolist())), backlash=tuple(B.tolist()), backlash_sigma=tuple(B_SIGMA.tolist())
)


def table(n=60, unknown=()):
    """Return the lengths of a perfect arm whose readings differ from the links by half the backlash; some (row, joint) sides are unknown."""
    rng = np.random.default_rng(4)
    true = random_table(n, rng, 0.0)
    side = rng.choice([-1.0, 1.0], true.q.shape)
    read = true.q + 0.5 * B * side
    for row, joint in unknown:
        side[row, joint] = np.nan
        read[row, joint] = true.q[row, joint]
    return replace(true, q=read, side=side)


def cov_of(problem):
    (group,) = problem.groups
    return residual_cov(group.sensor_cov, group.evaluate(problem.chain, problem.start).jac_joints, problem.joint_cov)


def test_with_the_sides_the_links_are_where_they_are():
    perfect = random_table(60, np.random.default_rng(4), 0.0)
    (group,) = build_problem(CHAIN, WORN, table()).groups
    np.testing.assert_allclose(group.q, perfect.q, atol=1e-15)
    exact = identify(CHAIN, WORN, table(), free=FREE)
    assert exact.rms_after["m"] < 1e-9
    blind = identify(CHAIN, WORN, replace(table(), side=np.full((60, 6), np.nan)), free=FREE)
    assert blind.rms_after["m"] > 2e-5
    assert np.nanmedian((exact.sigma / blind.sigma)[:54][FREE]) < 0.9


def test_what_is_left_is_how_well_it_is_known_and_all_of_it_where_the_side_is_not():
    problem = build_problem(CHAIN, WORN, table(unknown=[(3, 1), (7, 5)]))
    (group,) = problem.groups
    jac = group.evaluate(problem.chain, problem.start).jac_joints
    left = np.tile(READING**2 + 0.25 * B_SIGMA**2, (60, 1))
    left[3, 1] += 0.25 * B[1] ** 2
    left[7, 5] += 0.25 * B[5] ** 2
    np.testing.assert_allclose(cov_of(problem)[:, 0], SIGMA**2 + (jac**2 * left).sum(axis=1), rtol=1e-9)


def test_rows_of_three_residuals_have_it_too():
    """Points of a tracker, one of them approached from an unknown side."""
    cov = tuple(map(tuple, (1e-10 * np.eye(3)).tolist()))
    seen = table(40, unknown=[(2, 0)])
    tracker = Device("t", cov, xyz=(0.0, 0.0, 0.0), sigma=0.0, turn_sigma=0.0)
    rig = replace(WORN, trackers={"t": tracker}, targets={"p": Point("p", (0.1, 0.0, 0.05))})
    words = {"kind": np.full(40, "position"), "tracker": np.full(40, "t"), "target": np.full(40, "p")}
    problem = build_problem(CHAIN, rig, replace(seen, xyz=np.zeros((40, 3)), sigma=np.full(40, np.nan), **words))
    (group,) = problem.groups
    jac = group.evaluate(problem.chain, problem.start).jac_joints.reshape(40, 3, 6)
    left = np.tile(READING**2 + 0.25 * B_SIGMA**2, (40, 1))
    left[2, 0] += 0.25 * B[0] ** 2
    expected = 1e-10 * np.eye(3) + np.einsum("nwj,nj,nvj->nwv", jac, left, jac)
    np.testing.assert_allclose(cov_of(problem), expected, rtol=1e-9, atol=1e-16)


@pytest.mark.parametrize(
    ("rig", "says"),
    [
        (replace(WORN, joint_cov=()), "backlash needs joint_cov"),
        (replace(WORN, backlash=WORN.backlash[:3]), "for each joint"),
        (replace(WORN, backlash_sigma=()), "for each joint"),
        (replace(WORN, backlash=tuple(3.0 * B)), "at least half"),
    ],
)
def test_what_does_not_fit_is_said(rig, says):
    with pytest.raises(ProblemError, match=says):
        build_problem(CHAIN, rig, table())
