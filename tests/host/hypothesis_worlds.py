"""Worlds for the engine of hypotheses: nine mounts of one bar, check poses on the first mount, and one fault each.

Robots are built in or a URDF, poses are random on hemispheres about the chucks, and the true arm differs from the
drawing by random tolerances. A fault is put into the world (a chuck, the base, a link, a reading), never into a column
of the engine; its seeds are those of this file alone.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path

import numpy as np
import plan_bench

from truearm.estimate.defaults import choose_defaults
from truearm.estimate.identify import SolverOptions, identify
from truearm.kinds.table import ObservationTable
from truearm.model.chain import point_forward, point_jacobians
from truearm.model.robot_file import builtin_robot, load_robot
from truearm.model.transforms import rotation
from truearm.plan.ball_bar_plan import all_pairings, make_site, plan_ballbar
from truearm.plan.forecast import Knowledge
from truearm.plan.options import Budget, PoseOptions
from truearm.plan.route import Visits
from truearm.types import BallBar, Rig

SIGMA = 84e-6  # m
PER_MOUNT, CHECKS = 40, 10  # poses; the checks are measured twice more, in the middle and at the end
PANDA_URDF = Path(__file__).parents[1] / "data" / "mukca" / "panda.urdf"
PANDA_RIG = Rig(
    plan_bench.triangle("c", (0.42, 0.05, 0.06), 0.14), plan_bench.triangle("s", (0.0, 0.0, 0.05), 0.08), {}
)
RIGS = plan_bench.RIGS | {"panda": PANDA_RIG, "urdf": PANDA_RIG}
BARS = {"puma560": ("bar46", 0.46), "ur5e": ("bar35", 0.35), "irb120": ("bar25", 0.25)}
STROKE = 0.03  # m: half of it
N_POSES = 360
CANDIDATES = 4
LONG_LEVERS = 3  # joints: an error of 0.3 mrad of a wrist joint moves the sphere by less than the noise


@dataclass(frozen=True)
class Site:
    """A robot with its rig and the poses of a session, in order: names of chuck and sphere of each."""

    chain: object
    free: object
    rig: Rig
    q: object  # (n, j)
    chuck: object  # (n,)
    sphere: object  # (n,)
    first: object  # (n,) whether a row belongs to the nine mounts, not to the checks


@dataclass(frozen=True)
class World:
    """A site with its true arm and what was measured there; ``names`` of the engine are right for its fault."""

    site: Site
    truth: object  # (p,) parameters at the start
    table: ObservationTable
    names: tuple[str, ...] = ()


@cache
def site(robot, visits=1, planned=False):
    """Return the site of a robot by its name; ``visits``: how often each mount is returned to.

    ``planned``: with poses by the planner, as ``truearm plan ballbar`` orders them; this takes 10 s.
    """
    of = load_robot(str(PANDA_URDF), None, "ball_link") if robot == "urdf" else builtin_robot(robot)
    name, zero = BARS.get(robot, ("bar40", 0.40))
    rig = replace(RIGS[robot], bars={name: BallBar(name, zero, 1.0, 0.075, SIGMA)})
    if planned and not of.is_urdf:
        design = replace(Knowledge.design(of, rig), links=None)  # thin links: as tests/host/fault_worlds.py
        where = make_site(design, plan_bench.LIMITS, plan_bench.SIZES)
        times = Visits(visits, 10 if visits == 1 else 0)
        options = PoseOptions(candidates=2000)
        plan = plan_ballbar(where, design, all_pairings(rig), Budget(N_POSES), options, times).route.plan
        return Site(of.chain, of.free, rig, plan.q, plan.chuck, plan.sphere, np.ones(len(plan), dtype=bool))
    rng, q, pairs = np.random.default_rng(7), [], []
    each = {}
    for number, chuck in enumerate(rig.chucks):
        for sphere in list(rig.spheres)[:: -1 if number % 2 else 1]:  # one part is changed at a time
            each[chuck, sphere] = informative(of, rig.chucks[chuck], rig.spheres[sphere], zero, rng)
    checks = next(iter(each.values()))[:CHECKS]
    start = next(iter(each))
    part = PER_MOUNT // visits
    first = []
    for visit in range(visits):
        for number, (pair, poses) in enumerate(each.items()):
            mine = poses[visit * part : (visit + 1) * part]
            q.append(mine)
            pairs += [pair] * len(mine)
            first += [True] * len(mine)
            if visits == 1 and number in (4, 8):
                q.append(checks)
                pairs += [start] * CHECKS
                first += [False] * CHECKS
    chucks, spheres = np.array(pairs).T
    return Site(of.chain, of.free, rig, np.concatenate(q), chucks, spheres, np.array(first))


def informative(of, chuck, sphere, radius, rng):
    """Return PER_MOUNT of several times as many poses: each next one tells most about the free parameters."""
    q = on_shell(of.chain, chuck, sphere, radius, CANDIDATES * PER_MOUNT, rng)
    at, by_robot, _ = point_jacobians(of.chain, of.chain.params_nominal, q, np.array(sphere.xyz))
    bar = at - np.array(chuck.xyz)
    tolerance = np.array([{"m": 0.5e-3, "rad": 2e-3}.get(p.unit, 0.0) for p in of.chain.parameters]) * of.free
    rows = np.einsum("ni,nip->np", bar / np.linalg.norm(bar, axis=1)[:, None], by_robot) * tolerance / SIGMA
    covariance, picked = np.eye(rows.shape[1]), []
    for _ in range(PER_MOUNT):
        told = np.einsum("np,pq,nq->n", rows, covariance, rows, optimize=True)
        told[picked] = -1.0
        picked.append(int(np.argmax(told)))
        along = covariance @ rows[picked[-1]]
        covariance -= np.outer(along, along) / (1.0 + rows[picked[-1]] @ along)
    return q[picked]


def on_shell(chain, chuck, sphere, radius, n, rng):
    """Return poses (n, j) with a sphere near a hemisphere about a chuck, within the joint limits."""
    lower, upper = (np.clip(limit, -2.6, 2.6) for limit in chain.limits)
    kept = np.zeros((0, lower.size))
    while len(kept) < n:
        u = rng.normal(size=(6 * n, 3))
        u[:, 2] = np.abs(u[:, 2])
        u /= np.linalg.norm(u, axis=1, keepdims=True)
        goal = np.array(chuck.xyz) + (radius + rng.uniform(-STROKE, STROKE, (6 * n, 1))) * u
        q = rng.uniform(lower, upper, (6 * n, lower.size))
        for _ in range(25):
            at, _, by_joints = point_jacobians(chain, chain.params_nominal, q, np.array(sphere.xyz))
            square = by_joints @ by_joints.swapaxes(1, 2) + 1e-4 * np.eye(3)
            step = (by_joints.swapaxes(1, 2) @ np.linalg.solve(square, (goal - at)[..., None]))[..., 0]
            q = np.clip(q + np.clip(step, -0.5, 0.5), lower, upper)
        at = point_forward(chain, chain.params_nominal, q, np.array(sphere.xyz))
        kept = np.concatenate([kept, q[np.linalg.norm(at - goal, axis=1) < 1e-3]])
    return kept[:n]


def true_arm(of, rng):
    """Return the parameters (p,) of an arm within 0.5 mm and 2 mrad of the drawing."""
    tolerance = np.array([{"m": 0.5e-3, "rad": 2e-3}.get(p.unit, 0.0) for p in of.chain.parameters])
    return of.chain.params_nominal + of.free * tolerance * rng.normal(size=tolerance.size)


def points(of, truth, q, sphere_off=0.0):
    places = np.array([of.rig.spheres[name].xyz for name in of.sphere]) + sphere_off
    return point_forward(of.chain, truth, q, places)


def chucks(of):
    return np.array([of.rig.chucks[name].xyz for name in of.chuck])


def measured(of, truth, length, rng, names=(), noise=None, chuck=None, sphere=None):
    n = len(of.q)
    noise = SIGMA * rng.normal(size=n) if noise is None else noise
    (bar,) = of.rig.bars
    labels = {
        "bar": bar,
        "chuck": of.chuck if chuck is None else chuck,
        "sphere": of.sphere if sphere is None else sphere,
    }
    source = [f"poses.csv row {i + 2}" for i in range(n)]
    table = ObservationTable(q=of.q, kind="ball_bar", value=length + noise, source=source, **labels)
    return World(of, truth, table, names)


def direction(rng):
    u = rng.normal(size=3)
    return u / np.linalg.norm(u)


def clean(of, rng, amount=0.0):
    truth = true_arm(of, rng)
    return measured(of, truth, np.linalg.norm(points(of, truth, of.q) - chucks(of), axis=1), rng)


def slip(of, rng, amount=0.3e-3):
    """A chuck or a sphere moves in the middle of its use, in a random direction."""
    truth, u = true_arm(of, rng), direction(rng)
    which = rng.integers(2)
    column, kind = ((of.chuck, "chuck"), (of.sphere, "sphere"))[which]
    name = rng.choice(np.unique(column))
    mine = np.flatnonzero(column == name)
    at = mine[int(len(mine) * rng.uniform(0.15, 0.85))]
    off = ((np.arange(len(of.q)) >= at) & (column == name))[:, None] * amount * u
    bar = points(of, truth, of.q, off if which else 0.0) - chucks(of) - (0.0 if which else off)
    return measured(of, truth, np.linalg.norm(bar, axis=1), rng, (f"{kind}.{name}.step",))


def wrong_chuck(of, rng, amount):
    """A chuck is elsewhere than the rig says, from the first row on; across the plane of all chucks, the base follows."""
    truth, name = true_arm(of, rng), rng.choice(np.unique(of.chuck))
    off = (of.chuck == name)[:, None] * amount * direction(rng)
    bar = points(of, truth, of.q) - chucks(of) - off
    return measured(of, truth, np.linalg.norm(bar, axis=1), rng, (f"chuck.{name}.offset",))


def on_length(change, *names):
    """Return a fault that adds ``change(of, bar (n, 3), t (n,), amount, rng)`` to the lengths."""

    def fault(of, rng, amount):
        truth = true_arm(of, rng)
        bar = points(of, truth, of.q) - chucks(of)
        length = np.linalg.norm(bar, axis=1)
        t = np.linspace(0.0, 1.0, len(length))
        (label,) = of.rig.bars
        added = change(bar / length[:, None], length, t, amount, rng)
        return measured(of, truth, length + added, rng, tuple(name.format(bar=label) for name in names))

    return fault


def cable(u, length, t, amount, rng):
    return amount * np.cos(np.arctan2(u[:, 1], u[:, 0]) - rng.uniform(0.0, 2.0 * np.pi))


def hysteresis(u, length, t, amount, rng):
    return amount * np.sign(np.diff(length, prepend=length[0]))


def pads(u, length, t, amount, rng):
    return amount * np.cos(3.0 * np.arctan2(u[:, 1], u[:, 0]))


def creep(of, rng, amount):
    """The base tilts towards the table or away from it, linearly in time."""
    truth, n = true_arm(of, rng), len(of.q)
    turns = rotation(np.linspace(0.0, rng.choice([-1.0, 1.0]) * amount, n)[:, None] * [0.0, 1.0, 0.0])
    moved = np.einsum("nij,nj->ni", turns, points(of, truth, of.q))
    return measured(of, truth, np.linalg.norm(moved - chucks(of), axis=1), rng, ("base.tilt.drift", "base.drift"))


def growth(of, rng, amount):
    """A link of the arm grows, linearly in time: the one whose growth turns most with the poses, such as the upper arm."""
    truth = true_arm(of, rng)
    best = None
    for link in (i for i, p in enumerate(of.chain.parameters) if p.unit == "m" and of.free[i]):
        step = 1e-4 * np.eye(truth.size)[link]
        by_link = (points(of, truth + step, of.q) - points(of, truth - step, of.q)) / 2e-4
        turns = abs(truth[link]) * by_link.std(axis=0).max()
        best = max(best or (0.0, 0, by_link), (turns, link, by_link), key=lambda one: one[0])
    _, link, by_link = best
    moved = points(of, truth, of.q) + np.linspace(0.0, amount, len(of.q))[:, None] * by_link
    name = of.chain.parameter_names[link]
    return measured(of, truth, np.linalg.norm(moved - chucks(of), axis=1), rng, (f"{name}.drift", "arm.growth"))


def joint_off(change, *forms):
    """Return a fault by which a joint's link is off its reading by ``change(q_j (n,), amount, rng)``."""

    def fault(of, rng, amount):
        truth = true_arm(of, rng)
        joint = int(rng.integers(LONG_LEVERS))
        off = np.zeros_like(of.q)
        off[:, joint] = change(of.q[:, joint], amount, rng)
        name = of.chain.joints[joint].name
        length = np.linalg.norm(points(of, truth, of.q + off) - chucks(of), axis=1)
        return measured(of, truth, length, rng, tuple(f"{name}.{form}" for form in forms))

    return fault


