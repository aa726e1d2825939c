"""Lines, trackers, flats, seats and bars in fits: what is recovered, what is seen, and whether the σ are true.

NEES is the normalised squared error eᵀC⁻¹e over all that is seen: chi-squared with the dimension as mean and twice it as
variance, so the mean of N runs has the standard error sqrt(2·dimension/N).
"""

from dataclasses import replace

import numpy as np
import pytest
from device_bench import TARGETS, join, joints_at, line_rows, named, random_pose, rows, touches, tracked, values
from puma_bench import CHAIN, CHUCKS, FREE, RIG, SPHERES, TRUTH, random_table
from tests.refusals import refused

from truearm.errors import ProblemError
from truearm.estimate.fit import fit
from truearm.estimate.identify import identify
from truearm.estimate.information import seen, spectrum, weighed
from truearm.estimate.problem import build_problem
from truearm.estimate.residual_noise import checked_joint_cov
from truearm.estimate.whitened_rows import whitened_blocks
from truearm.model.chain import point_forward
from truearm.model.transforms import rotation, rotation_vector
from truearm.types import Device, Plane, Point, Rig

# Renders (1991), III-C; the sixth-but-one of S_q is missing in print, its neighbours' order is taken.
S_X = np.array([3.84, 10.0, 3.84]) * 1e-9
S_Q = np.array([21.0, 21.0, 21.0, 1.31, 21.0, 305.0]) * 1e-9
FLAT = Plane("table", (0.45, 0.0, 0.2), (0.0, 0.05, 1.0), 2e-5)


def matrix(diagonal):
    return tuple(tuple(row) for row in np.diag(diagonal).tolist())


def solve(problem, x):
    """Return lm's estimate x (P,) with the robot's paper set and all of the rig free, and the indices of these columns."""
    columns = np.concatenate([FREE, np.ones(len(problem.names) - FREE.size, bool)])
    found = fit(problem, columns, x)
    assert found.status == "converged"
    return found.information, found.x, columns


@pytest.fixture(scope="module")
def clean_lines():
    rng = np.random.default_rng(0)
    return [line_rows(f"l{i}", 12, rng) for i in range(8)]


def everything(rng, n_lines=3):
    """Return rows of all kinds without noise, with everything in the rig unknown that can be, and the truth by name."""
    bars = random_table(60, rng)
    lines = [line_rows(f"l{i}", 10, rng) for i in range(n_lines)]
    pose, other = (np.concatenate(random_pose(rng)) for _ in range(2))
    points = tracked("position", 20, pose, rng, q_rate=0.3 * rng.normal(size=(20, 6)))
    points = replace(points, q=points.q - 2e-3 * points.q_rate)
    frames = replace(tracked("pose", 10, other, rng), tracker=np.full(10, "u"))
    flat = touches(FLAT, 10, rng, offset=3e-3, tilt=(0.01, -0.02))
    seat = np.array([0.4, 0.2, 0.4])
    balls = rows("seat", joints_at(np.tile(seat, (15, 1)), rng), sphere="s9", place="p", socket="0")
    balls = balls.select(np.isfinite(balls.q).all(axis=1))
    truth = {"time_offset": 2e-3, **named("tracker.t", pose), **named("socket.p.0", seat)}
    truth |= named("plane.table", (3e-3, 0.01, -0.02), ("offset", "tilt1", "tilt2"))
    for i, (_, line) in enumerate(lines):
        truth |= named(f"line.l{i}", line)
    truth |= {f"chuck.c2.{k}": v for k, v in zip("xyz", CHUCKS["c2"].xyz, strict=True)}
    truth |= {f"target.ball.{k}": v for k, v in zip("xyz", TARGETS["ball"].xyz, strict=True)}
    truth |= {f"bar.short.{k}": v for k, v in (("zero", RIG.bars["short"].zero), ("gain", 1.0))}
    # A tracker with a declared pose: its turn is counted from there.
    truth |= named("tracker.u", [*other[:3], 0.0, 0.0, 0.0])
    declared = Device("u", matrix(S_X), tuple(other[:3] + 0.01), tuple(other[3:]), 0.1, 0.1, rotation_sigma=1e-4)
    rig = replace(
        RIG,
        chucks={**CHUCKS, "c2": Point("c2", CHUCKS["c2"].xyz, 1e-3)},
        spheres={**SPHERES, "s9": Point("s9", TARGETS["ball"].xyz)},
        bars={"short": replace(RIG.bars["short"], zero_sigma=1e-3, gain_sigma=1e-2)},
        targets={"ball": Point("ball", TARGETS["ball"].xyz, 1e-3)},
        trackers={"t": Device("t", matrix(S_X)), "u": declared},
        planes={"table": FLAT},
        time_offset_sigma=None,
    )
    return rig, join(bars, *(t for t, _ in lines), points, frames, flat, balls), truth


