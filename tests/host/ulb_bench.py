"""Renders' bench for tests: the ULB robot, straight lines driven by its nominal model, and a line device at each.

The paper states neither the position nor the length of its lines. Here each is 0.4 m long in a random direction within
reach, with one tool orientation. The device is placed along the true points, so that its transverse sensors measure the
millimetres by which the real robot's path deviates from straight.
"""

import numpy as np

from truearm.kinds.table import ObservationTable
from truearm.model.chain import forward, joint_jacobian, point_forward
from truearm.model.robot_file import builtin_robot
from truearm.model.transforms import rotation, rotation_vector
from truearm.types import Device, Rig

CHAIN = builtin_robot("ulb").chain
NOMINAL = CHAIN.params_nominal
AT = {name: i for i, name in enumerate(CHAIN.parameter_names)}
OFFSETS = [AT[f"joint{i}.offset"] for i in (2, 3, 4, 5, 6)]  # III-E: θ1 is fixed
S_X = 1e-9 * np.diag([3.84, 10.0, 3.84])  # m², y along the line
S_Q = 1e-9 * np.diag([21.0, 21.0, 21.0, 1.31, 1.31, 305.0])  # rad²; five of six are printed, the fifth is assumed
SENSOR = tuple(map(tuple, S_X.tolist()))
JOINT = tuple(map(tuple, S_Q.tolist()))
ORIGIN = np.zeros(3)


def rig(table, joint_cov=JOINT, sigma=0.1, turn_sigma=0.1):
    """Return the paper's S_x and S_q, and each line's device at the nominal robot's points, set up level by hand."""
    poses = {}
    for name in dict.fromkeys(table.line.tolist()):
        mine = table.line == name
        xyz, rot = level(point_forward(CHAIN, NOMINAL, table.q[mine], ORIGIN), table.xyz[mine])
        poses[name] = Device(name, SENSOR, tuple(xyz.tolist()), tuple(rotation_vector(rot).tolist()), sigma, turn_sigma)
    return Rig(lines=poses, joint_cov=joint_cov)


def level(p_base, read):
    """Return a device with y from the first point to the last and x horizontal; its mean reading is ``read``."""
    y = p_base[-1] - p_base[0]
    y /= np.linalg.norm(y)
    x = np.cross(y, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    rot = np.column_stack([x, y, np.cross(x, y)])
    return p_base.mean(axis=0) - rot @ read.mean(axis=0), rot


def free(*indices):
    out = np.zeros(len(NOMINAL), dtype=bool)
    out[list(indices)] = True
    return out


def straights(count, n, rng, length=0.4):
    """Return readings (count, n, 6) that move the nominal end along random lines, each with one tool orientation."""
    kept = np.zeros((0, n, 6))
    while len(kept) < count:
        first = rng.uniform([-1.5, -1.5, -2.2, -1.5, 0.5, -1.5], [1.5, -0.2, -0.6, 1.5, 2.0, 1.5], (60, 6))
        T = forward(CHAIN, NOMINAL, first)[:, None]
        along = rng.normal(size=(60, 1, 3))
        along *= length / np.linalg.norm(along, axis=2, keepdims=True)
        goal = T[..., :3, 3] + np.linspace(-0.5, 0.5, n)[:, None] * along
        q = np.repeat(first[:, None], n, axis=1)
        for _ in range(15):
            pose = forward(CHAIN, NOMINAL, q)
            spin = 0.5 * np.cross(pose[..., :3, :3], T[..., :3, :3], axis=-2).sum(axis=-1)
            error = np.concatenate([goal - pose[..., :3, 3], spin], axis=-1)
            jac = joint_jacobian(CHAIN, NOMINAL, q)
            square = jac @ jac.swapaxes(-1, -2) + 1e-7 * np.eye(6)
            step = (jac.swapaxes(-1, -2) @ np.linalg.solve(square, error[..., None]))[..., 0]
            q = q + np.clip(step, -0.3, 0.3)
        reached = np.linalg.norm(forward(CHAIN, NOMINAL, q)[..., :3, 3] - goal, axis=-1).max(axis=1) < 1e-7
        smooth = np.abs(np.diff(q, axis=1)).max(axis=(1, 2)) < 4.0 / n
        kept = np.concatenate([kept, q[reached & smooth]])
    return kept[:count]


def line(name, q, truth, rng, noise=1.0):
    """Return rows of one line: the true robot at q (n, 6), a device along the true points, S_x and S_q times noise²."""
    n = len(q)
    p_base = point_forward(CHAIN, truth, q, ORIGIN)
    xyz, rot = level(p_base, np.zeros((n, 3)))
    rot = rotation(0.02 * rng.normal(size=3)) @ rot  # by eye and spirit level, to a degree
    read = (p_base - xyz) @ rot + noise * rng.multivariate_normal(ORIGIN, S_X, n)
    return rows(name, q + noise * rng.multivariate_normal(np.zeros(6), S_Q, n), read)


def rows(name, q, xyz):
    source = [f"{name} point {i + 1}" for i in range(len(q))]
    return ObservationTable(q=q, kind="line", source=source, xyz=xyz, line=name)


def join(tables):
    return ObservationTable.joined(tables)


def lines(count, n, truth, rng, noise=1.0):
    """Return ``count`` lines of n points, named l0, l1, …."""
    return join([line(f"l{i}", q, truth, rng, noise) for i, q in enumerate(straights(count, n, rng))])
