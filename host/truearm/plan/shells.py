"""Poses on hemispherical shells about the chucks, planned on the design model, in an order that keeps moves short.

A shell holds the places of a sphere that a ball-bar at mid-travel allows about a chuck: ``‖T(q)·s − c‖ = zero``. The
measuring places are the crossings of a grid of latitudes and longitudes (Goswami, Quaid, Peshkin 1993, fig. 2), those
that the arm reaches. At each place the tool faces the chuck, but for a tilt drawn up to ``MAX_TILT``, and is turned about
that axis by an angle drawn over the whole turn: with a constant tool orientation relative to the base the measurements
lose rank (28 of 36).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from truearm.errors import PlanError
from truearm.model.chain import Chain, point_forward
from truearm.plan.inverse import PUMA_ELBOW_UP, Arm, Branch, inverse, make_arm
from truearm.plan.tour import short_tour, untangled, without_dearest
from truearm.types import BallBar, Floats, Plan, Point, Rig

# Between the tool's axis and the direction to the chuck. It is what tells the radius of a shell from the robot's size:
# with 35° the fit on 46 cm predicts 61 cm to 0.0890 mm (expected RMS, of 0.084 mm noise), in one of a hundred
# runs to 0.103 mm; with 60° to 0.0875 mm and 0.095 mm.
MAX_TILT = np.deg2rad(60.0)
# Below, the bar would touch the table; above, longitudes crowd at the pole.
LOWEST, HIGHEST = np.deg2rad(12.0), np.deg2rad(84.0)
SURPLUS = 1.25  # poses sought for one visited: the dearest to visit are left out
TRIES = 3  # orientations tried at a place before it counts as out of reach
FREE_TRAVEL = 0.015  # m
STRAIN_PER_SECOND = 0.008  # m: how much strain beyond that is as dear as a second of motion


def plan_shells(
    chain: Chain,
    params: Floats,
    rig: Rig,
    bar: str,
    n_poses: int = 800,
    seed: int = 0,
    branch: Branch = PUMA_ELBOW_UP,
    speed: Floats | None = None,
) -> Plan:
    """``n_poses`` poses with one bar, spread evenly over all pairings of a chuck and a sphere, in order of their visits.

    ``params`` (p,) is the model that the robot is programmed with, ``speed`` (j,) [rad/s] weighs the joints where the
    order of visits is chosen. Shells are named ``<bar>-<chuck>``.
    Raises PlanError where the arm does not reach that many places.
    """
    pairings = [(chuck, sphere) for chuck in rig.chucks.values() for sphere in rig.spheres.values()]
    if n_poses < len(pairings):
        raise PlanError(f"{n_poses} poses are too few for {len(pairings)} pairings")
    rng = np.random.default_rng(seed)
    arm = make_arm(chain, params, branch, rng)
    counts = np.diff(np.linspace(0, n_poses, len(pairings) + 1).astype(int))
    reached = _reachable(arm, rig.bars[bar], pairings, int(counts.max() * SURPLUS) + 1, rng)
    weights = np.ones(len(chain.joints)) if speed is None else 1.0 / np.asarray(speed)
    here = 0.5 * (branch.lower + branch.upper)
    parts = []
    for (chuck, sphere), count, q in zip(pairings, counts, reached, strict=True):
        cost = _move_costs(arm, q, weights, rig.bars[bar], chuck, sphere)
        order = short_tour(np.abs((q - here) * weights).max(axis=-1), cost)
        parts.append(q[untangled(without_dearest(order, cost, int(count)), cost)])
        here = parts[-1][-1]
    names = np.repeat(
        [(f"{bar}-{chuck.name}", bar, chuck.name, sphere.name) for chuck, sphere in pairings], counts, axis=0
    )
    return Plan(np.concatenate(parts), *names.T)


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


def _reachable(
    arm: Arm, bar: BallBar, pairings: Sequence[tuple[Point, Point]], count: int, rng: np.random.Generator
) -> list[Floats]:
    """``count`` joint vectors for each pairing; the grid is made finer until enough of it is in reach of all."""
    p_chuck, p_sphere = np.array([(chuck.xyz, sphere.xyz) for chuck, sphere in pairings]).swapaxes(0, 1)
    n_places = 3 * count
    for _ in range(5):
        directions = grid_directions(n_places)
        pairing, place = np.divmod(np.arange(len(pairings) * len(directions)), len(directions))
        q = np.full((len(place), len(arm.chain.joints)), np.nan)
        for _ in range(TRIES):
            left = np.flatnonzero(np.isnan(q[:, 0]))
            which = pairing[left]
            q[left] = inverse(arm, _tool_poses(directions[place[left]], bar.zero, p_chuck[which], p_sphere[which], rng))
        found = [q[(pairing == i) & ~np.isnan(q[:, 0])] for i in range(len(pairings))]
        if min(map(len, found)) >= count:
            return [rows[np.linspace(0, len(rows) - 1, count).round().astype(int)] for rows in found]
        n_places *= 2
    chuck, sphere = pairings[int(np.argmin([len(rows) for rows in found]))]
    raise PlanError(
        f"the arm reaches too few places of bar {bar.name} between chuck {chuck.name} and sphere {sphere.name}; "
        "move the chucks"
    )


def _tool_poses(
    directions: Floats, length: float, p_chuck: Floats, p_sphere: Floats, rng: np.random.Generator
) -> Floats:
    """End poses (m, 4, 4) with the spheres on the shells and the tool's z axis towards the chuck, tilted and turned."""
    m = len(directions)
    tilt, azimuth, turn = MAX_TILT * np.sqrt(rng.random(m)), *(2.0 * np.pi * rng.random((2, m)))
    lat, lon = np.arcsin(directions[:, 2]), np.arctan2(directions[:, 1], directions[:, 0])
    facing = Rotation.from_euler("ZY", np.stack([lon, -0.5 * np.pi - lat], axis=-1))  # z axis along −direction
    varied = Rotation.from_euler("ZYZ", np.stack([azimuth, tilt, turn - azimuth], axis=-1))
    turned = facing * varied
    poses = np.tile(np.eye(4), (m, 1, 1))
    poses[:, :3, :3] = turned.as_matrix()
    poses[:, :3, 3] = p_chuck + length * directions - turned.apply(p_sphere)
    return poses


def _move_costs(arm: Arm, q: Floats, weights: Floats, bar: BallBar, chuck: Point, sphere: Point) -> Floats:
    """Cost (m, m) of a move between any two poses: its duration squared, and more where it strains the bar.

    Halfway between two poses of a shell the bar is shorter or longer than on it. The true robot strays by up to 22 mm
    from the design model (at Table II's values), which leaves FREE_TRAVEL of half the travel, 37.5 mm, to the moves.
    """
    duration = np.abs((q[:, None] - q[None]) * weights).max(axis=-1)
    first, second = np.triu_indices(len(q), 1)
    p_halfway = point_forward(arm.chain, arm.params, 0.5 * (q[first] + q[second]), np.array(sphere.xyz))
    strain = np.zeros_like(duration)
    strain[first, second] = np.abs(np.linalg.norm(p_halfway - chuck.xyz, axis=-1) - bar.zero)
    strain += strain.T
    return np.asarray(duration**2 + (np.maximum(strain - FREE_TRAVEL, 0.0) / STRAIN_PER_SECOND) ** 2)
