"""Joint laws over many worlds: whether the claimed covariance covers, and whether arms without laws are left alone.

Curves of 1, 2, 17 and 34 cycles and real masses, none of them drawn from the prior. WORLDS are run by ``make soak``.
"""

import numpy as np
import pytest
from ur10_bench import RIG, ROBOT

from truearm.estimate import joint_laws, law_fit
from truearm.estimate.problem import build_problem
from truearm.kinds.table import ObservationTable
from truearm.model.chain import joint_frames, point_forward
from truearm.workflows.identify import IdentifyOptions, identified
from truearm.workflows.inputs import Observed

WORLDS = 40
NOISE = 3e-5  # m
DOWN = np.array([0.0, 0.0, -1.0])
MIDDLE = np.array([0.0, -1.5, 1.5, 0.0, 1.5, 0.0])
CYCLES = (1, 2, 17, 34)
POINTS = np.array([[0.0, 0.02, 0.109], [0.08, 0.0, 0.06], [-0.05, 0.07, 0.08]])
WIDE, BEYOND = 1.2, 0.6  # rad: the covered range to either side, and how far outside of it is judged


def truth_of(rng, laws):
    """Return the true parameters and a function from readings to true joint angles."""
    chain = ROBOT.chain
    params = chain.params_nominal + ROBOT.free * rng.normal(
        0.0, [1e-3 if p.unit == "m" else 2e-3 for p in chain.parameters]
    )
    waves = [(joint, c, rng.uniform(1e-4, 4e-4), rng.uniform(0.0, 7.0)) for joint, c in zip(rng.permutation(4), CYCLES)]
    masses = {2: rng.uniform(4.0, 9.0), 3: rng.uniform(1.0, 3.0), 6: rng.uniform(0.5, 5.0)}
    compliance = {1: rng.uniform(1e-5, 5e-5), 2: rng.uniform(1e-5, 5e-5)}

    def angles(q):
        out = q.copy()
        if not laws:
            return out
        for joint, cycles, size, phase in waves:
            out[:, joint] += size * np.sin(cycles * q[:, joint] + phase)
        frames = joint_frames(chain, params, q)
        ends = [*(frames[:, k, :3, 3] for k in range(6)), point_forward(chain, params, q, np.zeros(3))]
        for joint, give in compliance.items():
            axis, origin = frames[:, joint, :3, 2], frames[:, joint, :3, 3]
            for k, mass in masses.items():
                if k > joint:
                    out[:, joint] += give * mass * (np.cross(axis, ends[k] - origin) @ DOWN)
        return out

    return params, angles


def table_of(q, points, target):
    n = len(q)
    return ObservationTable(
        q=q,
        kind=np.full(n, "position"),
        xyz=points,
        sigma=np.full(n, NOISE),
        tracker=np.full(n, "tracker"),
        target=target,
        source=np.array([f"world row {i + 1}" for i in range(n)]),
    )


def world(seed, n, laws, several=1):
    """Return a table to fit, and tables without noise inside and outside the covered range."""
    rng = np.random.default_rng(seed)
    params, angles = truth_of(rng, laws)

    def rows(count, low, high, noise):
        q = MIDDLE + rng.choice([-1.0, 1.0], (count, 6)) * rng.uniform(low, high, (count, 6))
        parts = [point_forward(ROBOT.chain, params, angles(q), at) for at in POINTS[:several]]
        xyz = np.stack(parts, axis=1).reshape(-1, 3)
        names = np.tile([f"t{k}" for k in range(several)], count)
        return table_of(np.repeat(q, several, axis=0), xyz + rng.normal(0.0, noise, xyz.shape), names)

    return rows(n, 0.0, WIDE, NOISE), rows(200, 0.0, WIDE, 0.0), rows(200, WIDE, WIDE + BEYOND, 0.0)


def rig_of(several):
    from dataclasses import replace

    from truearm.types import Point

    return replace(RIG, targets={f"t{k}": Point(f"t{k}", tuple(POINTS[k]), None) for k in range(several)})


def fitted(table, rig, mode):
    none = np.zeros(len(table), dtype=bool)
    return identified(ROBOT, Observed(rig, table), none, IdentifyOptions(joint_laws=mode))


def judged(found, rig, table):
    """Return errors (n, 3) [m] of predicted points and their covariances (n, 3, 3), in the tracker's axes."""
    problem = build_problem(found.chain, rig, table)
    lin = problem.groups[0].evaluate(found.chain, found.estimate.value)
    jac = lin.jac_params.reshape(len(table), 3, -1)
    return lin.residual.reshape(-1, 3), jac @ found.estimate.covariance @ jac.swapaxes(1, 2)


def coverage(error, cov):
    sigma = np.sqrt(np.diagonal(cov, axis1=1, axis2=2))
    nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(cov), error)
    return float(np.mean(np.abs(error) < 2.0 * sigma)), float(nees.mean() / 3.0)