def test_all_kinds_at_once_find_all_parameters():
    rig, t, truth = everything(np.random.default_rng(2))
    # The other priors' means are true here; this one's would hold the result a little off.
    rig = replace(rig, trackers={**rig.trackers, "u": replace(rig.trackers["u"], sigma=None, turn_sigma=None)})
    problem = build_problem(CHAIN, rig, t)
    expected = values(problem, truth)
    information, x, _ = solve(problem, problem.start)
    assert seen(spectrum(information.root)).all()
    np.testing.assert_allclose(x, expected, atol=1e-10)


def noisy(t, rig, rng, sensors=True):
    """Return rows with the noise that the rig declares."""
    cov = checked_joint_cov(rig.joint_cov, 6)
    joints = np.zeros((6, 6)) if cov is None else np.linalg.cholesky(cov)
    scale = np.array([0.0 if k in ("seat", "plane", "ball_bar") else 1.0 for k in t.kind])[:, None]
    sigma = {"ball_bar": RIG.bars["short"].sigma, "plane": FLAT.sigma}
    value = t.value + np.array([sigma.get(str(k), 0.0) for k in t.kind]) * rng.normal(size=len(t))
    return replace(
        t,
        q=t.q + rng.normal(size=t.q.shape) @ joints.T,
        xyz=t.xyz + scale * np.sqrt(S_X) * rng.normal(size=t.xyz.shape),
        value=value,
        rotation=rotation_vector(rotation(1e-4 * rng.normal(size=t.rotation.shape)) @ rotation(t.rotation)),
    )


def nees(rig, declared, t, truth, seeds):
    """Return the mean NEES with its standard error, the dimension, and the mean reduced χ², for a declared noise that may be wrong."""
    found, chi2 = [], []
    for seed in seeds:
        problem = build_problem(CHAIN, declared, noisy(t, rig, np.random.default_rng(seed)))
        expected = values(problem, truth)
        # Priors of the rig are of the same kind as data: their error is drawn with the rest.
        information, x, columns = solve(problem, expected)
        root = information.root
        found.append(float(np.sum((root @ (x - expected)[columns]) ** 2)))
        rank = int(seen(spectrum(root)).sum())
        chi2.append(information.chi2 / (information.n_residuals - rank))
    return float(np.mean(found)), float(np.sqrt(2.0 * rank / len(found))), rank, float(np.mean(chi2))


@pytest.fixture(scope="module")
def tracker_bench():
    """A known tracker with Renders' S_x on an arm with his S_q, and 99 true poses of three targets."""
    rng = np.random.default_rng(3)
    pose = np.concatenate(random_pose(rng))
    device = Device("t", matrix(S_X), tuple(pose[:3]), tuple(pose[3:]), 0.0, 0.0)
    rig = Rig(targets=TARGETS, trackers={"t": device}, joint_cov=matrix(S_Q))
    return rig, join(*(tracked("position", 33, pose, rng, name) for name in TARGETS))


def test_errors_in_variables_claim_what_they_err(tracker_bench):
    rig, t = tracker_bench
    mean, error, rank, chi2 = nees(rig, rig, t, {}, range(100))
    assert rank == 36
    assert abs(mean - 36) < 3 * error
    assert abs(chi2 - 1.0) < 3 * np.sqrt(2 / (261 * 100))


def test_ignoring_the_joints_noise_is_found_out_by_the_same_test(tracker_bench):
    rig, t = tracker_bench
    mean, error, _, chi2 = nees(rig, replace(rig, joint_cov=()), t, {}, range(30))
    assert mean - 36 > 10 * error
    assert chi2 - 1.0 > 10 * np.sqrt(2 / (261 * 30))


