"""Lines, trackers and flats about the PUMA for tests: rows that a true robot and true devices would have given."""

import numpy as np
from puma_bench import CHAIN, TRUTH, random_poses

from truearm.model.chain import forward, point_forward, point_jacobians
from truearm.observe.rotation import rotation, rotation_vector
from truearm.types import ObservationTable, Point

TARGETS = {"ball": Point("ball", (0.02, -0.03, 0.12)), "other": Point("other", (-0.05, 0.04, 0.08))}


def rows(kind, q, **columns):
    """A table of one kind; what is not given is empty. Identifiers may be one word for all rows."""
    n = len(q)
    text = {name: np.full(n, "") for name in ("bar", "chuck", "sphere", "socket", "place", "shell")}
    nan = {name: np.full(n, np.nan) for name in ("value", "sigma")}
    given = {k: np.full(n, v) if isinstance(v, str) else v for k, v in columns.items()}
    source = np.array([f"{kind} {i + 1}" for i in range(n)])
    return ObservationTable(**{"q": q, "kind": np.full(n, kind), "source": source, **text, **nan, **given})


def join(*tables):
    names = ObservationTable.__dataclass_fields__
    return ObservationTable(**{name: np.concatenate([getattr(t, name) for t in tables]) for name in names})


def in_device(p_base, xyz, vector):
    """(n, 3) points of the base in the axes of a device at xyz, turned by a rotation vector."""
    return (p_base - np.asarray(xyz)) @ rotation(np.asarray(vector))


def target(q, name="ball", params=TRUTH):
    """(n, 3) where the robot has a target."""
    return point_forward(CHAIN, params, q, np.array(TARGETS[name].xyz))


def random_pose(rng):
    """A device's position within reach and its rotation vector, any orientation."""
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    turn *= np.sign(np.linalg.det(turn))
    return rng.uniform([0.2, -0.4, 0.3], [0.6, 0.4, 0.8]), rotation_vector(turn)


def line_joints(points, rng, params=TRUTH, name="ball"):
    """(n, 6) joint readings that bring the target of the true robot to points (n, 3), each its own tool orientation."""
    out = np.zeros((0, 6))
    for point in points:
        q = random_poses(30, rng)
        for _ in range(60):
            p, _, jac = point_jacobians(CHAIN, params, q, np.array(TARGETS[name].xyz))
            square = jac @ jac.swapaxes(1, 2) + 1e-6 * np.eye(3)
            step = (jac.swapaxes(1, 2) @ np.linalg.solve(square, (point - p)[..., None]))[..., 0]
            q = q + np.clip(step, -0.3, 0.3)
        good = np.linalg.norm(point_forward(CHAIN, params, q, np.array(TARGETS[name].xyz)) - point, axis=1) < 1e-12
        out = np.concatenate([out, q[good][:1]])
    return out


def line_rows(name, n, rng, transverse=5e-3, params=TRUTH):
    """n points of one line, 0.5 m long, anywhere within reach; transverse readings up to ±``transverse``."""
    while True:
        xyz, vector = random_pose(rng)
        measured = rng.uniform(-transverse, transverse, (n, 3))
        measured[:, 1] = np.linspace(-0.25, 0.25, n)
        q = line_joints(xyz + measured @ rotation(vector).T, rng, params)
        if len(q) == n:
            return rows("line", q, xyz=measured, line=name, target="ball")


def orientation(q, params=TRUTH):
    return forward(CHAIN, params, q)[:, :3, :3]
