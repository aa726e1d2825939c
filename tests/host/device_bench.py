"""Lines, trackers and flats around the PUMA for tests: rows that a true robot and true devices would have produced."""

import numpy as np
from puma_bench import CHAIN, TRUTH, random_poses

from truearm.kinds.plane import frame_of
from truearm.kinds.table import ObservationTable
from truearm.model.chain import forward, point_forward, point_jacobians
from truearm.model.transforms import rotation, rotation_vector
from truearm.types import Point

TARGETS = {
    "ball": Point("ball", (0.02, -0.03, 0.12)),
    "other": Point("other", (-0.05, 0.04, 0.08)),
    "third": Point("third", (0.06, 0.05, 0.10)),
}


def rows(kind, q, **columns):
    """Return a table of one kind."""
    return ObservationTable(columns, q=q, kind=kind, source=[f"{kind} {i + 1}" for i in range(len(q))])


def join(*tables):
    return ObservationTable.joined(tables)


def in_device(p_base, xyz, vector):
    """Return points (n, 3) of the base in the axes of a device at xyz, rotated by a rotation vector."""
    return (p_base - np.asarray(xyz)) @ rotation(np.asarray(vector))


def target(q, name="ball", params=TRUTH):
    """Return the position of the robot's target (n, 3)."""
    return point_forward(CHAIN, params, q, np.array(TARGETS[name].xyz))


def random_pose(rng):
    """Return a device's position within reach and its rotation vector, with any orientation."""
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    turn *= np.sign(np.linalg.det(turn))
    return rng.uniform([0.2, -0.4, 0.3], [0.6, 0.4, 0.8]), rotation_vector(turn)


def joints_at(points, rng, params=TRUTH, name="ball", tries=10):
    """Return joint readings (n, 6) that bring a target of the robot to points (n, 3), each with a different
    orientation.

    NaN where none of the random starts converged.
    """
    p_end = np.array(TARGETS[name].xyz)
    q = random_poses(len(points) * tries, rng)
    goal = np.repeat(points, tries, axis=0)
    for _ in range(40):
        p, _, jac = point_jacobians(CHAIN, params, q, p_end)
        square = jac @ jac.swapaxes(1, 2) + 1e-6 * np.eye(3)
        step = (jac.swapaxes(1, 2) @ np.linalg.solve(square, (goal - p)[..., None]))[..., 0]
        q = q + np.clip(step, -0.3, 0.3)
    good = np.linalg.norm(point_forward(CHAIN, params, q, p_end) - goal, axis=1) < 1e-12
    first = np.argmax(good.reshape(-1, tries), axis=1) + tries * np.arange(len(points))
    return np.where(good[first, None], q[first], np.nan)


def line_rows(name, n, rng, transverse=5e-3):
    """Return n points of one line, 0.5 m long, anywhere within reach, and its pose (6,) x y z rx ry rz.

    Transverse readings are up to ±``transverse``.
    """
    while True:
        xyz, vector = random_pose(rng)
        measured = rng.uniform(-transverse, transverse, (n, 3))
        measured[:, 1] = np.linspace(-0.25, 0.25, n)
        q = joints_at(xyz + measured @ rotation(vector).T, rng)
        if np.isfinite(q).all():
            return rows("line", q, xyz=measured, line=name, target="ball"), np.concatenate([xyz, vector])


def tracked(kind, n, pose, rng, name="ball", **columns):
    """Return n rows of kind position or pose of one target at random joints, by tracker "t" at ``pose``."""
    q = random_poses(n, rng)
    if kind == "pose":
        turned = rotation(np.asarray(pose[3:])).T @ orientation(q)
        columns["rotation"] = rotation_vector(turned)
    return rows(kind, q, xyz=in_device(target(q, name), pose[:3], pose[3:]), tracker="t", target=name, **columns)


def touches(plane, n, rng, offset=0.0, tilt=(0.0, 0.0), ball=5e-3):
    """Return n touches, by a ball, of the declared plane moved by its three parameters."""
    e1, e2, n0 = frame_of(np.array(plane.normal))
    turn = rotation(tilt[0] * e1 + tilt[1] * e2)
    while True:
        across = rng.uniform(-0.2, 0.2, (n, 2)) @ (turn @ np.stack([e1, e2], axis=1)).T
        q = joints_at(np.array(plane.xyz) + (offset + ball) * (turn @ n0) + across, rng)
        if np.isfinite(q).all():
            return rows("plane", q, plane=plane.name, target="ball", value=np.full(n, ball))


def values(problem, truth):
    """Return x (P,) with the true robot and the rig's values by name in ``truth``, which must be complete."""
    return np.concatenate([TRUTH, [truth[name] for name in problem.names[len(TRUTH) :]]])


def named(thing, numbers, parts=("x", "y", "z", "rx", "ry", "rz")):
    return {f"{thing}.{k}": v for k, v in zip(parts, numbers, strict=False)}


def orientation(q, params=TRUTH):
    return forward(CHAIN, params, q)[:, :3, :3]
