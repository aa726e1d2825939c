"""Poses on hemispherical shells about the chucks, planned on the design model, in an order with short moves.

A shell is the set of positions of a sphere about a chuck with the ball-bar at mid-travel: ``‖T(q)·s − c‖ = zero``. The
measuring points are the crossings of a grid of latitudes and longitudes (Goswami, Quaid, Peshkin 1993, fig. 2) that the
arm reaches. At each point the tool faces the chuck, with a random tilt, and is rotated about that axis by a random
angle over the full turn. With a constant tool orientation relative to the base, the measurements lose rank (28 of 36).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from truearm.errors import Argument, PlanError
from truearm.model.chain import point_forward
from truearm.plan.branches import Arm, inverse
from truearm.plan.measurement_limits import Pairing, Site, allowed
from truearm.progress import steps_of
from truearm.types import BallBar, Floats, Plan, Point

# Below, the bar would touch the table; above, longitudes crowd at the pole.
LOWEST, HIGHEST = np.deg2rad(12.0), np.deg2rad(84.0)
CUP_MARGIN = np.deg2rad(4.0)  # reserved for the path between poses
TRIES = 3  # orientations tried at a point before it counts as out of reach
FREE_TRAVEL = 0.015  # m
STRAIN_PER_SECOND = 0.008  # m: the excess strain that costs as much as a second of motion


def candidates(site: Site, pairings: Sequence[Pairing], n: int, seed: int = 0, spread: float = 0.0) -> Plan:
    """Return ``n`` poses or a few more, spread over the pairings and their shells, within the site's limits.

    A pairing whose shell the arm can hardly reach gives fewer. ``spread`` [m]: the random deviation of the bar's length
    from mid-travel, in either direction, which separates a bar's gain from its zero. Raises PlanError if a pairing
    gives none.
    """
    rng = np.random.default_rng(seed)
    joints: list[Floats] = []
    for pairing in steps_of(pairings, f"looking for poses in reach of {len(pairings)} pairings"):
        joints.append(_of_pairing(site, pairing, -(-n // len(pairings)), spread, rng))
        if not len(joints[-1]):
            raise PlanError(
                f"the arm cannot reach any pose with bar {pairing.bar} between chuck {pairing.chuck} and sphere "
                f"{pairing.sphere}; give another length of the bar, move the chucks, or allow more of the joints' range with ",
                Argument("branch"),
            )
    names = [(f"{p.bar}-{p.chuck}", p.bar, p.chuck, p.sphere) for p in pairings]
    return Plan(np.concatenate(joints), *np.repeat(names, list(map(len, joints)), axis=0).T)


def _of_pairing(site: Site, pairing: Pairing, count: int, spread: float, rng: np.random.Generator) -> Floats:
    """Return at most ``count`` joint vectors of one pairing; the grid is refined, up to a limit, as needed."""
    bar, mounted = pairing.of(site.rig)
    tilt = site.limits.sphere_angle - CUP_MARGIN
    n_places, q = 2 * count, np.zeros((0, len(site.arm.chain.joints)))
    for _ in range(4):
        directions = grid_directions(n_places, max(LOWEST, 0.5 * np.pi - site.limits.chuck_angle + 0.02))
        q = np.full((len(directions), len(site.arm.chain.joints)), np.nan)
        for _ in range(TRIES):
            missing = np.flatnonzero(np.isnan(q[:, 0]))
            length = bar.zero + spread * rng.uniform(-1.0, 1.0, (len(missing), 1))
            joints = inverse(
                site.arm, tool_poses(directions[missing], length, mounted.p_chuck, mounted.p_sphere, rng, tilt)
            )
            good = ~np.isnan(joints[:, 0])
            good[good] = allowed(site, joints[good], pairing, site.limits.tightened())
            q[missing[good]] = joints[good]
        q = q[~np.isnan(q[:, 0])]
        if len(q) >= count:
            return np.asarray(q[np.linspace(0, len(q) - 1, count).round().astype(int)])
        n_places *= 2
    return q


def grid_directions(n: int, lowest: float = LOWEST) -> Floats:
    """Return about n unit vectors (m, 3), m ≥ n, from a chuck to the crossings of a latitude/longitude grid.

    Rings of latitude alternate in direction, so that neighbours in the list are neighbours on the shell.
    """
    n_latitudes = max(3, int(np.ceil(np.sqrt(n / 4.0))))
    n_longitudes = int(np.ceil(n / n_latitudes))
    latitudes = np.linspace(lowest, HIGHEST, n_latitudes)
    longitudes = 2.0 * np.pi * np.arange(n_longitudes) / n_longitudes
    rings = [longitudes if i % 2 == 0 else longitudes[::-1] for i in range(n_latitudes)]
    lat, lon = np.repeat(latitudes, n_longitudes), np.concatenate(rings)
    return np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)], axis=-1)


def tool_poses(
    directions: Floats,
    length: float | Floats,
    p_chuck: Floats,
    p_sphere: Floats,
    rng: np.random.Generator,
    max_tilt: float,
) -> Floats:
    """Return end poses (m, 4, 4) with spheres on shells and the tool's z axis towards the chuck, tilted and turned."""
    m = len(directions)
    tilt, azimuth, turn = max_tilt * np.sqrt(rng.random(m)), *(2.0 * np.pi * rng.random((2, m)))
    lat, lon = np.arcsin(directions[:, 2]), np.arctan2(directions[:, 1], directions[:, 0])
    facing = Rotation.from_euler("ZY", np.stack([lon, -0.5 * np.pi - lat], axis=-1))  # z axis along −direction
    varied = Rotation.from_euler("ZYZ", np.stack([azimuth, tilt, turn - azimuth], axis=-1))
    turned = facing * varied
    poses = np.tile(np.eye(4), (m, 1, 1))
    poses[:, :3, :3] = turned.as_matrix()
    poses[:, :3, 3] = p_chuck + length * directions - turned.apply(p_sphere)
    return poses


def move_costs(arm: Arm, q: Floats, weights: Floats, bar: BallBar, chuck: Point, sphere: Point) -> Floats:
    """Return the cost (m, m) of a move between any two poses: its duration squared plus a penalty if it strains a bar.

    ``q`` (m, j) are the poses; ``weights`` (j,) [s/rad] make a duration of the angle by which a joint turns.

    Halfway between two poses of a shell the bar is shorter or longer than on it. The true robot deviates by up to 22 mm
    from the design model (with Table II's values), which leaves FREE_TRAVEL of half the travel, 37.5 mm, for the moves.
    """
    duration = np.abs((q[:, None] - q[None]) * weights).max(axis=-1)
    first, second = np.triu_indices(len(q), 1)
    p_halfway = point_forward(arm.chain, arm.params, 0.5 * (q[first] + q[second]), np.array(sphere.xyz))
    strain = np.zeros_like(duration)
    strain[first, second] = np.abs(np.linalg.norm(p_halfway - chuck.xyz, axis=-1) - bar.zero)
    strain += strain.T
    return np.asarray(duration**2 + (np.maximum(strain - FREE_TRAVEL, 0.0) / STRAIN_PER_SECOND) ** 2)
