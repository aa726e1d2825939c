"""Poses on hemispherical shells about the chucks, by inverse kinematics on the design model.

A shell holds the places of a sphere that a ball-bar at mid-travel allows about a chuck: ``‖T(q)·s − c‖ = zero``. The
measuring places are the crossings of a grid of latitudes and longitudes (Goswami, Quaid, Peshkin 1993, fig. 2), those
that the arm reaches. At each place the tool faces the chuck, but for a tilt drawn up to ``MAX_TILT``, and is turned about
that axis by an angle drawn over the whole turn: with a constant tool orientation relative to the base the measurements
lose rank (28 of 36).

Inverse kinematics is damped least squares, all places at once: Δq = Jᵀ(JJᵀ + λ²I)⁻¹e with e the pose error (m, rad).
It starts from the nearest of many random poses of one configuration branch (``Box``). What leaves the branch or comes near
a singularity, the robot's own column or the table is dropped. So all poses are of one branch, and the arm can go from any
of them to any other without passing a singularity of the elbow or the wrist.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from truearm.errors import PlanError
from truearm.files.plan import Plan
from truearm.model.chain import Chain, forward, joint_jacobian, point_forward
from truearm.types import BallBar, Floats, Point, Rig

# Between the tool's axis and the direction to the chuck. It is what tells the radius of a shell from the robot's size:
# with 35° the fit on 46 cm predicts 61 cm to 0.0901 mm (expected RMS, of 0.084 mm noise), with 55° to 0.0878 mm.
MAX_TILT = np.deg2rad(55.0)
# Below, the bar would touch the table; above, longitudes crowd at the pole.
LOWEST, HIGHEST = np.deg2rad(12.0), np.deg2rad(84.0)
N_SEEDS = 30_000
SURPLUS = 1.1  # poses sought for one visited: the dearest to visit are left out
TRIES = 3  # orientations tried at a place before it counts as out of reach
ITERATIONS = 12
DAMPING = 0.01
LEVER = 0.45  # m, what makes a metre comparable with a radian when singularity is judged
MIN_SINGULAR_VALUE = 0.05
TOLERANCE = 1e-7  # m, and rad
FREE_TRAVEL = 0.012  # m


@dataclass(frozen=True)
class Box:
    """One configuration branch as joint bounds (j,) [rad], and how near the end may come to the base's z axis and to
    the table, z = 0 [m]."""

    lower: Floats
    upper: Floats
    clearance: float = 0.25
    height: float = 0.08


# A PUMA 560 with its elbow above the line from shoulder to wrist, wrist not flipped; 5° or more inside the joint limits,
# 10° or more away from the stretched elbow (q3 = 87°) and the aligned wrist (q5 = 0).
PUMA_ELBOW_UP = Box(
    np.deg2rad([-155.0, -170.0, 100.0, -105.0, 12.0, -180.0]), np.deg2rad([155.0, 35.0, 215.0, 165.0, 95.0, 180.0])
)


def plan_shells(
    chain: Chain,
    params: Floats,
    rig: Rig,
    bar: str,
    n_poses: int = 800,
    seed: int = 0,
    box: Box = PUMA_ELBOW_UP,
    speed: Floats | None = None,
) -> Plan:
    """``n_poses`` poses with one bar, spread evenly over all pairings of a chuck and a sphere, in order of their visits.

    ``params`` (p,) is the model that the robot is programmed with, ``speed`` (j,) [rad/s] weighs the joints where the
    order of visits is chosen. Shells are named ``<bar>-<chuck>``.
    Raises PlanError where the arm does not reach that many places.
    """
    if n_poses < len(rig.chucks) * len(rig.spheres):
        raise PlanError(f"{n_poses} poses are too few for {len(rig.chucks) * len(rig.spheres)} pairings")
    rng = np.random.default_rng(seed)
    seeds = _seeds(chain, params, box, rng)
    pairings = [(chuck, sphere) for chuck in rig.chucks.values() for sphere in rig.spheres.values()]
    counts = np.diff(np.linspace(0, n_poses, len(pairings) + 1).astype(int))
    weights = np.ones(len(chain.joints)) if speed is None else 1.0 / np.asarray(speed)
    here = 0.5 * (box.lower + box.upper)
    parts = []
    for (chuck, sphere), count in zip(pairings, counts, strict=True):
        q = _poses_of_pairing(chain, params, box, seeds, rig.bars[bar], chuck, sphere, int(count * SURPLUS) + 1, rng)
        cost = _move_costs(chain, params, q, weights, rig.bars[bar], chuck, sphere)
        order = short_tour(np.abs((q - here) * weights).max(axis=-1), cost)
        q = q[without_dearest(order, cost, int(count))]
        here = q[-1]
        names = (f"{bar}-{chuck.name}", bar, chuck.name, sphere.name)
        parts.append((q, [np.full(count, name) for name in names]))
    ids = (np.concatenate([part[1][k] for part in parts]) for k in range(4))
    return Plan(np.concatenate([part[0] for part in parts]), *ids)


def grid_directions(n: int) -> Floats:
    """About n unit vectors (m, 3), m ≥ n, from a chuck to the crossings of a latitude/longitude grid.

    Rings of latitude are walked to and fro, so that neighbours in the list are neighbours on the shell.
    """
    n_latitudes = max(3, int(np.ceil(np.sqrt(n / 4.0))))
    n_longitudes = int(np.ceil(n / n_latitudes))
    latitudes = np.linspace(LOWEST, HIGHEST, n_latitudes)
    longitudes = 2.0 * np.pi * np.arange(n_longitudes) / n_longitudes
    rings = [longitudes if i % 2 == 0 else longitudes[::-1] for i in range(n_latitudes)]
    lat, lon = np.repeat(latitudes, n_longitudes), np.concatenate(rings)
    return np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)], axis=-1)


def _poses_of_pairing(
    chain: Chain,
    params: Floats,
    box: Box,
    seeds: tuple[KDTree, Floats],
    bar: BallBar,
    chuck: Point,
    sphere: Point,
    count: int,
    rng: np.random.Generator,
) -> Floats:
    """``count`` joint vectors of one pairing; the grid is made finer until enough of it is in reach."""
    n_places = 3 * count
    for _ in range(5):
        directions = grid_directions(n_places)
        q = np.full((len(directions), len(chain.joints)), np.nan)
        for _ in range(TRIES):
            left = np.flatnonzero(np.isnan(q[:, 0]))
            targets = _tool_poses(directions[left], bar, chuck, sphere, rng)
            q[left] = inverse(chain, params, targets, seeds, box)
        reached = np.flatnonzero(~np.isnan(q[:, 0]))
        if len(reached) >= count:
            evenly = np.linspace(0, len(reached) - 1, count).round().astype(int)
            return np.asarray(q[reached[evenly]])
        n_places *= 2
    raise PlanError(f"the arm reaches too few places of bar {bar.name} about chuck {chuck.name}; move the chucks")


def _tool_poses(directions: Floats, bar: BallBar, chuck: Point, sphere: Point, rng: np.random.Generator) -> Floats:
    """End poses (m, 4, 4) with the sphere on the shell and the tool's z axis towards the chuck, tilted and turned."""
    m = len(directions)
    tilt, azimuth, turn = MAX_TILT * np.sqrt(rng.random(m)), *(2.0 * np.pi * rng.random((2, m)))
    lat, lon = np.arcsin(directions[:, 2]), np.arctan2(directions[:, 1], directions[:, 0])
    facing = Rotation.from_euler("ZY", np.stack([lon, -0.5 * np.pi - lat], axis=-1))  # z axis along −direction
    varied = Rotation.from_euler("ZYZ", np.stack([azimuth, tilt, turn - azimuth], axis=-1))
    poses = np.tile(np.eye(4), (m, 1, 1))
    poses[:, :3, :3] = (facing * varied).as_matrix()
    p_sphere = np.array(chuck.xyz) + bar.zero * directions
    poses[:, :3, 3] = p_sphere - poses[:, :3, :3] @ np.array(sphere.xyz)
    return poses