def covered_worlds(seeds, n, several):
    rig, out = rig_of(several), []
    for seed in seeds:
        table, inside, outside = world(seed, n, True, several)
        found = fitted(table, rig, "auto")
        out.append([*coverage(*judged(found, rig, inside)), *coverage(*judged(found, rig, outside))])
    return np.array(out)


def null_ratios(seeds, n, mode):
    """Return the RMS error of predicted points with laws, divided by that of geometry alone, in worlds without laws."""
    rig, out = rig_of(1), []
    for seed in seeds:
        table, inside, _ = world(seed, n, False)
        errors = [
            np.sqrt((judged(fitted(table, rig, mode), rig, inside)[0] ** 2).sum(axis=1).mean())
            for mode in (mode, "none")
        ]
        out.append(errors[0] / errors[1])
    return np.array(out)


def rms_error(found, table):
    return np.sqrt((judged(found, rig_of(1), table)[0] ** 2).sum(axis=1).mean())


def corner_world(seed):
    """Return rows in a corner of the joint space, and rows without noise there and everywhere."""
    rng = np.random.default_rng(seed)
    params, angles = truth_of(rng, True)
    corner = MIDDLE + rng.uniform(-0.8, 0.8, 6)

    def rows(n, middle, wide, noise):
        q = middle + rng.uniform(-wide, wide, (n, 6))
        at = point_forward(ROBOT.chain, params, angles(q), POINTS[0])
        return table_of(q, at + rng.normal(0.0, noise, at.shape), np.full(n, "t0"))

    return rows(30, corner, 0.3, NOISE), rows(100, corner, 0.3, 0.0), rows(100, MIDDLE, WIDE, 0.0)


def test_few_poses_in_a_corner_make_no_other_pose_worse_than_the_geometry():
    """Two curves of joint 2 and the sag of joints 2 and 3 pass for one curve there, which errs elsewhere."""
    table, here, elsewhere = corner_world(29)
    geometry, laws = (fitted(table, rig_of(1), mode) for mode in ("none", "auto"))
    assert rms_error(laws, here) < 0.5 * rms_error(geometry, here)
    assert rms_error(laws, elsewhere) < 1.03 * rms_error(geometry, elsewhere)
    error, cov = judged(laws, rig_of(1), elsewhere)
    assert coverage(error, cov)[0] > 0.8


def test_what_the_rows_do_not_determine_stays_nearer_the_geometry(monkeypatch):
    table, _, elsewhere = corner_world(34)
    near = rms_error(fitted(table, rig_of(1), "auto"), elsewhere)
    monkeypatch.setattr(joint_laws, "nearer_geometry", lambda of, anywhere, found, misfit: found)
    assert near < 0.8 * rms_error(fitted(table, rig_of(1), "auto"), elsewhere)


def test_many_poses_determine_laws_that_the_geometry_does_not_move(monkeypatch):
    moved = []

    def noted(of, anywhere, found, misfit):
        result = law_fit.nearer_geometry(of, anywhere, found, misfit)
        apart = (
            build_problem(of.problem.chain, rig_of(1), inside).groups[0].evaluate(of.problem.chain, x).residual
            for x in (found.x, result.x)
        )
        moved.append(np.abs(np.subtract(*apart)).max())
        return result

    monkeypatch.setattr(joint_laws, "nearer_geometry", noted)
    table, inside, _ = world(3, 200, True)
    fitted(table, rig_of(1), "sag")
    assert 0.0 < moved[-1] < 0.2 * NOISE


@pytest.mark.soak
@pytest.mark.parametrize(("several", "low", "high"), [(1, 0.90, 0.98), (3, 0.92, 0.99)])
def test_predicted_points_are_covered(several, low, high):
    """k = 2 of 0.954 due; variances that are held at their optimum cost some of it, and what is shared by three points of a pose widens the band.

    The mean over the worlds has a standard error of its own, of which two are added to the upper limit.
    """
    found = covered_worlds(range(WORLDS), 400, several)
    inside, nees, outside, _ = found.mean(axis=0)
    high_inside, _, high_outside, _ = high + 2.0 * found.std(axis=0, ddof=1) / np.sqrt(WORLDS)
    assert low <= inside <= high_inside
    assert low <= outside <= high_outside
    assert found[:, [0, 2]].min() >= 0.75
    assert nees <= 1.5


@pytest.mark.soak
@pytest.mark.parametrize("mode", ["auto", "curve"])
@pytest.mark.parametrize(("n", "mean", "worst"), [(400, 1.01, 1.10), (25, 1.05, np.inf)])
def test_arms_without_laws_are_left_alone(n, mean, worst, mode):
    """``auto`` does not try laws where the declared noise explains the residuals; ``curve`` always does."""
    ratios = null_ratios(range(WORLDS), n, mode)
    assert ratios.mean() <= mean
    assert ratios.max() <= worst