def play(reading, amount, rng):
    return -0.5 * amount * np.sign(np.diff(reading, prepend=reading[0]))


def jump(reading, amount, rng):
    n = reading.size
    return amount * (np.arange(n) >= int(n * rng.uniform(0.15, 0.85)))


def mislabelled(of, rng, whole=True):
    """One mount, or its second half, was measured with another sphere or chuck than its label says."""
    world = clean(of, rng)
    run = np.cumsum(np.concatenate([[0], (of.chuck[1:] != of.chuck[:-1]) | (of.sphere[1:] != of.sphere[:-1])]))
    mine = np.flatnonzero(run == rng.integers(run.max() + 1))
    mine = mine if whole else mine[len(mine) // 2 :]
    column, names = (("sphere", of.rig.spheres), ("chuck", of.rig.chucks))[rng.integers(2)]
    label = getattr(of, column).copy()
    label[mine] = rng.choice([name for name in names if name != label[mine[0]]])
    return replace(world, table=world.table.replace(**{column: label}))


# Faults of the list: what happens, its size [SI], and how often it must be in the list.
FAULTS = {
    "slip": (slip, 0.3e-3, 0.9),
    "small slip": (slip, 0.2e-3, 0.7),
    "wrong chuck": (wrong_chuck, 0.5e-3, 0.8),
    "bar": (on_length(lambda u, length, t, a, rng: a, "bar.{bar}.zero.offset"), 0.3e-3, 0.9),
    "bar drift": (on_length(lambda u, length, t, a, rng: a * t, "bar.{bar}.zero.drift"), 0.2e-3, 0.9),
    "creep": (creep, 0.5e-3, 0.9),
    "growth": (growth, 0.25e-3, 0.9),
    "hysteresis": (on_length(hysteresis, "bar.hysteresis"), 40e-6, 0.9),
    "backlash": (joint_off(play, "backlash"), 0.3e-3, 0.9),
    "cable": (on_length(cable, "bar.azimuth", "bar.lean"), 0.12e-3, 0.7),  # 129 of 150 worlds
    "encoder step": (joint_off(jump, "step", "run"), 0.3e-3, 0.5),
}


def tilting(course):
    """Return a fault by which the base tilts by ``course(t (n,), rng)`` (n, 3) [rad] over the session."""

    def fault(of, rng):
        truth = true_arm(of, rng)
        turns = rotation(course(np.linspace(0.0, 1.0, len(of.q)), rng))
        moved = np.einsum("nij,nj->ni", turns, points(of, truth, of.q))
        names = [f"base{item}.{form}" for item in ("", ".tilt") for form in ("drift", "step")]
        return measured(of, truth, np.linalg.norm(moved - chucks(of), axis=1), rng, tuple(names))

    return fault


def out_and_back(t, rng):
    """As the sun on a wall makes it."""
    return 0.5e-3 * np.sin(np.pi * t)[:, None] * [1.0, 0.0, 0.0]


def wandering(t, rng):
    """A random walk about both level axes, 0.5 mrad at its end."""
    steps = rng.normal(size=(t.size, 3)) * [1.0, 1.0, 0.0]
    return 0.5e-3 * np.cumsum(steps, axis=0) / np.sqrt(t.size)


def swaying(t, rng):
    """Somewhat more than one period about a random level axis."""
    axis, phase = rng.uniform(0.0, 2.0 * np.pi, 2)
    return 0.4e-3 * np.sin(2.6 * np.pi * t + phase)[:, None] * [np.cos(axis), np.sin(axis), 0.0]


def slow_noise(of, rng, amount=0.9):
    """Outside the list: noise that neighbours share, AR(1) with that coefficient."""
    noise = neighbours_noise(len(of.q), amount, rng)
    world = clean(of, rng)
    length = np.linalg.norm(points(of, world.truth, of.q) - chucks(of), axis=1)
    return measured(of, world.truth, length, rng, noise=noise)


def neighbours_noise(n, correlation, rng):
    """Return AR(1) noise (n,) [m] of the size SIGMA."""
    noise = [SIGMA * rng.normal()]
    for step in rng.normal(size=n - 1):
        noise.append(correlation * noise[-1] + SIGMA * np.sqrt(1.0 - correlation**2) * step)
    return np.array(noise)


def worn_gear(of, rng, amount=0.15e-3):
    """Outside the list: a gear of joint 2 with nine teeth to the turn."""
    truth, off = true_arm(of, rng), np.zeros_like(of.q)
    off[:, 1] = amount * np.sin(9.0 * of.q[:, 1] + rng.uniform(0.0, 2.0 * np.pi))
    return measured(of, truth, np.linalg.norm(points(of, truth, of.q + off) - chucks(of), axis=1), rng)


RETURNING = tilting(out_and_back)  # in the list, but most plans show little of it
OUTSIDE = {
    "slow noise": slow_noise,
    "worn gear": worn_gear,
    "wandering base": tilting(wandering),
    "swaying base": tilting(swaying),
}


LABELS = {"clean": clean, "mislabelled": mislabelled, "partly mislabelled": partial(mislabelled, whole=False)}


# The fault of the recipe in docs/how-to/extending.md, which is in the list of the tests alone.
RECIPE = on_length(pads, "bar.pads")


def with_mount_again(of, names):
    """Return a site where the poses of a mount, such as ("chuck c2", "sphere s3"), are measured again at the end."""
    rows = np.flatnonzero(
        of.first
        & np.array([{f"chuck {c}", f"sphere {s}"} == set(names) for c, s in zip(of.chuck, of.sphere, strict=True)])
    )
    rows = np.r_[np.arange(len(of.q)), rows]
    first = of.first[rows] & (np.arange(len(rows)) < len(of.q))
    return replace(of, q=of.q[rows], chuck=of.chuck[rows], sphere=of.sphere[rows], first=first)


def world(robot, fault, seed, visits=1, planned=False, of=None):
    """Return a world by the names of robot and fault, deterministically."""
    rng = np.random.default_rng([seed, sum(map(ord, robot + fault)), 0xFA17])
    if fault in FAULTS:
        make, amount, _ = FAULTS[fault]
        return make(of or site(robot, visits, planned), rng, amount)
    return (OUTSIDE | LABELS | {"out and back": RETURNING})[fault](site(robot, visits, planned), rng)


def identified(world):
    """Return an estimate of a world's table and the prior (p,) of its robot, as ``truearm identify`` chooses both."""
    of = world.site
    nothing = np.zeros(of.free.size, dtype=bool)
    free, sigma, _ = choose_defaults(of.chain, of.rig, world.table, of.free, nothing, prior=True)
    options = SolverOptions(reject=True)
    return identify(of.chain, of.rig, world.table, free=free, prior_sigma=sigma, prefer=of.free, options=options), sigma


def tool_error(world, values):
    """Return the true RMS error [m] of the tool for parameters (P,) over the mounts' poses."""
    of, p = world.site, world.truth.size
    apart = points(of, values[:p], of.q) - points(of, world.truth, of.q)
    return float(np.sqrt((apart[of.first] ** 2).sum(axis=1).mean()))
