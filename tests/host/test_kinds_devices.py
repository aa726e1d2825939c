"""Lines, trackers, poses and flats: signs, derivatives with respect to every unknown, initial placement."""

from dataclasses import replace

import numpy as np
import pytest
from device_bench import TARGETS, in_device, join, line_rows, random_pose, rows, target, touches, tracked
from puma_bench import CHAIN, TRUTH, random_poses

from truearm.estimate.problem import blocks, build_problem
from truearm.kinds.group import Layout
from truearm.kinds.kind import Scope, use_points
from truearm.kinds.plane import frame_of
from truearm.kinds.pose import PoseRows
from truearm.kinds.position import place
from truearm.model.transforms import rotation, rotation_vector
from truearm.types import Device, LinePlacement, Plane, Point, Rig

COV = ((1e-8, 1e-9, 0.0), (1e-9, 2e-8, 0.0), (0.0, 0.0, 3e-8))
FLAT = Plane("table", (0.45, 0.0, 0.2), (0.1, 0.2, 1.0), 1e-5)
TRACKER = Device("t", COV, (0.1, 0.2, 0.3), (0.5, -1.0, 2.0), 0.1, 0.1, 1e-4)
# Everything that can be unknown, is.
RIG = Rig(
    targets={"ball": Point("ball", TARGETS["ball"].xyz, None), "other": Point("other", TARGETS["other"].xyz, 1e-3)},
    trackers={"t": TRACKER},
    planes={"table": FLAT},
    time_offset_sigma=None,
)


def every_kind(rng):
    q = random_poses(4, rng)
    free = {"xyz": rng.normal(size=(4, 3)), "q_rate": rng.normal(size=(4, 6))}
    return join(
        rows("line", q, line="l", target="ball", **free),
        rows("position", q, tracker="t", target="other", **free),
        rows("pose", q, tracker="t", target="other", rotation=rng.normal(size=(4, 3)), **free),
        rows("plane", q, plane="table", target="ball"),
    )


def test_derivatives_by_every_unknown():
    rng = np.random.default_rng(0)
    problem = build_problem(CHAIN, RIG, every_kind(rng))
    # 54, two targets, a line and a tracker, the time offset, a plane
    assert len(problem.names) == 54 + 6 + 12 + 1 + 3
    x = problem.start + 0.02 * rng.normal(size=problem.start.size)
    kinds = list(blocks(problem))
    assert [type(b).__name__ for b in kinds] == ["PositionRows", "PositionRows", "PoseRows", "PlaneRows"]
    for block in kinds:
        jac = block.evaluate(problem.chain, x).jac_params
        for i, unit in enumerate(np.eye(x.size)):
            if isinstance(block, PoseRows):  # the logarithm of a rotation takes no complex step
                # Truncation h²/6 times a curvature of some units (a pose far off, at worst 0.1 rad from half a turn),
                # rounding 1e-15/h.
                up, down = (block.evaluate(problem.chain, x + s * 1e-6 * unit).residual for s in (1, -1))
                np.testing.assert_allclose(jac[:, i], (up - down) / -2e-6, atol=5e-9, err_msg=problem.names[i])
            else:
                step = block.evaluate(problem.chain, x + 1e-30j * unit).residual.imag / -1e-30
                np.testing.assert_allclose(jac[:, i], step, atol=1e-14, err_msg=problem.names[i])


def test_derivatives_by_the_joint_readings():
    rng = np.random.default_rng(1)
    problem = build_problem(CHAIN, RIG, every_kind(rng))
    h = 1e-6
    for block in blocks(problem):
        jac = block.evaluate(problem.chain, problem.start).jac_joints
        for i, unit in enumerate(np.eye(6)):
            up, down = (
                replace(block, q=block.q + s * h * unit).evaluate(problem.chain, problem.start).residual
                for s in (1, -1)
            )
            np.testing.assert_allclose(jac[:, i], -(up - down) / (2 * h), atol=5e-9)


def test_residual_is_measured_minus_predicted_in_the_devices_axes():
    rng = np.random.default_rng(4)
    pose = np.concatenate(random_pose(rng))
    error, small = np.array([1e-3, -2e-3, 3e-3]), np.array([1e-3, 2e-3, -1e-3])
    t = tracked("pose", 7, pose, rng)
    flat = touches(FLAT, 5, rng)
    rig = Rig(TARGETS, targets=TARGETS, planes={"table": replace(FLAT, offset_sigma=0.0, tilt_sigma=0.0)})
    known = Device("t", COV, tuple(pose[:3]), tuple(pose[3:]), 0.0, 0.0, 1e-4)
    turned = replace(t, xyz=t.xyz + error, rotation=rotation_vector(rotation(small) @ rotation(t.rotation)))
    both = join(turned, replace(flat, value=flat.value + 1e-3))
    problem = build_problem(CHAIN, replace(rig, trackers={"t": known}), both)
    assert len(problem.names) == 54  # all of the rig is known
    pose_block, plane_block = blocks(problem)
    found = pose_block.evaluate(problem.chain, TRUTH).residual.reshape(7, 6)
    np.testing.assert_allclose(found[:, :3], np.tile(error, (7, 1)), atol=2e-15)
    np.testing.assert_allclose(found[:, 3:], np.tile(small, (7, 1)), atol=4e-15)
    # The touching joints were solved to 1e-12.
    np.testing.assert_allclose(plane_block.evaluate(problem.chain, TRUTH).residual, 1e-3, atol=2e-12)