def _seeds(chain: Chain, params: Floats, box: Box, rng: np.random.Generator) -> tuple[KDTree, Floats]:
    """Random poses of the branch, to be looked up by what they reach."""
    q = rng.uniform(box.lower, box.upper, (N_SEEDS, len(box.lower)))
    return KDTree(_features(forward(chain, params, q))), q


def _features(poses: Floats) -> Floats:
    """Positions in LEVERs and two axes, (…, 9): the distance of two poses as inverse kinematics feels it."""
    return np.concatenate([poses[..., :3, 3] / LEVER, poses[..., :3, 2], 0.5 * poses[..., :3, 0]], axis=-1)


def inverse(chain: Chain, params: Floats, poses: Floats, seeds: tuple[KDTree, Floats], box: Box) -> Floats:
    """Joint vectors (m, j) of end poses (m, 4, 4); NaN where none was found that is good."""
    q = seeds[1][seeds[0].query(_features(poses))[1]]
    for _ in range(ITERATIONS):
        error, jacobian = _pose_error(chain, params, poses, q)
        normal = jacobian @ jacobian.swapaxes(-1, -2) + DAMPING**2 * np.eye(6)
        step = (jacobian.swapaxes(-1, -2) @ np.linalg.solve(normal, error[..., None]))[..., 0]
        q = q + np.clip(step, -0.4, 0.4)
    error, jacobian = _pose_error(chain, params, poses, q)
    good = np.all((q > box.lower) & (q < box.upper), axis=-1) & (np.abs(error).max(axis=-1) < TOLERANCE)
    good &= np.linalg.svd(jacobian, compute_uv=False)[:, -1] > MIN_SINGULAR_VALUE
    good &= (np.hypot(poses[:, 0, 3], poses[:, 1, 3]) > box.clearance) & (poses[:, 2, 3] > box.height)
    return np.where(good[:, None], q, np.nan)