def test_a_fused_fit_claims_what_it_errs():
    """Bars, lines, touches and seats, joints' noise through all of them: one covariance for a robot and four rigs."""
    rng = np.random.default_rng(4)
    rig, t, truth = everything(rng)
    t = t.select(np.isin(t.kind, ("ball_bar", "line", "plane", "seat")))
    quiet = {"bars": RIG.bars, "chucks": CHUCKS, "targets": TARGETS, "time_offset_sigma": 0.0}
    rig = replace(rig, **quiet, joint_cov=matrix(S_Q / 4), seat_sigma=1e-7)
    mean, error, rank, chi2 = nees(rig, rig, t, truth, range(25))
    assert rank == 36 + 3 * 6 + 3 + 3  # robot, lines, flat, socket
    assert abs(mean - rank) < 3 * error
    assert abs(chi2 - 1.0) < 3 * np.sqrt(2 / (25 * (60 + 90 + 10 + 3 * 13 - rank)))


def believed(rig, truth, rng):
    """The rig with all priors' means drawn about the truth, and the truth as the drawn rig counts it."""
    off = rng.normal(size=6) * [1e-3, 1e-3, 1e-3, 0.1, 0.1, 0.1]
    u = rig.trackers["u"]
    at = np.array([truth[f"tracker.u.{k}"] for k in "xyz"])
    turned = rotation_vector(rotation(-off[3:]) @ rotation(np.array(u.rotation)))
    bar = rig.bars["short"]
    drawn = replace(
        rig,
        trackers={**rig.trackers, "u": replace(u, xyz=tuple(at + off[:3]), rotation=tuple(turned), sigma=1e-3)},
        chucks={**rig.chucks, "c2": point_near(rig.chucks["c2"], rng)},
        targets={"ball": point_near(rig.targets["ball"], rng)},
        bars={"short": replace(bar, zero=bar.zero + bar.zero_sigma * rng.normal(), zero_sigma=bar.zero_sigma)},
    )
    return drawn, {**truth, **named("tracker.u", [*at, *off[3:]])}


def point_near(point, rng):
    return replace(point, xyz=tuple(point.xyz + point.sigma * rng.normal(size=3)))


@pytest.mark.soak
def test_all_kinds_with_drawn_priors_claim_what_they_err():
    """Every kind of observation and of prior at once; a tracker whose declared orientation is 0.1 rad off."""
    rng = np.random.default_rng(9)
    rig, t, truth = everything(rng)
    bar = replace(rig.bars["short"], gain_sigma=0.0)
    # The third chuck alone holds the whole scene against turning about the other two; were it known to 1 mm only, the
    # turn's second order (1e-5 m) would be of the size of what is measured, and NEES, a linear figure, would grow.
    chucks = {**rig.chucks, "c2": replace(rig.chucks["c2"], sigma=2e-5)}
    rig = replace(rig, chucks=chucks, bars={"short": bar}, joint_cov=matrix(S_Q / 100), seat_sigma=1e-8)
    found = []
    for seed in range(100):
        rng = np.random.default_rng(seed)
        drawn, true = believed(rig, truth, rng)
        # What was read does not depend on what is believed of the bar: its length is counted by the declared zero.
        measured = noisy(t, rig, rng)
        shift = np.where(t.kind == "ball_bar", drawn.bars["short"].zero - bar.zero, 0.0)
        problem = build_problem(CHAIN, drawn, replace(measured, value=measured.value + shift))
        expected = values(problem, true)
        information, x, columns = solve(problem, expected)
        found.append(float(np.sum((information.root @ (x - expected)[columns]) ** 2)))
    rank = int(seen(spectrum(information.root)).sum())
    assert rank == columns.sum()
    assert abs(np.mean(found) - rank) < 3 * np.sqrt(2.0 * rank / len(found))


def distances(problem, x):
    """Return the norm (n_rows,) of each row's whitened residual."""
    out = np.full(problem.n_rows, np.nan)
    for block in whitened_blocks(problem, x, np.zeros(x.size, bool)):
        out[block.row] = np.linalg.norm(block.residual, axis=1)
    return out