def test_rows_without_velocities_have_no_time_offset():
    t = tracked("position", 4, np.concatenate(random_pose(np.random.default_rng(7))), np.random.default_rng(7))
    problem = build_problem(CHAIN, replace(RIG, targets=TARGETS), t)
    assert problem.names[54:] == tuple(f"tracker.t.{k}" for k in ("x", "y", "z", "rx", "ry", "rz"))


def test_devices_are_placed_by_a_rotation():
    rng = np.random.default_rng(9)
    xyz, vector = random_pose(rng)
    p = rng.normal(size=(4, 3))
    at, rot = place(in_device(p, xyz, vector), p, np.eye(3))
    np.testing.assert_allclose(at, xyz, atol=2e-14)
    np.testing.assert_allclose(rot, rotation(vector), atol=2e-14)
    p = np.random.default_rng(10).normal(size=(6, 3))
    _, rot = place(p * [1.0, 1.0, -1.0], p, np.eye(3))
    np.testing.assert_allclose(rot @ rot.T, np.eye(3), atol=1e-14)
    assert np.linalg.det(rot) == pytest.approx(1.0, abs=1e-14)
    p_device = np.outer([-0.2, 0.1, 0.3], [0.0, 1.0, 0.0])
    _, rot = place(p_device, -p_device, np.eye(3))
    np.testing.assert_allclose(rot @ [0.0, 1.0, 0.0], [0.0, -1.0, 0.0], atol=1e-15)
    assert np.linalg.det(rot) == pytest.approx(1.0, abs=1e-15)


def set_up_by_hand(rng, sigma=0.05):
    """A line, where the nominal robot has its points, and its device, whose orientation is declared to ``sigma``."""
    t, pose = line_rows("l", 12, rng)
    declared = rotation(sigma * rng.normal(size=3)) @ rotation(pose[3:])
    device = Device("l", COV, None, tuple(rotation_vector(declared).tolist()), 0.1, sigma)
    return t, target(t.q, params=CHAIN.params_nominal), device


def started(t, device, rule):
    """Position, rotation vector from the declared orientation, and the orientation at which a problem starts."""
    start = build_problem(CHAIN, Rig(targets=TARGETS, lines={"l": device}, line_placement=rule), t).start[54:]
    return start[:3], start[3:], rotation(start[3:]) @ rotation(np.array(device.rotation))


@pytest.mark.parametrize("rule", LinePlacement)
def test_a_line_of_known_orientation_keeps_its_roll(rule):
    """Through a robot that errs by millimetres the points seem to say something of the roll; it is not listened to."""
    t, bent, device = set_up_by_hand(np.random.default_rng(12))
    _, turn, _ = started(t, device, rule)
    there = bent[1] - bent[0] if rule == "two_point" else np.linalg.svd(bent - bent.mean(axis=0))[2][0]
    there /= np.linalg.norm(there)
    # No part of the turn is about the line; a least-squares line by the points of both sides is the bent points' own
    # but for what their transverse readings weigh, (5 mm / 250 mm)² of an angle below 0.1 rad.
    assert abs(turn @ there) < (1e-13 if rule == "two_point" else 1e-4)
    assert 1e-3 < np.linalg.norm(turn) < 0.3
    _, unknown, _ = started(t, replace(device, turn_sigma=None), rule)
    assert abs(unknown @ there) > 0.02


def test_axes_of_lines_by_two_points_and_of_flats():
    t, bent, device = set_up_by_hand(np.random.default_rng(12))
    left = {}
    for rule in LinePlacement:
        at, _, rot = started(t, device, rule)
        left[rule] = bent - (at + t.xyz @ rot.T)
    chord = bent[1] - bent[0]
    # What is left there is along the line, their distance being wrong, and alike.
    np.testing.assert_allclose(np.cross(left["two_point"][:2], chord / np.linalg.norm(chord)), 0.0, atol=1e-14)
    np.testing.assert_allclose(left["two_point"][0], -left["two_point"][1], atol=1e-14)
    assert np.sum(left["least_squares"] ** 2) < 0.5 * np.sum(left["two_point"] ** 2)
    other = replace(t, xyz=np.concatenate([t.xyz[:2], t.xyz[:1:-1]]))
    np.testing.assert_array_equal(started(other, device, "two_point")[1], started(t, device, "two_point")[1])
    for normal in ([0, 0, 2], [1, 0, 0], [0, -1, 0], [0.3, -0.2, 0.9]):
        frame = frame_of(np.array(normal, dtype=float))
        np.testing.assert_allclose(frame @ frame.T, np.eye(3), atol=4e-16)
        np.testing.assert_allclose(frame[2] * np.linalg.norm(normal), normal, atol=4e-16)
        assert np.linalg.det(frame) == pytest.approx(1.0, abs=1e-15)


def test_an_item_that_two_columns_name_has_its_numbers_once():
    """As in a kind that compares two targets: the second column has a name of its own."""
    q = random_poses(3, np.random.default_rng(1))
    table = rows("position", q, target="ball", sphere=["other", "ball", "ball"])
    scope, every = Scope(CHAIN, RIG, table, ""), np.arange(3)
    first = use_points(scope, every, "target", RIG.targets)
    second = use_points(scope, every, "sphere", RIG.targets, item="target")
    layout = Layout(0, (first, second))
    assert [number.name for number in layout.unknown] == [
        f"target.{name}.{k}" for name in ("ball", "other") for k in "xyz"
    ]
    np.testing.assert_array_equal(layout.index(second), [[3, 4, 5], [0, 1, 2], [0, 1, 2]])