def _pose_error(chain: Chain, params: Floats, poses: Floats, q: Floats) -> tuple[Floats, Floats]:
    """Error (m, 6) and Jacobian (m, 6, j), positions in LEVERs."""
    here = forward(chain, params, q)
    turn = Rotation.from_matrix(poses[:, :3, :3] @ here[:, :3, :3].swapaxes(-1, -2)).as_rotvec()
    scale = np.array([1 / LEVER] * 3 + [1.0] * 3)
    error = np.concatenate([poses[:, :3, 3] - here[:, :3, 3], turn], axis=-1) * scale
    return error, joint_jacobian(chain, params, q) * scale[:, None]


def _move_costs(
    chain: Chain, params: Floats, q: Floats, weights: Floats, bar: BallBar, chuck: Point, sphere: Point
) -> Floats:
    """Cost (m, m) of a move between any two poses: its duration squared, and more where it strains the bar.

    Halfway between two poses of a shell the bar is shorter or longer than on it. The true robot strays by up to 22 mm
    from the design model (at Table II's values), which leaves FREE_TRAVEL of half the travel, 37.5 mm, to the moves.
    """
    duration = np.abs((q[:, None] - q[None]) * weights).max(axis=-1)
    first, second = np.triu_indices(len(q), 1)
    p_halfway = point_forward(chain, params, 0.5 * (q[first] + q[second]), np.array(sphere.xyz))
    strain = np.zeros_like(duration)
    strain[first, second] = np.abs(np.linalg.norm(p_halfway - chuck.xyz, axis=-1) - bar.zero)
    strain += strain.T
    return np.asarray(duration**2 + (np.maximum(strain - FREE_TRAVEL, 0.0) / 0.005) ** 2)


def short_tour(from_start: Floats, cost: Floats) -> NDArray[np.int64]:
    """Order of n points that keeps the sum of ``cost`` (n, n) of the moves small; ``from_start`` (n,) picks the first.

    Going always to the nearest point left ends with long moves back to what was passed over; reversing stretches of the
    tour (2-opt) mends these.
    """
    order = _nearest_first(from_start, cost)
    improved = True
    while improved:
        improved = False
        for i in range(len(order) - 2):
            # Reverse order[i+1 .. k]: the moves i→i+1 and k→k+1 become i→k and i+1→k+1; the last k has no k+1.
            here, after, k = order[i], order[i + 1], order[i + 2 :]
            gain = cost[here, after] - cost[here, k]
            gain[:-1] += cost[k[:-1], k[1:]] - cost[after, k[1:]]
            if gain.max() > 1e-12:
                end = i + 3 + int(np.argmax(gain))
                order[i + 1 : end] = order[i + 1 : end][::-1]
                improved = True
    return order


def without_dearest(order: NDArray[np.int64], cost: Floats, count: int) -> NDArray[np.int64]:
    """The tour without those points whose visit costs most, one by one, until ``count`` are left."""
    while len(order) > count:
        moves = np.concatenate([[0.0], cost[order[:-1], order[1:]], [0.0]])
        shortcuts = np.concatenate([[0.0], cost[order[:-2], order[2:]], [0.0]])
        order = np.delete(order, int(np.argmax(moves[:-1] + moves[1:] - shortcuts)))
    return order


def _nearest_first(from_start: Floats, cost: Floats) -> NDArray[np.int64]:
    order = [int(np.argmin(from_start))]
    left = np.ones(len(cost), dtype=bool)
    for _ in range(len(cost) - 1):
        left[order[-1]] = False
        order.append(int(np.argmin(np.where(left, cost[order[-1]], np.inf))))
    return np.array(order)
