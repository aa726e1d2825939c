"""The paper's bench for tests: a PUMA 560, three chucks, three spheres, poses, and tables of ball-bar lengths.

Poses come from the design values by inverse kinematics (damped Newton), lengths from the optimised ones, the "truth".
"""

import itertools

import numpy as np

from truearm.kinds.table import ObservationTable
from truearm.model.chain import forward, joint_jacobian, point_forward, point_jacobians
from truearm.model.robot_file import builtin_robot
from truearm.model.transforms import rotation
from truearm.types import BallBar, Point, Rig

ROBOT = builtin_robot("puma560")
CHAIN = ROBOT.chain
DESIGN = ROBOT.parameter_sets["design"]
TRUTH = ROBOT.parameter_sets["optimised"]
FREE = ROBOT.free  # the paper's 36
SIGMA = 0.084e-3  # m, the paper's repeatability
LOWER = np.array([j.lower for j in CHAIN.joints])
UPPER = np.array([j.upper for j in CHAIN.joints])


def triangle(centre, radius, height):
    """Return three named corners of an equilateral triangle in a horizontal plane."""
    turns = 2.0 * np.pi * np.arange(3) / 3.0
    return [(centre[0] + radius * np.cos(a), centre[1] + radius * np.sin(a), height) for a in turns]


def points(prefix, coordinates, sigma=0.0):
    return {f"{prefix}{i}": Point(f"{prefix}{i}", tuple(map(float, xyz)), sigma) for i, xyz in enumerate(coordinates)}


CHUCKS = points("c", triangle((0.45, 0.0), 0.10, 0.25))
SPHERES = points("s", triangle((0.0, 0.0), 0.06, 0.05))
STROKE = 4.0  # m: the poses are random, and so are their lengths
BARS = {"short": BallBar("short", 2.05, 1.0, STROKE, SIGMA), "long": BallBar("long", 2.2, 1.0, STROKE, SIGMA)}
RIG = Rig(CHUCKS, SPHERES, BARS)
PAIRS = tuple(itertools.product(CHUCKS, SPHERES))


def random_poses(n, rng):
    """Return joint readings (n, 6) anywhere within the limits, with arbitrary bar lengths."""
    return rng.uniform(LOWER, UPPER, (n, 6))


def constant_orientation_poses(n, rng, tilt=(0.0, 0.0, 0.0), shell=None):
    """Return poses (n, 6) with one tool orientation, rotated by the rotation vector ``tilt``.

    The end is anywhere in a box above the chucks, or (``shell``: chuck, sphere) a sphere is 46 cm from a chuck.
    """
    rot = rotation(np.array(tilt)) @ forward(CHAIN, DESIGN, np.radians([10.0, -60.0, 100.0, 20.0, 60.0, 30.0]))[:3, :3]
    q = np.tile(np.radians([10.0, -60.0, 100.0, 20.0, 60.0, 30.0]), (4 * n, 1))
    p_base_goal = rng.uniform([0.3, -0.3, 0.5], [0.6, 0.3, 0.9], (4 * n, 3))
    if shell is not None:
        p_base_goal = np.array(shell[0].xyz) + 0.46 * hemisphere(4 * n, rng) - rot @ np.array(shell[1].xyz)
    for _ in range(25):
        pose = forward(CHAIN, DESIGN, q)
        spin = 0.5 * np.cross(pose[:, :3, :3], rot[None], axis=1).sum(axis=2)
        error = np.concatenate([p_base_goal - pose[:, :3, 3], spin], axis=1)
        q = q + damped(joint_jacobian(CHAIN, DESIGN, q), error)
    pose = forward(CHAIN, DESIGN, q)
    good = np.linalg.norm(pose[:, :3, 3] - p_base_goal, axis=1) < 1e-9
    good &= np.abs(pose[:, :3, :3] - rot).max(axis=(1, 2)) < 1e-12
    assert good.sum() >= n
    return q[good][:n]


