"""Poses on hemispherical shells about the chucks, planned on the design model, in an order with short moves.

A shell is the set of positions of a sphere about a chuck with the ball-bar at mid-travel: ``‖T(q)·s − c‖ = zero``. The
measuring points are the crossings of a grid of latitudes and longitudes (Goswami, Quaid, Peshkin 1993, fig. 2) that the
arm reaches. At each point the tool faces the chuck, with a random tilt of up to ``MAX_TILT``, and is rotated about that
axis by a random angle over the full turn. With a constant tool orientation relative to the base, the measurements lose
rank (28 of 36).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from truearm.errors import Argument, PlanError
from truearm.model.chain import point_forward
from truearm.plan.branch_inverse import Arm, inverse
from truearm.plan.forecast import Known, known_arm
from truearm.plan.measurement_limits import Pairing, Site, allowed
from truearm.plan.visit_order import short_tour, untangled, without_dearest
from truearm.progress import steps_of
from truearm.types import BallBar, Floats, Plan, Point

# Between the tool's axis and the direction to the chuck. It separates the radius of a shell from the robot's size: with
# 35° the fit on 46 cm predicts 61 cm to 0.0890 mm (expected RMS, from 0.084 mm of noise), and to 0.103 mm in one run of
# a hundred; with 60° to 0.0875 mm and 0.095 mm.
MAX_TILT = np.deg2rad(60.0)
# Below, the bar would touch the table; above, longitudes crowd at the pole.
LOWEST, HIGHEST = np.deg2rad(12.0), np.deg2rad(84.0)
CUP_MARGIN = np.deg2rad(4.0)  # reserved for the path between poses
SURPLUS = 1.25  # poses searched for per pose visited: those with the most expensive visits are dropped
TRIES = 3  # orientations tried at a point before it counts as out of reach
FREE_TRAVEL = 0.015  # m
STRAIN_PER_SECOND = 0.008  # m: the excess strain that costs as much as a second of motion


def plan_shells(known: Known, bar: str, n_poses: int = 800, seed: int = 0, speed: Floats | None = None) -> Plan:
    """Return ``n_poses`` poses with one bar, spread evenly over all pairings of a chuck and a sphere, in order of their
    visits.

    ``speed`` (j,) [rad/s] weights the joints when the order of visits is chosen. Shells are named ``<bar>-<chuck>``.
    Raises PlanError if the arm has no branch or cannot reach that many points.
    """
    rig = known.rig
    pairings = [(chuck, sphere) for chuck in rig.chucks.values() for sphere in rig.spheres.values()]
    if n_poses < len(pairings):
        raise PlanError(f"{n_poses} poses are too few for {len(pairings)} pairings; give at least one pose per pairing")
    rng = np.random.default_rng(seed)
    arm = known_arm(known, rng)
    counts = np.diff(np.linspace(0, n_poses, len(pairings) + 1).astype(int))
    reached = _reachable(arm, rig.bars[bar], pairings, int(counts.max() * SURPLUS) + 1, rng)
    weights = np.ones(len(arm.chain.joints)) if speed is None else 1.0 / np.asarray(speed)
    here = 0.5 * (arm.branch.lower + arm.branch.upper)
    parts = []
    for (chuck, sphere), count, q in zip(pairings, counts, reached, strict=True):
        cost = move_costs(arm, q, weights, rig.bars[bar], chuck, sphere)
        order = short_tour(np.abs((q - here) * weights).max(axis=-1), cost)
        parts.append(q[untangled(without_dearest(order, cost, int(count)), cost)])
        here = parts[-1][-1]
    names = np.repeat(
        [(f"{bar}-{chuck.name}", bar, chuck.name, sphere.name) for chuck, sphere in pairings], counts, axis=0
    )
    return Plan(np.concatenate(parts), *names.T)


def candidates(site: Site, pairings: Sequence[Pairing], n: int, seed: int = 0, spread: float = 0.0) -> Plan:
    """Return ``n`` poses or a few more, spread over the pairings and their shells, within the site's limits.

    A pairing whose shell the arm can hardly reach gives fewer. ``spread`` [m]: the random deviation of the bar's length
    from mid-travel, in either direction, which separates a bar's gain from its zero. Raises PlanError if a pairing
    gives none.
    """
    rng = np.random.default_rng(seed)
    count = -(-n // len(pairings))
    for pairing in pairings:
        if _out_of_reach(site, pairing):
            raise PlanError(*_unreached(pairing))
    seeking = steps_of(pairings, f"looking for poses in reach of {len(pairings)} pairings")
    parts = [_of_pairing(site, pairing, count, spread, rng) for pairing in seeking]
    sizes = [len(q) for q in parts]
    if min(sizes) == 0:
        raise PlanError(*_unreached(pairings[sizes.index(0)]))
    names = [(f"{p.bar}-{p.chuck}", p.bar, p.chuck, p.sphere) for p in pairings]
    return Plan(np.concatenate(parts), *np.repeat(names, sizes, axis=0).T)


def _out_of_reach(site: Site, pairing: Pairing) -> bool:
    """Return whether a chuck is beyond the stretched arm with sphere and bar; checked before any search."""
    bar, mounted = pairing.of(site.rig)
    far = float(np.linalg.norm(mounted.p_chuck - site.arm.base))
    return far > site.arm.reach + float(np.linalg.norm(mounted.p_sphere)) + bar.zero + 0.5 * abs(bar.gain) * bar.travel


def _unreached(pairing: Pairing) -> tuple[str, ...]:
    return (
        f"the arm cannot reach any pose with bar {pairing.bar} between chuck {pairing.chuck} and sphere {pairing.sphere}; "
        "give another length of the bar, move the chucks, or allow more of the joints' range with ",
        Argument("branch"),
    )


def _of_pairing(site: Site, pairing: Pairing, count: int, spread: float, rng: np.random.Generator) -> Floats:
    """Return at most ``count`` joint vectors of one pairing; the grid is refined, up to a limit, as needed."""
    bar, mounted = pairing.of(site.rig)
    tilt = site.limits.sphere_angle - CUP_MARGIN
    n_places, q = 2 * count, np.zeros((0, len(site.arm.chain.joints)))
    for _ in range(4):
        directions = grid_directions(n_places, max(LOWEST, 0.5 * np.pi - site.limits.chuck_angle + 0.02))
        q = np.full((len(directions), len(site.arm.chain.joints)), np.nan)
        for _ in range(TRIES):
            left = np.flatnonzero(np.isnan(q[:, 0]))
            length = bar.zero + spread * rng.uniform(-1.0, 1.0, (len(left), 1))
            found = inverse(
                site.arm, _tool_poses(directions[left], length, mounted.p_chuck, mounted.p_sphere, rng, tilt)
            )
            good = ~np.isnan(found[:, 0])
            good[good] = allowed(site, found[good], pairing, site.limits.tightened())
            q[left[good]] = found[good]
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


def _reachable(
    arm: Arm, bar: BallBar, pairings: Sequence[tuple[Point, Point]], count: int, rng: np.random.Generator
) -> list[Floats]:
    """Return ``count`` joint vectors for each pairing; the grid is refined until all pairings reach enough of it."""
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
        f"the arm reaches too few poses with bar {bar.name} between chuck {chuck.name} and sphere {sphere.name}; "
        "give another length of the bar, move the chucks, or allow more of the joints' range"
    )


def _tool_poses(
    directions: Floats,
    length: float | Floats,
    p_chuck: Floats,
    p_sphere: Floats,
    rng: np.random.Generator,
    most: float = MAX_TILT,
) -> Floats:
    """Return end poses (m, 4, 4) with spheres on the shells and the tool's z axis towards the chuck, tilted and turned."""
    m = len(directions)
    tilt, azimuth, turn = most * np.sqrt(rng.random(m)), *(2.0 * np.pi * rng.random((2, m)))
    lat, lon = np.arcsin(directions[:, 2]), np.arctan2(directions[:, 1], directions[:, 0])
    facing = Rotation.from_euler("ZY", np.stack([lon, -0.5 * np.pi - lat], axis=-1))  # z axis along −direction
    varied = Rotation.from_euler("ZYZ", np.stack([azimuth, tilt, turn - azimuth], axis=-1))
    turned = facing * varied
    poses = np.tile(np.eye(4), (m, 1, 1))
    poses[:, :3, :3] = turned.as_matrix()
    poses[:, :3, 3] = p_chuck + length * directions - turned.apply(p_sphere)
    return poses


def move_costs(arm: Arm, q: Floats, weights: Floats, bar: BallBar, chuck: Point, sphere: Point) -> Floats:
    """Return the cost (m, m) of a move between any two poses: its duration squared, plus a penalty if it strains the
    bar.

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