def test_whitened_residuals_are_in_their_own_sigma():
    rig, t, truth = everything(np.random.default_rng(7))
    problem = build_problem(CHAIN, rig, replace(t, value=t.value + 1e-4, xyz=t.xyz + 1e-4 * np.eye(3)[0]))
    d = distances(problem, values(problem, truth))
    kinds = {k: d[t.kind == k] for k in ("ball_bar", "line", "position", "pose", "plane", "seat")}
    np.testing.assert_allclose(kinds["ball_bar"], 1e-4 / RIG.bars["short"].sigma, rtol=1e-6)
    np.testing.assert_allclose(kinds["plane"], 1e-4 / FLAT.sigma, rtol=1e-6)
    np.testing.assert_allclose(kinds["line"], 1e-4 / rig.line_sigma[0], rtol=1e-6)
    for kind in ("position", "pose"):
        np.testing.assert_allclose(kinds[kind], 1e-4 / np.sqrt(S_X[0]), rtol=1e-6)
    np.testing.assert_allclose(kinds["seat"], 0.0, atol=1e-6)
    half = weighed(replace(problem, joint_cov=np.diag(S_Q)), problem.start)
    assert (distances(half, values(problem, truth))[t.kind == "line"] < kinds["line"]).all()


def test_two_rigs_of_one_robot_share_the_robot():
    """Two days with the same names for other chucks: two sets of unknowns, one robot."""
    rng = np.random.default_rng(8)
    shifted = {k: Point(k, tuple(np.add(p.xyz, (0.05, -0.1, 0.02)))) for k, p in CHUCKS.items()}
    monday, friday = random_table(50, rng), random_table(50, rng)
    p_end = np.array([SPHERES[s].xyz for s in friday.sphere])
    p_chuck = np.array([shifted[c].xyz for c in friday.chuck])
    friday = replace(friday, value=np.linalg.norm(point_forward(CHAIN, TRUTH, friday.q, p_end) - p_chuck, axis=1))
    line, pose = line_rows("l", 10, rng)
    rigs = {
        "monday": replace(RIG, chucks={**CHUCKS, "c0": Point("c0", CHUCKS["c0"].xyz, None)}, targets=TARGETS),
        "friday": replace(RIG, chucks={**shifted, "c0": Point("c0", CHUCKS["c0"].xyz, None)}),
    }
    t = join(
        replace(monday, rig=np.full(50, "monday")),
        replace(friday, rig=np.full(50, "friday")),
        replace(line, rig=np.full(10, "monday")),
    )
    e = identify(CHAIN, rigs, t, free=FREE)
    assert e.parameter_names[54:] == (
        *(f"monday.chuck.c0.{k}" for k in "xyz"),
        *(f"monday.line.l.{k}" for k in ("x", "y", "z", "rx", "ry", "rz")),
        *(f"friday.chuck.c0.{k}" for k in "xyz"),
    )
    expected = np.concatenate([TRUTH, CHUCKS["c0"].xyz, pose, shifted["c0"].xyz])
    np.testing.assert_allclose(e.value[~e.free | e.identifiable], expected[~e.free | e.identifiable], atol=1e-10)
    assert e.identifiable[e.free].all()
    with refused("unsolvable", "row 1: ", "'monday'"):
        identify(CHAIN, RIG, t, free=FREE)
    with refused("unsolvable", "row 1: ", "'friday'", " monday"):
        identify(CHAIN, {"monday": rigs["monday"]}, t, free=FREE)
    with pytest.raises(ProblemError, match="joint_cov"):
        identify(CHAIN, {**rigs, "friday": replace(rigs["friday"], joint_cov=matrix(S_Q))}, t, free=FREE)


def test_a_held_out_line_is_placed_with_the_robot_fixed(clean_lines):
    t = join(*(t for t, _ in clean_lines))
    e = identify(CHAIN, Rig(targets=TARGETS), t, free=FREE, hold_out=t.line == "l7")
    assert not any(name.startswith("line.l7") for name in e.parameter_names)
    assert e.held_out.n == 12
    assert e.held_out_before.figures["m"].mean > 1e-3
    assert e.held_out.figures["m"].max < 1e-9