def vertical_tool_poses(n, rng):
    """Return poses (n, 6) of the design arm with one tool orientation, pointing down, joint 4 at zero."""
    q = np.zeros((n, 6))
    q[:, :3] = rng.uniform([-1.0, -1.5, 0.5], [1.0, 0.0, 2.0], (n, 3))
    q[:, 4] = np.pi - q[:, 1] - q[:, 2]
    q[:, 5] = q[:, 0] + 0.3
    assert np.ptp(forward(CHAIN, DESIGN, q)[:, :3, :3], axis=0).max() < 1e-14
    return q


def shell_poses(chuck, sphere, radius, n, rng):
    """Return poses (n, 6) on a hemispherical shell about a chuck, within joint limits, with random tool orientation."""
    kept = np.zeros((0, 6))
    while len(kept) < n:
        p_base_goal = np.array(chuck.xyz) + radius * hemisphere(4 * n, rng)
        q = random_poses(4 * n, rng)
        for _ in range(25):
            p_base, _, jac = point_jacobians(CHAIN, DESIGN, q, np.array(sphere.xyz))
            q = np.clip(q + damped(jac, p_base_goal - p_base), LOWER, UPPER)
        p_base = point_forward(CHAIN, DESIGN, q, np.array(sphere.xyz))
        kept = np.concatenate([kept, q[np.linalg.norm(p_base - p_base_goal, axis=1) < 1e-4]])
    return kept[:n]


def hemisphere(n, rng):
    u = rng.normal(size=(n, 3))
    u[:, 2] = np.abs(u[:, 2])
    return u / np.linalg.norm(u, axis=1, keepdims=True)


def damped(jac, error):
    """Return Jᵀ(JJᵀ + 1e-4)⁻¹e, at most 0.5 rad per joint."""
    square = jac @ jac.swapaxes(1, 2) + 1e-4 * np.eye(jac.shape[1])
    step = (jac.swapaxes(1, 2) @ np.linalg.solve(square, error[..., None]))[..., 0]
    return np.clip(step, -0.5, 0.5)


def lengths(params, q, pairs, chucks=CHUCKS, spheres=SPHERES):
    """Return distances (n,) sphere–chuck; ``pairs`` names (chuck, sphere) of each pose."""
    p_end_sphere = np.array([spheres[s].xyz for _, s in pairs])
    p_base_chuck = np.array([chucks[c].xyz for c, _ in pairs])
    return np.linalg.norm(point_forward(CHAIN, params, q, p_end_sphere) - p_base_chuck, axis=1)


def table(q, length, pairs, bar="short"):
    chuck, sphere = zip(*pairs, strict=True)
    source = [f"row {i + 1}" for i in range(len(q))]
    return ObservationTable(q=q, kind="ball_bar", value=length, bar=bar, chuck=chuck, sphere=sphere, source=source)


def all_pairs(n):
    """Return (chuck, sphere) for n poses, the nine pairings in turn."""
    return [PAIRS[i % 9] for i in range(n)]


def random_table(n, rng, sigma=0.0, truth=TRUTH):
    """Return n lengths of the true robot at random poses over all pairings, with noise."""
    q, pairs = random_poses(n, rng), all_pairs(n)
    return table(q, lengths(truth, q, pairs) + sigma * rng.normal(size=n), pairs)


def shell_table(n, radius, rng, sigma=0.0, bar="short"):
    """Return n lengths of the true robot on shells about all chucks, with noise."""
    counts = [len(range(i, n, 9)) for i in range(9)]
    parts = [shell_poses(CHUCKS[c], SPHERES[s], radius, k, rng) for (c, s), k in zip(PAIRS, counts, strict=True)]
    pairs = [pair for pair, k in zip(PAIRS, counts, strict=True) for _ in range(k)]
    q = np.concatenate(parts)
    return table(q, lengths(TRUTH, q, pairs) + sigma * rng.normal(size=n), pairs, bar)
